"""What else a protocol can tell of lifted runs: ablation, sweeps of parameters, signals of R, what lifting took."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from normlift_ns.core.metrics import classify
from normlift_ns.evaluation.options import ScannetOptions
from normlift_ns.evaluation.protocols import EvaluatedRun, MaskTruth, label_scene
from normlift_ns.evaluation.results import Evaluation, mean
from normlift_ns.evaluation.scannet import answers, read_labels
from normlift_ns.evaluation.signals import signals
from normlift_ns.evaluation.votes import Vote, own_vote, voter

Evaluate = Callable[[Iterable[EvaluatedRun]], Evaluation]
Row = Mapping[str, Any]


def study_votes(
    runs: Sequence[EvaluatedRun], evaluate: Evaluate, votes: Callable[[Vote], Iterator[Vote]], device: str
) -> list[Row]:
    """Results of the protocol with every vote, around what each run was lifted with."""
    voters = [voter(lifted.field, lifted.scene.gaussians.means, device) for lifted in runs]
    rows = []
    for each in zip(*(votes(own_vote(lifted.field.manifest)) for lifted in runs)):
        voted = (
            replace(lifted, field=vote_again(vote), refined=True)
            for lifted, vote_again, vote in zip(runs, voters, each)
        )
        rows.append({**each[0].label, **evaluate(voted).results})
    return rows


def scannet_signals(runs: Sequence[EvaluatedRun], labels: Sequence[Path], options: ScannetOptions) -> list[Row]:
    """`signals` of each run by the 19 classes."""
    rows = []
    for lifted, path in zip(runs, labels):
        scene = label_scene(replace(lifted, refined=False), path, read_labels(path))
        rule = {"min_opacity": options.min_opacity, "without_direction": options.without_direction}
        truth, found = answers(scene, 19, **rule)
        rows.append({"scene": scene.name, **signals(lifted.field.scalars, scene.opacity, truth, found)})
    return rows


def mask_signals(lifted: EvaluatedRun, truth: MaskTruth) -> list[Row]:
    """`signals` of a run by the classes of its masks."""
    plain = replace(lifted, refined=False)
    found = classify(plain.cosine(truth.classes), plain.valid)
    return [signals(lifted.field.scalars, lifted.scene.gaussians.opacities, truth.gaussians, found)]


def plain_signals(runs: Sequence[EvaluatedRun], labels: Sequence[Path]) -> list[Row]:
    """`signals` without a truth of Gaussians."""
    return [
        {"scene": path.name, **signals(lifted.field.scalars, lifted.scene.gaussians.opacities)}
        for lifted, path in zip(runs, labels)
    ]


def timing(runs: Sequence[EvaluatedRun]) -> list[Row]:
    """Seconds of every stage and peak memory of every lift, as their manifests have them, and the means."""
    rows = []
    for lifted in runs:
        cost = lifted.field.manifest.get("cost", {})
        rows.append({"scene": lifted.scene.name, **cost})
    means = {key: mean([row.get(key, float("nan")) for row in rows]) for key in rows[0] if key != "scene"}
    return [*rows, {"scene": "mean", **means}] if len(rows) > 1 else rows
