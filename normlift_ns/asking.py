"""Asking a semantic field: texts become relevancies of Gaussians, selections and a few numbers about them."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from normlift_ns.core.field import SemanticField
from normlift_ns.insight.histogram import Histogram, histogram, suggested_threshold, top_limit
from normlift_ns.objects import SceneObject, find_objects
from normlift_ns.options import RULES
from normlift_ns.question import Question
from normlift_ns.selection import Selection
from normlift_ns.text_encoders import encoder_name


@dataclass(frozen=True, eq=False, repr=False)
class Answer:
    """What a field answers to Q texts. `answer["fox"]` is what it says of one of them; see `Finding`.

    >>> import torch
    >>> from normlift_ns import Evidence, SemanticField, lift
    >>> from normlift_ns.question import Question
    >>> from normlift_ns.asking import answer
    >>> from normlift_ns.core.evidence import Entries
    >>> seen = Entries(torch.tensor([0, 1]), torch.tensor([1, 2]), torch.ones(2), (2,))
    >>> means = torch.tensor([[0.0, 0, 0], [1, 0, 0], [2, 0, 0]])
    >>> field = SemanticField.build(lift(Evidence.from_entries([seen], 3), torch.eye(2)), means)
    >>> found = answer(field, means, Question(("fox", "shield"), torch.eye(2)))
    >>> found["fox"].mask.tolist(), found["shield"].relevancy.tolist(), found["shield"].centroid
    ([True, False, False], [0.0, 1.0, 0.0], [1.0, 0.0, 0.0])
    """

    question: Question
    field: SemanticField
    means: Float[Tensor, "n 3"]
    """Centres of the Gaussians, in the scene's own units."""
    relevancy: Float[Tensor, "n q"]
    valid: Bool[Tensor, " n"]
    """Gaussians that have a direction."""
    selected: Bool[Tensor, "n q"]
    """Valid, above the threshold and reliable enough."""

    @property
    def texts(self) -> tuple[str, ...]:
        """The Q texts."""
        return self.question.texts

    @property
    def mask(self) -> Bool[Tensor, " n"]:
        """What any of the texts selects."""
        return self.selected.any(dim=1)

    def __len__(self) -> int:
        return len(self.texts)

    def __iter__(self) -> Iterator[Finding]:
        return (Finding(self, index) for index in range(len(self)))

    def __contains__(self, text: object) -> bool:
        return text in self.texts

    def __repr__(self) -> str:
        counts = ", ".join(f"{found.text!r}: {int(found.mask.sum()):,}" for found in self)
        return f"Answer of {len(self.valid):,} Gaussians, selected {counts}"

    def __getitem__(self, text: str) -> Finding:
        """What the field says of one text.

        Raises:
            KeyError: a text that was not asked.
        """
        if text not in self.texts:
            raise KeyError(f"{text!r} was not asked; the texts are {', '.join(map(repr, self.texts))}")
        return Finding(self, self.texts.index(text))


