"""Verdict whether a prompt is in the scene. Needs no torch.

Of the best cosine of a prompt, its rank is the share of the null vocabulary whose best cosine is lower. The limits of
the ranks fix the rate of false answers: one unrelated word in twenty is called found, whatever the encoder. Cosines of
the color encoder have a meaning of their own, and limits of their own. A field without a null vocabulary, or with one
of few words, is judged by the lead over the negatives. docs/honest_answers.md has the counts.
"""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Mapping
from typing import Any, Literal

from normlift_ns.core.relevancy import RELEVANCY_RULES
from normlift_ns.encoders.registry import find_encoder_kind
from normlift_ns.options import RelevancyRule

Verdict = Literal["found", "weak match", "probably not here"]
"""Found: the best match is what only things in a scene reach. Probably not here: as unrelated words."""
_FOUND_RANK, _WEAK_RANK = 0.95, 0.8
"""Shares of the null vocabulary that a prompt must outrank."""
_FEWEST = 100
"""Number of null words below which a rank says nothing."""


def null_rank(manifest: Mapping[str, Any], top_cosine: float) -> float | None:
    """Return the share of the null vocabulary that a prompt outranks, in 0..1; None if the field has too few words."""
    tops = (manifest.get("null_words") or {}).get("tops", ())
    return bisect_left(tops, top_cosine) / len(tops) if len(tops) >= _FEWEST else None


def judge(
    manifest: Mapping[str, Any], encoder: str | None, rule: RelevancyRule, *, top_cosine: float, top: float
) -> Verdict | None:
    """Return the verdict on a prompt; None if nothing tells whether its cosines are large.

    Args:
        manifest, encoder: of the field.
        top_cosine: cosine that one Gaussian in a thousand exceeds; top: the same of the relevancy.
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
