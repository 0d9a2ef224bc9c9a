"""Synthetic rooms of Gaussians with known classes, as a reproducible benchmark for lifting methods."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple

import numpy as np
import torch
from jaxtyping import Float, Int64
from matplotlib.colors import to_rgb
from numpy.typing import NDArray
from scipy.ndimage import map_coordinates
from scipy.spatial.transform import Rotation
from torch import Tensor

from normlift_ns.core.gaussians import GaussianScene
from normlift_ns.demo import shapes
from normlift_ns.demo.shapes import (
    ON_SURFACE,
    Array,
    Distance,
    box,
    capsule,
    cavity,
    cone,
    fit_surfels,
    map_threaded,
    place,
    project_to_surface,
    row_lengths,
    sample_near_surface,
    union,
)
from normlift_ns.errors import InputError

HALF_WIDTH = 1.6
"""Half the side of the floor in meters. The floor is the square -HALF_WIDTH..HALF_WIDTH in x and y at z = 0."""
HEIGHT = 1.8
"""Height of the walls in meters. The room has no ceiling."""

_OPACITY = 0.97
_POINTS_PER_GAUSSIAN = 12
"""Average number of points per Gaussian in the dense sample of surfaces that is divided into patches."""
_STRAY_SHARE = 0.1
"""Fraction of Gaussians that stray from the surfaces."""
_FLOATER_SHARE = 0.02
"""Fraction of Gaussians that float in the air."""
_MARGIN = 0.05
"""Margin in meters around the bounding box of the sampled points of a part, so that it contains the whole part."""
_FAINT_OPACITIES = (0.001, 0.1)
"""Range of the opacities of strays and floaters. Rasterizers never draw a Gaussian with an opacity below 1 / 255."""


@dataclass(frozen=True)
class DemoRoom:
    """Room of Gaussians with known colors and classes."""

    scene: GaussianScene
    """Gaussians in float32 and meters; z points up."""
    colors: Float[Tensor, "n 3"]
    """Color of each Gaussian, sRGB in 0..1."""
    labels: Int64[Tensor, " n"]
    """Class of each Gaussian, an index into `names`, or -1 for a floater, which has no class."""
    names: tuple[str, ...]
    """Name of each class, from the XKCD color survey."""


class Part(NamedTuple):
    """Surface of one class. A room can have several parts of the same class."""

    name: str
    """Name of the class."""
    detail: float
    """Number of Gaussians per square meter, relative to the walls."""
    shape: Distance
    paint: Callable[[Array], Array] | None = None
    """Function that returns factors [n, 3] or [n, 1] on the color of the class at points [n, 3]; None for a plain
    color."""
    gloss: float = 0.0
    """Color value that is added where a highlight is brightest; 0 for a matte surface."""


class Surface(NamedTuple):
    """Positions, normals and parts of the opaque Gaussians of a room."""

    means: Array
    normals: Array
    parts: NDArray[np.int64]
    """Index of the part of each Gaussian, [n]."""


SurfaceColors = Callable[[Sequence[Part], Surface, np.random.Generator], Array]
"""Function that returns the sRGB colors [n, 3] of surface Gaussians, including light and shadow. Values can be outside
0..1."""


class _Gaussians(NamedTuple):
    means: Array
    normals: Array
    """Unit vectors [n, 3] along the axis of the third scale."""
    scales: Array
    opacities: Array
    colors: Array
    labels: NDArray[Any]
    """Index of the part of each Gaussian, [n], or -1 for none."""


def build_room(
    parts: Sequence[Part], painter: SurfaceColors, area: float, num_gaussians: int, seed: int = 0
) -> DemoRoom:
    """Build a room. The same arguments always produce the same room.

    Most Gaussians lie flat on the surfaces. As in trained scenes, some faint Gaussians stray above and below the
    surfaces, at positions that views label inconsistently or do not show. Others float in the air.

    Args:
        parts: Surfaces of the room.
        painter: Function that colors the Gaussians on surfaces.
        area: Approximate visible area of all parts, each multiplied by its `detail`, in square meters.
        num_gaussians: Number of Gaussians, at least 2000.
        seed: Seed of the random numbers.
    Raises:
        ValueError: `num_gaussians` is less than 2000.
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
    quats /= row_lengths(quats)[:, None]
    means, quats, scales, opacities = (torch.from_numpy(x).float() for x in (means, quats, scales, opacities))
    scene = GaussianScene(means, quats, scales, opacities)
    names = tuple(dict.fromkeys(part.name for part in parts))  # in the order of the first part of each class
    classes = np.array([*(names.index(part.name) for part in parts), -1])[labels.astype(int)]
    return DemoRoom(scene, torch.from_numpy(colors.clip(0, 1)).float(), torch.from_numpy(classes), names)


