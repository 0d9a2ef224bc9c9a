"""A person before the page of ns-normlift-view, and before nerfstudio's viewer: asks, selects, exports, comes back."""

from __future__ import annotations

import re
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pytest
from PIL import Image
from plyfile import PlyData

from normlift_ns.query.question import load_query
from tests.browser.page import OnPage
from tests.browser.person import ARMED, BLUE, RED, YELLOW, changed, coloured, hue_mask, iou, middle, needs_chromium
from tests.browser.server import Server
from tests.browser.viewer import Tab, overlaid

if TYPE_CHECKING:
    from playwright.sync_api import Browser

pytestmark = [pytest.mark.slow, needs_chromium]


_SWATCH_CONTRAST = """() => {
  const light = (css) => css.match(/[\\d.]+/g).slice(0, 3).map((x) => x / 255)
    .map((x) => x <= 0.04045 ? x / 12.92 : ((x + 0.055) / 1.055) ** 2.4)
    .reduce((sum, x, i) => sum + x * [0.2126, 0.7152, 0.0722][i], 0);
  const contrast = (one, other) => {
    const [dark, bright] = [light(one), light(other)].sort((a, b) => a - b);
    return (bright + 0.05) / (dark + 0.05);
  };
  const panel = getComputedStyle(document.querySelector("#panel")).backgroundColor, scene = "rgb(20 23 28)";
  const styles = [...document.querySelectorAll(".swatch")].map((one) => getComputedStyle(one));
  return Math.min(...styles.flatMap((one) => [contrast(one.boxShadow, panel), contrast(one.backgroundColor, scene)]));
}"""
"""The least contrast of the ring of a swatch with the panel, and of its color with the dark scene."""


