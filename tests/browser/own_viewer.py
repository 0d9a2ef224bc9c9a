"""ns-normlift-view in a process of its own, and a person before it in headless Chromium."""

from __future__ import annotations

import io
import os
import re
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

import numpy as np
from PIL import Image
from playwright.sync_api import Browser, Error, Locator, Page, Route

PANEL = 320
"""Width of viser's control panel in pixels."""
_UNHURRIED = """
const [soon, never, waiting] = [requestAnimationFrame, cancelAnimationFrame, new Map()];
let [names, awake] = [0, 6000];
const draw = (name) => {
  const picture = waiting.get(name);
  if (picture) picture.frame ??= soon((now) => { waiting.delete(name); picture.draw(now); });
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
const wake = () => {
  const asleep = performance.now() >= awake;
  awake = performance.now() + 6000;
  if (asleep) [...waiting.keys()].forEach(draw);
};
for (const what of ["pointerdown", "pointermove", "pointerup", "wheel", "keydown", "keyup", "input", "resize"])
  addEventListener(what, wake, true);
const heard = (Kind) => class extends Kind {
  constructor(...how) { super(...how); this.addEventListener("message", wake); }
};
[window.Worker, window.WebSocket] = [heard(Worker), heard(WebSocket)];
"""
"""Ten pictures per second at most; one, where for six seconds nobody has done anything and nothing has come."""
COARSE = 0.4
"""Pixels of a picture per pixel of the page: enough for the tests, and quick."""
_SHARPNESS = re.compile(r"window\.devicePixelRatio\*\(\.2\+\.8\*\w+\)")
"""Where viser's client makes its pictures coarser, step by step, because drawing is slow."""
_PROGRAM = "from normlift_ns.scripts.view import main; main()"


def free_port() -> int:
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        return free.getsockname()[1]


@contextmanager
def own_viewer(
    config: Path, log: Path, *flags: str, port: int | None = None, python: Path | str = sys.executable
) -> Iterator[str]:
    """Address of an ns-normlift-view that shows a run; its output goes to `log`."""
    port = free_port() if port is None else port
    words = [str(python), "-c", _PROGRAM, "--load-config", str(config), "--port", str(port), *flags]
    root = str(Path(__file__).parents[2])
    with log.open("w") as file:
        process = subprocess.Popen(words, stdout=file, stderr=file, env={**os.environ, "PYTHONPATH": root})
    try:
        deadline = time.monotonic() + 120
        while f":{port} " not in log.read_text():
            assert process.poll() is None and time.monotonic() < deadline, log.read_text()[-2000:]
            time.sleep(0.1)
        yield f"http://127.0.0.1:{port}"
    finally:
        process.terminate()
        process.wait(timeout=30)
    assert "Traceback" not in log.read_text(), log.read_text()[-3000:]


def draw_in_software(page: Page, sharpness: float) -> None:
    """Makes a page leave time to the server: it draws ten pictures per second at most, one where nothing happens, and
    all with so many pixels per pixel of the page and side."""

    def coarse(route: Route) -> None:
        try:
            answer = route.fetch()
            route.fulfill(response=answer, body=_SHARPNESS.sub(str(sharpness), answer.text()))
        except Error:  # the server is away, or the page has gone
            with suppress(Error):
                route.abort()

    page.add_init_script(_UNHURRIED)
    page.route(re.compile(r"/assets/index-.*\.js$"), coarse)


class Own:
    """One tab with the viewer of its own in it, used as a person would."""

    def __init__(
        self, browser: Browser, address: str, size: tuple[int, int] = (960, 480), *, sharpness: float = COARSE
    ) -> None:
        self.context = browser.new_context(viewport={"width": size[0], "height": size[1]}, accept_downloads=True)
        self.page: Page = self.context.new_page()
        draw_in_software(self.page, sharpness)
        self.size, self.problems = size, []
        self.page.on("pageerror", lambda error: self.problems.append(str(error)))
        self.page.goto(address, wait_until="domcontentloaded")
        self.ready()

    def ready(self) -> None:
        self.button("Ask").wait_for(timeout=150_000)  # a server that starts has 120 s
        self.page.wait_for_timeout(1500)

    def button(self, name: str) -> Locator:
        return self.page.get_by_role("button", name=name, exact=True)

    def press(self, name: str) -> None:
        self.button(name).first.click()

    def field(self, label: str) -> Locator:
        row = self.page.locator(f'xpath=//label[text()="{label}"]/ancestor::*[.//input][1]')
        return row.locator("input:visible").last

    def ask(self, prompts: str, *, key: bool = False) -> None:
        """Types prompts and presses Ask, or Enter."""
        self.field("Prompts").fill(prompts)
        self.page.wait_for_timeout(300)  # viser sends what is typed at most every 50 ms
        if key:
            self.field("Prompts").press("Enter")
        else:
            self.press("Ask")

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

    def until(self, true: Callable[[], bool], what: str, timeout: float = 30) -> None:
        deadline = time.monotonic() + timeout
        while not true():
            assert time.monotonic() < deadline, f"{what}: not within {timeout} s; the page says {self.text()[:900]}"
            self.page.wait_for_timeout(100)

    def says(self, text: str, timeout: float = 30) -> None:
        self.until(lambda: text in self.text(), f"says {text!r}", timeout)

    def picture(self) -> np.ndarray:
        """RGB of the scene as the page shows it once it rests, uint8 [H, W, 3]."""
        before, calm, deadline = self._shot(), 0, time.monotonic() + 60
        while calm < 2 and time.monotonic() < deadline:  # the camera glides by a step per picture
            self.page.wait_for_timeout(500)
            now = self._shot()
            calm = calm + 1 if np.abs(now.astype(int) - before).mean() < 0.1 else 0
            before = now
        return before

    def _shot(self) -> np.ndarray:
        box = {"x": 0, "y": 0, "width": self.size[0] - PANEL, "height": self.size[1]}
        shot = self.page.screenshot(clip=box, animations="disabled")  # type: ignore[arg-type]
        return np.asarray(Image.open(io.BytesIO(shot)).convert("RGB"))
