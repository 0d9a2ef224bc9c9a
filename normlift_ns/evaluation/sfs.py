"""Score maps as in the published code of Splat Feature Solver (SFS), number by number, including its oddities."""

from __future__ import annotations

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float, Int64
from scipy import ndimage
from torch import Tensor

_BINS, _MIN_PEAK, _UPPER_QUANTILE = 40, 600, 0.75
_MIN_RANGE, _MIN_VARIANCE = 1e-12, 1e-10
_MAX_QUANTILE_VALUES = 2**24
"""Maximum number of values for torch's quantile."""
_EPSILON = 1e-12
"""Keeps the means of empty sides finite."""


def histogram_threshold(score: Float[Tensor, "h w"], instances: int) -> float:
    """Return the threshold of SFS's attention maps, a float32 number. Scores that reach it (>=) are selected.

    The histogram has 40 bins from the smallest to the largest score. Its peaks are the bins of at least 600 pixels that
    no neighbor exceeds; on a plateau, every bin is a peak. The rule uses the k-th peak from the right, with k the
    number of true instances. If there are fewer than k, it uses the rightmost peak.

    The valley is the nearest bin to the left that is lower than the peak and that no neighbor undercuts. The first bin
    is excluded. If there is no such bin, the valley is the rightmost bin of all that lies right of the peak and is
    lower. The threshold is the middle of the valley.

    Without a peak or a valley, the threshold is the mean of Otsu's threshold on the 40 bins and the 75th percentile. It
    is the mean of all scores if these are nearly equal (variance below 1e-10).

    In two cases, the published code has no answer to follow. It fails if the last two bins are equal and the peak is
    the last; this function then follows the rule above. Its float32 mean of a constant map may exceed the constant;
    this function then selects every pixel. The last digit of float32 sums depends on the memory layout, so this
    function keeps that of `score`.
    """
    values = score.detach().cpu().float().flatten()
    low, high = float(values.min()), float(values.max())
    if low == high:
        return low
    if high <= low + _MIN_RANGE:
        counts, edges = torch.tensor([len(values)]), torch.linspace(low, high + 1e-6, 2)
    else:
        counts, edges = values.histc(_BINS, low, high).long(), torch.linspace(low, high, _BINS + 1)
    valley = _valley(counts.tolist(), max(1, instances))
    if valley is not None:
        threshold = (float(edges[valley]) + float(edges[valley + 1])) / 2
    elif float(values.var()) < _MIN_VARIANCE:
        threshold = float(values.mean())
    else:
        few = len(values) <= _MAX_QUANTILE_VALUES
        upper = values.quantile(_UPPER_QUANTILE) if few else np.quantile(values.numpy(), _UPPER_QUANTILE)
        threshold = (_otsu(counts, edges) + float(upper)) / 2
    return float(torch.tensor(threshold, dtype=torch.float32))


def _valley(counts: list[int], instances: int) -> int | None:
    last = len(counts) - 1
    peaks = [
        i for i, count in enumerate(counts) if count >= max(_MIN_PEAK, counts[max(i - 1, 0)], counts[min(i + 1, last)])
    ]
    if len(peaks) == 0:
        return None
    peak = peaks[-instances] if instances <= len(peaks) else peaks[-1]
    for i in range(peak - 1, 0, -1):
        if counts[i] <= min(counts[i - 1], counts[i + 1]) and counts[i] < counts[peak]:
            return i
    return next((i for i in range(last, peak, -1) if counts[i] < counts[peak]), None)


def _otsu(counts: Int64[Tensor, " bins"], edges: Float[Tensor, " edges"]) -> float:
    """Return the center of the bin after which a split maximizes the variance between both sides, in float32."""
    center, share = (edges[:-1] + edges[1:]) / 2, counts.float() / int(counts.sum())
    below, moment = share.cumsum(0), (share * center).cumsum(0)
    above, total = 1 - below, (share * center).sum()
    between = below * above * (moment / (below + _EPSILON) - (total - moment) / (above + _EPSILON)) ** 2
    return float(center[int(between.argmax())])


def clean_mask(mask: Bool[Tensor, "h w"]) -> Bool[Tensor, "h w"]:
    """Open and close the mask by 3 x 3 pixels, keep its largest 8-connected component (the first of equals), and fill
    holes.

    The outside of the image counts as empty in every step, so erosion removes the border. In the outermost rows and
    columns, only filled holes remain.
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
