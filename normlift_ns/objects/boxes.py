"""Oriented bounding boxes of Gaussian centers that are robust to outliers."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass
from itertools import product
from typing import cast

import numpy as np
from jaxtyping import Float64

from normlift_ns.errors import InputError

CENTRAL = (0.01, 0.99)
"""Quantiles of the points along each axis that bound a box."""
_FLAT = 1e-14
"""Ratio of the smallest to the largest variance below which points count as flat."""
_DIRECTIONS = np.array([
    direction for direction in product((-1, 0, 1), repeat=3) if direction > (0, 0, 0)
], dtype=np.float64)  # fmt: skip
"""The 13 directions to the faces, edges and corners of a cube: every direction is within 28 degrees of one of them."""


@dataclass(frozen=True, eq=False)
class OrientedBox:
    """A box with arbitrary orientation.

    >>> box = oriented_box(np.array([[x, y, z] for x in (0, 8) for y in (0, 4) for z in (0, 2)], float))
    >>> box.size.round(2).tolist(), box.center.round(2).tolist(), abs(box.axes).round(2).tolist()[0]
    ([8.0, 4.0, 2.0], [4.0, 2.0, 1.0], [1.0, 0.0, 0.0])
    """

    center: Float64[np.ndarray, " 3"]
    size: Float64[np.ndarray, " 3"]
    """Edge lengths in descending order."""
    axes: Float64[np.ndarray, "3 3"]
    """Unit vectors along these edges, one per row, as a right-handed system."""

    @property
    def corners(self) -> Float64[np.ndarray, "8 3"]:
        """The eight corners. Bits a, b, c of index 4 a + 2 b + c select the far end of axes 0, 1 and 2."""
        signs = np.array(list(product((-0.5, 0.5), repeat=3)))
        return self.center + (signs * self.size) @ self.axes

    def moved(
        self, rotation: Float64[np.ndarray, "3 3"], scale: float, shift: Float64[np.ndarray, " 3"]
    ) -> OrientedBox:
        """Return the box transformed by p -> scale * rotation @ p + shift."""
        return OrientedBox(scale * rotation @ self.center + shift, scale * self.size, self.axes @ rotation.T)


def oriented_box(points: Float64[np.ndarray, "m 3"]) -> OrientedBox:
    """Return the oriented box of the central points.

    The axes are those of the smallest box (trimesh) around the points between the 1st and the 99th percentile along
    each of 13 directions. A few distant points therefore cannot rotate the box. Along each axis, the box extends from
    the 1st to the 99th percentile of all points.

    Raises:
        ValueError: there are no points, or some are not finite.
    """
    if len(points) == 0 or not np.isfinite(points).all():
        raise InputError(f"a box needs at least one point, all of them finite; got {len(points)} points")
    axes = _axes(points[_central(points)])
    low, high = np.quantile(points @ axes.T, CENTRAL, axis=0)
    order = np.argsort(low - high, kind="stable")
    axes = axes[order]
    if np.linalg.det(axes) < 0:
        axes[2] *= -1
    low, high = np.quantile(points @ axes.T, CENTRAL, axis=0)
    return OrientedBox((low + high) / 2 @ axes, high - low, axes)


def _central(points: Float64[np.ndarray, "m 3"]) -> np.ndarray:
    """Return a mask of the points that are not an outlier along any direction; of all points if that leaves none."""
    along = points @ _DIRECTIONS.T
    low, high = np.quantile(along, CENTRAL, axis=0)
    inside = ((along >= low) & (along <= high)).all(axis=1)
    return inside if inside.any() else np.ones(len(points), bool)


def _axes(points: Float64[np.ndarray, "m 3"]) -> Float64[np.ndarray, "3 3"]:
    """Return the axes of the smallest box around some points, one per row."""
    from scipy.spatial import QhullError  # noqa: PLC0415 (queries do not need it)
    from trimesh.bounds import oriented_bounds  # noqa: PLC0415

    centered = points - points.mean(axis=0)
    variances, principal = np.linalg.eigh(centered.T @ centered)
    if variances[0] > _FLAT * variances[2]:  # a point, line or plane has no 3D hull
        with suppress(QhullError):
            return cast(np.ndarray, oriented_bounds(centered)[0])[:3, :3].copy()
    return principal.T.copy()
