"""Sparse matrices in CSR format, for evidence, per-view weights and unlabeled weights."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property

import torch
from jaxtyping import Float, Float64, Int, Int32, Int64
from torch import Tensor
from torch.nn.functional import embedding_bag

from normlift_ns.core.device import TensorRecord, can_use_triton
from normlift_ns.errors import InputError
from normlift_ns.options import short_repr

CANCELLATION_RATIO = 1e-3
"""Vector sums shorter than this share of the sum of their weights are recomputed in float64, because they lose digits
by cancellation in float32."""
MANY_ENTRIES = 4096
"""Sums of more vectors than this are computed in float64, because rounding errors of float32 would add up."""
CHUNK_ELEMENTS = 2**24
"""Number of elements per block of a dense array that is computed in blocks."""
_MAX_NARROW_COLUMNS = 32
"""Largest number of table columns for which SciPy or a Triton kernel is faster than an embedding bag."""
_MAX_SORTED = 2**27
"""Largest number of entries that a GPU sorts in one call."""


def segment_sum(values: Tensor, offsets: Int64[Tensor, " rows_plus_1"]) -> Float64[Tensor, " rows"]:
    """Return the sums of the segments values[offsets[i]:offsets[i + 1]] in float64, or 0 for empty segments.

    Each segment is summed separately, so 1e-12 in one segment is not lost next to 1e6 in another.

    >>> segment_sum(torch.tensor([1.0, 2.0, 4.0]), torch.tensor([0, 2, 2, 3])).tolist()
    [3.0, 0.0, 4.0]
    """
    if values.numel() == 0:
        return torch.zeros(offsets.numel() - 1, dtype=torch.float64, device=values.device)
    if can_use_triton(values):
        from normlift_ns.kernels import sparse  # noqa: PLC0415 (needs triton)

        return sparse.segment_sum(values, offsets)
    return torch.segment_reduce(values.double(), "sum", offsets=offsets, initial=0.0)


@dataclass(frozen=True)
class SparseRows(TensorRecord):
    """A sparse matrix in CSR format.

    Row i holds columns column[offsets[i]:offsets[i + 1]], in ascending order, with their weights.
    """

    offsets: Int64[Tensor, " rows_plus_1"]
    column: Int32[Tensor, " nnz"]
    weight: Float[Tensor, " nnz"]

    @staticmethod
    def from_coo(
        row: Int[Tensor, " m"], column: Int[Tensor, " m"], weight: Float[Tensor, " m"], num_rows: int
    ) -> SparseRows:
        """Build a matrix from entries in any order. Duplicates are summed as in `sum_duplicates`."""
        row, column, weight = sum_duplicates(row, column, weight)
        return SparseRows(row_offsets(row, num_rows), column.int(), weight)

    @staticmethod
    def stack(parts: Sequence[tuple[Tensor, Tensor, Tensor]], num_rows: int, device: torch.device) -> SparseRows:
        """Build a matrix from lists of (row, column, weight), each sorted by row and then by column.

        In every row, the columns of a list must be larger than those of earlier lists.

        On the CPU, nothing is sorted. Each row receives its entries of the first list, then those of the second, and so
        on. On a GPU, a single stable sort of all entries is faster. It is used for up to 2**27 entries.
        """
        dtype = parts[0][2].dtype if parts else torch.float32
        parts = [part for part in parts if part[0].numel() > 0]
        if device.type == "cuda" and len(parts) > 1 and sum(len(part[0]) for part in parts) <= _MAX_SORTED:
            row, column, weight = (torch.cat(x) for x in zip(*parts))
            row, order = row.int().sort(stable=True)
            ends = torch.searchsorted(row, torch.arange(num_rows + 1, dtype=torch.int32, device=device))
            return SparseRows(ends, column.int()[order], weight[order])
        offsets = torch.zeros(num_rows + 1, dtype=torch.int64, device=device)
        for row, _, _ in parts:
            offsets[1:] += torch.bincount(row, minlength=num_rows)
        offsets = offsets.cumsum(0)
        position, size = offsets[:-1].clone(), int(offsets[-1])
        columns = torch.empty(size, dtype=torch.int32, device=device)
        weights = torch.empty(size, dtype=dtype, device=device)
        for row, column, weight in parts:
            count = torch.bincount(row, minlength=num_rows)
            shift = position - (count.cumsum(0) - count)  # index in the matrix minus index in this list
            target = torch.arange(row.numel(), device=device) + shift[row]
            columns[target], weights[target] = column, weight
            position += count
        return SparseRows(offsets, columns, weights)

    @staticmethod
    def add(a: SparseRows, b: SparseRows) -> SparseRows:
        """Return the sum of two matrices of the same shape, in float64."""
        weight = torch.cat([a.weight.double(), b.weight.double()])
        return SparseRows.from_coo(
            torch.cat([a.row_index(), b.row_index()]), torch.cat([a.column, b.column]), weight, len(a)
        )

    def __len__(self) -> int:
        return self.offsets.numel() - 1

    @cached_property
    def num_columns(self) -> int:
        """Smallest number of columns that contains all entries.

        Raises:
            ValueError: If the arrays do not form a valid matrix. Such arrays could cause out-of-bounds memory access.
        """
        size, lengths = self.column.numel(), self.offsets.diff()
        ends = [int(self.offsets[0]), int(self.offsets[-1])] if self.offsets.numel() > 0 else []
        if ends != [0, size] or self.weight.numel() != size or bool((lengths < 0).any()):
            raise InputError(
                f"row offsets must begin with 0, never decrease, and end with the number of columns ({size}) and of "
                f"weights ({self.weight.numel()}), got {short_repr(self.offsets.tolist())}"
            )
        low, high = (int(x) for x in self.column.aminmax()) if size > 0 else (0, -1)
        if low < 0:
            raise InputError(f"columns must be 0 or more, found {low}")
        return high + 1

    def row_index(self) -> Int64[Tensor, " nnz"]:
        """Return the row of every entry."""
        return torch.repeat_interleave(torch.arange(len(self), device=self.offsets.device), self.offsets.diff())

    def row_sums(self) -> Float64[Tensor, " rows"]:
        """Return the sum of the weights of each row, in float64."""
        return segment_sum(self.weight, self.offsets)

    def select_rows(self, rows: Int[Tensor, " m"]) -> SparseRows:
        """Return the given rows in the given order."""
        start, length = self.offsets[:-1][rows], self.offsets.diff()[rows]
        offsets = torch.cat([length.new_zeros(1), length.cumsum(0)])
        entry = torch.arange(int(offsets[-1]), device=offsets.device) + (start - offsets[:-1]).repeat_interleave(length)
        return SparseRows(offsets, self.column[entry], self.weight[entry])

    def select_columns(self, columns: Int64[Tensor, " m"], num_columns: int) -> SparseRows:
        """Return some distinct columns of a matrix with `num_columns` columns, renumbered in the given order."""
        new = torch.full((num_columns,), -1, dtype=torch.int64, device=columns.device)
        new[columns] = torch.arange(columns.numel(), device=columns.device)
        column = new[self.column.long()]
        keep = column >= 0
        return SparseRows.from_coo(self.row_index()[keep], column[keep], self.weight[keep], len(self))

    @staticmethod
    def append_columns(parts: Sequence[SparseRows], first_column: Sequence[int]) -> SparseRows:
        """Join matrices with the same rows along their columns. Columns of parts[i] start at first_column[i]."""
        entries = [(part.row_index(), part.column + first, part.weight) for part, first in zip(parts, first_column)]
        return SparseRows.stack(entries, len(parts[0]), parts[0].weight.device)

    def matmul(self, table: Float[Tensor, "columns d"]) -> Float[Tensor, "rows d"]:
        """Return the dense product of the matrix and a table, in the precision of the table."""
        if self.weight.numel() == 0:
            return table.new_zeros(len(self), table.shape[1])
        if can_use_triton(table) and table.shape[1] <= _MAX_NARROW_COLUMNS:
            from normlift_ns.kernels import sparse  # noqa: PLC0415 (needs triton)

            columns = [sparse.multiply_vector(self.offsets, self.column, self.weight, x.contiguous()) for x in table.T]
            return torch.stack(columns, dim=1)
        if table.device.type == "cpu" and table.shape[1] <= _MAX_NARROW_COLUMNS:  # ten times as fast as embedding_bag
            if self.num_columns > len(table):
                raise InputError(f"the table needs one row per column ({self.num_columns}), got {len(table)}")
            offsets = self.offsets.int() if self.weight.numel() < 2**31 else self.offsets
            arrays = (x.numpy() for x in (self.weight, self.column, offsets))
            from scipy.sparse import csr_array  # noqa: PLC0415 (not needed on a GPU)

            product = csr_array(tuple(arrays), shape=(len(self), len(table))) @ table.detach().numpy()
            return torch.from_numpy(product).to(table.dtype)
        # An embedding bag gathers, scales and adds rows, which is this product. It is threaded on the CPU,
        # deterministic on the GPU, and does not need MKL.
        return embedding_bag(
            self.column.long(),
            table,
            self.offsets,
            mode="sum",
            per_sample_weights=self.weight.to(table.dtype),
            include_last_offset=True,
        )

    def chunks(self, row_size: int) -> Iterator[tuple[int, SparseRows]]:
        """Yield consecutive blocks of rows as (first row, block).

        A dense array with `row_size` elements for each row of a block has at most 2**24 elements, unless a single row
        has more.
        """
        step = max(1, CHUNK_ELEMENTS // max(1, row_size))
        for first in range(0, len(self), step):
            offsets = self.offsets[first : first + step + 1]
            low, high = int(offsets[0]), int(offsets[-1])
            yield first, SparseRows(offsets - low, self.column[low:high], self.weight[low:high])

    def sums_of_unit_rows(self, table: Float[Tensor, "columns d"]) -> Float[Tensor, "rows d"]:
        """Return the product with a table of unit rows, with an accurate direction of every row of the result.

        Sums that nearly cancel and sums of more than `MANY_ENTRIES` rows are recomputed in float64.
        """
        sums = self.matmul(table)
        if table.dtype == torch.float64:
            return sums
        weak = torch.linalg.vector_norm(sums, dim=1) < CANCELLATION_RATIO * self.row_sums()
        weak = (weak | (self.offsets.diff() > MANY_ENTRIES)).nonzero().squeeze(1)
        if weak.numel() > 0:
            rows = self.select_rows(weak)
            used, column = rows.column.unique(return_inverse=True)
            exact = SparseRows(rows.offsets, column.int(), rows.weight).matmul(table[used.long()].double())
            sums[weak] = exact.to(sums.dtype)
        return sums


def sum_duplicates(
    row: Int[Tensor, " m"], column: Int[Tensor, " m"], weight: Float[Tensor, " m"]
) -> tuple[Int[Tensor, " nnz"], Int[Tensor, " nnz"], Float[Tensor, " nnz"]]:
    """Sort entries by (row, column) and sum duplicates in float64. The result is deterministic.

    >>> sum_duplicates(torch.tensor([1, 0, 1]), torch.tensor([5, 7, 5]), torch.tensor([1.0, 2.0, 4.0]))
    (tensor([0, 1]), tensor([7, 5]), tensor([2., 5.]))
    """
    if row.numel() == 0:
        return row, column, weight
    columns = int(column.max()) + 1
    key, summed = sum_equal_keys(row.long() * columns + column, weight)
    row_of = torch.div(key, columns, rounding_mode="floor")
    return row_of.to(row.dtype), (key - row_of * columns).to(column.dtype), summed


def sum_equal_keys(
    key: Int[Tensor, " m"], weight: Float[Tensor, " m"]
) -> tuple[Int[Tensor, " n"], Float[Tensor, " n"]]:
    """Return distinct keys in ascending order, each with its weights summed in float64 in the given order.

    >>> sum_equal_keys(torch.tensor([7, 5, 7]), torch.tensor([1.0, 2.0, 4.0]))
    (tensor([5, 7]), tensor([2., 5.]))
    """
    key, order = key.sort(stable=True)
    weight = weight[order]
    first = run_starts(key)
    if first.numel() == key.numel():
        return key, weight
    summed = segment_sum(weight, torch.cat([first, first.new_tensor([key.numel()])]))
    return key[first], summed.to(weight.dtype)


def run_starts(key: Int[Tensor, " m"]) -> Int64[Tensor, " g"]:
    """Return the indices at which runs of equal keys begin."""
    first = torch.ones_like(key, dtype=torch.bool)
    first[1:] = key[1:] != key[:-1]
    return first.nonzero().squeeze(1)


def row_offsets(row: Int[Tensor, " nnz"], num_rows: int) -> Int64[Tensor, " rows_plus_1"]:
    """Return the CSR offsets of entries with the given row indices.

    >>> row_offsets(torch.tensor([2, 0, 2]), 3).tolist()
    [0, 1, 1, 3]
    """
    counts = torch.bincount(row.long(), minlength=num_rows)
    return torch.cat([counts.new_zeros(1), counts.cumsum(0)])
