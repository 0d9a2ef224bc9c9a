"""Fast, query-only access to a lifted run: it opens in a second, because it needs neither torch nor nerfstudio.

Results equal those of `LiftedRun.ask` up to rounding of float32 sums (1e-6).
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

from normlift_ns.encoders.registry import LazyTextEncoder
from normlift_ns.errors import InputError
from normlift_ns.io.field import FieldArrays, read_field
from normlift_ns.io.run_dir import check_run, field_folder, resolve_manifest_paths, text_cache_folder
from normlift_ns.options import RELEVANCY_RULES, RelevancyRule
from normlift_ns.query.histogram import (
    Histogram,
    SelectionStats,
    presence_limit,
    relevancy_histogram,
    suggest_threshold,
)
from normlift_ns.query.question import Query, make_query
from normlift_ns.query.text_encoder import encoder_name, text_encoder_for, with_text_source


def _lead(positive: np.ndarray, negative: np.ndarray) -> np.ndarray:
    return positive - negative.max(axis=1, keepdims=True)


NUMPY_FORMULAS: dict[RelevancyRule, Callable[[np.ndarray, np.ndarray], np.ndarray]] = {
    "cosine": lambda positive, negative: positive,
    "lerf": lambda positive, negative: 1 / (1 + np.exp(-10 * _lead(positive, negative))),
    "margin": _lead,
}
"""NumPy versions of the formulas in `core.relevancy`."""
_BLOCK_ELEMENTS = 2**21
"""Elements converted to float32 at a time, few enough for a processor's cache."""


@dataclass(frozen=True, eq=False)
class QuickRun:
    """The semantic field of a run as NumPy arrays, and its text encoder."""

    folder: Path
    """The run directory."""
    field: FieldArrays
    """The field; its arrays include `means`, the centers of the Gaussians."""
    manifest: Mapping[str, Any]
    """The manifest of the field, with the text encoder that the user chose."""
    device: str = "cpu"
    """Device of the text encoder's network, if it needs one."""

    @cached_property
    def texts(self) -> LazyTextEncoder:
        """The text encoder; raises the errors of `text_encoder_for`."""
        return text_encoder_for(self, self.device, text_cache_folder(self.folder))

    def ask(self, texts: Sequence[str], **rules: Any) -> QuickAnswer:
        """Run a query for some prompts.

        Args:
            texts: the prompts.
            rules: keyword arguments of `make_query`, which also raises the errors.
        """
        return query_arrays(self.field, make_query(self, self.texts.rows, texts, **rules))


@dataclass(frozen=True, eq=False)
class QuickAnswer:
    """Result of a query with Q prompts."""

    question: Query
    field: FieldArrays
    relevancy: Float32[np.ndarray, "n q"]
    valid: Bool[np.ndarray, " n"]
    """True for Gaussians that have a direction."""
    selected: Bool[np.ndarray, "n q"]
    """True for Gaussians that are valid, above the threshold and reliable enough."""

    def summarize(self) -> list[dict[str, Any]]:
        """Return the numbers of every prompt as plain Python types, like `summarize_result`."""
        return [self._row(i) for i in range(len(self.question.texts))]

    @cached_property
    def histograms(self) -> list[Histogram | None]:
        """Relevancy histogram of every prompt, like `Finding.histogram`."""
        limit = presence_limit(self.question.rule, encoder_name(self.field))
        threshold = self.question.threshold
        return [
            relevancy_histogram(column, self.valid, threshold=threshold, limit=limit) for column in self.relevancy.T
        ]

    def _select(self, mask: Bool[np.ndarray, " n"]) -> SelectionStats:
        arrays = (self.field.arrays[name] for name in ("means", "reliability", "weight"))
        return SelectionStats(len(mask), *(array[mask] for array in arrays))

    def _row(self, index: int) -> dict[str, Any]:
        selection, relevancy = self._select(self.selected[:, index]), self.relevancy[:, index]
        hist = self.histograms[index]
        return {
            "text": self.question.texts[index],
            "fraction": selection.fraction,
            "centroid": selection.centroid,
            "extent": selection.extent,
            "peak": float(relevancy[self.valid].max()) if self.valid.any() else None,
            "mean_reliability": selection.mean_reliability,
            "stands_out": None if hist is None else hist.stands_out,
            "nearest": None if hist is None else self._select(self.valid & (relevancy >= hist.top)).centroid,
            "suggested_threshold": None if hist is None else hist.suggested,
            "histogram": None if hist is None else hist.to_json(),
        }


