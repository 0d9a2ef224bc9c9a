"""Draws for one page: the latest state, in a thread of its own, whenever it has changed."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable

from normlift_ns.session.state import State
from normlift_ns.viewer.adapter import Page
from normlift_ns.viewer.blind.stills import Stills
from normlift_ns.viewer.paint import opacities, painted
from normlift_ns.viewer.records import Records

_FRAME = 0.1
"""Seconds between two pictures that are sent, at least."""
_GLANCE = 0.02
"""Seconds after which to look again whether a page has taken what was sent."""


class Painter:
    """Begins to work when it is first told that something has `changed`.

    Args:
        state: what to draw.
        drawn: called with a state that was sent.
        rested: called with it again once nothing has changed for a while, for what takes longer.
        failed: called with whatever was raised.
    """

    def __init__(
        self,
        page: Page,
        records: Records,
        state: Callable[[], State],
        drawn: Callable[[State], None],
        rested: Callable[[State], None],
        failed: Callable[[Exception], None],
    ) -> None:
        self._page, self._records, self._state = page, records, state
        self._drawn, self._rested, self._failed = drawn, rested, failed
        self._changed, self._ended = threading.Event(), False
        self.stills: Stills | None = None
        """What draws in place of the browser, where that cannot."""
        threading.Thread(target=self._work, daemon=True).start()

    def changed(self) -> None:
        """There is something new to draw."""
        self._changed.set()

    def end(self) -> None:
        """Draws nothing any more."""
        self._ended = True
        self._changed.set()
        if self.stills is not None:
            self.stills.stop()

    def _work(self) -> None:
        while not self._ended:
            self._changed.wait()
            self._changed.clear()
            try:
                self._draw()
            except Exception as error:  # whatever it is: nothing may stop the viewer
                if not self._ended:
                    self._failed(error)

    def _draw(self) -> None:
        while self._page.behind and not self._ended:  # pictures for a slow page would come ever later
            time.sleep(_GLANCE)
        state = self._state()
        if self.stills is None:
            self._page.draw(self._records.buffer(*painted(self._records, state), opacities(self._records, state)))
        else:
            self.stills.change()
        corners = None if state.box is None else state.box.corners
        self._page.outline(None if corners is None else self._records.units.to_browser(corners))
        self._drawn(state)
        if not self._changed.wait(_FRAME) and not self._ended:
            self._rested(state)
