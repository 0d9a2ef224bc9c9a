"""Flags of all commands that say what is printed where: `--quiet` and `--log-file`."""

from __future__ import annotations

import re
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from datetime import datetime
from pathlib import Path
from typing import IO, Any, NamedTuple, cast

from normlift_ns.errors import InputError

FLAGS = (
    "Every command knows --quiet (no progress, only results, warnings and errors), --log-file FILE (what is printed is "
    "added to that file too, with what other packages warn of) and --version."
)
_CODES = re.compile(r"\x1b\[[0-9;?]*[A-Za-z]")
"""What colours a text in a terminal, or moves the cursor there."""


class Terminal(NamedTuple):
    """How a command talks."""

    quiet: bool = False
    log_file: Path | None = None


now = [Terminal()]
"""That of the command that runs; the last one."""


def terminal_flags(words: Sequence[str]) -> tuple[list[str], Terminal]:
    """The words of a command line without the flags of the terminal, and these.

    Raises:
        InputError: --log-file without a file, or --quiet with something that is neither True nor False.

    >>> terminal_flags(["--k", "8", "--quiet", "--log-file", "a.log"])
    (['--k', '8'], Terminal(quiet=True, log_file=PosixPath('a.log')))
    """
    rest, quiet, log_file = [], False, None
    given = iter(range(len(words)))
    for i in given:
        following = words[i + 1] if i + 1 < len(words) else "--"
        if words[i] == "--":  # the rest is for another command
            return [*rest, *words[i:]], Terminal(quiet, log_file)
        if words[i] == "--quiet":
            quiet = following != "False"
            if not following.startswith("-"):
                if following not in ("True", "False"):
                    raise InputError(f"--quiet is True or False, got {following!r}")
                next(given)
        elif words[i] in ("--log-file", "--log_file"):
            if following.startswith("--"):
                raise InputError("--log-file needs the name of a file")
            log_file = Path(following)
            next(given)
        else:
            rest.append(words[i])
    return rest, Terminal(quiet, log_file)


@contextmanager
def talking(terminal: Terminal, command: str) -> Iterator[None]:
    """What runs within prints as the terminal's flags say.

    Raises:
        InputError: the log file cannot be written.
    """
    streams = sys.stdout, sys.stderr
    now.append(terminal)
    log = None
    try:
        if terminal.log_file is not None:
            log = _opened(terminal.log_file)
            log.write(f"{datetime.now().astimezone().isoformat(timespec='seconds')} {command}\n")
            sys.stdout, sys.stderr = (_both(stream, log) for stream in streams)
        yield
    finally:
        sys.stdout, sys.stderr = streams
        now.pop()
        if log is not None:
            log.close()


def log_line(text: str) -> None:
    """A line for the log file alone, where there is one."""
    log = getattr(sys.stderr, "log", None)
    if log is not None:
        log.write(text)


def _opened(path: Path) -> IO[str]:
    try:
        if path.exists() and not path.is_file():
            raise InputError(f"{path}, given with --log-file, is there and is no file; give another name")
        return path.open("a", encoding="utf8", errors="backslashreplace")
    except OSError as error:
        raise InputError(f"{path}, given with --log-file, cannot be written: {error.strerror}") from error


class _Both:
    """A stream, and a file that gets the same without colours."""

    def __init__(self, stream: IO[str], log: IO[str]) -> None:
        self._stream, self.log = stream, log

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)

    def write(self, text: str) -> int:
        self.log.write(_CODES.sub("", text))
        return self._stream.write(text)


def _both(stream: Any, log: IO[str]) -> Any:
    return None if stream is None else cast(Any, _Both(stream, log))
