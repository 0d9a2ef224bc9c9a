"""Scores of all classes after variants of the refinement and other methods, on one damaged observation.

No [N, 512] array is needed: u_j t = sum_s E_js F_s t / (W_j ||f_j||). Votes copy rows of these scores. Linear averaging
of directions averages the scores, up to the length, which does not affect the arg max.
`research/tests/test_accuracy.py` compares both with `refine_variant`.
"""

from __future__ import annotations

from functools import partial
from typing import NamedTuple, get_args

import torch
from torch import Tensor

from normlift_ns import Evidence, Lifted, Neighbors, RefineConfig, rasterize_evidence
from normlift_ns.core.refine import decay_width, voting_weights
from normlift_ns.evaluation import baselines
from normlift_ns.evaluation.studies import Variant, variant_config, variant_reliability, variant_source
from research.damage import Observed
from research.synthetic_scenes import World

VARIANTS: tuple[Variant, ...] = get_args(Variant)


class Scores(NamedTuple):
    """Cosines of every Gaussian with K classes."""

    cosine: Tensor
    """[N, K] cosines, or 0 without a direction."""
    valid: Tensor
    """[N] True for Gaussians with a direction."""


def lifted_scores(lifted: Lifted, classes: Tensor) -> Scores:
    """Return the cosines of the unrefined directions."""
    sums = lifted.evidence.rows.matmul(lifted.features @ classes.T.to(lifted.features))
    length = (lifted.scalars.weight * lifted.scalars.norm)[:, None]
    valid = lifted.scalars.norm > 0
    return Scores(torch.where(valid[:, None], sums / length, 0.0), valid)


def only(neighbors: Neighbors, voters: Tensor | None) -> Neighbors:
    """Return the neighbors of the Gaussians `voters`, or of all for None. Others have none, and keep their
    direction."""
    if voters is None:
        return neighbors
    votes = torch.zeros(len(neighbors.index), 1, dtype=torch.bool, device=neighbors.index.device)
    votes[voters] = True
    distance = torch.where(votes, neighbors.distance, torch.inf)
    return Neighbors(torch.where(votes, neighbors.index, -1), distance, neighbors.spacing)


def refined_scores(
    variant: Variant, means: Tensor, lifted: Lifted, scores: Scores, neighbors: Neighbors,
    config: RefineConfig | None = None,
) -> Scores:  # fmt: skip
    """Return the scores after one variant of `refine_variant`."""
    config = config or RefineConfig()
    if variant == "none":
        return scores
    if variant == "linear":
        reliability = variant_reliability(variant, lifted.scalars)
        return _average(reliability, scores, neighbors, variant_config(variant, config))
    source = variant_source(variant, means, lifted.directions, lifted.scalars, config, neighbors=neighbors).long()
    return Scores(scores.cosine[source], scores.valid[source])


def _average(reliability: Tensor, scores: Scores, neighbors: Neighbors, config: RefineConfig) -> Scores:
    cosine, valid, width = scores.cosine.clone(), scores.valid.clone(), decay_width(neighbors.spacing, config)
    for i in (neighbors.index >= 0).any(1).nonzero().squeeze(1).split(2**14):
        group = torch.cat([i[:, None], neighbors.index[i].long()], dim=1).clamp(min=0)
        weight = voting_weights(neighbors, width, i, reliability).to(scores.cosine)
        total = torch.einsum("ik,ikc->ic", weight, scores.cosine[group])
        found = weight.sum(1) > 0
        cosine[i] = torch.where(found[:, None], total, cosine[i])
        valid[i] |= found
    return Scores(cosine, valid)


# Other methods on the same evidence, as `--study baselines` has them.


def centre_evidence(world: World) -> Evidence:
    """Return evidence by the idea of Occam's LGS, on the cells of a world."""
    return baselines.center_evidence(world.scene.means, world.cameras, list(world.cells.of_pixel), world.evidence)


def top_evidence(world: World, top: int = baselines.TOP) -> Evidence:
    """Return evidence by the idea of Dr.Splat, on the cells of a world."""
    rasterize = partial(rasterize_evidence, world.scene)
    return baselines.top_evidence(rasterize, world.cameras, list(world.cells.of_pixel), world.evidence, top)


def median_scores(observed: Observed, classes: Tensor, gaussians: Tensor | None = None) -> Scores:
    """Return scores by the idea of VALA, for some or all Gaussians."""
    n, device = len(observed.evidence.rows), observed.features.device
    cosine = torch.zeros(n, len(classes), device=device)
    valid = torch.zeros(n, dtype=torch.bool, device=device)
    for block, u in baselines.iter_medians(observed.evidence, observed.features, gaussians):
        cosine[block] = u @ classes.T
        valid[block] = (u != 0).any(1)
    return Scores(cosine, valid)
