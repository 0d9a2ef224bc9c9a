"""Lifted runs for evaluation, and the evaluation against instance masks."""

from __future__ import annotations

import os
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import torch
from jaxtyping import Bool, Float, Int64
from torch import Tensor

from normlift_ns.core.evidence import UNLABELED, Evidence
from normlift_ns.core.field import SemanticField
from normlift_ns.core.gaussians import Camera, GaussianScene
from normlift_ns.core.metrics import NO_CLASS, class_scores, classify, confusion
from normlift_ns.core.scene import Scene, Views
from normlift_ns.data.images import label_undistortion
from normlift_ns.encoders.text_files import TextEncoder
from normlift_ns.errors import InputError
from normlift_ns.evaluation.options import Evaluation, MaskOptions, PromptText, read_document
from normlift_ns.io.guard import check_files_distinct
from normlift_ns.rasterization.rasterize import rasterize_evidence, render
from normlift_ns.rasterization.settings import RasterSettings
from normlift_ns.segmentation.regions import LabelFiles

_VALUE = re.compile(r"0|-?[1-9][0-9]{0,9}")


class _NamesFile(msgspec.Struct):
    """Content of a file of mask names."""

    labels: dict[str, PromptText]
    background: int | None = None


@dataclass(frozen=True)
class Names:
    """Class names of the values of instance masks."""

    classes: tuple[str, ...]
    """Distinct names, which are used as prompts."""
    class_of: Mapping[int, int]
    """Index in `classes` of each mask value. Pixels with other values are ignored."""


def read_names(path: Path) -> Names:
    """Read a JSON file such as {"labels": {"1": "table", ...}, "background": 0}.

    The file may also consist of the inner object alone, such as {"1": "table", ...}. Values with the same name belong
    to the same class.

    Raises:
        FileNotFoundError: If the file does not exist.
        ValueError: If the file has the wrong format.
    """
    expected = 'expected {"labels": {"1": "table", ...}}'
    if not os.path.lexists(path):
        raise FileNotFoundError(
            f'the file of mask names {path} does not exist; write {{"labels": {{"1": "table", ...}}}} to it'
        )
    try:
        document = read_document(path, dict[str, Any])
        named = msgspec.convert(document if "labels" in document else {"labels": document}, _NamesFile)
        wrong = [key for key in named.labels if _VALUE.fullmatch(key) is None]
        if len(wrong) > 0:
            raise InputError(f"{wrong[0]!r} is not a mask value, expected an integer such as 1")
        name_of = {int(value): name for value, name in named.labels.items()}
        if named.background is not None and named.background in name_of:
            raise InputError(f"value {named.background} is the background, but also has a name")
        if len(name_of) == 0:
            raise InputError("it contains no names")
    except ValueError as error:
        raise InputError(f"{path} is not a valid file of mask names ({error}); {expected}") from error
    classes = tuple(dict.fromkeys(name_of.values()))
    return Names(classes, {value: classes.index(name) for value, name in name_of.items()})


def read_classes(masks: LabelFiles, name: str, names: Names, height: int, width: int) -> Int64[Tensor, "h w"]:
    """Return the class of every pixel of an image, or -1 for pixels to ignore.

    Raises:
        FileNotFoundError, ValueError: If the mask is missing, is damaged, or has the wrong size. The message names the
            file.
    """
    values = masks.values(name)
    if values.shape != (1, height, width):
        size = values.shape if len(values) > 1 else values.shape[1:]
        raise InputError(
            f"mask {masks.path(name)} has shape {size}, but its image {name} is {height} x {width} (height x width); "
            "provide masks of the same size as the undistorted images"
        )
    unique, inverse = np.unique(values[0], return_inverse=True)
    table = torch.tensor([names.class_of.get(int(value), NO_CLASS) for value in unique])
    return table[torch.from_numpy(inverse.reshape(height, width))]


def gaussian_truth(
    evidence: Evidence, classes: int, *, purity: float = 0.75, min_weight: float = 1.0
) -> Int64[Tensor, " n"]:
    """Return the true class of every Gaussian from evidence of the true masks, with one column per view and class.

    A Gaussian below either minimum has class -1.

    Args:
        purity: Minimum share of the class in the weight of the Gaussian. The weight includes that of ignored pixels.
        min_weight: Minimum weight over all views, in pixels.
    """
    columns = torch.arange(evidence.num_regions) % classes
    by_class = evidence.rows.matmul(torch.nn.functional.one_hot(columns, classes).to(evidence.rows.weight))
    total = by_class.sum(1) + evidence.unlabeled.row_sums().to(by_class)
    best = by_class.max(dim=1)
    valid = (total >= min_weight) & (best.values >= purity * total)
    return torch.where(valid, best.indices, NO_CLASS)


