"""Search panel in the nerfstudio viewer: what its widgets do to the history of states."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from threading import Lock
from typing import Any, cast

from torch import Tensor

from normlift_ns.analysis.objects import find_floaters
from normlift_ns.core.field import SemanticField
from normlift_ns.encoders.text_files import LazyTextEncoder
from normlift_ns.errors import InputError, describe_error
from normlift_ns.io.run_dir import text_cache_folder
from normlift_ns.nerfstudio_plugin.panel_view import (
    CLICK_MODES,
    NO_FIELD_MESSAGE,
    ClickListener,
    PanelHost,
    PanelView,
    PanelWidgets,
    explanation_of_run,
    export_selection,
    move_camera,
    store_prompts,
)
from normlift_ns.query.question import Query, load_query
from normlift_ns.query.text_encoder import default_rule, text_encoder_for
from normlift_ns.session import actions
from normlift_ns.session.actions import carry_threshold
from normlift_ns.session.objects import ObjectRow
from normlift_ns.session.prompts import (
    Prompt,
    build_query,
    encode_prompts,
    join_prompts,
    prompts_of_query,
    split_prompts,
)
from normlift_ns.session.selection import SelectionContext
from normlift_ns.session.state import History, RequestToken, State
from normlift_ns.viewer.widgets import OBJECT_ACTIONS, Explanation


class PromptEncoder:
    """Encoder of the panel's prompts. The text encoder is loaded at the first prompt and then kept."""

    def __init__(self) -> None:
        self.encoder: list[LazyTextEncoder] = []
        """The text encoder as the only item once it is loaded; empty before."""
        self._lock = Lock()

    def encode_query(
        self,
        field: SemanticField,
        folder: Path | None,
        line: str,
        negatives: str,
        clicks: Mapping[str, Any],
        widgets: PanelWidgets | None,
        is_current: Callable[[], bool],
    ) -> tuple[tuple[Prompt, ...], Query] | None:
        """Encode a line of prompts and build its query.

        Args:
            folder: folder of the semantic field; None: no stored prompts and no text embedding cache.
            line: prompts as typed.
            negatives: negative prompts as typed.
            clicks: directions of clicked Gaussians, by the names of their prompts.
            widgets: where the rule, the minimum reliability and the choice of features are set; None: defaults.
            is_current: returns False once the request is stale.
        Returns:
            The prompts and their query; None if the request is stale.
        Raises:
            ValueError, OSError: as `encode_prompts` and `session.prompts.build_query`.
        """
        vectors: dict[str, Any] = dict(clicks)
        with suppress(ValueError, OSError):  # a damaged file is reported when it is shown or replaced
            vectors |= {prompt.text: prompt.vector for prompt in prompts_of_query(load_stored_query(folder))}
        options: dict[str, Any] = {}
        if widgets is not None:
            options = {
                "rule": widgets.rule.value,
                "min_reliability": widgets.reliability.value,
                "refined": widgets.refined.value,
            }

        def encode(texts: Sequence[str]) -> Any:
            if len(self.encoder) == 0:
                cache = None if folder is None else text_cache_folder(folder.parent)
                self.encoder.append(text_encoder_for(field, str(field.source.device), cache))
            return self.encoder[0].rows(texts)

        with self._lock:  # so that two threads do not both load the encoder
            if not is_current():
                return None
            prompts = encode_prompts(line, encode, vectors)
            return build_query(field, prompts, encode, negatives=split_prompts(negatives), **options)


def load_stored_query(folder: Path | None) -> Query | None:
    """Return the query stored in a run, or None if it stores none."""
    return None if folder is None else load_query(folder)


# Controller of the panel in nerfstudio's viewer: applies the actions of the widgets to a history of states.
#
# All browsers share one panel, as they share nerfstudio's own. States are immutable, and so is the `Display` of a
# state that the model gets. Other threads can therefore render images without waiting for this one.


_READING = "Reading the prompts. The first query also loads the text encoder, which takes a while."
_ACTIONS = {
    "Hide": actions.hide,
    "Only": actions.show_only,
    "All": actions.show_all,
    "Suggested": actions.use_suggested_threshold,
    "Leave out what is poorly evidenced": actions.remove_weak,
}
_SLIDERS = {
    "Threshold": actions.set_threshold,
    "Minimum reliability": actions.set_min_reliability,
    "Grow": actions.resize,
}


