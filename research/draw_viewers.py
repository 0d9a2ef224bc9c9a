"""docs/viewer_own.jpg, viewer_overlay.jpg and viewer_isolated.jpg: both viewers on the demo room, in Chromium.

python -m research.draw_viewers [FOLDER of both lifted runs of the demo]      after make demo; the runs do not change

The page uses the trained networks, and the panel in nerfstudio's viewer uses color names.
"""

from __future__ import annotations

import io
import sys
import tempfile
from pathlib import Path

from PIL import Image
from playwright.sync_api import Browser, Page

from research.plots import DOCS
from tests.browser.page import OnPage
from tests.browser.person import PANEL, chromium, coloured
from tests.browser.server import OWN, Server
from tests.browser.server import STOCK as STOCK_VIEWER
from tests.browser.viewer import TITLE, Tab

RUNS = Path("demo/outputs/room/normlift")
ASKED, STOCK = "banana, wine bottle", "tomato red, banana yellow"
"""Objects that the first views of the two viewers show."""
CLICKED = (0.35, 0.85)
"""Position of the pumpkin in the image of the first view, as fractions of its width and height."""


def main(runs: Path) -> None:
    """Draw the three figures."""
    config = runs / "demo" / "config.yml"
    log = Path(tempfile.mkdtemp()) / "log"
    with chromium() as browser:
        with Server(OWN, runs / "thing" / "config.yml", log).running() as address:
            own(browser, address)
        with Server(STOCK_VIEWER, config, log, cwd=config.parents[4]).running() as address:
            stock(browser, address)


def own(browser: Browser, address: str) -> None:
    """Draw ns-normlift-view with an answer."""
    page = OnPage(browser, address, size=(1200, 720))
    page.page.emulate_media(color_scheme="dark")
    page.page.reload()
    page.ready()
    page.ask(ASKED)
    page.selects(lambda count: count > 0, "an answer")
    page.sees(lambda seen: coloured(seen).sum() > 1000, "an overlay")
    page.page.locator("#selected").hover()  # so that no button is marked
    shot(page.page, "viewer_own")


def stock(browser: Browser, address: str) -> None:
    """Draw ns-viewer with an answer, and with one isolated object."""
    tab = Tab(browser, address, size=(1300, 947))
    tab.fresh()
    tab.asks(STOCK, answered=2)
    tab.show("overlay")
    tab.sees(lambda seen: coloured(seen).sum() > 1000, "an overlay")
    shot(tab.page, "viewer_overlay")
    tab.press("Clear")
    tab.show("rgb")
    tab.arm("More like this")
    tab.click(((1300 - PANEL) * CLICKED[0], (947 - TITLE) * CLICKED[1]))
    tab.selects(lambda count: count > 0, "clicked")
    tab.press("Only")
    tab.show("rgb")
    tab.sees(lambda seen: (seen.std(axis=2) < 20).mean() > 0.7, "one thing before the background")
    shot(tab.page, "viewer_isolated")


def shot(page: Page, name: str) -> None:
    """Save the page as a JPEG file of the documentation, at most 1,200 pixels wide."""
    image = Image.open(io.BytesIO(page.screenshot())).convert("RGB")
    image.thumbnail((1200, 1200))
    image.save(DOCS / f"{name}.jpg", quality=88)
    sys.stdout.write(f"Written: {DOCS / name}.jpg\n")


if __name__ == "__main__":
    main(Path(sys.argv[1]).resolve() if len(sys.argv) > 1 else RUNS.resolve())
