"""One browser, a server for each viewer, and where the pictures go that the tests take."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

from tests.browser.page import OnPage
from tests.browser.person import chromium
from tests.browser.server import OWN, STOCK, Server, copied, faults
from tests.browser.viewer import Tab

if TYPE_CHECKING:
    from playwright.sync_api import Browser


@pytest.fixture(scope="session")
def browser() -> Iterator[Browser]:
    """A browser for all tests; each opens tabs of its own."""
    with chromium() as browser:
        yield browser


@pytest.fixture(scope="session")
def servers(lifted: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[dict[str, Server]]:
    """Servers of copies of a run, which have printed no traceback in the end."""
    made = {}
    for program in (STOCK, OWN):
        folder = tmp_path_factory.mktemp("viewer")
        made[program] = Server(program, copied(lifted, folder), folder / "viewer.log", cwd=folder)
    yield made
    for server in made.values():
        server.stop()
        assert faults(server.said()) == []


@pytest.fixture
def stock(servers: dict[str, Server]) -> Iterator[Server]:
    """nerfstudio's viewer before a lifted room that stores the queries red and yellow."""
    yield from as_stored(servers[STOCK])


@pytest.fixture
def own(servers: dict[str, Server]) -> Iterator[Server]:
    """ns-normlift-view before the same room."""
    yield from as_stored(servers[OWN])


def as_stored(server: Server) -> Iterator[Server]:
    """Starts a server unless it runs, and takes back afterwards what a test has stored in the run."""
    stored, kept = server.config.parent / "normlift", server.config.parent.parent / "kept"
    shutil.copytree(stored, kept)
    server.start()
    yield server
    shutil.rmtree(stored)
    kept.rename(stored)


@pytest.fixture
def tab(stock: Server, browser: Browser) -> Iterator[Tab]:
    tab = Tab(browser, stock.address)
    tab.fresh()
    yield tab
    tab.leave()


@pytest.fixture
def page(own: Server, browser: Browser) -> Iterator[OnPage]:
    yield (page := OnPage(browser, own.address))
    page.leave()