@dataclass(frozen=True, eq=False, repr=False)
class Finding:
    """What a field says of one text. Places are in the scene's own units; None where nothing is selected.

    Means are weighted by W_j, what the views saw of each Gaussian.

    >>> import torch
    >>> from normlift_ns import Evidence, SemanticField, lift
    >>> from normlift_ns.question import Question
    >>> from normlift_ns.asking import answer
    >>> from normlift_ns.core.evidence import Entries
    >>> seen = Entries(torch.tensor([0, 1, 2]), torch.tensor([1, 1, 2]), torch.tensor([3.0, 1.0, 1.0]), (2,))
    >>> means = torch.tensor([[0.0, 0, 0], [4, 0, 0], [9, 9, 9]])
    >>> field = SemanticField.build(lift(Evidence.from_entries([seen], 3), torch.eye(2)), means)
    >>> fox = answer(field, means, Question(("fox",), torch.tensor([[1.0, 0]])))["fox"]
    >>> fox.mask.tolist(), [round(x, 3) for x in fox.centroid], fox.peak, fox.mean_reliability
    ([True, True, False], [1.0, 0.0, 0.0], 1.0, 0.5)
    """

    answer: Answer
    index: int
    """Of the text."""

    def __repr__(self) -> str:
        return f"Finding {self.text!r}: {int(self.mask.sum()):,} of {len(self.mask):,} Gaussians"

    @property
    def text(self) -> str:
        """The text."""
        return self.answer.texts[self.index]

    @property
    def relevancy(self) -> Float[Tensor, " n"]:
        """Of every Gaussian."""
        return self.answer.relevancy[:, self.index]

    @property
    def mask(self) -> Bool[Tensor, " n"]:
        """The selected Gaussians."""
        return self.answer.selected[:, self.index]

    @property
    def fraction(self) -> float:
        """Share of all Gaussians that is selected."""
        return self._selection.fraction

    @property
    def centroid(self) -> list[float] | None:
        """Weighted mean of the selected centres, x, y, z."""
        return self._selection.centroid

    @property
    def extent(self) -> list[float] | None:
        """Size of the box that holds the central 90 % of the selected centres along each axis."""
        return self._selection.extent

    @property
    def peak(self) -> float | None:
        """Largest relevancy of a Gaussian that has a direction."""
        valid = self.answer.valid
        return float(self.relevancy[valid].max()) if bool(valid.any()) else None

    @cached_property
    def histogram(self) -> Histogram | None:
        """How the relevancies are spread, with the threshold among them; None where no Gaussian has a direction."""
        question = self.answer.question
        limit = top_limit(question.rule, encoder_name(self.answer.field))
        arrays = (self.relevancy.cpu().numpy(), self.answer.valid.cpu().numpy())
        return histogram(*arrays, threshold=question.threshold, limit=limit)

    @property
    def suggested_threshold(self) -> float | None:
        """The threshold that the histogram suggests for this text."""
        return None if self.histogram is None else self.histogram.suggested

    @property
    def stands_out(self) -> bool | None:
        """False where the text is probably not in the scene; None where nobody can tell."""
        return None if self.histogram is None else self.histogram.stands_out

    @property
    def nearest(self) -> list[float] | None:
        """Where the scene is most like the text: weighted mean of the centres of the one Gaussian in a thousand whose
        relevancy is largest, selected or not."""
        if self.histogram is None:
            return None
        return self._numbers_of(self.answer.valid & (self.relevancy >= self.histogram.top)).centroid

    @property
    def mean_reliability(self) -> float | None:
        """Weighted mean of R of the selected Gaussians."""
        return self._selection.mean_reliability

    @property
    def objects(self) -> list[SceneObject]:
        """The parts of the selection that hang together in space, the largest first."""
        return find_objects(self.answer.field, self.answer.means, self.mask).objects

    @cached_property
    def _selection(self) -> Selection:
        return self._numbers_of(self.mask)

    def _numbers_of(self, mask: Bool[Tensor, " n"]) -> Selection:
        scalars = self.answer.field.scalars
        arrays = (self.answer.means, scalars.reliability, scalars.weight)
        return Selection(len(mask), *(x[mask].cpu().numpy() for x in arrays))


def answer(field: SemanticField, means: Float[Tensor, "n 3"], question: Question) -> Answer:
    """Relevancy and selection of every Gaussian for each text. The question of the answer has the threshold that is
    suggested, if the given one asks for that.

    Args:
        means: centres of the Gaussians.
    Raises:
        ValueError: vectors of another length than the field's, a rule without its negatives.
    """
    given = question.negative_vectors if RULES[question.rule].compares else None
    negatives = None if given is None else torch.from_numpy(given)
    vectors = torch.from_numpy(question.vectors)
    relevancy = field.relevancy(vectors, negatives, rule=question.rule, refined=question.refined)
    valid = field.valid(refined=question.refined)
    question = settled(question, relevancy, valid)
    found = Answer(question, field, means.detach(), relevancy, valid, relevancy.new_empty(0, 0).bool())
    return reselect(found, question.threshold, question.min_reliability)


def settled(question: Question, relevancy: Float[Tensor, "n q"], valid: Bool[Tensor, " n"]) -> Question:
    """The question with a threshold, which is the suggested one if it asks for that."""
    if not question.suggest:
        return question
    suggested = suggested_threshold(relevancy.cpu().numpy(), valid.cpu().numpy())
    return replace(question, threshold=question.threshold if suggested is None else suggested, suggest=False)


def reselect(found: Answer, threshold: float, min_reliability: float) -> Answer:
    """The same relevancies with another selection."""
    sure = found.valid & (found.field.scalars.reliability >= min_reliability)
    question = replace(found.question, threshold=threshold, min_reliability=min_reliability)
    return replace(found, question=question, selected=(found.relevancy > threshold) & sure[:, None])


def summarize(found: Answer) -> list[dict[str, Any]]:
    """The numbers of every `Finding`, ready for JSON."""
    names = (
        "text", "fraction", "centroid", "extent", "peak", "mean_reliability", "stands_out", "nearest",
        "suggested_threshold",
    )  # fmt: skip
    rows = [{name: getattr(finding, name) for name in names} for finding in found]
    drawn = [finding.histogram for finding in found]
    return [row | {"histogram": None if of is None else of.to_json()} for row, of in zip(rows, drawn)]


def pixel_relevancy(values: Float[Tensor, "h w q"], alpha: Float[Tensor, "h w"]) -> Float[Tensor, "h w q"]:
    """Composited relevancies per unit of opacity; 0 where (almost) nothing is drawn."""
    return torch.where(alpha[:, :, None] > 0.05, values / alpha[:, :, None].clamp(min=1e-6), 0.0)
