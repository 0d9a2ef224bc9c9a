"""Consensus of regions across views, computed before the lift.

An error in a 2D feature affects its whole region in one view, so neighboring Gaussians have the same error. Regions of
other views that cover these Gaussians usually do not have it. The consensus therefore moves each feature toward those
of overlapping regions in other views. Let E be the evidence and F_s the feature of region s. Let W_jv(s) be the weight
of Gaussian j in the view of s, including pixels without a region. Let t be a region of another view v. Sums over j run
over the Gaussians that are visible in both views::

    p_js = E_js / W_jv(s)                                        share of the weight of j in s, 0 if below 0.02
    c_st = sum_j p_js p_jt / sum_j p_js                          share of s that lies in t
    J_st = 1 / (1 / c_st + 1 / c_ts - 1)                         soft intersection over union, symmetric, in 0..1
    B    = sum_sv a_sv max_{t in v} J_st / sum_sv a_sv           weighted mean of the best overlaps
    F'_s = normalize(F_s + b(B) sum_t J_st c_ts ** q F_t)        b: 0 up to B = 0.4, then linear, 1 from B = 0.5

W_jv(s) includes pixels without a region, because masks have inaccurate borders. Otherwise, an object without a mask in
some view would appear to lie in the masks of adjacent objects. The part of s that lies in regions of view v is
a_sv = sum_j p_js sum_{t in v} p_jt.

The factor c_ts limits the influence of a region t that covers several objects. B distinguishes masks of objects from
cells of an arbitrary partition, for which the consensus would only average neighboring cells. For example, a square of
a grid and its best match in a randomly shifted grid share 9/16 of their area on average. This corresponds to J = 0.39.

Directions come from the lift of F', but the reliability R comes from the lift of F (see `with_original_reliability`).
The R of F measures the agreement of the regions before the consensus. It predicts the accuracy of F' better than the R
of F' does.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import NamedTuple

import torch
from jaxtyping import Float, Float64, Int, Int64
from torch import Tensor

from normlift_ns.core.arguments import check_arguments
from normlift_ns.core.device import can_use_triton
from normlift_ns.core.evidence import Evidence
from normlift_ns.core.lift import Scalars, check_unit_rows
from normlift_ns.core.partition import Partition
from normlift_ns.core.sparse import SparseRows, row_offsets, run_starts, segment_sum
from normlift_ns.errors import InputError

MIN_OVERLAP = 0.1
"""Smallest overlap that counts, both one-sided (c) and symmetric (J). Smaller overlaps are set to 0."""
MIN_VISIBILITY = 0.5
"""Smallest weight of a visible Gaussian, as a share of the median weight of the Gaussians in the same view."""
CHANCE_AGREEMENT, AGREEMENT_RAMP = 0.4, 0.1
"""Largest B of regions that overlap by chance, and the additional increase of B over which b(B) rises to 1."""
MIN_SHARE = 0.02
"""Smallest p_js that counts. Smaller shares are set to 0."""
SAMPLING_SEED = 0
"""Seed of the pseudo-random numbers of `hash_to_unit`."""
_MEDIAN_SAMPLE = 2**16
"""Approximate number of weights in the sample for medians."""
_MAX_PRODUCTS, _MAX_DENSE = 2**25, 2**26
"""Largest number of products of entries (CPU) and of elements of a dense block (GPU) in memory at a time."""


class Overlaps(NamedTuple):
    """Overlaps between regions of different views at one level."""

    iou: SparseRows
    """J, the soft intersection over union of regions in different views, as a symmetric [S, S] matrix. Values below
    `MIN_OVERLAP` are left out."""
    inside: Float[Tensor, " nnz"]
    """c_ts of every entry (s, t) of `iou`, the share of region t that lies in region s."""
    agreement: float
    """B, the weighted mean of the best overlaps of all regions, in 0..1."""


@check_arguments
class Consensus(NamedTuple):
    """Feature table after the consensus, with statistics.

    >>> import torch
    >>> from normlift_ns import Evidence, consensus
    >>> from normlift_ns.core.evidence import Entries
    >>> entries = Entries(torch.tensor([0, 0]), torch.tensor([1, 3]), torch.ones(2), num_regions=(1, 1))
    >>> evidence = Evidence.from_entries([entries], num_gaussians=1)  # two views of one Gaussian
    >>> result = consensus(evidence, torch.eye(2))
    >>> result.features[0], result.agreement, result.gaussians
    (tensor([0.7071, 0.7071]), [1.0], 1)
    """

    features: Float[Tensor, "s d"]
    """F', the features after the consensus, as unit rows. Zero rows of the input stay zero."""
    agreement: list[float]
    """B of every level, in ascending order of the levels. B is the weighted mean of the best overlaps, in 0..1."""
    gaussians: int
    """Number of sampled Gaussians."""