def _surface(
    parts: Sequence[Part], painter: SurfaceColors, area: float, count: int, rng: np.random.Generator
) -> _Gaussians:
    """Cover all surfaces with Gaussians, except where the surfaces lie inside other parts."""
    low, high = np.array([-HALF_WIDTH, -HALF_WIDTH, 0]), np.array([HALF_WIDTH, HALF_WIDTH, HEIGHT])
    density, shapes = _POINTS_PER_GAUSSIAN * count / area, [part.shape for part in parts]
    near = [sample_near_surface(part.shape, low, high, density * part.detail, rng) for part in parts]
    samples = _uncovered(shapes, map_threaded(partial(project_to_surface, low=low, high=high), shapes, near))
    bounds = np.cumsum([len(points) for points in samples])
    counts = np.diff(np.rint(bounds / bounds[-1] * count).astype(int), prepend=0)
    first = [rng.choice(len(points), n, replace=False) for points, n in zip(samples, counts)]
    covers = map_threaded(fit_surfels, shapes, samples, first)
    means, normals, radii, thickness = (np.concatenate(values) for values in zip(*covers))
    labels = np.repeat(np.arange(len(parts)), counts)
    scales = np.stack([radii, radii, thickness], axis=1)
    colors = painter(parts, Surface(means, normals, labels), rng)
    return _Gaussians(means, normals, scales, np.full(count, _OPACITY), colors, labels)


def _uncovered(shapes: Sequence[Distance], samples: Sequence[Array]) -> list[Array]:
    """Return the points of each part that do not lie inside another part."""
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

    return map_threaded(uncovered, shapes, samples)


def _strays(parts: Sequence[Part], surface: _Gaussians, count: int, rng: np.random.Generator) -> _Gaussians:
    """Return faint copies of surface Gaussians, shifted by up to three radii, with the class of the nearest part."""
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
    normals /= row_lengths(normals)[:, None]
    scales = rng.uniform(0.005, 0.04, (count, 3))
    colors = np.repeat(rng.uniform(0.4, 0.9, (count, 1)), 3, axis=1)
    return _Gaussians(means, normals, scales, _faint(count, rng), colors, np.full(count, -1))


def _faint(count: int, rng: np.random.Generator) -> Array:
    low, high = np.log(_FAINT_OPACITIES)
    return np.exp(rng.uniform(low, high, count))


# Light in the colors of surfaces, from a lamp with soft shadows, gloss and contact shadows. Lengths are in meters.


_SOFTNESS = 6.0
"""Sharpness of the edges of shadows. Larger values give harder edges."""
_GLOSS_POWER = 32
"""Exponent of highlights. Larger values make highlights smaller."""


_LAMP, _LAMP_COLOR = np.array([-0.8, 0.9, 2.6]), np.array([0.5, 0.48, 0.45])
"""Position of the lamp in meters, and color of its light on surfaces that face it."""
_SKY_COLOR, _FLOOR_COLOR = np.array([0.62, 0.63, 0.65]), np.array([0.5, 0.49, 0.48])
"""Colors of the ambient light on surfaces that face upward and downward."""
_GRID_STEP = 0.04
"""Side in meters of the grid cells in which distances are interpolated for shadows."""
_CHUNKS = 16
"""Number of chunks into which points are divided. A few thousand points per chunk fit into processor caches."""
_CONTACT_STRENGTH = 1.0
"""Factor on `contact_shadow`."""


