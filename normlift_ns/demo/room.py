"""A small room of coloured solids, made in code: Gaussians of known class, a repeatable benchmark for any lift."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import torch
from jaxtyping import Float, Int64
from matplotlib.colors import to_rgb
from numpy.typing import NDArray
from torch import Tensor

from normlift_ns.core.gaussians import GaussianScene
from normlift_ns.demo.light import shade
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
from normlift_ns.errors import InputError

HALF_WIDTH = 1.6
"""The floor is the square -HALF_WIDTH..HALF_WIDTH in x and y at z = 0, metres; z is up."""
HEIGHT = 1.8
"""Of the walls, metres. There is no ceiling."""

_OPACITY = 0.97
_EXPOSURE = 0.7
"""This share of the surface of each class is no brighter than the colour that its name stands for."""
_BOARD_WIDTH = 0.15
"""Of the floor, metres."""
_TEXTURE = 0.02
"""Standard deviation of a random factor on every colour."""
_POINTS_PER_GAUSSIAN = 12
"""Of the dense sample that surfaces are cut from, on average."""
_DETAILED_AREA = 105.0
"""Visible area of all parts, each times its `detail`, square metres."""
_STRAY_SHARE = 0.1
"""Of all Gaussians."""
_FLOATER_SHARE = 0.02
"""Of all Gaussians."""
_FAINT = (0.001, 0.1)
"""Range of the opacities of strays and floaters. Below 1 / 255 a Gaussian is never drawn."""


@dataclass(frozen=True)
class DemoRoom:
    """N Gaussians whose colour and class are known."""

    scene: GaussianScene
    """In metres, z up, float32."""
    colors: Float[Tensor, "n 3"]
    """sRGB in 0..1."""
    labels: Int64[Tensor, " n"]
    """Class of every Gaussian, an index of `names`; -1: a floater, which belongs to nothing."""
    names: tuple[str, ...]
    """One colour word per class, from the XKCD colour survey."""


_FLOOR = 1
"""Its class."""


class _Gaussians(NamedTuple):
    means: Array
    normals: Array
    """[n, 3], unit; the third axis of `scales`."""
    scales: Array
    opacities: Array
    colors: Array
    labels: NDArray[Any]
    """[n], integers."""


class _Part(NamedTuple):
    """All surfaces of one class."""

    name: str
    detail: float
    """Gaussians per square metre, relative to the walls."""
    shape: Distance


def _parts() -> list[_Part]:
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
        _Part("cream", 1, cavity(box(2 * w, 2 * w, 4 * HEIGHT))),
        _Part("light brown", 2.5, place(box(2 * w, 2 * w, 0.1), 0, 0, -0.05)),
        _Part("teal", 3, place(cone(0.95, 0.95, 0.04, 0.02), 0, 0, -0.006)),
        _Part("chocolate brown", 5, union(place(box(1.35, 0.95, 0.06, 0.029), 0, 0, 0.59), *legs)),
        _Part("sky blue", 4, place(sofa, 0.25, 1.3, -0.04)),
        _Part("dark green", 5, place(cactus, 1.2, -1.2, 0, 40)),
        _Part("bright blue", 4, place(box(0.75, 0.5, 0.5, 0.03), -1.38, 0.35, 0.235, 90)),
        _Part("pink", 5, place(cone(0.3, 0.3, 0.36, 0.07), 1.2, 0.35, 0.175)),
        _Part("orange", 5, place(cone(0.24, 0.02, 0.65, 0.015), -1.1, -1.1, 0.32)),
        _Part("red", 6, place(sphere(0.19), -0.36, 0.18, 0.805)),
        _Part("yellow", 6, place(torus(0.15, 0.06), -0.03, -0.24, 0.825, 25)),
        _Part("green", 6, place(box(0.27, 0.27, 0.27, 0.03), 0.42, -0.08, 0.75, 28)),
        _Part("purple", 6, place(cone(0.1, 0.1, 0.4, 0.02), 0.14, 0.27, 0.815)),
    ]


def demo_room(num_gaussians: int = 40_000, seed: int = 0) -> DemoRoom:
    """Builds the room. The same arguments give the same room.

    Most Gaussians lie flat on the surfaces. As in trained scenes, some faint ones stray above and below the surfaces,
    where views contradict each other or see nothing, and some float in the air.

    Args:
        num_gaussians: N, at least 2000.
    Raises:
        ValueError: too few Gaussians.
    """
    if num_gaussians < 2000:
        raise InputError(f"num_gaussians must be at least 2000, or solids have no shape; got {num_gaussians}")
    rng = np.random.default_rng(seed)
    parts = _parts()
    names = tuple(part.name for part in parts)
    num_strays, num_floaters = int(_STRAY_SHARE * num_gaussians), int(_FLOATER_SHARE * num_gaussians)
    surface = _surface(parts, num_gaussians - num_strays - num_floaters, rng)
    groups = surface, _strays(parts, surface, num_strays, rng), _floaters(num_floaters, rng)
    means, normals, scales, opacities, colors, labels = (np.concatenate(values) for values in zip(*groups))
    upper = normals * np.where(normals[:, 2:] < 0, -1, 1)
    quats = np.stack([1 + upper[:, 2], -upper[:, 1], upper[:, 0], np.zeros(len(upper))], axis=1)  # z axis to normal
    quats /= length(quats)[:, None]
    scene = GaussianScene(*(torch.from_numpy(x).float() for x in (means, quats, scales, opacities)))
    return DemoRoom(scene, torch.from_numpy(colors.clip(0, 1)).float(), torch.from_numpy(labels), names)


def _surface(parts: list[_Part], count: int, rng: np.random.Generator) -> _Gaussians:
    """All surfaces but those inside other parts."""
    low, high = np.array([-HALF_WIDTH, -HALF_WIDTH, 0]), np.array([HALF_WIDTH, HALF_WIDTH, HEIGHT])
    samples = []
    for part in parts:
        density = _POINTS_PER_GAUSSIAN * count * part.detail / _DETAILED_AREA
        points = surface_points(part.shape, low, high, density, rng)
        others = union(*(other.shape for other in parts if other is not part))
        samples.append(points[others(points) > ON_SURFACE])
    bounds = np.cumsum([len(points) for points in samples])
    counts = np.diff(np.rint(bounds / bounds[-1] * count).astype(int), prepend=0)
    covers = [cover(part.shape, points, n, rng) for part, points, n in zip(parts, samples, counts)]
    means, normals, radii, thickness = (np.concatenate(values) for values in zip(*covers))
    labels = np.repeat(np.arange(len(parts)), counts)
    scales = np.stack([radii, radii, thickness], axis=1)
    colors = _painted(parts, means, normals, labels, rng)
    return _Gaussians(means, normals, scales, np.full(count, _OPACITY), colors, labels)


def _painted(
    parts: list[_Part], means: Array, normals: Array, labels: NDArray[np.int64], rng: np.random.Generator
) -> Array:
    """Colours of surface Gaussians, [n, 3]: that of their class, lit."""
    brightness, gloss = shade(union(*(part.shape for part in parts)), means, normals)
    brightness /= np.array([np.quantile(brightness[labels == i], _EXPOSURE) for i in range(len(parts))])[labels]
    brightness *= rng.normal(1, _TEXTURE, len(labels))
    board = ((means[:, 0] + HALF_WIDTH) // _BOARD_WIDTH).astype(int)
    tone = rng.uniform(0.9, 1.04, board.max() + 2)
    brightness *= np.where(labels == _FLOOR, tone[board], 1)
    base = np.array([to_rgb(f"xkcd:{part.name}") for part in parts])[labels]
    return base * brightness[:, None] + gloss[:, None]


def _strays(parts: list[_Part], surface: _Gaussians, count: int, rng: np.random.Generator) -> _Gaussians:
    """Faint copies of surface Gaussians, up to three of their radii above or below; they belong to the nearest part."""
    chosen = rng.choice(len(surface.labels), count)
    heights = surface.scales[chosen, :1] * rng.uniform(-3, 3, (count, 1))
    means = surface.means[chosen] + surface.normals[chosen] * heights
    labels = np.argmin([np.abs(part.shape(means)) for part in parts], axis=0)
    copies = _Gaussians(*(values[chosen] for values in surface))
    return copies._replace(means=means, opacities=_faint(count, rng), labels=labels)


def _floaters(count: int, rng: np.random.Generator) -> _Gaussians:
    """Faint grey blobs in the air."""
    means = rng.uniform((-1.6, -1.6, 0.2), (1.6, 1.6, 2.0), (count, 3))
    normals = rng.normal(size=(count, 3))
    normals /= length(normals)[:, None]
    scales = rng.uniform(0.005, 0.04, (count, 3))
    colors = np.repeat(rng.uniform(0.4, 0.9, (count, 1)), 3, axis=1)
    return _Gaussians(means, normals, scales, _faint(count, rng), colors, np.full(count, -1))


def _faint(count: int, rng: np.random.Generator) -> Array:
    low, high = np.log(_FAINT)
    return np.exp(rng.uniform(low, high, count))
