"""A person before ns-normlift-view: the browser draws the demo room, and every browser has its own question."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from plyfile import PlyData

from normlift_ns.runs.question import load_question
from tests.browser.own_viewer import Own, free_port, own_viewer
from tests.browser.viewer import CHROMIUM, WITHOUT_WEBGL, chromium, hue_mask, iou, middle

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(CHROMIUM is None, reason="no Chromium here: install Debian's package chromium"),
]
RED, PURPLE = (0, 0.9), (0.79, 0.6)
"""Hue (in turns) and least saturation of two things in the room, as they are drawn."""


@pytest.fixture(scope="module")
def address(demo_run: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    with own_viewer(demo_run, tmp_path_factory.mktemp("log") / "view.log") as address:
        yield address


def bright(picture: np.ndarray) -> np.ndarray:
    """Pixels that are not grey."""
    return np.ptp(picture.astype(int), axis=2) > 60


def test_a_person_asks_hides_clicks_and_downloads(address: str, demo_run: Path, pictures: Path, tmp_path: Path) -> None:
    with chromium() as browser:
        own = Own(browser, address)
        own.says("The run stores these prompts")
        photo = own.picture()
        own.page.screenshot(path=pictures / "view_start.png")
        red, purple = hue_mask(photo, *RED), hue_mask(photo, *PURPLE)
        assert min(red.sum(), purple.sum()) > 1000

        own.ask("red, zebra; purple", key=True)
        own.until(lambda: own.selected() > 0, "an answer")
        assert "contains no colour name" in own.text()
        overlay = own.picture()
        own.page.screenshot(path=pictures / "view_asked.png")
        print("overlay of red and purple: IoU", iou(bright(overlay), red | purple))
        assert iou(bright(overlay), red | purple) > 0.75
        both = own.selected()

        own.field("Threshold").fill("0.97")
        own.until(lambda: 0 <= own.selected() < both, "a higher threshold selects less")
        own.press("Undo")
        own.until(lambda: own.selected() == both, "undone")

        own.press("Select")
        own.says("Click on an object.")
        own.press("Cancel")
        own.until(lambda: "Click on an object." not in own.text(), "cancelled")
        own.page.mouse.click(*middle(red))
        own.page.wait_for_timeout(500)
        assert own.selected() == both
        own.press("Select")
        own.says("Click on an object.")
        own.page.mouse.click(*middle(red))
        own.until(lambda: 0 < own.selected() < both, "the connected object")
        ball = own.selected()
        own.press("Add")
        own.says("Click on objects.")
        own.page.mouse.click(*middle(purple))
        own.until(lambda: own.selected() > ball, "added")
        own.page.keyboard.press("Escape")
        own.until(lambda: "Click on" not in own.text(), "Escape ends it")
        own.press("Undo")
        own.until(lambda: own.selected() == ball, "the ball alone")

        own.press("Hide")
        own.until(lambda: hue_mask(own.picture(), *RED).sum() < 50, "the ball is hidden")
        own.ask("purple")
        own.until(lambda: "■ purple object 1" in own.text(), "purple is asked")
        own.press("Hide")
        own.page.wait_for_timeout(800)
        rest = own.picture()
        own.page.screenshot(path=pictures / "view_hidden.png")
        assert bright(rest)[red | purple].mean() < 0.05, "both stay hidden"
        for _ in range(3):
            own.press("Undo")
        own.until(lambda: own.selected() == ball, "hides undone")
        own.press("Redo")
        own.press("Redo")

        own.ask("red, purple")
        own.press("Unhide")
        own.says("red object 1")
        own.press("go to")
        own.page.wait_for_timeout(1500)
        near = own.picture()
        own.page.screenshot(path=pictures / "view_go_to.png")
        assert np.abs(near.astype(int) - overlay).mean() > 3
        with own.page.expect_download() as waiting:
            own.press("export")
        file = tmp_path / waiting.value.suggested_filename
        waiting.value.save_as(file)
        vertices = PlyData.read(file)["vertex"]
        colours = np.stack([vertices[f"f_dc_{i}"] for i in range(3)], axis=1).mean(axis=0) * 0.2821 + 0.5
        assert file.name == "red_1.ply"
        assert 50 < vertices.count <= both
        assert colours[0] > 0.5 > max(colours[1:]) + 0.2

        own.press("More like this")
        own.says("Click on an object.")
        own.page.mouse.click(*middle(bright(near)))
        own.says("like click 1")
        own.press("Save prompts in run")
        own.until(lambda: "The run stores" in own.text() or "cannot be saved" in own.text(), "saved")
        own.page.screenshot(path=pictures / "view_saved.png")
        question = load_question(demo_run.parent / "normlift")
        assert question is not None
        assert question.texts == ("red", "yellow", "sky blue", "dark green", "like click 1")
        own.ask("like click 1, red")
        own.until(lambda: own.text().count("■") >= 2, "the click is asked again")
        assert own.problems == []


def test_a_person_asks_why_and_takes_floaters_away(address: str, pictures: Path) -> None:
    with chromium() as browser:
        own = Own(browser, address, (960, 1400))
        own.ask("red, orchid")
        own.until(lambda: own.selected() > 0 and own.images("svg") == 2, "two histograms")
        both = own.selected()
        own.press("Suggested")
        own.until(lambda: own.selected() not in (both, -1), "another threshold")
        own.press("Undo")
        own.until(lambda: own.selected() == both, "undone")
        own.press("Why?")
        own.says("These weigh most:")
        own.until(lambda: own.images("jpeg") >= 3, "photographs")
        own.page.screenshot(path=pictures / "view_why.png")
        assert "The photographs" in own.text()
        assert "of the weight" in own.text()

        photo = own.picture()
        own.press("Select likely floaters")
        own.says("then press Hide")
        own.until(lambda: own.images("jpeg") == 0, "the reasons of another selection are gone")
        floaters = own.selected()
        assert 0 < floaters < 1500
        assert bright(own.picture()).sum() > 20
        own.page.screenshot(path=pictures / "view_floaters.png")
        own.press("Hide")
        own.page.wait_for_timeout(800)
        assert np.abs(own.picture().astype(int) - photo).mean() > 0.05
        own.press("Undo")
        own.press("Undo")
        own.until(lambda: own.selected() == both, "floaters are back")

        own.ask("orchid")
        own.until(lambda: own.selected() not in (both, -1) and own.images("svg") == 1, "one prompt, one histogram")
        own.says("orchid: probably not in this scene. The nearest match at")
        own.page.screenshot(path=pictures / "view_absent.png")
        before = own.picture()
        own.press("Go to nearest: orchid")
        own.until(lambda: np.abs(own.picture().astype(int) - before).mean() > 3, "the camera is there")
        own.page.screenshot(path=pictures / "view_nearest.png")
        own.ask("red")
        own.until(lambda: own.button("Go to nearest: orchid").count() == 0, "red is there")
        assert own.problems == []


def test_two_browsers_have_their_own_questions_and_come_back(demo_run: Path, pictures: Path, tmp_path: Path) -> None:
    port = free_port()
    with chromium() as browser:
        with own_viewer(demo_run, tmp_path / "first.log", port=port) as address:
            one, two = Own(browser, address), Own(browser, address)
            one.ask("red")
            two.ask("purple, teal")
            one.until(lambda: one.selected() > 0, "one asks")
            two.until(lambda: two.selected() > 0, "two asks")
            red, teal = one.selected(), two.selected()
            assert red != teal
            assert "purple" not in one.text()
            one.press("Hide")
            one.page.wait_for_timeout(500)
            one.page.reload()
            one.ready()
            one.until(lambda: one.selected() == red, "a reload keeps question and hides")
            assert bright(one.picture()).sum() < 50
            assert one.field("Prompts").input_value() == "red"
            one.press("Undo")
            one.until(lambda: bright(one.picture()).sum() > 1000, "history comes back too: the hide is undone")
            one.press("Redo")
            one.until(lambda: bright(one.picture()).sum() < 50, "and done again")
            one.press("Undo")
            one.until(lambda: bright(one.picture()).sum() > 1000, "undone")
            two.context.set_offline(True)
            two.page.wait_for_timeout(1000)
            two.context.set_offline(False)
            assert two.selected() == teal
            assert [tab.problems for tab in (one, two)] == [[], []]
            two.context.close()

            one.press("Link")
            one.until(lambda: "?q=" in one.page.url, "a link")
            before, link = one.picture(), one.page.url
            one.context.close()
            three = Own(browser, link)
            three.until(lambda: three.selected() == red, "the link asks its question")
            assert np.abs(three.picture().astype(int) - before).mean() < 6
            three.page.screenshot(path=pictures / "view_link.png")
        with own_viewer(demo_run, tmp_path / "again.log", "--share-readonly", "True", port=port):
            three.until(lambda: three.button("Save prompts in run").count() == 0, "the page finds the new server", 60)
            three.until(lambda: three.selected() == red, "its link brings the question back", 60)  # the run is opened
            assert three.button("Save prompts in run").count() == 0
            assert three.problems == []


def test_a_saved_click_is_asked_after_a_restart(demo_run: Path, pictures: Path, tmp_path: Path) -> None:
    stored = demo_run.parent / "normlift"
    shutil.copytree(stored, tmp_path / "kept")
    try:
        with chromium() as browser:
            with own_viewer(demo_run, tmp_path / "first.log") as address:
                own = Own(browser, address)
                own.press("More like this")
                own.says("Click on an object.")
                own.page.mouse.click(*middle(hue_mask(own.picture(), *PURPLE)))
                own.until(lambda: own.selected() > 0, "what is like it")
                alike, name = own.selected(), own.field("Prompts").input_value()
                own.press("Save prompts in run")
                own.says("The run stores")
                own.context.close()
            with own_viewer(demo_run, tmp_path / "again.log") as address:
                own = Own(browser, address)
                own.says("The run stores these prompts")
                assert name in own.field("Prompts").input_value()
                own.ask(name)
                own.until(lambda: own.selected() == alike, "the same answer")
                overlay = own.picture()
                own.page.screenshot(path=pictures / "view_click_again.png")
                assert bright(overlay).sum() > 1000
                assert own.problems == []
    finally:
        shutil.rmtree(stored)
        shutil.copytree(tmp_path / "kept", stored)


def test_a_phone(address: str, pictures: Path) -> None:
    with chromium() as browser:
        own = Own(browser, address, (390, 700))
        own.ask("red, sky blue")
        own.until(lambda: own.selected() > 0, "an answer")
        own.page.wait_for_timeout(1500)
        own.page.screenshot(path=pictures / "view_phone.png")
        width = own.page.evaluate("document.documentElement.scrollWidth")
        assert width <= 390
        for name in ("Ask", "Cancel", "Select"):
            box = own.button(name).bounding_box()
            assert box is not None
            assert box["x"] >= 0
            assert box["x"] + box["width"] <= 390
        assert own.problems == []


def test_a_browser_without_webgl_gets_pictures_from_the_server(address: str, pictures: Path) -> None:
    with chromium() as browser:
        able = Own(browser, address)
        drawn = able.picture()
        assert able.page.locator("#normlift_still").count() == 0
        able.context.close()
    with chromium(*WITHOUT_WEBGL) as browser:
        own = Own(browser, address)
        assert not own.page.evaluate("document.createElement('canvas').getContext('webgl') instanceof Object")
        own.says("no WebGL 2")
        own.until(lambda: own.page.locator("#normlift_still").count() == 1, "a picture")
        photo = own.picture()
        own.page.screenshot(path=pictures / "view_without_webgl.png")
        red, purple = hue_mask(photo, *RED), hue_mask(photo, *PURPLE)
        for mask, rule in ((red, RED), (purple, PURPLE)):
            print("as the browser draws: IoU", iou(mask, hue_mask(drawn, *rule)))
            assert iou(mask, hue_mask(drawn, *rule)) > 0.8

        own.ask("red", key=True)
        own.until(lambda: own.selected() > 0, "an answer")
        assert iou(bright(own.picture()), red) > 0.7
        own.press("Select")
        own.says("Click on an object.")
        own.page.mouse.click(*middle(purple))
        own.until(lambda: iou(bright(own.picture()), purple) > 0.7, "the other object")
        own.press("Hide")
        own.until(lambda: hue_mask(own.picture(), *PURPLE).sum() < 50, "hidden")
        before = own.picture()
        own.page.mouse.move(300, 200)
        own.page.mouse.down()
        own.page.mouse.move(380, 220, steps=8)
        own.page.mouse.up()
        own.until(lambda: np.abs(own.picture().astype(int) - before).mean() > 3, "the camera has turned")
        own.page.screenshot(path=pictures / "view_without_webgl_turned.png")
        assert own.problems == []


def test_held_keys_add_and_take_away(address: str, pictures: Path) -> None:
    with chromium() as browser:
        own = Own(browser, address)
        photo = own.picture()
        red, purple = hue_mask(photo, *RED), hue_mask(photo, *PURPLE)

        def click_holding(key: str, mask: np.ndarray) -> None:
            own.page.keyboard.down(key)
            own.says("Click on objects.")
            own.page.mouse.click(*middle(mask))
            own.page.wait_for_timeout(100)
            own.page.keyboard.up(key)
            own.until(lambda: "Click on" not in own.text(), "released")

        click_holding("Shift", red)
        own.until(lambda: own.selected() > 0, "the ball")
        ball = own.selected()
        click_holding("Shift", purple)
        own.until(lambda: own.selected() > ball, "both")
        both = own.selected()
        assert iou(bright(own.picture()), red | purple) > 0.6
        own.page.screenshot(path=pictures / "view_shift.png")
        click_holding("Alt", red)
        own.until(lambda: own.selected() == both - ball, "the ball is taken away")
        own.page.mouse.click(*middle(red))
        own.page.wait_for_timeout(500)
        assert own.selected() == both - ball
        own.page.keyboard.press("Control+z")
        own.until(lambda: own.selected() == both, "undone by keys")
        own.page.keyboard.press("Control+Shift+z")
        own.until(lambda: own.selected() == both - ball, "done again by keys")
        own.field("Prompts").press_sequentially("RED", delay=50)  # Shift within a text is no click
        own.page.keyboard.down("Shift")
        own.page.wait_for_timeout(500)
        own.page.keyboard.up("Shift")
        assert "Click on" not in own.text()
        assert own.problems == []


def test_a_box_is_drawn_and_cuts(address: str, pictures: Path) -> None:
    with chromium() as browser:
        own = Own(browser, address)
        own.ask("purple")
        own.until(lambda: own.selected() > 0, "an answer")
        whole, bare = own.selected(), own.picture()
        own.page.get_by_text("Box", exact=True).click()
        own.press("Around")
        own.until(lambda: np.abs(own.picture().astype(int) - bare).max() > 60, "the outline")
        boxed = own.picture()
        own.page.screenshot(path=pictures / "view_box.png")
        line = np.abs(boxed.astype(int) - bare).max(axis=2) > 60
        print("the outline covers", line.sum(), "pixels of the colour", boxed[line].mean(axis=0))
        assert 200 < line.sum() < 0.1 * line.size
        red, green, blue = boxed[line].mean(axis=0)
        assert red > green + 30 > blue + 60
        assert own.selected() == whole
        (top, bottom), (left, right) = ((np.nonzero(line)[i].min(), np.nonzero(line)[i].max()) for i in (0, 1))
        inside = np.zeros_like(line)
        inside[top : bottom + 1, left : right + 1] = True
        assert (bright(bare) & inside).sum() > 0.95 * bright(bare).sum()

        height = (
            own.page.get_by_text("Size", exact=True).locator("xpath=ancestor::*[.//input][1]").locator("input").last
        )
        height.fill(f"{float(height.input_value()) / 2:.3f}")
        own.page.wait_for_timeout(300)
        own.press("Inside")
        own.until(lambda: 0 < own.selected() < whole, "cut")
        own.page.screenshot(path=pictures / "view_box_cut.png")
        own.press("None")
        own.until(lambda: own.selected() == whole, "whole again")
        own.until(lambda: np.abs(own.picture().astype(int) - bare).mean() < 1, "the picture as before")
        assert own.problems == []
