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
    from playwright.sync_api import Browser

pytestmark = [pytest.mark.slow, needs_chromium]
THINGS = {"red": RED, "yellow": YELLOW, "blue": BLUE}


def things_in(tab: Tab) -> dict[str, np.ndarray]:
    """Where things of the room are in the picture, once it is drawn."""
    photo = tab.sees(lambda seen: all(hue_mask(seen, *rule).sum() > 3000 for rule in THINGS.values()), "the room")
    return {name: hue_mask(photo, *rule) for name, rule in THINGS.items()}


def test_a_person_asks_and_sees_answers_objects_reasons_and_floaters(tab: Tab, tmp_path: Path) -> None:
    for button in ("Ask", "Hide", "Undo", "Clear"):  # without scrolling
        box = tab.button(button).bounding_box()
        assert box is not None and box["y"] + box["height"] < 1000
    things = things_in(tab)

    tab.asks("red", answered=1, key=True)
    overlay = tab.sees(lambda seen: iou(overlaid(seen), things["red"]) > 0.7, "an overlay of red")
    tab.until(lambda: tab.output() == "overlay", "the answer is shown")
    some = tab.selected()
    for label, value, least in (("Threshold", "0.98", 0), ("Minimum reliability", "0.75", 1)):
        tab.type(label, value)
        tab.selects(lambda count, least=least: least <= count < some, f"fewer by {label}")
        tab.press("Undo")
        tab.selects(lambda count: count == some, "undone")

    tab.asks("red, yellow; bright blue, glorp", answered=3)
    tab.says(r"⚠\s+glorp")
    tab.show("segmentation")

    def drawn_by_name(seen: np.ndarray) -> bool:
        red, yellow, blue = (seen[things[name]].mean(axis=0) for name in THINGS)
        return red[0] > 150 > red[1:].max() and yellow[:2].min() > 150 > yellow[2] and blue[2] > 150 > blue[0]

    classes = tab.sees(drawn_by_name, "each thing in the colour of its name")
    tab.show("reliability")
    tab.sees(lambda seen: changed(seen, classes) > 3, "reliability")
    tab.show("relevancy_yellow")
    tab.asks("red", answered=1)
    tab.until(lambda: tab.output() == "overlay", "relevancy_yellow is no output any more")

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
    tab.type("Threshold", "0.995")
    tab.selects(lambda count: count < some, "fewer")
    tab.until(lambda: tab.images("jpeg") == 0, "another selection has other reasons")
    tab.press("Use suggested")
    tab.until(lambda: 0.5 < float(tab.typed("Threshold")) < 0.95, "another threshold")
    for _ in range(2):
        tab.press("Undo")
    tab.selects(lambda count: count == some, "as it was")
    tab.press("Select likely floaters")
    tab.selects(lambda count: count not in (0, some), "floaters")

    tab.ask("maroon")
    tab.says(r"maroon: .*\d\.\d\d")  # its nearest match
    panel = tab.page.locator("[role=tabpanel]:visible").bounding_box()
    assert panel is not None and panel["width"] <= 320  # nothing makes it wider


