"""Search panel in the nerfstudio viewer: its widgets, their contents, and their effect on the history of states."""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable, Iterable, Sequence
from contextlib import AbstractContextManager, suppress
from dataclasses import replace
from functools import cache
from pathlib import Path
from threading import Lock, RLock, Thread
from typing import Any, cast

import numpy as np
import torch
from jaxtyping import Bool, Float
from nerfstudio.viewer.render_state_machine import RenderAction
from nerfstudio.viewer.viewer_elements import ViewerControl
from torch import Tensor
from viser import Icon, _gui_handles, _messages

from normlift_ns.analysis.explain import RecordedVotes
from normlift_ns.analysis.objects import find_floaters
from normlift_ns.core.field import SemanticField
from normlift_ns.core.gaussians import GaussianScene
from normlift_ns.core.relevancy import RELEVANCY_RULES
from normlift_ns.data.open_scene import open_scene
from normlift_ns.encoders.text_files import LazyTextEncoder
from normlift_ns.errors import InputError, describe_error
from normlift_ns.exports import MIN_OPACITY_LOGIT, write_splat_ply
from normlift_ns.io.atomic import safe_file_name
from normlift_ns.io.run_dir import cache_folder, text_cache_folder
from normlift_ns.query.engine import Answer
from normlift_ns.query.question import Query, load_query, save_query
from normlift_ns.query.text_encoder import default_rule, text_encoder_for
from normlift_ns.rendering.colors import COLORMAPS, Colormap, clip_text, prompt_colors
from normlift_ns.rendering.figures import Display, make_display, output_names
from normlift_ns.session import actions
from normlift_ns.session.actions import MAX_GROW_STEPS, MAX_THRESHOLD, MIN_THRESHOLD, carry_threshold
from normlift_ns.session.objects import ObjectRow, list_objects, unoccluded_viewpoint
from normlift_ns.session.prompts import (
    Prompt,
    build_query,
    click_name,
    encode_prompts,
    join_prompts,
    merge_queries,
    prompts_of_query,
    split_prompts,
)
from normlift_ns.session.selection import SelectionContext
from normlift_ns.session.state import History, RequestToken, RequestTokens, State
from normlift_ns.viewer.adapter import handle_in_order, ignore_closed_clients, send_in_order
from normlift_ns.viewer.widgets import (
    MAX_OBJECT_ROWS,
    OBJECT_ACTIONS,
    Explanation,
    ObjectRows,
    color_swatch,
    diagnostics_mdx,
    escape_mdx,
)

VISER_SCALE = 10.0
"""Units of the viser scene per scene unit: nerfstudio's VISER_NERFSTUDIO_SCALE_RATIO."""
CLICK_MODES = {"More like this": "like", "Select": "select", "Add": "add", "Drop": "take away"}
"""Effect of a click, by the caption of its button."""


class ClickListener:
    """Listener for clicks on the scene, in at most one browser of a viewer.

    Args:
        hit: called with the mode of the click, and with the origin and direction of its ray in scene units.
    """

    def __init__(self, hit: Callable[[str, Tensor, Tensor], None]) -> None:
        self._hit = hit
        self._armed: tuple[str, Any] | None = None
        self.directions: dict[str, np.ndarray] = {}
        """Directions of the clicked Gaussians, by the names of their prompts."""

    @property
    def armed(self) -> bool:
        """True if a browser waits for a click."""
        return self._armed is not None

    def arm(self, button: str, client: Any) -> None:
        """Wait for a click in one browser.

        Args:
            button: caption of the button, a key of `CLICK_MODES`.
        """
        self.disarm()
        client.scene.on_pointer_event("click")(self._clicked)
        self._armed = (CLICK_MODES[button], client)

    def disarm(self) -> None:
        """Stop waiting for a click."""
        armed, self._armed = self._armed, None
        if armed is not None and armed[1].scene._scene_pointer_cb is not None:
            with suppress(Exception):  # raised by viser if the browser has just disconnected
                armed[1].scene.remove_pointer_callback()

    def on_disconnect(self, client: Any) -> bool:
        """Handle a disconnected browser; return whether it waited for a click."""
        waited = self._armed is not None and self._armed[1].client_id == client.client_id
        if waited:
            self._armed = None
        return waited

    def add_direction(self, vector: np.ndarray, taken: Iterable[str]) -> str:
        """Keep the direction of a clicked Gaussian.

        Args:
            taken: prompt names that must not be used again, in addition to those of `known`.
        Returns:
            Name of the new prompt.
        """
        names = {*self.directions, *taken}
        name = next(name for n in range(1, len(names) + 2) if (name := click_name(n)) not in names)
        self.directions[name] = vector
        return name

    def _clicked(self, event: Any) -> None:
        armed = self._armed
        if armed is None or event.ray_origin is None:
            return
        self.disarm()
        self._hit(armed[0], torch.tensor(event.ray_origin) / VISER_SCALE, torch.tensor(event.ray_direction))


