"""What a person has asked, selected and hidden."""

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
"""R below which a Gaussian is poorly evidenced."""


@dataclass(frozen=True, eq=False)
class State:
    """Everything that is shown to one person, but for the camera. Never changed; masks in it are not either.

    The selection is made in this order: what the prompts select (unless `from_answer` is False), with `added` and
    without `removed`, grown or shrunk, cut by the box.
    """

    space: Space
    prompts: tuple[Prompt, ...] = ()
    """All rows, those with a problem too."""
    question: Question | None = None
    """Of the rows without a problem; it also has the threshold and the minimum reliability."""
    shown: int | None = None
    """The text of the question that selects; None: all of them."""
    from_answer: bool = True
    added: Bool[Tensor, " n"] | None = None
    removed: Bool[Tensor, " n"] | None = None
    steps: int = 0
    """Of growth over the neighbour graph; below 0 of shrinking."""
    box: Box | None = None
    hidden: Bool[Tensor, " n"] | None = None
    """What is not drawn."""
    look: str = "colours"
    """How the viewer draws it; the viewer has the names."""
    did: str = ""
    """The action that led here, for the list of steps."""

    @cached_property
    def answer(self) -> Answer | None:
        """To the question; None without one."""
        return None if self.question is None else self.space.answer(self.question)

    @cached_property
    def unresized(self) -> Bool[Tensor, " n"]:
        """What the prompts and clicks select, before it is grown and cut."""
        found = self.space.none()
        if self.answer is not None and self.from_answer:
            found = self.answer.mask if self.shown is None else self.answer.selected[:, self.shown]
        found = found if self.added is None else found | self.added
        return found if self.removed is None else found & ~self.removed

    @cached_property
    def selection(self) -> Bool[Tensor, " n"]:
        """The selected Gaussians, hidden or not."""
        found = self.space.resized(self.unresized, self.steps, refined=self.refined)
        return found if self.box is None else found & self.box.kept(self.space.means)

    @property
    def drawn(self) -> Bool[Tensor, " n"]:
        """Everything that is not hidden."""
        return ~self.space.none() if self.hidden is None else ~self.hidden

    @property
    def by_hand(self) -> str:
        """What to say after the number of selected Gaussians where prompts do not select; empty: they do."""
        return "" if self.from_answer else ", by hand"

    @property
    def name(self) -> str:
        """What a file of the selection is called: the prompts that select, or where none does "selection"."""
        if self.question is None or not self.from_answer:
            return "selection"
        texts = self.question.texts
        return join_prompts(texts if self.shown is None else texts[self.shown : self.shown + 1])

    @property
    def refined(self) -> bool:
        """Whether refined features are asked."""
        return True if self.question is None else self.question.refined

    @cached_property
    def poor(self) -> float:
        """Share of the selection that is poorly evidenced; 0 where nothing is selected."""
        chosen = self.space.field.scalars.reliability[self.selection]
        return float((chosen < POOR).float().mean()) if len(chosen) > 0 else 0.0

    @property
    def remark(self) -> str:
        """What a person should know of the evidence before they trust the selection; empty: nothing.

        `actions.leave_out_poor` does what it offers.
        """
        if self.poor < 0.25:
            return ""
        return f"{self.poor:.0%} of this selection is poorly evidenced (R < {POOR:g})."

    def lean(self) -> State:
        """The same without what it has computed, for a history: it computes it again where it is shown again."""
        return replace(self)
