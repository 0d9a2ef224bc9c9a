"""What Splat Feature Solver's (SFS's) published code does with a map of scores, number by number, oddities included."""

from __future__ import annotations

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float, Int64
from scipy import ndimage
from torch import Tensor

_BINS, _LEAST_PEAK, _UPPER_SHARE = 40, 600, 0.75
_ONE_VALUE, _LEAST_VARIANCE = 1e-12, 1e-10
_MOST_QUANTILE = 2**24
"""Values of which torch computes a quantile."""
_TINY = 1e-12
"""Keeps the means of empty sides finite."""


def histogram_threshold(score: Float[Tensor, "h w"], instances: int) -> float:
    """The threshold of SFS's attention maps, a float32 number; what reaches it (>=) is found.

    Of a histogram of 40 bins from the least to the largest score, peaks are bins of at least 600 pixels that no
    neighbour exceeds; on a plateau each bin is one. The peak is the k-th from the right, k the number of true
    instances, or the rightmost one if there are fewer than k. The valley is the nearest bin to its left, the first bin
    excepted, that no neighbour undercuts and that is lower than the peak; if there is none, the rightmost bin of all
    that lies right of the peak and is lower. The threshold is the middle of the valley. Without peak or valley it is
    the mean of all scores where these are nearly equal (variance below 1e-10), else the mean of Otsu's threshold on the
    40 bins and of the 75th percentile.

    In two cases the published code has no answer to follow: it fails where the two last bins are equal and the peak is
    the last, and its float32 mean of a constant map may exceed the constant. Here the first follows the rule above, and
    the second finds every pixel. Sums of float32 numbers depend on how they lie in memory, by the last digit: that of
    `score` is left as it is.
    """
    values = score.detach().cpu().float().flatten()
    low, high = float(values.min()), float(values.max())
    if low == high:
        return low
    if high <= low + _ONE_VALUE:
        counts, edges = torch.tensor([len(values)]), torch.linspace(low, high + 1e-6, 2)
    else:
        counts, edges = values.histc(_BINS, low, high).long(), torch.linspace(low, high, _BINS + 1)
    valley = _valley(counts.tolist(), max(1, instances))
    if valley is not None:
        threshold = (float(edges[valley]) + float(edges[valley + 1])) / 2
    elif float(values.var()) < _LEAST_VARIANCE:
        threshold = float(values.mean())
    else:
        threshold = (_otsu(counts, edges) + _upper_quartile(values)) / 2
    return float(torch.tensor(threshold, dtype=torch.float32))


def _valley(counts: list[int], instances: int) -> int | None:
    last = len(counts) - 1
    peaks = [
        i
        for i, count in enumerate(counts)
        if count >= max(_LEAST_PEAK, counts[max(i - 1, 0)], counts[min(i + 1, last)])
    ]
    if len(peaks) == 0:
        return None
    peak = peaks[-instances] if instances <= len(peaks) else peaks[-1]
    for i in range(peak - 1, 0, -1):
        if counts[i] <= min(counts[i - 1], counts[i + 1]) and counts[i] < counts[peak]:
            return i
    return next((i for i in range(last, peak, -1) if counts[i] < counts[peak]), None)


def _otsu(counts: Int64[Tensor, " bins"], edges: Float[Tensor, " edges"]) -> float:
    """Centre of the bin after which a split leaves the largest variance between its sides; in float32."""
    centre, share = (edges[:-1] + edges[1:]) / 2, counts.float() / int(counts.sum())
    below, moment = share.cumsum(0), (share * centre).cumsum(0)
    above, total = 1 - below, (share * centre).sum()
    between = below * above * (moment / (below + _TINY) - (total - moment) / (above + _TINY)) ** 2
    return float(centre[int(between.argmax())])


def _upper_quartile(values: Float[Tensor, " n"]) -> float:
    if len(values) <= _MOST_QUANTILE:
        return float(values.quantile(_UPPER_SHARE))
    return float(np.quantile(values.numpy(), _UPPER_SHARE))


def cleaned(mask: Bool[Tensor, "h w"]) -> Bool[Tensor, "h w"]:
    """Opened and closed by 3 x 3 pixels, the largest 8-connected component (the first of equals), its holes filled.

    What is outside of the image counts as empty in every step, so that erosion takes the border: no pixel of the
    outermost rows and columns is left but where a hole is filled.
    """
    image, square = mask.cpu().numpy().astype(np.uint8), np.ones((3, 3), np.uint8)
    for step in (cv2.erode, cv2.dilate, cv2.dilate, cv2.erode):
        image = step(image, square, borderType=cv2.BORDER_CONSTANT, borderValue=0)
    labels, count = ndimage.label(image, structure=square)  # pyright: ignore[reportGeneralTypeIssues]
    if count == 0:
        return torch.zeros_like(mask, device="cpu")
    sizes = np.bincount(labels.ravel())
    largest = labels == 1 + sizes[1:].argmax()
    return torch.from_numpy(np.asarray(ndimage.binary_fill_holes(largest)))
