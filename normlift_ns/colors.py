"""Colours of what is found, the same in every viewer and picture.

Relevancy goes through a perceptual colour map that colour-blind people can read, the more opaque the larger it is, so
that weak matches stay quiet. A prompt that names a colour has that colour; the others have colours that people with any
colour vision tell apart (Okabe and Ito, 2008), as far as there are enough.
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
"""The first is the default. turbo is there for people who are used to it; it is neither even nor safe."""
RELIABILITY_COLORS: Colormap = "cividis"
"""Of R, always from 0 to 1."""
FAINT, OPAQUE = 0.35, 0.9
"""Opacity over the scene of the least and of the most relevant of what is selected."""
_OKABE_ITO = ("e69f00", "56b4e9", "009e73", "f0e442", "0072b2", "d55e00", "cc79a7")
_LEAST_SATURATION = 0.3
"""A prompt for something grey is not drawn in grey, which is the colour of all that is not selected."""
_APART = 0.25
"""Distance in RGB at which two colours are told apart."""


def colors_of(colormap: Colormap) -> Float[Tensor, "256 3"]:
    """RGB in 0..1 of matplotlib's colour map.

    >>> [round(x, 2) for x in colors_of("viridis")[255].tolist()]
    [0.99, 0.91, 0.14]
    """
    from matplotlib import colormaps  # noqa: PLC0415 (a lift does without)

    return torch.from_numpy(colormaps[colormap](torch.arange(256).numpy())[:, :3]).float()


def heat(
    relevancy: Float[Tensor, "*n"],
    scale: tuple[float, float],
    colors: Float[Tensor, "256 3"],
    *,
    faint: float = FAINT,
) -> tuple[Float[Tensor, "*n 3"], Float[Tensor, "*n"]]:
    """Colour, and opacity over the scene, by relevancy.

    Args:
        scale: relevancies of the first and the last colour; what is beyond them gets these.
        faint: opacity of the first colour; that of the last is `OPAQUE`.

    >>> heat(torch.tensor([0.0, 0.5, 1.0]), (0.0, 1.0), colors_of("viridis"))[1]
    tensor([0.3500, 0.6250, 0.9000])
    """
    step = ((relevancy - scale[0]) / (scale[1] - scale[0])).clamp(0, 1)
    return colors[(step * 255).round().long()], faint + (OPAQUE - faint) * step


def named_color(text: str) -> tuple[float, float, float] | None:
    """RGB in 0..1 of the first strong colour that a text names, by the XKCD colour survey; None: it names none.

    >>> [round(255 * x) for x in named_color("a sky blue bowl")]
    [117, 187, 253]
    >>> named_color("the fox"), named_color("white")
    (None, None)
    """
    table = survey()
    named = [table[name] for name in colour_names(text) if name in table]  # without a slash, as one of each pair is
    colors = [(c[0] / 255, c[1] / 255, c[2] / 255) for c in (bytes.fromhex(code[1:]) for code in named)]
    return next((color for color in colors if colorsys.rgb_to_hsv(*color)[1] >= _LEAST_SATURATION), None)


def prompt_colors(texts: Sequence[str]) -> Float[Tensor, "q 3"]:
    """RGB in 0..1 of every prompt: the colour that it names, or one that is told apart from those before.

    >>> (prompt_colors(["fox", "sky blue", "sky blue bowl"]) * 255).round().int().tolist()
    [[230, 159, 0], [117, 187, 253], [0, 158, 115]]
    """
    found: list[tuple[float, ...] | None] = []
    for text in texts:
        color = named_color(text)
        found.append(None if color in found else color)
    taken = [color for color in found if color is not None]
    for i, color in enumerate(found):
        if color is None:
            found[i] = _another(taken)
            taken.append(found[i])  # type: ignore[arg-type]
    return torch.tensor(found, dtype=torch.float32).reshape(len(found), 3)


def _another(taken: Sequence[tuple[float, ...]]) -> tuple[float, ...]:
    """The first of `_candidates` that is told apart from the colours taken, or the one farthest from them."""
    if len(taken) == 0:
        return _candidates()[0]
    distance = torch.cdist(torch.tensor(_candidates()), torch.tensor(taken)).amin(dim=1)
    apart = (distance >= _APART).nonzero()
    return _candidates()[int(apart[0]) if len(apart) > 0 else int(distance.argmax())]


@cache
def _candidates() -> tuple[tuple[float, ...], ...]:
    """Okabe and Ito's colours, then hues a golden section of the circle apart, in four tones."""
    safe = (tuple(int(color[i : i + 2], 16) / 255 for i in (0, 2, 4)) for color in _OKABE_ITO)
    tones = ((0.85, 0.95), (0.6, 0.95), (0.85, 0.65), (0.45, 0.75))
    return (*safe, *(colorsys.hsv_to_rgb((i * 0.618034) % 1, *tones[i % 4]) for i in range(160)))
