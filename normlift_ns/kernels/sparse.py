"""Triton kernels for sums and products of sparse matrices."""

from __future__ import annotations

from typing import NamedTuple, Protocol

import torch
import triton
import triton.language as tl
from jaxtyping import Float, Float32, Float64, Int32, Int64
from torch import Tensor

_ROWS = 128
_VECTORS = 16
"""Number of vector sums per program. With one sum per program, starting the programs takes as long as the sums."""


class RowNorms(NamedTuple):
    """Norms and sums of the rows j of a sparse matrix E. Column s has a unit vector F_s and belongs to a view v."""

    total: Float64[Tensor, " n"]
    """||sum_s E_js F_s||"""
    by_view: Float64[Tensor, " n"]
    """sum_v ||sum_{s in v} E_js F_s||"""
    weight: Float64[Tensor, " n"]
    """sum_s E_js"""
    weight_squared: Float64[Tensor, " n"]
    """sum_v (sum_{s in v} E_js) ** 2"""
    views: Int32[Tensor, " n"]
    """Number of views with a positive weight."""


@triton.jit(do_not_specialize=["segments"])
def _segment_sum(values, offsets, out, segments, ROWS: tl.constexpr):
    row = tl.program_id(0).to(tl.int64) * ROWS + tl.arange(0, ROWS)
    start = tl.load(offsets + row, mask=row < segments, other=0)
    length = tl.load(offsets + row + 1, mask=row < segments, other=0) - start
    total = tl.zeros([ROWS], tl.float64)
    for i in range(tl.max(length, axis=0)):
        total += tl.load(values + start + i, mask=i < length, other=0.0).to(tl.float64)
    tl.store(out + row, total, mask=row < segments)


def segment_sum(values: Float[Tensor, " m"], offsets: Int64[Tensor, " rows_plus_1"]) -> Float64[Tensor, " rows"]:
    """Return the sums of the segments values[offsets[i]:offsets[i + 1]], from left to right in float64.

    The kernel is fast for many short segments.
    """
    out = torch.empty(len(offsets) - 1, dtype=torch.float64, device=values.device)
    _segment_sum[(triton.cdiv(len(out), _ROWS),)](values, offsets, out, len(out), ROWS=_ROWS, num_warps=4)
    return out


@triton.jit(do_not_specialize=["rows"])
def _product(offsets, column, weight, vector, out, rows, ROWS: tl.constexpr):
    row = tl.program_id(0).to(tl.int64) * ROWS + tl.arange(0, ROWS)
    start = tl.load(offsets + row, mask=row < rows, other=0)
    length = tl.load(offsets + row + 1, mask=row < rows, other=0) - start
    total = tl.zeros([ROWS], tl.float64)
    for i in range(tl.max(length, axis=0)):
        inside = i < length
        value = tl.load(vector + tl.load(column + start + i, mask=inside, other=0), mask=inside, other=0.0)
        total += tl.load(weight + start + i, mask=inside, other=0.0).to(tl.float64) * value.to(tl.float64)
    tl.store(out + row, total.to(out.dtype.element_ty), mask=row < rows)


def multiply_vector(
    offsets: Int64[Tensor, " n_plus_1"],
    column: Int32[Tensor, " nnz"],
    weight: Float[Tensor, " nnz"],
    vector: Float[Tensor, " s"],
) -> Float[Tensor, " n"]:
    """Return the product E x of a sparse matrix E and a vector x, in the precision of x but summed in float64.

    The kernel is fast for many short rows.
    """
    out = torch.empty(len(offsets) - 1, dtype=vector.dtype, device=vector.device)
    grid = (triton.cdiv(len(out), _ROWS),)
    _product[grid](offsets, column, weight, vector, out, len(out), ROWS=_ROWS, num_warps=4)
    return out


@triton.jit
def _exact_sum(column, weight, table, start, stop, dimension, BLOCK: tl.constexpr):
    """Return the weighted sum of rows of the table in float64."""
    d = tl.arange(0, BLOCK)
    total = tl.zeros([BLOCK], tl.float64)
    for e in range(start, stop):
        row = tl.load(column + e).to(tl.int64) * dimension + d
        total += tl.load(weight + e).to(tl.float64) * tl.load(table + row, mask=d < dimension, other=0.0).to(tl.float64)
    return total


@triton.jit
def _store_norms(
    out_total, out_by_view, out_weight, out_squared, out_views, j, total, by_view, weight, squared, views
):  # fmt: skip
    tl.store(out_total + j, total)
    tl.store(out_by_view + j, by_view)
    tl.store(out_weight + j, weight)
    tl.store(out_squared + j, squared)
    tl.store(out_views + j, views)


