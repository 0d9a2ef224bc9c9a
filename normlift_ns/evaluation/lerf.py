"""Evaluation on LERF-OVS, with its label files and scores."""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Hashable, Iterable, Mapping, Sequence
from dataclasses import asdict
from pathlib import Path, PurePosixPath
from typing import Annotated, Any, NamedTuple

import cv2
import msgspec
import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from normlift_ns.core.gaussians import Camera
from normlift_ns.core.metrics import localized, mask_iou, mask_recall
from normlift_ns.core.relevancy import relevancy
from normlift_ns.errors import InputError
from normlift_ns.evaluation.options import (
    LANGSPLAT_MASKINGS,
    AveragingOrder,
    Evaluation,
    LerfOptions,
    Masking,
    PromptText,
    mean,
    read_document,
)
from normlift_ns.evaluation.protocols import EvaluatedRun, scene_names
from normlift_ns.evaluation.sfs import clean_mask, histogram_threshold
from normlift_ns.options import BACKGROUND_WORDS, CANONICAL_NEGATIVES

# Labels of LERF-OVS, with one JSON file of named polygons per annotated frame.


_Point = tuple[float, float]


class _Info(msgspec.Struct):
    width: Annotated[int, msgspec.Meta(ge=1, le=2**15)]
    height: Annotated[int, msgspec.Meta(ge=1, le=2**15)]


class _Object(msgspec.Struct):
    category: PromptText
    segmentation: Annotated[list[_Point], msgspec.Meta(min_length=3)]
    bbox: tuple[float, float, float, float] | None = None


class _File(msgspec.Struct):
    """Content of a label file."""

    info: _Info
    objects: list[_Object]


class LabeledFrame(NamedTuple):
    """Masks and boxes of the objects in an annotated frame."""

    stem: str
    """File stem of the annotated image."""
    masks: dict[str, Bool[Tensor, "h w"]]
    """Mask of each category, as the union of its objects."""
    boxes: dict[str, list[tuple[float, float, float, float]]]
    """Boxes (x1, y1, x2, y2) of the objects of each category, in pixels."""


def read_frames(folder: Path) -> list[Path]:
    """Return the JSON files of a folder such as lerf_ovs/label/figurines, sorted by name.

    Raises:
        FileNotFoundError: If the folder does not exist or has no JSON files.
    """
    files = sorted(folder.glob("*.json")) if os.path.isdir(folder) else []
    if len(files) == 0:
        raise FileNotFoundError(
            f"{folder} has no label files; give a folder such as lerf_ovs/label/SCENE, with files like frame_00041.json"
        )
    return files


def read_frame(file: Path, width: int, height: int) -> LabeledFrame:
    """Read a label file, and fill its polygons after scaling them to the size of the image.

    Raises:
        ValueError: If the file has the wrong format, labels an image whose aspect ratio differs by more than 1%, or
            has a polygon outside the image. The message names the file.
    """
    try:
        document = read_document(file, _File)
        size = document.info.width, document.info.height
        shapes = [(o.category, _points(o.segmentation, *size), _box(o.bbox, *size)) for o in document.objects]
    except ValueError as error:
        raise InputError(
            f"{file} is not a LERF-OVS label file ({error}); expected "
            '{"info": {"width", "height"}, "objects": [{"category", "segmentation": [[x, y], ...], "bbox"}]}'
        ) from error
    if abs(size[0] * height - size[1] * width) > 0.01 * size[0] * height:
        raise InputError(
            f"{file} labels an image of {size[0]} x {size[1]} pixels, but the image of the run has {width} x {height}; "
            "use the images that were annotated"
        )
    scale = np.array([width / size[0], height / size[1]])
    masks: dict[str, np.ndarray] = {}
    boxes: dict[str, list[tuple[float, float, float, float]]] = {}
    for category, points, box in shapes:
        mask = masks.setdefault(category, np.zeros((height, width), np.uint8))
        scaled = points * scale
        drawn = np.zeros_like(mask)
        cv2.fillPoly(drawn, [np.int32(scaled)], 1)  # pyrefly: ignore[no-matching-overload]
        if not drawn.any():
            raise InputError(
                f"{file} has a segmentation of {category!r} outside its image of {size[0]} x {size[1]} pixels; correct "
                "or remove it"
            )
        mask |= drawn
        low, high = (scaled.min(0), scaled.max(0)) if box is None else box * scale
        boxes.setdefault(category, []).append((low[0], low[1], high[0], high[1]))
    return LabeledFrame(file.stem, {name: torch.from_numpy(m).bool() for name, m in masks.items()}, boxes)


