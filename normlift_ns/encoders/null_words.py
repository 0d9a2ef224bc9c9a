"""Null vocabulary of unrelated words, whose cosines calibrate the cosines of prompts for any encoder.

A Gaussian matches a prompt if its cosine with the prompt is larger than its cosines with almost all unrelated words. A
prompt is in the scene if its best match is better than those of almost all unrelated words. See `core.null_level`.
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
from normlift_ns.encoders.text_files import CachedTextEncoder, TextEmbeddingFile, TextEncoder
from normlift_ns.errors import InputError

_FEWEST = 5
"""Smallest number of words in a null vocabulary."""


@cache
def null_words() -> tuple[str, ...]:
    """Return 200 names of objects, which research/null_words.py selects."""
    return tuple(json.loads(Path(__file__).with_name("null_words.json").read_text(encoding="utf8")))


def null_vectors(
    source: FeatureSource, encoder: Mapping[str, Any], cache: Path | None = None
) -> Float[Tensor, "m d"] | None:
    """Return the vectors of the null vocabulary of a lift.

    The vocabulary consists of the prompts that were supplied with precomputed features or in a file of text embeddings.
    For other lifts, it is `null_words`. The result is None if the vocabulary has fewer than five words, or the encoder
    cannot embed them.

    Args:
        encoder: Encoder settings from the manifest.
        cache: Folder that keeps the vectors of `null_words`, because loading a network for them takes seconds. None:
            compute them.
    """
    kind, file = find_encoder_kind(encoder.get("encoder")), encoder.get("text_vectors")
    texts: TextEncoder = source
    if isinstance(source, PrecomputedFeatures):
        words: tuple[str, ...] = tuple(source.texts)
    elif file is not None:
        words = tuple(TextEmbeddingFile(Path(file)).texts)
    else:
        words = null_words() if kind is not None and kind.has_null_words else ()
        identity = {"source": source.identity, "encoder": dict(encoder)}
        texts = CachedTextEncoder(lambda: identity, lambda: source, cache)
    if len(words) < _FEWEST:
        return None
    try:
        return texts.text(words)
    except InputError:  # the encoder cannot embed these words
        return None
