"""Selecting, hiding and taking back, on cubes whose answers are known."""

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from normlift_ns.errors import InputError
from normlift_ns.session import actions
from normlift_ns.session.found import found_objects
from normlift_ns.session.history import MOST_STATES, History
from normlift_ns.session.prompts import Prompt, click_name, pose, read_prompts
from normlift_ns.session.space import Box
from normlift_ns.session.state import State
from normlift_ns.session.turns import Turns
from normlift_ns.session.viewpoint import viewpoint
from tests.session.worlds import BLOCK, cubes, ray, read, rows

SPACE = cubes()


def asked(line: str, state: State | None = None) -> State:
    prompts, question = pose(SPACE.field, read_prompts(line, read), read, negatives=())
    return actions.ask(State(SPACE) if state is None else state, prompts, question)


def same(one: torch.Tensor, other: torch.Tensor) -> bool:
    return torch.equal(one, other)


def test_prompts_select_and_hides_add_up_over_questions():
    state = asked("red, zebra, blue")
    assert same(state.selection, rows(0, 1, 2))
    assert same(actions.show(state, 1).selection, rows(1))
    state = actions.hide(actions.show(state, 1))
    state = actions.hide(actions.click(asked("red", state), ray(0)))
    assert same(state.drawn, rows(2, 3))
    assert same(actions.show_all(state).drawn, rows(0, 1, 2, 3))
    assert same(actions.only(asked("red", state)).drawn, rows(0, 2))
    with pytest.raises(InputError, match="blank"):
        actions.only(asked("green"))
    with pytest.raises(InputError, match="nothing to hide"):
        actions.hide(State(SPACE))


def test_a_click_selects_the_connected_object_adds_and_takes_away():
    state = asked("red")
    assert same(actions.click(state, ray(0)).selection, rows(0))
    assert same(actions.click(state, ray(BLOCK), "add").selection, rows(0, 1, 2))
    assert same(actions.click(state, ray(0), "take away").selection, rows(2))
    alone = actions.click(State(SPACE), ray(2 * BLOCK + 5))
    assert same(alone.selection, rows(2))
    both = actions.click(actions.click(alone, ray(BLOCK), "add"), ray(2 * BLOCK), "take away")
    assert same(both.selection, rows(1))
    assert same(actions.add(actions.take_away(state, rows(0)), rows(0)).selection, rows(0, 2))
    with pytest.raises(InputError, match="nothing with semantics"):
        actions.click(state, ray(3 * BLOCK))
    with pytest.raises(InputError, match="nothing with semantics"):
        actions.click(actions.hide(actions.click(state, ray(0))), ray(0))


def test_the_thresholds_go_on_after_a_click_that_adds():
    state = actions.click(asked("red"), ray(BLOCK), "add")
    assert same(actions.threshold(state, 1.5).selection, rows(1))
    assert state.question is not None
    assert actions.threshold(state, state.question.threshold) is state
    sure = actions.min_reliability(asked("red"), 0.9)
    reliable = SPACE.field.scalars.reliability >= 0.9
    assert same(sure.selection, rows(0, 2) & reliable)


def test_growing_goes_from_part_to_whole_and_shrinking_to_the_core():
    part = actions.select(State(SPACE), ray(21).bool())
    assert same(actions.resize(part, 1).selection, rows(0))
    assert same(actions.resize(part, 10).selection, rows(0))  # the other red cube is too far
    whole = actions.select(State(SPACE), rows(0))
    cores = [int(actions.resize(whole, -steps).selection.sum()) for steps in range(11)]
    assert cores == sorted(cores, reverse=True)
    assert BLOCK > cores[5] > cores[10] >= 1
    two = actions.resize(actions.select(State(SPACE), rows(0, 2)), -10).selection
    assert bool((two & rows(0)).any())
    assert bool((two & rows(2)).any())
    assert actions.resize(whole, 0) is whole
    assert actions.resize(whole, 99).steps == 10
    assert same(actions.resize(State(SPACE), 3).selection, SPACE.none())


@settings(deadline=None, max_examples=30)
@given(st.sets(st.integers(0, 4 * BLOCK - 1), min_size=1, max_size=20), st.integers(-10, 9))
def test_every_step_of_growth_holds_the_one_before(chosen, steps):
    selected = torch.zeros(4 * BLOCK, dtype=torch.bool)
    selected[list(chosen)] = True
    less, more = SPACE.resized(selected, steps), SPACE.resized(selected, steps + 1)
    assert not bool((less & ~more).any())
    assert steps < 0 or not bool((selected & ~more).any())


def test_a_box_cuts_inside_outside_and_turned():
    state = asked("red")
    box = Box((1.5, 1.5, 1.5), (10, 10, 10))
    assert same(actions.cut(state, box).selection, rows(0))
    assert same(actions.cut(state, Box(box.centre, box.size, keeps_inside=False)).selection, rows(2))
    assert same(actions.cut(actions.cut(state, box), None).selection, state.selection)
    half = 0.5**0.5
    turned = Box((1, 2, 3), (2, 4, 6), (0.5, 0.1, -0.7, 0.2))
    inside = torch.from_numpy(np.array(turned.centre) + 0.999 * (turned.corners - turned.centre))
    outside = torch.from_numpy(np.array(turned.centre) + 1.001 * (turned.corners - turned.centre))
    assert bool(turned.kept(inside).all())
    assert not bool(turned.kept(outside).any())
    turned = Box((101.5, 1.5, 1.5), (10, 300, 10), (half, 0, 0, half))  # y of the box is x of the world
    assert same(turned.kept(SPACE.means), rows(0, 1, 2))


