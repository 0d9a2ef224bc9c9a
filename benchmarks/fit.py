"""Hyper-parameters of the vote, fitted on some damages and seeds and reported on others; sensitivity curves.

    python -m benchmarks.fit                          tabletop and demo room
    python -m benchmarks.fit --scenes demo --voters 1500

Procedure, fixed before any run: start from the defaults. For two rounds, go through tau, gamma, sigma_d, K, Delta in
this order and set each to the value of its grid with the highest mean mIoU over `FIT` (damages, all scenes, seeds from
100 on); a change counts only if it gains at least `WORTH` points. Then report defaults and fitted values on `HELD_OUT`
(other damages, seeds from 200 on), with 95 % intervals of the paired difference, the curve of every parameter around
the defaults there, and the two readings of unlabelled pixels. Writes results/fit.json.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from benchmarks.accuracy import mean_and_interval, worlds
from benchmarks.damage import LADDER, Damage, observe
from benchmarks.report import RESULTS, Report
from benchmarks.variants import Scores, lifted_scores
from benchmarks.worlds import Words, World
from normlift_ns import Neighbors, RefineConfig, lift, nearest_neighbors
from normlift_ns.core.metrics import class_scores, classify, confusion

FIT = ("mild", "wrong classes", "split masks", "few views", "shifted masks")
HELD_OUT = ("noise", "merged masks", "dropped masks", "dominant view", "pose noise", "hard")
GRIDS: dict[str, tuple[float, ...]] = {
    "tau": (0.6, 0.7, 0.75, 0.8, 0.85, 0.9, 0.95),
    "gamma": (0.01, 0.02, 0.05, 0.1, 0.2),
    "sigma_d": (1.0, 2.0, 3.0, 4.0, 6.0),
    "k": (12, 24, 36, 48, 60),
    "delta": (0.0, 0.05, 0.1, 0.2, 0.3),
}
BETAS = (0.25, 0.5, 1.0, 2.0, 4.0)
WORTH = 0.1
MOST = int(max(GRIDS["k"]))


@dataclass(frozen=True)
class Observation:
    """One damaged lift with the cosines among the neighbours of a sample of Gaussians: any vote is cheap then."""

    scene: str
    damage: str
    seed: int
    scores: Scores
    group: Tensor
    """[M, 1 + MOST] voters and their neighbours, -1 where there are fewer."""
    distance: Tensor
    """[M, 1 + MOST], in units of the scene's median spacing."""
    gram: Tensor
    """[M, 1 + MOST, 1 + MOST] cosines, half precision."""
    norm: Tensor
    n_eff: Tensor
    """[N]"""
    diluted: Tensor
    """R with unlabelled pixels as observations of nothing."""
    truth: Tensor
    """[M]"""

    def reliability(self, beta: float) -> Tensor:
        """R for another beta."""
        n = self.n_eff
        return torch.where(n > 0, self.norm * n / (n + beta), 0.0)

    def sources(self, config: RefineConfig, reliability: Tensor) -> Tensor:
        """[M] whose direction every voter takes: equations 9 and 10, as `refine` evaluates them."""
        size = config.k + 1
        group, distance = self.group[:, :size], self.distance[:, :size]
        r = torch.where(group >= 0, reliability[group.clamp(min=0)], 0.0)
        weight = r * torch.exp(-0.5 * (distance / config.sigma_d) ** 2)
        gate = torch.sigmoid((self.gram[:, :size, :size].float() - config.tau) / config.gamma)
        score = r * torch.einsum("mjk,mk->mj", gate, weight)
        best, choice = score[:, 1:].max(dim=1)
        wins = best > score[:, 0] + config.delta
        return torch.where(wins, group.gather(1, choice[:, None] + 1).squeeze(1), group[:, 0])

    def miou(self, config: RefineConfig, reliability: Tensor | None = None) -> float:
        """mIoU of the sample after the vote, in points."""
        source = self.sources(config, self.reliability(1.0) if reliability is None else reliability)
        found = classify(self.scores.cosine[source], self.scores.valid[source])
        return 100 * class_scores(confusion(self.truth, found, self.scores.cosine.shape[1])).miou

    def unrefined(self) -> float:
        """mIoU of the sample before the vote, in points."""
        own = self.group[:, 0]
        found = classify(self.scores.cosine[own], self.scores.valid[own])
        return 100 * class_scores(confusion(self.truth, found, self.scores.cosine.shape[1])).miou


