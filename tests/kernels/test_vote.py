"""The kernel's vote against the plain one."""

import pytest
import torch

from normlift_ns import RefineConfig, nearest_neighbors, refine
from normlift_ns.core.refine import decay_width, spatial_order
from normlift_ns.kernels.vote import vote
from tests.scenes import generator, unit_rows

DEVICE = "cuda" if torch.cuda.is_available() else "cpu"


@pytest.mark.parametrize(("n", "k", "dimension"), [(50, 12, 70), (20, 36, 33)])
def test_equals_the_plain_vote(n, k, dimension):
    g = generator(n)
    means = torch.randn(n, 3, generator=g)
    classes = unit_rows(4, dimension, 1, torch.float32)[torch.randint(0, 4, (n,), generator=g)]
    directions = torch.nn.functional.normalize(classes + 0.03 * torch.randn(n, dimension, generator=g), dim=1)
    reliability = torch.rand(n, generator=g)
    directions[:6], reliability[:6] = 0.0, 0.0
    config = RefineConfig(k=k, delta=0.02)
    neighbors = nearest_neighbors(means, k)
    expected = refine(means, directions, reliability, config, neighbors=neighbors)
    # voters in two calls, directions in another order
    perm = torch.randperm(n, generator=g)
    source = torch.arange(n, dtype=torch.int32).to(DEVICE)
    for voters in spatial_order(means).split(n // 2 + 1):
        arrays = (voters, neighbors.index, neighbors.distance, directions[perm], perm.argsort().int(), reliability)
        vote(
            *(x.to(DEVICE) for x in arrays),
            source,
            tau=config.tau,
            gamma=config.gamma,
            width=float(decay_width(neighbors, config)),
            delta=config.delta,
        )
    assert (expected != torch.arange(n)).float().mean() > 0.2
    assert torch.equal(source.cpu(), expected)


def test_nothing_changes_where_nobody_is_reliable():
    means = torch.randn(10, 3, generator=generator(0))
    neighbors = nearest_neighbors(means, 4)
    directions, reliability = unit_rows(10, 16, 0, torch.float32), torch.zeros(10)
    source = torch.full((10,), -7, dtype=torch.int32)
    row_of = torch.arange(10, dtype=torch.int32)
    arrays = (torch.arange(10), neighbors.index, neighbors.distance, directions, row_of, reliability, source)
    there = [x.to(DEVICE) for x in arrays]
    vote(*there, tau=0.8, gamma=0.05, width=1.0, delta=0.0)
    assert torch.equal(there[-1].cpu(), source)  # nothing written


def test_spatial_order_is_a_permutation_that_keeps_neighbours_together():
    means = torch.rand(2000, 3, generator=generator(4))
    means[3], means[7] = torch.inf, torch.nan
    order = spatial_order(means)
    assert torch.equal(order.sort().values, torch.arange(2000))
    step = (means[order][1:] - means[order][:-1]).norm(dim=1)
    assert step[step.isfinite()].mean() < 0.15  # 0.66 in a random order
    assert torch.equal(spatial_order(torch.full((3, 3), torch.nan)), torch.arange(3))
