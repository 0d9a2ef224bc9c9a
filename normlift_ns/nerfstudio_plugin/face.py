"""The face of the panel: which state it shows, in the widgets and in the picture of nerfstudio's viewer."""

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

WAITING = "No semantics yet. They are lifted at the end of the training."


def redraw(viewer: Any) -> None:
    """Has every browser before nerfstudio's viewer draw its picture again.

    nerfstudio 1.1.5's own `Viewer._trigger_rerender` ends at the first browser that comes or goes at this moment, and
    leaves the pictures of those after it as they were.
    """
    if not viewer.ready:
        return
    for number, client in viewer.viser_server.get_clients().items():
        with suppress(KeyError):  # it is coming, and will draw anyway, or going
            viewer.render_statemachines[number].action(RenderAction("move", viewer.get_camera_state(client)))


class _Control(ViewerControl):
    """By which nerfstudio tells the panel that there is a viewer."""

    def __init__(self, face: Face) -> None:
        self._face = [face]  # in a list: nerfstudio looks for widgets in whatever it can walk to

    def _setup(self, viewer: Any) -> None:
        super()._setup(viewer)
        self._face[0].install(viewer)


class Face(torch.nn.Module):
    """What is shown. A module, because nerfstudio looks for a `ViewerControl` in modules only.

    Args:
        armed: whether a browser waits for a click.
    """

    def __init__(self, host: Host, armed: Callable[[], bool]) -> None:
        super().__init__()
        self._host = [host]  # in a list: a module that holds its parent
        self._armed = armed
        self._viewer: Any = None
        self._widgets: Widgets | None = None
        self._history: History[State] | None = None
        self._line, self._message, self._negatives = "", "", ""
        self._colormap: Colormap = COLORMAPS[0]
        self._turns, self._lock = Turns(), RLock()
        self._reasons: Reasons | None = None
        self._rest = Rest(self._list, lambda error: self.tell(explain(error)[0]))
        self.control = _Control(self)

    @property
    def state(self) -> State | None:
        """What is shown now; None: there is no field."""
        return None if self._history is None else self._history.now

    @property
    def answer(self) -> Answer | None:
        """To the question of the state."""
        return None if self.state is None else self.state.answer

    @property
    def viewed(self) -> bool:
        """Whether a viewer shows the panel."""
        return self._widgets is not None

    def act(self, name: str, value: Any = None, client: Any = None) -> None:
        """What a widget does.

        Args:
            client: the browser in which it was pressed.
        """
        raise NotImplementedError

    def forget(self, client: Any) -> None:
        """A browser is gone."""
        raise NotImplementedError

    def install(self, viewer: Any) -> None:
        """Makes the tab in a viewer."""
        self._viewer = viewer
        self._widgets = Widgets(viewer.viser_server, self.act, self._lock)
        viewer.viser_server.on_client_disconnect(self._gone)
        pass_over_the_gone(viewer.viser_server)
        self._widgets.prompts.value, self._widgets.negatives.value = self._line, self._negatives
        if self.state is not None:
            self._rest.follow(self.state)
        self._follow()

    def _gone(self, client: Any) -> None:
        """viser tells it under a lock of its own, which a thread that holds ours may wait for."""
        Thread(target=self.forget, args=(client,), daemon=True).start()

    def tell(self, message: str) -> None:
        """Shows a message, and below it what is selected."""
        with self._lock:
            self._message = message
            self._follow()

    def _show(self, history: History[State], *, answered: bool = False) -> None:
        """Shows a state of a history. The display is complete before the model gets it."""
        now = history.now
        drawn = None if now.hidden is None else now.drawn
        display = make_display(
            now.space.field,
            now.answer,
            shown=now.shown,
            colormap=self._colormap,
            chosen=now.selection,
            drawn=drawn,
            by_hand=not now.from_answer,
        )
        self._history = history
        if self._reasons is not None:
            self._reasons.follow(now)
        if self._viewer is not None:
            self._keep_output(display, answered=answered)
            self._rest.follow(now)
        self._host[0].show(display)
        self._follow()
        if self._viewer is not None:
            redraw(self._viewer)

    def _keep_output(self, display: Display, *, answered: bool) -> None:
        """Where rgb, or an output that there will not be any more, is shown, the overlay takes its place."""
        output = self._viewer.control_panel._output_render
        gone = output.value.startswith("relevancy_") and output.value not in output_names(display.texts)
        if "overlay" in output.options and (gone or (answered and output.value == "rgb")):
            output.value = "overlay"

    def _write(self, line: str) -> None:
        """Puts another line into the box of prompts; otherwise it belongs to the person who types."""
        self._line = line
        if self._widgets is not None:
            self._widgets.prompts.value = line

    def _follow(self) -> None:
        """Shows the state in the widgets."""
        widgets, state = self._widgets, self.state
        if widgets is None:
            return
        why = "" if self._reasons is None else self._reasons.busy
        widgets.ask.disabled = self._turns.busy != "" or state is None
        busy = self._turns.busy or why
        widgets.cancel.visible = busy != "" or self._armed()
        widgets.explain("" if self._reasons is None else self._reasons.content, busy=why != "")
        if state is None:
            widgets.status.content, widgets.found.content, widgets.histograms.content = WAITING, "", ""
            return
        widgets.follow(state)
        faint = drawable(self._host[0].splats()[0]["opacities"])
        widgets.status.content = said(state, self._message, busy, faint)
        widgets.found.content = found_table(state)

    def _list(self, wanted: Callable[[], bool], found: Found, histograms: str) -> None:
        with self._lock:
            if self._widgets is not None and wanted():
                self._widgets.rows.show(found)
                self._widgets.histograms.content = histograms
