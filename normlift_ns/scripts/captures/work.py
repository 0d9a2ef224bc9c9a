"""What one worker does of a list of captures, beside others that may do the same."""

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

CLAIMS, LOGS = "claims", "logs"
"""Folders in that of the results."""


def work(
    captures: Sequence[Capture],
    folder: Path,
    patience: float,
    *,
    say: Callable[[str], None] = lambda text: None,
    program: Sequence[str] = LIFT,
) -> dict[str, Outcome]:
    """Lifts the captures that are not lifted yet and that no other worker lifts; returns the outcomes by key.

    Args:
        folder: of claims and results, which the workers share; made if missing.
        patience: seconds without a heartbeat after which a worker counts as dead; the same for all of them.
        say: called with a line for every capture.
        program: ns-normlift.
    Raises:
        OSError: the folder cannot be written.
    """
    worker = f"{file_name(socket.gethostname())}_{os.getpid()}_{secrets.token_hex(4)}"
    for inside in (CLAIMS, LOGS):
        (folder / inside).mkdir(parents=True, exist_ok=True)
    at_start, before = read_states(folder / CLAIMS), latest(read_lines(folder, Outcome))
    missing = {capture.key: capture for capture in captures if not _is_complete(capture, before)}
    for claim in claims(folder / CLAIMS, list(missing), at_start, patience):
        capture = missing[claim.key]
        try:
            say(f"{capture.name} …")
            outcome = _outcome(capture, claim, folder, patience, worker, program)
        except BaseException:
            end(claim, LEFT)
            raise
        if outcome is None:
            say(f"{capture.name}: left to another worker, which took this one for dead")
            continue
        append_line(folder / f"{worker}{SUFFIX}", outcome)
        end(claim, outcome.state)
        told = {"done": "lifted", "skipped": "lifted already", "failed": f"failed: {outcome.message}"}
        say(f"{capture.name}: {told[outcome.state]} ({outcome.seconds:.1f} s)")
    return latest(read_lines(folder, Outcome))


def _is_complete(capture: Capture, before: dict[str, Outcome]) -> bool:
    """Whether nothing is left to do: the capture is lifted, and a line of JSON says so."""
    known = before.get(capture.key)
    if known is None or known.state == "failed":
        return False
    try:
        return capture.run is None or is_lifted(capture.run)
    except InputError:  # told when it is its turn
        return False


def _outcome(
    capture: Capture, claim: Claim, folder: Path, patience: float, worker: str, program: Sequence[str]
) -> Outcome | None:
    """Lifts a capture unless it is lifted; None where another worker has taken over."""
    begun, log = time.monotonic(), folder / LOGS / f"{claim.path.name}.log"

    def told(state: OutcomeState, message: str = "", code: int = 0) -> Outcome:
        run = None if capture.run is None or state == "failed" else str(capture.run)
        seconds, now = time.monotonic() - begun, time.time()
        return Outcome(capture.name, capture.key, claim.number, state, seconds, message, code, run, worker, now)

    try:
        if capture.run is not None and is_lifted(capture.run):
            return told("skipped")
        beats = count(1)
        code = run_program([*program, *capture.words], log, lambda: beat(claim, next(beats)), patience / BEATS)
        if code is None:
            return None
        if code == 0:
            return told("done")
        if capture.run is not None and is_lifted(capture.run):  # by a worker that was taken for dead
            return told("skipped")
    except InputError as error:
        return told("failed", str(error), 1)
    return told("failed", why(code, log), code if code > 0 else 128 - code)
