"""Raw parameters of a trained splat, and the validation of splat files."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, fields
from functools import cached_property
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from normlift_ns.core.gaussians import GaussianScene
from normlift_ns.errors import InputError

DEGREES = {0: 0, 3: 1, 8: 2, 15: 3, 24: 4}
"""Degree of the spherical harmonics by the number of coefficients beyond the constant one."""
_MAX_MEDIAN_WIDTH = 0.02
"""Largest plausible width of the median Gaussian, as a fraction of the scene. If a file has no negative log scales and
exceeds it, its scales are linear."""

_DTYPES = (torch.float16, torch.bfloat16, torch.float32, torch.float64)
_SAMPLE_SIZE, _BLOCK_ROWS = 2**20, 2**18
_MIN_LOGITS = 100
"""Number of Gaussians from which logits that all lie in 0..1 cannot be a coincidence."""


@dataclass(frozen=True)
class Splat:
    """Raw parameters of N Gaussians, as trainers store them."""

    means: Float[Tensor, "n 3"]
    quats: Float[Tensor, "n 4"]
    """Rotations as (w, x, y, z)."""
    scales: Float[Tensor, "n 3"]
    """Logarithms of the standard deviations."""
    opacities: Float[Tensor, "n 1"]
    """Logits."""
    features_dc: Float[Tensor, "n 3"]
    """Constant spherical harmonic of the colors."""
    features_rest: Float[Tensor, "n k 3"]
    """Remaining spherical harmonics: K = 0, 3, 8, 15 or 24."""

    def __len__(self) -> int:
        return len(self.means)

    @property
    def parameters(self) -> dict[str, Tensor]:
        """The tensors by splatfacto's names."""
        return {item.name: getattr(self, item.name) for item in fields(self)}

    @property
    def degree(self) -> int:
        """Degree of the spherical harmonics."""
        return DEGREES[self.features_rest.shape[1]]

    @cached_property
    def activated(self) -> GaussianScene:
        """The Gaussians with activated scales and opacities, as a rasterizer takes them."""
        return GaussianScene(self.means, self.quats, self.scales.exp(), self.opacities.sigmoid().squeeze(-1))


def check_splat(splat: Splat, file: Path) -> None:
    """Raise if the Gaussians cannot be drawn.

    Raises:
        ValueError: if there are no Gaussians, values are not finite, all rotations are zero, scales are not logarithms,
            or opacities are not logits.
    """
    if len(splat) == 0:
        raise InputError(f"{file} holds no Gaussians. Export the scene again.")
    for name, values in _activated_values(splat):
        blocks = values.reshape(len(splat), -1).split(_BLOCK_ROWS)
        invalid = torch.cat([~block.isfinite().all(dim=1) for block in blocks]).nonzero()
        if len(invalid) > 0:
            raise InputError(
                f"{file} has {len(invalid):,} of {len(splat):,} Gaussians whose {name} are NaN or infinite, the first "
                f"in row {int(invalid[0])}. Expected finite numbers. Remove those Gaussians; for a PLY file, for "
                f"example, with: splat-transform {file.name} --filter-nan clean.ply"
            )
    lengths = splat.quats.abs().amax(dim=1)
    if bool((lengths == 0).all()):
        raise InputError(f"{file} has only zero quaternions, so no Gaussian can be drawn. Export the scene again.")
    low, high = float(splat.opacities.min()), float(splat.opacities.max())
    if len(splat) >= _MIN_LOGITS and low >= 0 and high <= 1:
        raise InputError(
            f"{file} seems to hold opacities, between {low:.3g} and {high:.3g}, instead of their logits. Expected "
            "logits, as all splat trainers write them; store log(opacity / (1 - opacity))."
        )
    sample = splat.means[:: max(1, len(splat) // _SAMPLE_SIZE)]
    left, right = sample.quantile(0.05, dim=0), sample.quantile(0.95, dim=0)
    extent, width = float((right - left).amax()), float(splat.scales.median().exp())
    if bool((splat.scales >= 0).all()) and extent > 0 and width > _MAX_MEDIAN_WIDTH * extent:
        raise InputError(
            f"{file} seems to hold linear scales, between {float(splat.scales.min()):.3g} and "
            f"{float(splat.scales.max()):.3g}: read as logarithms, they make the median Gaussian {width:.3g} wide in "
            f"a scene of {extent:.3g}. Expected natural logarithms, as all splat trainers write them; store log(scale)."
        )


def _activated_values(splat: Splat) -> Iterator[tuple[str, Tensor]]:
    """Yield the values that must be finite; logits and logarithms themselves may be infinite."""
    yield "means", splat.means
    yield "rotations", splat.quats
    yield "scales", splat.activated.scales
    yield "opacities", splat.activated.opacities
    yield "colors", splat.features_dc
    yield "colors", splat.features_rest


def from_parameters(parameters: Mapping[str, Tensor], file: Path) -> Splat:
    """Return a float32 splat from a trainer's tensors, after checking their types and shapes.

    Args:
        parameters: tensors by splatfacto's names.
        file: their file, for messages.
    Raises:
        ValueError: if there are no Gaussians, or a tensor has the wrong shape or is not float16, bfloat16, float32 or
            float64.
    """
    n = len(parameters["means"]) if parameters["means"].ndim > 0 else 0
    if parameters["means"].ndim == 2 and n == 0:
        raise InputError(f"{file} holds no Gaussians. Give the file of a training run that kept some.")
    shapes = {"means": (3,), "quats": (4,), "scales": (3,), "opacities": (1,), "features_dc": (3,)}
    for name, shape in shapes.items():
        value = parameters[name]
        if tuple(value.shape) != (n, *shape) or value.dtype not in _DTYPES:
            raise InputError(
                f"{file}: {name} is {value.dtype} {tuple(value.shape)}, expected floating-point numbers of shape "
                f"{(n, *shape)}, one row per Gaussian. Copy the file again, or give that of another training run."
            )
    rest = parameters["features_rest"]
    if (
        rest.ndim != 3
        or len(rest) != n
        or rest.shape[2] != 3
        or rest.shape[1] not in DEGREES
        or rest.dtype not in _DTYPES
    ):
        raise InputError(
            f"{file}: its spherical harmonics have shape {tuple(rest.shape)} and type {rest.dtype}, expected "
            f"floating-point numbers of shape ({n}, K, 3) with K = {', '.join(map(str, DEGREES))} for degrees "
            f"{', '.join(map(str, DEGREES.values()))}. Copy the file again, or give that of another training run."
        )
    return Splat(**{name: parameters[name].detach().float() for name in (*shapes, "features_rest")})
