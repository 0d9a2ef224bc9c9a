"""Queries of a semantic field: relevancy and selection of every Gaussian for each prompt, with summary numbers."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from normlift_ns.analysis.objects import SceneObject, find_objects
from normlift_ns.core.field import SemanticField
from normlift_ns.options import RELEVANCY_RULES
from normlift_ns.query.histogram import (
    Histogram,
    SelectionStats,
    presence_limit,
    relevancy_histogram,
    suggest_threshold,
)
from normlift_ns.query.question import Query
from normlift_ns.query.text_encoder import encoder_name


@dataclass(frozen=True, eq=False, repr=False)
class Answer:
    """Result of a query with Q prompts. `answer["fox"]` is the result for one prompt; see `Finding`.

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
        return self.selected.any(dim=1)

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
        arrays = (self.relevancy.cpu().numpy(), self.answer.valid.cpu().numpy())
        return relevancy_histogram(*arrays, threshold=question.threshold, limit=limit)

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
        return find_objects(self.answer.field, self.answer.means, self.mask).objects

    @cached_property
    def _selection(self) -> SelectionStats:
        return self._select(self.mask)

    def _select(self, mask: Bool[Tensor, " n"]) -> SelectionStats:
        scalars = self.answer.field.scalars
        arrays = (self.answer.means, scalars.reliability, scalars.weight)
        return SelectionStats(len(mask), *(x[mask].cpu().numpy() for x in arrays))


def run_query(field: SemanticField, means: Float[Tensor, "n 3"], question: Query) -> Answer:
    """Compute relevancy and selection of every Gaussian for each prompt.

    If the query asks for a suggested threshold, the query in the result has that threshold.

    Args:
        means: centers of the Gaussians.
    Raises:
        ValueError: the embeddings have a different dimension than the field, or the rule needs negatives and there are
            none.
    """
    negatives = question.negative_vectors if RELEVANCY_RULES[question.rule].compares else None
    relevancy = field.relevancy(
        torch.from_numpy(question.vectors),
        None if negatives is None else torch.from_numpy(negatives),
        rule=question.rule,
        refined=question.refined,
    )
    valid = field.valid(refined=question.refined)
    question = resolve_threshold(question, relevancy, valid)
    result = Answer(question, field, means.detach(), relevancy, valid, relevancy.new_empty(0, 0).bool())
    return apply_threshold(result, question.threshold, question.min_reliability)


def resolve_threshold(question: Query, relevancy: Float[Tensor, "n q"], valid: Bool[Tensor, " n"]) -> Query:
    """Return the query with a fixed threshold: the suggested one if it asks for that, otherwise its own."""
    if not question.suggest:
        return question
    suggested = suggest_threshold(relevancy.cpu().numpy(), valid.cpu().numpy())
    return replace(question, threshold=question.threshold if suggested is None else suggested, suggest=False)


def apply_threshold(result: Answer, threshold: float, min_reliability: float) -> Answer:
    """Return the result with the selection for a different threshold and minimum reliability."""
    reliable = result.valid & (result.field.scalars.reliability >= min_reliability)
    question = replace(result.question, threshold=threshold, min_reliability=min_reliability)
    return replace(result, question=question, selected=(result.relevancy > threshold) & reliable[:, None])


def summarize_result(result: Answer) -> list[dict[str, Any]]:
    """Return the numbers of every `Finding` as plain Python types."""
    names = (
        "text", "fraction", "centroid", "extent", "peak", "mean_reliability", "stands_out", "nearest",
        "suggested_threshold",
    )  # fmt: skip
    return [
        {name: getattr(finding, name) for name in names}
        | {"histogram": None if finding.histogram is None else finding.histogram.to_json()}
        for finding in result
    ]


def pixel_relevancy(values: Float[Tensor, "h w q"], alpha: Float[Tensor, "h w"]) -> Float[Tensor, "h w q"]:
    """Normalize rendered relevancies by opacity; return 0 for pixels that are (almost) empty."""
    return torch.where(alpha[:, :, None] > 0.05, values / alpha[:, :, None].clamp(min=1e-6), 0.0)
