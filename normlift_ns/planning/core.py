"""What consensus, lift, neighbours, vote and storage cost, from two samples of the Gaussians."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from normlift_ns.core.consensus import consensus
from normlift_ns.core.evidence import Evidence
from normlift_ns.core.field import SemanticField
from normlift_ns.core.gaussians import GaussianScene
from normlift_ns.core.lift import lift
from normlift_ns.core.neighbors import nearest_neighbors
from normlift_ns.core.refine import possible, refine
from normlift_ns.options import LiftOptions
from normlift_ns.planning.plan import Rate

Timed = Callable[[Callable[[], Any]], tuple[float, Any]]
"""Does some work; returns its seconds and what it gave."""
_SAMPLE = {"cpu": 2**13, "cuda": 2**18}
"""Gaussians of the larger sample."""
_SMALLER = 4
"""How many times smaller the other one is."""
_MOST_VIEWS = 64
"""A lift of more views is taken for so many times a lift of these."""


@dataclass(frozen=True)
class _Costs:
    """Of one sample: seconds of every stage, how many items it had, and the bytes of what is stored."""

    seconds: dict[str, float]
    items: dict[str, float]
    stored: int


def core_rates(
    gaussians: GaussianScene,
    evidence: Evidence,
    features: Float[Tensor, "s d"],
    options: LiftOptions,
    views: int,
    timed: Timed,
) -> tuple[dict[str, Rate], Rate]:
    """What the core of a lift costs, stage by stage, and the bytes that it stores.

    The evidence of a few views is repeated until there are as many as the lift has, so that a Gaussian of the sample
    has as many entries as it will have. Every stage then costs a fixed part and so much for each of its items.

    Args:
        evidence: of a few views.
        features: of their regions.
        views: of the whole lift.
    """
    repeated = min(views, _MOST_VIEWS)
    times = max(1, round(repeated / evidence.num_views))
    table = features.to(evidence.rows.weight).repeat(times, 1)
    longer = views / (times * evidence.num_views)
    most = min(len(gaussians), _SAMPLE.get(gaussians.means.device.type, _SAMPLE["cpu"]))
    costs = []
    for count in 2 * (most // _SMALLER, most):  # the first two load or compile what these sizes need: not counted
        rows = torch.linspace(0, len(gaussians) - 1, max(1, count), dtype=torch.float64).long()
        rows = rows.to(gaussians.means.device)
        parts = {"rows": evidence.rows.select_rows(rows), "unlabeled": evidence.unlabeled.select_rows(rows)}
        some = replace(evidence, **parts, num_excluded=0)
        costs.append(_costs(gaussians.means[rows], some, times, table, options, timed))
    whole = _items(evidence, times, len(gaussians), options)
    counts = {name: value * (longer if name != "neighbors" else 1.0) for name, value in whole.items()}
    counts |= {name: float(len(gaussians)) for name in ("vote", "store")}
    counts["consensus"] *= longer
    small, large = costs[2:]
    rates = {
        name: _rate((small.items[name], seconds), (large.items[name], large.seconds[name]), counts[name])
        for name, seconds in small.seconds.items()
    }
    stored = _rate((small.items["store"], small.stored), (large.items["store"], large.stored), counts["store"])
    return rates, stored


def _rate(small: tuple[float, float], large: tuple[float, float], count: float) -> Rate:
    """The line through two costs; one through the larger alone where they do not rise."""
    (items, cost), (more, most) = small, large
    each = (most - cost) / (more - items) if more > items else most / max(1.0, more)
    each = min(max(each, 0.0), most / max(1.0, more))
    return Rate(most - each * more, each, count)


def _costs(
    means: Float[Tensor, "m 3"],
    few: Evidence,
    times: int,
    features: Float[Tensor, "s d"],
    options: LiftOptions,
    timed: Timed,
) -> _Costs:
    """Does what a lift does after the evidence, on some Gaussians."""
    evidence = Evidence.merge(*[few] * times)
    how = {"beta": options.beta, "unlabeled": options.unlabeled}
    seconds: dict[str, float] = {}
    table, copied = features, None
    if options.consensus:
        given = {
            "power": options.consensus_power, "sample": options.consensus_sample, "least": options.consensus_least
        }  # fmt: skip
        seconds["consensus"], found = timed(lambda: consensus(evidence, features, **given))
        table = found.features
    seconds["lift"], lifted = timed(lambda: lift(evidence, table, **how))
    if options.consensus:
        seconds["lift"] += timed(lambda: lift(evidence, features, **how))[0]
    if options.refine:
        vote = possible(replace(options.vote, k=min(options.vote.k, max(1, len(means) - 1))), len(means))
        seconds["neighbors"], neighbors = timed(lambda: nearest_neighbors(means, vote.k))
        own, reliability = lifted.scalars.own_evidence, lifted.scalars.reliability
        seconds["vote"], copied = timed(
            lambda: refine(means, lifted.directions, reliability, vote, own=own, neighbors=neighbors)
        )
    stored = {"tolerance": options.tolerance, "storage": options.storage}
    seconds["store"], field = timed(lambda: SemanticField.build(lifted, means, copied, **stored))
    stored_bytes = field.manifest["forms"][field.manifest["form"]]["bytes"]
    return _Costs(seconds, _items(few, times, len(means), options), stored_bytes)


def _items(few: Evidence, times: int, gaussians: int, options: LiftOptions) -> dict[str, float]:
    """What the stages go through: the consensus the Gaussians that it samples in every region, the lift entries of
    the evidence, and the others Gaussians.
    """
    per_region = torch.bincount(few.rows.column.long(), minlength=few.num_regions)
    sampled = float(per_region.clamp(max=options.consensus_sample).sum()) * times
    others = dict.fromkeys(("neighbors", "vote", "store"), float(gaussians))
    return {"consensus": sampled, "lift": float(few.nnz * times), **others}
