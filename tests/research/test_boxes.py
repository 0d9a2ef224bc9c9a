"""Oriented boxes, and how far two of them agree."""

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image
from scipy.spatial.transform import Rotation

from benchmarks.box_overlap import box_iou, half_spaces, intersection_volume
from benchmarks.boxes import box_scores
from benchmarks.captures import SHARED, all_cameras, trained_scene, training_indices
from normlift_ns import InputError, SemanticField, lift, rasterize_evidence
from normlift_ns.asking import answer
from normlift_ns.evaluation.instance_masks import gaussian_truth
from normlift_ns.objects.boxes import OrientedBox, oriented_box
from normlift_ns.question import Question
from tests.captures import needs_shared


def cuboid(seed: int, count: int = 3000, size: tuple[float, float, float] = (4.0, 2.0, 1.0)) -> np.ndarray:
    return (np.random.default_rng(seed).random((count, 3)) - 0.5) * size


def turned(seed: int) -> np.ndarray:
    return Rotation.random(random_state=seed).as_matrix()


@given(st.integers(0, 2**16), st.floats(0.01, 100))
@settings(max_examples=20, deadline=None)
def test_the_box_of_a_turned_cuboid_is_the_cuboid(seed, scale):
    rotation, shift = turned(seed), np.array([3.0, -2, 7])
    box = oriented_box(scale * cuboid(seed) @ rotation.T + shift)
    truth = OrientedBox(shift, scale * 0.98 * np.array([4.0, 2, 1]), rotation.T)  # 1 % is cut off at each end
    assert box_iou(box, truth) > 0.9
    assert np.allclose(box.axes @ box.axes.T, np.eye(3), atol=1e-9)
    assert np.linalg.det(box.axes) == pytest.approx(1)
    assert (np.diff(box.size) <= 0).all()


def test_strays_decide_nothing():
    """One Gaussian in 120, as far away as it likes; without percentiles each would stretch the box to itself."""
    points = cuboid(1, 6000) @ turned(1).T
    clean = oriented_box(points)
    far = np.random.default_rng(2).normal(size=(50, 3))
    for distance in (6.0, 1e3, 1e6):
        strays = distance * far / np.linalg.norm(far, axis=1, keepdims=True)
        assert box_iou(oriented_box(np.concatenate([points, strays])), clean) > 0.93
    one = np.concatenate([points, [[1e9, 1e9, -1e9]]])
    assert box_iou(oriented_box(one), clean) > 0.97


def test_the_box_reaches_from_percentile_to_percentile_of_all_points():
    points = cuboid(3) @ turned(3).T
    box = oriented_box(points)
    along = (points - box.center) @ box.axes.T
    for k in range(3):
        assert np.quantile(along[:, k], [0.01, 0.99]) == pytest.approx([-box.size[k] / 2, box.size[k] / 2], abs=1e-9)


def test_points_lines_and_planes_have_boxes():
    line = np.linspace(0, 1, 101)[:, None] * [[2.0, 2, 0]]
    assert oriented_box(line).size == pytest.approx([0.98 * 8**0.5, 0, 0], abs=1e-9)
    plane = cuboid(4) * [1, 1, 0]
    assert oriented_box(plane).size[2] == pytest.approx(0, abs=1e-9)
    assert oriented_box(np.ones((5, 3))).size.tolist() == [0, 0, 0]
    assert oriented_box(np.array([[1.0, 2, 3]])).center.tolist() == pytest.approx([1, 2, 3])
    for wrong in (np.empty((0, 3)), np.array([[np.nan, 0, 0]])):
        with pytest.raises(InputError, match="a box needs points that are finite"):
            oriented_box(wrong)


