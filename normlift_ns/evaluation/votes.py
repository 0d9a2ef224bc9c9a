"""Other votes over the directions that a run stores: the paper's ablation, and a sweep of every parameter."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from functools import cache
from typing import Any, get_args

import torch
from jaxtyping import Float
from torch import Tensor

from normlift_ns.core.ablations import Variant, linear_average, variant_config, variant_reliability, variant_source
from normlift_ns.core.field import SemanticField
from normlift_ns.core.neighbors import Neighbors, nearest_neighbors
from normlift_ns.core.storage import StoredDirections
from normlift_ns.options import RefineConfig

SWEEPS: dict[str, tuple[float, ...]] = {
    "beta": (0.25, 0.5, 1.0, 2.0, 4.0),
    "k": (12, 24, 36, 48, 60),
    "sigma_d": (0.5, 1.0, 1.5, 2.0, 3.0),
    "tau": (0.7, 0.75, 0.8, 0.85, 0.9),
    "gamma": (0.05, 0.1, 0.2, 0.4, 0.8),
    "delta": (0.0, 0.05, 0.1, 0.2, 0.3),
}
"""Values tried, the others as the run was lifted; beta, K and Delta as in the paper's appendix."""


@dataclass(frozen=True)
class Vote:
    """One way to refine."""

    variant: Variant
    config: RefineConfig
    beta: float
    label: Mapping[str, Any]
    """What tells it from the others."""


def own_vote(manifest: Mapping[str, Any]) -> Vote:
    """The vote that a run was lifted with; the defaults where its manifest does not say."""
    options = manifest.get("options", {})
    kind = {"vote": "paper"} if "vote" in options else {}  # version 0.1 knew no other
    config = RefineConfig(**{**kind, **options.get("vote", {})})
    return Vote(config.vote, config, options.get("beta", 1.0), {})


def ablation(own: Vote) -> Iterator[Vote]:
    """The variants of the paper's table 2, and the posterior vote."""
    for variant in get_args(Variant):
        yield replace(own, variant=variant, label={"variant": variant})


def sweeps(own: Vote) -> Iterator[Vote]:
    """`SWEEPS` around the run's own values."""
    for parameter, values in SWEEPS.items():
        for value in values:
            label = {"parameter": parameter, "value": value}
            if parameter == "beta":
                yield replace(own, beta=value, label=label)
            else:
                changed: dict[str, Any] = {parameter: int(value) if parameter == "k" else value}
                yield replace(own, config=replace(own.config, **changed), label=label)


def voter(field: SemanticField, means: Float[Tensor, "n 3"], device: str) -> Callable[[Vote], SemanticField]:
    """Votes again, on the device; neighbours are searched once per K. Only linear averaging holds all directions."""
    there, places = field.to(device), means.to(device)

    @cache
    def neighbors(k: int) -> Neighbors:
        return nearest_neighbors(places, k)

    def unrefined(gaussians: Tensor) -> Tensor:
        return there.directions(gaussians, refined=False)

    def voted(vote: Vote) -> SemanticField:
        near = neighbors(vote.config.k)
        own = torch.arange(len(field), dtype=torch.int32)
        if vote.variant == "none":
            return replace(field, source=own)
        if vote.variant == "linear":
            r = variant_reliability(vote.variant, there.scalars, vote.beta)
            config = variant_config(vote.variant, vote.config)
            found = linear_average(unrefined(own.long().to(device)), r, near, config)
            has = (found != 0).any(dim=1)
            norm = torch.where(has & (there.scalars.norm <= 0), 1.0, there.scalars.norm)
            scalars = replace(field.scalars, norm=norm.to(field.scalars.norm))
            return replace(field, scalars=scalars, source=own, store=StoredDirections(found[has].half().cpu(), None))
        scalars, how = there.scalars, {"beta": vote.beta, "neighbors": near}
        return replace(field, source=variant_source(vote.variant, places, unrefined, scalars, vote.config, **how).cpu())

    return voted
