"""What a panel knows: the answer that is shown, how it is shown, and what each action makes of that.

A session is never changed: every action returns another one, with a message for the user. It knows no viewer.
"""

from __future__ import annotations

import os
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from normlift_ns.asking import Answer, answer, reselect
from normlift_ns.core.field import SemanticField
from normlift_ns.core.files import file_name, numbered
from normlift_ns.errors import InputError
from normlift_ns.options import RasterizeMode
from normlift_ns.question import Question
from normlift_ns.runs.question import save_question
from normlift_ns.runs.splats import export_files, write_splats
from normlift_ns.viewer.display import COLORMAPS, PARTS, Colormap, Display, Part, make_display, selection
from normlift_ns.viewer.status import clipped, report

MOST_PROMPTS = 64
ALL_PROMPTS = "all prompts"
CLICKED = "like what was clicked"
_ALIKE = 0.9


@dataclass(frozen=True)
class Session:
    """A field, and what is asked and shown of it."""

    field: SemanticField
    means: Float[Tensor, "n 3"]
    answer: Answer | None = None
    shown: int | None = None
    """The prompt whose relevancy is in the overlay and whose selection counts; None: all of them together."""
    part: Part = PARTS[0]
    """What is drawn."""
    colormap: Colormap = COLORMAPS[0]

    @cached_property
    def display(self) -> Display:
        """What to draw."""
        return make_display(self.field, self.answer, shown=self.shown, colormap=self.colormap, part=self.part)

    @property
    def chosen(self) -> Bool[Tensor, " n"] | None:
        """The selected Gaussians that are shown; None without an answer."""
        return selection(self.answer, self.shown)

    @property
    def prompts(self) -> list[str]:
        """The choices of what is shown: all prompts, then each."""
        texts = () if self.answer is None else self.answer.texts
        return [ALL_PROMPTS, *(f"{i}: {clipped(text, 40)}" for i, text in enumerate(texts))]

    @property
    def report(self) -> str:
        """How many Gaussians are selected, as `status.report` says it."""
        return report(self.answer, self.shown)

    def ask(self, question: Question) -> Session:
        """The answer to a question. All its prompts are shown.

        Raises:
            ValueError: vectors of another length than the field's, a rule without its negatives.
        """
        return replace(self, answer=answer(self.field, self.means, question), shown=None)

    def ask_next(self, question: Question, threshold: float) -> Session:
        """`ask`, with the threshold that the user has set where the question before had the same rule."""
        before = self.answer
        if before is not None and before.question.rule == question.rule and before.texts != (CLICKED,):
            question = replace(question, threshold=threshold)
        return self.ask(question)

    def clear(self) -> Session:
        """No answer."""
        return replace(self, answer=None, shown=None)

    def use_refined(self, refined: bool) -> Session:
        """The same question to the refined or the unrefined features; the same prompt stays shown."""
        if self.answer is None or self.answer.question.refined == refined:
            return self
        return replace(self.ask(replace(self.answer.question, refined=refined)), shown=self.shown)

    def reselect(self, threshold: float, min_reliability: float) -> Session:
        """The same relevancies with another selection."""
        if self.answer is None:
            return self
        question = self.answer.question
        if (threshold, min_reliability) == (question.threshold, question.min_reliability):
            return self
        return replace(self, answer=reselect(self.answer, threshold, min_reliability))

    def show(self, shown: int | None, part: Part, colormap: Colormap) -> Session:
        """The same answer, shown otherwise."""
        if (shown, part, colormap) == (self.shown, self.part, self.colormap):
            return self
        return replace(self, shown=shown, part=part, colormap=colormap)

    def ask_like(self, weights: Float[Tensor, " n"], *, min_reliability: float, refined: bool) -> tuple[Session, str]:
        """Asks for everything similar to the Gaussian that weighs most, among those with a direction.

        Args:
            weights: of the Gaussians on the ray that was clicked.
        Returns:
            The session and a message; the same session where the ray meets nothing with semantics.
        """
        weights = weights.where(self.field.valid(refined=refined), 0.0)
        met = int(weights.argmax())
        if float(weights[met]) == 0:
            return self, "There is nothing with semantics where you clicked."
        vector = self.field.directions(torch.tensor([met], device=weights.device), refined=refined).cpu().numpy()
        question = Question((CLICKED,), vector, threshold=_ALIKE, min_reliability=min_reliability, refined=refined)
        reliability = float(self.field.scalars.reliability[met])
        return self.ask(question), f"Clicked Gaussian {met}, reliability {reliability:.2f}."

    def export(
        self,
        folder: Path,
        parameters: Mapping[str, Tensor],
        *,
        spherical_harmonics: bool,
        rasterize_mode: RasterizeMode,
    ) -> str:
        """Writes the selection that is shown to a new PLY file in the folder; returns a message.

        Args:
            parameters, spherical_harmonics, rasterize_mode: as in `write_splats`.
        Raises:
            ValueError: nothing is selected.
        """
        chosen = self.chosen
        if self.answer is None or chosen is None or not bool(chosen.any()):
            raise InputError("Nothing is selected; there is nothing to export.")
        texts = self.answer.texts
        name = file_name("_".join(texts) if self.shown is None else texts[self.shown])
        folder.mkdir(exist_ok=True)
        how: dict[str, Any] = {"spherical_harmonics": spherical_harmonics, "rasterize_mode": rasterize_mode}
        for path in numbered(folder / f"{name}.ply"):
            if not any(map(os.path.lexists, export_files(path))):
                with suppress(FileExistsError):  # another process was faster
                    rows = write_splats(path, parameters, self.field, self.answer, keep=chosen, **how)
                    return f"{len(rows):,} Gaussians written to {path}"
        raise AssertionError("numbers do not end")

    def save(self, folder: Path | None) -> str:
        """Stores the question in the folder of the field; returns a message.

        Raises:
            ValueError: there is no question, or no folder.
        """
        if self.answer is None or folder is None:
            raise InputError("No query yet; there is nothing to save.")
        path = save_question(folder, self.answer.question)
        return f"Saved {len(self.answer.texts)} queries in {path}; ns-render draws them."


def split_prompts(text: str) -> list[str]:
    """What stands between semicolons, without blanks around it.

    >>> split_prompts("red mug ; bowl;")
    ['red mug', 'bowl']
    """
    return [part for part in (p.strip() for p in text.split(";")) if part]


def check_prompts(prompts: list[str]) -> None:
    """Raises ValueError unless there is at least one prompt and not too many."""
    if len(prompts) == 0:
        raise InputError("Type what to look for, then press Query.")
    if len(prompts) > MOST_PROMPTS:
        raise InputError(f"{len(prompts)} prompts; ask for {MOST_PROMPTS} at most at a time.")
