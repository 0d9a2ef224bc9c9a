"""The three evaluation protocols on lifted runs: from files and options to metrics."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Bool, Float, Int64
from torch import Tensor

from normlift_ns.core.evidence import UNLABELED
from normlift_ns.core.field import SemanticField
from normlift_ns.core.gaussians import Camera
from normlift_ns.core.metrics import classify
from normlift_ns.core.query import relevancy
from normlift_ns.core.scene import Scene, Views
from normlift_ns.encoders.regions import LabelFiles
from normlift_ns.encoders.source import TextEncoder, refuse_shared
from normlift_ns.errors import InputError
from normlift_ns.evaluation.instance_masks import evaluate_masks, gaussian_truth, read_classes, read_names
from normlift_ns.evaluation.lerf import FrameScores, frame_rows, summarize_lerf
from normlift_ns.evaluation.lerf_labels import LabeledFrame, match_views, read_frame, read_frames
from normlift_ns.evaluation.options import LANGSPLAT, LerfOptions, MaskOptions, ScannetOptions
from normlift_ns.evaluation.results import Evaluation
from normlift_ns.evaluation.scannet import (
    NYU40,
    PAPER_SPELLING,
    SceneLabels,
    check_identity,
    evaluate_scannet,
    read_labels,
)
from normlift_ns.options import BACKGROUND_WORDS, CANONICAL_NEGATIVES
from normlift_ns.raster.rasterize import rasterize_evidence, render
from normlift_ns.raster.settings import RasterSettings

_CHANNELS = 64
"""Number of feature channels that are composited together."""


@dataclass(frozen=True)
class EvaluatedRun:
    """A lifted run, and which of its features to evaluate."""

    scene: Scene
    field: SemanticField
    texts: TextEncoder
    refined: bool
    cache: Path | None = None
    """Folder in which the lift caches 2D features."""

    def cosine(self, names: Sequence[str]) -> Float[Tensor, "n q"]:
        """Return the cosine between every Gaussian's direction and each prompt; 0 without a direction."""
        return self.field.query(self.texts.text(names), refined=self.refined).float()

    @property
    def valid(self) -> Bool[Tensor, " n"]:
        """Gaussians with a direction."""
        return self.field.valid(refined=self.refined)

    @property
    def settings(self) -> RasterSettings:
        """Rasterizer settings of the lift."""
        return RasterSettings.recorded(self.field.manifest)

    def composited(self, camera: Camera, values: Float[Tensor, "n q"]) -> tuple[Tensor, Tensor]:
        """Render values [H, W, Q] and alpha [H, W] with the settings of the lift."""
        mode = self.scene.rasterize_mode
        return render(self.scene.gaussians, camera, values, rasterize_mode=mode, settings=self.settings)

    def feature_lengths(
        self, cameras: Sequence[Camera], factor: Float[Tensor, "n 1"] | float = 1.0
    ) -> list[Float[Tensor, "h w"]]:
        """Return the length of every pixel's composited feature vector, computed in groups of channels.

        Args:
            factor: factor on the directions before they are composited.
        """
        squares = [torch.zeros(camera.height, camera.width, dtype=torch.float64) for camera in cameras]
        for axes in torch.eye(self.field.dimension).split(_CHANNELS):
            values = factor * self.field.query(axes, refined=self.refined).float()
            for i, camera in enumerate(cameras):
                squares[i] += self.composited(camera, values)[0].double().square().sum(dim=2)
        return [square.sqrt() for square in squares]

    def cameras(self) -> dict[str, Camera]:
        """Return the cameras of all training and held-out images by image name."""
        splits = (self.scene.train, self.scene.held_out)
        return {name: camera for views in splits for name, camera in zip(views.names, views.cameras)}


def scene_names(labels: Sequence[Path]) -> list[str]:
    """Return scene names for label files or folders: the name of the file or folder, or the whole path if names are
    equal.

    >>> scene_names([Path("label/ramen"), Path("a/scene0000_00_vh_clean_2.labels.ply")])
    ['ramen', 'scene0000_00']
    >>> scene_names([Path("a/ramen"), Path("b/ramen")])
    ['a/ramen', 'b/ramen']
    """
    short = [path.name.split("_vh_clean")[0] for path in labels]
    return [name if short.count(name) == 1 else str(path) for name, path in zip(short, labels)]


def label_scene(
    lifted: EvaluatedRun, name: str, path: Path, nyu40: Int64[Tensor, " n"], options: ScannetOptions
) -> SceneLabels:
    """Return the data of a run that protocol scannet needs.

    Raises:
        ValueError: the number of vertices differs from that of Gaussians.
    """
    check_identity(name, len(lifted.scene.gaussians), nyu40, path)
    prompts = NYU40 if options.spelling == "script" else NYU40 | PAPER_SPELLING
    cosine = lifted.cosine(tuple(prompts.values()))
    return SceneLabels(name, cosine, lifted.valid, lifted.scene.gaussians.opacities, nyu40)


def run_scannet(runs: Iterable[EvaluatedRun], labels: Sequence[Path], options: ScannetOptions) -> Evaluation:
    """Run protocol scannet with one run per scene.

    Raises:
        FileNotFoundError, ValueError: labels are missing, damaged or of another number of points.
    """
    truths = [read_labels(path) for path in labels]
    inputs = zip(runs, scene_names(labels), labels, truths)
    scenes = [label_scene(lifted, name, path, nyu40, options) for lifted, name, path, nyu40 in inputs]
    kwargs = {"min_opacity": options.min_opacity, "without_direction": options.without_direction}
    evaluation = evaluate_scannet(scenes, **kwargs)
    return replace(evaluation, settings={**evaluation.settings, "spelling": options.spelling})