def things(page: OnPage) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The picture of the room, and where its red and its yellow thing are."""
    photo = page.sees(lambda seen: min(hue_mask(seen, *rule).sum() for rule in (RED, YELLOW)) > 500, "the room")
    return photo, hue_mask(photo, *RED), hue_mask(photo, *YELLOW)


def covers(seen: np.ndarray, where: np.ndarray) -> bool:
    """Whether colors lie there, and hardly elsewhere."""
    return bool(coloured(seen)[where].mean() > 0.8 and coloured(seen)[~where].mean() < 0.03)


def test_a_person_asks(page: OnPage) -> None:
    photo, red, yellow = things(page)
    assert "normlift" in page.page.title() and page.page.locator("#name").inner_text() in page.page.title()
    assert page.page.locator("#examples button").count() >= 2
    assert page.prompts.input_value() == "red, yellow"  # those that the run stores
    assets = "performance.getEntriesByType('resource').filter((one) => one.name.includes('/assets/'))"
    sizes = page.page.evaluate(f"{assets}.map((one) => one.encodedBodySize)")
    assert len(sizes) == 2 and 1e5 < sum(sizes) <= 1.6e6  # compressed

    page.ask("red, zebra; yellow")
    both = page.selects(lambda count: count > 0, "an answer")
    chips = page.chips()
    assert chips[0].startswith("red") and "not understood" in chips[1] and chips[2].startswith("yellow")
    assert all(0 < float(re.findall(r"\d\.\d\d", chips[i])[0]) <= 1 for i in (0, 2))
    seen = page.sees(lambda seen: covers(seen, red | yellow), "an overlay of both")
    colors = "all => all.map((one) => getComputedStyle(one).backgroundColor)"
    for swatch, where in zip(page.page.locator(".swatch").evaluate_all(colors), (red, yellow)):  # one scheme of colors
        rgb = np.array(re.findall(r"\d+", swatch)[:3], dtype=float)
        drawn = np.median(seen[where], axis=0)
        assert np.corrcoef(rgb, drawn)[0, 1] > 0.9

    page.page.locator(".chip", has_text="yellow").click()
    page.sees(lambda seen: covers(seen, yellow), "one answer alone")
    page.page.locator(".chip", has_text="yellow").click()
    page.until(lambda: page.page.locator(".histogram").count() == 2, "two histograms")
    fewer = page.changes(lambda: page.page.locator("#threshold").press("End"), "a higher threshold")
    assert fewer < both
    page.changes(lambda: page.does("do-suggested"), "the suggested threshold")
    page.page.keyboard.press("Control+z")
    page.selects(lambda count: count == fewer, "undone")
    page.page.keyboard.press("Control+z")
    page.selects(lambda count: count == both, "undone")

    page.does("mode-heat")
    heat = page.sees(lambda seen: coloured(seen).mean() > 0.5, "a heat map")
    assert page.page.locator("#mode-heat").get_attribute("aria-checked") == "true"
    assert page.page.locator("#legend").inner_text().startswith("relevancy")
    page.page.locator("#canvas").focus()
    page.page.keyboard.press("4")
    assert changed(page.sees(lambda seen: changed(seen, heat) > 10, "RGB"), photo) < 3

    page.ask(", ".join(f"red {i}" for i in range(65)))
    page.until(lambda: page.page.locator("#answers.stale").count() == 1, "too many: the old answer is dimmed")
    page.ask("glorp")
    page.until(lambda: "not understood" in page.chips()[0] and page.selected() == 0, "no old answer")
    assert "glorp" in page.toast()[0] and len(page.chips()) == 1 and page.page.locator("#answer").is_hidden()
    assert page.page.locator("#answers.stale").count() == 0
    page.does("do-undo")
    page.until(lambda: page.selected() == both and page.prompts.input_value() == "red, zebra, yellow", "it is back")
    page.does("mode-overlay")
    page.sees(lambda seen: covers(seen, red | yellow), "its overlay")
    page.does("do-clear")
    page.until(lambda: page.prompts.input_value() == "", "an empty box")
    page.sees(lambda seen: changed(seen, photo) < 3, "the colors of the scene")


def test_a_person_selects_by_hand(page: OnPage) -> None:
    _, red, yellow = things(page)
    page.ask("red, yellow")
    both = page.selects(lambda count: count > 0, "an answer")
    ball = page.changes(lambda: page.click(middle(red)), "the ball")
    assert 0 < ball < both and page.chips() == ["red" + page.chips()[0][3:], *page.chips()[1:]]
    assert "Selected by hand" in page.chips()[-1] and page.page.locator("#answer").is_hidden()
    page.sees(lambda seen: covers(seen, red), "the ball is drawn")
    added = page.changes(lambda: page.click(middle(yellow), hold="Shift"), "added at the first click")
    assert added > ball
    page.sees(lambda seen: covers(seen, red | yellow), "both")
    assert page.changes(lambda: page.click(middle(yellow), hold="Control"), "removed") == ball

    grown = page.changes(lambda: page.does("do-grow"), "grown")
    assert grown > ball and page.changes(lambda: page.does("do-shrink"), "shrunk") == ball
    total = page.state("total")
    assert page.changes(lambda: page.does("do-invert"), "inverted") == total - ball
    for key, count in (("Control+z", ball), ("Control+Shift+z", total - ball), ("Control+z", ball)):
        page.page.keyboard.press(key)
        page.selects(lambda found, count=count: found == count, key)

    page.page.locator("#fold-history summary").click()
    steps = page.page.locator("#history button").count()
    assert steps >= 6
    page.page.locator("#history button").nth(1).click()
    page.selects(lambda count: count == both, "a step of the history")
    assert page.page.locator("#history button").count() == steps

    rows, columns = np.nonzero(yellow)
    corners = [(columns.min() - 3.0, rows.min() - 3.0), (columns.max() + 3.0, rows.max() + 3.0)]
    page.page.locator("#canvas").focus()
    page.page.keyboard.press("r")
    assert page.page.locator("#tool-rectangle").get_attribute("aria-checked") == "true"
    inside = page.changes(lambda: page.trace(*corners), "a rectangle")
    assert 0 < inside < total / 2
    page.does("tool-brush")
    x, y = middle(red)
    painted = page.changes(lambda: page.trace((x - 8, y), (x + 8, y)), "a brush")
    page.does("tool-lasso")
    around = [(x - 80, y - 25), (x + 80, y - 25), (x + 80, y + 90), (x - 80, y + 90)]
    assert page.changes(lambda: page.trace(*around), "a lasso") != painted
    page.page.keyboard.press("Escape")
    assert page.page.locator("#tool-select").get_attribute("aria-checked") == "true"

    ball = page.changes(lambda: page.click(middle(red)), "the ball")
    page.does("do-layer")
    page.until(lambda: page.page.locator("#layers li").count() == 1, "a layer")
    page.does("do-hide")
    page.sees(lambda seen: hue_mask(seen, *RED).sum() < 0.1 * red.sum(), "hidden")
    page.until(lambda: page.state("hidden") == ball, "so many")
    page.does("do-show")
    page.until(lambda: page.state("hidden") == 0, "shown")
    page.click(middle(yellow))
    page.does("do-isolate")
    page.until(lambda: page.state("hidden") > total / 2, "isolated")
    page.sees(lambda seen: hue_mask(seen, *RED).sum() < 0.1 * red.sum(), "the ball is not there")
    page.does("do-show")
    page.page.locator("#layers .main").click()
    page.selects(lambda count: count == ball, "the layer")


def test_a_person_looks_around_explains_and_exports(page: OnPage, own: Server, tmp_path: Path) -> None:
    _, red, yellow = things(page)
    page.ask("red")
    some = page.selects(lambda count: count > 0, "an answer")
    page.until(lambda: page.page.locator("#objects button").count() > 1, "objects")
    best = re.findall(r"\d\.\d\d", page.chips()[0])[0]
    assert page.page.locator("#legend").inner_text().endswith(best)  # the same number

    def distance() -> float:
        return page.page.evaluate("page.view.camera.position.distanceTo(page.view.controls.target)")

    far = distance()
    page.page.locator("#objects button[aria-label^='Go to']").first.click()
    page.until(lambda: distance() < 0.9 * far, "closer")
    near = page.sees(lambda seen: coloured(seen).mean() > red.mean(), "larger")
    page.page.locator("#canvas").focus()
    page.page.keyboard.press("ArrowLeft")
    page.sees(lambda seen: changed(seen, near) > 1, "turned")
    page.page.locator("#fold-cameras summary").click()
    page.page.locator("#cameras button").nth(2).click()
    page.until(lambda: page.page.evaluate("page.view.camera.fov") != 55, "a training camera")
    page.does("do-home")

    page.does("do-why")
    page.until(lambda: page.page.locator("#why img").count() >= 3, "images")
    drawn = "[...document.querySelectorAll('#why img')].every((one) => one.naturalWidth)"
    page.until(lambda: page.page.evaluate(drawn), "drawn")
    assert re.search(r"Based on about \d+ images", page.page.locator("#why").inner_text())
    assert page.page.locator("#stage").bounding_box()["height"] > 200  # type: ignore[index]  # beside the scene
    page.page.keyboard.press("Escape")
    page.until(lambda: page.page.locator("#why").is_hidden(), "closed")

    vertices = PlyData.read(page.save(lambda: page.does("save-ply"), tmp_path), mmap=False)["vertex"]
    assert 0 < vertices.count <= some
    text, box = page.toast()
    button = page.page.locator("#save-ply").bounding_box()
    assert "Downloaded" in text and button is not None and abs(box["y"] - button["y"]) < 150  # near what was pressed
    picture = Image.open(page.save(lambda: page.does("do-screenshot"), tmp_path))
    assert picture.format == "PNG" and picture.width >= 600

    page.sees(lambda seen: covers(seen, red), "the start view")
    page.does("tool-measure")
    page.click(middle(red))
    page.until(lambda: page.page.locator("#overlay circle").count() == 1, "one end")
    page.click(middle(yellow))
    page.says(r"Distance: \d")
    page.page.keyboard.press("Escape")
    page.page.mouse.move(*middle(red))
    page.page.mouse.move(middle(red)[0] + 1, middle(red)[1])
    page.until(lambda: re.search(r"red\s+relevancy \d\.\d\d · R \d\.\d\d", page.text()), "hover")

    page.page.locator("#do-hide").hover()
    page.until(lambda: page.page.locator("#tip").is_visible(), "a tooltip")
    assert re.search(r"Hide the selected Gaussians\.\s*H", page.page.locator("#tip").inner_text())
    page.page.keyboard.press("?")
    assert page.page.locator("#help kbd").count() > 20
    page.page.keyboard.press("Escape")
    page.page.locator("#fold-advanced summary").click()
    page.ask("red, yellow, purple")
    page.does("do-save")
    page.until(lambda: len((load_query(own.config.parent / "normlift") or page).texts) == 3, "stored")  # type: ignore[union-attr]


def test_pages_are_their_own_and_outlive_the_server(own: Server, browser: Browser) -> None:
    one, two = OnPage(browser, own.address), OnPage(browser, own.address)
    _, red, _ = things(one)
    one.ask("red")
    two.ask("yellow")
    count = one.selects(lambda count: count > 0, "one asks")
    two.selects(lambda other: other not in (0, count), "two asks something else")
    two.leave()
    one.does("do-hide")
    one.until(lambda: one.state("hidden") == count, "hidden")
    one.page.reload()
    one.ready()
    assert one.selected() == one.state("hidden") == count and one.prompts.input_value() == "red"
    one.page.keyboard.press("Control+z")
    one.until(lambda: one.state("hidden") == 0, "history comes back too")

    assert one.page.request.head(own.address).status == 200
    one.does("do-link")
    one.until(lambda: "?q=" in one.page.evaluate("location.search"), "a link")
    link = one.page.evaluate("location.href")
    one.ask("yellow")
    other = one.selects(lambda found: found not in (0, count), "asks again")
    one.page.wait_for_timeout(1500)  # until the page knows what to come back to
    own.stop()
    one.says("Connection lost")
    own.start("--read-only", "True")
    one.until(lambda: one.page.locator("#offline").is_hidden(), "back")
    one.selects(lambda found: found == other, "with the last question")
    three = OnPage(browser, link)
    three.selects(lambda found: found == count, "the link asks its question")
    three.sees(lambda seen: covers(seen, red), "from its camera")
    assert three.page.locator("#do-save").count() == 0
    three.leave()
    one.leave()


@pytest.mark.parametrize("size", [(390, 760), (1300, 800)])
def test_everything_has_a_name_and_fits(own: Server, browser: Browser, size: tuple[int, int]) -> None:
    page = OnPage(browser, own.address, size)
    page.ask("red, eggplant")
    page.until(lambda: page.page.locator(".histogram").count() == 2, "histograms")
    assert page.page.evaluate("document.documentElement.scrollWidth") <= size[0]
    assert page.page.evaluate("document.querySelector('#panel').scrollWidth") <= size[0]
    stage, panel = (page.page.locator(name).bounding_box() for name in ("#stage", "#panel"))
    assert stage is not None and panel is not None
    if size[0] < 720:  # the scene above the panel
        assert stage["y"] + stage["height"] <= panel["y"] + 1 and stage["height"] > 300
    nameless = """[...document.querySelectorAll("button, input, select, [role=slider]")].filter((one) =>
      one.checkVisibility() && !(one.textContent.trim() || one.getAttribute("aria-label") || one.labels?.length))"""
    assert page.page.evaluate(f"{nameless}.map((one) => one.outerHTML)") == []
    seen = set()
    for _ in range(60):
        page.page.keyboard.press("Tab")
        seen.add(page.page.evaluate("document.activeElement.id"))
    assert {"prompts", "ask", "do-hide", "threshold", "mode-heat", "tool-select"} <= seen
    assert page.page.locator("#stage").bounding_box() == stage  # nothing shifts
    tipless = """[...document.querySelectorAll("button, input, select, summary, [role=slider]")].filter((one) =>
      !one.closest("[data-tip], #help") && one.checkVisibility()).map((one) => one.outerHTML)"""
    for name in ("layers", "history", "cameras", "advanced"):
        page.page.locator(f"#fold-{name} summary").click()
    assert page.page.evaluate(tipless) == []
    listed = page.page.locator("#help kbd").all_text_contents()
    keys = page.page.evaluate("[...document.querySelectorAll('[data-keys]')].map((one) => one.dataset.keys)")
    assert len(keys) > 25 and {key for key in keys if key not in " / ".join(listed)} == set()
    for _ in range(2):  # dark and light
        assert page.page.evaluate(_SWATCH_CONTRAST) >= 3
        page.does("do-theme")
    page.page.set_viewport_size({"width": 1690 - size[0], "height": 700})  # across the breakpoint
    page.until(lambda: page.page.locator("#stage").bounding_box() != stage, "another layout")
    assert page.page.evaluate("!document.body.innerText.includes(page.connection.memory.token)")
    page.leave()


def test_the_pointer_tells_what_is_drawn(page: OnPage) -> None:
    things(page)
    page.ask("red, yellow, sky blue")
    page.selects(lambda count: count > 0, "an answer")
    same, named = page.pointed()
    assert same >= 95 and named >= 95


def test_a_browser_without_webgl_gets_stills(page: OnPage, own: Server, browser: Browser) -> None:
    _, *drawn = things(page)
    blind = OnPage(browser, own.address, webgl=False)

    def as_drawn(seen: np.ndarray) -> bool:
        return all(iou(mask, hue_mask(seen, *rule)) > 0.8 for mask, rule in zip(drawn, (RED, YELLOW)))

    blind.sees(as_drawn, "what the browser draws")
    blind.ask("red")
    blind.sees(lambda seen: covers(seen, drawn[0]), "an overlay")
    blind.click(middle(drawn[1]))
    before = blind.sees(lambda seen: covers(seen, drawn[1]), "the other object")
    blind.trace((300, 300), (380, 320))
    blind.sees(lambda seen: changed(seen, before) > 2, "the camera has turned")
    blind.leave()


def test_no_frame_is_missing_or_unsorted(page: OnPage) -> None:
    """Over changes of colors, thresholds and visibility, with a sorter that takes half a second longer."""
    things(page)
    page.watch()
    page.page.evaluate("page.scene.spark.sortDelay = 500")
    fetched = "performance.getEntriesByType('resource').filter((one) => one.name.includes('geometry')).length"
    geometry = page.page.evaluate(fetched)
    page.ask("red, yellow")
    threshold = page.state("threshold")
    for _ in range(4):
        page.page.locator("#threshold").press("ArrowRight")
    page.changes_quickly(150)
    assert page.page.evaluate(fetched) == geometry
    assert min(page.measured("colors")) <= 150
    assert page.state("threshold") > threshold
    before = page.page.evaluate("page.revision")
    assert page.page.evaluate("(page.search.ask('yellow'), !document.querySelector('#busy').hidden)")
    page.until(lambda: page.state("revision") > before and page.page.locator("#busy").is_hidden(), "done")
    assert page.state("threshold") == threshold  # that of the question before is not carried over
    assert re.fullmatch(r"\d\.\d\d", page.page.locator("#threshold-value").inner_text())


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
    tab.type("Threshold", "0.98")
    tab.selects(lambda count: 0 <= count < some, "fewer")
    tab.press("Undo")
    tab.selects(lambda count: count == some, "undone")

    tab.until(lambda: tab.images("svg") == 1, "a histogram")
    tab.says("object 1")
    tab.press("Go to")
    near = tab.sees(lambda seen: changed(seen, overlay) > 3, "the camera has moved")
    tab.press("Hide")
    tab.sees(lambda seen: overlaid(seen).sum() < 0.8 * overlaid(near).sum(), "hidden")
    tab.press("Undo")
    tab.until(lambda: "Gaussians are hidden" not in tab.text(), "undone")
    assert tab.save(lambda: tab.press("Export"), tmp_path).name == "red_1.ply"
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
    vertices = PlyData.read(tab.save(lambda: tab.press("Download selection"), tmp_path), mmap=False)["vertex"]
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
