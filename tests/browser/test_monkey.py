"""Both viewers before a monkey: nothing breaks, whatever is pressed, and the server's memory does not grow.

NORMLIFT_SOAK: minutes per viewer (0.5). NORMLIFT_SEED: the seed, which is printed. `make soak` takes 30 minutes and a
seed of its own. Chance is made of the seed and the number of the deed, so that a run can nearly be repeated.
"""

from __future__ import annotations

import os
import random
import re
import signal
import time
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

from tests.browser.page import OnPage
from tests.browser.person import needs_chromium
from tests.browser.server import OWN, STOCK, Server, copied, faults
from tests.browser.viewer import Tab
from tests.viewer.scenes import until

if TYPE_CHECKING:
    from playwright.sync_api import Browser

pytestmark = [pytest.mark.extra, needs_chromium]
MINUTES = float(os.environ.get("NORMLIFT_SOAK", "0.5"))
SEED = os.environ.get("NORMLIFT_SEED", "1")
MOST_GROWTH = 50.0
"""Megabytes that are not freed, once it is warm."""
KILL, WARM = 0.3, 0.65
"""When the server is killed, and from when on its memory is watched, as shares of the time."""
ASKED = (
    "import ctypes, gc, os, signal; "
    "freed = lambda *_: (gc.collect(), ctypes.CDLL(None).malloc_trim(0), os.write(1, b'freed\\n')); "
    "signal.signal(signal.SIGUSR2, freed); "
)
"""A program that gives back memory that it has freed when it is asked."""
PROMPTS = (
    "red", "red, yellow", "dark green; sky blue", "red, zebra; purple", " ", ",;,", "like click 1", "like click 99",
    "<b>red</b>", "[/red] {x}", "**red** | `code` | <script>alert(1)", "größe, 红色, 🦊", "\u202ered",
    "../../etc/passwd", "x" * 5000, ", ".join(f"red {i}" for i in range(200)),
)  # fmt: skip
KEYS = ("Escape", "Enter", "Control+z", "Control+Shift+z", "Tab", "Shift", "Alt", "w", "ArrowLeft", "Backspace")
SIZES = ((640, 480), (900, 480), (390, 700))
PRESSED = (
    "button, summary, select, [type=range], [role=tab], [role=option], input[readonly], "
    ".mantine-ActionIcon-root, .mantine-Slider-track, .mantine-NumberInput-control"
)
_FIND = """([what, share]) => {
  const found = [...document.querySelectorAll(what)].filter((e) =>
    e.getClientRects().length > 0 && !e.disabled && !e.querySelector(".tabler-icon-share"));
  if (found.length === 0) return null;
  const one = found[Math.floor(share * found.length)];
  one.scrollIntoView({block: "center"});
  const box = one.getBoundingClientRect();
  return [box.x, box.y, box.width, box.height, (one.textContent || "").slice(0, 30)];
}"""
"""Any of some elements, but for what asks a server on the internet for a tunnel."""
FOREIGN = re.compile(
    r"ERR_NAME_NOT_RESOLVED|ERR_INTERNET_DISCONNECTED"  # viser's page calls Google's statistics
    r"|ERR_CONNECTION_RE(?:FUSED|SET)|WebSocket connection to|Failed to fetch"  # while the server is away
    r"|WebGL|GL Driver|GPU stall|computeBoundingSphere"  # of Chromium and of three.js
    r"|null \((setting 'enabled'|reading 'setLookAt')\)|resetCameraViewRef"  # of viser before its camera is there
    r"|Tried to update non-existent component"  # of viser: still in a page's queue when the connection was lost
    r"|showSaveFilePicker"  # of viser: its own "Export Canvas" cannot ask where to
)
"""Errors that are not ours."""


class Serving(Server):
    """A viewer that says how much memory it uses."""

    def megabytes(self) -> float:
        """Memory that is really used, without what the C library keeps for later."""
        assert self.process is not None
        before = self.said().count("freed")
        self.process.send_signal(signal.SIGUSR2)
        until(lambda: self.said().count("freed") > before, self.said)
        status = Path(f"/proc/{self.process.pid}/status").read_text()
        return int(re.findall(r"VmRSS:\s+(\d+) kB", status)[0]) / 1024


