"""Why something is selected, as the panels tell it."""

import html
from typing import Any

import pytest
import torch

from normlift_ns import Evidence
from normlift_ns.analysis.explain import VoteImage, explain_selection
from normlift_ns.core.evidence import Entries
from normlift_ns.errors import InputError
from normlift_ns.session import actions
from normlift_ns.session.state import State
from normlift_ns.viewer.widgets import Explanation, explanation_mdx
from tests.session.worlds import BLOCK, rows, world

NAMES = ("a/[x](y).png", "b.png", "c.png", "d.png", "e.png")


class FakeVotes:
    """Five photographs: the first cube is red in four of them and blue in the last, the second blue in all."""

    names = NAMES

    def __init__(self, problem: Exception | None = None) -> None:
        self.problem = problem
        entries = []
        for view in range(5):
            column = torch.where(torch.arange(2 * BLOCK) < BLOCK, 1 + (view == 4), 2)
            weight = torch.full((2 * BLOCK,), 5.0 - view)
            entries.append(Entries(torch.arange(2 * BLOCK), column, weight, (2,)))
        self.evidence = Evidence.from_entries(entries, 4 * BLOCK)

    def explain(self, selected: torch.Tensor, *, refined: bool = True) -> Any:
        return explain_selection(self.evidence, torch.eye(2).repeat(5, 1), selected)

    def pictures(self, votes: Any) -> Any:
        for vote in votes:
            if self.problem is not None:
                raise self.problem
            yield VoteImage(NAMES[vote.view], vote, torch.full((12, 16, 3), 40 * vote.view, dtype=torch.uint8))


def test_three_that_weigh_most_and_those_that_disagree():
    lines = explanation_mdx(FakeVotes(), rows(0))
    named = [line for line in lines.splitlines() if line.startswith("a&#47;")]
    assert len(named) == 2  # it weighs most, and disagrees a little
    assert not any(set("[]()/") & set(line) for line in named)
    most, different = html.unescape(lines).split("Most disagreement:")
    assert "Strongest support:" in most and "C_inter" in most
    assert "a/[x](y).png: 33% of the weight (320 pixels, 1 region), cosine 1.00" in most
    assert [name in most for name in NAMES] == [True, True, True, False, False]
    assert "e.png: 7% of the weight" in different and "of the disagreement" in different
    alike = explanation_mdx(FakeVotes(), rows(1))
    assert "Most disagreement" not in alike
    assert [text.count("data:image/jpeg") for text in (lines, alike)] == [4, 3]  # e.png too, and each once
    for problem in (InputError("they were given from Python"), FileNotFoundError("b.png is missing")):
        text = html.unescape(explanation_mdx(FakeVotes(problem), rows(0)))
        assert f": {problem}" in text and "33% of the weight" in text and "data:image" not in text


def test_reasons_belong_to_their_selection():
    reasons = Explanation(FakeVotes)  # type: ignore[arg-type]
    with pytest.raises(InputError, match="nothing is selected"):
        reasons.compute(reasons.start(State(world())), State(world()))
    assert (reasons.content, reasons.busy) == ("", "")
    state = actions.select(State(world()), rows(0))
    reasons.compute(reasons.start(state), state)
    assert "Strongest support" in reasons.content
    reasons.update(actions.hide(state))  # the selection is the same
    assert reasons.content != ""
    reasons.update(actions.select(state, rows(1)))
    assert reasons.content == ""


@pytest.mark.parametrize("fails", [False, True])
def test_a_late_answer_is_dropped_and_so_is_its_error(fails):
    state = actions.select(State(world()), rows(0))

    class Slow(FakeVotes):
        def explain(self, selected: torch.Tensor, *, refined: bool = True) -> Any:
            assert reasons.busy
            reasons.update(actions.select(state, rows(1)))  # meanwhile
            if fails:
                raise InputError("too late to be told")
            return super().explain(selected, refined=refined)

    reasons = Explanation(Slow)  # type: ignore[arg-type]
    reasons.compute(reasons.start(state), state)
    assert (reasons.content, reasons.busy) == ("", "")
