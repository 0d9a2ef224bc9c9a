"""What else a protocol can tell of lifted runs: ablation, sweeps of parameters, signals of R, what lifting took."""

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


def study_ablation(
    runs: Sequence[EvaluatedRun], evaluate: Evaluate, device: str, tell: Callable[[str], None] = lambda text: None
) -> list[Row]:
    """Results of the protocol with every variant, without consensus and with it, whichever way the runs were lifted.

    Args:
        tell: told why variants are left out: the features of a run cannot be made again.
    """
    rows: list[Row] = []
    for on, votes in ((False, ablation), (True, agreed_ablation)):
        try:
            some = [with_consensus(lifted, on, device) for lifted in runs]
        except (ValueError, FileNotFoundError) as error:
            tell(f"The ablation leaves out all variants {'with' if on else 'without'} consensus: {error}")
            continue
        rows += study_votes(some, evaluate, votes, device)
    return rows


def signal_rows(names: Sequence[str], scenes: Sequence[SceneSignals]) -> list[Row]:
    """`signals` of every scene and, if there are several, of all of them pooled."""
    rows: list[Row] = [{"scene": name, **signals(scene)} for name, scene in zip(names, scenes)]
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


def baselines(runs: Sequence[EvaluatedRun], evaluate: Evaluate, device: str) -> list[Row]:
    """Results of the protocol for the runs and for `BASELINES` on the same features; those are not refined.

    Raises:
        ValueError, FileNotFoundError: as `seen_blocks`.
    """
    rows: list[Row] = []
    for refined in (True, False):
        name, what = ("normlift", "the run, refined") if refined else ("unrefined", "the run, unrefined")
        results = evaluate(replace(lifted, refined=refined) for lifted in runs).results
        rows.append({"method": name, "what": what, **results})
    for method, what in BASELINES.items():
        others = (replace(lifted, field=baseline_field(method, lifted, device), refined=False) for lifted in runs)
        rows.append({"method": method, "what": what, **evaluate(others).results})
    return rows


def timing(
    runs: Sequence[EvaluatedRun], device: str = "cpu", tell: Callable[[str], None] = lambda text: None
) -> list[Row]:
    """Seconds of every stage and peak memory of every lift, as their manifests have them, and on a GPU those of SFS's
    way and of ours on some views of each, measured now; and the means.

    Args:
        tell: told why SFS's way is left out, where it is.
    """
    rows = []
    for lifted in runs:
        row = {"scene": lifted.scene.name, **lifted.field.manifest.get("cost", {})}
        reason = why_not_timed(lifted, device)
        if reason is None:
            try:
                row |= time_sfs_way(lifted, device)
            except (ValueError, FileNotFoundError) as error:  # its features cannot be made again
                reason = str(error)
        if reason is not None:
            tell(f"The timing of {lifted.scene.name} leaves out SFS's way (512 channels through gsplat): {reason}")
        rows.append(row)
    keys = list(dict.fromkeys(key for row in rows for key in row if key != "scene"))
    table: list[Row] = [{"scene": row["scene"], **{key: row.get(key, math.nan) for key in keys}} for row in rows]
    means = {key: mean([row[key] for row in table]) for key in keys}
    return [*table, {"scene": "mean", **means}] if len(table) > 1 else table
