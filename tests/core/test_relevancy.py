from typing import get_args

import numpy as np
import pytest
import torch

from normlift_ns import relevancy
from normlift_ns.analysis.objects import best_prompt
from normlift_ns.options import RelevancyRule
from tests.random_scenes import generator

POSITIVE = torch.rand(50, 3, generator=generator(0), dtype=torch.float64) * 2 - 1
NEGATIVE = torch.rand(50, 4, generator=generator(1), dtype=torch.float64) * 2 - 1


def test_lerf_is_the_least_softmax_over_negatives():
    expected = torch.ones_like(POSITIVE)
    for q in range(3):
        for b in range(4):
            pair = torch.stack([POSITIVE[:, q], NEGATIVE[:, b]], 1)
            expected[:, q] = torch.minimum(expected[:, q], torch.softmax(10 * pair, dim=1)[:, 0])
    assert torch.allclose(relevancy(POSITIVE, NEGATIVE, rule="lerf"), expected, rtol=1e-13)


def test_margin_is_the_lead_over_the_best_background():
    expected = torch.stack([POSITIVE[:, q] - NEGATIVE.max(1).values for q in range(3)], 1)
    assert torch.equal(relevancy(POSITIVE, NEGATIVE, rule="margin"), expected)


def test_cosine_is_itself_and_images_work_too():
    assert torch.equal(relevancy(POSITIVE), POSITIVE)
    image = relevancy(POSITIVE.view(5, 10, 3), NEGATIVE.view(5, 10, 4), rule="lerf")
    assert torch.equal(image.view(50, 3), relevancy(POSITIVE, NEGATIVE, rule="lerf"))


def test_arrays_have_the_relevancy_of_tensors():
    for rule in get_args(RelevancyRule):
        values = relevancy(POSITIVE.numpy(), NEGATIVE.numpy(), rule=rule)
        np.testing.assert_allclose(values, relevancy(POSITIVE, NEGATIVE, rule=rule).numpy(), rtol=1e-14)


def test_forms_that_compare_need_negatives():
    for negative in (None, NEGATIVE[:, :0]):
        with pytest.raises(ValueError, match="object, things, stuff, texture"):
            relevancy(POSITIVE, negative, rule="lerf")


def test_what_is_not_a_cosine_is_refused():
    for wrong in ({"positive": 3 * POSITIVE}, {"negative": NEGATIVE * torch.inf}, {"positive": POSITIVE.numpy() * 3}):
        given = {"positive": POSITIVE, "negative": NEGATIVE, **wrong}
        with pytest.raises(ValueError, match=rf"{next(iter(wrong))} must be cosines in -1\.\.1"):
            relevancy(**given, rule="lerf")
    assert relevancy(torch.full((1, 2), 1.001, dtype=torch.half)).shape == (1, 2)


@pytest.mark.usefixtures("unchecked")
def test_unknown_rule():
    with pytest.raises(ValueError, match=r"rule .*cosine, lerf, margin.*dot"):
        relevancy(POSITIVE, NEGATIVE, rule="dot")


def test_strongest_is_the_selected_prompt_of_largest_relevancy():
    selected = torch.rand(50, 3, generator=generator(2)) < 0.6
    for row, chosen, found in zip(POSITIVE, selected, best_prompt(POSITIVE, selected).tolist()):
        among = [q for q in range(3) if chosen[q]]
        assert found == (max(among, key=lambda q: float(row[q])) if among else -1)
    assert best_prompt(POSITIVE[:, :0], selected[:, :0]).tolist() == [-1] * 50
