"""Queries of a semantic field: relevancy and selection of every Gaussian for each prompt, with summary numbers.

One implementation serves fields of torch tensors on any device (`SemanticField`), and fields of NumPy arrays for the
command line (`query.arrays.ArrayField`). This module does not need torch.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any, NamedTuple, Protocol, cast

import numpy as np
from jaxtyping import Bool, Float, Int64

from normlift_ns.core.relevancy import RELEVANCY_RULES, gaussian_relevancy
from normlift_ns.options import RelevancyRule
from normlift_ns.query.question import Query, as_numpy
from normlift_ns.query.text_encoder import HasManifest, encoder_name

if TYPE_CHECKING:
    from torch import Tensor

    from normlift_ns.analysis.objects import SceneObject
    from normlift_ns.core.field import SemanticField

_CENTRAL = (0.05, 0.95)
"""Quantiles of the selected centers that bound their extent."""


class QueryField(HasManifest, Protocol):
    """A semantic field of N Gaussians that queries can run on: see `SemanticField`."""

    @property
    def scalars(self) -> Any:
        """Scalars per Gaussian, at least `reliability` and `weight`, as in `core.lift.Scalars`."""
        ...

    def valid(self, *, refined: bool = True) -> Any:
        """Return a mask of the Gaussians with a direction."""
        ...

    def query(self, text_vectors: Float[np.ndarray, "q d"], *, refined: bool = True) -> Any:
        """Return the cosine of every Gaussian's direction to Q vectors."""
        ...


@dataclass(frozen=True, eq=False, repr=False)
class Answer:
    """Result of a query with Q prompts. `answer["fox"]` is the result for one prompt; see `Finding`.

    Its arrays are those of the field: torch tensors on its device, or NumPy arrays on the command line.

    >>> import torch
    >>> from normlift_ns import Evidence, SemanticField, lift
    >>> from normlift_ns.query.question import Query
    >>> from normlift_ns.query.engine import run_query
    >>> from normlift_ns.core.evidence import Entries
    >>> entries = Entries(torch.tensor([0, 1]), torch.tensor([1, 2]), torch.ones(2), (2,))
    >>> means = torch.tensor([[0.0, 0, 0], [1, 0, 0], [2, 0, 0]])
    >>> field = SemanticField.build(lift(Evidence.from_entries([entries], 3), torch.eye(2)), means)
    >>> result = run_query(field, means, Query(("fox", "shield"), torch.eye(2)))
    >>> result["fox"].mask.tolist(), result["shield"].relevancy.tolist(), result["shield"].centroid
    ([True, False, False], [0.0, 1.0, 0.0], [1.0, 0.0, 0.0])
    """

    question: Query
    field: SemanticField
    means: Float[Tensor, "n 3"]
    """Centers of the Gaussians, in units of the scene."""
    relevancy: Float[Tensor, "n q"]
    valid: Bool[Tensor, " n"]
    """True for Gaussians that have a direction."""
    selected: Bool[Tensor, "n q"]
    """True for Gaussians that are valid, above the threshold and reliable enough."""

    @property
    def texts(self) -> tuple[str, ...]:
        """The Q prompts."""
        return self.question.texts

    @property
    def mask(self) -> Bool[Tensor, " n"]:
        """Gaussians that any of the prompts selects."""
        return self.selected.any(1)

    @property
    def suggested_threshold(self) -> float | None:
        """One threshold for all prompts, which their relevancies suggest; None if no Gaussian has a direction."""
        return suggest_threshold(as_numpy(self.relevancy), as_numpy(self.valid))

    def __len__(self) -> int:
        return len(self.texts)

    def __iter__(self) -> Iterator[Finding]:
        return (Finding(self, index) for index in range(len(self)))

    def __contains__(self, text: object) -> bool:
        return text in self.texts

    def __repr__(self) -> str:
        counts = ", ".join(f"{finding.text!r}: {int(finding.mask.sum()):,}" for finding in self)
        return f"Answer of {len(self.valid):,} Gaussians, selected {counts}"

    def __getitem__(self, text: str) -> Finding:
        """Return the result for one prompt.

        Raises:
            KeyError: the prompt is not part of the query.
        """
        if text not in self.texts:
            raise KeyError(
                f"{text!r} is not a prompt of this query; its prompts are {', '.join(map(repr, self.texts))}"
            )
        return Finding(self, self.texts.index(text))

    def to_json(self) -> list[dict[str, Any]]:
        """Return the numbers of every prompt as plain Python types."""
        return [finding.to_json() for finding in self]