_MAX_TABLE_ROWS = 8


def visible_mask(opacities: Float[Tensor, "n 1"]) -> Bool[Tensor, " n"]:
    """Return the mask of Gaussians that are opaque enough to be drawn.

    Args:
        opacities: logits.
    """
    return opacities.detach()[:, 0] >= MIN_OPACITY_LOGIT


def status_mdx(state: State, message: str, busy: str, drawn: Bool[Tensor, " n"]) -> str:
    """Return the status: running work, message, size of the selection, reasons for differing counts, and warnings.

    Args:
        busy: description of the running work; empty: none.
        drawn: mask of Gaussians, as from `visible_mask`.
    """
    lines = [escape_mdx(text) for text in (busy, clip_text(message, 400)) if text]
    selection = state.selection
    count, hidden = int(selection.sum()), 0 if state.hidden is None else int(state.hidden.sum())
    if state.query is None and count == 0:
        lines.append("No query yet.")
    else:
        lines.append(f"**{count:,}** of {len(state.space):,} Gaussians selected{state.by_hand_suffix}")
    faint = int((selection & ~drawn.to(selection.device)).sum())
    counts = [(faint, "of them are never drawn or exported (opacity below 1/255).")]
    if state.answer is not None and state.prompts_select and state.shown is None:
        several = int((state.answer.selected.sum(dim=1) > 1).sum())
        counts.append((several, "of them are selected by several prompts."))
    counts.append((hidden, "Gaussians are hidden."))
    lines += [f"{count:,} {text}" for count, text in counts if count > 0]
    if state.warning:
        lines.append(escape_mdx(state.warning))
    return "\n\n".join(lines)


def prompt_table(state: State) -> str:
    """Return a table with the color, count and highest relevancy of each prompt, or with the prompt's error."""
    answer = state.answer
    if len(state.prompts) == 0 or answer is None:
        return ""
    counts, valid = answer.selected.sum(dim=0).tolist(), answer.valid
    peaks = answer.relevancy[valid].amax(dim=0).tolist() if bool(valid.any()) else [0.0] * len(counts)
    colors = prompt_colors(answer.texts).tolist()
    rows = {text: (counts[i], peaks[i], colors[i]) for i, text in enumerate(answer.texts)}
    lines = [
        f"{escape_mdx(answer.question.rule)} above {answer.question.threshold:g}",
        "",
        "| | prompt | selected | peak |",
        "|---|---|---|---|",
    ]
    failed = [prompt for prompt in state.prompts if prompt.error]  # listed first, to be noticed
    listed = [*failed, *(prompt for prompt in state.prompts if not prompt.error)][:_MAX_TABLE_ROWS]
    for prompt in listed:
        name = escape_mdx(clip_text(prompt.text, 40))
        if prompt.error or prompt.text not in rows:
            lines.append(f"| ⚠ | {name} | {escape_mdx(clip_text(prompt.error, 120))} | |")
            continue
        count, peak, color = rows[prompt.text]
        lines.append(f"| {color_swatch(color)} | {name} | {count:,} | {peak:.2f} |")
    if len(state.prompts) > len(listed):
        lines.append(f"| | and {len(state.prompts) - len(listed)} more | | |")
    return "\n".join(lines)


# Widgets of the panel: a separate tab in nerfstudio's viewer, in front of its other tabs.
#
# The widgets are viser's. nerfstudio's own elements appear in a folder far down, do not report which browser pressed
# them, and hold the render lock while their callbacks run.


