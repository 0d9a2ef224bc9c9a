"""Solids as signed distance functions, negative inside and in meters, and flat Gaussians that cover their surfaces."""

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
"""Function that returns the signed distances [n] from points [n, 3] to a surface."""

ON_SURFACE = 1e-3
"""Largest distance in meters at which a point counts as lying on the surface."""
_OVERLAP = 2.6
"""Standard deviation of a Gaussian relative to that of its patch. It is large enough to close gaps in the surface."""
_SHELL = 0.02
"""Largest distance from the surface, in meters, at which points are projected onto it."""
_MIN_SCALE = 1e-3
"""Smallest standard deviation of a Gaussian, in meters."""
_CREASE = 0.03
"""Weight of normals in the division of a surface into patches, in meters. A difference of 60 degrees counts like this
distance, so that patches end at edges."""


class Surfels(NamedTuple):
    """Flat round Gaussians on a surface."""

    means: Array
    """Centers, [n, 3]."""
    normals: Array
    """Outward unit normals, [n, 3]."""
    radii: Array
    """Standard deviations within the surface, [n]."""
    thickness: Array
    """Standard deviations along the normal, [n]."""


def sphere(radius: float) -> Distance:
    """Return a sphere around the origin."""
    return lambda p: row_lengths(p) - radius


def box(width: float, depth: float, height: float, rounding: float = 0.0) -> Distance:
    """Return an upright box around the origin."""
    half = np.array([width, depth, height]) / 2 - rounding
    return lambda p: _outside(np.abs(p) - half) - rounding


def cone(bottom: float, top: float, height: float, rounding: float = 0.0) -> Distance:
    """Return an upright truncated cone around the origin. It is a cylinder if both radii are equal."""
    half, slope = height / 2 - rounding, (top - bottom) / height
    middle, lean = (bottom + top) / 2 - rounding, np.hypot(1, slope)

    def distance(p: Array) -> Array:
        side = (np.hypot(p[:, 0], p[:, 1]) - middle - slope * p[:, 2]) / lean
        return _outside(np.stack([side, np.abs(p[:, 2]) - half], axis=1)) - rounding

    return distance


def torus(radius: float, tube: float) -> Distance:
    """Return an upright torus around the origin with its axis along y."""
    return lambda p: np.hypot(np.hypot(p[:, 0], p[:, 2]) - radius, p[:, 1]) - tube


def cavity(shape: Distance) -> Distance:
    """Return the space outside a shape."""
    return lambda p: -shape(p)


def place(shape: Distance, x: float, y: float, z: float, turn: float = 0.0) -> Distance:
    """Rotate a shape by `turn` degrees about the vertical axis, and then translate it by (x, y, z)."""
    c, s = np.cos(np.radians(turn)), np.sin(np.radians(turn))

    def distance(p: Array) -> Array:
        q = p - (x, y, z)
        return shape(np.stack([c * q[:, 0] + s * q[:, 1], c * q[:, 1] - s * q[:, 0], q[:, 2]], axis=1))

    return distance


def union(*shapes: Distance) -> Distance:
    """Return the union of shapes."""
    return lambda p: reduce(np.minimum, (shape(p) for shape in shapes))


def row_lengths(vectors: Array) -> Array:
    """Return the lengths [n] of rows [n, k]. For short rows, this is much faster than numpy.linalg.norm."""
    return np.sqrt(np.einsum("nk,nk->n", vectors, vectors))


def _outside(beyond: Array) -> Array:
    """Return the signed distance to a convex body from the signed distances [n, k] to its perpendicular faces."""
    return row_lengths(beyond.clip(0)) + reduce(np.maximum, beyond.T).clip(None, 0)


def normals(shape: Distance, points: Array) -> Array:
    """Return the unit gradients [n, 3] of the distance at points, which are outward normals on the surface."""
    steps = 1e-4 * np.eye(3)
    gradient = np.stack([shape(points + step) - shape(points - step) for step in steps], axis=1)
    return gradient / row_lengths(gradient)[:, None].clip(1e-12)


