"""Search panel in nerfstudio's viewer, with its widgets and their actions."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager, suppress
from dataclasses import replace
from functools import cache
from pathlib import Path
from threading import Thread
from typing import Any

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
from normlift_ns.exports import MIN_OPACITY_LOGIT
from normlift_ns.io.run_dir import cache_folder, text_cache_folder
from normlift_ns.query.engine import Answer
from normlift_ns.query.question import Query, join_prompts, load_query, split_prompts
from normlift_ns.query.text_encoder import default_rule, text_encoder_for
from normlift_ns.rendering.colors import COLORMAPS, Colormap, clip_text
from normlift_ns.rendering.figures import Display, make_display, output_names
from normlift_ns.session import actions
from normlift_ns.session.actions import MAX_GROW_STEPS, MAX_THRESHOLD, MIN_THRESHOLD
from normlift_ns.session.objects import ObjectRow, list_objects, unoccluded_viewpoint
from normlift_ns.session.outputs import splat_bytes, store_query
from normlift_ns.session.prompts import prompts_of_query
from normlift_ns.session.selection import SelectionContext
from normlift_ns.session.state import History, RequestToken, RequestTokens, State
from normlift_ns.viewer.adapter import KEYS_SCRIPT, handle_in_order, ignore_closed_clients, send_in_order
from normlift_ns.viewer.controller import NO_FIELD_MESSAGE, Controller, Session
from normlift_ns.viewer.widgets import (
    ALL_PROMPTS,
    MAX_OBJECT_ROWS,
    Act,
    Action,
    ActionWidgets,
    Explanation,
    ObjectRows,
    diagnostics_mdx,
    escape_mdx,
    prompt_rows,
)

VISER_SCALE = 10.0
"""Number of units of the viser scene per scene unit; VISER_NERFSTUDIO_SCALE_RATIO in nerfstudio."""


class ClickListener:
    """Listener for a click on the scene in one browser.

    Args:
        hit: Callback with the action of the click, and the origin and direction of its ray in scene units.
    """

    def __init__(self, hit: Callable[[Action, Tensor, Tensor], None]) -> None:
        self._hit = hit
        self._armed: tuple[Action, Any] | None = None

    @property
    def armed(self) -> bool:
        """True while a click is expected."""
        return self._armed is not None

    def arm(self, action: Action, client: Any) -> None:
        """Expect a click in one browser, and stop expecting one in any other browser."""
        self.disarm()
        client.scene.on_pointer_event("click")(self._clicked)
        self._armed = (action, client)

    def disarm(self) -> None:
        """Stop expecting a click."""
        armed, self._armed = self._armed, None
        if armed is not None and armed[1].scene._scene_pointer_cb is not None:
            with suppress(Exception):  # viser raises if the browser has just disconnected
                armed[1].scene.remove_pointer_callback()

    def on_disconnect(self, client: Any) -> bool:
        """Stop expecting a click in a disconnected browser, and return True if one was expected there."""
        waited = self._armed is not None and self._armed[1].client_id == client.client_id
        if waited:
            self._armed = None
        return waited

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
        opacities: Opacities as logits.
    """
    return opacities.detach()[:, 0] >= MIN_OPACITY_LOGIT


