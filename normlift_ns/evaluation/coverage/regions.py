"""Regions without reliable evidence: parts of what the photographs show that hang together in space."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Float64, Int, Int64
from torch import Tensor

from normlift_ns.core.lift import Scalars
from normlift_ns.objects import connected_components

HIDDEN = 0.01
"""Share of all surface that the Gaussians make up together which are too small or too transparent to matter."""
LEAST_SHARE = 0.001
"""Of the surface, in a region that is listed."""
MOST = 20
"""Regions that are listed."""


@dataclass(frozen=True)
class Region:
    """Gaussians that hang together, are seen in photographs, and have little reliable evidence; means by surface."""

    size: int
    """Number of Gaussians."""
    centre: list[float]
    """In the scene's own units."""
    box: dict[str, list[float]]
    """The corners "min" and "max" of the box that holds the centres."""
    share: float
    """Of the surface that the photographs show, in 0..1."""
    reliability: float
    """Mean R, where a view that hardly sees a Gaussian is not counted as a whole one (R_j(S) of `gain`)."""
    lifted_reliability: float
    """Mean R of the lift, in which every view counts that has any weight."""
    norm: float
    """Mean ||f|| where there is evidence: low where views disagree, which more views of the same kind do not mend."""
    views: float
    """Mean number of lifted views that saw it, with at least a tenth of the weight that the best photograph gives."""
    unsupported: float
    """Share that no vote can repair: neither a Gaussian nor any of its neighbours has evidence."""


class Evidenced(NamedTuple):
    """What is known of every Gaussian."""

    means: Float[Tensor, "n 3"]
    scalars: Scalars
    surface: Float64[Tensor, " n"]
    """s_j"""
    reliability: Float64[Tensor, " n"]
    """R_j(S)"""
    views: Int[Tensor, " n"]
    """Lifted views that saw it."""
    unsupported: Bool[Tensor, " n"]


def visible(surface: Float64[Tensor, " n"]) -> Bool[Tensor, " n"]:
    """Gaussians that are large and opaque enough to matter: without the smallest that make up `HIDDEN` of the surface.

    >>> visible(torch.tensor([0.5, 0.001, 0.5, 0.0])).tolist()
    [True, False, True, False]
    """
    order = surface.argsort()
    found = torch.zeros_like(surface, dtype=torch.bool)
    found[order] = surface[order].cumsum(0) > HIDDEN * surface.sum()
    return found


def weak_regions(
    known: Evidenced, *, min_reliability: float, reach: float
) -> tuple[list[Region], list[Int64[Tensor, " m"]]]:
    """Regions of visible Gaussians with R_j(S) below a bound, and their Gaussians; those that lack most come first.

    What a region lacks is sum_j s_j (min_reliability - R_j(S)).

    Args:
        reach: as in `connected_components`.
    """
    surface = known.surface
    weak = visible(surface) & (known.reliability < min_reliability)
    labels = connected_components(known.means, weak, reach=reach)
    chosen = (labels >= 0).nonzero().squeeze(1)
    number, lacking = labels[chosen].long(), surface * (min_reliability - known.reliability)
    share, lack = (torch.bincount(number, x[chosen]) for x in (surface / surface.sum(), lacking))
    listed = (share >= LEAST_SHARE).nonzero().squeeze(1)
    listed = listed[lack[listed].argsort(descending=True, stable=True)][:MOST]
    parts = [chosen[number == i] for i in listed.tolist()]
    return [_region(known, rows) for rows in parts], parts


def _region(known: Evidenced, rows: Int64[Tensor, " m"]) -> Region:
    surface, places, norm = known.surface[rows], known.means[rows].double(), known.scalars.norm[rows]
    weight = surface / surface.sum()

    def mean(values: Tensor, weight: Tensor = weight) -> float:
        return float((weight * values.double()).sum())

    seen = weight * (norm > 0)
    return Region(
        size=len(rows),
        centre=(weight[:, None] * places).sum(0).tolist(),
        box={"min": places.amin(0).tolist(), "max": places.amax(0).tolist()},
        share=float(surface.sum() / known.surface.sum()),
        reliability=mean(known.reliability[rows]),
        lifted_reliability=mean(known.scalars.reliability[rows]),
        norm=mean(norm, seen / seen.sum()) if bool((seen > 0).any()) else 0.0,
        views=mean(known.views[rows]),
        unsupported=mean(known.unsupported[rows]),
    )
