"""A page of nerfstudio's viewer outlives its server: what was saved is there again."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

from tests.browser.test_demo_room import YELLOW, iou
from tests.browser.viewer import CHROMIUM, Tab, chromium, coloured, faults, free_port, hue_mask, middle, ns_viewer

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(CHROMIUM is None, reason="no Chromium here: install Debian's package chromium"),
]


def test_a_saved_click_is_asked_again_after_a_restart(demo_run: Path, tmp_path: Path, pictures: Path) -> None:
    run = tmp_path / "run"
    shutil.copytree(demo_run.parent, run)
    port = free_port()
    with chromium() as browser:
        with ns_viewer(run / "config.yml", tmp_path / "first.log", cwd=tmp_path, port=port) as address:
            tab = Tab(browser, address)
            tab.press("Hide Train Cams")
            tab.settle()
            yellow = hue_mask(tab.picture(), *YELLOW)
            tab.press("More like this")
            tab.says("Click on something in the scene")
            tab.click(*middle(yellow))
            tab.until(  # what is stored has four answers
                lambda: tab.field("Prompts").input_value() == "like click 1" and tab.answered() == 1,
                "clicked",
                timeout=60,
            )
            clicked = tab.selected()
            tab.press("Save prompts in run")
            tab.says("prompts now")
            tab.type("Prompts", "red")
            tab.press("Ask")
            tab.until(lambda: tab.selected() not in (clicked, -1), "something else", timeout=60)
        with ns_viewer(run / "config.yml", tmp_path / "second.log", cwd=tmp_path, port=port):
            # the page finds the new server, which shows what is stored
            tab.until(lambda: tab.field("Prompts").input_value().endswith("like click 1"), "reconnected", timeout=90)
            tab.type("Prompts", "like click 1")
            tab.press("Ask")
            tab.until(lambda: tab.answered() == 1 and tab.selected() == clicked, "asked again", timeout=60)
            drawn = "what was clicked is drawn again"
            tab.until(lambda: iou(coloured(tab.picture()), yellow) > 0.55, drawn, timeout=90)
            tab.page.screenshot(path=pictures / "panel_reconnected.png")
            assert tab.problems == []
    for log in ("first.log", "second.log"):
        assert faults((tmp_path / log).read_text()) == []
