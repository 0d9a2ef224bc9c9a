"""Triton compositing kernels that list splats by cell, sum weights by region, and render any number of channels.

A cell is one of gsplat's tiles or a part of one. The list of a cell contains the splats whose rectangle touches the
tile, as in gsplat. Culling removes the splats whose alpha cannot reach its threshold in the cell. This test uses
float64, and a margin for all float32 rounding of alpha. The sums are therefore the same as with gsplat's lists.
"""

from __future__ import annotations

from itertools import pairwise
from typing import NamedTuple

import torch
import triton
import triton.language as tl
from jaxtyping import Float32, Int, Int32, Int64
from torch import Tensor

from normlift_ns.kernels.projection import ProjectedSplats
from normlift_ns.kernels.projection_2dgs import SPLAT_2D

_BLOCK = 32
_ROUNDING = tl.constexpr(2.0**-20)
"""Bound on the relative float32 rounding error of a dx^2 and c dy^2 in the exponent of alpha.

The error is at most 12 half units in the last place.
"""
_REACH_MARGIN = tl.constexpr(1e-3)
"""Margin added to the exponent log(opacity / min_alpha), at which alpha falls to its threshold.

It covers the rounding of the exponential in gsplat and of the float64 computation here.
"""
_NEEDLE = tl.constexpr(1e-6)
"""Ratio of the determinant of a conic to the product of its diagonal entries, above which a splat can be culled.

At smaller ratios, the determinant is too inaccurate.
"""
_FAR = tl.constexpr(1e30)
_SIZES = ("width", "height", "tiles_across", "tiles_down", "cells_across", "cells_down")
"""Kernel arguments that Triton does not specialize, so that a kernel is compiled once for all image sizes."""