def _points(segmentation: Sequence[_Point], width: int, height: int) -> np.ndarray:
    """Return the points of a polygon; raise InputError if one is more than an image width or height out of bounds."""
    points = np.array(segmentation, dtype=float)
    distance = np.abs(points / (width, height) - 0.5)
    if distance.max() > 1.5:
        raise InputError(
            f"a segmentation or bbox in an image of {width} x {height} pixels has a coordinate of "
            f"{points.flat[distance.argmax()]:g}"
        )
    return points


def _box(box: tuple[float, float, float, float] | None, width: int, height: int) -> np.ndarray | None:
    return None if box is None else _points([box[:2], box[2:]], width, height)


def match_views(files: Sequence[Path], names: Sequence[str]) -> tuple[dict[Path, str], list[str]]:
    """Match label files with images by their stems.

    Returns:
        The image of every label file that matches one, and the stems of the other label files.
    Raises:
        ValueError: If no label file matches an image, or a label file matches several images.
    """
    images: dict[str, list[str]] = {}
    for name in names:
        images.setdefault(PurePosixPath(name).stem, []).append(name)
    matches = {file: images[file.stem] for file in files if file.stem in images}
    if len(matches) == 0:
        stems = ", ".join(sorted(images)[:3])
        raise InputError(
            f"no label file in {files[0].parent} (such as {files[0].name}) matches an image of the run (such as "
            f"{stems}); give the labels of this scene"
        )
    for file, candidates in matches.items():
        if len(candidates) > 1:
            raise InputError(
                f"{file} matches several images of the run, {' and '.join(candidates)}, by the name {file.stem}; "
                "rename all but one of them"
            )
    return {file: candidates[0] for file, candidates in matches.items()}, [f.stem for f in files if f not in matches]


# 2D open-vocabulary segmentation on LERF-OVS, which composites scores of prompts instead of feature maps.


_BOX, _THRESHOLD, _HALF_WINDOW = 30, 0.4, 3
"""Side of the box filter in pixels, threshold, and half the side of the majority window in pixels, as in LangSplat.

The threshold applies to 2 x - 1 for a relevancy x that is scaled to 0..1.
"""


class FrameScores(NamedTuple):
    """Composited scores of prompts in a frame."""

    frame: LabeledFrame
    prompts: Float[Tensor, "h w q"]
    """Scores of the categories, in the order of `frame.masks`. With LangSplat's maskings, they are relevancies."""
    background: Float[Tensor, "h w b"]
    """Scores of `BACKGROUND_WORDS`, or of `CANONICAL_NEGATIVES` with LangSplat's maskings. Only the masking
    "background" uses them."""


def prompt_mask(
    score: Float[Tensor, "h w"],
    background: Float[Tensor, "h w b"],
    masking: Masking,
    *,
    margin: float,
    instances: int,
) -> Bool[Tensor, "h w"]:
    """Return the mask of a prompt.

    Args:
        masking: "background" selects scores that exceed those of all background words by more than the margin.
            "auto" selects scores of at least `histogram_threshold`. "langsplat" and "langsplat_composited" scale the
            relevancy to 0..1 over the image. They select a pixel if most of the pixels around it exceed 0.7, which
            LangSplat writes as 2 x - 1 > 0.4.
        margin: Lead over the background words, in cosine.
        instances: True number of instances of the prompt in the frame.
    """
    if masking == "background":
        return score > background.max(dim=2).values + margin
    if masking == "auto":
        return score >= histogram_threshold(score, instances)
    above = score - score.min()
    return _majority((2 * (above / (above.max() + 1e-9)) - 1).clamp(0, 1) > _THRESHOLD)


