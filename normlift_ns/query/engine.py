"""Queries of a semantic field: relevancy and selection of every Gaussian for each prompt, with summary numbers.

One implementation serves fields of torch tensors on any device (`SemanticField`), and fields of NumPy arrays for the
command line (`query.arrays.ArrayField`). This module does not need torch.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any, NamedTuple, Protocol, cast

import numpy as np
from jaxtyping import Bool, Float

from normlift_ns.core.relevancy import RELEVANCY_RULES, gaussian_relevancy
from normlift_ns.query.histogram import Histogram, presence_limit, relevancy_histogram, suggest_threshold
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
        """Numbers of the Gaussians, with `reliability` and `weight`, as in `core.lift.Scalars`."""
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

    If the query asks for a suggested threshold, the query in the result has that threshold.

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

    If the query asks for a suggested threshold, the query in the result has that threshold.
    """
    if question.suggest_threshold:
        suggested = answer.suggested_threshold
        question = replace(
            question, threshold=question.threshold if suggested is None else suggested, suggest_threshold=False
        )
    reliable = answer.valid & (answer.field.scalars.reliability >= question.min_reliability)
    return replace(answer, question=question, selected=(answer.relevancy > question.threshold) & reliable[:, None])