@check_arguments
def consensus(
    evidence: Evidence,
    features: Float[Tensor, "s d"],
    *,
    level: Int[Tensor, " s"] | None = None,
    power: float = 1.0,
    sample: int = 50,
    least: float = CHANCE_AGREEMENT,
) -> Consensus:
    """Compute F', the features of all regions after the consensus, with the formulas at the top of this module.

    Args:
        features: F, unit or zero rows, one per column of the evidence.
        level: Level of every region (default: the same for all). Regions of different levels are not compared.
        power: q, the exponent of c_ts, >= 0.
        sample: Minimum number of Gaussians to sample in each region, >= 1. Regions with fewer use all of them.
        least: Largest B that regions reach by chance, in 0..1. Up to this B, regions keep their features.
    Raises:
        ValueError: If `features` or `level` has the wrong length, a feature is neither a unit vector nor 0, or another
            argument is out of range.

    >>> import torch
    >>> from normlift_ns import Evidence, consensus
    >>> from normlift_ns.core.evidence import Entries
    >>> entries = Entries(torch.tensor([0, 0, 0]), torch.tensor([1, 3, 5]), torch.ones(3), num_regions=(1, 1, 1))
    >>> evidence = Evidence.from_entries([entries], num_gaussians=1)  # three views, each with one region
    >>> consensus(evidence, torch.tensor([[0.6, 0.8], [0.6, -0.8], [0.6, 0.8]])).features[1]
    tensor([0.9138, 0.4061])
    """
    check_consensus_inputs(evidence.num_regions, features, level)
    _check_numbers(power, sample, least)
    chosen, probability = sample_gaussians(evidence.rows, evidence.num_regions, sample)
    return sampled_consensus(
        evidence.select_gaussians(chosen), probability, features, level=level, power=power, least=least
    )


def check_consensus_inputs(size: int, features: Tensor, level: Tensor | None) -> None:
    """Raise ValueError if the features or levels are invalid, or do not have one row per region of the evidence."""
    for name, length in (("features", len(features)), ("level", size if level is None else len(level))):
        if length != size:
            raise InputError(f"{name} must have one row per region of the evidence ({size:,}), got {length:,}")
    if level is not None and bool((level < 0).any()):
        raise InputError(f"level must contain whole numbers >= 0, got {int(level.min())}")
    check_unit_rows(
        features, "feature rows", "give rows of length 1, or of zeros for regions without a feature", allow_zeros=True
    )


def _check_numbers(power: float, sample: int, least: float) -> None:
    if not 0 <= power < float("inf"):
        raise InputError(f"power must be >= 0 and finite, got {power!r}")
    if not 1 <= sample < 2**31:
        raise InputError(f"sample must be a whole number in 1..2147483647, got {sample!r}")
    if not 0 <= least <= 1:
        raise InputError(f"least must be a number in 0..1, got {least!r}")


