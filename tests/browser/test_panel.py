"""A person before the panel in nerfstudio's viewer: types, presses, clicks, and looks at the picture on the page."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pytest
from plyfile import PlyData

from normlift_ns.query.question import load_query
from tests.browser.person import ARMED, BLUE, RED, YELLOW, changed, hue_mask, iou, middle, needs_chromium
from tests.browser.server import Server
from tests.browser.viewer import HIDDEN, Tab, overlaid

if TYPE_CHECKING:
    pass

pytestmark = [pytest.mark.slow, needs_chromium]
THINGS = {"red": RED, "yellow": YELLOW, "blue": BLUE}


def things_in(tab: Tab) -> dict[str, np.ndarray]:
    """Where things of the room are in the picture, once it is drawn."""
    photo = tab.sees(lambda seen: all(hue_mask(seen, *rule).sum() > 3000 for rule in THINGS.values()), "the room")
    return {name: hue_mask(photo, *rule) for name, rule in THINGS.items()}


def test_a_person_asks_clicks_saves_and_outlives_the_server(tab: Tab, stock: Server, tmp_path: Path) -> None:
    """What each control does is tested in tests/nerfstudio_plugin/test_panel.py; here, that a browser shows it."""
    for button in ("Ask", "Hide", "Undo", "Clear"):  # without scrolling
        box = tab.button(button).bounding_box()
        assert box is not None and box["y"] + box["height"] < 1000
    things = things_in(tab)

    tab.asks("red, glorp", answered=1, key=True)
    tab.says(r"⚠\s+glorp")
    overlay = tab.sees(lambda seen: iou(overlaid(seen), things["red"]) > 0.7, "an overlay of red")
    tab.until(lambda: tab.output() == "overlay", "the answer is shown")
    some = tab.selected()
    for label, value, least in (("Threshold", "0.98", 0), ("Minimum reliability", "0.75", 1)):
        tab.type(label, value)
        tab.selects(lambda count, least=least: least <= count < some, f"fewer by {label}")
        tab.press("Undo")
        tab.selects(lambda count: count == some, "undone")

    tab.until(lambda: tab.images("svg") == 1, "a histogram")
    tab.says("object 1")
    tab.press("Go to")
    near = tab.sees(lambda seen: changed(seen, overlay) > 3, "the camera has moved")
    tab.press("Hide")
    tab.says(HIDDEN)
    tab.sees(lambda seen: overlaid(seen).sum() < 0.8 * overlaid(near).sum(), "hidden")
    tab.press("Undo")
    tab.until(lambda: HIDDEN not in tab.text(), "undone")
    assert tab.save("Export", tmp_path).name == "red_1.ply"
    tab.press("Why?")
    tab.until(lambda: tab.images("jpeg") >= 3, "photographs")
    panel = tab.page.locator("[role=tabpanel]:visible").bounding_box()
    assert panel is not None and panel["width"] <= 320  # nothing makes it wider

    tab.page.reload(wait_until="domcontentloaded")  # the camera stands where it stood at first
    tab.show("rgb")
    yellow = things_in(tab)["yellow"]
    for end in ("Escape", "Cancel"):
        tab.arm("More like this")
        tab.page.keyboard.press("Escape") if end == "Escape" else tab.press("Cancel")
        tab.until(lambda: ARMED not in tab.text(), f"disarmed by {end}")
        tab.click(middle(things["red"]))  # does nothing: the next one is the first that counts
    tab.arm("More like this")
    tab.click(middle(yellow))
    clicked = tab.selects(lambda count: count not in (0, some), "clicked")
    name = tab.typed("Prompts")
    vertices = PlyData.read(tab.save("Download selection", tmp_path), mmap=False)["vertex"]
    assert 0.8 * clicked < vertices.count <= clicked
    tab.press("Save prompts in run")
    tab.until(lambda: len(load_query(stock.config.parent / "normlift").texts) == 3, "saved")  # type: ignore[union-attr]
    stock.stop()
    stock.start()
    # the page finds the new server, which shows what is stored
    tab.until(lambda: tab.typed("Prompts") == f"red, yellow, {name}" and tab.answered() == 3, "reconnected")
    tab.asks(name, answered=1)
    tab.selects(lambda count: count == clicked, "asked again")
    tab.sees(lambda seen: iou(overlaid(seen), yellow) > 0.55, "what was clicked is drawn again")
