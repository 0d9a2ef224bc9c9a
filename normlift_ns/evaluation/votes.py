"""Alternative votes over the stored directions of a run: the paper's ablation, and a sweep of every parameter."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache
from typing import Any, get_args

import torch
from jaxtyping import Float
from torch import Tensor

from normlift_ns.core.ablations import Variant, linear_average, variant_config, variant_reliability, variant_source
from normlift_ns.core.field import SemanticField
from normlift_ns.core.lift import Scalars
from normlift_ns.core.neighbors import Neighbors, nearest_neighbors
from normlift_ns.core.storage import StoredDirections
from normlift_ns.options import LiftOptions, RefineConfig, VoteKind

SWEEPS: dict[str, tuple[float, ...]] = {
    "beta": (0.25, 0.5, 1.0, 2.0, 4.0),
    "k": (12, 24, 36, 48, 60),
    "sigma_d": (0.5, 1.0, 1.5, 2.0, 3.0),
    "tau": (0.7, 0.75, 0.8, 0.85, 0.9),
    "gamma": (0.05, 0.1, 0.2, 0.4, 0.8),
    "delta": (0.0, 0.05, 0.1, 0.2, 0.3),
}
"""Values of each parameter, in addition to its default and the values of the runs; the others stay as in the lift.

beta, K and Delta are as in the paper's appendix.
"""
AGREED: dict[str, Variant] = {"consensus": "none", "consensus_paper": "paper", "consensus_posterior": "posterior"}
"""Vote after the consensus, by variant name."""
BETA = LiftOptions().beta
"""Default beta."""


@dataclass(frozen=True)
class Vote:
    """Variant and parameters of a vote."""

    variant: Variant
    config: RefineConfig
    beta: float
    label: Mapping[str, Any]
    """Columns that distinguish it from other votes."""


def own_vote(manifest: Mapping[str, Any]) -> Vote:
    """Return the vote that a run was lifted with, with defaults for values that its manifest does not record."""
    options = manifest.get("options", {})
    kind = {"vote": "paper"} if "vote" in options else {}  # the only one in version 0.1
    config = RefineConfig(**{**kind, **options.get("vote", {})})
    return Vote(config.vote, config, options.get("beta", BETA), {})


def voting_scalars(field: SemanticField) -> Scalars:
    """Return the scalars that a run votes with.

    With consensus, ||f|| is the one before the consensus, from which R was computed.
    """
    scalars, options = field.scalars, field.manifest.get("options", {})
    if not options.get("consensus", False):
        return scalars
    support = scalars.n_eff / (scalars.n_eff + options.get("beta", BETA))
    return replace(scalars, norm=torch.where(support > 0, scalars.reliability / support, 0.0).clamp(max=1))


def ablation(owns: Sequence[Vote]) -> Iterator[list[Vote]]:
    """Yield the variants of the paper's table 2 and the posterior vote, one vote per run."""
    return _variants(owns, {variant: variant for variant in get_args(Variant)})


def agreed_ablation(owns: Sequence[Vote]) -> Iterator[list[Vote]]:
    """Yield `AGREED` for runs with consensus, one vote per run."""
    return _variants(owns, AGREED)


def _variants(owns: Sequence[Vote], variants: Mapping[str, Variant]) -> Iterator[list[Vote]]:
    for name, variant in variants.items():
        yield [replace(own, variant=variant, label={"variant": name}) for own in owns]


def sweeps(owns: Sequence[Vote]) -> Iterator[list[Vote]]:
    """Yield the votes of `SWEEPS` around the values of each run, one vote per run.

    They include the default and the values of the runs, and mark both.
    """
    for parameter, values in SWEEPS.items():
        default = default_of(parameter, owns[0].config.vote)
        used = {_value(own, parameter) for own in owns}
        for value in sorted({*values, default, *used}):
            label = {"parameter": parameter, "value": value, "default": value == default, "own": value in used}
            yield [_changed(own, parameter, value, label) for own in owns]


def default_of(parameter: str, kind: VoteKind) -> float:
    """Return the default of a parameter of `SWEEPS` for a kind of vote."""
    return _value(Vote(kind, RefineConfig(vote=kind), BETA, {}), parameter)


def _value(vote: Vote, parameter: str) -> float:
    if parameter == "beta":
        return vote.beta
    return getattr(vote.config if parameter == "k" else vote.config.numbers, parameter)


def _changed(own: Vote, parameter: str, value: float, label: Mapping[str, Any]) -> Vote:
    if parameter == "beta":
        return replace(own, beta=value, label=label)
    changed: dict[str, Any] = {parameter: int(value) if parameter == "k" else value}
    return replace(own, config=replace(own.config, **changed), label=label)


def voter(field: SemanticField, means: Float[Tensor, "n 3"], device: str) -> Callable[[Vote], SemanticField]:
    """Return a function that votes again on the device.

    It searches neighbors once per K. Only linear averaging holds all directions in memory.
    """
    device_field, means = field.to(device), means.to(device)
    scalars = voting_scalars(device_field)

    @cache
    def neighbors(k: int) -> Neighbors:
        return nearest_neighbors(means, k)

    def unrefined(gaussians: Tensor) -> Tensor:
        return device_field.directions(gaussians, refined=False)

    def apply(vote: Vote) -> SemanticField:
        near = neighbors(vote.config.k)
        own = torch.arange(len(field), dtype=torch.int32)
        if vote.variant == "none":
            return replace(field, source=own)
        if vote.variant == "linear":
            r = variant_reliability(vote.variant, scalars, vote.beta)
            config = variant_config(vote.variant, vote.config)
            directions = linear_average(unrefined(own.long().to(device)), r, near, config)
            valid = (directions != 0).any(dim=1)
            norm = torch.where(valid & (device_field.scalars.norm <= 0), 1.0, device_field.scalars.norm)
            changed = replace(field.scalars, norm=norm.to(field.scalars.norm))
            store = StoredDirections(directions[valid].half().cpu(), None)
            return replace(field, scalars=changed, source=own, store=store)
        kwargs = {"beta": vote.beta, "neighbors": near}
        source = variant_source(vote.variant, means, unrefined, scalars, vote.config, **kwargs)
        return replace(field, source=source.cpu())

    return apply
