"""JSON files from other programs, validated against the types that a protocol expects."""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Annotated, Any, TypeVar

import msgspec

from normlift_ns.errors import InputError

Name = Annotated[str, msgspec.Meta(pattern=r"(?s)\A(?!.*[\ud800-\udfff]).*\S")]
"""Text that can be used as a prompt: not blank, and without lone surrogates."""
_MAX_BYTES = 2**26
"""Maximum file size in bytes; label files have some thousands."""
T = TypeVar("T")


def read_document(path: Path, kind: type[T]) -> T:
    """Read a JSON file and convert it to a type.

    Raises:
        ValueError: the file is missing, too large or not valid JSON, a key occurs twice, or a value has another type.
    """
    if not os.path.isfile(path):
        raise InputError("it is not a file")
    try:
        with path.open("rb") as file:
            content = file.read(_MAX_BYTES + 1)
        if len(content) > _MAX_BYTES:
            raise InputError(f"it has more than {_MAX_BYTES:,} bytes")
        document = json.loads(content.decode("utf8"), object_pairs_hook=_unique_keys, parse_constant=_reject_constant)
        return msgspec.convert(document, kind)
    except (OSError, ValueError, RecursionError) as error:  # msgspec's errors are ValueErrors
        raise InputError(f"{type(error).__name__}: {error}") from None


def _unique_keys(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    result = dict(pairs)
    if len(result) < len(pairs):
        keys = [key for key, _ in pairs]
        duplicate = next(key for key in keys if keys.count(key) > 1)
        raise InputError(f"the key {duplicate!r} occurs twice")
    return result


def _reject_constant(text: str) -> float:
    raise InputError(f"{text} is not a valid JSON number")
