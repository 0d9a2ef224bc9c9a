"""A third room, in which the choice made after the second room's result is confirmed or refuted.

The second room refuted the first choice of the rule, and the consensus was then changed. The next choice needs a room
that has not been examined: a kitchen with many small objects and twenty classes. Its cameras are at five places, as on
a tripod, instead of on a path. It was written before the changed consensus was run on the grid, and must not be used to
choose.
"""

from __future__ import annotations

import math

from normlift_ns import Camera
from normlift_ns.demo.shapes import box, capsule, cavity, cone, place, sphere, torus, union
from research.made_room import Part, Plan, built, look
from research.synthetic_scenes import World, world_of_room

LENGTH, WIDTH, HEIGHT = 4.2, 4.0, 2.5
"""Sides of the floor in x and y, and height of the walls, in meters. There is no ceiling."""
SEED = 23
FIELD_OF_VIEW = 62.0
"""Horizontal field of view in degrees."""
PLACES = ((-0.9, -1.5, 1.6), (1.5, -1.4, 1.35), (1.6, 0.2, 1.75), (-1.6, 0.1, 1.2), (0.1, -0.5, 1.95))
"""Positions of the tripod in meters."""


def parts() -> list[Part]:
    """Return all surfaces, one entry per class."""
    table = union(
        place(cone(0.55, 0.55, 0.04, 0.01), 0, 0, 0.74),
        *(place(cone(0.03, 0.03, 0.72), 0.36 * math.cos(a), 0.36 * math.sin(a), 0.36) for a in (0.4, 1.97, 3.54, 5.11)),
    )
    stool = union(
        place(cone(0.17, 0.17, 0.05, 0.02), 0, 0, 0.48),
        *(capsule((0.06 * x, 0.06 * y, 0.46), (0.15 * x, 0.15 * y, 0.02), 0.018) for x in (-1, 1) for y in (-1, 1)),
    )
    mug = [
        union(place(cone(0.045, 0.045, 0.1, 0.01), x, y, 0.05), place(torus(0.035, 0.01), x + 0.05, y, 0.05, 90))
        for x, y in ((0.0, 0.0), (0.16, 0.09))
    ]
    kettle = union(
        place(cone(0.1, 0.06, 0.18, 0.03), 0, 0, 0.09),
        capsule((0.06, 0, 0.12), (0.15, 0, 0.18), 0.016),
        capsule((-0.06, 0, 0.19), (0.06, 0, 0.19), 0.012),
    )
    pan = union(place(cone(0.14, 0.16, 0.06, 0.01), 0, 0, 0.03), capsule((0.14, 0, 0.05), (0.36, 0, 0.07), 0.015))
    apples = union(*(place(sphere(0.042), 0.09 * math.cos(2.1 * i), 0.09 * math.sin(2.1 * i), 0.05) for i in range(3)))
    bananas = union(*(
        capsule((-0.09, 0.04 * i, 0.03 + 0.015 * i), (0.09, 0.04 * i + 0.03, 0.035 + 0.015 * i), 0.02) for i in range(3)
    ))  # fmt: skip
    bottles = union(*(
        union(place(cone(0.037, 0.037, 0.2, 0.01), x, 0, 0.1), capsule((x, 0, 0.2), (x, 0, 0.29), 0.014))
        for x in (0.0, 0.11, 0.22, 0.33)
    ))  # fmt: skip
    lamp = union(place(cone(0.2, 0.06, 0.18, 0.01), 0, 0, 0), capsule((0, 0, 0.1), (0, 0, 0.9), 0.008))
    boards = union(*(place(box(1.3, 0.24, 0.03, 0.005), 0, 0, z) for z in (0.0, 0.38)))
    plates = union(*(place(cone(0.11, 0.13, 0.018, 0.005), 0, 0, 0.012 + 0.022 * i) for i in range(5)))
    return [
        ("wall", (0.88, 0.82, 0.70), 1, cavity(box(LENGTH, WIDTH, 4 * HEIGHT))),
        ("floor", (0.30, 0.33, 0.38), 2, place(box(LENGTH, WIDTH, 0.2), 0, 0, -0.1)),
        ("counter", (0.58, 0.58, 0.56), 4, place(box(3.0, 0.62, 0.9, 0.015), 0.5, 1.66, 0.45)),
        ("fridge", (0.90, 0.92, 0.95), 3, place(box(0.66, 0.66, 1.8, 0.04), -1.72, 1.62, 0.89)),
        ("stove", (0.13, 0.13, 0.14), 6, place(box(0.6, 0.54, 0.03, 0.01), 0.3, 1.66, 0.925)),
        ("pan", (0.45, 0.10, 0.10), 12, place(pan, 0.18, 1.68, 0.94, -35)),
        ("kettle", (0.15, 0.35, 0.65), 14, place(kettle, 0.45, 1.62, 0.94, 150)),
        ("sink", (0.70, 0.74, 0.78), 8, place(box(0.5, 0.4, 0.05, 0.02), 1.3, 1.66, 0.915)),
        ("bottles", (0.10, 0.40, 0.20), 14, place(bottles, -0.75, 1.72, 0.9, 8)),
        ("boards", (0.52, 0.36, 0.20), 6, place(boards, 0.9, 1.88, 1.42)),
        ("plates", (0.95, 0.95, 0.85), 14, place(plates, 0.6, 1.86, 1.44)),
        ("bowl", (0.85, 0.55, 0.15), 14, place(cone(0.07, 0.14, 0.1, 0.02), 1.2, 1.85, 1.86)),
        ("table", (0.62, 0.45, 0.28), 6, place(table, -0.3, -0.1, 0)),
        ("apples", (0.75, 0.10, 0.12), 18, place(apples, -0.45, -0.02, 0.76)),
        ("bananas", (0.95, 0.82, 0.15), 18, place(bananas, -0.1, 0.1, 0.76, 70)),
        ("mugs", (0.35, 0.20, 0.55), 18, place(union(*mug), -0.2, -0.38, 0.76, 15)),
        ("stool", (0.20, 0.55, 0.50), 8, place(stool, 0.55, -0.45, 0, 25)),
        ("bin", (0.40, 0.42, 0.45), 5, place(cone(0.16, 0.19, 0.5, 0.02), 1.75, -1.65, 0.24)),
        ("mat", (0.65, 0.25, 0.40), 4, place(box(1.2, 0.5, 0.02, 0.008), 0.6, 1.0, 0.006, 3)),
        ("lamp", (0.98, 0.85, 0.55), 6, place(lamp, -0.3, -0.1, 1.6)),
    ]


PLAN = Plan(LENGTH, WIDTH, HEIGHT, tuple(parts()), SEED)


def turns(count: int = 30, phase: float = 0.0, width: int = 320, height: int = 240) -> list[Camera]:
    """Return cameras at five places in turn. Each turns between its images towards the center and both sides of it."""
    found = []
    for i in range(count):
        x, y, z = PLACES[i % len(PLACES)]
        turn = (i // len(PLACES) + phase) / math.ceil(count / len(PLACES)) - 0.5
        away = math.atan2(0.5 - y, 0.1 - x) + 1.5 * turn
        target = (x + 2 * math.cos(away), y + 2 * math.sin(away), 0.7 + 0.45 * math.sin(3 * turn + x))
        found.append(look((x, y, z), target, width, height, FIELD_OF_VIEW))
    return found


def third(num_gaussians: int = 40_000, views: int = 30, width: int = 320) -> World:
    """Return the room as a world: twenty classes, 30 views, 5 held-out views between them."""
    size = width, width * 3 // 4
    return world_of_room("third", built(PLAN, num_gaussians), turns(views, 0.0, *size), turns(5, 0.45, *size))
