"""Results of captures: one line of JSON each, and a table."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

from rich.table import Table

from normlift_ns.scripts.captures.listed import Capture
from normlift_ns.scripts.shared import plain

OutcomeState = Literal["done", "failed", "skipped"]


@dataclass(frozen=True)
class Outcome:
    """Result of one attempt at a capture."""

    capture: str
    """Line of the capture in the list."""
    key: str
    """Digest of scene and options."""
    attempt: int
    """Number of the attempt from 1, counted over all workers."""
    state: OutcomeState
    """done, failed, or skipped if the capture was already lifted."""
    seconds: float
    """Duration of the attempt."""
    message: str
    """Reason for a failure; otherwise empty."""
    code: int
    """Exit code of the process, or 128 plus the number of the signal that killed it."""
    run: str | None
    """Directory of the lifted run; None if the attempt failed or the directory is not known."""
    worker: str
    """Name of the worker."""
    time: float
    """End of the attempt in seconds since 1970, by the clock of the worker."""


def latest(outcomes: Iterable[Outcome]) -> dict[str, Outcome]:
    """Return the last outcome of each capture by key; a later skip does not replace a completed lift.

    >>> done = Outcome("fox", "a", 1, "done", 41.0, "", code=0, run=None, worker="one", time=1.0)
    >>> skipped = Outcome("fox", "a", 2, "skipped", 0.0, "", code=0, run=None, worker="two", time=2.0)
    >>> latest([skipped, done])["a"].state
    'done'
    """
    by_key: dict[str, Outcome] = {}
    for outcome in sorted(outcomes, key=lambda outcome: (outcome.attempt, outcome.time)):
        previous = by_key.get(outcome.key)
        if previous is None or outcome.state != "skipped" or previous.state != "done":
            by_key[outcome.key] = outcome
    return by_key


def worst(outcomes: Iterable[Outcome]) -> int:
    """Return the largest exit code of failed captures; 0 if none failed."""
    return max((outcome.code for outcome in outcomes if outcome.state == "failed"), default=0)


def summary(captures: Sequence[Capture], outcomes: Mapping[str, Outcome]) -> Table:
    """Return a table with one row per capture, in the order of the list."""
    table = Table(box=None, padding=(0, 2, 0, 0))
    for title in ("capture", "state", "seconds", "run, or error"):
        table.add_column(title, justify="right" if title == "seconds" else "left", overflow="fold")
    for capture in captures:
        outcome = outcomes.get(capture.key)
        if outcome is None:
            table.add_row(plain(capture.name), "unknown", "", "its results were deleted")
        else:
            text = outcome.message if outcome.state == "failed" else outcome.run or ""
            table.add_row(plain(capture.name), outcome.state, f"{outcome.seconds:.1f}", plain(text))
    return table


def counted(captures: Sequence[Capture], outcomes: Mapping[str, Outcome]) -> str:
    """Return the number of lifted, skipped and failed captures as one line."""
    states = [outcomes[capture.key].state for capture in captures if capture.key in outcomes]
    words = {"done": "lifted", "skipped": "already lifted", "failed": "failed"}
    return ", ".join(f"{count} {words[state]}" for state in words if (count := states.count(state)) > 0)
