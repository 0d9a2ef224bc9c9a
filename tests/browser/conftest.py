"""One browser, a server for each viewer, and where the pictures go that the tests take."""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

from tests.browser.person import chromium
from tests.browser.server import OWN, STOCK, Server, copied, faults
from tests.browser.viewer import Own, Tab

if TYPE_CHECKING:
    from playwright.sync_api import Browser


@pytest.fixture(scope="session")
def pictures(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder for screenshots; NORMLIFT_SCREENSHOTS names one that is kept."""
    kept = os.environ.get("NORMLIFT_SCREENSHOTS")
    folder = tmp_path_factory.mktemp("screenshots") if kept is None else Path(kept)
    folder.mkdir(parents=True, exist_ok=True)
    print(f"screenshots in {folder}")
    return folder


@pytest.fixture(scope="session")
def browser() -> Iterator[Browser]:
    """A browser for all tests; each opens tabs of its own."""
    with chromium() as browser:
        yield browser


@pytest.fixture(scope="session")
def stock_server(lifted: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Server]:
    yield from served(STOCK, lifted, tmp_path_factory.mktemp("stock"))


@pytest.fixture(scope="session")
def own_server(lifted: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Server]:
    yield from served(OWN, lifted, tmp_path_factory.mktemp("own"))


def served(program: str, config: Path, folder: Path) -> Iterator[Server]:
    """A server of a copy of a run, which has printed no traceback in the end."""
    server = Server(program, copied(config, folder), folder / "viewer.log", cwd=folder)
    yield server
    server.stop()
    assert faults(server.said()) == []


@pytest.fixture
def stock(stock_server: Server) -> Iterator[Server]:
    """nerfstudio's viewer before a lifted room that stores the queries red and yellow."""
    yield from as_stored(stock_server)


@pytest.fixture
def own(own_server: Server) -> Iterator[Server]:
    """Our own viewer before the same room."""
    yield from as_stored(own_server)


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
    """A fresh tab before nerfstudio's viewer."""
    tab = Tab(browser, stock.address)
    tab.fresh()
    yield tab
    tab.leave()


@pytest.fixture
def page(own: Server, browser: Browser) -> Iterator[Own]:
    """A fresh tab before our own viewer."""
    page = Own(browser, own.address)
    yield page
    page.leave()
