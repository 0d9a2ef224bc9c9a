"""Fit of the hyper-parameters of the vote on some damages and seeds, evaluated on others, with sensitivity curves.

    python -m research.fit                                        tabletop and plain room, for a GPU
    python -m research.fit --scenes demo --voters 500 --seeds 1   for CPUs

K stays at 36, because the time of the vote grows with its square. sigma_d is at least 1, because below 1 only the
Gaussian itself has an influence. The curves extend further. Every combination in `SEARCH` is tried on `FIT` (damages,
all scenes, seeds from 100 on), and the highest mean mIoU wins. Then `START` and the winner are compared on `HELD_OUT`
(other damages, seeds from 200 on). Results are 95 % intervals of the paired difference, a curve of every parameter
around the winner, and other treatments of unlabeled pixels and of the weights. Plain voting has its own best
combination, to separate the effect of parameters from that of the method. Two earlier searches with wider grids reached
their ends, K = 60 and sigma_d = 0.25, before these bounds were set. The command writes results/fit.json.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from torch import Tensor

from normlift_ns import Neighbors, RefineConfig, lift, nearest_neighbors
from normlift_ns.core.metrics import class_scores, classify, confusion
from research.accuracy import worlds
from research.accuracy_report import mean_and_interval
from research.damage import LADDER, Damage, observe
from research.report import RESULTS, Report
from research.synthetic_scenes import Words, World
from research.variants import Scores, lifted_scores

FIT = ("noise only", "mild", "wrong classes", "split masks", "few views", "shifted masks")
HELD_OUT = ("noise", "merged masks", "dropped masks", "dominant view", "pose noise", "hard")
START = RefineConfig(vote="paper", k=36, sigma_d=3.0, tau=0.8, gamma=0.05, delta=0.1)
"""A first guess, from an exploration on other data."""
SEARCH: dict[str, tuple[float, ...]] = {
    "tau": (0.6, 0.7, 0.8, 0.85, 0.9, 0.95),
    "gamma": (0.02, 0.05, 0.1, 0.2, 0.4),
    "sigma_d": (1.0, 1.5, 2.0, 3.0, 6.0),
    "delta": (0.0, 0.02, 0.1),
}
CURVES: dict[str, tuple[float, ...]] = {
    "tau": (0.5, 0.6, 0.7, 0.75, 0.8, 0.85, 0.9, 0.95),
    "gamma": (0.01, 0.02, 0.05, 0.1, 0.2, 0.4, 0.8),
    "sigma_d": (0.25, 0.5, 1.0, 1.5, 2.0, 3.0, 4.0, 6.0),
    "k": (6, 12, 24, 36, 48, 60),
    "delta": (0.0, 0.02, 0.05, 0.1, 0.2, 0.3),
}
BETAS = (0.25, 0.5, 1.0, 2.0, 4.0)
MOST = int(max(CURVES["k"]))


@dataclass(frozen=True)
class Observation:
    """A damaged lift with the cosines between the neighbors of a sample of Gaussians, from which any vote is fast."""

    scene: str
    damage: str
    seed: int
    scores: Scores
    group: Tensor
    """[M, 1 + MOST] voters and their neighbors, or -1 for missing neighbors."""
    distance: Tensor
    """[M, 1 + MOST], in units of the scene's median spacing."""
    gram: Tensor
    """[M, 1 + MOST, 1 + MOST] cosines, half precision."""
    norm: Tensor
    n_eff: Tensor
    """[N]"""
    diluted: Tensor
    """R with unlabeled pixels as views without a feature."""
    truth: Tensor
    """[M]"""

    def reliability(self, beta: float) -> Tensor:
        """Return R for another beta."""
        n = self.n_eff
        return torch.where(n > 0, self.norm * n / (n + beta), 0.0)

    def sources(self, config: RefineConfig, reliability: Tensor) -> Tensor:
        """Return [M], the Gaussian whose direction each voter takes: equations 9 and 10, as in `refine`."""
        size, numbers = config.k + 1, config.numbers
        group, distance = self.group[:, :size], self.distance[:, :size]
        r = torch.where(group >= 0, reliability[group.clamp(min=0)], 0.0)
        square = (distance / numbers.sigma_d) ** 2
        nearest = torch.where(r > 0, square, torch.inf).amin(dim=1, keepdim=True)
        weight = r * torch.exp(-0.5 * (square - nearest).nan_to_num(0).clamp(min=0))
        gate = torch.sigmoid((self.gram[:, :size, :size].float() - numbers.tau) / numbers.gamma)
        score = r * torch.einsum("mjk,mk->mj", gate, weight)
        best, choice = score[:, 1:].max(dim=1)
        margin = numbers.delta * torch.exp(0.5 * nearest.squeeze(1)) if numbers.delta > 0 else 0.0
        wins = best > score[:, 0] + margin
        return torch.where(wins, group.gather(1, choice[:, None] + 1).squeeze(1), group[:, 0])

    def miou(self, config: RefineConfig, reliability: Tensor | None = None) -> float:
        """Return the mIoU of the sample after the vote, in percentage points."""
        source = self.sources(config, self.reliability(1.0) if reliability is None else reliability)
        found = classify(self.scores.cosine[source], self.scores.valid[source])
        return 100 * class_scores(confusion(self.truth, found, self.scores.cosine.shape[1])).miou

    def unrefined(self) -> float:
        """Return the mIoU of the sample before the vote, in percentage points."""
        own = self.group[:, 0]
        found = classify(self.scores.cosine[own], self.scores.valid[own])
        return 100 * class_scores(confusion(self.truth, found, self.scores.cosine.shape[1])).miou


