"""Finished parts of a long run, one JSON line each: a run that was stopped goes on where it was."""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Any


class RowsError(ValueError):
    """A file of rows that cannot be gone on with."""


def read_rows(path: Path, run: dict[str, Any]) -> list[dict[str, Any]]:
    """The rows in a file that is made if there is none; a half-written last line is cut off.

    Args:
        run: what all rows must have in common, the first line of the file.
    Raises:
        RowsError: rows of another run, or a damaged line that is not the last.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    content = path.read_bytes() if path.exists() else b""
    whole = content[: content.rfind(b"\n") + 1]
    if len(whole) < len(content):
        os.truncate(path, len(whole))
    lines = whole.decode().splitlines()
    if len(lines) == 0:
        append(path, run)
        return []
    found: list[dict[str, Any]] = []
    for number, line in enumerate(lines, start=1):
        try:
            found.append(json.loads(line))
        except json.JSONDecodeError as error:
            raise RowsError(f"{path}, line {number} is no JSON ({error}); delete the line, or the file") from error
    if found[0] != json.loads(json.dumps(run)):
        raise RowsError(
            f"{path} holds rows of another run, {json.dumps(found[0])[:300]}; expected {json.dumps(run)[:300]}; give "
            "another file: --rows PATH"
        )
    return found[1:]


def append(path: Path, row: dict[str, Any]) -> None:
    """Adds a line in one piece, whoever else writes."""
    line = (json.dumps(row) + "\n").encode()
    file = os.open(path, os.O_WRONLY | os.O_APPEND | os.O_CREAT, 0o644)
    try:
        written = os.write(file, line)
        assert written == len(line), (written, len(line))
    finally:
        os.close(file)
