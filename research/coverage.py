"""Comparison of the images that the coverage study suggests with random images.

    python -m research.coverage                     plain room and, if the captures are available, the tabletop
    python -m research.coverage --scenes demo --steps "noise only"

Eight neighboring training views are lifted, as at the start of a capture. Four views are then added: the views that the
study suggests from weights alone, or four random views, in 64 draws. The score is the mIoU of the lift of all twelve,
before the vote, over all Gaussians with a known class. The rank of the suggestions is the share of draws that they
exceed; ties count half. At the step "noise only", the study must reach the 75th percentile on average over seeds. Steps
with damaged masks are only reported. The command writes results/coverage.json.

The rule, the gain of `evaluation.coverage`, was fixed before any result was seen. Other rules were compared on 20 other
seeds (100 to 119) of a room of 20,000 Gaussians; see docs/evaluation.md.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from normlift_ns import RasterSettings, lift
from normlift_ns.core.metrics import class_scores, classify, confusion
from normlift_ns.core.sparse import SparseRows
from normlift_ns.evaluation.coverage import RasterInputs, choose_views, max_weights, model_of_lift, view_weights
from research.accuracy import SEEDS, worlds
from research.accuracy_report import mean_and_interval
from research.damage import LADDER, Observed, observe
from research.report import RESULTS, Report, stopwatch
from research.synthetic_scenes import Words, World

START, ADDED, DRAWS = 8, 4, 64
GOAL = 75.0
"""Percentile of the draws that the suggestions must reach on average."""
STEPS = ("noise only", "mild", "merged masks", "wrong classes", "hard")


class Outcome(NamedTuple):
    """Scores of one seed, in percentage points of mIoU."""

    before: float
    """mIoU of the first views."""
    suggested: float
    draws: list[float]
    everything: float
    """mIoU of all views."""

    @property
    def percentile(self) -> float:
        """Share of the draws that the suggestions exceed, in percent; ties count half."""
        drawn = np.array(self.draws)
        return float(100 * ((drawn < self.suggested).mean() + 0.5 * (drawn == self.suggested).mean()))


class Sums:
    """Sums sum_s E_js (F_s t) for each view.

    The answer for any set of views is a sum over these views. The division by the length of f_j does not change the arg
    max.
    """

    def __init__(self, world: World, words: Words, observed: Observed, counted: Tensor) -> None:
        rows, views = observed.evidence.rows.select_rows(counted), observed.evidence.num_views
        scores = observed.features @ words.classes.T.to(observed.features)
        place = rows.row_index() * views + observed.evidence.region_view[rows.column.long()].long()
        self.sums = scores.new_zeros(len(counted) * views, world.classes)
        for part in torch.arange(len(place), device=place.device).split(2**22):
            self.sums.index_add_(0, place[part], rows.weight[part, None] * scores[rows.column[part].long()])
        self.sums = self.sums.view(len(counted), views, world.classes)
        self.truth, self.classes = world.truth[counted], world.classes

    def miou(self, views: Sequence[int]) -> float:
        """Return the mIoU of the lift of some views, in percentage points."""
        found = self.sums[:, list(views)].sum(1)
        answer = classify(found, (found != 0).any(1))
        return 100 * class_scores(confusion(self.truth, answer, self.classes)).miou


def suggested(observed: Observed, weights: SparseRows, first: Sequence[int], left: Sequence[int]) -> list[int]:
    """Return the views that the study adds to the first views."""
    columns = observed.evidence.columns_of(first)
    lifted = lift(observed.evidence.select_views(first), observed.features[columns])
    chosen, rest = (
        weights.select_columns(torch.tensor(some, device=weights.weight.device), observed.evidence.num_views)
        for some in (first, left)
    )
    known = model_of_lift(lifted.scalars, chosen, max_weights(weights), beta=1.0)
    return [left[view] for view, _ in choose_views(known, rest, len(left), ADDED)]


def outcome(world: World, words: Words, weights: SparseRows, counted: Tensor, step: str, seed: int) -> Outcome:
    """Return the scores of one seed. The first views and the draws depend only on the seed, not on the step."""
    observed = observe(world, words, LADDER[step], seed)
    g, count = torch.Generator().manual_seed(seed), len(world.cameras)
    start = int(torch.randint(0, count, (), generator=g))
    first = [(start + i) % count for i in range(START)]
    left = [view for view in range(count) if view not in first]
    draws = [[left[i] for i in torch.randperm(len(left), generator=g)[:ADDED].tolist()] for _ in range(DRAWS)]
    sums = Sums(world, words, observed, counted)
    return Outcome(
        sums.miou(first),
        sums.miou([*first, *suggested(observed, weights, first, left)]),
        [sums.miou([*first, *draw]) for draw in draws],
        sums.miou(range(count)),
    )


def outcomes(
    world: World, words: Words, weights: SparseRows, step: str, seeds: Sequence[int], sample: int | None
) -> Iterator[Outcome]:
    """Yield the outcome of each seed, over a sample of the Gaussians with a known class."""
    known = (world.truth >= 0).nonzero().squeeze(1)
    some = torch.randperm(len(known), generator=torch.Generator().manual_seed(0))[:sample].to(known.device)
    for seed in seeds:
        yield outcome(world, words, weights, known[some], step, seed)


def add(report: Report, key: str, found: Sequence[Outcome]) -> None:
    """Add means over seeds, with intervals."""
    for name, unit, values in (
        ("before", "points", [one.before for one in found]),
        ("suggested", "points", [one.suggested for one in found]),
        ("drawn_median", "points", [float(np.median(one.draws)) for one in found]),
        ("drawn_75", "points", [float(np.quantile(one.draws, GOAL / 100)) for one in found]),
        ("everything", "points", [one.everything for one in found]),
        ("percentile", "% of 64 draws", [one.percentile for one in found]),
    ):
        mean, half = mean_and_interval(values)
        report.add(f"{key}.{name}", mean, unit)
        report.add(f"{key}.{name}_ci95", half, f"{unit}, half of the 95 % interval over seeds")
    report.add(f"{key}.percentile_worst", min(one.percentile for one in found), "% of 64 draws, worst seed")


def main(arguments: argparse.Namespace) -> None:
    torch.set_grad_enabled(False)
    report, device = Report("coverage"), "cuda" if torch.cuda.is_available() else "cpu"
    for there, words in worlds(False, arguments.scenes, None):
        world = there.to(device)
        with stopwatch() as watch:
            drawn = RasterInputs(world.scene, "classic", RasterSettings(), 1)
            weights = view_weights(drawn, world.cameras)
        report.add(f"{world.name}.weights_s", watch.seconds, f"s, {len(world.cameras)} views")
        for step in arguments.steps:
            seeds = range(arguments.first_seed, arguments.first_seed + arguments.seeds)
            found = list(outcomes(world, words, weights, step, seeds, arguments.sample))
            add(report, f"{world.name}.{step}", found)
            shown = " ".join(f"{one.percentile:.0f}" for one in found)
            print(f"{world.name}, {step}: percentiles {shown}", flush=True)
    report.write(arguments.output)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenes", nargs="+", default=["tabletop", "demo"], help="tabletop, demo")
    parser.add_argument("--steps", nargs="+", default=STEPS, choices=LADDER, help="steps of the ladder of damage")
    parser.add_argument("--sample", type=int, help="Gaussians that count; all by default")
    parser.add_argument("--seeds", type=int, default=SEEDS, help="repeats")
    parser.add_argument("--first-seed", type=int, default=0, help="first seed; 100 and more are for development")
    parser.add_argument("--output", type=Path, default=RESULTS, help="folder of the JSON file")
    main(parser.parse_args())
