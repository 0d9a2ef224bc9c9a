"""Guards of all files: what may be read, and which existing files an output may replace."""

from __future__ import annotations

import codecs
import json
import os
import re
import stat
from collections.abc import Callable, Iterable, Mapping
from functools import cache
from io import BufferedReader
from itertools import pairwise
from pathlib import Path
from typing import Any

from normlift_ns.errors import InputError

MAX_TEXT_BYTES = 2**26
"""Size limit of a text file; normlift_ns writes a few thousand bytes."""


def open_regular(path: str | Path, *, max_bytes: int | None = None) -> BufferedReader:
    """Open a regular file for reading, without waiting for a pipe.

    Raises:
        FileNotFoundError: the file does not exist.
        ValueError: it is a folder, a pipe or a device, or has more than `max_bytes` bytes.
    """
    try:
        file = open(path, "rb", opener=_open_at_once)  # noqa: SIM115 (the caller closes it)
    except IsADirectoryError:
        raise InputError(f"{path} is not a regular file; replace it with the file that belongs there") from None
    try:
        status = os.fstat(file.fileno())
        if not stat.S_ISREG(status.st_mode):
            raise InputError(f"{path} is not a regular file; replace it with the file that belongs there")
        if max_bytes is not None and status.st_size > max_bytes:
            raise InputError(f"{path} has {status.st_size:,} bytes, expected at most {max_bytes:,}")
    except BaseException:
        file.close()
        raise
    return file


def _open_at_once(path: str, flags: int) -> int:
    return os.open(path, flags | getattr(os, "O_NONBLOCK", 0))


def check_regular(path: str | Path, *, max_bytes: int | None = None) -> None:
    """Raise the errors of `open_regular` before another library opens the file."""
    open_regular(path, max_bytes=max_bytes).close()


def read_file(path: str | Path, *, max_bytes: int = MAX_TEXT_BYTES) -> bytes:
    """Return the content of a regular file; raises the errors of `open_regular`."""
    with open_regular(path, max_bytes=max_bytes) as file:
        return file.read()


def read_text(path: Path, encoding: str = "utf8") -> str:
    """Return the text of a regular file, with \\n as line ends; raises the errors of `open_regular`."""
    return read_file(path).decode(encoding).replace("\r\n", "\n")  # copying via Windows may change line endings


# Outputs. A run or a data set is recognized by its files; further inputs are those that a command was given.


_RUN = r"config\.yml|(dataparser_transforms|splat|transforms|added_photographs)\.json|nerfstudio_models|normlift"
_IMAGES = r"(images|masks|depths?|normals|semantics|instance)(_\d+)?|sparse|colmap|(cameras|labels|transforms.*)\.json"
_DATA_SET = rf"{_IMAGES}|sparse_pc\.ply|points3D\..*|(train|test|val|validation)_list\.txt"
_OWNERS = (
    ("run", ("config.yml", "nerfstudio_models"), _RUN),
    ("run", ("cfg_args",), r"cfg_args|(cameras|exposure)\.json|input\.ply|point_cloud"),
    ("run", ("cfg.yml", "ckpts"), r"cfg\.yml|ckpts|ply|renders|stats|tb|videos"),
    ("data set", ("transforms_train.json",), rf"{_DATA_SET}|train|test|val"),
    *(("data set", (name,), _DATA_SET) for name in ("transforms.json", "sparse/0", "sparse/cameras.bin")),
    *(("data set", (name,), _DATA_SET) for name in ("sparse/cameras.txt", "colmap/sparse", "database.db")),
)
"""Kind of folder, entries that identify it, and a pattern of the entries that belong to it."""
_KINDS = {
    ".ply": rb"ply\r?\n", ".png": rb"\x89PNG\r\n\x1a\n", ".npy": rb"\x93NUMPY", ".jpg": rb"\xff\xd8\xff",
    ".glb": rb"glTF", ".spz": rb"\x1f\x8b|NGSP",
    ".pdf": rb"%PDF-", ".safetensors": rb'(?s).{8}\{"', ".svg": rb"<\?xml[^>]*>\s*(<!DOCTYPE svg|<svg)|<svg",
}  # fmt: skip
"""First bytes of files by the suffix that names their kind."""
_HEAD_BYTES = 1024
_inputs: set[str] = set()


def protect_inputs(*paths: Path | None) -> None:
    """Let no output replace these files, or the files in these folders."""
    _inputs.update(os.path.abspath(path) for path in paths if path is not None)


def forget_inputs() -> None:
    """Forget the files of `protect_inputs`, at the beginning of a command."""
    _inputs.clear()


def refuse_inputs(paths: Iterable[Path], *, instead: str = "path") -> None:
    """Raise, before anything is computed, if an output would replace a file of a run, a data set, a cache, or an input.

    A run is a folder that has config.yml and nerfstudio_models/, or files of another trainer. Nothing may be written
    over its files or into its folders; figures, tables and exports next to these are allowed. A data set may get new
    files.

    Args:
        instead: flags with which the user can choose another path, for the error message.
    Raises:
        ValueError: as above, with links resolved.

    >>> refuse_inputs([Path("answers.json")], instead="--output-json")
    """
    owners, inputs = cache(lambda folder: list(_owners(folder))), cache(_input_files)
    for path in paths:
        owner = _owner_of(os.path.realpath(path), owners, inputs)
        if owner is not None:
            raise InputError(
                f"{path} is part of {owner}, and replacing it would destroy that; give another {instead} "
                "(--overwrite True does not allow this)"
            )


