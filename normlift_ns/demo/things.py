"""Shapes of familiar objects around the origin, standing or lying on z = 0, in meters."""

from __future__ import annotations

import numpy as np
from scipy.spatial import KDTree

from normlift_ns.demo.shapes import Array, Distance, capsule, cone, length, place, union

Point = tuple[float, float, float]

_NEAR = 0.25
"""Distance from the bounding sphere beyond which the sphere replaces the object, because lighting evaluates it
often."""

_DIMPLE = 0.38
"""Width of a fruit's dimple, in radii."""


def bounded(shape: Distance, center: Point, radius: float) -> Distance:
    """Return a shape that lies within a sphere; far from it, use the distance to the sphere."""

    def distance(p: Array) -> Array:
        result = length(p - center) - radius
        near = result < _NEAR
        result[near] = shape(p[near])
        return result

    return distance


def ellipsoid(a: float, b: float, c: float) -> Distance:
    """Return an ellipsoid around the origin. Its distance is accurate near the surface, where it is needed."""
    radii = np.array([a, b, c])

    def distance(p: Array) -> Array:
        q = p / radii
        outer = length(q)
        return outer * (outer - 1) / length(q / radii).clip(1e-9)

    return distance


def gourd(radius: float, height: float, ribs: int, furrow: float, dimple: float, belly: float = 0.0) -> Distance:
    """Return a tomato, an apple or a pumpkin: a flattened sphere with ribs and a dimple at its poles.

    Args:
        furrow: depth of the furrows between ribs, in radii.
        dimple: depth of the dimple, in half heights.
        belly: how much wider it is above its middle than below.
    """
    body = ellipsoid(radius, radius, height / 2)

    def distance(p: Array) -> Array:
        q = p - (0, 0, height / 2)
        from_axis = np.hypot(q[:, 0], q[:, 1]) / radius
        between_ribs = 1 - np.abs(np.cos(ribs / 2 * np.arctan2(q[:, 1], q[:, 0])))
        rib = 1 - furrow * between_ribs * from_axis.clip(0, 1)  # none at the poles
        dent = 1 - dimple * np.exp(-((from_axis / _DIMPLE) ** 2))
        lean = 1 + belly * (q[:, 2] / height).clip(-0.5, 0.5)
        factor = (rib * dent)[:, None] * np.stack([lean, lean, np.ones(len(q))], axis=1)
        return body(q / factor) * (rib * dent)

    return bounded(distance, (0, 0, height / 2), max(radius * (1 + belly / 2), height / 2))


def tapered(start: Point, end: Point, first: float, last: float) -> Distance:
    """Return spheres along a line segment, with radii from `first` to `last`."""
    a, b = np.array(start), np.array(end)

    def distance(p: Array) -> Array:
        along = ((p - a) @ (b - a) / ((b - a) @ (b - a))).clip(0, 1)
        return length(p - a - along[:, None] * (b - a)) - first - (last - first) * along

    return distance


BANANA_BEND, BANANA_ARC = 0.24, np.radians(55)
"""Radius of the center line of a banana, and half the angle that it spans."""


def banana(radius: float) -> Distance:
    """Return a banana from its stem at the origin along -y, bent about z, with its middle toward +x."""
    start = np.array([BANANA_BEND * np.cos(BANANA_ARC), BANANA_BEND * np.sin(BANANA_ARC), 0])
    stem = tapered((-0.035, 0.03, 0), (0, 0, 0), 0.3 * radius, 0.36 * radius)

    def distance(p: Array) -> Array:
        q = p + start  # from the center of the bend
        angle = np.arctan2(q[:, 1], q[:, 0]).clip(-BANANA_ARC, BANANA_ARC)
        position = np.abs(angle) / BANANA_ARC
        nearest = BANANA_BEND * np.stack([np.cos(angle), np.sin(angle), np.zeros(len(p))], axis=1)
        return length(q - nearest) - radius * (1 - 0.25 * position**2 - 0.4 * position**8)

    return bounded(union(distance, stem), (0.03, -0.2, 0), 0.27)


def banana_end(points: Array) -> Array:
    """Return how close points of a banana are to its dark ends, [n], positive near them."""
    x, y = BANANA_BEND * np.cos(BANANA_ARC), BANANA_BEND * np.sin(BANANA_ARC)
    to_end = BANANA_BEND * (BANANA_ARC - np.abs(np.arctan2(points[:, 1] + y, points[:, 0] + x)))
    return 1.6 - to_end / 0.012


def calyx(radius: float, leaves: int = 5) -> Distance:
    """Return the green star on a tomato, with its stem."""
    angles = 2 * np.pi * np.arange(leaves) / leaves
    tips = [(radius * np.cos(a), radius * np.sin(a), 0.004) for a in angles]
    star = [tapered((0, 0, 0.01), tip, 0.2 * radius, 0.06 * radius) for tip in tips]
    stem = capsule((0, 0, 0), (0.1 * radius, 0, 0.7 * radius), 0.13 * radius)
    return bounded(union(*star, stem), (0, 0, 0), 1.1 * radius)


def aubergine() -> Distance:
    """Return an eggplant along y, with its thin end toward +y."""
    thick = tapered((0, -0.13, 0.1), (0, 0.02, 0.085), 0.1, 0.085)
    thin = tapered((0, 0, 0.087), (0.02, 0.15, 0.062), 0.087, 0.05)
    return bounded(union(thick, thin), (0, 0, 0.09), 0.26)


def aubergine_cap() -> Distance:
    """Return the green cap and stem at the thin end of `aubergine`."""
    cap = tapered((0.018, 0.16, 0.064), (0.024, 0.22, 0.06), 0.06, 0.02)
    stem = tapered((0.024, 0.2, 0.06), (0.045, 0.31, 0.085), 0.018, 0.013)
    return bounded(union(cap, stem), (0.03, 0.2, 0.06), 0.14)


def bottle(radius: float, height: float) -> Distance:
    """Return a wine bottle with a body, shoulders and a neck."""
    body, neck = 0.46 * height, 0.32 * radius
    return union(
        place(cone(radius, radius, body, 0.012), 0, 0, body / 2),
        tapered((0, 0, body - 0.2 * radius), (0, 0, body + 1.5 * radius), radius, neck),
        place(cone(neck, neck, height - body, 0.006), 0, 0, (height + body) / 2),
    )


def bowl(radius: float, thickness: float) -> Distance:
    """Return a hemisphere with a flat foot, open at the top."""

    def distance(p: Array) -> Array:
        q = p - (0, 0, radius)
        shell = np.abs(length(q) - radius + thickness / 2) - thickness / 2
        return np.maximum(shell, q[:, 2] + 0.25 * radius)

    return union(distance, place(cone(0.5 * radius, 0.45 * radius, 0.04, 0.01), 0, 0, 0.02))


def heap(centers: Array, radius: float) -> Distance:
    """Return spheres of the same radius."""
    tree = KDTree(centers)
    return lambda p: np.asarray(tree.query(p)[0]) - radius


def leaf(long: float, wide: float, thick: float) -> Distance:
    """Return a blade that grows from the origin along x and bends downward."""
    blade = ellipsoid(long / 2, wide / 2, thick / 2)

    def distance(p: Array) -> Array:
        x = p[:, 0] - long / 2
        bent = np.stack([x, p[:, 1], p[:, 2] + 0.6 * x**2 / long - 0.5 * np.abs(p[:, 1]) * wide], axis=1)
        return 0.9 * blade(bent)

    return bounded(distance, (long / 2, 0, 0), 0.6 * long)
