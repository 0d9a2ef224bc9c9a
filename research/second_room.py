"""A second room, in which the choice made on the tabletop and the plain room is confirmed or refuted.

It is a long bedroom, unlike the square room of `normlift_ns.demo` with a table in the middle. Objects, sizes and
densities differ, and the camera moves along the room instead of around its center. It was written before anything was
fitted on the grid, and must not be used to choose.
"""

from __future__ import annotations

import math

from normlift_ns import Camera
from normlift_ns.demo.shapes import box, capsule, cavity, cone, place, sphere, torus, union
from research.made_room import Part, Plan, built, look
from research.synthetic_scenes import World, world_of_room

LENGTH, WIDTH, HEIGHT = 5.2, 3.4, 2.4
"""Sides of the floor in x and y, and height of the walls, in meters. There is a ceiling lamp, but no ceiling."""
SEED = 7
FIELD_OF_VIEW = 68.0
"""Horizontal field of view in degrees."""


def parts() -> list[Part]:
    """Return all surfaces, one entry per class."""
    bed = union(
        place(box(2.0, 1.4, 0.3, 0.04), 0, 0, 0.25),
        place(box(0.08, 1.4, 0.9, 0.03), -1.0, 0, 0.45),
    )
    chair = union(
        place(box(0.44, 0.44, 0.05, 0.02), 0, 0, 0.45),
        place(box(0.05, 0.44, 0.5, 0.02), -0.2, 0, 0.7),
        *(place(cone(0.02, 0.02, 0.46), x, y, 0.22) for x in (-0.19, 0.19) for y in (-0.19, 0.19)),
    )
    desk = union(
        place(box(0.6, 1.3, 0.04, 0.015), 0, 0, 0.73),
        *(place(box(0.56, 0.05, 0.72, 0.01), 0, y, 0.36) for y in (-0.6, 0.6)),
    )
    shelf = union(
        *(place(box(0.3, 0.9, 0.03), 0, 0, z) for z in (0.06, 0.5, 0.95, 1.4)),
        *(place(box(0.3, 0.03, 1.42), 0, y, 0.71) for y in (-0.45, 0.45)),
    )
    books = union(*(
        place(box(0.2, 0.035 + 0.012 * (i % 3), 0.24 + 0.03 * (i % 4), 0.004), 0, -0.36 + 0.085 * i, 0.66)
        for i in range(9)
    ))  # fmt: skip
    plant = union(
        capsule((0, 0, 0.3), (0.05, 0.02, 0.95), 0.035),
        *(
            capsule((0.03, 0, 0.6 + 0.09 * i), (0.3 * math.cos(2.4 * i), 0.3 * math.sin(2.4 * i), 0.8 + 0.1 * i), 0.05)
            for i in range(5)
        ),
    )
    lamp = union(place(cone(0.3, 0.12, 0.3, 0.02), 0, 0, 0.15), capsule((0, 0, 0.25), (0, 0, 0.7), 0.015))
    shoe = [union(capsule((x, 0, 0.05), (x, 0.16, 0.045), 0.05), capsule((x, 0, 0.06), (x, 0, 0.12), 0.045))
            for x in (-0.08, 0.08)]  # fmt: skip
    return [
        ("wall", (0.80, 0.84, 0.78), 1, cavity(box(LENGTH, WIDTH, 4 * HEIGHT))),
        ("floor", (0.46, 0.40, 0.36), 2, place(box(LENGTH, WIDTH, 0.2), 0, 0, -0.1)),
        ("runner", (0.55, 0.10, 0.20), 3, place(box(2.6, 0.8, 0.03, 0.01), 0.3, -0.25, 0.008)),
        ("bed", (0.25, 0.35, 0.62), 3, place(bed, -1.5, 0.9, -0.06)),
        ("pillow", (0.95, 0.93, 0.70), 8, place(box(0.4, 0.7, 0.16, 0.075), -2.15, 0.9, 0.41, 4)),
        ("wardrobe", (0.38, 0.24, 0.14), 2, place(box(1.1, 0.6, 1.9, 0.02), 1.6, 1.38, 0.94)),
        ("desk", (0.75, 0.60, 0.38), 5, place(desk, 2.25, -0.6, 0)),
        ("chair", (0.12, 0.12, 0.15), 6, place(chair, 1.5, -0.55, 0, 165)),
        ("shelf", (0.62, 0.62, 0.66), 5, place(shelf, -2.4, -0.9, -0.02)),
        ("books", (0.85, 0.35, 0.10), 7, place(books, -2.38, -0.9, 0)),
        ("pot", (0.70, 0.38, 0.28), 6, place(cone(0.13, 0.2, 0.34, 0.02), -0.7, -1.35, 0.16)),
        ("plant", (0.15, 0.50, 0.15), 6, place(plant, -0.7, -1.35, 0, 20)),
        ("globe", (0.15, 0.55, 0.75), 14, place(sphere(0.14), 2.25, -1.0, 0.91)),
        ("ring", (0.90, 0.75, 0.10), 14, place(torus(0.12, 0.035), 2.15, -0.25, 0.90, 60)),
        ("lamp", (0.98, 0.90, 0.85), 5, place(lamp, 0.2, 0.1, 1.75)),
        ("shoes", (0.60, 0.10, 0.55), 10, place(union(*shoe), 0.7, 0.75, 0, 35)),
    ]  # fmt: skip


PLAN = Plan(LENGTH, WIDTH, HEIGHT, tuple(parts()), SEED)


def walk(count: int = 30, phase: float = 0.0, width: int = 320, height: int = 240) -> list[Camera]:
    """Return cameras on a figure of eight along the room, at heights of 0.9 to 1.7 m, that face the opposite side."""
    found = []
    for i in range(count):
        t = 2 * math.pi * (i + phase) / count
        eye = (1.9 * math.cos(t), 0.75 * math.sin(2 * t), 1.3 + 0.4 * math.sin(3 * t + 1))
        target = (-1.5 * math.cos(t + 0.6), -1.2 * math.sin(t + 0.6), 0.55 + 0.35 * math.cos(2 * t))
        found.append(look(eye, target, width, height, FIELD_OF_VIEW))
    return found


def second(num_gaussians: int = 40_000, views: int = 30, width: int = 320) -> World:
    """Return the room as a world: sixteen classes, 30 views, 5 held-out views between them."""
    size = width, width * 3 // 4
    return world_of_room("second", built(PLAN, num_gaussians), walk(views, 0.0, *size), walk(5, 0.37, *size))