def map_threaded(function: Callable[..., Any], *items: Iterable[Any]) -> list[Any]:
    """Map a function over items in threads. NumPy and SciPy release the GIL during long array operations."""
    with ThreadPoolExecutor() as pool:
        return list(pool.map(function, *items))


def sample_near_surface(shape: Distance, low: Array, high: Array, density: float, rng: np.random.Generator) -> Array:
    """Sample random points [m, 3] near a surface in the box `low`..`high`.

    `project_to_surface` keeps about `density` points per square meter.
    """
    cell = 0.1  # side of a search cell
    ticks = [np.arange(a - cell / 2, b + cell, cell) for a, b in zip(low, high)]
    centers = np.stack(np.meshgrid(*ticks, indexing="ij"), axis=-1).reshape(-1, 3)
    centers = centers[np.abs(shape(centers)) < cell + _SHELL]
    count = int(density * len(centers) * cell**3 / (2 * _SHELL))
    return centers[rng.integers(len(centers), size=count)] + rng.uniform(-cell / 2, cell / 2, (count, 3))


def project_to_surface(shape: Distance, points: Array, low: Array, high: Array) -> Array:
    """Project the points near a surface onto it; return the projections [n, 3] that are in the box `low`..`high`."""
    points = points[np.abs(shape(points)) < _SHELL]
    for _ in range(2):
        points = points - shape(points)[:, None] * normals(shape, points)
    inside = ((points >= low - ON_SURFACE) & (points <= high + ON_SURFACE)).all(axis=1)
    return points[inside & (np.abs(shape(points)) < ON_SURFACE)]


def fit_surfels(shape: Distance, points: Array, first: NDArray[np.int64]) -> Surfels:
    """Divide a surface into compact patches (k-means), and cover each patch with one Gaussian.

    Args:
        points: Dense sample [m, 3] of the surface, with at least ten points per patch.
        first: Indices [n] of the points that are the initial centers of patches.
    """
    count = len(first)
    if count == 0:
        return Surfels(np.empty((0, 3)), np.empty((0, 3)), np.empty(0), np.empty(0))
    sample = np.hstack([points, _CREASE * normals(shape, points)])
    centers = sample[first]
    for _ in range(6):
        centers = _patch_means(sample, _nearest(centers, sample), centers)
    means = centers[:, :3]
    normal = centers[:, 3:] / row_lengths(centers[:, 3:])[:, None].clip(1e-12)  # zero if a patch covers both sides
    patch = _nearest(centers, sample)
    offsets = points - means[patch]
    along = (offsets * normal[patch]).sum(axis=1)
    squares = np.stack([along**2, ((offsets**2).sum(axis=1) - along**2) / 2], axis=1)
    variances = _patch_means(squares, patch, np.zeros((count, 2)))
    thickness, radii = (_OVERLAP * np.sqrt(variances)).clip(_MIN_SCALE).T
    return Surfels(means, normal, radii, thickness)


def _nearest(centers: Array, sample: Array) -> NDArray[np.int64]:
    """Return the index of the nearest center for each row of the sample."""
    return np.asarray(KDTree(centers).query(sample)[1])


def _patch_means(values: Array, patch: NDArray[np.int64], empty: Array) -> Array:
    """Return the mean of the rows of `values` in each patch, or the row of `empty` for an empty patch."""
    size = np.bincount(patch, minlength=len(empty))[:, None]
    sums = np.stack([np.bincount(patch, column, len(empty)) for column in values.T], axis=1)
    return np.where(size > 0, sums / size.clip(1), empty)


# Shapes of everyday objects at the origin that stand or lie on the plane z = 0, in meters.


Point = tuple[float, float, float]

