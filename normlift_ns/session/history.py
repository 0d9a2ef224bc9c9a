"""Undo and redo of everything: a list of states, none of which is ever changed."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Generic, TypeVar

T = TypeVar("T")
MOST_STATES = 100


def _same(state: T) -> T:
    return state


@dataclass(frozen=True, eq=False)
class History(Generic[T]):
    """States in the order in which they came, and which of them is shown.

    >>> history = History.of("a").do("b").do("c").undo()
    >>> history.now, history.undo().now, history.redo().now, history.do("d").can_redo
    ('b', 'a', 'c', False)
    """

    states: tuple[T, ...]
    at: int = 0
    """Index of the state that is shown."""
    key: str | None = None
    """What the last step was called, where steps of the same name are one."""

    lean: Callable[[T], T] = _same
    """What is kept of a state that is not shown, for instance `State.lean`."""

    @staticmethod
    def of(state: T, *, lean: Callable[[T], T] = _same) -> History[T]:
        """A history that begins now."""
        return History((state,), lean=lean)

    @property
    def now(self) -> T:
        """The state that is shown."""
        return self.states[self.at]

    @property
    def can_undo(self) -> bool:
        """Whether there is a state before."""
        return self.at > 0

    @property
    def can_redo(self) -> bool:
        """Whether a step was undone."""
        return self.at < len(self.states) - 1

    def do(self, state: T, *, key: str | None = None) -> History[T]:
        """Shows another state; what was undone is forgotten. The state that is shown already makes no step.

        Args:
            key: steps in a row of the same key become one, such as those of a slider that is dragged.
        """
        if state is self.now:
            return self
        again = key is not None and key == self.key and self.at > 0
        kept = (*self._left[: self.at + (not again)], state)[-MOST_STATES:]
        return History(kept, len(kept) - 1, key, self.lean)

    def undo(self) -> History[T]:
        """The state before; the same history where there is none."""
        return self.go_to(self.at - 1)

    def redo(self) -> History[T]:
        """The state that was undone last; the same history where there is none."""
        return self.go_to(self.at + 1)

    def go_to(self, index: int) -> History[T]:
        """Any state of the list; the same history where there is no such."""
        if index == self.at or not 0 <= index < len(self.states):
            return self
        return replace(self, states=self._left, at=index, key=None)

    @property
    def _left(self) -> tuple[T, ...]:
        """The states, once another one is shown."""
        return (*self.states[: self.at], self.lean(self.now), *self.states[self.at + 1 :])
