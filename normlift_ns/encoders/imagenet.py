"""Vocabulary of the 1,000 classes of ImageNet, with names, synonyms, hypernyms and the last words of names.

`imagenet_words.json`, which research/imagenet_words.py writes, contains the names and hypernyms of all classes from
WordNet 3.0. A name, such as "red fox", stands for all classes with that name. A hypernym, such as "dog" or "furniture",
stands for all classes below it. The last word of a name, such as "trunks", stands for all classes whose names end
in this word. This does not apply to words that are themselves names or hypernyms: "dog" does not include hot dog.
"""

from __future__ import annotations

import difflib
import json
import re
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import Any

from normlift_ns.errors import InputError, truncate_text

_ENDINGS = (("ches", "ch"), ("shes", "sh"), ("ses", "s"), ("xes", "x"), ("zes", "z"), ("ies", "y"), ("men", "man"),
            ("s", ""))  # fmt: skip
"""Plural endings and the singular endings that replace them, as in WordNet."""
_AFTER_HEAD = re.compile(r"\b(?:of|on|in|with|at|under|by|near|behind|from|for|that|which)\b.*")
"""Pattern of the part of a phrase that follows its main noun."""


def find_classes(prompt: str) -> list[int]:
    """Return the indices of the classes that a prompt names, in ascending order.

    If the whole prompt is not in the vocabulary, it is cut before the first preposition or relative pronoun. Then the
    longest known phrase at its end is used.

    >>> find_classes("A red fox"), find_classes("two foxes in the snow"), find_classes("cup of tea")
    ([277], [277, 278, 279, 280], [968])

    Raises:
        InputError: If the prompt does not name a class.
    """
    _, word = _find_words(prompt)
    if word is not None:
        return list(_vocabulary()[word])
    text = _normalized(prompt)
    near = [name for name in _vocabulary() if not set(text.split()).isdisjoint(name.split())]
    near += [name for word in (text, *text.split()) for name in difflib.get_close_matches(word, _vocabulary())]
    suggestions = ", ".join(list(dict.fromkeys(near))[:6] or ["dog", "chair", "vehicle"])
    raise InputError(
        f"prompt {truncate_text(prompt)!r} is not the name of an ImageNet class or of a group of classes. Use a name "
        f"such as {suggestions}, or lift with --encoder open_clip for other words"
    )


def known_words(prompt: str) -> str:
    """Return the words of a prompt that `find_classes` uses, or "" if the prompt does not name a class.

    >>> known_words("A red fox"), known_words("blue fox that sleeps")
    ('red fox', 'fox')
    """
    return _find_words(prompt)[0]


def _find_words(prompt: str) -> tuple[str, str | None]:
    """Return the relevant words of a prompt and the vocabulary entry that they match, or "" and None."""
    text = _normalized(prompt)
    head = _AFTER_HEAD.sub("", text).split()
    for phrase in (text, *(" ".join(head[start:]) for start in range(len(head)))):
        for word in _singulars(phrase):
            if word in _vocabulary():
                return phrase, word
    return "", None


def _normalized(text: str) -> str:
    """Return the words of a text in lower case, separated by spaces instead of hyphens and other punctuation."""
    return " ".join(re.findall(r"[^\W_]+(?:['.][^\W_]+)*", text.lower()))


def _singulars(phrase: str) -> Iterator[str]:
    """Yield a phrase and its possible singulars."""
    yield phrase
    before, _, last = phrase.rpartition(" ")
    stems = [last.removesuffix(ending) + singular for ending, singular in _ENDINGS if last.endswith(ending)]
    for stem in [_table()["plurals"].get(last, last), *stems]:
        yield f"{before} {stem}".strip()


@cache
def _table() -> dict[str, Any]:
    return json.loads(Path(__file__).with_name("imagenet_words.json").read_text(encoding="utf8"))


@cache
def _vocabulary() -> dict[str, tuple[int, ...]]:
    """Return the class indices of each name, hypernym and last word of a name. All keys are normalized."""
    known: dict[str, set[int]] = {}
    heads: dict[str, set[int]] = {}
    for number, names in enumerate(_table()["classes"].values()):
        for name in map(_normalized, names.split(", ")):
            known.setdefault(name, set()).add(number)
            heads.setdefault(name.split()[-1], set()).add(number)
    for names, groups in _table()["hypernyms"].items():
        for name in map(_normalized, names.split(", ")):
            for group in groups.split():
                first, _, last = group.partition("-")
                known.setdefault(name, set()).update(range(int(first), int(last or first) + 1))
    return {word: tuple(sorted(found)) for word, found in (heads | known).items()}


def class_names() -> list[str]:
    """Return the first name of each of the 1,000 classes."""
    return [names.split(", ")[0] for names in _table()["classes"].values()]
