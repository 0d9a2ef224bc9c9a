"""The legend in a picture: a colour bar with its scale, or the prompts with their colours."""

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
"""Pictures that are lower, as viewers draw them while the camera moves, have no room for a legend."""
_MOST_ROWS = 12
_BACKDROP, _INK = (20, 20, 20), (255, 255, 255)
_BACKDROP_OPACITY = 0.75


def clipped(text: str, most: int) -> str:
    """The text on one line, cut where it is longer than `most` characters, with escapes for what is not printed.

    >>> clipped("a  red bowl", 8)
    'a red b…'
    """
    return shortened(visible(" ".join(text.split())), most)


@lru_cache(maxsize=16)
def font(size: int) -> ImageFont.FreeTypeFont:
    """The font of all pictures, which comes with matplotlib."""
    from matplotlib import get_data_path  # noqa: PLC0415 (a lift does without)

    return ImageFont.truetype(str(Path(get_data_path()) / "fonts" / "ttf" / "DejaVuSans.ttf"), size)


def with_bar(
    picture: Float[Tensor, "h w 3"], colormap: Colormap, scale: tuple[float, float], title: str
) -> Float[Tensor, "h w 3"]:
    """The picture, with a colour bar in its lower right corner where there is room for one.

    Args:
        picture: RGB in 0..1.
        scale: what the first and the last colour stand for.
    """
    height, width = picture.shape[:2]
    tile = None if height < LEAST_HEIGHT else _bar(colormap, scale, clipped(title, 28), _size(height))
    return picture if tile is None else _stamped(picture, tile, width)


def with_prompts(picture: Float[Tensor, "h w 3"], texts: Sequence[str], colors: Float[Tensor, "q 3"]) -> Tensor:
    """The picture [H, W, 3], with prompts and their colours in its lower right corner where there is room for them."""
    height, width = picture.shape[:2]
    if height < LEAST_HEIGHT or len(texts) == 0:
        return picture
    rows = tuple(clipped(text, 28) for text in texts[:_MOST_ROWS])
    rows += (f"and {len(texts) - _MOST_ROWS} more",) if len(texts) > _MOST_ROWS else ()
    rgb = tuple(tuple(row) for row in (colors[:_MOST_ROWS].cpu() * 255).round().int().tolist())
    return _stamped(picture, _list(rows, rgb, _size(height)), width)


def _size(height: int) -> int:
    """Of the font, in pixels."""
    return max(11, height // 42)


def _stamped(picture: Tensor, tile: UInt8[np.ndarray, "rows columns 3"], width: int) -> Tensor:
    """The picture, with a tile in its lower right corner, if it leaves a third of the width free."""
    rows, columns = tile.shape[:2]
    margin = max(4, rows // 8)
    if 3 * columns > 2 * width or columns + 2 * margin > width or rows + 2 * margin > len(picture):
        return picture
    there = (slice(-rows - margin, -margin), slice(-columns - margin, -margin))
    out = picture.clone()
    opacity = np.where((tile == _BACKDROP).all(axis=2), _BACKDROP_OPACITY, 1.0)  # the backdrop lets the picture through
    opacity = torch.from_numpy(opacity[:, :, None]).to(picture)
    out[there] = opacity * (torch.from_numpy(tile).to(picture) / 255) + (1 - opacity) * out[there]
    return out


@lru_cache(maxsize=64)
def _bar(colormap: Colormap, scale: tuple[float, float], title: str, size: int) -> np.ndarray:
    letters, pad = font(size), size // 2
    ends = [f"{end:.2f}" for end in scale]
    wide = max(12 * size, round(letters.getlength(title)))
    tile = Image.new("RGB", (wide + 2 * pad, 4 * size + 2 * pad), _BACKDROP)
    draw = ImageDraw.Draw(tile)
    draw.text((pad, pad // 2), title, fill=_INK, font=letters)
    ramp = (colors_of(colormap).numpy() * 255).round().astype(np.uint8)[None]
    tile.paste(Image.fromarray(ramp).resize((wide, size)), (pad, pad + round(1.3 * size)))
    for x, text in ((pad, ends[0]), (pad + wide - round(letters.getlength(ends[1])), ends[1])):
        draw.text((x, pad + round(2.5 * size)), text, fill=_INK, font=letters)
    return np.array(tile)


@lru_cache(maxsize=4)
def _list(rows: tuple[str, ...], colors: tuple[tuple[int, int, int], ...], size: int) -> np.ndarray:
    letters, pad, step = font(size), size // 2, round(1.5 * size)
    wide = round(max(letters.getlength(row) for row in rows)) + 2 * size
    tile = Image.new("RGB", (wide + 2 * pad, step * len(rows) + 2 * pad), _BACKDROP)
    draw = ImageDraw.Draw(tile)
    for i, row in enumerate(rows):
        top = pad + i * step
        if i < len(colors):
            draw.rectangle((pad, top + size // 6, pad + size, top + size // 6 + size), fill=colors[i])
        draw.text((pad + 2 * size, top), row, fill=_INK, font=letters)
    return np.array(tile)
