"""Colors and legends of query results, the same in every viewer and figure.

The default colormap of relevancy is perceptually uniform and readable with color blindness. Opacity increases with
relevancy, so that weak matches are less visible. A prompt that names a saturated color is drawn in this color, unless
an earlier prompt has it. Other prompts get colors that are distinguishable with any color vision (Okabe and Ito, 2008),
or further hues if these colors are used up.
"""

from __future__ import annotations

import colorsys
from collections.abc import Sequence
from functools import cache, lru_cache
from pathlib import Path
from typing import Literal, get_args

import numpy as np
import torch
from jaxtyping import Float, UInt8
from PIL import Image, ImageDraw, ImageFont
from torch import Tensor

from normlift_ns.encoders.color import find_color_names, xkcd_colors
from normlift_ns.errors import escape_unprintable, truncate_text

Colormap = Literal["viridis", "cividis", "inferno", "magma", "turbo"]
COLORMAPS: tuple[Colormap, ...] = get_args(Colormap)
"""Available colormaps, the default first. turbo is well known, but neither perceptually uniform nor readable with color
blindness.
"""
RELIABILITY_COLORMAP: Colormap = "cividis"
"""Colormap of the reliability R, always over the range 0 to 1."""
MIN_OVERLAY_OPACITY, MAX_OVERLAY_OPACITY = 0.35, 0.9
"""Opacity of the overlay at the first and the last color of its scale."""
_OKABE_ITO = ("e69f00", "56b4e9", "009e73", "f0e442", "0072b2", "d55e00", "cc79a7")
_MIN_SATURATION = 0.3
"""Minimum saturation of a named color for use as the prompt's color, because unselected Gaussians are gray."""
_MIN_DISTANCE = 0.25
"""Minimum distance in RGB between two distinguishable colors."""


def colormap_rgb(colormap: Colormap) -> Float[Tensor, "256 3"]:
    """Return the 256 colors of a matplotlib colormap, RGB in 0..1.

    >>> [round(x, 2) for x in colormap_rgb("viridis")[255].tolist()]
    [0.99, 0.91, 0.14]
    """
    from matplotlib import colormaps  # noqa: PLC0415 (a lift does not need it)

    return torch.from_numpy(colormaps[colormap](torch.arange(256).numpy())[:, :3]).float()


def apply_colormap(
    relevancy: Float[Tensor, "*n"],
    scale: tuple[float, float],
    colors: Float[Tensor, "256 3"],
    *,
    min_opacity: float = MIN_OVERLAY_OPACITY,
) -> tuple[Float[Tensor, "*n 3"], Float[Tensor, "*n"]]:
    """Map relevancy to a color and an opacity over the scene.

    Args:
        scale: Relevancies of the first and the last color; relevancies outside this range are clamped.
        colors: Colors of a colormap, RGB in 0..1.
        min_opacity: Opacity of the first color; the last color has opacity `MAX_OVERLAY_OPACITY`.

    >>> apply_colormap(torch.tensor([0.0, 0.5, 1.0]), (0.0, 1.0), colormap_rgb("viridis"))[1]
    tensor([0.3500, 0.6250, 0.9000])
    """
    step = ((relevancy - scale[0]) / (scale[1] - scale[0])).clamp(0, 1)
    return colors[(step * 255).round().long()], min_opacity + (MAX_OVERLAY_OPACITY - min_opacity) * step


def named_color(text: str) -> tuple[float, float, float] | None:
    """Return the first saturated color that a prompt names, as RGB in 0..1; None if it names no saturated color.

    The color names are those of the XKCD color survey.

    >>> [round(255 * x) for x in named_color("a sky blue bowl")]
    [117, 187, 253]
    >>> named_color("the fox"), named_color("white")
    (None, None)
    """
    table = xkcd_colors()  # for every name with a slash, it also has the name without the slash
    codes = (bytes.fromhex(table[name][1:]) for name in find_color_names(text) if name in table)
    colors = ((c[0] / 255, c[1] / 255, c[2] / 255) for c in codes)
    return next((color for color in colors if colorsys.rgb_to_hsv(*color)[1] >= _MIN_SATURATION), None)


def prompt_colors(texts: Sequence[str]) -> Float[Tensor, "q 3"]:
    """Return a color for each prompt, RGB in 0..1.

    A prompt gets the color that it names. If it names no saturated color, or an earlier prompt has the same color, it
    gets a distinguishable one.

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
    """Return the first candidate color that is distinguishable from the used colors, or else the most distant one."""
    if len(used) == 0:
        return _candidates()[0]
    distance = torch.cdist(torch.tensor(_candidates()), torch.tensor(used)).amin(dim=1)
    distinct = (distance >= _MIN_DISTANCE).nonzero()
    return _candidates()[int(distinct[0]) if len(distinct) > 0 else int(distance.argmax())]


@cache
def _candidates() -> tuple[tuple[float, ...], ...]:
    """Return Okabe and Ito's colors, then hues at golden-ratio steps around the color wheel, in four tones."""
    okabe_ito = (tuple(int(color[i : i + 2], 16) / 255 for i in (0, 2, 4)) for color in _OKABE_ITO)
    tones = ((0.85, 0.95), (0.6, 0.95), (0.85, 0.65), (0.45, 0.75))  # saturation and value
    return (*okabe_ito, *(colorsys.hsv_to_rgb((i * 0.618034) % 1, *tones[i % 4]) for i in range(160)))


RGB = tuple[float, float, float]
"""RGB color with components in 0..1."""


