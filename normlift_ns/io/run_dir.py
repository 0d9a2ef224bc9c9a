"""Paths, checks and digests of the files of a lifted run, and the manifest of its semantic field."""

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

from normlift_ns.errors import InputError, json_type
from normlift_ns.io.atomic import (
    complete_interrupted_writes,
    file_digest,
    text_digest,
    write_text_file,
)
from normlift_ns.io.guard import open_regular, read_file, read_text, refuse_inputs
from normlift_ns.options import LiftOptions, SourceOptions, Storage, new_names, option_name, option_setting

FIELD_FOLDER = "normlift"
"""Name of the folder of the semantic field in the run directory."""
TEXT_EMBEDDINGS_FILE = "texts.npz"
"""Name of the file in the field folder that stores the user's prompts with their embeddings."""
_MAX_NAME_BYTES = 200
"""Maximum length of a folder name in bytes. Systems allow 255 bytes; the rest is reserved for appended numbers."""
_SEAL = "# Lines below: "
"""Beginning of a config.yml that normlift_ns wrote. The digest of all lines except the first one follows."""
_WRITTEN = (
    *("field.safetensors", "evidence.safetensors", TEXT_EMBEDDINGS_FILE, "../dataparser_transforms.json"),
    *("../splat.json", "../transforms.json", "../added_photographs.json"),
)
"""Default names of files that a lift writes, relative to the field folder; see `written_files`."""
SCHEMA_VERSION = 1
MANIFEST_FILE = "manifest.json"
LIFT_AGAIN = "lift again with: ns-normlift --load-config ..."
DIGESTED_PATH = re.compile(r"(\.\./(nerfstudio_models/)?)?\w[\w.-]*")
"""Pattern of the paths of files with digests, relative to the folder of the manifest.

The files are in this folder, in the run directory or in nerfstudio_models/.
"""
_LARGE = 2**32
"""Size of a checkpoint in bytes above which its end is checked first, because computing its digest takes seconds."""
_Count = Annotated[int, msgspec.Meta(ge=0, lt=2**31)]


def run_directory(output_dir: Path, name: str, timestamp: str | None = None) -> Path:
    """Return the directory of a new lifted run, output_dir/name/normlift/timestamp, as an absolute path.

    Args:
        timestamp: Name of the last folder. If None, the current time in the format 2024-05-01_120000.
    Raises:
        ValueError: The timestamp or the name is not a valid folder name.
    """
    stamp = datetime.now().strftime("%Y-%m-%d_%H%M%S") if timestamp is None else timestamp
    for kind, folder in (("timestamp", stamp), ("experiment name", name)):
        if not isinstance(folder, str):
            raise InputError(f"the {kind} must be a string, got {folder!r:.60}")
        if folder.startswith(".") or folder.strip() == "" or {"/", "\\"} & set(folder) or not folder.isprintable():
            raise InputError(
                f"the {kind} {folder!r} is not a valid folder name; give a printable, non-blank name without "
                "slashes or a leading dot, such as 'run'"
            )
        if len(os.fsencode(folder)) > _MAX_NAME_BYTES:
            raise InputError(
                f"the {kind} {folder[:20]!r}… has {len(os.fsencode(folder))} bytes, expected at most "
                f"{_MAX_NAME_BYTES}; give a shorter name"
            )
    return Path(os.path.abspath(output_dir)) / name / "normlift" / stamp


def cache_folder(run_dir: Path) -> Path:
    """Return the cache folder for 2D features, evidence and text embeddings, which sibling runs share."""
    return run_dir.parent / ".cache"


def text_cache_folder(run_dir: Path) -> Path:
    """Return the cache folder for text embeddings, which is in `cache_folder`."""
    return cache_folder(run_dir) / "texts"


def field_folder(run_dir: Path) -> Path:
    """Return the folder of the semantic field of a lifted run.

    Raises:
        FileNotFoundError: The run has no semantic field.
    """
    folder = run_dir / FIELD_FOLDER
    if not folder.is_dir():
        raise FileNotFoundError(
            f"{run_dir} is a run without semantics: the folder {FIELD_FOLDER}/ is missing. Run ns-normlift "
            "--load-config CONFIG.yml, then give the new config.yml, whose path ns-normlift prints at the end."
        )
    return folder


def recorded_gsplat_version(run_dir: Path) -> str | None:
    """Return the version of gsplat whose rasterization rules a lift used.

    Returns:
        The version, such as "1.4"; None if the run is not lifted or its manifest has no version.
    Raises:
        ValueError: The manifest of the semantic field is damaged.
    """
    folder = run_dir / FIELD_FOLDER
    if not (folder / MANIFEST_FILE).exists():
        return None
    version = read_manifest(folder)[0].get("gsplat_rules")
    return None if version is None else str(version)


