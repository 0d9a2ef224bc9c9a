"""Accuracy where the truth is known: the refinement's variants and other methods over a ladder of damage.

    python -m benchmarks.accuracy                     tabletop and demo room, every Gaussian votes; for a GPU
    python -m benchmarks.accuracy --voters 4000 --views 22
                                                      for CPUs: a sample votes and counts, half of the tabletop's views,
                                                      no 2D accuracy, no A^2 and top-k weights
    python -m benchmarks.accuracy --quick             demo room of 20,000 Gaussians, three steps of the ladder, 2 seeds

Writes results/accuracy.json: means over seeds with 95 % intervals (Student's t), in points (per cent).
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from scipy import stats
from torch import Tensor

from benchmarks.damage import LADDER, Damage, Observed, observe
from benchmarks.report import RESULTS, Report
from benchmarks.variants import (
    VARIANTS,
    Scores,
    centre_evidence,
    lifted_scores,
    median_scores,
    only,
    refined_scores,
    top_evidence,
)
from benchmarks.worlds import Words, World, demo, made_words, real_words, tabletop, with_floaters
from normlift_ns import Lifted, Neighbors, RefineConfig, lift, nearest_neighbors, refine
from normlift_ns.core.metrics import class_scores, classify, confusion, spearman
from normlift_ns.evaluation.signals import accuracy_bins

SEEDS = 8
VARIES = 0.05
"""Accuracy varies over bins of reliability if their means span at least this much."""
PRESETS = ("preset_half", "preset_every_second_view")
OTHERS = {"sfs": "A^2 weights", "occam": "centre pixels", "vala": "gated geometric median", "drsplat": "top-k rays"}


def scores_2d(world: World, scores: Scores) -> dict[str, float]:
    """mIoU of composited scores in the sampled pixels of the held-out views, in points."""
    rows, truth = world.pixels
    image = torch.zeros(len(truth), world.classes, device=scores.cosine.device)
    weight = rows.weight.to(image)[:, None]
    gaussian = rows.row_index().to(image.device)
    image.index_add_(0, rows.column.long().to(image.device), weight * scores.cosine[gaussian])
    found = classify(image, (image != 0).any(1)).cpu()
    return {"miou_2d": 100 * class_scores(confusion(truth, found, world.classes)).miou}


def scores_3d(world: World, scores: Scores, counted: Tensor) -> dict[str, float]:
    """mIoU and mAcc over Gaussians, in points."""
    found = classify(scores.cosine[counted], scores.valid[counted])
    result = class_scores(confusion(world.truth[counted], found, world.classes))
    return {"miou": 100 * result.miou, "macc": 100 * result.macc}


class Bench:
    """One scene, with what does not depend on damage."""

    def __init__(self, world: World, words: Words, voters: int | None, device: str, config: RefineConfig) -> None:
        self.world, self.words, self.config = world.to(device), words, config
        self.classes = words.classes.to(device)
        known = (self.world.truth >= 0).nonzero().squeeze(1)
        g = torch.Generator().manual_seed(0)
        self.sampled = voters is not None and voters < len(known)
        self.counted = known[torch.randperm(len(known), generator=g)[:voters].to(device)] if self.sampled else known
        self.neighbors: Neighbors = nearest_neighbors(self.world.scene.means, config.k)
        self.voting = only(self.neighbors, self.counted if self.sampled else None)
        self.others = {"occam": replace(self.world, evidence=centre_evidence(self.world))}
        if not self.sampled:
            self.others["sfs"] = replace(self.world, evidence=self.world.squared.to(device))
            self.others["drsplat"] = replace(self.world, evidence=top_evidence(self.world))

    def run(self, damage: Damage, seed: int) -> dict[str, Any]:
        """All variants and methods on one observation."""
        world, known = self.world, self.world.truth >= 0
        observed = observe(world, self.words, damage, seed)
        lifted = lift(observed.evidence, observed.features)
        plain = lifted_scores(lifted, self.classes)
        row: dict[str, Any] = {}
        for variant in VARIANTS:
            scores = refined_scores(variant, world.scene.means, lifted, plain, self.voting, self.config)
            row[variant] = scores_3d(world, scores, self.counted)
            if not self.sampled:
                row[variant] |= scores_2d(world, scores)
        if not self.sampled:
            row |= self._presets(observed, lifted, plain)
        row["vala"] = scores_3d(
            world, median_scores(observed, self.classes, self.counted if self.sampled else None), self.counted
        )
        for name, other in self.others.items():
            seen = observe(other, self.words, damage, seed)
            row[name] = scores_3d(world, lifted_scores(lift(seen.evidence, seen.features), self.classes), self.counted)
        correct = classify(plain.cosine, plain.valid) == world.truth
        for name, key in (("reliability", lifted.scalars.reliability), ("norm", lifted.scalars.norm)):
            row[f"{name}_bins"] = accuracy_bins(key[known], correct[known])
        return row

    def _presets(self, observed: Observed, lifted: Lifted, plain: Scores) -> dict[str, Any]:
        """The full variant by faster lifts, as in `benchmarks.presets`."""
        means = self.world.scene.means
        read = partial(lifted.directions, dtype=torch.float16)
        given = {"own": lifted.scalars.own_evidence, "neighbors": self.neighbors}
        source = refine(means, read, lifted.scalars.reliability, self.config, **given).long()
        half = Scores(plain.cosine[source], plain.valid[source])
        views = list(range(0, observed.evidence.num_views, 2))
        columns = observed.evidence.columns_of(views)
        fewer = lift(observed.evidence.select_views(views), observed.features[columns])
        scores = lifted_scores(fewer, self.classes)
        second = refined_scores("paper", means, fewer, scores, self.neighbors, self.config)
        found = {"half": half, "every_second_view": second}
        return {f"preset_{name}": scores_3d(self.world, scores, self.counted) for name, scores in found.items()}


def worlds(quick: bool, names: Sequence[str], views: int | None = None) -> Iterator[tuple[World, Words]]:
    """The scenes and the vectors of their classes; `views` training views of the tabletop."""
    if "tabletop" in names and not quick:
        yield tabletop(views), real_words()
    if "demo" in names:
        world = demo(20_000 if quick else 40_000)
        yield world, made_words(world.classes)


def run_all(
    quick: bool, names: Sequence[str], views: int | None, voters: int | None, seeds: int, device: str
) -> list[dict[str, Any]]:
    """One row per scene, damage and seed."""
    ladder = {name: LADDER[name] for name in (("mild", "few views", "hard") if quick else LADDER)}
    rows = []
    for world, words in worlds(quick, names, views):
        for floaters in (False, True):
            steps = {name: damage for name, damage in ladder.items() if damage.floaters == floaters}
            if len(steps) == 0:
                continue
            bench = Bench(with_floaters(world) if floaters else world, words, voters, device, RefineConfig())
            for seed in range(seeds):
                for name, damage in steps.items():
                    rows.append({"scene": world.name, "damage": name, "seed": seed, **bench.run(damage, seed)})
                    shown = " ".join(f"{v} {rows[-1][v]['miou']:.1f}" for v in VARIANTS)
                    print(f"{world.name}, {name}, seed {seed}: {shown}", flush=True)
    return rows


def mean_and_interval(values: Sequence[float]) -> tuple[float, float]:
    """Mean over seeds and half the width of its 95 % interval."""
    n = len(values)
    half = stats.t.ppf(0.975, n - 1) * np.std(values, ddof=1) / n**0.5 if n > 1 else float("nan")
    return float(np.mean(values)), float(half)


def summarize(rows: list[dict[str, Any]], report: Report) -> None:
    """Means over the ladder and per step, with intervals; keys of the tabletop (or the only scene) have no prefix."""
    scenes = list(dict.fromkeys(row["scene"] for row in rows))
    for scene in scenes:
        prefix = "" if scene == scenes[0] else f"{scene}."
        of_scene = [row for row in rows if row["scene"] == scene]
        steps = list(dict.fromkeys(row["damage"] for row in of_scene))
        seeds = sorted({row["seed"] for row in of_scene})
        methods = [m for m in (*VARIANTS, *OTHERS, *PRESETS) if m in of_scene[0]]

        def value(method: str, metric: str, seed: int, steps: Sequence[str], rows: list = of_scene) -> float:
            """Mean over steps of the ladder of one seed."""
            return float(np.mean([r[method][metric] for r in rows if r["seed"] == seed and r["damage"] in steps]))

        def add(key: str, values: Sequence[float], prefix: str = prefix) -> None:
            mean, half = mean_and_interval(values)
            report.add(prefix + key, mean, "points")
            report.add(f"{prefix}{key}_ci95", half, "points, half of the 95 % interval over seeds")

        for method in methods:
            group = "ablation" if method in VARIANTS else "preset" if method in PRESETS else "baseline"
            name = method.removeprefix("preset_")
            for metric in of_scene[0][method]:
                add(
                    f"{group}.{name}.{metric}",
                    [value(method, metric, s, steps) for s in seeds],
                )
            for step in steps if group == "ablation" else ():
                add(f"ladder.{step}.{name}.miou", [value(method, "miou", s, [step]) for s in seeds])
        for method in (variant for variant in VARIANTS if variant != "paper"):
            pairs = [value("paper", "miou", s, steps) - value(method, "miou", s, steps) for s in seeds]
            add(f"ablation.paper_minus_{method}.miou", pairs)
        _add_reliability(of_scene, steps, prefix, report)


def _add_reliability(rows: list[dict[str, Any]], steps: Sequence[str], prefix: str, report: Report) -> None:
    """Spearman between ten bins by R (or ||f||) and their accuracy, means over seeds, per step of the ladder."""
    varying = {"reliability": [], "norm": []}
    for step in steps:
        for name, found in varying.items():
            bins = np.mean([row[f"{name}_bins"] for row in rows if row["damage"] == step], axis=0)
            value = spearman(torch.arange(10.0), torch.from_numpy(bins))
            report.add(f"{prefix}{name}.{step}.spearman_bins", value, "Spearman, ten bins")
            if name == "reliability":
                report.add(f"{prefix}{name}.{step}.lowest_bin", 100 * bins[0], "points, accuracy of the lowest tenth")
                report.add(
                    f"{prefix}{name}.{step}.highest_bin", 100 * bins[-1], "points, accuracy of the highest tenth"
                )
            if np.ptp(bins) >= VARIES:
                found.append(value)
    for name, found in varying.items():
        if len(found) > 0:
            mean = float(np.mean(found))
            report.add(f"{prefix}{name}.spearman_bins_mean", mean, "mean over steps where accuracy varies")


def main(arguments: argparse.Namespace) -> None:
    torch.set_grad_enabled(False)
    device = "cuda" if torch.cuda.is_available() else "cpu"
    seeds = 2 if arguments.quick else arguments.seeds
    voters = 4000 if arguments.quick and arguments.voters is None else arguments.voters
    rows = run_all(arguments.quick, arguments.scenes, arguments.views, voters, seeds, device)
    report = Report("accuracy")
    report.add("voters", -1 if voters is None else voters, "Gaussians per scene that count; -1: all")
    report.add("seeds", seeds, "repeats")
    report.add("tabletop_views", -1 if arguments.views is None else arguments.views, "training views; -1: all")
    summarize(rows, report)
    report.write(arguments.output)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="a small scene, three steps, two seeds")
    parser.add_argument("--voters", type=int, help="Gaussians that vote and count; all by default")
    parser.add_argument("--views", type=int, help="training views of the tabletop; all by default")
    parser.add_argument("--seeds", type=int, default=SEEDS, help="repeats")
    parser.add_argument("--scenes", nargs="+", default=["tabletop", "demo"], help="tabletop, demo")
    parser.add_argument("--output", type=Path, default=RESULTS, help="folder of the JSON file")
    main(parser.parse_args())
