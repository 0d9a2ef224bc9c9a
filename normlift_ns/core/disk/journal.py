"""What is under way when several files, or a folder, take their places: a journal that completes it after a crash.

A journal moves and deletes files, so only one that this user's programs have written is followed: it is signed with a
key that stands in the user's own state folder. Whoever sends a folder to somebody can sign none for them.
"""

from __future__ import annotations

import hmac
import json
import os
import secrets
import warnings
from collections.abc import Mapping
from contextlib import suppress
from functools import cache
from pathlib import Path
from typing import Any

from normlift_ns.core.disk.atomic import rename_new
from normlift_ns.crash import state_folder

SUFFIX = ".journal"
_KEY, _KEY_BYTES, _LARGEST = "key", 32, 2**20


def write_journal(temporary: Path, steps: Mapping[str, Any]) -> Path:
    """Says what is about to happen to the folder of a temporary one; the journal is there whole, or not at all.

    Args:
        steps: `files`, `remove` and `overwrite`; or `place`, `new` and `old`. Names, without folders.
    """
    unfinished, journal = temporary / "steps.json", temporary / f"steps{SUFFIX}"
    text = json.dumps(steps)
    unfinished.write_text(f"{_signature(temporary, text)}\n{text}", "utf8")
    descriptor = os.open(unfinished, os.O_RDWR)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
    os.rename(unfinished, journal)
    return journal


def complete(temporary: Path) -> bool:
    """Completes, or undoes, what a journal says is under way; False where there is one that this user did not begin."""
    journal = temporary / f"steps{SUFFIX}"
    if not os.path.lexists(journal):
        return True
    steps = _read(journal)
    if steps is None:
        warnings.warn(
            f"{temporary} holds files that another user, or another machine, was putting into {temporary.parent} when "
            "it was stopped. They are left alone; run the same command there again, or delete that folder",
            stacklevel=2,
        )
        return False
    folder = temporary.parent
    if "place" in steps:
        place = folder / Path(steps["place"]).name
        for name in (steps["new"], steps["old"]):
            if not os.path.lexists(place) and (temporary / Path(name).name).exists():
                os.rename(temporary / Path(name).name, place)
        return True
    for name in (Path(name).name for name in steps["files"]):
        if (temporary / name).exists() and (steps["overwrite"] or not os.path.lexists(folder / name)):
            os.replace(temporary / name, folder / name)
    for name in steps["remove"]:
        (folder / Path(name).name).unlink(missing_ok=True)
    journal.unlink()
    return True


def _read(journal: Path) -> dict[str, Any] | None:
    """The steps of a journal of ours."""
    if journal.is_symlink() or not journal.is_file() or journal.stat().st_size > _LARGEST:
        return None
    signature, _, text = journal.read_bytes().decode("utf8", "replace").partition("\n")
    same = hmac.compare_digest(signature.encode(), _signature(journal.parent, text).encode())
    return json.loads(text) if same else None


def _signature(temporary: Path, text: str) -> str:
    """Of the steps in one place: a journal that was moved is no journal any more."""
    message = f"{temporary.resolve()}\n{text}".encode("utf8", "surrogateescape")
    return hmac.new(_key(), message, "sha256").hexdigest()


@cache
def _key() -> bytes:
    """The user's key, made at its first use; where there is no place for one, a key of this process."""
    folder, new = state_folder(), secrets.token_bytes(_KEY_BYTES)
    if folder is None:
        return new
    with suppress(OSError):
        folder.mkdir(parents=True, exist_ok=True)
        path, draft = folder / _KEY, folder / f"{_KEY}.{secrets.token_hex(8)}"
        if not path.exists():
            descriptor = os.open(draft, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600)
            with os.fdopen(descriptor, "wb") as file:
                file.write(new)
            rename_new(draft, path)  # another process may have been faster
            draft.unlink(missing_ok=True)
        found = path.read_bytes() if path.is_file() else b""
        if len(found) == _KEY_BYTES and (os.name == "nt" or path.stat().st_uid == os.getuid()):
            return found
    return new
