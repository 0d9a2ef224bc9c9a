"""Work claims for processes that share a folder, without locks.

A claim is a file KEY.NUMBER for attempt NUMBER at task KEY. Only the latest attempt is valid. Processes create claims
with O_EXCL, so only one process owns an attempt, even on network drives. The owner writes a heartbeat into the file,
and creates KEY.NUMBER.OUTCOME when the attempt ends. If the heartbeat stops, another process claims the next attempt.

Claim files are never deleted, because a process could otherwise delete the claim of another one. Each process measures
heartbeats with its own clock, so the clocks of different machines may differ.
"""

from __future__ import annotations

import os
import re
import socket
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import msgspec

from normlift_ns.io.guard import read_file

ABANDONED = "left"
"""Outcome of an abandoned attempt; any process may claim the task again immediately."""
BEATS_PER_TIMEOUT = 6
"""Number of heartbeats that an owner writes per timeout; see `iter_claims`."""
_CLAIM_NAME = re.compile(r"([0-9a-z_-]+)\.([1-9][0-9]*)(?:\.([a-z]+))?")
_PULSE_DIGITS = 12
_MAX_POLL_INTERVAL = 5.0
"""Maximum time between two checks of the claims of other processes, in seconds."""


class ClaimState(NamedTuple):
    """State of a task."""

    number: int
    """Number of the latest attempt; 0 if no process has claimed the task yet."""
    outcome: str | None
    """Outcome of that attempt; None before the first attempt, while the attempt runs, or if its owner died."""


UNCLAIMED = ClaimState(0, None)


@dataclass(frozen=True)
class Claim:
    """Claim of one process for one attempt at a task."""

    folder: Path
    key: str
    number: int

    @property
    def path(self) -> Path:
        """Path of the claim file."""
        return self.folder / f"{self.key}.{self.number}"


def claim_states(names: Iterable[str]) -> dict[str, ClaimState]:
    """Return the states of all tasks that have claim files, by key.

    Args:
        names: Names of all files in the folder. Files other than claims are ignored.

    >>> claim_states(["a.1", "a.1.left", "a.2", "b.1", "b.1.done", "notes.txt"])
    {'a': ClaimState(number=2, outcome=None), 'b': ClaimState(number=1, outcome='done')}
    """
    latest: dict[str, ClaimState] = {}
    for name in names:
        match = _CLAIM_NAME.fullmatch(name)
        if match is not None:
            key, state = match[1], ClaimState(int(match[2]), match[3])
            previous = latest.get(key, UNCLAIMED)
            if (state.number, state.outcome or "") > (previous.number, previous.outcome or ""):
                latest[key] = state
    return latest


def is_claimable(state: ClaimState, at_start: ClaimState) -> bool:
    """Return True if a task is unclaimed or abandoned, or if its latest attempt ended before this process started.

    Args:
        state: Current state of the task.
        at_start: State of the task when this process started.

    >>> failed = ClaimState(1, "failed")
    >>> is_claimable(failed, at_start=failed), is_claimable(failed, at_start=UNCLAIMED)
    (True, False)
    """
    return state.number == 0 or state.outcome == ABANDONED or (state.outcome is not None and state == at_start)


def read_claim_states(folder: Path) -> dict[str, ClaimState]:
    """Return the `claim_states` of a folder; an empty dict if the folder does not exist yet."""
    try:
        return claim_states(os.listdir(folder))
    except FileNotFoundError:
        return {}


def try_claim(folder: Path, key: str, after: int) -> Claim | None:
    """Claim the next attempt at a task; return None if another process claimed it first.

    Args:
        key: Name of the task, made of lowercase letters, digits, - and _.
        after: Number of the latest attempt, as in `ClaimState`.
    Raises:
        OSError: The folder cannot be written.

    >>> import tempfile
    >>> folder = Path(tempfile.mkdtemp())
    >>> mine = try_claim(folder, "fox", after=0)
    >>> mine.path.name, try_claim(folder, "fox", after=0)
    ('fox.1', None)
    """
    attempt = Claim(folder, key, after + 1)
    assert _CLAIM_NAME.fullmatch(attempt.path.name), key
    folder.mkdir(parents=True, exist_ok=True)
    try:
        with attempt.path.open("xb") as file:  # host name and process ID are only for people
            file.write(f"{0:0{_PULSE_DIGITS}d} {socket.gethostname()} {os.getpid()}\n".encode())
    except FileExistsError:
        return None
    return attempt


def write_pulse(claim: Claim, count: int) -> bool:
    """Write the heartbeat of a claim; return False if another process has taken over the task.

    If the file cannot be written, the function raises no error, and the heartbeat stops for other processes.

    Args:
        count: Non-negative number that differs from the previous one.
    """
    with suppress(OSError), claim.path.open("r+b", buffering=0) as file:
        file.write(f"{count:0{_PULSE_DIGITS}d}".encode())
    return not os.path.lexists(Claim(claim.folder, claim.key, claim.number + 1).path)


