"""Worker that lifts captures of a list, possibly alongside other workers."""

from __future__ import annotations

import os
import secrets
import socket
import time
from collections.abc import Callable, Sequence
from itertools import count
from pathlib import Path

from normlift_ns.core.disk.claims import BEATS, LEFT, Claim, beat, claims, end, read_states
from normlift_ns.core.disk.lines import SUFFIX, append_line, read_lines
from normlift_ns.core.files import file_name
from normlift_ns.errors import InputError
from normlift_ns.scripts.captures.listed import Capture, is_lifted
from normlift_ns.scripts.captures.outcomes import Outcome, OutcomeState, latest
from normlift_ns.scripts.captures.process import LIFT, run_program, why

_CLAIMS, _LOGS = "claims", "logs"
"""Subfolders of the results folder."""


def work(
    captures: Sequence[Capture],
    folder: Path,
    patience: float,
    *,
    say: Callable[[str], None] = lambda text: None,
    program: Sequence[str] = LIFT,
) -> dict[str, Outcome]:
    """Lift the captures that are neither lifted nor claimed by another worker; return the outcomes by key.

    Args:
        captures: The captures of this worker.
        folder: Folder of claims and results, which all workers share; created if missing.
        patience: Seconds without a heartbeat after which a worker counts as dead; the same for all workers.
        say: Callback for messages about each capture.
        program: Command of ns-normlift.
    Raises:
        OSError: The folder cannot be written.
    """
    worker = f"{file_name(socket.gethostname())}_{os.getpid()}_{secrets.token_hex(4)}"
    for name in (_CLAIMS, _LOGS):
        (folder / name).mkdir(parents=True, exist_ok=True)
    at_start, previous = read_states(folder / _CLAIMS), latest(read_lines(folder, Outcome))
    missing = {capture.key: capture for capture in captures if not _is_complete(capture, previous)}
    for claim in claims(folder / _CLAIMS, list(missing), at_start, patience):
        capture = missing[claim.key]
        try:
            say(f"{capture.name} …")
            outcome = _lift_capture(capture, claim, folder, patience, worker, program)
        except BaseException:
            end(claim, LEFT)
            raise
        if outcome is None:
            say(f"{capture.name}: taken over by another worker, which missed the heartbeats of this one")
            continue
        append_line(folder / f"{worker}{SUFFIX}", outcome)
        end(claim, outcome.state)
        results = {"done": "lifted", "skipped": "already lifted", "failed": f"failed: {outcome.message}"}
        say(f"{capture.name}: {results[outcome.state]} ({outcome.seconds:.1f} s)")
    return latest(read_lines(folder, Outcome))


def _is_complete(capture: Capture, outcomes: dict[str, Outcome]) -> bool:
    """Return whether a capture is lifted and has a result that says so."""
    outcome = outcomes.get(capture.key)
    if outcome is None or outcome.state == "failed":
        return False
    try:
        return capture.run is None or is_lifted(capture.run)
    except InputError:  # reported when the capture is processed
        return False


def _lift_capture(
    capture: Capture, claim: Claim, folder: Path, patience: float, worker: str, program: Sequence[str]
) -> Outcome | None:
    """Lift a capture unless it is already lifted; return None if another worker has taken over."""
    start_time, log = time.monotonic(), folder / _LOGS / f"{claim.path.name}.log"

    def outcome(state: OutcomeState, message: str = "", code: int = 0) -> Outcome:
        run = None if capture.run is None or state == "failed" else str(capture.run)
        seconds, now = time.monotonic() - start_time, time.time()
        return Outcome(capture.name, capture.key, claim.number, state, seconds, message, code, run, worker, now)

    try:
        if capture.run is not None and is_lifted(capture.run):
            return outcome("skipped")
        beats = count(1)
        code = run_program([*program, *capture.words], log, lambda: beat(claim, next(beats)), patience / BEATS)
        if code is None:
            return None
        if code == 0:
            return outcome("done")
        if capture.run is not None and is_lifted(capture.run):  # by a worker that was considered dead
            return outcome("skipped")
    except InputError as error:
        return outcome("failed", str(error), 1)
    return outcome("failed", why(code, log), code if code > 0 else 128 - code)
