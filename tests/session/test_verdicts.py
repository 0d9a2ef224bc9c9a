"""What an answer says of itself, on cubes whose relevancies are known."""

from dataclasses import replace

import numpy as np
import pytest

from normlift_ns.errors import InputError
from normlift_ns.options import SourceOptions
from normlift_ns.session import actions
from normlift_ns.session.history import History
from normlift_ns.session.prompts import pose, read_prompts
from normlift_ns.session.space import Space
from normlift_ns.session.state import State
from normlift_ns.session.verdicts import carried, suggested, verdicts
from normlift_ns.text_encoders import ENCODER_KEYS
from tests.session.worlds import BLOCK, cubes, ray, read, rows

CLIP = cubes()
"""Of an encoder that nobody knows: its cosines have no threshold."""
_ENCODER = {key: getattr(SourceOptions(encoder="colour"), key) for key in ENCODER_KEYS}
COLOUR = Space(replace(CLIP.field, manifest={**CLIP.field.manifest, "encoder": _ENCODER}), CLIP.means)


def asked(space: Space, line: str, state: State | None = None, **how) -> State:
    prompts, question = pose(space.field, read_prompts(line, read), read, negatives=(), **how)
    state = State(space) if state is None else state
    return actions.ask(state, prompts, carried(state, question))


def test_a_text_that_is_not_there_is_said_with_its_nearest_match():
    (verdict,) = verdicts(asked(COLOUR, "green"))
    assert verdict.words.startswith("green: probably not in this scene. The nearest match at ")
    assert verdict.words.endswith(" has relevancy 0.00; things that are in a scene reach 0.9 or more.")
    red, blue = verdicts(asked(COLOUR, "red, blue"))
    assert (red.words, blue.words) == ("", "")
    assert red.colour != blue.colour
    (unknown,) = verdicts(asked(CLIP, "green"))
    assert unknown.words == ""  # of bare cosines of an unknown encoder nobody can tell


def test_histograms_are_of_the_prompts_that_select():
    state = asked(COLOUR, "red, blue, green")
    assert [one.text for one in verdicts(state)] == ["red", "blue", "green"]
    assert [one.text for one in verdicts(state, most=2)] == ["red", "blue"]
    assert [one.text for one in verdicts(actions.show(state, 1))] == ["blue"]
    counts = verdicts(state)[0].histogram.counts
    assert counts.tolist() == [BLOCK] + 30 * [0] + [2 * BLOCK]  # one cube is blue, two are red, one has no direction
    assert verdicts(actions.click(state, ray(0))) == ()
    assert verdicts(State(COLOUR)) == ()


def test_the_suggested_threshold_is_that_of_the_histogram():
    state = asked(COLOUR, "red, blue")
    values = np.repeat([1.0, 0, 1, 0, 1, 0], BLOCK)  # both texts in the three cubes that have a direction
    expected = np.median(values) + 0.6 * (np.quantile(values, 0.999) - np.median(values))
    assert suggested(state) == pytest.approx(expected, abs=1e-6)
    after = actions.suggest(state)
    assert after.question is not None and after.question.threshold == pytest.approx(expected, abs=1e-6)
    assert actions.suggest(after) is after
    assert suggested(actions.show(state, 1)) == pytest.approx(0.6, abs=1e-6)
    assert suggested(State(COLOUR)) is None
    with pytest.raises(InputError, match="no threshold to suggest"):
        actions.suggest(State(COLOUR))


def test_a_suggested_threshold_gives_way_to_the_person():
    state = asked(CLIP, "blue")
    assert state.question is not None and state.answer is not None
    assert not state.question.suggest
    assert state.question.threshold == state.answer.question.threshold == pytest.approx(0.6, abs=1e-6)
    again = asked(CLIP, "blue")  # the space remembers the relevancies, and suggests all the same
    assert again.question is not None and again.question.threshold == state.question.threshold
    moved = actions.threshold(state, 0.3)
    assert moved.answer is not None and moved.answer.question.threshold == 0.3
    history = History.of(state).do(moved)
    assert history.undo().now.answer.question.threshold == state.question.threshold
    red = asked(CLIP, "red", state)
    assert red.question is not None
    assert red.question.threshold == pytest.approx(0.6, abs=1e-6)  # two of three cubes are red, and are selected
    assert bool((red.selection == rows(0, 2)).all())
    kept = asked(CLIP, "red", moved)
    assert kept.question is not None and kept.question.threshold == 0.3
    assert bool((kept.selection == rows(0, 2)).all())


def test_the_threshold_stays_only_where_the_rule_does():
    state = actions.threshold(asked(COLOUR, "red"), 0.8)
    after = asked(COLOUR, "blue", state)
    assert after.question is not None and after.question.threshold == 0.8
    other = carried(state, replace(after.question, rule="margin", threshold=0.02))
    assert other.threshold == 0.02
    click = actions.ask(
        state, *pose(COLOUR.field, read_prompts("like click 1", read, {"like click 1": [1, 0, 0]}), read)
    )
    assert click.question is not None
    assert carried(state, click.question).threshold == click.question.threshold == 0.9


def test_floaters_are_a_selection_like_any_other():
    state = asked(COLOUR, "red")
    after = actions.select_floaters(state, rows(1))
    assert bool((after.selection == rows(1)).all())
    assert bool((actions.hide(after).drawn == rows(0, 2, 3)).all())
    with pytest.raises(InputError, match="no likely floaters"):
        actions.select_floaters(state, COLOUR.none())


def test_a_threshold_that_nothing_reaches_is_said_with_the_best_match():
    state = asked(COLOUR, "red")
    assert not verdicts(state)[0].words
    (verdict,) = verdicts(actions.threshold(state, 1.0))
    assert verdict.words.startswith("red: nothing is above the threshold of 1.00. The nearest match at ")
    assert verdict.words.endswith(" has relevancy 1.00; lower the threshold, or press Suggested.")
    assert verdict.nearest is not None