def shade(scene: Distance, points: Array, normals: Array) -> tuple[Array, Array]:
    """Return the light on surface points, as factors [n, 3] on their colors, and highlights [n] in 0..1.

    Args:
        scene: Distance to all surfaces that cast shadows.
        points: Points [n, 3] on these surfaces.
        normals: Outward unit normals [n, 3] at the points.
    """
    to_lamp = _LAMP - points
    distance = row_lengths(to_lamp)
    to_lamp /= distance[:, None]
    lit = visibility(_interpolated(scene, points), points + 0.02 * normals, to_lamp, distance)
    facing = (normals * to_lamp).sum(axis=1).clip(0) * lit
    upward = (1 + normals[:, 2:]) / 2
    ambient = (_SKY_COLOR * upward + _FLOOR_COLOR * (1 - upward)) * (
        1 - _CONTACT_STRENGTH * contact_shadow(scene, points, normals)[:, None]
    )
    return ambient + _LAMP_COLOR * facing[:, None], facing**_GLOSS_POWER


def _interpolated(scene: Distance, points: Array) -> Distance:
    """Return a fast approximation of a distance function, interpolated on a grid around points."""
    low, high = points.min(axis=0) - _GRID_STEP, points.max(axis=0) + _GRID_STEP
    ticks = [np.arange(a, b + _GRID_STEP, _GRID_STEP) for a, b in zip(low, high)]
    grid = np.stack(np.meshgrid(*ticks, indexing="ij"), axis=-1)
    values = _distances(scene, grid.reshape(-1, 3)).reshape(grid.shape[:3])
    return lambda p: map_coordinates(values, ((p - low) / _GRID_STEP).T, order=1, mode="nearest")


def visibility(scene: Distance, start: Array, direction: Array, distance: Array) -> Array:
    """Return the fraction of an area light that is visible from each point, [n].

    Sphere tracing from the point to the lamp finds how closely the ray passes other surfaces.
    """
    visible, traveled = np.ones(len(start)), np.full(len(start), 0.03)
    for _ in range(32):
        clearance = scene(start + traveled[:, None] * direction)
        visible = np.minimum(visible, (_SOFTNESS * clearance / traveled).clip(0, 1))
        traveled = np.minimum(traveled + clearance.clip(0.02, 0.3), distance)
    return visible


def contact_shadow(scene: Distance, points: Array, normals: Array) -> Array:
    """Return the darkening of points by nearby surfaces, [n], in 0..0.45."""
    probes = ((0.03, 0.1), (0.08, 0.15), (0.2, 0.2))  # height above the surface, and weight
    return np.sum([w * (1 - _distances(scene, points + h * normals) / h).clip(0, 1) for h, w in probes], axis=0)


def _distances(scene: Distance, points: Array) -> Array:
    return np.concatenate(map_threaded(scene, np.array_split(points, _CHUNKS)))


# Procedural textures, which are factors on the color of a surface at its points. Lengths are in meters.


Paint = Callable[[Array], Array]
"""Function that returns factors [n, 3] or [n, 1] on colors at points [n, 3]."""

_WAVES = 9
"""Number of waves in the noise. With fewer waves, the pattern looks regular."""


def noise(points: Array, size: float, seed: int = 0) -> Array:
    """Return smooth noise [n] with spots of about `size`, as a sum of plane waves with random directions.

    The mean of the noise is 0, and most values are in -1..1.
    """
    rng = np.random.default_rng(seed)
    waves = rng.normal(size=(_WAVES, 3)) * (2 / size)
    return np.sin(points @ waves.T + rng.uniform(0, 2 * np.pi, _WAVES)).sum(axis=1) / np.sqrt(_WAVES)


def mottled(size: float, depth: float, seed: int = 0) -> Paint:
    """Return a texture of spots of about `size` that are lighter or darker by about `depth`."""
    return lambda p: 1 + depth * noise(p, size, seed)[:, None]


