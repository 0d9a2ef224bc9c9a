"""Null vocabulary: unrelated texts that a prompt is compared with, so that cosines of any encoder get a meaning.

A Gaussian belongs to a prompt if the prompt is nearer to it than almost all unrelated words are, and a prompt is in the
scene if its best match is better than those of almost all unrelated words. See `core.null_level`.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from functools import cache
from pathlib import Path
from typing import Any

from jaxtyping import Float
from torch import Tensor

from normlift_ns.encoders.base import FeatureSource, PrecomputedFeatures
from normlift_ns.encoders.registry import find_encoder_kind
from normlift_ns.encoders.text_files import TextEmbeddingFile
from normlift_ns.errors import InputError

_FEWEST = 5
"""Number of texts below which there is no null vocabulary."""


@cache
def null_words() -> tuple[str, ...]:
    """Return 200 names of things; research/null_words.py chooses them."""
    return tuple(json.loads(Path(__file__).with_name("null_words.json").read_text(encoding="utf8")))


def null_vectors(source: FeatureSource, encoder: Mapping[str, Any]) -> Float[Tensor, "m d"] | None:
    """Return the vectors of the null vocabulary of a lift; None if it has none.

    Features of one's own, and imported ones, are compared with the texts that were given with them.

    Args:
        encoder: settings of the encoder, as in the manifest.
    """
    kind, file = find_encoder_kind(encoder.get("encoder")), encoder.get("text_vectors")
    if isinstance(source, PrecomputedFeatures):
        words: tuple[str, ...] = tuple(source.texts)
    elif file is not None:
        words = tuple(TextEmbeddingFile(Path(file)).texts)
    else:
        words = null_words() if kind is not None and kind.has_null_words else ()
    if len(words) < _FEWEST:
        return None
    try:
        return source.text(words)
    except InputError:  # an encoder that does not know them
        return None
