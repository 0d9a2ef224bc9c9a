"""Cost of the presets in accuracy: mIoU relative to that of the default, on the same damaged masks of the plain room.

    python -m research.losses      a few minutes on two CPU cores

The default is rasterized at full resolution, and lifted and refined in float32. The command writes results/losses.json:
differences in percentage points, means over steps of the ladder and seeds, with 95 % intervals.
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path

import torch
from torch import Tensor

from normlift_ns import (
    Camera,
    Evidence,
    RefineConfig,
    SemanticField,
    lift,
    nearest_neighbors,
    rasterize_evidence,
    refine,
)
from normlift_ns.core.metrics import class_scores, classify, confusion
from research.accuracy_report import mean_and_interval
from research.damage import LADDER, Observed, observe
from research.report import RESULTS, Report
from research.synthetic_scenes import Words, World, demo, made_words
from research.variants import Scores, lifted_scores

STEPS, SEEDS = ("noise only", "mild", "hard"), 5
TOLERANCE = 0.05
"""Tolerance of the preset that is stored in a basis."""


def coarse_evidence(world: World, observed: Observed, step: int = 2) -> Evidence:
    """Return the evidence of the masks of an observation in smaller images.

    Each side is divided by `step`. The most frequent mask among the pixels that are merged counts.
    """
    view, labels, cameras = observed.evidence.region_view, [], []
    count = torch.bincount(view, minlength=len(world.cameras))
    first = count.cumsum(0) - count
    for v, camera in enumerate(world.cameras):
        column = observed.columns[0][world.cells.of_pixel[v].long()]
        local = torch.where(column >= 0, column - first[v], -1)
        blocks = local.unfold(0, step, step).unfold(1, step, step).flatten(2)
        labels.append(blocks.mode(dim=2).values.int())
        height, width = labels[-1].shape
        K = camera.K.clone()
        K[:2] /= step
        cameras.append(Camera(K, camera.world_to_camera, width, height))
    return rasterize_evidence(world.scene, cameras, labels, num_regions=count.tolist())


def miou(world: World, words: Words, observed: Observed, *, low_rank: bool = False) -> float:
    """Return the mIoU of the whole method in percentage points, with storage in a basis if `low_rank` is True."""
    lifted, config = lift(observed.evidence, observed.features), RefineConfig()
    near = nearest_neighbors(world.scene.means, config.k)
    own, reliability = lifted.scalars.own_evidence, lifted.scalars.reliability
    source = refine(world.scene.means, lifted.directions, reliability, config, own=own, neighbors=near).long()
    if not low_rank:
        plain = lifted_scores(lifted, words.classes)
        scores = Scores(plain.cosine[source], plain.valid[source])
    else:
        field = SemanticField.build(lifted, world.scene.means, source, tolerance=TOLERANCE, storage="low_rank")
        scores = Scores(field.query(words.classes), field.valid())
    found = classify(scores.cosine, scores.valid)
    return 100 * class_scores(confusion(world.truth, found, world.classes)).miou


def every_second_view(observed: Observed) -> Observed:
    """Return the observation with every second view."""
    views = list(range(0, observed.evidence.num_views, 2))
    kept: Tensor = observed.evidence.columns_of(views)
    return observed._replace(evidence=observed.evidence.select_views(views), features=observed.features[kept])


def main(output: Path) -> None:
    torch.set_grad_enabled(False)
    world = demo()
    words = made_words(world.classes)
    labels = [cells - cells.min() for cells in world.cells.of_pixel]
    exact = rasterize_evidence(world.scene, world.cameras, labels, dtype=torch.float64)
    double = replace(world, evidence=exact)
    report, found = Report("losses"), dict[str, list[float]]()
    for step in STEPS:
        for seed in range(SEEDS):
            seen = observe(world, words, LADDER[step], seed)
            precise = observe(double, words, LADDER[step], seed)
            default = miou(world, words, seen)
            values = {
                "default": default,
                "exact": miou(double, words, precise._replace(features=precise.features.double())) - default,
                "low_rank": miou(world, words, seen, low_rank=True) - default,
                "half_resolution": miou(world, words, seen._replace(evidence=coarse_evidence(world, seen))) - default,
                "every_second_view": miou(world, words, every_second_view(seen)) - default,
            }
            for name, value in values.items():
                found.setdefault(name, []).append(value)
            print(step, seed, {name: round(value, 2) for name, value in values.items()}, flush=True)
    for name, values in found.items():
        mean, half = mean_and_interval(values)
        report.add(name, mean, "points" if name == "default" else "points, against the default")
        report.add(f"{name}_ci95", half, "points, half of the 95 % interval over steps and seeds")
    report.write(output)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--output", type=Path, default=RESULTS, help="folder of the JSON file")
    main(parser.parse_args().output)