def status_mdx(state: State, message: str, busy: str, drawn: Bool[Tensor, " n"]) -> str:
    """Return the status as MDX, with the running work, message, size of the selection, remarks on it, and warnings.

    Args:
        busy: Description of the running work, or an empty string.
        drawn: Mask of Gaussians from `visible_mask`.
    """
    lines = [escape_mdx(text) for text in (busy, clip_text(message, 400)) if text]
    selection = state.selection
    count, hidden = int(selection.sum()), 0 if state.hidden is None else int(state.hidden.sum())
    if state.query is None and count == 0:
        lines.append("No query.")
    else:
        lines.append(f"**{count:,}** of {len(state.space):,} Gaussians selected{state.by_hand_suffix}")
    faint = int((selection & ~drawn.to(selection.device)).sum())
    counts = [(faint, "of the selected Gaussians cannot be drawn or exported (opacity below 1/255).")]
    if state.answer is not None and state.prompts_select and state.shown is None:
        several = int(((state.answer.selected.sum(dim=1) > 1) & selection).sum())
        counts.append((several, f"of the selected Gaussians match{'es' * (several == 1)} several prompts."))
    counts.append((hidden, "Gaussian is hidden." if hidden == 1 else "Gaussians are hidden."))
    lines += [f"{count:,} {text}" for count, text in counts if count > 0]
    if state.warning:
        lines.append(escape_mdx(state.warning))
    return "\n\n".join(lines)


def prompt_table(state: State) -> str:
    """Return a Markdown table with the color, selection size and highest relevancy, or the error, of each prompt."""
    answer = state.answer
    if len(state.prompts) == 0:
        return ""
    if answer is None:  # no prompt is understood
        return "\n".join(prompt_rows(state.prompts, ("selected", "peak"), {}, max_rows=_MAX_TABLE_ROWS))
    counts, valid = answer.selected.sum(dim=0).tolist(), answer.valid
    peaks = answer.relevancy[valid].amax(dim=0).tolist() if bool(valid.any()) else [0.0] * len(counts)
    numbers = {text: (f"{counts[i]:,}", f"{peaks[i]:.2f}") for i, text in enumerate(answer.texts)}
    failed_first = sorted(state.prompts, key=lambda prompt: not prompt.error)  # so that users notice errors
    rows = prompt_rows(failed_first, ("selected", "peak"), numbers, max_rows=_MAX_TABLE_ROWS)
    return "\n".join([f"{escape_mdx(answer.question.rule)} above {answer.question.threshold:g}", "", *rows])


# Widgets of the panel, which is the first tab in nerfstudio's viewer.
#
# They are viser widgets. nerfstudio's own elements are at the bottom of another tab, do not report the browser that
# used them, and hold the render lock during their callbacks.


TAB_LABEL = "Search"