def run_lerf(runs: Iterable[EvaluatedRun], labels: Sequence[Path], options: LerfOptions) -> Evaluation:
    """Run protocol lerf with one run per scene.

    Raises:
        FileNotFoundError, ValueError: labels are missing, damaged or of other images.
    """
    files = [read_frames(folder) for folder in labels]
    rows, missing = [], []
    for scene, frames, lifted in zip(scene_names(labels), files, runs):
        cameras = lifted.cameras()
        images, unmatched = match_views(frames, list(cameras))
        missing += [f"{scene}/{stem}" for stem in unmatched]
        views = [
            (cameras[name], read_frame(file, cameras[name].width, cameras[name].height))
            for file, name in images.items()
        ]
        views = [(camera, frame) for camera, frame in views if len(frame.masks) > 0]
        factor = lifted.field.scalars.norm[:, None].float() if options.scale == "norm" else 1.0
        lengths: list[Tensor | None] = [None] * len(views)
        if options.masking == "langsplat":
            lengths = list(lifted.feature_lengths([camera for camera, _ in views], factor))
        for (camera, frame), length in zip(views, lengths):
            scores = _frame_scores(lifted, camera, frame, factor, length, options)
            rows += [
                {"scene": scene, **row, "frame": f"{scene}/{frame.stem}"}
                for row in frame_rows(scores, options.masking, margin=options.margin, clean=options.clean)
            ]
    if len(rows) == 0:
        raise InputError(f"the label files in {', '.join(map(str, labels))} have no objects; nothing can be scored")
    settings = {**asdict(options), "labels_without_image": missing}
    return summarize_lerf(rows, options.average, settings)


def _frame_scores(
    lifted: EvaluatedRun,
    camera: Camera,
    frame: LabeledFrame,
    factor: Float[Tensor, "n 1"] | float,
    length: Float[Tensor, "h w"] | None,
    options: LerfOptions,
) -> FrameScores:
    """Return composited scores, divided by the length of each pixel's feature if given."""
    prompts, langsplat = tuple(frame.masks), options.masking in LANGSPLAT
    negatives = CANONICAL_NEGATIVES if langsplat else BACKGROUND_WORDS
    values, _ = lifted.composited(camera, factor * lifted.cosine((*prompts, *negatives)))
    if length is not None:
        values = torch.where(length[:, :, None] > 0, values / length[:, :, None], 0.0).to(values)
    values, background = values[:, :, : len(prompts)], values[:, :, len(prompts) :]
    return FrameScores(frame, relevancy(values, background, rule="lerf") if langsplat else values, background)


@dataclass(frozen=True)
class MaskTruth:
    """Ground truth of a run from its instance masks."""

    classes: tuple[str, ...]
    gaussians: Int64[Tensor, " n"]
    """Class of every Gaussian, -1 if it does not count."""
    held_out: Sequence[Int64[Tensor, "h w"]]
    """Class of every pixel in the held-out views."""
    settings: Mapping[str, Any]


def mask_truth(
    scene: Scene, folder: Path, options: MaskOptions, *, settings: RasterSettings | None = None
) -> MaskTruth:
    """Derive the truth of Gaussians from the masks of the training views, and that of pixels in held-out views.

    Args:
        settings: rasterizer settings, those of gsplat 1.4 if None.
    Raises:
        FileNotFoundError, ValueError: masks or names are missing or damaged; the message names the file.
    """
    masks = LabelFiles(folder, what="instance mask", flag="--labels")
    images = [*scene.train.names, *scene.held_out.names]
    refuse_shared(
        ((name, masks.path(name)) for name in images), masks.what, "in folders named like those of the images"
    )
    names = read_names(options.names or folder.parent / "labels.json")

    def classes(views: Views) -> Iterator[Tensor]:
        for name, camera in zip(views.names, views.cameras):
            yield read_classes(masks, name, names, camera.height, camera.width)

    count = len(names.classes)
    evidence = rasterize_evidence(
        scene.gaussians,
        scene.train.cameras,
        (labels.int().clamp(min=UNLABELED) for labels in classes(scene.train)),
        num_regions=[count] * len(scene.train),
        rasterize_mode=scene.rasterize_mode,
        settings=settings,
    )
    truth = gaussian_truth(evidence, count, purity=options.purity, min_weight=options.min_weight)
    if not bool((truth >= 0).any()):
        raise InputError(
            f"no Gaussian lies in a mask of {folder}; check that the mask values are those in "
            f"{options.names or folder.parent / 'labels.json'}, and check --purity and --min-weight"
        )
    facts = {**asdict(options), "names": list(names.classes), "held_out_views": len(scene.held_out)}
    return MaskTruth(names.classes, truth, list(classes(scene.held_out)), facts)


def run_masks(lifted: EvaluatedRun, truth: MaskTruth) -> Evaluation:
    """Run protocol masks on one run: 3D over Gaussians, 2D in held-out views."""
    cosine, pixels = lifted.cosine(truth.classes), []
    for camera, exact in zip(lifted.scene.held_out.cameras, truth.held_out):
        values, alpha = lifted.composited(camera, cosine)
        pixels.append((exact, classify(values.flatten(0, 1), alpha.flatten() > 0).view(alpha.shape)))
    prediction, reliability = classify(cosine, lifted.valid), lifted.field.scalars.reliability
    return evaluate_masks(truth.classes, truth.gaussians, prediction, pixels, reliability, truth.settings)
