"""Undo and redo: a list of immutable states."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Generic, TypeVar

T = TypeVar("T")
MOST_STATES = 100


def _identity(state: T) -> T:
    return state


@dataclass(frozen=True, eq=False)
class History(Generic[T]):
    """States in chronological order, and the index of the current one.

    >>> history = History.of("a").do("b").do("c").undo()
    >>> history.now, history.undo().now, history.redo().now, history.do("d").can_redo
    ('b', 'a', 'c', False)
    """

    states: tuple[T, ...]
    at: int = 0
    """Index of the current state."""
    key: str | None = None
    """Key of the last step, if successive steps with this key are merged."""

    lean: Callable[[T], T] = _identity
    """Applied to a state when another one becomes current, for instance `State.lean`."""

    @staticmethod
    def of(state: T, *, lean: Callable[[T], T] = _identity) -> History[T]:
        """Return a history with a single state."""
        return History((state,), lean=lean)

    @property
    def now(self) -> T:
        """The current state."""
        return self.states[self.at]

    @property
    def can_undo(self) -> bool:
        """Whether there is an earlier state."""
        return self.at > 0

    @property
    def can_redo(self) -> bool:
        """Whether there is a later state, after an undo."""
        return self.at < len(self.states) - 1

    def do(self, state: T, *, key: str | None = None) -> History[T]:
        """Make a new state current, and drop undone ones. The state that is current already adds no step.

        Args:
            key: successive steps with the same key are merged into one, such as the drag of a slider.
        """
        if state is self.now:
            return self
        merge = key is not None and key == self.key and self.at > 0
        states = (*self._leaned[: self.at + (not merge)], state)[-MOST_STATES:]
        return History(states, len(states) - 1, key, self.lean)

    def undo(self) -> History[T]:
        """Return to the previous state; the same history if there is none."""
        return self.go_to(self.at - 1)

    def redo(self) -> History[T]:
        """Return to the state undone last; the same history if there is none."""
        return self.go_to(self.at + 1)

    def go_to(self, index: int) -> History[T]:
        """Make any state of the list current; the same history if the index is out of range."""
        if index == self.at or not 0 <= index < len(self.states):
            return self
        return replace(self, states=self._leaned, at=index, key=None)

    @property
    def _leaned(self) -> tuple[T, ...]:
        """The states with `lean` applied to the current one."""
        return (*self.states[: self.at], self.lean(self.now), *self.states[self.at + 1 :])