class PanelWidgets(ActionWidgets):
    """Tab with the widgets of the panel, shared by all browsers."""

    def __init__(self, gui: Any, act: Act, lock: AbstractContextManager[Any]) -> None:
        super().__init__(gui, act, lock)
        with add_first_tab(gui, TAB_LABEL, "SEARCH"):
            self.prompts = gui.add_text("Prompts", "", hint="Objects to search for, separated by commas.")
            self.ask = self._button(Action.ASK, hint="Search for the prompts (or press Enter in the text field).")
            self.cancel = self._button(Action.CANCEL, hint="Cancel the query or the pending click (or press Escape).")
            self.cancel.visible = False
            self.status = gui.add_markdown("")
            self.remove_weak = self._button(Action.REMOVE_WEAK)
            self.remove_weak.visible = False
            self._group("History", (Action.UNDO, Action.REDO, Action.CLEAR))
            numbers = (MIN_THRESHOLD, MAX_THRESHOLD, 0.005, 0.5)
            self.threshold = self._slider(Action.THRESHOLD, numbers, "Relevancy above which Gaussians are selected.")
            self.reliability = self._slider(
                Action.RELIABILITY, (0.0, 1.0, 0.01, 0.0), "Smallest reliability R of selected Gaussians."
            )
            self._button(Action.SUGGESTED, hint="Use the threshold suggested by the histogram (dashed line).")
            self._group("Selection", (Action.HIDE, Action.SHOW_ONLY, Action.SHOW_ALL))
            self._button(Action.SELECT_FLOATERS, hint="Select likely floaters. Check them before you hide them.")
            self.prompt_table = gui.add_markdown("")
            self.histograms = gui.add_markdown("")
            self.rows = ObjectRows(gui, act)
            with gui.add_folder("Why"):
                hint = "Show the training images with the largest votes for the selection."
                self.explain_button = self._button(Action.EXPLAIN, hint=hint)
                self.reasons = gui.add_markdown("")
            with gui.add_folder("Click in the scene"):
                self._button(Action.LIKE, hint="Search for everything similar to the Gaussian that you click.")
                self._group("Objects", (Action.SELECT, Action.ADD, Action.REMOVE))
                numbers = (-MAX_GROW_STEPS, MAX_GROW_STEPS, 1, 0)
                self.steps = self._slider(Action.GROW, numbers, "Grow (> 0) or shrink (< 0) the selection.")
            with gui.add_folder("Keep"):
                self._button(Action.DOWNLOAD, hint="Download the selected Gaussians as a PLY file.")
                self._button(Action.SAVE, hint="Add the prompts to those stored in the run. ns-render draws them.")
                self.replace = self._button(Action.REPLACE)
                self.replace.visible = False
            with gui.add_folder("Advanced", expand_by_default=False):
                choice = gui.add_dropdown(
                    "Prompt shown", (ALL_PROMPTS,), ALL_PROMPTS, hint="Prompt that selects Gaussians."
                )
                self.shown = self._input(Action.SHOW_PROMPT, choice)
                colors = gui.add_dropdown("Colors", COLORMAPS, COLORMAPS[0], hint="Colormap of the relevancy.")
                self._input(Action.COLORS, colors)
                hint = "Negative prompts to compare with, separated by commas."
                self.negatives = gui.add_text("Negatives", "", hint=hint)
                rules = ("auto", *RELEVANCY_RULES)
                self.rule = gui.add_dropdown("Relevancy", rules, "auto", hint="Only lerf and margin use negatives.")
                refined = gui.add_checkbox("Refined", True, hint="Use directions after the refinement.")
                self.refined = self._input(Action.REFINED, refined)
        gui._websock_interface.queue_message(_messages.RunJavascriptMessage(source=KEYS_SCRIPT))

    def reset_query_settings(self, negatives: str) -> None:
        """Reset the settings that apply to the next query.

        Args:
            negatives: Default negative prompts.
        """
        self.reset_reliability()
        self._reset(Action.REFINED, self.refined, True)
        self.rule.value, self.negatives.value = "auto", negatives

    def show_state(self, state: State) -> None:
        """Show a state as in the base class, and in the checkbox for refined features."""
        super().show_state(state)
        if state.query is not None:
            self._set(Action.REFINED, self.refined, state.query.refined)


