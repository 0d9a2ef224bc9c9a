"""manifest.json: what is known of a semantic field, with the digests of its files and of itself."""

from __future__ import annotations

import json
import re
import warnings
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any

import msgspec

from normlift_ns.core.disk.digests import file_digest, text_digest
from normlift_ns.core.files import write_text
from normlift_ns.errors import InputError
from normlift_ns.options import Storage

SCHEMA_VERSION = 1
MANIFEST = "manifest.json"
REMEDY = "lift again with: ns-normlift --load-config ..."
_LARGEST = 2**26
"""Bytes of a manifest that is read; ours have some thousand."""
BESIDE = re.compile(r"(\.\./(nerfstudio_models/)?)?\w[\w.-]*")
"""Names of files that a manifest may have digests of: beside it, and in the run that it belongs to."""
_Count = Annotated[int, msgspec.Meta(ge=0, lt=2**31)]


class _Facts(msgspec.Struct):
    """What every program that opens a field relies on; the rest of a manifest is for people."""

    num_gaussians: _Count
    dimension: _Count
    means_fingerprint: str
    form: Storage
    encoder: dict[str, str | None] | None = None
    features: dict[str, Any] = {}
    cameras: list[float] | None = None
    cameras_held_out: list[float] | None = None


def write_manifest(folder: Path, facts: Mapping[str, Any], digests: Mapping[str, str]) -> None:
    """Writes facts, digests of files by their paths from the folder, and its own: of its text without that digest.

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
        text = _text(path)
        facts = json.loads(text)
        if not isinstance(facts, dict):
            raise InputError(f"it holds {type(facts).__name__}, expected an object")
    except (OSError, ValueError, RecursionError) as error:
        raise InputError(
            f"the semantic field in {folder} is damaged ({path}: {type(error).__name__}: {error}); {REMEDY}"
        ) from error
    if facts.get("schema_version") != SCHEMA_VERSION or isinstance(facts["schema_version"], bool):
        found = repr(facts.get("schema_version"))[:50]
        raise InputError(f"{folder}: schema version {found}, this program reads {SCHEMA_VERSION}; lift again")
    expected, digests = facts.pop("digest", None), facts.pop("digests", None)
    if expected is not None or digests is not None:
        found = text_digest(text.replace(f'"digest": {json.dumps(expected)}', '"digest": ""', 1))
        if found != expected:
            raise InputError(f"{path} is damaged: its text has digest {found}, expected {str(expected)[:50]}; {REMEDY}")
    try:
        msgspec.convert(facts, _Facts)
        digests = None if digests is None else msgspec.convert(digests, dict[str, str])
        if strange := [name for name in digests or () if BESIDE.fullmatch(name) is None]:
            raise InputError(f"it has a digest of {strange[0]!r}, which is no file of a run")
    except (ValueError, RecursionError) as error:
        raise InputError(f"{path} is damaged ({error}); {REMEDY}") from error
    return facts, digests


def _text(path: Path) -> str:
    """Of a regular file: anything else might never end."""
    if not path.is_file():
        raise InputError("it is no file")
    if path.stat().st_size > _LARGEST:
        raise InputError(f"it has {path.stat().st_size:,} bytes, expected {_LARGEST:,} at most")
    return path.read_bytes().decode("utf8").replace("\r\n", "\n")  # a copy by way of Windows is the same text


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


def check_files(folder: Path) -> None:
    """Makes sure that the files of a run, as far as they are there, are those that were written with its field.

    Needs neither torch nor nerfstudio: damage shows before either is loaded.

    Args:
        folder: of the manifest, which must be complete.
    Raises:
        FileNotFoundError, ValueError: as `read_manifest`; a file that is damaged, or of another run.
    """
    for name, expected in (read_manifest(folder)[1] or {}).items():
        path = folder.parent / name.removeprefix("../") if name.startswith("../") else folder / name
        if not path.is_file() or path.suffix == ".safetensors":  # these have digests of their own
            continue
        found = file_digest(path)
        if found != expected:
            raise InputError(
                f"{path} is damaged, or not the file that belongs to the semantic field in {folder}: its content has "
                f"digest {found}, expected {expected}; copy it again from the whole run, or {REMEDY}"
            )
