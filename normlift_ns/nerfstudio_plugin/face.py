"""View of the panel: shows a state in the widgets and in the image of nerfstudio's viewer."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from threading import RLock, Thread
from typing import Any

import torch
from nerfstudio.viewer.render_state_machine import RenderAction
from nerfstudio.viewer.viewer_elements import ViewerControl

from normlift_ns.asking import Answer
from normlift_ns.colors import COLORMAPS, Colormap
from normlift_ns.crash import explain
from normlift_ns.nerfstudio_plugin.insights import Rest
from normlift_ns.nerfstudio_plugin.keeping import Host
from normlift_ns.nerfstudio_plugin.said import drawable, found_table, said
from normlift_ns.nerfstudio_plugin.widgets import Widgets
from normlift_ns.session.found import Found
from normlift_ns.session.history import History
from normlift_ns.session.state import State
from normlift_ns.session.turns import Turns
from normlift_ns.viewer.adapter import pass_over_the_gone
from normlift_ns.viewer.display import Display, make_display, output_names
from normlift_ns.viewer.reasons import Reasons

WAITING = "No semantics yet. They are lifted at the end of training."


def redraw(viewer: Any) -> None:
    """Render the image again in every browser that shows nerfstudio's viewer.

    nerfstudio 1.1.5's own `Viewer._trigger_rerender` stops at the first browser that connects or disconnects at this
    moment, and leaves outdated images in the browsers after it.
    """
    if not viewer.ready:
        return
    for number, client in viewer.viser_server.get_clients().items():
        with suppress(KeyError):  # connecting, and about to render anyway, or disconnecting
            viewer.render_statemachines[number].action(RenderAction("move", viewer.get_camera_state(client)))


class _Control(ViewerControl):
    """Element through which nerfstudio passes its viewer to the panel."""

    def __init__(self, panel: Face) -> None:
        self._panel = [panel]  # in a list: nerfstudio searches attributes for widgets

    def _setup(self, viewer: Any) -> None:
        super()._setup(viewer)
        self._panel[0].install(viewer)


class Face(torch.nn.Module):
    """Widgets and display of the panel. A module, because nerfstudio searches only modules for a `ViewerControl`.

    Args:
        armed: returns whether a browser waits for a click.
    """

    def __init__(self, host: Host, armed: Callable[[], bool]) -> None:
        super().__init__()
        self._host = [host]  # in a list: the model is the parent of this module
        self._armed = armed
        self._viewer: Any = None
        self._widgets: Widgets | None = None
        self._history: History[State] | None = None
        self._line, self._message, self._negatives = "", "", ""
        self._colormap: Colormap = COLORMAPS[0]
        self._turns, self._lock = Turns(), RLock()
        self._reasons: Reasons | None = None
        self._details = Rest(self._show_details, lambda error: self.tell(explain(error)[0]))
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
    def viewed(self) -> bool:
        """Whether a viewer shows the panel."""
        return self._widgets is not None

    def act(self, name: str, value: Any = None, client: Any = None) -> None:
        """Carry out the action of a widget.

        Args:
            name: name of the widget or caption of the button.
            client: the browser in which it was pressed.
        """
        raise NotImplementedError

    def forget(self, client: Any) -> None:
        """Handle a disconnected browser."""
        raise NotImplementedError

    def install(self, viewer: Any) -> None:
        """Add the tab to a viewer."""
        self._viewer = viewer
        self._widgets = Widgets(viewer.viser_server, self.act, self._lock)
        viewer.viser_server.on_client_disconnect(self._on_disconnect)
        pass_over_the_gone(viewer.viser_server)
        self._widgets.prompts.value, self._widgets.negatives.value = self._line, self._negatives
        if self.state is not None:
            self._details.follow(self.state)
        self._update_widgets()

    def _on_disconnect(self, client: Any) -> None:
        """Handle a disconnect in another thread.

        viser calls this under its own lock, for which a thread that holds the panel's lock may be waiting.
        """
        Thread(target=self.forget, args=(client,), daemon=True).start()

    def tell(self, message: str) -> None:
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
            chosen=state.selection,
            drawn=drawn,
            by_hand=not state.from_answer,
        )
        self._history = history
        if self._reasons is not None:
            self._reasons.follow(state)
        if self._viewer is not None:
            self._select_output(display, answered=answered)
            self._details.follow(state)
        self._host[0].show(display)
        self._update_widgets()
        if self._viewer is not None:
            redraw(self._viewer)

    def _select_output(self, display: Display, *, answered: bool) -> None:
        """Switch to the overlay if the current output no longer exists, or if it is rgb and there is a new answer."""
        output = self._viewer.control_panel._output_render
        outdated = output.value.startswith("relevancy_") and output.value not in output_names(display.texts)
        if "overlay" in output.options and (outdated or (answered and output.value == "rgb")):
            output.value = "overlay"

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
        explaining = "" if self._reasons is None else self._reasons.busy
        widgets.ask.disabled = self._turns.busy != "" or state is None
        busy = self._turns.busy or explaining
        widgets.cancel.visible = busy != "" or self._armed()
        widgets.explain("" if self._reasons is None else self._reasons.content, busy=explaining != "")
        if state is None:
            widgets.status.content, widgets.found.content, widgets.histograms.content = WAITING, "", ""
            return
        widgets.follow(state)
        visible = drawable(self._host[0].splats()[0]["opacities"])
        widgets.status.content = said(state, self._message, busy, visible)
        widgets.found.content = found_table(state)

    def _show_details(self, is_current: Callable[[], bool], objects: Found, histograms: str) -> None:
        with self._lock:
            if self._widgets is not None and is_current():
                self._widgets.rows.show(objects)
                self._widgets.histograms.content = histograms
