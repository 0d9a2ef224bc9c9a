"""docs/page.webp: ten seconds of the page of ns-normlift-view, in Chromium: a question, a walk around it, R and *Why?*.

python -m research.moving_page [config.yml of the lifted demo room]      after make demo; nothing is saved in the run
"""

from __future__ import annotations

import io
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

from PIL import Image

from research.draw_viewers import CONFIG
from research.plots import DOCS
from tests.browser.page import OnPage
from tests.browser.person import chromium
from tests.browser.server import OWN, Server

ASKED = "pumpkin, blueberry"
SIZE, SHOWN = (1100, 660), (880, 528)
"""Of the page and of the picture, in pixels."""
STEPS, FRAME_MS, STILL_MS = 18, 200, 1200
"""Frames of the walk; milliseconds of one of them, and of a picture to look at."""


def frames(page: OnPage) -> Iterator[tuple[Image.Image, int]]:
    """Pictures of the page and how long each is shown."""

    def shot(milliseconds: int) -> tuple[Image.Image, int]:
        picture = Image.open(io.BytesIO(page.page.screenshot())).convert("RGB").resize(SHOWN, Image.Resampling.LANCZOS)
        return picture, milliseconds

    yield shot(STILL_MS // 2)
    for end in (4, 7, 12, len(ASKED)):
        page.prompts.fill(ASKED[:end])
        yield shot(FRAME_MS)
    page.ask(ASKED)
    page.selects(lambda count: count > 0, "an answer")
    page.calm()
    yield shot(STILL_MS)
    x, y = SIZE[0] * 0.6, SIZE[1] * 0.55
    for step in range(STEPS):
        page.trace((x, y), (x + (14 if step < STEPS // 2 else -14), y))
        page.calm()
        yield shot(FRAME_MS)
    page.does("mode-reliability")
    page.calm()
    yield shot(STILL_MS)
    page.does("mode-overlay")
    page.press("Why?")
    page.page.locator("#why img").first.wait_for()
    page.calm()
    yield shot(2 * STILL_MS)


def main(config: Path) -> None:
    """Draws the moving picture."""
    log = Path(tempfile.mkdtemp()) / "log"
    with chromium() as browser, Server(OWN, config, log).running() as address:
        page = OnPage(browser, address, size=SIZE)
        page.page.emulate_media(color_scheme="dark")
        page.page.reload()
        page.ready()
        first, *rest = frames(page)
    durations = [milliseconds for _, milliseconds in (first, *rest)]
    path = DOCS / "page.webp"
    pictures = [picture for picture, _ in rest]
    first[0].save(path, save_all=True, append_images=pictures, duration=durations, loop=0, quality=60, method=6)
    sys.stdout.write(f"Written: {path}, {sum(durations) / 1000:.1f} s, {path.stat().st_size / 1e6:.2f} MB\n")


if __name__ == "__main__":
    main(Path(sys.argv[1]).resolve() if len(sys.argv) > 1 else CONFIG.resolve())
