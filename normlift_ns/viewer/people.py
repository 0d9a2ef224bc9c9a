"""Everyone who looks: a page each, and what is kept for those who come back."""

from __future__ import annotations

import secrets
import threading
from collections import OrderedDict

from normlift_ns.session.history import History
from normlift_ns.session.state import State
from normlift_ns.viewer.adapter import Page
from normlift_ns.viewer.person import Person
from normlift_ns.viewer.shared import Memory, Run

MOST_KEPT = 64
"""Persons who are remembered after they have left."""


class People:
    """All pages of one server."""

    def __init__(self, run: Run) -> None:
        self._run, self._lock = run, threading.Lock()
        self._memories: OrderedDict[str, Memory] = OrderedDict()
        self._here: dict[int, Person] = {}
        self._left: set[int] = set()

    def come(self, page: Page) -> None:
        """Makes the panel of a page, in the thread that calls."""
        person = Person(self._run, page, self._remember)
        with self._lock:
            left = page.number in self._left or page.gone
            self._left.discard(page.number)
            if not left:
                self._here[page.number] = person
        if left:  # while the panel was made
            person.leave()

    def go(self, number: int) -> None:
        """Keeps what a page had that is gone."""
        with self._lock:
            person = self._here.pop(number, None)
            if person is None:
                self._left.add(number)
        if person is not None:
            person.leave()

    def _remember(self, token: str, page: int) -> tuple[Memory, str]:
        """The memory of a token; a page that shows it already, such as a duplicated tab, keeps it, and the new one
        gets a copy under a token of its own.
        """
        with self._lock:
            found = self._memories.get(token)
            if found is not None and found.page is not None and found.page in self._here:
                token, found = (
                    secrets.token_urlsafe(16),
                    Memory(found.history, found.line, dict(found.clicks), found.view, found.link),
                )
            if found is None:
                found = Memory(History.of(State(self._run.space), lean=State.lean))
            found.page = page
            self._memories[token] = found
            self._memories.move_to_end(token)
            for old in [name for name, memory in self._memories.items() if memory.page is None][:-MOST_KEPT]:
                del self._memories[old]
            return found, token
