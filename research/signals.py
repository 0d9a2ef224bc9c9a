"""Relation of R to evidence, opacity and accuracy, accuracy by number of views, and the effect of mixed features.

    python -m research.signals                  plain room and, if the captures are available, the tabletop
    python -m research.signals --scenes demo

The command writes results/signals.json. For drift, two features of different classes are mixed, a f + (1 - a) g. The
mixture drifts if it is nearest to the text of a third class. Features are text vectors with noise as in `damage`; with
noise 0, they are the texts. No number is tuned to those of the paper.
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import normalize

from normlift_ns import RefineConfig, lift, nearest_neighbors
from normlift_ns.core.metrics import classify
from normlift_ns.evaluation.studies import SceneSignals, Variant, signal_statistics
from research.accuracy import SEEDS, scores_3d, worlds
from research.accuracy_report import mean_and_interval
from research.damage import LADDER, observe
from research.features import Lengths
from research.report import RESULTS, Report
from research.synthetic_scenes import Words, World
from research.variants import lifted_scores, refined_scores

STEP = "hard"
"""Step of the ladder whose signals are shown."""
MISTAKEN = ("shifted masks", "pose noise", STEP)
"""Steps whose wrong answers are examined."""
VIEWS = (2, 4, 8, 16, 32)
NOISE = (0.0, 0.6, 1.2, 2.0, 3.0)
MIXES = tuple(i / 10 for i in range(11))


def evidence_table(world: World, words: Words, report: Report) -> None:
    """Add `mistakes` on some steps of the ladder and `signal_statistics` on one, as means over seeds."""
    neighbors = nearest_neighbors(world.scene.means, RefineConfig().k)
    for step in MISTAKEN:
        found = []
        for seed in range(SEEDS):
            observed = observe(world, words, LADDER[step], seed)
            lifted = lift(observed.evidence, observed.features)
            scores = lifted_scores(lifted, words.classes.to(world.truth.device))
            answer = classify(scores.cosine, scores.valid)
            shown = {}
            if step == STEP:
                voted = refined_scores("paper", world.scene.means, lifted, scores, neighbors)
                answers = {"unrefined": answer, "refined": classify(voted.cosine, voted.valid)}
                shown = signal_statistics(SceneSignals(lifted.scalars, world.scene.opacities, world.truth, answers))
            found.append(shown | mistakes(lifted.scalars.reliability, world.truth, answer))
        for key in found[0]:
            report.add(f"{world.name}.{step}.{key}", float(np.mean([one[key] for one in found])), "of 1")


def mistakes(reliability: Tensor, truth: Tensor, answer: Tensor) -> dict[str, float]:
    """Return figures of the Gaussians with R in its sixth to eighth tenth.

    They are the share of wrong answers, and the share of these that name the largest class.
    """
    counts = (truth >= 0) & (reliability > 0)
    tenths = reliability[counts].argsort().tensor_split(10)
    some = torch.cat(tenths[5:8])
    found, exact = answer[counts][some], truth[counts][some]
    wrong, largest = found != exact, truth[counts].bincount().argmax()
    return {
        "middle.wrong": float(wrong.double().mean()),
        "middle.wrong_largest": float((found == largest)[wrong].double().mean()),
    }


def views_curve(world: World, words: Words, report: Report) -> None:
    """Add the accuracy by number of views, before and after the vote."""
    known = (world.truth >= 0).nonzero().squeeze(1)
    neighbors = nearest_neighbors(world.scene.means, RefineConfig().k)
    for count in [v for v in VIEWS if v < len(world.cameras)]:
        found: dict[Variant, list[float]] = {"none": [], "paper": []}
        for seed in range(SEEDS):
            observed = observe(world, words, replace(LADDER["mild"], views=count), seed)
            lifted = lift(observed.evidence, observed.features)
            plain = lifted_scores(lifted, words.classes.to(world.truth.device))
            for variant, values in found.items():
                scores = refined_scores(variant, world.scene.means, lifted, plain, neighbors)
                values.append(scores_3d(world, scores, known)["miou"])
        for variant, values in found.items():
            mean, half = mean_and_interval(values)
            report.add(f"{world.name}.views.{count}.{variant}.miou", mean, "points")
            report.add(f"{world.name}.views.{count}.{variant}.miou_ci95", half, "half of the 95 % interval over seeds")


def noisy(words: Words, noise: float, g: torch.Generator) -> Tensor:
    """Return [K, D], one image feature of every class as in `damage`, or the texts themselves without noise."""
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
    """Return the share of pairs of classes whose mixture is nearest to a third class."""
    features = noisy(words, noise, torch.Generator().manual_seed(seed))
    a, b = torch.triu_indices(len(features), len(features), 1)
    mixed = mix * features[a] + (1 - mix) * features[b]
    nearest = (mixed @ words.classes.T).argmax(1)
    return float(((nearest != a) & (nearest != b)).double().mean())


def main(arguments: argparse.Namespace) -> None:
    torch.set_grad_enabled(False)
    report = Report("signals")
    device = "cuda" if torch.cuda.is_available() else "cpu"
    for world, words in worlds(False, arguments.scenes, arguments.views):
        for noise in NOISE:
            for mix in MIXES:
                rate = float(np.mean([drift_rate(words, noise, mix, seed) for seed in range(20)]))
                report.add(f"{world.name}.drift.noise{noise}.mix{mix}", 100 * rate, "% of pairs, 20 draws")
        evidence_table(world.to(device), words, report)
        views_curve(world.to(device), words, report)
    report.write(arguments.output)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenes", nargs="+", default=["tabletop", "demo"], help="tabletop, demo")
    parser.add_argument("--views", type=int, help="training views of the tabletop; all by default")
    parser.add_argument("--output", type=Path, default=RESULTS, help="folder of the JSON file")
    main(parser.parse_args())
