import itertools
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


def test_rules_are_those_of_their_definitions():
    lerf = torch.ones_like(POSITIVE)
    for q, b in itertools.product(range(3), range(4)):  # the least softmax over negatives
        pair = torch.stack([POSITIVE[:, q], NEGATIVE[:, b]], 1)
        lerf[:, q] = torch.minimum(lerf[:, q], torch.softmax(10 * pair, dim=1)[:, 0])
    margin = torch.stack([POSITIVE[:, q] - NEGATIVE.max(1).values for q in range(3)], 1)
    assert torch.allclose(relevancy(POSITIVE, NEGATIVE, rule="lerf"), lerf, rtol=1e-13)
    assert torch.equal(relevancy(POSITIVE, NEGATIVE, rule="margin"), margin)
    assert torch.equal(relevancy(POSITIVE), POSITIVE)
    image = relevancy(POSITIVE.view(5, 10, 3), NEGATIVE.view(5, 10, 4), rule="lerf")
    assert torch.allclose(image.view(50, 3), lerf, rtol=1e-13)


def test_arrays_have_the_relevancy_of_tensors():
    for rule in get_args(RelevancyRule):
        values = relevancy(POSITIVE.numpy(), NEGATIVE.numpy(), rule=rule)
        np.testing.assert_allclose(values, relevancy(POSITIVE, NEGATIVE, rule=rule).numpy(), rtol=1e-14)


@pytest.mark.usefixtures("unchecked")
def test_what_is_not_a_cosine_or_a_rule_is_refused():
    for wrong in ({"positive": 3 * POSITIVE}, {"negative": NEGATIVE * torch.inf}, {"positive": POSITIVE.numpy() * 3}):
        given = {"positive": POSITIVE, "negative": NEGATIVE, **wrong}
        with pytest.raises(ValueError, match=rf"{next(iter(wrong))} must be cosines in -1\.\.1"):
            relevancy(**given, rule="lerf")
    assert relevancy(torch.full((1, 2), 1.001, dtype=torch.half)).shape == (1, 2)
    for negative, rule, message in (
        (None, "lerf", "object, things, stuff, texture"),
        (NEGATIVE[:, :0], "lerf", "object, things, stuff, texture"),
        (NEGATIVE, "dot", r"rule .*cosine, lerf, margin.*dot"),
    ):
        with pytest.raises(ValueError, match=message):
            relevancy(POSITIVE, negative, rule=rule)


def test_strongest_is_the_selected_prompt_of_largest_relevancy():
    selected = torch.rand(50, 3, generator=generator(2)) < 0.6
    for row, chosen, found in zip(POSITIVE, selected, best_prompt(POSITIVE, selected).tolist()):
        among = [q for q in range(3) if chosen[q]]
        assert found == (max(among, key=lambda q: float(row[q])) if among else -1)
    assert best_prompt(POSITIVE[:, :0], selected[:, :0]).tolist() == [-1] * 50