class SearchPanel(PanelView):
    """The panel with its queries, clicks and history."""

    def __init__(self, host: PanelHost) -> None:
        super().__init__(host, lambda: self._clicks.armed)
        self._asker, self._clicks = PromptEncoder(), ClickListener(self._on_click)
        self._folder: Path | None = None

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
                with suppress(ValueError, OSError):  # a missing file of text embeddings is reported when it is needed
                    self._negatives = join_prompts(default_rule(field).negatives)
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
            self._details.cancel()
            self._history = self._reasons = None
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
            self._show(history.do(_ACTIONS[name](state)))
        elif name in _SLIDERS:
            self._show(history.do(_SLIDERS[name](state, value), key=name))
        elif name in ("Undo", "Redo"):
            history = history.undo() if name == "Undo" else history.redo()
            self._set_prompts(join_prompts([prompt.text for prompt in history.now.prompts]))
            self._show(history)
        elif name == "Clear":
            self._cancel()
            self._set_prompts("")
            with suppress(ValueError, OSError):  # as in `open`
                self._negatives = join_prompts(default_rule(state.space.field).negatives)
            if self._widgets is not None:
                self._widgets.reset_query_settings(self._negatives)
            self._show(history.do(replace(actions.show_all(actions.clear(state)), action="Clear")))
        elif name == "shown" and self._widgets is not None:
            self._show(history.do(actions.show_prompt(state, self._widgets.prompt_index(value))))
        elif name == "refined" and state.query is not None:
            question = replace(state.query, refined=value)
            self._show(history.do(actions.update_query(state, question, "Refined features")))
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

    def _cancel(self) -> None:
        """Discard running work, and stop waiting for a click."""
        self._turns.cancel()
        self._clicks.disarm()
        if self._reasons is not None:
            self._reasons.clear()

    def _act_on_object(self, action: str, row: ObjectRow, client: Any) -> None:
        if action == "go to":
            move_camera(client, row, self._host[0].scene(), cast(State, self.state).drawn)
        elif action == "export":
            self._download(row.mask, row.name, client)
        else:
            history = cast("History[State]", self._history)
            self._show(history.do((actions.show_only if action == "only" else actions.hide)(history.now, row.mask)))

    def _download(self, mask: Tensor, name: str, client: Any) -> None:
        file, content, count = export_selection(self._host[0], cast(State, self.state), mask, name)
        client.send_file_download(file, content)
        self.show_message(f"Sent {file} with {count:,} Gaussians to the browser's downloads.")

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
        inputs = (self._folder, self._line, self._negatives, dict(self._clicks.directions), self._widgets)
        field = cast(State, self.state).space.field
        result = self._asker.encode_query(field, *inputs, lambda: self._turns.busy != "")
        with self._lock:
            if result is not None and self._turns.finish(token) and self._history is not None:
                state, (prompts, question) = self._history.now, result
                self._message = ""
                self._show(
                    self._history.do(actions.ask(state, prompts, carry_threshold(state, question))), answered=True
                )

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
        state, reasons = cast(State, self.state), cast(Explanation, self._reasons)
        token = reasons.start(state)
        self.show_message("")
        try:
            reasons.compute(token, state)
        finally:
            with self._lock:
                self._update_widgets()

    def on_disconnect(self, client: Any) -> None:
        """Handle a disconnected browser, and stop waiting for its click."""
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
                saved = load_stored_query(self._folder)
                vector = actions.picked_direction(history.now, weights)
                self._set_prompts(self._clicks.add_direction(vector, () if saved is None else saved.texts))
            self._ask()
        except Exception as error:  # as in `act`
            self.show_message(describe_error(error)[0])

    def _save(self, state: State, *, replaces: bool) -> None:
        try:
            count = store_prompts(self._folder, state, replace=replaces)
        except InputError:
            self._offer_to_replace(state.query is not None)
            raise
        self._offer_to_replace(False)
        prompts = "one prompt" if count == 1 else f"{count} prompts"
        self.show_message(f"Saved. The run now stores {prompts} for ns-render to draw.")

    def _offer_to_replace(self, visible: bool) -> None:
        if self._widgets is not None:
            self._widgets.replace.visible = visible
