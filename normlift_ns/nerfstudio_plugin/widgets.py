"""Widgets of the panel: a separate tab in nerfstudio's viewer, in front of its other tabs.

The widgets are viser's. nerfstudio's own elements appear in a folder far down, do not report which browser pressed
them, and hold the render lock while their callbacks run.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import AbstractContextManager
from typing import Any

from normlift_ns.colors import COLORMAPS
from normlift_ns.options import RULES
from normlift_ns.session.actions import HIGHEST, LOWEST, MOST_STEPS
from normlift_ns.session.state import State
from normlift_ns.viewer.legend import clipped
from normlift_ns.viewer.rows import Rows

ALL_PROMPTS = "all prompts"
TAB = "Search"
_SCRIPT = """
(() => {
  if (window.normlift) return;
  window.normlift = true;
  const style = document.createElement("style");
  style.textContent = `.mantine-Button-root[data-variant="outline"] { padding-inline: 2px; }
    .mantine-Flex-root > div:has(label:empty) { display: none; }`;
  document.head.append(style);
  const press = (text) => {
    const found = [...document.querySelectorAll("button")].find((b) => b.textContent.trim() === text);
    if (found && !found.disabled) found.click();
  };
  addEventListener("keydown", (event) => {
    const row = event.target.closest ? event.target.closest("div:has(label)") : null;
    const label = row && row.querySelector("label") ? row.querySelector("label").textContent : "";
    const asks = event.target.tagName === "INPUT" && ["Prompts", "Negatives"].includes(label);
    if (event.key === "Enter" && asks) setTimeout(() => press("Ask"), 150);
    if (event.key === "Escape") press("Cancel");
  });
})();
"""
"""Script for the keys Enter and Escape, which viser 0.2.7 does not handle. It sends typed text at most every 50 ms."""


class Widgets:
    """The tab with its widgets, shared by all browsers.

    Args:
        server: viser's server.
        act: called with the name of the pressed or changed widget, its value, and the client of the browser.
        lock: lock of the panel, held while a change is passed to `act`. No other thread can revert it meanwhile.
    """

    def __init__(self, server: Any, act: Callable[[str, Any, Any], None], lock: AbstractContextManager[Any]) -> None:
        self._gui, self._act = server.gui, act
        self._lock = lock
        self._values: dict[str, Any] = {}
        with first_tab(server.gui, TAB, "SEARCH"):
            self.prompts = self._gui.add_text("Prompts", "", hint="What to look for, separated by commas.")
            self.ask = self._button("Ask", hint="Or press Enter in the prompts.")
            self.cancel = self._button("Cancel", hint="Or press Escape. Stops a query or a pending click.")
            self.cancel.visible = False
            self.status = self._gui.add_markdown("")
            self.poor = self._button("Leave out what is poorly evidenced")
            self.poor.visible = False
            self._group("History", ("Undo", "Redo", "Clear"))
            self.threshold = self._slider(
                "Threshold", LOWEST, HIGHEST, 0.005, 0.5, "Relevancy above which Gaussians are selected."
            )
            self.reliability = self._slider(
                "Minimum reliability", 0.0, 1.0, 0.01, 0.0, "Reliability R that selected Gaussians must have."
            )
            self._button("Suggested", hint="Use the threshold that the histogram suggests, its dashed line.")
            self._group("Selection", ("Hide", "Only", "All"))
            self._button("Select likely floaters", hint="Gaussians of no surface. Check them, then hide them.")
            self.found = self._gui.add_markdown("")
            self.histograms = self._gui.add_markdown("")
            self.rows = Rows(self._gui, lambda action, row, event: act(action, row, event.client))
            with self._gui.add_folder("Why"):
                self.why = self._button("Why?", hint="Show the training images that voted for the selection.")
                self.reasons = self._gui.add_markdown("")
            with self._gui.add_folder("Click in the scene"):
                self._button("More like this", hint="Ask for everything similar to the Gaussian you click.")
                self._group("Objects", ("Select", "Add", "Drop"))
                self.steps = self._slider(
                    "Grow", -MOST_STEPS, MOST_STEPS, 1, 0, "Grow or shrink the selection, from part to whole."
                )
            with self._gui.add_folder("Keep"):
                self._button("Download selection", hint="The selected Gaussians as a PLY file.")
                self._button("Save prompts in run", hint="Add them to the stored prompts; ns-render draws them.")
                self.replace = self._button("Replace the saved prompts")
                self.replace.visible = False
            with self._gui.add_folder("How it is asked and drawn", expand_by_default=False):
                self.shown = self._input(
                    "shown",
                    self._gui.add_dropdown("Prompt shown", (ALL_PROMPTS,), ALL_PROMPTS, hint="Prompt that selects."),
                )
                self.colormap = self._input(
                    "colormap", self._gui.add_dropdown("Colours", COLORMAPS, COLORMAPS[0], hint="Relevancy colormap.")
                )
                hint = "Prompts to compare with, separated by commas."
                self.negatives = self._gui.add_text("Negatives", "", hint=hint)
                rules = ("auto", *RULES)
                self.rule = self._gui.add_dropdown("Relevancy", rules, "auto", hint="lerf and margin use negatives.")
                self.refined = self._input(
                    "refined", self._gui.add_checkbox("Refined", True, hint="Use refined features.")
                )
        self._gui._websock_interface.queue_message(_javascript(_SCRIPT))

    def forget(self, negatives: str) -> None:
        """Reset the settings that apply to the next query.

        Args:
            negatives: default negative prompts.
        """
        self._reset("Minimum reliability", self.reliability, 0.0)
        self._reset("refined", self.refined, True)
        self.rule.value, self.negatives.value = "auto", negatives

    def follow(self, state: State) -> None:
        """Show a state in every widget except the text boxes."""
        texts = () if state.answer is None else state.answer.texts
        options = (ALL_PROMPTS, *(f"{i + 1}: {clipped(text, 30)}" for i, text in enumerate(texts)))
        if tuple(self.shown.options) != options:
            self._values["shown"] = ALL_PROMPTS
            self.shown.options = options
            self._values["shown"] = self.shown.value  # viser keeps the choice if it is a new option
        self._set("shown", self.shown, options[0 if state.shown is None else state.shown + 1])
        if state.question is not None:
            threshold = min(HIGHEST, max(LOWEST, state.question.threshold))
            self._set("Threshold", self.threshold, threshold)
            self._set("Minimum reliability", self.reliability, state.question.min_reliability)
            self._set("refined", self.refined, state.question.refined)
        self._set("Grow", self.steps, state.steps)
        self.poor.visible = state.remark != ""

    def explain(self, reasons: str, *, busy: bool) -> None:
        """Show the explanation of a selection.

        Args:
            reasons: MDX, as `viewer.reasons.Reasons.content`.
            busy: whether the explanation is being computed.
        """
        self.why.disabled = busy
        if self.reasons.content != reasons:
            self.reasons.content = reasons

    def place(self, value: str) -> int | None:
        """Return the index of the prompt that an option of the dropdown names; None: all prompts."""
        return None if value == ALL_PROMPTS else int(value.split(":", maxsplit=1)[0]) - 1

    def _button(self, label: str, *, hint: str | None = None) -> Any:
        button = self._gui.add_button(label, hint=hint)
        button.on_click(lambda event: self._act(label, None, event.client))
        return button

    def _group(self, label: str, options: tuple[str, ...]) -> None:
        group = self._gui.add_button_group(label, options)
        group._impl.is_button = True  # else viser 0.2.7 ignores a second press of the same button
        group.on_click(lambda event: self._act(group.value, None, event.client))

    def _slider(self, label: str, low: float, high: float, step: float, value: float, hint: str) -> Any:
        return self._input(label, self._gui.add_slider(label, low, high, step, value, hint=hint))

    def _input(self, name: str, widget: Any) -> Any:
        """Pass the changes of a widget to `act`, except changes made by the program; return the widget."""
        self._values[name] = widget.value

        def changed(event: Any) -> None:
            with self._lock:
                if widget.value != self._values[name]:
                    self._values[name] = widget.value
                    self._act(name, widget.value, event.client)

        widget.on_update(changed)
        return widget

    def _set(self, name: str, widget: Any, value: Any) -> None:
        """Set a widget without calling `act`, unless it has a user's change that `act` has not received yet."""
        if widget.value == self._values[name]:
            self._reset(name, widget, value)

    def _reset(self, name: str, widget: Any, value: Any) -> None:
        """Set a widget without calling `act`, even if a user has just changed it."""
        if widget.value != value:
            self._values[name] = value
            widget.value = value


def first_tab(gui: Any, label: str, icon: str) -> Any:
    """Add a tab in front of the viewer's tabs. Widgets created in its context are placed in it.

    viser adds new tabs at the end, and the viewer does not expose its tab group.
    """
    from viser import Icon, _gui_handles  # noqa: PLC0415 (nerfstudio's commands without a viewer load this module)

    handles = gui._container_handle_from_id.values()
    tabs = [handle for handle in handles if isinstance(handle, _gui_handles.GuiTabHandle)]
    group = tabs[0]._parent if len(tabs) > 0 else gui.add_tab_group()
    tab = group.add_tab(label, getattr(Icon, icon))
    rows: list[list[Any]] = [group._labels, group._icons_html, group._tabs]
    for row in rows:
        row.insert(0, row.pop())
    group._sync_with_client()
    return tab


def _javascript(source: str) -> Any:
    from viser import _messages  # noqa: PLC0415 (as above)

    return _messages.RunJavascriptMessage(source=source)
