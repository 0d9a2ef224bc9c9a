"""Gate of the vote, measured on neighbors that share their regions.

A gate decides from a cosine whether two directions belong to the same object. Texts of one scene have cosines to each
other of 0.73 to 0.95 in CLIP and near 0 in a classifier, so no fixed cosine suits both. After a consensus, directions
of one object agree closely, and this agreement can be measured in the lift. Let `same` be the cosines of lifted
directions of neighbors that share a region in at least half of the views that show both::

    tau   = 5 % quantile of same, at most 0.9985
    gamma = (1 - tau) / 2
"""

from __future__ import annotations

import torch
from jaxtyping import Float64, Int32, Int64
from torch import Tensor

from normlift_ns.core.consensus import hash_to_unit
from normlift_ns.core.lift import Lifted
from normlift_ns.core.sparse import SparseRows, sum_equal_keys

GATE_QUANTILE = 0.05
"""Fraction of the measured pairs of neighbors that have a cosine below tau, if tau is below `MAX_TAU`. Their gate is
less than one half."""
SHARED_VIEWS = 0.5
"""Minimum fraction of views with a shared region, among the views that show both Gaussians."""
MAX_TAU = 0.9985
"""Largest tau. A sharper gate would depend on rounding."""
_PAIRS = 20_000
"""Approximate number of pairs to measure. The rank of their quantile has a standard error of 0.2 % of the pairs."""
_LEAST_PAIRS = 50


def sample_pairs(
    gaussians: Int64[Tensor, " m"], neighbors: Int32[Tensor, "m k"], n: int
) -> tuple[Int64[Tensor, " p"], Int64[Tensor, " p"]]:
    """Return rows of sampled Gaussians, and one neighbor of each.

    The sample and the choice of neighbors depend only on the indices of the Gaussians.

    Args:
        gaussians: Index of every row among all n Gaussians.
        neighbors: Neighbors of every row, -1 for none. Rows for which -1 is chosen are left out.
    """
    number, share = hash_to_unit(gaussians), min(1.0, _PAIRS / max(1, n))
    row = (number < share).nonzero().squeeze(1)
    slot = (number[row] / share * neighbors.shape[1]).long().clamp(max=neighbors.shape[1] - 1)
    neighbor = neighbors[row].long().gather(1, slot[:, None]).squeeze(1)
    return row[neighbor >= 0], neighbor[neighbor >= 0]


def shared_region_cosines(
    lifted: Lifted, first: Int64[Tensor, " p"], second: Int64[Tensor, " p"], level: Int64[Tensor, " s"] | None = None
) -> Float64[Tensor, " q"]:
    """Return <u_i, u_k> of the pairs that share a region in at least half of the views that show both.

    Pairs with a Gaussian without a direction are left out.

    Args:
        first, second: Rows of the two Gaussians of every pair.
        level: Level of every region (default: the same for all). A level of a view counts as a view of its own.
    """
    evidence, norm = lifted.evidence, lifted.scalars.norm
    usable = (norm[first] > 0) & (norm[second] > 0)
    first, second = first[usable], second[usable]
    if len(first) == 0:
        return torch.zeros(0, dtype=torch.float64, device=norm.device)
    group = evidence.region_view.long()
    if level is not None and len(level) > 0:
        group = group * (int(level.max()) + 1) + level.to(group.device)
    rows = [evidence.rows.select_rows(x) for x in (first, second)]
    seen, share = zip(*(_shares(x, group) for x in rows))
    width = len(group)
    entry = [x.row_index() * width + x.column.long() for x in rows]
    together = _matched(entry[0], entry[1], share[0], share[1], width, len(first))
    groups = int(group.max()) + 1
    both = _matched(seen[0], seen[1], torch.ones_like(seen[0]), torch.ones_like(seen[1]), groups, len(first))
    same = (both > 0) & (together >= SHARED_VIEWS * both)
    u, v = lifted.directions(first[same]), lifted.directions(second[same])
    return (u.double() * v.double()).sum(1)


def relative_gate(cosines: Float64[Tensor, " q"]) -> tuple[float, float] | None:
    """Return tau and gamma for the cosines of `shared_region_cosines`, or None if there are fewer than 50.

    Both are rounded to four digits, so that rounding errors of the lift do not change them.

    >>> relative_gate(torch.linspace(0.8, 1.0, 101, dtype=torch.float64))
    (0.81, 0.095)
    """
    if len(cosines) < _LEAST_PAIRS:
        return None
    position = GATE_QUANTILE * (len(cosines) - 1)
    tau = round(min(float(cosines.sort().values[int(position)]), MAX_TAU), 4)
    return tau, round((1 - tau) / 2, 4)


def _shares(rows: SparseRows, group: Int64[Tensor, " s"]) -> tuple[Int64[Tensor, " g"], Float64[Tensor, " nnz"]]:
    """Return a key of every (row, group) with weight, and the share of every entry in the weight of its group."""
    key = rows.row_index() * (int(group.max()) + 1) + group[rows.column.long()]
    seen, total = sum_equal_keys(key, rows.weight.double())
    return seen, rows.weight.double() / total.clamp(min=1e-30)[torch.searchsorted(seen, key)]


def _matched(
    a: Int64[Tensor, " x"], b: Int64[Tensor, " y"], at: Tensor, bt: Tensor, width: int, pairs: int
) -> Float64[Tensor, " p"]:
    """Return, for every pair, the sum of at * bt over the keys that `a` and `b` have in common.

    Keys ascend, and pair i has the keys from i * width to (i + 1) * width - 1.
    """
    place = torch.searchsorted(b, a).clamp(max=len(b) - 1)
    equal = b[place] == a
    products = at[equal].double() * bt[place[equal]].double()
    pair, total = sum_equal_keys(torch.div(a[equal], width, rounding_mode="floor"), products)
    return torch.zeros(pairs, dtype=torch.float64, device=a.device).index_put((pair,), total)
