"""docs/page.webp: ten seconds of ns-normlift-view on the demo room with the trained networks, in Chromium.

python -m research.moving_picture [config.yml of a lifted run]      after make demo; the run does not change

The script types a prompt, hovers over the answer, adds a second prompt, opens the explanation, isolates the selection,
and downloads it. The frames are screenshots of the page with the durations given here.
"""

from __future__ import annotations

import io
import sys
import tempfile
from pathlib import Path

from PIL import Image

from research.plots import DOCS
from tests.browser.page import OnPage
from tests.browser.person import chromium, coloured
from tests.browser.server import OWN, Server

CONFIG = Path("demo/outputs/room/normlift/thing/config.yml")
PROMPTS = ("wine bottle", ", banana")
"""First prompt, and the text that is added to it."""
SIZE, WIDTH = (1200, 750), 1000
"""Size of the page, and width of the animation."""
POINTER = """
const pointer = globalThis.pointer = document.createElement("div");
const arrow = "M3 2v19l5-5 4 9 4-2-4-8h7z";
pointer.innerHTML = `<svg width="26" height="26"><path d="${arrow}" fill="white" stroke="black"/></svg>`;
pointer.style.cssText = "position: fixed; z-index: 9999; pointer-events: none; left: 600px; top: 420px";
document.body.append(pointer);
addEventListener("pointermove", ({clientX, clientY}) => {
  [pointer.style.left, pointer.style.top] = [`${clientX - 3}px`, `${clientY - 2}px`];
}, true);
"""
"""Script that draws the pointer, which screenshots do not show."""


def main(config: Path) -> None:
    """Run the scene and write the animation."""
    log = Path(tempfile.mkdtemp()) / "log"
    with chromium() as browser, Server(OWN, config, log).running() as address:
        film = Film(OnPage(browser, address, size=SIZE))
        play(film)
    film.save(DOCS / "page.webp")


class Film:
    """Frames of a page, with their times in milliseconds."""

    def __init__(self, seen: OnPage) -> None:
        self.seen, self.frames, self.times = seen, list[Image.Image](), list[int]()
        seen.page.emulate_media(color_scheme="dark")
        seen.page.reload()
        seen.ready()
        seen.page.evaluate(POINTER)

    def keep(self, milliseconds: int) -> None:
        """Add a screenshot of the page."""
        image = Image.open(io.BytesIO(self.seen.page.screenshot())).convert("RGB")
        self.frames.append(image.resize((WIDTH, WIDTH * image.height // image.width), Image.Resampling.LANCZOS))
        self.times.append(milliseconds)

    def move(self, x: float, y: float, steps: int = 4) -> None:
        """Move the pointer in a few frames."""
        left, top = self.seen.page.evaluate("[pointer.offsetLeft + 3, pointer.offsetTop + 2]")
        for step in range(1, steps + 1):
            self.seen.page.mouse.move(left + (x - left) * step / steps, top + (y - top) * step / steps)
            self.keep(60)

    def press(self, element: str) -> None:
        """Move to an element and click on it."""
        box = self.seen.page.locator(element).bounding_box()
        assert box is not None
        self.move(box["x"] + box["width"] / 2, box["y"] + box["height"] / 2)
        self.seen.page.mouse.down()
        self.seen.page.mouse.up()

    def type(self, text: str) -> None:
        """Type letter by letter, press Enter and wait for the answer."""
        before = self.seen.page.evaluate("page.revision")
        for letter in text:
            self.seen.page.keyboard.type(letter)
            self.keep(70)
        self.seen.page.keyboard.press("Enter")
        self.seen.until(lambda: self.seen.page.evaluate("page.revision") > before, "an answer")
        self.seen.calm()

    def save(self, path: Path) -> None:
        """Write an animated WebP that repeats forever."""
        first, *others = self.frames
        how = {"save_all": True, "append_images": others, "duration": self.times, "loop": 0}
        first.save(path, **how, quality=80, method=6, minimize_size=False)
        seconds, size = sum(self.times) / 1000, path.stat().st_size
        sys.stdout.write(f"Written: {path}, {len(self.frames)} frames, {seconds:.1f} s, {size / 1e6:.2f} MB\n")


def play(film: Film) -> None:
    """Act on the page, and record the frames."""
    seen = film.seen
    film.keep(500)
    film.press("#prompts")
    film.type(PROMPTS[0])
    seen.sees(lambda picture: coloured(picture).sum() > 300, "an overlay")
    film.keep(900)
    seen.prompts.press("End")
    film.type(PROMPTS[1])
    film.keep(900)
    film.move(*middle(seen))
    seen.page.locator("#hover:not([hidden])").wait_for()
    film.keep(900)
    film.press("#do-why")
    seen.page.locator("#why:not([hidden]) img").first.wait_for()
    film.keep(2000)
    seen.page.keyboard.press("Escape")
    film.press("#do-isolate")
    seen.until(lambda: seen.state("hidden") > 0, "isolated")
    seen.calm()
    film.keep(900)
    film.press("#save-ply")
    film.keep(900)


def middle(seen: OnPage) -> tuple[float, float]:
    """Return the position on the page of the colored pixel nearest to the center of all colored pixels."""
    rows, columns = coloured(seen.shot()).nonzero()
    nearest = ((rows - rows.mean()) ** 2 + (columns - columns.mean()) ** 2).argmin()
    box = seen.page.locator("#stage").bounding_box()
    assert box is not None
    return box["x"] + float(columns[nearest]), box["y"] + float(rows[nearest])


if __name__ == "__main__":
    main(Path(sys.argv[1]).resolve() if len(sys.argv) > 1 else CONFIG.resolve())
