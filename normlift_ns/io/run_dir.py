"""Files of a lifted run: their paths, checks and digests, and the manifest of the semantic field."""

from __future__ import annotations

import json
import os
import re
import warnings
import zipfile
from collections.abc import Iterable, Mapping
from datetime import datetime
from pathlib import Path
from typing import Annotated, Any

import msgspec

from normlift_ns.errors import InputError
from normlift_ns.io.atomic import (
    complete_interrupted_writes,
    file_digest,
    text_digest,
    write_text_file,
)
from normlift_ns.io.guard import read_file, read_text, refuse_inputs
from normlift_ns.options import LiftOptions, SourceOptions, Storage, new_names

FIELD_FOLDER = "normlift"
"""Folder of the semantic field inside the run directory."""
TEXT_EMBEDDINGS_FILE = "texts.npz"
"""Prompts with embeddings provided by the user, in the folder of the field."""
_MAX_NAME_BYTES = 200
"""Maximum length of a folder name; systems allow 255 bytes, and some are reserved for appended numbers."""
_SEAL = "# Lines below: "
"""First words of a config.yml that normlift_ns wrote; the digest of the following lines comes next."""
_WRITTEN = (
    *("field.safetensors", "evidence.safetensors", TEXT_EMBEDDINGS_FILE, "../dataparser_transforms.json"),
    *("../splat.json", "../transforms.json", "../added_photographs.json"),
)
"""Files of a lift, relative to the folder of the field."""
SCHEMA_VERSION = 1
MANIFEST_FILE = "manifest.json"
LIFT_AGAIN = "lift again with: ns-normlift --load-config ..."
DIGESTED_PATH = re.compile(r"(\.\./(nerfstudio_models/)?)?\w[\w.-]*")
"""Relative paths that a manifest may have digests of: files next to it, and files of its run."""
_LARGE = 2**32
"""Size in bytes above which the end of a checkpoint is checked before its digest is computed, which takes seconds."""
_Count = Annotated[int, msgspec.Meta(ge=0, lt=2**31)]


def run_directory(output_dir: Path, name: str, timestamp: str | None = None) -> Path:
    """Return the directory of a new lifted run, output_dir/name/normlift/timestamp, as an absolute path.

    Args:
        timestamp: None for the current time, formatted like 2024-05-01_120000.
    Raises:
        ValueError: the timestamp or the name is not a valid folder name.
    """
    stamp = datetime.now().strftime("%Y-%m-%d_%H%M%S") if timestamp is None else timestamp
    for kind, folder in (("timestamp", stamp), ("experiment name", name)):
        if not isinstance(folder, str):
            raise InputError(f"the {kind} must be a string, got {folder!r:.60}")
        if folder.startswith(".") or folder.strip() == "" or {"/", "\\"} & set(folder) or not folder.isprintable():
            raise InputError(
                f"the {kind} {folder!r} is not the name of a folder; give one without slashes, such as 'run'"
            )
        if len(os.fsencode(folder)) > _MAX_NAME_BYTES:
            raise InputError(
                f"the {kind} {folder[:20]!r}… has {len(os.fsencode(folder))} bytes; give at most {_MAX_NAME_BYTES}"
            )
    return Path(os.path.abspath(output_dir)) / name / "normlift" / stamp


def cache_folder(run_dir: Path) -> Path:
    """Return the cache folder for 2D features, evidence and text embeddings, shared by sibling runs."""
    return run_dir.parent / ".cache"


def text_cache_folder(run_dir: Path) -> Path:
    """Return the folder that caches text embeddings."""
    return cache_folder(run_dir) / "texts"


def field_folder(run_dir: Path) -> Path:
    """Return the folder of the semantic field of a lifted run.

    Raises:
        FileNotFoundError: the run has no semantic field.
    """
    folder = run_dir / FIELD_FOLDER
    if not folder.is_dir():
        raise FileNotFoundError(
            f"{run_dir} is a run without semantics (no {FIELD_FOLDER}/ in it). Lift it with ns-normlift --load-config, "
            "then give the config.yml whose path ns-normlift prints at the end."
        )
    return folder


def recorded_gsplat_version(run_dir: Path) -> str | None:
    """Return the gsplat version whose rasterization a run was lifted with.

    Returns:
        None if the run is not lifted, or does not record the version.
    Raises:
        ValueError: the manifest of the semantic field is damaged.
    """
    folder = run_dir / FIELD_FOLDER
    if not (folder / MANIFEST_FILE).exists():
        return None
    version = read_manifest(folder)[0].get("gsplat_rules")
    return None if version is None else str(version)


def resolve_manifest_paths(manifest: Mapping[str, Any], folder: Path) -> Mapping[str, Any]:
    """Return the manifest with its file of text embeddings as a full path instead of one relative to `folder`."""
    encoder = manifest.get("encoder")
    if not isinstance(encoder, dict) or encoder.get("text_vectors") is None:
        return manifest
    path = str(folder / encoder["text_vectors"])  # absolute paths stay as they are
    return {**manifest, "encoder": {**encoder, "text_vectors": path}}


