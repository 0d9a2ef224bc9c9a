"""Histogram, suggested threshold and verdict for the relevancies of a prompt.

This module does not need torch.
"""

from __future__ import annotations

import math
from bisect import bisect_left
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from jaxtyping import Bool, Float, Float64, Int64

from normlift_ns.core.arguments import check_arguments
from normlift_ns.core.relevancy import RELEVANCY_RULES, TOP_QUANTILE
from normlift_ns.encoders.registry import EncoderKind, find_encoder_kind
from normlift_ns.options import RelevancyRule
from normlift_ns.query.text_encoder import HasManifest, encoder_name

Verdict = Literal["found", "weak match", "probably not here"]
"""Presence of a prompt in a scene; see `judge`. With null words, a prompt is "found" if it matches better than at least
90% of them, and a "weak match" if it matches better than at least 70%."""


# Histogram of the relevancies of one prompt, with a suggested threshold.
#
# Let m be the median relevancy of the Gaussians that have a direction. Let t be their top, the relevancy that one
# Gaussian in a thousand exceeds. If more than half of the Gaussians are at the top, m is the minimum instead of the
# median, so that a threshold can still separate them.
#
# The suggested threshold is the one at which the selection is most stable. Let N(x) be the number of Gaussians above x
# and u the relevancy that 20 Gaussians exceed, or one in a thousand if these are fewer. Of the thresholds m + f (u - m)
# with f in the range of the encoder, it is the one for which log N falls least from f - 0.2 to f + 0.2. If this is at
# an end of the range, the selection is stable nowhere, and f is the middle of the range. docs/honest_answers.md has the
# errors of this rule, and those of alternatives.


HISTOGRAM_BINS = 32
_AT_TOP = 1e-3
"""Distance from the top below which the median counts as at the top, as a fraction of the range from minimum to top."""
_EPSILON = 1e-6
"""Minimum width of a histogram, and distance of the suggested threshold below u (see above) if m and u are equal."""
_SMALLEST_OBJECT = 20
"""Number of Gaussians that exceed u (see above) if the scene has 20,000 or more."""
_STABLE_OVER = 0.2
"""Distance below and above f (see above) over which the fall of log N is measured."""
_STEPS = 100
"""Number of steps from m to u (see above) at which the Gaussians above a threshold are counted."""
_BARS = " ▁▂▃▄▅▆▇█"


@check_arguments
@dataclass(frozen=True, eq=False)
class Histogram:
    """Histogram of the relevancies of one prompt in bins of equal width, with thresholds.

    >>> import numpy as np
    >>> from normlift_ns.query.threshold import relevancy_histogram
    >>> values = np.array([0.1] * 60 + [0.2] * 30 + [0.9] * 10)
    >>> hist = relevancy_histogram(values, np.ones(100, bool), 0.5, (0.4, 0.8))
    >>> int(hist.counts.sum()), 0.2 < hist.suggested < 0.9
    (100, True)
    """

    edges: Float[np.ndarray, " bins_plus_1"]
    """Bin edges. Their range includes the threshold and the relevancy of every Gaussian that has a direction."""
    counts: Int64[np.ndarray, " bins"]
    threshold: float
    """Relevancy above which a Gaussian is selected."""
    median: float
    """Median relevancy, or the smallest relevancy if more than half of the Gaussians are at the top."""
    top: float
    """Relevancy that one Gaussian in a thousand exceeds."""
    suggested: float
    """Suggested threshold for this prompt."""

    def to_json(self) -> dict[str, Any]:
        """Return the range, counts, median and top as plain Python types."""
        low, high = float(self.edges[0]), float(self.edges[-1])
        statistics = {"median": self.median, "top": self.top}
        return {"low": low, "high": high, "counts": self.counts.tolist(), **statistics}


def relevancy_histogram(
    relevancy: Float[np.ndarray, " n"], valid: Bool[np.ndarray, " n"], threshold: float, positions: tuple[float, float]
) -> Histogram | None:
    """Return the histogram of one prompt; None if no Gaussian has a direction.

    Args:
        relevancy: Relevancies of all Gaussians.
        valid: True for Gaussians that have a direction.
        threshold: Relevancy above which a Gaussian is selected.
        positions: Result of `suggested_range`.
    """
    values = _ascending(relevancy[valid])
    return _histogram(values, threshold, positions) if len(values) > 0 else None


