"""The Gaussians of a splat as they were trained, and the checks that every file of them must pass."""

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
"""Degree of the spherical harmonics by their number beyond the constant one."""
_WIDE = 0.02
"""A median Gaussian wider than this share of the scene, in a file without negative logarithms: they are none."""

_PRECISIONS = (torch.float16, torch.bfloat16, torch.float32, torch.float64)
_SAMPLE, _BLOCK = 2**20, 2**18
_MANY = 100
"""Gaussians from which logits that all lie in 0..1 are no chance."""


@dataclass(frozen=True)
class Splat:
    """N Gaussians with raw parameters, as trainers store them."""

    means: Float[Tensor, "n 3"]
    quats: Float[Tensor, "n 4"]
    """Rotations as (w, x, y, z)."""
    scales: Float[Tensor, "n 3"]
    """Logarithms of the standard deviations."""
    opacities: Float[Tensor, "n 1"]
    """Logits."""
    features_dc: Float[Tensor, "n 3"]
    """The constant spherical harmonic of the colours."""
    features_rest: Float[Tensor, "n k 3"]
    """The others: K = 0, 3, 8, 15 or 24."""

    def __len__(self) -> int:
        return len(self.means)

    @property
    def parameters(self) -> dict[str, Tensor]:
        """By the names that splatfacto gives them."""
        return {item.name: getattr(self, item.name) for item in fields(self)}

    @property
    def degree(self) -> int:
        """Degree of the spherical harmonics."""
        return DEGREES[self.features_rest.shape[1]]

    @cached_property
    def activated(self) -> GaussianScene:
        """The Gaussians as a rasterizer sees them."""
        return GaussianScene(self.means, self.quats, self.scales.exp(), self.opacities.sigmoid().squeeze(-1))


def check_splat(splat: Splat, file: Path) -> None:
    """Refuses Gaussians that nothing could draw.

    Raises:
        ValueError: none at all, values that are not finite, rotations of length zero, scales that are no logarithms,
            opacities that are no logits.
    """
    if len(splat) == 0:
        raise InputError(f"{file} holds no Gaussians at all. Export the scene again.")
    for name, values in _drawn(splat):
        blocks = values.reshape(len(splat), -1).split(_BLOCK)
        wrong = torch.cat([~block.isfinite().all(dim=1) for block in blocks]).nonzero()
        if len(wrong) > 0:
            raise InputError(
                f"{file} has {len(wrong):,} of {len(splat):,} Gaussians whose {name} are NaN or infinite, the first in "
                f"row {int(wrong[0])}. Expected finite numbers; remove those Gaussians, for a PLY "
                f"file for example with: splat-transform {file.name} --filter-nan clean.ply"
            )
    lengths = splat.quats.abs().amax(dim=1)
    if bool((lengths == 0).all()):
        raise InputError(f"{file} has rotations of zeros only, so nothing of it can be drawn. Export the scene again.")
    low, high = float(splat.opacities.min()), float(splat.opacities.max())
    if len(splat) >= _MANY and low >= 0 and high <= 1:
        raise InputError(
            f"{file} seems to hold opacities, between {low:.3g} and {high:.3g}, in place of their logits. Expected "
            "logits, as all splat trainers write them; store log(opacity / (1 - opacity))."
        )
    some = splat.means[:: max(1, len(splat) // _SAMPLE)]
    left, right = some.quantile(0.05, dim=0), some.quantile(0.95, dim=0)
    extent, width = float((right - left).amax()), float(splat.scales.median().exp())
    if bool((splat.scales >= 0).all()) and extent > 0 and width > _WIDE * extent:
        raise InputError(
            f"{file} seems to hold linear scales, between {float(splat.scales.min()):.3g} and "
            f"{float(splat.scales.max()):.3g}: taken for logarithms, the median Gaussian would be {width:.3g} wide in "
            f"a scene of {extent:.3g}. Expected natural logarithms, as all splat trainers write them; store log(scale)."
        )


def _drawn(splat: Splat) -> Iterator[tuple[str, Tensor]]:
    """What must be finite; a logit or logarithm may well be infinite."""
    yield "means", splat.means
    yield "rotations", splat.quats
    yield "scales", splat.activated.scales
    yield "opacities", splat.activated.opacities
    yield "colours", splat.features_dc
    yield "colours", splat.features_rest


def from_parameters(parameters: Mapping[str, Tensor], file: Path) -> Splat:
    """A splat from a trainer's tensors by splatfacto's names, as float32; checks types and shapes.

    Raises:
        ValueError: no Gaussian, a tensor of another type than half, bfloat16, float32 or float64, or of a shape that
            does not fit.
    """
    n = len(parameters["means"]) if parameters["means"].ndim > 0 else 0
    if parameters["means"].ndim == 2 and n == 0:
        raise InputError(f"{file} holds no Gaussians at all. Give the file of a training that kept some.")
    shapes = {"means": (3,), "quats": (4,), "scales": (3,), "opacities": (1,), "features_dc": (3,)}
    for name, shape in shapes.items():
        value = parameters[name]
        if tuple(value.shape) != (n, *shape) or value.dtype not in _PRECISIONS:
            raise InputError(
                f"{file}: {name} is {value.dtype} {tuple(value.shape)}, expected floating-point numbers of shape "
                f"{(n, *shape)}, one row per Gaussian. Copy the file again, or give that of another training."
            )
    rest = parameters["features_rest"]
    if (
        rest.ndim != 3
        or len(rest) != n
        or rest.shape[2] != 3
        or rest.shape[1] not in DEGREES
        or rest.dtype not in _PRECISIONS
    ):
        raise InputError(
            f"{file}: its spherical harmonics have shape {tuple(rest.shape)} and type {rest.dtype}, expected "
            f"floating-point numbers of shape ({n}, K, 3) with K = {', '.join(map(str, DEGREES))} for degrees "
            f"{', '.join(map(str, DEGREES.values()))}. Copy the file again, or give that of another training."
        )
    return Splat(**{name: parameters[name].detach().float() for name in (*shapes, "features_rest")})
