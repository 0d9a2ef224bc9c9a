"""Colours of prompts, as tuples: those of `normlift_ns.colors`, which every viewer and picture has."""

from __future__ import annotations

from collections.abc import Sequence

from normlift_ns.colors import prompt_colors

Colour = tuple[float, float, float]
"""RGB in 0..1."""


def prompt_colours(texts: Sequence[str]) -> list[Colour]:
    """One colour per prompt: that of the first colour name in it, else one that tells it apart.

    >>> [tuple(round(x, 2) for x in colour) for colour in prompt_colours(["yellow bowl", "fox"])]
    [(1.0, 1.0, 0.08), (0.9, 0.62, 0.0)]
    """
    return [(red, green, blue) for red, green, blue in prompt_colors(texts).tolist()]