def sampled_consensus(
    sampled: Evidence,
    probability: Float64[Tensor, " m"],
    features: Float[Tensor, "s d"],
    *,
    level: Int[Tensor, " s"] | None = None,
    power: float = 1.0,
    least: float = CHANCE_AGREEMENT,
) -> Consensus:
    """Compute the consensus from the evidence of sampled Gaussians.

    Args:
        sampled: Evidence of the Gaussians from `sample_gaussians`.
        probability: Sampling probability of each row.
        features, level, power, least: As in `consensus`.
    """
    rows, size, device = sampled.rows, sampled.num_regions, sampled.rows.weight.device
    level = torch.zeros(size, dtype=torch.int64) if level is None else level
    out, agreement = features.to(device, copy=True), []
    levels = level.unique().tolist()
    total = total_view_weights(sampled, max(1, len(levels)))
    for number in levels:
        columns = (level == number).nonzero().squeeze(1).to(device)
        part = rows if len(columns) == size else rows.select_columns(columns, size)
        overlaps = region_overlaps(part, sampled.region_view[columns], probability, total)
        out[columns] = apply_consensus(out[columns], overlaps, power, least)
        agreement.append(overlaps.agreement)
    return Consensus(out, agreement, len(probability))


def with_original_reliability(scalars: Scalars, original: Scalars) -> Scalars:
    """Return `scalars` with the reliability R of `original`, or R = 0 for Gaussians without a direction in `scalars`.

    Args:
        scalars: Scalars of the lift of F', the features after the consensus.
        original: Scalars of the lift of F, the features before the consensus.
    """
    return replace(scalars, reliability=torch.where(scalars.norm > 0, original.reliability, 0.0))


def apply_consensus(
    features: Float[Tensor, "s d"], overlaps: Overlaps, power: float = 1.0, least: float = CHANCE_AGREEMENT
) -> Float[Tensor, "s d"]:
    """Return F', the features of the regions of one level after the consensus.

    All regions keep their features if the agreement B is at most `least`. A region also keeps its feature if the
    feature is zero, the region has no overlaps, or the weighted sum nearly vanishes.
    """
    strength = min(1.0, max(0.0, (overlaps.agreement - least) / AGREEMENT_RAMP))
    if strength == 0 or overlaps.iou.weight.numel() == 0:
        return features
    table = features.to(torch.promote_types(features.dtype, torch.float32))
    weight = strength * overlaps.iou.weight * overlaps.inside**power
    others = SparseRows(overlaps.iou.offsets, overlaps.iou.column, weight.to(table.dtype)).matmul(table)
    total = table + others
    length = torch.linalg.vector_norm(total, dim=1, keepdim=True)
    alone = (overlaps.iou.offsets.diff() == 0)[:, None] | (table == 0).all(dim=1, keepdim=True) | (length < 1e-6)
    return torch.where(alone, features, (total / length).to(features.dtype))


def sample_gaussians(
    rows: SparseRows, num_columns: int, least: int, portion: Partition | None = None
) -> tuple[Int64[Tensor, " m"], Float64[Tensor, " m"]]:
    """Sample Gaussians until every region has at least `least` of them, or all of its Gaussians.

    Each Gaussian has a pseudo-random number in [0, 1) that depends only on its index. A region samples those of
    its Gaussians whose numbers are below a limit, and doubles the limit until the sample is large enough. Sums over the
    sample estimate sums over all Gaussians if every term is divided by the sampling probability of its Gaussian.

    Args:
        portion: Partition of the Gaussians, if several processes lift the scene. `rows` then covers the Gaussians of
            this process, and counts include all processes.
    Returns:
        Indices of the sampled rows, and the sampling probability of each.
    """

    def count_entries(entries: SparseRows) -> Int64[Tensor, " columns"]:
        counts = torch.bincount(entries.column, minlength=num_columns)
        return counts if portion is None else portion.communicator.all_reduce(counts)

    count = count_entries(rows)
    share = ((least + 3 * least**0.5) / count.double().clamp(min=1)).clamp(max=1)
    index = torch.arange(len(rows), device=rows.offsets.device) if portion is None else portion.indices
    number = hash_to_unit(index)
    while True:
        probability = _largest_share(rows, share)
        chosen = (number < probability).nonzero().squeeze(1)
        sampled = count_entries(rows.select_rows(chosen))
        lacking = sampled < count.clamp(max=least)
        if not bool(lacking.any()):
            return chosen, probability[chosen]
        share = torch.where(lacking, (2 * share).clamp(max=1), share)


