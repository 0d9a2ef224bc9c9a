"""Regions of a photograph, outlined."""

from __future__ import annotations

import torch
from jaxtyping import Bool, UInt8
from torch import Tensor
from torch.nn.functional import max_pool2d

_LINE = (255, 176, 0)
"""Orange, which people of any colour vision tell from a dark rim."""
_DIMMED = 0.45
"""Brightness of what is outside."""
_PIXELS_PER_WIDTH = 320
"""Of the longer side of the picture, for every pixel of the line."""


def outlined(image: UInt8[Tensor, "h w 3"], masks: Bool[Tensor, "r h w"]) -> UInt8[Tensor, "h w 3"]:
    """The picture, darker outside of all regions, with an orange line in a dark rim along the inner edge of each.

    >>> image = torch.full((9, 9, 3), 200, dtype=torch.uint8)
    >>> mask = torch.zeros(1, 9, 9, dtype=torch.bool)
    >>> mask[:, 2:7, 2:7] = True
    >>> shown = outlined(image, mask)
    >>> shown[0, 0].tolist(), shown[2, 4].tolist(), shown[4, 4].tolist()
    ([90, 90, 90], [255, 176, 0], [200, 200, 200])
    """
    width = max(1, round(max(image.shape[:2]) / _PIXELS_PER_WIDTH))
    inside = masks.any(dim=0)
    line = (masks & ~_shrunk(masks, width)).any(dim=0)
    rim = ~line & (~_shrunk(~line[None], width)[0])
    shown = torch.where(inside[:, :, None], image.float(), _DIMMED * image.float())
    shown = torch.where((rim & inside)[:, :, None], 0.25 * shown, shown) if width > 1 else shown
    colour = torch.tensor(_LINE, dtype=torch.float32)
    return torch.where(line[:, :, None], colour, shown).round().to(torch.uint8)


def _shrunk(masks: Bool[Tensor, "r h w"], width: int) -> Bool[Tensor, "r h w"]:
    """Without a border of some pixels; what lies beyond the picture is no part of a mask."""
    outside = torch.nn.functional.pad((~masks).float(), (width,) * 4, value=1.0)
    return max_pool2d(outside[:, None], 2 * width + 1, stride=1)[:, 0] == 0
