"""Pixel counts and boxes of masks at the size of the image, without enlarging the logits in memory.

Enlarging is linear and separable, and every pixel is computed from three neighboring logits along each axis. One
program handles some rows of one mask. It keeps three lines of logits, enlarged along the row, until a row needs others.
"""

from __future__ import annotations

import torch
import triton
import triton.language as tl
from jaxtyping import Float, Float32, Int32, Int64
from torch import Tensor

_ROWS = 64
"""Rows per program."""


@triton.jit
def _line(logits, line, first, w0, w1, w2, inside):
    """Return a line of logits, interpolated at the columns of the image."""
    pointer = logits + line + first
    a = tl.load(pointer, mask=inside, other=0.0).to(tl.float32)
    b = tl.load(pointer + 1, mask=inside, other=0.0).to(tl.float32)
    c = tl.load(pointer + 2, mask=inside, other=0.0).to(tl.float32)
    return w0 * a + w1 * b + w2 * c


@triton.jit
def _measure(
    logits, row_first, row_weights, column_first, column_weights, out, height, width, low_height, low_width, offset,
    ROWS: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """Write the pixels above offset, the pixels above -offset, and x0, y0, x1, y1 of some rows to out[mask, part]."""
    mask = tl.program_id(0).to(tl.int64)
    mask_logits = logits + mask * low_height * low_width
    x = tl.arange(0, BLOCK)
    inside = x < width
    first = tl.load(column_first + x, mask=inside, other=0)
    w0 = tl.load(column_weights + 3 * x, mask=inside, other=0.0)
    w1 = tl.load(column_weights + 3 * x + 1, mask=inside, other=0.0)
    w2 = tl.load(column_weights + 3 * x + 2, mask=inside, other=0.0)
    start = tl.program_id(1) * ROWS
    line = tl.load(row_first + start)
    above = _line(mask_logits, line * low_width, first, w0, w1, w2, inside)
    middle = _line(mask_logits, (line + 1) * low_width, first, w0, w1, w2, inside)
    below = _line(mask_logits, (line + 2) * low_width, first, w0, w1, w2, inside)
    inner = tl.zeros([BLOCK], tl.int32)
    outer = tl.zeros([BLOCK], tl.int32)
    columns = tl.zeros([BLOCK], tl.int32)
    top = tl.full((), 0, tl.int32) + height
    bottom = tl.full((), -1, tl.int32)
    for y in range(start, tl.minimum(start + ROWS, height)):
        next_line = tl.load(row_first + y)
        if next_line != line:
            line = next_line
            above = _line(mask_logits, line * low_width, first, w0, w1, w2, inside)
            middle = _line(mask_logits, (line + 1) * low_width, first, w0, w1, w2, inside)
            below = _line(mask_logits, (line + 2) * low_width, first, w0, w1, w2, inside)
        v0 = tl.load(row_weights + 3 * y)
        v1 = tl.load(row_weights + 3 * y + 1)
        v2 = tl.load(row_weights + 3 * y + 2)
        value = v0 * above + v1 * middle + v2 * below
        inner += (inside & (value > offset)).to(tl.int32)
        outer += (inside & (value > -offset)).to(tl.int32)
        positive = (inside & (value > 0)).to(tl.int32)
        columns = tl.maximum(columns, positive)
        any_positive = tl.max(positive, axis=0)
        top = tl.where((any_positive > 0) & (top == height), y, top)
        bottom = tl.where(any_positive > 0, y, bottom)
    row = out + (mask * tl.num_programs(1) + tl.program_id(1)) * 6
    tl.store(row, tl.sum(inner, axis=0))
    tl.store(row + 1, tl.sum(outer, axis=0))
    tl.store(row + 2, tl.min(tl.where(columns > 0, x, width), axis=0))
    tl.store(row + 3, top)
    tl.store(row + 4, tl.max(tl.where(columns > 0, x, -1), axis=0))
    tl.store(row + 5, bottom)


def measure_masks(
    logits: Float[Tensor, "m y x"],
    row_first: Int32[Tensor, " h"],
    row_weights: Float32[Tensor, "h 3"],
    column_first: Int32[Tensor, " w"],
    column_weights: Float32[Tensor, "w 3"],
    offset: float,
) -> tuple[Int32[Tensor, " m"], Int32[Tensor, " m"], Int64[Tensor, "m 4"]]:
    """Measure masks at the size of the image.

    Args:
        logits: Logits at the resolution of the network.
        row_first: Row i of the image is the sum of the lines row_first[i] to row_first[i] + 2 of the logits, weighted
            by row_weights[i].
        row_weights: Weights of the rows.
        column_first: Same as `row_first` for columns.
        column_weights: Weights of the columns.
        offset: Distance of the thresholds from 0.

    Returns:
        The number of pixels above the offset, the number above minus the offset, and the box of the pixels above 0.
        Boxes are (x0, y0, x1, y1), with x1 and y1 inclusive, or zeros for an empty mask.
    """
    count, height, width = len(logits), len(row_first), len(column_first)
    num_parts, block = triton.cdiv(height, _ROWS), triton.next_power_of_2(width)
    partial = torch.empty(count, num_parts, 6, dtype=torch.int32, device=logits.device)
    _measure[(count, num_parts)](
        logits.contiguous(), row_first, row_weights, column_first, column_weights, partial, height, width,
        logits.shape[1], logits.shape[2], offset, ROWS=_ROWS, BLOCK=block, num_warps=min(16, max(4, block // 256)),
    )  # fmt: skip
    low, high = partial[:, :, 2:4].amin(dim=1), partial[:, :, 4:6].amax(dim=1)
    boxes = torch.cat([low, high], dim=1).long() * (high[:, :1] >= 0)
    return *partial[:, :, :2].sum(dim=1, dtype=torch.int32).unbind(dim=1), boxes
