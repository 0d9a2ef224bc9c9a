"""Objects are connected components of what is selected, and have oriented boxes."""

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from normlift_ns import InputError
from normlift_ns.analysis import objects
from research.box_overlap import box_iou, half_spaces
from tests.examples import examples
from tests.random_scenes import generator


def blob(count: int, centre: tuple[float, float, float], seed: int) -> torch.Tensor:
    return torch.rand(count, 3, generator=generator(seed)) + torch.tensor(centre)


def test_blobs_apart_are_objects_by_size_whatever_scale_and_order():
    means = torch.cat([blob(60, (0, 0, 0), 0), blob(150, (5, 0, 0), 1), blob(20, (0, 9, 0), 2)])
    every, order = torch.ones(230, dtype=torch.bool), torch.randperm(230, generator=generator(6))
    labels = objects.connected_components(means, every)
    truth = torch.tensor([1] * 60 + [0] * 150 + [2] * 20)
    assert (labels == truth).float().mean() > 0.97
    sizes = torch.bincount(labels[labels >= 0])
    assert sizes.diff().le(0).all()
    assert torch.equal(objects.connected_components(1000 * means, every), labels)
    shuffled = objects.connected_components(means[order], every)
    assert torch.equal(torch.bincount(shuffled[shuffled >= 0]), sizes)


def test_only_what_is_selected_connects():
    line = torch.arange(30)[:, None] * torch.tensor([[1.0, 0, 0]])
    selected = torch.ones(30, dtype=torch.bool)
    assert objects.connected_components(line, selected).tolist() == [0] * 30
    selected[10:16] = False
    assert objects.connected_components(line, selected).tolist() == [1] * 10 + [-1] * 6 + [0] * 14
    assert objects.connected_components(line, selected, max_gap=8.0).tolist() == [0] * 10 + [-1] * 6 + [0] * 14


def test_parts_smaller_than_one_gaussian_are_refused():
    means, every = torch.rand(4, 3), torch.ones(4, 1)
    for min_size in (0, 1.5):
        with pytest.raises(InputError, match="object_min_gaussians"):
            objects.find_objects(None, means, every[:, 0] > 0, min_gaussians=min_size)
        with pytest.raises(InputError, match="object_min_gaussians"):
            objects.find_instances(("a",), means, every, every > 0, min_gaussians=min_size)


def test_further_prompts_change_no_number_of_an_object():
    means = torch.cat([blob(60, (0, 0, 0), 1), blob(40, (9, 0, 0), 2), blob(30, (18, 0, 0), 3)])
    g = generator(4)
    relevancy, selected = torch.rand(130, 3, generator=g), torch.rand(130, 3, generator=g) < 0.95
    texts = ("a", "b", "c")
    alone = objects.find_instances(texts[:1], means, relevancy[:, :1], selected[:, :1], max_gap=3.0)
    together = objects.find_instances(texts, means, relevancy, selected, max_gap=3.0)
    assert together.classes[: len(alone.classes)] == alone.classes == (1, 1, 1)
    of_first = together.class_id == 1
    assert 0 < int(of_first.sum()) < 80
    assert torch.equal(together.instance_id[of_first], alone.instance_id[of_first])
    relevancy[:, 0] = 0.0  # the other prompts take all
    taken = objects.find_instances(texts, means, relevancy, selected | torch.tensor([False, True, False]), max_gap=3.0)
    assert taken.classes[:3] == (1, 1, 1) and not bool((taken.class_id == 1).any())


def test_nothing_one_and_the_same_place():
    means = torch.tensor([[0.0, 0, 0], [0, 0, 0], [torch.nan, 0, 0], [1, 1, 1]])
    none = torch.zeros(4, dtype=torch.bool)
    assert objects.connected_components(means, none).tolist() == [-1] * 4
    assert objects.connected_components(means, torch.tensor([False, False, True, True])).tolist() == [-1, -1, -1, 0]
    assert objects.connected_components(means, torch.tensor([True, True, True, False])).tolist() == [0, 0, -1, -1]


def cuboid(seed: int, count: int = 3000, size: tuple[float, float, float] = (4.0, 2.0, 1.0)) -> np.ndarray:
    return (np.random.default_rng(seed).random((count, 3)) - 0.5) * size


def turned(seed: int) -> np.ndarray:
    return Rotation.random(random_state=seed).as_matrix()


@examples(5)
@given(st.integers(0, 2**16), st.floats(0.01, 100))
def test_the_box_of_a_turned_cuboid_is_the_cuboid(seed, scale):
    rotation, shift = turned(seed), np.array([3.0, -2, 7])
    points = scale * cuboid(seed, 12_000) @ rotation.T + shift
    box = objects.oriented_box(points)
    sizes = scale * 0.98 * np.array([4.0, 2, 1])  # 1 % is cut off at each end
    truth = objects.OrientedBox(*map(torch.from_numpy, (shift, sizes, rotation.T)))
    assert box_iou(box, truth) > 0.88
    assert np.allclose(box.axes @ box.axes.T, np.eye(3), atol=1e-9)
    assert np.linalg.det(box.axes) == pytest.approx(1)
    assert (np.diff(box.size) <= 0).all()
    along, half = (points - box.center.numpy()) @ box.axes.numpy().T, box.size.numpy() / 2
    assert np.quantile(along, [0.01, 0.99], axis=0) == pytest.approx(np.stack([-half, half]), abs=1e-9 * scale)


def test_strays_decide_nothing():
    """One Gaussian in 120, as far away as it likes."""
    points = cuboid(1, 6000) @ turned(1).T
    clean = objects.oriented_box(points)
    far = np.random.default_rng(2).normal(size=(50, 3))
    for distance in (6.0, 1e3, 1e6):
        strays = distance * far / np.linalg.norm(far, axis=1, keepdims=True)
        assert box_iou(objects.oriented_box(np.concatenate([points, strays])), clean) > 0.93


def test_points_lines_and_planes_have_boxes():
    line = np.linspace(0, 1, 101)[:, None] * [[2.0, 2, 0]]
    assert objects.oriented_box(line).size.tolist() == pytest.approx([0.98 * 8**0.5, 0, 0], abs=1e-9)
    plane = cuboid(4) * [1, 1, 0]
    assert float(objects.oriented_box(plane).size[2]) == pytest.approx(0, abs=1e-9)
    assert objects.oriented_box(np.ones((5, 3))).size.tolist() == [0, 0, 0]
    assert objects.oriented_box(np.array([[1.0, 2, 3]])).center.tolist() == pytest.approx([1, 2, 3])
    for wrong in (np.empty((0, 3)), np.array([[np.nan, 0, 0]])):
        with pytest.raises(InputError, match="finite"):
            objects.oriented_box(wrong)


def test_boxes_move_with_their_points():
    points, rotation = cuboid(5), turned(5)
    moved = objects.oriented_box(points).transformed(objects.SimilarityTransform(rotation, 3.0, np.array([1.0, 2, 3])))
    again = objects.oriented_box(3 * points @ rotation.T + [1, 2, 3])
    assert box_iou(moved, again) > 0.95
    inside = half_spaces(moved) @ np.append(moved.center.numpy(), 1)
    assert inside == pytest.approx(np.repeat(-moved.size.numpy()[None] / 2, 2, 0).ravel())
    assert np.abs(half_spaces(moved)[:, :3] @ moved.corners.numpy().T + half_spaces(moved)[:, 3:]).min(0).max() < 1e-9