def observation(
    world: World, words: Words, name: str, damage: Damage, seed: int, neighbors: Neighbors, voters: Tensor
) -> Observation:
    """Lift one observation, and compute the cosines between the neighbors of every voter."""
    observed = observe(world, words, damage, seed)
    lifted = lift(observed.evidence, observed.features)
    diluted = lift(observed.evidence, observed.features, unlabeled="dilute").scalars.reliability
    group = torch.cat([voters[:, None], neighbors.index[voters].long()], dim=1)
    spacing = neighbors.spacing[neighbors.spacing.isfinite()].median()
    distance = torch.nn.functional.pad(neighbors.distance[voters], (1, 0)) / spacing
    gram = torch.empty(len(voters), MOST + 1, MOST + 1, dtype=torch.float16, device=voters.device)
    for rows in torch.arange(len(voters), device=voters.device).split(256):
        needed, place = group[rows].clamp(min=0).unique(return_inverse=True)
        u = lifted.directions(needed)[place]
        gram[rows] = (u @ u.transpose(1, 2)).half()
    scores = lifted_scores(lifted, words.classes.to(voters.device))
    return Observation(
        *(world.name, name, seed, scores, group, distance.float(), gram),
        *(lifted.scalars.norm, lifted.scalars.n_eff, diluted, world.truth[voters]),
    )


@dataclass(frozen=True)
class Site:
    """A scene with the data that all observations of it share."""

    world: World
    words: Words
    neighbors: Neighbors

    def observations(
        self, damages: Sequence[str], seeds: Sequence[int], voters: int, weight_power: Literal[1, 2] = 1
    ) -> Iterator[Observation]:
        """Yield an observation for each seed and damage, with a sample of voters per seed."""
        world = self.world
        if weight_power == 2:
            world = replace(world, evidence=world.squared.to(world.evidence.rows.weight.device))
        known = (world.truth >= 0).nonzero().squeeze(1)
        for seed in seeds:
            g = torch.Generator().manual_seed(seed)
            sample = known[torch.randperm(len(known), generator=g)[:voters].to(known.device)]
            for name in damages:
                yield observation(world, self.words, name, LADDER[name], seed, self.neighbors, sample)


def mean_miou(found: Sequence[Observation], config: RefineConfig) -> float:
    """Return the mean mIoU over observations."""
    return float(np.mean([one.miou(config) for one in found]))


