"""User actions, the widgets that send them, and the content of panels as MDX."""

from __future__ import annotations

import base64
import io
from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager
from enum import Enum
from threading import Lock
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, UInt8
from PIL import Image
from torch import Tensor

from normlift_ns.analysis.explain import RecordedVotes, ViewVote
from normlift_ns.errors import InputError, escape_unprintable
from normlift_ns.query.threshold import Histogram
from normlift_ns.rendering.colors import clip_text, prompt_rgb_tuples
from normlift_ns.session.actions import MAX_THRESHOLD, MIN_THRESHOLD, diagnose_prompts
from normlift_ns.session.objects import ObjectList, ObjectRow
from normlift_ns.session.prompts import Prompt
from normlift_ns.session.state import RequestToken, RequestTokens, State
from normlift_ns.viewer.adapter import add_button_group


class Action(Enum):
    """Action of a user in a viewer. The value is the caption of the action's button or slider, if it has one."""

    ASK = "Ask"
    CANCEL = "Cancel"
    UNDO = "Undo"
    REDO = "Redo"
    CLEAR = "Clear"
    THRESHOLD = "Threshold"
    SUGGESTED = "Use suggested"
    RELIABILITY = "Minimum reliability"
    REFINED = "refined"
    SHOW_PROMPT = "shown"
    HIDE = "Hide"
    SHOW_ONLY = "Isolate"
    SHOW_ALL = "Show all"
    GROW = "Grow"
    REMOVE_WEAK = "Leave out Gaussians with weak evidence"
    SELECT_FLOATERS = "Select likely floaters"
    LIKE = "More like this"
    SELECT = "Select"
    ADD = "Add"
    REMOVE = "Remove"
    EXPLAIN = "Why?"
    GO_TO = "Go to"
    DOWNLOAD = "Download selection"
    SAVE = "Save prompts in run"
    REPLACE = "Replace the saved prompts"
    COLORS = "colors"


Act = Callable[[Action, Any, Any], None]
"""Function of an action, the value of the action, and the browser that sent the action."""
SLIDERS = (Action.THRESHOLD, Action.RELIABILITY, Action.GROW)
"""Actions of sliders. Successive actions of one slider are merged into one step of the history."""
ALL_PROMPTS = "all prompts"


