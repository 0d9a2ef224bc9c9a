"""nerfstudio's viewer in a process of its own, and a person before it."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from tests.browser.person import COARSE, Person, coloured, draw_in_software

if TYPE_CHECKING:
    from playwright.sync_api import Browser, Locator

TITLE = 52
"""Height of the title bar in pixels."""


class Tab(Person):
    """A browser tab with nerfstudio's viewer in it, whose panel all tabs share."""

    top = TITLE
    drawn = r"\b512(x\d+)?px"

    def __init__(self, browser: Browser, address: str, size: tuple[int, int] = (1300, 1000), **how: Any) -> None:
        super().__init__(browser, address, size, **how)

    def prepare(self) -> None:
        draw_in_software(self.page, COARSE)

    @property
    def prompts(self) -> Locator:
        return self.field("Prompts")

    def fresh(self) -> None:
        """Takes back what was done before in any tab, but for what is stored."""
        self.press("Clear")
        self.until(lambda: "No query" in self.text() and self.typed("Prompts") == "", "cleared")
        self.show("rgb")

    def arm(self, button: str) -> None:
        super().arm(button)
        canvas = self.page.locator("canvas[data-engine]")  # what makes it take clicks comes on another way
        self.until(lambda: "cursor: pointer" in (canvas.get_attribute("style") or ""), "takes clicks")

    def choose(self, label: str, option: str) -> None:
        if self.typed(label) != option:
            self.hit(self.field(label))
            with self.sending():
                self.hit(self.page.get_by_role("option", name=option, exact=True))

    def tab(self, name: str) -> None:
        self.hit(self.page.get_by_role("tab", name=name, exact=True))

    def output(self) -> str:
        """The output that is shown; as after `show`, the tab Search is open afterwards."""
        self.tab("Control")
        found = self.typed("Output type")
        self.tab("Search")
        return found

    def show(self, output: str) -> None:
        self.tab("Control")
        self.until(lambda: self.typed("Output type") != "not set", "a picture tells what there is")
        self.choose("Output type", output)
        self.tab("Search")

    def answered(self) -> int:
        """Number of prompts in the table that are answered."""
        return sum(text.count("■") for text in self.page.locator("table:visible").all_inner_texts())

    def asks(self, prompts: str, *, answered: int, key: bool = False) -> None:
        self.ask(prompts, key=key)
        self.until(lambda: self.answered() == answered, f"asked {prompts[:20]!r}")


def overlaid(picture: np.ndarray) -> np.ndarray:
    """Pixels that are not grey; without the legend in the lower right corner."""
    mask = coloured(picture)
    mask[-160:, -340:] = False
    return mask
