"""Boxes of the tabletop's objects from exact and from damaged masks, compared with boxes of the true Gaussians.

    python -m research.boxes --views 16

True Gaussians are defined in `research.synthetic_scenes` (see `PURITY`). Both boxes are computed alike, but the found
objects are connected components, of which the largest counts.
"""

from __future__ import annotations

import argparse
from collections.abc import Mapping, Sequence
from dataclasses import replace

import torch
from torch import Tensor

from normlift_ns import RefineConfig, SemanticField, consensus, lift, refine
from normlift_ns.analysis.objects import oriented_box
from normlift_ns.exports import answer_instances
from normlift_ns.query.engine import Answer, run_query
from normlift_ns.query.question import Query
from research.box_overlap import box_iou
from research.damage import STEPS, Damage, observe
from research.synthetic_scenes import Words, World, real_words, tabletop

EXACT = "exact masks"
DAMAGES: dict[str, Damage] = {EXACT: Damage(noise=0.0), "hard": STEPS["hard"]}


def asked(world: World, words: Words, damage: Damage, seed: int = 0) -> Answer:
    """Return the answer of a lift with default options to all classes. A Gaussian belongs to the best class."""
    observed = observe(world, words, damage, seed)
    table = consensus(
        observed.evidence, observed.features, level=torch.zeros(len(observed.features), dtype=torch.int64)
    )
    lifted = lift(observed.evidence, table.features)
    means, own = world.scene.means, lifted.scalars.own_evidence
    source = refine(means, lifted.directions, lifted.scalars.reliability, RefineConfig(), own=own)
    field = SemanticField.build(lifted, means, source)
    texts = tuple(str(c) for c in range(world.classes))
    vectors = words.classes.double().cpu().numpy()
    found = run_query(field, means, Query(texts, vectors, rule="cosine", threshold=-2.0))
    return replace(found, selected=found.valid[:, None].expand_as(found.relevancy))


def box_scores(means: Tensor, truth: Tensor, found: Answer) -> list[float]:
    """Return, for each class, the IoU of the box of its true Gaussians and the box of the largest component found."""
    instances = answer_instances(found)
    scores = []
    for c in range(len(found.texts)):
        first = next((i for i, of in enumerate(instances.classes, 1) if of == c + 1), None)
        if first is None:
            scores.append(0.0)
            continue
        both = (means[truth == c], means[instances.instance_id == first])
        scores.append(box_iou(*(oriented_box(points.double().cpu().numpy()) for points in both)))
    return scores


def table(rows: Mapping[str, Sequence[float]], names: Sequence[str]) -> str:
    """Return the scores as a Markdown table."""
    lines = [f"| object | {' | '.join(rows)} |", "|---" * (1 + len(rows)) + "|"]
    for i, name in enumerate(names):
        lines.append(f"| {name} | {' | '.join(f'{scores[i]:.2f}' for scores in rows.values())} |")
    means = (sum(scores) / len(scores) for scores in rows.values())
    return "\n".join([*lines, f"| mean | {' | '.join(f'{mean:.3f}' for mean in means)} |"])


def main() -> None:
    from normlift_ns.evaluation.protocols import read_names  # noqa: PLC0415
    from tests.captures import SHARED  # noqa: PLC0415

    parser = argparse.ArgumentParser()
    parser.add_argument("--views", type=int, help="number of evenly spread views; all 44 by default")
    world, words = tabletop(parser.parse_args().views), real_words()
    names = read_names(SHARED / "captures" / "tabletop" / "labels.json").classes
    rows = {step: box_scores(world.scene.means, world.truth, asked(world, words, d)) for step, d in DAMAGES.items()}
    print(table(rows, names))


if __name__ == "__main__":
    main()
