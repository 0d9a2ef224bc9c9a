"""Outlines of regions in an image."""

from __future__ import annotations

import torch
from jaxtyping import Bool, UInt8
from torch import Tensor
from torch.nn.functional import max_pool2d

_LINE_COLOR = (255, 176, 0)
"""Orange, which contrasts with the dark rim for people with any color vision."""
_OUTSIDE_BRIGHTNESS = 0.45
_SIDE_PER_LINE_WIDTH = 320
"""Pixels of the longer image side per pixel of line width."""


def outlined(image: UInt8[Tensor, "h w 3"], masks: Bool[Tensor, "r h w"]) -> UInt8[Tensor, "h w 3"]:
    """Darken an image outside all regions, and draw an orange line with a dark rim along the inner edge of each region.

    >>> image = torch.full((9, 9, 3), 200, dtype=torch.uint8)
    >>> mask = torch.zeros(1, 9, 9, dtype=torch.bool)
    >>> mask[:, 2:7, 2:7] = True
    >>> shown = outlined(image, mask)
    >>> shown[0, 0].tolist(), shown[2, 4].tolist(), shown[4, 4].tolist()
    ([90, 90, 90], [255, 176, 0], [200, 200, 200])
    """
    width = max(1, round(max(image.shape[:2]) / _SIDE_PER_LINE_WIDTH))
    inside = masks.any(dim=0)
    line = (masks & ~_eroded(masks, width)).any(dim=0)
    rim = ~line & (~_eroded(~line[None], width)[0])
    shown = torch.where(inside[:, :, None], image.float(), _OUTSIDE_BRIGHTNESS * image.float())
    shown = torch.where((rim & inside)[:, :, None], 0.25 * shown, shown) if width > 1 else shown
    color = torch.tensor(_LINE_COLOR, dtype=torch.float32)
    return torch.where(line[:, :, None], color, shown).round().to(torch.uint8)


def _eroded(masks: Bool[Tensor, "r h w"], width: int) -> Bool[Tensor, "r h w"]:
    """Erode masks by `width` pixels; pixels beyond the image count as outside."""
    outside = torch.nn.functional.pad((~masks).float(), (width,) * 4, value=1.0)
    return max_pool2d(outside[:, None], 2 * width + 1, stride=1)[:, 0] == 0