def wood(width: float, across: int, ring: float = 0.035, joint: float = 0.006, contrast: float = 1.0) -> Paint:
    """Return a texture of wooden boards, side by side along a horizontal axis.

    Args:
        width: Width of a board.
        across: Axis along which the boards lie side by side, 0 for x or 1 for y.
        ring: Distance between the lines of the grain.
        joint: Half the width of the dark line between two boards.
        contrast: Contrast of the grain. Dark woods need a higher contrast.
    """

    def paint(p: Array) -> Array:
        board = np.floor(p[:, across] / width)
        local = p + 7.3 * board[:, None]  # each board has a different part of the grain
        stretched = local * np.where(np.arange(3) == 1 - across, 0.18, 1)  # the grain runs along the board
        rings = stretched[:, across] / ring + 1.1 * noise(stretched, 0.12, 1)
        grain = 0.09 * np.sin(2 * np.pi * rings) + 0.05 * noise(stretched, 0.03, 2)
        tone = 0.09 * np.sin(board * 12.9898)
        edge = np.abs(p[:, across] / width - board - 0.5) * width  # from the middle of the board
        return ((1 + contrast * (grain + tone)) * np.where(edge > width / 2 - joint, 0.62, 1))[:, None]

    return paint


def woven(band: float, half_length: float, half_width: float) -> Paint:
    """Return the texture of a rug around the origin, with rows of diamonds of length `band` and a darker border."""

    def paint(p: Array) -> Array:
        x, y = p[:, 0] / band, p[:, 1] / band
        diamond = np.abs((x % 1) - 0.5) + np.abs((y % 1) - 0.5)
        tone = np.where(diamond < 0.2, 1.15, np.where(diamond < 0.4, 0.7, 0.95))
        to_edge = np.minimum(half_length - np.abs(p[:, 0]), half_width - np.abs(p[:, 1]))
        tone = np.where(to_edge < 0.4 * band, np.where(to_edge < 0.2 * band, 0.6, 1.1), tone)
        return (tone * (1 + 0.04 * noise(p, 0.03, 3)))[:, None]

    return paint


def cloth(thread: float = 0.03) -> Paint:
    """Return the texture of a slightly uneven fabric of crossing threads, `thread` apart."""
    return lambda p: (
        1 + 0.05 * np.sin(2 * np.pi * (p[:, :1] + p[:, 2:]) / thread) * np.sin(2 * np.pi * p[:, 1:2] / thread)
    ) * (1 + 0.05 * noise(p, 0.12, 4)[:, None])  # fmt: skip


def ribs(count: int, depth: float) -> Paint:
    """Return a texture of dark furrows between the ribs of `shapes.gourd`."""

    def paint(p: Array) -> Array:
        furrow = 1 - np.abs(np.cos(count / 2 * np.arctan2(p[:, 1], p[:, 0])))
        return ((1 - depth * furrow**2) * (1 + 0.03 * noise(p, 0.05, 5)))[:, None]

    return paint


def banded(tones: Callable[[Array], Array], tint: tuple[float, float, float]) -> Paint:
    """Return a texture that blends from the plain color to the factors `tint` as `tones` grows from 0 to 1."""
    return lambda p: 1 + tones(p).clip(0, 1)[:, None] * (np.array(tint) - 1)


# The demo room, with objects on a table, light and textures. Classes have the names of their colors.
#
# The color encoder accepts only color names, and many names in the XKCD color survey contain names of objects. The
# prompt "tomato red" therefore selects the tomatoes by their color.


_TABLE = 0.62
"""Height of the table top in meters."""
_EXPOSURE = 0.8
"""Fraction of the surface of each part that is not brighter than the color of its class."""
_ROUGHNESS = 0.012
"""Standard deviation of the random factor on each color."""
_DETAILED_AREA = 130.0
"""Visible area of all parts, each multiplied by its `detail`, in square meters."""
_RIPE = (1.0, 1.0, 1.0)
"""Factors on the color of a ripe banana."""
_STEM = (0.42, 0.33, 0.3)
"""Factors that color the ends of a banana brown."""
_VEIN = (1.7, 1.5, 2.0)
"""Factors that lighten the middle of a leaf."""
_GOLDEN_ANGLE = 137.5
"""Angle in degrees between successive leaves of a plant."""


def demo_room(num_gaussians: int = 45_000, seed: int = 0) -> DemoRoom:
    """Build the demo room. The same arguments always produce the same room.

    Args:
        num_gaussians: Number of Gaussians, at least 2000.
        seed: Seed of the random numbers.
    Raises:
        ValueError: `num_gaussians` is less than 2000.
    """
    return build_room([*_walls(), *_furniture(), *_plant(), *_fruit()], _painted, _DETAILED_AREA, num_gaussians, seed)


