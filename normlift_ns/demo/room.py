"""The demo room: objects with the names of their colors, on a table, in a room with light and texture.

The color encoder knows only names of colors. Many names in the XKCD color survey are names of objects. The prompt
"tomato red" thus finds the tomatoes here, by their color.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.colors import to_rgb
from scipy.spatial.transform import Rotation

from normlift_ns.demo import paint, things
from normlift_ns.demo.build import HALF_WIDTH, HEIGHT, DemoRoom, Part, Surface, built
from normlift_ns.demo.light import shade
from normlift_ns.demo.shapes import Array, box, capsule, cavity, cone, place, union

_TABLE = 0.62
"""Height of the table top in meters."""
_EXPOSURE = 0.8
"""Share of each part's surface that is no brighter than the color of its name."""
_ROUGHNESS = 0.012
"""Standard deviation of a random factor on every color."""
_DETAILED_AREA = 130.0
"""Visible area of all parts, each multiplied by its `detail`, in square meters."""
_RIPE = (1.0, 1.0, 1.0)
"""Factors that make the pale banana yellow of the survey as yellow as a real banana."""
_STEM = (0.42, 0.33, 0.3)
"""Factors that make the ends of a banana brown."""
_VEIN = (1.7, 1.5, 2.0)
"""Factors that make the middle of a leaf lighter."""
_GOLDEN_ANGLE = 137.5
"""Angle in degrees between successive leaves of a plant."""


def demo_room(num_gaussians: int = 45_000, seed: int = 0) -> DemoRoom:
    """Build the room. The same arguments give the same room.

    Args:
        num_gaussians: N, at least 2000.
    Raises:
        ValueError: `num_gaussians` is too small.
    """
    return built([*_walls(), *_furniture(), *_plant(), *_fruit()], _painted, _DETAILED_AREA, num_gaussians, seed)


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
        matte /= matte.max(axis=1, keepdims=True).clip(1)  # a clipped channel would change the hue
        colors[rows] = matte + part.gloss * shine[rows, None]
    return colors * rng.normal(1, _ROUGHNESS, (len(colors), 1))


def _at(part: Part, x: float, y: float, z: float, turn: float = 0.0, tilt: float = 0.0, roll: float = 0.0) -> Part:
    """Move a part together with its texture: roll about x, tilt about y (+x end down), turn about z, then translate.

    Angles are in degrees.
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
        Part("white", 1, cavity(box(2 * w, 2 * w, 4 * HEIGHT)), paint.mottled(0.3, 0.012)),
        Part("slate", 2, place(box(2 * w, 2 * w, 0.1), 0, 0, -0.05), paint.wood(0.2, 1)),
        Part("sky blue", 3, place(box(0.03, 1.2, 0.8), w, 0, 1.2), paint.mottled(0.35, 0.05, 8)),
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
        Part("merlot", 4, place(box(1.7, 2.0, 0.024, 0.01), 0, 0, 0.004), paint.woven(0.34, 0.85, 1.0)),
        Part("cocoa", 11, union(place(box(1.08, 1.5, 0.06, 0.01), 0, 0, _TABLE - 0.03), *legs), paint.wood(0.27, 0)),
        Part("teal", 4, place(sofa, 0.3, 1.27, 0), paint.cloth()),
        _at(Part("merlot", 7, pillow, paint.cloth(0.05)), 0.72, 1.2, 0.56, 12, 0, -18),
        _at(Part("merlot", 7, pillow, paint.cloth(0.05)), -0.12, 1.2, 0.56, -14, 0, -18),
    ]


def _plant() -> list[Part]:
    """Return a plant on the floor, in the corner."""
    x, y, rim = 1.18, -1.18, 0.42
    pot = union(place(cone(0.17, 0.23, 0.38, 0.012), x, y, 0.19), place(cone(0.255, 0.255, 0.08, 0.015), x, y, 0.38))
    vein = paint.banded(lambda p: 1.2 - np.abs(p[:, 1]) / 0.008, _VEIN)
    blade = Part("forest", 9, things.leaf(0.42, 0.19, 0.03), vein)
    leaves = [_at(blade, x, y, rim + 0.1 + 0.06 * i, _GOLDEN_ANGLE * i + 40, -18 - 4.2 * i) for i in range(13)]
    stalk = Part("forest", 6, capsule((x, y, rim - 0.1), (x, y, rim + 0.8), 0.022))
    return [Part("white", 6, pot, paint.mottled(0.1, 0.03)), stalk, *leaves]


def _fruit() -> list[Part]:
    """Return the objects on the table."""
    z = _TABLE
    tomato = Part("tomato red", 30, things.gourd(0.105, 0.175, 5, 0.06, 0.18), paint.mottled(0.08, 0.02), 0.4)
    star = Part("forest", 40, things.calyx(0.065))
    apple = Part("apple", 30, things.gourd(0.092, 0.17, 1, 0.0, 0.24, 0.25), paint.mottled(0.03, 0.04), 0.35)
    stem = Part("cocoa", 40, capsule((0, 0, 0.13), (0.012, 0, 0.19), 0.007))
    tomatoes = [(-0.27, 0.2, 20), (-0.05, 0.36, 80), (-0.3, 0.43, 140)]
    apples = [(-0.36, -0.04, 30), (-0.16, -0.14, 200)]
    berries = [_ring(10, 0.13, 0.0), _ring(6, 0.072, 0.035), _ring(3, 0.04, 0.085)]
    return [
        _at(Part("pumpkin", 14, things.gourd(0.25, 0.34, 10, 0.13, 0.2), paint.ribs(10, 0.3), 0.15), 0.2, 0.06, z),
        _at(Part("forest", 30, things.tapered((0, 0, 0.27), (0.03, 0.02, 0.4), 0.035, 0.022)), 0.2, 0.06, z),
        *(_at(tomato, x, y, z, turn) for x, y, turn in tomatoes),
        *(_at(star, x, y, z + 0.152, turn) for x, y, turn in tomatoes),
        *(_at(part, x, y, z, turn) for part in (apple, stem) for x, y, turn in apples),
        *_bananas(-0.12, -0.34, z + 0.035),
        _at(Part("eggplant", 22, things.aubergine(), None, 0.35), 0.06, 0.58, z, 12),
        _at(Part("forest", 40, things.aubergine_cap()), 0.06, 0.58, z, 12),
        _at(Part("white", 14, things.bowl(0.2, 0.02), None, 0.2), 0.27, -0.45, z),
        _at(Part("blueberry", 30, things.heap(np.concatenate(berries), 0.042), None, 0.2), 0.27, -0.45, z + 0.12),
        _at(Part("forest", 18, things.bottle(0.075, 0.56), None, 0.4), 0.36, 0.42, z),
        _at(Part("white", 18, cone(0.0765, 0.0765, 0.13)), 0.36, 0.42, z + 0.15),
    ]


def _ring(count: int, radius: float, height: float) -> Array:
    """Return [count, 3] positions around the vertical axis."""
    angles = 2 * np.pi * np.arange(count) / count + radius
    return np.stack([radius * np.cos(angles), radius * np.sin(angles), np.full(count, height)], axis=1)


def _bananas(x: float, y: float, z: float) -> list[Part]:
    """Return a bunch with its stems at (x, y), arched over the table."""
    tints = paint.banded(things.banana_end, _STEM)
    banana = Part("banana yellow", 26, things.banana(0.044), lambda p: _RIPE * tints(p), 0.15)
    return [_at(banana, x, y, z + 0.012 * i, -75 + 17 * i, -62 + 16 * i) for i in range(4)]