def _owner_of(path: str, owners: Callable[[str], Iterable[Any]], inputs: Callable[[], Mapping[Any, str]]) -> str | None:
    """Return what a path without links is part of; None if an output may be written there."""
    exists, folder = os.path.exists(path), os.path.dirname(path)
    for kind, parent, names in owners(folder):
        if (exists or kind == "run") and names.fullmatch(Path(path).relative_to(parent).parts[0]):
            return f"the {kind} {parent}"
    parts = Path(folder).parts
    if (exists and ".cache" in parts) or ("normlift", ".cache") in pairwise(parts):
        return f"the cache {folder}"
    statuses = map(os.stat, (path, *Path(path).parents) if exists else ())
    name = next(filter(None, (inputs().get((status.st_dev, status.st_ino)) for status in statuses)), None)
    return None if name is None else f"the input {name}"


def _owners(folder: str) -> Iterable[tuple[str, str, re.Pattern[str]]]:
    """Yield the runs and data sets that contain a folder, with the pattern of their entries."""
    for parent in (folder, *map(str, Path(folder).parents)):
        for kind, markers, names in _OWNERS:
            if all(os.path.exists(os.path.join(parent, marker)) for marker in markers):
                yield kind, parent, re.compile(names)


def _input_files() -> dict[tuple[int, int], str]:
    """Return the names of the inputs that exist by device and inode, so that links are recognized."""
    found = {}
    for name in filter(os.path.exists, _inputs):
        status = os.stat(name)
        found[status.st_dev, status.st_ino] = name
    return found


def refuse_other_kinds(path: Path, kind: str | None, flags: str = "overwrite=True") -> None:
    """Raise if an output would replace anything but an empty file or a regular file of its own kind.

    Args:
        path: the output; if it does not exist, nothing is checked.
        kind: kind of the output as of `file_kind`; None: not known yet.
        flags: flags that name the output, for the error message.
    Raises:
        ValueError: `path` is a folder, a pipe, a device or a broken link, or its content is of another kind.
    """
    if not os.path.lexists(path):
        return
    try:
        found = file_kind(path)
    except (OSError, InputError):
        raise InputError(
            f"{path}, given with {flags}, exists and is not a regular file that can be read; give another name"
        ) from None
    if found != "" and kind is not None and kind != found:
        raise InputError(
            f"{path} holds {found}, and would be replaced by {kind}; give another name, "
            "or delete it (--overwrite True replaces only a file of the same kind)"
        )


def file_kind(path: Path) -> str:
    """Return the kind of a file by its content, as a suffix such as ".ply"; "" for an empty file.

    Other kinds are told apart by their first word or bytes.

    Raises:
        OSError, ValueError: it cannot be read, or is not a regular file.
    """
    with open_regular(path) as file:
        head = file.read(_HEAD_BYTES)
        if (known := next((suffix for suffix, start in _KINDS.items() if re.match(start, head)), None)) is not None:
            return known
        if head.startswith(b"PK"):
            return ".npz" if _is_npz(file) else "a ZIP archive"
        if head.lstrip()[:1] in (b"{", b"["):
            file.seek(0)
            return ".json" if _is_json(file) else "text that is not JSON"
    decoder = codecs.getincrementaldecoder("utf8")("replace")  # the head may end within a character
    text = decoder.decode(head, final=len(head) < _HEAD_BYTES)
    if any(not (c.isprintable() or c.isspace()) or c == "\ufffd" for c in text):
        return f"data beginning with {head[:4].hex()}"
    first, comma, _ = text.partition("\n")[0].partition(",")
    return f"a table with the column {first[:40]!r}" if comma else "text" if text else ""


def suffix_kind(path: Path) -> str | None:
    """Return the kind of file that a suffix promises; None if it promises none."""
    return suffix if (suffix := path.suffix.lower()) in {*_KINDS, ".json", ".npz"} else None


def _is_npz(file: BufferedReader) -> bool:
    import zipfile  # noqa: PLC0415 (its import takes 8 ms, and few commands need it)

    try:
        with zipfile.ZipFile(file) as archive:
            return all(name.endswith(".npy") for name in archive.namelist())
    except Exception:  # zipfile raises any kind of exception on a damaged file
        return False


def _is_json(file: BufferedReader) -> bool:
    try:
        json.loads(file.read(MAX_TEXT_BYTES))
    except (ValueError, RecursionError):
        return False
    return True


def check_files_distinct(files: Iterable[tuple[str, Path]], description: str, remedy: str) -> None:
    """Check that no two images use the same file, with symbolic links resolved.

    Args:
        files: Pairs of an image name and one of its files.
        description: Kind of file, for the message.
        remedy: How to give each image its own file, for the message.
    Raises:
        ValueError: If two images share a file.
    """
    owner: dict[str, str] = {}
    for name, file in files:
        other = owner.setdefault(os.path.realpath(file), name)
        if other != name:
            raise InputError(
                f"images {other} and {name} would share the {description} {file}; give each its own file, {remedy}"
            )
