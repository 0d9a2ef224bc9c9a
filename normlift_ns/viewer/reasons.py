"""Why something is selected, as a panel shows it: the photographs that voted, and those that disagree most."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from threading import Lock

import torch
from jaxtyping import Bool
from torch import Tensor

from normlift_ns.errors import InputError
from normlift_ns.insight.why import ViewVote
from normlift_ns.runs.votes import Votes
from normlift_ns.session.state import State
from normlift_ns.session.turns import Turn, Turns
from normlift_ns.viewer.drawing import photograph_mdx
from normlift_ns.viewer.legend import clipped
from normlift_ns.viewer.status import as_text

SHOWN = 3
"""Photographs that weigh most, and as many that disagree most."""
_BUSY = "Looking for the photographs that voted."
_one_at_a_time = Lock()
"""Votes read files and keep tables; two threads would do both twice."""


def reasons_mdx(votes: Votes, selected: Bool[Tensor, " n"], *, refined: bool = True) -> str:
    """How far the photographs agree, in words, and the photographs with the regions that voted for a selection.

    Where they cannot be shown, as those of features that were given from Python, a sentence says why.

    Raises:
        ValueError: nothing is selected; what the cache no longer holds.
        FileNotFoundError: a photograph that is needed to count the votes is gone.
    """
    why = votes.explain(selected.cpu(), refined=refined)
    most, different = why.views[:SHOWN], why.most_different[:SHOWN]
    shown, problem = {}, ""
    try:
        for picture in votes.pictures(dict.fromkeys((*most, *different))):
            shown[picture.vote.view] = photograph_mdx(picture.image)
    except (InputError, OSError) as error:
        problem = f"The photographs cannot be shown: {error}"
    lines = [as_text(why.sentence), *filter(None, [as_text(clipped(problem, 400))])]
    for title, some in (("These weigh most:", most), ("These disagree most:", different)):
        if len(some) > 0:
            lines += [f"**{title}**", *_listed(some, votes.names, shown)]
    return "\n\n".join(lines)


def _listed(some: Sequence[ViewVote], names: Sequence[str], shown: dict[int, str]) -> list[str]:
    """Each photograph with its numbers, and its picture where it was not shown before."""
    lines = []
    for vote in some:
        regions = "1 region" if len(vote.regions) == 1 else f"{len(vote.regions)} regions"
        facts = f"{vote.share:.0%} of the weight ({vote.weight:,.0f} pixels, {regions}), cosine {vote.agreement:.2f}"
        if vote.disagreement >= 0.005:
            facts += f", {vote.disagreement:.0%} of the disagreement"
        lines.append(f"{as_text(clipped(names[vote.view], 60))}: {as_text(facts)}")
        lines += filter(None, [shown.pop(vote.view, "")])
    return lines


class Reasons:
    """What one person is told; what belongs to a selection before is dropped.

    Args:
        votes: of the run; opened when they are first wanted.
    """

    def __init__(self, votes: Callable[[], Votes]) -> None:
        self._votes, self._turns = votes, Turns()
        self._of: Bool[Tensor, " n"] | None = None
        self.content = ""
        """As MDX; empty: nobody asked why."""

    @property
    def busy(self) -> str:
        """What runs, in words; empty: nothing."""
        return self._turns.busy

    def start(self, state: State) -> Turn:
        """A ticket to `find` the reasons of a selection; those before are dropped."""
        self._of, self.content = state.selection, ""
        return self._turns.start(_BUSY)

    def find(self, turn: Turn, state: State) -> None:
        """Looks for the reasons of a selection, which can take seconds: to be called without a lock, in any thread.

        Raises:
            ValueError, FileNotFoundError: as `reasons_mdx`, unless nobody waits for them any more.
        """
        found = ""
        try:
            with _one_at_a_time:
                if self._turns.wanted(turn):
                    found = reasons_mdx(self._votes(), state.selection, refined=state.refined)
        except Exception:
            if self._turns.finish(turn):
                raise
        if self._turns.finish(turn):
            self.content = found

    def follow(self, state: State) -> None:
        """Forgets the reasons of another selection than that of this state."""
        if self._of is not None and not torch.equal(self._of, state.selection):
            self.forget()

    def forget(self) -> None:
        """Drops what is shown and what runs."""
        self._turns.cancel()
        self._of, self.content = None, ""
