"""The widgets of the panel: a tab of its own in nerfstudio's viewer, in front of the others.

They are viser's, not nerfstudio's: its elements stand in a folder far down, forget who pressed them, and hold its
render lock while they work.
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
"""Enter and Escape, which viser 0.2.7 does not know. It sends what is typed at most every 50 ms."""


class Widgets:
    """The tab, for all browsers.

    Args:
        server: viser's.
        act: called with the name of what was pressed or changed, its value and the client who did it.
        lock: the panel's, held while a change is passed to `act`, so that no other thread takes it back meanwhile.
    """

    def __init__(self, server: Any, act: Callable[[str, Any, Any], None], lock: AbstractContextManager[Any]) -> None:
        self._gui, self._act = server.gui, act
        self._lock = lock
        self._values: dict[str, Any] = {}
        with first_tab(server.gui, TAB, "SEARCH"):
            self.prompts = self._gui.add_text("Prompts", "", hint="What to look for, separated by commas.")
            self.ask = self._button("Ask", hint="Or press Enter in the prompts.")
            self.cancel = self._button("Cancel", hint="Or press Escape. Ends what waits or runs.")
            self.cancel.visible = False
            self.status = self._gui.add_markdown("")
            self.poor = self._button("Leave out what is poorly evidenced")
            self.poor.visible = False
            self._group("History", ("Undo", "Redo", "Clear"))
            self.threshold = self._slider("Threshold", LOWEST, HIGHEST, 0.005, 0.5, "Relevancy to select.")
            self.reliability = self._slider(
                "Minimum reliability", 0.0, 1.0, 0.01, 0.0, "R that what is selected must have."
            )
            self._button("Suggested", hint="The threshold that the histogram suggests, the dashed line in it.")
            self._group("Selection", ("Hide", "Only", "All"))
            self._button("Select likely floaters", hint="Gaussians of no surface. Look at them, then hide them.")
            self.found = self._gui.add_markdown("")
            self.histograms = self._gui.add_markdown("")
            self.rows = Rows(self._gui, lambda deed, row, event: act(deed, row, event.client))
            with self._gui.add_folder("Why"):
                self.why = self._button("Why?", hint="The photographs that voted for the selection.")
                self.reasons = self._gui.add_markdown("")
            with self._gui.add_folder("Click in the scene"):
                self._button("More like this", hint="Asks for everything similar to the Gaussian you click.")
                self._group("Objects", ("Select", "Add", "Drop"))
                self.steps = self._slider(
                    "Grow", -MOST_STEPS, MOST_STEPS, 1, 0, "Grows or shrinks the selection, from part to whole."
                )
            with self._gui.add_folder("Keep"):
                self._button("Download selection", hint="The selected Gaussians as a PLY file.")
                self._button("Save prompts in run", hint="Beside those already there; ns-render draws them.")
                self.replace = self._button("Replace the saved prompts")
                self.replace.visible = False
            with self._gui.add_folder("How it is asked and drawn", expand_by_default=False):
                self.shown = self._input(
                    "shown",
                    self._gui.add_dropdown("Prompt shown", (ALL_PROMPTS,), ALL_PROMPTS, hint="Which one selects."),
                )
                self.colormap = self._input(
                    "colormap", self._gui.add_dropdown("Colours", COLORMAPS, COLORMAPS[0], hint="Of relevancy.")
                )
                self.negatives = self._gui.add_text("Negatives", "", hint="What to compare with, separated by commas.")
                rules = ("auto", *RULES)
                self.rule = self._gui.add_dropdown("Relevancy", rules, "auto", hint="lerf and margin use negatives.")
                self.refined = self._input(
                    "refined", self._gui.add_checkbox("Refined", True, hint="Use refined features.")
                )
        self._gui._websock_interface.queue_message(_javascript(_SCRIPT))

    def forget(self, negatives: str) -> None:
        """Sets back what the next question would take over."""
        self._reset("Minimum reliability", self.reliability, 0.0)
        self._reset("refined", self.refined, True)
        self.rule.value, self.negatives.value = "auto", negatives

    def follow(self, state: State) -> None:
        """Shows a state in every widget but the boxes in which a person types."""
        texts = () if state.answer is None else state.answer.texts
        options = (ALL_PROMPTS, *(f"{i + 1}: {clipped(text, 30)}" for i, text in enumerate(texts)))
        if tuple(self.shown.options) != options:
            self._values["shown"] = ALL_PROMPTS
            self.shown.options = options
            self._values["shown"] = self.shown.value  # viser keeps the choice where the new options have it
        self._set("shown", self.shown, options[0 if state.shown is None else state.shown + 1])
        if state.question is not None:
            threshold = min(HIGHEST, max(LOWEST, state.question.threshold))
            self._set("Threshold", self.threshold, threshold)
            self._set("Minimum reliability", self.reliability, state.question.min_reliability)
            self._set("refined", self.refined, state.question.refined)
        self._set("Grow", self.steps, state.steps)
        self.poor.visible = state.remark != ""

    def explain(self, reasons: str, *, busy: bool) -> None:
        """Shows why something is selected, as `viewer.reasons.Reasons` has it."""
        self.why.disabled = busy
        if self.reasons.content != reasons:
            self.reasons.content = reasons

    def place(self, value: str) -> int | None:
        """The prompt that a choice of the dropdown names."""
        return None if value == ALL_PROMPTS else int(value.split(":", maxsplit=1)[0]) - 1

    def _button(self, label: str, *, hint: str | None = None) -> Any:
        button = self._gui.add_button(label, hint=hint)
        button.on_click(lambda event: self._act(label, None, event.client))
        return button

    def _group(self, label: str, options: tuple[str, ...]) -> None:
        group = self._gui.add_button_group(label, options)
        group._impl.is_button = True  # viser 0.2.7 takes a second press of the same one for no change
        group.on_click(lambda event: self._act(group.value, None, event.client))

    def _slider(self, label: str, low: float, high: float, step: float, value: float, hint: str) -> Any:
        return self._input(label, self._gui.add_slider(label, low, high, step, value, hint=hint))

    def _input(self, name: str, widget: Any) -> Any:
        """A widget whose changes are told, but for those that the program made."""
        self._values[name] = widget.value

        def changed(event: Any) -> None:
            with self._lock:
                if widget.value != self._values[name]:
                    self._values[name] = widget.value
                    self._act(name, widget.value, event.client)

        widget.on_update(changed)
        return widget

    def _set(self, name: str, widget: Any, value: Any) -> None:
        """Sets a widget without telling `act`, unless a person has changed it and `act` has not been told yet."""
        if widget.value == self._values[name]:
            self._reset(name, widget, value)

    def _reset(self, name: str, widget: Any, value: Any) -> None:
        """Sets a widget without telling `act`, even where a person has just changed it."""
        if widget.value != value:
            self._values[name] = value
            widget.value = value


def first_tab(gui: Any, label: str, icon: str) -> Any:
    """A tab in front of those that the viewer has; as a context, it takes the widgets that are made in it.

    viser adds tabs behind the others, and the viewer keeps its group of tabs to itself.
    """
    from viser import Icon, _gui_handles  # noqa: PLC0415 (nerfstudio's commands without a viewer load this module)

    tabs = [held for held in gui._container_handle_from_id.values() if isinstance(held, _gui_handles.GuiTabHandle)]
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
