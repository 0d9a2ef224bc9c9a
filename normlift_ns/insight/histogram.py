"""How the relevancies of one text are spread over a scene: where to cut, and whether anything stands out at all.

With m the median relevancy of the Gaussians that have a direction, and t the top, which one in a thousand exceeds (m is
the least relevancy where more than half of them are at the top, so that a threshold is left to tell them by):

* The suggested threshold is m + 0.6 (t - m). It has no unit, so that it serves any encoder and any rule.
* A text is probably not in the scene where t is below a limit, which depends on the rule: see `top_limit`.

docs/honest_answers.md has the error rates of both, and what did worse. Needs no torch.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int64

from normlift_ns.options import RULES, Rule

BINS = 32
_TOP = 0.999
"""Quantile of relevancies that is the top: a single stray Gaussian is none."""
_PART = 0.6
"""Of the way from the median to the top, where the suggested threshold is."""
_ALIKE = 1e-3
"""Share of the range of relevancies within which the median is at the top."""
_SAME = 1e-6
"""Relevancies that differ by less are the same; where all are, and above 0, this far below them is suggested."""
_LEAST_COLOUR = 0.9
"""Top of bare cosines of the colour encoder below which a text is probably not in the scene."""
_BARS = " ▁▂▃▄▅▆▇█"


@dataclass(frozen=True, eq=False)
class Histogram:
    """Relevancies of one text in equal bins, with the threshold among them.

    >>> import numpy as np
    >>> from normlift_ns.insight.histogram import histogram
    >>> values = np.array([0.1] * 60 + [0.2] * 30 + [0.9] * 10)
    >>> found = histogram(values, np.ones(100, bool), threshold=0.5, limit=0.62)
    >>> int(found.counts.sum()), round(found.suggested, 6), found.stands_out
    (100, 0.58, True)
    """

    edges: Float[np.ndarray, " bins_plus_1"]
    """They hold every relevancy of a Gaussian that has a direction, and the threshold."""
    counts: Int64[np.ndarray, " bins"]
    threshold: float
    """Relevancy above which a Gaussian is selected."""
    median: float
    top: float
    """Relevancy that one Gaussian in a thousand exceeds."""
    limit: float | None
    """A text whose top is lower is probably not in the scene; None: with this encoder and rule, nobody can tell."""

    @property
    def suggested(self) -> float:
        """The threshold that the relevancies suggest."""
        return _between(self.median, self.top)

    @property
    def stands_out(self) -> bool | None:
        """False where the text is probably not in the scene; None where nobody can tell."""
        return None if self.limit is None else self.top >= self.limit

    def to_json(self) -> dict[str, Any]:
        """The same as plain types, with what follows from it."""
        return {
            "low": float(self.edges[0]),
            "high": float(self.edges[-1]),
            "counts": self.counts.tolist(),
            "median": self.median,
            "top": self.top,
            "limit": self.limit,
        }


def histogram(
    relevancy: Float[np.ndarray, " n"], valid: Bool[np.ndarray, " n"], *, threshold: float, limit: float | None
) -> Histogram | None:
    """The histogram of one text; None where no Gaussian has a direction.

    Args:
        limit: as `top_limit` gives it.
    """
    values = relevancy[valid].astype(np.float64)
    if len(values) == 0:
        return None
    low, high = min(float(values.min()), threshold), max(float(values.max()), threshold)
    if high - low < _SAME:
        low, high = low - _SAME / 2, high + _SAME / 2
    counts, edges = np.histogram(values, BINS, (low, high))
    median, top = _median_and_top(values)
    return Histogram(edges, counts.astype(np.int64), threshold, median, top, limit)


def bars(counts: Sequence[int] | Int64[np.ndarray, " bins"], low: float, high: float, threshold: float) -> str:
    """One line of text: a bar for two bins, the higher the more Gaussians (logarithmic), and | at the threshold.

    >>> bars([500, 0, 50, 0, 0, 0, 0, 5], 0.0, 1.0, 0.5)
    '█▆| ▃'
    """
    pairs = np.asarray(counts).reshape(-1, 2).sum(axis=1)
    heights = np.log1p(pairs) / np.log1p(pairs.max()) * (len(_BARS) - 1)
    line = "".join(_BARS[math.ceil(height - 1e-9)] for height in heights)
    place = round((threshold - low) / (high - low) * len(line))
    return f"{line[:place]}|{line[place:]}"


def suggested_threshold(relevancy: Float[np.ndarray, "n q"], valid: Bool[np.ndarray, " n"]) -> float | None:
    """One threshold for all texts of a question, from all their relevancies; None where no Gaussian has a direction.

    >>> suggested_threshold(np.array([[0.0, 0.0], [0.0, 0.1], [0.0, 1.0]]), np.ones(3, bool)) > 0.5
    True
    >>> suggested_threshold(np.ones((3, 1)), np.ones(3, bool)) < 1  # all alike: all are selected
    True
    """
    values = relevancy[valid].astype(np.float64).ravel()
    if len(values) == 0:
        return None
    return _between(*_median_and_top(values))


def top_limit(rule: Rule, encoder: str | None) -> float | None:
    """The least top of a text that is in the scene; None where there is no such number.

    Relevancies of rules lerf and margin say by how much a text leads the negatives, whatever the encoder; bare cosines
    mean something where it is known how they are spread, which is so of the colour encoder: 0.9 is a neighbouring
    shade. Those of CLIP lie between 0.1 and 0.4, higher for some texts than for others, in the scene or not.

    >>> top_limit("lerf", "open_clip"), top_limit("cosine", "colour"), top_limit("cosine", "open_clip")
    (0.62, 0.9, None)
    """
    return _LEAST_COLOUR if rule == "cosine" and encoder == "colour" else RULES[rule].present


def _between(median: float, top: float) -> float:
    found = median + _PART * (top - median)
    return min(found, top - _SAME) if top > 0 else found  # where nothing is relevant, nothing is selected


def _median_and_top(values: np.ndarray) -> tuple[float, float]:
    median, top = np.quantile(values, (0.5, _TOP)).tolist()
    least = float(values.min())
    return (least if top - median < _ALIKE * (top - least) else median), top
