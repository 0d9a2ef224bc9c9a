"""Cost of consensus, lift, neighbors, vote and storage, extrapolated from two samples of the Gaussians."""

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
"""Does some work; returns its seconds and its result."""
_LARGE_SAMPLE = {"cpu": 2**13, "cuda": 2**18}
"""Gaussians in the larger sample."""
_SAMPLE_RATIO = 4
"""Ratio of the sizes of the two samples."""
_MAX_SAMPLE_VIEWS = 64
"""Maximum number of views in the samples. The cost of more views is extrapolated in proportion."""


@dataclass(frozen=True)
class _Costs:
    """Cost of one sample: seconds and number of items of every stage, and stored bytes."""

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
    """Measure the cost of each stage of the core of a lift, and the bytes that it stores.

    The evidence of a few views is repeated until there are as many as in the lift. A Gaussian of the sample then has as
    many entries as in the lift. The cost of a stage has a fixed part and a part for each of its items.

    Args:
        evidence: evidence of a few views.
        features: features of their regions.
        views: number of views in the whole lift.
    """
    repeated = min(views, _MAX_SAMPLE_VIEWS)
    times = max(1, round(repeated / evidence.num_views))
    table = features.to(evidence.rows.weight).repeat(times, 1)
    factor = views / (times * evidence.num_views)
    most = min(len(gaussians), _LARGE_SAMPLE.get(gaussians.means.device.type, _LARGE_SAMPLE["cpu"]))
    costs = []
    for count in 2 * (most // _SAMPLE_RATIO, most):  # the first two only load or compile kernels for these sizes
        rows = torch.linspace(0, len(gaussians) - 1, max(1, count), dtype=torch.float64).long()
        rows = rows.to(gaussians.means.device)
        parts = {"rows": evidence.rows.select_rows(rows), "unlabeled": evidence.unlabeled.select_rows(rows)}
        sample = replace(evidence, **parts, num_excluded=0)
        costs.append(_costs(gaussians.means[rows], sample, times, table, options, timed))
    items = _items(evidence, times, len(gaussians), options)
    counts = {name: value * (factor if name != "neighbors" else 1.0) for name, value in items.items()}
    counts |= {name: float(len(gaussians)) for name in ("vote", "store")}
    counts["consensus"] *= factor
    small, large = costs[2:]
    rates = {
        name: _rate((small.items[name], seconds), (large.items[name], large.seconds[name]), counts[name])
        for name, seconds in small.seconds.items()
    }
    stored = _rate((small.items["store"], small.stored), (large.items["store"], large.stored), counts["store"])
    return rates, stored


def _rate(small: tuple[float, float], large: tuple[float, float], count: float) -> Rate:
    """Fit a line through two costs, or one through the origin and the larger if they do not rise."""
    (items, cost), (more, most) = small, large
    each = (most - cost) / (more - items) if more > items else most / max(1.0, more)
    each = min(max(each, 0.0), most / max(1.0, more))
    return Rate(most - each * more, each, count)


def _costs(
    means: Float[Tensor, "m 3"],
    sample: Evidence,
    times: int,
    features: Float[Tensor, "s d"],
    options: LiftOptions,
    timed: Timed,
) -> _Costs:
    """Run all stages of a lift that follow the evidence, on some Gaussians."""
    evidence = Evidence.merge(*[sample] * times)
    lift_kwargs = {"beta": options.beta, "unlabeled": options.unlabeled}
    seconds: dict[str, float] = {}
    table, copied = features, None
    if options.consensus:
        kwargs = {
            "power": options.consensus_power, "sample": options.consensus_sample, "least": options.consensus_least
        }  # fmt: skip
        seconds["consensus"], result = timed(lambda: consensus(evidence, features, **kwargs))
        table = result.features
    seconds["lift"], lifted = timed(lambda: lift(evidence, table, **lift_kwargs))
    if options.consensus:
        seconds["lift"] += timed(lambda: lift(evidence, features, **lift_kwargs))[0]
    if options.refine:
        vote = possible(replace(options.vote, k=min(options.vote.k, max(1, len(means) - 1))), len(means))
        seconds["neighbors"], neighbors = timed(lambda: nearest_neighbors(means, vote.k))
        own, reliability = lifted.scalars.own_evidence, lifted.scalars.reliability
        seconds["vote"], copied = timed(
            lambda: refine(means, lifted.directions, reliability, vote, own=own, neighbors=neighbors)
        )
    store_kwargs = {"tolerance": options.tolerance, "storage": options.storage}
    seconds["store"], field = timed(lambda: SemanticField.build(lifted, means, copied, **store_kwargs))
    stored_bytes = field.manifest["forms"][field.manifest["form"]]["bytes"]
    return _Costs(seconds, _items(sample, times, len(means), options), stored_bytes)


def _items(evidence: Evidence, times: int, gaussians: int, options: LiftOptions) -> dict[str, float]:
    """Count the items of each stage.

    They are the Gaussians sampled in every region for the consensus, evidence entries for the lift, and Gaussians for
    the other stages.
    """
    per_region = torch.bincount(evidence.rows.column.long(), minlength=evidence.num_regions)
    sampled = float(per_region.clamp(max=options.consensus_sample).sum()) * times
    others = dict.fromkeys(("neighbors", "vote", "store"), float(gaussians))
    return {"consensus": sampled, "lift": float(evidence.nnz * times), **others}
