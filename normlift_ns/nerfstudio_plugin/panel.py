"""The panel in nerfstudio's viewer: what its widgets do to a history of states.

All browsers share one panel, as they share nerfstudio's. A state is never changed, and neither is the `Display` that
the model gets of it, so that pictures are rendered in other threads without waiting for this one.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any, cast

from torch import Tensor

from normlift_ns.core.field import SemanticField
from normlift_ns.crash import explain
from normlift_ns.errors import InputError
from normlift_ns.insight.floaters import find_floaters
from normlift_ns.nerfstudio_plugin.asker import Asker, stored
from normlift_ns.nerfstudio_plugin.clicks import MODES, Clicks
from normlift_ns.nerfstudio_plugin.face import WAITING, Face
from normlift_ns.nerfstudio_plugin.insights import go_to, reasons_of
from normlift_ns.nerfstudio_plugin.keeping import Host, save_prompts, selection_file
from normlift_ns.question import Question
from normlift_ns.session import actions
from normlift_ns.session.found import FoundObject
from normlift_ns.session.history import History
from normlift_ns.session.prompts import join_prompts, prompts_of
from normlift_ns.session.space import Space
from normlift_ns.session.state import State
from normlift_ns.session.turns import Turn
from normlift_ns.session.verdicts import carried
from normlift_ns.text_encoders import default_rule
from normlift_ns.viewer.reasons import Reasons
from normlift_ns.viewer.rows import OBJECT_DEEDS

_READING = "Reading the prompts. The first time the text encoder is loaded, which takes a while."
_DEEDS = {
    "Hide": actions.hide,
    "Only": actions.only,
    "All": actions.show_all,
    "Suggested": actions.suggest,
    "Leave out what is poorly evidenced": actions.leave_out_poor,
}
_SLIDERS = {"Threshold": actions.threshold, "Minimum reliability": actions.min_reliability, "Grow": actions.resize}


class Panel(Face):
    """What is asked and shown."""

    def __init__(self, host: Host) -> None:
        super().__init__(host, lambda: self._clicks.armed)
        self._asker, self._clicks = Asker(), Clicks(self._hit)
        self._folder: Path | None = None

    def open(
        self, field: SemanticField, means: Tensor, folder: Path | None = None, question: Question | None = None
    ) -> None:
        """Lets the panel be used, once there is a field, and shows the answer to a question.

        Args:
            folder: of the field; None: nothing can be saved.
        """
        with self._lock:
            self._folder, state = folder, State(Space(field, means))
            if question is None:
                with suppress(ValueError, OSError):  # a file of text vectors that is gone is told when it is needed
                    self._negatives = join_prompts(default_rule(field).negatives)
            else:
                state = actions.ask(state, prompts_of(question), question)
                self._negatives = join_prompts(question.negatives)
                self._write(join_prompts(question.texts))
            self._clicks.known, self._message = {}, ""
            self._reasons = reasons_of(folder, field)
            if self._widgets is not None:
                self._widgets.negatives.value = self._negatives
            self._show(History.of(state, lean=State.lean))

    def close(self) -> None:
        """Forgets the field, because the Gaussians are about to change."""
        with self._lock:
            self._cancel()
            self._rest.cancel()
            self._history = self._reasons = None
            self._follow()

    def act(self, name: str, value: Any = None, client: Any = None) -> None:
        """What a widget does; whatever goes wrong is told in the panel.

        Args:
            client: the browser in which it was pressed.
        """
        try:
            if self.state is None:
                raise InputError(WAITING)
            if name == "Ask":
                self._ask()
            elif name == "Select likely floaters":
                self._work("Looking for floaters.", self._select_floaters)
            elif name == "Why?":
                self._explain()
            else:
                with self._lock:
                    self._do(name, value, client)
        except Exception as error:  # whatever it is: nothing may stop the viewer
            self.tell(explain(error)[0])

    def _do(self, name: str, value: Any, client: Any) -> None:
        """All that takes no time."""
        history = cast("History[State]", self._history)
        now, self._message = history.now, ""
        if name in _DEEDS:
            self._show(history.do(_DEEDS[name](now)))
        elif name in _SLIDERS:
            self._show(history.do(_SLIDERS[name](now, value), key=name))
        elif name in ("Undo", "Redo"):
            moved = history.undo() if name == "Undo" else history.redo()
            self._write(join_prompts([prompt.text for prompt in moved.now.prompts]))
            self._show(moved)
        elif name == "Clear":
            self._cancel()
            self._write("")
            with suppress(ValueError, OSError):  # as in `open`
                self._negatives = join_prompts(default_rule(now.space.field).negatives)
            if self._widgets is not None:
                self._widgets.forget(self._negatives)
            self._show(history.do(replace(actions.show_all(actions.clear(now)), did="Clear")))
        elif name == "shown" and self._widgets is not None:
            self._show(history.do(actions.show(now, self._widgets.place(value))))
        elif name == "refined" and now.question is not None:
            self._show(history.do(actions.ask_again(now, replace(now.question, refined=value), "Refined features")))
        elif name == "colormap":
            self._colormap = value
            self._show(history)
        elif name in MODES:
            self._clicks.arm(name, client)
            self.tell("Click on something in the scene. Cancel or Escape ends it.")
        elif name == "Cancel":
            self._cancel()
            self._follow()
        elif name in OBJECT_DEEDS:
            self._with_object(name, value, client)
        elif name == "Download selection":
            self._download(now.selection, now.name, client)
        elif name in ("Save prompts in run", "Replace the saved prompts"):
            self._save(now, replaces=name.startswith("Replace"))

    def _cancel(self) -> None:
        """Ends what runs, and what waits for a click."""
        self._turns.cancel()
        self._clicks.disarm()
        if self._reasons is not None:
            self._reasons.forget()

    def _with_object(self, deed: str, row: FoundObject, client: Any) -> None:
        if deed == "go to":
            go_to(client, row, self._host[0].scene(), cast(State, self.state).drawn)
        elif deed == "export":
            self._download(row.mask, row.name, client)
        else:
            history = cast("History[State]", self._history)
            self._show(history.do((actions.only if deed == "only" else actions.hide)(history.now, row.mask)))

    def _download(self, mask: Tensor, name: str, client: Any) -> None:
        file, content, count = selection_file(self._host[0], cast(State, self.state), mask, name)
        client.send_file_download(file, content)
        self.tell(f"{file} with {count:,} Gaussians goes to your downloads.")

    def _ask(self) -> None:
        """Asks what the text boxes say."""
        if self._widgets is not None:
            self._line, self._negatives = self._widgets.prompts.value, self._widgets.negatives.value
        self._work(_READING, self._answer)

    def _work(self, what: str, work: Callable[[Turn], None]) -> None:
        """Does what takes a while, without any lock; the panel shows what, until it is done."""
        turn = self._turns.start(what)
        self._clicks.disarm()
        self.tell("")
        message = ""
        try:
            work(turn)
        except Exception as error:  # whatever an encoder makes its libraries raise: nothing may stop the viewer
            message = explain(error)[0]
        if self._turns.finish(turn):
            self.tell(message)

    def _answer(self, turn: Turn) -> None:
        asked = (self._folder, self._line, self._negatives, dict(self._clicks.known), self._widgets)
        field = cast(State, self.state).space.field
        posed = self._asker.pose(field, *asked, lambda: self._turns.busy != "")
        with self._lock:
            if posed is not None and self._turns.finish(turn) and self._history is not None:
                now, (prompts, question) = self._history.now, posed
                self._message = ""
                self._show(self._history.do(actions.ask(now, prompts, carried(now, question))), answered=True)

    def _select_floaters(self, turn: Turn) -> None:
        found = find_floaters(self._host[0].scene(), cast(State, self.state).space.field.scalars).mask
        with self._lock:
            if self._history is not None and self._turns.wanted(turn):
                after = actions.select_floaters(self._history.now, found)
                self._turns.finish(turn)
                self._message = actions.LOOK_FIRST
                self._show(self._history.do(after), answered=True)

    def _explain(self) -> None:
        """Shows the photographs that voted for the selection, which are looked for without any lock."""
        state, reasons = cast(State, self.state), cast(Reasons, self._reasons)
        turn = reasons.start(state)
        self.tell("")
        try:
            reasons.find(turn, state)
        finally:
            with self._lock:
                self._follow()

    def forget(self, client: Any) -> None:
        """A browser is gone; its click does not come any more."""
        if self._clicks.forget(client):
            self.tell("")

    def _hit(self, mode: str, origin: Tensor, direction: Tensor) -> None:
        """A browser has clicked: asks for everything like that, or selects, adds or takes away the object."""
        try:
            device = cast(State, self.state).space.means.device
            with self._viewer.train_lock:  # what is drawn may be changed by a picture that is being made
                weights = self._host[0].in_sight(origin.to(device), direction.to(device))
            with self._lock:
                history = cast("History[State]", self._history)
                if mode != "like":
                    self._message = ""
                    self._show(history.do(actions.click(history.now, weights, cast(Any, mode))), answered=True)
                    return
                saved = stored(self._folder)
                vector = actions.click_vector(history.now, weights)
                self._write(self._clicks.keep(vector, () if saved is None else saved.texts))
            self._ask()
        except Exception as error:  # as in `act`
            self.tell(explain(error)[0])

    def _save(self, now: State, *, replaces: bool) -> None:
        try:
            count = save_prompts(self._folder, now, replaces=replaces)
        except InputError:
            self._offer_to_replace(now.question is not None)
            raise
        self._offer_to_replace(False)
        stored = "one prompt" if count == 1 else f"{count} prompts"
        self.tell(f"Saved: the run stores {stored} now, for ns-render to draw.")

    def _offer_to_replace(self, offered: bool) -> None:
        if self._widgets is not None:
            self._widgets.replace.visible = offered
