"""A person walks through real captures on the page of ns-normlift-view, and every frame is watched."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import pytest
from plyfile import PlyData

from tests.browser.page import OnPage
from tests.browser.person import coloured, middle, needs_chromium
from tests.browser.server import OWN, Server
from tests.captures import needs_shared

if TYPE_CHECKING:
    from playwright.sync_api import Browser

pytestmark = [pytest.mark.slow, needs_shared, needs_chromium]


class Walk(NamedTuple):
    """What a person asks of a capture, and what the first answer looks like."""

    capture: str
    line: str
    looks: Callable[[np.ndarray], np.ndarray]
    """Whether RGB [N, 3] of the photograph is like the first prompt."""
    drawn: int = 1_000_000
    """Gaussians that the page draws at most."""


def orange(rgb: np.ndarray) -> np.ndarray:
    return (rgb[:, 0] > rgb[:, 1]) & (rgb[:, 1] > rgb[:, 2]) & (rgb[:, 0] - rgb[:, 2] > 50)


def reddish(rgb: np.ndarray) -> np.ndarray:
    return rgb[:, 0] - rgb[:, 1:].max(axis=1) > 20


FOX = Walk("fox", "orange, crimson", orange, drawn=80_000)  # half of them, to take half the time
TABLETOP = Walk("tabletop", "dusty red, black", reddish)


@pytest.mark.parametrize("walk", [FOX, pytest.param(TABLETOP, marks=pytest.mark.extra)], ids=lambda walk: walk.capture)
def test_a_person_walks_through_a_capture(
    colored: Callable[[str], Path], browser: Browser, tmp_path: Path, walk: Walk
) -> None:
    server = Server(OWN, colored(walk.capture), tmp_path / "view.log", cwd=tmp_path)
    with server.running("--max-gaussians", str(walk.drawn)) as address:
        page = OnPage(browser, address, (780, 440))
        walks(page, walk, tmp_path)
        page.leave()


def walks(page: OnPage, walk: Walk, folder: Path) -> None:
    photo = page.sees(lambda seen: seen.std() > 20, "the scene")
    page.watch()
    page.ask(walk.line)
    some = page.selects(lambda count: count > 0, "an answer")
    assert [chip.split()[0] for chip in page.chips()] == [text.split()[0] for text in walk.line.split(", ")]
    page.page.locator(".chip").first.click()
    page.until(lambda: page.state("shown") == 0 and page.selected() <= some, "the first answer alone")
    page.until(lambda: page.page.locator("#do-suggested:not([disabled])").count() == 1, "another threshold")
    first = page.changes(lambda: page.does("do-suggested"), "the suggested threshold")
    mask = coloured(page.sees(lambda seen: 0.001 < coloured(seen).mean() < 0.6, "an overlay"))
    assert walk.looks(photo[mask].astype(int)).mean() > 2 * walk.looks(photo[~mask].astype(int)).mean()

    assert min(page.pointed()) >= 95
    slider = page.page.locator("#threshold")
    higher = min(0.99, 0.5 * (page.state("threshold") + float(slider.get_attribute("max") or 1)))
    fewer = page.changes(lambda: slider.fill(f"{higher:.3f}"), "a higher threshold")
    assert 0 <= fewer < first
    page.page.locator("#canvas").focus()
    page.page.keyboard.press("Control+z")
    page.selects(lambda count: count == first, "undone")

    clicked = page.changes(lambda: page.click(middle(mask)), "an object")
    assert 0 < clicked < page.state("total") / 2 and page.state("by_hand")

    page.does("do-why")
    page.until(lambda: page.page.locator("#why img").count() >= 3, "images that support it")
    page.page.keyboard.press("Escape")
    page.until(lambda: page.page.locator("#why").is_hidden(), "closed")

    page.changes_quickly(50)

    distance = "page.view.camera.position.distanceTo(page.view.controls.target)"
    far = page.page.evaluate(distance)
    page.until(lambda: page.page.locator("#objects .main").count() > 0, "objects")
    page.does("do-go")
    page.until(lambda: page.page.evaluate(distance) != far, "the camera has moved")
    assert page.page.evaluate("page.view.sees(page.panel.state.objects[0].center)")
    vertices = PlyData.read(page.save("save-ply", folder), mmap=False)["vertex"]
    assert 0 < vertices.count <= page.selected()
