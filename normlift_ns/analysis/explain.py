"""Explanation of a selection of Gaussians by the images and regions that voted for it.

The selection is treated as one large Gaussian whose evidence is the sum over its members. With E_s = sum_j E_js and F_s
the unit feature of region s::

    W_v  = sum_{s in v} E_s                    weight of image v
    S_v  = sum_{s in v} E_s F_s                vote of image v
    a_v  = cos(S_v, sum_v S_v)                 agreement of image v with the sum of all votes
    C_inter = ||sum_v S_v|| / sum_v ||S_v||    and norm, C_intra, N_eff, R as in `core.lift`

The disagreement 1 - C_inter is the sum over images of ||S_v|| (1 - a_v) / sum_v ||S_v||. The images that disagree most
have the largest terms. A Gaussian that copied the direction of a neighbor counts with that neighbor's evidence.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any, NamedTuple

import torch
from jaxtyping import Bool, Float, Float64, Int, UInt8
from torch import Tensor
from torch.nn.functional import max_pool2d

from normlift_ns.core.evidence import Evidence
from normlift_ns.core.lift import lift
from normlift_ns.core.sparse import SparseRows
from normlift_ns.errors import InputError
from normlift_ns.options import UnlabeledMode

_UNLISTED_SHARE = 0.1
"""Maximum fraction of an image's weight in regions that are not listed."""


class RegionVote(NamedTuple):
    """Vote of one region of an image."""

    region: int
    """Index of the region within its image."""
    weight: float
    """E_s, in pixels."""
    share: float
    """Fraction of the image's weight, in 0..1."""
    agreement: float
    """Cosine between the region's feature and the direction of the selection."""


@dataclass(frozen=True)
class ViewVote:
    """Vote of one image for a selection."""

    view: int
    """Index of the image in the order of the lift."""
    weight: float
    """W_v, in pixels."""
    share: float
    """Fraction of the weight of all images, in 0..1."""
    agreement: float
    """a_v, in -1..1."""
    disagreement: float
    """Fraction of the total disagreement, in 0..1; 0 if all images agree."""
    regions: tuple[RegionVote, ...]
    """Regions by descending weight, until at most a tenth of the image's weight is left."""


@dataclass(frozen=True)
class Why:
    """Explanation of a selection: the votes of all images, and how well they agree.

    >>> import torch
    >>> from normlift_ns import Evidence
    >>> from normlift_ns.core.evidence import Entries
    >>> from normlift_ns.analysis.explain import explain_selection
    >>> entries = Entries(torch.tensor([0, 0, 1, 1]), torch.tensor([1, 3, 1, 3]), torch.tensor([3.0, 1, 3, 1]), (1, 1))
    >>> evidence = Evidence.from_entries([entries], 3)
    >>> why = explain_selection(evidence, torch.tensor([[1.0, 0.0], [0.0, 1.0]]), torch.tensor([True, True, False]))
    >>> [(vote.view, vote.weight, round(vote.agreement, 3)) for vote in why.views]
    [(0, 6.0, 0.949), (1, 2.0, 0.316)]
    >>> round(why.c_inter, 3), why.n_eff, why.most_different[0].view
    (0.791, 1.6, 1)
    """

    gaussians: int
    """Number of selected Gaussians."""
    copied: int
    """Number of those that copied a neighbor's direction, and count with its evidence."""
    norm: float
    c_intra: float
    c_inter: float
    n_eff: float
    reliability: float
    """R of the selection, treated as one Gaussian like the four numbers above."""
    views: tuple[ViewVote, ...]
    """Votes by descending weight; images without weight are left out."""

    @property
    def most_different(self) -> tuple[ViewVote, ...]:
        """Votes of the images that disagree, by descending disagreement; empty if all images agree."""
        votes = [vote for vote in self.views if vote.disagreement > 0]
        return tuple(sorted(votes, key=lambda vote: -vote.disagreement))

    @property
    def words(self) -> str:
        """How well the images agree, and the effective number of images, as English sentences.

        >>> Why(5, 0, 0.9, 1.0, 0.97, 3.2, 0.7, ()).words
        'The images agree (C_inter 0.97). Their weights are equivalent to 3.2 images of equal weight (N_eff).'
        """
        if len(self.views) == 0 and self.n_eff == 0:
            return "No image shows the selection."
        if len(self.views) == 1:
            return "Only one image shows the selection, so there is no other image to confirm it."
        level = next(words for least, words in _LEVELS if self.c_inter >= least)
        count = "a single image" if self.n_eff < 1.05 else f"{self.n_eff:.1f} images of equal weight"
        return f"The images {level} (C_inter {self.c_inter:.2f}). Their weights are equivalent to {count} (N_eff)."

    @property
    def sentence(self) -> str:
        """The words, and the fraction of the selection that copied the direction of a neighbor."""
        if self.copied == 0:
            return self.words
        return f"{self.words} {self.copied / self.gaussians:.0%} of the selection copied the direction of a neighbor."

    def to_json(self) -> dict[str, Any]:
        """Return all fields and the words as plain Python types."""
        plain = asdict(self)
        for view in plain["views"]:
            view["regions"] = [region._asdict() for region in view["regions"]]
        return {**plain, "words": self.words}


