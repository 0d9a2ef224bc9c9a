"""Time of the panel in nerfstudio's viewer in Chromium, from a press of Ask until the image changes.

    python -m research.panel --load-config outputs/room/normlift/demo/config.yml

`python -m research.latency` measures the same on the fox capture if Chromium is installed. The server renders the
scene, so the unit names the renderer of the server and that of the page in the browser. The time is the shortest of
some prompts after a first one, which loads the text encoder.
"""

from __future__ import annotations

import argparse
import io
import shutil
import socket
import subprocess
import sys
import tempfile
import time
import urllib.request
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import torch
from PIL import Image

from research.report import RESULTS, Report
from research.view import COLOURS, fox_run

SIZE = (1000, 500)
PATIENCE = 180
"""Longest wait in seconds."""
_BOX: Any = {"x": 100, "y": 60, "width": 500, "height": 400}
"""Part of the page that shows the scene."""
_PROGRAM = "import sys; from nerfstudio.scripts.viewer.run_viewer import entrypoint; sys.exit(entrypoint())"
_FLAGS = ["--no-sandbox", "--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]
_RENDERER = """() => {
  const gl = document.createElement('canvas').getContext('webgl2');
  const known = gl.getExtension('WEBGL_debug_renderer_info');
  return gl.getParameter(known ? known.UNMASKED_RENDERER_WEBGL : gl.RENDERER);
}"""


@contextmanager
def served(config: Path) -> Iterator[str]:
    """Yield the address of an ns-viewer of a run."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    words = [sys.executable, "-W", "ignore", "-c", _PROGRAM, "--load-config", str(config)]
    words += ["--viewer.websocket-host", "127.0.0.1", "--viewer.websocket-port", str(port)]
    process, address = subprocess.Popen(words, stdout=subprocess.DEVNULL), f"http://127.0.0.1:{port}"
    try:
        deadline = time.monotonic() + PATIENCE
        while True:
            try:
                urllib.request.urlopen(address, timeout=5).close()
                break
            except OSError as error:
                if process.poll() is not None or time.monotonic() > deadline:
                    raise RuntimeError(f"the viewer of {config} did not start") from error
                time.sleep(0.3)
        yield address
    finally:
        process.terminate()
        process.wait(timeout=30)


def picture(page: Any) -> np.ndarray:
    shot = page.screenshot(clip=_BOX)
    return np.asarray(Image.open(io.BytesIO(shot)).convert("RGB")).astype(int)


def settled(page: Any) -> np.ndarray:
    """Return the image after it has not changed for three seconds, because the server renders coarsely first."""
    before, since = picture(page), time.monotonic()
    while time.monotonic() - since < 3:
        page.wait_for_timeout(300)
        now = picture(page)
        if np.abs(now - before).mean() > 0.2:
            since = time.monotonic()
        before = now
    return before


def pressed(address: str, prompts: Sequence[str]) -> tuple[list[float], str]:
    """Return the seconds from the press until the image changes for every prompt, and the renderer of the page."""
    from playwright.sync_api import sync_playwright  # noqa: PLC0415 (not installed with the package)

    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=shutil.which("chromium"), args=_FLAGS)
        page = browser.new_page(viewport={"width": SIZE[0], "height": SIZE[1]})
        page.set_default_timeout(1e3 * PATIENCE)  # drawn in software a large scene takes seconds
        page.goto(address, wait_until="domcontentloaded")
        ask = page.get_by_role("button", name="Ask", exact=True)
        ask.wait_for()
        name = page.evaluate(_RENDERER)
        row = page.locator('xpath=//label[text()="Prompts"]/ancestor::*[.//input][1]').locator("input").last
        seconds = []
        for prompt in prompts:
            row.fill(prompt)
            before, start = settled(page), time.perf_counter()
            ask.click()
            while np.abs(picture(page) - before).mean() < 1 and time.perf_counter() - start < PATIENCE:
                pass
            seconds.append(time.perf_counter() - start)
        browser.close()
    return seconds, name


def add_panel(report: Report, config: Path, prompts: Sequence[str] = COLOURS[:4]) -> None:
    """Add panel.press_to_picture_s of a lifted run."""
    with served(config) as address:
        seconds, name = pressed(address, prompts)
    draws = "gsplat on CUDA" if torch.cuda.is_available() else "Numba on the CPU"
    report.add("panel.press_to_picture_s", min(seconds[1:]), f"s, drawn by {draws} and shown by {name}")


def add_fox_panel(report: Report) -> None:
    """Add panel.press_to_picture_s of the fox capture, if Chromium is installed."""
    if shutil.which("chromium") is not None:
        with tempfile.TemporaryDirectory() as folder:
            add_panel(report, fox_run(Path(folder)))


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--load-config", type=Path, help="lifted run; by default the fox capture is lifted first")
    parser.add_argument(
        "--prompts", nargs="+", default=COLOURS[:4], help="two or more prompts whose answers look different"
    )
    parser.add_argument("--output", type=Path, default=RESULTS, help="folder of the JSON file")
    arguments = parser.parse_args()
    found = Report("panel")
    if arguments.load_config is None:
        add_fox_panel(found)
    else:
        add_panel(found, arguments.load_config, arguments.prompts)
    found.write(arguments.output)