ALL_PROMPTS = "all prompts"
TAB_LABEL = "Search"
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


class PanelWidgets:
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
        with add_first_tab(server.gui, TAB_LABEL, "SEARCH"):
            self.prompts = self._gui.add_text("Prompts", "", hint="Objects to search for, separated by commas.")
            self.ask = self._button("Ask", hint="Or press Enter in the Prompts field.")
            self.cancel = self._button("Cancel", hint="Stop the query or the pending click, as Escape does.")
            self.cancel.visible = False
            self.status = self._gui.add_markdown("")
            self.remove_weak = self._button("Leave out Gaussians with weak evidence")
            self.remove_weak.visible = False
            self._group("History", ("Undo", "Redo", "Clear"))
            self.threshold = self._slider(
                "Threshold", MIN_THRESHOLD, MAX_THRESHOLD, 0.005, 0.5, "Relevancy above which Gaussians are selected."
            )
            self.reliability = self._slider(
                "Minimum reliability", 0.0, 1.0, 0.01, 0.0, "Minimum reliability R of selected Gaussians."
            )
            self._button("Suggested", hint="Use the threshold suggested by the histogram (dashed line).")
            self._group("Selection", ("Hide", "Only", "All"))
            self._button("Select likely floaters", hint="Gaussians that lie on no surface. Check, then hide them.")
            self.prompt_table = self._gui.add_markdown("")
            self.histograms = self._gui.add_markdown("")
            self.rows = ObjectRows(self._gui, lambda action, row, event: act(action, row, event.client))
            with self._gui.add_folder("Why"):
                self.explain_button = self._button(
                    "Why?", hint="Show the training images that voted for the selection."
                )
                self.reasons = self._gui.add_markdown("")
            with self._gui.add_folder("Click in the scene"):
                self._button("More like this", hint="Ask for everything similar to the Gaussian you click.")
                self._group("Objects", ("Select", "Add", "Drop"))
                self.steps = self._slider(
                    "Grow", -MAX_GROW_STEPS, MAX_GROW_STEPS, 1, 0, "Grow or shrink the selection, from part to whole."
                )
            with self._gui.add_folder("Keep"):
                self._button("Download selection", hint="Download the selected Gaussians as a PLY file.")
                self._button("Save prompts in run", hint="Add them to the stored prompts; ns-render draws them.")
                self.replace = self._button("Replace the saved prompts")
                self.replace.visible = False
            with self._gui.add_folder("How it is asked and drawn", expand_by_default=False):
                self.shown = self._input(
                    "shown",
                    self._gui.add_dropdown("Prompt shown", (ALL_PROMPTS,), ALL_PROMPTS, hint="The prompt to show."),
                )
                self.colormap = self._input(
                    "colormap", self._gui.add_dropdown("Colors", COLORMAPS, COLORMAPS[0], hint="Relevancy colormap.")
                )
                hint = "Prompts to compare with, separated by commas."
                self.negatives = self._gui.add_text("Negatives", "", hint=hint)
                rules = ("auto", *RELEVANCY_RULES)
                self.rule = self._gui.add_dropdown("Relevancy", rules, "auto", hint="lerf and margin use negatives.")
                self.refined = self._input(
                    "refined", self._gui.add_checkbox("Refined", True, hint="Use refined features.")
                )
        self._gui._websock_interface.queue_message(_messages.RunJavascriptMessage(source=_SCRIPT))

    def reset_query_settings(self, negatives: str) -> None:
        """Reset the settings that apply to the next query.

        Args:
            negatives: default negative prompts.
        """
        self._reset("Minimum reliability", self.reliability, 0.0)
        self._reset("refined", self.refined, True)
        self.rule.value, self.negatives.value = "auto", negatives

    def show_state(self, state: State) -> None:
        """Show a state in every widget except the text boxes."""
        texts = () if state.answer is None else state.answer.texts
        options = (ALL_PROMPTS, *(f"{i + 1}: {clip_text(text, 30)}" for i, text in enumerate(texts)))
        if tuple(self.shown.options) != options:
            self._values["shown"] = ALL_PROMPTS
            self.shown.options = options
            self._values["shown"] = self.shown.value  # viser keeps the choice if it is a new option
        self._set("shown", self.shown, options[0 if state.shown is None else state.shown + 1])
        if state.query is not None:
            threshold = min(MAX_THRESHOLD, max(MIN_THRESHOLD, state.query.threshold))
            self._set("Threshold", self.threshold, threshold)
            self._set("Minimum reliability", self.reliability, state.query.min_reliability)
            self._set("refined", self.refined, state.query.refined)
        self._set("Grow", self.steps, state.grow_steps)
        self.remove_weak.visible = state.warning != ""

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


