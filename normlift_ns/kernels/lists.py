"""Which splats touch which cells of an image: exact lists, nearest first, by two stable sorts.

A cell is a tile of gsplat's or a part of one. A splat is in the list of a cell if its rectangle touches the tile, as
gsplat decides, and if alpha can reach its threshold in a pixel of the cell. The second question is answered in float64
with a margin for all that float32 rounds where alpha is computed, so that the sums are those of gsplat's own lists.
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
"""Share of the squares in an exponent that float32 may round away: at most 12 half units in the last place."""
_REACH_MARGIN = tl.constexpr(1e-3)
"""Added to the largest exponent that counts, for the exponential and for what float64 rounds here."""
_NEEDLE = tl.constexpr(1e-6)
"""Share of the product of the diagonal below which a determinant does not tell how far a splat reaches."""
_FAR = tl.constexpr(1e30)


class Grid(NamedTuple):
    """How images of one size are divided."""

    width: int
    height: int
    tile: int
    """Side in pixels of the tiles in which gsplat draws, a power of two."""
    cell_width: int
    cell_height: int
    """Of the cells that have lists, in pixels; they divide a tile."""

    @property
    def across(self) -> int:
        """Cells from left to right."""
        return -(-self.width // self.cell_width)

    @property
    def down(self) -> int:
        """Cells from top to bottom."""
        return -(-self.height // self.cell_height)

    @property
    def cells(self) -> int:
        """Cells of one image, row by row."""
        return self.across * self.down


class Lists(NamedTuple):
    """Splats by cell, nearest first: members[offsets[c]:offsets[c + 1]], all cells of the first view, of the second…"""

    offsets: Int32[Tensor, " cells_plus_1"]
    members: Int32[Tensor, " pairs"]
    """Rows of the splats."""


@triton.jit
def _pairs(
    splats, order, seen, starts, ends, out_count, out_cell, out_member, entries, views, width, height, min_alpha,
    tiles_across, tiles_down, cells_across, cells_down,
    TILE: tl.constexpr, CELL_W: tl.constexpr, CELL_H: tl.constexpr, CULL: tl.constexpr, WRITE: tl.constexpr,
    SPLAT: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """Counts the cells of every splat, in the given order; or writes them, as many as were counted."""
    i = tl.program_id(0).to(tl.int64) * BLOCK + tl.arange(0, BLOCK)
    there = i < entries
    e = tl.load(order + i, mask=there, other=0)
    row = splats + SPLAT * e
    u, v = tl.load(row, mask=there, other=0.0), tl.load(row + 1, mask=there, other=0.0)
    half_width, half_height = tl.load(row + 6, mask=there, other=0.0), tl.load(row + 7, mask=there, other=0.0)
    # The tiles of the rectangle, in gsplat's float32, and their cells.
    x0 = tl.minimum(tl.maximum(tl.floor(u / TILE - half_width / TILE), 0.0), tiles_across).to(tl.int32)
    x1 = tl.minimum(tl.maximum(tl.ceil(u / TILE + half_width / TILE), 0.0), tiles_across).to(tl.int32)
    y0 = tl.minimum(tl.maximum(tl.floor(v / TILE - half_height / TILE), 0.0), tiles_down).to(tl.int32)
    y1 = tl.minimum(tl.maximum(tl.ceil(v / TILE + half_height / TILE), 0.0), tiles_down).to(tl.int32)
    x0, x1 = x0 * (TILE // CELL_W), tl.minimum(x1 * (TILE // CELL_W), cells_across)
    y0, y1 = y0 * (TILE // CELL_H), tl.minimum(y1 * (TILE // CELL_H), cells_down)
    y1 = tl.where(there, y1, y0)

    # {a dx^2 + 2 b dx dy + c dy^2 <= reach}: an ellipse that holds every pixel with alpha >= min_alpha.
    a = 2.0 * tl.load(row + 2, mask=there, other=1.0).to(tl.float64) * (1.0 - _ROUNDING)
    c = 2.0 * tl.load(row + 3, mask=there, other=1.0).to(tl.float64) * (1.0 - _ROUNDING)
    b = tl.load(row + 4, mask=there, other=0.0).to(tl.float64)
    opacity = tl.load(row + 5, mask=there, other=1.0)
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
    tall = tl.where(ellipse, tl.sqrt(reach * a / det), _FAR)
    turn = b / c * tl.sqrt(reach * c / det)  # dy at its left end; at its right end the opposite
    low = tl.ceil((v - tall - (CELL_H - 0.5)) / CELL_H)
    high = tl.floor((v + tall - 0.5) / CELL_H) + 1.0
    y0 = tl.maximum(tl.minimum(low, y1.to(tl.float64)), y0.to(tl.float64)).to(tl.int32)
    y1 = tl.minimum(tl.maximum(high, y0.to(tl.float64)), y1.to(tl.float64)).to(tl.int32)

    found = tl.zeros([BLOCK], tl.int32)
    if WRITE:
        place, end = tl.load(starts + i, mask=there, other=0), tl.load(ends + i, mask=there, other=0)
        view = (tl.load(seen + e, mask=there, other=0) % views).to(tl.int32) * (cells_across * cells_down)
    for k in range(tl.max(y1 - y0, axis=0)):
        y = y0 + k
        top = (y * CELL_H).to(tl.float64) + 0.5 - v
        bottom = tl.minimum((y * CELL_H).to(tl.float64) + (CELL_H - 0.5), height - 0.5) - v
        top, bottom = tl.maximum(top, -tall), tl.minimum(bottom, tall)
        at_right = tl.minimum(tl.maximum(-turn, top), bottom)
        at_left = tl.minimum(tl.maximum(turn, top), bottom)
        right = u - b / a * at_right + tl.sqrt(tl.maximum(reach * a - det * at_right * at_right, 0.0)) / a
        left = u - b / a * at_left - tl.sqrt(tl.maximum(reach * a - det * at_left * at_left, 0.0)) / a
        right, left = tl.where(ellipse, right, _FAR), tl.where(ellipse, left, -_FAR)
        first = tl.maximum(tl.ceil((left - (CELL_W - 0.5)) / CELL_W), x0.to(tl.float64))
        last = tl.minimum(tl.floor((right - 0.5) / CELL_W) + 1.0, x1.to(tl.float64))
        some = (y < y1) & (top <= bottom) & (left <= width - 0.5) & (first < last)
        count = tl.where(some, last - first, 0.0).to(tl.int32)
        if WRITE:
            cell = view + y * cells_across + tl.where(some, first, 0.0).to(tl.int32)
            for j in range(tl.max(count, axis=0)):
                now = (j < count) & (place < end)
                tl.store(out_cell + place, (cell + j).to(out_cell.dtype.element_ty), mask=now)
                tl.store(out_member + place, e.to(tl.int32), mask=now)
                place += now.to(tl.int64)
        found += count
    if not WRITE:
        tl.store(out_count + i, found, mask=there)


def list_cells(seen: Splats, views: int, grid: Grid, min_alpha: float, *, cull: bool = True) -> Lists:
    """The splats of every cell of all views.

    Args:
        cull: leave cells out in which no pixel can feel the splat. What else the lists hold does not depend on it.
    """
    device, entries, tile = seen.depth.device, len(seen.depth), grid.tile
    order = seen.depth.sort(stable=True).indices  # equal depths by Gaussian
    count = torch.empty(entries, dtype=torch.int32, device=device)
    launch = (triton.cdiv(entries, _BLOCK),)
    sizes = (entries, views, grid.width, grid.height, min_alpha, -(-grid.width // tile), -(-grid.height // tile))
    sizes += (grid.across, grid.down)
    shape = {"TILE": tile, "CELL_W": grid.cell_width, "CELL_H": grid.cell_height, "SPLAT": SPLAT, "BLOCK": _BLOCK}
    options = {**shape, "CULL": cull, "num_warps": 1}
    no = count
    if entries > 0:
        _pairs[launch](seen.splats, order, seen.seen, no, no, count, no, no, *sizes, WRITE=False, **options)
    ends = count.cumsum(0)
    pairs = int(ends[-1]) if entries > 0 else 0
    # Were a cell counted and not written, for another rounding, its place would lie behind all cells.
    nowhere = views * grid.cells
    kind = torch.int16 if nowhere < 2**15 else torch.int32
    cell = torch.full((pairs,), nowhere, dtype=kind, device=device)
    member = torch.zeros(pairs, dtype=torch.int32, device=device)
    if pairs > 0:
        starts = ends - count
        _pairs[launch](
            seen.splats, order, seen.seen, starts, ends, count, cell, member, *sizes, WRITE=True, **options
        )  # fmt: skip
    cell, by_cell = cell.sort(stable=True)
    bounds = torch.arange(nowhere + 1, dtype=kind, device=device)
    return Lists(torch.searchsorted(cell, bounds, out_int32=True), member[by_cell])
