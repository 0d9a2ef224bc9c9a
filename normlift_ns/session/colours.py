"""Colors of prompts as tuples, the same in every viewer and figure."""

from __future__ import annotations

from collections.abc import Sequence

from normlift_ns.colors import prompt_colors

Colour = tuple[float, float, float]
"""RGB in 0..1."""


def prompt_colours(texts: Sequence[str]) -> list[Colour]:
    """Return a color for each prompt: that of the first color name in it, else a distinct one.

    >>> [tuple(round(x, 2) for x in color) for color in prompt_colours(["yellow bowl", "fox"])]
    [(1.0, 1.0, 0.08), (0.9, 0.62, 0.0)]
    """
    return [(red, green, blue) for red, green, blue in prompt_colors(texts).tolist()]