def test_boxes_move_with_their_points():
    points, rotation = cuboid(5), turned(5)
    moved = oriented_box(points).moved(rotation, 3.0, np.array([1.0, 2, 3]))
    again = oriented_box(3 * points @ rotation.T + [1, 2, 3])
    assert box_iou(moved, again) > 0.95
    inside = half_spaces(moved) @ np.append(moved.center, 1)
    assert inside == pytest.approx(np.repeat(-moved.size[None] / 2, 2, 0).ravel())
    assert np.abs(half_spaces(moved)[:, :3] @ moved.corners.T + half_spaces(moved)[:, 3:]).min(0).max() < 1e-9


def straight(center: tuple[float, float, float], size: tuple[float, float, float]) -> OrientedBox:
    return OrientedBox(np.array(center, float), np.array(size, float), np.eye(3))


def test_intersections_that_are_known():
    cube = straight((0, 0, 0), (2, 2, 2))
    assert intersection_volume(cube, cube) == pytest.approx(8)
    assert intersection_volume(cube, straight((1, 1, 1), (2, 2, 2))) == pytest.approx(1)
    assert box_iou(cube, straight((1, 0, 0), (2, 2, 2))) == pytest.approx(4 / 12)
    assert box_iou(cube, straight((0.5, 0, 0), (1, 2, 2))) == pytest.approx(0.5)
    for away in (straight((2, 0, 0), (2, 2, 2)), straight((9, 0, 0), (2, 2, 2)), straight((0, 0, 0), (2, 2, 0))):
        assert box_iou(cube, away) == 0
    eighth = OrientedBox(np.zeros(3), np.array([2.0, 2, 2]), Rotation.from_euler("z", 45, degrees=True).as_matrix())
    assert intersection_volume(cube, eighth) == pytest.approx(2 * 8 * (2**0.5 - 1))  # a regular octagon, 2 high
    assert box_iou(straight((0, 0, 0), (0, 0, 0)), straight((0, 0, 0), (0, 0, 0))) == 0


@given(st.integers(0, 2**16))
@settings(max_examples=15, deadline=None)
def test_intersection_is_that_of_sampling(seed):
    g = np.random.default_rng(seed)
    first, second = (
        OrientedBox(0.5 * g.normal(size=3), np.sort(0.5 + g.random(3))[::-1], turned(seed + i)) for i in range(2)
    )
    points = (g.random((20000, 3)) - 0.5) * first.size @ first.axes + first.center
    inside = (half_spaces(second) @ np.column_stack([points, np.ones(len(points))]).T <= 0).all(axis=0)
    expected = inside.mean() * first.size.prod()
    assert intersection_volume(first, second) == pytest.approx(expected, abs=0.02 * first.size.prod())
    assert intersection_volume(first, second) == pytest.approx(intersection_volume(second, first), rel=1e-6, abs=1e-9)


@needs_shared
@pytest.mark.slow
def test_boxes_of_the_tabletop_from_exact_masks():
    """Twelve objects in sixteen views, as in docs/objects.md."""
    scene, cameras, train, classes = (
        trained_scene("tabletop"),
        all_cameras("tabletop"),
        training_indices("tabletop"),
        12,
    )
    chosen = [train[i] for i in np.linspace(0, len(train) - 1, 16).round().astype(int)]
    folder = SHARED / "captures" / "tabletop" / "instance"
    maps = [torch.from_numpy(np.array(Image.open(folder / f"{i:04d}.png")).astype(np.int32)) for i in chosen]
    how = {"num_regions": [classes] * len(chosen)}
    evidence = rasterize_evidence(scene, [cameras[i] for i in chosen], [labels - 1 for labels in maps], **how)
    truth = gaussian_truth(evidence, classes)
    lifted = lift(evidence, torch.eye(classes).repeat(len(chosen), 1))
    field = SemanticField.build(lifted, scene.means)
    texts = tuple(map(str, range(classes)))
    found = answer(field, scene.means, Question(texts, np.eye(classes), rule="cosine", threshold=0.5))
    scores = box_scores(scene.means, truth, found)
    print([round(score, 2) for score in scores])
    assert sum(scores) / classes >= 0.7
