"""Texts as a question to a semantic field: their vectors, and the rule by which they select. Needs no torch."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from jaxtyping import Float

from normlift_ns.errors import InputError
from normlift_ns.options import RULES, Rule
from normlift_ns.ranges import check_bool, check_number, shown
from normlift_ns.text_encoders import Field, default_rule, encoder_digest


@dataclass(frozen=True, eq=False)
class Question:
    """Q texts as the encoder of a field sees them, and what is selected by them. Vectors may be given as tensors."""

    texts: tuple[str, ...]
    vectors: Float[np.ndarray, "q d"]
    """One per text, of any length > 0."""
    negatives: tuple[str, ...] = ()
    """What the texts are compared with, where the rule compares."""
    negative_vectors: Float[np.ndarray, "b d"] | None = None
    rule: Rule = "cosine"
    threshold: float = 0.5
    """Relevancy above which a Gaussian is selected."""
    min_reliability: float = 0.0
    """Minimum R of a selected Gaussian, in 0..1."""
    refined: bool = True
    """Use refined features."""
    encoder: str | None = None
    """Digest of the encoder that made the vectors, see `encoder_digest`; None: nobody knows."""
    suggest: bool = False
    """Take the threshold that the histogram of all relevancies suggests, in place of this one, as soon as the question
    is answered; the question of an answer has its threshold."""

    def __post_init__(self) -> None:
        for name in ("vectors", "negative_vectors"):
            value = getattr(self, name)
            if value is not None and not isinstance(value, np.ndarray):  # a tensor, on any device
                object.__setattr__(self, name, value.detach().cpu().numpy())


def make_question(
    field: Field,
    read: Callable[[Sequence[str]], Any],
    texts: Sequence[str],
    *,
    negatives: Sequence[str] | None = None,
    rule: Rule | Literal["auto"] = "auto",
    threshold: float | Literal["auto"] | None = None,
    min_reliability: float = 0.0,
    refined: bool = True,
) -> Question:
    """Texts as a question to a field.

    Args:
        read: makes one vector per text, of an encoder that fits the field.
        negatives: what the texts are compared with; None: as the encoder says, see `default_rule`.
        rule: "auto": as the encoder says; lerf where other negatives are given, cosine where none are.
        threshold: "auto": what the histogram suggests. None: that of the encoder for its rule, else that of
            `RULES`; but "auto" for bare cosines, of which no number is known that selects something.
        min_reliability: minimum R of a selected Gaussian, in 0..1.
        refined: use refined features.
    Raises:
        ValueError: a text that is empty or that the encoder does not understand.
    """
    if negatives is not None and not isinstance(negatives, Sequence):
        raise InputError(f"negatives must be a list of texts, got {shown(negatives)}")
    if isinstance(negatives, str):
        raise InputError(f"negatives must be a list of texts, got the single text {negatives!r}; write [{negatives!r}]")
    if rule not in ("auto", *RULES):
        raise InputError(f"rule must be auto, {', '.join(RULES)}; got {rule!r}")
    min_reliability = check_number("min_reliability", min_reliability)
    if isinstance(threshold, str):
        if threshold != "auto":
            raise InputError(f'threshold must be a number or "auto", got {shown(threshold)}')
    elif threshold is not None:
        threshold = check_number("threshold", threshold)
    check_bool("refined", refined)
    default = default_rule(field)
    if rule == "auto":
        rule = default.rule if negatives is None else "cosine" if len(negatives) == 0 else "lerf"
    if threshold is None:
        known = RULES[rule].threshold if RULES[rule].compares else "auto"
        threshold = default.threshold if rule == default.rule else known
    negatives = tuple(default.negatives if negatives is None else negatives)
    return Question(
        texts=tuple(texts),
        vectors=read(texts),
        negatives=negatives,
        negative_vectors=read(negatives) if len(negatives) > 0 else None,
        rule=rule,
        threshold=RULES[rule].threshold if threshold == "auto" else threshold,
        suggest=threshold == "auto",
        min_reliability=min_reliability,
        refined=refined,
        encoder=encoder_digest(field.manifest),
    )
