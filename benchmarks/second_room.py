"""A second room: what is chosen on the tabletop and the demo room is confirmed or refuted here, and nowhere else.

A long bedroom beside `normlift_ns.demo`'s square room with a table in the middle: other objects, other sizes, other
densities, a camera that walks through instead of round. It was written before anything was fitted on the grid, and no
choice may look at it.
"""

from __future__ import annotations

import math

import numpy as np
import torch
from numpy.typing import NDArray

from benchmarks.worlds import World, world_of_room
from normlift_ns import Camera, GaussianScene
from normlift_ns.demo import DemoRoom
from normlift_ns.demo.shapes import (
    ON_SURFACE,
    Array,
    Distance,
    box,
    capsule,
    cavity,
    cone,
    cover,
    length,
    place,
    sphere,
    surface_points,
    torus,
    union,
)

LENGTH, WIDTH, HEIGHT = 5.2, 3.4, 2.4
"""Of the floor in x and y, and of the walls, metres. There is a ceiling lamp, but no ceiling."""
SEED = 7
POINTS_PER_GAUSSIAN = 12
STRAYS, FLOATERS = 0.08, 0.03
"""Shares of all Gaussians."""
MIN_THICKNESS = 1e-3
"""Metres."""
FIELD_OF_VIEW = 68.0
"""Horizontal, degrees."""

Part = tuple[str, tuple[float, float, float], float, Distance]
"""Name, sRGB, Gaussians per square metre relative to the walls, shape."""


def parts() -> list[Part]:
    """All surfaces, one entry per class."""
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


def second_room(num_gaussians: int = 40_000, seed: int = SEED) -> DemoRoom:
    """Builds the room: surfaces, faint strays about them, faint floaters of no class. Same arguments, same room."""
    rng, all_parts = np.random.default_rng(seed), parts()
    strays, floaters = int(STRAYS * num_gaussians), int(FLOATERS * num_gaussians)
    means, normals, scales, labels = _surface(all_parts, num_gaussians - strays - floaters, rng)
    colors = np.array([color for _, color, *_ in all_parts])[labels]
    colors = colors * (0.8 + 0.12 * normals[:, 2:] + 0.08 * normals[:, :1]) * rng.normal(1, 0.03, (len(labels), 1))
    opacities = np.full(len(labels), 0.95)
    chosen = rng.choice(len(labels), strays)
    beside = means[chosen] + normals[chosen] * scales[chosen, :1] * rng.uniform(-4, 4, (strays, 1))
    of_stray = np.argmin([np.abs(shape(beside)) for *_, shape in all_parts], axis=0)
    half = np.array([LENGTH, WIDTH]) / 2
    floating = rng.uniform((-half[0], -half[1], 0.1), (half[0], half[1], HEIGHT), (floaters, 3))
    turned = rng.normal(size=(floaters, 3))
    turned /= length(turned)[:, None]
    means = np.concatenate([means, beside, floating])
    normals = np.concatenate([normals, normals[chosen], turned])
    scales = np.concatenate([scales, scales[chosen], rng.uniform(0.006, 0.05, (floaters, 3))])
    faint = np.exp(rng.uniform(np.log(0.002), np.log(0.15), strays + floaters))
    opacities = np.concatenate([opacities, faint])
    colors = np.concatenate([colors, colors[chosen], rng.uniform(0.3, 0.9, (floaters, 3))]).clip(0, 1)
    labels = np.concatenate([labels, of_stray, np.full(floaters, -1)])
    upper = normals * np.where(normals[:, 2:] < 0, -1, 1)
    quats = np.stack([1 + upper[:, 2], -upper[:, 1], upper[:, 0], np.zeros(len(upper))], axis=1)
    quats /= length(quats)[:, None]
    scene = GaussianScene(*(torch.from_numpy(x).float() for x in (means, quats, scales, opacities)))
    names = tuple(name for name, *_ in all_parts)
    return DemoRoom(scene, torch.from_numpy(colors).float(), torch.from_numpy(labels), names)


def _surface(
    all_parts: list[Part], count: int, rng: np.random.Generator
) -> tuple[Array, Array, Array, NDArray[np.int64]]:
    """Means, normals, scales and classes of Gaussians on all surfaces but those inside other parts."""
    low, high = np.array([-LENGTH / 2, -WIDTH / 2, 0]), np.array([LENGTH / 2, WIDTH / 2, HEIGHT])
    area = 2 * HEIGHT * (LENGTH + WIDTH) + 4 * LENGTH * WIDTH + 60  # about, each part times its density
    samples = []
    for i, (_, _, dense, shape) in enumerate(all_parts):
        points = surface_points(shape, low, high, POINTS_PER_GAUSSIAN * count * dense / area, rng)
        others = union(*(other for j, (*_, other) in enumerate(all_parts) if j != i))
        samples.append(points[others(points) > ON_SURFACE])
    bounds = np.cumsum([len(points) for points in samples])
    counts = np.diff(np.rint(bounds / bounds[-1] * count).astype(int), prepend=0)
    with np.errstate(invalid="ignore"):  # both sides of a thin board in one patch
        covers = [cover(shape, points, n, rng) for (*_, shape), points, n in zip(all_parts, samples, counts)]
    means, normals, radii, thickness = (np.concatenate(values) for values in zip(*covers))
    normals[~np.isfinite(normals).all(axis=1)] = (0, 0, 1)
    thickness = np.nan_to_num(thickness, nan=MIN_THICKNESS).clip(MIN_THICKNESS)
    radii = np.nan_to_num(radii, nan=MIN_THICKNESS).clip(MIN_THICKNESS)
    return means, normals, np.stack([radii, radii, thickness], axis=1), np.repeat(np.arange(len(all_parts)), counts)


def walk(count: int = 30, phase: float = 0.0, width: int = 320, height: int = 240) -> list[Camera]:
    """Cameras on a figure of eight along the room, at heights between 0.9 and 1.7 m, that look across its middle at
    the far side.
    """
    found = []
    for i in range(count):
        t = 2 * math.pi * (i + phase) / count
        eye = (1.9 * math.cos(t), 0.75 * math.sin(2 * t), 1.3 + 0.4 * math.sin(3 * t + 1))
        target = (-1.5 * math.cos(t + 0.6), -1.2 * math.sin(t + 0.6), 0.55 + 0.35 * math.cos(2 * t))
        found.append(_look(eye, target, width, height))
    return found


def _look(place: tuple[float, float, float], target: tuple[float, float, float], width: int, height: int) -> Camera:
    eye = torch.tensor(place, dtype=torch.float64)
    forward = torch.nn.functional.normalize(torch.tensor(target, dtype=torch.float64) - eye, dim=0)
    right = torch.nn.functional.normalize(forward.cross(eye.new_tensor([0, 0, 1]), dim=0), dim=0)
    pose = torch.eye(4, dtype=torch.float64)
    pose[:3, :3] = torch.stack([right, forward.cross(right, dim=0), forward])
    pose[:3, 3] = -pose[:3, :3] @ eye
    focal = width / 2 / math.tan(math.radians(FIELD_OF_VIEW) / 2)
    K = torch.tensor([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]])
    return Camera(K, pose.float(), width, height)


def second(num_gaussians: int = 40_000, views: int = 30, width: int = 320) -> World:
    """The room as a world: sixteen classes, 30 views, 5 held-out views between them."""
    size = width, width * 3 // 4
    return world_of_room("second", second_room(num_gaussians), walk(views, 0.0, *size), walk(5, 0.37, *size))
