"""Request tokens that discard stale results: a number per user that increases with every request."""

from __future__ import annotations

from dataclasses import dataclass, field
from threading import Lock


@dataclass(frozen=True)
class Turn:
    """Token of one request."""

    number: int
    what: str
    """Description of the request, shown while it runs."""


@dataclass
class Turns:
    """Tokens of one user. Methods may be called from any thread.

    >>> turns = Turns()
    >>> first, second = turns.start("Reading red"), turns.start("Reading blue")
    >>> turns.busy, turns.finish(first), turns.busy, turns.finish(second), turns.busy
    ('Reading blue', False, 'Reading blue', True, '')
    """

    _lock: Lock = field(default_factory=Lock, repr=False)
    _last: Turn = Turn(0, "")
    _running: bool = False

    def start(self, description: str) -> Turn:
        """Return a new token; all earlier ones become stale."""
        with self._lock:
            self._last, self._running = Turn(self._last.number + 1, description), True
            return self._last

    def wanted(self, token: Turn) -> bool:
        """Return whether the result of a request is still wanted."""
        with self._lock:
            return self._running and token.number == self._last.number

    def finish(self, token: Turn) -> bool:
        """End a request; return whether its result is still wanted."""
        with self._lock:
            current = self._running and token.number == self._last.number
            self._running = self._running and not current
            return current

    def cancel(self) -> bool:
        """Make the running request stale; return whether there was one."""
        with self._lock:
            running, self._running = self._running, False
            return running

    @property
    def busy(self) -> str:
        """Description of the running request; empty if there is none."""
        with self._lock:
            return self._last.what if self._running else ""
