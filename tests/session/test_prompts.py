"""Rows of prompts: what is typed, clicked and saved."""

from unittest.mock import Mock

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from normlift_ns.errors import InputError
from normlift_ns.query.question import join_prompts, split_prompts
from normlift_ns.session.outputs import store_query
from normlift_ns.session.prompts import (
    MAX_PROMPTS,
    Prompt,
    build_query,
    click_name,
    encode_prompts,
    merge_queries,
    prompts_of_query,
)
from tests.session.worlds import read, world

TEXT = st.text(st.characters(exclude_categories=["Cs"]), max_size=12)


@given(st.lists(TEXT, max_size=6))
def test_joined_prompts_are_split_again(texts):
    clean = [" ".join(text.replace('"', " ").split()) for text in texts]
    assert split_prompts(join_prompts(texts)) == list(dict.fromkeys(text for text in clean if text))
    for text in texts:
        once = split_prompts(text)
        assert all(part == part.strip() != "" for part in once)
        assert len(set(once)) == len(once)


def test_an_unknown_word_marks_its_row_and_the_rest_is_answered():
    found = encode_prompts("red, zebra; blue", encoder := Mock(side_effect=read))
    assert [(one.text, "'zebra'" in one.error) for one in found] == [("red", False), ("zebra", True), ("blue", False)]
    assert (found[0].error, [*encoder.call_args_list[0].args[0]]) == ("", ["red", "zebra", "blue"])
    prompts, question = build_query(world().field, found, read, negatives=())
    assert (prompts, question.texts) == (found, ("red", "blue"))
    np.testing.assert_array_equal(question.embeddings, np.eye(3)[:2])
    with pytest.raises(InputError, match="zebra"):
        build_query(world().field, encode_prompts("zebra", read), read)
    with pytest.raises(InputError, match="prompt"):
        build_query(world().field, [], read)


def test_what_is_wrong_with_the_line_or_the_encoder_is_an_error():
    assert len(encode_prompts(",".join(map(str, range(MAX_PROMPTS))), lambda texts: np.ones((len(texts), 3)))) == 64
    for line, hint in ((" ;, \n", "prompt"), (",".join(map(str, range(MAX_PROMPTS + 1))), "65 .* 64")):
        with pytest.raises(InputError, match=hint):
            encode_prompts(line, read)
    with pytest.raises(FileNotFoundError, match="weights are gone"):
        encode_prompts("red", Mock(side_effect=FileNotFoundError("weights are gone")))


def test_a_click_is_asked_by_its_direction_and_beside_texts_by_the_rule_cosine_alone():
    field, click = world().field, np.array([0.6, 0.8, 0], np.float32)
    known = {click_name(1): click}
    (prompt,) = encode_prompts("like click 1", read, known)
    assert prompt.is_click
    _, question = build_query(field, [prompt], read)
    assert question.rule == "cosine" and question.suggest_threshold and not (question.gated or question.negatives)
    again = {row.text: row.vector for row in prompts_of_query(question)}
    (prompt,) = encode_prompts(join_prompts(question.texts), read, again)
    np.testing.assert_array_equal(prompt.vector, click)
    (lost,) = encode_prompts("like click 2", read, known)
    assert lost.vector is None and "'like click 2'" in lost.error

    prompts = [Prompt("red", read(["red"])[0]), prompt]
    assert build_query(field, prompts, read, negatives=())[1].texts == ("red", "like click 1")
    marked, question = build_query(field, prompts, read, negatives=["green"])
    assert question.texts == ("red",)
    assert marked[0].error == "" and "cosine" in marked[1].error


def test_saving_keeps_what_is_saved():
    field = world().field

    def posed(line, **how):
        return build_query(field, encode_prompts(line, read), read, **how)[1]

    one, two = posed("red, blue", negatives=()), posed("blue, green", negatives=(), threshold=0.7)
    both = merge_queries(one, two)
    assert (both.texts, both.threshold) == (("red", "blue", "green"), 0.7)
    np.testing.assert_array_equal(both.embeddings, np.eye(3))
    assert merge_queries(None, two) is two and prompts_of_query(None) == ()
    other = (["green"], True, r"rules cosine and lerf, negatives\)")
    for negatives, refined, different in (other, ((), False, r"\(refined features\)")):
        with pytest.raises(InputError, match=different):
            merge_queries(one, posed("red", negatives=negatives, refined=refined))
    for folder, query, reason in ((None, one, "not stored"), (None, None, "no query")):
        with pytest.raises(InputError, match=reason):
            store_query(folder, query)
