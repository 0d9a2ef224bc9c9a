"""State of a session, its history, and request tokens."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import cached_property
from threading import Lock
from typing import Generic, TypeVar

from jaxtyping import Bool
from torch import Tensor

from normlift_ns.options import WEAK_RELIABILITY
from normlift_ns.query.engine import Answer
from normlift_ns.query.question import Query, join_prompts
from normlift_ns.rendering.colors import Colormap
from normlift_ns.session.prompts import Prompt
from normlift_ns.session.selection import SelectionContext


@dataclass(frozen=True, eq=False)
class Layer:
    """Saved selection with a name."""

    name: str
    mask: Bool[Tensor, " n"]
    visible: bool = True
    """False to hide the Gaussians of the layer."""


@dataclass(frozen=True, eq=False)
class Addition:
    """Gaussians that an object contributed to the selection when it was selected or added."""

    text: str
    """Prompt of the object, or `BY_HAND`."""
    mask: Bool[Tensor, " n"]


BY_HAND = "selected by hand"
"""Text of objects that no prompt found."""


@dataclass(frozen=True, eq=False)
class State:
    """Immutable state of one user's view, without the camera; its masks are never modified.

    The selection contains the Gaussians that the prompts select (none if `prompts_select` is False) and those in
    `added`. Gaussians in `removed` are then left out. Finally, the selection is grown or shrunk by `grow_steps`.
    """

    space: SelectionContext
    prompts: tuple[Prompt, ...] = ()
    """All prompts, including those with errors."""
    query: Query | None = None
    """Query of the prompts that have no errors, with the threshold and the minimum reliability."""
    shown: int | None = None
    """Index of the only prompt that selects Gaussians; None if all prompts of the query do."""
    prompts_select: bool = True
    """True if prompts select Gaussians; False if the selection was made by hand."""
    added: Bool[Tensor, " n"] | None = None
    removed: Bool[Tensor, " n"] | None = None
    additions: tuple[Addition, ...] = ()
    """Objects that were selected or added, in chronological order."""
    grow_steps: int = 0
    """Number of growing steps over the neighbor graph; a negative number shrinks the selection."""
    hidden: Bool[Tensor, " n"] | None = None
    """Mask of the Gaussians that the user has hidden."""
    layers: tuple[Layer, ...] = ()
    color_mode: str = "rgb"
    """Name of the color mode; each viewer defines its own names."""
    colormap: Colormap = "viridis"
    """Colormap of relevancies."""
    action: str = ""
    """Description of the action that led to this state."""

    @cached_property
    def answer(self) -> Answer | None:
        """Answer to the query; None without a query."""
        return None if self.query is None else self.space.answer(self.query)

    @cached_property
    def selection_before_resize(self) -> Bool[Tensor, " n"]:
        """Mask of the Gaussians selected by prompts or by hand, before the selection is grown or shrunk."""
        mask = self.space.empty_mask()
        if self.answer is not None and self.prompts_select:
            mask = self.answer.mask if self.shown is None else self.answer.selected[:, self.shown]
        mask = mask if self.added is None else mask | self.added
        return mask if self.removed is None else mask & ~self.removed

    @cached_property
    def selection(self) -> Bool[Tensor, " n"]:
        """Mask of the selected Gaussians, including hidden ones."""
        return self.space.grow_or_shrink(self.selection_before_resize, self.grow_steps, refined=self.refined)

    @property
    def drawn(self) -> Bool[Tensor, " n"]:
        """Mask of the Gaussians that are neither hidden nor in a hidden layer."""
        mask = ~self.space.empty_mask() if self.hidden is None else ~self.hidden
        for layer in self.layers:
            mask = mask if layer.visible else mask & ~layer.mask
        return mask

    @property
    def by_hand_suffix(self) -> str:
        """Text after the number of selected Gaussians, for selections made by hand; empty if prompts select."""
        return "" if self.prompts_select else ", by hand"

    @property
    def name(self) -> str:
        """Name for a file of the selection: the selecting prompts, or those of selected objects, or "selection"."""
        if self.query is None or not self.prompts_select:
            texts = tuple(dict.fromkeys(one.text for one in self.additions))
            return join_prompts(texts) if texts != () and BY_HAND not in texts else "selection"
        texts = self.query.texts
        return join_prompts(texts if self.shown is None else texts[self.shown : self.shown + 1])

    @property
    def refined(self) -> bool:
        """True if the query uses refined features, or if there is no query."""
        return True if self.query is None else self.query.refined

    @cached_property
    def weak_fraction(self) -> float:
        """Fraction of the selection with weak evidence; 0 if nothing is selected."""
        reliability = self.space.field.scalars.reliability[self.selection]
        return float((reliability < WEAK_RELIABILITY).float().mean()) if len(reliability) > 0 else 0.0

    @property
    def warning(self) -> str:
        """Warning if a quarter or more of the selection has weak evidence, else empty.

        `actions.remove_weak` removes the Gaussians with weak evidence.
        """
        if self.weak_fraction < 0.25:
            return ""
        return f"{self.weak_fraction:.0%} of this selection has weak evidence (R < {WEAK_RELIABILITY:g})."

    def without_caches(self) -> State:
        """Return a copy without cached results, to save memory in a history."""
        return replace(self)


T = TypeVar("T")
MAX_STATES = 100


@dataclass(frozen=True, eq=False)
class History(Generic[T]):
    """States in chronological order, and the index of the current one.

    >>> history = History.of("a").do("b").do("c").undo()
    >>> history.now, history.undo().now, history.redo().now, history.do("d").redo().now
    ('b', 'a', 'c', 'd')
    """

    states: tuple[T, ...]
    index: int = 0
    """Index of the current state."""
    key: str | None = None
    """Key of the last step, if successive steps with this key are merged."""

    compact: Callable[[T], T] = lambda state: state
    """Function applied to the current state before another becomes current, for instance `State.without_caches`."""

    @staticmethod
    def of(state: T, *, lean: Callable[[T], T] = lambda state: state) -> History[T]:
        """Return a history with a single state, and with `lean` as its function `compact`."""
        return History((state,), compact=lean)

    @property
    def now(self) -> T:
        """The current state."""
        return self.states[self.index]

    def do(self, state: T, *, key: str | None = None) -> History[T]:
        """Append a new state, make it current, and drop undone states; do nothing if the state is already current.

        Args:
            key: Key to merge successive steps, such as those of a slider drag; None to keep them separate.
        """
        if state is self.now:
            return self
        merge = key is not None and key == self.key and self.index > 0
        states = (*self._leaned[: self.index + (not merge)], state)[-MAX_STATES:]
        return History(states, len(states) - 1, key, self.compact)

    def undo(self) -> History[T]:
        """Go back to the previous state; return the same history if there is none."""
        return self.go_to(self.index - 1)

    def redo(self) -> History[T]:
        """Go forward to the next state; return the same history if there is none."""
        return self.go_to(self.index + 1)

    def go_to(self, index: int) -> History[T]:
        """Make the state with this index current; return the same history if the index is out of range."""
        if index == self.index or not 0 <= index < len(self.states):
            return self
        return replace(self, states=self._leaned, index=index, key=None)

    @property
    def _leaned(self) -> tuple[T, ...]:
        """States, with `compact` applied to the current one."""
        return (*self.states[: self.index], self.compact(self.now), *self.states[self.index + 1 :])


# Request tokens that discard stale results.


@dataclass(frozen=True, eq=False)
class RequestToken:
    """Token of one request."""

    description: str
    """Description of the request, shown while it runs."""


@dataclass
class RequestTokens:
    """Tokens of the requests of one user; a new request makes earlier ones stale. Any thread may call the methods.

    >>> turns = RequestTokens()
    >>> first, second = turns.start("Reading red"), turns.start("Reading blue")
    >>> turns.busy, turns.finish(first), turns.busy, turns.finish(second), turns.busy
    ('Reading blue', False, 'Reading blue', True, '')
    """

    _lock: Lock = field(default_factory=Lock, repr=False)
    _running: RequestToken | None = None

    def start(self, description: str) -> RequestToken:
        """Return a new token, and make all earlier tokens stale."""
        with self._lock:
            self._running = token = RequestToken(description)
            return token

    def is_current(self, token: RequestToken) -> bool:
        """Return True if the token is not stale."""
        return self._running is token

    def finish(self, token: RequestToken) -> bool:
        """End a request; return True if its token is not stale, so that its result may be used."""
        with self._lock:
            current = self._running is token
            self._running = None if current else self._running
            return current

    def cancel(self) -> bool:
        """Make the running request stale; return True if there was one."""
        with self._lock:
            running, self._running = self._running, None
            return running is not None

    @property
    def busy(self) -> str:
        """Description of the running request; empty if no request is running."""
        running = self._running
        return "" if running is None else running.description
