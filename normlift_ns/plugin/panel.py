"""The panel in nerfstudio's viewer: what is asked, what is shown of the answer, and what is written.

nerfstudio finds the elements by walking the attributes of the model, in alphabetical order, once when the viewer
starts. It calls their hooks under its render lock; only a query, which may have to load a text encoder, runs without
and takes the lock to show its answer. Rendering happens in other threads, which read nothing of this but the `Display`
that the model got last.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace
from functools import wraps
from threading import Lock
from typing import TYPE_CHECKING, Any, cast

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

from normlift_ns.core.files import file_name, free_path
from normlift_ns.plugin.asking import THRESHOLDS, Answer, default_negatives, encoder_of, judge, pose, respond
from normlift_ns.plugin.display import COLORMAPS, PARTS, make_display, selection
from normlift_ns.plugin.elements import FreeButton, Markdown, TextBox, set_value
from normlift_ns.plugin.ply import write_splats
from normlift_ns.plugin.queries import Question, save_question
from normlift_ns.plugin.status import as_text, clipped, report

if TYPE_CHECKING:
    from normlift_ns.core.field import SemanticField
    from normlift_ns.encoders.source import TextEncoder
    from normlift_ns.plugin.model import NormLiftModel

MOST_PROMPTS = 64
_ALL = "all prompts"
_CLICKED = "like what was clicked"
_ALIKE = 0.9
_READING = (
    "Reading the prompts. The first time the text encoder is loaded, which takes a while; the picture stays live."
)
_WAITING = "No semantics yet. They are lifted at the end of the training."


def _reported(action: Callable[[Panel], None]) -> Callable[[Panel, Any], None]:
    """A hook that shows mistakes of the user, and of files, in the panel."""

    @wraps(action)
    def hook(panel: Panel, _: Any = None) -> None:
        try:
            action(panel)
        except (ValueError, OSError) as error:
            panel.note(str(error))

    return hook


class Panel(torch.nn.Module):
    """Elements and state of the panel. A module, because nerfstudio looks for elements in modules only."""

    def __init__(self, model: NormLiftModel) -> None:
        super().__init__()
        self._model = [model]  # in lists: a module that holds its parent, or an encoder that is saved with the model
        self._encoder: list[TextEncoder] = []
        self._answer: Answer | None = None
        self._rendered: tuple[int | None, str, str] | None = None
        self._turn = object()  # of the last query, clear or click: what was asked before it comes too late
        self._encoding, self._busy = Lock(), ""
        self.control = ViewerControl()
        self.ask_1_prompts = TextBox("Prompts", "", hint="What to look for; several are separated by ;")
        self.ask_2_negatives = TextBox("Negatives", "", hint="What to compare with; several are separated by ;")
        forms = ["auto", *THRESHOLDS]
        self.ask_3_relevancy = ViewerDropdown("Relevancy", "auto", forms, hint="lerf and margin use negatives")
        self.ask_4_refined = ViewerCheckbox("Refined", True, cb_hook=self._ask_again, hint="Ask voted directions")
        self.ask_5_query = FreeButton("Query", self._query)
        self.ask_6_clear = ViewerButton("Clear", self._clear)
        self.ask_7_click = ViewerButton("Click: more like this", self._arm)
        self.ask_8_status = Markdown(_WAITING)
        self.show_1_prompt = ViewerDropdown(
            "Prompt shown", _ALL, [_ALL], cb_hook=self._show, hint="In overlay and selection"
        )
        self.show_2_threshold = ViewerSlider(
            "Threshold", 0.5, -0.2, 1.0, 0.005, cb_hook=self._judge, hint="Relevancy above which to select"
        )
        self.show_3_reliability = ViewerSlider(
            "Min reliability", 0.0, 0.0, 1.0, 0.01, cb_hook=self._judge, hint="Least reliability to select"
        )
        self.show_4_part = ViewerDropdown("Draw", PARTS[0], list(PARTS), cb_hook=self._show, hint="What is drawn")
        self.show_5_colormap = ViewerDropdown(
            "Overlay colours", COLORMAPS[0], list(COLORMAPS), cb_hook=self._show, hint="Of the overlay"
        )
        self.write_1_export = ViewerButton("Export selection", self._export)
        self.write_2_save = ViewerButton("Save queries in run", self._save)
        for element in self._elements():
            element.disabled = True

    @property
    def answer(self) -> Answer | None:
        """What is shown now."""
        return self._answer

    def open(self, answer: Answer | None) -> None:
        """Lets the panel be used, once the model has a field, and shows an answer."""
        field = self._model[0].field
        assert field is not None
        self._answer = answer  # first: hooks run in other threads, and compare what they read with it
        for element in self._elements():
            element.disabled = False
            if element.gui_handle is not None:
                element.set_disabled(False)
        if answer is None:
            with suppress(ValueError, OSError):  # a file of text vectors that is gone is told when it is needed
                self.ask_2_negatives.value = "; ".join(default_negatives(field))
        else:
            question = answer.question
            self.ask_1_prompts.value = "; ".join(question.texts)
            self.ask_2_negatives.value = "; ".join(question.negatives)
            usual = "cosine" if len(question.negatives) == 0 else "lerf"
            self.ask_3_relevancy.value = "auto" if question.form == usual else question.form
            set_value(self.show_2_threshold, question.threshold)
            set_value(self.show_3_reliability, question.min_reliability)
            set_value(self.ask_4_refined, question.refined)
        self._replace(answer)

    def _elements(self) -> list[ViewerElement[Any]]:
        """All but the text."""
        found = [element for element in vars(self).values() if isinstance(element, ViewerElement)]
        return [element for element in found if element is not self.ask_8_status]

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
            question = self._posed()
        except (ValueError, OSError, MemoryError, RuntimeError) as error:
            message = str(error)
        viewer = self.control.viewer
        assert viewer.train_lock is not None
        with viewer.train_lock:
            if self._turn is turn:
                self._answer_to(question, message)
            else:
                self._report("")
        viewer._trigger_rerender()

    def _posed(self) -> Question:
        """What the text boxes say, as vectors."""
        field, form = self._model[0].field, cast(Any, self.ask_3_relevancy.value)
        prompts, negatives = _parts(self.ask_1_prompts.value), _parts(self.ask_2_negatives.value)
        if field is None:
            raise ValueError(_WAITING)
        if len(prompts) == 0:
            raise ValueError("Type what to look for, then press Query.")
        if len(prompts) > MOST_PROMPTS:
            raise ValueError(f"{len(prompts)} prompts; ask for {MOST_PROMPTS} at most at a time.")
        with self._encoding:  # an encoder is loaded at its first text, and must not be loaded twice
            self._busy = _READING
            self._report("")
            try:
                return pose(field, self._encoder_of(field), prompts, negatives=negatives, form=form)
            finally:
                self._busy = ""

    def _answer_to(self, question: Question | None, message: str) -> None:
        """Shows the answer to a question, judged as the elements say, or none and a message."""
        before, field, answer = self._answer, self._model[0].field, None
        if question is not None and field is not None:
            rule = {"min_reliability": self.show_3_reliability.value, "refined": self.ask_4_refined.value}
            if before is not None and before.question.form == question.form and before.texts != (_CLICKED,):
                rule["threshold"] = self.show_2_threshold.value  # as the user left it
            try:
                answer = respond(field, replace(question, **rule))
            except ValueError as error:
                message = str(error)
        self._replace(answer)
        if message:
            self.note(message)

    def _encoder_of(self, field: SemanticField) -> TextEncoder:
        if len(self._encoder) == 0:
            folder = self._model[0].config.semantics
            cache = None if folder is None else folder.parents[1] / ".cache" / "texts"
            self._encoder.append(encoder_of(field, str(self._model[0].device), cache))
        return self._encoder[0]

    @_reported
    def _clear(self) -> None:
        self._turn = object()
        self._replace(None)  # the prompts stay: this waits for a picture, and the user may type meanwhile

    @_reported
    def _ask_again(self) -> None:
        """The same question to the refined or the unrefined directions."""
        answer, field, refined = self._answer, self._model[0].field, self.ask_4_refined.value
        if answer is not None and field is not None and answer.question.refined != refined:
            self._replace(respond(field, replace(answer.question, refined=refined)), keep=True)

    @_reported
    def _judge(self) -> None:
        """Threshold and reliability decide anew what is selected."""
        answer, field = self._answer, self._model[0].field
        rule = (self.show_2_threshold.value, self.show_3_reliability.value)
        if answer is None or field is None or rule == (answer.question.threshold, answer.question.min_reliability):
            return
        self._answer = judge(field, answer, *rule)
        self._render()

    @_reported
    def _show(self) -> None:
        if self._choices() != self._rendered:
            self._render()

    @_reported
    def _arm(self) -> None:
        """The next click on the scene asks for what has the direction of the Gaussian that it meets."""
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

    def ask_like(self, origin: torch.Tensor, direction: torch.Tensor) -> None:
        """Selects what has the direction of the Gaussian that weighs most on a ray, among those with a direction."""
        model, refined = self._model[0], self.ask_4_refined.value
        field = model.field
        assert field is not None
        self._turn = object()
        weights = model.in_sight(origin.to(model.device), direction.to(model.device))
        weights = weights.where(field.valid(refined=refined), 0.0)
        chosen = int(weights.argmax())
        if float(weights[chosen]) == 0:
            self.note("There is nothing with semantics where you clicked.")
            return
        vector = field.directions(torch.tensor([chosen], device=model.device), refined=refined)
        sure = self.show_3_reliability.value
        question = Question((_CLICKED,), vector, threshold=_ALIKE, min_reliability=sure, refined=refined)
        self._replace(respond(field, question))
        self.note(f"Clicked Gaussian {chosen}, reliability {float(field.scalars.reliability[chosen]):.2f}.")

    @_reported
    def _export(self) -> None:
        """Writes the selection to a PLY file in the run."""
        model, chosen = self._model[0], selection(self._answer, self._shown())
        if chosen is None or not bool(chosen.any()):
            raise ValueError("Nothing is selected; there is nothing to export.")
        assert self._answer is not None and model.field is not None and model.config.semantics is not None
        texts, shown = self._answer.texts, self._shown()
        name = file_name("_".join(texts) if shown is None else texts[shown])
        path = model.config.semantics.parent / "exports" / f"{name}.ply"
        path.parent.mkdir(exist_ok=True)
        harmonics = model.config.sh_degree > 0
        path = free_path(path)
        rows = write_splats(
            path, dict(model.gauss_params), model.field, self._answer, keep=chosen, spherical_harmonics=harmonics
        )
        self.note(f"{len(rows):,} Gaussians written to {path}")

    @_reported
    def _save(self) -> None:
        folder = self._model[0].config.semantics
        if self._answer is None or folder is None:
            raise ValueError("Nothing is asked; there is nothing to save.")
        path = save_question(folder, self._answer.question)
        self.note(f"Saved {len(self._answer.texts)} queries in {path}; ns-render draws them.")

    def _choices(self) -> tuple[int | None, str, str]:
        """What the elements say about drawing: the prompt shown, the part drawn, the colours."""
        return self._shown(), self.show_4_part.value, self.show_5_colormap.value

    def _shown(self) -> int | None:
        """Index of the prompt shown; None: all of them."""
        options, value = self.show_1_prompt.options, self.show_1_prompt.value
        return options.index(value) - 1 if value in options[1:] else None

    def _replace(self, answer: Answer | None, keep: bool = False) -> None:
        """Shows another answer, or none.

        Args:
            keep: it has the same prompts, of which the same stays shown.
        """
        self._answer = answer
        if not keep:
            texts = () if answer is None else answer.texts
            set_value(self.show_1_prompt, _ALL)
            self.show_1_prompt.set_options([_ALL, *(f"{i}: {clipped(t, 40)}" for i, t in enumerate(texts))])
        if answer is not None:
            set_value(self.show_2_threshold, answer.question.threshold)
        self._render()

    def _render(self) -> None:
        """Gives the model what the elements say. The display is complete before it is handed over."""
        model = self._model[0]
        if model.field is None:
            return
        self._rendered = shown, part, colormap = self._choices()
        model.show(make_display(model.field, self._answer, shown=shown, colormap=colormap, part=part))  # type: ignore[arg-type]
        self._report("")

    def _report(self, message: str) -> None:
        lines = (as_text(self._busy), as_text(message), report(self._answer, self._shown()))
        self.ask_8_status.set("\n\n".join(filter(None, lines)))


def _parts(text: str) -> list[str]:
    """What stands between semicolons, without blanks around it."""
    return [part for part in (p.strip() for p in text.split(";")) if part]