class ActionWidgets:
    """Base class for widgets that send actions; a subclass creates the widgets that this class declares.

    Args:
        gui: viser's `GuiApi`.
        act: Function to call with the actions of the user.
        lock: Lock to hold while `act` handles a change, so that no other thread can revert the change.
    """

    prompts: Any
    ask: Any
    shown: Any
    threshold: Any
    reliability: Any
    steps: Any
    remove_weak: Any
    explain_button: Any
    reasons: Any

    def __init__(self, gui: Any, act: Act, lock: AbstractContextManager[Any]) -> None:
        self._gui, self._act, self._lock = gui, act, lock
        self._values: dict[Action, Any] = {}

    def show_state(self, state: State) -> None:
        """Show a state in the sliders and the prompt dropdown, and show `remove_weak` if there is a warning."""
        texts = () if state.answer is None else state.answer.texts
        options = (ALL_PROMPTS, *(f"{i + 1}: {clip_text(text, 30)}" for i, text in enumerate(texts)))
        if tuple(self.shown.options) != options:
            self._values[Action.SHOW_PROMPT] = ALL_PROMPTS
            self.shown.options = options
            self._values[Action.SHOW_PROMPT] = self.shown.value  # viser keeps the choice if it is among the options
        self._set(Action.SHOW_PROMPT, self.shown, options[0 if state.shown is None else state.shown + 1])
        if state.query is not None:
            threshold = min(MAX_THRESHOLD, max(MIN_THRESHOLD, state.query.threshold))
            self._set(Action.THRESHOLD, self.threshold, threshold)
            self._set(Action.RELIABILITY, self.reliability, state.query.min_reliability)
        self._set(Action.GROW, self.steps, state.grow_steps)
        self.remove_weak.visible = state.warning != ""

    def show_busy(self, explanation: Explanation, *, can_ask: bool) -> None:
        """Show an explanation, and disable the buttons of requests that are not possible at the moment."""
        self.ask.disabled = not can_ask
        self.explain_button.disabled = explanation.busy != ""
        if self.reasons.content != explanation.content:
            self.reasons.content = explanation.content

    def reset_reliability(self) -> None:
        """Reset the minimum reliability of the next query to 0."""
        self._reset(Action.RELIABILITY, self.reliability, 0.0)

    def _button(self, action: Action, label: str = "", *, hint: str | None = None, color: Any = None) -> Any:
        button = self._gui.add_button(label or action.value, hint=hint, color=color)
        button.on_click(lambda event: self._act(action, None, event.client))
        return button

    def _group(self, label: str, buttons: Sequence[Action], captions: Sequence[str] = ()) -> None:
        by_caption = dict(zip(captions or [action.value for action in buttons], buttons))
        pressed = lambda caption, event: self._act(by_caption[caption], None, event.client)  # noqa: E731
        add_button_group(self._gui, label, tuple(by_caption), pressed)

    def _slider(self, action: Action, numbers: tuple[float, float, float, float], hint: str, label: str = "") -> Any:
        """Add a slider; `numbers` are its minimum, maximum, step and initial value."""
        return self._input(action, self._gui.add_slider(label or action.value, *numbers, hint=hint))

    def _input(self, action: Action, widget: Any) -> Any:
        """Pass the user's changes of a widget to `act`, and return the widget."""
        self._values[action] = widget.value

        def changed(event: Any) -> None:
            with self._lock:
                if widget.value != self._values[action]:
                    self._values[action] = widget.value
                    self._act(action, widget.value, event.client)

        widget.on_update(changed)
        return widget

    def _set(self, action: Action, widget: Any, value: Any) -> None:
        """Set a widget without calling `act`, unless it has a change by a user that `act` has not received yet."""
        if widget.value == self._values[action]:
            self._reset(action, widget, value)

    def _reset(self, action: Action, widget: Any, value: Any) -> None:
        """Set a widget without calling `act`, even if a user has just changed it."""
        if widget.value != value:
            self._values[action] = value
            widget.value = value


def escape_mdx(text: str) -> str:
    """Escape a text so that MDX shows it literally.

    Unprintable characters become escape sequences. Then all characters except letters, digits and spaces become
    character references.

    >>> escape_mdx("a {b}")
    'a &#123;b&#125;'
    """
    return "".join(c if c.isalnum() or c == " " else f"&#{ord(c)};" for c in escape_unprintable(text, keep="\n"))


def color_swatch(color: Sequence[float]) -> str:
    """Return a colored square as MDX.

    Args:
        color: RGB in 0..1.
    """
    red, green, blue = (round(255 * x) for x in color)
    return f'<span style={{{{color: "rgb({red},{green},{blue})"}}}}>■</span>'


MAX_OBJECT_ROWS = 8
_OBJECT_BUTTONS = {
    "Go to": Action.GO_TO,
    "Isolate": Action.SHOW_ONLY,
    "Hide": Action.HIDE,
    "Export": Action.DOWNLOAD,
}