def _majority(mask: Bool[Tensor, "h w"]) -> Bool[Tensor, "h w"]:
    """Select a pixel if more than half of the pixels within 3 rows and columns are selected.

    As in LangSplat, windows do not include the last row and the last column of the image.
    """
    sums = torch.nn.functional.pad(mask.long().cumsum(0).cumsum(1), (1, 0, 1, 0))

    def window(size: int) -> tuple[Tensor, Tensor]:
        positions = torch.arange(size)
        return (positions - _HALF_WINDOW).clamp(min=0), (positions + _HALF_WINDOW + 1).clamp(max=size - 1)

    (top, bottom), (left, right) = (window(size) for size in mask.shape)
    inside = sums[bottom][:, right] - sums[top][:, right] - sums[bottom][:, left] + sums[top][:, left]
    return 2 * inside > (bottom - top)[:, None] * (right - left)


def box_filtered(relevancy: Float[Tensor, "h w"]) -> tuple[Float[Tensor, "h w"], Float[Tensor, "h w"]]:
    """Apply LangSplat's box filter of 30 x 30 pixels.

    Returns:
        The filtered relevancy, for the peak, and the mean of filtered and original relevancy, for the threshold.
    """
    image = relevancy.float().numpy()
    kernel = np.full((_BOX, _BOX), 1 / _BOX**2, np.float32)
    average = torch.from_numpy(cv2.filter2D(image, -1, kernel))
    return average, (average + relevancy) / 2


def frame_rows(scores: FrameScores, masking: Masking, *, margin: float, clean: bool) -> list[dict[str, Any]]:
    """Compute IoU, recall and localization of each category.

    A category is localized if its peak is in its true mask. With LangSplat's maskings, a category can have several
    peaks, and it is localized if one of them is in one of its boxes.
    """
    rows = []
    frame, langsplat = scores.frame, masking in LANGSPLAT_MASKINGS
    for q, (category, truth) in enumerate(frame.masks.items()):
        score, inside = scores.prompts[:, :, q], truth
        peaks = score
        if langsplat:
            peaks, score = box_filtered(score)
            inside = in_boxes(frame.boxes[category], *truth.shape)
        instances = len(frame.boxes[category])
        mask = prompt_mask(score, scores.background, masking, margin=margin, instances=instances)
        mask = clean_mask(mask) if clean else mask
        rows.append(
            {
                "frame": frame.stem,
                "category": category,
                "iou": mask_iou(mask, truth, empty=math.nan if langsplat else 0.0),
                "accuracy": mask_recall(mask, truth),
                "localized": float(localized(peaks, inside, any_peak=langsplat)),
            }
        )
    return rows


def in_boxes(boxes: Sequence[tuple[float, float, float, float]], height: int, width: int) -> Bool[Tensor, "h w"]:
    """Return a mask of the pixels inside any box, including the edges."""
    y, x = torch.meshgrid(torch.arange(height), torch.arange(width), indexing="ij")
    inside = torch.zeros(height, width, dtype=torch.bool)
    for x1, y1, x2, y2 in boxes:
        inside |= (x >= x1) & (x <= x2) & (y >= y1) & (y <= y2)
    return inside


def summarize_lerf(rows: Sequence[dict[str, Any]], average: AveragingOrder, settings: dict[str, Any]) -> Evaluation:
    """Compute miou, macc and loc_acc of every scene, and their means over scenes as in the paper.

    Results with the suffix _pooled are averages over the frames, pairs or categories of all scenes.

    Args:
        rows: Results of `frame_rows`, each with its scene.
        average: "frames" averages over the categories of a frame, then over the frames (code of Splat Feature Solver).
            "pairs" averages over all pairs of frame and category (code of LangSplat). "categories" averages over the
            frames of a category, then over the categories.
    """
    by_scene = _grouped(rows, lambda row: row["scene"])
    scenes: list[dict[str, Any]] = [
        {"scene": scene, "frames": len({row["frame"] for row in group}), **_averages(group, average)}
        for scene, group in by_scene.items()
    ]
    pooled = {f"{name}_pooled": value for name, value in _averages(rows, average).items()}
    results = {name: mean([scene[name] for scene in scenes]) for name in _METRICS} | pooled
    return Evaluation(results, rows, {"protocol": "lerf", "average": average, **settings}, scenes)


