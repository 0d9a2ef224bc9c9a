"""Thresholds and mask cleaning that reproduce the results of the published code of Splat Feature Solver (SFS)."""

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
"""Largest number of values that torch.quantile accepts."""
_EPSILON = 1e-12
"""Number added to the share of pixels on a side of Otsu's split, so that the mean of an empty side is finite."""


def histogram_threshold(score: Float[Tensor, "h w"], instances: int) -> float:
    """Return Splat Feature Solver's threshold of a score map as a float32 number. It selects scores >= threshold.

    The histogram has 40 bins from the smallest to the largest score. A peak is a bin with at least 600 pixels and no
    larger neighbor, so every bin of a flat top is a peak. The rule uses the k-th peak from the right for k true
    instances, or the rightmost peak if there are fewer.

    The valley is the nearest bin to the left that is lower than the peak and has no lower neighbor. The first bin
    is excluded. Without such a bin, the valley is the rightmost bin to the right of the peak that is lower than the
    peak. The threshold is the center of the valley.

    Without a peak or a valley, the threshold is the mean of Otsu's threshold on the 40 bins and the 75th percentile. If
    all scores are nearly equal (variance below 1e-10), it is their mean.

    This function differs from the published code in two cases. If the last two bins are equal and the peak is the last
    bin, the published code fails, and this function applies the rule above. For a constant map, the float32 mean of the
    published code may exceed the constant, but this function selects every pixel. The last digit of float32 sums
    depends on the memory layout, so this function keeps the layout of `score`.
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
    """Return Otsu's threshold: the center, in float32, of the last bin below the split with the largest between-class
    variance."""
    center, share = (edges[:-1] + edges[1:]) / 2, counts.float() / int(counts.sum())
    below, moment = share.cumsum(0), (share * center).cumsum(0)
    above, total = 1 - below, (share * center).sum()
    between = below * above * (moment / (below + _EPSILON) - (total - moment) / (above + _EPSILON)) ** 2
    return float(center[int(between.argmax())])


def clean_mask(mask: Bool[Tensor, "h w"]) -> Bool[Tensor, "h w"]:
    """Open and close a mask with a 3 x 3 square, keep the largest 8-connected component, and fill its holes.

    The first of several equally large components is kept. Pixels outside the image are empty in every step, so the
    outermost rows and columns of the result are empty.
    """
    image, square = mask.cpu().numpy().astype(np.uint8), np.ones((3, 3), np.uint8)
    for step in (cv2.erode, cv2.dilate, cv2.dilate, cv2.erode):
        image = step(image, square, borderType=cv2.BORDER_CONSTANT, borderValue=0)
    labels, count = ndimage.label(image, structure=square)
    if count == 0:
        return torch.zeros_like(mask, device="cpu")
    sizes = np.bincount(labels.ravel())
    largest = labels == 1 + sizes[1:].argmax()
    return torch.from_numpy(np.asarray(ndimage.binary_fill_holes(largest)))
