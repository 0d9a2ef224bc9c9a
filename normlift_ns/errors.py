"""Exceptions for user errors, messages and exit codes for all errors, and crash logs for internal errors."""

from __future__ import annotations

import os
import platform
import re
import secrets
import sys
import tempfile
import time
import traceback
from contextlib import suppress
from pathlib import Path


class InputError(ValueError):
    """Error for an invalid file or argument.

    The message names the file or argument, what was found, what was expected and what to do. Missing files raise
    `FileNotFoundError` instead, files that cannot be written raise `OSError`, and full memory raises `MemoryError`.
    The docstring of `describe_error` lists the kinds of user errors.

    >>> from normlift_ns import InputError, LiftOptions
    >>> try:
    ...     LiftOptions(max_views=0)
    ... except InputError as error:
    ...     print(error)
    max_views must be at least 1, got 0
    """


class ArgumentError(InputError, TypeError):
    """InputError for an argument of the wrong type; also a TypeError, as in Python's own functions."""


class PathError(InputError, OSError):
    """InputError for a path that is not valid for any file; also an OSError, as in Python's own functions."""


def json_type(value: object) -> str:
    """Return the JSON type of a value for error messages, with an article.

    >>> json_type([1, 2]), json_type(None)
    ('a list', 'null')
    """
    names = ((bool, "true or false"), (str, "a string"), (list, "a list"), (dict, "an object"), (type(None), "null"))
    return next((name for kind, name in names if isinstance(value, kind)), "a number")


class MissingImageError(InputError, KeyError, IndexError):
    """InputError for a training image that does not exist; also a KeyError and an IndexError."""

    __str__ = Exception.__str__  # KeyError would quote the message


class OutputError(Exception):
    """Error for a failed write to standard output.

    It is not an OSError, because loaders report an OSError as a read error.
    """


def escape_unprintable(text: str, keep: str = "") -> str:
    r"""Escape unprintable characters, which could move the cursor, hide text or reverse it.

    Args:
        text: Untrusted text, such as a prompt or a path.
        keep: Unprintable characters to keep, for example a line break.

    >>> print(escape_unprintable("red\x1b[31m mug\n"))
    red\x1b[31m mug\n
    """
    return "".join(
        c if c.isprintable() or c in keep else c.encode("unicode_escape", "surrogatepass").decode() for c in text
    )


_MAX_SUMMARY = 300


def truncate_text(text: str, max_length: int = 40) -> str:
    """Shorten text to at most `max_length` characters, with an ellipsis if anything is cut off.

    >>> truncate_text("a red bowl", 8)
    'a red b…'
    """
    return text if len(text) <= max_length else text[: max_length - 1] + "…"


def summarize_error(error: BaseException) -> str:
    """Return the type and the first line of another package's error, to quote in a message.

    If the first line ends with a colon, the second line follows. The result is cut after 300 characters.
    """
    lines = [line.strip() for line in str(error).strip().splitlines()]
    lines = lines[: 2 if len(lines) > 0 and lines[0].endswith(":") else 1]
    text = " ".join([f"{type(error).__name__}:", *lines]) if len(lines) > 0 else type(error).__name__
    return text if len(text) <= _MAX_SUMMARY else text[:_MAX_SUMMARY] + " ..."


EXIT_USER_ERROR, EXIT_INTERNAL_ERROR = 1, 70
"""Exit codes for user errors and internal errors. 70 is EX_SOFTWARE in sysexits.h."""


def describe_error(error: BaseException) -> tuple[str, int]:
    """Return the message for the user and the exit code of a command that fails with this error.

    User errors are `InputError`, `OSError`, full memory, and a torch that was built for another NumPy. For all others,
    which are internal errors, the traceback is also written to a log file, or printed if that fails.

    >>> describe_error(InputError("beta must be positive, got -1"))
    ('beta must be positive, got -1', 1)
    """
    message = _user_message(error)
    return (_report_bug(error), EXIT_INTERNAL_ERROR) if message is None else (message, EXIT_USER_ERROR)


_NO_MEMORY = re.compile(r"DefaultCPUAllocator|can't allocate memory|can't start new thread|std::bad_alloc")
"""Parts of messages with which torch and Python usually report full memory."""


def _user_message(error: BaseException) -> str | None:
    """Return the message of a user error; None for an internal error."""
    if isinstance(error, InputError):
        return str(error)
    if isinstance(error, OSError):
        named = error.filename is not None and error.strerror is not None
        return f"{error.filename}: {error.strerror}" if named else error.strerror or str(error)
    if isinstance(error, MemoryError) or (isinstance(error, RuntimeError) and _NO_MEMORY.search(str(error))):
        own = str(error) if type(error) is MemoryError else ""
        advice = "close other programs, or, for a lift, increase --lift-downscale or reduce --max-views"
        return own or f"the memory is full; {advice}"
    if type(error).__name__ == "OutOfMemoryError":  # torch's class, without importing torch
        return f"the GPU's memory is full ({_first_line(error)}); use the CPU: --device cpu"
    if isinstance(error, RuntimeError) and "Numpy is not available" in str(error):
        return "this torch was built for NumPy 1, but NumPy 2 is installed; run: pip install 'numpy<2'"
    return None


def _first_line(error: BaseException) -> str:
    return next(iter(str(error).strip().splitlines()), "")[:_MAX_SUMMARY]


def _report_bug(error: BaseException) -> str:
    """Log the traceback, or print it if no log file can be written; return the message for the user."""
    summary = f"{type(error).__name__}: {_first_line(error)}".removesuffix(": ")
    log = log_traceback(error)
    if log is None:
        traceback.print_exception(error)
    location = "printed above" if log is None else f"in {log}"
    return (
        f"This is a bug in normlift_ns: {summary}. The details are {location}; please include them in a report to the "
        "project's issue tracker."
    )


def log_traceback(error: BaseException) -> Path | None:
    """Write a traceback to a new file that only the user can read, and return its path; None if that fails."""
    text = "".join(traceback.format_exception(error))
    header = f"Python {platform.python_version()}, {platform.platform()}\n{escape_unprintable(' '.join(sys.argv))}\n\n"
    name = f"{time.strftime('%Y-%m-%d_%H%M%S')}_{os.getpid()}_{secrets.token_hex(4)}.log"
    for folder in _log_folders():
        with suppress(OSError, ValueError):
            folder.mkdir(parents=True, exist_ok=True)
            path = folder / name
            descriptor = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600)
            with os.fdopen(descriptor, "w", encoding="utf8", errors="backslashreplace") as file:
                file.write(header + text)
            return path
    return None


def _log_folders() -> list[Path]:
    """Return the candidate folders for log files, in order of preference."""
    folders = [folder] if (folder := user_state_folder()) is not None else []
    with suppress(OSError):  # no folder for temporary files
        folders.append(Path(tempfile.gettempdir()))
    return folders


def user_state_folder() -> Path | None:
    """Return this program's folder for user state, which may not exist yet; None if it is unknown."""
    state = Path(os.environ.get("XDG_STATE_HOME", ""))
    with suppress(RuntimeError):
        return (state if state.is_absolute() else Path.home() / ".local" / "state") / "normlift_ns"
    return None
