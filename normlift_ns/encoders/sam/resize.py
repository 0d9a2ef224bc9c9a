"""Bit-exact version of Pillow's bilinear resize for any device.

Pillow resizes 8-bit images along rows, then along columns, with weights of 22 bits and sums rounded to 8 bits. This is
integer arithmetic below 2^31, which gives the same result on every device. Pillow 13 may start with the columns if the
image loses rows and this is less work; pixels then differ by at most one.
"""

from __future__ import annotations

import math
from functools import lru_cache

import torch
from jaxtyping import Int32, Int64, UInt8
from torch import Tensor

_BITS = 22


def resize_bilinear(image: UInt8[Tensor, "h w c"], height: int, width: int) -> UInt8[Tensor, "height width c"]:
    """Resize an image like Pillow's Image.resize with Resampling.BILINEAR."""
    resized = _resize_axis(1, image, width) if width != image.shape[1] else image
    return _resize_axis(0, resized, height) if height != image.shape[0] else resized


def _resize_axis(axis: int, image: Tensor, size: int) -> Tensor:
    first, weights = (x.to(image.device) for x in _pillow_weights(image.shape[axis], size))
    shape = [1, 1, 1]
    shape[axis] = size
    total = torch.full((), 1 << (_BITS - 1), dtype=torch.int32, device=image.device)
    for tap, weight in enumerate(weights):
        index = (first + tap).clamp(max=image.shape[axis] - 1)  # past the last pixel the weight is 0
        total = total + image.index_select(axis, index).int() * weight.view(shape)
    return (total >> _BITS).to(torch.uint8)


@lru_cache(maxsize=64)
def _pillow_weights(size: int, new_size: int) -> tuple[Int64[Tensor, " n"], Int32[Tensor, "taps n"]]:
    """Return the first source pixel of every sample, and the weights of this pixel and the following ones."""
    scale = size / new_size
    support = max(scale, 1.0)
    center = (torch.arange(new_size, dtype=torch.float64) + 0.5) * scale
    first = (center - support + 0.5).long().clamp(min=0)
    last = (center + support + 0.5).long().clamp(max=size)
    index = first + torch.arange(2 * math.ceil(support) + 1)[:, None]
    weights = (1 - ((index - center + 0.5) * (1.0 / support)).abs()).clamp(min=0) * (index < last)
    total = torch.zeros_like(center)
    for tap in weights:  # in Pillow's order, for the same rounding
        total = total + tap
    return first, (0.5 + weights / total * (1 << _BITS)).int()
