"""Checks of files before they are read, and of existing files before an output replaces them."""

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
"""Maximum size of a text file that is read, in bytes. Such files are usually much smaller."""


def open_regular(path: str | Path, *, max_bytes: int | None = None) -> BufferedReader:
    """Open a regular file for reading, without blocking on a pipe.

    Raises:
        FileNotFoundError: The file does not exist.
        ValueError: The path is a folder, a pipe or a device, or the file has more than `max_bytes` bytes.
    """
    try:
        file = open(path, "rb", opener=_open_at_once)  # noqa: SIM115 (the caller closes it)
    except IsADirectoryError:
        raise InputError(f"{path} is a folder, expected a regular file; replace it, or give another path") from None
    try:
        status = os.fstat(file.fileno())
        if not stat.S_ISREG(status.st_mode):
            raise InputError(f"{path} is not a regular file but a pipe or device; replace it, or give another path")
        if max_bytes is not None and status.st_size > max_bytes:
            raise InputError(f"{path} has {status.st_size:,} bytes, expected at most {max_bytes:,}; give another file")
    except BaseException:
        file.close()
        raise
    return file


def _open_at_once(path: str, flags: int) -> int:
    return os.open(path, flags | getattr(os, "O_NONBLOCK", 0))


def check_regular(path: str | Path, *, max_bytes: int | None = None) -> None:
    """Raise the errors of `open_regular` before another library opens a file."""
    open_regular(path, max_bytes=max_bytes).close()


def read_file(path: str | Path, *, max_bytes: int = MAX_TEXT_BYTES) -> bytes:
    """Return the content of a regular file, or raise the errors of `open_regular`."""
    with open_regular(path, max_bytes=max_bytes) as file:
        return file.read()


def read_text(path: Path, encoding: str = "utf8") -> str:
    """Return the text of a regular file with \\n as line endings.

    Raises:
        FileNotFoundError, ValueError: The errors of `open_regular`, or the file has another encoding.
    """
    return read_file(path).decode(encoding).replace("\r\n", "\n")  # a copy made on Windows may end lines with \r\n


# Outputs. Runs and data sets are recognized by their files; a command adds its own inputs with `protect_inputs`.


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
"""Kinds of folders, each with the entries that identify it and a pattern for all entries that belong to it."""
_KINDS = {
    ".ply": rb"ply\r?\n", ".png": rb"\x89PNG\r\n\x1a\n", ".npy": rb"\x93NUMPY", ".jpg": rb"\xff\xd8\xff",
    ".glb": rb"glTF", ".spz": rb"\x1f\x8b|NGSP",
    ".pdf": rb"%PDF-", ".safetensors": rb'(?s).{8}\{"', ".svg": rb"<\?xml[^>]*>\s*(<!DOCTYPE svg|<svg)|<svg",
}  # fmt: skip
"""Patterns for the first bytes of a file, by the suffix of its kind."""
_HEAD_BYTES = 1024
_inputs: set[str] = set()


def protect_inputs(*paths: Path | None) -> None:
    """Protect files, and all files in folders, against replacement by outputs of this command; ignore None."""
    _inputs.update(os.path.abspath(path) for path in paths if path is not None)


def forget_inputs() -> None:
    """Remove all protections of `protect_inputs`. Each command calls this function when it starts."""
    _inputs.clear()


def refuse_inputs(paths: Iterable[Path], *, instead: str = "path") -> None:
    """Raise if an output would replace an input, or a file of a run, a data set or a cache.

    A run is a folder with config.yml and nerfstudio_models/, or with the files of another trainer. Outputs must not
    replace its files or go into its folders. Outputs next to its files and new files in a data set are allowed.
    Commands call this function before they start their work.

    Args:
        instead: Flags for choosing another path, quoted in the error message.
    Raises:
        ValueError: An output, with links resolved, would replace such a file, or go into a run or its cache.

    >>> refuse_inputs([Path("answers.json")], instead="--output-json")
    """
    owners, inputs = cache(lambda folder: list(_owners(folder))), cache(_input_files)
    for path in paths:
        owner = _owner_of(os.path.realpath(path), owners, inputs)
        if owner is not None:
            raise InputError(f"{path} is {owner}, so it cannot be an output; give another {instead}")


