"""Immutable state of a session: what a user has asked, selected and hidden."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

from jaxtyping import Bool
from torch import Tensor

from normlift_ns.asking import Answer
from normlift_ns.question import Question
from normlift_ns.session.prompts import Prompt, join_prompts
from normlift_ns.session.space import Box, Space

POOR = 0.6
"""R below which the evidence of a Gaussian is weak."""


@dataclass(frozen=True, eq=False)
class State:
    """Everything that one user sees, except the camera. Neither the state nor its masks are ever changed.

    The selection starts with the Gaussians that the prompts select, unless `from_answer` is False. `added` is added to
    it and `removed` is removed; the result is grown or shrunk, then cut by the box.
    """

    space: Space
    prompts: tuple[Prompt, ...] = ()
    """All rows, including those with errors."""
    question: Question | None = None
    """Query of the rows without errors, with the threshold and the minimum reliability."""
    shown: int | None = None
    """Index of the only prompt of the query that selects; None: all of them select."""
    from_answer: bool = True
    """Whether the prompts select; False: the selection was made by hand."""
    added: Bool[Tensor, " n"] | None = None
    removed: Bool[Tensor, " n"] | None = None
    steps: int = 0
    """Steps of growth over the neighbor graph; negative: steps of shrinking."""
    box: Box | None = None
    hidden: Bool[Tensor, " n"] | None = None
    """Gaussians that are not drawn."""
    look: str = "colours"
    """Color mode; each viewer defines the names."""
    did: str = ""
    """Description of the action that led to this state."""

    @cached_property
    def answer(self) -> Answer | None:
        """Answer to the query; None without one."""
        return None if self.question is None else self.space.answer(self.question)

    @cached_property
    def unresized(self) -> Bool[Tensor, " n"]:
        """Gaussians selected by prompts and clicks, before growing and cutting."""
        mask = self.space.none()
        if self.answer is not None and self.from_answer:
            mask = self.answer.mask if self.shown is None else self.answer.selected[:, self.shown]
        mask = mask if self.added is None else mask | self.added
        return mask if self.removed is None else mask & ~self.removed

    @cached_property
    def selection(self) -> Bool[Tensor, " n"]:
        """Selected Gaussians, whether hidden or not."""
        mask = self.space.resized(self.unresized, self.steps, refined=self.refined)
        return mask if self.box is None else mask & self.box.kept(self.space.means)

    @property
    def drawn(self) -> Bool[Tensor, " n"]:
        """Gaussians that are not hidden."""
        return ~self.space.none() if self.hidden is None else ~self.hidden

    @property
    def by_hand(self) -> str:
        """Suffix for the number of selected Gaussians if the selection was made by hand; empty if prompts select."""
        return "" if self.from_answer else ", by hand"

    @property
    def name(self) -> str:
        """Name for a file of the selection: the prompts that select, or "selection" if none does."""
        if self.question is None or not self.from_answer:
            return "selection"
        texts = self.question.texts
        return join_prompts(texts if self.shown is None else texts[self.shown : self.shown + 1])

    @property
    def refined(self) -> bool:
        """Whether the query uses refined features."""
        return True if self.question is None else self.question.refined

    @cached_property
    def poor(self) -> float:
        """Fraction of the selection with weak evidence; 0 if nothing is selected."""
        reliability = self.space.field.scalars.reliability[self.selection]
        return float((reliability < POOR).float().mean()) if len(reliability) > 0 else 0.0

    @property
    def remark(self) -> str:
        """Warning if at least a quarter of the selection has weak evidence, else empty.

        `actions.leave_out_poor` removes the Gaussians in question.
        """
        if self.poor < 0.25:
            return ""
        return f"{self.poor:.0%} of this selection has weak evidence (R < {POOR:g})."

    def lean(self) -> State:
        """Return a copy without cached results, for a history. They are computed again when it is shown again."""
        return replace(self)
