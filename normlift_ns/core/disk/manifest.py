"""manifest.json: what is known of a semantic field, with the digests of its files and of itself."""

from __future__ import annotations

import json
import warnings
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from normlift_ns.core.disk.tensors import text_digest
from normlift_ns.core.files import write_text
from normlift_ns.errors import InputError

SCHEMA_VERSION = 1
MANIFEST = "manifest.json"
REMEDY = "lift again with: ns-normlift --load-config ..."


def write_manifest(folder: Path, facts: Mapping[str, Any], digests: Mapping[str, str]) -> None:
    """Writes facts, digests of the files beside it by their names, and its own: of its text without that digest.

    Args:
        facts: JSON types only.
    """
    content = {"digest": None, **facts} | {"digest": "", "digests": dict(digests)}  # its own first
    text = json.dumps(content, indent=2) + "\n"
    write_text(folder / MANIFEST, text.replace('"digest": ""', f'"digest": "{text_digest(text)}"', 1))


def read_manifest(folder: Path) -> tuple[dict[str, Any], dict[str, str] | None]:
    """Facts and digests; None in place of these where version 0.1 wrote the manifest.

    Raises:
        FileNotFoundError: there is none.
        ValueError: a damaged one, or one of another schema.
    """
    path = folder / MANIFEST
    if not path.exists():
        raise FileNotFoundError(f"{folder} holds no complete semantic field ({MANIFEST} is missing); {REMEDY}")
    try:
        text = path.read_text("utf8")
        facts = dict(json.loads(text))
    except (ValueError, TypeError, RecursionError) as error:
        raise InputError(
            f"the semantic field in {folder} is damaged ({path}: {type(error).__name__}: {error}); {REMEDY}"
        ) from error
    if facts.get("schema_version") != SCHEMA_VERSION:
        raise InputError(
            f"{folder}: schema version {facts.get('schema_version')!r}, this program reads {SCHEMA_VERSION}; lift again"
        )
    expected, digests = facts.pop("digest", None), facts.pop("digests", None)
    if expected is None and digests is None:
        return facts, None
    found = text_digest(text.replace(f'"digest": {json.dumps(expected)}', '"digest": ""', 1))
    if found != expected or not isinstance(digests, dict):
        raise InputError(f"{path} is damaged: its text has digest {found}, expected {expected}; {REMEDY}")
    return facts, digests


def check_digests(folder: Path, found: Mapping[str, str | None], expected: Mapping[str, str] | None) -> None:
    """Makes sure that the files beside a manifest are those that were written with it.

    Args:
        found: digests of the files, by name; None for a file that has none.
        expected: those of the manifest; None: it has none, and neither must the files.
    Raises:
        ValueError: a file of another lift.
    """
    if expected is None and set(found.values()) == {None}:
        warnings.warn(
            f"{folder} was written by version 0.1, without digests: damage to its numbers would not show; {REMEDY}",
            stacklevel=2,
        )
        return
    for name, digest in found.items():
        wanted = None if expected is None else expected.get(name)
        if digest is None or digest != wanted:
            raise InputError(
                f"{folder / name} and the manifest beside it are of different lifts: the file has digest {digest}, the "
                f"manifest expects {wanted}; {REMEDY}"
            )
