"""Sums of compositing weights by (splat, region): one program of a single warp per cell, no atomics.

A program holds the pixels of its cell in registers and walks through its splats, nearest first, with the arithmetic of
gsplat's rasterize_to_pixels_fwd.cu. Every cell owns as much of the output as it can need and fills it from the start,
so that the result does not depend on the order in which programs run.
"""

from __future__ import annotations

from itertools import pairwise
from typing import NamedTuple

import torch
import triton
import triton.language as tl
from jaxtyping import Float32, Int, Int32
from torch import Tensor

from normlift_ns.kernels.lists import Grid, Lists
from normlift_ns.kernels.projection import SPLAT

UNROLL = 4
"""Splats between two looks at whether a cell is finished."""
_MOST_SLOTS = 2**26
"""Slots at once, of 8 or 12 bytes each."""
_COPIED = 128
"""Sums that a program moves at once."""


class Limits(NamedTuple):
    """Numbers that decide what a pixel draws: fields of the rasterizer's settings."""

    max_alpha: float
    min_alpha: float
    min_transmittance: float


class RegionSums(NamedTuple):
    """Nonzero sums, one per cell, splat and region, ordered by cell: places occur as often as cells show them."""

    key: Int[Tensor, " m"]
    """row of the splat * columns + label + 1."""
    weight: Float32[Tensor, " m"]