class ObjectRows:
    """List of found objects in a panel; the constructor adds it to the open container.

    Args:
        gui: viser's `GuiApi`.
        act: Function to call with an action and the row of its object as the value.
    """

    def __init__(self, gui: Any, act: Act) -> None:
        self._objects: tuple[ObjectRow, ...] = ()
        with gui.add_folder("Found objects"):
            self._summary = gui.add_markdown("No visible objects selected")
            # Created once, because viser never frees the memory of widgets in a panel that all pages share.
            self._rows = [self._row(gui, i, act) for i in range(MAX_OBJECT_ROWS)]

    def show(self, object_list: ObjectList) -> None:
        """Replace the listed objects; at most `MAX_OBJECT_ROWS` are shown."""
        self._objects, small = tuple(object_list.objects), object_list.in_smaller_parts
        unlisted = [f"Objects that are not listed: {object_list.left_out:,}"] * (object_list.left_out > 0)
        unlisted += [f"Gaussians in components too small to be objects: {small:,}"] * (small > 0)
        empty = "" if len(self._objects) > 0 else "No visible objects selected"
        self._summary.content = escape_mdx("; ".join(unlisted) or empty)
        for i, (text, buttons) in enumerate(self._rows):
            if i < len(self._objects):
                row = self._objects[i]
                details = escape_mdx(f"object {row.number}: {row.size:,} Gaussians, {row.evidence}")
                text.content = f"{color_swatch(row.color)} **{escape_mdx(clip_text(row.text, 40))}** {details}"
            text.visible = buttons.visible = i < len(self._objects)

    def _row(self, gui: Any, i: int, act: Act) -> tuple[Any, Any]:
        def pressed(caption: str, event: Any) -> None:
            if i < len(self._objects):
                act(_OBJECT_BUTTONS[caption], self._objects[i], event.client)

        text = gui.add_markdown("")
        buttons = add_button_group(gui, "", tuple(_OBJECT_BUTTONS), pressed)
        text.visible = buttons.visible = False
        return text, buttons


def prompt_rows(
    prompts: Sequence[Prompt], headings: Sequence[str], numbers: Mapping[str, Sequence[str]], *, max_rows: int
) -> list[str]:
    """Return the lines of a Markdown table with the color and the numbers, or the error, of each prompt.

    Args:
        headings: Headings of the columns of numbers.
        numbers: Formatted numbers by prompt text, in the order of the query.
        max_rows: Maximum number of prompts in the table.
    """
    colors = dict(zip(numbers, prompt_rgb_tuples(tuple(numbers))))
    rows = [("", "prompt", *headings), ("---",) * (2 + len(headings))]
    for prompt in prompts[:max_rows]:
        name = escape_mdx(clip_text(prompt.text, 40))
        if prompt.error or prompt.text not in numbers:
            rows.append(("⚠", name, escape_mdx(clip_text(prompt.error, 120)), *[""] * (len(headings) - 1)))
        else:
            rows.append((color_swatch(colors[prompt.text]), name, *numbers[prompt.text]))
    if len(prompts) > max_rows:
        rows.append(("", f"and {len(prompts) - max_rows} more", *[""] * len(headings)))
    return [f"| {' | '.join(row)} |" for row in rows]


# Histograms and images as MDX.


_WIDTH, _HEIGHT, _TOP, _BOTTOM = 280, 70, 14, 14
"""Width and height of a histogram in pixels, and margins above and below its bars."""
_BACKGROUND, _INK, _BAR = "#141414", "#ffffff", "#8c8c8c"
_MAX_SIDE, _QUALITY = 480, 80
"""Maximum longer side of an image in pixels, and its JPEG quality."""


