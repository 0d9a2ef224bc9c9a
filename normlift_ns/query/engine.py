"""Queries of a semantic field: relevancy and selection of every Gaussian for each prompt, with summary statistics.

The same code works for fields of torch tensors on any device (`SemanticField`) and for fields of NumPy arrays on the
command line (`query.arrays.ArrayField`). This module does not need torch.
"""

from __future__ import annotations

import os
import re
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import cached_property
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any, NamedTuple, Protocol, cast

import numpy as np
from jaxtyping import Bool, Float

from normlift_ns.core.arguments import check_arguments
from normlift_ns.core.relevancy import PROMPT_BLOCK, RELEVANCY_RULES, gaussian_relevancy, top_values
from normlift_ns.encoders.registry import find_encoder_kind
from normlift_ns.options import RelevancyRule
from normlift_ns.query.question import Query, as_numpy
from normlift_ns.query.text_encoder import HasManifest, encoder_name
from normlift_ns.query.threshold import (
    Histogram,
    Verdict,
    compares_cosines,
    judge,
    relevancy_histogram,
    suggest_threshold,
    suggested_range,
)

if TYPE_CHECKING:
    from torch import Tensor

    from normlift_ns.analysis.objects import SceneObject
    from normlift_ns.core.field import SemanticField

_CENTRAL = (0.05, 0.95)
"""Quantiles of the selected centers that bound their extent."""
_SUMMARIZED = ("reliability", "weight")
"""Names of the scalars per Gaussian that the summary of a prompt needs."""
_THREADS = min(8, os.cpu_count() or 1)
"""Maximum number of prompts that are summarized concurrently."""


class QueryField(HasManifest, Protocol):
    """Interface of a semantic field of N Gaussians for queries; see `SemanticField`."""

    @property
    def scalars(self) -> Any:
        """Scalars per Gaussian, including `reliability` and `weight` of `core.lift.Scalars`."""
        ...

    def valid(self, *, refined: bool = True) -> Any:
        """Return a mask of the Gaussians with a direction."""
        ...

    def query(self, text_vectors: Float[np.ndarray, "q d"], *, refined: bool = True) -> Any:
        """Return the cosines between the direction of every Gaussian and Q vectors."""
        ...

    def null_levels(self, *, refined: bool = True) -> Any:
        """Return the null level of every Gaussian as one column, or an array without columns if there are no levels."""
        ...


