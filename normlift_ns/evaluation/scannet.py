"""3D semantic segmentation on ScanNet as OpenGaussian runs it: Gaussian i is vertex i of the labelled mesh."""

from __future__ import annotations

import math
import os
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float, Int64
from torch import Tensor

from normlift_ns.core.metrics import NO_CLASS, ClassScores, WithoutDirection, class_scores, classify, confusion
from normlift_ns.errors import InputError
from normlift_ns.evaluation.results import Evaluation, mean
from normlift_ns.evaluation.vertices import read_column

NYU40 = {
    1: "wall", 2: "floor", 3: "cabinet", 4: "bed", 5: "chair", 6: "sofa", 7: "table", 8: "door", 9: "window",
    10: "bookshelf", 11: "picture", 12: "counter", 14: "desk", 16: "curtain", 24: "refrigerator", 28: "showercurtain",
    33: "toilet", 34: "sink", 36: "bathtub",
}  # fmt: skip
"""Names that are queried, bare and spelled as in OpenGaussian's script, by NYU40 id."""
PAPER_SPELLING = {28: "shower curtain"}
"""Names that the paper prints otherwise."""
_LAST_ID = 40
CLASS_SETS = {
    19: tuple(NYU40),
    15: tuple(i for i in NYU40 if i not in (11, 24, 28, 36)),
    10: (1, 2, 4, 5, 6, 7, 8, 9, 10, 33),
}
"""NYU40 ids of the three sets."""
SCENES = tuple(f"scene{x}_00" for x in ["0000", "0062", "0070", "0097", "0140", "0200", "0347", "0400", "0590", "0645"])
"""Scenes of the published table."""


class SceneLabels(NamedTuple):
    """What the protocol needs of one scene."""

    name: str
    cosine: Float[Tensor, "n 19"]
    """Of every Gaussian to the names of `NYU40`, in their order."""
    valid: Bool[Tensor, " n"]
    """Gaussians that have a direction."""
    opacity: Float[Tensor, " n"]
    nyu40: Int64[Tensor, " n"]
    """True NYU40 id of the vertex of every Gaussian."""


def read_labels(path: Path) -> Int64[Tensor, " n"]:
    """Property `label` of the vertices of a PLY file, such as scene0000_00_vh_clean_2.labels.ply.

    Raises:
        FileNotFoundError: no such file.
        ValueError: no PLY file, a damaged one, or one without labels.
    """
    if not os.path.isfile(path):
        raise FileNotFoundError(
            f"labels {path} do not exist; ScanNet's *_vh_clean_2.labels.ply is wanted, which its licence lets you "
            "download after registration"
        )
    try:
        found = read_column(path, "label")
        whole = np.nan_to_num(found.astype(float), nan=0.5).clip(-(2**31), 2**31).astype(np.int64)
        if (whole != found).any():
            raise InputError("its labels are no whole numbers of 32 bits")
    except (OSError, ValueError) as error:
        raise InputError(
            f"{path} is damaged or no PLY file with vertices and their labels ({error}); the file "
            "*_vh_clean_2.labels.ply is meant: download it again"
        ) from error
    known = np.isin(whole, list(NYU40))
    if not known.any():
        raise InputError(
            f"{path}: no label is one of the NYU40 ids {', '.join(map(str, NYU40))}; nothing can be scored"
        )
    strange = (whole > _LAST_ID) | (whole < -1)
    if strange.any():
        warnings.warn(
            f"{path}: {int(strange.sum()):,} of {len(whole):,} labels are no NYU40 ids ({whole[strange][0]} among "
            "them); they count as unlabelled",
            stacklevel=2,
        )
    return torch.from_numpy(np.where(strange, 0, whole))


