"""One capture in a process of its own."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from collections.abc import Callable, Sequence
from pathlib import Path

from normlift_ns.team.launch import TEAM, bound

LIFT = (sys.executable, "-m", "normlift_ns.scripts.lift")
"""ns-normlift of this very installation."""
_GRACE = 30.0
"""Seconds between asking a process to end and ending it."""
_TAIL = 2**14


def run_program(words: Sequence[str], log: Path, beat: Callable[[], bool], every: float) -> int | None:
    """Runs a program, with all that it prints in a new file; returns its exit code, or minus the signal that ended it.

    On Linux it ends with this process, however that ends; elsewhere only Ctrl-C and SIGTERM reach it.

    Args:
        beat: called every so many seconds; when it returns False, the program is ended, and the result is None.
    Raises:
        OSError: the program cannot be started, or the file not be written.
    """
    alone = {name: value for name, value in os.environ.items() if name not in TEAM}
    environment = alone | {"PYTHONUNBUFFERED": "1", "PYTHONIOENCODING": "utf-8"}  # its last line is its last word
    with (
        log.open("wb") as output,
        subprocess.Popen(
            words,
            stdin=subprocess.DEVNULL,
            stdout=output,
            stderr=subprocess.STDOUT,
            env=environment,
            preexec_fn=bound(),  # noqa: PLW1509 (workers have no threads)
        ) as process,
    ):
        try:
            while True:
                try:
                    return process.wait(every)
                except subprocess.TimeoutExpired:
                    if not beat():
                        _end(process)
                        return None
        except BaseException:  # Ctrl-C or SIGTERM
            _end(process)
            raise


def why(code: int, log: Path) -> str:
    """Why a process failed: the signal that ended it, or the last line that it printed."""
    if code < 0:
        name = signal.Signals(-code).name if -code in set(signal.Signals) else f"signal {-code}"
        hint = ", perhaps by the system for want of memory" if -code == signal.SIGKILL else ""
        return f"its process was ended by {name}{hint}; {log} has what it said before"
    with log.open("rb") as file:
        file.seek(max(0, log.stat().st_size - _TAIL))
        lines = file.read().decode("utf8", "replace").split("\n")
    last = next((line.strip() for line in reversed(lines) if line.strip() != ""), "")
    return last or f"its process ended with exit code {code} and without a word"


def _end(process: subprocess.Popen[bytes]) -> None:
    process.terminate()
    try:
        process.wait(_GRACE)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()