class Monkey:
    """Two browsers before one server, in which it presses, types, clicks, drags, reloads and closes by chance."""

    def __init__(self, browser: Browser, server: Serving, kind: type[OnPage] | type[Tab]) -> None:
        self.browser, self.server, self.kind = browser, server, kind
        self.deeds: list[str] = []
        self.problems: list[str] = []
        self.killed = False
        self.chance = random.Random(SEED)
        self.people = [self.opened(size) for size in SIZES[:2]]

    def opened(self, size: tuple[int, int]) -> OnPage | Tab:
        person = self.kind(self.browser, self.server.address, size=size)
        person.page.on("pageerror", lambda error: self.note(f"{error} {error.stack or ''}"))
        person.page.on("crash", lambda _: self.note("the tab has crashed"))
        person.page.on("dialog", lambda dialog: self.note(f"a dialog says {dialog.message}"))
        person.page.on("console", lambda line: self.note(line.text) if line.type == "error" else None)
        person.page.add_init_script("window.showSaveFilePicker = undefined")  # can end a browser without a screen
        person.page.reload(wait_until="domcontentloaded")
        return person

    def note(self, problem: str) -> None:
        if not FOREIGN.search(problem):
            self.problems.append(problem)

    def act(self) -> None:
        """One deed, and a look at whether anything is wrong."""
        from playwright.sync_api import Error  # noqa: PLC0415

        self.chance = random.Random(f"{SEED}:{len(self.deeds)}")
        who = self.chance.randrange(2)
        deeds = (self.press, self.ask, self.click, self.drag, self.key, self.renew)
        (deed,) = self.chance.choices(deeds, (50, 15, 15, 7, 9, 4))
        self.deeds.append(f"{who} {deed.__name__}")
        try:
            self.deeds[-1] += f" {deed(self.people[who])}"
            self.people[who].page.wait_for_timeout(self.chance.choice((0, 0, 100, 300)))
        except Error as error:
            self.problems.append(str(error))
        self.check()

    def check(self) -> None:
        self.problems += [f"the server: {fault[:4000]}" for fault in our_faults(self.server, self.kind)]
        if not self.server.alive():
            self.problems.append("the server has ended: " + self.server.said()[-2000:])
        last = "\n".join([f"{i}: {deed}" for i, deed in enumerate(self.deeds)][-30:])
        assert not self.problems, f"seed {SEED}, after\n{last}\n" + "\n".join(self.problems[:5])

    def kill(self) -> None:
        self.killed = True
        self.server.kill()
        self.server.start(MALLOC_ARENA_MAX="1")

    def megabytes(self) -> float:
        """Memory of the server while nobody looks: what is drawn at a moment, and how large, is no growth."""
        for person in self.people:
            person.page.goto("about:blank")
        used: list[float] = []
        while len(used) < 4 or (used[-1] < used[-4] - 1 and len(used) < 12):  # pictures are still being made
            time.sleep(2)
            used.append(self.server.megabytes())
        for person in self.people:
            person.page.goto(self.server.address, wait_until="domcontentloaded")
        return min(used)

    def use_everything(self) -> None:
        """A fresh page asks, and is answered; so that later only what leaks makes memory grow."""
        one = self.opened(SIZES[0])
        one.button("Ask").wait_for()
        if isinstance(one, Tab):
            one.press("Clear")  # a threshold that was saved would be kept
            one.until(lambda: one.selected() == -1, "cleared")
        one.ask("red, purple")
        one.says("purple (object )?1")
        one.press("Why?")
        one.until(lambda: one.images("jpeg") > 0, "reasons")
        if isinstance(one, OnPage):
            one.page.locator("#fold-advanced summary").click()
        one.press("Select likely floaters")
        one.until(lambda: one.images("jpeg") == 0 or isinstance(one, OnPage), "floaters")
        one.context.close()
        self.check()

    def press(self, person: OnPage | Tab) -> str | None:
        box = person.page.evaluate(_FIND, [PRESSED, self.chance.random()])
        if box is None:
            return None
        x, y = (box[i] + self.chance.uniform(0.1, 0.9) * box[i + 2] for i in range(2))
        person.page.mouse.click(x, y)
        return box[4]

    def ask(self, person: OnPage | Tab) -> str | None:
        box = person.prompts
        if not box.is_visible():
            return None
        box.click(click_count=3)
        text = self.chance.choice(PROMPTS)
        person.page.keyboard.insert_text(text)
        person.page.wait_for_timeout(self.chance.choice((0, 100, 300)))
        person.page.keyboard.press(self.chance.choice(("Enter", "Enter", "Tab")))
        return text[:40]

    def place(self, person: OnPage | Tab) -> tuple[float, float]:
        width, height = person.size
        return self.chance.uniform(5, max(30, width - 330)), self.chance.uniform(60, height - 5)

    def click(self, person: OnPage | Tab) -> str:
        """On the picture, often with a key or after a button that wait for it."""
        how = self.chance.choice(("Shift", "Alt", "Select", "Add", "Drop", "More like this", ""))
        if key := how in ("Shift", "Alt"):
            person.page.keyboard.down(how)
        elif how and person.button(how).first.is_visible():
            person.button(how).first.dispatch_event("click")
        person.page.wait_for_timeout(self.chance.choice((0, 100, 300)))
        person.page.mouse.click(*self.place(person), click_count=self.chance.choice((1, 1, 1, 2)))
        if key:
            person.page.keyboard.up(how)
        return how

    def drag(self, person: OnPage | Tab) -> str:
        start, end = self.place(person), self.place(person)
        button = self.chance.choice(("left", "right"))
        person.page.mouse.wheel(0, self.chance.choice((-300, 0, 300)))
        person.page.mouse.move(*start)
        person.page.mouse.down(button=button)  # type: ignore[arg-type]
        person.page.mouse.move(*end, steps=4)
        person.page.mouse.up(button=button)  # type: ignore[arg-type]
        return button

    def key(self, person: OnPage | Tab) -> str:
        key = self.chance.choice(KEYS)
        if self.chance.random() < 0.5:
            person.page.evaluate("document.activeElement && document.activeElement.blur()")
        person.page.keyboard.press(key, delay=self.chance.choice((0, 50, 300)))
        return key

    def renew(self, person: OnPage | Tab) -> str:
        if self.chance.random() < 0.5:
            person.page.reload(wait_until="domcontentloaded")
            return "reload"
        person.context.close()
        self.people[self.people.index(person)] = self.opened(self.chance.choice(SIZES))
        return "browser"


