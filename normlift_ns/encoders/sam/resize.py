"""Pillow's bilinear resize, to the bit, on any device.

Pillow resizes 8-bit images along rows, then along columns, each with weights of 22 bits and sums that are rounded to 8
bits. All of it is arithmetic of integers below 2^31, which comes out the same everywhere. Where images lose rows,
Pillow 13 may begin with the columns instead, if that is less work: then pixels differ by one at most.
"""

from __future__ import annotations

import math
from functools import lru_cache

import torch
from jaxtyping import Int32, Int64, UInt8
from torch import Tensor

_BITS = 22


def resize_bilinear(image: UInt8[Tensor, "h w c"], height: int, width: int) -> UInt8[Tensor, "height width c"]:
    """What Pillow's Image.resize with Resampling.BILINEAR makes of an image."""
    wide = _along(1, image, width) if width != image.shape[1] else image
    return _along(0, wide, height) if height != image.shape[0] else wide


def _along(axis: int, image: Tensor, size: int) -> Tensor:
    first, weights = (x.to(image.device) for x in _weights(image.shape[axis], size))
    shape = [1, 1, 1]
    shape[axis] = size
    total = torch.full((), 1 << (_BITS - 1), dtype=torch.int32, device=image.device)
    for tap, weight in enumerate(weights):
        at = (first + tap).clamp(max=image.shape[axis] - 1)  # beyond the last the weight is 0
        total = total + image.index_select(axis, at).int() * weight.view(shape)
    return (total >> _BITS).to(torch.uint8)


@lru_cache(maxsize=64)
def _weights(size: int, wanted: int) -> tuple[Int64[Tensor, " n"], Int32[Tensor, "taps n"]]:
    """For every sample the first pixel that it is made of, and the weights of that and of those after it."""
    scale = size / wanted
    reach = max(scale, 1.0)
    centre = (torch.arange(wanted, dtype=torch.float64) + 0.5) * scale
    first = (centre - reach + 0.5).long().clamp(min=0)
    last = (centre + reach + 0.5).long().clamp(max=size)
    place = first + torch.arange(2 * math.ceil(reach) + 1)[:, None]
    share = (1 - ((place - centre + 0.5) * (1.0 / reach)).abs()).clamp(min=0) * (place < last)
    total = torch.zeros_like(centre)
    for tap in share:  # in Pillow's order, so that sums are rounded alike
        total = total + tap
    return first, (0.5 + share / total * (1 << _BITS)).int()
