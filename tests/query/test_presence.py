"""The null level against its definition in float64, the selection by rule contrast, and the verdicts."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any
from unittest.mock import Mock

import numpy as np
import pytest
import torch

from normlift_ns import InputError, SemanticField
from normlift_ns.core.field import with_null_level
from normlift_ns.encoders.build import null_vectors, null_words
from normlift_ns.io.field import read_field
from normlift_ns.query.arrays import ArrayField
from normlift_ns.query.engine import run_query
from normlift_ns.query.question import Query, make_query
from normlift_ns.query.threshold import judge, null_rank
from tests.io.test_field import D, example
from tests.random_scenes import unit_rows


@pytest.mark.parametrize(("count", "k"), [(5, 2), (70, 2), (200, 6)])
def test_the_null_level_is_the_kth_largest_cosine_and_is_stored(count, k, tmp_path):
    lifted, means, source = example(0)
    null = unit_rows(count, D, 9)
    field = with_null_level(SemanticField.build(lifted, means, source, storage="float16"), null)
    cosine = field.query(null, refined=False).double()
    level = torch.where(field.valid(refined=False), cosine.sort(dim=1).values[:, -k], 0)
    assert field.null_level is not None
    torch.testing.assert_close(field.null_level.double(), level, atol=1e-6, rtol=0)
    tops = np.quantile(field.query(null)[field.valid()].numpy(), 0.999, axis=0)
    np.testing.assert_allclose(field.manifest["null_words"]["tops"], np.sort(tops), atol=6e-5)
    field.save(tmp_path)
    quick, read = ArrayField(*read_field(tmp_path)), SemanticField.load(tmp_path)
    question = make_query(field, lambda texts: null[: len(texts)].float(), ["a", "b"])
    assert (question.rule, question.threshold) == ("contrast", 0.5)
    found, again = run_query(read, means, question), run_query(quick, means.numpy(), question)
    torch.testing.assert_close(torch.from_numpy(again.relevancy), found.relevancy.float(), atol=1e-5, rtol=0)
    above = found.field.query(null[:2]) > level[source.long()][:, None]
    for index, verdict in enumerate(found.verdicts):
        wanted = above[:, index] if verdict != "probably not here" else torch.zeros(len(above), dtype=torch.bool)
        assert torch.equal(found.selected[:, index], wanted & found.valid)


def test_a_field_without_null_level_does_not_take_rule_contrast():
    lifted, means, source = example(0)
    field = SemanticField.build(lifted, means, source)
    with pytest.raises(InputError, match=r"contrast.*unrelated words"):
        run_query(field, means, Query(("a",), unit_rows(1, D, 3).float().numpy(), rule="contrast"))


def test_verdicts_follow_ranks_colors_and_leads():
    manifest = {"null_words": {"texts": 100, "tops": [i / 100 for i in range(100)]}}
    for top, rank, verdict in ((0.96, 0.96, "found"), (0.85, 0.85, "weak match"), (0.1, 0.1, "probably not here")):
        assert null_rank(manifest, top) == pytest.approx(rank)
        assert judge(manifest, "imagenet", "cosine", top_cosine=top, top=0) == verdict
    few = {"null_words": {"texts": 12, "tops": [0.1] * 12}}
    assert judge(few, None, "cosine", top_cosine=1, top=1) is None
    for rule, values in (("lerf", (0.4, 0.55, 0.7)), ("contrast", (0.4, 0.55, 0.7)), ("margin", (0.01, 0.03, 0.06))):
        verdicts = [judge(few, None, rule, top_cosine=0, top=value) for value in values]
        assert verdicts == ["probably not here", "weak match", "found"]
    colors = [judge({}, "colour", "cosine", top_cosine=value, top=value) for value in (0.5, 0.7, 0.9)]
    assert colors == ["probably not here", "weak match", "found"]


def test_the_vectors_of_the_null_words_are_kept_for_later_lifts(tmp_path):
    asked = []

    def text(words):
        asked.append(len(words))
        return torch.nn.functional.normalize(torch.arange(1.0, 2 * len(words) + 1).view(-1, 2), dim=1)

    def vectors(weights, text=text):
        source: Any = SimpleNamespace(identity={"weights": weights}, text=text)
        return null_vectors(source, {"encoder": "imagenet"}, tmp_path)

    first, again = vectors("a"), vectors("a")
    assert first is not None and again is not None and torch.equal(again, first)
    assert asked == [len(null_words())]
    assert vectors("b") is not None and len(asked) == 2
    with pytest.warns(UserWarning, match="unrelated words.*weights x"):
        assert vectors("c", Mock(side_effect=FileNotFoundError("weights x are missing"))) is None  # the lift goes on
