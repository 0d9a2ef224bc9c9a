"""Parts of research.coverage: what a choice of views answers is a sum over views, and its percentile."""

from types import SimpleNamespace
from typing import Any

import pytest
import torch

from normlift_ns import Evidence, lift
from normlift_ns.core.evidence import Entries
from normlift_ns.core.metrics import class_scores, classify, confusion
from normlift_ns.core.sparse import SparseRows
from research.coverage import Outcome, Sums
from research.damage import Observed
from research.variants import lifted_scores

GAUSSIANS, VIEWS, REGIONS, CLASSES = 40, 14, 5, 3


def observed(seed: int = 0) -> tuple[Any, Any, Observed, SparseRows]:
    """A world without geometry: random evidence of regions, each nearly of one class."""
    g = torch.Generator().manual_seed(seed)
    words = torch.nn.functional.normalize(torch.randn(CLASSES, 8, generator=g), dim=1)
    truth = torch.randint(0, CLASSES, (GAUSSIANS,), generator=g)
    parts = []
    for _ in range(VIEWS):
        rows = (torch.rand(GAUSSIANS, generator=g) < 0.3).nonzero().squeeze(1)
        column = 1 + truth[rows] + torch.randint(0, 2, (len(rows),), generator=g)
        parts.append(Entries(rows, column, torch.rand(len(rows), generator=g), num_regions=(REGIONS,)))
    evidence = Evidence.from_entries(parts, GAUSSIANS)
    shown = torch.arange(VIEWS * REGIONS) % REGIONS % CLASSES
    noise = 0.7 * torch.randn(VIEWS * REGIONS, 8, generator=g)
    features = torch.nn.functional.normalize(words[shown] + noise, dim=1)
    world = SimpleNamespace(truth=truth, classes=CLASSES, cameras=[None] * VIEWS)
    seen = evidence.view_weights()
    return world, SimpleNamespace(classes=words), Observed(evidence, features, torch.zeros(1, 0), []), seen


@pytest.mark.parametrize("views", [[0], [1, 2, 7], list(range(VIEWS))])
def test_sums_answer_as_the_lift_does(views):
    world, words, found, _ = observed()
    evidence = found.evidence.select_views(views)
    scores = lifted_scores(lift(evidence, found.features[found.evidence.columns_of(views)]), words.classes)
    answer = classify(scores.cosine, scores.valid)
    expected = 100 * class_scores(confusion(world.truth, answer, CLASSES)).miou
    assert Sums(world, words, found, torch.arange(GAUSSIANS)).miou(views) == pytest.approx(expected)
    assert 0 < expected < 100


def test_percentile_counts_ties_half():
    assert Outcome(0.0, 3.0, [1.0, 2.0, 3.0, 4.0], 5.0).percentile == 62.5