def our_faults(server: Server, kind: type) -> list[str]:
    """Tracebacks; of nerfstudio's viewer those through this package, but for what stands around all that viser reads.

    Its own widgets raise, for instance where they are pressed while it starts.
    """
    ours = r'normlift_ns/(?!viewer/adapter\.py", line \d+, in read\n)'
    return [fault for fault in faults(server.said()) if kind is OnPage or re.search(ours, fault)]


@pytest.mark.parametrize(("program", "kind"), [(OWN, OnPage), (STOCK, Tab)], ids=["own", "stock"])
def test_nothing_breaks_and_nothing_grows(program, kind, lifted: Path, browser: Browser, tmp_path: Path) -> None:
    server = Serving(ASKED + program, copied(lifted, tmp_path), tmp_path / "log", cwd=tmp_path)
    print(f"\n{kind.__name__}: seed {SEED}, {MINUTES:g} minutes")
    try:
        server.start(MALLOC_ARENA_MAX="1")  # with an arena per thread the C library keeps up to 250 MB
        soak(Monkey(browser, server, kind))
    finally:
        server.stop()
    assert our_faults(server, kind) == []


def soak(monkey: Monkey) -> None:
    """Time that servers take to start, and that memory takes to be measured, does not count."""
    whole, spent, used = 60 * MINUTES, 0.0, []
    while spent < whole:
        if spent > KILL * whole and not monkey.killed:
            monkey.kill()
            monkey.use_everything()
        if spent > WARM * whole and not used:
            used.append(monkey.megabytes())
        before = time.monotonic()
        monkey.act()
        spent += time.monotonic() - before
    used.append(monkey.megabytes())
    for person in monkey.people:
        person.context.close()
    monkey.use_everything()
    print(f"{len(monkey.deeds)} deeds; memory in MB once warm and at the end: {used}")
    assert used[-1] - used[0] < MOST_GROWTH, used
