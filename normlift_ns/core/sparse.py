"""Sparse rows: the one data structure under evidence, per-view weights and unlabelled weights."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property

import torch
from jaxtyping import Float, Float64, Int, Int32, Int64
from torch import Tensor
from torch.nn.functional import embedding_bag

from normlift_ns.core.gpu import kernels_apply
from normlift_ns.errors import InputError

CANCELLED = 1e-3
"""Below this share of its weight a vector sum is recomputed in float64: its float32 digits have cancelled."""
MANY_ENTRIES = 4096
"""Sums of more vectors than this are taken in float64: float32 would lose a digit after the other."""
CHUNK_ELEMENTS = 2**24
"""Of a dense array that is made block by block."""
_FEW_COLUMNS = 32
_FEW_TO_SORT = 2**27
"""Entries that a GPU sorts at once."""


def segment_sum(values: Tensor, offsets: Int64[Tensor, " rows_plus_1"]) -> Float64[Tensor, " rows"]:
    """Sums of consecutive segments values[offsets[i]:offsets[i + 1]], in float64, 0 for empty ones.

    Each segment is added up on its own, so that 1e-12 in one row survives 1e6 in another.

    >>> segment_sum(torch.tensor([1.0, 2.0, 4.0]), torch.tensor([0, 2, 2, 3])).tolist()
    [3.0, 0.0, 4.0]
    """
    if values.numel() == 0:
        return torch.zeros(offsets.numel() - 1, dtype=torch.float64, device=values.device)
    if kernels_apply(values):
        from normlift_ns.kernels import sums  # noqa: PLC0415 (needs triton)

        return sums.segment_sum(values, offsets)
    return torch.segment_reduce(values.double(), "sum", offsets=offsets, initial=0.0)


@dataclass(frozen=True)
class SparseRows:
    """A sparse matrix by rows (CSR): row i holds columns column[offsets[i]:offsets[i + 1]], ascending, with their
    weights.
    """

    offsets: Int64[Tensor, " rows_plus_1"]
    column: Int32[Tensor, " nnz"]
    weight: Float[Tensor, " nnz"]

    @staticmethod
    def from_coo(
        row: Int[Tensor, " m"], column: Int[Tensor, " m"], weight: Float[Tensor, " m"], num_rows: int
    ) -> SparseRows:
        """Sorts entries given in any order; entries of the same place become one. See `sum_duplicates`."""
        row, column, weight = sum_duplicates(row, column, weight)
        return SparseRows(row_offsets(row, num_rows), column.int(), weight)

    @staticmethod
    def stack(parts: Sequence[tuple[Tensor, Tensor, Tensor]], num_rows: int, device: torch.device) -> SparseRows:
        """Joins (row, column, weight) lists, each sorted by row, whose columns follow each other from list to list.

        Nothing is sorted: every entry goes straight to its place, behind those of its row in earlier lists. On a GPU
        one stable sort is faster, while there is memory for it.
        """
        dtype = parts[0][2].dtype if parts else torch.float32
        parts = [part for part in parts if part[0].numel() > 0]
        if device.type == "cuda" and len(parts) > 1 and sum(len(part[0]) for part in parts) < _FEW_TO_SORT:
            row, column, weight = (torch.cat(x) for x in zip(*parts))
            row, order = row.int().sort(stable=True)
            ends = torch.searchsorted(row, torch.arange(num_rows + 1, dtype=torch.int32, device=device))
            return SparseRows(ends, column.int()[order], weight[order])
        offsets = torch.zeros(num_rows + 1, dtype=torch.int64, device=device)
        for row, _, _ in parts:
            offsets[1:] += torch.bincount(row, minlength=num_rows)
        offsets = offsets.cumsum(0)
        place, size = offsets[:-1].clone(), int(offsets[-1])
        columns = torch.empty(size, dtype=torch.int32, device=device)
        weights = torch.empty(size, dtype=dtype, device=device)
        for row, column, weight in parts:
            count = torch.bincount(row, minlength=num_rows)
            behind = place - (count.cumsum(0) - count)  # what to add to the number of an entry in its list
            target = torch.arange(row.numel(), device=device) + behind[row]
            columns[target], weights[target] = column, weight
            place += count
        return SparseRows(offsets, columns, weights)

    @staticmethod
    def add(a: SparseRows, b: SparseRows) -> SparseRows:
        """The sum of two matrices of the same shape, in float64."""
        weight = torch.cat([a.weight.double(), b.weight.double()])
        return SparseRows.from_coo(
            torch.cat([a.row_index(), b.row_index()]), torch.cat([a.column, b.column]), weight, len(a)
        )

    def __len__(self) -> int:
        return self.offsets.numel() - 1

    @cached_property
    def num_columns(self) -> int:
        """Least number of columns that holds all entries.

        Raises:
            ValueError: arrays that are no matrix, and would lead into foreign memory.
        """
        size, lengths = self.column.numel(), self.offsets.diff()
        ends = [int(self.offsets[0]), int(self.offsets[-1])] if self.offsets.numel() > 0 else []
        if ends != [0, size] or self.weight.numel() != size or bool((lengths < 0).any()):
            raise InputError(
                f"offsets of rows must rise from 0 to the number of entries, found {ends} for {size} columns and "
                f"{self.weight.numel()} weights"
            )
        low, high = (int(x) for x in self.column.aminmax()) if size > 0 else (0, -1)
        if low < 0:
            raise InputError(f"columns must be 0 or more, found {low}")
        return high + 1

    def to(self, device: torch.device | str) -> SparseRows:
        """A copy on another device."""
        return SparseRows(self.offsets.to(device), self.column.to(device), self.weight.to(device))

    def row_index(self) -> Int64[Tensor, " nnz"]:
        """The row of every entry."""
        return torch.repeat_interleave(torch.arange(len(self), device=self.offsets.device), self.offsets.diff())

    def row_sums(self) -> Float64[Tensor, " rows"]:
        """Sum of the weights of each row, in float64."""
        return segment_sum(self.weight, self.offsets)

    def select_rows(self, rows: Int[Tensor, " m"]) -> SparseRows:
        """The given rows in the given order."""
        start, length = self.offsets[:-1][rows], self.offsets.diff()[rows]
        offsets = torch.cat([length.new_zeros(1), length.cumsum(0)])
        entry = torch.arange(int(offsets[-1]), device=offsets.device) + torch.repeat_interleave(
            start - offsets[:-1], length
        )
        return SparseRows(offsets, self.column[entry], self.weight[entry])

    def select_columns(self, columns: Int64[Tensor, " m"], num_columns: int) -> SparseRows:
        """The given columns, distinct, of `num_columns`, renumbered in the given order."""
        new = torch.full((num_columns,), -1, dtype=torch.int64, device=columns.device)
        new[columns] = torch.arange(columns.numel(), device=columns.device)
        column = new[self.column.long()]
        keep = column >= 0
        return SparseRows.from_coo(self.row_index()[keep], column[keep], self.weight[keep], len(self))

    @staticmethod
    def append_columns(parts: Sequence[SparseRows], first_column: Sequence[int]) -> SparseRows:
        """Matrices of the same rows side by side; the columns of each start at its `first_column`."""
        entries = [(part.row_index(), part.column + first, part.weight) for part, first in zip(parts, first_column)]
        return SparseRows.stack(entries, len(parts[0]), parts[0].weight.device)

    def matmul(self, table: Float[Tensor, "columns d"]) -> Float[Tensor, "rows d"]:
        """Dense product with a table, in the table's precision; all rows at once."""
        if self.weight.numel() == 0:
            return table.new_zeros(len(self), table.shape[1])
        if kernels_apply(table) and table.shape[1] <= _FEW_COLUMNS:
            from normlift_ns.kernels import sums  # noqa: PLC0415 (needs triton)

            columns = [sums.product(self.offsets, self.column, self.weight, x.contiguous()) for x in table.T]
            return torch.stack(columns, dim=1)
        if table.device.type == "cpu" and table.shape[1] <= _FEW_COLUMNS:  # ten times as fast as a bag of one column
            if self.num_columns > len(table):
                raise InputError(f"a matrix with {self.num_columns} columns needs as many rows, got {len(table)}")
            offsets = self.offsets.int() if self.weight.numel() < 2**31 else self.offsets
            arrays = (x.numpy() for x in (self.weight, self.column, offsets))
            from scipy.sparse import csr_array  # noqa: PLC0415 (a GPU does without)

            product = csr_array(tuple(arrays), shape=(len(self), len(table))) @ table.numpy()
            return torch.from_numpy(product).to(table.dtype)
        # An embedding bag is exactly this product: gather rows, scale, add. It is threaded on CPU, deterministic on
        # GPU, and needs no MKL.
        return embedding_bag(
            self.column.long(),
            table,
            self.offsets,
            mode="sum",
            per_sample_weights=self.weight.to(table.dtype),
            include_last_offset=True,
        )

    def chunks(self, row_size: int) -> Iterator[tuple[int, SparseRows]]:
        """Consecutive blocks of rows, (first row, block), small enough that block rows x row_size stays near 2**24
        elements.
        """
        step = max(1, CHUNK_ELEMENTS // max(1, row_size))
        for first in range(0, len(self), step):
            offsets = self.offsets[first : first + step + 1]
            low, high = int(offsets[0]), int(offsets[-1])
            yield first, SparseRows(offsets - low, self.column[low:high], self.weight[low:high])

    def sums_of_unit_rows(self, table: Float[Tensor, "columns d"]) -> Float[Tensor, "rows d"]:
        """`matmul` with a table of unit rows; sums that nearly cancel, and those of very many rows, are recomputed in
        float64, so that their direction is right.
        """
        sums = self.matmul(table)
        if table.dtype == torch.float64:
            return sums
        weak = torch.linalg.vector_norm(sums, dim=1) < CANCELLED * self.row_sums()
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
    """Entries sorted by (row, column), those of the same place added up in float64: the same result on every run.

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
    """Distinct keys in ascending order, each with the sum of its weights, added up in float64 in the order given.

    >>> sum_equal_keys(torch.tensor([7, 5, 7]), torch.tensor([1.0, 2.0, 4.0]))
    (tensor([5, 7]), tensor([2., 5.]))
    """
    key, order = key.sort(stable=True)
    weight = weight[order]
    starts = torch.ones_like(key, dtype=torch.bool)
    starts[1:] = key[1:] != key[:-1]
    first = starts.nonzero().squeeze(1)
    if first.numel() == key.numel():
        return key, weight
    summed = segment_sum(weight, torch.cat([first, first.new_tensor([key.numel()])]))
    return key[first], summed.to(weight.dtype)


def row_offsets(row: Int[Tensor, " nnz"], num_rows: int) -> Int64[Tensor, " rows_plus_1"]:
    """CSR offsets of entries with the given row numbers.

    >>> row_offsets(torch.tensor([2, 0, 2]), 3).tolist()
    [0, 1, 1, 3]
    """
    counts = torch.bincount(row.long(), minlength=num_rows)
    return torch.cat([counts.new_zeros(1), counts.cumsum(0)])