@triton.jit
def cell_pixels(cell, cells_across, CELL_W: tl.constexpr, CELL_H: tl.constexpr):
    """Rows [CELL_H, 1] and columns [1, CELL_W] of the image."""
    y = (cell // cells_across) * CELL_H + tl.arange(0, CELL_H)[:, None]
    x = (cell % cells_across) * CELL_W + tl.arange(0, CELL_W)[None, :]
    return y, x


@triton.jit
def blend(u, v, a, b, c, opacity, px, py, T, max_alpha, min_alpha, min_transmittance):
    """(A_ij, transmittance behind) of one splat in all pixels; a finished pixel has transmittance 0."""
    dx, dy = u - px, v - py
    sigma = 0.5 * (a * dx * dx + c * dy * dy) + b * dx * dy
    alpha = tl.minimum(opacity * tl.exp(-sigma), max_alpha)
    alpha = tl.where((sigma >= 0) & (alpha >= min_alpha), alpha, 0.0)
    after = T * (1.0 - alpha)
    goes_on = after > min_transmittance
    return tl.where(goes_on, alpha * T, 0.0), tl.where(goes_on, after, 0.0)


@triton.jit
def _number_labels(
    labels, local, table, counts, width, height, cells_across, cells, CELL_W: tl.constexpr, CELL_H: tl.constexpr
):
    """Numbers the labels >= -1 of a cell in ascending order: local[cell, pixel], -1 for none; table[cell, number]."""
    cell = tl.program_id(0).to(tl.int64)
    view = cell // cells
    y, x = cell_pixels((cell % cells).to(tl.int32), cells_across, CELL_W, CELL_H)
    label = tl.load(labels + (view * height + y) * width + x, mask=(y < height) & (x < width), other=-2)
    END: tl.constexpr = 2147483647
    number = tl.full([CELL_H, CELL_W], -1, tl.int32)
    count = 0
    current = tl.min(tl.where(label >= -1, label, END))
    while current != END:
        number = tl.where(label == current, count, number)
        tl.store(table + cell * CELL_W * CELL_H + count, current)
        count += 1
        current = tl.min(tl.where(label > current, label, END))
    pixel = tl.arange(0, CELL_H)[:, None] * CELL_W + tl.arange(0, CELL_W)[None, :]
    tl.store(local + cell * CELL_W * CELL_H + pixel, number.to(tl.int16))
    tl.store(counts + cell, count)


@triton.jit
def _sum_regions(
    splats, members, offsets, local, table, counts, base, out_key, out_weight, out_used,
    first_cell, first_slot, columns, cells_across, cells, max_alpha, min_alpha, min_transmittance,
    POWER: tl.constexpr, CELL_W: tl.constexpr, CELL_H: tl.constexpr, SPLAT: tl.constexpr, UNROLL: tl.constexpr,
):  # fmt: skip
    cell = first_cell + tl.program_id(0).to(tl.int64)
    start, stop = tl.load(offsets + cell), tl.load(offsets + cell + 1)
    count = tl.load(counts + cell)
    first = tl.load(base + cell) - first_slot
    slot = first
    if (start < stop) & (count > 0):
        y, x = cell_pixels((cell % cells).to(tl.int32), cells_across, CELL_W, CELL_H)
        px, py = x.to(tl.float32) + 0.5, y.to(tl.float32) + 0.5
        pixel = tl.arange(0, CELL_H)[:, None] * CELL_W + tl.arange(0, CELL_W)[None, :]
        number = tl.load(local + cell * CELL_W * CELL_H + pixel).to(tl.int32)
        only = tl.load(table + cell * CELL_W * CELL_H) + 1
        T = tl.where(number >= 0, 1.0, 0.0)
        i = start
        alive = 1
        # Numbers of the next splat are on their way while the present one is computed.
        m = tl.load(members + i)
        row = splats + SPLAT * m.to(tl.int64)
        u, v, a = tl.load(row), tl.load(row + 1), tl.load(row + 2)
        b, c, o = tl.load(row + 3), tl.load(row + 4), tl.load(row + 5)
        later = tl.load(members + i + 1, mask=i + 1 < stop, other=0)
        while (i < stop) & (alive > 0):
            for _ in tl.static_range(UNROLL):
                next_m = later
                more = i + 1 < stop
                later = tl.load(members + i + 2, mask=i + 2 < stop, other=0)
                row = splats + SPLAT * next_m.to(tl.int64)
                next_u = tl.load(row, mask=more, other=0.0)
                next_v = tl.load(row + 1, mask=more, other=0.0)
                next_a = tl.load(row + 2, mask=more, other=0.0)
                next_b = tl.load(row + 3, mask=more, other=0.0)
                next_c = tl.load(row + 4, mask=more, other=0.0)
                next_o = tl.load(row + 5, mask=more, other=0.0)

                weight, T = blend(u, v, a, b, c, o, px, py, T, max_alpha, min_alpha, min_transmittance)
                if POWER == 2:
                    weight = weight * weight
                if POWER == 0:
                    weight = tl.where(weight > 0, 1.0, 0.0)
                total = tl.sum(weight)
                if total > 0:
                    place = m.to(out_key.dtype.element_ty) * columns
                    if count == 1:
                        tl.store(out_weight + slot, total)
                        tl.store(out_key + slot, place + only)
                        slot += 1
                    else:
                        for r in range(count):
                            part = tl.sum(tl.where(number == r, weight, 0.0))
                            if part > 0:
                                label = tl.load(table + cell * CELL_W * CELL_H + r) + 1
                                tl.store(out_weight + slot, part)
                                tl.store(out_key + slot, place + label)
                                slot += 1
                i += 1
                m, u, v, a, b, c, o = next_m, next_u, next_v, next_a, next_b, next_c, next_o
            alive = tl.max(tl.where(T > 0, 1, 0))
    tl.store(out_used + cell - first_cell, slot - first)


@triton.jit
def _pack(key, weight, base, used, ends, out_key, out_weight, first_slot, COPIED: tl.constexpr):
    """Moves the used slots of a cell behind those of the cells before it."""
    cell = tl.program_id(0).to(tl.int64)
    count = tl.load(used + cell)
    source, target = tl.load(base + cell) - first_slot, tl.load(ends + cell) - count
    for k in range(0, count, COPIED):
        i = k + tl.arange(0, COPIED)
        tl.store(out_key + target + i, tl.load(key + source + i, mask=i < count), mask=i < count)
        tl.store(out_weight + target + i, tl.load(weight + source + i, mask=i < count), mask=i < count)


def region_sums(
    splats: Float32[Tensor, "m 8"],
    lists: Lists,
    labels: Int32[Tensor, "views h w"],
    grid: Grid,
    *,
    columns: int,
    limits: Limits,
    weight_power: int,
) -> RegionSums:
    """Sums of A_ij ** weight_power over the pixels of each region in each cell, for views of one size.

    Args:
        labels: region of every pixel; -1: unlabelled, summed like a region; below -1: no pixel.
        columns: more than the largest label + 1.
    """
    views, device, pixels = len(labels), splats.device, grid.cell_width * grid.cell_height
    cells = views * grid.cells
    shape = {"CELL_W": grid.cell_width, "CELL_H": grid.cell_height, "num_warps": 1}
    local = torch.empty(cells, pixels, dtype=torch.int16, device=device)
    table = torch.empty(cells, pixels, dtype=torch.int32, device=device)
    counts = torch.empty(cells, dtype=torch.int32, device=device)
    _number_labels[(cells,)](
        labels, local, table, counts, grid.width, grid.height, grid.across, grid.cells, **shape
    )  # fmt: skip
    slots = torch.cat([counts.new_zeros(1), counts * lists.offsets.diff()]).cumsum(0)  # the first of each cell
    kind = torch.int32 if len(splats) * columns < 2**31 else torch.int64  # of half the width: half the work to sort
    parts = [RegionSums(torch.zeros(0, dtype=kind, device=device), torch.zeros(0, device=device))]
    for first, last, low, high in _chunks(slots):
        key = torch.empty(high - low, dtype=kind, device=device)
        weight = torch.empty(high - low, device=device)
        used = torch.empty(last - first, dtype=torch.int32, device=device)
        _sum_regions[(last - first,)](
            splats, lists.members, lists.offsets, local, table, counts, slots, key, weight, used,
            first, low, columns, grid.across, grid.cells, *limits,
            POWER=weight_power, SPLAT=SPLAT, UNROLL=UNROLL, **shape,
        )  # fmt: skip
        ends = used.cumsum(0)
        total = int(ends[-1])
        packed = RegionSums(key.new_empty(total), weight.new_empty(total))
        _pack[(last - first,)](key, weight, slots[first:], used, ends, *packed, low, COPIED=_COPIED, num_warps=1)
        parts.append(packed)
    return parts[1] if len(parts) == 2 else RegionSums(*(torch.cat(x) for x in zip(*parts)))


def _chunks(slots: Int[Tensor, " cells_plus_1"]) -> list[tuple[int, int, int, int]]:
    """Runs of cells of at most _MOST_SLOTS slots, or of one cell: first and last cell, first and last slot."""
    total = int(slots[-1])
    if total <= _MOST_SLOTS:
        return [(0, len(slots) - 1, 0, total)] if total > 0 else []
    bounds = torch.arange(0, total + _MOST_SLOTS, _MOST_SLOTS, device=slots.device)
    cell = torch.cat([torch.searchsorted(slots, bounds, right=True) - 1, slots.new_tensor([len(slots) - 1])]).unique()
    return [
        (first, last, low, high) for (first, low), (last, high) in pairwise(zip(cell.tolist(), slots[cell].tolist()))
    ]