def add_first_tab(gui: Any, label: str, icon: str) -> Any:
    """Add a tab in front of the viewer's tabs. Widgets created in its context are placed in it.

    viser adds new tabs at the end, and the viewer does not expose its tab group.
    """
    handles = gui._container_handle_from_id.values()
    tabs = [handle for handle in handles if isinstance(handle, _gui_handles.GuiTabHandle)]
    group = tabs[0]._parent if len(tabs) > 0 else gui.add_tab_group()
    tab = group.add_tab(label, getattr(Icon, icon))
    rows: list[list[Any]] = [group._labels, group._icons_html, group._tabs]
    for row in rows:
        row.insert(0, row.pop())
    group._sync_with_client()
    return tab


_DELAY = 0.1
"""Seconds without a change before the details are computed."""


def explanation_of_run(folder: Path | None, field: SemanticField | None = None) -> Explanation:
    """Return the explanations of a lifted run.

    The run is opened a second time at the first explanation, with its images.

    Args:
        folder: folder of the semantic field; None: the run is not stored yet.
    """

    @cache
    def votes() -> RecordedVotes:
        if folder is None or field is None:
            raise InputError("The run is not stored yet, so the images behind the selection are unknown.")
        scene = open_scene(folder.parent / "config.yml")
        return RecordedVotes(scene, field.to("cpu"), cache_folder(folder.parent))

    return Explanation(votes)


def move_camera(client: Any, target: ObjectRow, scene: GaussianScene, drawn: Bool[Tensor, " n"]) -> None:
    """Move the camera of one browser to face an object, from the current side unless something blocks the view."""
    camera = client.camera
    view = (np.asarray(camera.position) / VISER_SCALE, camera.up_direction, float(camera.fov))
    position = unoccluded_viewpoint(target, scene, drawn, *view)
    with client.atomic():
        camera.position = np.array(position) * VISER_SCALE
        camera.look_at = np.array(target.center) * VISER_SCALE


# Controller of the panel in nerfstudio's viewer: applies the actions of the widgets to a history of states.
#
# All browsers share one panel, as they share nerfstudio's own. States are immutable, and so is the `Display` of a
# state that the model gets. Other threads can therefore render images without waiting for this one.


NO_FIELD_MESSAGE = "No semantics yet. They are lifted at the end of training."


def rerender_clients(viewer: Any) -> None:
    """Render the image again in every browser that shows nerfstudio's viewer.

    nerfstudio 1.1.5's own `Viewer._trigger_rerender` stops at the first browser that connects or disconnects at this
    moment, and leaves outdated images in the browsers after it.
    """
    if not viewer.ready:
        return
    for number, client in viewer.viser_server.get_clients().items():
        with suppress(KeyError):  # connecting, and about to render anyway, or disconnecting
            machine = viewer.render_statemachines[number]
            machine.action(RenderAction("move", viewer.get_camera_state(client)))
            machine.state = "low_move"  # its thread renders again soon even if it has just overwritten the action


class _Control(ViewerControl):
    """Element through which nerfstudio passes its viewer to the panel."""

    def __init__(self, panel: SearchPanel) -> None:
        self._panel = [panel]  # in a list: nerfstudio searches attributes for widgets

    def _setup(self, viewer: Any) -> None:
        super()._setup(viewer)
        self._panel[0].install(viewer)


_READING = "Reading the prompts. The first query also loads the text encoder, which takes a while."


def _show_prompt(state: State, option: str) -> State:
    """Let only the prompt of an option of the dropdown select."""
    return actions.show_prompt(state, None if option == ALL_PROMPTS else int(option.split(":", maxsplit=1)[0]) - 1)


def _use_refined(state: State, refined: bool) -> State:
    question = None if state.query is None else replace(state.query, refined=refined)
    return actions.update_query(state, question, "Refined features")


