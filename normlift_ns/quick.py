"""A lifted run that is asked, and nothing else: it opens in a second, because it needs neither torch nor nerfstudio.

What it answers is what `LiftedRun.ask` answers, but for the rounding of float32 sums (1e-6).
"""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Float32
from scipy.sparse import csr_array

from normlift_ns.core.disk.field_file import FieldArrays, read_field
from normlift_ns.errors import InputError
from normlift_ns.insight.histogram import Histogram, histogram, suggested_threshold, top_limit
from normlift_ns.options import RULES, Rule
from normlift_ns.question import Question, make_question
from normlift_ns.runs.files import check_run, field_folder, stored_paths, texts_cache
from normlift_ns.selection import Selection
from normlift_ns.text_encoders import Texts, encoder_name, encoder_of, with_texts


def _lead(positive: np.ndarray, negative: np.ndarray) -> np.ndarray:
    return positive - negative.max(axis=1, keepdims=True)


FORMULAS: dict[Rule, Callable[[np.ndarray, np.ndarray], np.ndarray]] = {
    "cosine": lambda positive, negative: positive,
    "lerf": lambda positive, negative: 1 / (1 + np.exp(-10 * _lead(positive, negative))),
    "margin": _lead,
}
"""As those of `core.query`."""
_BLOCK = 2**21
"""Elements converted to float32 at once; few stay in a processor's cache."""


@dataclass(frozen=True, eq=False)
class QuickRun:
    """The semantic field of a run in arrays, and the encoder of its texts."""

    folder: Path
    """The run directory."""
    field: FieldArrays
    """With the centres of the Gaussians, `means`."""
    manifest: Mapping[str, Any]
    """Of the field, with the encoder that was asked for."""
    device: str = "cpu"
    """Where the network of the text encoder works, where one is needed."""

    @cached_property
    def texts(self) -> Texts:
        """The encoder of texts; raises as `encoder_of`."""
        return encoder_of(self, self.device, texts_cache(self.folder))

    def ask(self, texts: Sequence[str], **rules: Any) -> QuickAnswer:
        """The answer to some texts; rules and errors are those of `make_question`."""
        return answer(self.field, make_question(self, self.texts.rows, texts, **rules))


@dataclass(frozen=True, eq=False)
class QuickAnswer:
    """What a field answers to Q texts."""

    question: Question
    field: FieldArrays
    relevancy: Float32[np.ndarray, "n q"]
    valid: Bool[np.ndarray, " n"]
    """Gaussians that have a direction."""
    selected: Bool[np.ndarray, "n q"]
    """Valid, above the threshold and reliable enough."""

    def summarize(self) -> list[dict[str, Any]]:
        """The numbers of every text, ready for JSON, as `asking.summarize` gives them."""
        return [self._row(i) for i in range(len(self.question.texts))]

    @cached_property
    def histograms(self) -> list[Histogram | None]:
        """Of every text, as `Finding.histogram`."""
        limit = top_limit(self.question.rule, encoder_name(self.field))
        threshold = self.question.threshold
        return [histogram(column, self.valid, threshold=threshold, limit=limit) for column in self.relevancy.T]

    def _selection(self, mask: Bool[np.ndarray, " n"]) -> Selection:
        arrays = (self.field.arrays[name] for name in ("means", "reliability", "weight"))
        return Selection(len(mask), *(array[mask] for array in arrays))

    def _row(self, index: int) -> dict[str, Any]:
        found, relevancy, spread = (
            self._selection(self.selected[:, index]), self.relevancy[:, index], self.histograms[index]
        )  # fmt: skip
        peak = float(relevancy[self.valid].max()) if self.valid.any() else None
        nearest = None if spread is None else self._selection(self.valid & (relevancy >= spread.top)).centroid
        numbers = {name: getattr(found, name) for name in ("fraction", "centroid", "extent")}
        return {
            "text": self.question.texts[index],
            **numbers,
            "peak": peak,
            "mean_reliability": found.mean_reliability,
            "stands_out": None if spread is None else spread.stands_out,
            "nearest": nearest,
            "suggested_threshold": None if spread is None else spread.suggested,
            "histogram": None if spread is None else spread.to_json(),
        }


