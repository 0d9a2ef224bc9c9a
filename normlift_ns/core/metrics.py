"""Metrics of segmentation, localization and ranking."""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Float64, Int, Int64
from torch import Tensor

from normlift_ns.errors import InputError
from normlift_ns.options import WithoutDirection

NO_CLASS = -1
"""Ground-truth class of points to ignore, and predicted class of Gaussians without a direction."""


class ClassScores(NamedTuple):
    """Scores per class, with their means over the classes in the ground truth."""

    iou: Float64[Tensor, " c"]
    """|truth and predicted| / |truth or predicted| over points with a true class; NaN if the truth lacks the class."""
    accuracy: Float64[Tensor, " c"]
    """Recall |truth and predicted| / |truth|; NaN if the truth lacks the class."""

    @property
    def miou(self) -> float:
        """Mean IoU over the present classes, in 0..1; NaN if there are none."""
        return float(self.iou.nanmean())

    @property
    def macc(self) -> float:
        """Mean recall over the present classes, in 0..1; NaN if there are none."""
        return float(self.accuracy.nanmean())


def confusion(truth: Int[Tensor, "*m"], predicted: Int[Tensor, "*m"], classes: int) -> Int64[Tensor, "c c_plus_1"]:
    """Return the confusion matrix, with one row per true class and one column per predicted class.

    An additional last column counts points without a predicted class. Points with a negative true class are ignored.

    Args:
        truth: True classes.
        predicted: Predicted classes, or a negative number for none.
        classes: Number of classes.
    Raises:
        ValueError: If a class is `classes` or larger.

    >>> confusion(torch.tensor([0, 0, 1, -1]), torch.tensor([0, 1, -1, 1]), 2).tolist()
    [[1, 1, 0], [0, 0, 1]]
    """
    for name, values in (("truth", truth), ("predicted", predicted)):
        if values.numel() > 0 and int(values.max()) >= classes:
            raise InputError(f"{name} contains class {int(values.max())}, expected 0..{classes - 1}, or -1 for none")
    counts = truth >= 0
    row, column = truth[counts].long(), predicted[counts].long()
    column = torch.where(column < 0, classes, column)
    return torch.bincount(row * (classes + 1) + column, minlength=classes * (classes + 1)).view(classes, classes + 1)


def class_scores(counts: Int64[Tensor, "c c_plus_1"]) -> ClassScores:
    """Return IoU and accuracy from the result of `confusion`.

    For several scenes, add their confusion matrices first or average their scores.
    """
    hits, of_truth = counts.diagonal().double(), counts.sum(1).double()
    union = of_truth + counts[:, : len(counts)].sum(0) - hits
    present = of_truth > 0
    return ClassScores(*(torch.where(present, hits / total, torch.nan) for total in (union, of_truth)))


def classify(
    scores: Float[Tensor, "n c"], valid: Bool[Tensor, " n"], *, without_direction: WithoutDirection = "none"
) -> Int64[Tensor, " n"]:
    """Return the class with the largest score for every Gaussian; ties go to the first class.

    Args:
        valid: Mask of the Gaussians with a direction, from `SemanticField.valid`.
        without_direction: Class of the other Gaussians. "none" is `NO_CLASS`, which lowers only the scores of the true
            class. "first" is class 0, the argmax for a zero feature in published scripts. It adds false positives to
            class 0, which is wall in ScanNet.
    """
    best = scores.argmax(dim=1)
    return torch.where(valid, best, NO_CLASS if without_direction == "none" else 0)


def mask_iou(predicted: Bool[Tensor, "h w"], truth: Bool[Tensor, "h w"], *, empty: float = math.nan) -> float:
    """Return |predicted and truth| / |predicted or truth|, in 0..1.

    Args:
        empty: Result for two empty masks (default: NaN). The code of Splat Feature Solver uses 0.
    """
    union = int((predicted | truth).sum())
    return int((predicted & truth).sum()) / union if union > 0 else empty


def mask_recall(predicted: Bool[Tensor, "h w"], truth: Bool[Tensor, "h w"]) -> float:
    """Return |predicted and truth| / |truth|, in 0..1, or NaN if the truth is empty."""
    size = int(truth.sum())
    return int((predicted & truth).sum()) / size if size > 0 else float("nan")


def localized(score: Float[Tensor, "h w"], truth: Bool[Tensor, "h w"], *, any_peak: bool = False) -> bool:
    """Return True if the pixel with the largest score is in the mask.

    Args:
        any_peak: Accept any of several pixels with the largest score (default: only the first in row-major order).
    """
    peak = score == score.max()
    if any_peak:
        return bool((peak & truth).any())
    return bool(truth.flatten()[int(peak.flatten().int().argmax())])


class Correlation(NamedTuple):
    """Rank correlation of two arrays."""

    value: float
    """Coefficient in -1..1; NaN if an array is constant or empty."""
    p: float
    """Two-sided p-value in 0..1; NaN if an array is constant or empty."""


def spearman_test(a: Float[Tensor, " n"], b: Float[Tensor, " n"]) -> Correlation:
    """Compute Spearman's rank correlation. Tied values get their mean rank."""
    return _correlation("spearmanr", a, b)


def kendall_test(a: Float[Tensor, " n"], b: Float[Tensor, " n"]) -> Correlation:
    """Compute Kendall's tau-b in O(n log n) time."""
    return _correlation("kendalltau", a, b)


def lowest_jaccard(a: Float[Tensor, " n"], b: Float[Tensor, " n"], share: float = 0.2) -> float:
    """Return the Jaccard index of two sets of points: the fraction `share` with the lowest values in each array.

    Ties are ordered by index. Independent arrays give about share / (2 - share), for example 0.111 for 0.2.
    """
    count = round(share * len(a))
    lowest = [set(x.argsort(stable=True)[:count].tolist()) for x in (a, b)]
    return len(lowest[0] & lowest[1]) / max(1, len(lowest[0] | lowest[1]))


def bin_means(
    key: Float[Tensor, " n"], values: Float[Tensor, " n"], bins: int = 10
) -> tuple[Float64[Tensor, " bins"], Float64[Tensor, " bins"]]:
    """Return the means of keys and values in bins of ascending keys. Ties are ordered by index.

    The sizes of the bins differ by at most one point.

    Raises:
        ValueError: If there are fewer points than bins.
    """
    if len(key) < bins:
        raise InputError(f"{bins} bins need at least {bins} points, got {len(key)}")
    parts = key.argsort(stable=True).tensor_split(bins)
    return tuple(torch.stack([x.double()[part].mean() for part in parts]) for x in (key, values))  # type: ignore[return-value]


def _correlation(name: str, a: Tensor, b: Tensor) -> Correlation:
    from scipy import stats  # noqa: PLC0415 (takes a second, and only studies need it)

    if not all(len(x) > 1 and bool((x != x[0]).any()) for x in (a, b)):
        return Correlation(math.nan, math.nan)
    result = getattr(stats, name)(*(x.detach().cpu().double().numpy() for x in (a, b)))
    return Correlation(float(result.statistic), float(result.pvalue))
