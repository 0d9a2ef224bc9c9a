"""Evidence E_js: the weight of Gaussian j in image region s.

A lift needs nothing else from the rasterizer. Evidence does not depend on features.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int, Int32, Int64
from torch import Tensor

from normlift_ns.core.arguments import check_arguments, check_rows
from normlift_ns.core.device import TensorRecord
from normlift_ns.core.sparse import SparseRows, row_offsets, segment_sum
from normlift_ns.errors import InputError
from normlift_ns.io.arrays import save_arrays
from normlift_ns.io.field import EVIDENCE_COUNTS, EVIDENCE_FORMAT, EvidenceArrays, read_evidence
from normlift_ns.io.guard import refuse_inputs, refuse_other_kinds
from normlift_ns.options import short_repr

UNLABELED, MASKED = -1, -2
"""Labels of pixels that have no region, and of pixels that do not count as observations."""
WEIGHT_POWERS = (0, 1, 2)
"""Valid exponents of the weights A_ij in evidence. With 0, evidence counts pixels."""


@check_arguments
class Entries(NamedTuple):
    """Nonzero weights from a rasterizer for one or more views, at most one per (gaussian, column), sorted by this
    pair."""

    gaussian: Int[Tensor, " nnz"]
    column: Int[Tensor, " nnz"]
    """Column of every weight. Each view has one column for unlabeled pixels, followed by one per region."""
    weight: Float[Tensor, " nnz"]
    num_regions: tuple[int, ...]
    """Number of regions of each view."""


@check_arguments
@dataclass(frozen=True)
class Evidence(TensorRecord):
    """Sparse matrix E_js of N Gaussians j and S regions s, with the weights of unlabeled pixels.

    E_js is the sum of A_ij ** weight_power over the pixels i of region s. A_ij is the compositing weight of Gaussian j
    in pixel i. Columns s number the regions of all views consecutively, like the rows of the feature table. The columns
    of every row are in ascending order. The constructor raises ValueError if the arrays are inconsistent.

    >>> import torch
    >>> from normlift_ns import Evidence
    >>> from normlift_ns.core.evidence import Entries
    >>> first = Entries(torch.tensor([0, 1]), torch.tensor([1, 2]), torch.tensor([0.5, 2.0]), num_regions=(2,))
    >>> second = Entries(torch.tensor([0, 1]), torch.tensor([1, 0]), torch.tensor([3.0, 1.0]), num_regions=(1,))
    >>> evidence = Evidence.from_entries([first, second], num_gaussians=2)
    >>> evidence.region_view.tolist(), evidence.rows.row_sums().tolist(), evidence.unlabeled.row_sums().tolist()
    ([0, 0, 1], [3.5, 2.0], [0.0, 1.0])
    >>> evidence.select_views([1]).rows.row_sums().tolist()
    [3.0, 0.0]
    """

    rows: SparseRows
    """E, [N, S]. All entries are >= 0."""
    region_view: Int32[Tensor, " s"]
    """Index of the view of every column, in non-decreasing order."""
    unlabeled: SparseRows
    """Weight of Gaussian j in the unlabeled pixels of view v, [N, views]."""
    num_views: int
    """Number of views, including those without regions."""
    weight_power: int = 1
    """Exponent of A_ij in E. The paper uses 1, and the code of Splat Feature Solver uses 2. With 0, E counts pixels."""
    num_excluded: int = 0
    """Number of Gaussians that were not drawn because a parameter was out of range or not finite."""

    def __post_init__(self) -> None:
        offsets, column, weight = self.rows.offsets, self.rows.column, self.rows.weight
        if offsets.numel() < 1 or int(offsets[-1]) != column.numel() or column.numel() != weight.numel():
            end = int(offsets[-1]) if offsets.numel() > 0 else "no offsets"
            raise InputError(
                f"Evidence.rows must have offsets that end with the number of columns ({column.numel()}) and of "
                f"weights ({weight.numel()}), got {end}"
            )
        _check_counts(self)
        if len(self.unlabeled) != self.num_gaussians:
            raise InputError(
                f"the number of rows of Evidence.unlabeled must be {self.num_gaussians}, one per Gaussian, got "
                f"{len(self.unlabeled)}"
            )
        check_rows("Evidence.rows.column", column, self.num_regions)
        if self.num_regions > 0 and (
            bool((self.region_view.diff() < 0).any())
            or not 0 <= int(self.region_view[0]) <= int(self.region_view[-1]) < self.num_views
        ):
            raise InputError(
                f"Evidence.region_view must be non-decreasing, with values >= 0 and below num_views ({self.num_views})"
            )

    @property
    def num_gaussians(self) -> int:
        """N, the number of Gaussians, including those without evidence."""
        return len(self.rows)

    @property
    def num_regions(self) -> int:
        """S, the number of regions of all views, including regions without Gaussians."""
        return self.region_view.numel()

    @property
    def nnz(self) -> int:
        """Number of entries E_js that the matrix stores."""
        return self.rows.weight.numel()

    @staticmethod
    @check_arguments
    def from_entries(
        parts: Sequence[Entries], num_gaussians: int, *, weight_power: int = 1, num_excluded: int = 0
    ) -> Evidence:
        """Build evidence from the entries of all views, in the given order.

        Raises:
            ValueError: If a count or `weight_power` is out of range (`num_gaussians`: 0..2**31 - 1). Also if entries
                are not distinct and sorted, have invalid indices, or have negative or non-finite weights.
        """
        if not 0 <= num_gaussians < 2**31:
            raise InputError(f"num_gaussians must be in 0..2147483647, got {num_gaussians}")
        for i, part in enumerate(parts):
            _check_entries(f"parts[{i}]", part, num_gaussians)
        return Evidence.join(parts, num_gaussians, weight_power=weight_power, num_excluded=num_excluded)

    @staticmethod
    def join(parts: Sequence[Entries], num_gaussians: int, *, weight_power: int, num_excluded: int) -> Evidence:
        """Build evidence like `from_entries`, but without checking the entries."""
        device = parts[0].weight.device if parts else torch.device("cpu")
        counts = [count for part in parts for count in part.num_regions]
        rows, unlabeled = (_join_by_sorting if device.type == "cuda" else _join)(parts, num_gaussians, device)
        region_view = torch.repeat_interleave(torch.arange(len(counts), dtype=torch.int32), torch.tensor(counts).int())
        return Evidence(rows, region_view.to(device), unlabeled, len(counts), weight_power, num_excluded)

    @cached_property
    def view_group_offsets(self) -> Int64[Tensor, " g_plus_1"]:
        """Offsets of the groups of entries that share a Gaussian and a view. Entries of a group are adjacent."""
        offsets, view = self.rows.offsets, self.region_view[self.rows.column.long()]
        starts = torch.ones(self.nnz, dtype=torch.bool, device=view.device)
        if self.nnz > 0:
            starts[1:] = view[1:] != view[:-1]
            starts[offsets[:-1][offsets.diff() > 0]] = True
        return torch.cat([starts.nonzero().squeeze(1), offsets[-1:]])

    def view_weights(self) -> SparseRows:
        """Return W_jv, the weight of Gaussian j in the labeled pixels of view v.

        The result is [N, views] in float64, with one entry per (Gaussian, view) pair that has evidence.
        """
        groups = self.view_group_offsets
        view = self.region_view[self.rows.column[groups[:-1]].long()]
        return SparseRows(torch.searchsorted(groups, self.rows.offsets), view, segment_sum(self.rows.weight, groups))

    @check_arguments
    def columns_of(self, views: Sequence[int] | Int[Tensor, " m"]) -> Int64[Tensor, " columns"]:
        """Return the columns of the given views, in the order of `views`.

        `features[evidence.columns_of(v)]` is the feature table of `evidence.select_views(v)`.

        Raises:
            ValueError: If a view does not exist or occurs twice.
        """
        chosen = views.tolist() if isinstance(views, Tensor) else list(views)
        if len(set(chosen)) != len(chosen) or any(not 0 <= v < self.num_views for v in chosen):
            raise InputError(f"views must be distinct and in 0..{self.num_views - 1}, got {short_repr(chosen)}")
        bounds = row_offsets(self.region_view, self.num_views).tolist()
        parts = [torch.arange(bounds[v], bounds[v + 1]) for v in chosen]
        return torch.cat([torch.zeros(0, dtype=torch.int64), *parts]).to(self.region_view.device)

    @check_arguments
    def select_views(self, views: Sequence[int] | Int[Tensor, " m"]) -> Evidence:
        """Return the evidence of the given views, renumbered in the order of `views`.

        Raises:
            ValueError: If a view does not exist or occurs twice.
        """
        columns = self.columns_of(views)
        chosen = torch.as_tensor(views, dtype=torch.int64, device=columns.device)
        rows = self.rows.select_columns(columns, self.num_regions)
        unlabeled = self.unlabeled.select_columns(chosen, self.num_views)
        new_view = torch.full((self.num_views,), -1, dtype=torch.int32, device=columns.device)
        new_view[chosen] = torch.arange(chosen.numel(), dtype=torch.int32, device=columns.device)
        region_view = new_view[self.region_view[columns].long()]
        return replace(self, rows=rows, region_view=region_view, unlabeled=unlabeled, num_views=chosen.numel())

    @check_arguments
    def select_gaussians(self, gaussians: Int[Tensor, " m"]) -> Evidence:
        """Return the evidence of the given Gaussians, in the order of `gaussians`.

        `num_excluded` is kept, but capped at the number of given Gaussians.

        Raises:
            ValueError: If a Gaussian does not exist.
        """
        check_rows("gaussians", gaussians, self.num_gaussians)
        rows, unlabeled = self.rows.select_rows(gaussians), self.unlabeled.select_rows(gaussians)
        return replace(self, rows=rows, unlabeled=unlabeled, num_excluded=min(self.num_excluded, len(rows)))

    @check_arguments
    def regroup(self, columns: Int[Tensor, "levels s"], region_view: Int32[Tensor, " m"]) -> Evidence:
        """Return the evidence of coarser regions without rasterizing again.

        E'_jt is the sum of E_js over all levels and over the columns s that are merged into t. If the old columns are
        the cells of a partition, the new columns may be any regions that consist of whole cells. The result is exact up
        to rounding, because sums of A_ij ** weight_power are additive for any power. Columns that map to -1 are added
        to the unlabeled weight of their view.

        With several levels, W_jv and the unlabeled weight count every pixel once per level. The effective number of
        views N_eff and the reliability R do not depend on the scale of W.

        Args:
            columns: New column of every old column, or -1 for none, with one row per level.
            region_view: Index of the view of every new column, in non-decreasing order.
        Raises:
            ValueError: If `columns` has the wrong shape, or a new column does not exist or belongs to a different view
                than its old columns.
        """
        if columns.shape[1] != self.num_regions:
            raise InputError(f"columns must have shape [levels, {self.num_regions}], got {tuple(columns.shape)}")
        check_rows("columns", columns, len(region_view), low=-1)
        columns, region_view = (x.to(self.region_view.device) for x in (columns.long(), region_view))
        level, column = (columns >= 0).nonzero(as_tuple=True)
        if not torch.equal(region_view[columns[level, column]], self.region_view[column]):
            raise InputError("a new column must be in the same view as its old columns; check columns and region_view")
        if torch.equal(columns, torch.arange(len(region_view), device=columns.device)[None]):
            return self
        old = self.rows.column.long()
        new = columns[:, old]
        keep = new >= 0
        row, view, weight = (x.expand_as(new) for x in (self.rows.row_index(), self.region_view[old], self.rows.weight))
        rows = SparseRows.from_coo(row[keep], new[keep], weight[keep], self.num_gaussians)
        blank = self.unlabeled
        unlabeled = SparseRows.from_coo(
            torch.cat([blank.row_index(), row[~keep]]),
            torch.cat([blank.column, view[~keep]]),
            torch.cat([blank.weight * len(columns), weight[~keep]]),
            self.num_gaussians,
        )
        return replace(self, rows=rows, region_view=region_view, unlabeled=unlabeled)

    @staticmethod
    @check_arguments
    def merge(*parts: Evidence) -> Evidence:
        """Concatenate the views and columns of all parts in argument order.

        The feature tables must be concatenated in the same order.

        Raises:
            ValueError: If no part is given, or if the parts differ in the weight power or in the number of Gaussians or
                excluded Gaussians.
        """
        if not parts:
            raise InputError("Evidence.merge needs at least one part, got none")
        for name in ("num_gaussians", "weight_power", "num_excluded"):
            values = sorted({getattr(part, name) for part in parts})
            if len(values) > 1:
                raise InputError(f"parts of Evidence.merge must have the same {name}, found {short_repr(values)}")
        views = torch.tensor([0, *(part.num_views for part in parts)]).cumsum(0).tolist()
        regions = torch.tensor([0, *(part.num_regions for part in parts)]).cumsum(0).tolist()
        rows = SparseRows.append_columns([part.rows for part in parts], regions)
        unlabeled = SparseRows.append_columns([part.unlabeled for part in parts], views)
        region_view = torch.cat([part.region_view + first for part, first in zip(parts, views)])
        return replace(parts[0], rows=rows, region_view=region_view, unlabeled=unlabeled, num_views=views[-1])

    @check_arguments
    def save(
        self, path: str | Path, *, key: str = "", remarks: Mapping[str, str] | None = None, own: bool = False
    ) -> str:
        """Write the evidence to a safetensors file atomically, replacing any existing file, and return its digest.

        Args:
            key: Cache key, which is part of the digest.
            remarks: Additional metadata for the file header, by name.
            own: Skip the checks of `io.guard`, for files in a run or cache of this package.
        Raises:
            ValueError: If this would replace an input, a file of a run or data set, or a file of a different type.
            OSError: If the file cannot be written, for instance because the disk is full.
        """
        rows, blank = self.rows, self.unlabeled
        tensors = {"offsets": rows.offsets, "region": rows.column, "weight": rows.weight}
        tensors |= {f"unlabeled_{name}": getattr(blank, name) for name in ("offsets", "column", "weight")}
        tensors["region_view"] = self.region_view
        counts = {name: str(getattr(self, name)) for name in EVIDENCE_COUNTS}
        metadata = {**(remarks or {}), "format": EVIDENCE_FORMAT, **counts}
        if not own:
            refuse_inputs([Path(path)])
            refuse_other_kinds(Path(path), ".safetensors")
        return save_arrays(Path(path), tensors, metadata, key=key, overwrite=True)

    @staticmethod
    @check_arguments
    def load(path: str | Path, *, key: str = "") -> Evidence:
        """Read a file written by `save`.

        Args:
            key: The key passed to `save`. With a key, files of version 0.1 are rejected, because they have no digest.
        Raises:
            FileNotFoundError: If the file does not exist.
            ValueError: If the file is damaged, is not an evidence file, or was saved with another key.
        """
        remedy = "rasterize again"
        arrays = read_evidence(Path(path), key=key, remedy=remedy)
        try:
            return Evidence.of_arrays(arrays)
        except ValueError as error:
            raise InputError(f"{path} is damaged ({error}); {remedy}") from error

    @staticmethod
    def of_arrays(arrays: EvidenceArrays) -> Evidence:
        """Build evidence from the arrays of a file without copying them."""
        rows, unlabeled = (SparseRows(*map(torch.from_numpy, part)) for part in (arrays.rows, arrays.unlabeled))
        return Evidence(rows, torch.from_numpy(arrays.region_view), unlabeled, *arrays.counts)


def check_not_negative(name: str, values: Tensor) -> None:
    """Raise ValueError if a value is negative or not finite.

    The message gives the number of invalid values and the first of them.

    >>> check_not_negative("reliability", torch.tensor([0.0, 1.0]))
    """
    bad = (~((values >= 0) & values.isfinite())).nonzero()
    if len(bad) > 0:
        first = int(bad[0, 0])
        raise InputError(
            f"{len(bad):,} of {values.numel():,} values of {name} {'is' if len(bad) == 1 else 'are'} negative or not "
            f"finite; the first is {name}[{first}] = {float(values[first]):g}"
        )


def _check_counts(evidence: Evidence) -> None:
    if evidence.weight_power not in WEIGHT_POWERS:
        raise InputError(f"weight_power must be 0, 1 or 2, got {evidence.weight_power}")
    if not 0 <= evidence.num_excluded <= evidence.num_gaussians:
        raise InputError(f"num_excluded must be in 0..{evidence.num_gaussians}, got {evidence.num_excluded}")


def _check_entries(name: str, part: Entries, num_gaussians: int) -> None:
    counts = part.num_regions
    if not all(0 <= count < 2**31 for count in counts) or sum(counts) + len(counts) >= 2**31:
        raise InputError(
            f"{name}.num_regions must contain counts >= 0 whose sum plus the number of views is below 2**31, got "
            f"{short_repr(counts)}"
        )
    check_rows(f"{name}.gaussian", part.gaussian, num_gaussians)
    check_rows(f"{name}.column", part.column, sum(counts) + len(counts))
    order = part.gaussian.long() * 2**31 + part.column
    if bool((order.diff() <= 0).any()):
        raise InputError(f"{name} must have distinct entries, sorted by gaussian and column")
    check_not_negative(f"{name}.weight", part.weight)


def _join(parts: Sequence[Entries], num_gaussians: int, device: torch.device) -> tuple[SparseRows, SparseRows]:
    """Join the entries of all parts without sorting, separately for regions and unlabeled pixels."""
    labeled, blank = [], []
    first, view = 0, 0
    for part in parts:
        is_region, new = _column_table(part.num_regions, first, view)
        is_region, new = is_region.to(device)[part.column], new.to(device)[part.column]
        for entries, keep in ((labeled, is_region), (blank, ~is_region)):
            entries.append(tuple(x[keep] for x in (part.gaussian, new, part.weight)))
        first, view = first + sum(part.num_regions), view + len(part.num_regions)
    rows, unlabeled = (SparseRows.stack(entries, num_gaussians, device) for entries in (labeled, blank))
    return rows, unlabeled


def _join_by_sorting(
    parts: Sequence[Entries], num_gaussians: int, device: torch.device
) -> tuple[SparseRows, SparseRows]:
    """Compute the result of `_join` with one stable sort, which is faster on a GPU.

    Entries of unlabeled pixels are sorted after all entries of regions.
    """
    is_region, new = _column_table([count for part in parts for count in part.num_regions], 0, 0)
    code = torch.where(is_region, new, -1 - new).to(device)  # index of the region, or -1 - view
    widths = torch.tensor([0, *(sum(part.num_regions) + len(part.num_regions) for part in parts)]).cumsum(0).tolist()
    column = torch.cat([code[first:][part.column] for part, first in zip(parts, widths)])
    weight = torch.cat([part.weight for part in parts])
    kind = torch.int32 if 2 * num_gaussians < 2**31 else torch.int64
    row = torch.cat([part.gaussian.to(kind) for part in parts])
    row, order = torch.where(column < 0, row + num_gaussians, row).sort(stable=True)
    column, weight = column[order], weight[order]
    offsets = torch.searchsorted(row, torch.arange(2 * num_gaussians + 1, dtype=kind, device=device))
    middle = int(offsets[num_gaussians])
    return (
        SparseRows(offsets[: num_gaussians + 1].clone(), column[:middle], weight[:middle]),
        SparseRows(offsets[num_gaussians:] - middle, -1 - column[middle:], weight[middle:].clone()),
    )


def _column_table(
    num_regions: Sequence[int], first_region: int, first_view: int
) -> tuple[Bool[Tensor, " columns"], Int32[Tensor, " columns"]]:
    """Return a mask of the columns of `Entries` that are regions, and the region or view index of every column."""
    start = torch.tensor([0, *(count + 1 for count in num_regions)]).cumsum(0)
    is_region = torch.ones(int(start[-1]), dtype=torch.bool)
    is_region[start[:-1]] = False
    new = first_region + is_region.cumsum(0) - 1
    new[~is_region] = first_view + torch.arange(len(num_regions))
    return is_region, new.int()