_NEAR = 0.25
"""Distance in meters from the bounding sphere beyond which the sphere replaces the object, for faster
lighting."""

_DIMPLE = 0.38
"""Width of the dimple of a fruit, relative to its radius."""


def within_sphere(shape: Distance, center: Point, radius: float) -> Distance:
    """Return a shape whose distance is replaced by that of a bounding sphere for points far from the sphere."""

    def distance(p: Array) -> Array:
        result = row_lengths(p - center) - radius
        near = result < _NEAR
        result[near] = shape(p[near])
        return result

    return distance


def ellipsoid(a: float, b: float, c: float) -> Distance:
    """Return an ellipsoid around the origin. Its distance is accurate only near the surface."""
    radii = np.array([a, b, c])

    def distance(p: Array) -> Array:
        q = p / radii
        outer = row_lengths(q)
        return outer * (outer - 1) / row_lengths(q / radii).clip(1e-9)

    return distance


def gourd(radius: float, height: float, ribs: int, furrow: float, dimple: float, belly: float = 0.0) -> Distance:
    """Return a flattened sphere with ribs and dimples at its poles, such as a tomato, an apple or a pumpkin.

    Args:
        radius: Horizontal radius at half the height.
        height: Height without dimples.
        ribs: Number of ribs.
        furrow: Depth of the furrows between ribs, relative to `radius`.
        dimple: Depth of the dimples, relative to half the height.
        belly: Relative difference in width between the upper and the lower half.
    """
    body = ellipsoid(radius, radius, height / 2)

    def distance(p: Array) -> Array:
        q = p - (0, 0, height / 2)
        from_axis = np.hypot(q[:, 0], q[:, 1]) / radius
        between_ribs = 1 - np.abs(np.cos(ribs / 2 * np.arctan2(q[:, 1], q[:, 0])))
        rib = 1 - furrow * between_ribs * from_axis.clip(0, 1)  # no furrows at the poles
        dent = 1 - dimple * np.exp(-((from_axis / _DIMPLE) ** 2))
        lean = 1 + belly * (q[:, 2] / height).clip(-0.5, 0.5)
        factor = (rib * dent)[:, None] * np.stack([lean, lean, np.ones(len(q))], axis=1)
        return body(q / factor) * (rib * dent)

    return within_sphere(distance, (0, 0, height / 2), max(radius * (1 + belly / 2), height / 2))


def tapered(start: Point, end: Point, first: float, last: float) -> Distance:
    """Return the union of spheres along a line segment, with radii from `first` to `last`."""
    a, b = np.array(start), np.array(end)

    def distance(p: Array) -> Array:
        along = ((p - a) @ (b - a) / ((b - a) @ (b - a))).clip(0, 1)
        return row_lengths(p - a - along[:, None] * (b - a)) - first - (last - first) * along

    return distance


def capsule(start: Point, end: Point, radius: float) -> Distance:
    """Return the set of points within `radius` of a line segment."""
    return tapered(start, end, radius, radius)


BANANA_BEND, BANANA_ARC = 0.24, np.radians(55)
"""Radius of the center line of a banana in meters, and half of its angle in radians."""


def banana(radius: float) -> Distance:
    """Return a banana that extends from its stem at the origin along -y, curved about z and bulging toward +x."""
    start = np.array([BANANA_BEND * np.cos(BANANA_ARC), BANANA_BEND * np.sin(BANANA_ARC), 0])
    stem = tapered((-0.035, 0.03, 0), (0, 0, 0), 0.3 * radius, 0.36 * radius)

    def distance(p: Array) -> Array:
        q = p + start  # from the center of the bend
        angle = np.arctan2(q[:, 1], q[:, 0]).clip(-BANANA_ARC, BANANA_ARC)
        position = np.abs(angle) / BANANA_ARC
        nearest = BANANA_BEND * np.stack([np.cos(angle), np.sin(angle), np.zeros(len(p))], axis=1)
        return row_lengths(q - nearest) - radius * (1 - 0.25 * position**2 - 0.4 * position**8)

    return within_sphere(union(distance, stem), (0.03, -0.2, 0), 0.27)