def check_identity(name: str, gaussians: int, labels: Int64[Tensor, " n"], path: Path) -> None:
    """Gaussian i must be vertex i.

    Raises:
        ValueError: their numbers differ.
    """
    if len(labels) != gaussians:
        raise InputError(
            f"run {name} has {gaussians:,} Gaussians, {path} {len(labels):,} vertices; the protocol needs one Gaussian "
            "per vertex, in their order: train from all vertices with densification and culling off and positions fixed"
        )


def scene_scores(
    scene: SceneLabels, classes: int, *, min_opacity: float = 0.1, without_direction: WithoutDirection = "first"
) -> ClassScores:
    """Scores of one scene for one of `CLASS_SETS`.

    Truth outside the set, and that of Gaussians of opacity below `min_opacity`, does not count. All names of the set
    are asked, also those that the scene lacks; IoU and recall are of the classes that it has.
    """
    truth, found = answers(scene, classes, min_opacity=min_opacity, without_direction=without_direction)
    return class_scores(confusion(truth, found, classes))


def answers(
    scene: SceneLabels, classes: int, *, min_opacity: float, without_direction: WithoutDirection
) -> tuple[Int64[Tensor, " n"], Int64[Tensor, " n"]]:
    """Truth and answer of every Gaussian, as indices into the set of classes; see `scene_scores`."""
    ids = list(NYU40)
    columns = [ids.index(i) for i in CLASS_SETS[classes]]
    class_of = torch.full((max(int(scene.nyu40.max()), *ids) + 1,), NO_CLASS)
    class_of[list(CLASS_SETS[classes])] = torch.arange(classes)
    truth = class_of[scene.nyu40.clamp(min=0)]
    truth = torch.where(scene.opacity < min_opacity, NO_CLASS, truth)
    return truth, classify(scene.cosine[:, columns], scene.valid, without_direction=without_direction)


def evaluate_scannet(
    scenes: Sequence[SceneLabels], *, min_opacity: float = 0.1, without_direction: WithoutDirection = "first"
) -> Evaluation:
    """mIoU and mAcc of every set of classes, means over scenes; beside them the other reading of Gaussians without
    direction, as `..._none` or `..._first`.
    """
    other: WithoutDirection = "none" if without_direction == "first" else "first"
    results, rows = {}, []
    by_scene: list[dict[str, Any]] = [{"scene": scene.name} for scene in scenes]
    for classes, ids in CLASS_SETS.items():
        scores = {
            rule: [scene_scores(s, classes, min_opacity=min_opacity, without_direction=rule) for s in scenes]
            for rule in (without_direction, other)
        }
        if all(math.isnan(score.miou) for score in scores[without_direction]):
            names = ", ".join(scene.name for scene in scenes)
            raise InputError(
                f"nothing can be scored with {classes} classes: no Gaussian of {names} has a label "
                f"among them and an opacity of at least {min_opacity:g} (--min-opacity)"
            )
        for rule, suffix in ((without_direction, ""), (other, f"_{other}")):
            results[f"miou_{classes}{suffix}"] = mean([s.miou for s in scores[rule]])
            results[f"macc_{classes}{suffix}"] = mean([s.macc for s in scores[rule]])
        for row, found in zip(by_scene, scores[without_direction]):
            row |= {f"miou_{classes}": found.miou, f"macc_{classes}": found.macc}
        for scene, found in zip(scenes, scores[without_direction]):
            rows += [
                {"scene": scene.name, "classes": classes, "class": NYU40[i], "iou": iou, "accuracy": accuracy}
                for i, iou, accuracy in zip(ids, found.iou.tolist(), found.accuracy.tolist())
                if not math.isnan(iou)  # the scene lacks the class
            ]
    names = [scene.name for scene in scenes]
    missing = [name for name in SCENES if name not in names]
    settings = {
        "protocol": "scannet", "min_opacity": min_opacity, "without_direction": without_direction, "scenes": names,
        "missing_scenes": missing,
    }  # fmt: skip
    share = mean([float((~scene.valid).double().mean()) for scene in scenes])
    return Evaluation({**results, "without_direction_share": share}, rows, settings, by_scene)
