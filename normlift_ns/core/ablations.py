"""Variants of the refinement: those of the paper's ablation (its table 2), and the posterior vote."""

from __future__ import annotations

from collections.abc import Callable
from typing import Literal, get_args

import torch
from jaxtyping import Float, Int32
from torch import Tensor

from normlift_ns.core.lift import Lifted, Scalars
from normlift_ns.core.neighbors import Neighbors, nearest_neighbors
from normlift_ns.core.refine import decay_width, refine, voting_weights
from normlift_ns.errors import InputError
from normlift_ns.options import RefineConfig, VoteKind

Variant = Literal["none", "plain_knn", "linear", "norm_only", "support_only", "paper", "posterior"]


def refine_variant(
    variant: Variant,
    means: Float[Tensor, "n 3"],
    lifted: Lifted,
    config: RefineConfig | None = None,
    *,
    beta: float = 1.0,
    neighbors: Neighbors | None = None,
) -> Float[Tensor, "n d"]:
    """Return the directions after one variant of the refinement, as unit rows or 0.

    Args:
        variant: "none" returns the directions of the lift. "linear" averages the directions of N+ with the weights
            R d_ik and normalizes the result. The others vote with `variant_config` and `variant_reliability`.
        beta: prior strength of the shrinkage of R, as in `lift`.
    Raises:
        ValueError: if the variant is unknown.

    >>> import torch
    >>> from normlift_ns import Evidence, RefineConfig, lift, refine_variant
    >>> from normlift_ns.core.evidence import Entries
    >>> entries = Entries(torch.tensor([0, 1, 2]), torch.tensor([1, 2, 1]), torch.ones(3), (2,))
    >>> lifted = lift(Evidence.from_entries([entries], 3), torch.eye(2))
    >>> means = torch.tensor([[0.0, 0, 0], [1, 0, 0], [2, 0, 0]])
    >>> [refine_variant(name, means, lifted, RefineConfig(k=2))[1] for name in ("none", "linear", "paper")]
    [tensor([0., 1.]), tensor([0.7716, 0.6361]), tensor([1., 0.])]
    """
    reliability, directions = variant_reliability(variant, lifted.scalars, beta), lifted.directions()
    config = variant_config(variant, config or RefineConfig())
    if variant == "none":
        return directions
    neighbors = neighbors or nearest_neighbors(means, config.k)
    if variant == "linear":
        return linear_average(directions, reliability, neighbors, config)
    source = variant_source(variant, means, directions, lifted.scalars, config, beta=beta, neighbors=neighbors)
    return directions[source.long()]


def variant_source(
    variant: Variant,
    means: Float[Tensor, "n 3"],
    directions: Float[Tensor, "n d"] | Callable[[Tensor], Tensor],
    scalars: Scalars,
    config: RefineConfig,
    *,
    beta: float = 1.0,
    neighbors: Neighbors | None = None,
) -> Int32[Tensor, " n"]:
    """Run `refine` as one of the variants that vote.

    Raises:
        ValueError: if the variant is unknown, or `refine` rejects the arguments.
    """
    reliability, config = variant_reliability(variant, scalars, beta), variant_config(variant, config)
    return refine(means, directions, reliability, config, own=scalars.own_evidence, neighbors=neighbors)


def variant_config(variant: Variant, config: RefineConfig) -> RefineConfig:
    """Return the options of a variant's vote.

    The result is `config` if that is for the variant's kind of vote. Otherwise it has the defaults of that kind, with
    the `k` and `prior` of `config`. All variants but "posterior" use the paper's vote.

    >>> variant_config("posterior", RefineConfig(vote="paper", k=12, sigma_d=3.0)).numbers.sigma_d
    2.0
    """
    kind: VoteKind = "posterior" if variant == "posterior" else "paper"
    return config if config.vote == kind else RefineConfig(vote=kind, k=config.k, prior=config.prior)


def variant_reliability(variant: Variant, scalars: Scalars, beta: float = 1.0) -> Float[Tensor, " n"]:
    """Return the R that a variant votes with.

    "plain_knn" uses 1 for every Gaussian with a direction, "norm_only" uses ||f||, and "support_only" uses
    N_eff / (N_eff + beta). All others use NormLift's R, the product of the last two.

    Raises:
        ValueError: if the variant is unknown.
    """
    if variant not in get_args(Variant):
        raise InputError(f"variant must be one of {', '.join(get_args(Variant))}; got {variant!r}")
    if variant == "plain_knn":
        return (scalars.norm > 0).to(scalars.norm.dtype)
    if variant == "norm_only":
        return scalars.norm
    support = torch.where(scalars.n_eff > 0, scalars.n_eff / (scalars.n_eff + beta), 0.0)
    return support if variant == "support_only" else scalars.norm * support


def linear_average(
    directions: Float[Tensor, "n d"], reliability: Float[Tensor, " n"], neighbors: Neighbors, config: RefineConfig
) -> Float[Tensor, "n d"]:
    """Return normalize(sum_{k in N+} R_k d_ik u_k), or u_i if that sum is 0."""
    out, width = torch.empty_like(directions), decay_width(neighbors.spacing, config)
    for i in torch.arange(len(directions), device=directions.device).split(2**14):
        group = torch.cat([i[:, None], neighbors.index[i]], dim=1).clamp(min=0)
        weight = voting_weights(neighbors, width, i, reliability).to(directions.dtype)
        out[i] = torch.einsum("ik,ikd->id", weight, directions[group])
    length = torch.linalg.vector_norm(out, dim=1, keepdim=True)
    return torch.where(length > 0, out / length, directions)
