"""Light baked into the colors of surfaces: lamps with soft shadows, gloss and contact shadows. Lengths are in
meters."""

from __future__ import annotations

import numpy as np
from scipy.ndimage import map_coordinates

from normlift_ns.demo.shapes import Array, Distance, each, length

_SOFTNESS = 6.0
"""Larger values sharpen the edges of shadows."""
_GLOSS_POWER = 32
"""Larger values make highlights smaller."""


_LAMP, _LAMP_COLOR = np.array([-0.8, 0.9, 2.6]), np.array([0.5, 0.48, 0.45])
"""Position of the lamp, and the warm light it casts on surfaces that face it."""
_SKY_COLOR, _FLOOR_COLOR = np.array([0.62, 0.63, 0.65]), np.array([0.5, 0.49, 0.48])
"""Ambient light on surfaces that face upward and downward."""
_GRID_STEP = 0.04
"""Side of the grid cells in which distances are interpolated for shadows."""
_CHUNKS = 16
"""Number of chunks that points are divided into. A few thousand points per chunk fit into processor caches."""
_CONTACT_STRENGTH = 1.0
"""Factor by which corners are darker than `contact`."""


def shade(scene: Distance, points: Array, normals: Array) -> tuple[Array, Array]:
    """Return the light on surface points, [n, 3] factors on their colors, and highlights, [n] in 0..1.

    Args:
        scene: distance to everything that casts a shadow.
        points: [n, 3] on its surface.
        normals: [n, 3], unit, outward.
    """
    to_lamp = _LAMP - points
    distance = length(to_lamp)
    to_lamp /= distance[:, None]
    lit = visibility(_interpolated(scene, points), points + 0.02 * normals, to_lamp, distance)
    facing = (normals * to_lamp).sum(axis=1).clip(0) * lit
    upward = (1 + normals[:, 2:]) / 2
    ambient = (_SKY_COLOR * upward + _FLOOR_COLOR * (1 - upward)) * (
        1 - _CONTACT_STRENGTH * contact(scene, points, normals)[:, None]
    )
    return ambient + _LAMP_COLOR * facing[:, None], facing**_GLOSS_POWER


def _interpolated(scene: Distance, points: Array) -> Distance:
    """Return a fast approximation of the distance, interpolated on a grid around the scene."""
    low, high = points.min(axis=0) - _GRID_STEP, points.max(axis=0) + _GRID_STEP
    ticks = [np.arange(a, b + _GRID_STEP, _GRID_STEP) for a, b in zip(low, high)]
    grid = np.stack(np.meshgrid(*ticks, indexing="ij"), axis=-1)
    values = _distances(scene, grid.reshape(-1, 3)).reshape(grid.shape[:3])
    return lambda p: map_coordinates(values, ((p - low) / _GRID_STEP).T, order=1, mode="nearest")


def visibility(scene: Distance, start: Array, direction: Array, distance: Array) -> Array:
    """Return the share of a soft lamp that each point sees, [n], by sphere tracing that keeps the closest miss."""
    visible, traveled = np.ones(len(start)), np.full(len(start), 0.03)
    for _ in range(32):
        clearance = scene(start + traveled[:, None] * direction)
        visible = np.minimum(visible, (_SOFTNESS * clearance / traveled).clip(0, 1))
        traveled = np.minimum(traveled + clearance.clip(0.02, 0.3), distance)
    return visible


def contact(scene: Distance, points: Array, normals: Array) -> Array:
    """Return the darkening close to other surfaces, 0 to 0.45, [n]."""
    probes = ((0.03, 0.1), (0.08, 0.15), (0.2, 0.2))  # height above the surface, weight
    return np.sum([w * (1 - _distances(scene, points + h * normals) / h).clip(0, 1) for h, w in probes], axis=0)


def _distances(scene: Distance, points: Array) -> Array:
    return np.concatenate(each(scene, np.array_split(points, _CHUNKS)))
