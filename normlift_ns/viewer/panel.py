"""The widgets of a page, and how they look for a state. They know no field, and what they do is `person.Person`'s."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

from normlift_ns.asking import Answer
from normlift_ns.errors import InputError
from normlift_ns.session.actions import HIGHEST, LOWEST
from normlift_ns.session.colours import prompt_colours
from normlift_ns.session.space import Box
from normlift_ns.session.state import POOR, State
from normlift_ns.session.verdicts import Verdict
from normlift_ns.viewer.adapter import SESSION, button_group
from normlift_ns.viewer.legend import clipped
from normlift_ns.viewer.paint import LOOKS, legend
from normlift_ns.viewer.rows import Rows
from normlift_ns.viewer.status import as_text, swatch

ALL = "all prompts"


class Panel:
    """The widgets of one page.

    Args:
        gui: viser's `GuiApi` of the page.
        act: called with the name of what was pressed or changed, and its value, in a thread of its own.
        readonly: without what writes to the disk of the server.
    """

    def __init__(self, gui: Any, act: Callable[[str, Any], None], facts: str, *, readonly: bool) -> None:
        self._gui, self._act = gui, act
        self._values: dict[str, Any] = {}
        self.session = gui.add_text(SESSION, "")
        self.session.on_update(lambda _: act("hello", self.session.value))
        self.prompts = gui.add_text("Prompts", "", hint="What to look for, separated by commas. Enter asks.")
        self.ask = self._button("Ask")
        self.cancel = self._button("Cancel", "Escape. Ends a question that runs, and clicks that wait.", "gray")
        self.status = gui.add_markdown("Type what to look for, then press Ask or Enter.")
        self._group("History", ("Undo", "Redo", "Clear"))
        self.shown = self._input(
            "shown", gui.add_dropdown("Prompt", (ALL,), initial_value=ALL, hint="Whose selection counts.")
        )
        self.threshold = self._slider(
            "threshold", "Threshold", LOWEST, HIGHEST, 0.005, 0.5, "Relevancy above which to select."
        )
        self._button("Suggested", "The threshold that the histogram suggests; it is the dashed line in it.", "gray")
        self.histograms = gui.add_markdown("")
        self._nearest: list[Any] = []
        self.sure = self._slider(
            "min_reliability", "Reliability", 0.0, 1.0, 0.01, 0.0, "Minimum R of what is selected."
        )
        self.look = self._input("look", gui.add_dropdown("Draw", LOOKS, initial_value=LOOKS[0]))
        with gui.add_folder("Click in the scene"):
            self._button("Select", "Selects the connected object that you click.", "gray")
            self._button("Add", "Adds objects that you click. Or hold Shift and click.", "gray")
            self._button("Take away", "Takes away objects that you click. Or hold Alt and click.", "gray")
            self._button("More like this", "Asks for everything like what you click.", "gray")
            self.steps = self._slider("resize", "Grow", -10, 10, 1, 0, "Grows or shrinks the selection, part to whole.")
        with gui.add_folder("Hide"):
            self._group("Selection", ("Hide", "Only", "Unhide"))
            self.poor = gui.add_button("Leave out what is poorly evidenced", visible=False)
            self.poor.on_click(lambda _: act("leave out", None))
            self._button("Select likely floaters", "Gaussians that belong to no surface. Look, then hide them.", "gray")
        with gui.add_folder("Why"):
            self.why = self._button("Why?", "Shows the photographs that voted for the selection.", "gray")
            self.reasons = gui.add_markdown("")
        with gui.add_folder("Box", expand_by_default=False):
            self._group("Place", ("Around", "None"))
            self._group("Keep", ("Inside", "Outside"))
            self.centre = gui.add_vector3("Centre", (0.0, 0.0, 0.0), step=0.01)
            self.size = gui.add_vector3("Size", (1.0, 1.0, 1.0), min=(0.0, 0.0, 0.0), step=0.01)
        self.rows = Rows(gui, lambda deed, row, _: act(deed, row))
        with gui.add_folder("Keep"):
            self._button("Download selection", "A PLY file of the selected Gaussians.", "gray")
            if not readonly:
                self._button("Save prompts in run", "Beside those that the run stores already.", "gray")
            self._button("Link", "Puts question and camera into the address of this page.", "gray")
        gui.add_markdown(as_text(facts))

    def _button(self, label: str, hint: str | None = None, color: Any = None) -> Any:
        button = self._gui.add_button(label, hint=hint, color=color)
        button.on_click(lambda _: self._act(label, None))
        return button

    def _group(self, label: str, options: Sequence[str]) -> None:
        button_group(self._gui, label, options, lambda name, _: self._act(name, None))

    def _slider(self, name: str, label: str, low: Any, high: Any, step: Any, value: Any, hint: str) -> Any:
        return self._input(name, self._gui.add_slider(label, low, high, step, value, hint=hint))

    def _input(self, name: str, widget: Any) -> Any:
        """A widget whose changes are told, but for those that the program made."""
        self._values[name] = widget.value

        def changed(_: Any) -> None:
            if widget.value != self._values[name]:
                self._values[name] = widget.value
                self._act(name, widget.value)

        widget.on_update(changed)
        return widget

    def set(self, name: str, widget: Any, value: Any) -> None:
        """Sets a widget without telling."""
        if widget.value != value:
            self._values[name] = value
            widget.value = value

    def forget(self) -> None:
        """Sets back what the next question would take over."""
        self.set("min_reliability", self.sure, 0.0)

    def follow(self, state: State) -> None:
        """Shows a state in all widgets but the prompts, which belong to the person who types."""
        texts = () if state.answer is None else state.answer.texts
        options = (ALL, *(f"{i + 1}: {clipped(text, 30)}" for i, text in enumerate(texts)))
        if tuple(self.shown.options) != options:
            self._values["shown"] = ALL
            self.shown.options = options
        self.set("shown", self.shown, options[0 if state.shown is None else state.shown + 1])
        if state.question is not None:
            self.set("threshold", self.threshold, min(HIGHEST, max(LOWEST, state.question.threshold)))
            self.set("min_reliability", self.sure, state.question.min_reliability)
        self.set("look", self.look, state.look)
        self.set("resize", self.steps, state.steps)
        if state.box is not None:
            self.centre.value, self.size.value = state.box.centre, state.box.size
        self.poor.visible = state.remark != ""

    def place(self, value: str) -> int | None:
        """The prompt that a choice of the dropdown names."""
        return None if value == ALL else int(value.partition(":")[0]) - 1

    def say(self, state: State, message: str, busy: str, drawable: int) -> None:
        """Shows what is selected, and a message."""
        self.status.content = status(state, message, busy, drawable)

    def explain(self, reasons: str, *, busy: bool) -> None:
        """Shows why something is selected, as `reasons.Reasons` has it."""
        self.why.disabled = busy
        if self.reasons.content != reasons:
            self.reasons.content = reasons

    def judge(self, histograms: str, found: Sequence[Verdict]) -> None:
        """Shows histograms as MDX, and a button to go to the nearest match of what is probably not in the scene."""
        self.histograms.content = histograms
        for button in self._nearest:
            button.remove()
        self._nearest = []
        for i, one in enumerate(verdict for verdict in found if verdict.nearest is not None):
            label = f"Go to nearest: {clipped(one.text, 20)}"
            place = self.histograms.order + (i + 1) / 100
            button = self._gui.add_button(label, color="gray", order=place)
            button.on_click(lambda _, one=one: self._act("nearest", one.nearest))
            self._nearest.append(button)

    def box(self, name: str, state: State) -> Box | None:
        """The box of a button: around the selection, or where the panel has it; None: none.

        Raises:
            ValueError: there is nothing to put it around.
        """
        if name == "None":
            return None
        if name != "Around":
            return Box(tuple(self.centre.value), tuple(self.size.value), keeps_inside=name == "Inside")
        chosen = state.space.means[state.selection].double()
        if len(chosen) == 0:
            raise InputError("Nothing is selected; there is nothing to put a box around.")
        low, high = chosen.amin(dim=0), chosen.amax(dim=0)
        centre, size = ((low + high) / 2).tolist(), (1.001 * (high - low) + 1e-9).tolist()
        return Box(tuple(centre), tuple(size))


def status(state: State, message: str, busy: str, drawable: int) -> str:
    """As MDX: what runs, a message, how much is selected, each prompt with its number or its problem, and the legend.

    Args:
        drawable: selected Gaussians that are drawn at all.
    """
    lines = [f"**{as_text(busy)}**"] * (busy != "") + [as_text(clipped(message, 400))] * (message != "")
    if state.question is None and not bool(state.selection.any()):
        return "\n\n".join(lines) or "Type what to look for, then press Ask or Enter."
    count = int(state.selection.sum())
    why = "" if drawable == count else f" ({drawable:,} of them are drawn: others are too faint, hidden or left out)"
    lines.append(f"**{count:,}** of {len(state.space):,} Gaussians selected{state.by_hand}{why}")
    if state.answer is not None:
        lines.append("\n".join(_rows(state, state.answer)))
    if state.remark:
        lines.append(as_text(f"{state.remark} Below R = {POOR:g} few views saw it, or they disagree."))
    return "\n\n".join([*lines, *filter(None, [legend(state)])])


def _rows(state: State, answer: Answer) -> list[str]:
    colours: Mapping[str, Any] = dict(zip(answer.texts, prompt_colours(answer.texts)))
    counts = dict(zip(answer.texts, answer.selected.sum(dim=0).tolist()))
    lines = ["| | prompt | found |", "|---|---|---|"]
    for prompt in state.prompts[:20]:
        name = as_text(clipped(prompt.text, 40))
        if prompt.text in counts and not prompt.problem:
            lines.append(f"| {swatch(colours[prompt.text])} | {name} | {counts[prompt.text]:,} |")
        else:
            lines.append(f"| ⚠ | {name} | {as_text(clipped(prompt.problem, 120))} |")
    if len(state.prompts) > 20:
        lines.append(f"| | and {len(state.prompts) - 20} more | |")
    return lines