def histogram_svg(histogram: Histogram, color: Sequence[float]) -> str:
    """Draw the histogram of one prompt as SVG.

    The heights of the bars are logarithmic. A solid line marks the threshold, and a dashed line marks the suggested
    threshold.

    Args:
        color: Color of the bars above the threshold, RGB in 0..1.

    >>> values = np.array([0.1] * 60 + [0.9] * 10)
    >>> from normlift_ns.query.threshold import relevancy_histogram
    >>> counts = relevancy_histogram(values, np.ones(70, bool), 0.5, (0.4, 0.8))
    >>> histogram_svg(counts, (1, 0, 0)).count("#ff0000")
    1
    """
    low, high = float(histogram.edges[0]), float(histogram.edges[-1])
    step, height_of_bars = _WIDTH / len(histogram.counts), _HEIGHT - _TOP - _BOTTOM
    heights = np.log1p(histogram.counts) / np.log1p(max(1, histogram.counts.max())) * height_of_bars
    selected = "#" + "".join(f"{round(255 * x):02x}" for x in color)
    parts = [f'<rect width="{_WIDTH}" height="{_HEIGHT}" rx="4" fill="{_BACKGROUND}"/>']
    for i, height in enumerate(heights):
        if height > 0:
            middle = (histogram.edges[i] + histogram.edges[i + 1]) / 2
            fill = selected if middle > histogram.threshold else _BAR
            position = f'x="{i * step + 0.5:.1f}" y="{_TOP + height_of_bars - height:.1f}"'
            parts.append(f'<rect {position} width="{step - 1:.1f}" height="{height:.1f}" fill="{fill}"/>')
    for value, dash in ((histogram.suggested, "3 3"), (histogram.threshold, "")):
        x = (value - low) / (high - low) * _WIDTH
        if 0 <= x <= _WIDTH:
            x, dashed = min(max(x, 1), _WIDTH - 1), f' stroke-dasharray="{dash}"' if dash else ""
            parts.append(f'<path d="M{x:.1f} {_TOP}V{_HEIGHT - _BOTTOM}" stroke="{_INK}" stroke-width="1.5"{dashed}/>')
    x = min(max((histogram.threshold - low) / (high - low) * _WIDTH, 30), _WIDTH - 30)
    parts.append(_text(x, _TOP - 3, "middle", f"> {histogram.threshold:.2f}"))
    parts.append(_text(4, _HEIGHT - 3, "start", f"{round(low, 2) + 0.0:.2f}"))
    parts.append(_text(_WIDTH - 4, _HEIGHT - 3, "end", f"{high:.2f}"))
    box = f'width="{_WIDTH}" height="{_HEIGHT}" viewBox="0 0 {_WIDTH} {_HEIGHT}"'
    return f'<svg xmlns="http://www.w3.org/2000/svg" {box}>{"".join(parts)}</svg>'


def _text(x: float, y: float, anchor: str, text: str) -> str:
    font = f'font-family="sans-serif" font-size="10" text-anchor="{anchor}"'
    return f'<text x="{x:.1f}" y="{y}" {font} fill="{_INK}">{text.replace(">", "&gt;")}</text>'


def diagnostics_mdx(state: State) -> str:
    """Return the histograms and warnings of `diagnose_prompts` as MDX; empty if there are none."""
    diagnostics, lines = diagnose_prompts(state), []
    for one in diagnostics:
        lines += [f"{color_swatch(one.color)} {escape_mdx(clip_text(one.text, 40))}"] * (len(diagnostics) > 1)
        lines.append(_image("image/svg+xml", histogram_svg(one.histogram, one.color).encode()))
        lines += [escape_mdx(clip_text(one.warning, 400))] * (one.warning != "")
    count = 0 if state.answer is None or state.shown is not None else len(state.answer.texts)
    if 0 < len(diagnostics) < count:
        more = count - len(diagnostics)
        shown = "prompt is not shown. Choose it" if more == 1 else "prompts are not shown. Choose one"
        lines.append(f"{more} more {shown} to see its histogram.")
    return "\n\n".join(lines)


def image_mdx(image: UInt8[Tensor, "h w 3"]) -> str:
    """Return an image as MDX, scaled down for a panel."""
    thumbnail, buffer = Image.fromarray(image.cpu().numpy()), io.BytesIO()
    thumbnail.thumbnail((_MAX_SIDE, _MAX_SIDE))
    thumbnail.save(buffer, "JPEG", quality=_QUALITY)
    return _image("image/jpeg", buffer.getvalue())


def _image(media_type: str, content: bytes) -> str:
    data = base64.b64encode(content).decode()
    return f'<img src="data:{media_type};base64,{data}" style={{{{width: "100%", borderRadius: "4px"}}}} />'