class CellGrid(NamedTuple):
    """Division of images of one size into cells."""

    width: int
    height: int
    tile: int
    """Side of gsplat's tiles in pixels, a power of two."""
    cell_width: int
    """Width of a cell in pixels, a divisor of `tile`."""
    cell_height: int
    """Height of a cell in pixels, a divisor of `tile`."""

    @property
    def across(self) -> int:
        """Number of cells from left to right."""
        return -(-self.width // self.cell_width)

    @property
    def down(self) -> int:
        """Number of cells from top to bottom."""
        return -(-self.height // self.cell_height)

    @property
    def cells(self) -> int:
        """Number of cells in an image."""
        return self.across * self.down


class CellLists(NamedTuple):
    """Lists of the splats of every cell, nearest first.

    The list of cell c is members[offsets[c]:offsets[c + 1]]. Cells are numbered row by row, view after view.
    """

    offsets: Int32[Tensor, " cells_plus_1"]
    members: Int32[Tensor, " pairs"]
    """Rows of the splats in `ProjectedSplats`."""


@triton.jit(do_not_specialize=["entries", "views", *_SIZES])
def _pairs(
    splats, order, keys, starts, ends, out_count, out_cell, out_member, entries, views, width, height, min_alpha,
    tiles_across, tiles_down, cells_across, cells_down,
    TILE: tl.constexpr, CELL_W: tl.constexpr, CELL_H: tl.constexpr, CULL: tl.constexpr, WRITE: tl.constexpr,
    SPLAT: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """Count the cells of every splat, or write at most as many cells as were counted."""
    i = tl.program_id(0).to(tl.int64) * BLOCK + tl.arange(0, BLOCK)
    valid = i < entries
    e = tl.load(order + i, mask=valid, other=0)
    row = splats + SPLAT * e
    u, v = tl.load(row, mask=valid, other=0.0), tl.load(row + 1, mask=valid, other=0.0)
    half_width, half_height = tl.load(row + 6, mask=valid, other=0.0), tl.load(row + 7, mask=valid, other=0.0)
    # Tiles of the rectangle, in float32 as in gsplat, and their cells.
    x0 = tl.minimum(tl.maximum(tl.floor(u / TILE - half_width / TILE), 0.0), tiles_across).to(tl.int32)
    x1 = tl.minimum(tl.maximum(tl.ceil(u / TILE + half_width / TILE), 0.0), tiles_across).to(tl.int32)
    y0 = tl.minimum(tl.maximum(tl.floor(v / TILE - half_height / TILE), 0.0), tiles_down).to(tl.int32)
    y1 = tl.minimum(tl.maximum(tl.ceil(v / TILE + half_height / TILE), 0.0), tiles_down).to(tl.int32)
    x0, x1 = x0 * (TILE // CELL_W), tl.minimum(x1 * (TILE // CELL_W), cells_across)
    y0, y1 = y0 * (TILE // CELL_H), tl.minimum(y1 * (TILE // CELL_H), cells_down)
    y1 = tl.where(valid, y1, y0)

    # The ellipse a dx^2 + 2 b dx dy + c dy^2 <= reach contains every pixel with alpha >= min_alpha.
    a = 2.0 * tl.load(row + 2, mask=valid, other=1.0).to(tl.float64) * (1.0 - _ROUNDING)
    c = 2.0 * tl.load(row + 3, mask=valid, other=1.0).to(tl.float64) * (1.0 - _ROUNDING)
    b = tl.load(row + 4, mask=valid, other=0.0).to(tl.float64)
    opacity = tl.load(row + 5, mask=valid, other=1.0)
    reach = 2.0 * (tl.log(opacity / min_alpha).to(tl.float64) + _REACH_MARGIN)
    u, v = u.to(tl.float64), v.to(tl.float64)
    det = a * c - b * b
    ellipse = (det > _NEEDLE * (a * c)) & (reach > 0)
    if not CULL:
        ellipse = ellipse & (i < 0)
    det = tl.where(ellipse, det, 1.0)
    a, c = tl.where(ellipse, a, 1.0), tl.where(ellipse, c, 1.0)
    b = tl.where(ellipse, b, 0.0)
    reach = tl.where(ellipse, reach, 0.0)
    half_extent = tl.where(ellipse, tl.sqrt(reach * a / det), _FAR)
    turn = b / c * tl.sqrt(reach * c / det)  # dy at the left end of the ellipse, -dy at its right end
    low = tl.ceil((v - half_extent - (CELL_H - 0.5)) / CELL_H)
    high = tl.floor((v + half_extent - 0.5) / CELL_H) + 1.0
    y0 = tl.maximum(tl.minimum(low, y1.to(tl.float64)), y0.to(tl.float64)).to(tl.int32)
    y1 = tl.minimum(tl.maximum(high, y0.to(tl.float64)), y1.to(tl.float64)).to(tl.int32)

    total = tl.zeros([BLOCK], tl.int32)
    if WRITE:
        place, end = tl.load(starts + i, mask=valid, other=0), tl.load(ends + i, mask=valid, other=0)
        view = (tl.load(keys + e, mask=valid, other=0) % views).to(tl.int32) * (cells_across * cells_down)
    for k in range(tl.max(y1 - y0, axis=0)):
        y = y0 + k
        top = (y * CELL_H).to(tl.float64) + 0.5 - v
        bottom = tl.minimum((y * CELL_H).to(tl.float64) + (CELL_H - 0.5), height - 0.5) - v
        top, bottom = tl.maximum(top, -half_extent), tl.minimum(bottom, half_extent)
        at_right = tl.minimum(tl.maximum(-turn, top), bottom)
        at_left = tl.minimum(tl.maximum(turn, top), bottom)
        right = u - b / a * at_right + tl.sqrt(tl.maximum(reach * a - det * at_right * at_right, 0.0)) / a
        left = u - b / a * at_left - tl.sqrt(tl.maximum(reach * a - det * at_left * at_left, 0.0)) / a
        right, left = tl.where(ellipse, right, _FAR), tl.where(ellipse, left, -_FAR)
        first = tl.maximum(tl.ceil((left - (CELL_W - 0.5)) / CELL_W), x0.to(tl.float64))
        last = tl.minimum(tl.floor((right - 0.5) / CELL_W) + 1.0, x1.to(tl.float64))
        touches = (y < y1) & (top <= bottom) & (left <= width - 0.5) & (first < last)
        count = tl.where(touches, last - first, 0.0).to(tl.int32)
        if WRITE:
            cell = view + y * cells_across + tl.where(touches, first, 0.0).to(tl.int32)
            for j in range(tl.max(count, axis=0)):
                writes = (j < count) & (place < end)
                tl.store(out_cell + place, (cell + j).to(out_cell.dtype.element_ty), mask=writes)
                tl.store(out_member + place, e.to(tl.int32), mask=writes)
                place += writes.to(tl.int64)
        total += count
    if not WRITE:
        tl.store(out_count + i, total, mask=valid)


def build_cell_lists(
    projected: ProjectedSplats, views: int, grid: CellGrid, min_alpha: float, *, cull: bool = True
) -> CellLists:
    """Return the list of splats of every cell in every view, nearest first.

    Args:
        projected: Splats of all views.
        views: Number of views.
        grid: Cells of an image.
        min_alpha: Smallest alpha that is drawn.
        cull: Omit splats from cells in which their alpha cannot reach `min_alpha`. The other entries stay the same.
    """
    device, entries, tile = projected.depth.device, len(projected.depth), grid.tile
    order = projected.depth.sort(stable=True).indices  # equal depths keep the order of the Gaussians
    count = torch.empty(entries, dtype=torch.int32, device=device)
    launch = (triton.cdiv(entries, _BLOCK),)
    sizes = (entries, views, grid.width, grid.height, min_alpha, -(-grid.width // tile), -(-grid.height // tile))
    sizes += (grid.across, grid.down)
    shape = {"TILE": tile, "CELL_W": grid.cell_width, "CELL_H": grid.cell_height, "BLOCK": _BLOCK}
    shape["SPLAT"] = projected.splats.shape[1]
    options = {**shape, "CULL": cull, "num_warps": 1}
    unused = count
    if entries > 0:
        _pairs[launch](
            projected.splats, order, projected.keys, unused, unused, count, unused, unused, *sizes,
            WRITE=False, **options,
        )  # fmt: skip
    ends = count.cumsum(0)
    pairs = int(ends[-1]) if entries > 0 else 0
    # If different rounding causes a cell to be counted but not written, its entry is sorted behind all cells.
    end = views * grid.cells
    dtype = torch.int16 if end < 2**15 else torch.int32
    cell = torch.full((pairs,), end, dtype=dtype, device=device)
    member = torch.zeros(pairs, dtype=torch.int32, device=device)
    if pairs > 0:
        starts = ends - count
        _pairs[launch](
            projected.splats, order, projected.keys, starts, ends, count, cell, member, *sizes, WRITE=True, **options
        )  # fmt: skip
    cell, by_cell = cell.sort(stable=True)
    bounds = torch.arange(end + 1, dtype=dtype, device=device)
    return CellLists(torch.searchsorted(cell, bounds, out_int32=True), member[by_cell])


# Sums of compositing weights by (splat, region), with one single-warp program per cell and without atomics.
#
# A program keeps the pixels of its cell in registers and iterates over its splats, nearest first, with the arithmetic
# of gsplat's rasterize_to_pixels_fwd.cu. Every cell writes to its own part of the output, which is large enough for any
# result. The result therefore does not depend on the order in which programs run.


UNROLL = 4
"""Number of splats to composite between two checks for unfinished pixels in a cell."""
_MOST_SLOTS = 2**26
"""Largest number of slots in a chunk, apart from those of its first cell. A slot holds one sum and its key, and takes
8 or 12 bytes."""
_COPIED = 128
"""Number of sums that a program of `_pack` copies in one step."""
_PLACES = 512
"""Number of sums per program of `decode_keys`."""


class AlphaLimits(NamedTuple):
    """Fields of `RasterSettings` that compositing uses."""

    max_alpha: float
    min_alpha: float
    min_transmittance: float


class RegionSums(NamedTuple):
    """Positive sums for every cell, splat and region, ordered by cell. A key can occur in several cells."""

    key: Int[Tensor, " m"]
    """Keys row * columns + label + 1. The row is that of the splat in `ProjectedSplats`."""
    weight: Float32[Tensor, " m"]


@triton.jit
def cell_pixels(cell, cells_across, CELL_W: tl.constexpr, CELL_H: tl.constexpr):
    """Return the rows y, [CELL_H, 1], and columns x, [1, CELL_W], of the pixels of a cell."""
    y = (cell // cells_across) * CELL_H + tl.arange(0, CELL_H)[:, None]
    x = (cell % cells_across) * CELL_W + tl.arange(0, CELL_W)[None, :]
    return y, x


@triton.jit
def _unpack_floats(pair):
    """Return the float32 numbers in the low and in the high half of an int64."""
    return pair.to(tl.int32).to(tl.float32, bitcast=True), (pair >> 32).to(tl.int32).to(tl.float32, bitcast=True)


@triton.jit
def load_splat(splats, m, valid, IS_2D: tl.constexpr):
    """Return u, v, opacity and nine numbers that describe the shape of a splat; an invalid splat has opacity 0.

    For a 2D Gaussian, the nine numbers are its transform. For a 3D Gaussian, the first three are half of xx, half of yy
    and xy of its conic, and the others repeat xy.
    """
    row = splats + (8 if IS_2D else 4) * m.to(tl.int64)
    u, v = _unpack_floats(tl.load(row, mask=valid, other=0))
    a, b = _unpack_floats(tl.load(row + 1, mask=valid, other=0))
    c, opacity = _unpack_floats(tl.load(row + 2, mask=valid, other=0))
    d, e, f, g, h, i = c, c, c, c, c, c
    if IS_2D:
        d, e = _unpack_floats(tl.load(row + 4, mask=valid, other=0))
        f, g = _unpack_floats(tl.load(row + 5, mask=valid, other=0))
        h, i = _unpack_floats(tl.load(row + 6, mask=valid, other=0))
    return u, v, opacity, a, b, c, d, e, f, g, h, i


@triton.jit
def _exponent(u, v, a, c, b, px, py):
    """Return -log(alpha / opacity), fused as by nvcc in rasterize_to_pixels_fwd.cu."""
    dx, dy = u - px, v - py
    return tl.fma(b * dx, dy, tl.fma(dx, a * dx, dy * (c * dy)))


@triton.jit
def _exponent_2d(u, v, u0, u1, u2, v0, v1, v2, w0, w1, w2, px, py):
    """Return -log(alpha / opacity), fused as by nvcc in rasterize_to_pixels_2dgs_fwd.cu; -1 for an edge-on plane."""
    a0, a1, a2 = tl.fma(px, w0, -u0), tl.fma(px, w1, -u1), tl.fma(px, w2, -u2)
    b0, b1, b2 = tl.fma(py, w0, -v0), tl.fma(py, w1, -v1), tl.fma(py, w2, -v2)
    c = tl.fma(a0, b1, -(a1 * b0))
    meets = c != 0
    inverse = 1.0 / tl.where(meets, c, 1.0)
    x, y = tl.fma(a1, b2, -(a2 * b1)) * inverse, tl.fma(a2, b0, -(a0 * b2)) * inverse
    dx, dy = u - px, v - py
    in_image = tl.fma(dy, dy, dx * dx)
    return tl.where(meets, 0.5 * tl.minimum(tl.fma(x, x, y * y), in_image + in_image), -1.0)


@triton.jit
def blend(
    u, v, opacity, a, b, c, d, e, f, g, h, i, px, py, T, max_alpha, min_alpha, min_transmittance, IS_2D: tl.constexpr
):  # fmt: skip
    """Return A_ij of one splat and the transmittance behind it in all pixels; both are 0 for finished pixels."""
    sigma = _exponent(u, v, a, b, c, px, py)
    if IS_2D:
        sigma = _exponent_2d(u, v, a, b, c, d, e, f, g, h, i, px, py)
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

    The kernel writes the number of each pixel's label to local[cell, pixel], or -1 for other labels. It writes the
    labels to table[cell, number].
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


@triton.jit(do_not_specialize=["first_cell", "first_slot", "columns"])
def _sum_regions(
    splats, members, offsets, local, table, counts, base, order, out_key, out_weight, out_used,
    first_cell, first_slot, columns, cells_across, cells, max_alpha, min_alpha, min_transmittance,
    POWER: tl.constexpr, IS_2D: tl.constexpr, CELL_W: tl.constexpr, CELL_H: tl.constexpr, UNROLL: tl.constexpr,
):  # fmt: skip
    cell = first_cell + tl.load(order + tl.program_id(0))
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
        # Load the next splat during the computation of the current one.
        m = tl.load(members + i)
        u, v, o, s0, s1, s2, s3, s4, s5, s6, s7, s8 = load_splat(splats, m, i < stop, IS_2D)
        later = tl.load(members + i + 1, mask=i + 1 < stop, other=0)
        while (i < stop) & (alive > 0):
            for _ in tl.static_range(UNROLL):
                next_m = later
                later = tl.load(members + i + 2, mask=i + 2 < stop, other=0)
                next_u, next_v, next_o, n0, n1, n2, n3, n4, n5, n6, n7, n8 = load_splat(
                    splats, next_m, i + 1 < stop, IS_2D
                )

                weight, T = blend(
                    u, v, o, s0, s1, s2, s3, s4, s5, s6, s7, s8, px, py, T, max_alpha, min_alpha, min_transmittance,
                    IS_2D,
                )  # fmt: skip
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
                m, u, v, o = next_m, next_u, next_v, next_o
                s0, s1, s2, s3, s4, s5, s6, s7, s8 = n0, n1, n2, n3, n4, n5, n6, n7, n8
            alive = tl.max(tl.where(T > 0, 1, 0))
    tl.store(out_used + cell - first_cell, slot - first)


@triton.jit(do_not_specialize=["base", "first_slot"])
def _pack(key, weight, base, used, ends, out_key, out_weight, first_slot, COPIED: tl.constexpr):
    """Copy the used slots of a cell to the output, right after those of the previous cells."""
    cell = tl.program_id(0).to(tl.int64)
    count = tl.load(used + cell)
    source, target = tl.load(base + cell) - first_slot, tl.load(ends + cell) - count
    for k in range(0, count, COPIED):
        i = k + tl.arange(0, COPIED)
        tl.store(out_key + target + i, tl.load(key + source + i, mask=i < count), mask=i < count)
        tl.store(out_weight + target + i, tl.load(weight + source + i, mask=i < count), mask=i < count)


def sum_regions(
    splats: Float32[Tensor, "m values"],
    lists: CellLists,
    labels: Int32[Tensor, "views h w"],
    grid: CellGrid,
    *,
    columns: int,
    limits: AlphaLimits,
    weight_power: int,
) -> RegionSums:
    """Return the sums of A_ij ** weight_power over the pixels of each region in each cell, for views of one size.

    Args:
        splats: Projected Gaussians; see `SPLAT` and `SPLAT_2D`.
        lists: Splats by cell.
        labels: Region of every pixel. -1 means unlabeled and is summed like a region; pixels with other negative labels
            are ignored.
        grid: Cells of an image.
        columns: Number of columns in keys, larger than the largest label + 1.
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
        # The longest lists come first, because a long list at the end would occupy the GPU alone.
        order = lists.offsets[first : last + 1].diff().argsort(descending=True)
        _sum_regions[(last - first,)](
            splats.view(torch.int64), lists.members, lists.offsets, local, table, counts, slots, order, key, weight,
            used, first, low, columns, grid.across, grid.cells, *limits,
            POWER=weight_power, IS_2D=splats.shape[1] == SPLAT_2D, UNROLL=UNROLL, **shape,
        )  # fmt: skip
        ends = used.cumsum(0)
        total = int(ends[-1])
        packed = RegionSums(key.new_empty(total), weight.new_empty(total))
        _pack[(last - first,)](key, weight, slots[first:], used, ends, *packed, low, COPIED=_COPIED, num_warps=1)
        parts.append(packed)
    return parts[1] if len(parts) == 2 else RegionSums(*(torch.cat(x) for x in zip(*parts)))


def _chunks(slots: Int[Tensor, " cells_plus_1"]) -> list[tuple[int, int, int, int]]:
    """Return ranges (first cell, last cell, first slot, last slot), with exclusive ends.

    Without its first cell, a range has at most `_MOST_SLOTS` slots.
    """
    total = int(slots[-1])
    if total <= _MOST_SLOTS:
        return [(0, len(slots) - 1, 0, total)] if total > 0 else []
    bounds = torch.arange(0, total + _MOST_SLOTS, _MOST_SLOTS, device=slots.device)
    cell = torch.cat([torch.searchsorted(slots, bounds, right=True) - 1, slots.new_tensor([len(slots) - 1])]).unique()
    return [
        (first, last, low, high) for (first, low), (last, high) in pairwise(zip(cell.tolist(), slots[cell].tolist()))
    ]


@triton.jit(do_not_specialize=["count", "columns", "views"])
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


def decode_keys(
    key: Int[Tensor, " m"], splat_keys: Int64[Tensor, " splats"], first: Int32[Tensor, " views_plus_1"], columns: int
) -> tuple[Int32[Tensor, " m"], Int32[Tensor, " m"]]:
    """Return the Gaussian and the column of every sum.

    Args:
        key: Keys of `RegionSums`.
        splat_keys: Key gaussian * views + view of every splat.
        first: First column of every view, and then the total number of columns.
        columns: Number of columns in `key`.
    """
    gaussian, column = (torch.empty(len(key), dtype=torch.int32, device=key.device) for _ in range(2))
    if len(key) > 0:
        _places[(triton.cdiv(len(key), _PLACES),)](
            key, splat_keys, first, gaussian, column, len(key), columns, len(first) - 1, BLOCK=_PLACES, num_warps=4
        )
    return gaussian, column


# Compositing of images with any number of channels, with one single-warp program per cell and group of channels.


_CHANNELS = 8
"""Largest number of channels per program. More channels need more programs, which compute the weights again."""


@triton.jit(do_not_specialize=_SIZES)
def _composite(
    splats, members, offsets, gaussians, values, image, out_alpha, width, height, channels, cells_across,
    max_alpha, min_alpha, min_transmittance,
    IS_2D: tl.constexpr, CELL_W: tl.constexpr, CELL_H: tl.constexpr, UNROLL: tl.constexpr, CHANNELS: tl.constexpr,
):  # fmt: skip
    cell = tl.program_id(0)
    channel = tl.program_id(1) * CHANNELS + tl.arange(0, CHANNELS)[None, None, :]
    start, stop = tl.load(offsets + cell), tl.load(offsets + cell + 1)
    y, x = cell_pixels(cell, cells_across, CELL_W, CELL_H)
    px, py = x.to(tl.float32) + 0.5, y.to(tl.float32) + 0.5
    inside = (y < height) & (x < width)
    T = tl.where(inside, 1.0, 0.0)
    weight_sum = tl.zeros([CELL_H, CELL_W], tl.float32)
    color = tl.zeros([CELL_H, CELL_W, CHANNELS], tl.float32)
    i = start
    alive = 1
    while (i < stop) & (alive > 0):
        for _ in tl.static_range(UNROLL):
            inside_list = i < stop
            m = tl.load(members + i, mask=inside_list, other=0).to(tl.int64)
            u, v, o, s0, s1, s2, s3, s4, s5, s6, s7, s8 = load_splat(splats, m, inside_list, IS_2D)
            gaussian = tl.load(gaussians + m)
            weight, T = blend(
                u, v, o, s0, s1, s2, s3, s4, s5, s6, s7, s8, px, py, T, max_alpha, min_alpha, min_transmittance, IS_2D
            )
            value = tl.load(values + gaussian * channels + channel, mask=channel < channels, other=0.0)
            color += weight[:, :, None] * value
            weight_sum += weight
            i += 1
        alive = tl.max(tl.where(T > 0, 1, 0))
    pixel = y.to(tl.int64) * width + x
    tl.store(image + pixel[:, :, None] * channels + channel, color, mask=inside[:, :, None] & (channel < channels))
    if tl.program_id(1) == 0:
        tl.store(out_alpha + pixel, weight_sum, mask=inside)


def composite(
    splats: Float32[Tensor, "m values"],
    lists: CellLists,
    gaussians: Int64[Tensor, " m"],
    values: Float32[Tensor, "n c"],
    grid: CellGrid,
    limits: AlphaLimits,
) -> tuple[Float32[Tensor, "h w c"], Float32[Tensor, "h w"]]:
    """Return sum_j A_ij values_j and sum_j A_ij of every pixel of one view.

    Args:
        splats: Projected Gaussians; see `SPLAT` and `SPLAT_2D`.
        lists: Splats by cell.
        gaussians: Gaussian of every splat.
        values: Values of every Gaussian.
        grid: Cells of the image.
        limits: Limits of alpha and transmittance.
    """
    channels = values.shape[1]
    image = torch.zeros(grid.height, grid.width, channels, device=splats.device)
    alpha = torch.zeros(grid.height, grid.width, device=splats.device)
    if len(lists.members) == 0:
        return image, alpha
    block = min(_CHANNELS, triton.next_power_of_2(max(1, channels)))
    _composite[(grid.cells, max(1, triton.cdiv(channels, block)))](
        splats.view(torch.int64), lists.members, lists.offsets, gaussians, values.contiguous(), image, alpha,
        grid.width, grid.height, channels, grid.across, *limits, IS_2D=splats.shape[1] == SPLAT_2D,
        CELL_W=grid.cell_width, CELL_H=grid.cell_height, UNROLL=UNROLL, CHANNELS=block, num_warps=1,
    )  # fmt: skip
    return image, alpha
