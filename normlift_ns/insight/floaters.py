"""Gaussians that belong to no surface: specks in front of the cameras, left over from a training.

For Gaussian j of those that are drawn, with d_j the distance to its 8th nearest of them, s_j its largest standard
deviation, s'_j the median of those of its 8 neighbours, f_j its mean feature (equation 3 of the paper) and o_j its
opacity, the score is::

    log2(d_j / (s_j + s'_j)) + 2 max(0, log2(median ||f|| / ||f_j||)) + (1 - o_j)

The first term counts, in doublings, by how much the neighbours are too far away to touch: a piece of a surface overlaps
them. The second says that photographs disagree about what it is more than they do elsewhere in the scene, for something
that floats is seen before one thing here and before another there; it is 0 without evidence. The third says that one
can see through it. docs/honest_answers.md has the shares that are found and lost, and what did not help.
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
_LEAST_OPACITY = 1 / 255
"""What is fainter is never drawn."""
_DISAGREEMENT = 2.0
"""Weight of the second term."""


class Floaters(NamedTuple):
    """Scores of all Gaussians, and those that are likely floaters.

    >>> import torch
    >>> from normlift_ns.core.gaussians import GaussianScene
    >>> from normlift_ns.core.lift import Scalars
    >>> from normlift_ns.insight.floaters import find_floaters
    >>> wall = torch.cartesian_prod(torch.arange(5.0), torch.arange(5.0), torch.zeros(1))
    >>> means = torch.cat([wall, torch.tensor([[2.0, 2.0, 9.0]])])
    >>> scene = GaussianScene(means, torch.ones(26, 4), torch.full((26, 3), 0.6), torch.full((26,), 0.8))
    >>> one = torch.ones(26)
    >>> found = find_floaters(scene, Scalars(one, one, one, one, one, one, one.int()))
    >>> found.mask.nonzero().tolist(), round(float(found.score[25]), 2)
    ([[25]], 3.12)
    """

    score: Float[Tensor, " n"]
    """The higher, the more likely; -inf for Gaussians that are never drawn."""
    mask: Bool[Tensor, " n"]
    """Score above the limit."""


def find_floaters(scene: GaussianScene, scalars: Scalars, *, limit: float = FLOATER_LIMIT) -> Floaters:
    """Scores Gaussians by how likely they float.

    Args:
        scalars: of a lift of the scene.
        limit: score above which a Gaussian is a likely floater.
    Raises:
        ValueError: scalars of another number of Gaussians; a limit that is not finite.
    """
    limit = check_number("floater_limit", limit)
    if len(scalars.norm) != len(scene):
        raise InputError(f"the lift is of {len(scalars.norm):,} Gaussians, the scene has {len(scene):,}")
    rows = (scene.drawable & (scene.opacities >= _LEAST_OPACITY)).nonzero().squeeze(1)
    score = torch.full((len(scene),), -torch.inf, device=scene.means.device)
    if len(rows) > 1:
        norm = scalars.norm.to(score)[rows]
        score[rows] = _free(scene, rows) + _DISAGREEMENT * _disagreement(norm) + 1 - scene.opacities[rows].float()
    return Floaters(score, score > limit)


def _free(scene: GaussianScene, rows: Tensor) -> Float[Tensor, " m"]:
    """log2(d / (s + s'))"""
    count = min(_NEIGHBORS, len(rows) - 1)
    neighbors = nearest_neighbors(scene.means[rows], count)
    size = scene.scales[rows].float().amax(dim=1)
    around = size[neighbors.index.long()].median(dim=1).values  # drawable ones have finite means, and so neighbours
    tiny = torch.finfo(torch.float32).tiny
    return (neighbors.distance[:, -1].float().clamp(min=tiny) / (size + around).clamp(min=tiny)).log2()


def _disagreement(norm: Float[Tensor, " m"]) -> Float[Tensor, " m"]:
    """max(0, log2(median ||f|| / ||f||)), 0 without evidence."""
    seen = norm > 0
    if not bool(seen.any()):
        return torch.zeros_like(norm)
    return torch.where(seen, (norm[seen].median() / norm.clamp(min=1e-30)).log2().clamp(min=0), 0.0)
