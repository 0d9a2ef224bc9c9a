"""Paths, checks and digests of the files of a lifted run."""

from __future__ import annotations

import os
import warnings
from collections.abc import Iterable, Mapping
from datetime import datetime
from pathlib import Path
from typing import Any

from normlift_ns.errors import InputError
from normlift_ns.io.atomic import complete_interrupted_writes, file_digest, refuse_existing, text_digest
from normlift_ns.io.manifest import DIGESTED_PATH, MANIFEST_FILE, check_file_digests, read_manifest

FIELD_FOLDER = "normlift"
"""Folder of the semantic field inside the run directory."""
TEXT_EMBEDDINGS_FILE = "texts.npz"
"""Prompts with embeddings provided by the user, in the folder of the field."""
_MAX_NAME_BYTES = 200
"""Maximum length of a folder name; systems allow 255 bytes, and some are reserved for appended numbers."""
_SEAL = "# Lines below: "
"""First words of a config.yml that normlift_ns wrote; the digest of the following lines comes next."""


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
    text = path.read_bytes().decode("utf8", "replace").replace("\r\n", "\n") if path.is_file() else ""
    first, _, rest = text.partition("\n")
    if first.startswith(_SEAL) and first != add_digest_comment(rest).partition("\n")[0]:
        warnings.warn(
            f"{path} is not as normlift_ns wrote it: it was edited, or is damaged. If you edited it, delete its first "
            "line; otherwise copy the whole run again",
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


def refuse_existing_run(run_dir: Path, overwrite: bool) -> None:
    """Raise FileExistsError if the directory exists and `overwrite` is False, or if it is not a run."""
    refuse_existing(run_dir, overwrite=overwrite, flags="--timestamp or --output-dir")
    if os.path.lexists(run_dir) and not (run_dir / "config.yml").is_file():
        raise FileExistsError(
            f"{run_dir} is not a run (it has no config.yml), so --overwrite does not replace it; give another "
            "--timestamp or --output-dir, or delete it yourself"
        )
