"""What R knows: Gaussians without evidence, R against opacity, accuracy by number of views, and what mixing does.

    python -m benchmarks.signals                  demo room and, where the captures are, the tabletop
    python -m benchmarks.signals --scenes demo

Writes results/signals.json. Drift: two features of different classes are mixed, a f + (1 - a) g; it drifts where the
mixture is nearest to a text that is neither's. Features are text vectors with noise as in `damage`; length 0 is text
only. No number is tuned to the paper's.
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import normalize

from benchmarks.accuracy import bins_of, mean_and_interval, scores_3d, worlds
from benchmarks.damage import LADDER, Lengths, observe
from benchmarks.report import RESULTS, Report
from benchmarks.variants import lifted_scores
from benchmarks.worlds import Words, World
from normlift_ns import lift
from normlift_ns.core.metrics import bin_means, classify, kendall, lowest_jaccard, spearman

VIEWS = (2, 4, 8, 16, 32)
NOISE = (0.0, 0.6, 1.2, 2.0, 3.0)
MIXES = tuple(i / 10 for i in range(11))
SAMPLE = 20_000


def evidence_table(world: World, words: Words, report: Report, seed: int = 0) -> None:
    """Share, mean opacity, share of faint ones, number of views and accuracy of Gaussians with and without evidence;
    then R against opacity among those with."""
    observed = observe(world, words, LADDER["hard"], seed)
    lifted = lift(observed.evidence, observed.features)
    scores = lifted_scores(lifted, words.classes)
    correct = classify(scores.cosine, scores.valid) == world.truth
    opacity, known, seen = world.scene.opacities, world.truth >= 0, lifted.reliability > 0
    for name, group in (("all", torch.ones_like(seen)), ("zero", ~seen), ("seen", seen)):
        if not bool(group.any()):
            continue
        prefix = f"{world.name}.evidence.{name}"
        report.add(f"{prefix}.share", 100 * group.double().mean(), "% of Gaussians")
        report.add(f"{prefix}.opacity", opacity[group].mean(), "mean")
        report.add(f"{prefix}.faint", 100 * (opacity[group] < 0.1).double().mean(), "% of opacity below 0.1")
        report.add(f"{prefix}.views", lifted.view_count[group].double().mean(), "views with weight, mean")
        if bool((group & known).any()):
            report.add(f"{prefix}.accuracy", 100 * correct[group & known].double().mean(), "points")
    prefix = f"{world.name}.opacity"
    r, o = lifted.reliability[seen], opacity[seen]
    some = torch.randperm(len(r), generator=torch.Generator().manual_seed(0))[:SAMPLE]
    report.add(f"{prefix}.spearman", spearman(r, o), "R against opacity, R > 0")
    report.add(f"{prefix}.kendall", kendall(r[some], o[some]), f"tau-b, {len(some)} Gaussians")
    report.add(f"{prefix}.jaccard", lowest_jaccard(r, o), "lowest fifths; 0.111 if independent")
    for i, value in enumerate(bin_means(r, o, 5)[1].tolist()):
        report.add(f"{prefix}.quintile{i + 1}", value, "mean opacity, by R")
    for name, key in (("reliability", lifted.reliability), ("norm", lifted.norm)):
        for i, value in enumerate(bins_of(key[known], correct[known])):
            report.add(f"{world.name}.{name}.bin{i + 1}", 100 * value, "points, tenths by ascending value")
    counts = torch.histc(lifted.reliability[seen], bins=20, min=0, max=1)
    for i, value in enumerate((counts / len(seen)).tolist()):
        report.add(f"{world.name}.histogram.{i * 0.05:.2f}", 100 * value, "% of Gaussians, R = 0 apart")


def views_curve(world: World, words: Words, report: Report, seeds: int = 5) -> None:
    """Accuracy of the unrefined lift by number of views."""
    known = (world.truth >= 0).nonzero().squeeze(1)
    for count in [v for v in VIEWS if v < len(world.cameras)]:
        found = []
        for seed in range(seeds):
            observed = observe(world, words, replace(LADDER["mild"], views=count), seed)
            lifted = lift(observed.evidence, observed.features)
            found.append(scores_3d(world, lifted_scores(lifted, words.classes), known)["miou"])
        mean, half = mean_and_interval(found)
        report.add(f"{world.name}.views.{count}.miou", mean, "points, unrefined")
        report.add(f"{world.name}.views.{count}.miou_ci95", half, "points, half of the 95 % interval over seeds")


def noisy(words: Words, noise: float, g: torch.Generator) -> Tensor:
    """[K, D] one image feature of every class, as `damage` makes them; without noise: the texts themselves."""
    if noise == 0:
        return words.classes
    classes, lengths = words.classes, Lengths()
    basis = torch.linalg.qr(classes.T).Q
    random = torch.randn(len(classes) + 1, classes.shape[1], generator=g)
    free = normalize(random - random @ basis @ basis.T, dim=1)
    mistakes = torch.randn(len(classes), len(words.others), generator=g) @ (words.others - words.others.mean(0))
    mixed = classes + lengths.common * free[-1] + lengths.own * free[:-1] + noise * normalize(mistakes, dim=1)
    return normalize(mixed, dim=1)


def drift_rate(words: Words, noise: float, mix: float, seed: int) -> float:
    """Share of pairs of classes whose mixture is nearest to a third class."""
    features = noisy(words, noise, torch.Generator().manual_seed(seed))
    a, b = torch.triu_indices(len(features), len(features), 1)
    mixed = mix * features[a] + (1 - mix) * features[b]
    nearest = (mixed @ words.classes.T).argmax(1)
    return float(((nearest != a) & (nearest != b)).double().mean())


def main(arguments: argparse.Namespace) -> None:
    torch.set_grad_enabled(False)
    report = Report("signals")
    for world, words in worlds(False, arguments.scenes, arguments.views):
        for noise in NOISE:
            for mix in MIXES:
                rate = float(np.mean([drift_rate(words, noise, mix, seed) for seed in range(20)]))
                report.add(f"{world.name}.drift.noise{noise}.mix{mix}", 100 * rate, "% of pairs, 20 draws")
        evidence_table(world, words, report)
        views_curve(world, words, report)
    report.write(arguments.output)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenes", nargs="+", default=["tabletop", "demo"], help="tabletop, demo")
    parser.add_argument("--views", type=int, help="training views of the tabletop; all by default")
    parser.add_argument("--output", type=Path, default=RESULTS, help="folder of the JSON file")
    main(parser.parse_args())