def _histogram(values: Float64[np.ndarray, " n"], threshold: float, positions: tuple[float, float]) -> Histogram:
    """Return the histogram of relevancies that are sorted in ascending order; see `relevancy_histogram`."""

    def count_below(edges: Float64[np.ndarray, "1 e"]) -> Int64[np.ndarray, "1 e"]:
        return np.searchsorted(values, edges[0])[None]

    (histogram,) = make_histograms(
        values[picked_ranks(len(values))][None], count_below, len(values), threshold, positions
    )
    return histogram


def picked_ranks(count: int) -> list[int]:
    """Return the ranks, in ascending order of relevancy, of the relevancies that `make_histograms` needs.

    They are the ranks of the smallest relevancy, the largest one and u, and those around the median and the top. Here,
    u is the relevancy that 20 Gaussians exceed, or one in a thousand if these are fewer.
    """
    around = [min(int(share * (count - 1)) + i, count - 1) for share in (0.5, TOP_QUANTILE) for i in (0, 1)]
    return [0, count - 1, count - 1 - min(_SMALLEST_OBJECT, count // 1000), *around]


def make_histograms(
    picked: Float64[np.ndarray, "q 7"],
    count_below: Callable[[Float64[np.ndarray, "q e"]], Int64[np.ndarray, "q e"]],
    count: int,
    threshold: float,
    positions: tuple[float, float],
) -> list[Histogram]:
    """Return the histogram of each prompt.

    Args:
        picked: Relevancies of each prompt at the ranks `picked_ranks(count)`.
        count_below: Function that returns the number of relevancies of each prompt that are below each edge.
        count: Number of Gaussians with a direction, at least 1.
        threshold: Relevancy above which a Gaussian is selected.
        positions: Result of `suggested_range`.
    """
    least, greatest, upper = picked[:, :3].T
    median, top = (
        _interpolate(picked[:, i], picked[:, i + 1], share * (count - 1) % 1)
        for i, share in ((3, 0.5), (5, TOP_QUANTILE))
    )
    median = np.where(top - median < _AT_TOP * (top - least), least, median)
    low, high = np.minimum(least, threshold), np.maximum(greatest, threshold)
    margin = np.where(high - low < _EPSILON, _EPSILON / 2, 0)
    edges = np.linspace(low - margin, high + margin, HISTOGRAM_BINS + 1, axis=1)
    steps = np.linspace(median, upper, _STEPS + 1, axis=1)
    below = count_below(np.concatenate([edges[:, 1:-1], steps], axis=1))
    counts = np.diff(below[:, : HISTOGRAM_BINS - 1], prepend=0, append=count).astype(np.int64)
    suggested = [_suggest(*row, positions) for row in zip(steps, count - below[:, HISTOGRAM_BINS - 1 :], top.tolist())]
    return [
        Histogram(*row[:2], threshold, *row[2:]) for row in zip(edges, counts, median.tolist(), top.tolist(), suggested)
    ]


def _interpolate(
    low: Float64[np.ndarray, " q"], high: Float64[np.ndarray, " q"], share: float
) -> Float64[np.ndarray, " q"]:
    """Interpolate linearly, with the same rounding as `np.quantile`."""
    return low + (high - low) * share if share < 0.5 else high - (high - low) * (1 - share)


def _ascending(values: Float[np.ndarray, ...]) -> Float64[np.ndarray, " n"]:
    """Return the values as a flat float64 array in ascending order."""
    return np.sort(values, axis=None).astype(np.float64)


def draw_histogram(
    counts: Sequence[int] | Int64[np.ndarray, " bins"], low: float, high: float, threshold: float
) -> str:
    """Draw a histogram as one line of text. Each bar stands for two bins, on a logarithmic scale; | is the threshold.

    >>> draw_histogram([500, 0, 50, 0, 0, 0, 0, 5], 0.0, 1.0, 0.5)
    '█▆| ▃'
    """
    pairs = np.asarray(counts).reshape(-1, 2).sum(axis=1)
    heights = np.log1p(pairs) / np.log1p(pairs.max()) * (len(_BARS) - 1)
    line = "".join(_BARS[math.ceil(height - 1e-9)] for height in heights)
    position = round((threshold - low) / (high - low) * len(line))
    return f"{line[:position]}|{line[position:]}"


def suggested_range(field: HasManifest) -> tuple[float, float]:
    """Return the range of suggested thresholds for the encoder of a field; see `EncoderKind.suggested`."""
    kind = find_encoder_kind(encoder_name(field))
    return EncoderKind.suggested if kind is None else kind.suggested


def suggest_threshold(
    relevancy: Float[np.ndarray, "n q"], valid: Bool[np.ndarray, " n"], positions: tuple[float, float]
) -> float | None:
    """Suggest one threshold for all prompts of a query; return None if no Gaussian has a direction.

    Args:
        positions: Result of `suggested_range`.

    >>> values = np.array([[0.1]] * 60 + [[0.2]] * 30 + [[0.9]] * 10)
    >>> 0.2 < suggest_threshold(values, np.ones(100, bool), (0.4, 0.8)) < 0.9
    True
    >>> suggest_threshold(np.ones((3, 1)), np.ones(3, bool), (0.4, 0.8)) < 1  # all alike: all are selected
    True
    """
    values = _ascending(relevancy[valid])
    return _histogram(values, 0.0, positions).suggested if len(values) > 0 else None


def _suggest(
    edges: Float64[np.ndarray, " steps"],
    above: Int64[np.ndarray, " steps"],
    top: float,
    positions: tuple[float, float],
) -> float:
    """Return the threshold at which the selection is most stable.

    Args:
        edges: Relevancies from m to u in equal steps.
        above: Number of Gaussians at or above each edge.
        top: Relevancy that one Gaussian in a thousand exceeds.
    """
    if top <= 0:
        return top  # if nothing is relevant, select nothing
    if edges[-1] - edges[0] < _EPSILON:
        return float(edges[-1]) - _EPSILON
    logarithm = np.log(above)
    first, last = (round(_STEPS * position) for position in positions)
    reach = round(_STEPS * _STABLE_OVER)
    steps = np.arange(first, last + 1)
    fall = logarithm[steps - reach] - logarithm[steps + reach]
    stable = steps[fall <= fall.min() + _EPSILON]
    best = stable[len(stable) // 2]
    return float(edges[best if first < best < last else (first + last) // 2])


# Presence of prompts in a scene.
#
# The rank of a prompt is the fraction of the null vocabulary whose best cosine is lower than that of the prompt. The
# limits on the rank fix the rate of false positives: with every encoder, one unrelated word in ten is "found". The
# color encoder has limits on the cosine instead. Without a null vocabulary of at least 100 words, the verdict depends
# on the relevancy, which compares the prompt with the negatives. docs/honest_answers.md has the counts.


_FOUND_RANK, _WEAK_RANK = 0.9, 0.7
"""Minimum ranks of a prompt (see `null_rank`) for the verdicts "found" and "weak match"."""
_FEWEST_NULL_WORDS = 100
"""Minimum number of unrelated words (null words) for a meaningful `null_rank`."""


def null_rank(manifest: Mapping[str, Any], top_cosine: float) -> float | None:
    """Return the rank of a prompt, in 0..1; None if the field has too few null words.

    The rank is the fraction of unrelated words (null words) whose top cosine is below `top_cosine`.
    """
    tops = (manifest.get("null_words") or {}).get("tops", ())
    return bisect_left(tops, top_cosine) / len(tops) if len(tops) >= _FEWEST_NULL_WORDS else None


def compares_cosines(manifest: Mapping[str, Any], encoder: str | None) -> bool:
    """Return True if `judge` uses cosines (with limits of the encoder or null words), False if it uses relevancies."""
    kind = find_encoder_kind(encoder)
    return (kind is not None and kind.present_from is not None) or null_rank(manifest, 0.0) is not None


def judge(
    manifest: Mapping[str, Any], encoder: str | None, rule: RelevancyRule, *, top_cosine: float, top: float
) -> Verdict | None:
    """Return the verdict on a prompt; None if neither the encoder, the null words nor the rule define limits for it.

    Args:
        manifest: Manifest of the field.
        encoder: Name of the encoder of the field.
        rule: Relevancy rule of the query.
        top_cosine: Cosine that one Gaussian in a thousand exceeds.
        top: Relevancy that one Gaussian in a thousand exceeds.
    """
    kind, rank = find_encoder_kind(encoder), null_rank(manifest, top_cosine)
    if kind is not None and kind.present_from is not None:
        return _by_limits(top_cosine, kind.present_from)
    if rank is not None:
        return _by_limits(rank, (_WEAK_RANK, _FOUND_RANK))
    settings = RELEVANCY_RULES[rule]
    return None if settings.presence_limit is None else _by_limits(top, (settings.threshold, settings.presence_limit))


def _by_limits(value: float, limits: tuple[float, float]) -> Verdict:
    weak, found = limits
    return "found" if value >= found else "weak match" if value >= weak else "probably not here"
