"""Selecting, hiding and taking back, on cubes whose answers are known."""

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from normlift_ns.errors import InputError
from normlift_ns.session import actions
from normlift_ns.session.objects import list_objects
from normlift_ns.session.prompts import Prompt, build_query, click_name, encode_prompts
from normlift_ns.session.state import MAX_STATES, History, State
from tests.session.worlds import BLOCK, ray, read, rows, world


def asked(line: str, state: State | None = None) -> State:
    prompts, question = build_query(world().field, encode_prompts(line, read), read, negatives=())
    return actions.ask(State(world()) if state is None else state, prompts, question)


def chosen(state: State, *cubes: int) -> bool:
    return torch.equal(state.selection, rows(*cubes))


def test_prompts_select_and_hides_add_up_over_questions():
    state = asked("red, zebra, blue")
    assert chosen(state, 0, 1, 2)
    assert chosen(actions.show_prompt(state, 1), 1)
    for nothing in (2, -1):
        assert actions.show_prompt(state, nothing) is state
    assert chosen(actions.show_prompt(actions.show_prompt(state, 1), None), 0, 1, 2)
    state = actions.hide(actions.show_prompt(state, 1))
    state = actions.hide(actions.click(asked("red", state), ray(0)))
    assert torch.equal(state.drawn, rows(2, 3))
    assert torch.equal(actions.show_all(state).drawn, rows(0, 1, 2, 3))
    assert torch.equal(actions.show_only(asked("red", state)).drawn, rows(0, 2))
    assert torch.equal(actions.clear(state).drawn, state.drawn) and chosen(actions.clear(state))
    for wrong, hint in (
        (lambda: actions.show_only(asked("green")), "selected"),
        (lambda: actions.hide(State(world())), "hide"),
    ):
        with pytest.raises(InputError, match=hint):
            wrong()


def test_layers_are_replaced_by_name_and_limited_in_number():
    state = asked("red")
    for number in (*range(actions.MAX_LAYERS), 5):
        state = actions.add_layer(state, f"layer {number}")
    assert len(state.layers) == actions.MAX_LAYERS and state.layers[-1].name == "layer 5"
    with pytest.raises(InputError, match=str(actions.MAX_LAYERS)):
        actions.add_layer(state, "one more")


def test_a_click_selects_the_connected_object_adds_and_takes_away():
    state = asked("red")
    assert chosen(actions.click(state, ray(0)), 0)
    assert chosen(actions.click(state, ray(BLOCK), "add"), 0, 1, 2)
    assert chosen(actions.click(state, ray(0), "remove"), 2)
    alone = actions.click(State(world()), ray(2 * BLOCK + 5))
    assert chosen(alone, 2)
    both = actions.click(actions.click(alone, ray(BLOCK), "add"), ray(2 * BLOCK), "remove")
    assert chosen(both, 1)
    assert chosen(actions.add(actions.remove(state, rows(0)), rows(0)), 0, 2)
    for blind, gaussian in ((state, 3 * BLOCK), (actions.hide(actions.click(state, ray(0))), 0)):
        with pytest.raises(InputError, match="position"):  # without a direction, or hidden
            actions.click(blind, ray(gaussian))
    like = Prompt(click_name(1), actions.picked_direction(state, ray(BLOCK + 1)))
    assert chosen(actions.ask(State(world()), *build_query(world().field, [like], read)), 1)


def test_the_thresholds_go_on_after_a_click_that_adds_and_stay_within_their_sliders():
    state = actions.click(asked("red"), ray(BLOCK), "add")
    assert chosen(actions.set_threshold(state, 1.5), 1)
    assert actions.set_threshold(state, state.query.threshold) is state
    sure = rows(0, 2) & (world().field.scalars.reliability >= 0.9)
    assert torch.equal(actions.set_min_reliability(asked("red"), 0.9).selection, sure)
    for typed, threshold, reliability in ((99.0, 1.0, 1.0), (-5.0, -0.2, 0.0), (0.3, 0.3, 0.3)):
        assert actions.set_threshold(state, typed).query.threshold == threshold
        assert actions.set_min_reliability(state, typed).query.min_reliability == reliability
    for act in (actions.set_threshold, actions.set_min_reliability):  # nothing is asked
        assert act(empty := State(world()), 0.3) is empty


def test_growing_goes_from_part_to_whole_and_shrinking_to_the_core():
    part = actions.select(State(world()), ray(21).bool())
    assert chosen(actions.resize(part, 1), 0)
    assert chosen(actions.resize(part, 10), 0)  # the other red cube is too far
    whole = actions.select(State(world()), rows(0))
    cores = [int(actions.resize(whole, -steps).selection.sum()) for steps in range(11)]
    assert cores == sorted(cores, reverse=True)
    assert BLOCK > cores[5] > cores[10] >= 1
    two = actions.resize(actions.select(State(world()), rows(0, 2)), -10)
    assert bool((two.selection & rows(0)).any()) and bool((two.selection & rows(2)).any())
    assert actions.resize(whole, 0) is whole
    assert (actions.resize(whole, 99).grow_steps, actions.resize(whole, -99).grow_steps) == (10, -10)
    assert chosen(actions.resize(State(world()), 3))
    shrunk = actions.resize(whole, -5)  # what is added or taken away then is so from what is left
    assert torch.equal(actions.add(shrunk, rows(1)).selection, shrunk.selection | rows(1))
    assert chosen(actions.remove(shrunk, shrunk.selection))


