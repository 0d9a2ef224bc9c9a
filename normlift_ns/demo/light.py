"""Light baked into the colours of surfaces: one lamp with soft shadows, and contact shadows. Lengths in metres."""

from __future__ import annotations

import numpy as np

from normlift_ns.demo.shapes import Array, Distance, length

_LAMP = np.array([0.5, -0.7, 2.6])
_SOFTNESS = 6.0
"""Larger values sharpen the edges of shadows."""


def shade(scene: Distance, points: Array, normals: Array) -> tuple[Array, Array]:
    """Brightness and gloss of surface points: color * brightness + gloss.

    Args:
        scene: distance to everything that casts a shadow.
        points: [n, 3] on its surface.
        normals: [n, 3], unit, outward.
    Returns:
        Brightness [n], 0.4 (a dark corner) to 1.03; gloss [n], at most 0.12.
    """
    to_lamp = _LAMP - points
    distance = length(to_lamp)
    to_lamp /= distance[:, None]
    lit = _visibility(scene, points + 0.01 * normals, to_lamp, distance)
    facing = (normals * to_lamp).sum(axis=1)
    halfway = to_lamp + np.array([0, 0, 1])
    halfway /= length(halfway)[:, None]
    brightness = (0.78 + 0.05 * facing) * (1 - _contact(scene, points, normals)) + 0.2 * facing.clip(0) * lit
    return brightness, 0.12 * lit * (normals * halfway).sum(axis=1).clip(0) ** 32


def _visibility(scene: Distance, start: Array, direction: Array, distance: Array) -> Array:
    """Share of a soft lamp that each point sees, [n]: sphere tracing that remembers the closest miss."""
    seen, travelled = np.ones(len(start)), np.full(len(start), 0.03)
    for _ in range(32):
        room = scene(start + travelled[:, None] * direction)
        seen = np.minimum(seen, (_SOFTNESS * room / travelled).clip(0, 1))
        travelled = np.minimum(travelled + room.clip(0.02, 0.3), distance)
    return seen


def _contact(scene: Distance, points: Array, normals: Array) -> Array:
    """Darkening where other surfaces are near, 0 to 0.45, [n]."""
    probes = ((0.03, 0.1), (0.08, 0.15), (0.2, 0.2))  # height above the surface, weight
    return np.sum([w * (1 - scene(points + h * normals) / h).clip(0, 1) for h, w in probes], axis=0)
