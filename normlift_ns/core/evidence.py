"""Evidence E_js: how much weight Gaussian j has in image region s. Independent of any feature, it is all that
rasterizing yields.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Float64, Int, Int32, Int64
from torch import Tensor

from normlift_ns.core.disk.field_file import EVIDENCE_COUNTS, EVIDENCE_FORMAT, EvidenceArrays, read_evidence
from normlift_ns.core.disk.tensors import save_tensors
from normlift_ns.core.sparse import SparseRows, row_offsets, segment_sum
from normlift_ns.errors import InputError

UNLABELED, MASKED = -1, -2
"""Labels of pixels without a region, and of pixels that are no observation at all."""


class Entries(NamedTuple):
    """What a rasterizer finds in one or a few views: distinct places, sorted by (gaussian, column)."""

    gaussian: Int[Tensor, " nnz"]
    column: Int[Tensor, " nnz"]
    """View by view, a column for the unlabelled pixels and then one per region."""
    weight: Float[Tensor, " nnz"]
    num_regions: tuple[int, ...]
    """Of each view."""


@dataclass(frozen=True)
class Evidence:
    """E_js = sum of A_ij over the pixels i of region s, sparse, by Gaussian; unlabelled pixels kept apart by view.

    Columns s number the regions of all views one after the other, like the rows of the feature table. Within a row
    they ascend, so the
    order is the same on every run. Raises ValueError on construction if the arrays do not fit each other.

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
    """E, [N, S]: E_js > 0 of every entry, the sum of A_ij ** weight_power."""
    region_view: Int32[Tensor, " s"]
    """View of every column, non-decreasing."""
    unlabeled: SparseRows
    """[N, views]: weight of Gaussian j in the unlabelled pixels of view v."""
    num_views: int
    """Number of views, those without any region included."""
    weight_power: int = 1
    """1: E sums A_ij (the paper). 2: E sums A_ij ** 2 (SFS's code)."""
    num_excluded: int = 0
    """Gaussians that were not drawn because a parameter was not finite or out of range."""

    def __post_init__(self) -> None:
        offsets, column, weight = self.rows.offsets, self.rows.column, self.rows.weight
        if offsets.numel() < 1 or int(offsets[-1]) != column.numel() or column.numel() != weight.numel():
            raise InputError(
                f"Evidence arrays disagree: offsets end at {offsets[-1:].tolist()}, {column.numel()} columns, "
                f"{weight.numel()} weights"
            )
        if len(self.unlabeled) != self.num_gaussians:
            raise InputError(
                f"Evidence.unlabeled has {len(self.unlabeled)} rows, expected one per Gaussian: {self.num_gaussians}"
            )
        if column.numel() > 0 and not (int(column.min()) >= 0 and int(column.max()) < self.num_regions):
            raise InputError(
                f"Evidence.rows.column must be in 0..{self.num_regions - 1}, found "
                f"{int(column.min())}..{int(column.max())}"
            )
        if self.num_regions > 0 and (
            bool((self.region_view.diff() < 0).any())
            or not 0 <= int(self.region_view[0]) <= int(self.region_view[-1]) < self.num_views
        ):
            raise InputError(f"Evidence.region_view must be non-decreasing in 0..{self.num_views - 1}")

    @property
    def num_gaussians(self) -> int:
        """N, those without evidence included."""
        return len(self.rows)

    @property
    def num_regions(self) -> int:
        """S, the columns: regions of all views, those that show no Gaussian included."""
        return self.region_view.numel()

    @property
    def nnz(self) -> int:
        """Number of entries."""
        return self.rows.weight.numel()

    @staticmethod
    def from_entries(
        parts: Sequence[Entries], num_gaussians: int, *, weight_power: int = 1, num_excluded: int = 0
    ) -> Evidence:
        """Joins the entries of all views, in their order."""
        device = parts[0].weight.device if parts else torch.device("cpu")
        counts = [count for part in parts for count in part.num_regions]
        rows, unlabeled = (_joined_by_sorting if device.type == "cuda" else _joined)(parts, num_gaussians, device)
        region_view = torch.repeat_interleave(torch.arange(len(counts), dtype=torch.int32), torch.tensor(counts).int())
        return Evidence(rows, region_view.to(device), unlabeled, len(counts), weight_power, num_excluded)

    @cached_property
    def view_group_offsets(self) -> Int64[Tensor, " g_plus_1"]:
        """Entry offsets of the (Gaussian, view) groups: entries of a row that share a view stand next to each other."""
        offsets, view = self.rows.offsets, self.region_view[self.rows.column.long()]
        starts = torch.ones(self.nnz, dtype=torch.bool, device=view.device)
        if self.nnz > 0:
            starts[1:] = view[1:] != view[:-1]
            starts[offsets[:-1][offsets.diff() > 0]] = True
        return torch.cat([starts.nonzero().squeeze(1), offsets[-1:]])

    def view_weights(self) -> SparseRows:
        """W_jv: weight of Gaussian j in the labelled pixels of view v, [N, views], one entry per pair with evidence,
        float64.
        """
        groups = self.view_group_offsets
        view = self.region_view[self.rows.column[groups[:-1]].long()]
        return SparseRows(torch.searchsorted(groups, self.rows.offsets), view, segment_sum(self.rows.weight, groups))

    def columns_of(self, views: Sequence[int] | Tensor) -> Int64[Tensor, " columns"]:
        """Columns of the given views, in their order: features[evidence.columns_of(v)] is the table of
        evidence.select_views(v).
        """
        bounds = torch.searchsorted(
            self.region_view, torch.arange(self.num_views + 1, dtype=torch.int32, device=self.region_view.device)
        ).tolist()
        parts = [torch.arange(bounds[v], bounds[v + 1]) for v in self._checked_views(views)]
        return torch.cat([torch.zeros(0, dtype=torch.int64), *parts]).to(self.region_view.device)

    def _checked_views(self, views: Sequence[int] | Tensor) -> list[int]:
        chosen = views.tolist() if isinstance(views, Tensor) else list(views)
        if len(set(chosen)) != len(chosen) or any(not 0 <= v < self.num_views for v in chosen):
            raise InputError(f"views must be distinct and in 0..{self.num_views - 1}, got {chosen}")
        return chosen

    def select_views(self, views: Sequence[int] | Tensor) -> Evidence:
        """The evidence of some views only, renumbered in the given order.

        Raises:
            ValueError: a view that does not exist or is named twice.
        """
        columns = self.columns_of(views)
        chosen = torch.tensor(self._checked_views(views), dtype=torch.int64, device=columns.device)
        rows = self.rows.select_columns(columns, self.num_regions)
        unlabeled = self.unlabeled.select_columns(chosen, self.num_views)
        new_view = torch.full((self.num_views,), -1, dtype=torch.int32, device=columns.device)
        new_view[chosen] = torch.arange(chosen.numel(), dtype=torch.int32, device=columns.device)
        region_view = new_view[self.region_view[columns].long()]
        return replace(self, rows=rows, region_view=region_view, unlabeled=unlabeled, num_views=chosen.numel())

    def select_gaussians(self, gaussians: Int[Tensor, " m"]) -> Evidence:
        """The evidence of some Gaussians only, in the given order."""
        rows, unlabeled = self.rows.select_rows(gaussians), self.unlabeled.select_rows(gaussians)
        return replace(self, rows=rows, unlabeled=unlabeled)

    def regroup(self, columns: Int[Tensor, "levels s"], region_view: Int32[Tensor, " m"]) -> Evidence:
        """The evidence of coarser regions, without rasterizing: E'_jt = sum over levels and the columns s of t of E_js.

        Rasterized on the cells of a partition, evidence becomes that of any regions made of whole cells, exactly but
        for rounding: sums of A_ij ** weight_power add up whatever the power. What maps to -1 joins the unlabelled
        weight of its view. With several levels every pixel is observed once per level, so that W_jv, unlabelled weight
        included, counts it as often; N_eff and R do not change with the scale of W.

        Args:
            columns: the new column of every column, one row per level; -1: none.
            region_view: view of every new column, non-decreasing.
        Raises:
            ValueError: a new column that does not exist, or of another view than its old one.
        """
        if columns.shape[1] != self.num_regions or not bool(((columns >= -1) & (columns < len(region_view))).all()):
            raise InputError(
                f"columns must be [levels, {self.num_regions}] with values in -1..{len(region_view) - 1}, got "
                f"{tuple(columns.shape)}"
            )
        columns, region_view = (x.to(self.region_view.device) for x in (columns.long(), region_view))
        level, column = (columns >= 0).nonzero(as_tuple=True)
        if not torch.equal(region_view[columns[level, column]], self.region_view[column]):
            raise InputError("a new column must be of the same view as the columns that it joins")
        if torch.equal(columns, torch.arange(len(region_view), device=columns.device)[None]):
            return self
        old = self.rows.column.long()
        new = columns[:, old]
        kept = new >= 0
        row, view, weight = (x.expand_as(new) for x in (self.rows.row_index(), self.region_view[old], self.rows.weight))
        rows = SparseRows.from_coo(row[kept], new[kept], weight[kept], self.num_gaussians)
        blank = self.unlabeled
        unlabeled = SparseRows.from_coo(
            torch.cat([blank.row_index(), row[~kept]]),
            torch.cat([blank.column, view[~kept]]),
            torch.cat([blank.weight * len(columns), weight[~kept]]),
            self.num_gaussians,
        )
        return replace(self, rows=rows, region_view=region_view, unlabeled=unlabeled)

    @staticmethod
    def merge(*parts: Evidence) -> Evidence:
        """Appends views and columns in argument order; feature tables concatenate likewise.

        Raises:
            ValueError: no part, or parts of different scenes or weight powers.
        """
        if not parts:
            raise InputError("Evidence.merge needs at least one part")
        for name in ("num_gaussians", "weight_power", "num_excluded"):
            values = [getattr(part, name) for part in parts]
            if len(set(values)) > 1:
                raise InputError(f"Evidence.merge: parts must agree in {name}, found {values}")
        views = torch.tensor([0, *(part.num_views for part in parts)]).cumsum(0).tolist()
        regions = torch.tensor([0, *(part.num_regions for part in parts)]).cumsum(0).tolist()
        rows = SparseRows.append_columns([part.rows for part in parts], regions)
        unlabeled = SparseRows.append_columns([part.unlabeled for part in parts], views)
        region_view = torch.cat([part.region_view + first for part, first in zip(parts, views)])
        return replace(parts[0], rows=rows, region_view=region_view, unlabeled=unlabeled, num_views=views[-1])

    def prune(self, *, relative: float) -> tuple[Evidence, Float64[Tensor, " n"]]:
        """Drops entries below `relative` times the largest entry of their Gaussian, and says what that can cost.

        With d_j the dropped share of W_j, f_j moves by at most 2 d_j for any table of unit features (f' - f = d_j f'
        - dropped / W_j), so
        ||f_j|| by at most as much and the direction by at most 4 d_j / (||f_j|| + ||f'_j||). Unlabelled weight stays.

        Args:
            relative: in 0..1; the largest entry of a Gaussian always stays.
        Returns:
            The smaller evidence, and per Gaussian the bound 2 d_j on |f_j - f'_j|.
        Raises:
            ValueError: `relative` outside 0..1.
        """
        if not 0 <= relative <= 1:
            raise InputError(f"relative must be in 0..1, got {relative}")
        weight, row = self.rows.weight, self.rows.row_index()
        largest = weight.new_zeros(self.num_gaussians).scatter_reduce_(0, row, weight, "amax", include_self=False)
        keep = weight >= relative * largest[row]
        total = self.rows.row_sums()
        dropped = segment_sum(torch.where(keep, 0.0, weight.double()), self.rows.offsets)
        bound = torch.where(total > 0, 2 * dropped / total, 0.0)
        kept = SparseRows(row_offsets(row[keep], self.num_gaussians), self.rows.column[keep], weight[keep])
        return replace(self, rows=kept), bound

    def to(self, device: torch.device | str) -> Evidence:
        """A copy on another device."""
        return replace(
            self,
            rows=self.rows.to(device),
            region_view=self.region_view.to(device),
            unlabeled=self.unlabeled.to(device),
        )

    def save(self, path: str | Path, *, key: str = "", remarks: Mapping[str, str] | None = None) -> str:
        """Writes a safetensors file, complete or not at all, in place of an earlier one; returns its digest.

        Args:
            key: what finds the file again in a cache.
            remarks: what the head of the file says besides, by name.
        Raises:
            OSError: it cannot be written, for instance because the disk is full.
        """
        rows, blank = self.rows, self.unlabeled
        tensors = {"offsets": rows.offsets, "region": rows.column, "weight": rows.weight}
        tensors |= {f"unlabeled_{name}": getattr(blank, name) for name in ("offsets", "column", "weight")}
        tensors["region_view"] = self.region_view
        counts = {name: str(getattr(self, name)) for name in EVIDENCE_COUNTS}
        facts = {**(remarks or {}), "format": EVIDENCE_FORMAT, **counts}
        return save_tensors(Path(path), tensors, facts, key=key, overwrite=True)

    @staticmethod
    def load(path: str | Path, *, key: str = "") -> Evidence:
        """Reads what `save` wrote.

        Args:
            key: as it was given then; a file with a key that has no digest, as version 0.1 wrote it, is refused.
        Raises:
            FileNotFoundError: no such file.
            ValueError: not an evidence file, or a damaged one.
        """
        return Evidence.read(Path(path), key=key)[0]

    @staticmethod
    def read(path: Path, *, key: str = "", remedy: str = "rasterize again") -> tuple[Evidence, str | None]:
        """`load`, with the digest of the file; None for one of version 0.1.

        Args:
            remedy: what to do about a damaged file, for the message.
        """
        found = read_evidence(path, key=key, remedy=remedy)
        try:
            return Evidence.of_arrays(found), found.digest
        except ValueError as error:
            raise InputError(f"{path} is damaged ({error}); {remedy}") from error

    @staticmethod
    def of_arrays(found: EvidenceArrays) -> Evidence:
        """What a file held, without a copy."""
        rows, unlabeled = (SparseRows(*map(torch.from_numpy, part)) for part in (found.rows, found.unlabeled))
        return Evidence(rows, torch.from_numpy(found.region_view), unlabeled, *found.counts)


