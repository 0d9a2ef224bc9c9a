"""Light baked into the colours of surfaces: lamps with soft shadows, gloss, and contact shadows. Lengths in metres."""

from __future__ import annotations

import numpy as np
from scipy.ndimage import map_coordinates

from normlift_ns.demo.shapes import Array, Distance, each, length

_SOFTNESS = 6.0
"""Larger values sharpen the edges of shadows."""
_GLOSS_POWER = 32
"""Larger values make highlights smaller."""


_KEY, _KEY_COLOR = np.array([-0.8, 0.9, 2.6]), np.array([0.5, 0.48, 0.45])
"""The lamp: its place, and its warm light on what faces it."""
_SKY_COLOR, _FLOOR_COLOR = np.array([0.62, 0.63, 0.65]), np.array([0.5, 0.49, 0.48])
"""The light that comes from everywhere, on what faces upwards and downwards."""
_MESH = 0.04
"""Side of the cells in which the distance is interpolated, for shadows."""
_SHARES = 16
"""In which many points are measured; a few thousand each, for the processor's caches."""
_CREVICE = 1.0
"""How much darker than `contact` corners are."""


def shade(scene: Distance, points: Array, normals: Array) -> tuple[Array, Array]:
    """Light on surface points, [n, 3] factors on their colours, and highlights, [n] in 0..1.

    Args:
        scene: distance to everything that casts a shadow.
        points: [n, 3] on its surface.
        normals: [n, 3], unit, outward.
    """
    to_lamp = _KEY - points
    distance = length(to_lamp)
    to_lamp /= distance[:, None]
    lit = visibility(_sampled(scene, points), points + 0.02 * normals, to_lamp, distance)
    facing = (normals * to_lamp).sum(axis=1).clip(0) * lit
    upward = (1 + normals[:, 2:]) / 2
    around = (_SKY_COLOR * upward + _FLOOR_COLOR * (1 - upward)) * (
        1 - _CREVICE * contact(scene, points, normals)[:, None]
    )
    return around + _KEY_COLOR * facing[:, None], facing**_GLOSS_POWER


def _sampled(scene: Distance, points: Array) -> Distance:
    """The distance by interpolation between points of a grid around the scene, for those who ask it often."""
    low, high = points.min(axis=0) - _MESH, points.max(axis=0) + _MESH
    ticks = [np.arange(a, b + _MESH, _MESH) for a, b in zip(low, high)]
    grid = np.stack(np.meshgrid(*ticks, indexing="ij"), axis=-1)
    values = _measured(scene, grid.reshape(-1, 3)).reshape(grid.shape[:3])
    return lambda p: map_coordinates(values, ((p - low) / _MESH).T, order=1, mode="nearest")


def visibility(scene: Distance, start: Array, direction: Array, distance: Array) -> Array:
    """Share of a soft lamp that each point sees, [n]: sphere tracing that remembers the closest miss."""
    seen, travelled = np.ones(len(start)), np.full(len(start), 0.03)
    for _ in range(32):
        room = scene(start + travelled[:, None] * direction)
        seen = np.minimum(seen, (_SOFTNESS * room / travelled).clip(0, 1))
        travelled = np.minimum(travelled + room.clip(0.02, 0.3), distance)
    return seen


def contact(scene: Distance, points: Array, normals: Array) -> Array:
    """Darkening where other surfaces are near, 0 to 0.45, [n]."""
    probes = ((0.03, 0.1), (0.08, 0.15), (0.2, 0.2))  # height above the surface, weight
    return np.sum([w * (1 - _measured(scene, points + h * normals) / h).clip(0, 1) for h, w in probes], axis=0)


def _measured(scene: Distance, points: Array) -> Array:
    return np.concatenate(each(scene, np.array_split(points, _SHARES)))
