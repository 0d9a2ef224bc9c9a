"""Metrics of segmentation, localisation and ranking, for labels in any number of dimensions."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, NamedTuple

import torch
from jaxtyping import Bool, Float, Float64, Int, Int64
from scipy import stats
from torch import Tensor

from normlift_ns.errors import InputError
from normlift_ns.options import WithoutDirection

NO_CLASS = -1
"""Truth of a point that does not count; answer of a Gaussian that has none."""


class ClassScores(NamedTuple):
    """Per class, and the means over the classes that the truth contains."""

    iou: Float64[Tensor, " c"]
    """|truth and found| / |truth or found| over the points that count; NaN where the truth lacks the class."""
    accuracy: Float64[Tensor, " c"]
    """Recall |truth and found| / |truth|; NaN where the truth lacks the class."""

    @property
    def miou(self) -> float:
        """Mean IoU over present classes, in 0..1; NaN if there is none."""
        return float(self.iou.nanmean())

    @property
    def macc(self) -> float:
        """Mean recall over present classes, in 0..1; NaN if there is none."""
        return float(self.accuracy.nanmean())


def confusion(truth: Int[Tensor, "*m"], found: Int[Tensor, "*m"], classes: int) -> Int64[Tensor, "c c_plus_1"]:
    """How many points of each true class (row) were found to be of each class (column); the last column: of none.

    Points whose truth is negative do not count, whatever was found there.

    Raises:
        ValueError: a class that is not below `classes`.

    >>> confusion(torch.tensor([0, 0, 1, -1]), torch.tensor([0, 1, -1, 1]), 2).tolist()
    [[1, 1, 0], [0, 0, 1]]
    """
    for name, values in (("truth", truth), ("found", found)):
        if values.numel() > 0 and int(values.max()) >= classes:
            raise InputError(f"{name} holds class {int(values.max())}, expected 0..{classes - 1}, or -1 for none")
    counts = truth >= 0
    row, column = truth[counts].long(), found[counts].long()
    column = torch.where(column < 0, classes, column)
    return torch.bincount(row * (classes + 1) + column, minlength=classes * (classes + 1)).view(classes, classes + 1)


def class_scores(counts: Int64[Tensor, "c c_plus_1"]) -> ClassScores:
    """IoU and accuracy from `confusion`; confusions of several scenes add up before, or their scores are averaged."""
    hits, of_truth = counts.diagonal().double(), counts.sum(1).double()
    union = of_truth + counts[:, : len(counts)].sum(0) - hits
    present = of_truth > 0
    return ClassScores(*(torch.where(present, hits / total, torch.nan) for total in (union, of_truth)))


def classify(
    scores: Float[Tensor, "n c"], valid: Bool[Tensor, " n"], *, without_direction: WithoutDirection = "none"
) -> Int64[Tensor, " n"]:
    """The class with the largest score; ties go to the first of them.

    Args:
        valid: Gaussians with a direction, `SemanticField.valid`.
        without_direction: what the others are: "none": `NO_CLASS`, a miss in the recall of their class and in no union
            but its own. "first": class 0, which is what the arg-max of a zero feature gives in published scripts; it
            adds false finds to the first class, ScanNet's wall.
    """
    best = scores.argmax(dim=1)
    return torch.where(valid, best, NO_CLASS if without_direction == "none" else 0)


def mask_iou(found: Bool[Tensor, "h w"], truth: Bool[Tensor, "h w"], *, empty: float = math.nan) -> float:
    """|found and truth| / |found or truth|, in 0..1.

    Args:
        empty: the result for two empty masks, of which the formula says nothing: NaN, or 0 in SFS's code.
    """
    union = int((found | truth).sum())
    return int((found & truth).sum()) / union if union > 0 else empty


def mask_recall(found: Bool[Tensor, "h w"], truth: Bool[Tensor, "h w"]) -> float:
    """|found and truth| / |truth|, in 0..1; NaN where the truth is empty."""
    size = int(truth.sum())
    return int((found & truth).sum()) / size if size > 0 else float("nan")


def localized(score: Float[Tensor, "h w"], truth: Bool[Tensor, "h w"], *, any_peak: bool = False) -> bool:
    """Whether the pixel with the largest score is in the mask.

    Args:
        any_peak: of several largest pixels any may be in the mask; otherwise the first one, row by row, must be.
    """
    peak = score == score.max()
    if any_peak:
        return bool((peak & truth).any())
    return bool(truth.flatten()[int(peak.flatten().int().argmax())])


class Correlation(NamedTuple):
    """A rank correlation."""

    value: float
    """In -1..1; NaN where one side is constant."""
    p: float
    """Probability of a correlation at least as strong among independent points, two-sided; NaN likewise."""


def spearman_test(a: Float[Tensor, " n"], b: Float[Tensor, " n"]) -> Correlation:
    """Spearman's rank correlation, ties at their mean rank."""
    return _correlation(stats.spearmanr, a, b)


def kendall_test(a: Float[Tensor, " n"], b: Float[Tensor, " n"]) -> Correlation:
    """Kendall's tau-b, in n log n steps."""
    return _correlation(stats.kendalltau, a, b)


def spearman(a: Float[Tensor, " n"], b: Float[Tensor, " n"]) -> float:
    """The value of `spearman_test`."""
    return spearman_test(a, b).value


def kendall(a: Float[Tensor, " n"], b: Float[Tensor, " n"]) -> float:
    """The value of `kendall_test`."""
    return kendall_test(a, b).value


def lowest_jaccard(a: Float[Tensor, " n"], b: Float[Tensor, " n"], share: float = 0.2) -> float:
    """Jaccard index of the sets of the lowest `share` by either value; equal values go in by index.

    Of two independent orders about share / (2 - share) is expected: 0.111 for 0.2.
    """
    count = round(share * len(a))
    low = [set(x.argsort(stable=True)[:count].tolist()) for x in (a, b)]
    return len(low[0] & low[1]) / max(1, len(low[0] | low[1]))


def bin_means(
    key: Float[Tensor, " n"], values: Float[Tensor, " n"], bins: int = 10
) -> tuple[Float64[Tensor, " bins"], Float64[Tensor, " bins"]]:
    """Means of key and value in bins of equal count, by ascending key; equal keys are cut by index.

    Raises:
        ValueError: fewer points than bins.
    """
    if len(key) < bins:
        raise InputError(f"{bins} bins need at least as many points, got {len(key)}")
    parts = key.argsort(stable=True).tensor_split(bins)
    return tuple(torch.stack([x.double()[part].mean() for part in parts]) for x in (key, values))  # type: ignore[return-value]


def _correlation(correlate: Callable[..., Any], a: Tensor, b: Tensor) -> Correlation:
    if not all(len(x) > 1 and bool((x != x[0]).any()) for x in (a, b)):
        return Correlation(math.nan, math.nan)
    found = correlate(*(x.detach().cpu().double().numpy() for x in (a, b)))
    return Correlation(float(found.statistic), float(found.pvalue))