def open_quick(
    load_config: Path,
    *,
    means: Float32[np.ndarray, "n 3"] | None = None,
    device: str = "cpu",
    text_vectors: Path | None = None,
    text_template: str | None = None,
) -> QuickRun | None:
    """Opens the field of a lifted run; None where its files alone do not tell what scene it is of: runs of version 0.1
    hold no centres of Gaussians, and other checkpoints may lie beside that of the lift.

    Args:
        means: centres of the Gaussians, of the scene that `open_run` found to be the field's.
        text_vectors, text_template: as in `open_run`.
    Raises:
        FileNotFoundError, ValueError: a run without semantics, or a damaged one.
    """
    folder = Path(os.path.abspath(load_config)).parent
    check_run(folder)
    inside = field_folder(folder)
    field = read_field(inside)
    beside = {f"../{path.relative_to(folder).as_posix()}" for path in folder.glob("nerfstudio_models/step-*.ckpt")}
    if means is not None:
        field = field._replace(arrays={**field.arrays, "means": means})
    elif "means" not in field.arrays or not beside <= field.digested:
        return None
    run = QuickRun(folder, field, stored_paths(field.manifest, inside), device)
    return with_texts(run, vectors=text_vectors, template=text_template)


def answer(field: FieldArrays, question: Question) -> QuickAnswer:
    """Relevancy and selection of every Gaussian for each text, as `asking.answer` computes them.

    Raises:
        ValueError: vectors of another length than the field's.
    """
    arrays = field.arrays
    source = arrays["source"] if question.refined else slice(None)
    negatives = question.negative_vectors if RULES[question.rule].compares else None
    given = question.vectors if negatives is None else np.concatenate([question.vectors, negatives])
    cosine, count = _cosines(field, given)[source], len(question.vectors)
    valid = (arrays["norm"] > 0)[source]
    relevancy = FORMULAS[question.rule](cosine[:, :count], cosine[:, count:])
    relevancy = np.where(valid[:, None], relevancy, np.float32(RULES[question.rule].least))
    if question.suggest:
        suggested = suggested_threshold(relevancy, valid)
        question = replace(question, threshold=question.threshold if suggested is None else suggested, suggest=False)
    sure = valid & (arrays["reliability"] >= np.float32(question.min_reliability))
    return QuickAnswer(question, field, relevancy, valid, (relevancy > question.threshold) & sure[:, None])


def _cosines(field: FieldArrays, given: Float[np.ndarray, "q d"]) -> Float32[np.ndarray, "n q"]:
    """As `SemanticField.query`, not refined."""
    arrays, dimension = field.arrays, int(field.manifest["dimension"])
    if given.shape[1] != dimension:
        raise InputError(
            f"text vectors must be [Q, {dimension}] like the field's features, got {given.shape}; use the encoder that "
            "made them"
        )
    vectors = given.astype(np.float64)
    vectors /= np.linalg.norm(vectors, axis=1, keepdims=True)
    found = arrays["norm"] > 0
    cosine = np.zeros((len(found), len(vectors)), np.float32)
    if field.evidence is not None:
        rows = field.evidence.rows
        table = arrays["features"].astype(np.float64) @ vectors.T
        matrix = csr_array((rows.weight, rows.column, rows.offsets), shape=(len(found), len(table)))
        length = arrays["weight"].astype(np.float64) * arrays["norm"]
        cosine[found] = (matrix @ table)[found] / length[found, None]
    else:
        coordinates, basis = arrays["coordinates"], arrays.get("basis")
        projected = vectors.astype(np.float32) if basis is None else vectors.astype(np.float32) @ basis.T
        step = max(1, _BLOCK // projected.shape[1])
        blocks = (coordinates[i : i + step].astype(np.float32) for i in range(0, len(coordinates), step))
        cosine[found] = np.concatenate([block @ projected.T for block in blocks] or [cosine[:0]])
    return cosine.clip(-1, 1)