def _owner_of(path: str, owners: Callable[[str], Iterable[Any]], inputs: Callable[[], Mapping[Any, str]]) -> str | None:
    """Return a description of a path that is an input or part of an input, run, data set or cache; None otherwise.

    Links in the path must already be resolved.
    """
    exists, folder = os.path.exists(path), os.path.dirname(path)
    for kind, parent, names in owners(folder):
        if (exists or kind == "run") and names.fullmatch(Path(path).relative_to(parent).parts[0]):
            return f"part of the {kind} {parent}"
    parts = Path(folder).parts
    if (exists and ".cache" in parts) or ("normlift", ".cache") in pairwise(parts):
        return f"part of the cache {folder}"
    statuses = map(os.stat, (path, *Path(path).parents) if exists else ())
    name = next(filter(None, (inputs().get((status.st_dev, status.st_ino)) for status in statuses)), None)
    return name and (f"part of the input folder {name}" if os.path.isdir(name) else f"the input file {name}")


def _owners(folder: str) -> Iterable[tuple[str, str, re.Pattern[str]]]:
    """Yield each run and data set that contains `folder`, as its kind, its path and a pattern of its entries."""
    for parent in (folder, *map(str, Path(folder).parents)):
        for kind, markers, names in _OWNERS:
            if all(os.path.exists(os.path.join(parent, marker)) for marker in markers):
                yield kind, parent, re.compile(names)


def _input_files() -> dict[tuple[int, int], str]:
    """Return the paths of existing inputs by device and inode, which identify a file regardless of links."""
    found = {}
    for name in filter(os.path.exists, _inputs):
        status = os.stat(name)
        found[status.st_dev, status.st_ino] = name
    return found


def refuse_other_kinds(path: Path, kind: str | None, flags: str = "") -> None:
    """Raise if an output would replace anything except an empty file or a regular file of its own kind.

    Args:
        path: Path of the output. If it does not exist, the function returns without a check.
        kind: Kind of the output, as `file_kind` returns it; None if it is not known yet; kinds are then not compared.
        flags: Flags for choosing the output, for the error message; empty if there are none.
    Raises:
        ValueError: `path` is a folder, a pipe, a device or a broken link, cannot be read, or is of a different kind.
    """
    if not os.path.lexists(path):
        return
    try:
        found = file_kind(path)
    except (OSError, InputError):
        output = f"{path}, given with {flags}," if flags else f"{path}"
        raise InputError(f"{output} is not a regular file, or cannot be read; give another name") from None
    if found != "" and kind is not None and kind != found:
        old, new = (f"a {name} file" if name.startswith(".") else name or "an empty file" for name in (found, kind))
        raise InputError(
            f"The content of {path} is {old}, but the output is {new}, and only a file of the same kind can be "
            "replaced; give another name, or delete the file"
        )


def file_kind(path: Path) -> str:
    """Return the kind of a file by its content: a suffix such as ".ply", or "" for an empty file.

    For other kinds, return a description, for instance with the first column of a table or the first bytes.

    Raises:
        OSError, ValueError: The file cannot be read, or is not a regular file.
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
    decoder = codecs.getincrementaldecoder("utf8")("replace")  # the head may end in the middle of a character
    text = decoder.decode(head, final=len(head) < _HEAD_BYTES)
    if any(not (c.isprintable() or c.isspace()) or c == "\ufffd" for c in text):
        return f"data beginning with {head[:4].hex()}"
    first, comma, _ = text.partition("\n")[0].partition(",")
    return f"a table with the column {first[:40]!r}" if comma else "text" if text else ""


def suffix_kind(path: Path) -> str | None:
    """Return the kind of a file, which is the suffix of its path in lowercase; None for an unknown suffix."""
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
    """Raise if two images use the same file, with symbolic links resolved.

    Args:
        files: Pairs of an image name and one of its files.
        description: Kind of file, for the error message.
        remedy: Advice on how to give each image its own file, for the error message.
    Raises:
        ValueError: Two images share a file.
    """
    owner: dict[str, str] = {}
    for name, file in files:
        other = owner.setdefault(os.path.realpath(file), name)
        if other != name:
            raise InputError(
                f"images {other} and {name} share the {description} {file}; give each image its own file, {remedy}"
            )
