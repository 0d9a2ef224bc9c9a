"""How a run stores a question: texts as vectors, with the rule by which they select.

A run with a stored question is rendered by stock nerfstudio without a text encoder.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import get_args

from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file

from normlift_ns.asking import Question
from normlift_ns.core.files import atomic_path
from normlift_ns.options import Rule

QUERIES_FILE = "queries.safetensors"
"""In the folder of the field: vectors, and everything else as JSON in the file's metadata."""
_KEY = "question"


def save_question(folder: Path, question: Question) -> Path:
    """Writes queries.safetensors beside the field, in place of an earlier one; returns its path."""
    rule = {"form": question.rule, "threshold": question.threshold, "min_reliability": question.min_reliability}
    facts = {"texts": question.texts, "negatives": question.negatives, "refined": question.refined, **rule}
    tensors = {"vectors": question.vectors, "negative_vectors": question.negative_vectors}
    with atomic_path(folder / QUERIES_FILE) as temporary:
        save_file(
            {name: value.contiguous().cpu() for name, value in tensors.items() if value is not None},
            temporary,
            metadata={_KEY: json.dumps(facts)},
        )
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
        with safe_open(path, framework="pt") as file:
            facts = json.loads((file.metadata() or {})[_KEY])
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118 (not a dictionary)
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
            raise ValueError(f"{len(question.vectors)} vectors of {len(question.texts)} texts, rule {question.rule!r}")
    except (SafetensorError, KeyError, TypeError, ValueError) as error:
        raise ValueError(
            f"{path} is damaged ({type(error).__name__}: {error}). Delete it, or store the queries again with: "
            "ns-normlift-query --load-config ... --text ... --save True"
        ) from error
    return question
