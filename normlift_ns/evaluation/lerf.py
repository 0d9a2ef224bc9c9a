"""2D open-vocabulary segmentation on LERF-OVS: scores of prompts are composited, not feature maps."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float
from skimage.filters import threshold_otsu
from torch import Tensor

from normlift_ns.core.metrics import localized, mask_iou, mask_recall
from normlift_ns.evaluation.lerf_labels import LabeledFrame
from normlift_ns.evaluation.options import Average, Masking
from normlift_ns.evaluation.results import Evaluation, mean

_HISTOGRAM_BINS, _LEAST_PEAK = 40, 600
_BOX, _THRESHOLD, _MAJORITY = 30, 0.4, 7


class FrameScores(NamedTuple):
    """Composited scores of one frame."""

    frame: LabeledFrame
    prompts: Float[Tensor, "h w q"]
    """Of the frame's categories, in the order of `frame.masks`."""
    background: Float[Tensor, "h w b"]
    """Masking "background": of `BACKGROUND_WORDS`. Masking "langsplat": relevancies are in `prompts` already; empty."""


def found_mask(
    score: Float[Tensor, "h w"],
    background: Float[Tensor, "h w b"],
    masking: Masking,
    *,
    margin: float,
    instances: int,
) -> Bool[Tensor, "h w"]:
    """The pixels that a prompt is found in.

    Args:
        masking: "background": score above every background word by the margin. "auto": SFS's threshold from the
            histogram of the scores; it is told the number of true instances. "langsplat": the relevancy, scaled to
            0..1 over the image, must exceed 0.7 (0.4 after 2 x - 1), by the majority in 7 x 7 pixels.
    """
    if masking == "background":
        return score > background.max(dim=2).values + margin
    if masking == "auto":
        return score > histogram_threshold(score, instances)
    low, high = score.min(), score.max()
    scaled = (2 * (score - low) / (high - low + 1e-9) - 1).clamp(0, 1)
    above = (scaled > _THRESHOLD).numpy().astype(np.float32)
    share = cv2.blur(above, (_MAJORITY, _MAJORITY), borderType=cv2.BORDER_REFLECT)
    return torch.from_numpy(share > 0.5)


def histogram_threshold(score: Float[Tensor, "h w"], instances: int) -> float:
    """SFS's rule: the valley left of the k-th peak from the right, k the number of instances, of a 40-bin histogram;
    peaks hold at least 600 pixels. Without so many peaks: the mean of Otsu's threshold and the 75th percentile.
    """
    values = score.double().numpy().ravel()
    counts, edges = np.histogram(values, bins=_HISTOGRAM_BINS)
    padded = np.concatenate([[-1], counts, [-1]])
    peaks = [i for i in range(_HISTOGRAM_BINS) if counts[i] >= _LEAST_PEAK and padded[i] < counts[i] >= padded[i + 2]]
    if len(peaks) < max(1, instances) or np.ptp(values) == 0:
        otsu = threshold_otsu(values) if np.ptp(values) > 0 else values[0]
        return float((otsu + np.percentile(values, 75)) / 2)
    valley = peaks[-max(1, instances)]
    while valley > 0 and counts[valley - 1] <= counts[valley]:
        valley -= 1
    return float((edges[valley] + edges[valley + 1]) / 2)


def cleaned(mask: Bool[Tensor, "h w"]) -> Bool[Tensor, "h w"]:
    """As SFS's code does after thresholding: opened and closed by 3 x 3 pixels, the largest 8-connected component, its
    holes filled.
    """
    square = np.ones((3, 3), np.uint8)
    image = mask.numpy().astype(np.uint8)
    image = cv2.morphologyEx(cv2.morphologyEx(image, cv2.MORPH_OPEN, square), cv2.MORPH_CLOSE, square)
    count, labels, facts, _ = cv2.connectedComponentsWithStats(image, connectivity=8)
    if count < 2:
        return torch.zeros_like(mask)
    largest = (labels == 1 + facts[1:, cv2.CC_STAT_AREA].argmax()).astype(np.uint8)
    outlines, _ = cv2.findContours(largest, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    return torch.from_numpy(cv2.drawContours(largest, outlines, -1, (1,), cv2.FILLED)).bool()


def box_filtered(relevancy: Float[Tensor, "h w"]) -> tuple[Float[Tensor, "h w"], Float[Tensor, "h w"]]:
    """LangSplat: the mean over 30 x 30 pixels, where the peak is looked for, and its mean with the relevancy itself,
    which is thresholded.
    """
    image = relevancy.float().numpy()
    kernel = np.full((_BOX, _BOX), 1 / _BOX**2, np.float32)
    average = torch.from_numpy(cv2.filter2D(image, -1, kernel))
    return average, (average + relevancy) / 2


def frame_rows(scores: FrameScores, masking: Masking, *, margin: float, clean: bool) -> list[dict[str, Any]]:
    """IoU, recall and whether the peak is in the mask (masking "langsplat": any peak, in any box), per category."""
    rows = []
    frame = scores.frame
    for q, (category, truth) in enumerate(frame.masks.items()):
        score, inside = scores.prompts[:, :, q], truth
        peaks = score
        if masking == "langsplat":
            peaks, score = box_filtered(score)
            inside = in_boxes(frame.boxes[category], *truth.shape)
        instances = len(frame.boxes[category])
        found = found_mask(score, scores.background, masking, margin=margin, instances=instances)
        found = cleaned(found) if clean else found
        rows.append(
            {
                "frame": frame.stem,
                "category": category,
                "iou": mask_iou(found, truth),
                "accuracy": mask_recall(found, truth),
                "localized": float(localized(peaks, inside, any_peak=masking == "langsplat")),
            }
        )
    return rows


def in_boxes(boxes: Sequence[tuple[float, float, float, float]], height: int, width: int) -> Bool[Tensor, "h w"]:
    """Pixels inside any of the boxes, edges included."""
    y, x = torch.meshgrid(torch.arange(height), torch.arange(width), indexing="ij")
    inside = torch.zeros(height, width, dtype=torch.bool)
    for x1, y1, x2, y2 in boxes:
        inside |= (x >= x1) & (x <= x2) & (y >= y1) & (y <= y2)
    return inside


def summarize_lerf(rows: Sequence[dict[str, Any]], average: Average, settings: dict[str, Any]) -> Evaluation:
    """miou, macc and loc_acc.

    Args:
        average: "frames": over the categories of a frame, then over frames (SFS's code). "pairs": over all pairs of
            frame and category (LangSplat's). "categories": over the frames of a category, then over categories.
    """
    key = {"frames": "frame", "categories": "category", "pairs": None}[average]
    groups: dict[Any, list[dict[str, Any]]] = {}
    for i, row in enumerate(rows):
        groups.setdefault(i if key is None else row[key], []).append(row)
    names = {"miou": "iou", "macc": "accuracy", "loc_acc": "localized"}
    results = {
        name: mean([mean([row[field] for row in group]) for group in groups.values()]) for name, field in names.items()
    }
    return Evaluation(results, rows, {"protocol": "lerf", "average": average, **settings})
