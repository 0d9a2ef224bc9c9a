import math

import pytest
import torch

from normlift_ns import GaussianScene
from normlift_ns.rasterization.rasterize import ray_weights
from tests.random_scenes import random_scene


def scene(*rows: tuple[float, float, float, float]) -> GaussianScene:
    """Round Gaussians of size 0.1 at (x, y, z) with an opacity."""
    table = torch.tensor(rows, dtype=torch.float64)
    quats = torch.tensor([1.0, 0, 0, 0]).double().expand(len(table), 4)
    return GaussianScene(table[:, :3], quats, torch.full((len(table), 3), 0.1).double(), table[:, 3])


ORIGIN, FORWARD = torch.zeros(3).double(), torch.tensor([0.0, 0.0, 2.0]).double()


def test_nearer_gaussians_take_light_and_what_lies_aside_behind_or_is_faint_is_not_met():
    found = ray_weights(scene((0, 0, 3, 0.8), (0, 0, 1, 0.3), (0, 0, 2, 0.5)), ORIGIN, FORWARD)
    assert torch.allclose(found, torch.tensor([0.7 * 0.5 * 0.8, 0.3, 0.7 * 0.5]).double())
    found = ray_weights(scene((0.1, 0, 1, 0.8), (0.6, 0, 1, 0.9), (0, 0, -1, 0.9), (0, 0, 2, 0.003)), ORIGIN, FORWARD)
    assert found.tolist() == [pytest.approx(0.8 * math.exp(-0.5)), 0, 0, 0]  # one standard deviation away, the first


def test_a_turned_needle_is_met_where_it_lies():
    half = math.sqrt(0.5)
    quats = torch.tensor([[half, 0, 0, half]]).double()  # a quarter turn about z: its long x axis points along y
    needle = GaussianScene(
        torch.tensor([[0.0, 0, 2]]).double(), quats, torch.tensor([[1.0, 0.01, 0.01]]).double(), torch.ones(1).double()
    )
    aside = torch.tensor([0.0, 0.5, 0]).double()
    assert float(ray_weights(needle, aside, FORWARD)[0]) == pytest.approx(math.exp(-0.125))
    assert float(ray_weights(needle, aside.roll(-1), FORWARD)[0]) == 0


def test_flat_gaussians_and_broken_ones_give_numbers():
    flat = random_scene(50, seed=3)
    flat.scales[:10] = 0
    flat.scales[10:20, 2] = 0
    flat.means[20] = torch.nan
    flat.quats[21] = 0
    found = ray_weights(flat, torch.tensor([0.0, 0, -4]).double(), FORWARD)
    assert found.isfinite().all()
    assert found[20] == found[21] == 0
    assert 0 < float(found.sum()) <= 1
