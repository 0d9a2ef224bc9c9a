"""What is said of an error: the user's mistakes and full disks as they are, ours with a log file to report."""

from __future__ import annotations

import os
import platform
import secrets
import sys
import tempfile
import time
import traceback
from contextlib import suppress
from pathlib import Path

from normlift_ns.errors import InputError, visible

USER, OURS = 1, 70
"""Exit codes; 70 is EX_SOFTWARE of sysexits.h."""
_LONGEST = 300


def explain(error: BaseException) -> tuple[str, int]:
    """What to tell the user of an error, and the exit code of a command that it ends.

    The traceback of an error that nobody foresaw goes to a log file.

    >>> explain(InputError("beta must be positive, got -1"))
    ('beta must be positive, got -1', 1)
    """
    if isinstance(error, InputError):
        return str(error), USER
    if isinstance(error, OSError):
        named = error.filename is not None and error.strerror is not None
        return (f"{error.filename}: {error.strerror}" if named else error.strerror or str(error)), USER
    if isinstance(error, MemoryError):
        return str(error) or "the memory is full; lift fewer or smaller views: --max-views, --lift-downscale", USER
    if type(error).__name__ == "OutOfMemoryError":  # torch's, which is not imported for this
        return f"the GPU's memory is full ({_first_line(error)}); work on the CPU: --device cpu", USER
    if isinstance(error, RuntimeError) and "Numpy is not available" in str(error):
        return "this torch was built for NumPy 1, and NumPy 2 is installed; type: pip install 'numpy<2'", USER
    return _bug(error), OURS


def _first_line(error: BaseException) -> str:
    return next(iter(str(error).strip().splitlines()), "")[:_LONGEST]


def _bug(error: BaseException) -> str:
    what = f"{type(error).__name__}: {_first_line(error)}".removesuffix(": ")
    log = log_traceback(error)
    if log is None:
        traceback.print_exception(error)
    where = "above" if log is None else f"in {log}"
    return (
        f"This is a bug of normlift_ns: {what}. The details are {where}; please report it at the project's issue "
        "tracker, with them."
    )


def log_traceback(error: BaseException) -> Path | None:
    """Writes a traceback to a new file that only the user can read; None where no folder takes it."""
    text = "".join(traceback.format_exception(error))
    facts = f"Python {platform.python_version()}, {platform.platform()}\n{visible(' '.join(sys.argv))}\n\n"
    name = f"{time.strftime('%Y-%m-%d_%H%M%S')}_{os.getpid()}_{secrets.token_hex(4)}.log"
    for folder in _folders():
        with suppress(OSError, ValueError):
            folder.mkdir(parents=True, exist_ok=True)
            path = folder / name
            descriptor = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600)
            with os.fdopen(descriptor, "w", encoding="utf8", errors="backslashreplace") as file:
                file.write(facts + text)
            return path
    return None


def _folders() -> list[Path]:
    """Where log files may go, the best first."""
    found = [folder] if (folder := state_folder()) is not None else []
    with suppress(OSError):  # no folder for temporary files
        found.append(Path(tempfile.gettempdir()))
    return found


def state_folder() -> Path | None:
    """Where a user's programs keep what they remember; it may not be there yet. None: a user without a home."""
    state = Path(os.environ.get("XDG_STATE_HOME", ""))
    with suppress(RuntimeError):
        return (state if state.is_absolute() else Path.home() / ".local" / "state") / "normlift_ns"
    return None
