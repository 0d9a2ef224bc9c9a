"""Products of two sparse matrices, in blocks of dense rows, and row maxima."""

from __future__ import annotations

from typing import Protocol

import torch
import triton
import triton.language as tl
from jaxtyping import Float32, Float64, Int32, Int64
from torch import Tensor

_ROWS = 128
_WIDTH = 64
"""Entries of a row that are added in one step."""


class Rows(Protocol):
    """Interface of `core.sparse.SparseRows`."""

    @property
    def offsets(self) -> Tensor: ...  # noqa: D102
    @property
    def column(self) -> Tensor: ...  # noqa: D102
    @property
    def weight(self) -> Tensor: ...  # noqa: D102


@triton.jit
def _row_max(offsets, column, value, out, rows, ROWS: tl.constexpr):
    row = tl.program_id(0).to(tl.int64) * ROWS + tl.arange(0, ROWS)
    start = tl.load(offsets + row, mask=row < rows, other=0)
    length = tl.load(offsets + row + 1, mask=row < rows, other=0) - start
    best = tl.zeros([ROWS], tl.float64)
    for i in range(tl.max(length, axis=0)):
        inside = i < length
        best = tl.maximum(
            best, tl.load(value + tl.load(column + start + i, mask=inside, other=0), mask=inside, other=0.0)
        )
    tl.store(out + row, best, mask=row < rows)


def row_max(
    offsets: Int64[Tensor, " n_plus_1"], column: Int32[Tensor, " nnz"], value: Float64[Tensor, " s"]
) -> Float64[Tensor, " n"]:
    """Return the maximum of value[column] over every row, for values >= 0; 0 for an empty row."""
    out = torch.empty(len(offsets) - 1, dtype=torch.float64, device=value.device)
    _row_max[(triton.cdiv(len(out), _ROWS),)](offsets, column, value, out, len(out), ROWS=_ROWS, num_warps=4)
    return out


@triton.jit
def _products(a_offsets, a_column, a_weight, b_offsets, b_column, b_weight, out, first, columns, WIDTH: tl.constexpr):
    """Compute one row of A B per program. Rows of B are added one after another, always in the same order.

    Columns within a row of B are distinct.
    """
    block = tl.program_id(0).to(tl.int64)
    row_start = out + block * columns
    for e in range(tl.load(a_offsets + first + block), tl.load(a_offsets + first + block + 1)):
        j = tl.load(a_column + e)
        factor = tl.load(a_weight + e)
        start, stop = tl.load(b_offsets + j), tl.load(b_offsets + j + 1)
        for i in range(start, stop, WIDTH):
            entry = i + tl.arange(0, WIDTH)
            inside = entry < stop
            pointer = row_start + tl.load(b_column + entry, mask=inside, other=0)
            value = tl.load(b_weight + entry, mask=inside, other=0.0)
            before = tl.load(pointer, mask=inside, other=0.0)
            tl.store(pointer, before + factor * value, mask=inside)
        tl.debug_barrier()  # the next row of B may hold the same columns


def products(a: Rows, b: Rows, columns: int, first: int, last: int) -> Float32[Tensor, "rows columns"]:
    """Return rows first..last - 1 of the product A B, dense, in float32; bitwise the same on every run."""
    out = torch.zeros(last - first, columns, device=a.weight.device)
    arrays = (a.offsets, a.column, a.weight.float(), b.offsets, b.column, b.weight.float())
    _products[(last - first,)](*arrays, out, first, columns, WIDTH=_WIDTH, num_warps=1, num_stages=1)
    return out
