"""Quality of a lift, measured without labels by the recognition of regions in left-out views.

Half of the views are left out, the others are lifted, and the left-out regions are compared with the lift. Then the
halves are swapped. Let s be a region of a left-out view, and u_j the directions of the Gaussians from the kept views.
If the consensus is enabled, these directions follow a consensus among the kept views. J and F' are those of
`core.consensus`, with b = 1 for F'::

    U_s        = normalize(sum_j E_js u_j)                      feature of s, predicted from the kept views
    V_s        = sum_t J_st F_t                                 over the kept regions t with J_st > 0.3
    recognized = U_s is nearer to F_s than to the feature of any other region of the same view and level
    confirmed  = V_s is nearer to F_s than to the feature of any other region of the same view and level
    agreement  = mean of <U_s, F'_s> over the regions s         F' from a consensus among the left-out views alone

Recognition is measured for confirmed regions only. A region without a similar region in other views, such as a wrong or
merged mask, should not be recognized. Regions without a feature, or whose Gaussians have no direction, do not count.
These measures do not include the vote, and do not predict whether the vote helps.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any, NamedTuple

import torch
from jaxtyping import Bool, Float, Float64, Int, Int64
from torch import Tensor
from torch.nn.functional import normalize

from normlift_ns.core.consensus import Overlaps, apply_consensus, hash_to_unit, region_overlaps, total_view_weights
from normlift_ns.core.evidence import Evidence
from normlift_ns.core.lift import lift
from normlift_ns.core.sparse import CHUNK_ELEMENTS, SparseRows, row_offsets

PARTNER_IOU = 0.3
"""Value that J_st, the soft intersection over union, must exceed for a kept region t to count in V_s."""


class LeftOut(NamedTuple):
    """Recognition of the regions of left-out views by a lift of the other views."""

    recognized: int
    """Number of confirmed regions that the lift recognizes."""
    confirmed: int
    """Number of left-out regions that overlapping kept regions confirm."""
    agreement: float
    """Mean of <U_s, F'_s> over the left-out regions s (see the module docstring); NaN without regions."""

    @property
    def facts(self) -> dict[str, Any]:
        """JSON-ready entry for the manifest of the lifted run."""
        agreement = None if self.agreement != self.agreement else self.agreement
        return {"recognized": self.recognized, "confirmed": self.confirmed, "agreement": agreement}


def leave_views_out(
    sampled: Evidence,
    probability: Float64[Tensor, " m"],
    features: Float[Tensor, "s d"],
    *,
    level: Int[Tensor, " s"] | None = None,
    power: float = 1.0,
    least: float | None = None,
) -> LeftOut:
    """Measure how well a lift of half of the views recognizes regions of the other views.

    The formulas are in the module docstring.

    Args:
        sampled: Evidence of the Gaussians from `sample_gaussians`.
        probability: Sampling probability of each row.
        features: F, the features before the consensus, as unit or zero rows.
        level: Level of every region (default: the same for all). Regions of different levels are not compared.
        power, least: Options of the consensus, as in `consensus`. If `least` is None, lift the kept views without a
            consensus.
    """
    device = sampled.rows.weight.device
    view, views = sampled.region_view.long(), sampled.num_views
    level = torch.zeros_like(view) if level is None else level.to(device).long()
    group = view * (int(level.max()) + 1 if len(level) > 0 else 1) + level
    held = hash_to_unit(torch.arange(views, device=device)).argsort().argsort() % 2 == 0  # one half of the views
    levels = level.unique().tolist()
    total, overlaps = total_view_weights(sampled, max(1, len(levels))), []
    for number in levels:
        columns = (level == number).nonzero().squeeze(1)
        part = sampled.rows.select_columns(columns, len(view))
        overlaps.append((columns, region_overlaps(part, view[columns], probability, total)))
    features = features.to(device)
    sums = torch.zeros(3, dtype=torch.float64, device=device)  # recognized, confirmed, agreement
    regions = 0
    for out in (held, ~held):
        if views < 2:
            break
        table, clean, partner = features.clone(), features.clone(), torch.zeros_like(features)
        for columns, found in overlaps:
            kept, left = ~out[view[columns]], out[view[columns]]
            if least is not None:
                table[columns[kept]] = apply_consensus(features[columns[kept]], _among(found, kept), power, least)
            clean[columns[left]] = apply_consensus(features[columns[left]], _among(found, left), power, -1.0)
            partner[columns] = _partners(found, kept, features[columns])
        columns = out[view].nonzero().squeeze(1)
        toward = _lifted_regions(sampled, probability, (~out).nonzero().squeeze(1), columns, table)
        seen = (toward != 0).any(1) & (features[columns] != 0).any(1)
        recognized = _nearest_is_own(toward, features[columns], group[columns])
        confirmed = _nearest_is_own(partner[columns], features[columns], group[columns]) & seen
        agreement = (normalize(toward, dim=1) * clean[columns]).sum(1)
        parts = ((recognized & confirmed).sum(), confirmed.sum(), agreement[seen].double().sum())
        sums += torch.stack([x.double() for x in parts])
        regions += int(seen.sum())
    recognized, confirmed, agreement = sums.tolist()
    return LeftOut(int(recognized), int(confirmed), agreement / regions if regions > 0 else float("nan"))


