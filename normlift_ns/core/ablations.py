"""The paper's ablation of the refinement (its table 2), behind one switch."""

from __future__ import annotations

from typing import Literal, get_args

import torch
from jaxtyping import Float
from torch import Tensor

from normlift_ns.core.lift import Lifted
from normlift_ns.core.neighbors import Neighbors, nearest_neighbors
from normlift_ns.core.refine import RefineConfig, decay_width, refine, voting_weights

Variant = Literal["none", "knn", "linear", "norm", "support", "full"]


def refine_variant(
    variant: Variant,
    means: Float[Tensor, "n 3"],
    lifted: Lifted,
    config: RefineConfig | None = None,
    *,
    beta: float = 1.0,
    neighbors: Neighbors | None = None,
) -> Float[Tensor, "n d"]:
    """Directions after one variant of the refinement, unit rows or 0.

    Args:
        variant: "none": the lift as it is. "knn": plain voting, every Gaussian with a direction counts the same (R =
            1).
            "linear": distance-weighted linear averaging of the directions of N+, weighted by R d_ik and normalised.
            "norm": R = ||f||. "support": R = N_eff / (N_eff + beta). "full": NormLift.
        beta: as in `lift`, for "support".
    Raises:
        ValueError: an unknown variant.
    """
    if variant not in get_args(Variant):
        raise ValueError(f"variant must be one of {', '.join(get_args(Variant))}; got {variant!r}")
    config = config or RefineConfig()
    directions = lifted.directions()
    if variant == "none":
        return directions
    neighbors = neighbors or nearest_neighbors(means, config.k)
    if variant == "linear":
        return _linear_average(directions, lifted.reliability, neighbors, config)
    support = torch.where(lifted.n_eff > 0, lifted.n_eff / (lifted.n_eff + beta), 0.0)
    reliability = {
        "knn": (lifted.norm > 0).to(lifted.norm.dtype),
        "norm": lifted.norm,
        "support": support,
        "full": lifted.reliability,
    }[variant]
    return directions[refine(means, directions, reliability, config, neighbors=neighbors).long()]


def _linear_average(directions: Tensor, reliability: Tensor, neighbors: Neighbors, config: RefineConfig) -> Tensor:
    out, width = torch.empty_like(directions), decay_width(neighbors, config)
    for i in torch.arange(len(directions), device=directions.device).split(2**14):
        group = torch.cat([i[:, None], neighbors.index[i]], dim=1).clamp(min=0)
        weight = voting_weights(neighbors, width, i, reliability).to(directions.dtype)
        out[i] = torch.einsum("ik,ikd->id", weight, directions[group])
    length = torch.linalg.vector_norm(out, dim=1, keepdim=True)
    return torch.where(length > 0, out / length, directions)