@dataclass(frozen=True, eq=False, repr=False)
class Finding:
    """Result of a query for one prompt.

    Positions are in units of the scene, and None if nothing is selected. Means are weighted by W_j, the total weight of
    Gaussian j over all views.

    >>> import torch
    >>> from normlift_ns import Evidence, SemanticField, lift
    >>> from normlift_ns.query.question import Query
    >>> from normlift_ns.query.engine import run_query
    >>> from normlift_ns.core.evidence import Entries
    >>> entries = Entries(torch.tensor([0, 1, 2]), torch.tensor([1, 1, 2]), torch.tensor([3.0, 1.0, 1.0]), (2,))
    >>> means = torch.tensor([[0.0, 0, 0], [4, 0, 0], [9, 9, 9]])
    >>> field = SemanticField.build(lift(Evidence.from_entries([entries], 3), torch.eye(2)), means)
    >>> fox = run_query(field, means, Query(("fox",), torch.tensor([[1.0, 0]])))["fox"]
    >>> fox.mask.tolist(), [round(x, 3) for x in fox.centroid], fox.peak, fox.mean_reliability
    ([True, True, False], [1.0, 0.0, 0.0], 1.0, 0.5)
    """

    answer: Answer
    index: int
    """Index of the prompt."""

    def __repr__(self) -> str:
        return f"Finding {self.text!r}: {int(self.mask.sum()):,} of {len(self.mask):,} Gaussians"

    @property
    def text(self) -> str:
        """The prompt."""
        return self.answer.texts[self.index]

    @property
    def relevancy(self) -> Float[Tensor, " n"]:
        """Relevancy of every Gaussian."""
        return self.answer.relevancy[:, self.index]

    @property
    def mask(self) -> Bool[Tensor, " n"]:
        """The selected Gaussians."""
        return self.answer.selected[:, self.index]

    @property
    def fraction(self) -> float:
        """Fraction of all Gaussians that is selected, in 0..1."""
        return self._selection.fraction

    @property
    def centroid(self) -> list[float] | None:
        """Weighted mean of the selected centers, [x, y, z]."""
        return self._selection.centroid

    @property
    def extent(self) -> list[float] | None:
        """Size of the box that holds the central 90 % of the selected centers along each axis."""
        return self._selection.extent

    @property
    def peak(self) -> float | None:
        """Highest relevancy of a Gaussian that has a direction."""
        valid = self.answer.valid
        return float(self.relevancy[valid].max()) if bool(valid.any()) else None

    @cached_property
    def histogram(self) -> Histogram | None:
        """Histogram of the relevancies, with the threshold; None if no Gaussian has a direction."""
        question = self.answer.question
        limit = presence_limit(question.rule, encoder_name(self.answer.field))
        relevancy, valid = as_numpy(self.relevancy), as_numpy(self.answer.valid)
        return relevancy_histogram(relevancy, valid, threshold=question.threshold, limit=limit)

    @property
    def suggested_threshold(self) -> float | None:
        """Threshold that the histogram suggests for this prompt."""
        return None if self.histogram is None else self.histogram.suggested

    @property
    def stands_out(self) -> bool | None:
        """False if the prompt is probably not in the scene; None if there is no limit to decide by."""
        return None if self.histogram is None else self.histogram.stands_out

    @property
    def nearest(self) -> list[float] | None:
        """Position that is most similar to the prompt, whether selected or not.

        It is the weighted mean of the centers of the one Gaussian in a thousand with the highest relevancy.
        """
        if self.histogram is None:
            return None
        return self._select(self.answer.valid & (self.relevancy >= self.histogram.top)).centroid

    @property
    def mean_reliability(self) -> float | None:
        """Weighted mean of R over the selected Gaussians."""
        return self._selection.mean_reliability

    @property
    def objects(self) -> list[SceneObject]:
        """Objects of the selection (connected components), by descending size."""
        from normlift_ns.analysis.objects import find_objects  # noqa: PLC0415 (needs torch)

        return find_objects(self.answer.field, self.answer.means, self.mask).objects

    def to_json(self) -> dict[str, Any]:
        """Return the numbers as plain Python types."""
        names = ("text", "fraction", "centroid", "extent", "peak", "mean_reliability", "stands_out", "nearest")
        values = {name: getattr(self, name) for name in (*names, "suggested_threshold")}
        return {**values, "histogram": None if self.histogram is None else self.histogram.to_json()}

    @cached_property
    def _selection(self) -> SelectionStats:
        return self._select(self.mask)

    def _select(self, mask: Bool[Tensor, " n"]) -> SelectionStats:
        scalars = self.answer.field.scalars
        return SelectionStats.of(mask, self.answer.means, scalars.reliability, scalars.weight)


