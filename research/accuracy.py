"""Accuracy on scenes with known truth: variants of the refinement and other methods, over a ladder of damage.

    python -m research.accuracy                     tabletop and plain room, every Gaussian votes; for a GPU
    python -m research.accuracy --voters 4000 --views 22
                                                      for CPUs: a sample votes and counts, half of the tabletop's views,
                                                      no 2D accuracy, no A^2 and top-k weights
    python -m research.accuracy --quick             plain room of 20,000 Gaussians, three steps of the ladder, 2 seeds
    python -m research.accuracy --minutes 9         start no observation after this many minutes; repeat to continue

The command writes results/accuracy.json: means over seeds with 95 % intervals (Student's t), in percentage points. Keys
without the name of a scene pool all scenes. `ablation` covers the 13 steps of version 0.1's ladder, `undamaged` its
step "noise only", and `views3` its steps with 3 views, except "few views". For each method, they contain the mean, the
gain over no refinement, the worst observation, the share of observations that are worse, and the share of Gaussians
that copy a direction. Later steps are only in `ladder`. Each finished observation is one line of the file `--rows`.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from normlift_ns import Lifted, Neighbors, RefineConfig, lift, nearest_neighbors, refine
from normlift_ns.core.consensus import consensus
from normlift_ns.core.metrics import class_scores, classify, confusion
from normlift_ns.evaluation.studies import Variant, accuracy_bins, variant_config, variant_source
from research.accuracy_report import AGREED, METHODS, THREE, VOTES, summarize
from research.damage import LADDER, STEPS, Damage, Observed, observe
from research.report import RESULTS, Report
from research.rows import append, read_rows
from research.synthetic_scenes import Words, World, demo, made_words, real_words, tabletop, with_floaters
from research.variants import (
    Scores,
    centre_evidence,
    lifted_scores,
    median_scores,
    only,
    refined_scores,
    top_evidence,
)

SEEDS = 8


def scores_2d(world: World, scores: Scores) -> dict[str, float]:
    """Return the mIoU of composited scores in the sampled pixels of the held-out views, in percentage points."""
    rows, truth = world.pixels
    image = torch.zeros(len(truth), world.classes, device=scores.cosine.device)
    weight = rows.weight.to(image)[:, None]
    gaussian = rows.row_index().to(image.device)
    image.index_add_(0, rows.column.long().to(image.device), weight * scores.cosine[gaussian])
    found = classify(image, (image != 0).any(1)).cpu()
    return {"miou_2d": 100 * class_scores(confusion(truth, found, world.classes)).miou}


def scores_3d(world: World, scores: Scores, counted: Tensor) -> dict[str, float]:
    """Return mIoU and mAcc over Gaussians, in percentage points."""
    found = classify(scores.cosine[counted], scores.valid[counted])
    result = class_scores(confusion(world.truth[counted], found, world.classes))
    return {"miou": 100 * result.miou, "macc": 100 * result.macc}


class Bench:
    """A scene with the data that all observations of it share."""

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

    def run(self, damage: Damage, seed: int, *, others: bool = True) -> dict[str, Any]:
        """Return the scores of all methods on one observation.

        Args:
            others: True to include accuracy in 2D, presets, other methods and bins of reliability.
        """
        world, known = self.world, self.world.truth >= 0
        observed = observe(world, self.words, damage, seed)
        lifted = lift(observed.evidence, observed.features)
        plain = lifted_scores(lifted, self.classes)
        agreed = lift(observed.evidence, consensus(observed.evidence, observed.features).features)
        voting = replace(agreed, scalars=lifted.scalars)  # with R as regions were seen, as `normlift_ns.pipeline` does
        row: dict[str, Any] = {}
        for method in METHODS:
            given = (voting, lifted_scores(agreed, self.classes)) if method in AGREED else (lifted, plain)
            scores, copied = self._refined(VOTES[method], *given)
            row[method] = scores_3d(world, scores, self.counted) | {"copied": copied}
            if others and not self.sampled:
                row[method] |= scores_2d(world, scores)
        if not others:
            return row
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
            row[f"{name}_bins"] = [float(x) for x in accuracy_bins(key[known], correct[known])]
        return row

    def _refined(self, variant: Variant, lifted: Lifted, plain: Scores) -> tuple[Scores, float]:
        """Return the scores after a variant, and the share of the counted Gaussians that copy a direction."""
        means = self.world.scene.means
        if variant in ("none", "linear"):
            return refined_scores(variant, means, lifted, plain, self.voting, self.config), 0.0
        config = variant_config(variant, self.config)
        source = variant_source(variant, means, lifted.directions, lifted.scalars, config, neighbors=self.voting).long()
        copied = float((source[self.counted] != self.counted).float().mean())
        return Scores(plain.cosine[source], plain.valid[source]), copied

    def _presets(self, observed: Observed, lifted: Lifted, plain: Scores) -> dict[str, Any]:
        """Return the scores of the default vote after faster lifts, as in `research.presets`."""
        means = self.world.scene.means
        read = partial(lifted.directions, dtype=torch.float16)
        given = {"own": lifted.scalars.own_evidence, "neighbors": self.neighbors}
        source = refine(means, read, lifted.scalars.reliability, self.config, **given).long()
        half = Scores(plain.cosine[source], plain.valid[source])
        views = list(range(0, observed.evidence.num_views, 2))
        columns = observed.evidence.columns_of(views)
        fewer = lift(observed.evidence.select_views(views), observed.features[columns])
        scores = lifted_scores(fewer, self.classes)
        second = refined_scores(self.config.vote, means, fewer, scores, self.neighbors, self.config)
        found = {"half": half, "every_second_view": second}
        return {f"preset_{name}": scores_3d(self.world, scores, self.counted) for name, scores in found.items()}


def worlds(quick: bool, names: Sequence[str], views: int | None = None) -> Iterator[tuple[World, Words]]:
    """Yield the scenes and the vectors of their classes.

    Args:
        views: Number of training views of the tabletop, or None for all.
    """
    if "tabletop" in names and not quick:
        yield tabletop(views), real_words()
    if "demo" in names:
        world = demo(20_000 if quick else 40_000)
        yield world, made_words(world.classes)


def steps_to_run(quick: bool) -> dict[str, Damage]:
    """Return damages by name: the ladder, the later steps, and the ladder with 3 views."""
    if quick:
        return {name: LADDER[name] for name in ("mild", "few views", "hard")}
    fewer = {name + THREE: replace(damage, views=3) for name, damage in LADDER.items() if name != "few views"}
    return STEPS | fewer


def run_all(arguments: argparse.Namespace, seeds: int, voters: int | None, deadline: float) -> list[dict[str, Any]]:
    """Return one row per scene, damage and seed, and stop at the deadline (`time.time`)."""
    device = "cuda" if torch.cuda.is_available() else "cpu"
    steps, path = steps_to_run(arguments.quick), arguments.rows
    run = {"seeds": seeds, "voters": voters, "views": arguments.views, "quick": arguments.quick}
    rows = read_rows(path, run)
    done = {(row["scene"], row["damage"], row["seed"]) for row in rows}
    for world, words in worlds(arguments.quick, arguments.scenes, arguments.views):
        for floaters in (False, True):
            missing = [
                (seed, name) for seed in range(seeds) for name, damage in steps.items()
                if damage.floaters == floaters and (world.name, name, seed) not in done
            ]  # fmt: skip
            if len(missing) == 0 or time.time() > deadline:
                continue
            bench = Bench(with_floaters(world) if floaters else world, words, voters, device, RefineConfig())
            for seed, name in missing:
                if time.time() > deadline:
                    break
                found = bench.run(steps[name], seed, others=name in LADDER)
                rows.append({"scene": world.name, "damage": name, "seed": seed, **found})
                append(path, rows[-1])
                shown = " ".join(f"{method} {found[method]['miou']:.1f}" for method in METHODS)
                print(f"{world.name}, {name}, seed {seed}: {shown}", flush=True)
    return rows


def main(arguments: argparse.Namespace) -> None:
    torch.set_grad_enabled(False)
    start = time.time()
    seeds = 2 if arguments.quick else arguments.seeds
    voters = 4000 if arguments.quick and arguments.voters is None else arguments.voters
    deadline = float("inf") if arguments.minutes is None else start + 60 * arguments.minutes
    rows = run_all(arguments, seeds, voters, deadline)
    scenes = [name for name in arguments.scenes if name == "demo" or not arguments.quick]
    expected = len(scenes) * len(steps_to_run(arguments.quick)) * seeds
    if len(rows) < expected:
        sys.exit(f"{len(rows)} of {expected} observations are finished; repeat the command to continue")
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
    parser.add_argument("--minutes", type=float, help="minutes after which no observation starts")
    parser.add_argument(
        "--rows", type=Path, default=RESULTS / "accuracy_rows.jsonl", help="file of finished observations"
    )
    parser.add_argument("--output", type=Path, default=RESULTS, help="folder of the JSON file")
    main(parser.parse_args())
