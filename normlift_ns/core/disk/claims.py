"""Who works on what, where several processes share a folder: claims, by files that one process alone can create.

A claim is the file KEY.NUMBER, which O_EXCL gives to one process, also on network drives; there are no locks. NUMBER
counts the attempts at a piece of work, and the highest is the one that counts. Its owner writes a heartbeat into it,
and KEY.NUMBER.OUTCOME beside it at its end. Whoever sees no heartbeat for some time takes the work over by claiming
the next number, which again only one process gets. Nothing is ever removed, so that no one can remove another's claim.
Watchers measure the time between two heartbeats by their own clocks: those of other machines need not agree.
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
from typing import NamedTuple

LEFT = "left"
"""The outcome of work that was given up before its end, and that anybody may take at once."""
BEATS = 6
"""Heartbeats in the time after which an owner counts as dead."""
_NAME = re.compile(r"([0-9a-z_-]+)\.([1-9][0-9]*)(?:\.([a-z]+))?")
_DIGITS = 12
_LONGEST_NAP = 5.0
"""Seconds between two looks at what others do."""


class State(NamedTuple):
    """How far a piece of work is."""

    number: int
    """Of its last attempt; 0: nobody has claimed it yet."""
    outcome: str | None
    """Of that attempt; None: it is under way, or its owner is dead."""


NEW = State(0, None)


@dataclass(frozen=True)
class Claim:
    """An attempt at a piece of work, which is this process's alone."""

    folder: Path
    key: str
    number: int

    @property
    def path(self) -> Path:
        """The file of the claim."""
        return self.folder / f"{self.key}.{self.number}"


class Seen(NamedTuple):
    """The heartbeat of a claim, and since when it is the same, in seconds of the watcher's own clock."""

    pulse: bytes
    since: float


def states(names: Iterable[str]) -> dict[str, State]:
    """The states of all work that was ever claimed, from the names of the files.

    >>> states(["a.1", "a.1.left", "a.2", "b.1", "b.1.done", "notes.txt"])
    {'a': State(number=2, outcome=None), 'b': State(number=1, outcome='done')}
    """
    found: dict[str, State] = {}
    for name in names:
        match = _NAME.fullmatch(name)
        if match is not None:
            key, state = match[1], State(int(match[2]), match[3])
            before = found.get(key, NEW)
            if (state.number, state.outcome or "") > (before.number, before.outcome or ""):
                found[key] = state
    return found


def free(state: State, at_start: State) -> bool:
    """Whether work may be claimed without waiting: nobody has it, it was given up, or its last attempt had ended
    before this process looked for the first time.

    >>> free(State(1, "failed"), at_start=State(1, "failed")), free(State(1, "failed"), at_start=NEW)
    (True, False)
    """
    return state.number == 0 or state.outcome == LEFT or (state.outcome is not None and state == at_start)


def watched(before: Seen | None, pulse: bytes, now: float) -> Seen:
    """What is known of a heartbeat after another look at it.

    >>> watched(Seen(b"7", since=10.0), b"7", now=15.0), watched(Seen(b"7", since=10.0), b"8", now=15.0)
    (Seen(pulse=b'7', since=10.0), Seen(pulse=b'8', since=15.0))
    """
    return before if before is not None and before.pulse == pulse else Seen(pulse, now)


def is_dead(seen: Seen, now: float, patience: float) -> bool:
    """Whether a heartbeat was the same for so many seconds.

    >>> is_dead(Seen(b"7", since=10.0), 69.0, 60.0), is_dead(Seen(b"7", since=10.0), 70.0, 60.0)
    (False, True)
    """
    return now - seen.since >= patience


def read_states(folder: Path) -> dict[str, State]:
    """`states` of a folder; nothing where it is not there yet."""
    try:
        return states(os.listdir(folder))
    except FileNotFoundError:
        return {}


def claim(folder: Path, key: str, after: int) -> Claim | None:
    """Claims the attempt after the one of that number; None where another process was faster.

    Args:
        key: of lower case letters, digits, - and _.
    Raises:
        OSError: the folder cannot be written.

    >>> import tempfile
    >>> folder = Path(tempfile.mkdtemp())
    >>> mine = claim(folder, "fox", after=0)
    >>> mine.path.name, claim(folder, "fox", after=0)
    ('fox.1', None)
    """
    taken = Claim(folder, key, after + 1)
    assert _NAME.fullmatch(taken.path.name), key
    folder.mkdir(parents=True, exist_ok=True)
    try:
        with taken.path.open("xb") as file:
            file.write(f"{0:0{_DIGITS}d} {socket.gethostname()} {os.getpid()}\n".encode())  # the rest is for people
    except FileExistsError:
        return None
    return taken


def beat(claim: Claim, count: int) -> bool:
    """Writes the heartbeat of a claim; False if another process has taken the work over.

    A heartbeat that cannot be written is one that is missing, and no error.

    Args:
        count: another one than the last time, at least 0.
    """
    with suppress(OSError), claim.path.open("r+b", buffering=0) as file:
        file.write(f"{count:0{_DIGITS}d}".encode())
    return not os.path.lexists(Claim(claim.folder, claim.key, claim.number + 1).path)


def read_pulse(claim: Claim) -> bytes:
    """The heartbeat of a claim, whoever has it; what cannot be read is none."""
    with suppress(OSError):
        return claim.path.read_bytes()[:_DIGITS]
    return b""


def end(claim: Claim, outcome: str) -> None:
    """Writes down how an attempt ended, so that nobody waits for it any more.

    Args:
        outcome: a word of lower case letters. `LEFT`: others may take the work at once.
    Raises:
        OSError: the folder cannot be written.
    """
    path = claim.path.with_name(f"{claim.path.name}.{outcome}")
    assert _NAME.fullmatch(path.name), outcome
    path.touch()


def claims(
    folder: Path,
    keys: Sequence[str],
    at_start: Mapping[str, State],
    patience: float,
    *,
    clock: Callable[[], float] = time.monotonic,
    sleep: Callable[[float], None] = time.sleep,
) -> Iterator[Claim]:
    """Claims one piece of work after the other, until others have ended all the rest.

    What another process works on is waited for, and taken over where its heartbeat stops. The caller does the work of
    every claim, beats meanwhile (`BEATS` times in `patience`), and ends it before it asks for the next.

    Args:
        keys: of the work that is to be done.
        at_start: `read_states` from before the caller found out what is to be done: an attempt that ended later
            is not repeated, one that ended before is.
        patience: seconds without a heartbeat after which its owner counts as dead.
    Raises:
        OSError: the folder cannot be written.

    >>> import tempfile
    >>> folder = Path(tempfile.mkdtemp())
    >>> for mine in claims(folder, ["a", "b"], {}, patience=60.0):
    ...     end(mine, "done")
    >>> read_states(folder)["a"], list(claims(folder, ["a", "b"], {}, patience=60.0))
    (State(number=1, outcome='done'), [])
    """
    seen: dict[Claim, Seen] = {}
    while True:
        now, found, waiting, mine = clock(), read_states(folder), False, None
        for key in keys:
            state = found.get(key, NEW)
            ours = free(state, at_start.get(key, NEW))
            if not ours and state.outcome is None:
                other = Claim(folder, key, state.number)
                seen[other] = watched(seen.get(other), read_pulse(other), now)
                ours, waiting = is_dead(seen[other], now, patience), True
            if ours and (mine := claim(folder, key, state.number)) is not None:
                break
            waiting |= ours  # somebody was faster, and may die
        if mine is not None:
            yield mine
        elif not waiting:
            return
        else:
            sleep(min(patience / BEATS, _LONGEST_NAP))