@dataclass(frozen=True, eq=False, repr=False)
class Answer:
    """Result of a query with Q prompts. `answer["fox"]` is the result for one prompt; see `Finding`.

    Arrays are like those of the field: torch tensors on its device, or NumPy arrays.

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
    """Centers of the Gaussians, in scene units unless `run_query` received other units."""
    relevancy: Float[Tensor, "n q"]
    valid: Bool[Tensor, " n"]
    """True for Gaussians that have a direction."""
    selected: Bool[Tensor, "n q"]
    """True for Gaussians that are valid, above the threshold and reliable enough. If the query is gated, False for
    prompts that are probably not in the scene."""
    verdicts: tuple[Verdict | None, ...]
    """Verdict on the presence of each prompt, regardless of the Gaussians that it selects."""

    @property
    def texts(self) -> tuple[str, ...]:
        """The Q prompts."""
        return self.question.texts

    @property
    def mask(self) -> Bool[Tensor, " n"]:
        """Mask of the Gaussians that one or more prompts select."""
        return self.selected.any(1)

    @property
    def suggested_threshold(self) -> float | None:
        """Suggested threshold for all prompts together; None if no Gaussian has a direction."""
        return suggest_threshold(as_numpy(self.relevancy), as_numpy(self.valid), suggested_range(self.field))

    def __len__(self) -> int:
        return len(self.texts)

    def __iter__(self) -> Iterator[Finding]:
        return (Finding(self, index) for index in range(len(self)))

    def __contains__(self, text: object) -> bool:
        return text in self.texts

    def __repr__(self) -> str:
        counts = ", ".join(f"{finding.text!r}: {int(finding.mask.sum()):,}" for finding in self)
        return f"Answer for {len(self.valid):,} Gaussians; selected: {counts}"

    def __getitem__(self, text: str) -> Finding:
        """Return the result for one prompt.

        Raises:
            KeyError: `text` is not a prompt of the query.
        """
        if text not in self.texts:
            raise KeyError(f"{text!r} is not a prompt of this query. Prompts: {', '.join(map(repr, self.texts))}")
        return Finding(self, self.texts.index(text))

    def numpy(self) -> dict[str, np.ndarray]:
        """Return the arrays as NumPy arrays: relevancy [N, Q], selected [N, Q], valid [N] and reliability [N]."""
        arrays = {"relevancy": self.relevancy, "selected": self.selected, "valid": self.valid}
        return {name: as_numpy(x) for name, x in (*arrays.items(), ("reliability", self.field.scalars.reliability))}

    def to_json(self) -> list[dict[str, Any]]:
        """Return the result of `Finding.to_json` for every prompt."""
        on_gpu = not isinstance(self.relevancy, np.ndarray) and self.relevancy.is_cuda
        if on_gpu and len(self) >= _THREADS and bool(self.valid.any()):
            return self._summarize()
        answer = self if len(self) < _THREADS else self._as_numpy()
        with ThreadPoolExecutor(_THREADS) as pool:  # sorting, which takes most of the time, is threaded
            return list(pool.map(Finding.to_json, answer))

    def _summarize(self) -> list[dict[str, Any]]:
        """Return the result of `to_json`, computed for all prompts together on the GPU."""
        from normlift_ns.query.summaries import summarize  # noqa: PLC0415 (needs torch)

        scalars, positions = self.field.scalars, suggested_range(self.field)
        summaries = summarize(
            self.relevancy, self.selected, self.valid, self.means, scalars.reliability, scalars.weight,
            threshold=self.question.threshold, positions=positions,
        )  # fmt: skip
        rows = []
        for finding, verdict, summary in zip(self, self.verdicts, summaries):
            some = summary["fraction"] > 0
            shown = "weak match" if verdict == "probably not here" and some else verdict
            rows.append({"text": finding.text, "verdict": shown, "read_as": finding.read_as, **summary})
        return rows

    def _as_numpy(self) -> Answer:
        """Return the answer with NumPy arrays, so that each array is copied to the CPU only once for all prompts."""
        arrays = {name: as_numpy(getattr(self, name)) for name in ("means", "relevancy", "valid", "selected")}
        scalars = SimpleNamespace(**{name: as_numpy(getattr(self.field.scalars, name)) for name in _SUMMARIZED})
        field: Any = SimpleNamespace(manifest=self.field.manifest, scalars=scalars)
        return replace(self, field=field, **arrays)


@check_arguments
@dataclass(frozen=True, eq=False, repr=False)
class Finding:
    """Result of a query for one prompt.

    Positions are in the units of `Answer.means`. The centroid, the extent and the mean reliability are None if no
    Gaussian is selected. Means are weighted by W_j, the total weight of Gaussian j over all views.

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
        """Mask of the selected Gaussians."""
        return self.answer.selected[:, self.index]

    def numpy(self) -> dict[str, np.ndarray]:
        """Return the arrays as NumPy arrays: relevancy [N], mask [N], valid [N] and reliability [N]."""
        arrays = self.answer.numpy()
        columns = {"relevancy": arrays["relevancy"][:, self.index], "mask": arrays["selected"][:, self.index]}
        return {**columns, "valid": arrays["valid"], "reliability": arrays["reliability"]}

    @property
    def fraction(self) -> float:
        """Selected fraction of all Gaussians, in 0..1."""
        return self._selection.fraction

    @property
    def centroid(self) -> list[float] | None:
        """Weighted mean of the centers of the selected Gaussians, [x, y, z]."""
        return self._selection.centroid

    @property
    def extent(self) -> list[float] | None:
        """Distance from the 5th to the 95th percentile of the selected centers along x, y and z."""
        return self._selection.extent

    @property
    def peak(self) -> float | None:
        """Highest relevancy of a Gaussian that has a direction; None if no Gaussian has one."""
        valid = self.answer.valid
        return float(self.relevancy[valid].max()) if bool(valid.any()) else None

    @cached_property
    def histogram(self) -> Histogram | None:
        """Histogram of the relevancies; None if no Gaussian has a direction."""
        question = self.answer.question
        relevancy, valid = as_numpy(self.relevancy), as_numpy(self.answer.valid)
        return relevancy_histogram(relevancy, valid, question.threshold, suggested_range(self.answer.field))

    @property
    def suggested_threshold(self) -> float | None:
        """Threshold that the histogram suggests for this prompt; None if no Gaussian has a direction."""
        return None if self.histogram is None else self.histogram.suggested

    @cached_property
    def verdict(self) -> Verdict | None:
        """Verdict on the presence of the prompt; None if `judge` returns None or no Gaussian has a direction.

        For a prompt that selects Gaussians, "weak match" replaces "probably not here".
        """
        verdict = self.answer.verdicts[self.index]
        return "weak match" if verdict == "probably not here" and bool(self.mask.any()) else verdict

    @property
    def read_as(self) -> str | None:
        """Words of the prompt that the encoder uses.

        It is None if the encoder is unknown, ignores all words, or ignores no words except articles.
        """
        kind = find_encoder_kind(encoder_name(self.answer.field))
        known = "" if kind is None else kind.known_words(self.text)
        ignored = set(re.findall(r"\w+", self.text.lower())) - set(re.findall(r"\w+", known.lower()))
        return known if known and not ignored <= {"a", "an", "the"} else None

    @property
    def nearest(self) -> list[float] | None:
        """Weighted mean center of the Gaussians with the highest relevancy, whether or not they are selected.

        They are the top 0.1% of the Gaussians with a direction, or at least one Gaussian. The position is None if no
        Gaussian has a direction.
        """
        if self.histogram is None:
            return None
        near = _indices(self.answer.valid & (self.relevancy >= self.histogram.top))
        centers, weight = (_float64(x[near]) for x in (self.answer.means, self.answer.field.scalars.weight))
        return _centroid(centers, weight)

    @property
    def mean_reliability(self) -> float | None:
        """Weighted mean of the reliability R over the selected Gaussians."""
        return self._selection.mean_reliability

    @property
    def objects(self) -> list[SceneObject]:
        """Objects of the selection, by descending size: its connected components with at least 20 Gaussians."""
        from normlift_ns.analysis.objects import find_objects  # noqa: PLC0415 (needs torch)

        return find_objects(self.answer.field, self.answer.means, self.mask).objects

    def to_json(self) -> dict[str, Any]:
        """Return the prompt with its verdict, summary statistics and histogram, as plain Python types."""
        names = ("text", "fraction", "centroid", "extent", "peak", "mean_reliability", "verdict", "nearest", "read_as")
        values = {name: getattr(self, name) for name in (*names, "suggested_threshold")}
        return {**values, "histogram": None if self.histogram is None else self.histogram.to_json()}

    @cached_property
    def _selection(self) -> SelectionStats:
        scalars = self.answer.field.scalars
        return SelectionStats.of(self.mask, self.answer.means, scalars.reliability, scalars.weight)


