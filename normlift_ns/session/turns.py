"""Who works, and whose answer still counts: a number per person that rises with every question."""

from __future__ import annotations

from dataclasses import dataclass, field
from threading import Lock


@dataclass(frozen=True)
class Turn:
    """A ticket for one piece of work."""

    number: int
    what: str
    """What a person reads while it runs."""


@dataclass
class Turns:
    """Tickets of one person. May be used from any thread.

    >>> turns = Turns()
    >>> first, second = turns.start("Reading red"), turns.start("Reading blue")
    >>> turns.busy, turns.finish(first), turns.busy, turns.finish(second), turns.busy
    ('Reading blue', False, 'Reading blue', True, '')
    """

    _lock: Lock = field(default_factory=Lock, repr=False)
    _last: Turn = Turn(0, "")
    _running: bool = False

    def start(self, what: str) -> Turn:
        """A ticket; those before it are stale from now on."""
        with self._lock:
            self._last, self._running = Turn(self._last.number + 1, what), True
            return self._last

    def wanted(self, turn: Turn) -> bool:
        """Whether the answer of a ticket still counts."""
        with self._lock:
            return self._running and turn.number == self._last.number

    def finish(self, turn: Turn) -> bool:
        """Whether the answer of a ticket still counts; it is not busy any more then."""
        with self._lock:
            current = self._running and turn.number == self._last.number
            self._running = self._running and not current
            return current

    def cancel(self) -> bool:
        """Makes what runs stale; whether anything ran."""
        with self._lock:
            was, self._running = self._running, False
            return was

    @property
    def busy(self) -> str:
        """What runs, in words; empty: nothing."""
        with self._lock:
            return self._last.what if self._running else ""