def read_pulse(claim: Claim) -> bytes:
    """Return the heartbeat of a claim; an empty byte string if the file cannot be read."""
    with suppress(OSError):
        return read_file(claim.path)[:_PULSE_DIGITS]
    return b""


def finish_claim(claim: Claim, outcome: str) -> None:
    """Record the outcome of an attempt, so that other processes stop waiting for it.

    Args:
        outcome: Word of lowercase letters. After `ABANDONED`, any process may claim the task immediately.
    Raises:
        OSError: The folder cannot be written.
    """
    path = claim.path.with_name(f"{claim.path.name}.{outcome}")
    assert _CLAIM_NAME.fullmatch(path.name), outcome
    path.touch()


def iter_claims(
    folder: Path,
    keys: Sequence[str],
    initial_states: Mapping[str, ClaimState],
    timeout: float,
    *,
    clock: Callable[[], float] = time.monotonic,
    sleep: Callable[[float], None] = time.sleep,
) -> Iterator[Claim]:
    """Yield claims of this process until all tasks have ended, whichever process works on them.

    The generator waits for tasks of other processes, and claims a task if its heartbeat stops. While the caller works
    on a claim, it must call `write_pulse` `BEATS_PER_TIMEOUT` times per `timeout`. It must call `finish_claim` before
    it requests the next claim.

    Args:
        keys: Names of the tasks.
        initial_states: Result of `read_claim_states` before the caller listed its tasks. Attempts that had ended
            by then are repeated. Attempts that end later are repeated only if their outcome is `ABANDONED`.
        timeout: Seconds without a heartbeat after which another process may take over a task.
        clock: Function that returns the time in seconds; tests replace it.
        sleep: Function that waits for a number of seconds; tests replace it.
    Raises:
        OSError: The folder cannot be written.

    >>> import tempfile
    >>> folder = Path(tempfile.mkdtemp())
    >>> for mine in iter_claims(folder, ["a", "b"], {}, timeout=60.0):
    ...     finish_claim(mine, "done")
    >>> read_claim_states(folder)["a"], list(iter_claims(folder, ["a", "b"], {}, timeout=60.0))
    (ClaimState(number=1, outcome='done'), [])
    """
    heartbeats: dict[Claim, tuple[bytes, float]] = {}  # latest heartbeat of each claim, and its first reading time
    while True:
        now, current, waiting, mine = clock(), read_claim_states(folder), False, None
        for key in keys:
            state = current.get(key, UNCLAIMED)
            available = is_claimable(state, initial_states.get(key, UNCLAIMED))
            if not available and state.outcome is None:
                other = Claim(folder, key, state.number)
                pulse = read_pulse(other)
                if heartbeats.get(other, (None, now))[0] != pulse:
                    heartbeats[other] = pulse, now
                available, waiting = now - heartbeats[other][1] >= timeout, True
            if available and (mine := try_claim(folder, key, state.number)) is not None:
                break
            waiting |= available  # another process claimed the task first, and may die
        if mine is not None:
            yield mine
        elif not waiting:
            return
        else:
            sleep(min(timeout / BEATS_PER_TIMEOUT, _MAX_POLL_INTERVAL))


# JSON Lines files: each process appends to its own file, and readers read all files in a folder.


JSONL_SUFFIX = ".jsonl"
_Line = TypeVar("_Line")


def append_jsonl(path: Path, line: Any) -> None:
    """Append a line to a JSON Lines file with a single write, and flush it to the disk.

    Args:
        path: File that no other process writes.
        line: Dataclass instance or other value that msgspec can encode as JSON.
    Raises:
        OSError: The file cannot be written.
    """
    with path.open("ab", buffering=0) as file:
        file.write(msgspec.json.encode(line) + b"\n")
        os.fsync(file.fileno())


def read_jsonl(folder: Path, kind: type[_Line]) -> list[_Line]:
    """Return the decoded lines of all .jsonl files in a folder, sorted by file name.

    Lines that cannot be decoded as `kind` are skipped, because a killed process may leave an incomplete line.

    >>> import tempfile
    >>> folder = Path(tempfile.mkdtemp())
    >>> append_jsonl(folder / "one.jsonl", {"fox": 1})
    >>> _ = (folder / "two.jsonl").write_text('{"fox": 2}\\n{"fo')
    >>> read_jsonl(folder, dict)
    [{'fox': 1}, {'fox': 2}]
    """
    lines = []
    for path in sorted(folder.glob(f"*{JSONL_SUFFIX}")):
        for line in read_file(path).splitlines():
            try:
                lines.append(msgspec.json.decode(line, type=kind))
            except (msgspec.MsgspecError, UnicodeDecodeError, RecursionError):
                continue
    return lines
