"""Why a selection of Gaussians means what it means: the photographs and regions that voted for it.

A selection is read as one large Gaussian, whose evidence is the sum of that of its members. With E_s = sum_j E_js and
F_s the unit feature of region s::

    W_v  = sum_{s in v} E_s                    what photograph v weighs
    S_v  = sum_{s in v} E_s F_s                what it says
    a_v  = cos(S_v, sum_v S_v)                 how far it agrees with all of them together
    C_inter = ||sum_v S_v|| / sum_v ||S_v||    and norm, C_intra, N_eff, R as in `core.lift`

The disagreement 1 - C_inter is a sum over photographs, of ||S_v|| (1 - a_v) / sum_v ||S_v||: those that disagree most
have the largest terms. A Gaussian that has copied the direction of a neighbour brings the evidence of that neighbour.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any, NamedTuple

import torch
from jaxtyping import Bool, Float, Float64, Int
from torch import Tensor

from normlift_ns.core.evidence import Evidence
from normlift_ns.core.lift import lift
from normlift_ns.core.sparse import SparseRows
from normlift_ns.errors import InputError
from normlift_ns.options import Unlabeled

_REST = 0.1
"""Share of a photograph's weight that regions which are not listed may have together."""


class RegionVote(NamedTuple):
    """One region of a photograph."""

    region: int
    """Number within its photograph."""
    weight: float
    """E_s, in pixels."""
    share: float
    """Of its photograph's weight, in 0..1."""
    agreement: float
    """Cosine of its feature to the selection's direction."""


@dataclass(frozen=True)
class ViewVote:
    """What one photograph says of a selection."""

    view: int
    """Number in the order of the lift."""
    weight: float
    """W_v, in pixels."""
    share: float
    """Of the weight of all photographs, in 0..1."""
    agreement: float
    """a_v, in -1..1."""
    disagreement: float
    """Its share of all disagreement, in 0..1; 0 where all agree."""
    regions: tuple[RegionVote, ...]
    """The heaviest first, until a tenth of the weight is left."""


@dataclass(frozen=True)
class Why:
    """What photographs say of a selection.

    >>> import torch
    >>> from normlift_ns import Evidence
    >>> from normlift_ns.core.evidence import Entries
    >>> from normlift_ns.insight.why import explain_selection
    >>> seen = Entries(torch.tensor([0, 0, 1, 1]), torch.tensor([1, 3, 1, 3]), torch.tensor([3.0, 1, 3, 1]), (1, 1))
    >>> evidence = Evidence.from_entries([seen], 3)
    >>> why = explain_selection(evidence, torch.tensor([[1.0, 0.0], [0.0, 1.0]]), torch.tensor([True, True, False]))
    >>> [(vote.view, vote.weight, round(vote.agreement, 3)) for vote in why.views]
    [(0, 6.0, 0.949), (1, 2.0, 0.316)]
    >>> round(why.c_inter, 3), why.n_eff, why.most_different[0].view
    (0.791, 1.6, 1)
    """

    gaussians: int
    """Of the selection."""
    copied: int
    """Those that have copied a neighbour's direction, and brought its evidence."""
    norm: float
    c_intra: float
    c_inter: float
    n_eff: float
    reliability: float
    """Of the selection as one Gaussian."""
    views: tuple[ViewVote, ...]
    """The heaviest first; photographs without weight are left out."""

    @property
    def most_different(self) -> tuple[ViewVote, ...]:
        """Photographs in which the disagreement lies, the most of it first; none where all agree."""
        found = [vote for vote in self.views if vote.disagreement > 0]
        return tuple(sorted(found, key=lambda vote: -vote.disagreement))

    @property
    def words(self) -> str:
        """How far the photographs agree, and on how many that rests.

        >>> Why(5, 0, 0.9, 1.0, 0.97, 3.2, 0.7, ()).words
        'The photographs agree (C_inter 0.97). It rests on as much as 3.2 photographs of equal weight (N_eff).'
        """
        if len(self.views) == 0 and self.n_eff == 0:
            return "No photograph says anything of it."
        if len(self.views) == 1:
            return "Only one photograph shows it, so that nothing tells whether others would agree."
        level = next(words for least, words in _LEVELS if self.c_inter >= least)
        count = "a single photograph" if self.n_eff < 1.05 else f"{self.n_eff:.1f} photographs of equal weight"
        return f"The photographs {level} (C_inter {self.c_inter:.2f}). It rests on as much as {count} (N_eff)."

    @property
    def sentence(self) -> str:
        """The words, and how much of the selection has copied the direction of a neighbour."""
        if self.copied == 0:
            return self.words
        return f"{self.words} {self.copied / self.gaussians:.0%} of it has copied the direction of a neighbour."

    def to_json(self) -> dict[str, Any]:
        """The same as plain types, with the words."""
        plain = asdict(self)
        for view in plain["views"]:
            view["regions"] = [region._asdict() for region in view["regions"]]
        return {**plain, "words": self.words}


