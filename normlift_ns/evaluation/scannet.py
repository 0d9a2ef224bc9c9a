"""3D semantic segmentation on ScanNet with OpenGaussian's protocol, in which Gaussian i is vertex i of the mesh."""

from __future__ import annotations

import math
import os
import warnings
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float, Int64
from plyfile import PlyData, PlyParseError
from torch import Tensor

from normlift_ns.core.metrics import NO_CLASS, ClassScores, class_scores, classify, confusion
from normlift_ns.data.splat import check_ply_header
from normlift_ns.errors import InputError
from normlift_ns.evaluation.options import Evaluation, ScannetOptions, mean
from normlift_ns.evaluation.protocols import EvaluatedRun, scene_names
from normlift_ns.options import WithoutDirection

NYU40 = {
    1: "wall", 2: "floor", 3: "cabinet", 4: "bed", 5: "chair", 6: "sofa", 7: "table", 8: "door", 9: "window",
    10: "bookshelf", 11: "picture", 12: "counter", 14: "desk", 16: "curtain", 24: "refrigerator", 28: "showercurtain",
    33: "toilet", 34: "sink", 36: "bathtub",
}  # fmt: skip
"""Prompts by NYU40 id: the class names as spelled in OpenGaussian's script."""
PAPER_SPELLING = {28: "shower curtain"}
"""Class names by NYU40 id that the paper spells differently."""
_LAST_ID = 40
CLASS_SETS = {
    19: tuple(NYU40),
    15: tuple(i for i in NYU40 if i not in (11, 24, 28, 36)),
    10: (1, 2, 4, 5, 6, 7, 8, 9, 10, 33),
}
"""NYU40 ids of the three class sets, by their number of classes."""
SCENES = tuple(f"scene{x}_00" for x in ["0000", "0062", "0070", "0097", "0140", "0200", "0347", "0400", "0590", "0645"])
"""Scenes of the published table."""
_OTHER: dict[WithoutDirection, WithoutDirection] = {"first": "none", "none": "first"}


class SceneLabels(NamedTuple):
    """Inputs of the protocol for one scene."""

    name: str
    cosine: Float[Tensor, "n 19"]
    """Cosine between every Gaussian's direction and each class name, in the order of `NYU40`."""
    valid: Bool[Tensor, " n"]
    """Mask of the Gaussians with a direction."""
    opacity: Float[Tensor, " n"]
    nyu40: Int64[Tensor, " n"]
    """True NYU40 id of the vertex of each Gaussian."""


def read_labels(path: Path) -> Int64[Tensor, " n"]:
    """Read the property `label` of the vertices in a PLY file such as scene0000_00_vh_clean_2.labels.ply.

    Raises:
        FileNotFoundError: If the file does not exist.
        ValueError: If the file is not a PLY file, is damaged, or has no label with an id in `NYU40`.
    """
    if not os.path.isfile(path):
        raise FileNotFoundError(
            f"the label file {path} does not exist or is not a file; expected ScanNet's *_vh_clean_2.labels.ply, which "
            "you can download after registration, under its license"
        )
    try:
        check_ply_header(path)
        vertex = next((x for x in PlyData.read(str(path), mmap="c").elements if x.name == "vertex"), None)
        if vertex is None or vertex.count == 0:
            raise InputError("its header has no vertices")
        names = [item.name for item in vertex.properties]
        if "label" not in names:
            raise InputError(f"its vertices have no property label, only {', '.join(names)}")
        column = np.asarray(vertex["label"])
        labels = np.nan_to_num(column.astype(float), nan=0.5).clip(-(2**31), 2**31).astype(np.int64)
        if (labels != column).any():
            raise InputError("its labels are not 32-bit integers")
    except (OSError, ValueError, TypeError, PlyParseError, EOFError, MemoryError, OverflowError) as error:
        raise InputError(
            f"{path} is damaged, or is not a PLY file with labeled vertices ({error}); download the "
            "*_vh_clean_2.labels.ply of the scene again"
        ) from error
    if not np.isin(labels, list(NYU40)).any():
        raise InputError(f"{path} has no label to score, expected some of the NYU40 ids {', '.join(map(str, NYU40))}")
    unknown = (labels > _LAST_ID) | (labels < -1)
    if unknown.any():
        warnings.warn(
            f"{path} has labels that are not NYU40 ids, such as {labels[unknown][0]}. Vertices with such labels "
            f"({int(unknown.sum()):,} of {len(labels):,}) are treated as unlabeled.",
            stacklevel=2,
        )
    return torch.from_numpy(np.where(unknown, 0, labels))


def check_identity(name: str, gaussians: int, labels: Int64[Tensor, " n"], path: Path) -> None:
    """Raise ValueError if the numbers of Gaussians and vertices differ, because Gaussian i must be vertex i."""
    if len(labels) != gaussians:
        raise InputError(
            f"run {name} has {gaussians:,} Gaussians, but {path} has {len(labels):,} vertices. The protocol needs one "
            "Gaussian per vertex, in the same order. Train with ns-train normlift-scannet, from all vertices, with "
            "fixed positions and without densification or culling"
        )