def total_view_weights(evidence: Evidence, levels: int = 1) -> SparseRows:
    """Return W_jv, the weight of every Gaussian in every view, [M, views]. Pixels without a region count too.

    Args:
        levels: Number of levels. Weights are divided by it, because the evidence counts every pixel once per level.
    """
    total = SparseRows.add(evidence.view_weights(), evidence.unlabeled)
    return replace(total, weight=total.weight / levels)


def region_overlaps(
    rows: SparseRows,
    region_view: Int[Tensor, " s"],
    probability: Float64[Tensor, " m"] | None = None,
    total: SparseRows | None = None,
) -> Overlaps:
    """Compute the overlaps of all regions of one level from the evidence of some Gaussians.

    Args:
        rows: E, [M, S].
        region_view: Index of the view of every column, in non-decreasing order.
        probability: Sampling probability of every row (default: 1, for rows that are not a sample).
        total: W_jv, [M, views], including pixels without a region (default: the weights in `rows`, as if all
            pixels had a region).
    """
    size, view = len(region_view), region_view.long()
    last = [x.max() for x in (view, *(() if total is None else (total.column,))) if len(x) > 0]
    views = int(max(last)) + 1 if size > 0 else 0
    shares, visible, labeled = _shares(rows, view, views, probability, total)
    area = torch.zeros(size, views, dtype=rows.weight.dtype, device=view.device)  # sum_j p_js over visible Gaussians
    in_regions = torch.zeros_like(area)  # a_sv
    parts, first = [(view[:0], view[:0], area.new_zeros(0, dtype=torch.float64))], 0
    for block_area, block_in_regions, *pairs in _inner_products(shares, visible, labeled, view, views):
        last = first + len(block_area)
        area[first:last], in_regions[first:last] = block_area, block_in_regions
        parts.append((pairs[0], pairs[1], pairs[2]))
        first = last
    row, column, inner = (torch.cat(x) for x in zip(*parts))
    c, inside = inner / area[row, view[column]], inner / area[column, view[row]]
    iou = (1 / (1 / c + 1 / inside - 1)).clamp(max=1)
    keep = (iou >= MIN_OVERLAP).nonzero().squeeze(1)
    keep = keep[(row[keep] * size + column[keep]).argsort()]
    row, column, iou, inside = row[keep], column[keep], iou[keep], inside[keep].clamp(max=1)
    starts = run_starts(row * views + view[column])
    best = torch.segment_reduce(iou, "max", offsets=torch.cat([starts, starts.new_tensor([len(row)])]), initial=0.0)
    overlap = (best * in_regions[row[starts], view[column[starts]]]).sum()
    possible = in_regions.sum(dtype=torch.float64) - in_regions.gather(1, view[:, None]).sum(dtype=torch.float64)
    agreement = float(overlap / possible) if len(row) > 0 else 0.0
    return Overlaps(SparseRows(row_offsets(row, size), column.int(), iou), inside, agreement)


def hash_to_unit(index: Int64[Tensor, " n"]) -> Float64[Tensor, " n"]:
    """Return a pseudo-random number in [0, 1) for every index, computed with the finalizer of MurmurHash3."""
    x = index + SAMPLING_SEED
    for shift, factor in ((16, 0x85EBCA6B), (13, 0xC2B2AE35)):
        x = ((x ^ (x >> shift)) * factor) & 0xFFFFFFFF
    return (x ^ (x >> 16)).double() / 2**32


