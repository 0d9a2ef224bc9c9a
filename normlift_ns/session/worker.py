"""Job queue that keeps slow work out of viser's few threads, which serve all pages."""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable


class Worker:
    """Queue that runs jobs one after another, in a thread that ends when the queue is empty.

    >>> event, worker = threading.Event(), Worker()
    >>> worker.put(event.set)
    >>> event.wait(5)
    True
    """

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._jobs: deque[tuple[str, Callable[[], None]]] = deque()
        self._running = self._ended = False

    def put(self, job: Callable[[], None], key: str = "") -> None:
        """Add a job to the end of the queue.

        Args:
            job: must not raise.
            key: of successive waiting jobs with the same key, only the last one runs; empty: all run.
        """
        with self._lock:
            if self._ended:
                return
            if key and self._jobs and self._jobs[-1][0] == key:
                self._jobs.pop()
            self._jobs.append((key, job))
            if self._running:
                return
            self._running = True
        threading.Thread(target=self._run, daemon=True).start()

    def drop(self) -> None:
        """Discard the waiting jobs; the running one continues."""
        with self._lock:
            self._jobs.clear()

    def end(self) -> None:
        """Discard the waiting jobs and accept no further ones."""
        with self._lock:
            self._ended = True
            self._jobs.clear()

    def _run(self) -> None:
        while True:
            with self._lock:
                if not self._jobs:
                    self._running = False
                    return
                _, job = self._jobs.popleft()
            job()
