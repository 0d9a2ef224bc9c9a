"""What the rules on masks want to know of logits at the size of the image, without making them: counts and boxes.

Enlarging is linear and separable, and every pixel is made of three neighbouring logits along each axis. One program
looks at some rows of one mask; it keeps three lines of logits, enlarged along the row, until a row needs others.
"""

from __future__ import annotations

import torch
import triton
import triton.language as tl
from jaxtyping import Float, Float32, Int32, Int64
from torch import Tensor

_ROWS = 64
"""Rows of a program."""


@triton.jit
def _line(logits, line, first, w0, w1, w2, inside):
    """A line of logits at the columns of the image."""
    at = logits + line + first
    a = tl.load(at, mask=inside, other=0.0).to(tl.float32)
    b = tl.load(at + 1, mask=inside, other=0.0).to(tl.float32)
    c = tl.load(at + 2, mask=inside, other=0.0).to(tl.float32)
    return w0 * a + w1 * b + w2 * c


@triton.jit
def _measure(
    logits, row_first, row_weights, column_first, column_weights, found, height, width, low_height, low_width, offset,
    ROWS: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """found[mask, part]: pixels above offset, above -offset, then x0, y0, x1, y1, of some rows."""
    mask = tl.program_id(0).to(tl.int64)
    own = logits + mask * low_height * low_width
    x = tl.arange(0, BLOCK)
    inside = x < width
    first = tl.load(column_first + x, mask=inside, other=0)
    w0 = tl.load(column_weights + 3 * x, mask=inside, other=0.0)
    w1 = tl.load(column_weights + 3 * x + 1, mask=inside, other=0.0)
    w2 = tl.load(column_weights + 3 * x + 2, mask=inside, other=0.0)
    start = tl.program_id(1) * ROWS
    line = tl.load(row_first + start)
    above = _line(own, line * low_width, first, w0, w1, w2, inside)
    middle = _line(own, (line + 1) * low_width, first, w0, w1, w2, inside)
    below = _line(own, (line + 2) * low_width, first, w0, w1, w2, inside)
    inner = tl.zeros([BLOCK], tl.int32)
    outer = tl.zeros([BLOCK], tl.int32)
    columns = tl.zeros([BLOCK], tl.int32)
    top = tl.full((), 0, tl.int32) + height
    bottom = tl.full((), -1, tl.int32)
    for y in range(start, tl.minimum(start + ROWS, height)):
        wanted = tl.load(row_first + y)
        if wanted != line:
            line = wanted
            above = _line(own, line * low_width, first, w0, w1, w2, inside)
            middle = _line(own, (line + 1) * low_width, first, w0, w1, w2, inside)
            below = _line(own, (line + 2) * low_width, first, w0, w1, w2, inside)
        v0 = tl.load(row_weights + 3 * y)
        v1 = tl.load(row_weights + 3 * y + 1)
        v2 = tl.load(row_weights + 3 * y + 2)
        value = v0 * above + v1 * middle + v2 * below
        inner += (inside & (value > offset)).to(tl.int32)
        outer += (inside & (value > -offset)).to(tl.int32)
        set_here = (inside & (value > 0)).to(tl.int32)
        columns = tl.maximum(columns, set_here)
        any_here = tl.max(set_here, axis=0)
        top = tl.where((any_here > 0) & (top == height), y, top)
        bottom = tl.where(any_here > 0, y, bottom)
    out = found + (mask * tl.num_programs(1) + tl.program_id(1)) * 6
    tl.store(out, tl.sum(inner, axis=0))
    tl.store(out + 1, tl.sum(outer, axis=0))
    tl.store(out + 2, tl.min(tl.where(columns > 0, x, width), axis=0))
    tl.store(out + 3, top)
    tl.store(out + 4, tl.max(tl.where(columns > 0, x, -1), axis=0))
    tl.store(out + 5, bottom)


def measure_masks(
    logits: Float[Tensor, "m y x"],
    row_first: Int32[Tensor, " h"],
    row_weights: Float32[Tensor, "h 3"],
    column_first: Int32[Tensor, " w"],
    column_weights: Float32[Tensor, "w 3"],
    offset: float,
) -> tuple[Int32[Tensor, " m"], Int32[Tensor, " m"], Int64[Tensor, "m 4"]]:
    """Of each mask at the size of an image: pixels above the offset, pixels above minus the offset, and the box of
    those above 0, as (x0, y0, x1, y1), both ends inside, zeros where there is none.

    Args:
        row_first, row_weights: a row of the image is made of the lines first[i] + 0, 1, 2 of the logits, with
            weights[i]; likewise columns.
    """
    count, height, width = len(logits), len(row_first), len(column_first)
    parts, block = triton.cdiv(height, _ROWS), triton.next_power_of_2(width)
    found = torch.empty(count, parts, 6, dtype=torch.int32, device=logits.device)
    _measure[(count, parts)](
        logits.contiguous(), row_first, row_weights, column_first, column_weights, found, height, width,
        logits.shape[1], logits.shape[2], offset, ROWS=_ROWS, BLOCK=block, num_warps=min(16, max(4, block // 256)),
    )  # fmt: skip
    least, most = found[:, :, 2:4].amin(dim=1), found[:, :, 4:6].amax(dim=1)
    boxes = torch.cat([least, most], dim=1).long() * (most[:, :1] >= 0)
    return *found[:, :, :2].sum(dim=1, dtype=torch.int32).unbind(dim=1), boxes