def evaluate_masks(
    names: Sequence[str],
    truth: Int64[Tensor, " n"],
    prediction: Int64[Tensor, " n"],
    pixels: Sequence[tuple[Int64[Tensor, "h w"], Int64[Tensor, "h w"]]],
    reliability: Float[Tensor, " n"],
    settings: Mapping[str, object],
) -> Evaluation:
    """Compute miou_3d and macc_3d over Gaussians, and miou_2d and macc_2d over all pixels of the held-out views.

    Args:
        pixels: True and predicted classes of every held-out view.
    """
    classes = len(names)
    of_gaussians = class_scores(confusion(truth, prediction, classes))
    counts = sum((confusion(t, f, classes) for t, f in pixels), torch.zeros(classes, classes + 1, dtype=torch.int64))
    of_pixels = class_scores(counts)
    scored = truth >= 0
    correct = (prediction == truth)[scored].double()
    results = {
        "miou_3d": of_gaussians.miou,
        "macc_3d": of_gaussians.macc,
        "accuracy_3d": float(correct.mean()) if len(correct) > 0 else float("nan"),
        "miou_2d": of_pixels.miou,
        "macc_2d": of_pixels.macc,
        "gaussians_with_truth_share": float(scored.double().mean()),
        "zero_evidence_share": float((reliability == 0).double().mean()),
    }
    rows: list[dict[str, Any]] = []
    for c, name in enumerate(names):
        rows.append({"class": name, "gaussians": int((truth == c).sum())})
        for suffix, scores in (("3d", of_gaussians), ("2d", of_pixels)):
            rows[-1] |= {f"iou_{suffix}": float(scores.iou[c]), f"accuracy_{suffix}": float(scores.accuracy[c])}
    return Evaluation(results, rows, {"protocol": "masks", **settings})


_CHANNELS = 64
"""Number of feature channels to composite at a time."""


@dataclass(frozen=True)
class EvaluatedRun:
    """Lifted run with the settings of its evaluation."""

    scene: Scene
    field: SemanticField
    texts: TextEncoder
    refined: bool
    cache: Path | None = None
    """Folder of the lift's cache of 2D features, or None without a cache."""

    def cosine(self, names: Sequence[str]) -> Float[Tensor, "n q"]:
        """Return the cosine between every Gaussian's direction and each prompt; 0 for Gaussians without a direction."""
        return self.field.query(self.texts.text(names), refined=self.refined).float()

    @property
    def valid(self) -> Bool[Tensor, " n"]:
        """Mask of the Gaussians with a direction."""
        return self.field.valid(refined=self.refined)

    @property
    def settings(self) -> RasterSettings:
        """Rasterizer settings of the lift."""
        return RasterSettings.recorded(self.field.manifest)

    def composite(self, camera: Camera, values: Float[Tensor, "n q"]) -> tuple[Tensor, Tensor]:
        """Render values [H, W, Q] and alpha [H, W] with the rasterizer settings of the lift."""
        mode = self.scene.rasterize_mode
        return render(self.scene.gaussians, camera, values, rasterize_mode=mode, settings=self.settings)

    def feature_lengths(
        self, cameras: Sequence[Camera], factor: Float[Tensor, "n 1"] | float = 1.0
    ) -> list[Float[Tensor, "h w"]]:
        """Return the length of the composited feature vector of every pixel, for each camera.

        Args:
            factor: Factor for all directions, or one per direction, to apply before compositing.
        """
        squares = [torch.zeros(camera.height, camera.width, dtype=torch.float64) for camera in cameras]
        for axes in torch.eye(self.field.dimension).split(_CHANNELS):
            values = factor * self.field.query(axes, refined=self.refined).float()
            for i, camera in enumerate(cameras):
                squares[i] += self.composite(camera, values)[0].double().square().sum(dim=2)
        return [square.sqrt() for square in squares]

    def cameras(self) -> dict[str, Camera]:
        """Return the cameras of all training and held-out images by image name."""
        train, held_out = self.scene.train, self.scene.held_out
        return dict(zip((*train.names, *held_out.names), (*train.cameras, *held_out.cameras)))


