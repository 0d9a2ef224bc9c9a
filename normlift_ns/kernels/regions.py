"""Sums of compositing weights by (splat, region): one single-warp program per cell, without atomics.

A program holds the pixels of its cell in registers and iterates over its splats, nearest first, with the arithmetic of
gsplat's rasterize_to_pixels_fwd.cu. Every cell has its own part of the output, large enough for any result, and fills
it from the start. So the result does not depend on the order in which programs run.
"""

from __future__ import annotations

from itertools import pairwise
from typing import NamedTuple

import torch
import triton
import triton.language as tl
from jaxtyping import Float32, Int, Int32, Int64
from torch import Tensor

from normlift_ns.kernels.lists import Grid, Lists

UNROLL = 4
"""Number of splats between checks whether a cell is finished."""
_MOST_SLOTS = 2**26
"""Largest number of slots in a chunk, of 8 or 12 bytes each."""
_COPIED = 128
"""Sums that a program moves in one step."""
_PLACES = 512
"""Sums per program that decodes keys."""


class Limits(NamedTuple):
    """Fields of the rasterizer's settings that compositing uses."""

    max_alpha: float
    min_alpha: float
    min_transmittance: float


class RegionSums(NamedTuple):
    """Nonzero sums, one per cell, splat and region, ordered by cell; a key can occur in several cells."""

    key: Int[Tensor, " m"]
    """Keys row * columns + label + 1, with the row of the splat."""
    weight: Float32[Tensor, " m"]


@triton.jit
def cell_pixels(cell, cells_across, CELL_W: tl.constexpr, CELL_H: tl.constexpr):
    """Return the rows [CELL_H, 1] and columns [1, CELL_W] of a cell in the image."""
    y = (cell // cells_across) * CELL_H + tl.arange(0, CELL_H)[:, None]
    x = (cell % cells_across) * CELL_W + tl.arange(0, CELL_W)[None, :]
    return y, x


@triton.jit
def _unpack_floats(pair):
    """Return the float32 numbers in the low and in the high half of an int64."""
    return pair.to(tl.int32).to(tl.float32, bitcast=True), (pair >> 32).to(tl.int32).to(tl.float32, bitcast=True)


@triton.jit
def load_splat(splats, m, valid):
    """Return u, v, half of xx, half of yy, xy and opacity of a splat; an invalid splat has opacity 0."""
    row = splats + 4 * m.to(tl.int64)
    u, v = _unpack_floats(tl.load(row, mask=valid, other=0))
    a, c = _unpack_floats(tl.load(row + 1, mask=valid, other=0))
    b, opacity = _unpack_floats(tl.load(row + 2, mask=valid, other=0))
    return u, v, a, c, b, opacity


@triton.jit
def blend(u, v, a, c, b, opacity, px, py, T, max_alpha, min_alpha, min_transmittance):
    """Return (A_ij, transmittance after it) of one splat in all pixels; a finished pixel has transmittance 0."""
    dx, dy = u - px, v - py
    # Fused as by nvcc in rasterize_to_pixels_fwd.cu.
    sigma = tl.fma(b * dx, dy, tl.fma(dx, a * dx, dy * (c * dy)))
    alpha = tl.minimum(opacity * tl.exp2(sigma * -1.4426950408889634), max_alpha)
    visible = (sigma >= 0) & (alpha >= min_alpha)
    after = T * (1.0 - alpha)
    continues = after > min_transmittance
    return tl.where(visible & continues, alpha * T, 0.0), tl.where(visible, tl.where(continues, after, 0.0), T)


@triton.jit
def _number_labels(
    labels, local, table, counts, width, height, cells_across, cells, CELL_W: tl.constexpr, CELL_H: tl.constexpr
):
    """Number the labels >= -1 of a cell in ascending order.

    The numbers are written to local[cell, pixel], -1 for none, and the labels to table[cell, number].
    """
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
    POWER: tl.constexpr, CELL_W: tl.constexpr, CELL_H: tl.constexpr, UNROLL: tl.constexpr,
):  # fmt: skip
    cell = first_cell + tl.program_id(0).to(tl.int64)
    start, stop = tl.load(offsets + cell), tl.load(offsets + cell + 1)
    count = tl.load(counts + cell)
    first = (tl.load(base + cell) - first_slot).to(tl.int32)
    slot = first
    if (start < stop) & (count > 0):
        y, x = cell_pixels((cell % cells).to(tl.int32), cells_across, CELL_W, CELL_H)
        px, py = x.to(tl.float32) + 0.5, y.to(tl.float32) + 0.5
        pixel = tl.arange(0, CELL_H)[:, None] * CELL_W + tl.arange(0, CELL_W)[None, :]
        number = tl.load(local + cell * CELL_W * CELL_H + pixel).to(tl.int32)
        only_column = tl.load(table + cell * CELL_W * CELL_H) + 1
        T = tl.where(number >= 0, 1.0, 0.0)
        i = start
        alive = 1
        # The next splat is loaded while the current one is computed.
        m = tl.load(members + i)
        u, v, a, c, b, o = load_splat(splats, m, i < stop)
        later = tl.load(members + i + 1, mask=i + 1 < stop, other=0)
        while (i < stop) & (alive > 0):
            for _ in tl.static_range(UNROLL):
                next_m = later
                later = tl.load(members + i + 2, mask=i + 2 < stop, other=0)
                next_u, next_v, next_a, next_c, next_b, next_o = load_splat(splats, next_m, i + 1 < stop)

                weight, T = blend(u, v, a, c, b, o, px, py, T, max_alpha, min_alpha, min_transmittance)
                if POWER == 2:
                    weight = weight * weight
                if POWER == 0:
                    weight = tl.where(weight > 0, 1.0, 0.0)
                total = tl.sum(weight)
                if total > 0:
                    base_key = m.to(out_key.dtype.element_ty) * columns
                    if count == 1:
                        tl.store(out_weight + slot, total)
                        tl.store(out_key + slot, base_key + only_column)
                        slot += 1
                    else:
                        for r in range(count):
                            part = tl.sum(tl.where(number == r, weight, 0.0))
                            if part > 0:
                                label = tl.load(table + cell * CELL_W * CELL_H + r) + 1
                                tl.store(out_weight + slot, part)
                                tl.store(out_key + slot, base_key + label)
                                slot += 1
                i += 1
                m, u, v, a, c, b, o = next_m, next_u, next_v, next_a, next_c, next_b, next_o
            alive = tl.max(tl.where(T > 0, 1, 0))
    tl.store(out_used + cell - first_cell, slot - first)


