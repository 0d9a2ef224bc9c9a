"""What else a protocol can tell of lifted runs: ablation, sweeps of parameters, signals of R, what lifting took."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from normlift_ns.core.metrics import classify
from normlift_ns.evaluation.options import ScannetOptions
from normlift_ns.evaluation.protocols import EvaluatedRun, MaskTruth, label_scene, scene_names
from normlift_ns.evaluation.results import Evaluation, mean
from normlift_ns.evaluation.scannet import answers, read_labels
from normlift_ns.evaluation.signals import SceneSignals, signals
from normlift_ns.evaluation.votes import Vote, own_vote, voter

Evaluate = Callable[[Iterable[EvaluatedRun]], Evaluation]
Row = Mapping[str, Any]


def study_votes(
    runs: Sequence[EvaluatedRun],
    evaluate: Evaluate,
    votes: Callable[[Sequence[Vote]], Iterator[Sequence[Vote]]],
    device: str,
) -> list[Row]:
    """Results of the protocol with every vote, around what each run was lifted with; equal votes are taken once."""
    voters = [voter(lifted.field, lifted.scene.gaussians.means, device) for lifted in runs]
    known: dict[Any, Mapping[str, float]] = {}
    rows = []
    for each in votes([own_vote(lifted.field.manifest) for lifted in runs]):
        key = tuple((vote.variant, vote.config, vote.beta) for vote in each)
        if key not in known:
            voted = (
                replace(lifted, field=vote_again(vote), refined=True)
                for lifted, vote_again, vote in zip(runs, voters, each)
            )
            known[key] = evaluate(voted).results
        rows.append({**each[0].label, **known[key]})
    return rows


def signal_rows(names: Sequence[str], scenes: Sequence[SceneSignals]) -> list[Row]:
    """`signals` of every scene and, if there are several, of all of them pooled."""
    rows = [{"scene": name, **signals(scene)} for name, scene in zip(names, scenes)]
    return [*rows, {"scene": POOLED, **signals(*scenes)}] if len(rows) > 1 else rows


POOLED = "all scenes"
"""What the row of all Gaussians of all scenes is called."""


def scannet_signals(runs: Sequence[EvaluatedRun], labels: Sequence[Path], options: ScannetOptions) -> list[Row]:
    """`signal_rows` by the 19 classes."""
    names, scenes = scene_names(labels), []
    rule = {"min_opacity": options.min_opacity, "without_direction": options.without_direction}
    for lifted, name, path in zip(runs, names, labels):
        nyu40, found, truth = read_labels(path), {}, None
        for kind, run in _both(lifted).items():
            truth, found[kind] = answers(label_scene(run, name, path, nyu40, options), 19, **rule)
        scenes.append(SceneSignals(lifted.field.scalars, lifted.scene.gaussians.opacities, truth, found))
    return signal_rows(names, scenes)


def mask_signals(lifted: EvaluatedRun, truth: MaskTruth) -> list[Row]:
    """`signal_rows` of a run by the classes of its masks."""
    found = {kind: classify(run.cosine(truth.classes), run.valid) for kind, run in _both(lifted).items()}
    scene = SceneSignals(lifted.field.scalars, lifted.scene.gaussians.opacities, truth.gaussians, found)
    return signal_rows([lifted.scene.name], [scene])


def plain_signals(runs: Sequence[EvaluatedRun], labels: Sequence[Path]) -> list[Row]:
    """`signal_rows` without a truth of Gaussians."""
    scenes = [SceneSignals(lifted.field.scalars, lifted.scene.gaussians.opacities) for lifted in runs]
    return signal_rows(scene_names(labels), scenes)


def _both(lifted: EvaluatedRun) -> dict[str, EvaluatedRun]:
    """The run's unrefined directions and, where it was lifted with a vote, the refined ones."""
    kinds = {"unrefined": False, "refined": True}
    if not lifted.field.manifest.get("options", {}).get("refine", True):
        del kinds["refined"]
    return {kind: replace(lifted, refined=refined) for kind, refined in kinds.items()}


def timing(runs: Sequence[EvaluatedRun]) -> list[Row]:
    """Seconds of every stage and peak memory of every lift, as their manifests have them, and the means."""
    rows = []
    for lifted in runs:
        cost = lifted.field.manifest.get("cost", {})
        rows.append({"scene": lifted.scene.name, **cost})
    means = {key: mean([row.get(key, float("nan")) for row in rows]) for key in rows[0] if key != "scene"}
    return [*rows, {"scene": "mean", **means}] if len(rows) > 1 else rows
