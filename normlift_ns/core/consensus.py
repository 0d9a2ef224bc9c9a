"""Consensus of regions across views, before the lift: what other views' regions of the same thing agree on.

A mistake of a 2D feature is shared by its whole region in one view, so that neighbours in space repeat it. Regions of
other views that hold the same Gaussians do not. With E the evidence, W_jv(s) the weight of Gaussian j in the view of
region s, in pixels without a region too, and sums over the Gaussians that both views see::

    p_js = E_js / W_jv(s)                                        share of j that lies in s, 0 where below 0.02
    c_st = sum_j p_js p_jt / sum_j p_js                          share of s that lies in t
    J_st = 1 / (1 / c_st + 1 / c_ts - 1)                         soft intersection over union, symmetric, in 0..1
    B    = sum_sv a_sv max_{t in v} J_st / sum_sv a_sv           what best overlaps come to
    F'_s = normalise(F_s + b(B) sum_t J_st c_ts ** q F_t)        b: 0 up to B = 0.4, 1 from there plus 0.1

Pixels without a region count because a thing that a view has no mask of would else seem to lie in the masks of its
neighbours, whose frayed borders reach it. a_sv = sum_j p_js sum_{t in v} p_jt is what of s lies in regions of v.

The factor c_ts keeps a region that covers several things from speaking for each of them. B tells regions of things
from cells of an arbitrary partition, whose overlaps average neighbours: two squares of the same size that lie at
random have 9/16 in common at best, which is J = 0.39.

Directions are those of the lift of F'. R stays that of the lift of F (`seen_reliability`): it knows where regions
disagreed before they were made to agree, and so ranks the answers of F' better than R of F' does.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import NamedTuple

import torch
from jaxtyping import Float, Float64, Int, Int64
from torch import Tensor

from normlift_ns.core.checks import check_tensors, check_unit_rows
from normlift_ns.core.evidence import Evidence
from normlift_ns.core.gpu import kernels_apply
from normlift_ns.core.lift import Scalars
from normlift_ns.core.portions import ALONE, Portion, Team, join_sparse
from normlift_ns.core.sparse import SparseRows, row_offsets, segment_sum
from normlift_ns.errors import InputError

LEAST = 0.1
"""Overlaps below this, one-sided or J, count as none."""
SEEN = 0.5
"""A view sees a Gaussian whose weight in it is at least this share of the median over those that its regions hold."""
CHANCE, RISE = 0.4, 0.1
"""B of regions that overlap by chance; so much above it, all regions are those of things."""
FAINT = 0.02
"""Regions with a smaller share of a Gaussian's weight in their view do not count."""
SEED = 0
"""Of the order in which Gaussians are sampled."""
_MEDIAN = 2**16
"""Weights of which medians are taken, about."""
_PAIRS, _DENSE = 2**25, 2**26
"""Products of entries on a CPU, and elements of a dense block on a GPU, that are held at a time."""


class Overlaps(NamedTuple):
    """Regions of different views that hold the same Gaussians, of one level."""

    iou: SparseRows
    """J, [S, S], symmetric, without its diagonal."""
    inside: Float[Tensor, " nnz"]
    """c_ts of every entry (s, t): the share of t that lies in s."""
    agreement: float
    """B, in 0..1."""


class Consensus(NamedTuple):
    """A feature table on which the views agree, and how it came about.

    >>> import torch
    >>> from normlift_ns import Evidence, consensus
    >>> from normlift_ns.core.evidence import Entries
    >>> seen = Entries(torch.tensor([0, 0]), torch.tensor([1, 3]), torch.ones(2), num_regions=(1, 1))
    >>> found = consensus(Evidence.from_entries([seen], num_gaussians=1), torch.eye(2))  # two views of one Gaussian
    >>> found.features[0], found.agreement, found.gaussians
    (tensor([0.7071, 0.7071]), [1.0], 1)
    """

    features: Float[Tensor, "s d"]
    """F': unit rows, 0 where F is."""
    agreement: list[float]
    """B of every level."""
    gaussians: int
    """How many were looked at."""


