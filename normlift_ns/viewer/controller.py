"""Controller of a viewer panel: it applies the actions of a user to the history of states, and runs slow requests."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Collection, Sequence
from contextlib import nullcontext
from dataclasses import dataclass, field, replace
from functools import partial
from threading import Lock, RLock
from typing import Any, cast

from jaxtyping import Bool, Float
from torch import Tensor

from normlift_ns.errors import InputError, describe_error
from normlift_ns.session import actions
from normlift_ns.session.actions import ClickMode, carry_threshold
from normlift_ns.session.objects import ObjectRow
from normlift_ns.session.prompts import build_query, click_name, encode_prompts, not_understood
from normlift_ns.session.state import History, RequestToken, RequestTokens, State
from normlift_ns.viewer.widgets import ALL_PROMPTS, SLIDERS, Action, Explanation

NO_FIELD_MESSAGE = (
    "This scene has no semantics yet. They are added by ns-normlift, or by the lift at the end of training."
)
_CLICK_MODES: dict[Action, ClickMode] = {Action.SELECT: "select", Action.ADD: "add", Action.REMOVE: "remove"}


def _show_prompt(state: State, option: str) -> State:
    """Select Gaussians by the prompt of a dropdown option, or by all prompts."""
    return actions.show_prompt(state, None if option == ALL_PROMPTS else int(option.split(":", maxsplit=1)[0]) - 1)


def _use_refined(state: State, refined: bool) -> State:
    question = None if state.query is None else replace(state.query, refined=refined)
    return actions.update_query(state, question, "Refined features")


_CHANGES: dict[Action, Callable[..., State]] = {
    Action.HIDE: lambda state, row=None: actions.hide(state, None if row is None else row.mask),
    Action.SHOW_ONLY: lambda state, row=None: actions.show_only(state, None if row is None else row.mask),
    Action.SHOW_ALL: actions.show_all,
    Action.SUGGESTED: actions.use_suggested_threshold,
    Action.REMOVE_WEAK: actions.remove_weak,
    Action.THRESHOLD: actions.set_threshold,
    Action.RELIABILITY: actions.set_min_reliability,
    Action.GROW: actions.resize,
    Action.SHOW_PROMPT: _show_prompt,
    Action.REFINED: _use_refined,
}
"""Functions from a state to the next state, by action. Some take a second argument, a value or the row of an object."""
_UNLOCKED = (Action.ASK, Action.SELECT_FLOATERS, Action.EXPLAIN)
"""Actions that must not hold the lock because they are slow or start other actions."""


@dataclass(eq=False)
class Session:
    """Queries and clicks of one user, kept while the viewer runs."""

    history: History[State] | None = None
    """History of states; None until the semantics of a run are loaded."""
    line: str = ""
    """Text in the prompt box."""
    clicks: dict[str, Any] = field(default_factory=dict)
    """Directions of clicked Gaussians, by the prompt texts that stand for the clicks."""


class Controller(ABC):
    """Base class for the controller of one panel, which applies actions to a session.

    The controller changes the history of the session only while it holds its lock; slow requests run without the lock.
    Methods may be called from any thread.

    Args:
        session: Session that the actions change.
        explanation: Explanation of the current selection.
    """

    reading_message: str
    """Message shown while prompts are encoded."""
    floaters_message = actions.FLOATERS_HINT
    """Message shown after floaters are selected."""

    def __init__(self, session: Session, explanation: Explanation) -> None:
        self._session, self._reasons = session, explanation
        self._widgets: Any = None
        """`ActionWidgets` of the panel; None without a viewer."""
        self._message, self._turns = "", RequestTokens()
        self._lock, self._encoder_lock = RLock(), Lock()
        self._handlers: dict[Action, Callable[[Any, Any], None]] = {
            **{action: partial(self._change, action) for action in _CHANGES},
            **{action: partial(self._wait_for_click, action) for action in (Action.LIKE, *_CLICK_MODES)},
            Action.ASK: lambda *_: self._ask(),
            Action.CANCEL: lambda *_: self._cancel(),
            Action.UNDO: lambda *_: self._go_to(self.history.undo()),
            Action.REDO: lambda *_: self._go_to(self.history.redo()),
            Action.CLEAR: lambda *_: self._clear(),
            Action.SELECT_FLOATERS: lambda *_: self._run("Looking for floaters.", self._select_floaters),
            Action.EXPLAIN: lambda *_: self._explain(),
            Action.GO_TO: self._move_camera,
            Action.DOWNLOAD: self._download_object,
            Action.SAVE: lambda *_: self._save(),
        }

    @property
    def history(self) -> History[State]:
        """History of the session; only valid if `state` is not None."""
        return cast("History[State]", self._session.history)

    @property
    def state(self) -> State | None:
        """Current state; None until the semantics of a run are loaded."""
        return None if self._session.history is None else self.history.now

    def act(self, action: Action, value: Any = None, client: Any = None) -> None:
        """Carry out an action, and show any error in the panel.

        Args:
            value: Value of a slider or a choice, or row of an object.
            client: viser's client handle of the user's browser.
        """
        self._guard(lambda: self._act(action, value, client))

    def show_message(self, message: str) -> None:
        """Show a message in the panel, above the size of the selection."""
        with self._lock:
            self._message = message
            self._update_widgets()

    @abstractmethod
    def _show(self, history: History[State], message: str = "", *, answered: bool = False) -> None:
        """Make a history current, and show its state.

        Args:
            message: Message to show with the state.
            answered: True if the selection is new and must be visible.
        """

    @abstractmethod
    def _update_widgets(self) -> None:
        """Show the message, the running work and the explanation in the widgets."""

    @abstractmethod
    def _start(self, job: Callable[[], None], kind: Action) -> None:
        """Run a slow job without the lock, in this thread or another one."""

    @abstractmethod
    def _encode(self, texts: Sequence[str]) -> Any:
        """Return the embedding of each text; the caller ensures that only one thread at a time calls this method."""

    @abstractmethod
    def _known_vectors(self) -> dict[str, Any]:
        """Return the vectors of clicks and of stored prompts, by text; they do not need an encoder."""

    @abstractmethod
    def _query_settings(self) -> dict[str, Any]:
        """Return the keyword arguments of `build_query` for the next query."""

    @abstractmethod
    def _find_floaters(self) -> Bool[Tensor, " n"]:
        """Return the mask of likely floaters. This takes seconds."""

    @abstractmethod
    def _wait_for_click(self, action: Action, value: Any, client: Any) -> None:
        """Carry out an action at the next click in the scene."""

    @abstractmethod
    def _move_camera(self, target: Any, client: Any) -> None:
        """Move the camera of a browser to face an object."""

    @abstractmethod
    def _clear(self) -> None:
        """Remove the query and the selection, and reset the query settings."""

    @abstractmethod
    def _download(self, mask: Bool[Tensor, " n"], name: str, client: Any) -> None:
        """Send Gaussians as a PLY file to a browser."""

    @abstractmethod
    def _save(self) -> None:
        """Store the prompts in the run."""

    def _guard(self, work: Callable[[], None]) -> None:
        """Call a function, and show any error in the panel."""
        try:
            work()
        except Exception as error:  # encoder libraries may raise any exception, which must not stop the viewer
            self._show_error(error)

    def _show_error(self, error: Exception) -> None:
        self.show_message(describe_error(error)[0])

    def _act(self, action: Action, value: Any, client: Any) -> None:
        if self.state is None:
            raise InputError(NO_FIELD_MESSAGE)
        with nullcontext() if action in _UNLOCKED else self._lock:
            self._handlers[action](value, client)

    def _download_object(self, row: ObjectRow | None, client: Any) -> None:
        """Download an object, or the selection if `row` is None."""
        state = self.history.now
        mask, name = (state.selection, state.name) if row is None else (row.mask, row.name)
        self._download(mask, name, client)

    def _change(self, action: Action, value: Any, client: Any) -> None:
        state = self.history.now
        state = _CHANGES[action](state) if value is None else _CHANGES[action](state, value)
        self._do(state, key=action.name if action in SLIDERS else None)

    def _do(self, state: State, message: str = "", *, key: str | None = None, answered: bool = False) -> None:
        """Add a state to the history, and show it."""
        self._show(self.history.do(state, key=key), message, answered=answered)

    def _go_to(self, history: History[State]) -> None:
        """Show another state of the history."""
        self._show(history)

    def _set_prompts(self, line: str) -> None:
        """Replace the text in the prompt box."""
        self._session.line = line
        if self._widgets is not None:
            self._widgets.prompts.value = line

    def _cancel(self) -> None:
        """Discard running work, and stop waiting for a click."""
        self._discard()
        self.show_message("")

    def _discard(self) -> None:
        """Discard running work."""
        self._turns.cancel()
        self._reasons.clear()

    def _ask(self) -> None:
        """Start the query of the prompts in the prompt box."""
        if self._widgets is not None:
            self._session.line = self._widgets.prompts.value
        self._run(self.reading_message, partial(self._answer, line=self._session.line))

    def _run(self, description: str, task: Callable[[RequestToken], None]) -> None:
        """Start a slow task, and show its description in the panel until it ends."""
        token = self._turns.start(description)
        self.show_message("")
        self._start(lambda: self._finish(token, task), Action.ASK)

    def _finish(self, token: RequestToken, task: Callable[[RequestToken], None]) -> None:
        message = ""
        try:
            if self._turns.is_current(token):
                task(token)
        except Exception as error:  # as in `_guard`
            message = describe_error(error)[0]
        if self._turns.finish(token):
            self.show_message(message)

    def _answer(self, token: RequestToken, line: str, **settings: Any) -> None:
        """Encode prompts and show the answer to their query, unless the request is stale."""
        space, settings, vectors = self.history.now.space, {**self._query_settings(), **settings}, self._known_vectors()
        with self._encoder_lock:  # no two threads may load the encoder
            if not self._turns.is_current(token):
                return
            prompts, query = encode_prompts(line, self._encode, vectors), None
            message = not_understood(prompts)
            if not message:
                prompts, query = build_query(space.field, prompts, self._encode, **settings)

        def ask(state: State) -> State:
            if query is None or "threshold" in settings:
                return actions.ask(state, prompts, query)
            return actions.ask(state, prompts, carry_threshold(state, query))

        self._show_result(token, ask, message)

    def _select_floaters(self, token: RequestToken) -> None:
        floaters = self._find_floaters()
        self._show_result(token, lambda state: actions.select_floaters(state, floaters), self.floaters_message)

    def _show_result(self, token: RequestToken, result: Callable[[State], State], message: str = "") -> None:
        """Apply the result of a request to the current state and show it, unless the request is stale."""
        with self._lock:
            if self._turns.is_current(token) and self.state is not None:
                state = result(self.state)  # before `finish`, so that the caller shows an error
                if self._turns.finish(token):
                    self._do(state, message, answered=True)

    def _explain(self) -> None:
        """Explain the selection by training images. The search for these images runs without the lock."""
        state, reasons = self.history.now, self._reasons
        token = reasons.start(state)
        self.show_message("")

        def compute() -> None:
            try:
                reasons.compute(token, state)
            finally:
                with self._lock:
                    self._update_widgets()

        self._start(lambda: self._guard(compute), Action.EXPLAIN)

    def _click(self, action: Action, weights: Float[Tensor, " n"], message: str = "") -> None:
        """Select, add or remove the clicked object."""
        self._do(actions.click(self.history.now, weights, _CLICK_MODES[action]), message, answered=True)

    def _ask_click(self, clicked: Any, stored: Collection[str]) -> None:
        """Start a query for all Gaussians similar to a clicked one.

        Args:
            clicked: Direction of the clicked Gaussian.
            stored: Texts of the prompts stored in the run, which the new click must not reuse.
        """
        with self._lock:
            names = {*self._session.clicks, *stored}
            name = next(name for n in range(1, len(names) + 2) if (name := click_name(n)) not in names)
            self._session.clicks[name] = clicked
            self._set_prompts(name)
        self.act(Action.ASK)
