"""What an answer says of itself, on cubes whose relevancies are known."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
import torch

from normlift_ns.errors import InputError
from normlift_ns.options import SourceOptions
from normlift_ns.query.question import Query
from normlift_ns.query.text_encoder import encoder_settings
from normlift_ns.session import actions
from normlift_ns.session.actions import carry_threshold, diagnose_prompts, threshold_suggestion
from normlift_ns.session.prompts import build_query, encode_prompts
from normlift_ns.session.selection import SelectionContext
from normlift_ns.session.state import History, State
from tests.session.worlds import BLOCK, ray, read, rows, world


@cache
def coloured() -> SelectionContext:
    """The world with an encoder whose cosines have a threshold; that of the plain one nobody knows."""
    manifest = {**world().field.manifest, "encoder": encoder_settings(SourceOptions(encoder="color"))}
    return SelectionContext(replace(world().field, manifest=manifest), world().means)


def asked(space: SelectionContext, line: str, state: State | None = None) -> State:
    prompts, question = build_query(space.field, encode_prompts(line, read), read, negatives=())
    state = State(space) if state is None else state
    return actions.ask(state, prompts, carry_threshold(state, question))


def test_a_text_that_is_not_there_is_said_with_its_nearest_match():
    (verdict,) = diagnose_prompts(asked(coloured(), "green"))
    assert verdict.warning.startswith("green: probably not here") and "0.00" in verdict.warning
    place = verdict.nearest_position
    assert place is not None and " ".join(f"{x:.2f}" for x in place) in verdict.warning
    red, blue = diagnose_prompts(asked(coloured(), "red, blue"))
    assert [(one.warning, one.nearest_position) for one in (red, blue)] == 2 * [("", None)]
    assert red.color != blue.color
    (unknown,) = diagnose_prompts(asked(world(), "green"))
    assert "not here" not in unknown.warning  # of bare cosines of an unknown encoder nobody can tell
    state = asked(coloured(), "red")
    (verdict,) = diagnose_prompts(actions.set_threshold(state, 1.0))  # that nothing reaches
    assert verdict.warning.startswith("red: ") and verdict.warning.count("1.00") == 2
    assert "Use suggested" in verdict.warning and verdict.nearest_position is not None
    (verdict,) = diagnose_prompts(actions.set_min_reliability(state, 1.0))  # leaves out all that match
    assert "reliability of at least 1.00. Lower" in verdict.warning and "no Gaussian is above" not in verdict.warning


def test_words_that_do_not_count_are_said() -> None:
    for encoder, prompt, known in (
        ("color", "The red", None),
        ("color", "gray", None),
        ("color", "gray wall", "gray"),
        ("color", "dark red shoes on a blue floor", "dark red, blue"),
        ("imagenet", "a red fox", None),
        ("imagenet", "blue fox", "fox"),
        ("imagenet", "not two foxes in the snow", "foxes"),
        ("open_clip", "blue fox", None),
    ):
        manifest = {**world().field.manifest, "encoder": encoder_settings(SourceOptions(encoder=encoder))}
        space = SelectionContext(replace(world().field, manifest=manifest), world().means)
        state = State(space, query=Query((prompt,), np.eye(3, dtype=np.float32)[:1]))
        assert state.answer is not None
        assert state.answer[prompt].read_as == known == state.answer.to_json()[0]["read_as"], prompt
        (verdict,) = diagnose_prompts(state)
        assert (f'read as "{known}"' in verdict.warning) == (known is not None), prompt


def test_histograms_are_of_the_prompts_that_select():
    state = asked(coloured(), "red, blue, green")
    assert [one.text for one in diagnose_prompts(state)] == ["red", "blue", "green"]
    assert [one.text for one in diagnose_prompts(state, max_prompts=2)] == ["red", "blue"]
    assert [one.text for one in diagnose_prompts(actions.show_prompt(state, 1))] == ["blue"]
    counts = diagnose_prompts(state)[0].histogram.counts
    assert counts.tolist() == [BLOCK] + 30 * [0] + [2 * BLOCK]  # one cube is blue, two are red, one has no direction
    for one in (actions.click(state, ray(0)), State(coloured())):
        assert diagnose_prompts(one) == ()


def test_the_suggested_threshold_is_that_of_the_histogram():
    state = asked(coloured(), "red, blue")
    values = np.repeat([1.0, 0, 1, 0, 1, 0], BLOCK)  # both texts in the three cubes that have a direction
    expected = np.median(values) + 0.8 * (np.quantile(values, 0.999) - np.median(values))
    assert threshold_suggestion(state) == pytest.approx(expected, abs=1e-6)
    after = actions.use_suggested_threshold(state)
    assert after.query is not None and after.query.threshold == pytest.approx(expected, abs=1e-6)
    assert actions.use_suggested_threshold(after) is after
    assert threshold_suggestion(actions.show_prompt(state, 1)) == pytest.approx(0.8, abs=1e-6)
    assert threshold_suggestion(State(coloured())) is None
    with pytest.raises(InputError, match="threshold"):
        actions.use_suggested_threshold(State(coloured()))


def test_a_suggested_threshold_gives_way_to_the_person():
    state = asked(world(), "blue")
    assert state.query is not None and state.answer is not None
    assert not state.query.suggest_threshold
    assert state.query.threshold == state.answer.question.threshold == pytest.approx(0.6, abs=1e-6)
    again = asked(world(), "blue")  # the space remembers the relevancies, and suggests all the same
    assert again.query is not None and again.query.threshold == state.query.threshold
    moved = actions.set_threshold(state, 0.3)
    assert moved.answer is not None and moved.answer.question.threshold == 0.3
    assert History.of(state).do(moved).undo().now.answer.question.threshold == state.query.threshold
    for before, threshold in ((state, 0.6), (moved, 0.3)):  # two of three cubes are red, and are selected
        red = asked(world(), "red", before)
        assert red.query is not None and red.query.threshold == pytest.approx(threshold, abs=1e-6)
        assert torch.equal(red.selection, rows(0, 2))


def test_the_threshold_stays_only_where_the_rule_does():
    state = actions.set_threshold(asked(coloured(), "red"), 0.75)
    after = asked(coloured(), "blue", state)
    assert after.query is not None and after.query.threshold == 0.75
    other = carry_threshold(state, replace(after.query, rule="margin", threshold=0.02))
    assert other.threshold == 0.02
    prompts = encode_prompts("like click 1", read, {"like click 1": [1, 0, 0]})
    click = actions.ask(state, *build_query(coloured().field, prompts, read))
    assert click.query is not None
    assert carry_threshold(state, click.query).threshold == click.query.threshold == pytest.approx(0.8, abs=1e-6)