def resolve_manifest_paths(manifest: Mapping[str, Any], folder: Path) -> Mapping[str, Any]:
    """Return a manifest in which the relative path of text embeddings is joined to `folder`, the manifest's folder."""
    encoder = manifest.get("encoder")
    if not isinstance(encoder, dict) or encoder.get("text_vectors") is None:
        return manifest
    path = str(folder / encoder["text_vectors"])  # absolute paths stay as they are
    return {**manifest, "encoder": {**encoder, "text_vectors": path}}


def check_run(run_dir: Path) -> None:
    """Raise if a file of a lifted run has changed since the lift; for config.yml, only warn.

    Safetensors files are not checked, because loading them checks their digests.

    Raises:
        ValueError: A file is damaged or from a different run.
    """
    if not run_dir.exists():
        complete_interrupted_writes(run_dir.parent)  # an interrupted command may have been replacing the run
    path = run_dir / "config.yml"
    text = read_file(path).decode("utf8", "replace").replace("\r\n", "\n") if path.is_file() else ""
    first, _, rest = text.partition("\n")
    if first.startswith(_SEAL) and first != add_digest_comment(rest).partition("\n")[0]:
        warnings.warn(
            f"{path} has changed since normlift_ns wrote it. If you edited it, delete its first line. Otherwise it is "
            "damaged, so copy the whole run again.",
            stacklevel=2,
        )
    if (run_dir / FIELD_FOLDER / MANIFEST_FILE).exists():
        check_file_digests(run_dir / FIELD_FOLDER)


def run_file_digests(folder: Path, files: Iterable[Path]) -> dict[str, str]:
    """Return the digests of files of a run, by path relative to the field folder.

    Files that do not exist or are not part of the run are left out.
    """
    names = {Path(os.path.relpath(file, folder)).as_posix(): file for file in files if file.is_file()}
    return {name: file_digest(file) for name, file in names.items() if DIGESTED_PATH.fullmatch(name)}


def add_digest_comment(config: str) -> str:
    """Return the text of a config.yml with its digest in a comment above, so that later edits are detected."""
    return f"{_SEAL}{text_digest(config)} (to change them without a warning, delete this line)\n{config}"


def complete_interrupted_lifts(run_dir: Path) -> None:
    """Call `complete_interrupted_writes` for the parent folder of a run and for its cache folders."""
    for folder in (run_dir.parent, *cache_folder(run_dir).glob("*")):
        complete_interrupted_writes(folder)


def refuse_existing_run(run_dir: Path, overwrite: bool, source: Path | None = None) -> None:
    """Raise before a lift starts its work if it would replace a run or folder that it must not replace.

    Args:
        source: File that the lift reads.
    Raises:
        FileExistsError: The directory exists, and `overwrite` is False or the directory is not a lifted run.
        ValueError: `source` is in the directory, or the errors of `refuse_inputs`.
    """
    flags = f"{option_name('timestamp')} or {option_name('output_dir')}"
    refuse_inputs([run_dir], instead=flags)
    complete_interrupted_writes(run_dir.parent)
    if source is not None and Path(os.path.realpath(source)).is_relative_to(os.path.realpath(run_dir)):
        raise InputError(f"{run_dir} contains {source}, which the lift reads; give another {flags}")
    is_run = (run_dir / "config.yml").is_file() and (run_dir / FIELD_FOLDER).is_dir()
    if os.path.lexists(run_dir) and not is_run:
        raise FileExistsError(
            f"{run_dir} exists and is not a lifted run, because config.yml or {FIELD_FOLDER}/ is missing. Only lifted "
            f"runs can be replaced; give another {flags}, or delete {run_dir}."
        )
    if not overwrite and os.path.lexists(run_dir):
        raise FileExistsError(f"{run_dir} exists; give another {flags}, or {option_setting('overwrite', True)}.")