@given(st.sets(st.integers(0, 4 * BLOCK - 1), min_size=1, max_size=20), st.integers(-10, 9))
def test_every_step_of_growth_holds_the_one_before(some, steps):
    selected = torch.zeros(4 * BLOCK, dtype=torch.bool)
    selected[list(some)] = True
    less, more = world().grow_or_shrink(selected, steps), world().grow_or_shrink(selected, steps + 1)
    assert not bool((less & ~more).any())
    assert steps < 0 or not bool((selected & ~more).any())


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


def test_steps_of_a_slider_are_one_and_old_states_go_and_hold_no_masks():
    history = History.of(0)
    for value in range(1, 5):
        history = history.do(value * 1000, key="threshold")
    assert history.states == (0, 4000)
    assert history.do(1, key="another").states == (0, 4000, 1)
    assert history.undo().redo().do(5000, key="threshold").states == (0, 4000, 5000)
    for value in range(2 * MAX_STATES):
        history = history.do(value)
    assert (len(history.states), history.now) == (MAX_STATES, 2 * MAX_STATES - 1)
    history = History.of(asked("red"), lean=State.without_caches)
    _ = history.now.selection
    history = history.do(actions.clear(history.now))
    assert "selection" not in vars(history.states[0])
    assert chosen(history.undo().now, 0, 2)


def test_objects_are_listed_with_what_their_buttons_need():
    found = list_objects(asked("red, blue, green"))
    assert [(row.name, row.size) for row in found.objects] == [("red 1", 64), ("red 2", 64), ("blue 1", 64)]
    assert (found.left_out, found.in_smaller_parts) == (0, 0)
    first, blue = found.objects[0], found.objects[2]
    assert first.center == pytest.approx((1.5, 1.5, 1.5))
    assert first.extent == pytest.approx(np.linalg.norm(3 * [3 * 1.0]), rel=0.1)  # of the cube
    assert first.color[0] > 0.8 > first.color[2]
    assert (first.mean_views, blue.mean_views) == pytest.approx((2.0, 1.0))
    for row in (first, blue):
        grade = "strong" if row.reliability >= 0.8 else "fair" if row.reliability >= 0.6 else "weak"
        assert row.evidence.startswith(grade) and f"{row.reliability:.2f}" in row.evidence
    assert [row.size for row in list_objects(actions.hide(asked("red"), first.mask)).objects] == [64]
    few = list_objects(asked("red, blue"), max_objects=2)
    assert ([row.name for row in few.objects], few.left_out) == (["red 1", "blue 1"], 1)
    assert list_objects(asked("red"), min_gaussians=65).in_smaller_parts == 128
    assert [row.name for row in list_objects(actions.show_prompt(asked("red, blue"), 1)).objects] == ["blue 1"]
    by_hand = list_objects(actions.click(asked("red"), ray(0)))
    assert [row.name for row in by_hand.objects] == ["selected by hand 1"]


def test_an_object_of_the_list_stays_one_object_with_its_name():
    state, both = asked("red, blue"), rows(0, 1)  # two cubes, which are two components
    one = actions.change_objects(state, both, "select", "red")
    assert [(row.name, row.size) for row in list_objects(one).objects] == [("red 1", 2 * BLOCK)]
    assert one.name == "red" and torch.equal(one.selection, both)
    more = actions.click(actions.click(one, ray(0), "add"), ray(2 * BLOCK), "add")
    assert [row.name for row in list_objects(more).objects] == ["red 1", "selected by hand 1"]
    assert more.name == "selection" and not more.prompts_select
    part = actions.change_objects(more, rows(0), "remove", "red")
    assert [row.name for row in list_objects(part).objects] == ["red 1", "selected by hand 1"]
    assert [row.size for row in list_objects(part).objects] == [BLOCK, BLOCK]
    back = actions.show_prompt(part, None)
    assert torch.equal(back.selection, state.selection) and back.name == state.name


def test_poor_evidence_is_told_and_left_out():
    state = asked("red, blue")
    poor = world().field.scalars.reliability < 0.6
    share = float((poor & rows(0, 1, 2)).sum() / (3 * BLOCK))
    assert state.weak_fraction == pytest.approx(share) and share > 0.25
    assert state.warning.startswith(f"{share:.0%} ")
    sure = actions.remove_weak(state)
    assert (sure.weak_fraction, sure.warning) == (0.0, "")
    assert torch.equal(sure.selection, rows(0, 1, 2) & ~poor)
    few = poor & rows(0, 1, 2)  # 20 % of what is selected
    few = actions.select(state, (few & (few.cumsum(0) <= 16)) | (~poor & rows(0, 1, 2)))
    assert 0 < few.weak_fraction < 0.25 and few.warning == ""


def test_a_file_is_called_after_what_selects_and_what_is_selected_by_hand_says_so():
    state = asked("red, zebra, blue")
    floating = actions.select_floaters(state, rows(3))
    assert chosen(floating, 3)
    for one, name, by_hand in (
        (state, "red, blue", ""), (actions.show_prompt(state, 1), "blue", ""), (floating, "selection", ", by hand"),
        (State(world()), "selection", ""),
    ):  # fmt: skip
        assert (one.name, one.by_hand_suffix) == (name, by_hand)
    with pytest.raises(InputError, match="floaters"):
        actions.select_floaters(state, rows())