def add_first_tab(gui: Any, label: str, icon: str) -> Any:
    """Add a tab in front of the viewer's tabs, and return it as a context for widgets.

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
"""Seconds without a change of the state before objects and histograms are computed."""


def explanation_of_run(folder: Path | None, field: SemanticField | None = None) -> Explanation:
    """Return an `Explanation` that uses the images of a lifted run.

    The first call of `Explanation.compute` opens the run again, with its images.

    Args:
        folder: Folder of the semantic field, or None if the run is not stored yet.
        field: Semantic field of the run, or None if the run is not stored yet.
    """

    @cache
    def votes() -> RecordedVotes:
        if folder is None or field is None:
            raise InputError("The run is not stored yet, so its images are unknown. Press Why? again after training.")
        scene = open_scene(folder.parent / "config.yml")
        return RecordedVotes(scene, field.to("cpu"), cache_folder(folder.parent))

    return Explanation(votes)


def move_camera(client: Any, target: ObjectRow, scene: GaussianScene, drawn: Bool[Tensor, " n"]) -> None:
    """Move the camera of one browser to face an object, from the current side if nothing blocks the view there."""
    camera = client.camera
    view = (np.asarray(camera.position) / VISER_SCALE, camera.up_direction, float(camera.fov))
    position = unoccluded_viewpoint(target, scene, drawn, *view)
    with client.atomic():
        camera.position = np.array(position) * VISER_SCALE
        camera.look_at = np.array(target.center) * VISER_SCALE


# All browsers share one panel, as they share nerfstudio's own panel. A state and its `Display` are immutable, so other
# threads can render without waiting for the panel.


def rerender_clients(viewer: Any) -> None:
    """Render the image again in every browser of nerfstudio's viewer.

    `Viewer._trigger_rerender` of nerfstudio 1.1.5 stops at the first browser that is connecting or disconnecting.
    The other browsers would keep outdated images.
    """
    if not viewer.ready:
        return
    for number, client in viewer.viser_server.get_clients().items():
        with suppress(KeyError):  # the browser is disconnecting, or connecting and renders anyway
            machine = viewer.render_statemachines[number]
            machine.action(RenderAction("move", viewer.get_camera_state(client)))
            machine.state = "low_move"  # the render thread renders again even if it has just overwritten the action


class _Control(ViewerControl):
    """Control through which nerfstudio passes its viewer to the panel."""

    def __init__(self, panel: SearchPanel) -> None:
        self._panel = panel

    def _setup(self, viewer: Any) -> None:
        super()._setup(viewer)
        self._panel.install(viewer)


class SearchPanel(Controller):
    """Search panel in nerfstudio's viewer.

    Args:
        host: The `NormLiftModel`, untyped because its module imports this module.
    """

    reading_message = "Reading the prompts. The first query also loads the text encoder, which takes a while."
    _widgets: PanelWidgets | None

    def __init__(self, host: Any) -> None:
        super().__init__(Session(), explanation_of_run(None))
        self._host = host
        self._viewer: Any = None
        self._folder: Path | None = None
        self._negatives = self._default_negatives = ""
        self._colormap: Colormap = COLORMAPS[0]
        self._overlay_due = False
        self._detail_turns = RequestTokens()
        self._encoder: list[LazyTextEncoder] = []
        """List with the text encoder as its only item; an empty list before the first prompt."""
        self._clicks = ClickListener(self._on_click)
        self._handlers[Action.COLORS] = lambda colormap, _: self._set_colormap(colormap)
        self._handlers[Action.REPLACE] = lambda *_: self._save(replaces=True)
        self.control = _Control(self)

    @property
    def answer(self) -> Answer | None:
        """Answer to the query of the current state, or None without a query."""
        return None if self.state is None else self.state.answer

    @property
    def has_viewer(self) -> bool:
        """True if a viewer shows the panel."""
        return self._widgets is not None

    def open(
        self, field: SemanticField, means: Tensor, folder: Path | None = None, question: Query | None = None
    ) -> None:
        """Enable the panel for a field, and show the answer to a query if one is given.

        Args:
            folder: Folder of the field, or None if prompts cannot be saved.
        """
        with self._lock:
            self._folder, state = folder, State(SelectionContext(field, means))
            self._set_default_negatives(field)
            if question is not None:
                state = actions.ask(state, prompts_of_query(question), question)
                self._negatives = join_prompts(question.negatives)
                self._set_prompts(join_prompts(question.texts))
            self._session.clicks = {}
            self._reasons = explanation_of_run(folder, field)
            if self._widgets is not None:
                self._widgets.negatives.value = self._negatives
            self._show(History.of(state, lean=State.without_caches))

    def close(self) -> None:
        """Disable the panel. Call this method before the Gaussians change."""
        with self._lock:
            self._discard()
            self._detail_turns.cancel()
            self._session.history = None
            self._update_widgets()

    def _set_colormap(self, colormap: Colormap) -> None:
        self._colormap = colormap
        self._show(self.history)

    def _go_to(self, history: History[State]) -> None:
        self._set_prompts(join_prompts([prompt.text for prompt in history.now.prompts]))
        super()._go_to(history)

    def _clear(self) -> None:
        """Clear the query and the selection, show all Gaussians, and reset the query settings."""
        self._discard()
        self._set_prompts("")
        self._set_default_negatives(self.history.now.space.field)
        if self._widgets is not None:
            self._widgets.reset_query_settings(self._negatives)
        self._do(replace(actions.show_all(actions.clear(self.history.now)), action="Clear"))

    def _set_default_negatives(self, field: SemanticField) -> None:
        with suppress(ValueError, OSError):  # errors of text embedding files are reported at the next query
            self._negatives = self._default_negatives = join_prompts(default_rule(field).negatives)

    def _discard(self) -> None:
        super()._discard()
        self._clicks.disarm()

    def _move_camera(self, target: ObjectRow, client: Any) -> None:
        move_camera(client, target, self._host.scene(), self.history.now.drawn)

    def _download(self, mask: Bool[Tensor, " n"], name: str, client: Any) -> None:
        if not bool(mask.any()):
            raise InputError("Nothing is selected. Select Gaussians before you download them.")
        file_name, content, count = splat_bytes(self._host.splat_parameters(), self.history.now, mask, name)
        client.send_file_download(file_name, content)
        self.show_message(f"Sent {file_name} to the browser. Gaussians: {count:,}.")

    def _ask(self) -> None:
        if self._widgets is not None:
            self._negatives = self._widgets.negatives.value
        super()._ask()

    def _run(self, description: str, task: Callable[[RequestToken], None]) -> None:
        self._clicks.disarm()
        super()._run(description, task)

    def _start(self, job: Callable[[], None], kind: Action) -> None:
        job()

    def _known_vectors(self) -> dict[str, Any]:
        vectors = dict(self._session.clicks)
        with suppress(ValueError, OSError):  # errors of damaged files are reported when prompts are saved
            vectors |= {prompt.text: prompt.vector for prompt in prompts_of_query(self._stored_query())}
        return vectors

    def _query_settings(self) -> dict[str, Any]:
        usual = self._negatives == self._default_negatives
        settings: dict[str, Any] = {"negatives": None if usual else split_prompts(self._negatives)}
        if (widgets := self._widgets) is not None:
            chosen = {"relevancy": widgets.rule, "min_reliability": widgets.reliability, "refined": widgets.refined}
            settings |= {name: widget.value for name, widget in chosen.items()}
        return settings

    def _encode(self, texts: Sequence[str]) -> Any:
        if len(self._encoder) == 0:
            field = self.history.now.space.field
            cache = None if self._folder is None else text_cache_folder(self._folder.parent)
            self._encoder.append(text_encoder_for(field, str(field.source.device), cache))
        return self._encoder[0].rows(texts)

    def _stored_query(self) -> Query | None:
        """Return the query that is stored in the run, or None if there is none."""
        return None if self._folder is None else load_query(self._folder)

    def _find_floaters(self) -> Bool[Tensor, " n"]:
        return find_floaters(self._host.scene(), self.history.now.space.field.scalars).mask

    def on_disconnect(self, client: Any) -> None:
        """Stop expecting a click in a disconnected browser."""
        if self._clicks.on_disconnect(client):
            self.show_message("")

    def _wait_for_click(self, action: Action, value: Any, client: Any) -> None:
        self._clicks.arm(action, client)
        self.show_message("Click on the scene, or press Cancel or Escape to stop.")

    def _on_click(self, action: Action, origin: Tensor, direction: Tensor) -> None:
        """Search for Gaussians similar to the clicked one, or select, add or remove the clicked object."""

        def click() -> None:
            device = self.history.now.space.means.device
            with self._viewer.train_lock:  # a render in another thread may change the set of drawn Gaussians
                weights = self._host.ray_weights(origin.to(device), direction.to(device))
            if action is Action.LIKE:
                stored = self._stored_query()
                vector = actions.picked_direction(self.history.now, weights)
                self._ask_click(vector, () if stored is None else stored.texts)
                return
            with self._lock:
                self._click(action, weights)

        self._guard(click)

    def _save(self, *, replaces: bool = False) -> None:
        """Store the prompts in the run, either in addition to the stored ones or instead of them."""
        query = self.history.now.query
        try:
            prompts = store_query(self._folder, query, replaces=replaces)
        except InputError:
            self._offer_to_replace(query is not None and self._folder is not None)
            raise
        self._offer_to_replace(False)
        self.show_message(f"Saved. The run now stores {prompts} for ns-render to draw.")

    def _offer_to_replace(self, visible: bool) -> None:
        if self._widgets is not None:
            self._widgets.replace.visible = visible

    def install(self, viewer: Any) -> None:
        """Add the panel to a viewer as its first tab."""

        def disconnected(client: Any) -> None:
            # in another thread to avoid a deadlock, because viser holds its lock during this call
            Thread(target=self.on_disconnect, args=(client,), daemon=True).start()

        self._viewer = viewer
        handle_in_order(viewer.viser_server)
        send_in_order(viewer.viser_server)
        self._follow_outputs(viewer.control_panel)
        self._widgets = PanelWidgets(viewer.viser_server.gui, self.act, self._lock)
        viewer.viser_server.on_client_disconnect(disconnected)
        ignore_closed_clients(viewer.viser_server)
        self._widgets.prompts.value, self._widgets.negatives.value = self._session.line, self._negatives
        if self.state is not None:
            self._update_details(self.state)
        self._update_widgets()

    def _show(self, history: History[State], message: str = "", *, answered: bool = False) -> None:
        """Show the current state of a history. A new answer switches the viewer from rgb to the overlay."""
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
        self._session.history, self._message = history, message
        self._reasons.update(state)
        if self._viewer is not None:
            self._select_output(display, answered=answered)
            self._update_details(state)
        self._host.show(display)
        self._update_widgets()
        if self._viewer is not None:
            rerender_clients(self._viewer)

    def _select_output(self, display: Display, *, answered: bool) -> None:
        """Switch to the overlay if the current output no longer exists, or if it is rgb and the answer is new."""
        output = self._viewer.control_panel._output_render
        if output.value.startswith("relevancy_") and output.value not in output_names(display.texts):
            output.value = "overlay"
        self._overlay_due = answered or (self._overlay_due and len(display.texts) > 0)
        self._show_overlay()

    def _show_overlay(self) -> None:
        """Switch from rgb to the overlay if the switch is pending and the viewer lists the overlay."""
        output = self._viewer.control_panel._output_render
        if self._overlay_due and "overlay" in output.options:
            self._overlay_due = False
            if output.value == "rgb":
                output.value = "overlay"

    def _follow_outputs(self, control_panel: Any) -> None:
        """Apply a pending switch to the overlay as soon as the viewer lists the overlay, after its first render."""
        update = control_panel.update_output_options

        def updated(names: list[str]) -> None:
            update(names)
            self._show_overlay()

        control_panel.update_output_options = updated

    def _update_widgets(self) -> None:
        """Show the current state in the widgets."""
        widgets, state = self._widgets, self.state
        if widgets is None:
            return
        widgets.show_busy(self._reasons, can_ask=self._turns.busy == "" and state is not None)
        busy = self._turns.busy or self._reasons.busy
        widgets.cancel.visible = busy != "" or self._clicks.armed
        if state is None:
            widgets.status.content, widgets.prompt_table.content, widgets.histograms.content = NO_FIELD_MESSAGE, "", ""
            return
        widgets.show_state(state)
        visible = visible_mask(self._host.splat_parameters().parameters["opacities"])
        widgets.status.content = status_mdx(state, self._message, busy, visible)
        widgets.prompt_table.content = prompt_table(state)

    def _update_details(self, state: State) -> None:
        """Compute and show the objects and histograms of the current state, after a short time without changes."""
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
        except Exception as error:  # errors must not stop the viewer
            if self._detail_turns.finish(token):
                self.show_message(describe_error(error)[0])
