"""Gaussians as a browser draws them: one record of 32 bytes each, in units that suit a browser."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, UInt8, UInt32

from normlift_ns.core.gaussians import Camera, GaussianScene
from normlift_ns.core.scene import Scene

MOST_DRAWN = 1_000_000
"""Gaussians that a browser sorts and draws without stuttering; more cost memory of its tab."""
BYTES = 32
_FAINTEST = 1 / 255
_THINNEST = 1e-4
"""Least standard deviation, as a share of the largest: what is thinner is not to be seen."""
_CONSTANT_HARMONIC = 0.28209479177387814
_EXTENT = 3.0
"""Half the size that a scene gets in the browser, whose cameras see from 0.01 to 1000."""


@dataclass(frozen=True)
class Units:
    """From the scene's own units to those of the browser: (place - centre) * factor."""

    centre: tuple[float, float, float]
    factor: float

    @staticmethod
    def of(cameras: Sequence[Camera], means: Float[np.ndarray, "m 3"]) -> Units:
        """Such that cameras and most Gaussians are within a few units of the origin."""
        poses = [np.linalg.inv(camera.world_to_camera.double().cpu().numpy())[:3, 3] for camera in cameras]
        places = np.concatenate([np.array(poses).reshape(-1, 3), means[:: 1 + len(means) // 10_000]])
        places = places[np.isfinite(places).all(axis=1)]
        if len(places) == 0:
            return Units((0.0, 0.0, 0.0), 1.0)
        centre = np.median(places, axis=0)
        size = float(np.quantile(np.abs(places - centre).max(axis=1), 0.8))
        return Units(tuple(centre.tolist()), _EXTENT / size if size > 0 else 1.0)  # pyright: ignore[reportArgumentType]

    def to_browser(self, place: Sequence[float] | np.ndarray) -> np.ndarray:
        """A place of the scene as the browser has it."""
        return (np.asarray(place, float) - self.centre) * self.factor

    def to_scene(self, place: Sequence[float] | np.ndarray) -> np.ndarray:
        """The inverse of `to_browser`."""
        return np.asarray(place, float) / self.factor + self.centre


@dataclass(frozen=True, eq=False)
class Records:
    """The Gaussians that can be drawn in a browser."""

    rows: np.ndarray
    """Their numbers in the scene, ascending."""
    table: UInt32[np.ndarray, "m 8"]
    """Centre (3 float32), one unused word, Cholesky factor of the covariance (6 float16), and room for the colour."""
    alpha: UInt8[np.ndarray, " m"]
    """Opacities."""
    colours: UInt8[np.ndarray, "m 3"]
    """Of the scene itself: spherical harmonics of degree 0."""
    left_out: int
    """Gaussians that would be seen, but are too many."""
    units: Units

    @property
    def facts(self) -> str:
        """What a person should know of them."""
        facts = f"{len(self.rows):,} Gaussians are drawn, in the colours of spherical harmonics of degree 0."
        if self.left_out > 0:
            facts += f" {self.left_out:,} more are left out, the faintest and smallest: browsers bear no more."
        return facts

    def buffer(
        self,
        colours: UInt8[np.ndarray, "m 3"],
        drawn: Bool[np.ndarray, " m"],
        alpha: UInt8[np.ndarray, " m"] | None = None,
    ) -> UInt32[np.ndarray, "k 8"]:
        """The records of those that are drawn, coloured.

        Args:
            alpha: opacities in place of their own.
        """
        alpha = self.alpha if alpha is None else alpha
        rgba = np.concatenate([colours, alpha[:, None]], axis=1)[drawn]
        found = self.table[drawn]
        found[:, 7] = np.ascontiguousarray(rgba).view(np.uint32)[:, 0]
        return found


def make_records(scene: Scene, most: int = MOST_DRAWN) -> Records:
    """The records of a scene: of what can be seen, the most opaque and largest where that is more than `most`."""
    gaussians, parameters = scene.gaussians, scene.parameters
    seen = gaussians.drawable & (gaussians.opacities >= _FAINTEST)
    rows = seen.nonzero().squeeze(1)
    left_out = max(0, len(rows) - most)
    if left_out > 0:
        largest = gaussians.scales[rows].double().topk(2, dim=1).values.prod(dim=1)
        rows = rows[(gaussians.opacities[rows] * largest).topk(most).indices].sort().values
    means = gaussians.means[rows].double().cpu().numpy()
    units = Units.of(scene.train.cameras, means)
    constant = parameters["features_dc"][rows].float()
    rgb = constant * _CONSTANT_HARMONIC + 0.5 if scene.has_harmonics else torch.sigmoid(constant)
    table = np.zeros((len(rows), 8), np.uint32)
    table[:, :3] = np.ascontiguousarray(units.to_browser(means), np.float32).view(np.uint32)
    factors = cholesky(gaussians, rows) * units.factor
    table[:, 4:7] = np.ascontiguousarray(factors.clip(-65504, 65504), np.float16).view(np.uint32)
    alpha = _bytes(gaussians.opacities[rows].cpu().numpy())
    return Records(rows.cpu().numpy(), table, alpha, _bytes(rgb.nan_to_num().cpu().numpy()), left_out, units)


def cholesky(gaussians: GaussianScene, rows: torch.Tensor) -> Float[np.ndarray, "m 6"]:
    """L00, L10, L20, L11, L21, L22 with L L^T the covariance, in the scene's own units; flat Gaussians are given a
    thickness of 1e-4 of their size.
    """
    quats = torch.nn.functional.normalize(gaussians.quats[rows].double(), dim=1).cpu().numpy()
    scales = gaussians.scales[rows].double().cpu().numpy()
    scales = np.maximum(scales, np.maximum(_THINNEST * scales.max(axis=1, initial=0, keepdims=True), 1e-30))
    size = scales.max(axis=1, initial=0)
    w, x, y, z = quats.T
    rotation = np.stack(
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y),
         2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
         2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)], axis=1,
    ).reshape(-1, 3, 3)  # fmt: skip
    axes = rotation * (scales / size[:, None])[:, None, :]
    a, b, c = axes[:, 0], axes[:, 1], axes[:, 2]
    first = np.sqrt((a * a).sum(1))  # Gram and Schmidt: no difference of squares, so that thin ones stay positive
    unit = a / first[:, None]
    l10, l20 = (b * unit).sum(1), (c * unit).sum(1)
    rest = b - l10[:, None] * unit
    second = np.sqrt((rest * rest).sum(1))
    unit = rest / np.maximum(second, 1e-300)[:, None]
    l21 = (c * unit).sum(1)
    last = c - l20[:, None] * (a / first[:, None]) - l21[:, None] * unit
    third = np.sqrt((last * last).sum(1))
    return np.stack([first, l10, l20, second, l21, third], axis=1) * size[:, None]


def _bytes(values: np.ndarray) -> np.ndarray:
    return (values.clip(0, 1) * 255).round().astype(np.uint8)