def _painted(parts: Sequence[Part], surface: Surface, rng: np.random.Generator) -> Array:
    """Return the colors of surface Gaussians, [n, 3], from their classes, textures and light."""
    light, shine = shade(union(*(part.shape for part in parts)), surface.means, surface.normals)
    colors = np.empty_like(light)
    for i, part in enumerate(parts):
        rows = surface.parts == i
        if not rows.any():
            continue
        factors = 1.0 if part.paint is None else part.paint(surface.means[rows])
        lit = light[rows] / np.quantile(light[rows].mean(axis=1), _EXPOSURE)
        matte = np.array(to_rgb(f"xkcd:{part.name}")) * factors * lit
        matte /= matte.max(axis=1, keepdims=True).clip(1)  # clipping single channels would change the hue
        colors[rows] = matte + part.gloss * shine[rows, None]
    return colors * rng.normal(1, _ROUGHNESS, (len(colors), 1))


def _at(part: Part, x: float, y: float, z: float, turn: float = 0.0, tilt: float = 0.0, roll: float = 0.0) -> Part:
    """Rotate and then translate a part together with its texture.

    The rotations are `roll` about x, `tilt` about y (which lowers the +x end) and `turn` about z, in this order and in
    degrees.
    """
    matrix = Rotation.from_euler("xyz", (roll, tilt, turn), degrees=True).as_matrix()
    shape, painted = part.shape, part.paint

    def local(p: Array) -> Array:
        return (p - (x, y, z)) @ matrix

    return part._replace(shape=lambda p: shape(local(p)), paint=painted and (lambda p: painted(local(p))))


def _walls() -> list[Part]:
    w = HALF_WIDTH
    bars = [
        *(place(box(0.05, 0.05, 0.86, 0.01), w - 0.01, y, 1.2) for y in (-0.62, 0.0, 0.62)),
        *(place(box(0.05, 1.29, 0.05, 0.01), w - 0.01, 0, z) for z in (0.78, 1.2, 1.62)),
    ]
    return [
        Part("white", 1, cavity(box(2 * w, 2 * w, 4 * HEIGHT)), mottled(0.3, 0.012)),
        Part("slate", 2, place(box(2 * w, 2 * w, 0.1), 0, 0, -0.05), wood(0.2, 1)),
        Part("sky blue", 3, place(box(0.03, 1.2, 0.8), w, 0, 1.2), mottled(0.35, 0.05, 8)),
        Part("white", 16, union(*bars)),
    ]


def _furniture() -> list[Part]:
    legs = [place(cone(0.035, 0.05, 0.57), x, y, 0.28) for x in (-0.42, 0.42) for y in (-0.62, 0.62)]
    sofa = union(
        place(box(1.7, 0.62, 0.2, 0.04), 0, 0, 0.14),
        *(place(box(0.68, 0.5, 0.18, 0.07), x, -0.05, 0.3) for x in (-0.345, 0.345)),
        *(place(box(0.68, 0.2, 0.44, 0.08), x, 0.22, 0.56) for x in (-0.345, 0.345)),
        *(place(box(0.19, 0.62, 0.5, 0.08), x, 0, 0.27) for x in (-0.77, 0.77)),
    )
    pillow = box(0.36, 0.13, 0.36, 0.062)
    return [
        Part("merlot", 4, place(box(1.7, 2.0, 0.024, 0.01), 0, 0, 0.004), woven(0.34, 0.85, 1.0)),
        Part("cocoa", 11, union(place(box(1.08, 1.5, 0.06, 0.01), 0, 0, _TABLE - 0.03), *legs), wood(0.27, 0)),
        Part("teal", 4, place(sofa, 0.3, 1.27, 0), cloth()),
        _at(Part("merlot", 7, pillow, cloth(0.05)), 0.72, 1.2, 0.56, 12, 0, -18),
        _at(Part("merlot", 7, pillow, cloth(0.05)), -0.12, 1.2, 0.56, -14, 0, -18),
    ]


