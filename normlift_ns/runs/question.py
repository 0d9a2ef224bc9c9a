"""Storage of a query in a run: prompts with their embeddings, and the rule that selects Gaussians.

Stock nerfstudio renders a run with a stored query without a text encoder.
"""

from __future__ import annotations

import math
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any

import msgspec
import numpy as np

from normlift_ns.core.disk.arrays import check_array, load_arrays, save_arrays
from normlift_ns.core.disk.manifest import MANIFEST, read_manifest
from normlift_ns.errors import InputError
from normlift_ns.options import RULES, Rule
from normlift_ns.question import Question
from normlift_ns.text_encoders import encoder_digest

QUERIES_FILE = "queries.safetensors"
"""File in the folder of the field, with embeddings as tensors and everything else as JSON in its metadata."""
_METADATA_KEY, _VECTORS = "question", ("vectors", "negative_vectors")
_REMEDY = "Delete it, or store the queries again with: ns-normlift-query --load-config ... --text ... --save True"

Text = Annotated[str, msgspec.Meta(pattern=r"\S")]


class _Metadata(msgspec.Struct, forbid_unknown_fields=True):
    """The JSON in the file's metadata."""

    texts: Annotated[tuple[Text, ...], msgspec.Meta(min_length=1)]
    negatives: tuple[Text, ...]
    refined: bool
    form: Rule
    threshold: float
    min_reliability: Annotated[float, msgspec.Meta(ge=0, le=1)]
    encoder: str | None = None


def save_question(folder: Path, question: Question) -> Path:
    """Write queries.safetensors next to the field, replacing an earlier one, and return its path.

    Raises:
        ValueError: `load_question` would raise an error for this query.
        FileNotFoundError: the folder does not exist any more.
        OSError: the file cannot be written.
    """
    if not folder.is_dir():
        raise FileNotFoundError(
            f"{folder} does not exist any more, so nothing was stored: the run was moved or deleted while it was open. "
            "Open it again at its new path"
        )
    if question.suggest:
        raise InputError(
            'the query cannot be stored: its threshold is "auto"; run the query, and store that of its answer'
        )
    metadata = _Metadata(
        question.texts, question.negatives, question.refined, question.rule, question.threshold,
        question.min_reliability, question.encoder,
    )  # fmt: skip
    vectors = {name: value for name in _VECTORS if (value := getattr(question, name)) is not None}
    arrays = {name: value.astype(np.float32) for name, value in vectors.items()}
    try:
        encoded = msgspec.json.encode(metadata).decode()
        decoded = _decode(encoded, arrays)
        if (folder / MANIFEST).exists():
            _check_encoder(decoded, read_manifest(folder)[0])
    except (ValueError, TypeError) as error:
        raise InputError(f"the query cannot be stored: {error}") from error
    save_arrays(folder / QUERIES_FILE, arrays, {_METADATA_KEY: encoded}, overwrite=True)
    return folder / QUERIES_FILE


def load_question(folder: Path) -> Question | None:
    """Load the query stored in the folder of a field; return None if there is none.

    Raises:
        ValueError: the file is damaged, or does not hold a query.
    """
    path = folder / QUERIES_FILE
    if not os.path.lexists(path):
        return None
    try:
        if not os.path.isfile(path):
            raise InputError("it is not a regular file")
        arrays, metadata, _ = load_arrays(path, undigested=(_METADATA_KEY,), remedy=_REMEDY)
        if set(metadata) != {_METADATA_KEY}:
            raise InputError(f"its metadata keys are {sorted(metadata)}, expected {_METADATA_KEY}")
        question = _decode(metadata[_METADATA_KEY], arrays)
        if (folder / MANIFEST).exists():
            _check_encoder(question, read_manifest(folder)[0])
        return question
    except (ValueError, RecursionError) as error:  # msgspec's errors are ValueErrors
        raise InputError(f"{path} is damaged ({type(error).__name__}: {error}). {_REMEDY}") from error


def _decode(encoded: str, arrays: dict[str, np.ndarray]) -> Question:
    """Return the query with this metadata and these embeddings.

    Raises:
        ValueError: the metadata or an embedding is not valid, or they do not fit together.
    """
    metadata = msgspec.json.decode(encoded, type=_Metadata)
    if not math.isfinite(metadata.threshold):
        raise InputError(f"the threshold is {metadata.threshold}, expected a finite number")
    if not {"vectors"} <= set(arrays) <= set(_VECTORS):
        raise InputError(f"it holds {', '.join(sorted(arrays)) or 'nothing'}; expected {' and '.join(_VECTORS)}")
    negative = arrays.get("negative_vectors")
    if (negative is None) != (len(metadata.negatives) == 0):
        raise InputError(
            f"it has {len(metadata.negatives)} negatives, but {'no' if negative is None else 'also'} negative_vectors"
        )
    if RULES[metadata.form].compares and negative is None:
        raise InputError(f"rule {metadata.form!r} needs negatives, but it has none")
    size = arrays["vectors"].shape[-1] if arrays["vectors"].ndim > 0 else 0
    _check_vectors("vectors", arrays["vectors"], metadata.texts, size)
    if negative is not None:
        _check_vectors("negative_vectors", negative, metadata.negatives, size)
    return Question(
        metadata.texts, arrays["vectors"], metadata.negatives, negative, metadata.form, metadata.threshold,
        metadata.min_reliability, metadata.refined, metadata.encoder,
    )  # fmt: skip


def _check_encoder(question: Question, manifest: Mapping[str, Any]) -> None:
    """Raise ValueError if the embeddings are from a different encoder than the field."""
    size, field_encoder = question.vectors.shape[1], encoder_digest(manifest)
    if size != manifest["dimension"]:
        raise InputError(
            f"its vectors have {size} dimensions, but the features of the run have {manifest['dimension']}"
        )
    if question.encoder is not None and field_encoder is not None and question.encoder != field_encoder:
        raise InputError(
            f"its prompts were encoded by another encoder ({question.encoder}) than that of the run ({field_encoder})"
        )


def _check_vectors(name: str, vectors: np.ndarray, texts: Sequence[str], size: int) -> None:
    check_array(f"{name} of {len(texts)} texts", vectors, "float32", (len(texts), max(1, size)), -math.inf)
    for text, row in zip(texts, vectors):
        if not np.isfinite(row).all() or not row.any():
            raise InputError(f"the vector of {text!r} is zero or not finite")