class SelectionStats(NamedTuple):
    """Summary statistics of the selected Gaussians.

    Positions are in the units of the centers. Means are weighted by W_j, the total weight of Gaussian j over all views.
    All values except the fraction are None if no Gaussian is selected.
    """

    fraction: float
    """Selected fraction of all Gaussians, in 0..1."""
    centroid: list[float] | None
    """Weighted mean of the centers of the selected Gaussians, [x, y, z]."""
    extent: list[float] | None
    """Distance from the 5th to the 95th percentile of the selected centers along x, y and z."""
    mean_reliability: float | None
    """Weighted mean of the reliability R over the selected Gaussians."""

    @staticmethod
    def of(mask: Any, means: Any, reliability: Any, weight: Any) -> SelectionStats:
        """Summarize the Gaussians in `mask`. All arguments are arrays or tensors with one row per Gaussian."""
        index = _indices(mask)
        centers, reliability, weight = (_float64(x[index]) for x in (means, reliability, weight))
        fraction = len(centers) / len(mask)
        if len(centers) == 0:
            return SelectionStats(fraction, None, None, None)
        low, high = np.quantile(centers, _CENTRAL, axis=0)
        mean = float(_shares(weight) @ reliability)
        return SelectionStats(fraction, _centroid(centers, weight), (high - low).tolist(), mean)