_LEVELS = (
    (0.95, "agree"),
    (0.85, "agree but for a few"),
    (0.6, "agree in part"),
    (0.0, "contradict each other"),
)
"""C_inter in words."""


def explain_selection(
    evidence: Evidence,
    features: Float[Tensor, "s d"],
    selected: Bool[Tensor, " n"],
    *,
    source: Int[Tensor, " n"] | None = None,
    beta: float = 1.0,
    unlabeled: Unlabeled = "ignore",
) -> Why:
    """What photographs say of a selection.

    Args:
        features: unit rows, one per column of the evidence.
        source: the Gaussian whose direction each one has, as `refine` gives it; None: its own.
        beta, unlabeled: as in `lift`.
    Raises:
        ValueError: nothing is selected, or arrays of another number of Gaussians or regions.
    """
    n = evidence.num_gaussians
    if selected.dtype != torch.bool or selected.shape != (n,):
        raise InputError(f"the selection must be {n:,} booleans, got {selected.dtype} {tuple(selected.shape)}")
    rows = selected.to(evidence.rows.offsets.device).nonzero().squeeze(1)
    if len(rows) == 0:
        raise InputError("nothing is selected, so that nothing has voted for it; select at least one Gaussian")
    origin = rows if source is None else source.to(rows.device).long()[rows]
    joined = _joined(evidence, origin)
    lifted = lift(joined, features, beta=beta, unlabeled=unlabeled)
    scalars = {
        name: float(getattr(lifted.scalars, name)[0]) for name in ("norm", "c_intra", "c_inter", "n_eff", "reliability")
    }
    table = features.to(joined.rows.weight.device)[joined.rows.column.long()].double()
    views = _votes(joined, torch.nn.functional.normalize(table, dim=1))
    return Why(len(rows), int((origin != rows).sum()), **scalars, views=views)


def _joined(evidence: Evidence, rows: Tensor) -> Evidence:
    """The evidence of some Gaussians, each as often as it is named, as that of one."""
    parts = []
    for matrix, columns in ((evidence.rows, evidence.num_regions), (evidence.unlabeled, evidence.num_views)):
        some = matrix.select_rows(rows)
        weight = torch.zeros(columns, dtype=torch.float64, device=rows.device)
        weight.index_add_(0, some.column.long(), some.weight.double())
        place = weight.nonzero().squeeze(1)
        offsets = torch.tensor([0, len(place)], device=rows.device)
        parts.append(SparseRows(offsets, place.int(), weight[place]))
    return Evidence(parts[0], evidence.region_view, parts[1], evidence.num_views, evidence.weight_power)


def _votes(joined: Evidence, table: Float64[Tensor, "r d"]) -> tuple[ViewVote, ...]:
    """One vote per photograph, from evidence of one row and the features of its entries."""
    column, weight = joined.rows.column.long(), joined.rows.weight
    view = joined.region_view[column].long()
    total = torch.zeros(joined.num_views, dtype=torch.float64, device=weight.device).index_add_(0, view, weight)
    says = table.new_zeros(joined.num_views, table.shape[1]).index_add_(0, view, weight[:, None] * table)
    direction = torch.nn.functional.normalize(says.sum(0), dim=0)
    length, along = says.norm(dim=1), says @ direction
    differs = (length - along).clamp(min=0)
    differs = torch.where(differs > 1e-12 * length, differs, 0.0)  # rounding
    share = differs / differs.sum() if float(differs.sum()) > 0 else differs
    agreement = torch.where(length > 0, along / length.clamp(min=1e-300), 0.0).clamp(-1, 1)
    cosine, first = table @ direction, _first_columns(joined)
    votes = []
    for v in total.argsort(descending=True, stable=True).tolist():
        if not float(total[v]) > 0:
            break
        entries = (view == v).nonzero().squeeze(1)
        entries = entries[weight[entries].argsort(descending=True, stable=True)]
        before = weight[entries].cumsum(0) - weight[entries]
        entries = entries[before <= (1 - _REST) * total[v]]
        regions = tuple(
            RegionVote(
                int(column[i] - first[v]), float(weight[i]), float(weight[i] / total[v]), float(cosine[i].clamp(-1, 1))
            )
            for i in entries.tolist()
        )
        of_all = float(total[v] / total.sum())
        votes.append(ViewVote(v, float(total[v]), of_all, float(agreement[v]), float(share[v]), regions))
    return tuple(votes)


def _first_columns(joined: Evidence) -> Tensor:
    """The first column of every photograph."""
    views = torch.arange(joined.num_views, dtype=torch.int32, device=joined.region_view.device)
    return torch.searchsorted(joined.region_view.contiguous(), views)
