"""Exact lists of the splats that touch each cell of an image, nearest first, built by two stable sorts.

A cell is one of gsplat's tiles or a part of one. A splat is in the list of a cell if its rectangle touches the tile, as
in gsplat, and alpha can reach its threshold in a pixel of the cell. The second condition is computed in float64 with a
margin for all float32 rounding of alpha. So the sums equal those with gsplat's own lists.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
import triton
import triton.language as tl
from jaxtyping import Int32
from torch import Tensor

from normlift_ns.kernels.projection import SPLAT, Splats

_BLOCK = 32
_ROUNDING = tl.constexpr(2.0**-20)
"""Relative float32 rounding error of the squares in an exponent: at most 12 half units in the last place."""
_REACH_MARGIN = tl.constexpr(1e-3)
"""Added to the largest relevant exponent, for the rounding of the exponential and of float64 here."""
_NEEDLE = tl.constexpr(1e-6)
"""Ratio of a determinant to the product of its diagonal below which it does not determine the reach of a splat."""
_FAR = tl.constexpr(1e30)


class Grid(NamedTuple):
    """Division of images of one size into cells."""

    width: int
    height: int
    tile: int
    """Side of gsplat's tiles in pixels, a power of two."""
    cell_width: int
    """Width in pixels of the cells that have lists; it divides a tile."""
    cell_height: int
    """Height in pixels of the cells that have lists; it divides a tile."""

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


class Lists(NamedTuple):
    """Splats by cell, nearest first: cell c has members[offsets[c]:offsets[c + 1]].

    Cells are numbered row by row, view after view.
    """

    offsets: Int32[Tensor, " cells_plus_1"]
    members: Int32[Tensor, " pairs"]
    """Rows of the splats."""


@triton.jit
def _pairs(
    splats, order, keys, starts, ends, out_count, out_cell, out_member, entries, views, width, height, min_alpha,
    tiles_across, tiles_down, cells_across, cells_down,
    TILE: tl.constexpr, CELL_W: tl.constexpr, CELL_H: tl.constexpr, CULL: tl.constexpr, WRITE: tl.constexpr,
    SPLAT: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """Count the cells of every splat in some order, or write them, at most as many as were counted."""
    i = tl.program_id(0).to(tl.int64) * BLOCK + tl.arange(0, BLOCK)
    valid = i < entries
    e = tl.load(order + i, mask=valid, other=0)
    row = splats + SPLAT * e
    u, v = tl.load(row, mask=valid, other=0.0), tl.load(row + 1, mask=valid, other=0.0)
    half_width, half_height = tl.load(row + 6, mask=valid, other=0.0), tl.load(row + 7, mask=valid, other=0.0)
    # The tiles of the rectangle, in float32 like gsplat, and their cells.
    x0 = tl.minimum(tl.maximum(tl.floor(u / TILE - half_width / TILE), 0.0), tiles_across).to(tl.int32)
    x1 = tl.minimum(tl.maximum(tl.ceil(u / TILE + half_width / TILE), 0.0), tiles_across).to(tl.int32)
    y0 = tl.minimum(tl.maximum(tl.floor(v / TILE - half_height / TILE), 0.0), tiles_down).to(tl.int32)
    y1 = tl.minimum(tl.maximum(tl.ceil(v / TILE + half_height / TILE), 0.0), tiles_down).to(tl.int32)
    x0, x1 = x0 * (TILE // CELL_W), tl.minimum(x1 * (TILE // CELL_W), cells_across)
    y0, y1 = y0 * (TILE // CELL_H), tl.minimum(y1 * (TILE // CELL_H), cells_down)
    y1 = tl.where(valid, y1, y0)

    # {a dx^2 + 2 b dx dy + c dy^2 <= reach}: an ellipse that contains every pixel with alpha >= min_alpha.
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


def list_cells(projected: Splats, views: int, grid: Grid, min_alpha: float, *, cull: bool = True) -> Lists:
    """Return the splats of every cell of all views.

    Args:
        projected: Splats of all views.
        views: Number of views.
        grid: Cells of an image.
        min_alpha: Threshold of alpha.
        cull: Whether to omit a splat from cells in which alpha stays below the threshold. Other entries of the lists
            do not depend on it.
    """
    device, entries, tile = projected.depth.device, len(projected.depth), grid.tile
    order = projected.depth.sort(stable=True).indices  # equal depths stay in the order of the Gaussians
    count = torch.empty(entries, dtype=torch.int32, device=device)
    launch = (triton.cdiv(entries, _BLOCK),)
    sizes = (entries, views, grid.width, grid.height, min_alpha, -(-grid.width // tile), -(-grid.height // tile))
    sizes += (grid.across, grid.down)
    shape = {"TILE": tile, "CELL_W": grid.cell_width, "CELL_H": grid.cell_height, "SPLAT": SPLAT, "BLOCK": _BLOCK}
    options = {**shape, "CULL": cull, "num_warps": 1}
    unused = count
    if entries > 0:
        _pairs[launch](
            projected.splats, order, projected.seen, unused, unused, count, unused, unused, *sizes,
            WRITE=False, **options,
        )  # fmt: skip
    ends = count.cumsum(0)
    pairs = int(ends[-1]) if entries > 0 else 0
    # If a cell was counted but not written, because of different rounding, its entry sorts behind all cells.
    end = views * grid.cells
    dtype = torch.int16 if end < 2**15 else torch.int32
    cell = torch.full((pairs,), end, dtype=dtype, device=device)
    member = torch.zeros(pairs, dtype=torch.int32, device=device)
    if pairs > 0:
        starts = ends - count
        _pairs[launch](
            projected.splats, order, projected.seen, starts, ends, count, cell, member, *sizes, WRITE=True, **options
        )  # fmt: skip
    cell, by_cell = cell.sort(stable=True)
    bounds = torch.arange(end + 1, dtype=dtype, device=device)
    return Lists(torch.searchsorted(cell, bounds, out_int32=True), member[by_cell])
