"""ns-viewer in a process of its own, and a person before it in headless Chromium."""

from __future__ import annotations

import io
import os
import re
import shutil
import subprocess
import sys
import tempfile
import time
import urllib.request
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Literal

import numpy as np
from PIL import Image
from playwright.sync_api import Browser, Locator, Page, sync_playwright

from tests.browser.own_viewer import COARSE, PANEL, draw_in_software, free_port

CHROMIUM = shutil.which("chromium")
_FLAGS = ("--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader")
WITHOUT_WEBGL = ("--disable-gpu", "--disable-3d-apis")
_SIZE = (1300, 1000)
TITLE = 52
"""Height of the title bar in pixels."""
_PROGRAM = "import sys; from nerfstudio.scripts.viewer.run_viewer import entrypoint; sys.exit(entrypoint())"


@contextmanager
def ns_viewer(config: Path, log: Path, *, cwd: Path, port: int | None = None) -> Iterator[str]:
    """Address of an ns-viewer that shows a run; its output goes to `log`."""
    port = free_port() if port is None else port
    flags = ["--load-config", config, "--viewer.websocket-host", "127.0.0.1", "--viewer.websocket-port", port]
    with log.open("w") as file:
        process = subprocess.Popen(
            [sys.executable, "-W", "ignore", "-c", _PROGRAM, *map(str, flags)], stdout=file, stderr=file, cwd=cwd
        )
    try:
        address, deadline = f"http://127.0.0.1:{port}", time.monotonic() + 180
        while process.poll() is None and time.monotonic() < deadline:
            try:
                urllib.request.urlopen(address, timeout=5).close()
                break
            except OSError:
                time.sleep(0.5)
        else:
            raise AssertionError(f"ns-viewer did not start: {log.read_text()[-2000:]}")
        yield address
    finally:
        process.terminate()
        process.wait(timeout=30)


@contextmanager
def chromium(*flags: str) -> Iterator[Browser]:
    """A headless Chromium, by default one that draws in software."""
    with sync_playwright() as playwright, tempfile.TemporaryDirectory() as folder:
        program = _behind_the_server(Path(folder) / "chromium")
        browser = playwright.chromium.launch(executable_path=program, args=["--no-sandbox", *(flags or _FLAGS)])
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


