"""Solids as signed distance functions (negative inside), and flat Gaussians that cover their surfaces, in meters."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from functools import reduce
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

Array = NDArray[np.float64]
Distance = Callable[[Array], Array]
"""Signed distance of points [n, 3] to a surface, [n]."""

ON_SURFACE = 1e-3
"""Maximum distance in meters at which a point counts as lying on the surface."""
_OVERLAP = 2.6
"""Standard deviation of a Gaussian, in units of that of its patch; large enough to close the surface."""
_SHELL = 0.02
"""Half the thickness of the layer whose points are projected onto the surface, in meters."""
_MIN_SCALE = 1e-3
"""Minimum standard deviation of a Gaussian, in meters."""
_CREASE = 0.03
"""Distance in meters that separates points as strongly as normals at 60 degrees do, so that patches end at edges."""


class Surfels(NamedTuple):
    """Flat round Gaussians on a surface."""

    means: Array
    """[n, 3]"""
    normals: Array
    """[n, 3], unit, outward."""
    radii: Array
    """[n], standard deviation within the surface."""
    thickness: Array
    """[n], standard deviation along the normal."""


def sphere(radius: float) -> Distance:
    """Return a sphere around the origin."""
    return lambda p: length(p) - radius


def box(width: float, depth: float, height: float, rounding: float = 0.0) -> Distance:
    """Return an upright box around the origin."""
    half = np.array([width, depth, height]) / 2 - rounding
    return lambda p: _outside(np.abs(p) - half) - rounding


def cone(bottom: float, top: float, height: float, rounding: float = 0.0) -> Distance:
    """Return an upright truncated cone around the origin, which is a cylinder if both radii are equal."""
    half, slope = height / 2 - rounding, (top - bottom) / height
    middle, lean = (bottom + top) / 2 - rounding, np.hypot(1, slope)

    def distance(p: Array) -> Array:
        side = (np.hypot(p[:, 0], p[:, 1]) - middle - slope * p[:, 2]) / lean
        return _outside(np.stack([side, np.abs(p[:, 2]) - half], axis=1)) - rounding

    return distance


def torus(radius: float, tube: float) -> Distance:
    """Return an upright torus around the origin, with its axis along y."""
    return lambda p: np.hypot(np.hypot(p[:, 0], p[:, 2]) - radius, p[:, 1]) - tube


def capsule(start: tuple[float, float, float], end: tuple[float, float, float], radius: float) -> Distance:
    """Return all points within `radius` of a line segment."""
    a, b = np.array(start), np.array(end)

    def distance(p: Array) -> Array:
        along = ((p - a) @ (b - a) / ((b - a) @ (b - a))).clip(0, 1)
        return length(p - a - along[:, None] * (b - a)) - radius

    return distance


def cavity(shape: Distance) -> Distance:
    """Return all space outside the shape."""
    return lambda p: -shape(p)


def place(shape: Distance, x: float, y: float, z: float, turn: float = 0.0) -> Distance:
    """Return the shape turned by `turn` degrees about the vertical axis, then moved by (x, y, z)."""
    c, s = np.cos(np.radians(turn)), np.sin(np.radians(turn))

    def distance(p: Array) -> Array:
        q = p - (x, y, z)
        return shape(np.stack([c * q[:, 0] + s * q[:, 1], c * q[:, 1] - s * q[:, 0], q[:, 2]], axis=1))

    return distance


def union(*shapes: Distance) -> Distance:
    """Return the union of the shapes."""
    return lambda p: reduce(np.minimum, (shape(p) for shape in shapes))


def length(vectors: Array) -> Array:
    """Return the lengths [n] of rows [n, k]; on short rows much faster than numpy.linalg.norm."""
    return np.sqrt(np.einsum("nk,nk->n", vectors, vectors))


def _outside(beyond: Array) -> Array:
    """Return the distance to a convex body from the signed distances [n, k] to its perpendicular faces."""
    return length(beyond.clip(0)) + reduce(np.maximum, beyond.T).clip(None, 0)


def normals(shape: Distance, points: Array) -> Array:
    """Return unit gradients of the distance, [n, 3], which are the outward normals on the surface."""
    steps = 1e-4 * np.eye(3)
    gradient = np.stack([shape(points + step) - shape(points - step) for step in steps], axis=1)
    return gradient / length(gradient)[:, None].clip(1e-12)


def each(function: Callable[..., Any], *items: Iterable[Any]) -> list[Any]:
    """Map a function over items on all cores; NumPy and SciPy release the GIL during long array operations."""
    with ThreadPoolExecutor() as pool:
        return list(pool.map(function, *items))


def points_near(shape: Distance, low: Array, high: Array, density: float, rng: np.random.Generator) -> Array:
    """Sample random points near the surface in the box `low`..`high`, [m, 3].

    `projected` keeps about `density` of them per square meter.
    """
    cell = 0.1  # side of a search cell
    ticks = [np.arange(a - cell / 2, b + cell, cell) for a, b in zip(low, high)]
    centers = np.stack(np.meshgrid(*ticks, indexing="ij"), axis=-1).reshape(-1, 3)
    centers = centers[np.abs(shape(centers)) < cell + _SHELL]
    count = int(density * len(centers) * cell**3 / (2 * _SHELL))
    return centers[rng.integers(len(centers), size=count)] + rng.uniform(-cell / 2, cell / 2, (count, 3))


def projected(shape: Distance, points: Array, low: Array, high: Array) -> Array:
    """Project the points near the surface onto it; return those that are then in the box `low`..`high`, [n, 3]."""
    points = points[np.abs(shape(points)) < _SHELL]
    for _ in range(2):
        points = points - shape(points)[:, None] * normals(shape, points)
    inside = ((points >= low - ON_SURFACE) & (points <= high + ON_SURFACE)).all(axis=1)
    return points[inside & (np.abs(shape(points)) < ON_SURFACE)]


def cover(shape: Distance, points: Array, first: NDArray[np.int64]) -> Surfels:
    """Divide a surface into compact patches (k-means) and cover each with one Gaussian.

    Args:
        points: [m, 3], a dense sample of the surface, with at least ten points per patch.
        first: [n], indices of the points at which the patches start.
    """
    count = len(first)
    if count == 0:
        return Surfels(np.empty((0, 3)), np.empty((0, 3)), np.empty(0), np.empty(0))
    sample = np.hstack([points, _CREASE * normals(shape, points)])
    centers = sample[first]
    for _ in range(6):
        centers = _patch_means(sample, _nearest(centers, sample), centers)
    means = centers[:, :3]
    normal = centers[:, 3:] / length(centers[:, 3:])[:, None].clip(1e-12)  # zero if one patch has both sides
    patch = _nearest(centers, sample)
    offsets = points - means[patch]
    along = (offsets * normal[patch]).sum(axis=1)
    squares = np.stack([along**2, ((offsets**2).sum(axis=1) - along**2) / 2], axis=1)
    variances = _patch_means(squares, patch, np.zeros((count, 2)))
    thickness, radii = (_OVERLAP * np.sqrt(variances)).clip(_MIN_SCALE).T
    return Surfels(means, normal, radii, thickness)


def _nearest(centers: Array, sample: Array) -> NDArray[np.int64]:
    """Return the index of the nearest center for every row of the sample."""
    return np.asarray(KDTree(centers).query(sample)[1])


def _patch_means(values: Array, patch: NDArray[np.int64], empty: Array) -> Array:
    """Return the means of the rows of `values` by patch, and rows of `empty` for patches without any."""
    size = np.bincount(patch, minlength=len(empty))[:, None]
    sums = np.stack([np.bincount(patch, column, len(empty)) for column in values.T], axis=1)
    return np.where(size > 0, sums / size.clip(1), empty)