def consensus(
    evidence: Evidence,
    features: Float[Tensor, "s d"],
    *,
    level: Int[Tensor, " s"] | None = None,
    power: float = 1.0,
    sample: int = 50,
    least: float = CHANCE,
    portion: Portion | None = None,
) -> Consensus:
    """F' of every region; formulas at the top of this file.

    Args:
        features: unit rows or 0, one per column of the evidence.
        level: of every region; regions of different levels are not compared. None: all are of one.
        power: q, the exponent of c_ts, >= 0.
        sample: Gaussians that every region has at least, or all that it has; >= 1.
        least: B up to which regions overlap by chance and keep their features, in 0..1.
        portion: which Gaussians the evidence is of, where others of the team have the rest; None: all there are.
    Raises:
        ValueError: a table or levels of another length, rows that are neither unit vectors nor 0, negative levels, a
            power, a sample or a least B outside its range.

    >>> import torch
    >>> from normlift_ns import Evidence, consensus
    >>> from normlift_ns.core.evidence import Entries
    >>> seen = Entries(torch.tensor([0, 0, 0]), torch.tensor([1, 3, 5]), torch.ones(3), num_regions=(1, 1, 1))
    >>> evidence = Evidence.from_entries([seen], num_gaussians=1)  # three views, each with one region
    >>> consensus(evidence, torch.tensor([[0.6, 0.8], [0.6, -0.8], [0.6, 0.8]])).features[1]
    tensor([0.9138, 0.4061])
    """
    size = evidence.num_regions
    check_tensors(features=features, **({} if level is None else {"level": level}))
    for name, length in (("features", len(features)), ("level", size if level is None else len(level))):
        if length != size:
            raise InputError(f"{name} must have one row per region of the evidence, {size:,}; got {length:,}")
    if features.ndim != 2 or not features.dtype.is_floating_point:
        raise InputError(f"features must be floating-point rows [S, D], got {features.dtype} {tuple(features.shape)}")
    if level is not None and (level.ndim != 1 or level.dtype.is_floating_point or bool((level < 0).any())):
        raise InputError(f"level must be whole numbers >= 0 of shape [S], got {level.dtype} {tuple(level.shape)}")
    if not isinstance(power, int | float) or not 0 <= power < float("inf"):
        raise InputError(f"power must be a number >= 0, got {power!r}")
    if not isinstance(sample, int) or sample < 1:
        raise InputError(f"sample must be a whole number >= 1, got {sample!r}")
    if not isinstance(least, int | float) or not 0 <= least <= 1:
        raise InputError(f"least must be a number in 0..1, got {least!r}")
    check_unit_rows(features, "feature rows", "normalise them, or set those without a feature to 0", zeros=True)
    device = evidence.rows.weight.device
    chosen, chance = sampled_gaussians(evidence.rows, size, sample, portion)
    seen = evidence.select_gaussians(chosen)
    level = torch.zeros(size, dtype=torch.int64) if level is None else level
    out, agreement = features.to(device, copy=True), []
    levels = level.unique().tolist()
    if portion is not None and portion.team.size > 1:
        seen, chance = _of_the_team(seen, portion.gaussians[chosen], chance, portion.team)
        if portion.team.rank > 0:
            return Consensus(portion.team.spread(out), portion.team.tell(None), len(chance))
    rows, total = seen.rows, seen_weights(seen, torch.arange(len(chance), device=device), max(1, len(levels)))
    for number in levels:
        columns = (level == number).nonzero().squeeze(1).to(device)
        part = rows if len(columns) == size else rows.select_columns(columns, size)
        overlaps = region_overlaps(part, evidence.region_view[columns], chance, total)
        out[columns] = agreed(out[columns], overlaps, power, least)
        agreement.append(overlaps.agreement)
    if portion is not None:
        out, agreement = portion.team.spread(out), portion.team.tell(agreement)
    return Consensus(out, agreement, len(chance))


def _of_the_team(
    seen: Evidence, numbers: Int64[Tensor, " m"], chance: Float64[Tensor, " m"], team: Team
) -> tuple[Evidence, Float64[Tensor, " all"]]:
    """The sampled Gaussians of all processes with their chances, in the order of their numbers."""
    order = team.join(numbers).argsort()
    rows, unlabeled = (join_sparse(team, part).select_rows(order) for part in (seen.rows, seen.unlabeled))
    return replace(seen, rows=rows, unlabeled=unlabeled), team.join(chance)[order]


def seen_reliability(agreed: Scalars, seen: Scalars) -> Scalars:
    """The numbers of the lift of F', with R of the lift of F; 0 where F' gives no direction."""
    return replace(agreed, reliability=torch.where(agreed.norm > 0, seen.reliability, 0.0))