def prompt_rgb_tuples(texts: Sequence[str]) -> list[RGB]:
    """Return the colors of `prompt_colors` as tuples.

    >>> [tuple(round(x, 2) for x in color) for color in prompt_rgb_tuples(["yellow bowl", "fox"])]
    [(1.0, 1.0, 0.08), (0.9, 0.62, 0.0)]
    """
    return [(red, green, blue) for red, green, blue in prompt_colors(texts).tolist()]


# Legends in images: a color bar with its scale, or a list of prompts with their colors.


MIN_LEGEND_HEIGHT = 160
"""Minimum height in pixels of an image with a legend. Smaller images, such as those rendered while the camera
moves, have none."""
_MAX_PROMPTS = 12
_BACKDROP, _INK = (20, 20, 20), (255, 255, 255)
_BACKDROP_OPACITY = 0.75


def clip_text(text: str, most: int) -> str:
    """Convert a text to one line of at most `most` characters, with unprintable characters escaped.

    >>> clip_text("a  red bowl", 8)
    'a red b…'
    """
    return truncate_text(escape_unprintable(" ".join(text.split())), most)


@lru_cache(maxsize=16)
def load_font(size: int) -> ImageFont.FreeTypeFont:
    """Load matplotlib's DejaVu Sans, the font of all images, at a size in pixels."""
    from matplotlib import get_data_path  # noqa: PLC0415 (a lift does not need it)

    return ImageFont.truetype(str(Path(get_data_path()) / "fonts" / "ttf" / "DejaVuSans.ttf"), size)


def add_color_bar(
    image: Float[Tensor, "h w 3"], colormap: Colormap, scale: tuple[float, float], title: str
) -> Float[Tensor, "h w 3"]:
    """Add a color bar to the lower right corner of an image, if there is enough space.

    Args:
        image: RGB in 0..1.
        scale: Values of the first and the last color.
        title: Title above the color bar.
    """
    height, width = image.shape[:2]
    tile = None if height < MIN_LEGEND_HEIGHT else _color_bar(colormap, scale, clip_text(title, 28), _font_size(height))
    return image if tile is None else _paste(image, tile, width)


def add_prompt_legend(image: Float[Tensor, "h w 3"], texts: Sequence[str], colors: Float[Tensor, "q 3"]) -> Tensor:
    """Add a legend of prompts to the lower right corner of an image [H, W, 3], if there is enough space."""
    height, width = image.shape[:2]
    if height < MIN_LEGEND_HEIGHT or len(texts) == 0:
        return image
    rows = tuple(clip_text(text, 28) for text in texts[:_MAX_PROMPTS])
    rows += (f"and {len(texts) - _MAX_PROMPTS} more",) if len(texts) > _MAX_PROMPTS else ()
    rgb = tuple(tuple(row) for row in (colors[:_MAX_PROMPTS].cpu() * 255).round().int().tolist())
    return _paste(image, _prompt_list(rows, rgb, _font_size(height)), width)


def _font_size(height: int) -> int:
    """Return the font size in pixels for an image of the given height."""
    return max(11, height // 42)


def _paste(image: Tensor, tile: UInt8[np.ndarray, "rows columns 3"], width: int) -> Tensor:
    """Paste a tile into the lower right corner of an image, if it fits and leaves a third of the width free."""
    rows, columns = tile.shape[:2]
    margin = max(4, rows // 8)
    if 3 * columns > 2 * width or columns + 2 * margin > width or rows + 2 * margin > len(image):
        return image
    corner = (slice(-rows - margin, -margin), slice(-columns - margin, -margin))
    result = image.clone()
    opacity = np.where((tile == _BACKDROP).all(axis=2), _BACKDROP_OPACITY, 1.0)  # the backdrop is translucent
    opacity = torch.from_numpy(opacity[:, :, None]).to(image)
    result[corner] = opacity * (torch.from_numpy(tile).to(image) / 255) + (1 - opacity) * result[corner]
    return result


@lru_cache(maxsize=64)
def _color_bar(colormap: Colormap, scale: tuple[float, float], title: str, size: int) -> np.ndarray:
    typeface, pad = load_font(size), size // 2
    ends = [f"{end:.2f}" for end in scale]
    width = max(12 * size, round(typeface.getlength(title)))
    tile = Image.new("RGB", (width + 2 * pad, 4 * size + 2 * pad), _BACKDROP)
    draw = ImageDraw.Draw(tile)
    draw.text((pad, pad // 2), title, fill=_INK, font=typeface)
    ramp = (colormap_rgb(colormap).numpy() * 255).round().astype(np.uint8)[None]
    tile.paste(Image.fromarray(ramp).resize((width, size)), (pad, pad + round(1.3 * size)))
    for x, text in ((pad, ends[0]), (pad + width - round(typeface.getlength(ends[1])), ends[1])):
        draw.text((x, pad + round(2.5 * size)), text, fill=_INK, font=typeface)
    return np.array(tile)


@lru_cache(maxsize=4)
def _prompt_list(rows: tuple[str, ...], colors: tuple[tuple[int, int, int], ...], size: int) -> np.ndarray:
    typeface, pad, step = load_font(size), size // 2, round(1.5 * size)
    width = round(max(typeface.getlength(row) for row in rows)) + 2 * size
    tile = Image.new("RGB", (width + 2 * pad, step * len(rows) + 2 * pad), _BACKDROP)
    draw = ImageDraw.Draw(tile)
    for i, row in enumerate(rows):
        top = pad + i * step
        if i < len(colors):
            draw.rectangle((pad, top + size // 6, pad + size, top + size // 6 + size), fill=colors[i])
        draw.text((pad + 2 * size, top), row, fill=_INK, font=typeface)
    return np.array(tile)
