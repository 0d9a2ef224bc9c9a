"""A person before a viewer in headless Chromium, and what they see."""

from __future__ import annotations

import io
import os
import re
import shutil
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from PIL import Image

from tests.browser.server import PATIENCE

if TYPE_CHECKING:
    from playwright.sync_api import Browser, Locator, Page, Route

CHROMIUM = shutil.which("chromium")
needs_chromium = pytest.mark.skipif(CHROMIUM is None, reason="no Chromium here: install Debian's package chromium")
ARMED = "Click on"
"""What a panel says while it waits for a click."""
PANEL = 320
"""Width of viser's control panel in pixels."""
COARSE = 0.4
"""Pixels of a picture per pixel of the page: enough for the tests, and quick."""
RED, YELLOW, BLUE = ((0, 0.9), (1 / 6, 0.8), (0.6, 0.85))
"""Hue (in turns) and least saturation of things in the room, as they are drawn."""
_UNHURRIED = """
const [soon, never, waiting] = [requestAnimationFrame, cancelAnimationFrame, new Map()];
let [names, awake] = [0, 6000];
window.counts = {frames: 0, sent: 0};
window.wanted = {};
const draw = (name) => {
  const picture = waiting.get(name);
  if (picture) picture.frame ??= soon((now) => { waiting.delete(name); counts.frames++; picture.draw(now); });
};
window.requestAnimationFrame = (callback) => {
  const [name, picture] = [++names, {draw: callback}];
  waiting.set(name, picture);
  picture.timer = setTimeout(draw, performance.now() < awake ? 100 : 1000, name);
  return name;
};
window.cancelAnimationFrame = (name) => {
  const picture = waiting.get(name);
  clearTimeout(picture?.timer);
  never(picture?.frame);
  waiting.delete(name);
};
window.wake = () => {
  const asleep = performance.now() >= awake;
  awake = performance.now() + 6000;
  if (asleep) [...waiting.keys()].forEach(draw);
};
for (const what of ["pointerdown", "pointermove", "pointerup", "wheel", "keydown", "keyup", "input", "resize"])
  addEventListener(what, wake, true);
addEventListener("click", ({target}) => { wanted.hit ||= wanted.element?.contains(target); }, true);
addEventListener("scroll", ({target}) => { (target.scrollingElement ?? target).scrollLeft = 0; }, true);
const heard = (Kind) => class extends Kind {
  constructor(...how) { super(...how); this.addEventListener("message", wake); }
  postMessage(what, ...rest) {
    super.postMessage(what, ...rest);
    if (what?.message?.type === "GuiUpdateMessage") counts.sent++;
  }
};
[window.Worker, window.WebSocket] = [heard(Worker), heard(WebSocket)];
"""
"""Ten pictures per second at most; one, where for six seconds nobody has done anything and nothing has come. Counts
pictures, and values of widgets that were sent to the server. Nothing is moved sideways: a click may bring into view
what a panel hides beyond its edge, and the picture with it.
"""
_BLIND = """
const plain = HTMLCanvasElement.prototype.getContext;
HTMLCanvasElement.prototype.getContext = function (kind, ...rest) {
  return kind.includes("webgl") ? null : plain.call(this, kind, ...rest);
};
"""
"""A browser without WebGL."""
_SHARPNESS = re.compile(r"window\.devicePixelRatio\*\(\.2\+\.8\*\w+\)")
"""Where viser's client makes its pictures coarser, step by step, because drawing is slow."""