def test_a_person_clicks_hides_downloads_grows_and_undoes(tab: Tab, tmp_path: Path) -> None:
    things = things_in(tab)
    for end in ("Escape", "Cancel"):
        tab.arm("More like this")
        tab.page.keyboard.press("Escape") if end == "Escape" else tab.press("Cancel")
        tab.until(lambda: ARMED not in tab.text(), f"disarmed by {end}")
        tab.click(middle(things["red"]))  # does nothing: the next one is the first that counts
    tab.arm("More like this")
    tab.click(middle(things["yellow"]))
    alike = tab.selects(lambda count: count > 0, "clicked")
    name = tab.typed("Prompts")
    assert name.startswith("like click ")
    tab.sees(lambda seen: iou(overlaid(seen), things["yellow"]) > 0.55, "an overlay of what is yellow")

    vertices = PlyData.read(tab.save("Download selection", tmp_path), mmap=False)["vertex"]
    assert 0.8 * alike < vertices.count <= alike

    tab.show("rgb")
    tab.press("Hide")
    tab.says(HIDDEN)
    tab.asks("red", answered=1)
    tab.selects(lambda count: count != alike, "asked")
    tab.until(lambda: tab.output() == "overlay", "the answer is shown")
    tab.press("Hide")
    tab.show("rgb")

    def gone(seen: np.ndarray) -> bool:
        return all(hue_mask(seen, *THINGS[x]).sum() < 0.15 * things[x].sum() for x in ("red", "yellow"))

    tab.sees(gone, "both are hidden")
    for _ in range(3):
        tab.press("Undo")
    tab.until(lambda: HIDDEN not in tab.text() and tab.typed("Prompts") == name, "undone")
    tab.sees(lambda seen: iou(hue_mask(seen, *YELLOW), things["yellow"]) > 0.9, "yellow is back")

    counts = [alike]
    for button, thing in (("Select", "red"), ("Add", "yellow"), ("Remove", "red")):
        tab.arm(button)
        tab.click(middle(things[thing]))
        counts.append(tab.selects(lambda count: count != counts[-1], button))
    _, _, both, yellow = counts
    assert both == counts[1] + yellow
    tab.type("Grow", "-7")
    part = tab.selects(lambda count: 0 < count < yellow, "a part")

    def drawn_in_part(seen: np.ndarray) -> bool:
        shown, whole = overlaid(seen), things["yellow"]
        return 0.02 < (shown & whole).sum() / whole.sum() < 0.9 and (shown & ~whole).sum() < 0.1 * whole.sum()

    tab.show("overlay")
    tab.sees(drawn_in_part, "the part is drawn")
    tab.type("Grow", "3")
    tab.selects(lambda count: count > max(part, yellow), "more than the whole")
    tab.press("Undo")
    tab.selects(lambda count: count == yellow, "the whole")


def test_two_tabs_and_everything_at_once(tab: Tab, stock: Server, browser: Browser) -> None:
    other = Tab(browser, stock.address)
    tab.asks("red; yellow", answered=2)
    other.until(lambda: other.answered() == 2 and other.selected() == tab.selected() > 0, "both tabs agree")
    tab.arm("More like this")
    other.click((300, 400))  # is not the click that the first tab waits for
    other.asks("red", answered=1)  # but a question ends the waiting
    tab.until(lambda: ARMED not in tab.text() and tab.answered() == 1, "disarmed")
    tab.asks("red", answered=1)
    for text, prompts in (("yellow", 1), (", ".join(f"red {i}" for i in range(50)), 8), ("x" * 10_000, 0)):
        tab.ask(text)
        other.drag(15, 0)
        for one in (tab, other):
            one.until(lambda one=one, prompts=prompts: one.answered() == prompts, f"asked {text[:20]!r}")
    other.until(lambda: "xxxx" in other.text(), "the message in both")
    assert len(tab.text()) < 5000
    tab.press("Clear")
    other.until(lambda: "xxxx" not in other.text() and other.selected() == -1, "cleared")
    other.leave()


def test_a_page_outlives_its_server_and_a_saved_click_is_asked_again(tab: Tab, stock: Server) -> None:
    yellow = things_in(tab)["yellow"]
    tab.arm("More like this")
    tab.click(middle(yellow))
    clicked = tab.selects(lambda count: count > 0, "clicked")
    name = tab.typed("Prompts")
    tab.press("Save prompts in run")
    tab.until(lambda: len(load_query(stock.config.parent / "normlift").texts) == 3, "saved")  # type: ignore[union-attr]
    tab.asks("red", answered=1)
    tab.selects(lambda count: count != clicked, "something else")
    stock.stop()
    stock.start()
    # the page finds the new server, which shows what is stored
    tab.until(lambda: tab.typed("Prompts") == f"red, yellow, {name}" and tab.answered() == 3, "reconnected")
    tab.until(lambda: tab.images("svg") == 3, "histograms")
    tab.says("object 1")
    tab.asks(name, answered=1)
    tab.selects(lambda count: count == clicked, "asked again")
    tab.sees(lambda seen: iou(overlaid(seen), yellow) > 0.55, "what was clicked is drawn again")
