"""Heartbeats of the processes of a distributed lift, which detect lost processes.

A thread of each process increments a counter in the shared store, even if one image takes hours to process. If a
counter stops, the other processes report its process as lost, and exit. A process that fails reports its own error
first.
"""

from __future__ import annotations

import os
import signal
import socket
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, field
from datetime import timedelta
from threading import Event, Thread
from typing import Any, NamedTuple

HEARTBEAT_INTERVAL = 2.0
"""Seconds between heartbeats."""
HEARTBEAT_TIMEOUT = 30.0
"""Seconds without a heartbeat after which a process counts as lost."""
_GRACE = 10.0
"""Seconds between SIGTERM and a forced exit of this process, which may be waiting for the lost process."""


class PeerFailure(NamedTuple):
    """The loss or failure of another process, after which this process has to exit."""

    rank: int
    """Rank of the lost or failed process."""
    reported: bool
    """True if the process failed and reported its error, False if its heartbeat stopped."""
    host: str
    """Host name and process id, or "host unknown"."""


@dataclass
class Heartbeat:
    """The heartbeat of this process, and a monitor of the heartbeats of other processes."""

    store: Any
    """Client of the shared store, used only by this object."""
    rank: int
    size: int
    on_failure: Callable[[PeerFailure], None]
    """Function that is called before a forced exit. It must return quickly."""
    failure: PeerFailure | None = None
    _waiting: bool = False
    _stop: Event = field(default_factory=Event)
    _loss_detected: Event = field(default_factory=Event)

    def start(self) -> None:
        """Start the thread that sends the heartbeat and monitors the other processes."""
        self.store.set(f"place/{self.rank}", f"{socket.gethostname()}, process {os.getpid()}")
        Thread(target=self._run, name="heartbeat", daemon=True).start()

    def stop(self, well: bool) -> bool:
        """Stop the heartbeat, and notify the other processes that this process exits.

        If the store is unreachable, its host, usually process 0, has exited. Process 0 has then reported its own error,
        unless this process has detected the loss.

        Args:
            well: True if this process succeeded, False if the other processes have to exit too.
        Returns:
            True if this process is the first to fail and should report its error.
        """
        self._stop.set()
        with suppress(Exception):  # a lost store raises various errors, and the other processes exit too
            first = not well and self.store.add("failures", 1) == 1
            self.store.set(f"end/{self.rank}", "well" if well else "failed")
            if well and self.rank == 0:  # this process may host the store
                self.store.wait([f"end/{r}" for r in range(self.size)], timedelta(seconds=2 * HEARTBEAT_INTERVAL))
            return first
        return self.rank == 0 or self.failure is not None

    def wait_for_failure(self) -> PeerFailure | None:
        """Wait for the cause of a communication error; return the failure, or None if none is detected in time."""
        self._waiting = True
        self._loss_detected.wait(HEARTBEAT_TIMEOUT + 5 * HEARTBEAT_INTERVAL)
        return self.failure

    def _run(self) -> None:
        beats: dict[int, tuple[bytes, float]] = {}
        places = {r: "host unknown" for r in range(self.size)}
        count = 0
        while self.failure is None and not self._stop.wait(HEARTBEAT_INTERVAL):
            count += 1
            try:
                self.store.set(f"beat/{self.rank}", str(count))
                for r in range(self.size):
                    if r != self.rank:
                        self._check(r, beats, places)
            except Exception:  # a store whose process is lost raises various errors
                self.failure = self.failure or PeerFailure(0, False, places[0])
        if self.failure is None or self._stop.is_set():
            return
        self._loss_detected.set()
        if self._waiting:
            return
        os.kill(os.getpid(), signal.SIGTERM)  # the handler of SIGTERM removes partial files
        if not self._stop.wait(_GRACE):
            self.on_failure(self.failure)
            os._exit(1)

    def _check(self, r: int, beats: dict[int, tuple[bytes, float]], places: dict[int, str]) -> None:
        if self.store.check([f"place/{r}"]):
            places[r] = self.store.get(f"place/{r}").decode()
        if self.store.check([f"end/{r}"]):
            if self.store.get(f"end/{r}") == b"failed":
                self.failure = PeerFailure(r, True, places[r])
            return
        beat = self.store.get(f"beat/{r}") if self.store.check([f"beat/{r}"]) else b""
        now = time.monotonic()
        if r not in beats or beats[r][0] != beat:
            beats[r] = beat, now
        elif now - beats[r][1] > HEARTBEAT_TIMEOUT:
            self.failure = PeerFailure(r, False, places[r])
