"""Views that are left out: regions that show the same things are recognized, random ones are not."""

import pytest
import torch

from normlift_ns.core.consensus import sample_gaussians
from normlift_ns.core.left_out import LeftOut, leave_views_out
from tests.core.test_consensus import things
from tests.random_scenes import generator, unit_rows

COUNT, VIEWS = 4, 8


def judged(features: torch.Tensor, **options) -> LeftOut:
    evidence = things(1, gaussians=200, views=VIEWS, count=COUNT)
    chosen, probability = sample_gaussians(evidence.rows, evidence.num_regions, 50)
    return leave_views_out(evidence.select_gaussians(chosen), probability, features, **options)


@pytest.mark.parametrize("least", [None, 0.0])
def test_regions_of_the_same_things_are_recognized(least):
    found = judged(unit_rows(COUNT, 6, 0).repeat(VIEWS, 1), least=least)
    assert found.recognized == found.confirmed == COUNT * VIEWS
    assert 0.9 < found.agreement <= 1


def test_unrelated_and_wrong_features_lower_the_agreement():
    clean = unit_rows(COUNT, 16, 0).repeat(VIEWS, 1)
    wrong = torch.rand(len(clean), generator=generator(3)) < 0.3
    damaged = judged(torch.where(wrong[:, None], clean.roll(1, 0), clean), least=None)
    assert damaged.agreement < judged(clean, least=None).agreement - 0.05
    assert damaged.confirmed < COUNT * VIEWS
    unrelated = judged(unit_rows(COUNT * VIEWS, 40, 0), least=None)
    assert unrelated.confirmed < 0.6 * COUNT * VIEWS  # a quarter by chance
    assert abs(unrelated.agreement) < 0.4


def test_one_view_or_no_region_gives_no_figure():
    evidence = things(1, gaussians=60, views=1, count=COUNT)
    found = leave_views_out(evidence, torch.ones(60, dtype=torch.float64), unit_rows(COUNT, 6, 0))
    assert found.facts == {"recognized": 0, "confirmed": 0, "agreement": None}
