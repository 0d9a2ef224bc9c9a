"""A person before ns-normlift-view: the browser draws the demo room, and every browser has its own question."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pytest
from plyfile import PlyData

from normlift_ns.query.question import load_query
from tests.browser.person import ARMED, RED, YELLOW, changed, coloured, covers, hue_mask, iou, middle, needs_chromium
from tests.browser.server import Server
from tests.browser.viewer import Own, Tab

if TYPE_CHECKING:
    from playwright.sync_api import Browser

pytestmark = [pytest.mark.slow, needs_chromium]


def red_and_yellow(page: Own) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The picture once the room is drawn, and where two of its things are."""
    photo = page.sees(lambda seen: min(hue_mask(seen, *rule).sum() for rule in (RED, YELLOW)) > 1000, "the room")
    return photo, hue_mask(photo, *RED), hue_mask(photo, *YELLOW)


def test_a_person_asks_hides_clicks_and_downloads(page: Own, own: Server, tmp_path: Path) -> None:
    _, red, yellow = red_and_yellow(page)
    page.ask("red, zebra; yellow", key=True)
    both = page.selects(lambda count: count > 0, "an answer")
    page.says(r"⚠\s+zebra")
    overlay = page.sees(lambda seen: covers(seen, red | yellow), "an overlay of both")
    page.type("Threshold", "0.97")
    page.selects(lambda count: count < both, "a higher threshold selects less")
    page.press("Undo")
    page.selects(lambda count: count == both, "undone")

    page.arm("Select")
    page.press("Cancel")
    page.until(lambda: ARMED not in page.text(), "cancelled")
    page.click(middle(yellow))  # does nothing, or there would be one more to undo below
    page.arm("Select")
    page.click(middle(red))
    ball = page.selects(lambda count: 0 < count < both, "the connected object")
    page.arm("Add")
    page.click(middle(yellow))
    page.selects(lambda count: count > ball, "added")
    page.page.keyboard.press("Escape")
    page.until(lambda: ARMED not in page.text(), "Escape ends it")
    for count in (ball, both):
        page.press("Undo")
        page.selects(lambda found, count=count: found == count, "undone")
    page.press("Redo")
    page.selects(lambda count: count == ball, "the ball again")

    page.press("Hide")
    page.sees(lambda seen: hue_mask(seen, *RED).sum() < 50, "the ball is hidden")
    page.ask("yellow")
    page.says("yellow object 1")
    page.press("Hide")
    page.sees(lambda seen: coloured(seen)[red | yellow].mean() < 0.05, "both stay hidden")
    for _ in range(3):
        page.press("Undo")
    page.selects(lambda count: count == ball, "hides undone")

    page.hit(page.page.get_by_text("Box", exact=True))
    page.press("Around")
    page.until(lambda: page.typed("Size") != "1", "the box is around the ball")  # Outside reads it
    page.press("Outside")
    page.selects(lambda count: count == 0, "cut")
    page.press("None")
    page.selects(lambda count: count == ball, "whole again")

    page.ask("red, maroon")
    page.until(lambda: page.images("svg") == 2, "two histograms")
    page.press("Why?")
    page.until(lambda: page.images("jpeg") >= 3, "photographs")
    page.ask("red, yellow")
    page.says("red object 1")
    page.press("go to")
    page.sees(lambda seen: changed(seen, overlay) > 3, "the camera has moved")
    file = page.save("export", tmp_path)
    vertices = PlyData.read(file, mmap=False)["vertex"]
    assert file.name == "red_1.ply" and 50 < vertices.count <= both


