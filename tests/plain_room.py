"""The plain room, of coloured solids: the scene "demo" of the benchmarks and the room of many tests.

Figures rest on it to the last bit, so it stays as it is. `normlift_ns.demo.room.demo_room` is the room that people see.
"""

from collections.abc import Sequence

import numpy as np
from matplotlib.colors import to_rgb

from normlift_ns.demo.room import HALF_WIDTH, HEIGHT, DemoRoom, Part, Surface, build_room, contact_shadow, visibility
from normlift_ns.demo.shapes import Array, box, capsule, cavity, cone, place, row_lengths, sphere, torus, union

_LAMP = np.array([0.5, -0.7, 2.6])
_EXPOSURE = 0.7
"""This share of the surface of each class is no brighter than the colour that its name stands for."""
_BOARD_WIDTH = 0.15
"""Of the floor, metres."""
_TEXTURE = 0.02
"""Standard deviation of a random factor on every colour."""
_DETAILED_AREA = 105.0
"""Visible area of all parts, each times its `detail`, square metres."""
_FLOOR = 1
"""Its class."""


def _parts() -> list[Part]:
    w = HALF_WIDTH
    legs = [place(cone(0.03, 0.045, 0.57), x, y, 0.28) for x in (-0.55, 0.55) for y in (-0.33, 0.33)]
    sofa = union(
        place(box(1.3, 0.6, 0.34, 0.05), 0, 0, 0.16),
        place(box(1.3, 0.2, 0.75, 0.06), 0, 0.25, 0.36),
        *(place(box(0.2, 0.6, 0.52, 0.06), x, 0, 0.25) for x in (-0.6, 0.6)),
    )
    cactus = union(
        capsule((0, 0, 0), (0, 0, 0.95), 0.13),
        capsule((0, 0, 0.5), (0.3, 0, 0.5), 0.075),
        capsule((0.3, 0, 0.5), (0.3, 0, 0.8), 0.075),
        capsule((0, 0, 0.35), (-0.28, 0, 0.35), 0.07),
        capsule((-0.28, 0, 0.35), (-0.28, 0, 0.6), 0.07),
    )
    return [
        Part("cream", 1, cavity(box(2 * w, 2 * w, 4 * HEIGHT))),
        Part("light brown", 2.5, place(box(2 * w, 2 * w, 0.1), 0, 0, -0.05)),
        Part("teal", 3, place(cone(0.95, 0.95, 0.04, 0.02), 0, 0, -0.006)),
        Part("chocolate brown", 5, union(place(box(1.35, 0.95, 0.06, 0.029), 0, 0, 0.59), *legs)),
        Part("sky blue", 4, place(sofa, 0.25, 1.3, -0.04)),
        Part("dark green", 5, place(cactus, 1.2, -1.2, 0, 40)),
        Part("bright blue", 4, place(box(0.75, 0.5, 0.5, 0.03), -1.38, 0.35, 0.235, 90)),
        Part("pink", 5, place(cone(0.3, 0.3, 0.36, 0.07), 1.2, 0.35, 0.175)),
        Part("orange", 5, place(cone(0.24, 0.02, 0.65, 0.015), -1.1, -1.1, 0.32)),
        Part("red", 6, place(sphere(0.19), -0.36, 0.18, 0.805)),
        Part("yellow", 6, place(torus(0.15, 0.06), -0.03, -0.24, 0.825, 25)),
        Part("green", 6, place(box(0.27, 0.27, 0.27, 0.03), 0.42, -0.08, 0.75, 28)),
        Part("purple", 6, place(cone(0.1, 0.1, 0.4, 0.02), 0.14, 0.27, 0.815)),
    ]


def plain_room(num_gaussians: int = 40_000, seed: int = 0) -> DemoRoom:
    """Builds the room. The same arguments give the same room.

    Args:
        num_gaussians: N, at least 2000.
    Raises:
        ValueError: too few Gaussians.
    """
    return build_room(_parts(), _painted, _DETAILED_AREA, num_gaussians, seed)


def _painted(parts: Sequence[Part], surface: Surface, rng: np.random.Generator) -> Array:
    """Colours of surface Gaussians, [n, 3]: that of their class, lit."""
    means, normals, labels = surface
    brightness, shine = _shade(parts, means, normals)
    brightness /= np.array([np.quantile(brightness[labels == i], _EXPOSURE) for i in range(len(parts))])[labels]
    brightness *= rng.normal(1, _TEXTURE, len(labels))
    board = ((means[:, 0] + HALF_WIDTH) // _BOARD_WIDTH).astype(int)
    tone = rng.uniform(0.9, 1.04, board.max() + 2)
    brightness *= np.where(labels == _FLOOR, tone[board], 1)
    base = np.array([to_rgb(f"xkcd:{part.name}") for part in parts])[labels]
    return base * brightness[:, None] + shine[:, None]


def _shade(parts: Sequence[Part], points: Array, normals: Array) -> tuple[Array, Array]:
    """Brightness [n], 0.4 (a dark corner) to 1.03, and gloss [n], at most 0.12: color * brightness + gloss."""
    scene = union(*(part.shape for part in parts))
    to_lamp = _LAMP - points
    distance = row_lengths(to_lamp)
    to_lamp /= distance[:, None]
    lit = visibility(scene, points + 0.01 * normals, to_lamp, distance)
    facing = (normals * to_lamp).sum(axis=1)
    brightness = (0.78 + 0.05 * facing) * (1 - contact_shadow(scene, points, normals)) + 0.2 * facing.clip(0) * lit
    halfway = to_lamp + np.array([0, 0, 1])
    halfway /= row_lengths(halfway)[:, None]
    return brightness, 0.12 * lit * (normals * halfway).sum(axis=1).clip(0) ** 32
