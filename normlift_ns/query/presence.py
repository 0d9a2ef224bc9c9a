"""Verdicts on the presence of prompts in a scene. This module does not need torch.

The rank of a prompt is the fraction of the null vocabulary whose best cosine is lower than that of the prompt. The
limits on the rank fix the rate of false positives: with every encoder, one unrelated word in ten is "found". The
color encoder has limits on the cosine instead. Without a null vocabulary of at least 100 words, the verdict depends on
the relevancy, which compares the prompt with the negatives. docs/honest_answers.md has the counts.
"""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Mapping
from typing import Any, Literal

from normlift_ns.core.relevancy import RELEVANCY_RULES
from normlift_ns.encoders.registry import find_encoder_kind
from normlift_ns.options import RelevancyRule

Verdict = Literal["found", "weak match", "probably not here"]
"""Presence of a prompt. found: it matches better than almost all unrelated words. probably not here: it matches no
better than many of them."""
_FOUND_RANK, _WEAK_RANK = 0.9, 0.7
"""Minimum ranks of a prompt for the verdicts "found" and "weak match"."""
_FEWEST = 100
"""Minimum number of null words for a meaningful rank."""


def null_rank(manifest: Mapping[str, Any], top_cosine: float) -> float | None:
    """Return the fraction of null words with a lower best cosine, in 0..1; None if the field has too few null words."""
    tops = (manifest.get("null_words") or {}).get("tops", ())
    return bisect_left(tops, top_cosine) / len(tops) if len(tops) >= _FEWEST else None


def compares_cosines(manifest: Mapping[str, Any], encoder: str | None) -> bool:
    """Return whether `judge` uses cosines (with limits of the encoder or null words) instead of relevancies."""
    kind = find_encoder_kind(encoder)
    return (kind is not None and kind.present_from is not None) or null_rank(manifest, 0.0) is not None


def judge(
    manifest: Mapping[str, Any], encoder: str | None, rule: RelevancyRule, *, top_cosine: float, top: float
) -> Verdict | None:
    """Return the verdict on a prompt; None if there are no null words, limits or negatives to compare with.

    Args:
        manifest: Manifest of the field.
        encoder: Name of the encoder of the field.
        rule: Relevancy rule of the query.
        top_cosine: Cosine that one Gaussian in a thousand exceeds.
        top: Relevancy that one Gaussian in a thousand exceeds.
    """
    kind, rank = find_encoder_kind(encoder), null_rank(manifest, top_cosine)
    if kind is not None and kind.present_from is not None:
        return _by_limits(top_cosine, kind.present_from)
    if rank is not None:
        return _by_limits(rank, (_WEAK_RANK, _FOUND_RANK))
    settings = RELEVANCY_RULES[rule]
    return None if settings.presence_limit is None else _by_limits(top, (settings.threshold, settings.presence_limit))


def _by_limits(value: float, limits: tuple[float, float]) -> Verdict:
    weak, found = limits
    return "found" if value >= found else "weak match" if value >= weak else "probably not here"
