"""Histogram of the relevancies of one prompt, with a suggested threshold and a test for absence from the scene.

Let m be the median relevancy of the Gaussians that have a direction, and t their top: the relevancy that one in a
thousand exceeds. If more than half of them are at the top, m is the minimum instead, so that a threshold can still
separate them.

* The suggested threshold is m + 0.6 (t - m). It adapts to the range of relevancies, so it suits any encoder and rule.
* The prompt is probably not in the scene if t is below a limit that depends on the rule; see `presence_limit`.

docs/honest_answers.md has the error rates of both, and of alternatives that did worse. This module does not need torch.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int64

from normlift_ns.core.relevancy import RELEVANCY_RULES
from normlift_ns.options import RelevancyRule

HISTOGRAM_BINS = 32
_TOP_QUANTILE = 0.999
"""Quantile of relevancies that defines the top; a single stray Gaussian does not affect it."""
_SUGGESTED_FRACTION = 0.6
"""Position of the suggested threshold between the median (0) and the top (1)."""
_AT_TOP = 1e-3
"""The median counts as being at the top if it is closer than this fraction of the range of relevancies."""
_EPSILON = 1e-6
"""Relevancies that differ by less count as equal; if all are equal and positive, the threshold is this far below."""
_COLOR_LIMIT = 0.9
"""Limit of the top for plain cosines of the color encoder."""
_BARS = " ▁▂▃▄▅▆▇█"


@dataclass(frozen=True, eq=False)
class Histogram:
    """Relevancies of one prompt in bins of equal width, with the threshold within their range.

    >>> import numpy as np
    >>> from normlift_ns.query.histogram import relevancy_histogram
    >>> values = np.array([0.1] * 60 + [0.2] * 30 + [0.9] * 10)
    >>> hist = relevancy_histogram(values, np.ones(100, bool), threshold=0.5, limit=0.62)
    >>> int(hist.counts.sum()), round(hist.suggested, 6), hist.stands_out
    (100, 0.58, True)
    """

    edges: Float[np.ndarray, " bins_plus_1"]
    """Bin edges; their range includes the threshold and the relevancy of every Gaussian that has a direction."""
    counts: Int64[np.ndarray, " bins"]
    threshold: float
    """Relevancy above which a Gaussian is selected."""
    median: float
    top: float
    """Relevancy that one Gaussian in a thousand exceeds."""
    limit: float | None
    """A prompt with a lower top is probably not in the scene; None if this encoder and rule have no such limit."""

    @property
    def suggested(self) -> float:
        """Suggested threshold for this prompt."""
        return _suggest(self.median, self.top)

    @property
    def stands_out(self) -> bool | None:
        """False if the prompt is probably not in the scene; None if there is no limit to decide by."""
        return None if self.limit is None else self.top >= self.limit

    def to_json(self) -> dict[str, Any]:
        """Return the range, counts and statistics as plain Python types."""
        return {
            "low": float(self.edges[0]),
            "high": float(self.edges[-1]),
            "counts": self.counts.tolist(),
            "median": self.median,
            "top": self.top,
            "limit": self.limit,
        }


def relevancy_histogram(
    relevancy: Float[np.ndarray, " n"], valid: Bool[np.ndarray, " n"], *, threshold: float, limit: float | None
) -> Histogram | None:
    """Return the histogram of one prompt; None if no Gaussian has a direction.

    Args:
        valid: True for Gaussians that have a direction.
        threshold: relevancy above which a Gaussian is selected.
        limit: result of `presence_limit`.
    """
    values = relevancy[valid].astype(np.float64)
    if len(values) == 0:
        return None
    low, high = min(float(values.min()), threshold), max(float(values.max()), threshold)
    if high - low < _EPSILON:
        low, high = low - _EPSILON / 2, high + _EPSILON / 2
    counts, edges = np.histogram(values, HISTOGRAM_BINS, (low, high))
    median, top = _median_and_top(values)
    return Histogram(edges, counts.astype(np.int64), threshold, median, top, limit)


def draw_histogram(
    counts: Sequence[int] | Int64[np.ndarray, " bins"], low: float, high: float, threshold: float
) -> str:
    """Draw a histogram as one line of text, with one bar per two bins, a logarithmic scale, and | at the threshold.

    >>> draw_histogram([500, 0, 50, 0, 0, 0, 0, 5], 0.0, 1.0, 0.5)
    '█▆| ▃'
    """
    pairs = np.asarray(counts).reshape(-1, 2).sum(axis=1)
    heights = np.log1p(pairs) / np.log1p(pairs.max()) * (len(_BARS) - 1)
    line = "".join(_BARS[math.ceil(height - 1e-9)] for height in heights)
    position = round((threshold - low) / (high - low) * len(line))
    return f"{line[:position]}|{line[position:]}"


def suggest_threshold(relevancy: Float[np.ndarray, "n q"], valid: Bool[np.ndarray, " n"]) -> float | None:
    """Suggest one threshold for all prompts of a query; return None if no Gaussian has a direction.

    >>> suggest_threshold(np.array([[0.0, 0.0], [0.0, 0.1], [0.0, 1.0]]), np.ones(3, bool)) > 0.5
    True
    >>> suggest_threshold(np.ones((3, 1)), np.ones(3, bool)) < 1  # all alike: all are selected
    True
    """
    values = relevancy[valid].astype(np.float64).ravel()
    if len(values) == 0:
        return None
    return _suggest(*_median_and_top(values))


def presence_limit(rule: RelevancyRule, encoder: str | None) -> float | None:
    """Return the limit of the top below which a prompt is probably not in the scene; None if there is no such limit.

    Relevancies of the rules lerf and margin measure the lead over the negatives, which has a meaning with any encoder.
    Plain cosines have a meaning only if their distribution is known, as it is for the color encoder, where 0.9 is a
    neighboring shade. Cosines of CLIP lie between 0.1 and 0.4, and vary by prompt, in the scene or not.

    >>> presence_limit("lerf", "open_clip"), presence_limit("cosine", "colour"), presence_limit("cosine", "open_clip")
    (0.62, 0.9, None)
    """
    return _COLOR_LIMIT if rule == "cosine" and encoder == "colour" else RELEVANCY_RULES[rule].presence_limit


def _suggest(median: float, top: float) -> float:
    threshold = median + _SUGGESTED_FRACTION * (top - median)
    return min(threshold, top - _EPSILON) if top > 0 else threshold  # if nothing is relevant, select nothing


def _median_and_top(values: np.ndarray) -> tuple[float, float]:
    """Return the median and the top; the minimum in place of the median if that is at the top."""
    median, top = np.quantile(values, (0.5, _TOP_QUANTILE)).tolist()
    least = float(values.min())
    return (least if top - median < _AT_TOP * (top - least) else median), top
