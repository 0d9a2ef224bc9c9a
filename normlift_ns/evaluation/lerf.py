"""2D open-vocabulary segmentation on LERF-OVS, with composited scores of prompts instead of feature maps."""

from __future__ import annotations

import math
from collections.abc import Callable, Hashable, Mapping, Sequence
from typing import Any, NamedTuple

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from normlift_ns.core.metrics import localized, mask_iou, mask_recall
from normlift_ns.evaluation.lerf_labels import LabeledFrame
from normlift_ns.evaluation.options import LANGSPLAT, Average, Masking
from normlift_ns.evaluation.results import Evaluation, mean
from normlift_ns.evaluation.sfs import cleaned, histogram_threshold

_BOX, _THRESHOLD, _HALF_WINDOW = 30, 0.4, 3
"""LangSplat's values: side of the box filter, threshold, and half the side of the majority window."""


class FrameScores(NamedTuple):
    """Composited scores of a frame."""

    frame: LabeledFrame
    prompts: Float[Tensor, "h w q"]
    """Scores of the frame's categories, in the order of `frame.masks`."""
    background: Float[Tensor, "h w b"]
    """Scores of `BACKGROUND_WORDS`, for masking "background". With LangSplat's maskings, `prompts` are relevancies
    already."""


def found_mask(
    score: Float[Tensor, "h w"],
    background: Float[Tensor, "h w b"],
    masking: Masking,
    *,
    margin: float,
    instances: int,
) -> Bool[Tensor, "h w"]:
    """Return the mask of a prompt.

    Args:
        masking: "background" selects scores that exceed every background word by the margin. "auto" selects scores that
            reach SFS's threshold, computed from their histogram and the number of true instances. "langsplat" and
            "langsplat_composited" scale the relevancy to 0..1 over the image. They select pixels if it exceeds 0.7 (0.4
            after 2 x - 1) in the majority of the pixels around them.
    """
    if masking == "background":
        return score > background.max(dim=2).values + margin
    if masking == "auto":
        return score >= histogram_threshold(score, instances)
    above = score - score.min()
    return _majority((2 * (above / (above.max() + 1e-9)) - 1).clamp(0, 1) > _THRESHOLD)


def _majority(mask: Bool[Tensor, "h w"]) -> Bool[Tensor, "h w"]:
    """Select a pixel if more than half of the pixels at most 3 rows and columns away are selected.

    As in LangSplat, the last row and the last column of the image do not count.
    """
    sums = torch.nn.functional.pad(mask.long().cumsum(0).cumsum(1), (1, 0, 1, 0))

    def window(size: int) -> tuple[Tensor, Tensor]:
        positions = torch.arange(size)
        return (positions - _HALF_WINDOW).clamp(min=0), (positions + _HALF_WINDOW + 1).clamp(max=size - 1)

    (top, bottom), (left, right) = (window(size) for size in mask.shape)
    inside = sums[bottom][:, right] - sums[top][:, right] - sums[bottom][:, left] + sums[top][:, left]
    return 2 * inside > (bottom - top)[:, None] * (right - left)


def box_filtered(relevancy: Float[Tensor, "h w"]) -> tuple[Float[Tensor, "h w"], Float[Tensor, "h w"]]:
    """Apply LangSplat's box filter.

    Returns:
        The mean over 30 x 30 pixels, which determines the peak, and its mean with the relevancy, for the threshold.
    """
    image = relevancy.float().numpy()
    kernel = np.full((_BOX, _BOX), 1 / _BOX**2, np.float32)
    average = torch.from_numpy(cv2.filter2D(image, -1, kernel))
    return average, (average + relevancy) / 2


def frame_rows(scores: FrameScores, masking: Masking, *, margin: float, clean: bool) -> list[dict[str, Any]]:
    """Compute IoU, recall and localization of each category.

    A category is localized if its peak lies in the mask. With LangSplat's maskings, any peak may lie in any box.
    """
    rows = []
    frame, langsplat = scores.frame, masking in LANGSPLAT
    for q, (category, truth) in enumerate(frame.masks.items()):
        score, inside = scores.prompts[:, :, q], truth
        peaks = score
        if langsplat:
            peaks, score = box_filtered(score)
            inside = in_boxes(frame.boxes[category], *truth.shape)
        instances = len(frame.boxes[category])
        mask = found_mask(score, scores.background, masking, margin=margin, instances=instances)
        mask = cleaned(mask) if clean else mask
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
    """Return the pixels inside any of the boxes, including their edges."""
    y, x = torch.meshgrid(torch.arange(height), torch.arange(width), indexing="ij")
    inside = torch.zeros(height, width, dtype=torch.bool)
    for x1, y1, x2, y2 in boxes:
        inside |= (x >= x1) & (x <= x2) & (y >= y1) & (y <= y2)
    return inside


def summarize_lerf(rows: Sequence[dict[str, Any]], average: Average, settings: dict[str, Any]) -> Evaluation:
    """Compute miou, macc and loc_acc of every scene and their means over scenes, as the paper averages.

    Results with _pooled are averaged over the frames, pairs or categories of all scenes together.

    Args:
        rows: results of `frame_rows`, each with its scene.
        average: "frames" averages over the categories of a frame, then over frames (SFS's code). "pairs" averages over
            all pairs of frame and category (LangSplat's). "categories" averages over the frames of a category, then
            over categories.
    """
    by_scene = _grouped(rows, lambda row: row["scene"])
    scenes = [
        {"scene": scene, "frames": len({row["frame"] for row in group}), **_averages(group, average)}
        for scene, group in by_scene.items()
    ]
    pooled = {f"{name}_pooled": value for name, value in _averages(rows, average).items()}
    results = {name: mean([scene[name] for scene in scenes]) for name in _METRICS} | pooled
    return Evaluation(results, rows, {"protocol": "lerf", "average": average, **settings}, scenes)


_METRICS = {"miou": "iou", "macc": "accuracy", "loc_acc": "localized"}


def _averages(rows: Sequence[Mapping[str, Any]], average: Average) -> dict[str, float]:
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
