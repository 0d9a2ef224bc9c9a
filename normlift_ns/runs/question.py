"""How a run stores a question: texts as vectors, with the rule by which they select.

A run with a stored question is rendered by stock nerfstudio without a text encoder.
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
"""In the folder of the field: vectors, and everything else as JSON in the file's metadata."""
_KEY, _VECTORS = "question", ("vectors", "negative_vectors")
_REMEDY = "Delete it, or store the queries again with: ns-normlift-query --load-config ... --text ... --save True"

Text = Annotated[str, msgspec.Meta(pattern=r"\S")]


class _Facts(msgspec.Struct, forbid_unknown_fields=True):
    """The JSON in the metadata."""

    texts: Annotated[tuple[Text, ...], msgspec.Meta(min_length=1)]
    negatives: tuple[Text, ...]
    refined: bool
    form: Rule
    threshold: float
    min_reliability: Annotated[float, msgspec.Meta(ge=0, le=1)]
    encoder: str | None = None


def save_question(folder: Path, question: Question) -> Path:
    """Writes queries.safetensors beside the field, in place of an earlier one; returns its path.

    Raises:
        ValueError: what `load_question` would refuse.
        FileNotFoundError: the folder is gone.
        OSError: the file cannot be written.
    """
    if not folder.is_dir():
        raise FileNotFoundError(
            f"{folder} is gone: the run was moved or deleted after it was opened, and nothing was stored. Open the run "
            "where it is now"
        )
    if question.suggest:
        raise InputError(
            "the question cannot be stored: its threshold is to be suggested; ask it, and store the answer's"
        )
    facts = _Facts(
        question.texts, question.negatives, question.refined, question.rule, question.threshold,
        question.min_reliability, question.encoder,
    )  # fmt: skip
    given = {name: value for name in _VECTORS if (value := getattr(question, name)) is not None}
    arrays = {name: value.astype(np.float32) for name, value in given.items()}
    try:
        stored = _encoded(facts)
        checked = _question(stored, arrays)
        if (folder / MANIFEST).exists():
            _check_belongs(checked, read_manifest(folder)[0])
    except (ValueError, TypeError) as error:
        raise InputError(f"the question cannot be stored: {error}") from error
    save_arrays(folder / QUERIES_FILE, arrays, {_KEY: stored}, overwrite=True)
    return folder / QUERIES_FILE


def load_question(folder: Path) -> Question | None:
    """The question stored in the folder of a field; None if there is none.

    Raises:
        ValueError: a damaged file, or one that holds no question.
    """
    path = folder / QUERIES_FILE
    if not os.path.lexists(path):
        return None
    try:
        if not os.path.isfile(path):
            raise InputError("it is no file")
        arrays, stored, _ = load_arrays(path, undigested=(_KEY,), remedy=_REMEDY)
        if set(stored) != {_KEY}:
            raise InputError(f"its metadata has {sorted(stored)}, expected {_KEY}")
        question = _question(stored[_KEY], arrays)
        if (folder / MANIFEST).exists():
            _check_belongs(question, read_manifest(folder)[0])
        return question
    except (ValueError, RecursionError) as error:  # msgspec's errors are ValueErrors
        raise InputError(f"{path} is damaged ({type(error).__name__}: {error}). {_REMEDY}") from error


def _encoded(facts: _Facts) -> str:
    return msgspec.json.encode(facts).decode()


def _question(stored: str, arrays: dict[str, np.ndarray]) -> Question:
    """What the file says.

    Raises:
        ValueError: facts or vectors that are none, or that do not belong together.
    """
    facts = msgspec.json.decode(stored, type=_Facts)
    if not math.isfinite(facts.threshold):
        raise InputError(f"the threshold is {facts.threshold}, expected a finite number")
    if not {"vectors"} <= set(arrays) <= set(_VECTORS):
        raise InputError(f"it holds {', '.join(sorted(arrays)) or 'nothing'}; expected {' and '.join(_VECTORS)}")
    negative = arrays.get("negative_vectors")
    if (negative is None) != (len(facts.negatives) == 0):
        raise InputError(f"{len(facts.negatives)} negatives, {'no' if negative is None else 'some'} vectors of them")
    if RULES[facts.form].compares and negative is None:
        raise InputError(f"rule {facts.form!r} compares with negatives, and there are none")
    size = arrays["vectors"].shape[-1] if arrays["vectors"].ndim > 0 else 0
    _check_vectors("vectors", arrays["vectors"], facts.texts, size)
    if negative is not None:
        _check_vectors("negative_vectors", negative, facts.negatives, size)
    return Question(
        facts.texts, arrays["vectors"], facts.negatives, negative, facts.form, facts.threshold,
        facts.min_reliability, facts.refined, facts.encoder,
    )  # fmt: skip


def _check_belongs(question: Question, manifest: Mapping[str, Any]) -> None:
    """Raises ValueError where the vectors are of another encoder than the field beside them."""
    size, known = question.vectors.shape[1], encoder_digest(manifest)
    if size != manifest["dimension"]:
        raise InputError(f"its vectors have {size} numbers, the features of the run {manifest['dimension']}")
    if question.encoder is not None and known is not None and question.encoder != known:
        raise InputError(f"its texts were read by another encoder ({question.encoder}) than that of the run ({known})")


def _check_vectors(name: str, vectors: np.ndarray, texts: Sequence[str], size: int) -> None:
    check_array(f"{name} of {len(texts)} texts", vectors, "float32", (len(texts), max(1, size)), -math.inf)
    for text, row in zip(texts, vectors):
        if not np.isfinite(row).all() or not row.any():
            raise InputError(f"the vector of {text!r} is zero or not finite")