_LEVELS = (
    (0.95, "agree"),
    (0.85, "agree with few exceptions"),
    (0.6, "agree partly"),
    (0.0, "contradict each other"),
)
"""Minimum C_inter of each description."""


def explain_selection(
    evidence: Evidence,
    features: Float[Tensor, "s d"],
    selected: Bool[Tensor, " n"],
    *,
    source: Int[Tensor, " n"] | None = None,
    beta: float = 1.0,
    unlabeled: UnlabeledMode = "ignore",
) -> Why:
    """Explain a selection by the votes of the images.

    Args:
        features: one unit row per column (region) of the evidence.
        selected: True for the selected Gaussians.
        source: for each Gaussian, the index of the one whose direction it has, from `refine`; None if all have their
            own.
        beta, unlabeled: as in `lift`.
    Raises:
        ValueError: nothing is selected, or the numbers of Gaussians or regions differ.
    """
    n = evidence.num_gaussians
    if selected.dtype != torch.bool or selected.shape != (n,):
        raise InputError(f"the selection must be {n:,} booleans, got {selected.dtype} {tuple(selected.shape)}")
    rows = selected.to(evidence.rows.offsets.device).nonzero().squeeze(1)
    if len(rows) == 0:
        raise InputError("nothing is selected; select at least one Gaussian")
    origin = rows if source is None else source.to(rows.device).long()[rows]
    joined = _summed(evidence, origin)
    lifted = lift(joined, features, beta=beta, unlabeled=unlabeled)
    scalars = {
        name: float(getattr(lifted.scalars, name)[0]) for name in ("norm", "c_intra", "c_inter", "n_eff", "reliability")
    }
    table = features.to(joined.rows.weight.device)[joined.rows.column.long()].double()
    views = _votes(joined, torch.nn.functional.normalize(table, dim=1))
    return Why(len(rows), int((origin != rows).sum()), **scalars, views=views)


def _summed(evidence: Evidence, rows: Tensor) -> Evidence:
    """Return the sum of the evidence of some Gaussians as one row; repeated Gaussians count repeatedly."""
    parts = []
    for matrix, columns in ((evidence.rows, evidence.num_regions), (evidence.unlabeled, evidence.num_views)):
        selected = matrix.select_rows(rows)
        weight = torch.zeros(columns, dtype=torch.float64, device=rows.device)
        weight.index_add_(0, selected.column.long(), selected.weight.double())
        column = weight.nonzero().squeeze(1)
        offsets = torch.tensor([0, len(column)], device=rows.device)
        parts.append(SparseRows(offsets, column.int(), weight[column]))
    return Evidence(parts[0], evidence.region_view, parts[1], evidence.num_views, evidence.weight_power)


