"""Comparison of two reliabilities for the answers of the consensus and for the vote: R of F and R of F'.

    python -m research.consensus                 tabletop (half of its views), plain room and second room
    python -m research.consensus --minutes 9     start no observation after this many minutes; repeat to continue
    python -m research.consensus --quick         plain room of 20,000 Gaussians, two steps, one seed

The command writes results/consensus.json. No parameter was fitted on its damage steps and seeds (`fit.HELD_OUT`, seeds
from 200 on, and the two steps of the ladder with dependent mistakes). Three figures are computed for each observation.
Kendall's tau compares R with the correctness of the unrefined answers of F', over all Gaussians with a known class.
Spearman's correlation compares ten bins of equal count by R with their accuracy, if the accuracy varies. The mIoU after
the posterior vote with each R is that of a sample. The R to store is the one with the higher mean of tau and of mIoU
over scenes. `research.accuracy` has the accuracy of all methods.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from normlift_ns import Neighbors, RefineConfig, lift, nearest_neighbors, refine
from normlift_ns.core.consensus import consensus
from normlift_ns.core.metrics import classify, kendall_test, spearman_test
from normlift_ns.evaluation.studies import accuracy_bins
from research.accuracy import scores_3d
from research.accuracy_report import mean_and_interval
from research.damage import STEPS, observe
from research.fit import HELD_OUT
from research.report import RESULTS, Report
from research.rows import append, read_rows
from research.second_room import second
from research.synthetic_scenes import Words, World, demo, made_words, real_words, tabletop
from research.variants import Scores, lifted_scores, only

SCENES = ("tabletop", "demo", "second")
DAMAGES = (*HELD_OUT, "group", "arc")
FIRST_SEED = 200
VIEWS = 22
"""Number of training views of the tabletop."""
VARYING = 0.05
"""Bins are not ranked if their accuracies differ by less than this."""
SOURCES = ("F", "F'")


def make_world(name: str, gaussians: int) -> tuple[World, Words]:
    """Return a scene and the vectors of its classes."""
    if name == "tabletop":
        return tabletop(VIEWS), real_words()
    world = demo(gaussians) if name == "demo" else second(gaussians)
    return world, made_words(world.classes)


def observation(
    world: World, classes: Tensor, words: Words, voting: Neighbors, some: Tensor, step: str, seed: int
) -> dict[str, Any]:
    """Return the row of one observation."""
    observed, means = observe(world, words, STEPS[step], seed), world.scene.means
    found = consensus(observed.evidence, observed.features)
    lifts = {name: lift(observed.evidence, x) for name, x in zip(SOURCES, (observed.features, found.features))}
    answers, known = {name: lifted_scores(x, classes) for name, x in lifts.items()}, world.truth >= 0
    correct = (classify(*answers["F'"]) == world.truth)[known]
    row: dict[str, Any] = {"agreement": found.agreement[0]}
    for name, lifted in lifts.items():
        r, own = lifted.scalars.reliability, lifted.scalars.own_evidence
        source = refine(means, lifts["F'"].directions, r, RefineConfig(vote="posterior"), own=own, neighbors=voting)
        voted = Scores(*(x[source.long()] for x in answers["F'"]))
        row[name] = {
            "miou": scores_3d(world, answers[name], some)["miou"],
            "voted": scores_3d(world, voted, some)["miou"],
            "kendall": kendall_test(r[known].cpu(), correct.double().cpu()).value,
            "bins": accuracy_bins(r[known], correct),
        }
    return row


def run_all(arguments: argparse.Namespace, steps: Sequence[str], deadline: float) -> list[dict[str, Any]]:
    """Return one row per scene, step and seed, and stop at the deadline (`time.time`)."""
    device = "cuda" if torch.cuda.is_available() else "cpu"
    run = {"voters": arguments.voters, "gaussians": arguments.gaussians, "views": VIEWS}
    rows = read_rows(arguments.rows, run)
    done = {(row["scene"], row["step"], row["seed"]) for row in rows}
    for name in arguments.scenes:
        every = [(step, FIRST_SEED + seed) for seed in range(arguments.seeds) for step in steps]
        missing = [x for x in every if (name, *x) not in done]
        if len(missing) == 0 or time.time() > deadline:
            continue
        there, words = make_world(name, arguments.gaussians)
        world, classes = there.to(device), words.classes.to(device)
        known = (world.truth >= 0).nonzero().squeeze(1)
        g = torch.Generator().manual_seed(0)
        some = known[torch.randperm(len(known), generator=g)[: arguments.voters].to(device)]
        voting = only(nearest_neighbors(world.scene.means, RefineConfig().k), some)
        for step, seed in missing:
            if time.time() > deadline:
                break
            found = observation(world, classes, words, voting, some, step, seed)
            rows.append({"scene": name, "step": step, "seed": seed, **found})
            append(arguments.rows, rows[-1])
            shown = (f"{x}: {found[x]['kendall']:.3f}, voted {found[x]['voted']:.1f}" for x in SOURCES)
            print(f"{name}, {step}, seed {seed}: R of", "; of ".join(shown), flush=True)
    return rows


def ranks(row: dict[str, Any], source: str) -> float | None:
    """Return Spearman's correlation of ten bins, or None if the accuracy hardly varies by either R."""
    if max(np.ptp(row[x]["bins"]) for x in SOURCES) < VARYING:
        return None
    return spearman_test(torch.arange(10.0), torch.tensor(row[source]["bins"])).value


