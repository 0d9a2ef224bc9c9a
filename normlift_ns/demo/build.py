"""Synthetic rooms: Gaussians of known class on the surfaces of parts, as a reproducible benchmark for any lift."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple

import numpy as np
import torch
from jaxtyping import Float, Int64
from numpy.typing import NDArray
from torch import Tensor

from normlift_ns.core.gaussians import GaussianScene
from normlift_ns.demo.shapes import ON_SURFACE, Array, Distance, cover, each, length, points_near, projected
from normlift_ns.errors import InputError

HALF_WIDTH = 1.6
"""Half the side of the floor, the square -HALF_WIDTH..HALF_WIDTH in x and y at z = 0, in meters; z is up."""
HEIGHT = 1.8
"""Height of the walls in meters. There is no ceiling."""

_OPACITY = 0.97
_POINTS_PER_GAUSSIAN = 12
"""Average number of points per Gaussian in the dense sample that surfaces are divided from."""
_STRAY_SHARE = 0.1
"""Share of all Gaussians."""
_FLOATER_SHARE = 0.02
"""Share of all Gaussians."""
_MARGIN = 0.05
"""Maximum extent of a part beyond the bounding box of its sample, in meters."""
_FAINT_OPACITIES = (0.001, 0.1)
"""Range of the opacities of strays and floaters. A Gaussian below 1 / 255 is never drawn."""


@dataclass(frozen=True)
class DemoRoom:
    """N Gaussians of known color and class."""

    scene: GaussianScene
    """Gaussians in meters, z up, float32."""
    colors: Float[Tensor, "n 3"]
    """sRGB in 0..1."""
    labels: Int64[Tensor, " n"]
    """Class of every Gaussian, an index into `names`; -1 for a floater, which belongs to no class."""
    names: tuple[str, ...]
    """Name of each class, from the XKCD color survey."""


class Part(NamedTuple):
    """Surface of a class. A room may have several parts of the same class."""

    name: str
    """Name of the class."""
    detail: float
    """Gaussians per square meter, relative to the walls."""
    shape: Distance
    paint: Callable[[Array], Array] | None = None
    """Factors [n, 3] or [n, 1] on the color of the class at points [n, 3] of the surface; None for a plain color."""
    gloss: float = 0.0
    """Brightness of highlights."""


class Surface(NamedTuple):
    """Positions, normals and parts of the opaque Gaussians in a room."""

    means: Array
    normals: Array
    parts: NDArray[np.int64]
    """[n], indices of the room's parts"""


Painter = Callable[[Sequence[Part], Surface, np.random.Generator], Array]
"""sRGB [n, 3] of the Gaussians on a surface, including light and shadow; values may leave 0..1."""


class _Gaussians(NamedTuple):
    means: Array
    normals: Array
    """[n, 3], unit; the third axis of `scales`."""
    scales: Array
    opacities: Array
    colors: Array
    labels: NDArray[Any]
    """[n], integers: indices of parts"""


def class_names(parts: Sequence[Part]) -> tuple[str, ...]:
    """Return the names of the classes, in the order of their first parts."""
    return tuple(dict.fromkeys(part.name for part in parts))


def built(parts: Sequence[Part], painter: Painter, area: float, num_gaussians: int, seed: int = 0) -> DemoRoom:
    """Build a room. The same arguments give the same room.

    Most Gaussians lie flat on the surfaces. As in trained scenes, some faint ones stray above and below the surfaces,
    in places that the views contradict each other about or do not show. Others float in the air.

    Args:
        area: approximate visible area of all parts, each multiplied by its `detail`, in square meters.
        num_gaussians: N, at least 2000.
    Raises:
        ValueError: `num_gaussians` is too small.
    """
    if num_gaussians < 2000:
        raise InputError(f"num_gaussians must be at least 2000 to cover the shapes, got {num_gaussians}")
    rng = np.random.default_rng(seed)
    num_strays, num_floaters = int(_STRAY_SHARE * num_gaussians), int(_FLOATER_SHARE * num_gaussians)
    surface = _surface(parts, painter, area, num_gaussians - num_strays - num_floaters, rng)
    groups = surface, _strays(parts, surface, num_strays, rng), _floaters(num_floaters, rng)
    means, normals, scales, opacities, colors, labels = (np.concatenate(values) for values in zip(*groups))
    upper = normals * np.where(normals[:, 2:] < 0, -1, 1)
    quats = np.stack([1 + upper[:, 2], -upper[:, 1], upper[:, 0], np.zeros(len(upper))], axis=1)  # z axis to normal
    quats /= length(quats)[:, None]
    scene = GaussianScene(*(torch.from_numpy(x).float() for x in (means, quats, scales, opacities)))
    names = class_names(parts)
    classes = np.array([*(names.index(part.name) for part in parts), -1])[labels.astype(int)]
    return DemoRoom(scene, torch.from_numpy(colors.clip(0, 1)).float(), torch.from_numpy(classes), names)


