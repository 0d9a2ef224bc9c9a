"""The paper's ablation of the refinement (its table 2), behind one switch."""

from __future__ import annotations

from typing import Literal, get_args

import torch
from jaxtyping import Float
from torch import Tensor

from normlift_ns.core.lift import Lifted, Scalars
from normlift_ns.core.neighbors import Neighbors, nearest_neighbors
from normlift_ns.core.refine import decay_width, refine, voting_weights
from normlift_ns.errors import InputError
from normlift_ns.options import RefineConfig

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
        variant: "none": the lift as it is. "linear": distance-weighted linear averaging of the directions of N+,
            weighted by R d_ik and normalised. The others vote with the R of `variant_reliability`.
        beta: as in `lift`.
    Raises:
        ValueError: an unknown variant.

    >>> import torch
    >>> from normlift_ns import Evidence, RefineConfig, lift, refine_variant
    >>> from normlift_ns.core.evidence import Entries
    >>> seen = Entries(torch.tensor([0, 1, 2]), torch.tensor([1, 2, 1]), torch.ones(3), (2,))
    >>> lifted = lift(Evidence.from_entries([seen], 3), torch.eye(2))
    >>> means = torch.tensor([[0.0, 0, 0], [1, 0, 0], [2, 0, 0]])
    >>> [refine_variant(name, means, lifted, RefineConfig(k=2))[1] for name in ("none", "linear", "full")]
    [tensor([0., 1.]), tensor([0.7716, 0.6361]), tensor([1., 0.])]
    """
    config = config or RefineConfig()
    reliability, directions = variant_reliability(variant, lifted.scalars, beta), lifted.directions()
    if variant == "none":
        return directions
    neighbors = neighbors or nearest_neighbors(means, config.k)
    if variant == "linear":
        return linear_average(directions, reliability, neighbors, config)
    return directions[refine(means, directions, reliability, config, neighbors=neighbors).long()]


def variant_reliability(variant: Variant, scalars: Scalars, beta: float = 1.0) -> Float[Tensor, " n"]:
    """R that a variant votes with.

    "knn": plain voting, 1 for every Gaussian with a direction. "norm": ||f||. "support": N_eff / (N_eff + beta). Any
    other: their product, NormLift's R.

    Raises:
        ValueError: an unknown variant.
    """
    if variant not in get_args(Variant):
        raise InputError(f"variant must be one of {', '.join(get_args(Variant))}; got {variant!r}")
    if variant == "knn":
        return (scalars.norm > 0).to(scalars.norm.dtype)
    if variant == "norm":
        return scalars.norm
    support = torch.where(scalars.n_eff > 0, scalars.n_eff / (scalars.n_eff + beta), 0.0)
    return support if variant == "support" else scalars.norm * support


def linear_average(
    directions: Float[Tensor, "n d"], reliability: Float[Tensor, " n"], neighbors: Neighbors, config: RefineConfig
) -> Float[Tensor, "n d"]:
    """normalise(sum_{k in N+} R_k d_ik u_k); u_i where nobody counts."""
    out, width = torch.empty_like(directions), decay_width(neighbors, config)
    for i in torch.arange(len(directions), device=directions.device).split(2**14):
        group = torch.cat([i[:, None], neighbors.index[i]], dim=1).clamp(min=0)
        weight = voting_weights(neighbors, width, i, reliability).to(directions.dtype)
        out[i] = torch.einsum("ik,ikd->id", weight, directions[group])
    length = torch.linalg.vector_norm(out, dim=1, keepdim=True)
    return torch.where(length > 0, out / length, directions)
