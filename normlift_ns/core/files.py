"""Writing files completely or not at all."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path


@contextmanager
def atomic_path(path: Path) -> Iterator[Path]:
    """Yields a temporary name beside `path`; renames it to `path` on success, removes it on any failure, Ctrl-C
    included.
    """
    temporary = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    try:
        yield temporary
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)


def file_name(text: str) -> str:
    """A text as part of a file name: letters and digits stay, 40 characters at most.

    >>> file_name("../tea pot")
    '___tea_pot'
    """
    return "".join(c if c.isalnum() else "_" for c in text[:40])


def free_path(path: Path) -> Path:
    """The path, or the first of path_2, path_3, … that does not exist yet."""
    number, found = 1, path
    while found.exists():
        number += 1
        found = path.with_name(f"{path.stem}_{number}{path.suffix}")
    return found
