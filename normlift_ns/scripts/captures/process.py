"""Child processes that lift one capture each."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from collections.abc import Callable, Sequence
from pathlib import Path

from normlift_ns.team.launch import TEAM, bound

LIFT = (sys.executable, "-m", "normlift_ns.scripts.lift")
"""Command of ns-normlift in this installation."""
_GRACE = 30.0
"""Seconds between terminating a process and killing it."""
_TAIL = 2**14
"""Number of bytes at the end of a log file that may contain its last line."""


def run_program(words: Sequence[str], log: Path, beat: Callable[[], bool], every: float) -> int | None:
    """Run a program with its output in a log file; return its exit code, or minus the signal that killed it.

    On Linux, the program ends whenever this process ends; elsewhere, only after Ctrl-C and SIGTERM.

    Args:
        words: Command line of the program.
        log: New file for its output.
        beat: Callback; if it returns False, the program is terminated and the result is None.
        every: Seconds between two calls of `beat`.
    Raises:
        OSError: The program cannot be started, or the log cannot be written.
    """
    inherited = {name: value for name, value in os.environ.items() if name not in TEAM}
    environment = inherited | {"PYTHONUNBUFFERED": "1", "PYTHONIOENCODING": "utf-8"}  # keeps the last line complete
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
                        _terminate(process)
                        return None
        except BaseException:  # Ctrl-C or SIGTERM
            _terminate(process)
            raise


def why(code: int, log: Path) -> str:
    """Return why a process failed: the signal that killed it, or the last line that it printed."""
    if code < 0:
        name = signal.Signals(-code).name if -code in set(signal.Signals) else f"signal {-code}"
        hint = ", perhaps because the system ran out of memory" if -code == signal.SIGKILL else ""
        return f"its process was killed by {name}{hint}; see its output in {log}"
    with log.open("rb") as file:
        file.seek(max(0, log.stat().st_size - _TAIL))
        lines = file.read().decode("utf8", "replace").split("\n")
    last = next((line.strip() for line in reversed(lines) if line.strip() != ""), "")
    return last or f"its process ended with exit code {code} and without output"


def _terminate(process: subprocess.Popen[bytes]) -> None:
    process.terminate()
    try:
        process.wait(_GRACE)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()
