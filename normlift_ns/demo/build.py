"""Rooms made in code: Gaussians of known class on the surfaces of parts, a repeatable benchmark for any lift."""

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
"""The floor is the square -HALF_WIDTH..HALF_WIDTH in x and y at z = 0, metres; z is up."""
HEIGHT = 1.8
"""Of the walls, metres. There is no ceiling."""

_OPACITY = 0.97
_POINTS_PER_GAUSSIAN = 12
"""Of the dense sample that surfaces are cut from, on average."""
_STRAY_SHARE = 0.1
"""Of all Gaussians."""
_FLOATER_SHARE = 0.02
"""Of all Gaussians."""
_REACH = 0.05
"""No part reaches farther beyond the box around its sample, metres."""
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
    """One name of the XKCD colour survey per class."""


class Part(NamedTuple):
    """A surface of a class. Several parts of a room may be of one class."""

    name: str
    """Of the class."""
    detail: float
    """Gaussians per square metre, relative to the walls."""
    shape: Distance
    paint: Callable[[Array], Array] | None = None
    """Factors [n, 3] or [n, 1] on the class's colour at points [n, 3] of the surface; None: plain."""
    gloss: float = 0.0
    """Brightness that a highlight adds."""


class Surface(NamedTuple):
    """Where the opaque Gaussians of a room lie."""

    means: Array
    normals: Array
    parts: NDArray[np.int64]
    """[n], indices of the room's parts."""


Painter = Callable[[Sequence[Part], Surface, np.random.Generator], Array]
"""sRGB [n, 3] of the Gaussians of a surface, light and shadow included; may leave 0..1."""


class _Gaussians(NamedTuple):
    means: Array
    normals: Array
    """[n, 3], unit; the third axis of `scales`."""
    scales: Array
    opacities: Array
    colors: Array
    labels: NDArray[Any]
    """[n], integers: indices of parts."""


def class_names(parts: Sequence[Part]) -> tuple[str, ...]:
    """Of the classes, in the order of their first parts."""
    return tuple(dict.fromkeys(part.name for part in parts))


def built(parts: Sequence[Part], painter: Painter, area: float, num_gaussians: int, seed: int = 0) -> DemoRoom:
    """Builds a room. The same arguments give the same room.

    Most Gaussians lie flat on the surfaces. As in trained scenes, some faint ones stray above and below the surfaces,
    where views contradict each other or see nothing, and some float in the air.

    Args:
        area: about, of all parts that can be seen, each times its `detail`, square metres.
        num_gaussians: N, at least 2000.
    Raises:
        ValueError: too few Gaussians.
    """
    if num_gaussians < 2000:
        raise InputError(f"num_gaussians must be at least 2000, or solids have no shape; got {num_gaussians}")
    rng = np.random.default_rng(seed)
    num_strays, num_floaters = int(_STRAY_SHARE * num_gaussians), int(_FLOATER_SHARE * num_gaussians)
    surface = _surface(parts, painter, area, num_gaussians - num_strays - num_floaters, rng)
    groups = surface, _strays(parts, surface, num_strays, rng), _floaters(num_floaters, rng)
    means, normals, scales, opacities, colors, of_part = (np.concatenate(values) for values in zip(*groups))
    upper = normals * np.where(normals[:, 2:] < 0, -1, 1)
    quats = np.stack([1 + upper[:, 2], -upper[:, 1], upper[:, 0], np.zeros(len(upper))], axis=1)  # z axis to normal
    quats /= length(quats)[:, None]
    scene = GaussianScene(*(torch.from_numpy(x).float() for x in (means, quats, scales, opacities)))
    names = class_names(parts)
    of_class = np.array([*(names.index(part.name) for part in parts), -1])
    return DemoRoom(
        scene, torch.from_numpy(colors.clip(0, 1)).float(), torch.from_numpy(of_class[of_part.astype(int)]), names
    )


def _surface(parts: Sequence[Part], painter: Painter, area: float, count: int, rng: np.random.Generator) -> _Gaussians:
    """All surfaces but those inside other parts."""
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
    """Those points of each part that lie inside no other part."""
    boxes = [
        (points.min(axis=0, initial=np.inf) - _REACH, points.max(axis=0, initial=-np.inf) + _REACH)
        for points in samples
    ]

    def uncovered(shape: Distance, points: Array) -> Array:
        left, axes = np.ones(len(points), bool), points.T.copy()
        for other, (low, high) in zip(shapes, boxes):
            if other is not shape:
                inside = left.copy()
                for axis, least, most in zip(axes, low, high):
                    inside &= (axis > least) & (axis < most)
                near = np.flatnonzero(inside)
                left[near] = other(points[near]) > ON_SURFACE
        return points[left]

    return each(uncovered, shapes, samples)


def _strays(parts: Sequence[Part], surface: _Gaussians, count: int, rng: np.random.Generator) -> _Gaussians:
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
