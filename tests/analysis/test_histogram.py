"""Histograms of relevancy: every Gaussian is in one bin, and the rules are those that the module says."""

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from normlift_ns import InputError, SemanticField
from normlift_ns.core.relevancy import RELEVANCY_RULES
from normlift_ns.encoders.registry import EncoderKind
from normlift_ns.query import engine
from normlift_ns.query.question import Query, make_query, save_query
from normlift_ns.query.threshold import HISTOGRAM_BINS, draw_histogram, relevancy_histogram, suggest_threshold
from tests.examples import examples
from tests.io.test_field import D, example
from tests.random_scenes import unit_rows

RANGE = EncoderKind.suggested
VALUES = arrays(np.float32, st.integers(1, 60), elements=st.floats(-2, 2, width=32))


@examples(25)
@given(values=VALUES, threshold=st.floats(-3, 3), seed=st.integers(0, 9))
def test_every_valid_gaussian_is_in_one_bin(values, threshold, seed):
    valid = np.random.default_rng(seed).random(len(values)) < 0.7
    found = relevancy_histogram(values, valid, threshold, RANGE)
    if not valid.any():
        assert found is None
        return
    assert found.counts.sum() == valid.sum()
    counts, edges = np.histogram(values[valid].astype(np.float64), HISTOGRAM_BINS, (found.edges[0], found.edges[-1]))
    assert np.array_equal(found.counts, counts)
    assert np.array_equal(found.edges, edges)
    median, top = np.quantile(values[valid].astype(np.float64), (0.5, 0.999))
    assert (found.top, found.median in (median, values[valid].min())) == (top, True)
    assert len(found.counts) == HISTOGRAM_BINS == len(found.edges) - 1
    assert found.edges[0] <= min(threshold, values[valid].min())
    assert found.edges[-1] >= max(threshold, values[valid].max())
    assert (
        min(found.median, found.top - 1e-6) <= found.suggested <= values[valid].max()
        and found.top <= values[valid].max() + 1e-6
    )
    line = draw_histogram(found.counts, found.edges[0], found.edges[-1], threshold)
    assert (len(line), line.count("|")) == (HISTOGRAM_BINS // 2 + 1, 1)


def asked(encoder: str | None, **how) -> Query:
    lifted, means, source = example(0)
    field = SemanticField.build(lifted, means, source, provenance={"encoder": {"encoder": encoder}})
    read = {"cosine": unit_rows(1, D, 3).float().numpy()}
    return make_query(field, lambda texts: np.repeat(read["cosine"], len(texts), 0), ["a"], **how)


def test_every_encoder_has_a_default_that_selects_something():
    for encoder, how, threshold, suggest in (
        ("open_clip", {}, 0.5, False),  # lerf, against four negatives
        ("open_clip", {"negatives": []}, 0.5, True),
        ("open_clip", {"relevancy": "cosine"}, 0.5, True),
        ("open_clip", {"relevancy": "cosine", "threshold": 0.3}, 0.3, False),
        ("open_clip", {"relevancy": "margin"}, 0.02, False),
        ("open_clip", {"threshold": "auto"}, 0.5, True),
        ("color", {}, 0.7, False),
        ("color", {"threshold": "auto"}, 0.5, True),
        (None, {}, 0.5, True),
    ):
        question = asked(encoder, **how)
        assert (question.threshold, question.suggest_threshold) == (threshold, suggest), (encoder, how)
    with pytest.raises(InputError, match=r"threshold .*auto.*much"):
        asked("color", threshold="much")


def test_an_answer_has_the_threshold_that_it_was_given(tmp_path):
    lifted, means, source = example(0)
    field = SemanticField.build(lifted, means, source)
    question = Query(("a", "b"), unit_rows(2, D, 3).float().numpy(), suggest_threshold=True)
    found = engine.run_query(field, means, question)
    wanted = suggest_threshold(found.relevancy.numpy(), found.valid.numpy(), RANGE)
    assert (found.question.threshold, found.question.suggest_threshold) == (wanted, False)
    assert torch.equal(found.selected, (found.relevancy > wanted) & found.valid[:, None])
    assert bool(found.mask.any())
    with pytest.raises(InputError, match="threshold"):
        save_query(tmp_path, question)
    save_query(tmp_path, found.question)


def test_a_text_that_most_of_the_scene_is_selects_it_and_limits_go_by_the_lead():
    lerf, margin = (RELEVANCY_RULES[rule].presence_limit for rule in ("lerf", "margin"))
    assert margin is not None and 1 / (1 + np.exp(-10 * margin)) == pytest.approx(lerf, abs=1e-12)
    values = np.repeat([0.2, 0.9, 0.9 + 1e-9], [30, 60, 10])
    found = relevancy_histogram(values, np.ones(100, bool), 0.5, RANGE)
    assert found is not None and 0.4 < found.suggested < 0.8
    assert suggest_threshold(values[:, None], np.ones(100, bool), RANGE) == pytest.approx(found.suggested)
    assert int((values > found.suggested).sum()) == 70


@pytest.mark.parametrize("size", [60, 400, 30_000])
def test_a_suggestion_separates_an_object_of_any_size_from_what_is_alike(size: int) -> None:
    rng, count = np.random.default_rng(size), 50_000
    alike, other = rng.normal(0.35, 0.05, count // 5), rng.normal(0.1, 0.08, count)
    values = np.concatenate([rng.normal(0.8, 0.04, size), alike, other])
    suggested = suggest_threshold(values[:, None], np.ones(len(values), bool), RANGE)
    assert suggested is not None and (values[:size] > suggested).mean() > 0.95
    assert (values[size:] > suggested).sum() < 0.05 * size
