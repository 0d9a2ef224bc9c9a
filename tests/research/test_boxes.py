"""How far two oriented boxes agree."""

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image
from scipy.spatial.transform import Rotation

from benchmarks.box_overlap import box_iou, half_spaces, intersection_volume
from benchmarks.boxes import box_scores
from benchmarks.captures import SHARED, all_cameras, trained_scene, training_indices
from normlift_ns import SemanticField, lift, rasterize_evidence
from normlift_ns.asking import answer
from normlift_ns.evaluation.instance_masks import gaussian_truth
from normlift_ns.objects.boxes import OrientedBox
from normlift_ns.question import Question
from tests.captures import needs_shared
from tests.examples import examples


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


@examples(15)
@given(st.integers(0, 2**16))
def test_intersection_is_that_of_sampling(seed):
    g = np.random.default_rng(seed)
    first, second = (
        OrientedBox(
            0.5 * g.normal(size=3), np.sort(0.5 + g.random(3))[::-1], Rotation.random(random_state=seed + i).as_matrix()
        )
        for i in range(2)
    )
    points = (g.random((20000, 3)) - 0.5) * first.size @ first.axes + first.center
    inside = (half_spaces(second) @ np.column_stack([points, np.ones(len(points))]).T <= 0).all(axis=0)
    expected = inside.mean() * first.size.prod()
    assert intersection_volume(first, second) == pytest.approx(expected, abs=0.02 * first.size.prod())
    assert intersection_volume(first, second) == pytest.approx(intersection_volume(second, first), rel=1e-6, abs=1e-9)


@needs_shared
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