def summarize(rows: list[dict[str, Any]], report: Report) -> None:
    """Add means with intervals over observations: of all scenes, of each scene, and of each step."""
    scenes, steps = (list(dict.fromkeys(row[key] for row in rows)) for key in ("scene", "step"))
    groups = {"all": rows}
    groups |= {scene: [row for row in rows if row["scene"] == scene] for scene in scenes}
    groups |= {f"step {step}": [row for row in rows if row["step"] == step] for step in steps}
    for group, some in groups.items():
        for source in SOURCES:
            for key, unit in (("kendall", "tau"), ("miou", "points"), ("voted", "points")):
                _add(report, f"{group}.{source}.{key}", [row[source][key] for row in some], unit)
            found = [x for row in some if (x := ranks(row, source)) is not None]
            if len(found) > 0:
                _add(report, f"{group}.{source}.spearman_bins", found, f"{len(found)} of {len(some)} observations")
            lowest = [100 * row[source]["bins"][0] for row in some]
            _add(report, f"{group}.{source}.lowest_tenth", lowest, "points, accuracy of the lowest tenth by R")
        for key in ("kendall", "voted"):
            gain = [row["F'"][key] - row["F"][key] for row in some]
            _add(report, f"{group}.difference.{key}", gain, "R of F' against R of F")


def _add(report: Report, key: str, values: Sequence[float], unit: str) -> None:
    mean, half = mean_and_interval(values)
    report.add(key, mean, unit)
    report.add(f"{key}_ci95", half, "half of the 95 % interval")


def main(arguments: argparse.Namespace) -> None:
    torch.set_grad_enabled(False)
    deadline = float("inf") if arguments.minutes is None else time.time() + 60 * arguments.minutes
    steps = DAMAGES
    if arguments.quick:
        arguments.scenes, arguments.gaussians, arguments.seeds, steps = ["demo"], 20_000, 1, ("hard", "group")
    rows = run_all(arguments, steps, deadline)
    wanted = set(wanted_rows(arguments, steps))
    rows = [row for row in rows if (row["scene"], row["step"], row["seed"]) in wanted]
    if len(rows) < len(wanted):
        sys.exit(f"{len(rows)} of {len(wanted)} observations are finished; repeat the command to continue")
    report = Report("consensus")
    report.add("voters", arguments.voters, "Gaussians per scene that vote and count for mIoU")
    report.add("seeds", arguments.seeds, f"repeats, from {FIRST_SEED} on")
    summarize(rows, report)
    report.write(arguments.output)


def wanted_rows(arguments: argparse.Namespace, steps: Sequence[str]) -> Iterator[tuple[str, str, int]]:
    """Yield scene, step and seed of every observation."""
    for scene in arguments.scenes:
        for step in steps:
            yield from ((scene, step, FIRST_SEED + seed) for seed in range(arguments.seeds))


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="a small scene, two steps, one seed")
    parser.add_argument("--voters", type=int, default=2500, help="Gaussians that vote and count for mIoU")
    parser.add_argument("--gaussians", type=int, default=40_000, help="Gaussians of each room")
    parser.add_argument("--seeds", type=int, default=2, help="repeats")
    parser.add_argument("--scenes", nargs="+", default=list(SCENES), choices=SCENES)
    parser.add_argument("--minutes", type=float, help="minutes after which no observation starts")
    parser.add_argument("--rows", type=Path, default=RESULTS / "consensus_rows.jsonl", help="finished observations")
    parser.add_argument("--output", type=Path, default=RESULTS, help="folder of the JSON file")
    main(parser.parse_args())
