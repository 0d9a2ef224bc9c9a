"""A monkey before a viewer: two browsers in which it presses, types, clicks, reloads and closes by chance, and a server
that is killed meanwhile.

Chance is made of the seed and the number of the deed, so that a run can be repeated as far as time is not part of it.
"""

from __future__ import annotations

import random
import re
import signal
import time
from pathlib import Path

from playwright.sync_api import Browser, ConsoleMessage, Page, TimeoutError

from tests.browser.person import COARSE, draw_in_software
from tests.browser.server import Server, faults

PROMPTS = (
    "red", "purple", "red, yellow", "dark green; sky blue", "teal", "zebra", "red, zebra; purple", "", " ", ",;,", "-5",
    "like click 1", "like click 99", "red, red, red", "<b>red</b>", "[/red] {x}", "**red** | `code` | <script>alert(1)",
    "{{constructor}}", "red\\", "ROT", "größe, 红色, 🦊", "\u202ered", "%s %d {0}", "../../etc/passwd", "x" * 5000,
    ", ".join(f"red {i}" for i in range(200)), "red " * 400, "orange" + "," * 300,
)  # fmt: skip
NUMBERS = ("0", "0.5", "0.97", "1", "-0.2", "-7", "9", "1e9", "0,5", "-", "abc", "", "0.0000001")
KEYS = (
    "Escape", "Enter", "Control+z", "Control+Shift+z", "Tab", "Shift", "Alt", "w", "ArrowLeft", "ArrowUp", "Backspace",
    "Space",
)  # fmt: skip
SIZES = ((640, 480), (390, 700), (900, 480), (640, 300))
PRESSED = "button, [role=tab], .mantine-ActionIcon-root, .tabler-icon-chevron-up, .tabler-icon-chevron-down"
_NOT_PRESSED = ".tabler-icon-share"
"""Asks a server on the internet for a tunnel."""
_FIND = """([what, not, share]) => {
  const found = [...document.querySelectorAll(what)].filter((e) =>
    e.getClientRects().length > 0 && !e.disabled && !e.matches(not) && !e.querySelector(not));
  if (found.length === 0) return null;
  const one = found[Math.floor(share * found.length)];
  one.scrollIntoView({block: "center"});
  const box = one.getBoundingClientRect();
  return [box.x, box.y, box.width, box.height, (one.textContent || one.className.baseVal || "").slice(0, 30)];
}"""
_PROMPTS = """() => {
  let row = [...document.querySelectorAll("label")].find((e) => e.textContent === "Prompts");
  while (row && !row.querySelector("input")) row = row.parentElement;
  const box = row && row.querySelector("input");
  if (!box || box.getClientRects().length === 0) return false;
  box.focus();
  box.select();
  return true;
}"""
_SHOWN = """() => [document.body.innerText,
  ...[...document.querySelectorAll("input, textarea")].map((e) => e.value)].join(" | ")"""
"""What a page says, and what is typed in it."""
_STACKS = """
Error.stackTraceLimit = 40;
const told = console.error;
console.error = (...words) => told(...words, new Error().stack);
window.showSaveFilePicker = undefined;
"""
"""So that errors on the console say where they come from, and no dialogue of the system opens, which can end a browser
without a screen.
"""
FOREIGN = re.compile(
    r"ERR_NAME_NOT_RESOLVED|ERR_INTERNET_DISCONNECTED"  # viser's page calls Google's statistics
    r"|ERR_CONNECTION_RE(?:FUSED|SET)|WebSocket connection to|Failed to fetch"  # while the server is away
    r"|WebGL|GL Driver|GPU stall|computeBoundingSphere"  # of Chromium and of three.js
    r"|null \((setting 'enabled'|reading 'setLookAt')\)"  # of viser: clicks before its camera is there
    r"|resetCameraViewRef"  # of viser: its own "Reset View" before its camera is there
    r"|showSaveFilePicker"  # of viser: its own "Export Canvas" cannot ask where to
)
"""Errors that are not ours."""
_LATE = "Tried to update non-existent component"
"""Of viser: what was still in a page's queue when the connection was lost."""


