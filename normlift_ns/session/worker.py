"""Work that waits its turn without holding up a thread of viser's: its few threads serve all pages."""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable


class Worker:
    """Does one thing after another, in a thread that lives as long as there is something to do.

    >>> done, worker = threading.Event(), Worker()
    >>> worker.put(done.set)
    >>> done.wait(5)
    True
    """

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._jobs: deque[tuple[str, Callable[[], None]]] = deque()
        self._works = self._ended = False

    def put(self, job: Callable[[], None], key: str = "") -> None:
        """Does something after what was put before.

        Args:
            job: raises nothing.
            key: of those of the same key that wait in a row only the last is done; empty: all.
        """
        with self._lock:
            if self._ended:
                return
            if key and self._jobs and self._jobs[-1][0] == key:
                self._jobs.pop()
            self._jobs.append((key, job))
            if self._works:
                return
            self._works = True
        threading.Thread(target=self._work, daemon=True).start()

    def drop(self) -> None:
        """Forgets what waits; what is being done is done to its end."""
        with self._lock:
            self._jobs.clear()

    def end(self) -> None:
        """Takes nothing any more."""
        with self._lock:
            self._ended = True
            self._jobs.clear()

    def _work(self) -> None:
        while True:
            with self._lock:
                if not self._jobs:
                    self._works = False
                    return
                _, job = self._jobs.popleft()
            job()
