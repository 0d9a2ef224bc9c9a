"""Solids as signed distance functions (negative inside) and flat Gaussians that cover their surfaces. Metres."""

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
"""Nearer points count as lying on the surface, metres."""
_OVERLAP = 2.6
"""Standard deviation of a Gaussian in units of that of its patch; large enough to close the surface."""
_SHELL = 0.02
"""Half the thickness of the layer whose points are projected onto the surface, metres."""
_MIN_SCALE = 1e-3
"""Metres."""
_CREASE = 0.03
"""Points this far apart (metres) part as readily as points whose normals are at 60 degrees, so that patches end at
edges."""


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
    """A ball around the origin."""
    return lambda p: length(p) - radius


def box(width: float, depth: float, height: float, rounding: float = 0.0) -> Distance:
    """An upright box around the origin."""
    half = np.array([width, depth, height]) / 2 - rounding
    return lambda p: _outside(np.abs(p) - half) - rounding


def cone(bottom: float, top: float, height: float, rounding: float = 0.0) -> Distance:
    """An upright truncated cone around the origin, a cylinder where both radii are equal."""
    half, slope = height / 2 - rounding, (top - bottom) / height
    middle, lean = (bottom + top) / 2 - rounding, np.hypot(1, slope)

    def distance(p: Array) -> Array:
        beside = (np.hypot(p[:, 0], p[:, 1]) - middle - slope * p[:, 2]) / lean
        return _outside(np.stack([beside, np.abs(p[:, 2]) - half], axis=1)) - rounding

    return distance


def torus(radius: float, tube: float) -> Distance:
    """A torus standing upright around the origin, its axis along y."""
    return lambda p: np.hypot(np.hypot(p[:, 0], p[:, 2]) - radius, p[:, 1]) - tube


def capsule(start: tuple[float, float, float], end: tuple[float, float, float], radius: float) -> Distance:
    """All points within `radius` of a line segment."""
    a, b = np.array(start), np.array(end)

    def distance(p: Array) -> Array:
        along = ((p - a) @ (b - a) / ((b - a) @ (b - a))).clip(0, 1)
        return length(p - a - along[:, None] * (b - a)) - radius

    return distance


def cavity(shape: Distance) -> Distance:
    """All space but the shape."""
    return lambda p: -shape(p)


def place(shape: Distance, x: float, y: float, z: float, turn: float = 0.0) -> Distance:
    """The shape turned by `turn` degrees about the vertical, then moved by (x, y, z)."""
    c, s = np.cos(np.radians(turn)), np.sin(np.radians(turn))

    def distance(p: Array) -> Array:
        q = p - (x, y, z)
        return shape(np.stack([c * q[:, 0] + s * q[:, 1], c * q[:, 1] - s * q[:, 0], q[:, 2]], axis=1))

    return distance


def union(*shapes: Distance) -> Distance:
    """Everything that belongs to any of the shapes."""
    return lambda p: reduce(np.minimum, (shape(p) for shape in shapes))


def length(vectors: Array) -> Array:
    """Of rows [n, k], [n]; much faster than numpy.linalg.norm on short rows."""
    return np.sqrt(np.einsum("nk,nk->n", vectors, vectors))


def _outside(beyond: Array) -> Array:
    """Distance to a convex body from the signed distances [n, k] to its perpendicular faces."""
    return length(beyond.clip(0)) + reduce(np.maximum, beyond.T).clip(None, 0)


def normals(shape: Distance, points: Array) -> Array:
    """Unit gradients of the distance, [n, 3]; on the surface its outward normals."""
    steps = 1e-4 * np.eye(3)
    gradient = np.stack([shape(points + step) - shape(points - step) for step in steps], axis=1)
    return gradient / length(gradient)[:, None].clip(1e-12)


def each(function: Callable[..., Any], *items: Iterable[Any]) -> list[Any]:
    """As map, on all cores: NumPy and SciPy let other threads work while they are in a long array."""
    with ThreadPoolExecutor() as pool:
        return list(pool.map(function, *items))


def points_near(shape: Distance, low: Array, high: Array, density: float, rng: np.random.Generator) -> Array:
    """Random points around the surface within the box `low`..`high`, [m, 3], of which `projected` leaves about
    `density` per square metre.
    """
    cell = 0.1  # side of a search cell
    ticks = [np.arange(a - cell / 2, b + cell, cell) for a, b in zip(low, high)]
    centres = np.stack(np.meshgrid(*ticks, indexing="ij"), axis=-1).reshape(-1, 3)
    centres = centres[np.abs(shape(centres)) < cell + _SHELL]
    count = int(density * len(centres) * cell**3 / (2 * _SHELL))
    return centres[rng.integers(len(centres), size=count)] + rng.uniform(-cell / 2, cell / 2, (count, 3))


def projected(shape: Distance, points: Array, low: Array, high: Array) -> Array:
    """Those points near the surface, moved onto it, that are in the box `low`..`high` then, [n, 3]."""
    points = points[np.abs(shape(points)) < _SHELL]
    for _ in range(2):
        points = points - shape(points)[:, None] * normals(shape, points)
    inside = ((points >= low - ON_SURFACE) & (points <= high + ON_SURFACE)).all(axis=1)
    return points[inside & (np.abs(shape(points)) < ON_SURFACE)]


def cover(shape: Distance, points: Array, first: NDArray[np.int64]) -> Surfels:
    """Cuts a surface into compact patches (k-means) and lays one Gaussian over each.

    Args:
        points: [m, 3], a dense sample of the surface, at least ten points a patch.
        first: [n], the points in whose places the patches start.
    """
    count = len(first)
    if count == 0:
        return Surfels(np.empty((0, 3)), np.empty((0, 3)), np.empty(0), np.empty(0))
    sample = np.hstack([points, _CREASE * normals(shape, points)])
    centres = sample[first]
    for _ in range(6):
        centres = _patch_means(sample, _nearest(centres, sample), centres)
    means, normal = (
        centres[:, :3],
        centres[:, 3:] / length(centres[:, 3:])[:, None].clip(1e-12),
    )  # none where both sides are one patch
    patch = _nearest(centres, sample)
    offsets = points - means[patch]
    along = (offsets * normal[patch]).sum(axis=1)
    squares = np.stack([along**2, ((offsets**2).sum(axis=1) - along**2) / 2], axis=1)
    variances = _patch_means(squares, patch, np.zeros((count, 2)))
    thickness, radii = (_OVERLAP * np.sqrt(variances)).clip(_MIN_SCALE).T
    return Surfels(means, normal, radii, thickness)


def _nearest(centres: Array, sample: Array) -> NDArray[np.int64]:
    """Index of the nearest centre of every row of the sample."""
    return np.asarray(KDTree(centres).query(sample)[1])


def _patch_means(values: Array, patch: NDArray[np.int64], empty: Array) -> Array:
    """Means of the rows of `values` by patch; rows of `empty` for patches without any."""
    size = np.bincount(patch, minlength=len(empty))[:, None]
    sums = np.stack([np.bincount(patch, column, len(empty)) for column in values.T], axis=1)
    return np.where(size > 0, sums / size.clip(1), empty)
