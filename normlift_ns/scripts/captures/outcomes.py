"""What came of captures: one line of JSON each, and the table of all."""

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
    """What came of one capture."""

    capture: str
    """Its line in the list."""
    key: str
    attempt: int
    """From 1, whichever worker made it."""
    state: OutcomeState
    """skipped: it was lifted already."""
    seconds: float
    message: str
    """Why it failed; empty otherwise."""
    code: int
    """Exit code of its process; 128 and the number of a signal that ended it."""
    run: str | None
    """Directory of the lifted run; None where it failed, or is not known."""
    worker: str
    time: float
    """When it ended, in seconds since 1970 by the clock of the worker."""


def latest(outcomes: Iterable[Outcome]) -> dict[str, Outcome]:
    """The outcome of each capture by its key: of the last attempt, but for one that found it lifted by one of these.

    >>> done = Outcome("fox", "a", 1, "done", 41.0, "", code=0, run=None, worker="one", time=1.0)
    >>> found = Outcome("fox", "a", 2, "skipped", 0.0, "", code=0, run=None, worker="two", time=2.0)
    >>> latest([found, done])["a"].state
    'done'
    """
    found: dict[str, Outcome] = {}
    for outcome in sorted(outcomes, key=lambda outcome: (outcome.attempt, outcome.time)):
        before = found.get(outcome.key)
        if before is None or outcome.state != "skipped" or before.state != "done":
            found[outcome.key] = outcome
    return found


def worst(outcomes: Iterable[Outcome]) -> int:
    """The largest exit code of those that failed; 0: none did."""
    return max((outcome.code for outcome in outcomes if outcome.state == "failed"), default=0)


def summary(captures: Sequence[Capture], outcomes: Mapping[str, Outcome]) -> Table:
    """One row per capture, in the order of the list."""
    table = Table(box=None, padding=(0, 2, 0, 0))
    for title in ("capture", "state", "seconds", "run, or why there is none"):
        table.add_column(title, justify="right" if title == "seconds" else "left", overflow="fold")
    for capture in captures:
        found = outcomes.get(capture.key)
        if found is None:
            table.add_row(plain(capture.name), "unknown", "", "its results were removed")
        else:
            text = found.message if found.state == "failed" else found.run or ""
            table.add_row(plain(capture.name), found.state, f"{found.seconds:.1f}", plain(text))
    return table


def counted(captures: Sequence[Capture], outcomes: Mapping[str, Outcome]) -> str:
    """How many captures came to what, in one line."""
    states = [outcomes[capture.key].state for capture in captures if capture.key in outcomes]
    words = {"done": "lifted", "skipped": "lifted already", "failed": "failed"}
    return ", ".join(f"{count} {words[state]}" for state in words if (count := states.count(state)) > 0)
