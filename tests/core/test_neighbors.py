"""Exact neighbours against all pairs, ties and coincident points above all."""

import math

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from normlift_ns import nearest_neighbors
from tests.random_scenes import generator


def all_pairs(means: torch.Tensor, k: int) -> tuple[torch.Tensor, torch.Tensor]:
    distance = torch.linalg.vector_norm(means.double()[:, None] - means.double()[None], dim=-1)
    found = distance.fill_diagonal_(math.inf).sort(dim=1, stable=True)
    index = torch.where(found.values < math.inf, found.indices, -1)
    pad = (0, max(0, k - len(means)))
    return (torch.nn.functional.pad(index, pad, value=-1)[:, :k],
            torch.nn.functional.pad(found.values, pad, value=math.inf)[:, :k])  # fmt: skip


def test_equals_all_pairs_ties_by_index():
    sparse = 1e3 * torch.rand(20, 3, generator=generator(5))
    for name, means in {
        "random": torch.rand(120, 3, generator=generator(0)),
        "few places": torch.rand(20, 3, generator=generator(1))[torch.randint(0, 20, (100,), generator=generator(2))],
        "dense and sparse": torch.cat([1e-4 * torch.rand(60, 3, generator=generator(4)), sparse]),
        "one": torch.zeros(1, 3),
    }.items():
        index, distance = all_pairs(means, 130)
        for k in (1, 7, 130):
            found = nearest_neighbors(means, k)
            assert torch.equal(found.index, index[:, :k]), (name, k)
            assert torch.allclose(found.distance, distance[:, :k], rtol=1e-12, atol=0), (name, k)


@given(seed=st.integers(0, 2**31), side=st.integers(1, 6), n=st.integers(1, 60), k=st.integers(1, 12))
def test_equals_all_pairs_on_lattices(seed, side, n, k):
    means = torch.randint(0, side, (n, 3), generator=generator(seed)).float()
    assert torch.equal(nearest_neighbors(means, k).index, all_pairs(means, k)[0])


def test_spacing_ignores_coincident_points_and_non_finite_ones_are_nobodys_neighbour():
    means = torch.tensor([[0.0, 0, 0]] * 5 + [[2.0, 0, 0]] * 5 + [[5.0, 0, 0]])
    assert nearest_neighbors(means, 2).spacing.tolist() == [2] * 10 + [3]
    assert nearest_neighbors(means[:5], 2).spacing.tolist() == [math.inf] * 5
    means = torch.rand(20, 3, generator=generator(0))
    means[3] = torch.nan
    means[7, 0] = torch.inf
    found = nearest_neighbors(means, 30)
    assert (found.index[[3, 7]] == -1).all()
    others = found.index[[i for i in range(20) if i not in (3, 7)]]
    assert not ((others == 3) | (others == 7)).any()
    assert ((others >= 0).sum(1) == 17).all()


def test_many_coincident_points_stay_cheap():
    """20,000 Gaussians at one place: all pairs would be 400 million."""
    means = torch.cat([torch.zeros(20_000, 3), torch.ones(5, 3)])
    found = nearest_neighbors(means, 4)
    assert found.index[0].tolist() == [1, 2, 3, 4]
    assert found.index[19_999].tolist() == [0, 1, 2, 3]
    assert found.index[20_004].tolist() == [20_000, 20_001, 20_002, 20_003]


def test_progress_comes_in_blocks_and_blocks_change_nothing(monkeypatch):
    means, told = torch.randint(0, 3, (90, 3), generator=generator(3)).float(), []
    whole = nearest_neighbors(means, 7)
    monkeypatch.setattr("normlift_ns.core.neighbors._BLOCK", 5)
    monkeypatch.setattr("normlift_ns.core.neighbors._MAX_RANKED", 50)
    found = nearest_neighbors(means, 7, progress=lambda *step: told.append(step))
    assert all(torch.equal(a, b) for a, b in zip(found, whole))
    places = len(means.unique(dim=0))
    assert told == [(first * 90 // places, 90) for first in range(5, places, 5)] + [(90, 90)]


@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a GPU")
def test_progress_on_a_gpu_changes_nothing(monkeypatch):
    means, told = torch.randn(20_000, 3, generator=generator(0)).cuda(), []
    whole = nearest_neighbors(means, 36)
    monkeypatch.setattr("normlift_ns.kernels.nearest._LEAVES", 64)
    found = nearest_neighbors(means, 36, progress=lambda *step: told.append(step))
    assert all(torch.equal(a, b) for a, b in zip(found, whole))
    assert len(told) == 10  # of 625 leaves with points
    assert told == sorted(told)
    assert told[-1] == (20_000, 20_000)
