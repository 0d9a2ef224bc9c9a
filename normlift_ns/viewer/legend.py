"""Legends in images: a color bar with its scale, or the prompts with their colors."""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float, UInt8
from PIL import Image, ImageDraw, ImageFont
from torch import Tensor

from normlift_ns.colors import Colormap, colors_of
from normlift_ns.errors import shortened, visible

LEAST_HEIGHT = 160
"""Image height in pixels below which there is no legend, as in the small images of a moving camera."""
_MAX_PROMPTS = 12
_BACKDROP, _INK = (20, 20, 20), (255, 255, 255)
_BACKDROP_OPACITY = 0.75


def clipped(text: str, most: int) -> str:
    """Return a text on one line, shortened to at most `most` characters, with unprintable characters escaped.

    >>> clipped("a  red bowl", 8)
    'a red b…'
    """
    return shortened(visible(" ".join(text.split())), most)


@lru_cache(maxsize=16)
def font(size: int) -> ImageFont.FreeTypeFont:
    """Return the font of all images, which comes with matplotlib."""
    from matplotlib import get_data_path  # noqa: PLC0415 (a lift does not need it)

    return ImageFont.truetype(str(Path(get_data_path()) / "fonts" / "ttf" / "DejaVuSans.ttf"), size)


def with_bar(
    image: Float[Tensor, "h w 3"], colormap: Colormap, scale: tuple[float, float], title: str
) -> Float[Tensor, "h w 3"]:
    """Return an image with a color bar in its lower right corner if there is room for one.

    Args:
        image: RGB in 0..1.
        scale: values of the first and the last color.
    """
    height, width = image.shape[:2]
    tile = None if height < LEAST_HEIGHT else _color_bar(colormap, scale, clipped(title, 28), _font_size(height))
    return image if tile is None else _paste(image, tile, width)


def with_prompts(image: Float[Tensor, "h w 3"], texts: Sequence[str], colors: Float[Tensor, "q 3"]) -> Tensor:
    """Return an image [H, W, 3] with prompts and their colors in its lower right corner if there is room for them."""
    height, width = image.shape[:2]
    if height < LEAST_HEIGHT or len(texts) == 0:
        return image
    rows = tuple(clipped(text, 28) for text in texts[:_MAX_PROMPTS])
    rows += (f"and {len(texts) - _MAX_PROMPTS} more",) if len(texts) > _MAX_PROMPTS else ()
    rgb = tuple(tuple(row) for row in (colors[:_MAX_PROMPTS].cpu() * 255).round().int().tolist())
    return _paste(image, _prompt_list(rows, rgb, _font_size(height)), width)


def _font_size(height: int) -> int:
    """Return the font size in pixels for an image height."""
    return max(11, height // 42)


def _paste(image: Tensor, tile: UInt8[np.ndarray, "rows columns 3"], width: int) -> Tensor:
    """Return an image with a tile in its lower right corner if a third of the width stays free."""
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
    typeface, pad = font(size), size // 2
    ends = [f"{end:.2f}" for end in scale]
    width = max(12 * size, round(typeface.getlength(title)))
    tile = Image.new("RGB", (width + 2 * pad, 4 * size + 2 * pad), _BACKDROP)
    draw = ImageDraw.Draw(tile)
    draw.text((pad, pad // 2), title, fill=_INK, font=typeface)
    ramp = (colors_of(colormap).numpy() * 255).round().astype(np.uint8)[None]
    tile.paste(Image.fromarray(ramp).resize((width, size)), (pad, pad + round(1.3 * size)))
    for x, text in ((pad, ends[0]), (pad + width - round(typeface.getlength(ends[1])), ends[1])):
        draw.text((x, pad + round(2.5 * size)), text, fill=_INK, font=typeface)
    return np.array(tile)


@lru_cache(maxsize=4)
def _prompt_list(rows: tuple[str, ...], colors: tuple[tuple[int, int, int], ...], size: int) -> np.ndarray:
    typeface, pad, step = font(size), size // 2, round(1.5 * size)
    width = round(max(typeface.getlength(row) for row in rows)) + 2 * size
    tile = Image.new("RGB", (width + 2 * pad, step * len(rows) + 2 * pad), _BACKDROP)
    draw = ImageDraw.Draw(tile)
    for i, row in enumerate(rows):
        top = pad + i * step
        if i < len(colors):
            draw.rectangle((pad, top + size // 6, pad + size, top + size // 6 + size), fill=colors[i])
        draw.text((pad + 2 * size, top), row, fill=_INK, font=typeface)
    return np.array(tile)