def banana_end(points: Array) -> Array:
    """Return the proximity [n] of points to the dark ends of a banana, positive only near the ends."""
    x, y = BANANA_BEND * np.cos(BANANA_ARC), BANANA_BEND * np.sin(BANANA_ARC)
    to_end = BANANA_BEND * (BANANA_ARC - np.abs(np.arctan2(points[:, 1] + y, points[:, 0] + x)))
    return 1.6 - to_end / 0.012


def calyx(radius: float, leaves: int = 5) -> Distance:
    """Return the star-shaped calyx of a tomato with its stem."""
    angles = 2 * np.pi * np.arange(leaves) / leaves
    tips = [(radius * np.cos(a), radius * np.sin(a), 0.004) for a in angles]
    star = [tapered((0, 0, 0.01), tip, 0.2 * radius, 0.06 * radius) for tip in tips]
    stem = capsule((0, 0, 0), (0.1 * radius, 0, 0.7 * radius), 0.13 * radius)
    return within_sphere(union(*star, stem), (0, 0, 0), 1.1 * radius)


def aubergine() -> Distance:
    """Return an eggplant along the y axis, with its thin end toward +y."""
    thick = tapered((0, -0.13, 0.1), (0, 0.02, 0.085), 0.1, 0.085)
    thin = tapered((0, 0, 0.087), (0.02, 0.15, 0.062), 0.087, 0.05)
    return within_sphere(union(thick, thin), (0, 0, 0.09), 0.26)


def aubergine_cap() -> Distance:
    """Return the green cap and stem at the thin end of `aubergine`."""
    cap = tapered((0.018, 0.16, 0.064), (0.024, 0.22, 0.06), 0.06, 0.02)
    stem = tapered((0.024, 0.2, 0.06), (0.045, 0.31, 0.085), 0.018, 0.013)
    return within_sphere(union(cap, stem), (0.03, 0.2, 0.06), 0.14)


def bottle(radius: float, height: float) -> Distance:
    """Return a wine bottle with a body, shoulders and a neck."""
    body, neck = 0.46 * height, 0.32 * radius
    return union(
        place(cone(radius, radius, body, 0.012), 0, 0, body / 2),
        tapered((0, 0, body - 0.2 * radius), (0, 0, body + 1.5 * radius), radius, neck),
        place(cone(neck, neck, height - body, 0.006), 0, 0, (height + body) / 2),
    )


def bowl(radius: float, thickness: float) -> Distance:
    """Return a bowl in the shape of a spherical cap, with a flat foot and open at the top."""

    def distance(p: Array) -> Array:
        q = p - (0, 0, radius)
        shell = np.abs(row_lengths(q) - radius + thickness / 2) - thickness / 2
        return np.maximum(shell, q[:, 2] + 0.25 * radius)

    return union(distance, place(cone(0.5 * radius, 0.45 * radius, 0.04, 0.01), 0, 0, 0.02))


def heap(centers: Array, radius: float) -> Distance:
    """Return the union of spheres of equal radius around the centers."""
    tree = KDTree(centers)
    return lambda p: np.asarray(tree.query(p)[0]) - radius


def leaf(long: float, wide: float, thick: float) -> Distance:
    """Return a leaf blade that extends from the origin along x and bends downward."""
    blade = ellipsoid(long / 2, wide / 2, thick / 2)

    def distance(p: Array) -> Array:
        x = p[:, 0] - long / 2
        bent = np.stack([x, p[:, 1], p[:, 2] + 0.6 * x**2 / long - 0.5 * np.abs(p[:, 1]) * wide], axis=1)
        return 0.9 * blade(bent)

    return within_sphere(distance, (long / 2, 0, 0), 0.6 * long)
