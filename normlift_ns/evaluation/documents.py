"""JSON files that others wrote, as the types that a protocol expects."""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Annotated, Any, TypeVar

import msgspec

from normlift_ns.errors import InputError

Name = Annotated[str, msgspec.Meta(pattern=r"(?s)\A(?!.*[\ud800-\udfff]).*\S")]
"""A text that can be asked: not blank, and without halves of characters."""
_LARGEST = 2**26
"""Bytes; label files have some thousands."""
T = TypeVar("T")


def read_document(path: Path, kind: type[T]) -> T:
    """The content of a JSON file.

    Raises:
        ValueError: no file, one that is too large or no JSON, keys that stand twice, values of other types.
    """
    if not os.path.isfile(path):
        raise InputError("it is no file")
    try:
        with path.open("rb") as file:
            content = file.read(_LARGEST + 1)
        if len(content) > _LARGEST:
            raise InputError(f"it has more than {_LARGEST:,} bytes")
        found = json.loads(content.decode("utf8"), object_pairs_hook=_once, parse_constant=_no_number)
        return msgspec.convert(found, kind)
    except (OSError, ValueError, RecursionError) as error:  # msgspec's errors are ValueErrors
        raise InputError(f"{type(error).__name__}: {error}") from None


def _once(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    found = dict(pairs)
    if len(found) < len(pairs):
        keys = [key for key, _ in pairs]
        twice = next(key for key in keys if keys.count(key) > 1)
        raise InputError(f"the key {twice!r} stands twice")
    return found


def _no_number(text: str) -> float:
    raise InputError(f"{text} is no number in JSON")
