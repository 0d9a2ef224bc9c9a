"""ns-normlift-view in a process of its own, and a person before it."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

from tests.browser.person import COARSE, Person
from tests.browser.server import OWN, Server

if TYPE_CHECKING:
    from playwright.sync_api import Browser


@contextmanager
def own_viewer(config: Path, log: Path, *flags: str, python: Path | str = sys.executable) -> Iterator[str]:
    """Address of an ns-normlift-view that shows a run; its output goes to `log`."""
    with Server(OWN, config, log, python=python).running(*flags) as address:
        yield address


class Own(Person):
    """A browser tab with our own viewer in it, where every tab has a panel of its own."""

    def __init__(
        self,
        browser: Browser,
        address: str,
        size: tuple[int, int] = (960, 480),
        *,
        sharpness: float = COARSE,
        webgl: bool = True,
    ) -> None:
        super().__init__(browser, address, size, sharpness=sharpness, webgl=webgl)
        self.ready()

    def ready(self) -> None:
        """Waits until the page has the prompts that the run stores, or those that it had before."""
        self.button("Ask").wait_for()
        self.until(lambda: self.typed("Prompts"), "greeted")