def _plant() -> list[Part]:
    """Return a potted plant on the floor in a corner of the room."""
    x, y, rim = 1.18, -1.18, 0.42
    pot = union(place(cone(0.17, 0.23, 0.38, 0.012), x, y, 0.19), place(cone(0.255, 0.255, 0.08, 0.015), x, y, 0.38))
    vein = banded(lambda p: 1.2 - np.abs(p[:, 1]) / 0.008, _VEIN)
    blade = Part("forest", 9, shapes.leaf(0.42, 0.19, 0.03), vein)
    leaves = [_at(blade, x, y, rim + 0.1 + 0.06 * i, _GOLDEN_ANGLE * i + 40, -18 - 4.2 * i) for i in range(13)]
    stalk = Part("forest", 6, capsule((x, y, rim - 0.1), (x, y, rim + 0.8), 0.022))
    return [Part("white", 6, pot, mottled(0.1, 0.03)), stalk, *leaves]


def _fruit() -> list[Part]:
    """Return the objects on the table."""
    z = _TABLE
    tomato = Part("tomato red", 30, shapes.gourd(0.105, 0.175, 5, 0.06, 0.18), mottled(0.08, 0.02), 0.4)
    star = Part("forest", 40, shapes.calyx(0.065))
    apple = Part("apple", 30, shapes.gourd(0.092, 0.17, 1, 0.0, 0.24, 0.25), mottled(0.03, 0.04), 0.35)
    stem = Part("cocoa", 40, capsule((0, 0, 0.13), (0.012, 0, 0.19), 0.007))
    tomatoes = [(-0.27, 0.2, 20), (-0.05, 0.36, 80), (-0.3, 0.43, 140)]
    apples = [(-0.36, -0.04, 30), (-0.16, -0.14, 200)]
    berries = [_ring(10, 0.13, 0.0), _ring(6, 0.072, 0.035), _ring(3, 0.04, 0.085)]
    return [
        _at(Part("pumpkin", 14, shapes.gourd(0.25, 0.34, 10, 0.13, 0.2), ribs(10, 0.3), 0.15), 0.2, 0.06, z),
        _at(Part("forest", 30, shapes.tapered((0, 0, 0.27), (0.03, 0.02, 0.4), 0.035, 0.022)), 0.2, 0.06, z),
        *(_at(tomato, x, y, z, turn) for x, y, turn in tomatoes),
        *(_at(star, x, y, z + 0.152, turn) for x, y, turn in tomatoes),
        *(_at(part, x, y, z, turn) for part in (apple, stem) for x, y, turn in apples),
        *_bananas(-0.12, -0.34, z + 0.035),
        _at(Part("eggplant", 22, shapes.aubergine(), None, 0.35), 0.06, 0.58, z, 12),
        _at(Part("forest", 40, shapes.aubergine_cap()), 0.06, 0.58, z, 12),
        _at(Part("white", 14, shapes.bowl(0.2, 0.02), None, 0.2), 0.27, -0.45, z),
        _at(Part("blueberry", 30, shapes.heap(np.concatenate(berries), 0.042), None, 0.2), 0.27, -0.45, z + 0.12),
        _at(Part("forest", 18, shapes.bottle(0.075, 0.56), None, 0.4), 0.36, 0.42, z),
        _at(Part("white", 18, cone(0.0765, 0.0765, 0.13)), 0.36, 0.42, z + 0.15),
    ]


def _ring(count: int, radius: float, height: float) -> Array:
    """Return `count` positions [count, 3] on a horizontal circle around the vertical axis."""
    angles = 2 * np.pi * np.arange(count) / count + radius
    return np.stack([radius * np.cos(angles), radius * np.sin(angles), np.full(count, height)], axis=1)


def _bananas(x: float, y: float, z: float) -> list[Part]:
    """Return a bunch of bananas that arches over the table, with its stems at (x, y, z)."""
    tints, ripe = banded(shapes.banana_end, _STEM), np.array(_RIPE)
    banana = Part("banana yellow", 26, shapes.banana(0.044), lambda p: ripe * tints(p), 0.15)
    return [_at(banana, x, y, z + 0.012 * i, -75 + 17 * i, -62 + 16 * i) for i in range(4)]
