"""manifest.json: metadata of a semantic field, with digests of its files and of the manifest itself."""

from __future__ import annotations

import json
import re
import warnings
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any

import msgspec

from normlift_ns.errors import InputError
from normlift_ns.io.atomic import file_digest, text_digest, write_text_file
from normlift_ns.options import Storage

SCHEMA_VERSION = 1
MANIFEST_FILE = "manifest.json"
LIFT_AGAIN = "lift again with: ns-normlift --load-config ..."
_MAX_BYTES = 2**26
"""Size limit of a manifest; normlift_ns writes a few thousand bytes."""
DIGESTED_PATH = re.compile(r"(\.\./(nerfstudio_models/)?)?\w[\w.-]*")
"""Relative paths that a manifest may have digests of: files next to it, and files of its run."""
_Count = Annotated[int, msgspec.Meta(ge=0, lt=2**31)]


class _Metadata(msgspec.Struct):
    """The entries that programs rely on; the other entries of a manifest are for human readers."""

    num_gaussians: _Count
    dimension: _Count
    means_fingerprint: str
    form: Storage
    encoder: dict[str, str | None] | None = None
    features: dict[str, Any] = {}
    cameras: list[float] | None = None
    cameras_held_out: list[float] | None = None


def write_manifest(folder: Path, facts: Mapping[str, Any], digests: Mapping[str, str]) -> None:
    """Write metadata, digests of files, and the manifest's own digest, computed with that entry empty.

    Args:
        facts: metadata of JSON types.
        digests: digests by path relative to the folder.
    """
    content = {"digest": None, **facts} | {"digest": "", "digests": dict(digests)}  # its own digest comes first
    text = json.dumps(content, indent=2) + "\n"
    write_text_file(folder / MANIFEST_FILE, text.replace('"digest": ""', f'"digest": "{text_digest(text)}"', 1))


def read_manifest(folder: Path) -> tuple[dict[str, Any], dict[str, str] | None]:
    """Read and check a manifest.

    Returns:
        Metadata, and the digests of files by path relative to the folder; None instead of digests for version 0.1.
    Raises:
        FileNotFoundError: the manifest does not exist.
        ValueError: the manifest is damaged or has an unknown schema version.
    """
    path = folder / MANIFEST_FILE
    if not path.exists():
        raise FileNotFoundError(f"{folder} holds no complete semantic field ({MANIFEST_FILE} is missing); {LIFT_AGAIN}")
    try:
        text = read_text(path)
        facts = json.loads(text)
        if not isinstance(facts, dict):
            raise InputError(f"it holds a {type(facts).__name__}, expected a JSON object")
    except (OSError, ValueError, RecursionError) as error:
        raise InputError(
            f"the semantic field in {folder} is damaged ({path}: {type(error).__name__}: {error}); {LIFT_AGAIN}"
        ) from error
    if facts.get("schema_version") != SCHEMA_VERSION or isinstance(facts["schema_version"], bool):
        version = repr(facts.get("schema_version"))[:50]
        raise InputError(f"{folder} has schema version {version}, expected {SCHEMA_VERSION}; lift again")
    expected, digests = facts.pop("digest", None), facts.pop("digests", None)
    if expected is not None or digests is not None:
        actual = text_digest(text.replace(f'"digest": {json.dumps(expected)}', '"digest": ""', 1))
        if actual != expected:
            raise InputError(
                f"{path} is damaged: its text has digest {actual}, expected {str(expected)[:50]}; {LIFT_AGAIN}"
            )
    try:
        msgspec.convert(facts, _Metadata)
        digests = None if digests is None else msgspec.convert(digests, dict[str, str])
        if outside := [name for name in digests or () if DIGESTED_PATH.fullmatch(name) is None]:
            raise InputError(f"it has a digest of {outside[0]!r}, which is not a file of a run")
    except (ValueError, RecursionError) as error:
        raise InputError(f"{path} is damaged ({error}); {LIFT_AGAIN}") from error
    return facts, digests


def read_text(path: Path) -> str:
    """Read a regular file of limited size; reading a pipe, say, might never end."""
    if not path.is_file():
        raise InputError("it is not a regular file")
    if path.stat().st_size > _MAX_BYTES:
        raise InputError(f"it has {path.stat().st_size:,} bytes, expected at most {_MAX_BYTES:,}")
    return path.read_bytes().decode("utf8").replace("\r\n", "\n")  # copying via Windows may change line endings


def check_digests(folder: Path, actual: Mapping[str, str | None], expected: Mapping[str, str] | None) -> None:
    """Raise if the files next to a manifest were not written together with it.

    Args:
        actual: actual digests of the files by name; None for files without a digest.
        expected: digests in the manifest. None for a manifest of version 0.1; the files must then have none either.
    Raises:
        ValueError: a file is from a different lift.
    """
    if expected is None and set(actual.values()) == {None}:
        warnings.warn(
            f"{folder} was written by version 0.1, without digests, so damage cannot be detected; {LIFT_AGAIN}",
            stacklevel=2,
        )
        return
    for name, digest in actual.items():
        wanted = None if expected is None else expected.get(name)
        if digest is None or digest != wanted:
            raise InputError(
                f"{folder / name} and the manifest next to it are from different lifts: the file has digest {digest}, "
                f"the manifest expects {wanted}; {LIFT_AGAIN}"
            )


def check_file_digests(folder: Path) -> None:
    """Raise if an existing file of a run is not the one that was written with its semantic field.

    This check needs neither torch nor nerfstudio, so it reports damage before either is imported.

    Args:
        folder: folder of the manifest.
    Raises:
        FileNotFoundError: the manifest does not exist.
        ValueError: the manifest or another file is damaged, or a file is from a different run.
    """
    for name, expected in (read_manifest(folder)[1] or {}).items():
        path = folder.parent / name.removeprefix("../") if name.startswith("../") else folder / name
        if not path.is_file() or path.suffix == ".safetensors":  # safetensors files have digests of their own
            continue
        actual = file_digest(path)
        if actual != expected:
            raise InputError(
                f"{path} is damaged or does not belong to the semantic field in {folder}: its content has digest "
                f"{actual}, expected {expected}; copy the whole run again, or {LIFT_AGAIN}"
            )