def agreed(
    features: Float[Tensor, "s d"], overlaps: Overlaps, power: float = 1.0, least: float = CHANCE
) -> Float[Tensor, "s d"]:
    """F' of the regions of one level. Regions that overlap none keep their rows as they are."""
    strength = min(1.0, max(0.0, (overlaps.agreement - least) / RISE))
    if strength == 0 or overlaps.iou.weight.numel() == 0:
        return features
    table = features.to(torch.promote_types(features.dtype, torch.float32))
    weight = strength * overlaps.iou.weight * overlaps.inside**power
    others = SparseRows(overlaps.iou.offsets, overlaps.iou.column, weight.to(table.dtype)).matmul(table)
    total = table + others
    length = torch.linalg.vector_norm(total, dim=1, keepdim=True)
    alone = (overlaps.iou.offsets.diff() == 0)[:, None] | (table == 0).all(dim=1, keepdim=True) | (length < 1e-6)
    return torch.where(alone, features, (total / length).to(features.dtype))


def sampled_gaussians(
    rows: SparseRows, num_columns: int, least: int, portion: Portion | None = None
) -> tuple[Int64[Tensor, " m"], Float64[Tensor, " m"]]:
    """Gaussians so that every region has at least `least` of them or all that it has, and the chance that each had.

    Every Gaussian draws a number by its index alone; a region takes those below its share. Sums over the sample, each
    term divided by its chance, are unbiased.

    Args:
        portion: which Gaussians the rows are of; None: all there are. Regions count those of the whole team.
    Returns:
        The rows that were chosen, and the chance of each.
    """
    add = ALONE.add if portion is None else portion.team.add
    count = add(torch.bincount(rows.column, minlength=num_columns))
    share = ((least + 3 * least**0.5) / count.double().clamp(min=1)).clamp(max=1)
    number = _numbers(torch.arange(len(rows), device=rows.offsets.device) if portion is None else portion.gaussians)
    while True:
        chance = _largest(rows, share)
        chosen = (number < chance).nonzero().squeeze(1)
        got = add(torch.bincount(rows.select_rows(chosen).column, minlength=num_columns))
        lacking = got < count.clamp(max=least)
        if not bool(lacking.any()):
            return chosen, chance[chosen]
        share = torch.where(lacking, (2 * share).clamp(max=1), share)


def seen_weights(evidence: Evidence, gaussians: Int64[Tensor, " m"], levels: int = 1) -> SparseRows:
    """W_jv of some Gaussians, pixels without a region included, [M, views]: in each of so many levels, because the
    evidence counts a pixel once per level.
    """
    rows, blank = evidence.rows.select_rows(gaussians), evidence.unlabeled.select_rows(gaussians)
    found = SparseRows.add(replace(evidence, rows=rows, unlabeled=blank).view_weights(), blank)
    return replace(found, weight=found.weight / levels)


def region_overlaps(
    rows: SparseRows,
    region_view: Int[Tensor, " s"],
    chance: Float64[Tensor, " m"] | None = None,
    total: SparseRows | None = None,
) -> Overlaps:
    """J of all regions of one level, from the evidence of some Gaussians.

    Args:
        rows: E, [M, S].
        region_view: view of every column, non-decreasing.
        chance: with which each of the Gaussians was taken; None: they are all.
        total: W_jv, [M, views], pixels without a region included; None: there are none.
    """
    size, view = len(region_view), region_view.long()
    last = [x.max() for x in (view, *(() if total is None else (total.column,))) if len(x) > 0]
    views = int(max(last)) + 1 if size > 0 else 0
    shares, visible, labeled = _shares(rows, view, views, chance, total)
    area = torch.zeros(size, views, dtype=rows.weight.dtype, device=view.device)  # sum_j p_js over what a view sees
    in_regions = torch.zeros_like(area)  # a_sv
    parts, first = [(view[:0], view[:0], area.new_zeros(0, dtype=torch.float64))], 0
    for of_seen, of_regions, *pairs in _inner_products(shares, visible, labeled, view, views):
        last = first + len(of_seen)
        area[first:last], in_regions[first:last] = of_seen, of_regions
        parts.append((pairs[0], pairs[1], pairs[2]))
        first = last
    row, column, inner = (torch.cat(x) for x in zip(*parts))
    c, inside = inner / area[row, view[column]], inner / area[column, view[row]]
    iou = (1 / (1 / c + 1 / inside - 1)).clamp(max=1)
    kept = (iou >= LEAST).nonzero().squeeze(1)
    kept = kept[(row[kept] * size + column[kept]).argsort()]
    row, column, iou, inside = row[kept], column[kept], iou[kept], inside[kept].clamp(max=1)
    starts = _starts(row * views + view[column])
    best = torch.segment_reduce(iou, "max", offsets=torch.cat([starts, starts.new_tensor([len(row)])]), initial=0.0)
    met = (best * in_regions[row[starts], view[column[starts]]]).sum()
    seen = in_regions.sum(dtype=torch.float64) - in_regions.gather(1, view[:, None]).sum(dtype=torch.float64)
    agreement = float(met / seen) if len(row) > 0 else 0.0
    return Overlaps(SparseRows(row_offsets(row, size), column.int(), iou), inside, agreement)


