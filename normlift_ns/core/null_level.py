"""Null level of every Gaussian, the cosine that a prompt must exceed to differ from unrelated text.

The level is the k-th largest cosine between a Gaussian and the texts of the null vocabulary. Here, k is 3 % of the
number of texts, rounded, and at least 2. With many texts, a prompt above the level is therefore more similar than about
97 % of them. If the null vocabulary consists of the texts of a scene, at most 83, only the most similar text is above
the level. docs/honest_answers.md compares other shares.
"""

from __future__ import annotations

from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor

from normlift_ns.core.field import SemanticField
from normlift_ns.core.relevancy import top_values

NULL_SHARE = 0.03
"""Share of the null vocabulary that may be more similar to a Gaussian than a matching prompt."""
_BLOCK = 32


def with_null_level(field: SemanticField, vectors: Float[Tensor, "m d"]) -> SemanticField:
    """Return the field with null levels.

    Its manifest records the top cosine of each null text, which is the 99.9 % quantile over the Gaussians.

    Args:
        vectors: Vectors of any norm > 0, one for each of at least two texts of the null vocabulary.
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