def check_run(run_dir: Path) -> None:
    """Raise if a file of a lifted run is not as it was written; only warn if that file is config.yml.

    Raises:
        ValueError: a file is damaged or from a different run.
    """
    if not run_dir.exists():
        complete_interrupted_writes(run_dir.parent)  # completes a replacement of the run that was interrupted
    path = run_dir / "config.yml"
    text = read_file(path).decode("utf8", "replace").replace("\r\n", "\n") if path.is_file() else ""
    first, _, rest = text.partition("\n")
    if first.startswith(_SEAL) and first != add_digest_comment(rest).partition("\n")[0]:
        warnings.warn(
            f"{path} has changed since normlift_ns wrote it: it was edited, or is damaged. If you edited it, "
            "delete its first line; otherwise copy the whole run again",
            stacklevel=2,
        )
    if (run_dir / FIELD_FOLDER / MANIFEST_FILE).exists():
        check_file_digests(run_dir / FIELD_FOLDER)


def run_file_digests(folder: Path, files: Iterable[Path]) -> dict[str, str]:
    """Return digests of files of a run by path relative to the folder of its field.

    Files that do not exist, or are not part of the run, are left out.
    """
    names = {Path(os.path.relpath(file, folder)).as_posix(): file for file in files if file.is_file()}
    return {name: file_digest(file) for name, file in names.items() if DIGESTED_PATH.fullmatch(name)}


def add_digest_comment(config: str) -> str:
    """Return the text of a config.yml with its digest in a comment at the top, so that edits can be detected."""
    return f"{_SEAL}{text_digest(config)} (to change them without a warning, delete this line)\n{config}"


def complete_interrupted_lifts(run_dir: Path) -> None:
    """Clean up after killed lifts, next to a run directory and in its cache; see `complete_interrupted_writes`."""
    for folder in (run_dir.parent, *cache_folder(run_dir).glob("*")):
        complete_interrupted_writes(folder)


def refuse_existing_run(run_dir: Path, overwrite: bool, source: Path | None = None) -> None:
    """Raise before a lift writes a run that it must not replace.

    Args:
        source: a file that the lift reads.
    Raises:
        FileExistsError: the directory exists and `overwrite` is False, or it is not a run.
        ValueError: `source` is in the directory, or this is part of another run.
    """
    flags = "--timestamp or --output-dir"
    refuse_inputs([run_dir], instead=flags)
    complete_interrupted_writes(run_dir.parent)
    if source is not None and Path(os.path.realpath(source)).is_relative_to(os.path.realpath(run_dir)):
        raise InputError(f"{run_dir} is the run that is lifted, and a lift cannot replace it; give another {flags}")
    if not overwrite and os.path.lexists(run_dir):
        raise FileExistsError(f"{run_dir} exists; give another {flags}, or --overwrite True.")
    is_run = (run_dir / "config.yml").is_file() and (run_dir / FIELD_FOLDER).is_dir()
    if os.path.lexists(run_dir) and not is_run:
        raise FileExistsError(
            f"{run_dir} is not a lifted run (it has no config.yml or no {FIELD_FOLDER}/), so --overwrite does not "
            "replace it; give another --timestamp or --output-dir, or delete it yourself"
        )


def written_files(run_dir: Path) -> set[str]:
    """Return the files of a run that normlift_ns wrote, relative to it: those that its manifest lists.

    If the manifest is damaged or of version 0.1, these are all files with the names that a lift writes.
    """
    names = {"config.yml", *(f"{FIELD_FOLDER}/{name}" for name in (MANIFEST_FILE, "queries.safetensors"))}
    try:
        listed = read_manifest(run_dir / FIELD_FOLDER)[1]
    except (OSError, ValueError):
        listed = None
    if listed is None:
        checkpoints = (f"../nerfstudio_models/{x.name}" for x in run_dir.glob("nerfstudio_models/step-*.ckpt"))
        listed = dict.fromkeys((*_WRITTEN, *checkpoints))
    return names | {os.path.normpath(f"{FIELD_FOLDER}/{name}").replace(os.sep, "/") for name in listed}


# manifest.json: metadata of a semantic field, with digests of its files and of the manifest itself.


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
    text = text.replace('"digest": ""', f'"digest": "{text_digest(text)}"', 1)
    write_text_file(folder / MANIFEST_FILE, text, own=True)


def read_manifest(folder: Path) -> tuple[dict[str, Any], dict[str, str] | None]:
    """Read and check a manifest.

    Returns:
        Metadata with the option names of this version, and the digests of files by path relative to the
        folder; None instead of digests for version 0.1.
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
    return facts | _new_names(facts), digests


def _new_names(facts: Mapping[str, Any]) -> dict[str, Any]:
    """Return the entries of a manifest that record options, with the names of this version."""
    recorded = {"options": LiftOptions, "source": SourceOptions}
    return {name: new_names(recorded[name], x) for name, x in facts.items() if name in recorded and isinstance(x, dict)}


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


def _ends_as_archive(path: Path) -> bool:
    """Return whether a file has the record that ends a ZIP archive. This reads the last 66 kB only."""
    with path.open("rb") as file:
        return zipfile.is_zipfile(file)


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
        if path.stat().st_size > _LARGE and path.suffix == ".ckpt" and not _ends_as_archive(path):
            raise InputError(
                f"{path} is damaged: it is not a ZIP archive, as checkpoints are; copy the whole run again, "
                f"or {LIFT_AGAIN}"
            )
        actual = file_digest(path)
        if actual != expected:
            raise InputError(
                f"{path} is damaged or does not belong to the semantic field in {folder}: its content has digest "
                f"{actual}, expected {expected}; copy the whole run again, or {LIFT_AGAIN}"
            )
