"""Queries for a semantic field: prompts with their embeddings, and the rule that selects Gaussians.

This module does not need torch.
"""

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
    """A query: Q prompts, their embeddings, and how they select Gaussians. Embeddings may be passed as tensors."""

    texts: tuple[str, ...]
    vectors: Float[np.ndarray, "q d"]
    """One embedding per prompt, of any norm > 0."""
    negatives: tuple[str, ...] = ()
    """Negative prompts, for rules that compare with them."""
    negative_vectors: Float[np.ndarray, "b d"] | None = None
    rule: Rule = "cosine"
    threshold: float = 0.5
    """Relevancy above which a Gaussian is selected."""
    min_reliability: float = 0.0
    """Minimum R of a selected Gaussian, in 0..1."""
    refined: bool = True
    """Use refined features."""
    encoder: str | None = None
    """Digest of the encoder of the embeddings, see `encoder_digest`; None if unknown."""
    suggest: bool = False
    """Replace the threshold with the one that the histogram of all relevancies suggests, when the query runs. The query
    stored in the result has that threshold.
    """

    def __post_init__(self) -> None:
        for name in ("vectors", "negative_vectors"):
            value = getattr(self, name)
            if value is not None and not isinstance(value, np.ndarray):  # a tensor on any device
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
    """Encode prompts as a query for a field.

    Args:
        read: encodes prompts as one embedding each, with an encoder that fits the field.
        texts: the prompts.
        negatives: negative prompts (default: those of the encoder, see `default_rule`).
        rule: "auto" is the rule of the encoder if `negatives` is None, cosine if it is empty, and lerf otherwise.
        threshold: "auto" is the threshold that the histogram suggests. None is the threshold of the encoder for its own
            rule, and otherwise that of `RULES`. For the rule cosine with an encoder of another rule, None is "auto",
            because no threshold suits all encoders.
        min_reliability: minimum R of a selected Gaussian, in 0..1.
        refined: use refined features.
    Raises:
        ValueError: an argument is not valid, or the encoder cannot encode a prompt, for instance because it is empty.
    """
    if negatives is not None and not isinstance(negatives, Sequence):
        raise InputError(f"negatives must be a list of strings, got {shown(negatives)}")
    if isinstance(negatives, str):
        raise InputError(
            f"negatives must be a list of strings, got the single string {negatives!r}; write [{negatives!r}]"
        )
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
        general = RULES[rule].threshold if RULES[rule].compares else "auto"
        threshold = default.threshold if rule == default.rule else general
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