def _surface(parts: Sequence[Part], painter: Painter, area: float, count: int, rng: np.random.Generator) -> _Gaussians:
    """Cover all surfaces with Gaussians, except for those inside other parts."""
    low, high = np.array([-HALF_WIDTH, -HALF_WIDTH, 0]), np.array([HALF_WIDTH, HALF_WIDTH, HEIGHT])
    density, shapes = _POINTS_PER_GAUSSIAN * count / area, [part.shape for part in parts]
    near = [points_near(part.shape, low, high, density * part.detail, rng) for part in parts]
    samples = _uncovered(shapes, each(partial(projected, low=low, high=high), shapes, near))
    bounds = np.cumsum([len(points) for points in samples])
    counts = np.diff(np.rint(bounds / bounds[-1] * count).astype(int), prepend=0)
    first = [rng.choice(len(points), n, replace=False) for points, n in zip(samples, counts)]
    covers = each(cover, shapes, samples, first)
    means, normals, radii, thickness = (np.concatenate(values) for values in zip(*covers))
    labels = np.repeat(np.arange(len(parts)), counts)
    scales = np.stack([radii, radii, thickness], axis=1)
    colors = painter(parts, Surface(means, normals, labels), rng)
    return _Gaussians(means, normals, scales, np.full(count, _OPACITY), colors, labels)


def _uncovered(shapes: Sequence[Distance], samples: Sequence[Array]) -> list[Array]:
    """Return the points of each part that lie inside no other part."""
    boxes = [
        (points.min(axis=0, initial=np.inf) - _MARGIN, points.max(axis=0, initial=-np.inf) + _MARGIN)
        for points in samples
    ]

    def uncovered(shape: Distance, points: Array) -> Array:
        keep, axes = np.ones(len(points), bool), points.T.copy()
        for other, (low, high) in zip(shapes, boxes):
            if other is not shape:
                inside = keep.copy()
                for axis, least, most in zip(axes, low, high):
                    inside &= (axis > least) & (axis < most)
                near = np.flatnonzero(inside)
                keep[near] = other(points[near]) > ON_SURFACE
        return points[keep]

    return each(uncovered, shapes, samples)


def _strays(parts: Sequence[Part], surface: _Gaussians, count: int, rng: np.random.Generator) -> _Gaussians:
    """Return faint copies of surface Gaussians, up to three radii above or below; each belongs to the nearest part."""
    chosen = rng.choice(len(surface.labels), count)
    heights = surface.scales[chosen, :1] * rng.uniform(-3, 3, (count, 1))
    means = surface.means[chosen] + surface.normals[chosen] * heights
    labels = np.argmin([np.abs(part.shape(means)) for part in parts], axis=0)
    copies = _Gaussians(*(values[chosen] for values in surface))
    return copies._replace(means=means, opacities=_faint(count, rng), labels=labels)


def _floaters(count: int, rng: np.random.Generator) -> _Gaussians:
    """Return faint gray Gaussians in the air."""
    means = rng.uniform((-1.6, -1.6, 0.2), (1.6, 1.6, 2.0), (count, 3))
    normals = rng.normal(size=(count, 3))
    normals /= length(normals)[:, None]
    scales = rng.uniform(0.005, 0.04, (count, 3))
    colors = np.repeat(rng.uniform(0.4, 0.9, (count, 1)), 3, axis=1)
    return _Gaussians(means, normals, scales, _faint(count, rng), colors, np.full(count, -1))


def _faint(count: int, rng: np.random.Generator) -> Array:
    low, high = np.log(_FAINT_OPACITIES)
    return np.exp(rng.uniform(low, high, count))
