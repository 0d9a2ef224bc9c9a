"""Both viewers before a monkey: nothing breaks, whatever is pressed, and the server's memory does not grow.

NORMLIFT_SOAK: minutes per viewer (0.5). NORMLIFT_SEED: the seed, which is printed. `make soak` takes 30 minutes and a
seed of its own.
"""

from __future__ import annotations

import os
import time
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

from tests.browser.person import needs_chromium
from tests.browser.server import OWN, STOCK, copied, faults

if TYPE_CHECKING:
    from playwright.sync_api import Browser

    from tests.browser.monkey import Monkey, Serving

pytestmark = [pytest.mark.extra, needs_chromium]
MINUTES = float(os.environ.get("NORMLIFT_SOAK", "0.5"))
SEED = os.environ.get("NORMLIFT_SEED", "1")
MOST_GROWTH = 50.0
"""Megabytes that are not freed, once it is warm."""
KILLS = (0.2, 0.4) if MINUTES > 5 else (0.3,)
"""When the server is killed, as shares of the time; the last one lives on."""
WARM = 0.65
"""From when on its memory is watched."""
LOOKS = 4 if MINUTES > 5 else 2
"""How often, the last time at the end; a look takes half a minute."""
ASKED = (
    "import ctypes, faulthandler, gc, signal; faulthandler.register(signal.SIGUSR1); "
    "signal.signal(signal.SIGUSR2, lambda *_: (gc.collect(), ctypes.CDLL(None).malloc_trim(0))); "
)
"""A program that tells what its threads do when it is asked, and gives back memory that it has freed."""


@pytest.mark.parametrize("viewer", ["own", "stock"])
def test_nothing_breaks_and_nothing_grows(viewer: str, lifted: Path, browser: Browser, tmp_path: Path) -> None:
    from tests.browser.monkey import Monkey, Serving, is_ours  # noqa: PLC0415 (imports playwright)

    config = copied(lifted, tmp_path)
    server = Serving(ASKED + {"own": OWN, "stock": STOCK}[viewer], config, tmp_path / "log", cwd=tmp_path)
    print(f"\n{viewer} viewer: seed {SEED}, {MINUTES:g} minutes")
    try:
        server.start()
        soak(Monkey(browser, server, f"{SEED}:{viewer}", forgives=viewer == "stock"), server)
    finally:
        server.stop()
    found = faults(server.said())
    foreign = [fault for fault in found if not is_ours(fault)]
    print(f"{len(foreign)} tracebacks of viser and nerfstudio alone")
    assert found == (foreign if viewer == "stock" else [])


def soak(monkey: Monkey, server: Serving) -> None:
    """Time that servers take to start, and that memory takes to be measured, does not count."""
    whole, spent, kills, used = 60 * MINUTES, 0.0, list(KILLS), []
    while spent < whole:
        if kills and spent > kills[0] * whole:
            kills.pop(0)
            monkey.kill()
            if not kills:
                monkey.use_everything()
        if spent > (WARM + len(used) * (1 - WARM) / (LOOKS - 1)) * whole:
            used.append(monkey.megabytes())
        before = time.monotonic()
        monkey.act()
        spent += time.monotonic() - before
    used.append(monkey.megabytes())
    monkey.still_works()
    print(f"{len(monkey.deeds)} deeds; memory in MB from when it was warm on: {', '.join(f'{x:.0f}' for x in used)}")
    assert used[-1] - used[0] < MOST_GROWTH, used
