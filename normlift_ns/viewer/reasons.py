"""Explanation of a selection for a panel: the training images that voted for it, and those that disagree most."""

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
"""Number of images shown with the largest weight, and of those shown with the largest disagreement."""
_BUSY = "Looking for the training images that voted."
_explain_lock = Lock()
"""Held while votes are read and cached, so that two threads do not do both twice."""


def reasons_mdx(votes: Votes, selected: Bool[Tensor, " n"], *, refined: bool = True) -> str:
    """Return the agreement of the images in words, and the images with the regions that voted for a selection.

    If the images cannot be shown, for instance because features were passed from Python, a sentence gives the reason.

    Raises:
        ValueError: nothing is selected, or the cache lacks the votes.
        FileNotFoundError: an image needed to count the votes is missing.
    """
    why = votes.explain(selected.cpu(), refined=refined)
    heaviest, different = why.views[:SHOWN], why.most_different[:SHOWN]
    images, problem = {}, ""
    try:
        for picture in votes.pictures(dict.fromkeys((*heaviest, *different))):
            images[picture.vote.view] = photograph_mdx(picture.image)
    except (InputError, OSError) as error:
        problem = f"The images cannot be shown: {error}"
    lines = [as_text(why.sentence), *filter(None, [as_text(clipped(problem, 400))])]
    for title, view_votes in (("Images that weigh most:", heaviest), ("Images that disagree most:", different)):
        if len(view_votes) > 0:
            lines += [f"**{title}**", *_list_votes(view_votes, votes.names, images)]
    return "\n\n".join(lines)


def _list_votes(votes: Sequence[ViewVote], names: Sequence[str], images: dict[int, str]) -> list[str]:
    """List each view with its numbers, and with its image at the first mention."""
    lines = []
    for vote in votes:
        regions = "1 region" if len(vote.regions) == 1 else f"{len(vote.regions)} regions"
        numbers = f"{vote.share:.0%} of the weight ({vote.weight:,.0f} pixels, {regions}), cosine {vote.agreement:.2f}"
        if vote.disagreement >= 0.005:
            numbers += f", {vote.disagreement:.0%} of the disagreement"
        lines.append(f"{as_text(clipped(names[vote.view], 60))}: {as_text(numbers)}")
        lines += filter(None, [images.pop(vote.view, "")])
    return lines


class Reasons:
    """Explanation shown to one user. It is dropped when the selection changes.

    Args:
        votes: returns the votes of the run; called at the first explanation.
    """

    def __init__(self, votes: Callable[[], Votes]) -> None:
        self._votes, self._turns = votes, Turns()
        self._selection: Bool[Tensor, " n"] | None = None
        self.content = ""
        """MDX of the explanation; empty if there is none."""

    @property
    def busy(self) -> str:
        """Description of the running work; empty if there is none."""
        return self._turns.busy

    def start(self, state: State) -> Turn:
        """Return a token to `find` the explanation of a selection; the previous explanation is dropped."""
        self._selection, self.content = state.selection, ""
        return self._turns.start(_BUSY)

    def find(self, token: Turn, state: State) -> None:
        """Compute the explanation of a selection. This can take seconds: call it without a lock, from any thread.

        Raises:
            ValueError, FileNotFoundError: as `reasons_mdx`, unless the request is stale.
        """
        content = ""
        try:
            with _explain_lock:
                if self._turns.wanted(token):
                    content = reasons_mdx(self._votes(), state.selection, refined=state.refined)
        except Exception:
            if self._turns.finish(token):
                raise
        if self._turns.finish(token):
            self.content = content

    def follow(self, state: State) -> None:
        """Drop the explanation if the selection of this state is another one."""
        if self._selection is not None and not torch.equal(self._selection, state.selection):
            self.forget()

    def forget(self) -> None:
        """Drop the explanation and any running computation."""
        self._turns.cancel()
        self._selection, self.content = None, ""