@triton.jit(do_not_specialize=["rows"])
def _row_norms(
    offsets, column, weight, column_view, table, out_total, out_by_view, out_weight, out_squared, out_views,
    rows, dimension, min_share, max_entries, VECTORS: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    first = tl.program_id(0) * VECTORS
    for j in range(first, tl.minimum(first + VECTORS, rows)):
        _norms_of_row(
            offsets, column, weight, column_view, table, out_total, out_by_view, out_weight, out_squared, out_views,
            j, dimension, min_share, max_entries, BLOCK,
        )  # fmt: skip


@triton.jit
def _norms_of_row(
    offsets, column, weight, column_view, table, out_total, out_by_view, out_weight, out_squared, out_views,
    j, dimension, min_share, max_entries, BLOCK: tl.constexpr,
):  # fmt: skip
    """Compute the norms of one row. Repeat a sum in float64 if it has many terms or they nearly cancel."""
    start, stop = tl.load(offsets + j), tl.load(offsets + j + 1)
    if stop - start <= 1:  # no vector sum is needed, because rows of the table are unit vectors
        only = tl.load(weight + start, mask=start < stop, other=0.0).to(tl.float64)
        _store_norms(out_total, out_by_view, out_weight, out_squared, out_views, j, only, only, only, only * only,
                     tl.where(only > 0, 1, 0))  # fmt: skip
    else:
        d = tl.arange(0, BLOCK)
        zero = tl.zeros([BLOCK], tl.float32)
        total, view_total = zero, zero
        all_weight = tl.zeros([], tl.float64)
        view_weight, squared, by_view = all_weight, all_weight, all_weight
        views, first = 0, start
        view = -1
        # Load the row of the next entry and the column of the one after it during the sum of an entry.
        s = tl.load(column + start)
        next_column = tl.load(column + start + 1)
        next_view, next_w = tl.load(column_view + s), tl.load(weight + start)
        next_row = tl.load(table + s.to(tl.int64) * dimension + d, mask=d < dimension, other=0.0)
        for e in range(start, stop + 1):
            entry_view, w, row = next_view, next_w, next_row
            s, following = next_column, tl.minimum(e + 1, stop - 1)
            next_column = tl.load(column + tl.minimum(e + 2, stop - 1))
            next_view = tl.where(e + 1 < stop, tl.load(column_view + s), -2)
            next_w = tl.where(e + 1 < stop, tl.load(weight + following), 0.0)
            next_row = tl.load(table + s.to(tl.int64) * dimension + d, mask=d < dimension, other=0.0)
            if (entry_view != view) & (view != -1):  # end of the entries of a view
                norm = view_weight  # norm of a single unit row
                if e - first > 1:
                    norm = tl.sqrt(tl.sum(view_total * view_total, axis=0)).to(tl.float64)
                    if (norm < min_share * view_weight) | (e - first > max_entries):
                        exact = _exact_sum(column, weight, table, first, e, dimension, BLOCK)
                        norm = tl.sqrt(tl.sum(exact * exact, axis=0))
                by_view += norm
                all_weight += view_weight
                squared += view_weight * view_weight
                views += tl.where(view_weight > 0, 1, 0)
                total += view_total
                view_total = zero
                view_weight = tl.zeros([], tl.float64)
                first = e
            view_total += w * row  # 0 after the last entry
            view_weight += w.to(tl.float64)
            view = entry_view
        norm = tl.sqrt(tl.sum(total * total, axis=0)).to(tl.float64)
        if (norm < min_share * all_weight) | (stop - start > max_entries):
            exact = _exact_sum(column, weight, table, start, stop, dimension, BLOCK)
            norm = tl.sqrt(tl.sum(exact * exact, axis=0))
        _store_norms(
            out_total, out_by_view, out_weight, out_squared, out_views, j, norm, by_view, all_weight, squared, views
        )  # fmt: skip


def row_norms(
    offsets: Int64[Tensor, " n_plus_1"],
    column: Int32[Tensor, " nnz"],
    weight: Float32[Tensor, " nnz"],
    column_view: Int32[Tensor, " s"],
    table: Float32[Tensor, "s d"],
    min_share: float,
    max_entries: int,
) -> RowNorms:
    """Return the norms and sums of all rows of E, without an [N, D] array.

    Args:
        offsets: Row offsets of the sparse matrix E.
        column: Columns of the entries, ascending in each row. Entries of a view are therefore consecutive.
        weight: Weights of the entries.
        column_view: View of every column, non-decreasing.
        table: Unit rows F.
        min_share: A sum is repeated in float64 if its norm is below `min_share` times the sum of its weights.
        max_entries: Number of entries above which a sum is repeated in float64.
    """
    n, dimension, device = len(offsets) - 1, table.shape[1], table.device
    out = RowNorms(
        *(torch.empty(n, dtype=torch.float64, device=device) for _ in range(4)),
        torch.empty(n, dtype=torch.int32, device=device),
    )
    _row_norms[(triton.cdiv(n, _VECTORS),)](
        offsets, column, weight, column_view, table, *out, n, dimension, min_share, max_entries,
        VECTORS=_VECTORS, BLOCK=triton.next_power_of_2(dimension), num_warps=1,
    )  # fmt: skip
    return out


@triton.jit(do_not_specialize=["count"])
def _unit_sums(
    rows, offsets, column, weight, table, norms, out, count, dimension, min_share, max_entries,
    VECTORS: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    first = tl.program_id(0).to(tl.int64) * VECTORS
    for i in range(first, tl.minimum(first + VECTORS, count)):
        _unit_sum(rows, offsets, column, weight, table, norms, out, i, dimension, min_share, max_entries, BLOCK)


@triton.jit
def _unit_sum(
    rows, offsets, column, weight, table, norms, out, i, dimension, min_share, max_entries, BLOCK: tl.constexpr
):
    j = tl.load(rows + i)
    start, stop = tl.load(offsets + j), tl.load(offsets + j + 1)
    d = tl.arange(0, BLOCK)
    total = tl.zeros([BLOCK], tl.float32)
    all_weight = tl.zeros([], tl.float32)
    if tl.load(norms + j) > 0:
        for e in range(start, stop):
            w = tl.load(weight + e)
            row = tl.load(column + e).to(tl.int64) * dimension + d
            total += w * tl.load(table + row, mask=d < dimension, other=0.0)
            all_weight += w
        norm = tl.sqrt(tl.sum(total * total, axis=0))
        if (norm < min_share * all_weight) | (stop - start > max_entries):
            exact = _exact_sum(column, weight, table, start, stop, dimension, BLOCK)
            total = (exact / tl.sqrt(tl.sum(exact * exact, axis=0))).to(tl.float32)
        else:
            total = total / norm
    tl.store(out + i * dimension + d, total.to(out.dtype.element_ty), mask=d < dimension)


def unit_sums(
    rows: Int64[Tensor, " m"],
    offsets: Int64[Tensor, " n_plus_1"],
    column: Int32[Tensor, " nnz"],
    weight: Float32[Tensor, " nnz"],
    table: Float32[Tensor, "s d"],
    norms: Float32[Tensor, " n"],
    dtype: torch.dtype,
    min_share: float,
    max_entries: int,
) -> Float[Tensor, "m d"]:
    """Return sum_s E_js F_s of some rows j as unit vectors, or 0 if the norm is 0.

    Args:
        rows: Indices of the rows j.
        offsets: Row offsets of the sparse matrix E.
        column: Columns of the entries.
        weight: Weights of the entries.
        table: Unit rows F.
        norms: Norm of sum_s E_js F_s for every row j of E.
        dtype: Precision of the result.
        min_share: As in `row_norms`.
        max_entries: As in `row_norms`.
    """
    dimension = table.shape[1]
    out = torch.empty(len(rows), dimension, dtype=dtype, device=table.device)
    if len(rows) > 0:
        _unit_sums[(triton.cdiv(len(rows), _VECTORS),)](
            rows, offsets, column, weight, table, norms, out, len(rows), dimension, min_share, max_entries,
            VECTORS=_VECTORS, BLOCK=triton.next_power_of_2(dimension), num_warps=1,
        )  # fmt: skip
    return out


# Products of two sparse matrices as blocks of dense rows, and row maxima.


_PRODUCT_ROWS = 128
_WIDTH = 64
"""Number of entries of a row that a program adds in one step."""


class SparseRowsLike(Protocol):
    """Interface of `core.sparse.SparseRows`."""

    @property
    def offsets(self) -> Tensor: ...  # noqa: D102
    @property
    def column(self) -> Tensor: ...  # noqa: D102
    @property
    def weight(self) -> Tensor: ...  # noqa: D102


@triton.jit(do_not_specialize=["rows"])
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
    """Return the maximum of value[column] over every row, or 0 for an empty row. Values must be >= 0."""
    out = torch.empty(len(offsets) - 1, dtype=torch.float64, device=value.device)
    _row_max[(triton.cdiv(len(out), _PRODUCT_ROWS),)](
        offsets, column, value, out, len(out), ROWS=_PRODUCT_ROWS, num_warps=4
    )
    return out


@triton.jit(do_not_specialize=["first", "columns"])
def _products(a_offsets, a_column, a_weight, b_offsets, b_column, b_weight, out, first, columns, WIDTH: tl.constexpr):
    """Compute one row of A B per program. Rows of B are added in a fixed order.

    The columns in a row of B must be distinct.
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
        tl.debug_barrier()  # the next row of B may have the same columns


def multiply_rows(
    a: SparseRowsLike, b: SparseRowsLike, columns: int, first: int, last: int
) -> Float32[Tensor, "rows columns"]:
    """Return the dense float32 rows first..last - 1 of the product A B, bitwise the same on every run."""
    out = torch.zeros(last - first, columns, device=a.weight.device)
    arrays = (a.offsets, a.column, a.weight.float(), b.offsets, b.column, b.weight.float())
    _products[(last - first,)](*arrays, out, first, columns, WIDTH=_WIDTH, num_warps=1, num_stages=1)
    return out