def scene_scores(
    scene: SceneLabels, classes: int, *, min_opacity: float = 0.1, without_direction: WithoutDirection = "first"
) -> ClassScores:
    """Score one scene with one of `CLASS_SETS`.

    A Gaussian is not scored if its true class is not in the set, or if its opacity is below `min_opacity`. All names of
    the set are prompts, but IoU and recall are computed only for the classes in the scene.

    Args:
        classes: Number of classes of the set, 10, 15 or 19.
    """
    truth, prediction = predict_classes(scene, classes, min_opacity=min_opacity, without_direction=without_direction)
    return class_scores(confusion(truth, prediction, classes))


def predict_classes(
    scene: SceneLabels, classes: int, *, min_opacity: float, without_direction: WithoutDirection
) -> tuple[Int64[Tensor, " n"], Int64[Tensor, " n"]]:
    """Return the true and the predicted class of every Gaussian as indices in the class set, as in `scene_scores`."""
    ids = list(NYU40)
    columns = [ids.index(i) for i in CLASS_SETS[classes]]
    class_of = torch.full((max(int(scene.nyu40.max()), *ids) + 1,), NO_CLASS)
    class_of[list(CLASS_SETS[classes])] = torch.arange(classes)
    truth = class_of[scene.nyu40.clamp(min=0)]
    truth = torch.where(scene.opacity < min_opacity, NO_CLASS, truth)
    return truth, classify(scene.cosine[:, columns], scene.valid, without_direction=without_direction)


def evaluate_scannet(scenes: Sequence[SceneLabels], options: ScannetOptions) -> Evaluation:
    """Compute mIoU and mAcc of every class set, averaged over scenes.

    Results with the suffix _none or _first use the other choice of `without_direction`.

    Raises:
        ValueError: If no Gaussian can be scored with one of the class sets.
    """
    min_opacity, without_direction = options.min_opacity, options.without_direction
    other = _OTHER[without_direction]
    names = [scene.name for scene in scenes]
    results, rows = {}, []
    by_scene: list[dict[str, Any]] = [{"scene": name} for name in names]
    for classes in CLASS_SETS:
        scores = {
            rule: [scene_scores(s, classes, min_opacity=min_opacity, without_direction=rule) for s in scenes]
            for rule in (without_direction, other)
        }
        if all(math.isnan(score.miou) for score in scores[without_direction]):
            raise InputError(
                f"nothing can be scored with {classes} classes, because no Gaussian of {', '.join(names)} has one of "
                f"these classes and an opacity of at least {min_opacity:g}; reduce --min-opacity or check the labels"
            )
        for rule, suffix in ((without_direction, ""), (other, f"_{other}")):
            results[f"miou_{classes}{suffix}"] = mean([s.miou for s in scores[rule]])
            results[f"macc_{classes}{suffix}"] = mean([s.macc for s in scores[rule]])
        for row, score in zip(by_scene, scores[without_direction]):
            row |= {f"miou_{classes}": score.miou, f"macc_{classes}": score.macc}
            rows += _class_rows(row["scene"], classes, score)
    missing = [name for name in SCENES if name not in names]
    facts = {"min_opacity": min_opacity, "without_direction": without_direction, "scenes": names}
    settings = {"protocol": "scannet", **facts, "missing_scenes": missing, "spelling": options.spelling}
    share = mean([float((~scene.valid).double().mean()) for scene in scenes])
    return Evaluation({**results, "without_direction_share": share}, rows, settings, by_scene)


def _class_rows(scene: str, classes: int, scores: ClassScores) -> list[dict[str, Any]]:
    """Return the scores of each class in the ground truth of a scene."""
    return [
        {"scene": scene, "classes": classes, "class": NYU40[i], "iou": iou, "accuracy": accuracy}
        for i, iou, accuracy in zip(CLASS_SETS[classes], scores.iou.tolist(), scores.accuracy.tolist())
        if not math.isnan(iou)
    ]


def label_scene(
    lifted: EvaluatedRun, name: str, path: Path, nyu40: Int64[Tensor, " n"], options: ScannetOptions
) -> SceneLabels:
    """Return the inputs of protocol scannet for a run.

    Raises:
        ValueError: If the number of vertices differs from the number of Gaussians.
    """
    check_identity(name, len(lifted.scene.gaussians), nyu40, path)
    prompts = NYU40 if options.spelling == "script" else NYU40 | PAPER_SPELLING
    cosine = lifted.cosine(tuple(prompts.values()))
    return SceneLabels(name, cosine, lifted.valid, lifted.scene.gaussians.opacities, nyu40)


def run_scannet(runs: Iterable[EvaluatedRun], labels: Sequence[Path], options: ScannetOptions) -> Evaluation:
    """Run protocol scannet with one run per scene.

    Raises:
        FileNotFoundError, ValueError: If labels are missing or damaged, or have the wrong number of vertices.
    """
    truths = [read_labels(path) for path in labels]
    inputs = zip(runs, scene_names(labels), labels, truths)
    scenes = [label_scene(lifted, name, path, nyu40, options) for lifted, name, path, nyu40 in inputs]
    return evaluate_scannet(scenes, options)