def _indices(mask: Any) -> Any:
    """Return the indices of the True values of a mask. They index several arrays faster than the mask does."""
    return np.flatnonzero(mask) if isinstance(mask, np.ndarray) else mask.nonzero().squeeze(1)


def _float64(values: Any) -> np.ndarray:
    return as_numpy(values).astype(np.float64)


def _shares(weight: Float[np.ndarray, " m"]) -> Float[np.ndarray, " m"]:
    return (weight + 1e-12) / (weight + 1e-12).sum()


def _centroid(centers: Float[np.ndarray, "m 3"], weight: Float[np.ndarray, " m"]) -> list[float] | None:
    return (_shares(weight) @ centers).tolist() if len(centers) > 0 else None


def run_query(field: QueryField, means: Any, question: Query) -> Answer:
    """Compute the relevancy and selection of every Gaussian for each prompt.

    If `question.suggest_threshold` is set, the query in the answer has the suggested threshold.

    Args:
        means: Centers of the Gaussians, as a tensor or array like those of the field.
    Raises:
        ValueError: The embeddings have a different dimension than the field, or the negatives or null levels that the
            rule needs are missing.
    """
    vectors, count = question.embeddings, len(question.embeddings)
    if RELEVANCY_RULES[question.rule].needs_negatives and question.negative_embeddings is not None:
        vectors = np.concatenate([vectors, question.negative_embeddings])
    valid, cosine = field.valid(refined=question.refined), field.query(vectors, refined=question.refined)
    negative = field.null_levels(refined=question.refined) if question.rule == "contrast" else cosine[:, count:]
    relevancy, verdicts = cosine[:, :count], []
    for first in range(0, count, PROMPT_BLOCK):  # relevancies replace their cosines, which saves half of the memory
        block = relevancy[:, first : first + PROMPT_BLOCK]
        values = gaussian_relevancy(block, negative, valid, question.rule)
        verdicts += _judge_all(field, question.rule, block, values, valid)
        block[:] = values
    points: Any = means if isinstance(means, np.ndarray) else means.detach()
    selected = relevancy[:0] > 0
    unselected = Answer(question, cast("SemanticField", field), points, relevancy, valid, selected, tuple(verdicts))
    return apply_threshold(unselected, question)


def _judge_all(
    field: HasManifest, rule: RelevancyRule, cosine: Any, relevancy: Any, valid: Any
) -> list[Verdict | None]:
    """Return the verdict on every prompt, from the rows of valid Gaussians in the cosines and relevancies [N, Q]."""
    if not bool(valid.any()):
        return [None] * cosine.shape[1]
    name, manifest = encoder_name(field), field.manifest
    compared = cosine if compares_cosines(manifest, name) else relevancy
    tops = top_values(compared.T[:, valid].T)
    return [judge(manifest, name, rule, top_cosine=top, top=top) for top in tops]


def apply_threshold(answer: Answer, question: Query) -> Answer:
    """Return the answer to a query with the same embeddings but a different threshold or minimum reliability.

    If `question.suggest_threshold` is set, the query in the answer has the suggested threshold.
    """
    if question.suggest_threshold:
        suggested = answer.suggested_threshold
        question = replace(
            question, threshold=question.threshold if suggested is None else suggested, suggest_threshold=False
        )
    reliable = answer.valid & (answer.field.scalars.reliability >= question.min_reliability)
    selected = (answer.relevancy > question.threshold) & reliable[:, None]
    if question.gated:
        for index, verdict in enumerate(answer.verdicts):
            if verdict == "probably not here":
                selected[:, index] = False
    return replace(answer, question=question, selected=selected)