def test_browsers_have_their_own_questions_and_outlive_the_server(own: Server, browser: Browser) -> None:
    one, two = Own(browser, own.address), Own(browser, own.address)
    one.ask("red")
    two.ask("yellow, teal")
    red = one.selects(lambda count: count > 0, "one asks")
    teal = two.selects(lambda count: count not in (0, red), "two asks something else")
    assert "yellow" not in one.text()
    one.sees(lambda seen: coloured(seen).sum() > 1000, "an overlay")
    one.press("Hide")
    one.sees(lambda seen: coloured(seen).sum() < 50, "hidden")
    one.page.reload()
    one.ready()
    one.selects(lambda count: count == red, "a reload keeps the question")
    one.sees(lambda seen: coloured(seen).sum() < 50, "and what is hidden")
    assert one.typed("Prompts") == "red"
    for button, hides in (("Undo", False), ("Redo", True), ("Undo", False)):
        one.press(button)
        one.sees(lambda seen, hides=hides: (coloured(seen).sum() < 50) == hides, f"history comes back too: {button}")

    photo = two.sees(lambda seen: hue_mask(seen, *YELLOW).sum() > 1000, "what is yellow")
    two.arm("More like this")
    two.click(middle(hue_mask(photo, *YELLOW)))
    two.until(lambda: two.typed("Prompts") == "like click 1" and two.selected() not in (-1, teal), "what is like it")
    alike = two.selected()
    two.press("Save prompts in run")
    two.says("3 prompts")
    question = load_query(own.config.parent / "normlift")
    assert question is not None and question.texts == ("red", "yellow", "like click 1")
    two.leave()

    one.press("Link")
    one.until(lambda: "?q=" in one.page.evaluate("location.search"), "a link")
    link = one.page.evaluate("location.href")
    before = one.sees(lambda seen: coloured(seen).sum() > 1000, "an overlay")
    one.leave()
    three = Own(browser, link)
    three.selects(lambda count: count == red, "the link asks its question")
    three.sees(lambda seen: changed(seen, before) < 6, "from its camera")

    own.start("--read-only", "True")
    three.until(lambda: three.button("Save prompts in run").count() == 0, "the page finds the new server")
    three.selects(lambda count: count == red, "its link brings the question back")
    assert three.button("Save prompts in run").count() == 0
    three.leave()
    four = Own(browser, own.address)
    assert four.typed("Prompts") == "red, yellow, like click 1"
    four.ask("like click 1")
    four.selects(lambda count: count == alike, "the same answer to the stored click")
    four.sees(lambda seen: coloured(seen).sum() > 1000, "an overlay")
    four.leave()


def test_a_phone(own: Server, stock: Server, browser: Browser) -> None:
    buttons = ("Ask", "Undo", "Clear", "Hide", "Why?", "Download selection")
    for server, kind, fits in ((own, Own, ("Ask", "Cancel", "Select")), (stock, Tab, buttons)):
        phone = kind(browser, server.address, (390, 700))
        if isinstance(phone, Tab):
            phone.fresh()
        phone.ask("red, sky blue")
        phone.selects(lambda count: count > 0, "an answer")
        phone.until(lambda phone=phone: phone.images("svg") == 2, "histograms")
        phone.fits(*fits)
        phone.leave()


def test_a_browser_without_webgl_gets_pictures_from_the_server(page: Own, own: Server, browser: Browser) -> None:
    _, *drawn = red_and_yellow(page)
    assert page.page.locator("#normlift_still").count() == 0
    blind = Own(browser, own.address, webgl=False)
    blind.says("no WebGL 2")
    blind.until(lambda: blind.page.locator("#normlift_still").count() == 1, "a picture")

    def as_drawn(seen: np.ndarray) -> bool:
        return all(iou(mask, hue_mask(seen, *rule)) > 0.8 for mask, rule in zip(drawn, (RED, YELLOW)))

    photo = blind.sees(as_drawn, "what the browser draws")
    red, yellow = hue_mask(photo, *RED), hue_mask(photo, *YELLOW)
    blind.ask("red", key=True)
    blind.sees(lambda seen: covers(seen, red), "an overlay")
    blind.arm("Select")
    blind.click(middle(yellow))
    blind.sees(lambda seen: covers(seen, yellow), "the other object")
    blind.press("Hide")
    before = blind.sees(lambda seen: hue_mask(seen, *YELLOW).sum() < 50, "hidden")
    blind.drag(80, 20)
    blind.sees(lambda seen: changed(seen, before) > 3, "the camera has turned")
    blind.leave()


def test_held_keys_add_and_take_away(page: Own) -> None:
    _, red, yellow = red_and_yellow(page)

    page.click_holding("Shift", middle(red))
    ball = page.selects(lambda count: count > 0, "the ball")
    page.click_holding("Shift", middle(yellow))
    both = page.selects(lambda count: count > ball, "both")
    page.sees(lambda seen: covers(seen, red | yellow), "an overlay of both")
    page.click_holding("Alt", middle(red))
    page.selects(lambda count: count == both - ball, "the ball is taken away")
    page.click(middle(red))  # does nothing, or there would be one more to undo
    for keys, count in (("Control+z", both), ("Control+Shift+z", both - ball)):
        page.page.keyboard.press(keys)
        page.selects(lambda found, count=count: found == count, keys)
    session = page.page.locator('xpath=//label[text()="Session"]/ancestor::*[.//input][1]//input').first
    page.until(lambda: '"held":""' in session.input_value(), "Shift is released")
    page.field("Prompts").press_sequentially("RED", delay=50)
    page.page.keyboard.down("Shift")  # within a text it holds nothing
    page.page.evaluate("new Promise(setTimeout)")  # after what waits for a moment
    assert '"held":""' in session.input_value()
    page.page.keyboard.up("Shift")