Rasterize = Callable[..., Evidence]
"""`rasterize_evidence` with fixed arguments that all calls share."""


def rasterizer(scene: Scene, settings: RasterSettings | None, gaussians: GaussianScene | None = None) -> Rasterize:
    """Return `rasterize_evidence` with the Gaussians and the mode of a scene as fixed arguments.

    `gaussians` replaces the Gaussians of the scene, for example with a copy on another device.
    """
    gaussians = scene.gaussians if gaussians is None else gaussians
    return partial(rasterize_evidence, gaussians, rasterize_mode=scene.rasterize_mode, settings=settings)


def scene_names(labels: Sequence[Path]) -> list[str]:
    """Return a scene name for each label file or folder: its name up to "_vh_clean", or its path for repeated names.

    >>> scene_names([Path("label/ramen"), Path("a/scene0000_00_vh_clean_2.labels.ply")])
    ['ramen', 'scene0000_00']
    >>> scene_names([Path("a/ramen"), Path("b/ramen")])
    ['a/ramen', 'b/ramen']
    """
    short = [path.name.split("_vh_clean")[0] for path in labels]
    return [name if short.count(name) == 1 else str(path) for name, path in zip(short, labels)]


@dataclass(frozen=True)
class MaskTruth:
    """Ground truth of a run from its instance masks."""

    classes: tuple[str, ...]
    gaussians: Int64[Tensor, " n"]
    """Index in `classes` for every Gaussian, or -1 for Gaussians to ignore."""
    held_out: Sequence[Int64[Tensor, "h w"]]
    """Index in `classes` for every pixel of each held-out view, or -1 for pixels to ignore."""
    settings: Mapping[str, Any]


def mask_truth(
    scene: Scene, folder: Path, options: MaskOptions, *, settings: RasterSettings | None = None
) -> MaskTruth:
    """Derive the ground truth of Gaussians and of held-out pixels from instance masks.

    Args:
        settings: Rasterizer settings (default: those of gsplat 1.4).
    Raises:
        FileNotFoundError, ValueError: If masks or names are missing or damaged. The message names the file.
    """
    undistort = label_undistortion(scene.train, scene.held_out)
    masks = LabelFiles(folder, undistort=undistort, description="instance mask", flag="--labels")
    images = [*scene.train.names, *scene.held_out.names]
    check_files_distinct(
        ((name, masks.path(name)) for name in images), masks.description, "in folders named like those of the images"
    )
    names = read_names(options.names or folder.parent / "labels.json")

    def classes(views: Views) -> Iterator[Tensor]:
        for name, camera in zip(views.names, views.cameras):
            yield read_classes(masks, name, names, camera.height, camera.width)

    count = len(names.classes)
    labels = (labels.int().clamp(min=UNLABELED) for labels in classes(scene.train))
    evidence = rasterizer(scene, settings)(scene.train.cameras, labels, num_regions=[count] * len(scene.train))
    truth = gaussian_truth(evidence, count, purity=options.purity, min_weight=options.min_weight)
    if not bool((truth >= 0).any()):
        raise InputError(
            f"no Gaussian can be scored with the masks in {folder}; check that the mask values are those in "
            f"{options.names or folder.parent / 'labels.json'}, or reduce --purity or --min-weight"
        )
    facts = {**asdict(options), "names": list(names.classes), "held_out_views": len(scene.held_out)}
    return MaskTruth(names.classes, truth, list(classes(scene.held_out)), facts)


def run_masks(lifted: EvaluatedRun, truth: MaskTruth) -> Evaluation:
    """Run protocol masks on one run, in 3D over Gaussians and in 2D over held-out views."""
    cosine, pixels = lifted.cosine(truth.classes), []
    for camera, exact in zip(lifted.scene.held_out.cameras, truth.held_out):
        values, alpha = lifted.composite(camera, cosine)
        pixels.append((exact, classify(values.flatten(0, 1), alpha.flatten() > 0).view(alpha.shape)))
    prediction, reliability = classify(cosine, lifted.valid), lifted.field.scalars.reliability
    return evaluate_masks(truth.classes, truth.gaussians, prediction, pixels, reliability, truth.settings)
