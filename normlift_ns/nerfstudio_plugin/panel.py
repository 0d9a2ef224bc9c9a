"""The panel in nerfstudio's viewer: widgets around a `Session`, which knows what is asked and shown.

nerfstudio finds the widgets by walking the attributes of the model, in alphabetical order, once when the viewer
starts. It calls their hooks under its render lock; only a query, which may have to load a text encoder, runs without
and takes the lock to show its answer. Rendering happens in other threads, which read nothing of this but the `Display`
that the model got last.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import replace
from functools import wraps
from pathlib import Path
from threading import Lock
from typing import Any, Protocol, cast

import torch
from nerfstudio.viewer.viewer_elements import (
    ViewerButton,
    ViewerCheckbox,
    ViewerClick,
    ViewerControl,
    ViewerDropdown,
    ViewerElement,
    ViewerSlider,
)
from torch import Tensor

from normlift_ns.asking import Answer
from normlift_ns.core.crash import explain
from normlift_ns.core.field import SemanticField
from normlift_ns.errors import InputError
from normlift_ns.nerfstudio_plugin.widgets import FreeButton, Markdown, TextBox, set_value
from normlift_ns.options import THRESHOLDS, RasterizeMode
from normlift_ns.question import Question, make_question
from normlift_ns.runs.files import texts_cache
from normlift_ns.text_encoders import Texts, default_negatives, encoder_of
from normlift_ns.viewer.display import COLORMAPS, PARTS, Display
from normlift_ns.viewer.session import ALL_PROMPTS, Session, check_prompts, split_prompts
from normlift_ns.viewer.status import as_text, clipped

_READING = (
    "Reading the prompts. The first time the text encoder is loaded, which takes a while; the picture stays live."
)
_WAITING = "No semantics yet. They are lifted at the end of the training."


class Host(Protocol):
    """What the panel needs of the model."""

    def show(self, display: Display | None) -> None:
        """Replaces what is drawn besides the colours."""
        ...

    def in_sight(self, origin: Tensor, direction: Tensor) -> Tensor:
        """Weights of the Gaussians on a ray."""
        ...

    def splats(self) -> tuple[Mapping[str, Tensor], bool, RasterizeMode]:
        """For `write_splats`: parameters, whether colours are spherical harmonics, and how they were rasterized."""
        ...


def _reported(action: Callable[[Panel], None]) -> Callable[[Panel, Any], None]:
    """A hook that shows what went wrong in the panel."""

    @wraps(action)
    def hook(panel: Panel, _: Any = None) -> None:
        try:
            action(panel)
        except Exception as error:  # whatever it is: nothing may stop the viewer
            panel.note(explain(error)[0])

    return hook


class Panel(torch.nn.Module):
    """Widgets of the panel. A module, because nerfstudio looks for widgets in modules only."""

    def __init__(self, host: Host) -> None:
        super().__init__()
        self._host = [host]  # in lists: a module that holds its parent, or an encoder that is saved with the model
        self._encoder: list[Texts] = []
        self._folder: Path | None = None
        self._session: Session | None = None
        self._turn = object()  # of the last query, clear or click: what was asked before it comes too late
        self._encoding, self._busy = Lock(), ""
        self.control = ViewerControl()
        self.ask_1_prompts = TextBox("Prompts", "", hint="What to look for; several are separated by ;")
        self.ask_2_negatives = TextBox("Negatives", "", hint="What to compare with; several are separated by ;")
        rules = ["auto", *THRESHOLDS]
        self.ask_3_rule = ViewerDropdown("Relevancy", "auto", rules, hint="lerf and margin use negatives")
        self.ask_4_refined = ViewerCheckbox("Refined", True, cb_hook=self._use_refined, hint="Use refined features")
        self.ask_5_query = FreeButton("Query", self._query)
        self.ask_6_clear = ViewerButton("Clear", self._clear)
        self.ask_7_click = ViewerButton("Click: more like this", self._arm)
        self.ask_8_status = Markdown(_WAITING)
        self.show_1_prompt = ViewerDropdown(
            "Prompt shown", ALL_PROMPTS, [ALL_PROMPTS], cb_hook=self._show, hint="In overlay and selection"
        )
        self.show_2_threshold = ViewerSlider(
            "Threshold", 0.5, -0.2, 1.0, 0.005, cb_hook=self._reselect, hint="Relevancy above which to select"
        )
        self.show_3_reliability = ViewerSlider(
            "Minimum reliability", 0.0, 0.0, 1.0, 0.01, cb_hook=self._reselect, hint="Of what is selected"
        )
        self.show_4_part = ViewerDropdown("Draw", PARTS[0], list(PARTS), cb_hook=self._show, hint="What is drawn")
        self.show_5_colormap = ViewerDropdown(
            "Overlay colours", COLORMAPS[0], list(COLORMAPS), cb_hook=self._show, hint="Of the overlay"
        )
        self.write_1_export = ViewerButton("Export selection", self._export)
        self.write_2_save = ViewerButton("Save queries in run", self._save)
        for widget in self._widgets():
            widget.disabled = True

    @property
    def answer(self) -> Answer | None:
        """What is shown now."""
        return None if self._session is None else self._session.answer

    def open(
        self, field: SemanticField, means: Tensor, folder: Path | None = None, question: Question | None = None
    ) -> None:
        """Lets the panel be used, once there is a field, and shows the answer to a question.

        Args:
            folder: of the field; None: nothing can be saved.
        """
        self._folder, session = folder, Session(field, means)
        session = session if question is None else session.ask(question)
        self._session = session  # before the widgets: hooks run in other threads, and compare what they read with it
        for widget in self._widgets():
            widget.disabled = False
            if widget.gui_handle is not None:
                widget.set_disabled(False)
        if question is None:
            with suppress(ValueError, OSError):  # a file of text vectors that is gone is told when it is needed
                self.ask_2_negatives.value = "; ".join(default_negatives(field))
        else:
            self.ask_1_prompts.value = "; ".join(question.texts)
            self.ask_2_negatives.value = "; ".join(question.negatives)
            usual = "cosine" if len(question.negatives) == 0 else "lerf"
            self.ask_3_rule.value = "auto" if question.rule == usual else question.rule
            set_value(self.show_2_threshold, question.threshold)
            set_value(self.show_3_reliability, question.min_reliability)
            set_value(self.ask_4_refined, question.refined)
        self._replace(session)

    def close(self) -> None:
        """Forgets the field, because the Gaussians are about to change."""
        self._session = None

    def _widgets(self) -> list[ViewerElement[Any]]:
        """All but the text."""
        found = [widget for widget in vars(self).values() if isinstance(widget, ViewerElement)]
        return [widget for widget in found if widget is not self.ask_8_status]

    def note(self, text: str) -> None:
        """Shows a message, and below it what is shown now."""
        self._report(clipped(text, 400))

    def _query(self, _: Any = None) -> None:
        """Asks what the text boxes say; nothing of an earlier answer stays, whatever happens.

        Called without the render lock, which it takes once the texts are vectors.
        """
        self._turn = turn = object()
        question, message = None, ""
        try:
            question = self._read_question()
        except Exception as error:  # whatever an encoder makes its libraries raise: nothing may stop the viewer
            message = explain(error)[0]
        viewer = self.control.viewer
        assert viewer.train_lock is not None
        with viewer.train_lock:
            if self._turn is turn:
                self._answer_to(question, message)
            else:
                self._report("")
        viewer._trigger_rerender()

    def _read_question(self) -> Question:
        """What the text boxes say, as vectors."""
        session, rule = self._session, cast(Any, self.ask_3_rule.value)
        prompts, negatives = split_prompts(self.ask_1_prompts.value), split_prompts(self.ask_2_negatives.value)
        if session is None:
            raise InputError(_WAITING)
        check_prompts(prompts)
        with self._encoding:  # an encoder is loaded at its first text, and must not be loaded twice
            self._busy = _READING
            self._report("")
            try:
                encoder = self._encoder_of(session.field)
                return make_question(session.field, encoder.rows, prompts, negatives=negatives, rule=rule)
            finally:
                self._busy = ""

    def _answer_to(self, question: Question | None, message: str) -> None:
        """Shows the answer to a question, with the selection that the widgets say, or none and a message."""
        session = self._session
        if session is None:
            return
        found = session.clear()
        if question is not None:
            sure, refined = self.show_3_reliability.value, self.ask_4_refined.value
            question = replace(question, min_reliability=sure, refined=refined)
            try:
                found = session.ask_next(question, self.show_2_threshold.value)
            except Exception as error:  # likewise
                message = explain(error)[0]
        self._replace(found)
        if message:
            self.note(message)

    def _encoder_of(self, field: SemanticField) -> Texts:
        if len(self._encoder) == 0:
            cache = None if self._folder is None else texts_cache(self._folder.parent)
            self._encoder.append(encoder_of(field, str(field.source.device), cache))
        return self._encoder[0]

    @_reported
    def _clear(self) -> None:
        self._turn = object()
        if self._session is not None:
            self._replace(self._session.clear())  # the prompts stay: the user may type while this waits for a picture

    @_reported
    def _use_refined(self) -> None:
        if self._session is not None:
            found = self._session.use_refined(self.ask_4_refined.value)
            if found is not self._session:
                self._follow(found)

    @_reported
    def _reselect(self) -> None:
        """Threshold and reliability decide anew what is selected."""
        if self._session is not None:
            found = self._session.reselect(self.show_2_threshold.value, self.show_3_reliability.value)
            if found is not self._session:
                self._draw(found)

    @_reported
    def _show(self) -> None:
        if self._session is not None:
            found = self._as_chosen(self._session)
            if found is not self._session:
                self._draw(found)

    @_reported
    def _arm(self) -> None:
        """The next click on the scene asks for everything similar to the Gaussian that it meets."""
        self.control.register_pointer_cb("click", self._clicked)
        self.note("Click on something in the scene.")

    def _clicked(self, click: ViewerClick) -> None:
        """Called by viser without the render lock."""
        viewer = self.control.viewer
        self.control.unregister_pointer_cb()
        assert viewer.train_lock is not None
        with viewer.train_lock:
            self.ask_like(torch.tensor(click.origin), torch.tensor(click.direction))
        viewer._trigger_rerender()

    def ask_like(self, origin: Tensor, direction: Tensor) -> None:
        """Selects everything similar to the Gaussian that weighs most on a ray, among those with a direction."""
        session = self._session
        assert session is not None
        self._turn, device = object(), session.means.device
        weights = self._host[0].in_sight(origin.to(device), direction.to(device))
        sure, refined = self.show_3_reliability.value, self.ask_4_refined.value
        found, message = session.ask_like(weights, min_reliability=sure, refined=refined)
        if found is not session:
            self._replace(found)
        self.note(message)

    @_reported
    def _export(self) -> None:
        """Writes the selection to a PLY file in the run."""
        if self._session is None or self._folder is None:
            raise InputError(_WAITING)
        parameters, harmonics, mode = self._host[0].splats()
        how: dict[str, Any] = {"spherical_harmonics": harmonics, "rasterize_mode": mode}
        self.note(self._session.export(self._folder.parent / "exports", parameters, **how))

    @_reported
    def _save(self) -> None:
        if self._session is None:
            raise InputError(_WAITING)
        self.note(self._session.save(self._folder))

    def _as_chosen(self, session: Session) -> Session:
        """The session, shown as the widgets say."""
        options, value = self.show_1_prompt.options, self.show_1_prompt.value
        shown = options.index(value) - 1 if value in options[1:] else None
        return session.show(shown, cast(Any, self.show_4_part.value), cast(Any, self.show_5_colormap.value))

    def _replace(self, session: Session) -> None:
        """Shows another answer, or none: of all its prompts."""
        self._session = session
        set_value(self.show_1_prompt, ALL_PROMPTS)
        self.show_1_prompt.set_options(session.prompts)
        self._follow(session)

    def _follow(self, session: Session) -> None:
        """Shows a session, and its threshold on the slider."""
        self._session = session
        if session.answer is not None:
            set_value(self.show_2_threshold, session.answer.question.threshold)
        self._draw(self._as_chosen(session))

    def _draw(self, session: Session) -> None:
        """Gives the model what to draw. The display is complete before it is handed over."""
        self._session = session
        self._host[0].show(session.display)
        self._report("")

    def _report(self, message: str) -> None:
        report = _WAITING if self._session is None else self._session.report
        self.ask_8_status.set("\n\n".join(filter(None, (as_text(self._busy), as_text(message), report))))
