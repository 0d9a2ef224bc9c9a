"""Colors of query results, the same in every viewer and figure.

Relevancy is drawn with a perceptual colormap that is readable with color blindness. Opacity rises with relevancy, which
keeps weak matches unobtrusive. A prompt that names a color is drawn in that color. The other prompts get colors that
are distinguishable with any color vision (Okabe and Ito, 2008), as long as there are enough of these.
"""

from __future__ import annotations

import colorsys
from collections.abc import Sequence
from functools import cache
from typing import Literal, get_args

import torch
from jaxtyping import Float
from torch import Tensor

from normlift_ns.encoders.texts.colours import colour_names, survey

Colormap = Literal["viridis", "cividis", "inferno", "magma", "turbo"]
COLORMAPS: tuple[Colormap, ...] = get_args(Colormap)
"""Available colormaps, the default first. turbo is offered because it is well known; it is neither perceptually uniform
nor readable with color blindness.
"""
RELIABILITY_COLORS: Colormap = "cividis"
"""Colormap of R, always over the range 0 to 1."""
FAINT, OPAQUE = 0.35, 0.9
"""Opacity over the scene at the lowest and at the highest selected relevancy."""
_OKABE_ITO = ("e69f00", "56b4e9", "009e73", "f0e442", "0072b2", "d55e00", "cc79a7")
_MIN_SATURATION = 0.3
"""Prompts that name a less saturated color are not drawn in it: gray is the color of everything not selected."""
_MIN_DISTANCE = 0.25
"""Distance in RGB at which two colors are distinguishable."""


def colors_of(colormap: Colormap) -> Float[Tensor, "256 3"]:
    """Return the RGB values, in 0..1, of a matplotlib colormap.

    >>> [round(x, 2) for x in colors_of("viridis")[255].tolist()]
    [0.99, 0.91, 0.14]
    """
    from matplotlib import colormaps  # noqa: PLC0415 (a lift does not need it)

    return torch.from_numpy(colormaps[colormap](torch.arange(256).numpy())[:, :3]).float()


def heat(
    relevancy: Float[Tensor, "*n"],
    scale: tuple[float, float],
    colors: Float[Tensor, "256 3"],
    *,
    faint: float = FAINT,
) -> tuple[Float[Tensor, "*n 3"], Float[Tensor, "*n"]]:
    """Map relevancy to a color and an opacity over the scene.

    Args:
        scale: relevancies of the first and the last color; relevancies outside this range are clamped.
        colors: RGB values of a colormap, in 0..1.
        faint: opacity of the first color; the last color has opacity `OPAQUE`.

    >>> heat(torch.tensor([0.0, 0.5, 1.0]), (0.0, 1.0), colors_of("viridis"))[1]
    tensor([0.3500, 0.6250, 0.9000])
    """
    step = ((relevancy - scale[0]) / (scale[1] - scale[0])).clamp(0, 1)
    return colors[(step * 255).round().long()], faint + (OPAQUE - faint) * step


def named_color(text: str) -> tuple[float, float, float] | None:
    """Return the first saturated color that a prompt names, as RGB in 0..1; None if it names none.

    Color names are those of the XKCD color survey.

    >>> [round(255 * x) for x in named_color("a sky blue bowl")]
    [117, 187, 253]
    >>> named_color("the fox"), named_color("white")
    (None, None)
    """
    table = survey()
    named = [table[name] for name in colour_names(text) if name in table]  # each name with a slash has a twin without
    colors = [(c[0] / 255, c[1] / 255, c[2] / 255) for c in (bytes.fromhex(code[1:]) for code in named)]
    return next((color for color in colors if colorsys.rgb_to_hsv(*color)[1] >= _MIN_SATURATION), None)


def prompt_colors(texts: Sequence[str]) -> Float[Tensor, "q 3"]:
    """Return a color for each prompt, as RGB in 0..1: the color that it names, or one distinguishable from the others.

    >>> (prompt_colors(["fox", "sky blue", "sky blue bowl"]) * 255).round().int().tolist()
    [[230, 159, 0], [117, 187, 253], [0, 158, 115]]
    """
    colors: list[tuple[float, ...] | None] = []
    for text in texts:
        color = named_color(text)
        colors.append(None if color in colors else color)
    used = [color for color in colors if color is not None]
    for i, color in enumerate(colors):
        if color is None:
            colors[i] = _distinct(used)
            used.append(colors[i])  # type: ignore[arg-type]
    return torch.tensor(colors, dtype=torch.float32).reshape(len(colors), 3)


def _distinct(used: Sequence[tuple[float, ...]]) -> tuple[float, ...]:
    """Return the first of `_candidates` that is distinguishable from the used colors, or the one farthest from them."""
    if len(used) == 0:
        return _candidates()[0]
    distance = torch.cdist(torch.tensor(_candidates()), torch.tensor(used)).amin(dim=1)
    distinct = (distance >= _MIN_DISTANCE).nonzero()
    return _candidates()[int(distinct[0]) if len(distinct) > 0 else int(distance.argmax())]


@cache
def _candidates() -> tuple[tuple[float, ...], ...]:
    """Return Okabe and Ito's colors, then hues spaced by the golden ratio of the color wheel, in four tones."""
    okabe_ito = (tuple(int(color[i : i + 2], 16) / 255 for i in (0, 2, 4)) for color in _OKABE_ITO)
    tones = ((0.85, 0.95), (0.6, 0.95), (0.85, 0.65), (0.45, 0.75))  # saturation and value
    return (*okabe_ito, *(colorsys.hsv_to_rgb((i * 0.618034) % 1, *tones[i % 4]) for i in range(160)))