def _joined(parts: Sequence[Entries], num_gaussians: int, device: torch.device) -> tuple[SparseRows, SparseRows]:
    """Regions and unlabelled pixels of all parts, every entry put straight to its place."""
    labeled, blank = [], []
    first, view = 0, 0
    for part in parts:
        is_region, new = _column_table(part.num_regions, first, view)
        is_region, new = is_region.to(device)[part.column], new.to(device)[part.column]
        for found, keep in ((labeled, is_region), (blank, ~is_region)):
            found.append(tuple(x[keep] for x in (part.gaussian, new, part.weight)))
        first, view = first + sum(part.num_regions), view + len(part.num_regions)
    rows, unlabeled = (SparseRows.stack(found, num_gaussians, device) for found in (labeled, blank))
    return rows, unlabeled


def _joined_by_sorting(
    parts: Sequence[Entries], num_gaussians: int, device: torch.device
) -> tuple[SparseRows, SparseRows]:
    """The same by one stable sort, which suits a GPU: the rows of the regions, and behind them those of the unlabelled
    pixels.
    """
    is_region, new = _column_table([count for part in parts for count in part.num_regions], 0, 0)
    code = torch.where(is_region, new, -1 - new).to(device)  # of a region its number, of the others -1 - view
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
    """Of every column of `Entries`: whether it is a region, and the number of that region, or else of the view."""
    start = torch.tensor([0, *(count + 1 for count in num_regions)]).cumsum(0)
    is_region = torch.ones(int(start[-1]), dtype=torch.bool)
    is_region[start[:-1]] = False
    new = first_region + is_region.cumsum(0) - 1
    new[~is_region] = first_view + torch.arange(len(num_regions))
    return is_region, new.int()