# Explanation of a selection for a panel: training images that voted for it, and images that disagree most.


_BUSY = "Finding supporting images …"
_explain_lock = Lock()
"""Lock for reading and caching votes, so that only one thread at a time does so."""


def explanation_mdx(votes: RecordedVotes, selected: Bool[Tensor, " n"], *, refined: bool = True) -> str:
    """Return the agreement of the images as text, and the images with outlines of the regions that voted, as MDX.

    If an image cannot be shown, for instance because features were passed from Python, the text gives the reason.

    Raises:
        ValueError: Nothing is selected, or the votes are not in the cache.
        FileNotFoundError: An image that is needed to count the votes is missing.
    """
    why = votes.explain(selected.cpu(), refined=refined)
    heaviest, different = why.images_to_show()
    images, problem = {}, ""
    try:
        for picture in votes.pictures(dict.fromkeys((*heaviest, *different))):
            images[picture.vote.view] = image_mdx(picture.image)
    except (InputError, OSError) as error:
        problem = f"Not all images can be shown: {error}"
    lines = [escape_mdx(why.sentence), *filter(None, [escape_mdx(clip_text(problem, 400))])]
    for title, view_votes in (("Strongest support:", heaviest), ("Images that disagree:", different)):
        if len(view_votes) > 0:
            lines += [f"**{title}**", *_list_votes(view_votes, votes.names, images)]
    return "\n\n".join(lines)


def _list_votes(votes: Sequence[ViewVote], names: Sequence[str], images: dict[int, str]) -> list[str]:
    """Return lines with the numbers of each vote, and with the image of its view unless an earlier line has it."""
    lines = []
    for vote in votes:
        regions = "1 region" if len(vote.regions) == 1 else f"{len(vote.regions)} regions"
        pixels = f"{vote.weight:,.0f} pixel{'s' * (round(vote.weight) != 1)}"
        numbers = f"{vote.share:.0%} of the weight ({pixels}, {regions}), cosine {vote.agreement:.2f}"
        if vote.disagreement >= 0.005:
            numbers += f", {vote.disagreement:.0%} of the disagreement"
        lines.append(f"{escape_mdx(clip_text(names[vote.view], 60))}: {escape_mdx(numbers)}")
        lines += filter(None, [images.pop(vote.view, "")])
    return lines


class Explanation:
    """Explanation of the current selection of one user.

    Args:
        votes: Function that returns the votes of the run. Each explanation calls it, so it should cache its result.
    """

    def __init__(self, votes: Callable[[], RecordedVotes]) -> None:
        self._votes, self._turns = votes, RequestTokens()
        self._selection: Bool[Tensor, " n"] | None = None
        self.content = ""
        """Explanation as MDX; empty if there is none."""

    @property
    def busy(self) -> str:
        """Description of the running work; empty if no work is running."""
        return self._turns.busy

    def start(self, state: State) -> RequestToken:
        """Return a token for `compute`, and drop the previous explanation."""
        self._selection, self.content = state.selection, ""
        return self._turns.start(_BUSY)

    def compute(self, token: RequestToken, state: State) -> None:
        """Compute the explanation of a selection. This can take seconds, so call it without a lock, from any thread.

        Raises:
            ValueError, FileNotFoundError: The errors of `explanation_mdx`, unless the request is stale.
        """
        content = ""
        try:
            with _explain_lock:
                if self._turns.is_current(token):
                    content = explanation_mdx(self._votes(), state.selection, refined=state.refined)
        except Exception:
            if self._turns.finish(token):
                raise
        if self._turns.finish(token):
            self.content = content

    def update(self, state: State) -> None:
        """Drop the explanation if the selection of a state differs from the explained selection."""
        if self._selection is not None and not torch.equal(self._selection, state.selection):
            self.clear()

    def clear(self) -> None:
        """Drop the explanation and any running computation."""
        self._turns.cancel()
        self._selection, self.content = None, ""