def _votes(joined: Evidence, table: Float64[Tensor, "r d"]) -> tuple[ViewVote, ...]:
    """Return one vote per image, from evidence with a single row and the features of its entries."""
    column, weight = joined.rows.column.long(), joined.rows.weight
    view = joined.region_view[column].long()
    total = torch.zeros(joined.num_views, dtype=torch.float64, device=weight.device).index_add_(0, view, weight)
    vectors = table.new_zeros(joined.num_views, table.shape[1]).index_add_(0, view, weight[:, None] * table)
    direction = torch.nn.functional.normalize(vectors.sum(0), dim=0)
    length, along = vectors.norm(dim=1), vectors @ direction
    gap = (length - along).clamp(min=0)
    gap = torch.where(gap > 1e-12 * length, gap, 0.0)  # ignore rounding errors
    disagreement = gap / gap.sum() if float(gap.sum()) > 0 else gap
    agreement = torch.where(length > 0, along / length.clamp(min=1e-300), 0.0).clamp(-1, 1)
    cosine, first = table @ direction, _first_columns(joined)
    votes = []
    for v in total.argsort(descending=True, stable=True).tolist():
        if not float(total[v]) > 0:
            break
        entries = (view == v).nonzero().squeeze(1)
        entries = entries[weight[entries].argsort(descending=True, stable=True)]
        before = weight[entries].cumsum(0) - weight[entries]
        entries = entries[before <= (1 - _UNLISTED_SHARE) * total[v]]
        regions = tuple(
            RegionVote(
                int(column[i] - first[v]), float(weight[i]), float(weight[i] / total[v]), float(cosine[i].clamp(-1, 1))
            )
            for i in entries.tolist()
        )
        share = float(total[v] / total.sum())
        votes.append(ViewVote(v, float(total[v]), share, float(agreement[v]), float(disagreement[v]), regions))
    return tuple(votes)


def _first_columns(joined: Evidence) -> Tensor:
    """Return the index of the first column of each image."""
    views = torch.arange(joined.num_views, dtype=torch.int32, device=joined.region_view.device)
    return torch.searchsorted(joined.region_view.contiguous(), views)


# Outlines of regions in an image.


_LINE_COLOR = (255, 176, 0)
"""Orange, which contrasts with the dark rim for people with any color vision."""
_OUTSIDE_BRIGHTNESS = 0.45
_SIDE_PER_LINE_WIDTH = 320
"""Pixels of the longer image side per pixel of line width."""


def draw_outlines(image: UInt8[Tensor, "h w 3"], masks: Bool[Tensor, "r h w"]) -> UInt8[Tensor, "h w 3"]:
    """Darken an image outside all regions, and draw an orange line with a dark rim along the inner edge of each region.

    >>> image = torch.full((9, 9, 3), 200, dtype=torch.uint8)
    >>> mask = torch.zeros(1, 9, 9, dtype=torch.bool)
    >>> mask[:, 2:7, 2:7] = True
    >>> shown = draw_outlines(image, mask)
    >>> shown[0, 0].tolist(), shown[2, 4].tolist(), shown[4, 4].tolist()
    ([90, 90, 90], [255, 176, 0], [200, 200, 200])
    """
    width = max(1, round(max(image.shape[:2]) / _SIDE_PER_LINE_WIDTH))
    inside = masks.any(dim=0)
    line = (masks & ~_eroded(masks, width)).any(dim=0)
    rim = ~line & (~_eroded(~line[None], width)[0])
    shown = torch.where(inside[:, :, None], image.float(), _OUTSIDE_BRIGHTNESS * image.float())
    shown = torch.where((rim & inside)[:, :, None], 0.25 * shown, shown) if width > 1 else shown
    color = torch.tensor(_LINE_COLOR, dtype=torch.float32)
    return torch.where(line[:, :, None], color, shown).round().to(torch.uint8)


def _eroded(masks: Bool[Tensor, "r h w"], width: int) -> Bool[Tensor, "r h w"]:
    """Erode masks by `width` pixels; pixels beyond the image count as outside."""
    outside = torch.nn.functional.pad((~masks).float(), (width,) * 4, value=1.0)
    return max_pool2d(outside[:, None], 2 * width + 1, stride=1)[:, 0] == 0