@contextmanager
def chromium() -> Iterator[Browser]:
    from playwright.sync_api import sync_playwright  # noqa: PLC0415

    flags = ["--no-sandbox", "--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]
    with sync_playwright() as playwright, tempfile.TemporaryDirectory() as folder:
        program = _behind_the_server(Path(folder) / "chromium")
        browser = playwright.chromium.launch(executable_path=program, args=flags, timeout=1000 * PATIENCE)
        yield browser
        browser.close()


def _behind_the_server(script: Path) -> str | Path | None:
    """Chromium that yields to the server. As root it would put itself first, draw without end, and starve it."""
    setpriv = shutil.which("setpriv")
    if setpriv is None or os.geteuid() != 0:
        return CHROMIUM
    without = "--bounding-set=-sys_nice --inh-caps=-sys_nice"
    script.write_text(f'#!/bin/sh\nexec nice -n 5 {setpriv} {without} {CHROMIUM} "$@"\n')
    script.chmod(0o700)
    return script


def draw_in_software(page: Page, sharpness: float) -> None:
    """Makes a page leave time to the server: it draws ten pictures per second at most, one where nothing happens, and
    all with so many pixels per pixel of the page and side."""
    from playwright.sync_api import Error  # noqa: PLC0415

    def coarse(route: Route) -> None:
        try:
            answer = route.fetch(timeout=1000 * PATIENCE)
            route.fulfill(response=answer, body=_SHARPNESS.sub(str(sharpness), answer.text()))
        except Error:  # the server is away, or the page has gone
            with suppress(Error):
                route.abort()

    page.add_init_script(_UNHURRIED)
    page.route(re.compile(r"/assets/index-.*\.js$"), coarse)


class Person:
    """A person before a browser tab of their own, which has a viewer in it."""

    top = 0
    """Height in pixels of what stands over the picture."""
    drawn = ""
    """What the page says once the picture is as fine as it gets, a pattern."""

    def __init__(self, browser: Browser, address: str, size: tuple[int, int], *, webgl: bool = True) -> None:
        self.size, self.problems = size, []
        self.context = browser.new_context(viewport={"width": size[0], "height": size[1]}, accept_downloads=True)
        self.context.set_default_timeout(1000 * PATIENCE)
        self.page: Page = self.context.new_page()
        self.prepare()
        if not webgl:
            self.page.add_init_script(_BLIND)
        self.page.on("pageerror", lambda error: self.problems.append(str(error)))
        self.page.goto(address, wait_until="domcontentloaded")
        self.button("Ask").wait_for()

    def prepare(self) -> None:
        """Changes the page before it is loaded."""

    def leave(self) -> None:
        """Closes the tab, in which nothing has gone wrong. NORMLIFT_SCREENSHOTS names a folder for its last picture."""
        if "NORMLIFT_SCREENSHOTS" in os.environ:
            self.page.screenshot(path=Path(os.environ["NORMLIFT_SCREENSHOTS"]) / f"{time.time_ns()}.png")
        self.context.close()
        assert self.problems == []

    def button(self, name: str) -> Locator:
        return self.page.get_by_role("button", name=name, exact=True)

    def press(self, name: str) -> None:
        with self.sending():
            self.hit(self.button(name).first)

    def hit(self, element: Locator) -> None:
        """Clicks on an element, and again if the page has moved it away meanwhile, as a message above it does."""

        def clicked() -> bool:
            element.evaluate("element => { wanted = {element} }")
            element.click()
            return self.page.evaluate("wanted.hit ?? false")

        self.until(clicked, "hit")

    def field(self, label: str) -> Locator:
        """The input to the right of a label; of a slider, the number."""
        row = self.page.locator(f'xpath=//label[text()="{label}"]/ancestor::*[.//input][1]')
        return row.locator("input:visible").last

    def typed(self, label: str) -> str:
        return self.field(label).input_value()

    def type(self, label: str, text: str) -> None:
        if self.typed(label) != text:
            with self.sending():
                self.field(label).fill(text)

    @contextmanager
    def sending(self) -> Iterator[None]:
        """Waits until the page has sent what is done: of two values within 50 ms it would send the last alone."""
        before = self.page.evaluate("counts.sent")
        yield
        self.until(lambda: self.page.evaluate("counts.sent") > before, "sent")

    def ask(self, prompts: str, *, key: bool = False) -> None:
        """Types prompts and presses Ask, or Enter."""
        self.type("Prompts", prompts)
        self.field("Prompts").press("Enter") if key else self.press("Ask")

    def arm(self, button: str) -> None:
        """Presses a button after which a click does something."""
        self.press(button)
        self.says(ARMED)

    def save(self, press: Callable[[], object], folder: Path) -> Path:
        with self.page.expect_download() as waiting:
            press()
        waiting.value.save_as(folder / waiting.value.suggested_filename)
        return folder / waiting.value.suggested_filename

    def text(self) -> str:
        return self.page.locator("body").inner_text()

    def selected(self) -> int:
        """Number of selected Gaussians that the panel tells; -1 where it tells none."""
        found = re.findall(r"([\d,]+) of [\d,]+ Gaussians selected", self.text())
        return int(found[0].replace(",", "")) if found else -1

    def images(self, kind: str) -> int:
        """Number of drawings or photographs of a kind that the panel shows and the browser could read."""
        some = f"[...document.querySelectorAll('img[src^=\"data:image/{kind}\"]')]"
        return self.page.evaluate(f"{some}.filter((image) => image.complete && image.naturalWidth > 0).length")

    def until(self, true: Callable[[], Any], what: str) -> None:
        deadline = time.monotonic() + PATIENCE
        while not true():
            assert time.monotonic() < deadline, f"{what}: never; the page says {self.text()[:900]}"
            time.sleep(0.03)

    def selects(self, true: Callable[[int], bool], what: str) -> int:
        """Waits until the number of selected Gaussians is as it should be, and returns it."""
        found: list[int] = []

        def holds() -> bool:
            found.append(self.selected())
            return found[-1] >= 0 and true(found[-1])

        self.until(holds, what)
        return found[-1]

    def says(self, pattern: str) -> None:
        self.until(lambda: re.search(pattern, self.text()), f"says {pattern!r}")

    def sees(self, true: Callable[[np.ndarray], Any], what: str) -> np.ndarray:
        """RGB of the scene, uint8 [H, W, 3], once something holds of it and two pictures later it is the same."""
        shots: list[np.ndarray] = []
        frames = [0]

        def holds() -> bool:
            if (count := self.page.evaluate("wake(), counts.frames")) < frames[0] + 3:
                return False
            shots.append(self.shot())
            frames[0] = count
            calm = len(shots) > 1 and np.abs(shots[-1].astype(int) - shots[-2]).mean() < 0.1
            return calm and true(shots[-1]) and re.search(self.drawn, self.text())

        self.until(holds, what)
        return shots[-1]

    def shot(self) -> np.ndarray:
        width = max(self.size[0] - PANEL, 70)
        box = {"x": 0, "y": self.top, "width": width, "height": self.size[1] - self.top}
        shot = self.page.screenshot(clip=box, animations="disabled")  # type: ignore[arg-type]
        return np.asarray(Image.open(io.BytesIO(shot)).convert("RGB"))

    def click(self, place: tuple[float, float]) -> None:
        self.page.mouse.click(place[0], self.top + place[1])


def hue_mask(picture: np.ndarray, hue: float, saturation: float) -> np.ndarray:
    """Pixels of a hue, strongly coloured; without the axes in the lower left corner."""
    from matplotlib.colors import rgb_to_hsv  # noqa: PLC0415

    turn, strong, bright = np.moveaxis(rgb_to_hsv(picture / 255), 2, 0)
    near = np.abs((turn - hue + 0.5) % 1 - 0.5) < 0.04
    return without_axes(near & (strong > saturation) & (bright > 0.25))


def coloured(picture: np.ndarray) -> np.ndarray:
    """Pixels that are not grey; without the axes."""
    return without_axes(np.ptp(picture.astype(int), axis=2) > 50)


def without_axes(mask: np.ndarray) -> np.ndarray:
    mask = mask.copy()
    mask[-90:, :90] = False
    return mask


def changed(one: np.ndarray, other: np.ndarray) -> float:
    """Mean difference of two pictures, of 255."""
    return float(np.abs(one.astype(int) - other).mean())


def iou(one: np.ndarray, other: np.ndarray) -> float:
    return float((one & other).sum() / max(1, (one | other).sum()))


def middle(mask: np.ndarray) -> tuple[float, float]:
    """x and y of the pixel of a mask that is nearest to its centre."""
    y, x = np.nonzero(mask)
    nearest = np.argmin((y - y.mean()) ** 2 + (x - x.mean()) ** 2)
    return float(x[nearest]), float(y[nearest])