class Tab:
    """One browser tab with the viewer in it, used as a person would."""

    def __init__(
        self, browser: Browser, address: str, *, size: tuple[int, int] = _SIZE, sharpness: float = COARSE
    ) -> None:
        self.page: Page = browser.new_page(viewport={"width": size[0], "height": size[1]})
        self._size = size
        draw_in_software(self.page, sharpness)
        self.problems: list[str] = []
        self.page.on("pageerror", lambda error: self.problems.append(str(error)))
        self.page.goto(address, wait_until="domcontentloaded")
        self.page.locator("xpath=//label[text()='Prompts']").wait_for(timeout=60_000)
        self.settle()

    def field(self, label: str) -> Locator:
        """The input to the right of a label; of a slider, the number."""
        row = self.page.locator(f'xpath=//label[text()="{label}"]/ancestor::*[.//input][1]')
        return row.locator("input:visible").last

    def type(self, label: str, text: str) -> None:
        self.field(label).fill(text)
        self.page.wait_for_timeout(300)  # viser sends what is typed at most every 50 ms

    def choose(self, label: str, option: str) -> None:
        self.field(label).click()
        self.page.get_by_role("option", name=option, exact=True).click()
        self.page.wait_for_timeout(200)

    def press(self, button: str) -> None:
        self.page.get_by_role("button", name=button, exact=True).click()

    def tab(self, name: str) -> None:
        """Opens one of the viewer's tabs."""
        self.page.get_by_role("tab", name=name, exact=True).click()

    def output(self) -> str:
        """The output that is shown; the tab Search is open afterwards."""
        self.tab("Control")
        found = self.field("Output type").input_value()
        self.tab("Search")
        return found

    def show(self, output: str) -> None:
        """Chooses the output; the tab Search is open afterwards."""
        self.tab("Control")
        self.choose("Output type", output)
        self.tab("Search")

    def status(self) -> str:
        """What the panel says."""
        return self.page.locator("body").inner_text()

    def says(self, text: str, timeout: float = 60_000) -> None:
        """Waits until the page shows a text."""
        self.page.get_by_text(text).first.wait_for(timeout=timeout)

    def images(self, kind: str) -> int:
        """Number of drawings or photographs of a kind that the panel shows."""
        return self.page.locator(f'img[src^="data:image/{kind}"]').count()

    def selected(self) -> int:
        """Number of selected Gaussians that the panel shows; -1 where nothing is asked."""
        found = re.findall(r"([\d,]+) of [\d,]+ Gaussians selected", self.status())
        return int(found[0].replace(",", "")) if found else -1

    def answered(self) -> int:
        """Number of prompts in the table that are answered."""
        return sum(text.count("■") for text in self.page.locator("table:visible").all_inner_texts())

    def until(self, true: Callable[[], bool], what: str, timeout: float = 20) -> None:
        """Waits until something holds of the page."""
        deadline = time.monotonic() + timeout
        while not true():
            assert time.monotonic() < deadline, f"{what}: not within {timeout} s; the page says {self.status()[-600:]}"
            self.page.wait_for_timeout(200)

    def settle(self) -> None:
        """Waits until the picture does not change any more: the viewer draws coarsely first."""
        before, calm, deadline = self.picture(), 0, time.monotonic() + 60
        while calm < 3 and time.monotonic() < deadline:
            self.page.wait_for_timeout(600)
            now = self.picture()
            calm = calm + 1 if np.abs(now.astype(int) - before).mean() < 0.2 else 0
            before = now

    def picture(self) -> np.ndarray:
        """RGB of the scene as the page shows it, uint8 [H, W, 3]."""
        box = {"x": 0, "y": TITLE, "width": max(self._size[0] - PANEL, 70), "height": self._size[1] - TITLE}
        return np.asarray(Image.open(io.BytesIO(self.page.screenshot(clip=box))).convert("RGB"))  # type: ignore[arg-type]

    def click(self, x: float, y: float) -> None:
        """Clicks on the picture, pixels from its upper left corner."""
        self.page.mouse.click(x, TITLE + y)

    def drag(self, x: float, y: float, button: Literal["left", "right"] = "left") -> None:
        """Drags from the middle of the picture: turns the camera, with the right button moves it."""
        middle = ((self._size[0] - PANEL) / 2, (TITLE + self._size[1]) / 2)
        self.page.mouse.move(*middle)
        self.page.mouse.down(button=button)
        self.page.mouse.move(middle[0] + x, middle[1] + y, steps=10)
        self.page.mouse.up(button=button)


def faults(log: str) -> list[str]:
    """Tracebacks in what a viewer printed."""
    return re.findall(r"Traceback \(most recent call last\):\n(?:[ \t].*\n|\n)*.*", log)


def is_ours(fault: str) -> bool:
    """Whether a traceback has led through this package, but for what stands around all that viser reads."""
    return re.search(r'normlift_ns/(?!viewer/adapter\.py", line \d+, in read\n)', fault) is not None


def hue_mask(picture: np.ndarray, hue: float, saturation: float) -> np.ndarray:
    """Pixels of a hue, strongly coloured; without the axes in the lower left corner."""
    rgb = picture.astype(float) / 255
    high, low = rgb.max(axis=2), rgb.min(axis=2)
    spread = np.maximum(high - low, 1e-6)
    red, green, blue = np.moveaxis(rgb, 2, 0)
    turn = np.where(
        high == red,
        (green - blue) / spread % 6,
        np.where(high == green, (blue - red) / spread + 2, 4 + (red - green) / spread),
    )
    near = np.abs((turn / 6 - hue + 0.5) % 1 - 0.5) < 0.04
    return without_axes(near & (spread / np.maximum(high, 1e-6) > saturation) & (high > 0.25))


def coloured(picture: np.ndarray) -> np.ndarray:
    """Pixels that are not grey; without the axes, and without the legend in the lower right corner."""
    mask = without_axes(np.ptp(picture.astype(int), axis=2) > 50)
    mask[-160:, -340:] = False
    return mask


def without_axes(mask: np.ndarray) -> np.ndarray:
    mask = mask.copy()
    mask[-90:, :90] = False
    return mask


def iou(one: np.ndarray, other: np.ndarray) -> float:
    return float((one & other).sum() / (one | other).sum())


def middle(mask: np.ndarray) -> tuple[float, float]:
    """x and y of the pixel of a mask that is nearest to its centre."""
    y, x = np.nonzero(mask)
    nearest = np.argmin((y - y.mean()) ** 2 + (x - x.mean()) ** 2)
    return float(x[nearest]), float(y[nearest])
