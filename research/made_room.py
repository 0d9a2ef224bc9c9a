"""Rooms made in code for the benchmarks: colored surfaces, faint Gaussians near them, and faint floaters.

A plan describes a room by the size of its floor, its parts and a seed.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from normlift_ns import Camera, GaussianScene
from normlift_ns.demo.room import DemoRoom
from normlift_ns.demo.shapes import (
    ON_SURFACE,
    Array,
    Distance,
    fit_surfels,
    project_to_surface,
    row_lengths,
    sample_near_surface,
    union,
)

POINTS_PER_GAUSSIAN = 12
STRAYS, FLOATERS = 0.08, 0.03
"""Shares of all Gaussians."""
MIN_THICKNESS = 1e-3
"""Smallest thickness in meters."""

Part = tuple[str, tuple[float, float, float], float, Distance]
"""Name, sRGB color, density of Gaussians per square meter relative to the walls, and shape."""


@dataclass(frozen=True)
class Plan:
    """Plan of a room."""

    length: float
    width: float
    height: float
    """Height of the walls in meters; `length` and `width` are the sides of the floor along x and y."""
    parts: tuple[Part, ...]
    """All surfaces, one entry per class."""
    seed: int


def built(plan: Plan, num_gaussians: int) -> DemoRoom:
    """Build a room: surfaces, faint Gaussians near them, and faint floaters without a class.

    The same arguments give the same room.
    """
    rng, all_parts = np.random.default_rng(plan.seed), plan.parts
    strays, floaters = int(STRAYS * num_gaussians), int(FLOATERS * num_gaussians)
    means, normals, scales, labels = _surface(plan, num_gaussians - strays - floaters, rng)
    colors = np.array([color for _, color, *_ in all_parts])[labels]
    colors = colors * (0.8 + 0.12 * normals[:, 2:] + 0.08 * normals[:, :1]) * rng.normal(1, 0.03, (len(labels), 1))
    opacities = np.full(len(labels), 0.95)
    chosen = rng.choice(len(labels), strays)
    beside = means[chosen] + normals[chosen] * scales[chosen, :1] * rng.uniform(-4, 4, (strays, 1))
    of_stray = np.argmin([np.abs(shape(beside)) for *_, shape in all_parts], axis=0)
    half = np.array([plan.length, plan.width]) / 2
    floating = rng.uniform((-half[0], -half[1], 0.1), (half[0], half[1], plan.height), (floaters, 3))
    turned = rng.normal(size=(floaters, 3))
    turned /= row_lengths(turned)[:, None]
    means = np.concatenate([means, beside, floating])
    normals = np.concatenate([normals, normals[chosen], turned])
    scales = np.concatenate([scales, scales[chosen], rng.uniform(0.006, 0.05, (floaters, 3))])
    faint = np.exp(rng.uniform(np.log(0.002), np.log(0.15), strays + floaters))
    opacities = np.concatenate([opacities, faint])
    colors = np.concatenate([colors, colors[chosen], rng.uniform(0.3, 0.9, (floaters, 3))]).clip(0, 1)
    labels = np.concatenate([labels, of_stray, np.full(floaters, -1)])
    upper = normals * np.where(normals[:, 2:] < 0, -1, 1)
    quats = np.stack([1 + upper[:, 2], -upper[:, 1], upper[:, 0], np.zeros(len(upper))], axis=1)
    quats /= row_lengths(quats)[:, None]
    a, b, c, d = (torch.from_numpy(x).float() for x in (means, quats, scales, opacities))
    scene = GaussianScene(a, b, c, d)
    names = tuple(name for name, *_ in all_parts)
    return DemoRoom(scene, torch.from_numpy(colors).float(), torch.from_numpy(labels), names)


def _surface(plan: Plan, count: int, rng: np.random.Generator) -> tuple[Array, Array, Array, NDArray[np.int64]]:
    """Return means, normals, scales and classes of Gaussians on all surfaces that are not inside other parts."""
    all_parts, sides = plan.parts, np.array([plan.length, plan.width])
    low, high = np.array([*(-sides / 2), 0]), np.array([*(sides / 2), plan.height])
    area = 2 * plan.height * sides.sum() + 4 * sides.prod() + 60  # about, each part times its density
    samples = []
    for i, (_, _, dense, shape) in enumerate(all_parts):
        near = sample_near_surface(shape, low, high, POINTS_PER_GAUSSIAN * count * dense / area, rng)
        points = project_to_surface(shape, near, low, high)
        others = union(*(other for j, (*_, other) in enumerate(all_parts) if j != i))
        samples.append(points[others(points) > ON_SURFACE])
    bounds = np.cumsum([len(points) for points in samples])
    counts = np.diff(np.rint(bounds / bounds[-1] * count).astype(int), prepend=0)
    with np.errstate(invalid="ignore"):  # both sides of a thin board in one patch
        covers = [
            fit_surfels(shape, points, rng.choice(len(points), n, replace=False))
            for (*_, shape), points, n in zip(all_parts, samples, counts)
        ]
    means, normals, radii, thickness = (np.concatenate(values) for values in zip(*covers))
    normals[~np.isfinite(normals).all(axis=1)] = (0, 0, 1)
    thickness = np.nan_to_num(thickness, nan=MIN_THICKNESS).clip(MIN_THICKNESS)
    radii = np.nan_to_num(radii, nan=MIN_THICKNESS).clip(MIN_THICKNESS)
    return means, normals, np.stack([radii, radii, thickness], axis=1), np.repeat(np.arange(len(all_parts)), counts)


def look(
    place: tuple[float, float, float], target: tuple[float, float, float], width: int, height: int, degrees: float
) -> Camera:
    """Return an upright camera at a position that faces a target; `degrees` is its horizontal field of view."""
    eye = torch.tensor(place, dtype=torch.float64)
    forward = torch.nn.functional.normalize(torch.tensor(target, dtype=torch.float64) - eye, dim=0)
    right = torch.nn.functional.normalize(forward.cross(eye.new_tensor([0, 0, 1]), dim=0), dim=0)
    pose = torch.eye(4, dtype=torch.float64)
    pose[:3, :3] = torch.stack([right, forward.cross(right, dim=0), forward])
    pose[:3, 3] = -pose[:3, :3] @ eye
    focal = width / 2 / math.tan(math.radians(degrees) / 2)
    K = torch.tensor([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]])
    return Camera(K, pose.float(), width, height)
