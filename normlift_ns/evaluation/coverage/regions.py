"""Regions without reliable evidence: spatially connected parts of what the images show."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Float64, Int, Int64
from torch import Tensor

from normlift_ns.core.lift import Scalars
from normlift_ns.objects import connected_components

_HIDDEN_SHARE = 0.01
"""Total share of the surface of all Gaussians that are too small or too transparent to matter."""
_MIN_SHARE = 0.001
"""Minimum share of the surface in a listed region."""
_MAX_REGIONS = 20
"""Maximum number of listed regions."""


@dataclass(frozen=True)
class Region:
    """Connected Gaussians that images show, but with little reliable evidence. Means are weighted by surface."""

    size: int
    """Number of Gaussians."""
    centre: list[float]
    """Center in the scene's own units."""
    box: dict[str, list[float]]
    """Corners "min" and "max" of the box around the centers."""
    share: float
    """Share of the surface that the images show, in 0..1."""
    reliability: float
    """Mean R. A view that hardly shows a Gaussian does not count as a whole one (R_j(S) of `gain`)."""
    lifted_reliability: float
    """Mean R of the lift, in which every view with any weight counts."""
    norm: float
    """Mean ||f|| of Gaussians with evidence. It is low if views disagree, which more views of the same kind do not
    fix."""
    views: float
    """Mean number of lifted views that show a Gaussian with at least a tenth of its weight in the best image."""
    unsupported: float
    """Share of Gaussians that no vote can repair, because neither they nor their neighbors have evidence."""


class Evidenced(NamedTuple):
    """Evidence for every Gaussian."""

    means: Float[Tensor, "n 3"]
    scalars: Scalars
    surface: Float64[Tensor, " n"]
    """s_j"""
    reliability: Float64[Tensor, " n"]
    """R_j(S)"""
    views: Int[Tensor, " n"]
    """Lifted views that show it."""
    unsupported: Bool[Tensor, " n"]


def visible(surface: Float64[Tensor, " n"]) -> Bool[Tensor, " n"]:
    """Return the Gaussians that are large and opaque enough to matter, without the smallest that make up `HIDDEN` of
    the surface.

    >>> visible(torch.tensor([0.5, 0.001, 0.5, 0.0])).tolist()
    [True, False, True, False]
    """
    order = surface.argsort()
    mask = torch.zeros_like(surface, dtype=torch.bool)
    mask[order] = surface[order].cumsum(0) > _HIDDEN_SHARE * surface.sum()
    return mask


def weak_regions(
    evidence: Evidenced, *, min_reliability: float, reach: float
) -> tuple[list[Region], list[Int64[Tensor, " m"]]]:
    """Return regions of visible Gaussians with R_j(S) below a bound, and their Gaussians, sorted by their lack of
    evidence.

    The lack of a region is sum_j s_j (min_reliability - R_j(S)).

    Args:
        reach: as in `connected_components`.
    """
    surface = evidence.surface
    weak = visible(surface) & (evidence.reliability < min_reliability)
    labels = connected_components(evidence.means, weak, reach=reach)
    chosen = (labels >= 0).nonzero().squeeze(1)
    number, lacking = labels[chosen].long(), surface * (min_reliability - evidence.reliability)
    share, lack = (torch.bincount(number, x[chosen]) for x in (surface / surface.sum(), lacking))
    listed = (share >= _MIN_SHARE).nonzero().squeeze(1)
    listed = listed[lack[listed].argsort(descending=True, stable=True)][:_MAX_REGIONS]
    parts = [chosen[number == i] for i in listed.tolist()]
    return [_region(evidence, rows) for rows in parts], parts


def _region(evidence: Evidenced, rows: Int64[Tensor, " m"]) -> Region:
    surface, means, norm = evidence.surface[rows], evidence.means[rows].double(), evidence.scalars.norm[rows]
    weight = surface / surface.sum()

    def mean(values: Tensor, weight: Tensor = weight) -> float:
        return float((weight * values.double()).sum())

    evidenced = weight * (norm > 0)
    return Region(
        size=len(rows),
        centre=(weight[:, None] * means).sum(0).tolist(),
        box={"min": means.amin(0).tolist(), "max": means.amax(0).tolist()},
        share=float(surface.sum() / evidence.surface.sum()),
        reliability=mean(evidence.reliability[rows]),
        lifted_reliability=mean(evidence.scalars.reliability[rows]),
        norm=mean(norm, evidenced / evidenced.sum()) if bool((evidenced > 0).any()) else 0.0,
        views=mean(evidence.views[rows]),
        unsupported=mean(evidence.unsupported[rows]),
    )
