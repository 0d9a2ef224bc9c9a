"""Output flags of all commands: `--quiet` and `--log-file`."""

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
    "Every command accepts --quiet (print results, warnings and errors, but no progress), --log-file FILE (append all "
    "output to this file, including the warnings of other packages) and --version."
)
_ESCAPES = re.compile(r"\x1b\[[0-9;?]*[A-Za-z]")
"""Terminal escape sequences that set colors or move the cursor."""


class Terminal(NamedTuple):
    """Output settings of a command."""

    quiet: bool = False
    log_file: Path | None = None


now = [Terminal()]
"""Stack of output settings; the last ones belong to the running command."""


def terminal_flags(words: Sequence[str]) -> tuple[list[str], Terminal]:
    """Split a command line into the words without output flags, and the output settings.

    Raises:
        InputError: --log-file has no file, or --quiet is neither True nor False.

    >>> terminal_flags(["--k", "8", "--quiet", "--log-file", "a.log"])
    (['--k', '8'], Terminal(quiet=True, log_file=PosixPath('a.log')))
    """
    rest, quiet, log_file = [], False, None
    indices = iter(range(len(words)))
    for i in indices:
        following = words[i + 1] if i + 1 < len(words) else "--"
        if words[i] == "--":  # the rest is for another command
            return [*rest, *words[i:]], Terminal(quiet, log_file)
        if words[i] == "--quiet":
            quiet = following != "False"
            if not following.startswith("-"):
                if following not in ("True", "False"):
                    raise InputError(f"--quiet must be True or False, got {following!r}")
                next(indices)
        elif words[i] in ("--log-file", "--log_file"):
            if following.startswith("--"):
                raise InputError("--log-file needs a file name")
            log_file = Path(following)
            next(indices)
        else:
            rest.append(words[i])
    return rest, Terminal(quiet, log_file)


@contextmanager
def talking(terminal: Terminal, command: str) -> Iterator[None]:
    """Apply output settings to everything that runs in this context.

    Raises:
        InputError: The log file cannot be written.
    """
    streams = sys.stdout, sys.stderr
    now.append(terminal)
    log = None
    try:
        if terminal.log_file is not None:
            log = _open_log(terminal.log_file)
            log.write(f"{datetime.now().astimezone().isoformat(timespec='seconds')} {command}\n")
            sys.stdout, sys.stderr = (_logged(stream, log) for stream in streams)
        yield
    finally:
        sys.stdout, sys.stderr = streams
        now.pop()
        if log is not None:
            log.close()


def log_line(text: str) -> None:
    """Write a line to the log file only, if there is one."""
    log = getattr(sys.stderr, "log", None)
    if log is not None:
        log.write(text)


def _open_log(path: Path) -> IO[str]:
    try:
        if path.exists() and not path.is_file():
            raise InputError(f"{path}, given with --log-file, exists and is not a regular file; give another name")
        return path.open("a", encoding="utf8", errors="backslashreplace")
    except OSError as error:
        raise InputError(f"{path}, given with --log-file, cannot be written: {error.strerror}") from error


class _LoggedStream:
    """A stream whose output also goes to a log file, without escape sequences."""

    def __init__(self, stream: IO[str], log: IO[str]) -> None:
        self._stream, self.log = stream, log

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)

    def write(self, text: str) -> int:
        self.log.write(_ESCAPES.sub("", text))
        return self._stream.write(text)


def _logged(stream: Any, log: IO[str]) -> Any:
    return None if stream is None else cast(Any, _LoggedStream(stream, log))
