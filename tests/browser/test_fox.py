"""A person before the fox capture: a real scene, without any stored query."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pytest
from plyfile import PlyData

from tests.browser.person import needs_chromium
from tests.browser.server import STOCK, Server
from tests.browser.viewer import Tab, overlaid
from tests.captures import needs_shared

if TYPE_CHECKING:
    from playwright.sync_api import Browser

pytestmark = [pytest.mark.slow, needs_shared, needs_chromium]


def test_a_person_finds_the_fox(colored: Callable[[str], Path], tmp_path: Path, browser: Browser) -> None:
    with Server(STOCK, colored("fox"), tmp_path / "viewer.log", cwd=tmp_path).running() as address:
        tab = Tab(browser, address)
        assert tab.typed("Prompts") == "" and tab.selected() == -1  # nothing is stored
        tab.fresh()
        before = tab.sees(lambda seen: seen.std() > 20, "the scene")
        tab.drag(-400, 150, button="right")  # brings the fox into the middle
        photo = tab.sees(lambda seen: np.abs(seen.astype(int) - before).mean() > 10, "the camera has moved")
        tab.asks("orange, crimson", answered=2)
        tab.until(lambda: tab.output() == "overlay", "the first answer is shown")
        tab.type("Threshold", "0.35")
        tab.hit(tab.page.get_by_text("Advanced", exact=True))
        tab.choose("Prompt shown", "1: orange")

        def has_found(seen: np.ndarray) -> bool:
            orange = overlaid(seen)
            if not 0.005 < orange.mean() < 0.3:
                return False
            (red, green, blue), rest = photo[orange].mean(axis=0), photo[~orange].mean(axis=0)
            return red > green > blue and red - blue > 50 and rest[0] - rest[2] < 0.5 * (red - blue)

        orange = overlaid(tab.sees(has_found, "what is orange"))
        tab.choose("Prompt shown", "2: crimson")
        tab.sees(lambda seen: (overlaid(seen) & orange).sum() < 0.05 * orange.sum(), "the fox is not crimson")

        vertices = PlyData.read(tab.save("Download selection", tmp_path), mmap=False)["vertex"]
        assert 0 < vertices.count <= tab.selected()
        tab.leave()
