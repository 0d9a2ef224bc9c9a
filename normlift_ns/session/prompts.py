"""Prompts as rows, each a text or a click with its vector or its error, and queries made from these rows."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np
from jaxtyping import Float

from normlift_ns.errors import InputError
from normlift_ns.options import RelevancyRule
from normlift_ns.query.question import Query, make_query, split_prompts
from normlift_ns.query.text_encoder import HasManifest

MAX_PROMPTS = 64
CLICK_THRESHOLD = 0.9
"""Minimum cosine between the directions of a clicked Gaussian and a similar one."""
_CLICK = re.compile(r"like (what was clicked|click \d+)")
_NO_PROMPT = "There is no prompt to search for. Give at least one prompt."
_CLICK_RULE = "Clicks need the rule cosine. Choose the rule cosine, or ask for clicks without other prompts."
EncodeTexts = Callable[[Sequence[str]], Any]
"""Function from texts to vectors [Q, D], such as an encoder's `rows`. It raises ValueError if it cannot encode a text.
"""


@dataclass(frozen=True, eq=False)
class Prompt:
    """Text or click with its vector, or with an error."""

    text: str
    vector: Float[np.ndarray, " d"] | None = None
    """Vector of the prompt; None if there is an error."""
    error: str = ""
    """Error message for the user; empty without an error."""

    @property
    def is_click(self) -> bool:
        """True if the prompt stands for a click on the scene."""
        return is_click(self.text)


def click_name(number: int) -> str:
    """Return the prompt text that stands for a click. The prompt's vector is the direction of the clicked Gaussian."""
    return f"like click {number}"


def is_click(text: str) -> bool:
    """Return True if a prompt text stands for a click.

    >>> is_click(click_name(3)), is_click("like what was clicked"), is_click("click")
    (True, True, False)
    """
    return _CLICK.fullmatch(text) is not None


def encode_prompts(text: str, read: EncodeTexts, known_vectors: Mapping[str, Any] | None = None) -> tuple[Prompt, ...]:
    """Encode a line of prompts. A prompt that cannot be encoded gets the error message of the encoder.

    Args:
        text: Prompts as the user typed them.
        read: Function that encodes texts.
        known_vectors: Vectors of clicks and of prompts stored in the run, by text; they do not need an encoder.
    Raises:
        ValueError: The text has no prompts, or more than `MAX_PROMPTS`.
        OSError, MemoryError: The encoder cannot be loaded.
    """
    texts, vectors = split_prompts(text), dict(known_vectors or {})
    if len(texts) == 0:
        raise InputError(_NO_PROMPT)
    if len(texts) > MAX_PROMPTS:
        raise InputError(f"There are {len(texts)} prompts; the maximum is {MAX_PROMPTS} at a time. Remove some.")
    new, errors = [one for one in texts if one not in vectors], {}
    try:
        vectors |= zip(new, read(new) if len(new) > 0 else [])
    except ValueError:
        for one in new:
            try:
                if is_click(one):
                    raise InputError(f"{one!r} is not a click of this session or run. Click the scene again.")
                vectors[one] = read([one])[0]
            except ValueError as error:
                errors[one] = str(error)
    return tuple(
        Prompt(one, error=errors[one]) if one in errors else Prompt(one, np.asarray(vectors[one], np.float32))
        for one in texts
    )


def not_understood(prompts: Sequence[Prompt]) -> str:
    """Return the error of the first prompt if no prompt has a vector; "" otherwise.

    >>> not_understood([Prompt("glorp", error="'glorp' is unknown")])
    "'glorp' is unknown"
    """
    return prompts[0].error if all(prompt.vector is None for prompt in prompts) else ""


def build_query(
    field: HasManifest,
    prompts: Sequence[Prompt],
    read: EncodeTexts,
    *,
    negatives: Sequence[str] | None = None,
    relevancy: RelevancyRule | Literal["auto"] = "auto",
    threshold: float | Literal["auto"] | None = None,
    min_reliability: float = 0.0,
    refined: bool = True,
) -> tuple[tuple[Prompt, ...], Query]:
    """Build the query of all prompts that have a vector.

    A query of clicks alone uses the rule cosine and, by default, the suggested threshold. It is not gated, because a
    clicked Gaussian is in the scene. A query of clicks and texts requires the rule cosine.

    Args:
        read: Function that encodes the negatives. The keyword arguments are those of `make_query`.
    Returns:
        The prompts, with an error for each click if the rule is not cosine, and the query.
    Raises:
        ValueError: No prompt has a vector, or an argument is not valid (see `make_query`).
    """
    rows = tuple(prompts)
    clicks = [prompt.is_click for prompt in rows if prompt.vector is not None]
    if len(clicks) == 0:
        raise InputError(rows[0].error if len(rows) > 0 else _NO_PROMPT)
    if all(clicks):
        negatives, relevancy, threshold = (), "cosine", "auto" if threshold is None else threshold
    options = {"negatives": negatives, "relevancy": relevancy, "threshold": threshold}
    options |= {"min_reliability": min_reliability, "refined": refined}
    question = _question(field, rows, read, options)
    if any(clicks) and question.rule != "cosine":
        error: dict[str, Any] = {"vector": None, "error": _CLICK_RULE}
        rows = tuple(replace(p, **error) if p.is_click and p.vector is not None else p for p in rows)
        question = _question(field, rows, read, options)
    return rows, replace(question, gated=question.gated and not all(clicks))


def _question(field: HasManifest, prompts: Sequence[Prompt], read: EncodeTexts, options: Mapping[str, Any]) -> Query:
    """Return the query of the prompts that have a vector."""
    vectors: dict[str, Any] = {prompt.text: prompt.vector for prompt in prompts if prompt.vector is not None}

    def encode(texts: Sequence[str]) -> np.ndarray:
        return np.stack([vectors[text] if text in vectors else read([text])[0] for text in texts])

    return make_query(field, encode, list(vectors), **options)


def prompts_of_query(question: Query | None) -> tuple[Prompt, ...]:
    """Return the prompts of a query, such as the query stored in a run, with their vectors; () for None."""
    if question is None:
        return ()
    return tuple(Prompt(text, np.asarray(row)) for text, row in zip(question.texts, question.embeddings))


def merge_queries(stored: Query | None, asked: Query) -> Query:
    """Merge stored and new prompts into one query; a new prompt replaces a stored prompt with the same text.

    The other settings are those of `asked`.

    Args:
        stored: Query stored in the run; None if it has none.
        asked: Query to add.
    Raises:
        ValueError: The queries differ in rule, negatives or `refined`.
    """
    if stored is None:
        return asked
    names = {"rule": f"rules {stored.rule} and {asked.rule}", "negatives": "negatives", "refined": "refined features"}
    different = [name for field, name in names.items() if getattr(stored, field) != getattr(asked, field)]
    if len(different) > 0:
        raise InputError(
            "The new prompts cannot be added to the stored ones, which have different settings "
            f"({', '.join(different)}). Replace the stored prompts, or ask again with the settings of the stored ones."
        )
    rows = {text: row for query in (stored, asked) for text, row in zip(query.texts, query.embeddings)}
    return replace(asked, texts=tuple(rows), embeddings=np.stack(list(rows.values())))
