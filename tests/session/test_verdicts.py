"""What an answer says of itself, on cubes whose relevancies are known."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
import torch

from normlift_ns.errors import InputError
from normlift_ns.options import SourceOptions
from normlift_ns.query.text_encoder import ENCODER_KEYS
from normlift_ns.session import actions
from normlift_ns.session.actions import carry_threshold, diagnose_prompts, threshold_suggestion
from normlift_ns.session.prompts import build_query, encode_prompts
from normlift_ns.session.selection import SelectionContext
from normlift_ns.session.state import History, State
from tests.session.worlds import BLOCK, ray, read, rows, world


@cache
def coloured() -> SelectionContext:
    """The world with an encoder whose cosines have a threshold; that of the plain one nobody knows."""
    encoder = {key: getattr(SourceOptions(encoder="colour"), key) for key in ENCODER_KEYS}
    return SelectionContext(
        replace(world().field, manifest={**world().field.manifest, "encoder": encoder}), world().means
    )


def asked(space: SelectionContext, line: str, state: State | None = None) -> State:
    prompts, question = build_query(space.field, encode_prompts(line, read), read, negatives=())
    state = State(space) if state is None else state
    return actions.ask(state, prompts, carry_threshold(state, question))


def test_a_text_that_is_not_there_is_said_with_its_nearest_match():
    (verdict,) = diagnose_prompts(asked(coloured(), "green"))
    assert verdict.words.startswith("green: ") and "0.00" in verdict.words and "0.9 " in verdict.words
    place = verdict.nearest
    assert place is not None and " ".join(f"{x:.2f}" for x in place) in verdict.words
    red, blue = diagnose_prompts(asked(coloured(), "red, blue"))
    assert [(one.words, one.nearest) for one in (red, blue)] == 2 * [("", None)]
    assert red.colour != blue.colour
    (unknown,) = diagnose_prompts(asked(world(), "green"))
    assert unknown.words == ""  # of bare cosines of an unknown encoder nobody can tell
    state = asked(coloured(), "red")
    (verdict,) = diagnose_prompts(actions.set_threshold(state, 1.0))  # that nothing reaches
    assert verdict.words.startswith("red: ") and verdict.words.count("1.00") == 2
    assert "Suggested" in verdict.words and verdict.nearest is not None


def test_histograms_are_of_the_prompts_that_select():
    state = asked(coloured(), "red, blue, green")
    assert [one.text for one in diagnose_prompts(state)] == ["red", "blue", "green"]
    assert [one.text for one in diagnose_prompts(state, most=2)] == ["red", "blue"]
    assert [one.text for one in diagnose_prompts(actions.show_prompt(state, 1))] == ["blue"]
    counts = diagnose_prompts(state)[0].histogram.counts
    assert counts.tolist() == [BLOCK] + 30 * [0] + [2 * BLOCK]  # one cube is blue, two are red, one has no direction
    for one in (actions.click(state, ray(0)), State(coloured())):
        assert diagnose_prompts(one) == ()


def test_the_suggested_threshold_is_that_of_the_histogram():
    state = asked(coloured(), "red, blue")
    values = np.repeat([1.0, 0, 1, 0, 1, 0], BLOCK)  # both texts in the three cubes that have a direction
    expected = np.median(values) + 0.6 * (np.quantile(values, 0.999) - np.median(values))
    assert threshold_suggestion(state) == pytest.approx(expected, abs=1e-6)
    after = actions.use_suggested_threshold(state)
    assert after.question is not None and after.question.threshold == pytest.approx(expected, abs=1e-6)
    assert actions.use_suggested_threshold(after) is after
    assert threshold_suggestion(actions.show_prompt(state, 1)) == pytest.approx(0.6, abs=1e-6)
    assert threshold_suggestion(State(coloured())) is None
    with pytest.raises(InputError, match="threshold"):
        actions.use_suggested_threshold(State(coloured()))


def test_a_suggested_threshold_gives_way_to_the_person():
    state = asked(world(), "blue")
    assert state.question is not None and state.answer is not None
    assert not state.question.suggest
    assert state.question.threshold == state.answer.question.threshold == pytest.approx(0.6, abs=1e-6)
    again = asked(world(), "blue")  # the space remembers the relevancies, and suggests all the same
    assert again.question is not None and again.question.threshold == state.question.threshold
    moved = actions.set_threshold(state, 0.3)
    assert moved.answer is not None and moved.answer.question.threshold == 0.3
    assert History.of(state).do(moved).undo().now.answer.question.threshold == state.question.threshold
    for before, threshold in ((state, 0.6), (moved, 0.3)):  # two of three cubes are red, and are selected
        red = asked(world(), "red", before)
        assert red.question is not None and red.question.threshold == pytest.approx(threshold, abs=1e-6)
        assert torch.equal(red.selection, rows(0, 2))


def test_the_threshold_stays_only_where_the_rule_does():
    state = actions.set_threshold(asked(coloured(), "red"), 0.8)
    after = asked(coloured(), "blue", state)
    assert after.question is not None and after.question.threshold == 0.8
    other = carry_threshold(state, replace(after.question, rule="margin", threshold=0.02))
    assert other.threshold == 0.02
    prompts = encode_prompts("like click 1", read, {"like click 1": [1, 0, 0]})
    click = actions.ask(state, *build_query(coloured().field, prompts, read))
    assert click.question is not None
    assert carry_threshold(state, click.question).threshold == click.question.threshold == 0.9
