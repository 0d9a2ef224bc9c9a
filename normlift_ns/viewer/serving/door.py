"""The door of a viewer: it serves at once, before torch is imported and the run is read; pages wait meanwhile."""

from __future__ import annotations

import threading
from collections.abc import Callable

from normlift_ns.viewer.adapter import Page, Server

OPENING = "Opening the run."


class Door:
    """A server whose pages wait until somebody takes them."""

    def __init__(self, host: str, port: int) -> None:
        self._lock, self._waiting = threading.Lock(), dict[int, Page]()
        self._hosts: tuple[Callable[[Page], None], Callable[[int], None]] | None = None
        self.server = Server(host, port, "normlift", self._come, self._go)

    def open(self, label: str, come: Callable[[Page], None], go: Callable[[int], None]) -> None:
        """Gives away the pages that wait, and all that come.

        Args:
            label: stands over the panel.
            come: called for every page that comes.
            go: called with the number of a page that is gone; it may not have come yet.
        """
        self.server.label(label)
        with self._lock:
            self._hosts, waiting = (come, go), list(self._waiting.values())
            self._waiting.clear()
        for page in waiting:
            page.notice("")
            come(page)

    def _come(self, page: Page) -> None:
        with self._lock:
            hosts = self._hosts
            if hosts is None:
                self._waiting[page.number] = page
                page.notice(OPENING)
        if hosts is not None:
            hosts[0](page)

    def _go(self, number: int) -> None:
        with self._lock:
            hosts = self._hosts
            self._waiting.pop(number, None)
        if hosts is not None:
            hosts[1](number)
