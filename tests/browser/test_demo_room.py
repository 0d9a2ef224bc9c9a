"""A person before the demo room: types, presses, clicks, and looks at the picture on the page."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from plyfile import PlyData

from normlift_ns.runs.question import load_question
from tests.browser.viewer import CHROMIUM, Tab, chromium, coloured, hue_mask, iou, middle, ns_viewer

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
    assert "Traceback" not in log.read_text()


@pytest.fixture(scope="module")
def tab(address: str) -> Iterator[Tab]:
    with chromium() as browser:
        tab = Tab(browser, address)
        tab.press("Hide Train Cams")
        tab.settle()
        yield tab
        assert tab.problems == []


def test_a_person_asks_clicks_isolates_and_exports(tab: Tab, run_dir: Path, pictures: Path) -> None:
    photo = tab.picture()
    things = {name: hue_mask(photo, *rule) for name, rule in (("red", RED), ("yellow", YELLOW), ("blue", BLUE))}
    assert all(mask.sum() > 3000 for mask in things.values()), {name: mask.sum() for name, mask in things.items()}
    assert "red" in tab.field("Prompts").input_value()  # the stored question

    tab.choose("Output type", "overlay")
    tab.type("Prompts", "red")
    tab.press("Query")
    tab.settle()
    tab.page.screenshot(path=pictures / "demo_overlay.png")
    overlay = coloured(tab.picture())
    print("overlay of red: IoU", iou(overlay, things["red"]))
    assert iou(overlay, things["red"]) > 0.75
    some = tab.selected()

    tab.type("Threshold", "0.98")
    tab.settle()
    few = tab.selected()
    print("selected", some, "above 0.5,", few, "above 0.98")
    assert 0 <= few < some
    assert coloured(tab.picture()).sum() < overlay.sum()
    tab.type("Threshold", "0.5")

    tab.type("Prompts", "red; yellow; bright blue")
    tab.press("Query")
    tab.says("bright blue")
    tab.choose("Output type", "segmentation")
    tab.settle()
    tab.page.screenshot(path=pictures / "demo_segmentation.png")
    classes = tab.picture()
    colours = [classes[mask].mean(axis=0) for mask in things.values()]
    assert min(np.abs(a - b).max() for i, a in enumerate(colours) for b in colours[:i]) > 60, colours
    for mask in things.values():
        assert coloured(classes)[mask].mean() > 0.85
    assert coloured(classes)[~np.logical_or.reduce(list(things.values()))].mean() < 0.15

    tab.choose("Output type", "overlay")
    tab.press("Click: more like this")
    tab.says("Click on something in the scene")
    tab.click(*middle(things["yellow"]))
    tab.says("Clicked Gaussian")
    tab.settle()
    tab.page.screenshot(path=pictures / "demo_click.png")
    print("clicked yellow: IoU", iou(coloured(tab.picture()), things["yellow"]))
    assert iou(coloured(tab.picture()), things["yellow"]) > 0.6
    alike = tab.selected()

    tab.choose("Output type", "rgb")
    tab.choose("Draw", "the selection alone")
    tab.settle()
    tab.page.screenshot(path=pictures / "demo_isolated.png")
    alone = tab.picture()
    assert iou(hue_mask(alone, *YELLOW), things["yellow"]) > 0.6
    assert hue_mask(alone, *RED).sum() < 50
    assert (np.abs(alone.astype(int) - (38, 42, 55)).max(axis=2) < 12).mean() > 0.7  # the background
    tab.choose("Draw", "without the selection")
    tab.settle()
    assert hue_mask(tab.picture(), *YELLOW).sum() < 0.1 * things["yellow"].sum()
    assert iou(hue_mask(tab.picture(), *RED), things["red"]) > 0.9
    tab.choose("Draw", "everything")

    tab.press("Export selection")
    tab.says("Gaussians written to")
    (ply,) = (run_dir / "exports").glob("*.ply")
    vertices = PlyData.read(ply)["vertex"]
    assert 0.8 * alike < vertices.count <= alike
    colours = np.stack([vertices[f"f_dc_{i}"] for i in range(3)], axis=1).mean(axis=0) * 0.2821 + 0.5
    assert colours[0] > 0.6
    assert colours[1] > 0.6
    assert colours[2] < 0.35

    tab.type("Prompts", "teal")
    tab.press("Query")
    tab.says("teal")
    tab.press("Save queries in run")
    tab.says("Saved 1 queries")
    question = load_question(run_dir / "normlift")
    assert question is not None
    assert question.texts == ("teal",)


def test_two_tabs_and_everything_at_once(tab: Tab, address: str, log: Path) -> None:
    other = Tab(tab.page.context.browser, address)  # type: ignore[arg-type]
    tab.choose("Output type", "overlay")
    tab.type("Prompts", "red; yellow")
    tab.press("Query")
    other.until(lambda: other.status().count("■") == 2 and other.selected() == tab.selected() > 0, "both tabs agree")
    assert other.field("Prompts").input_value() == "red; yellow"

    for i in range(4):  # a prompt typed while the camera moves, asked while the picture is drawn
        other.drag(40 * (-1) ** i, 10)
        tab.field("Prompts").press_sequentially(" ; blue"[: 3 + i], delay=30)
        other.drag(-40 * (-1) ** i, -10)
        tab.press("Query")
    tab.type("Prompts", "red")
    tab.press("Query")
    tab.until(lambda: tab.status().count("■") == 1 and 0 < tab.selected() < 1000, "only red is left")
    alone = tab.selected()

    crop = tab.page.locator('xpath=//*[text()="Crop Viewport"]/following::input[@type="checkbox"][1]')
    crop.check()
    tab.settle()
    for text, prompts in (("yellow", 1), ("", 0), ("; ".join(["red", "yellow"] * 25), 50), ("x" * 10_000, 0)):
        tab.type("Prompts", text)
        tab.press("Query")
        other.drag(15, 0)
        for one in (tab, other):
            one.until(lambda one=one, prompts=prompts: one.status().count("■") == prompts, f"asked {text[:20]!r}")
            assert (one.selected() > 0) is (prompts > 0)
        tab.settle()
    assert len(tab.status()) < 5000
    crop.uncheck()

    assert "xxxx" in other.status()
    tab.press("Clear")
    other.until(lambda: "xxxx" not in other.status() and "No query yet." in other.status(), "cleared")
    tab.type("Prompts", "red")
    tab.press("Query")
    other.until(lambda: tab.selected() == other.selected() == alone, "the same as before")
    assert other.problems == []
    other.page.close()
    assert "Traceback" not in log.read_text()
