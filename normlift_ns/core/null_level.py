"""Null level of every Gaussian: the cosine that a text must exceed there to be more than one of many unrelated texts.

The texts of the null vocabulary are compared with every Gaussian. The level is their k-th largest cosine, k = 3 % of
the texts, at least 2. So a text that is above the level is nearer than 97 % of the unrelated ones; and where the null
vocabulary is the list of all texts of a scene, the nearest text alone is above it. docs/honest_answers.md compares
shares.
"""

from __future__ import annotations

from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor

from normlift_ns.core.field import SemanticField
from normlift_ns.core.relevancy import top_values

NULL_SHARE = 0.03
"""Share of the null vocabulary that may be nearer to a Gaussian than a text that is found there."""
_BLOCK = 32


def with_null_level(field: SemanticField, vectors: Float[Tensor, "m d"]) -> SemanticField:
    """Return a field with its null level, and the best cosine of every null text in its manifest.

    Args:
        vectors: vectors of the null vocabulary, M >= 2, of any length > 0.
    """
    count = max(2, round(NULL_SHARE * len(vectors)))
    own, source = field.valid(refined=False), field.source.long()
    valid, best = field.valid(), None
    tops: list[float] = []
    for block in vectors.split(_BLOCK):
        cosine = field.query(block, refined=False).float()
        tops += top_values(cosine[source[valid]]) if bool(valid.any()) else []
        best = cosine if best is None else torch.cat([best, cosine], 1)
        best = best.topk(min(count, best.shape[1]), 1).values
    assert best is not None
    level = torch.where(own, best[:, -1], 0.0)
    facts = {"texts": len(vectors), "tops": sorted(round(top, 4) for top in tops)}
    return replace(field, null_level=level, manifest={**field.manifest, "null_words": facts})
