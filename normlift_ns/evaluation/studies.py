"""Further studies of lifted runs: ablation, parameter sweeps, signals of R, comparison with other methods, timing."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from normlift_ns.core.metrics import classify
from normlift_ns.evaluation.baselines import BASELINES, baseline_field, with_consensus
from normlift_ns.evaluation.dense import time_sfs_way, why_not_timed
from normlift_ns.evaluation.options import ScannetOptions
from normlift_ns.evaluation.protocols import EvaluatedRun, MaskTruth, label_scene, scene_names
from normlift_ns.evaluation.results import Evaluation, mean
from normlift_ns.evaluation.scannet import answers, read_labels
from normlift_ns.evaluation.signals import SceneSignals, signals
from normlift_ns.evaluation.votes import Vote, ablation, agreed_ablation, own_vote, voter

Evaluate = Callable[[Iterable[EvaluatedRun]], Evaluation]
Row = Mapping[str, Any]


def study_votes(
    runs: Sequence[EvaluatedRun],
    evaluate: Evaluate,
    votes: Callable[[Sequence[Vote]], Iterator[Sequence[Vote]]],
    device: str,
) -> list[Row]:
    """Evaluate the protocol with every vote, around that of each run; equal votes are evaluated once."""
    voters = [voter(lifted.field, lifted.scene.gaussians.means, device) for lifted in runs]
    results: dict[Any, Mapping[str, float]] = {}
    rows = []
    for run_votes in votes([own_vote(lifted.field.manifest) for lifted in runs]):
        key = tuple((vote.variant, vote.config, vote.beta) for vote in run_votes)
        if key not in results:
            voted = (
                replace(lifted, field=vote_again(vote), refined=True)
                for lifted, vote_again, vote in zip(runs, voters, run_votes)
            )
            results[key] = evaluate(voted).results
        rows.append({**run_votes[0].label, **results[key]})
    return rows


def study_ablation(
    runs: Sequence[EvaluatedRun], evaluate: Evaluate, device: str, tell: Callable[[str], None] = lambda text: None
) -> list[Row]:
    """Evaluate the protocol with every variant, with and without consensus, no matter how the runs were lifted.

    Args:
        tell: called with the reason if variants are left out, because the features of a run cannot be computed again.
    """
    rows: list[Row] = []
    for on, votes in ((False, ablation), (True, agreed_ablation)):
        try:
            variants = [with_consensus(lifted, on, device) for lifted in runs]
        except (ValueError, FileNotFoundError) as error:
            tell(f"The ablation leaves out all variants {'with' if on else 'without'} consensus: {error}")
            continue
        rows += study_votes(variants, evaluate, votes, device)
    return rows


def signal_rows(names: Sequence[str], scenes: Sequence[SceneSignals]) -> list[Row]:
    """Return `signals` of every scene and, if there are several, of all of them pooled."""
    rows: list[Row] = [{"scene": name, **signals(scene)} for name, scene in zip(names, scenes)]
    return [*rows, {"scene": POOLED, **signals(*scenes)}] if len(rows) > 1 else rows


POOLED = "all scenes"
"""Scene name of the pooled row."""


def scannet_signals(runs: Sequence[EvaluatedRun], labels: Sequence[Path], options: ScannetOptions) -> list[Row]:
    """Return `signal_rows` for the 19 classes of ScanNet."""
    names, scenes = scene_names(labels), []
    kwargs = {"min_opacity": options.min_opacity, "without_direction": options.without_direction}
    for lifted, name, path in zip(runs, names, labels):
        nyu40, predictions, truth = read_labels(path), {}, None
        for kind, run in _by_refinement(lifted).items():
            truth, predictions[kind] = answers(label_scene(run, name, path, nyu40, options), 19, **kwargs)
        scenes.append(SceneSignals(lifted.field.scalars, lifted.scene.gaussians.opacities, truth, predictions))
    return signal_rows(names, scenes)


def mask_signals(lifted: EvaluatedRun, truth: MaskTruth) -> list[Row]:
    """Return `signal_rows` of a run for the classes of its masks."""
    predictions = {kind: classify(run.cosine(truth.classes), run.valid) for kind, run in _by_refinement(lifted).items()}
    scene = SceneSignals(lifted.field.scalars, lifted.scene.gaussians.opacities, truth.gaussians, predictions)
    return signal_rows([lifted.scene.name], [scene])


def plain_signals(runs: Sequence[EvaluatedRun], labels: Sequence[Path]) -> list[Row]:
    """Return `signal_rows` without true classes."""
    scenes = [SceneSignals(lifted.field.scalars, lifted.scene.gaussians.opacities) for lifted in runs]
    return signal_rows(scene_names(labels), scenes)


def _by_refinement(lifted: EvaluatedRun) -> dict[str, EvaluatedRun]:
    """Return the run with unrefined directions and, if it was lifted with a vote, with refined ones."""
    kinds = {"unrefined": False, "refined": True}
    if not lifted.field.manifest.get("options", {}).get("refine", True):
        del kinds["refined"]
    return {kind: replace(lifted, refined=refined) for kind, refined in kinds.items()}


def baselines(runs: Sequence[EvaluatedRun], evaluate: Evaluate, device: str) -> list[Row]:
    """Evaluate the protocol for the runs and for `BASELINES` on the same features. Baselines are not refined.

    Raises:
        ValueError, FileNotFoundError: as `seen_blocks`.
    """
    rows: list[Row] = []
    for refined in (True, False):
        name, what = ("normlift", "the run, refined") if refined else ("unrefined", "the run, unrefined")
        results = evaluate(replace(lifted, refined=refined) for lifted in runs).results
        rows.append({"method": name, "what": what, **results})
    for method, what in BASELINES.items():
        relifted = (replace(lifted, field=baseline_field(method, lifted, device), refined=False) for lifted in runs)
        rows.append({"method": method, "what": what, **evaluate(relifted).results})
    return rows


def timing(
    runs: Sequence[EvaluatedRun], device: str = "cpu", tell: Callable[[str], None] = lambda text: None
) -> list[Row]:
    """Return the seconds of every stage and the peak memory of every lift, from the manifests, and their means.

    On a GPU, also time SFS's method and this package's on some views of each run.

    Args:
        tell: called with the reason if SFS's method is left out.
    """
    rows = []
    for lifted in runs:
        row = {"scene": lifted.scene.name, **lifted.field.manifest.get("cost", {})}
        reason = why_not_timed(lifted, device)
        if reason is None:
            try:
                row |= time_sfs_way(lifted, device)
            except (ValueError, FileNotFoundError) as error:  # its features cannot be computed again
                reason = str(error)
        if reason is not None:
            tell(f"The timing of {lifted.scene.name} leaves out SFS's method (512 channels through gsplat): {reason}")
        rows.append(row)
    keys = list(dict.fromkeys(key for row in rows for key in row if key != "scene"))
    table: list[Row] = [{"scene": row["scene"], **{key: row.get(key, math.nan) for key in keys}} for row in rows]
    means = {key: mean([row[key] for row in table]) for key in keys}
    return [*table, {"scene": "mean", **means}] if len(table) > 1 else table
