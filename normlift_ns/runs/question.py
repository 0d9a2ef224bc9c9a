"""How a run stores a question: texts as vectors, with the rule by which they select.

A run with a stored question is rendered by stock nerfstudio without a text encoder.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import get_args

from normlift_ns.asking import Question
from normlift_ns.core.disk.tensors import load_tensors, save_tensors
from normlift_ns.errors import InputError
from normlift_ns.options import Rule

QUERIES_FILE = "queries.safetensors"
"""In the folder of the field: vectors, and everything else as JSON in the file's metadata."""
_KEY = "question"
_REMEDY = "Delete it, or store the queries again with: ns-normlift-query --load-config ... --text ... --save True"


def save_question(folder: Path, question: Question) -> Path:
    """Writes queries.safetensors beside the field, in place of an earlier one; returns its path."""
    rule = {"form": question.rule, "threshold": question.threshold, "min_reliability": question.min_reliability}
    facts = {"texts": question.texts, "negatives": question.negatives, "refined": question.refined, **rule}
    tensors = {"vectors": question.vectors, "negative_vectors": question.negative_vectors}
    given = {name: value for name, value in tensors.items() if value is not None}
    save_tensors(folder / QUERIES_FILE, given, {_KEY: json.dumps(facts)}, overwrite=True)
    return folder / QUERIES_FILE


def load_question(folder: Path) -> Question | None:
    """The question stored in the folder of a field; None if there is none.

    Raises:
        ValueError: a damaged file.
    """
    path = folder / QUERIES_FILE
    if not path.exists():
        return None
    try:
        tensors, stored, _ = load_tensors(path, undigested=(_KEY,), remedy=_REMEDY)
        facts = json.loads(stored[_KEY])
        question = Question(
            texts=tuple(map(str, facts["texts"])),
            vectors=tensors["vectors"],
            negatives=tuple(map(str, facts["negatives"])),
            negative_vectors=tensors.get("negative_vectors"),
            rule=facts["form"],
            threshold=float(facts["threshold"]),
            min_reliability=float(facts["min_reliability"]),
            refined=bool(facts["refined"]),
        )
        if len(question.vectors) != len(question.texts) or question.rule not in get_args(Rule):
            raise InputError(f"{len(question.vectors)} vectors of {len(question.texts)} texts, rule {question.rule!r}")
    except (KeyError, TypeError, ValueError) as error:
        raise InputError(f"{path} is damaged ({type(error).__name__}: {error}). {_REMEDY}") from error
    return question