def observation(
    world: World, words: Words, name: str, damage: Damage, seed: int, neighbors: Neighbors, voters: Tensor
) -> Observation:
    """Lifts, and multiplies the directions of every voter's neighbours with each other."""
    observed = observe(world, words, damage, seed)
    lifted = lift(observed.evidence, observed.features)
    diluted = lift(observed.evidence, observed.features, unlabeled="dilute").reliability
    group = torch.cat([voters[:, None], neighbors.index[voters].long()], dim=1)
    spacing = neighbors.spacing[neighbors.spacing.isfinite()].median()
    distance = torch.cat([torch.zeros(len(voters), 1), neighbors.distance[voters]], dim=1) / spacing
    gram = torch.empty(len(voters), MOST + 1, MOST + 1, dtype=torch.float16)
    for rows in torch.arange(len(voters)).split(256):
        needed, place = group[rows].clamp(min=0).unique(return_inverse=True)
        u = lifted.directions(needed)[place]
        gram[rows] = (u @ u.transpose(1, 2)).half()
    scores = lifted_scores(lifted, words.classes)
    return Observation(
        world.name, name, seed, scores, group, distance.float(), gram, lifted.norm, lifted.n_eff, diluted,
        world.truth[voters],
    )  # fmt: skip


def observations(
    names: Sequence[str], damages: Sequence[str], seeds: Sequence[int], voters: int, views: int | None
) -> Iterator[Observation]:
    """All observations of all scenes."""
    for world, words in worlds(False, names, views):
        neighbors = nearest_neighbors(world.scene.means, MOST)
        known = (world.truth >= 0).nonzero().squeeze(1)
        for seed in seeds:
            g = torch.Generator().manual_seed(seed)
            sample = known[torch.randperm(len(known), generator=g)[:voters]]
            for name in damages:
                yield observation(world, words, name, LADDER[name], seed, neighbors, sample)


def mean_miou(found: Sequence[Observation], config: RefineConfig) -> float:
    """Mean over observations."""
    return float(np.mean([one.miou(config) for one in found]))


def with_value(config: RefineConfig, parameter: str, value: float) -> RefineConfig:
    """The configuration with one parameter changed."""
    changed: dict[str, Any] = {parameter: int(value) if parameter == "k" else value}
    return replace(config, **changed)


def fit(found: Sequence[Observation], rounds: int = 2) -> RefineConfig:
    """The procedure at the top of this file."""
    config = RefineConfig()
    best = mean_miou(found, config)
    for _ in range(rounds):
        for parameter, grid in GRIDS.items():
            for value in grid:
                tried = with_value(config, parameter, value)
                miou = mean_miou(found, tried)
                if miou >= best + WORTH:
                    config, best = tried, miou
            print(f"{parameter}: {getattr(config, parameter)}, mIoU {best:.2f}", flush=True)
    return config


def main(arguments: argparse.Namespace) -> None:
    torch.set_grad_enabled(False)
    report, default = Report("fit"), RefineConfig()
    given = (arguments.voters, arguments.views)
    seeds = range(100, 100 + arguments.seeds)
    fitted = fit(list(observations(arguments.scenes, FIT, seeds, *given)))
    for parameter in GRIDS:
        report.add(f"fitted.{parameter}", getattr(fitted, parameter), f"default {getattr(default, parameter)}")
    seeds = range(200, 200 + arguments.seeds)
    rows: dict[str, list[float]] = {}

    def add(key: str, value: float) -> None:
        rows.setdefault(key, []).append(value)

    for one in observations(arguments.scenes, HELD_OUT, seeds, *given):
        base, new = one.miou(default), one.miou(fitted)
        add("held_out.none", one.unrefined())
        add("held_out.default", base)
        add("held_out.fitted", new)
        add("held_out.fitted_minus_default", new - base)
        add(f"held_out.{one.damage}.fitted_minus_default", new - base)
        add("held_out.dilute_minus_ignore", one.miou(default, one.diluted) - base)
        for parameter, grid in GRIDS.items():
            for value in grid:
                add(f"curve.{parameter}.{value}", one.miou(with_value(default, parameter, value)))
        for beta in BETAS:
            add(f"curve.beta.{beta}", one.miou(default, one.reliability(beta)))
    for key, values in rows.items():
        mean, half = mean_and_interval(values)
        report.add(key, mean, "points, mIoU")
        if not key.startswith("curve"):
            report.add(f"{key}_ci95", half, "points, half of the 95 % interval over damages and seeds")
    report.write(arguments.output)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenes", nargs="+", default=["tabletop", "demo"], help="tabletop, demo")
    parser.add_argument("--voters", type=int, default=2000, help="Gaussians that vote and count")
    parser.add_argument("--views", type=int, help="training views of the tabletop; all by default")
    parser.add_argument("--seeds", type=int, default=3, help="repeats for the fit, and as many for the report")
    parser.add_argument("--output", type=Path, default=RESULTS, help="folder of the JSON file")
    main(parser.parse_args())