def written_files(run_dir: Path) -> set[str]:
    """Return the paths of the files that a lift wrote, relative to the run directory.

    They are config.yml, the manifest, the stored queries, and the files that the manifest lists. If the manifest is
    missing, damaged or from version 0.1, the default names of all files that a lift writes replace its list.
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


# manifest.json: metadata of a semantic field, with digests of the files and of the manifest itself.


class _Metadata(msgspec.Struct):
    """Entries of a manifest whose types are checked."""

    num_gaussians: _Count
    dimension: _Count
    means_fingerprint: str
    form: Storage
    encoder: dict[str, str | None] | None = None
    features: dict[str, Any] = {}
    cameras: list[float] | None = None
    cameras_held_out: list[float] | None = None


def write_manifest(folder: Path, facts: Mapping[str, Any], digests: Mapping[str, str]) -> None:
    """Write a manifest of metadata, digests of files, and a digest of its own text.

    The digest of the text is computed with an empty string in its own place.

    Args:
        facts: Metadata with JSON types.
        digests: Digests of files, by path relative to the folder.
    """
    content = {"digest": None, **facts} | {"digest": "", "digests": dict(digests)}  # `digest` is the first entry
    text = json.dumps(content, indent=2) + "\n"
    text = text.replace('"digest": ""', f'"digest": "{text_digest(text)}"', 1)
    write_text_file(folder / MANIFEST_FILE, text, own=True)


def read_manifest(folder: Path) -> tuple[dict[str, Any], dict[str, str] | None]:
    """Read and check a manifest.

    Returns:
        Metadata with the option names of this version, and the digests of files by path relative to the folder. In
        version 0.1, manifests have no digests, and the second result is None.
    Raises:
        FileNotFoundError: The manifest does not exist.
        ValueError: The manifest is damaged or has an unknown schema version.
    """
    path = folder / MANIFEST_FILE
    if not path.exists():
        raise FileNotFoundError(f"{folder} has no complete semantic field: {MANIFEST_FILE} is missing; {LIFT_AGAIN}")
    try:
        text = read_text(path)
        facts = json.loads(text)
        if not isinstance(facts, dict):
            raise InputError(f"it contains {json_type(facts)}, expected a JSON object")
    except (OSError, ValueError, RecursionError) as error:
        raise InputError(
            f"the semantic field in {folder} is damaged or cannot be read ({path}: {error}); {LIFT_AGAIN}"
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
            raise InputError(f"it has a digest of {outside[0]!r}, which is not a file of the run")
    except (ValueError, RecursionError) as error:
        raise InputError(f"{path} is damaged ({error}); {LIFT_AGAIN}") from error
    return facts | _new_names(facts), digests


def _new_names(facts: Mapping[str, Any]) -> dict[str, Any]:
    """Return the entries of a manifest that contain options, with the option names of this version."""
    recorded = {"options": LiftOptions, "source": SourceOptions}
    return {name: new_names(recorded[name], x) for name, x in facts.items() if name in recorded and isinstance(x, dict)}


def check_digests(folder: Path, actual: Mapping[str, str | None], expected: Mapping[str, str] | None) -> None:
    """Raise if a manifest and the files next to it are from different lifts.

    If neither the manifest nor any file has a digest, as in version 0.1, only warn.

    Args:
        actual: Digests of the files by name; None for files without a digest.
        expected: Digests in the manifest; None for a manifest of version 0.1.
    Raises:
        ValueError: A file is from a different lift.
    """
    if expected is None and set(actual.values()) == {None}:
        warnings.warn(
            f"{folder} was written by version 0.1 and has no digests, so damage cannot be detected; {LIFT_AGAIN}",
            stacklevel=2,
        )
        return
    for name, digest in actual.items():
        wanted = None if expected is None else expected.get(name)
        if digest is None or digest != wanted:
            raise InputError(
                f"{folder / name} and the files next to it are from different lifts: the digest of the file is "
                f"{digest or 'missing'}, and that in the manifest is {wanted or 'missing'}; {LIFT_AGAIN}"
            )


def _ends_as_archive(path: Path) -> bool:
    """Return True if a file ends with the last record of a ZIP archive. At most the last 66 kB are read."""
    with open_regular(path) as file:
        return zipfile.is_zipfile(file)


def check_file_digests(folder: Path) -> None:
    """Raise if an existing file of a run differs from the digest in the manifest.

    The check imports neither torch nor nerfstudio, so commands can report damage early. It skips safetensors files,
    which contain their own digests.

    Args:
        folder: Folder of the manifest.
    Raises:
        FileNotFoundError: The manifest does not exist.
        ValueError: A file is damaged or from a different run.
    """
    for name, expected in (read_manifest(folder)[1] or {}).items():
        path = folder.parent / name.removeprefix("../") if name.startswith("../") else folder / name
        if not path.is_file() or path.suffix == ".safetensors":  # safetensors files contain their own digests
            continue
        if path.stat().st_size > _LARGE and path.suffix == ".ckpt" and not _ends_as_archive(path):
            raise InputError(
                f"{path} is damaged: checkpoints are ZIP archives, but this file does not end like one; copy the whole "
                f"run again, or {LIFT_AGAIN}"
            )
        actual = file_digest(path)
        if actual != expected:
            raise InputError(
                f"{path} is damaged or from a different run than {folder}: its content has digest {actual}, expected "
                f"{expected}; copy the whole run again, or {LIFT_AGAIN}"
            )
