"""Metrics against loops over sets and cases worked by hand."""

import math

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from tests.examples import examples


@pytest.fixture(scope="module")
def metrics():
    """The module; it imports all of scipy's statistics."""
    from normlift_ns.core import metrics  # noqa: PLC0415

    return metrics


def scores_by_sets(truth: list[int], found: list[int], classes: int) -> tuple[list[float], list[float]]:
    """The definition of the ScanNet protocol, with sets of points."""
    counted = {i for i, t in enumerate(truth) if t >= 0}
    ious, accuracies = [], []
    for c in range(classes):
        t = {i for i in counted if truth[i] == c}
        f = {i for i in counted if found[i] == c}
        ious.append(len(t & f) / len(t | f) if t else math.nan)
        accuracies.append(len(t & f) / len(t) if t else math.nan)
    return ious, accuracies


@pytest.mark.filterwarnings("ignore:Mean of empty slice")
@examples(25)
@given(st.lists(st.tuples(st.integers(-1, 4), st.integers(-1, 4)), min_size=1, max_size=40))
def test_scores_equal_their_definition_by_sets(metrics, pairs):
    truth, found = (list(x) for x in zip(*pairs))
    scores = metrics.class_scores(metrics.confusion(torch.tensor(truth), torch.tensor(found), 5))
    ious, accuracies = scores_by_sets(truth, found, 5)
    assert scores.iou.tolist() == pytest.approx(ious, nan_ok=True)
    assert scores.accuracy.tolist() == pytest.approx(accuracies, nan_ok=True)
    assert scores.miou == pytest.approx(np.nanmean(ious), nan_ok=True)
    assert scores.macc == pytest.approx(np.nanmean(accuracies), nan_ok=True)


def test_confusion_works_on_images_and_refuses_unknown_classes(metrics):
    truth = torch.tensor([[0, 1], [1, -1]])
    assert metrics.confusion(truth, truth, 2).tolist() == [[1, 0, 0], [0, 2, 0]]
    with pytest.raises(ValueError, match=r"predicted .*class 2, expected 0\.\.1"):
        metrics.confusion(truth, truth + 1, 2)
    assert math.isnan(metrics.class_scores(metrics.confusion(torch.tensor([-1]), torch.tensor([0]), 2)).miou)


def test_gaussians_without_direction_are_no_class_or_the_first_one(metrics):
    cosine = torch.tensor([[0.1, 0.3], [0.0, 0.0], [0.2, 0.2]])
    valid = torch.tensor([True, False, True])
    assert metrics.classify(cosine, valid).tolist() == [1, -1, 0]
    assert metrics.classify(cosine, valid, without_direction="first").tolist() == [1, 0, 0]
    truth = torch.tensor([1, 1, 0])
    found = (metrics.classify(cosine, valid), metrics.classify(cosine, valid, without_direction="first"))
    ours, published = (metrics.class_scores(metrics.confusion(truth, x, 2)) for x in found)
    assert ours.iou.tolist() == [1, 0.5]
    assert published.iou.tolist() == [0.5, 0.5]  # the wall pays for points that nobody saw


def test_masks_and_localisation_by_hand(metrics):
    a, b = torch.tensor([[1, 1], [0, 0]]).bool(), torch.tensor([[1, 0], [1, 0]]).bool()
    none = torch.zeros_like(a)
    assert (metrics.mask_iou(a, b), metrics.mask_recall(a, b)) == (1 / 3, 1 / 2)
    assert math.isnan(metrics.mask_iou(none, none))
    assert metrics.mask_iou(none, none, empty=0.0) == 0
    assert metrics.mask_iou(none, a) == 0
    assert math.isnan(metrics.mask_recall(a, none))
    # Localisation with ties
    score = torch.tensor([[0.5, 0.1], [0.5, 0.2]])
    assert metrics.localized(score, torch.tensor([[True, False], [False, False]]))
    lower = torch.tensor([[False, False], [True, False]])
    assert not metrics.localized(score, lower)
    assert metrics.localized(score, lower, any_peak=True)
    assert not metrics.localized(score, ~lower & torch.tensor([[False, True], [True, True]]), any_peak=True)


def test_rank_correlations_and_p_values(metrics):
    """Of 5! orders two are in perfect agreement or disagreement; Spearman's 0.9 of five is t = 3.576 with 3 degrees."""
    order = torch.arange(5.0)
    assert metrics.kendall_test(order, order) == pytest.approx((1.0, 2 / 120))
    found = metrics.spearman_test(order, torch.tensor([0.0, 1, 2, 4, 3]))
    assert found == pytest.approx((0.9, 0.0374), abs=1e-4)
    tied, other = torch.tensor([1.0, 1, 2]), torch.tensor([1.0, 2, 9])
    assert metrics.kendall_test(tied, other).value == pytest.approx(2 / 6**0.5)
    assert metrics.spearman_test(tied, other).value == pytest.approx(3**0.5 / 2)
    for test in (metrics.kendall_test, metrics.spearman_test):
        assert all(map(math.isnan, test(order, torch.zeros(5))))


def test_jaccard_of_the_lowest_and_bins_by_hand(metrics):
    a, b = torch.arange(10.0), torch.tensor([1.0, 9, 0, 8, 7, 6, 5, 4, 3, 2])
    assert metrics.lowest_jaccard(a, b, 0.2) == 1 / 3  # {0, 1} and {2, 0}
    assert metrics.lowest_jaccard(a, a, 0.2) == 1
    assert metrics.lowest_jaccard(torch.zeros(10), a, 0.2) == 1  # ties go in by index
    assert metrics.lowest_jaccard(a, b) == 1 / 3  # the default
    assert len(metrics.bin_means(torch.arange(40.0), torch.arange(40.0))[0]) == 10
    keys, values = metrics.bin_means(torch.tensor([3.0, 1, 2, 4]), torch.tensor([0.0, 1, 1, 0]), 2)
    assert (keys.tolist(), values.tolist()) == ([1.5, 3.5], [1, 0])
    with pytest.raises(ValueError, match="5 bins need"):
        metrics.bin_means(torch.zeros(4), torch.zeros(4), 5)
