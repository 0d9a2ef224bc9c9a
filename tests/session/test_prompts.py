"""Rows of prompts: what is typed, clicked and saved."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from normlift_ns.errors import InputError
from normlift_ns.session.colours import prompt_colours
from normlift_ns.session.prompts import (
    MOST_PROMPTS,
    Prompt,
    click_name,
    join_prompts,
    merged,
    pose,
    prompts_of,
    read_prompts,
    split_prompts,
)
from tests.session.worlds import cubes, read

TEXT = st.text(st.characters(exclude_categories=["Cs"]), max_size=12)


@given(st.lists(TEXT, max_size=6))
def test_joined_prompts_are_split_again(texts):
    clean = [" ".join(text.replace('"', " ").split()) for text in texts]
    assert split_prompts(join_prompts(texts)) == list(dict.fromkeys(text for text in clean if text))


@given(TEXT)
def test_splitting_is_stable(text):
    once = split_prompts(text)
    assert all(part == part.strip() != "" for part in once)
    assert len(set(once)) == len(once)


def test_an_unknown_word_marks_its_row_and_the_rest_is_answered():
    calls = []

    def counted(texts):
        calls.append(tuple(texts))
        return read(texts)

    found = read_prompts("red, zebra; blue", counted)
    assert [(prompt.text, prompt.problem) for prompt in found] == [
        ("red", ""),
        ("zebra", "text 'zebra' is unknown"),
        ("blue", ""),
    ]
    assert calls[0] == ("red", "zebra", "blue")
    prompts, question = pose(cubes().field, found, read, negatives=())
    assert prompts == found
    assert question.texts == ("red", "blue")
    np.testing.assert_array_equal(question.vectors, np.eye(3)[:2])
    with pytest.raises(InputError, match="zebra"):
        pose(cubes().field, read_prompts("zebra", read), read)


def test_what_is_wrong_with_the_line_or_the_encoder_is_an_error():
    with pytest.raises(InputError, match="Type what to look for"):
        read_prompts(" ;, \n", read)
    with pytest.raises(InputError, match="65 prompts"):
        read_prompts(",".join(map(str, range(MOST_PROMPTS + 1))), read)

    def without_weights(_):
        raise FileNotFoundError("weights are gone")

    with pytest.raises(FileNotFoundError, match="weights are gone"):
        read_prompts("red", without_weights)


def test_a_click_is_asked_again_by_its_direction():
    field, click = cubes().field, np.array([0.6, 0.8, 0], np.float32)
    known = {click_name(1): click}
    (prompt,) = read_prompts("like click 1", read, known)
    _, question = pose(field, [prompt], read)
    assert (question.rule, question.threshold, question.negatives) == ("cosine", 0.9, ())
    again = {row.text: row.vector for row in prompts_of(question)}
    (prompt,) = read_prompts(join_prompts(question.texts), read, again)
    np.testing.assert_array_equal(prompt.vector, click)
    (lost,) = read_prompts("like click 2", read, known)
    assert "is no click of this session or run" in lost.problem


def test_a_click_beside_texts_needs_the_rule_cosine():
    prompts = [Prompt("red", read(["red"])[0]), Prompt(click_name(1), read(["blue"])[0])]
    field = cubes().field
    assert pose(field, prompts, read, negatives=())[1].texts == ("red", "like click 1")
    marked, question = pose(field, prompts, read, negatives=["green"])
    assert question.texts == ("red",)
    assert "rule cosine" in marked[1].problem


def test_saving_keeps_what_is_saved():
    field = cubes().field
    _, one = pose(field, read_prompts("red, blue", read), read, negatives=())
    _, two = pose(field, read_prompts("blue, green", read), read, negatives=(), threshold=0.7)
    both = merged(one, two)
    assert (both.texts, both.threshold) == (("red", "blue", "green"), 0.7)
    np.testing.assert_array_equal(both.vectors, np.eye(3))
    assert merged(None, two) is two
    _, other = pose(field, read_prompts("red", read), read, negatives=["green"])
    with pytest.raises(InputError, match="stores 2 prompts with the rule cosine, these go by lerf"):
        merged(one, other)


def test_a_prompt_has_the_colour_that_it_names():
    assert prompt_colours(["a dark green leaf"])[0] == pytest.approx((3 / 255, 53 / 255, 0), abs=1 / 255)
    colours = prompt_colours(["fox", "bear", "wolf", "yellow"])
    assert min(np.abs(np.subtract(a, b)).max() for i, a in enumerate(colours) for b in colours[:i]) > 0.2
