"""How far two oriented boxes agree."""

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from normlift_ns.analysis.objects import OrientedBox
from research.box_overlap import box_iou, intersection_volume


def straight(center: tuple[float, float, float], size: tuple[float, float, float]) -> OrientedBox:
    return box(np.array(center, float), np.array(size, float), np.eye(3))


def box(*arrays: np.ndarray) -> OrientedBox:
    return OrientedBox(*(torch.from_numpy(x.copy()) for x in arrays))


def test_intersections_that_are_known():
    cube = straight((0, 0, 0), (2, 2, 2))
    assert intersection_volume(cube, cube) == pytest.approx(8)
    assert intersection_volume(cube, straight((1, 1, 1), (2, 2, 2))) == pytest.approx(1)
    assert box_iou(cube, straight((1, 0, 0), (2, 2, 2))) == pytest.approx(4 / 12)
    assert box_iou(cube, straight((0.5, 0, 0), (1, 2, 2))) == pytest.approx(0.5)
    for away in (straight((2, 0, 0), (2, 2, 2)), straight((9, 0, 0), (2, 2, 2)), straight((0, 0, 0), (2, 2, 0))):
        assert box_iou(cube, away) == 0
    eighth = box(np.zeros(3), np.array([2.0, 2, 2]), Rotation.from_euler("z", 45, degrees=True).as_matrix())
    assert intersection_volume(cube, eighth) == pytest.approx(2 * 8 * (2**0.5 - 1))  # a regular octagon, 2 high
    assert box_iou(straight((0, 0, 0), (0, 0, 0)), straight((0, 0, 0), (0, 0, 0))) == 0
