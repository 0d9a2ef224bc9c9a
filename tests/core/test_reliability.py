"""Independent views and the reliability that counts them."""

import math

import pytest
import torch

from normlift_ns.core.reliability import independent_views, pair_reliability
from normlift_ns.core.sparse import SparseRows
from tests.random_scenes import dense, generator, random_evidence


def test_views_are_counted_by_their_angles():
    evidence = random_evidence(30, [1] * 9, seed=4, fill=0.6)
    weights, g = evidence.view_weights(), generator(5)
    means, centers = torch.randn(30, 3, generator=g, dtype=torch.float64), torch.randn(9, 3, generator=g) * 4
    found = independent_views(weights, means, centers)
    table, n_eff = dense(weights, 9), []
    for j, row in enumerate(table):
        toward = torch.nn.functional.normalize(centers.double() - means[j], dim=1)
        total = 0.0
        for v in range(9):
            for w in range(9):
                angle = 0.0 if v == w else math.degrees(math.acos(max(-1, min(1, float(toward[v] @ toward[w])))))
                total += float(row[v] * row[w]) * math.exp(-angle / 21.7)
        n_eff.append(float(row.sum() ** 2) / total if total > 0 else 0.0)
    torch.testing.assert_close(found, torch.tensor(n_eff, dtype=torch.float64), rtol=1e-6, atol=1e-9)
    # Cameras at one place are one view, and opposite ones are two
    rows = SparseRows(torch.tensor([0, 2, 4]), torch.tensor([0, 1, 0, 2], dtype=torch.int32), torch.ones(4))
    centers = torch.tensor([[4.0, 0, 0], [4.0, 0, 0], [-4.0, 0, 0]])
    found = independent_views(rows, torch.zeros(2, 3, dtype=torch.float64), centers)
    assert abs(float(found[0]) - 1) < 1e-4
    assert 1.99 < float(found[1]) < 2


def test_one_view_is_never_more_reliable_than_two_that_agree():
    views = torch.tensor([1.0, 1.2, 2.0, 8.0])
    found = pair_reliability(torch.tensor([1.0, 1.0, 1.0, 1.0]), views, 1.0)
    assert float(found[0]) == pytest.approx(0.02)  # the paper's R is 0.5
    assert bool((found.diff() > 0).all())
    orthogonal = pair_reliability(torch.tensor([0.5**0.5]), torch.tensor([2.0]), 1.0)
    assert float(orthogonal) == pytest.approx(0.01, abs=1e-6)