@settings(deadline=None, max_examples=40)
@given(st.lists(st.integers(0, 9), max_size=25))
def test_everything_is_undone_and_done_again(choices):
    deeds = [
        lambda s: asked("red", s),
        lambda s: asked("blue, zebra", s),
        lambda s: actions.click(s, ray(0), "add"),
        lambda s: actions.click(s, ray(BLOCK), "take away"),
        actions.hide,
        actions.show_all,
        lambda s: actions.threshold(s, 0.95),
        lambda s: actions.resize(s, 1),
        lambda s: actions.cut(s, Box((0, 0, 0), (50, 50, 50))),
        actions.clear,
    ]
    history, seen = History.of(State(SPACE), lean=State.lean), [(SPACE.none(), ~SPACE.none())]
    for choice in choices:
        try:
            after = deeds[choice](history.now)
        except InputError:
            continue
        if after is not history.now:
            history = history.do(after)
            seen.append((after.selection, after.drawn))
    for expected in reversed(seen):
        assert all(map(same, (history.now.selection, history.now.drawn), expected))
        history = history.undo()
    assert not history.can_undo
    for expected in seen:
        assert all(map(same, (history.now.selection, history.now.drawn), expected))
        history = history.redo()
    assert not history.can_redo


@given(st.lists(st.one_of(st.integers(0, 9), st.sampled_from(["undo", "redo"]))))
def test_a_history_is_a_list_with_a_place_in_it(steps):
    history, states, at = History.of(-1), [-1], 0
    for step in steps:
        if isinstance(step, str):
            at = min(max(at + (1 if step == "redo" else -1), 0), len(states) - 1)
            history = history.undo() if step == "undo" else history.redo()
        elif step != states[at]:
            states, at = [*states[: at + 1], step], at + 1
            history = history.do(step)
        assert (list(history.states), history.now) == (states, states[at])


def test_steps_of_a_slider_are_one_and_old_states_go():
    history = History.of(0)
    for value in range(1, 5):
        history = history.do(value * 1000, key="threshold")
    assert history.states == (0, 4000)
    assert history.undo().redo().do(5000, key="threshold").states == (0, 4000, 5000)
    for value in range(2 * MOST_STATES):
        history = history.do(value)
    assert len(history.states) == MOST_STATES
    assert history.now == 2 * MOST_STATES - 1


def test_states_that_are_not_shown_hold_no_masks_of_their_own():
    history = History.of(asked("red"), lean=State.lean)
    _ = history.now.selection
    history = history.do(actions.clear(history.now))
    assert "selection" not in vars(history.states[0])
    assert same(history.undo().now.selection, rows(0, 2))


def test_objects_are_listed_with_what_their_buttons_need():
    found = found_objects(asked("red, blue, green"))
    assert [(row.name, row.size) for row in found.objects] == [("red 1", 64), ("red 2", 64), ("blue 1", 64)]
    assert (found.left_out, found.in_smaller_parts) == (0, 0)
    first = found.objects[0]
    assert first.centre == pytest.approx((1.5, 1.5, 1.5))
    assert first.colour[0] > 0.8 > first.colour[2]
    assert "evidenced (R" in first.evidence
    state = actions.hide(asked("red"), first.mask)
    assert [row.size for row in found_objects(state).objects] == [64]
    few = found_objects(asked("red, blue"), most=2)
    assert [row.name for row in few.objects] == ["red 1", "blue 1"]
    assert few.left_out == 1
    assert found_objects(asked("red"), min_size=65).in_smaller_parts == 128
    by_hand = found_objects(actions.click(asked("red"), ray(0)))
    assert [row.name for row in by_hand.objects] == ["selected by hand 1"]
    place = viewpoint(first, (1.5, 1.5, 500.0))
    assert place[:2] == pytest.approx((1.5, 1.5))
    assert 1.5 + first.extent < place[2] < 100


def test_poor_evidence_is_told_and_left_out():
    state = asked("red, blue")
    poor = SPACE.field.scalars.reliability < 0.6
    share = float((poor & rows(0, 1, 2)).sum() / (3 * BLOCK))
    assert state.poor == pytest.approx(share)
    assert share > 0.25
    assert state.remark.startswith(f"{share:.0%} of this selection is poorly evidenced")
    sure = actions.leave_out_poor(state)
    assert (sure.poor, sure.remark) == (0.0, "")
    assert same(sure.selection, rows(0, 1, 2) & ~poor)


def test_a_click_becomes_a_prompt():
    vector = actions.click_vector(asked("red"), ray(BLOCK + 1))
    prompts, question = pose(SPACE.field, [Prompt(click_name(1), vector)], read)
    assert same(actions.ask(State(SPACE), prompts, question).selection, rows(1))


def test_late_answers_do_not_count():
    turns = Turns()
    first = turns.start("one")
    second = turns.start("two")
    assert not turns.finish(first)
    assert turns.busy == "two"
    assert turns.cancel()
    assert not turns.finish(second)
    assert not turns.cancel()
    assert turns.busy == ""


def test_a_file_is_called_after_what_selects_and_what_is_selected_by_hand_says_so():
    state = asked("red, zebra, blue")
    assert (state.name, state.by_hand) == ("red, blue", "")
    assert actions.show(state, 1).name == "blue"
    floating = actions.select_floaters(state, rows(3))
    assert (floating.name, floating.by_hand) == ("selection", ", by hand")
    assert State(SPACE).name == "selection"


@pytest.mark.parametrize(("typed", "kept"), [(99.0, 1.0), (-5.0, -0.2), (0.3, 0.3)])
def test_numbers_beyond_a_slider_become_its_end(typed, kept):
    state = asked("red")
    assert actions.threshold(state, typed).question.threshold == kept
    assert actions.min_reliability(state, typed).question.min_reliability == max(0.0, kept)