def _largest_share(rows: SparseRows, share: Float64[Tensor, " s"]) -> Float64[Tensor, " n"]:
    """Return the largest value of `share` over the columns that occur in each row, or 0 for an empty row."""
    if can_use_triton(share):
        from normlift_ns.kernels.sparse import row_max  # noqa: PLC0415 (needs triton)

        return row_max(rows.offsets, rows.column, share)
    return torch.segment_reduce(share[rows.column.long()], "max", offsets=rows.offsets, initial=0.0)


def _shares(
    rows: SparseRows,
    view: Int64[Tensor, " s"],
    views: int,
    probability: Float64[Tensor, " m"] | None,
    total: SparseRows | None,
) -> tuple[SparseRows, SparseRows, SparseRows]:
    """Return the shares of Gaussians in regions, and the views in which they are visible.

    All values are divided by the square root of the Gaussian's sampling probability. Sums of products of two values
    therefore estimate the sums over all Gaussians.

    Returns:
        The shares p_js of visible Gaussians [M, S]; a matrix with 1 for every view in which a Gaussian is
        visible [M, views]; and the sums of p_js over the regions of every view [M, views].
    """
    group_of_entry, group_row, group_view, weight = _group_by_view(rows, view, views)
    if total is None:
        total = SparseRows(row_offsets(group_row, len(rows)), group_view.int(), weight)
    all_row, all_view = total.row_index(), total.column.long()
    entry = torch.searchsorted(all_row * views + all_view, group_row * views + group_view)
    total_weight = total.weight.double().index_put((entry,), torch.maximum(total.weight.double()[entry], weight))
    step = max(1, len(total_weight) // _MEDIAN_SAMPLE)
    smallest = MIN_VISIBILITY * _medians(total_weight[::step], all_view[::step], views)
    seen = (total_weight > 0) & (total_weight >= smallest[all_view])
    share = rows.weight.double() / total_weight[entry][group_of_entry]
    keep = seen[entry][group_of_entry] & (share >= MIN_SHARE)
    row = rows.row_index()[keep]
    scale = total_weight.new_ones(len(rows)) if probability is None else probability.rsqrt()
    shares = SparseRows(row_offsets(row, len(rows)), rows.column[keep], share[keep] * scale[row])
    visible = SparseRows(row_offsets(all_row[seen], len(rows)), all_view[seen].int(), scale[all_row[seen]])
    _, group_row, group_view, weight = _group_by_view(shares, view, views)
    return shares, visible, SparseRows(row_offsets(group_row, len(rows)), group_view.int(), weight)


def _group_by_view(
    rows: SparseRows, view: Int64[Tensor, " s"], views: int
) -> tuple[Int64[Tensor, " nnz"], Int64[Tensor, " g"], Int64[Tensor, " g"], Float64[Tensor, " g"]]:
    """Group the entries of each row by view.

    Returns:
        The group of every entry, and the row, view and weight of every group.
    """
    row, column_view = rows.row_index(), view[rows.column.long()]
    starts = run_starts(row * views + column_view)
    ends = torch.cat([starts, starts.new_tensor([len(row)])])
    group_of_entry = torch.repeat_interleave(torch.arange(len(starts), device=row.device), ends.diff())
    return group_of_entry, row[starts], column_view[starts], segment_sum(rows.weight, ends)


def _medians(values: Float64[Tensor, " m"], group: Int64[Tensor, " m"], groups: int) -> Float64[Tensor, " groups"]:
    """Return the lower median of every group, or 0 for an empty group."""
    order = values.argsort(stable=True)
    order = order[group[order].argsort(stable=True)]
    offsets = row_offsets(group, groups)
    nonempty = offsets.diff() > 0
    middle = offsets[:-1] + (offsets.diff() - 1).clamp(min=0) // 2
    out = values.new_zeros(groups)
    out[nonempty] = values[order[middle[nonempty]]]
    return out


_Block = tuple[Tensor, Tensor, Tensor, Tensor, Tensor]
"""Sums for a block of regions s. The first tensor, [regions, views], is the sum of p_js over the Gaussians that are
visible in each view, and the second is a_sv. The others are s, t and sum_j p_js p_jt for regions t of other views with
c_st >= `MIN_OVERLAP`."""


def _inner_products(
    shares: SparseRows, visible: SparseRows, labeled: SparseRows, view: Int64[Tensor, " s"], views: int
) -> Iterator[_Block]:
    """Yield the sums of `_Block` for all regions, one block at a time."""
    order = shares.column.argsort(stable=True)
    row, weight = shares.row_index()[order].int(), shares.weight[order]
    by_region = SparseRows(row_offsets(shares.column, len(view)), row, weight)  # the transpose
    if can_use_triton(view):
        from normlift_ns.kernels.sparse import multiply_rows  # noqa: PLC0415 (needs triton)

        step = max(1, _MAX_DENSE // max(1, len(view)))
        for first in range(0, len(view), step):
            last = min(len(view), first + step)
            area, in_regions = (multiply_rows(by_region, x, views, first, last) for x in (visible, labeled))
            inner = multiply_rows(by_region, shares, len(view), first, last)
            near = (inner >= (MIN_OVERLAP * area)[:, view]) & (inner > 0) & (view[first:last, None] != view)
            row, column = near.nonzero(as_tuple=True)
            yield area, in_regions, row + first, column, inner[row, column].double()
    else:
        by_region, shares, visible = (x.to("cpu") for x in (by_region, shares, visible))
        for block in _sparse_blocks(by_region, shares, visible, view.cpu(), views):
            yield tuple(x.to(view.device) for x in block)  # pyrefly: ignore[invalid-yield]


def _sparse_blocks(
    by_region: SparseRows, shares: SparseRows, visible: SparseRows, view: Tensor, views: int
) -> Iterator[_Block]:
    from scipy.sparse import csr_array  # noqa: PLC0415 (not needed on a GPU)

    shares_csr, visible_csr = (
        csr_array(tuple(a.numpy() for a in (x.weight, x.column, x.offsets.int())), shape=(len(x), width))
        for x, width in ((shares, len(view)), (visible, views))
    )
    pairs = segment_sum(shares.offsets.diff()[by_region.column.long()].double(), by_region.offsets).cumsum(0)
    first = 0
    while first < len(view):
        before = pairs[first - 1] if first > 0 else 0.0
        last = max(first + 1, int(torch.searchsorted(pairs, before + _MAX_PRODUCTS, right=True)))
        low, high = int(by_region.offsets[first]), int(by_region.offsets[last])
        offsets = (by_region.offsets[first : last + 1] - low).int()
        arrays = (by_region.weight[low:high].numpy(), by_region.column[low:high].numpy(), offsets.numpy())
        block = csr_array(arrays, shape=(last - first, len(shares)))
        inner, area = csr_array(block @ shares_csr), torch.from_numpy(csr_array(block @ visible_csr).toarray())
        row = torch.repeat_interleave(torch.arange(last - first), torch.from_numpy(inner.indptr).long().diff())
        column, value = torch.from_numpy(inner.indices), torch.from_numpy(inner.data)
        key = row * views + view[column]  # the part of s in a view's regions is the sum over those regions
        in_regions = torch.bincount(key, weights=value, minlength=(last - first) * views)
        own = torch.arange(last - first) * views + view[first:last]
        smallest = MIN_OVERLAP * area.flatten()
        smallest[own] = torch.inf
        keep = (value >= smallest[key]).nonzero().squeeze(1)
        yield area, in_regions.view(-1, views), row[keep] + first, column[keep].long(), value[keep]
        first = last