_METRICS = {"miou": "iou", "macc": "accuracy", "loc_acc": "localized"}


def _averages(rows: Sequence[Mapping[str, Any]], average: AveragingOrder) -> dict[str, float]:
    group_key: Callable[[Mapping[str, Any]], Hashable] = {
        "frames": lambda row: (row["scene"], row["frame"]),
        "categories": lambda row: row["category"],
        "pairs": id,
    }[average]
    groups = _grouped(rows, group_key).values()
    return {name: mean([mean([row[key] for row in group]) for group in groups]) for name, key in _METRICS.items()}


def _grouped(
    rows: Sequence[Mapping[str, Any]], key: Callable[[Mapping[str, Any]], Hashable]
) -> dict[Hashable, list[Mapping[str, Any]]]:
    groups: dict[Hashable, list[Mapping[str, Any]]] = {}
    for row in rows:
        groups.setdefault(key(row), []).append(row)
    return groups


def run_lerf(runs: Iterable[EvaluatedRun], labels: Sequence[Path], options: LerfOptions) -> Evaluation:
    """Run protocol lerf with one run per scene.

    Raises:
        FileNotFoundError, ValueError: If labels are missing, are damaged, or belong to other images.
    """
    files = [read_frames(folder) for folder in labels]
    rows, missing = [], []
    for scene, frames, lifted in zip(scene_names(labels), files, runs):
        cameras = lifted.cameras()
        images, unmatched = match_views(frames, list(cameras))
        missing += [f"{scene}/{stem}" for stem in unmatched]
        labeled = ((cameras[name], file) for file, name in images.items())
        read = [(camera, read_frame(file, camera.width, camera.height)) for camera, file in labeled]
        views = [(camera, frame) for camera, frame in read if len(frame.masks) > 0]
        lengths: list[Tensor | None] = [None] * len(views)
        if options.masking == "langsplat":
            lengths = list(lifted.feature_lengths([camera for camera, _ in views], _scale(lifted, options)))
        for (camera, frame), length in zip(views, lengths):
            scores = _frame_scores(lifted, camera, frame, length, options)
            rows += [
                {"scene": scene, **row, "frame": f"{scene}/{frame.stem}"}
                for row in frame_rows(scores, options.masking, margin=options.margin, clean=options.clean)
            ]
    if len(rows) == 0:
        folders = ", ".join(map(str, labels))
        raise InputError(f"the label files that match images have no objects ({folders}); annotate at least one object")
    settings = {**asdict(options), "labels_without_image": missing}
    return summarize_lerf(rows, options.average, settings)


def _scale(lifted: EvaluatedRun, options: LerfOptions) -> Float[Tensor, "n 1"] | float:
    return lifted.field.scalars.norm[:, None].float() if options.scale == "norm" else 1.0


def _frame_scores(
    lifted: EvaluatedRun, camera: Camera, frame: LabeledFrame, length: Float[Tensor, "h w"] | None, options: LerfOptions
) -> FrameScores:
    """Return composited scores of a frame, divided by the feature length of each pixel if `length` is given."""
    prompts, langsplat = tuple(frame.masks), options.masking in LANGSPLAT_MASKINGS
    negatives = CANONICAL_NEGATIVES if langsplat else BACKGROUND_WORDS
    values, _ = lifted.composite(camera, _scale(lifted, options) * lifted.cosine((*prompts, *negatives)))
    if length is not None:
        values = torch.where(length[:, :, None] > 0, values / length[:, :, None], 0.0).to(values)
    values, background = values[:, :, : len(prompts)], values[:, :, len(prompts) :]
    return FrameScores(frame, relevancy(values, background, rule="lerf") if langsplat else values, background)
