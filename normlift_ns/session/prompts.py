"""Prompts as rows: every text or click with its vector, or with what is wrong with it."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np
from jaxtyping import Float

from normlift_ns.errors import InputError
from normlift_ns.options import RULES, Rule
from normlift_ns.question import Question, make_question
from normlift_ns.text_encoders import Field

MOST_PROMPTS = 64
ALIKE = 0.9
"""Cosine to a clicked direction above which a Gaussian is like what was clicked."""
_SEPARATED = re.compile(r'\s*(?:"([^"]*)"|([^,;\n]*))\s*(?:[,;\n]|$)')
_CLICK = re.compile(r"like (what was clicked|click \d+)")
_RULED = "A click is compared by its cosine; ask it alone, or choose the rule cosine."
Read = Callable[[Sequence[str]], Any]
"""Texts to vectors [Q, D], as `rows` of an encoder; raises ValueError for a text that it cannot read."""


@dataclass(frozen=True, eq=False)
class Prompt:
    """One row of a question."""

    text: str
    vector: Float[np.ndarray, " d"] | None = None
    """None where the row has a problem."""
    problem: str = ""
    """Why there is no answer to it, in words for the person who typed it."""

    @property
    def clicked(self) -> bool:
        """Whether it is a click in the scene, and no text."""
        return is_click(self.text)


def click_name(number: int) -> str:
    """What a click is called in a row of prompts; the vector of its direction is kept under this name."""
    return f"like click {number}"


def is_click(text: str) -> bool:
    """Whether a text is the name of a click.

    >>> is_click(click_name(3)), is_click("like what was clicked"), is_click("click")
    (True, True, False)
    """
    return _CLICK.fullmatch(text) is not None


def split_prompts(text: str) -> list[str]:
    """What stands between commas, semicolons and line breaks, each once; quotes keep a comma in a prompt.

    >>> split_prompts('red mug , bowl;;"salt, pepper"; bowl')
    ['red mug', 'bowl', 'salt, pepper']
    """
    found = (quoted or bare for quoted, bare in _SEPARATED.findall(text))
    return list(dict.fromkeys(part for part in (" ".join(part.split()) for part in found) if part))


def join_prompts(texts: Sequence[str]) -> str:
    """The line that `split_prompts` reads as these texts.

    >>> join_prompts(["red mug", "salt, pepper"])
    'red mug, "salt, pepper"'
    """
    lines = (" ".join(text.replace('"', " ").split()) for text in texts)
    return ", ".join(f'"{line}"' if re.search("[,;]", line) else line for line in lines)


def read_prompts(text: str, read: Read, known: Mapping[str, Any] | None = None) -> tuple[Prompt, ...]:
    """A line of prompts as rows. A text that cannot be read keeps the encoder's message, and the others their vectors.

    Args:
        known: vectors that need no reading, by their texts: of clicks, and of what is saved in the run.
    Raises:
        ValueError: no prompt, or too many.
        OSError, MemoryError: the encoder itself cannot be loaded.
    """
    texts, known = split_prompts(text), known or {}
    if len(texts) == 0:
        raise InputError("Type what to look for, then press Ask.")
    if len(texts) > MOST_PROMPTS:
        raise InputError(f"{len(texts)} prompts; ask for {MOST_PROMPTS} at most at a time.")
    new = [one for one in texts if one not in known]
    try:
        found: dict[str, Any] = dict(zip(new, read(new) if len(new) > 0 else []))
    except ValueError:
        found = {one: _read_alone(one, read) for one in new}
    return tuple(_row(one, known[one] if one in known else found[one]) for one in texts)


def _read_alone(text: str, read: Read) -> Any:
    if is_click(text):
        return f"{text!r} is no click of this session or run; click the scene again."
    try:
        return read([text])[0]
    except ValueError as error:
        return str(error)


def _row(text: str, found: Any) -> Prompt:
    if isinstance(found, str):
        return Prompt(text, problem=found)
    return Prompt(text, np.asarray(found, np.float32))


def pose(
    field: Field,
    prompts: Sequence[Prompt],
    read: Read,
    *,
    negatives: Sequence[str] | None = None,
    rule: Rule | Literal["auto"] = "auto",
    threshold: float | None = None,
    min_reliability: float = 0.0,
    refined: bool = True,
) -> tuple[tuple[Prompt, ...], Question]:
    """The question of all rows that have a vector; rows that it leaves out come back with their problem.

    Clicks alone are asked by their cosine, above 0.9; clicks beside texts only where the rule is cosine.

    Args:
        read: for the negatives. The other arguments are those of `make_question`.
    Raises:
        ValueError: no row has a vector; as `make_question`.
    """
    good = [prompt for prompt in prompts if prompt.vector is not None]
    if len(good) == 0:
        raise InputError(prompts[0].problem if len(prompts) > 0 else "Type what to look for, then press Ask.")
    how: dict[str, Any] = {"min_reliability": min_reliability, "refined": refined}
    if all(prompt.clicked for prompt in good):
        threshold = ALIKE if threshold is None else threshold
        question = _made(field, good, read, negatives=(), rule="cosine", threshold=threshold, **how)
        return tuple(prompts), question
    how |= {"negatives": negatives, "rule": rule, "threshold": threshold}
    question = _made(field, good, read, **how)
    if not RULES[question.rule].compares or not any(prompt.clicked for prompt in good):
        return tuple(prompts), question
    ruled = tuple(replace(p, vector=None, problem=_RULED) if p.clicked and p.vector is not None else p for p in prompts)
    return ruled, _made(field, [prompt for prompt in ruled if prompt.vector is not None], read, **how)


def _made(field: Field, prompts: Sequence[Prompt], read: Read, **how: Any) -> Question:
    vectors: dict[str, Any] = {prompt.text: prompt.vector for prompt in prompts}

    def rows(texts: Sequence[str]) -> np.ndarray:
        return np.stack([vectors[text] if text in vectors else read([text])[0] for text in texts])

    return make_question(field, rows, list(vectors), **how)


def prompts_of(question: Question | None) -> tuple[Prompt, ...]:
    """The rows of a question, for instance of the one that a run stores; none of None."""
    if question is None:
        return ()
    return tuple(Prompt(text, np.asarray(row)) for text, row in zip(question.texts, question.vectors))


def merged(stored: Question | None, asked: Question) -> Question:
    """What to save so that nothing is lost: the stored prompts and the new ones, a new one in place of its namesake.

    Raises:
        ValueError: the two go by different rules, or by different negatives.
    """
    if stored is None:
        return asked
    if (stored.rule, stored.negatives, stored.refined) != (asked.rule, asked.negatives, asked.refined):
        raise InputError(
            f"The run stores {len(stored.texts)} prompts with the rule {stored.rule}, these go by {asked.rule} or by "
            "other negatives; they cannot be saved together. Replace the stored ones, or ask again with their rule."
        )
    rows: dict[str, Any] = {prompt.text: prompt.vector for prompt in (*prompts_of(stored), *prompts_of(asked))}
    return replace(asked, texts=tuple(rows), vectors=np.stack(list(rows.values())))