def with_value(config: RefineConfig, parameter: str, value: float) -> RefineConfig:
    """Return the configuration with one parameter changed."""
    changed: dict[str, Any] = {parameter: int(value) if parameter == "k" else value}
    return replace(config, **changed)


def plain(one: Observation) -> Tensor:
    """Return the R of plain voting."""
    return (one.norm > 0).float()


def fit(found: Sequence[Observation], search: Mapping[str, Sequence[float]] = SEARCH) -> tuple[RefineConfig, ...]:
    """Return the best combination for the full method, and that for plain voting."""
    combinations: list[dict[str, Any]] = [dict(zip(search, values)) for values in product(*search.values())]
    configs = [replace(START, **values) for values in combinations]
    full = [mean_miou(found, config) for config in configs]
    knn = [float(np.mean([one.miou(config, plain(one)) for one in found])) for config in configs]
    return configs[int(np.argmax(full))], configs[int(np.argmax(knn))]


def main(arguments: argparse.Namespace) -> None:
    torch.set_grad_enabled(False)
    report = Report("fit")
    device = "cuda" if torch.cuda.is_available() else "cpu"
    found = ((world.to(device), words) for world, words in worlds(False, arguments.scenes, arguments.views))
    sites = [Site(world, words, nearest_neighbors(world.scene.means, MOST)) for world, words in found]
    seeds = range(100, 100 + arguments.seeds)
    fitted, fitted_knn = fit([one for site in sites for one in site.observations(FIT, seeds, arguments.voters)])
    for parameter in CURVES:
        report.add(f"fitted.{parameter}", getattr(fitted, parameter), f"began with {getattr(START, parameter)}")
        report.add(f"fitted_knn.{parameter}", getattr(fitted_knn, parameter), "of plain voting")
    rows: dict[str, list[float]] = {}

    def add(key: str, value: float) -> None:
        rows.setdefault(key, []).append(value)

    given = (HELD_OUT, range(200, 200 + arguments.seeds), arguments.voters)
    for one, squared in (x for site in sites for x in zip(site.observations(*given), site.observations(*given, 2))):
        base, new = one.miou(START), one.miou(fitted)
        for group in ("held_out", f"{one.scene}.held_out"):
            add(f"{group}.none", one.unrefined())
            add(f"{group}.start", base)
            add(f"{group}.fitted", new)
            add(f"{group}.fitted_minus_start", new - base)
            add(f"{group}.knn", one.miou(fitted, plain(one)))
            add(f"{group}.knn_fitted_for_it", one.miou(fitted_knn, plain(one)))
            add(f"{group}.dilute_minus_ignore", one.miou(fitted, one.diluted) - new)
            add(f"{group}.squared_minus_linear", squared.miou(fitted) - new)
            add(f"{group}.squared_minus_linear_unrefined", squared.unrefined() - one.unrefined())
        for parameter, grid in CURVES.items():
            for value in grid:
                add(f"curve.{parameter}.{value}", one.miou(with_value(fitted, parameter, value)))
        for beta in BETAS:
            add(f"curve.beta.{beta}", one.miou(fitted, one.reliability(beta)))
    for key, values in rows.items():
        mean, half = mean_and_interval(values)
        report.add(key, mean, "points, mIoU")
        if not key.startswith("curve"):
            report.add(f"{key}_ci95", half, "points, half of the 95 % interval over damages and seeds")
    report.write(arguments.output)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenes", nargs="+", default=["tabletop", "demo"], help="tabletop, demo")
    parser.add_argument("--voters", type=int, default=20_000, help="Gaussians that vote and count")
    parser.add_argument("--views", type=int, help="training views of the tabletop; all by default")
    parser.add_argument("--seeds", type=int, default=5, help="repeats for the fit, and for the report")
    parser.add_argument("--output", type=Path, default=RESULTS, help="folder of the JSON file")
    main(parser.parse_args())
