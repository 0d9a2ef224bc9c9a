"""Write-ahead journal for replacing several files or a folder, so that a crash in the middle can be completed.

A journal moves and deletes files, so `complete` follows only journals that the same user's programs wrote. Each is
signed with a key in the user's state folder. A folder received from somebody else cannot contain a valid signature.
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
_KEY_FILE, _KEY_BYTES, _MAX_JOURNAL_BYTES = "key", 32, 2**20


def write_journal(temporary: Path, steps: Mapping[str, Any]) -> Path:
    """Write the journal of the steps that are about to move files from a temporary folder into its parent.

    The journal itself is written atomically.

    Args:
        steps: `files`, `remove` and `overwrite`; or `place`, `new` and `old`. All names are without folders.
    """
    draft, journal = temporary / "steps.json", temporary / f"steps{SUFFIX}"
    text = json.dumps(steps)
    draft.write_text(f"{_signature(temporary, text)}\n{text}", "utf8")
    descriptor = os.open(draft, os.O_RDWR)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
    os.rename(draft, journal)
    return journal


def complete(temporary: Path) -> bool:
    """Complete or undo the steps of a journal; return False if this user did not write it.

    Without a journal, do nothing and return True.
    """
    journal = temporary / f"steps{SUFFIX}"
    if not os.path.lexists(journal):
        return True
    steps = _read(journal)
    if steps is None:
        warnings.warn(
            f"{temporary} holds files that another user or another machine was moving into {temporary.parent} when it "
            "was stopped. They are left unchanged; run that command there again, or delete the folder",
            stacklevel=2,
        )
        return False
    folder = temporary.parent
    if "place" in steps:
        target = folder / Path(steps["place"]).name
        for name in (steps["new"], steps["old"]):
            if not os.path.lexists(target) and (temporary / Path(name).name).exists():
                os.rename(temporary / Path(name).name, target)
        return True
    for name in (Path(name).name for name in steps["files"]):
        if (temporary / name).exists() and (steps["overwrite"] or not os.path.lexists(folder / name)):
            os.replace(temporary / name, folder / name)
    for name in steps["remove"]:
        (folder / Path(name).name).unlink(missing_ok=True)
    journal.unlink()
    return True


def _read(journal: Path) -> dict[str, Any] | None:
    """Return the steps of a journal; None if its signature is not valid."""
    if journal.is_symlink() or not journal.is_file() or journal.stat().st_size > _MAX_JOURNAL_BYTES:
        return None
    signature, _, text = journal.read_bytes().decode("utf8", "replace").partition("\n")
    valid = hmac.compare_digest(signature.encode(), _signature(journal.parent, text).encode())
    return json.loads(text) if valid else None


def _signature(temporary: Path, text: str) -> str:
    """Return the signature of a journal, which includes its path: moving a journal invalidates it."""
    message = f"{temporary.resolve()}\n{text}".encode("utf8", "surrogateescape")
    return hmac.new(_key(), message, "sha256").hexdigest()


@cache
def _key() -> bytes:
    """Return the user's key, created at its first use; a key for this process alone if it cannot be stored."""
    folder, new = state_folder(), secrets.token_bytes(_KEY_BYTES)
    if folder is None:
        return new
    with suppress(OSError):
        folder.mkdir(parents=True, exist_ok=True)
        path, draft = folder / _KEY_FILE, folder / f"{_KEY_FILE}.{secrets.token_hex(8)}"
        if not path.exists():
            descriptor = os.open(draft, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600)
            with os.fdopen(descriptor, "wb") as file:
                file.write(new)
            rename_new(draft, path)  # another process may have been faster
            draft.unlink(missing_ok=True)
        stored = path.read_bytes() if path.is_file() else b""
        if len(stored) == _KEY_BYTES and (os.name == "nt" or path.stat().st_uid == os.getuid()):
            return stored
    return new