class SelectionStats(NamedTuple):
    """Summary numbers of selected Gaussians.

    Positions are in units of the scene, and None if nothing is selected. Means are weighted by W_j, the total weight of
    Gaussian j over all views.
    """

    fraction: float
    """Fraction of all Gaussians that is selected, in 0..1."""
    centroid: list[float] | None
    """Weighted mean of the selected centers, [x, y, z]."""
    extent: list[float] | None
    """Size of the box that holds the central 90 % of the selected centers along each axis."""
    mean_reliability: float | None
    """Weighted mean of R over the selected Gaussians."""

    @staticmethod
    def of(mask: Any, means: Any, reliability: Any, weight: Any) -> SelectionStats:
        """Summarize a selection, from arrays or tensors of all Gaussians."""
        centers, reliability, weight = (as_numpy(x[mask]).astype(np.float64) for x in (means, reliability, weight))
        fraction = len(centers) / len(mask)
        if len(centers) == 0:
            return SelectionStats(fraction, None, None, None)
        share = (weight + 1e-12) / (weight + 1e-12).sum()
        low, high = np.quantile(centers, _CENTRAL, axis=0)
        return SelectionStats(fraction, (share @ centers).tolist(), (high - low).tolist(), float(share @ reliability))


def run_query(field: QueryField, means: Any, question: Query) -> Answer:
    """Compute relevancy and selection of every Gaussian for each prompt.

    If `question.suggest_threshold` is set, the query in the answer has the suggested threshold.

    Args:
        means: centers of the Gaussians, as tensor or array like the field.
    Raises:
        ValueError: the embeddings have a different dimension than the field, or the rule needs negatives and there are
            none.
    """
    vectors, count = question.embeddings, len(question.embeddings)
    if RELEVANCY_RULES[question.rule].needs_negatives and question.negative_embeddings is not None:
        vectors = np.concatenate([vectors, question.negative_embeddings])
    valid, cosine = field.valid(refined=question.refined), field.query(vectors, refined=question.refined)
    relevancy = gaussian_relevancy(cosine[:, :count], cosine[:, count:], valid, question.rule)
    means = means if isinstance(means, np.ndarray) else means.detach()
    unselected = Answer(question, cast("SemanticField", field), means, relevancy, valid, selected=relevancy[:0] > 0)
    return apply_threshold(unselected, question)


def apply_threshold(answer: Answer, question: Query) -> Answer:
    """Return the answer to a query with the same embeddings but another threshold or minimum reliability.

    If `question.suggest_threshold` is set, the query in the answer has the suggested threshold.
    """
    if question.suggest_threshold:
        suggested = answer.suggested_threshold
        question = replace(
            question, threshold=question.threshold if suggested is None else suggested, suggest_threshold=False
        )
    reliable = answer.valid & (answer.field.scalars.reliability >= question.min_reliability)
    return replace(answer, question=question, selected=(answer.relevancy > question.threshold) & reliable[:, None])


# Histogram of the relevancies of one prompt, with a suggested threshold and a test for absence from the scene.
#
# Let m be the median relevancy of the Gaussians that have a direction, and t their top: the relevancy that one in a
# thousand exceeds. If more than half of them are at the top, m is the minimum instead, so that a threshold can still
# separate them.
#
# * The suggested threshold is m + 0.6 (t - m). It adapts to the range of relevancies, so it suits any encoder and rule.
# * The prompt is probably not in the scene if t is below a limit that depends on the rule; see `presence_limit`.
#
# docs/honest_answers.md has the error rates of both, and of alternatives that did worse.


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
    >>> from normlift_ns.query.engine import relevancy_histogram
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
        low, high = float(self.edges[0]), float(self.edges[-1])
        statistics = {"median": self.median, "top": self.top, "limit": self.limit}
        return {"low": low, "high": high, "counts": self.counts.tolist(), **statistics}


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