@triton.jit
def _pack(key, weight, base, used, ends, out_key, out_weight, first_slot, COPIED: tl.constexpr):
    """Move the used slots of a cell directly behind those of the previous cells."""
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
    """Return the sums of A_ij ** weight_power over the pixels of each region in each cell, for views of one size.

    Args:
        splats: Projected Gaussians; see `SPLAT`.
        lists: Splats by cell.
        labels: Region of every pixel. -1 means unlabeled and is summed like a region; pixels below -1 are ignored.
        grid: Cells of an image.
        columns: A number above the largest label + 1.
        limits: Limits of alpha and transmittance.
        weight_power: Exponent of A_ij.
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
    slots = torch.cat([counts.new_zeros(1), counts * lists.offsets.diff().long()]).cumsum(0)  # first slot of each cell
    dtype = torch.int32 if len(splats) * columns < 2**31 else torch.int64  # int32 takes half the time to sort
    parts = [RegionSums(torch.zeros(0, dtype=dtype, device=device), torch.zeros(0, device=device))]
    for first, last, low, high in _chunks(slots):
        key = torch.empty(high - low, dtype=dtype, device=device)
        weight = torch.empty(high - low, device=device)
        used = torch.empty(last - first, dtype=torch.int32, device=device)
        _sum_regions[(last - first,)](
            splats.view(torch.int64), lists.members, lists.offsets, local, table, counts, slots, key, weight, used,
            first, low, columns, grid.across, grid.cells, *limits,
            POWER=weight_power, UNROLL=UNROLL, **shape,
        )  # fmt: skip
        ends = used.cumsum(0)
        total = int(ends[-1])
        packed = RegionSums(key.new_empty(total), weight.new_empty(total))
        _pack[(last - first,)](key, weight, slots[first:], used, ends, *packed, low, COPIED=_COPIED, num_warps=1)
        parts.append(packed)
    return parts[1] if len(parts) == 2 else RegionSums(*(torch.cat(x) for x in zip(*parts)))


def _chunks(slots: Int[Tensor, " cells_plus_1"]) -> list[tuple[int, int, int, int]]:
    """Return ranges of cells with at most _MOST_SLOTS slots, or of a single cell: (first, last) cell and slot.

    The last cell and slot are exclusive.
    """
    total = int(slots[-1])
    if total <= _MOST_SLOTS:
        return [(0, len(slots) - 1, 0, total)] if total > 0 else []
    bounds = torch.arange(0, total + _MOST_SLOTS, _MOST_SLOTS, device=slots.device)
    cell = torch.cat([torch.searchsorted(slots, bounds, right=True) - 1, slots.new_tensor([len(slots) - 1])]).unique()
    return [
        (first, last, low, high) for (first, low), (last, high) in pairwise(zip(cell.tolist(), slots[cell].tolist()))
    ]


@triton.jit
def _places(key, splat_keys, first, out_gaussian, out_column, count, columns, views, BLOCK: tl.constexpr):
    i = tl.program_id(0).to(tl.int64) * BLOCK + tl.arange(0, BLOCK)
    valid = i < count
    k = tl.load(key + i, mask=valid, other=0)
    splat = k // columns
    gaussian_view = tl.load(splat_keys + splat, mask=valid, other=0)
    gaussian = gaussian_view // views
    column = tl.load(first + (gaussian_view - gaussian * views), mask=valid, other=0) + (k - splat * columns).to(
        tl.int32
    )
    tl.store(out_gaussian + i, gaussian.to(tl.int32), mask=valid)
    tl.store(out_column + i, column, mask=valid)


def places(
    key: Int[Tensor, " m"], splat_keys: Int64[Tensor, " splats"], first: Int32[Tensor, " views_plus_1"], columns: int
) -> tuple[Int32[Tensor, " m"], Int32[Tensor, " m"]]:
    """Return the Gaussian and the column of every sum.

    Args:
        key: Keys as in `RegionSums`.
        splat_keys: Keys gaussian * views + view of every splat.
        first: First column of every view.
        columns: Columns per row in `key`.
    """
    gaussian, column = (torch.empty(len(key), dtype=torch.int32, device=key.device) for _ in range(2))
    if len(key) > 0:
        _places[(triton.cdiv(len(key), _PLACES),)](
            key, splat_keys, first, gaussian, column, len(key), columns, len(first) - 1, BLOCK=_PLACES, num_warps=4
        )
    return gaussian, column
