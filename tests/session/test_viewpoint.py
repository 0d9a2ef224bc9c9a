"""Where a camera goes to look at something, among walls whose places are known."""

import numpy as np
import pytest
import torch

from normlift_ns import GaussianScene
from normlift_ns.session.objects import LookAtTarget, unoccluded_viewpoint, viewpoint

SPOT = LookAtTarget((0.0, 0.0, 0.0), 1.0)
FROM, UP = (0.0, -10.0, 0.0), (0.0, 0.0, 1.0)
AWAY = 1 / (1.6 * np.tan(0.45))


def walls(*sides: tuple[float, float, float], scale: float = 0.05) -> GaussianScene:
    """Opaque patches of 0.8 x 0.8, each at 1.2 from the spot, and the spot itself."""
    axis = torch.linspace(-0.4, 0.4, 9, dtype=torch.float64)
    flat = torch.cartesian_prod(axis, axis)
    parts = [torch.zeros(1, 3, dtype=torch.float64)]
    for side in sides:
        normal = torch.tensor(side, dtype=torch.float64)
        one = torch.linalg.cross(normal, torch.tensor([0.3, 0.5, 0.8], dtype=torch.float64))
        one = one / one.norm()
        other = torch.linalg.cross(normal, one)
        parts.append(1.2 * normal + flat[:, :1] * one + flat[:, 1:] * other)
    means = torch.cat(parts).float()
    n = len(means)
    return GaussianScene(means, torch.eye(4)[:1].expand(n, 4), torch.full((n, 3), scale), torch.full((n,), 0.99))


def test_a_spot_fills_most_of_the_picture_from_the_side_where_the_camera_is_unless_a_wall_is_there():
    seen = (0, -AWAY, 0)
    assert viewpoint(SPOT, FROM) == pytest.approx(seen)
    assert viewpoint(SPOT, SPOT.center) == pytest.approx(seen)
    assert viewpoint(LookAtTarget((1.0, 0.0, 0.0), 2.0), (1.0, 0.0, 9.0), np.pi / 2) == pytest.approx((1, 0, 1.25))
    for sides in ((), ((0, 1, 0),), ((1, 0, 0), (-1, 0, 0), (0, 0, 1))):  # nothing in the way
        assert unoccluded_viewpoint(SPOT, walls(*sides), None, FROM, UP) == pytest.approx(seen), sides
    raised = (3.0, -8.0, 6.0)
    assert unoccluded_viewpoint(SPOT, walls(), None, raised, UP) == pytest.approx(viewpoint(SPOT, raised))
    scene = walls((0, -1, 0))
    hidden = torch.arange(len(scene)) == 0
    assert unoccluded_viewpoint(SPOT, scene, hidden, FROM, UP) == pytest.approx(seen)
    around = np.array(unoccluded_viewpoint(SPOT, scene, None, FROM, UP))
    assert np.linalg.norm(around) == pytest.approx(AWAY)
    assert around[1] < 0 and np.abs(around) == pytest.approx([AWAY * 0.5**0.5, AWAY * 0.5**0.5, 0])


def test_a_large_gaussian_whose_center_is_farther_away_stands_in_the_way_too():
    beside = torch.tensor([[0.0, 0.0, 0.0], [3.0, -1.0, 0.0]])
    scene = GaussianScene(beside, torch.eye(4)[:1].expand(2, 4), torch.tensor([[0.05] * 3, [2.0] * 3]), torch.ones(2))
    assert unoccluded_viewpoint(SPOT, scene, None, FROM, UP) == pytest.approx((AWAY * 0.5**0.5, -AWAY * 0.5**0.5, 0))


def test_in_a_corner_it_takes_the_open_side():
    around = [(np.sin(a), -np.cos(a), 0.0) for a in np.radians([0, 45, -45, 90, -90, 135, -135])]
    place = np.array(unoccluded_viewpoint(SPOT, walls(*around), None, FROM, UP))
    assert place == pytest.approx([0, AWAY, 0], abs=1e-9)
    above = np.array(unoccluded_viewpoint(SPOT, walls(*around, (0.0, 1.0, 0.0)), None, FROM, UP))
    assert above[2] > 0.4 * AWAY
    assert np.linalg.norm(above) == pytest.approx(AWAY)


def test_without_any_clear_side_it_stays_on_one():
    scene = GaussianScene(torch.zeros(1, 3), torch.eye(4)[:1], torch.full((1, 3), 30.0), torch.ones(1))
    for spot, some, place, up in (
        (LookAtTarget((0.0, 0.0, 0.0), 1e-3), scene, FROM, UP),
        (SPOT, walls((0, -1, 0)), (0, 0, 5.0), UP),
        (SPOT, walls((0, -1, 0)), FROM, (0, 0, 0)),
    ):
        assert np.isfinite(unoccluded_viewpoint(spot, some, None, place, up)).all()
