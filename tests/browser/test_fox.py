"""A person before the fox capture: a real scene, without any stored query."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from plyfile import PlyData

from tests.browser.viewer import CHROMIUM, Tab, chromium, coloured, faults, middle, ns_viewer
from tests.captures import needs_shared

pytestmark = [
    pytest.mark.slow,
    needs_shared,
    pytest.mark.skipif(CHROMIUM is None, reason="no Chromium here: install Debian's package chromium"),
]


def test_a_person_finds_the_fox(fox_run: Path, tmp_path: Path, pictures: Path) -> None:
    log = tmp_path / "viewer.log"
    with ns_viewer(fox_run, log, cwd=tmp_path) as address, chromium() as browser:
        tab = Tab(browser, address)
        tab.press("Hide Train Cams")
        tab.drag(-400, 150, button="right")  # brings the fox into the middle
        tab.settle()
        photo = tab.picture()
        tab.page.screenshot(path=pictures / "fox.png")
        assert "No query yet." in tab.status()

        tab.type("Prompts", "orange, crimson")
        tab.press("Ask")
        tab.says("crimson")
        tab.until(lambda: tab.output() == "overlay", "the first answer is shown", timeout=60)
        tab.type("Threshold", "0.35")
        tab.page.get_by_text("How it is asked and drawn", exact=True).click()
        tab.choose("Prompt shown", "1: orange")
        tab.settle()
        tab.page.screenshot(path=pictures / "fox_orange.png")
        orange = coloured(tab.picture())
        print("orange covers", orange.mean(), "of the picture, its mean colour is", photo[orange].mean(axis=0))
        assert 0.005 < orange.mean() < 0.3
        red, green, blue = photo[orange].mean(axis=0)
        assert red > green > blue
        assert red - blue > 50
        rest = photo[~orange].mean(axis=0)
        assert rest[0] - rest[2] < 0.5 * (red - blue)

        tab.choose("Prompt shown", "2: crimson")
        tab.until(
            lambda: (coloured(tab.picture()) & orange).sum() < 0.05 * orange.sum(), "the fox is not crimson", timeout=60
        )
        tab.choose("Prompt shown", "1: orange")

        tab.press("More like this")
        tab.says("Click on something in the scene")
        tab.click(*middle(orange))
        tab.until(lambda: tab.field("Prompts").input_value() == "like click 1" and tab.selected() > 0, "clicked")
        tab.settle()
        tab.page.screenshot(path=pictures / "fox_click.png")
        x, y = map(int, middle(orange))
        assert coloured(tab.picture())[y - 2 : y + 3, x - 2 : x + 3].mean() > 0.5

        tab.press("Only")
        tab.show("rgb")
        tab.settle()
        tab.page.screenshot(path=pictures / "fox_alone.png")
        assert (np.abs(tab.picture().astype(int) - (38, 42, 55)).max(axis=2) < 12).mean() > 0.4
        with tab.page.expect_download() as download:
            tab.press("Download selection")
        assert 0 < PlyData.read(str(download.value.path()))["vertex"].count <= tab.selected()
        assert tab.problems == []
    assert faults(log.read_text()) == []
