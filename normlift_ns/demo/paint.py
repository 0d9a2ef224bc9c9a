"""Textures as formulas: factors on the color of a surface at its points. Lengths are in meters."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from normlift_ns.demo.shapes import Array

Paint = Callable[[Array], Array]
"""Returns factors [n, 3] or [n, 1] at points [n, 3]."""

_WAVES = 9
"""Number of waves in the noise; fewer give a regular pattern."""


def noise(points: Array, size: float, seed: int = 0) -> Array:
    """Return smooth noise with spots of about `size`, [n], mean 0, mostly in -1..1: plane waves of random
    directions."""
    rng = np.random.default_rng(seed)
    waves = rng.normal(size=(_WAVES, 3)) * (2 / size)
    return np.sin(points @ waves.T + rng.uniform(0, 2 * np.pi, _WAVES)).sum(axis=1) / np.sqrt(_WAVES)


def mottled(size: float, depth: float, seed: int = 0) -> Paint:
    """Return spots of about `size`, lighter and darker by about `depth`."""
    return lambda p: 1 + depth * noise(p, size, seed)[:, None]


def wood(width: float, across: int, ring: float = 0.035, joint: float = 0.006, contrast: float = 1.0) -> Paint:
    """Return boards of `width` with grain, side by side along the horizontal axis `across` (0: x, 1: y).

    Args:
        ring: distance between the lines of the grain.
        joint: half the width of the dark line between two boards.
        contrast: contrast of the grain; dark woods need more.
    """

    def paint(p: Array) -> Array:
        board = np.floor(p[:, across] / width)
        local = p + 7.3 * board[:, None]  # each board has another part of the grain
        stretched = local * np.where(np.arange(3) == 1 - across, 0.18, 1)  # the grain runs along the board
        rings = stretched[:, across] / ring + 1.1 * noise(stretched, 0.12, 1)
        grain = 0.09 * np.sin(2 * np.pi * rings) + 0.05 * noise(stretched, 0.03, 2)
        tone = 0.09 * np.sin(board * 12.9898)
        edge = np.abs(p[:, across] / width - board - 0.5) * width  # from the middle of the board
        return ((1 + contrast * (grain + tone)) * np.where(edge > width / 2 - joint, 0.62, 1))[:, None]

    return paint


def woven(band: float, half_length: float, half_width: float) -> Paint:
    """Return the pattern of a rug around the origin, with rows of diamonds of length `band` and a darker border."""

    def paint(p: Array) -> Array:
        x, y = p[:, 0] / band, p[:, 1] / band
        diamond = np.abs((x % 1) - 0.5) + np.abs((y % 1) - 0.5)
        tone = np.where(diamond < 0.2, 1.15, np.where(diamond < 0.4, 0.7, 0.95))
        to_edge = np.minimum(half_length - np.abs(p[:, 0]), half_width - np.abs(p[:, 1]))
        tone = np.where(to_edge < 0.4 * band, np.where(to_edge < 0.2 * band, 0.6, 1.1), tone)
        return (tone * (1 + 0.04 * noise(p, 0.03, 3)))[:, None]

    return paint


def cloth(thread: float = 0.03) -> Paint:
    """Return a slightly uneven weave of crossing threads."""
    return lambda p: (
        1 + 0.05 * np.sin(2 * np.pi * (p[:, :1] + p[:, 2:]) / thread) * np.sin(2 * np.pi * p[:, 1:2] / thread)
    ) * (1 + 0.05 * noise(p, 0.12, 4)[:, None])  # fmt: skip


def ribs(count: int, depth: float) -> Paint:
    """Return dark furrows between the ribs of `things.gourd`."""

    def paint(p: Array) -> Array:
        furrow = 1 - np.abs(np.cos(count / 2 * np.arctan2(p[:, 1], p[:, 0])))
        return ((1 - depth * furrow**2) * (1 + 0.03 * noise(p, 0.05, 5)))[:, None]

    return paint


def banded(tones: Callable[[Array], Array], tint: tuple[float, float, float]) -> Paint:
    """Return `tint` at points whose `tones` is 1, and the plain color at those whose `tones` is 0."""
    return lambda p: 1 + tones(p).clip(0, 1)[:, None] * (np.array(tint) - 1)