def _numbers(index: Int64[Tensor, " n"]) -> Float64[Tensor, " n"]:
    """A number in [0, 1) of every index, well mixed: the last step of MurmurHash3."""
    x = index + SEED
    for shift, factor in ((16, 0x85EBCA6B), (13, 0xC2B2AE35)):
        x = ((x ^ (x >> shift)) * factor) & 0xFFFFFFFF
    return (x ^ (x >> 16)).double() / 2**32


def _largest(rows: SparseRows, share: Float64[Tensor, " s"]) -> Float64[Tensor, " n"]:
    """Largest share among the columns of every row, 0 without any."""
    if kernels_apply(share):
        from normlift_ns.kernels.overlaps import row_max  # noqa: PLC0415 (needs triton)

        return row_max(rows.offsets, rows.column, share)
    return torch.segment_reduce(share[rows.column.long()], "max", offsets=rows.offsets, initial=0.0)


def _starts(key: Int64[Tensor, " m"]) -> Int64[Tensor, " g"]:
    """Where runs of equal keys begin."""
    first = torch.ones_like(key, dtype=torch.bool)
    first[1:] = key[1:] != key[:-1]
    return first.nonzero().squeeze(1)


def _shares(
    rows: SparseRows,
    view: Int64[Tensor, " s"],
    views: int,
    chance: Float64[Tensor, " m"] | None,
    total: SparseRows | None,
) -> tuple[SparseRows, SparseRows, SparseRows]:
    """p [M, S] of the views that see a Gaussian, 1 for each of them [M, views], and what of that lies in regions, all
    divided by the square root of the Gaussian's chance, so that products count as often as they would in the whole.
    """
    entries, of_row, of_view, weight = _by_view(rows, view, views)
    if total is None:
        total = SparseRows(row_offsets(of_row, len(rows)), of_view.int(), weight)
    all_row, all_view = total.row_index(), total.column.long()
    place = torch.searchsorted(all_row * views + all_view, of_row * views + of_view)
    whole = total.weight.double().index_put((place,), torch.maximum(total.weight.double()[place], weight))
    some = max(1, len(whole) // _MEDIAN)
    seen = (whole > 0) & (whole >= SEEN * _medians(whole[::some], all_view[::some], views)[all_view])
    share = rows.weight.double() / whole[place][entries]
    kept = seen[place][entries] & (share >= FAINT)
    row = rows.row_index()[kept]
    scale = whole.new_ones(len(rows)) if chance is None else chance.rsqrt()
    shares = SparseRows(row_offsets(row, len(rows)), rows.column[kept], share[kept] * scale[row])
    visible = SparseRows(row_offsets(all_row[seen], len(rows)), all_view[seen].int(), scale[all_row[seen]])
    _, of_row, of_view, weight = _by_view(shares, view, views)
    return shares, visible, SparseRows(row_offsets(of_row, len(rows)), of_view.int(), weight)


def _by_view(
    rows: SparseRows, view: Int64[Tensor, " s"], views: int
) -> tuple[Int64[Tensor, " nnz"], Int64[Tensor, " g"], Int64[Tensor, " g"], Float64[Tensor, " g"]]:
    """Groups of the entries of a row that share a view: that of every entry, and row, view and weight of each."""
    row, column_view = rows.row_index(), view[rows.column.long()]
    starts = _starts(row * views + column_view)
    ends = torch.cat([starts, starts.new_tensor([len(row)])])
    of_entry = torch.repeat_interleave(torch.arange(len(starts), device=row.device), ends.diff())
    return of_entry, row[starts], column_view[starts], segment_sum(rows.weight, ends)


def _medians(values: Float64[Tensor, " m"], group: Int64[Tensor, " m"], groups: int) -> Float64[Tensor, " groups"]:
    """The lower median of every group, 0 for empty ones."""
    order = values.argsort(stable=True)
    order = order[group[order].argsort(stable=True)]
    offsets = row_offsets(group, groups)
    there = offsets.diff() > 0
    middle = offsets[:-1] + (offsets.diff() - 1).clamp(min=0) // 2
    out = values.new_zeros(groups)
    out[there] = values[order[middle[there]]]
    return out


_Block = tuple[Tensor, Tensor, Tensor, Tensor, Tensor]
"""sum_j p_js of some regions s over what a view sees and over what lies in its regions, [regions, views], and
(s, t, sum_j p_js p_jt) of other views, c_st >= `LEAST`."""


def _inner_products(
    shares: SparseRows, visible: SparseRows, labeled: SparseRows, view: Int64[Tensor, " s"], views: int
) -> Iterator[_Block]:
    """The products of all regions, block by block."""
    order = shares.column.argsort(stable=True)
    row, weight = shares.row_index()[order].int(), shares.weight[order]
    by_region = SparseRows(row_offsets(shares.column, len(view)), row, weight)  # the transpose
    if kernels_apply(view):
        step = max(1, _DENSE // max(1, len(view)))
        for first in range(0, len(view), step):
            last = min(len(view), first + step)
            yield _dense_block(by_region, shares, visible, labeled, view, views, first, last)
    else:
        by_region, shares, visible = (x.to("cpu") for x in (by_region, shares, visible))
        for block in _sparse_blocks(by_region, shares, visible, view.cpu(), views):
            yield tuple(x.to(view.device) for x in block)  # pyright: ignore[reportReturnType]


def _dense_block(
    by_region: SparseRows,
    shares: SparseRows,
    visible: SparseRows,
    labeled: SparseRows,
    view: Tensor,
    views: int,
    first: int,
    last: int,
) -> _Block:
    from normlift_ns.kernels.overlaps import products  # noqa: PLC0415 (needs triton)

    area, met = (products(by_region, x, views, first, last) for x in (visible, labeled))
    inner = products(by_region, shares, len(view), first, last)
    row, column = ((inner >= (LEAST * area)[:, view]) & (inner > 0) & (view[first:last, None] != view)).nonzero(
        as_tuple=True
    )
    return area, met, row + first, column, inner[row, column].double()


def _sparse_blocks(
    by_region: SparseRows, shares: SparseRows, visible: SparseRows, view: Tensor, views: int
) -> Iterator[_Block]:
    from scipy.sparse import csr_array  # noqa: PLC0415 (a GPU does without)

    whole, seen = (
        csr_array(tuple(a.numpy() for a in (x.weight, x.column, x.offsets.int())), shape=(len(x), width))
        for x, width in ((shares, len(view)), (visible, views))
    )
    pairs = segment_sum(shares.offsets.diff()[by_region.column.long()].double(), by_region.offsets).cumsum(0)
    first = 0
    while first < len(view):
        done = pairs[first - 1] if first > 0 else 0.0
        last = max(first + 1, int(torch.searchsorted(pairs, done + _PAIRS, right=True)))
        low, high = int(by_region.offsets[first]), int(by_region.offsets[last])
        offsets = (by_region.offsets[first : last + 1] - low).int()
        arrays = (by_region.weight[low:high].numpy(), by_region.column[low:high].numpy(), offsets.numpy())
        block = csr_array(arrays, shape=(last - first, len(shares)))
        inner, area = csr_array(block @ whole), torch.from_numpy(csr_array(block @ seen).toarray())
        row = torch.repeat_interleave(torch.arange(last - first), torch.from_numpy(inner.indptr).long().diff())
        column, value = torch.from_numpy(inner.indices), torch.from_numpy(inner.data)
        key = row * views + view[column]  # what is seen of s in a view lies in the regions of that view
        met = torch.bincount(key, weights=value, minlength=(last - first) * views)
        own = torch.arange(last - first) * views + view[first:last]
        least = LEAST * area.flatten()
        least[own] = torch.inf
        kept = (value >= least[key]).nonzero().squeeze(1)
        yield area, met.view(-1, views), row[kept] + first, column[kept].long(), value[kept]
        first = last
