"""How the processes of a team notice that one of them is gone, while a slow one may take its time.

Every process counts up a heartbeat in the store of the team, from a thread, so that hours in one photograph do not
matter. One whose heartbeat stands still is gone: the others end, and say so. One that fails says that first.
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

BEAT = 2.0
"""Seconds between two heartbeats."""
PATIENCE = 30.0
"""Seconds without one after which a process counts as gone."""
_GRACE = 10.0
"""Seconds that this process has to end by itself, before it is ended: it may be waiting for the one that is gone."""


class Lost(NamedTuple):
    """Why a process has to end."""

    rank: int
    """Of the process that is gone or has failed."""
    failed: bool
    """It has told what went wrong itself."""
    place: str
    """Its machine and number there."""


@dataclass
class Heart:
    """The heartbeat of this process, and an ear for those of the others."""

    store: Any
    """A client of the team's store that nobody else uses."""
    rank: int
    size: int
    last_words: Callable[[Lost], None]
    """Told before the process is ended; has to be quick."""
    lost: Lost | None = None
    _waiting: bool = False
    _stop: Event = field(default_factory=Event)
    _found: Event = field(default_factory=Event)

    def start(self) -> None:
        """Begins to beat and to listen."""
        self.store.set(f"place/{self.rank}", f"{socket.gethostname()}, process {os.getpid()}")
        Thread(target=self._run, name="heart", daemon=True).start()

    def stop(self, well: bool) -> bool:
        """Tells the others that this process has ended by itself. Whether it is the first of those that have failed.

        If the store is gone, process 0 has ended, which holds it: it has reported its own error, unless it is the loss
        that this process has noticed.

        Args:
            well: it has done its work. Otherwise the others have to end too.
        """
        self._stop.set()
        with suppress(Exception):  # whatever a store says that is gone: so is the team
            first = not well and self.store.add("failures", 1) == 1
            self.store.set(f"end/{self.rank}", "well" if well else "failed")
            if well and self.rank == 0:  # the store may be in this process
                self.store.wait([f"end/{r}" for r in range(self.size)], timedelta(seconds=2 * BEAT))
            return first
        return self.rank == 0 or self.lost is not None

    def wait_for_a_loss(self) -> Lost | None:
        """Who is gone, once that is known; None where all are well. For a process that could not reach another one."""
        self._waiting = True
        self._found.wait(PATIENCE + 5 * BEAT)
        return self.lost

    def _run(self) -> None:
        beats: dict[int, tuple[bytes, float]] = {}
        places = {r: "its machine is not known" for r in range(self.size)}
        count = 0
        while self.lost is None and not self._stop.wait(BEAT):
            count += 1
            try:
                self.store.set(f"beat/{self.rank}", str(count))
                for r in range(self.size):
                    if r != self.rank:
                        self._listen(r, beats, places)
            except Exception:  # whatever a store says whose process is gone
                self.lost = self.lost or Lost(0, False, places[0])
        if self.lost is not None and not self._stop.is_set():
            self._end()

    def _listen(self, r: int, beats: dict[int, tuple[bytes, float]], places: dict[int, str]) -> None:
        if self.store.check([f"place/{r}"]):
            places[r] = self.store.get(f"place/{r}").decode()
        if self.store.check([f"end/{r}"]):
            if self.store.get(f"end/{r}") == b"failed":
                self.lost = Lost(r, True, places[r])
            return
        beat = self.store.get(f"beat/{r}") if self.store.check([f"beat/{r}"]) else b""
        now = time.monotonic()
        if r not in beats or beats[r][0] != beat:
            beats[r] = beat, now
        elif now - beats[r][1] > PATIENCE:
            self.lost = Lost(r, False, places[r])

    def _end(self) -> None:
        self._found.set()
        if self._waiting:
            return
        os.kill(os.getpid(), signal.SIGTERM)  # what is half-written is removed, as far as the process gets
        if not self._stop.wait(_GRACE):
            assert self.lost is not None
            self.last_words(self.lost)
            os._exit(1)