def _lifted_regions(
    sampled: Evidence, probability: Tensor, kept: Int64[Tensor, " k"], columns: Int64[Tensor, " c"], table: Tensor
) -> Float[Tensor, "c d"]:
    """Return sum_j E_js u_j for the given columns s, with u from the kept views, estimated from the sample."""
    views = kept.tolist()
    lifted = lift(sampled.select_views(views), table[sampled.columns_of(views)])
    rows = sampled.rows.select_columns(columns, sampled.num_regions)
    sums = table.new_zeros(len(columns), table.shape[1])
    for chunk in torch.arange(len(rows), device=table.device).split(max(1, CHUNK_ELEMENTS // table.shape[1])):
        part = rows.select_rows(chunk)
        order = part.column.argsort(stable=True)
        row = part.row_index()[order]
        weight = part.weight[order].double() / probability[chunk[row]]
        by_region = SparseRows(row_offsets(part.column, len(columns)), row.int(), weight.to(table.dtype))
        sums += by_region.matmul(lifted.directions(chunk).to(table.dtype))
    return sums


def _among(found: Overlaps, keep: Bool[Tensor, " s"]) -> Overlaps:
    """Return the overlaps among the regions to keep, which are renumbered from 0."""
    row, column = found.iou.row_index(), found.iou.column.long()
    entry = keep[row] & keep[column]
    new = keep.cumsum(0) - 1
    iou = SparseRows(row_offsets(new[row[entry]], int(keep.sum())), new[column[entry]].int(), found.iou.weight[entry])
    return Overlaps(iou, found.inside[entry], found.agreement)


def _partners(found: Overlaps, kept: Bool[Tensor, " s"], features: Float[Tensor, "s d"]) -> Float[Tensor, "s d"]:
    """Return V_s, the sum of J_st F_t over the kept regions t with J_st > `PARTNER_IOU`."""
    weight = torch.where(kept[found.iou.column.long()] & (found.iou.weight > PARTNER_IOU), found.iou.weight, 0.0)
    return replace(found.iou, weight=weight.to(features.dtype)).matmul(features)


def _nearest_is_own(
    rows: Float[Tensor, "c d"], features: Float[Tensor, "c d"], group: Int64[Tensor, " c"]
) -> Bool[Tensor, " c"]:
    """Return a mask of the nonzero rows that are nearer to their own feature than to the other features of their group.

    The mask is False for the only row of a group.
    """
    found = torch.zeros(len(rows), dtype=torch.bool, device=rows.device)
    for one in group.unique().tolist():
        members = (group == one).nonzero().squeeze(1)
        best = (rows[members] @ features[members].T).argmax(1)
        found[members] = (best == torch.arange(len(members), device=rows.device)) & (len(members) > 1)
    return found & (rows != 0).any(1)