def open_quick(
    load_config: Path,
    *,
    means: Float32[np.ndarray, "n 3"] | None = None,
    device: str = "cpu",
    text_vectors: Path | None = None,
    text_template: str | None = None,
) -> QuickRun | None:
    """Open the field of a lifted run; return None if its files alone do not determine the scene.

    Runs of version 0.1 do not store Gaussian centers, and other runs may hold a checkpoint that the lift did not write.
    Such runs need `means`.

    Args:
        load_config: path of the run's config.yml.
        means: centers of the Gaussians, from a scene that `open_run` has matched with the field.
        device: device of the text encoder's network.
        text_vectors, text_template: as in `open_run`.
    Raises:
        FileNotFoundError, ValueError: the run has no semantic field, or is damaged.
    """
    run_dir = Path(os.path.abspath(load_config)).parent
    check_run(run_dir)
    folder = field_folder(run_dir)
    field = read_field(folder)
    checkpoints = {
        f"../{path.relative_to(run_dir).as_posix()}" for path in run_dir.glob("nerfstudio_models/step-*.ckpt")
    }
    if means is not None:
        field = field._replace(arrays={**field.arrays, "means": means})
    elif "means" not in field.arrays or not checkpoints <= field.digested:
        return None
    run = QuickRun(run_dir, field, resolve_manifest_paths(field.manifest, folder), device)
    return with_text_source(run, vectors=text_vectors, template=text_template)


def query_arrays(field: FieldArrays, question: Query) -> QuickAnswer:
    """Compute relevancy and selection of every Gaussian for each prompt, like `run_query`.

    Raises:
        ValueError: the embeddings have a different dimension than the field.
    """
    arrays = field.arrays
    source = arrays["source"] if question.refined else slice(None)
    negatives = question.negative_vectors if RELEVANCY_RULES[question.rule].compares else None
    vectors = question.vectors if negatives is None else np.concatenate([question.vectors, negatives])
    cosine, count = _cosines(field, vectors)[source], len(question.vectors)
    valid = (arrays["norm"] > 0)[source]
    relevancy = NUMPY_FORMULAS[question.rule](cosine[:, :count], cosine[:, count:])
    relevancy = np.where(valid[:, None], relevancy, np.float32(RELEVANCY_RULES[question.rule].least))
    if question.suggest:
        suggested = suggest_threshold(relevancy, valid)
        question = replace(question, threshold=question.threshold if suggested is None else suggested, suggest=False)
    reliable = valid & (arrays["reliability"] >= np.float32(question.min_reliability))
    return QuickAnswer(question, field, relevancy, valid, (relevancy > question.threshold) & reliable[:, None])


def _cosines(field: FieldArrays, embeddings: Float[np.ndarray, "q d"]) -> Float32[np.ndarray, "n q"]:
    """Return the cosines of `SemanticField.query` for unrefined features."""
    arrays, dimension = field.arrays, int(field.manifest["dimension"])
    if embeddings.shape[1] != dimension:
        raise InputError(
            f"text embeddings must be [Q, {dimension}] like the features of the field, got {embeddings.shape}; use the "
            "encoder of these features"
        )
    vectors = embeddings.astype(np.float64)
    vectors /= np.linalg.norm(vectors, axis=1, keepdims=True)
    valid = arrays["norm"] > 0
    cosine = np.zeros((len(valid), len(vectors)), np.float32)
    if field.evidence is not None:
        rows = field.evidence.rows
        table = arrays["features"].astype(np.float64) @ vectors.T
        matrix = csr_array((rows.weight, rows.column, rows.offsets), shape=(len(valid), len(table)))
        length = arrays["weight"].astype(np.float64) * arrays["norm"]
        cosine[valid] = (matrix @ table)[valid] / length[valid, None]
    else:
        coordinates, basis = arrays["coordinates"], arrays.get("basis")
        projected = vectors.astype(np.float32) if basis is None else vectors.astype(np.float32) @ basis.T
        step = max(1, _BLOCK_ELEMENTS // projected.shape[1])
        blocks = (coordinates[i : i + step].astype(np.float32) for i in range(0, len(coordinates), step))
        cosine[valid] = np.concatenate([block @ projected.T for block in blocks] or [cosine[:0]])
    return cosine.clip(-1, 1)
