"""The GPU's neighbour search against the k-d tree of the CPU."""

import pytest
import torch

from normlift_ns.core.neighbors import _on_cpu
from normlift_ns.kernels import nearest
from tests.distributed.threads import together
from tests.random_scenes import generator

DEVICE = "cuda" if torch.cuda.is_available() else "cpu"
pytestmark = pytest.mark.filterwarnings("ignore:invalid value encountered:RuntimeWarning")  # infinity - infinity


def uneven(n: int, seed: int = 0) -> torch.Tensor:
    """Two thirds of the points in a cluster a thousandth of the scene's size, one far away, three at one place."""
    g = generator(seed)
    points = torch.randn(n, 3, generator=g)
    points[: 2 * n // 3] = points[: 2 * n // 3] * 1e-3 + 2
    points[-1] = 1e4
    points[-4:-1] = 0.5
    return points


LARGER = [pytest.param(150, 12, marks=pytest.mark.extra), pytest.param(70, 36, marks=pytest.mark.extra)]


@pytest.mark.parametrize(("n", "k"), [(45, 12), (5, 12), (1, 3), *LARGER])
def test_equals_the_cpu(n, k):
    points = uneven(n).to(DEVICE)
    found = nearest.find_nearest(points, k)
    expected = _on_cpu(points.cpu(), k)
    unsure = (~found.certain).nonzero().squeeze(1)  # the far one: to float32 the cluster is one point
    assert (n - 1 in unsure.tolist()) == (n > k)
    if unsure.numel() > 0:
        for array, exact in zip(found, nearest.brute_force_nearest(points, unsure, k)):
            array[unsure] = exact
    assert torch.equal(found.index.cpu(), expected.index)
    assert torch.allclose(found.distance.cpu().double(), expected.distance, rtol=1e-7, atol=0)
    assert torch.equal(found.spacing.cpu(), expected.spacing)


def test_what_it_cannot_order_is_reported():
    """Six points of a lattice stand at each distance, more than the spare candidates; and more stand at one place."""
    coincident = torch.zeros(38, 3)
    coincident[30:] = torch.randn(8, 3, generator=generator(1))
    lattice = torch.cartesian_prod(torch.arange(3.0), torch.arange(3.0), torch.arange(4.0))
    for points, surely_not in ((lattice, 0), (coincident, 30)):
        found, expected = nearest.find_nearest(points.to(DEVICE), 12), _on_cpu(points, 12)
        certain = found.certain.cpu()
        assert torch.equal(found.index.cpu()[certain], expected.index[certain])
        assert not certain.all() and not certain[:surely_not].any()


def test_nodes_sorted_each_for_itself_or_in_several_processes_are_the_same_tree(monkeypatch):
    points = uneven(333).round(decimals=1)
    points[5:9] = -0.0
    trees = []
    for most in (0, 64, 10**9):
        monkeypatch.setattr(nearest, "_SORTED_IN_A_BLOCK", most)
        trees.append(nearest.build_kd_tree(points.to(DEVICE)))
    for size in (2, 3):
        trees += together(size, lambda team: nearest.build_kd_tree(points.to(DEVICE), team))
    assert all(torch.equal(a, b) for tree in trees[1:] for a, b in zip(tree, trees[0]))


def test_looking_at_all_points_equals_the_cpu_where_everything_ties(monkeypatch):
    monkeypatch.setattr(nearest, "_PAIRS", 300)  # two rows at once
    points = torch.cartesian_prod(*[torch.arange(5.0)] * 3)
    points[3] = points[90]
    rows = torch.tensor([0, 3, 62, 90, 124])
    for k in (1, 12, 130):
        found, expected = nearest.brute_force_nearest(points, rows, k), _on_cpu(points, k)
        assert torch.equal(found.index, expected.index[rows])
        assert torch.allclose(found.distance.double(), expected.distance[rows], rtol=1e-7)
        assert torch.equal(found.spacing, expected.spacing[rows])
