"""JSON Lines files: each process appends to a file of its own, and readers read all files of a folder."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any, TypeVar

import msgspec

SUFFIX = ".jsonl"
_Line = TypeVar("_Line")


def append_line(path: Path, line: Any) -> None:
    """Append a line, with a single write, and wait until it is on the disk.

    Args:
        path: a file that no other process writes.
        line: a dataclass instance or other value that msgspec encodes as JSON.
    Raises:
        OSError: the file cannot be written.
    """
    descriptor = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_APPEND, 0o666)
    with os.fdopen(descriptor, "wb", buffering=0) as file:
        file.write(msgspec.json.encode(line) + b"\n")
        os.fsync(descriptor)


def read_lines(folder: Path, kind: type[_Line]) -> list[_Line]:
    """Return the lines of all .jsonl files in a folder, file by file in the order of their names.

    Lines that do not decode as `kind` are skipped: a process that is killed may leave an incomplete one.

    >>> import tempfile
    >>> folder = Path(tempfile.mkdtemp())
    >>> append_line(folder / "one.jsonl", {"fox": 1})
    >>> _ = (folder / "two.jsonl").write_text('{"fox": 2}\\n{"fo')
    >>> read_lines(folder, dict)
    [{'fox': 1}, {'fox': 2}]
    """
    lines = []
    for path in sorted(folder.glob(f"*{SUFFIX}")):
        for line in path.read_bytes().splitlines():
            try:
                lines.append(msgspec.json.decode(line, type=kind))
            except (msgspec.MsgspecError, UnicodeDecodeError, RecursionError):
                continue
    return lines
