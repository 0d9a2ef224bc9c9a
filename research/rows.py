"""Finished parts of a long run, one JSON line each, so that an interrupted run can continue."""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Any


class RowsError(ValueError):
    """Error for a file of rows that cannot be continued."""


def read_rows(path: Path, run: dict[str, Any]) -> list[dict[str, Any]]:
    """Return the rows of a file, which is created if it does not exist. An incomplete last line is removed.

    Args:
        run: Settings that all rows share, which are the first line of the file.
    Raises:
        RowsError: If the rows are from another run, or a complete line is damaged.
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
            raise RowsError(
                f"{path}, line {number} is not valid JSON ({error}); delete the line, or the file"
            ) from error
    if found[0] != json.loads(json.dumps(run)):
        raise RowsError(
            f"{path} contains rows of another run, {json.dumps(found[0])[:300]}; expected {json.dumps(run)[:300]}; "
            "give another file: --rows PATH"
        )
    return found[1:]


def append(path: Path, row: dict[str, Any]) -> None:
    """Add a line in a single write, so that several processes can add lines."""
    line = (json.dumps(row) + "\n").encode()
    file = os.open(path, os.O_WRONLY | os.O_APPEND | os.O_CREAT, 0o644)
    try:
        written = os.write(file, line)
        assert written == len(line), (written, len(line))
    finally:
        os.close(file)