class Serving(Server):
    """A viewer that says what its threads do when it is asked, and how much memory it uses."""

    def start(self, *flags: str, **environment: str) -> None:
        super().start(*flags, MALLOC_ARENA_MAX="1", **environment)  # as `megabytes` needs it

    def threads(self) -> str:
        """What every thread of the server does."""
        if not self.alive():
            return ""
        assert self.process is not None
        before = len(self.said())
        self.process.send_signal(signal.SIGUSR1)
        time.sleep(2)
        return self.said()[before:]

    def megabytes(self) -> float:
        """Memory that is really used, without what the C library keeps for later.

        With an arena for each of nerfstudio's threads it keeps up to 250 MB, whatever it is asked to give back.
        """
        assert self.process is not None
        self.process.send_signal(signal.SIGUSR2)
        time.sleep(0.3)
        status = Path(f"/proc/{self.process.pid}/status").read_text()
        return int(re.findall(r"VmRSS:\s+(\d+) kB", status)[0]) / 1024


def is_ours(fault: str) -> bool:
    """Whether a traceback has led through this package, but for what stands around all that viser reads."""
    return re.search(r'normlift_ns/(?!viewer/adapter\.py", line \d+, in read\n)', fault) is not None


class Monkey:
    """Two browsers before one server.

    Args:
        forgives: tracebacks that do not lead through this package. nerfstudio's own widgets raise, for instance where
            they are pressed while it starts.
    """

    def __init__(self, browser: Browser, server: Serving, seed: str, *, forgives: bool) -> None:
        self._browser, self._server, self.seed, self._forgives = browser, server, seed, forgives
        self.deeds: list[str] = []
        self.problems: list[str] = []
        self._killed = -10
        self._pages = [self._opened(SIZES[0]), self._opened(SIZES[2])]
        self.wait_for_panels()

    def wait_for_panels(self) -> None:
        """Until the pages have found the server."""
        for page in self._pages:
            page.get_by_role("button", name="Ask", exact=True).wait_for()

    def _opened(self, size: tuple[int, int]) -> Page:
        context = self._browser.new_context(viewport={"width": size[0], "height": size[1]}, accept_downloads=False)
        context.set_default_timeout(60_000)
        return self._watched(context.new_page())

    def _watched(self, page: Page) -> Page:
        page.on("pageerror", lambda error: self._note(f"page error: {error} {error.stack or ''}"))
        page.on("crash", lambda _: self._note("the tab has crashed"))
        page.on("dialog", lambda dialog: self._note(f"a dialog says {dialog.message}"))
        page.on("console", self._hear)
        page.add_init_script(_STACKS)
        draw_in_software(page, COARSE)
        page.goto(self._server.address, wait_until="domcontentloaded")
        return page

    def _hear(self, line: ConsoleMessage) -> None:
        if line.type == "error":
            self._note(f"console: {line.text}")
        if line.text.startswith(("Connected", "Disconnected", "Order lock")) and self.deeds:
            self.deeds[-1] += f" ({line.text.split('!')[0]})"

    def _note(self, problem: str) -> None:
        late = _LATE in problem and len(self.deeds) - self._killed < 10
        if not late and not FOREIGN.search(problem):
            self.problems.append(problem)

    def act(self) -> None:
        """One deed, and a look at whether anything is wrong."""
        chance = random.Random(f"{self.seed}:{len(self.deeds)}")
        who = chance.randrange(2)
        deeds = (self._press, self._ask, self._slide, self._number, self._choose, self._click, self._drag, self._key,
                 self._reload, self._reopen, self._resize, self._wait)  # fmt: skip
        (deed,) = chance.choices(deeds, (34, 14, 7, 5, 5, 14, 6, 8, 2, 1, 1, 3))
        self.deeds.append(f"{who} {deed.__name__[1:]}")
        try:
            self.deeds[-1] += f" {deed(who, chance)}"
        except TimeoutError as error:
            raise AssertionError(
                f"{self.deeds[-1]}: {error}\nthe server's threads:\n{self._server.threads()}"
            ) from error
        self.check()

    def kill(self) -> None:
        """Kills the server and starts it again."""
        self._killed = len(self.deeds)
        self._server.kill()
        self._server.start()

    def megabytes(self) -> float:
        """Memory of the server while nobody looks: what is drawn at a moment, and how large, is no growth."""
        for page in self._pages:
            page.goto("about:blank")
        used: list[float] = []
        while len(used) < 12:  # pictures and photographs that were asked for are still being made
            time.sleep(2)
            used.append(self._server.megabytes())
            if len(used) > 3 and used[-1] > used[-4] - 1:  # no less than it was 6 seconds ago
                break
        for page in self._pages:
            page.goto(self._server.address, wait_until="domcontentloaded")
        return min(used)

    def use_everything(self) -> None:
        """Presses what loads something when it is first pressed, so that later only what leaks makes memory grow."""
        self._ask_in_a_fresh_page(
            "purple object 1", ("Why?", "These weigh most:"), ("Select likely floaters", "press Hide")
        )
        self.check()

    def still_works(self) -> None:
        """A fresh page asks, and is answered; those before are closed."""
        for old in self._pages:
            old.context.close()
        self._ask_in_a_fresh_page("Gaussians selected")
        self.check()

    def _ask_in_a_fresh_page(self, answer: str, *more: tuple[str, str]) -> None:
        """Asks, and presses more buttons, each until it is answered."""
        page = self._opened(SIZES[0])
        page.set_default_timeout(180_000)
        try:
            page.get_by_role("button", name="Ask", exact=True).wait_for()
            page.wait_for_timeout(3000)
            page.get_by_role("button", name="Clear", exact=True).click()  # a threshold that was saved would be kept
            page.wait_for_timeout(2000)
            assert page.evaluate(_PROMPTS)
            page.keyboard.insert_text("red, purple")
            page.wait_for_timeout(2000)
            for name, said in (("Ask", answer), *more):
                page.get_by_role("button", name=name, exact=True).click()
                page.get_by_text(said).first.wait_for()
        except TimeoutError as error:
            shown = f"no answer, but: {page.evaluate(_SHOWN)}\nthe server's threads:\n{self._server.threads()}"
            raise AssertionError(shown) from error
        page.context.close()

    def check(self) -> None:
        said = self._server.said()
        self.problems += [
            f"the server: {fault[:4000]}" for fault in faults(said) if is_ours(fault) or not self._forgives
        ]
        if not self._server.alive():
            self.problems.append("the server has ended: " + said[-2000:])
        if self.problems:
            last = "\n".join([f"{i}: {deed}" for i, deed in enumerate(self.deeds)][-30:])
            raise AssertionError(f"seed {self.seed}, after\n{last}\n" + "\n".join(self.problems[:5]))

    def _find(self, who: int, what: str, chance: random.Random) -> list | None:
        return self._pages[who].evaluate(_FIND, [what, _NOT_PRESSED, chance.random()])

    def _press(self, who: int, chance: random.Random) -> str:
        found = self._find(who, PRESSED, chance)
        if found is None:
            return "nothing"
        self._pages[who].mouse.click(found[0] + found[2] / 2, found[1] + found[3] / 2)
        return found[4]

    def _ask(self, who: int, chance: random.Random) -> str:
        page, text, how = self._pages[who], chance.choice(PROMPTS), chance.choice(("Ask", "Enter", "letters", ""))
        if not page.evaluate(_PROMPTS):
            return "nowhere"
        if how == "letters":
            page.keyboard.type(text[:20], delay=20)
        else:
            page.keyboard.insert_text(text)
        page.wait_for_timeout(chance.choice((0, 100, 300)))
        if how == "Ask":
            page.evaluate(
                "() => [...document.querySelectorAll('button')].find((b) => b.textContent.trim() === 'Ask')?.click()"
            )
        else:
            page.keyboard.press("Enter")
        return f"{how} {text[:40]!r}"

    def _slide(self, who: int, chance: random.Random) -> str:
        found = self._find(who, ".mantine-Slider-track, .mantine-Slider-trackContainer", chance)
        if found is None:
            return "nothing"
        mouse, share = self._pages[who].mouse, [chance.uniform(-0.1, 1.1) for _ in range(4)]
        mouse.move(found[0] + share[0] * found[2], found[1] + found[3] / 2)
        mouse.down()
        for x in share[1:]:
            mouse.move(found[0] + x * found[2], found[1] + found[3] / 2, steps=3)
        mouse.up()
        return f"{share[-1]:.2f}"

    def _number(self, who: int, chance: random.Random) -> str:
        found, text = self._find(who, ".mantine-NumberInput-input", chance), chance.choice(NUMBERS)
        if found is None:
            return "nothing"
        page = self._pages[who]
        page.mouse.click(found[0] + found[2] / 3, found[1] + found[3] / 2, click_count=3)
        page.keyboard.insert_text(text)
        page.keyboard.press(chance.choice(("Enter", "Tab", "ArrowUp", "ArrowDown")))
        return text

    def _choose(self, who: int, chance: random.Random) -> str:
        found = self._find(who, "input[readonly], .mantine-Select-input", chance)
        if found is None:
            return "nothing"
        page = self._pages[who]
        page.mouse.click(found[0] + found[2] / 2, found[1] + found[3] / 2)
        page.wait_for_timeout(300)
        option = self._find(who, "[role=option]", chance)
        if option is None:
            return "no option"
        page.mouse.click(option[0] + option[2] / 2, option[1] + option[3] / 2)
        return option[4]

    def _place(self, who: int, chance: random.Random) -> tuple[float, float]:
        size = self._pages[who].viewport_size
        assert size is not None
        return chance.uniform(5, max(30, size["width"] - 330)), chance.uniform(60, size["height"] - 5)

    def _click(self, who: int, chance: random.Random) -> str:
        page, place = self._pages[who], self._place(who, chance)
        arm, held = chance.choice(("Select", "Add", "Take away", "Drop", "More like this", "")), chance.random()
        key = "Shift" if held < 0.2 else "Alt" if held < 0.4 else ""
        if key:
            page.keyboard.down(key)
        elif arm:
            page.evaluate(
                "(arm) => [...document.querySelectorAll('button')].find((b) => b.textContent.trim() === arm)?.click()",
                arm,
            )
        page.wait_for_timeout(chance.choice((0, 100, 300)))
        page.mouse.click(*place, click_count=chance.choice((1, 1, 1, 2)))
        if key:
            page.keyboard.up(key)
        return f"{key or arm} {place[0]:.0f} {place[1]:.0f}"

    def _drag(self, who: int, chance: random.Random) -> str:
        mouse = self._pages[who].mouse
        button = chance.choice(("left", "right", "wheel"))
        start, end = self._place(who, chance), self._place(who, chance)
        mouse.move(*start)
        if button == "wheel":
            mouse.wheel(0, chance.choice((-300, 300)))
            return button
        mouse.down(button=button)  # type: ignore[arg-type]
        mouse.move(*end, steps=4)
        mouse.up(button=button)  # type: ignore[arg-type]
        return button

    def _key(self, who: int, chance: random.Random) -> str:
        key = chance.choice(KEYS)
        if chance.random() < 0.5:
            self._pages[who].evaluate("document.activeElement && document.activeElement.blur()")
        self._pages[who].keyboard.press(key, delay=chance.choice((0, 50, 300)))
        return key

    def _reload(self, who: int, chance: random.Random) -> str:
        self._pages[who].reload(wait_until="domcontentloaded")
        self._pages[who].wait_for_timeout(chance.choice((0, 500, 3000)))
        return ""

    def _reopen(self, who: int, chance: random.Random) -> str:
        """Closes the page, or the whole browser, and opens another one."""
        old = self._pages[who]
        if chance.random() < 0.5:
            self._pages[who] = self._watched(old.context.new_page())
            old.close()
            return "page"
        old.context.close()
        self._pages[who] = self._opened(chance.choice(SIZES))
        return "browser"

    def _resize(self, who: int, chance: random.Random) -> str:
        width, height = chance.choice(SIZES)
        self._pages[who].set_viewport_size({"width": width, "height": height})
        return f"{width} x {height}"

    def _wait(self, who: int, chance: random.Random) -> str:
        self._pages[who].wait_for_timeout(chance.choice((200, 1000, 3000)))
        return ""
