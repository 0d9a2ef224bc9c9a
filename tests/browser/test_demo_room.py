"""A person before the demo room: types, presses, clicks, and looks at the picture on the page."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from plyfile import PlyData

from normlift_ns.runs.question import load_question
from tests.browser.viewer import CHROMIUM, Tab, chromium, coloured, faults, hue_mask, iou, middle, ns_viewer

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(CHROMIUM is None, reason="no Chromium here: install Debian's package chromium"),
]
RED, YELLOW, BLUE = ((0, 0.9), (1 / 6, 0.8), (0.6, 0.85))
"""Hue (in turns) and least saturation of three things of the room, as they are drawn."""


@pytest.fixture(scope="module")
def run_dir(demo_run: Path) -> Path:
    return demo_run.parent


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("log") / "viewer.log"


@pytest.fixture(scope="module")
def address(run_dir: Path, log: Path) -> Iterator[str]:
    with ns_viewer(run_dir / "config.yml", log, cwd=run_dir.parents[3]) as address:
        yield address
    assert faults(log.read_text()) == []


@pytest.fixture(scope="module")
def tab(address: str, pictures: Path) -> Iterator[Tab]:
    with chromium() as browser:
        tab = Tab(browser, address)
        tab.page.screenshot(path=pictures / "panel_fresh.png")
        tab.press("Hide Train Cams")
        tab.settle()
        yield tab
        assert tab.problems == []


def test_the_panel_is_found_without_scrolling(tab: Tab) -> None:
    for button in ("Ask", "Hide", "Undo", "Clear"):
        box = tab.page.get_by_role("button", name=button, exact=True).bounding_box()
        assert box is not None and box["y"] + box["height"] < 1000
    assert "red" in tab.field("Prompts").input_value()  # the stored question
    tab.says("object 1")  # that it has found
    assert tab.images("svg") == 3


def test_a_person_asks_and_sees_the_answer(tab: Tab, pictures: Path) -> None:
    photo = tab.picture()
    things = {name: hue_mask(photo, *rule) for name, rule in (("red", RED), ("yellow", YELLOW), ("blue", BLUE))}
    assert all(mask.sum() > 3000 for mask in things.values()), {name: mask.sum() for name, mask in things.items()}

    tab.field("Prompts").fill("red")
    tab.page.wait_for_timeout(200)
    tab.field("Prompts").press("Enter")
    tab.until(lambda: tab.answered() == 1, "asked by the key")
    tab.settle()
    tab.page.screenshot(path=pictures / "panel_overlay.png")
    overlay = coloured(tab.picture())
    print("overlay of red: IoU", iou(overlay, things["red"]))
    assert iou(overlay, things["red"]) > 0.7
    some = tab.selected()

    tab.type("Threshold", "0.98")
    tab.until(lambda: 0 <= tab.selected() < some, "fewer above a higher threshold")
    tab.press("Undo")
    tab.until(lambda: tab.selected() == some, "undone")
    tab.type("Minimum reliability", "0.75")
    tab.until(lambda: 0 < tab.selected() < some, "fewer are well evidenced")
    tab.press("Undo")
    tab.until(lambda: tab.selected() == some, "undone again")

    tab.type("Prompts", "red, yellow; bright blue, glorp")
    tab.press("Ask")
    tab.until(lambda: tab.answered() == 3, "the three that are known")
    tab.says("⚠")
    tab.show("segmentation")
    tab.settle()
    tab.page.screenshot(path=pictures / "panel_segmentation.png")
    classes = tab.picture()
    colours = {name: classes[mask].mean(axis=0) for name, mask in things.items()}
    print("colours of the segmentation", colours)
    assert colours["red"][0] > 150 > colours["red"][1:].max()
    assert colours["yellow"][:2].min() > 150 > colours["yellow"][2]
    assert colours["blue"][2] > 150 > colours["blue"][0]

    tab.show("reliability")
    tab.settle()
    tab.page.screenshot(path=pictures / "panel_reliability.png")
    tab.show("relevancy_yellow")
    tab.settle()
    tab.page.screenshot(path=pictures / "panel_relevancy.png")
    tab.type("Prompts", "red")
    tab.press("Ask")
    tab.until(lambda: tab.answered() == 1, "asked again")
    tab.page.wait_for_timeout(1000)
    assert tab.output() == "overlay"  # relevancy_yellow is no output any more


def test_a_person_clicks_cancels_hides_and_undoes(tab: Tab, run_dir: Path, pictures: Path) -> None:
    tab.press("Clear")
    tab.until(lambda: "No query yet." in tab.status() and tab.field("Prompts").input_value() == "", "cleared")
    tab.show("rgb")
    tab.settle()
    photo = tab.picture()
    things = {name: hue_mask(photo, *rule) for name, rule in (("red", RED), ("yellow", YELLOW))}
    for end in ("Escape", "Cancel"):
        tab.press("More like this")
        tab.says("Click on something in the scene")
        tab.page.keyboard.press("Escape") if end == "Escape" else tab.press("Cancel")
        tab.until(lambda: "Click on something" not in tab.status(), f"disarmed by {end}")
        tab.click(*middle(things["yellow"]))
        tab.page.wait_for_timeout(500)
        assert tab.selected() == -1
    tab.press("More like this")
    tab.says("Click on something in the scene")
    tab.click(*middle(things["yellow"]))
    tab.until(lambda: tab.selected() > 0, "clicked")
    assert tab.field("Prompts").input_value() == "like click 1"
    tab.settle()
    tab.page.screenshot(path=pictures / "panel_click.png")
    overlay = coloured(tab.picture())
    print("clicked yellow: IoU", iou(overlay, things["yellow"]))
    assert iou(overlay, things["yellow"]) > 0.55
    alike = tab.selected()

    with tab.page.expect_download() as download:
        tab.press("Download selection")
    vertices = PlyData.read(str(download.value.path()))["vertex"]
    assert 0.8 * alike < vertices.count <= alike
    colours = np.stack([vertices[f"f_dc_{i}"] for i in range(3)], axis=1).mean(axis=0) * 0.2821 + 0.5
    assert colours[:2].min() > 0.6
    assert colours[2] < 0.35
    panel = tab.page.locator("[role=tabpanel]:visible").bounding_box()
    assert panel is not None and panel["width"] <= 320  # nothing makes it wider

    tab.press("Save prompts in run")
    tab.says("the run stores 5 prompts now")
    question = load_question(run_dir / "normlift")
    assert question is not None
    assert question.texts == ("red", "yellow", "sky blue", "dark green", "like click 1")

    tab.show("rgb")
    tab.press("Hide")
    tab.until(lambda: "are hidden" in tab.status(), "hidden")
    tab.type("Prompts", "red")
    tab.press("Ask")
    tab.until(lambda: tab.answered() == 1 and tab.selected() != alike, "asked")
    tab.press("Hide")
    tab.show("rgb")
    tab.settle()
    tab.page.screenshot(path=pictures / "panel_hidden.png")
    bare = tab.picture()
    for name, rule in (("red", RED), ("yellow", YELLOW)):
        assert hue_mask(bare, *rule).sum() < 0.15 * things[name].sum()
    for _ in range(3):
        tab.press("Undo")
        tab.page.wait_for_timeout(300)
    tab.until(lambda: "are hidden" not in tab.status(), "undone")
    tab.settle()
    assert iou(hue_mask(tab.picture(), *YELLOW), things["yellow"]) > 0.9
    tab.press("Only")
    tab.settle()
    tab.page.screenshot(path=pictures / "panel_only.png")
    assert iou(hue_mask(tab.picture(), *YELLOW), things["yellow"]) > 0.6
    assert (np.abs(tab.picture().astype(int) - (38, 42, 55)).max(axis=2) < 12).mean() > 0.7  # the background
    tab.press("All")


def test_a_person_sees_objects_reasons_and_floaters(tab: Tab, pictures: Path) -> None:
    tab.type("Prompts", "red")
    tab.press("Ask")
    tab.until(lambda: tab.answered() == 1 and tab.images("svg") == 1, "a row of the table and a histogram")
    tab.says("object 1")
    tab.show("overlay")
    tab.settle()
    before, red = tab.picture(), tab.selected()
    for name, deed in (("go to", None), ("hide", "are hidden")):
        tab.page.get_by_role("button", name=name, exact=True).first.click()
        if deed is not None:
            tab.says(deed)
    tab.settle()
    tab.page.screenshot(path=pictures / "panel_objects.png")
    assert np.abs(tab.picture().astype(int) - before).mean() > 3  # the camera has moved
    tab.press("Undo")
    with tab.page.expect_download() as download:
        tab.page.get_by_role("button", name="export", exact=True).first.click()
    assert download.value.suggested_filename == "red_1.ply"

    tab.press("Why?")
    tab.says("These weigh most:")
    tab.until(lambda: tab.images("jpeg") >= 3, "photographs")
    tab.page.get_by_text("These weigh most:").scroll_into_view_if_needed()
    tab.page.screenshot(path=pictures / "panel_why.png")
    tab.press("Suggested")
    tab.until(lambda: 0.55 < float(tab.field("Threshold").input_value()) < 0.75, "another threshold")
    tab.type("Threshold", "0.995")
    tab.until(lambda: tab.selected() < red and tab.images("jpeg") == 0, "another selection has other reasons")
    tab.type("Threshold", "0.5")
    tab.until(lambda: tab.selected() == red, "the threshold is as it was")

    tab.press("Select likely floaters")
    tab.says("then press Hide")
    tab.until(lambda: 0 < tab.selected() < 1500, "some")
    tab.settle()
    tab.page.screenshot(path=pictures / "panel_floaters.png")
    tab.press("Hide")
    tab.says("are hidden")
    tab.press("Undo")
    tab.press("Undo")
    tab.until(lambda: tab.selected() == red, "as before")

    tab.type("Prompts", "orchid")
    tab.press("Ask")
    tab.says("orchid: probably not in this scene. The nearest match at")
    panel = tab.page.locator("[role=tabpanel]:visible").bounding_box()
    assert panel is not None and panel["width"] <= 320
    tab.page.screenshot(path=pictures / "panel_absent.png")


def test_a_click_selects_an_object_which_grows_and_shrinks(tab: Tab, pictures: Path) -> None:
    tab.press("Clear")
    tab.until(lambda: "No query yet." in tab.status(), "cleared")
    tab.show("rgb")
    tab.settle()
    photo = tab.picture()
    things = {name: hue_mask(photo, *rule) for name, rule in (("red", RED), ("yellow", YELLOW))}
    counts = []
    for button, name in (("Select", "red"), ("Add", "yellow"), ("Drop", "red")):
        before = tab.selected()
        tab.press(button)
        tab.says("Click on something in the scene")
        tab.click(*middle(things[name]))
        tab.until(lambda before=before: tab.selected() not in (before, -1), button)
        counts.append(tab.selected())
    red, both, yellow = counts
    assert both == red + yellow
    tab.type("Grow", "-7")
    tab.until(lambda: 0 < tab.selected() < yellow, "a part")
    part = tab.selected()
    tab.settle()
    tab.page.screenshot(path=pictures / "panel_part.png")
    shown = coloured(tab.picture())
    print("part of the yellow thing:", (shown & things["yellow"]).sum() / things["yellow"].sum())
    assert 0.02 < (shown & things["yellow"]).sum() / things["yellow"].sum() < 0.9
    assert (shown & ~things["yellow"]).sum() < 0.1 * things["yellow"].sum()
    tab.type("Grow", "3")
    tab.until(lambda: tab.selected() > max(part, yellow), "more than the whole")
    tab.press("Undo")
    tab.until(lambda: tab.selected() == yellow, "the whole")
    tab.press("Clear")


def test_two_tabs_and_everything_at_once(tab: Tab, address: str, log: Path) -> None:
    other = Tab(tab.page.context.browser, address)  # type: ignore[arg-type]
    tab.show("overlay")
    tab.type("Prompts", "red; yellow")
    tab.press("Ask")
    other.until(lambda: other.answered() == 2 and other.selected() == tab.selected() > 0, "both tabs agree")
    tab.press("More like this")
    tab.says("Click on something in the scene")
    other.click(300, 400)  # is not the click that the first tab waits for
    other.page.wait_for_timeout(500)
    assert "Click on something" in tab.status()
    tab.press("Cancel")
    for i in range(4):  # a prompt typed while the camera moves, asked while the picture is drawn
        other.drag(40 * (-1) ** i, 10)
        tab.field("Prompts").press_sequentially(" ; blue"[: 3 + i], delay=30)
        other.drag(-40 * (-1) ** i, -10)
        tab.press("Ask")
    tab.type("Prompts", "red")
    tab.press("Ask")
    tab.until(lambda: tab.answered() == 1 and 0 < tab.selected() < 1000, "only red is left")
    for text, prompts in (("yellow", 1), (", ".join(f"red {i}" for i in range(50)), 8), ("x" * 10_000, 8)):
        tab.type("Prompts", text)
        tab.press("Ask")
        other.drag(15, 0)
        for one in (tab, other):
            one.until(lambda one=one, prompts=prompts: one.answered() == prompts, f"asked {text[:20]!r}")
    assert len(tab.status()) < 5000
    other.until(lambda: "xxxx" in other.status(), "the message in both")
    tab.press("Clear")
    other.until(lambda: "xxxx" not in other.status() and "No query yet." in other.status(), "cleared")
    assert other.problems == []
    other.page.close()
    assert faults(log.read_text()) == []


def test_a_phone(tab: Tab, address: str, pictures: Path) -> None:
    phone = Tab(tab.page.context.browser, address, size=(390, 700))  # type: ignore[arg-type]
    phone.type("Prompts", "red, sky blue")
    phone.press("Ask")
    phone.until(lambda: phone.answered() == 2, "an answer")
    phone.page.wait_for_timeout(1500)
    phone.page.screenshot(path=pictures / "panel_phone.png")
    assert phone.page.evaluate("document.documentElement.scrollWidth") <= 390
    for name in ("Ask", "Undo", "Clear", "Hide", "Why?", "Download selection"):
        box = phone.page.get_by_role("button", name=name, exact=True).first.bounding_box()
        assert box is not None
        assert box["x"] >= 0
        assert box["x"] + box["width"] <= 390
    assert phone.problems == []
    phone.page.close()