_ACTIONS: dict[str, Callable[..., State]] = {
    "Hide": actions.hide,
    "Only": actions.show_only,
    "All": actions.show_all,
    "Suggested": actions.use_suggested_threshold,
    "Leave out Gaussians with weak evidence": actions.remove_weak,
    "Threshold": actions.set_threshold,
    "Minimum reliability": actions.set_min_reliability,
    "Grow": actions.resize,
    "shown": _show_prompt,
    "refined": _use_refined,
}
"""Actions on a state by the name of their widget; those of sliders and choices take its value."""
_SLIDERS = ("Threshold", "Minimum reliability", "Grow")


class SearchPanel(torch.nn.Module):
    """The panel with its queries, clicks and history. A module, because nerfstudio searches only modules for a
    `ViewerControl`.

    Args:
        host: the `NormLiftModel`, whose module imports this one.
    """

    def __init__(self, host: Any) -> None:
        super().__init__()
        self._host = [host]  # in a list: the model is the parent of this module
        self._viewer: Any = None
        self._widgets: PanelWidgets | None = None
        self._history: History[State] | None = None
        self._folder: Path | None = None
        self._line, self._message, self._negatives = "", "", ""
        self._colormap: Colormap = COLORMAPS[0]
        self._overlay_due = False
        self._turns, self._detail_turns = RequestTokens(), RequestTokens()
        self._lock, self._encoder_lock = RLock(), Lock()
        self._encoder: list[LazyTextEncoder] = []
        """The text encoder as the only item once a prompt has loaded it; empty before."""
        self._clicks = ClickListener(self._on_click)
        self._reasons = explanation_of_run(None)
        self.control = _Control(self)

    @property
    def state(self) -> State | None:
        """The state shown now; None without a field."""
        return None if self._history is None else self._history.now

    @property
    def answer(self) -> Answer | None:
        """The answer to the query of the state; None without one."""
        return None if self.state is None else self.state.answer

    @property
    def has_viewer(self) -> bool:
        """True if a viewer shows the panel."""
        return self._widgets is not None

    def open(
        self, field: SemanticField, means: Tensor, folder: Path | None = None, question: Query | None = None
    ) -> None:
        """Enable the panel for a field, and show the answer to a query.

        Args:
            folder: folder of the field; None: prompts cannot be saved.
        """
        with self._lock:
            self._folder, state = folder, State(SelectionContext(field, means))
            if question is None:
                self._set_default_negatives(field)
            else:
                state = actions.ask(state, prompts_of_query(question), question)
                self._negatives = join_prompts(question.negatives)
                self._set_prompts(join_prompts(question.texts))
            self._clicks.directions, self._message = {}, ""
            self._reasons = explanation_of_run(folder, field)
            if self._widgets is not None:
                self._widgets.negatives.value = self._negatives
            self._show(History.of(state, lean=State.without_caches))

    def close(self) -> None:
        """Drop the field, because the Gaussians are about to change."""
        with self._lock:
            self._cancel()
            self._detail_turns.cancel()
            self._history = None
            self._update_widgets()

    def on_action(self, name: str, value: Any = None, client: Any = None) -> None:
        """Carry out the action of a widget; the panel shows any error.

        Args:
            name: name of the widget or caption of the button.
            client: the browser in which it was pressed.
        """
        try:
            if self.state is None:
                raise InputError(NO_FIELD_MESSAGE)
            if name == "Ask":
                self._ask()
            elif name == "Select likely floaters":
                self._run("Looking for floaters.", self._select_floaters)
            elif name == "Why?":
                self._explain()
            else:
                with self._lock:
                    self._act_quickly(name, value, client)
        except Exception as error:  # no error may stop the viewer
            self.show_message(describe_error(error)[0])

    def _act_quickly(self, name: str, value: Any, client: Any) -> None:
        """Carry out an action that takes no noticeable time."""
        history = cast("History[State]", self._history)
        state, self._message = history.now, ""
        if name in _ACTIONS:
            state = _ACTIONS[name](state) if value is None else _ACTIONS[name](state, value)
            self._show(history.do(state, key=name if name in _SLIDERS else None))
        elif name in ("Undo", "Redo"):
            history = history.undo() if name == "Undo" else history.redo()
            self._set_prompts(join_prompts([prompt.text for prompt in history.now.prompts]))
            self._show(history)
        elif name == "Clear":
            self._clear(history)
        elif name == "colormap":
            self._colormap = value
            self._show(history)
        elif name in CLICK_MODES:
            self._clicks.arm(name, client)
            self.show_message("Click on the scene, or press Cancel or Escape to stop.")
        elif name == "Cancel":
            self._cancel()
            self._update_widgets()
        elif name in OBJECT_ACTIONS:
            self._act_on_object(name, value, client)
        elif name == "Download selection":
            self._download(state.selection, state.name, client)
        elif name in ("Save prompts in run", "Replace the saved prompts"):
            self._save(state, replaces=name.startswith("Replace"))

    def _clear(self, history: History[State]) -> None:
        """Remove the query and the selection, show everything, and reset the settings of queries."""
        self._cancel()
        self._set_prompts("")
        self._set_default_negatives(history.now.space.field)
        if self._widgets is not None:
            self._widgets.reset_query_settings(self._negatives)
        self._show(history.do(replace(actions.show_all(actions.clear(history.now)), action="Clear")))

    def _set_default_negatives(self, field: SemanticField) -> None:
        with suppress(ValueError, OSError):  # a missing file of text embeddings is reported when it is needed
            self._negatives = join_prompts(default_rule(field).negatives)

    def _cancel(self) -> None:
        """Discard running work, and stop waiting for a click."""
        self._turns.cancel()
        self._clicks.disarm()
        self._reasons.clear()

    def _act_on_object(self, action: str, row: ObjectRow, client: Any) -> None:
        if action == "go to":
            move_camera(client, row, self._host[0].scene(), cast(State, self.state).drawn)
        elif action == "export":
            self._download(row.mask, row.name, client)
        else:
            history = cast("History[State]", self._history)
            self._show(history.do((actions.show_only if action == "only" else actions.hide)(history.now, row.mask)))

    def _download(self, mask: Tensor, stem: str, client: Any) -> None:
        """Send Gaussians as a PLY file to a browser."""
        if not bool(mask.any()):
            raise InputError("Nothing is selected; there is nothing to download.")
        splat, state = self._host[0].splat_parameters(), cast(State, self.state)
        if not bool((mask & visible_mask(splat.parameters["opacities"])).any()):
            raise InputError("All selected Gaussians are invisible (opacity below 1/255): nothing to download.")
        name = f"{safe_file_name(stem)}.ply"
        with tempfile.TemporaryDirectory() as folder:
            rows = write_splat_ply(Path(folder) / name, splat, state.space.field, state.answer, keep=mask)
            client.send_file_download(name, (Path(folder) / name).read_bytes())
        self.show_message(f"Sent {name} with {len(rows):,} Gaussians to the browser's downloads.")

    def _ask(self) -> None:
        """Ask the prompts in the text boxes."""
        if self._widgets is not None:
            self._line, self._negatives = self._widgets.prompts.value, self._widgets.negatives.value
        self._run(_READING, self._answer)

    def _run(self, description: str, task: Callable[[RequestToken], None]) -> None:
        """Run a slow task without holding a lock; the panel shows its description until it ends."""
        token = self._turns.start(description)
        self._clicks.disarm()
        self.show_message("")
        message = ""
        try:
            task(token)
        except Exception as error:  # the libraries of an encoder may raise anything; no error may stop the viewer
            message = describe_error(error)[0]
        if self._turns.finish(token):
            self.show_message(message)

    def _answer(self, token: RequestToken) -> None:
        result = self._encode_query(cast(State, self.state).space.field)
        with self._lock:
            if result is not None and self._turns.finish(token) and self._history is not None:
                state, (prompts, question) = self._history.now, result
                self._message = ""
                self._show(
                    self._history.do(actions.ask(state, prompts, carry_threshold(state, question))), answered=True
                )

    def _encode_query(self, field: SemanticField) -> tuple[tuple[Prompt, ...], Query] | None:
        """Encode the prompts and build their query; None if the request is stale.

        Raises:
            ValueError, OSError: as `encode_prompts` and `session.prompts.build_query`.
        """
        line, negatives, widgets, vectors = self._line, self._negatives, self._widgets, dict(self._clicks.directions)
        with suppress(ValueError, OSError):  # a damaged file is reported when it is shown or replaced
            vectors |= {prompt.text: prompt.vector for prompt in prompts_of_query(self._stored_query())}
        options: dict[str, Any] = {}
        if widgets is not None:
            choices = {"relevancy": widgets.rule, "min_reliability": widgets.reliability, "refined": widgets.refined}
            options = {name: widget.value for name, widget in choices.items()}

        def encode(texts: Sequence[str]) -> Any:
            if len(self._encoder) == 0:
                cache = None if self._folder is None else text_cache_folder(self._folder.parent)
                self._encoder.append(text_encoder_for(field, str(field.source.device), cache))
            return self._encoder[0].rows(texts)

        with self._encoder_lock:  # so that two threads do not both load the encoder
            if self._turns.busy == "":
                return None
            prompts = encode_prompts(line, encode, vectors)
            return build_query(field, prompts, encode, negatives=split_prompts(negatives), **options)

    def _stored_query(self) -> Query | None:
        """Return the query stored in the run; None if it stores none."""
        return None if self._folder is None else load_query(self._folder)

    def _select_floaters(self, token: RequestToken) -> None:
        floaters = find_floaters(self._host[0].scene(), cast(State, self.state).space.field.scalars).mask
        with self._lock:
            if self._history is not None and self._turns.is_current(token):
                state = actions.select_floaters(self._history.now, floaters)
                self._turns.finish(token)
                self._message = actions.FLOATERS_HINT
                self._show(self._history.do(state), answered=True)

    def _explain(self) -> None:
        """Show the training images behind the selection; the search for them holds no lock."""
        state, reasons = cast(State, self.state), self._reasons
        token = reasons.start(state)
        self.show_message("")
        try:
            reasons.compute(token, state)
        finally:
            with self._lock:
                self._update_widgets()

    def on_disconnect(self, client: Any) -> None:
        """Stop waiting for the click of a disconnected browser."""
        if self._clicks.on_disconnect(client):
            self.show_message("")

    def _on_click(self, mode: str, origin: Tensor, direction: Tensor) -> None:
        """Handle a click: ask for everything similar, or select, add or remove the object under it."""
        try:
            device = cast(State, self.state).space.means.device
            with self._viewer.train_lock:  # a render in another thread may change which Gaussians are drawn
                weights = self._host[0].ray_weights(origin.to(device), direction.to(device))
            with self._lock:
                history = cast("History[State]", self._history)
                if mode != "like":
                    self._message = ""
                    self._show(history.do(actions.click(history.now, weights, cast(Any, mode))), answered=True)
                    return
                saved = self._stored_query()
                vector = actions.picked_direction(history.now, weights)
                self._set_prompts(self._clicks.add_direction(vector, () if saved is None else saved.texts))
            self._ask()
        except Exception as error:  # as in `act`
            self.show_message(describe_error(error)[0])

    def _save(self, state: State, *, replaces: bool) -> None:
        """Store the prompts of a state in the run, in addition to those stored there or instead of them."""
        try:
            if state.query is None or self._folder is None:
                raise InputError("No query yet; there is nothing to save.")
            question = merge_queries(None if replaces else load_query(self._folder), state.query)
            save_query(self._folder, question)
        except InputError:
            self._offer_to_replace(state.query is not None)
            raise
        self._offer_to_replace(False)
        prompts = "one prompt" if len(question.texts) == 1 else f"{len(question.texts)} prompts"
        self.show_message(f"Saved. The run now stores {prompts} for ns-render to draw.")

    def _offer_to_replace(self, visible: bool) -> None:
        if self._widgets is not None:
            self._widgets.replace.visible = visible

    def install(self, viewer: Any) -> None:
        """Add the tab to a viewer."""

        def disconnected(client: Any) -> None:
            # in another thread: viser calls this under its own lock, for which the holder of the panel's may be waiting
            Thread(target=self.on_disconnect, args=(client,), daemon=True).start()

        self._viewer = viewer
        handle_in_order(viewer.viser_server)
        send_in_order(viewer.viser_server)
        self._follow_outputs(viewer.control_panel)
        self._widgets = PanelWidgets(viewer.viser_server, self.on_action, self._lock)
        viewer.viser_server.on_client_disconnect(disconnected)
        ignore_closed_clients(viewer.viser_server)
        self._widgets.prompts.value, self._widgets.negatives.value = self._line, self._negatives
        if self.state is not None:
            self._update_details(self.state)
        self._update_widgets()

    def show_message(self, message: str) -> None:
        """Show a message above the size of the selection."""
        with self._lock:
            self._message = message
            self._update_widgets()

    def _show(self, history: History[State], *, answered: bool = False) -> None:
        """Show the current state of a history. The display is complete before the model gets it.

        Args:
            answered: whether the selection is new, so that the overlay replaces an rgb output.
        """
        state = history.now
        drawn = None if state.hidden is None else state.drawn
        display = make_display(
            state.space.field,
            state.answer,
            shown=state.shown,
            colormap=self._colormap,
            selection=state.selection,
            drawn=drawn,
            by_hand=not state.prompts_select,
        )
        self._history = history
        self._reasons.update(state)
        if self._viewer is not None:
            self._select_output(display, answered=answered)
            self._update_details(state)
        self._host[0].show(display)
        self._update_widgets()
        if self._viewer is not None:
            rerender_clients(self._viewer)

    def _select_output(self, display: Display, *, answered: bool) -> None:
        """Switch to the overlay if the current output no longer exists, or if it is rgb and there is a new answer."""
        output = self._viewer.control_panel._output_render
        if output.value.startswith("relevancy_") and output.value not in output_names(display.texts):
            output.value = "overlay"
        self._overlay_due = answered or (self._overlay_due and len(display.texts) > 0)
        self._show_overlay()

    def _show_overlay(self) -> None:
        """Switch from rgb to the overlay if it is due and the viewer knows it."""
        output = self._viewer.control_panel._output_render
        if self._overlay_due and "overlay" in output.options:
            self._overlay_due = False
            if output.value == "rgb":
                output.value = "overlay"

    def _follow_outputs(self, control_panel: Any) -> None:
        """Show an overlay that is due as soon as the viewer knows it, which is after its first image."""
        update = control_panel.update_output_options

        def updated(names: list[str]) -> None:
            update(names)
            self._show_overlay()

        control_panel.update_output_options = updated

    def _set_prompts(self, line: str) -> None:
        """Replace the text in the prompt box, which otherwise only the user edits."""
        self._line = line
        if self._widgets is not None:
            self._widgets.prompts.value = line

    def _update_widgets(self) -> None:
        """Show the state in the widgets."""
        widgets, state = self._widgets, self.state
        if widgets is None:
            return
        widgets.ask.disabled = self._turns.busy != "" or state is None
        busy = self._turns.busy or self._reasons.busy
        widgets.cancel.visible = busy != "" or self._clicks.armed
        widgets.explain_button.disabled = self._reasons.busy != ""
        if widgets.reasons.content != self._reasons.content:
            widgets.reasons.content = self._reasons.content
        if state is None:
            widgets.status.content, widgets.prompt_table.content, widgets.histograms.content = NO_FIELD_MESSAGE, "", ""
            return
        widgets.show_state(state)
        visible = visible_mask(self._host[0].splat_parameters().parameters["opacities"])
        widgets.status.content = status_mdx(state, self._message, busy, visible)
        widgets.prompt_table.content = prompt_table(state)

    def _update_details(self, state: State) -> None:
        """Show the objects and histograms of the state that is shown now, after a moment without changes."""
        token = self._detail_turns.start("Looking for objects.")
        Thread(target=self._compute_details, args=(token, state), daemon=True).start()

    def _compute_details(self, token: RequestToken, state: State) -> None:
        time.sleep(_DELAY)
        if not self._detail_turns.is_current(token):
            return
        try:
            objects, histograms = list_objects(state, max_objects=MAX_OBJECT_ROWS), diagnostics_mdx(state)
            with self._lock:
                if self._widgets is not None and self._detail_turns.finish(token):
                    self._widgets.rows.show(objects)
                    self._widgets.histograms.content = histograms
        except Exception as error:  # no error may stop the viewer
            if self._detail_turns.finish(token):
                self.show_message(describe_error(error)[0])
