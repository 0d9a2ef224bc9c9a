"""Consensus where the truth is known: accuracy before and after the vote, and which R ranks accuracy better.

    python -m benchmarks.consensus                 demo room and half of the tabletop's views, a sample votes
    python -m benchmarks.consensus --quick         demo room of 20,000 Gaussians, three steps, one seed

Writes results/consensus.json. Steps are those of the ladder and three that it does not have: whole groups of things in
one mask, and 3 views of undamaged and of mildly damaged masks. Spearman: between ten bins by R and the accuracy of the
answers of F' in each, with R from the lift of F and from that of F'.
"""

from __future__ import annotations

import argparse
from collections import defaultdict
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from benchmarks import damage as damages
from benchmarks.accuracy import scores_3d, worlds
from benchmarks.accuracy_report import mean_and_interval
from benchmarks.damage import LADDER, Damage, Observed, observe
from benchmarks.report import RESULTS, Report
from benchmarks.variants import Scores, lifted_scores, only, refined_scores
from benchmarks.worlds import Words, World
from normlift_ns import RefineConfig, lift, nearest_neighbors
from normlift_ns.core.consensus import consensus
from normlift_ns.core.metrics import classify, spearman
from normlift_ns.evaluation.signals import accuracy_bins

GROUPED = 0.4
"""Share of views in which three to six things share one mask."""
STEPS: dict[str, Damage] = {
    **{name: damage for name, damage in LADDER.items() if not damage.floaters},
    "group": LADDER["mild"],
    "undamaged, 3 views": Damage(views=3),
    "mild, 3 views": replace(LADDER["mild"], views=3),
}
VARYING = 0.05


def grouped(world: World, words: Words, damage: Damage, seed: int) -> Observed:
    """`observe`, with groups of things in one mask."""
    original = damages._merge_and_drop

    def joined(size: Tensor, damage: Damage, g: torch.Generator) -> tuple[Tensor, Tensor]:
        partner, dropped = original(size, damage, g)
        for view in (torch.rand(len(size), generator=g) < GROUPED).nonzero().flatten().tolist():
            there = (size[view] > 0).nonzero().flatten()
            some = there[torch.randperm(len(there), generator=g)[: int(torch.randint(3, 7, (), generator=g))]]
            partner[view, some] = some[size[view, some].argmax()] if len(some) > 0 else some
        return partner, dropped

    damages._merge_and_drop = joined
    try:
        return observe(world, words, damage, seed)
    finally:
        damages._merge_and_drop = original


def rows_of(world: World, words: Words, voters: int, seeds: int, steps: list[str], device: str) -> Iterator[dict]:
    """Scores of one scene."""
    world, classes = world.to(device), words.classes.to(device)
    known = (world.truth >= 0).nonzero().squeeze(1)
    g = torch.Generator().manual_seed(0)
    some = known[torch.randperm(len(known), generator=g)[:voters].to(device)]
    means = world.scene.means
    voting = only(nearest_neighbors(means, RefineConfig().k), some)
    for seed in range(seeds):
        for step in steps:
            observed = (grouped if step == "group" else observe)(world, words, STEPS[step], seed)
            evidence, row = observed.evidence, {"scene": world.name, "step": step, "seed": seed}
            found = consensus(evidence, observed.features)
            row["agreement"] = found.agreement[0]
            lifts = {"none": lift(evidence, observed.features), "consensus": lift(evidence, found.features)}
            answers: dict[str, Scores] = {}
            for name, lifted in lifts.items():
                answers[name] = lifted_scores(lifted, classes)
                voted = refined_scores("paper", means, lifted, answers[name], voting)
                row[name] = scores_3d(world, answers[name], some)["miou"]
                row["paper" if name == "none" else "consensus_full"] = scores_3d(world, voted, some)["miou"]
            correct = (classify(*answers["consensus"]) == world.truth)[known]
            for name, source in (("F", "none"), ("F'", "consensus")):
                row[f"bins {name}"] = accuracy_bins(lifts[source].scalars.reliability[known], correct)
            yield row


def summarize(rows: list[dict], report: Report) -> None:
    """Means over seeds of every step and over all, and Spearman of the mean bins."""
    columns = [name for name in rows[0] if name not in ("scene", "step", "seed") and not name.startswith("bins")]
    for scene in dict.fromkeys(row["scene"] for row in rows):
        ranks = defaultdict(list)
        for step in [*dict.fromkeys(row["step"] for row in rows), "all"]:
            chosen = [row for row in rows if row["scene"] == scene and step in ("all", row["step"])]
            for column in columns:
                mean, half = mean_and_interval([row[column] for row in chosen])
                report.add(f"{scene}.{step}.{column}", mean, "points" if column != "agreement" else "of 1")
                report.add(f"{scene}.{step}.{column}_ci95", half, "half of the 95 % interval")
            for name in ("F", "F'"):
                bins = np.mean([row[f"bins {name}"] for row in chosen], axis=0)
                value = spearman(torch.arange(10.0), torch.from_numpy(bins))
                report.add(f"{scene}.{step}.spearman R from {name}", value, "ten bins")
                report.add(f"{scene}.{step}.lowest tenth, R from {name}", 100 * bins[0], "points")
                if step != "all" and np.ptp(bins) >= VARYING:
                    ranks[name].append(value)
        for name, found in ranks.items():
            report.add(
                f"{scene}.spearman R from {name}", float(np.mean(found)), "mean over steps where accuracy varies"
            )


def main(arguments: argparse.Namespace) -> None:
    torch.set_grad_enabled(False)
    device, quick = "cuda" if torch.cuda.is_available() else "cpu", arguments.quick
    steps = ["noise only", "merged masks", "group"] if quick else list(STEPS)
    rows = []
    for world, words in worlds(quick, arguments.scenes, 22):
        for row in rows_of(world, words, arguments.voters, 1 if quick else arguments.seeds, steps, device):
            rows.append(row)
            print(
                *(f"{k} {v:.2f}" if isinstance(v, float) else v for k, v in row.items() if k[:4] != "bins"), flush=True
            )
    report = Report("consensus")
    summarize(rows, report)
    report.write(arguments.output)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="a small scene, three steps, one seed")
    parser.add_argument("--voters", type=int, default=2500, help="Gaussians that vote and count")
    parser.add_argument("--seeds", type=int, default=2, help="repeats")
    parser.add_argument("--scenes", nargs="+", default=["tabletop", "demo"], help="tabletop, demo")
    parser.add_argument("--output", type=Path, default=RESULTS, help="folder of the JSON file")
    main(parser.parse_args())
