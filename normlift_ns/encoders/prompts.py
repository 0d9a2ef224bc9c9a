"""Validation of prompts, and normalization of vectors."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from jaxtyping import Float32

from normlift_ns.errors import InputError

UNIT_TOLERANCE = 1e-3
"""Largest deviation from length 1 of a unit vector; half precision leaves 5e-4."""


def check_prompts(prompts: Sequence[str]) -> None:
    """Raise ValueError unless `prompts` is a list of at least one text, none of them empty."""
    if isinstance(prompts, str):
        raise InputError(f"prompts must be a list of texts, got the single text {prompts!r}; write [{prompts!r}]")
    if len(prompts) == 0:
        raise InputError('no text given; name at least one object to search for, such as --text "orange"')
    for prompt in prompts:
        if not isinstance(prompt, str) or "\0" in prompt:
            raise InputError(f"a text must be a str without NUL characters, got {prompt!r:.60}")
    empty = [i for i, prompt in enumerate(prompts) if not prompt.strip()]
    if len(empty) > 0:
        raise InputError(
            f"text {empty[0] + 1} of {len(prompts)} is empty ({prompts[empty[0]]!r}); remove it, or describe what "
            "to search for"
        )


def unit_rows(vectors: Any) -> Float32[np.ndarray, "*n d"]:
    """Return vectors normalized to unit length, without overflow or underflow; they must be finite and not zero.

    >>> unit_rows(np.array([3e-320, 4e-320])), unit_rows(np.array([3e38, 3e38], np.float32))
    (array([0.6, 0.8], dtype=float32), array([0.70710677, 0.70710677], dtype=float32))
    """
    rows = np.asarray(vectors).astype(np.float64)
    rows = rows / np.abs(rows).max(axis=-1, keepdims=True)
    return (rows / np.linalg.norm(rows, axis=-1, keepdims=True)).astype(np.float32)
