"""Detection of floaters: Gaussians in front of the cameras that belong to no surface, left over from training.

The score of a visible Gaussian j is::

    log2(d_j / (s_j + s'_j)) + 2 max(0, log2(median ||f|| / ||f_j||)) + (1 - o_j)

where d_j is the distance to its 8th nearest visible neighbor, and s_j is its largest standard deviation. s'_j is the
median of the largest standard deviations of these 8 neighbors. f_j is its mean feature (equation 3 of the paper), and
o_j its opacity.

* The first term is high if the neighbors are too far away to touch, counted in doublings; Gaussians on a surface
  overlap their neighbors.
* The second term is high if views disagree about Gaussian j more than about the rest of the scene. Views see a floater
  in front of different objects. The term is 0 without evidence.
* The third term is high for transparent Gaussians.

docs/honest_answers.md reports detection and false-positive rates, and the variants that did not help.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from normlift_ns.core.gaussians import GaussianScene
from normlift_ns.core.lift import Scalars
from normlift_ns.core.neighbors import nearest_neighbors
from normlift_ns.errors import InputError
from normlift_ns.options import FLOATER_LIMIT
from normlift_ns.ranges import check_number

_NEIGHBORS = 8
_MIN_OPACITY = 1 / 255
"""Gaussians with a lower opacity are never rendered."""
_DISAGREEMENT_WEIGHT = 2.0


class Floaters(NamedTuple):
    """Floater scores of all Gaussians, and a mask of the likely floaters.

    >>> import torch
    >>> from normlift_ns.core.gaussians import GaussianScene
    >>> from normlift_ns.core.lift import Scalars
    >>> from normlift_ns.insight.floaters import find_floaters
    >>> wall = torch.cartesian_prod(torch.arange(5.0), torch.arange(5.0), torch.zeros(1))
    >>> means = torch.cat([wall, torch.tensor([[2.0, 2.0, 9.0]])])
    >>> scene = GaussianScene(means, torch.ones(26, 4), torch.full((26, 3), 0.6), torch.full((26,), 0.8))
    >>> one = torch.ones(26)
    >>> floaters = find_floaters(scene, Scalars(one, one, one, one, one, one, one.int()))
    >>> floaters.mask.nonzero().tolist(), round(float(floaters.score[25]), 2)
    ([[25]], 3.12)
    """

    score: Float[Tensor, " n"]
    """Higher for more likely floaters; -inf for Gaussians that are never rendered."""
    mask: Bool[Tensor, " n"]
    """True if the score is above the limit."""


def find_floaters(scene: GaussianScene, scalars: Scalars, *, limit: float = FLOATER_LIMIT) -> Floaters:
    """Score each Gaussian by how likely it is a floater.

    Args:
        scalars: per-Gaussian numbers from a lift of the scene.
        limit: score above which a Gaussian is a likely floater.
    Raises:
        ValueError: the scalars have a different number of Gaussians, or the limit is not finite.
    """
    limit = check_number("floater_limit", limit)
    if len(scalars.norm) != len(scene):
        raise InputError(f"the lift has {len(scalars.norm):,} Gaussians, but the scene has {len(scene):,}")
    rows = (scene.drawable & (scene.opacities >= _MIN_OPACITY)).nonzero().squeeze(1)
    score = torch.full((len(scene),), -torch.inf, device=scene.means.device)
    if len(rows) > 1:
        norm = scalars.norm.to(score)[rows]
        isolation, disagreement = _isolation(scene, rows), _disagreement(norm)
        score[rows] = isolation + _DISAGREEMENT_WEIGHT * disagreement + 1 - scene.opacities[rows].float()
    return Floaters(score, score > limit)


def _isolation(scene: GaussianScene, rows: Tensor) -> Float[Tensor, " m"]:
    """Return the first term, log2(d / (s + s'))."""
    count = min(_NEIGHBORS, len(rows) - 1)
    neighbors = nearest_neighbors(scene.means[rows], count)
    size = scene.scales[rows].float().amax(dim=1)
    neighbor_size = size[neighbors.index.long()].median(dim=1).values  # finite means: no index is -1
    tiny = torch.finfo(torch.float32).tiny
    return (neighbors.distance[:, -1].float().clamp(min=tiny) / (size + neighbor_size).clamp(min=tiny)).log2()


def _disagreement(norm: Float[Tensor, " m"]) -> Float[Tensor, " m"]:
    """Return the second term without its weight, max(0, log2(median ||f|| / ||f||)); 0 without evidence."""
    has_evidence = norm > 0
    if not bool(has_evidence.any()):
        return torch.zeros_like(norm)
    return torch.where(has_evidence, (norm[has_evidence].median() / norm.clamp(min=1e-30)).log2().clamp(min=0), 0.0)
