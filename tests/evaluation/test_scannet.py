"""The ScanNet protocol against a loop over points, and by hand."""

import math

import numpy as np
import pytest
import torch

from normlift_ns.errors import InputError
from normlift_ns.evaluation import scannet
from normlift_ns.evaluation.options import ScannetOptions
from tests.random_scenes import generator


def random_scene(seed: int, n: int = 400) -> scannet.SceneLabels:
    g = generator(seed)
    cosine = torch.rand(n, 19, generator=g)
    valid = torch.rand(n, generator=g) > 0.2
    nyu40 = torch.randint(0, 41, (n,), generator=g)
    seen = torch.where(valid[:, None], cosine, 0.0)
    return scannet.SceneLabels(f"scene{seed}", seen, valid, torch.rand(n, generator=g), nyu40)


def loop(scene: scannet.SceneLabels, classes: int, first: bool) -> tuple[float, float]:
    """OpenGaussian's protocol, point by point: labels 1..C, 0 ignored, opacity rule, prediction of ignored points 0."""
    ids = scannet.CLASS_SETS[classes]
    columns = [list(scannet.NYU40).index(i) for i in ids]
    truth, found = [], []
    for j in range(len(scene.nyu40)):
        label = ids.index(int(scene.nyu40[j])) + 1 if int(scene.nyu40[j]) in ids else 0
        label = 0 if float(scene.opacity[j]) < 0.1 else label
        scores = [float(scene.cosine[j, c]) for c in columns]
        answer = scores.index(max(scores)) + 1  # all 0 without direction: class 1
        answer = answer if first or bool(scene.valid[j]) else -1
        truth.append(label)
        found.append(answer if label > 0 else 0)
    ious, recalls = [], []
    for c in range(1, classes + 1):
        hits = sum(t == c and f == c for t, f in zip(truth, found))
        union = sum(c in (t, f) for t, f in zip(truth, found))
        if c in truth:
            ious.append(hits / union)
            recalls.append(hits / truth.count(c))
    return sum(ious) / len(ious), sum(recalls) / len(recalls)


def test_equals_the_loop():
    scenes = [random_scene(seed, n=150 + 100 * seed) for seed in range(3)]
    found = scannet.evaluate_scannet(scenes, ScannetOptions()).results
    for classes in scannet.CLASS_SETS:
        for suffix, first in (("", True), ("_none", False)):
            miou, macc = (sum(part) / 3 for part in zip(*(loop(scene, classes, first) for scene in scenes)))
            assert found[f"miou_{classes}{suffix}"] == pytest.approx(miou, abs=1e-12)
            assert found[f"macc_{classes}{suffix}"] == pytest.approx(macc, abs=1e-12)
        assert found[f"miou_{classes}"] != found[f"miou_{classes}_none"]


def test_sets_are_those_of_the_protocol():
    assert [len(ids) for ids in scannet.CLASS_SETS.values()] == [19, 15, 10]
    most, some, few = ({scannet.NYU40[i] for i in ids} for ids in scannet.CLASS_SETS.values())
    assert most - some == {"picture", "refrigerator", "showercurtain", "bathtub"}
    assert some - few == {"cabinet", "counter", "desk", "curtain", "sink"}


def test_opacity_absent_classes_and_missing_directions_by_hand():
    names = list(scannet.NYU40)
    nyu40 = torch.tensor([1, 2, 2, 5, 40, 2])  # wall, floor, floor, chair, a class outside all sets, floor
    cosine = torch.zeros(6, 19)
    for j, seen in enumerate((1, 2, 5, 5, 5)):
        cosine[j, names.index(seen)] = 0.3
    valid = torch.tensor([True, True, True, True, True, False])
    opacity = torch.tensor([0.9, 0.9, 0.9, 0.05, 0.9, 0.9])  # the chair is too faint to count
    scene = scannet.SceneLabels("s", cosine, valid, opacity, nyu40)
    scores = scannet.scene_scores(scene, 10)
    assert scores.iou[0] == 1 / 2  # the last floor, never seen, is called wall
    assert scores.iou[1] == 1 / 3
    assert scores.iou[2:].isnan().all()  # no chair that counts; the floor called chair hurts the floor alone
    assert scannet.scene_scores(scene, 10, without_direction="none").iou[0] == 1
    assert scannet.scene_scores(scene, 10, min_opacity=0).iou[3] == 1 / 2
    evaluation = scannet.evaluate_scannet([scene], ScannetOptions())
    assert {row["class"] for row in evaluation.rows} == {"wall", "floor"}
    assert evaluation.results["without_direction_share"] == pytest.approx(1 / 6)
    assert not any(math.isnan(value) for value in evaluation.results.values())


def test_what_cannot_be_scored_is_refused(tmp_path):
    scene = scannet.SceneLabels(
        "s", torch.zeros(3, 19), torch.ones(3).bool(), torch.full((3,), 0.5), torch.tensor([1, 2, 3])
    )
    with pytest.raises(InputError, match=r" s .*--min-opacity"):
        scannet.evaluate_scannet([scene], ScannetOptions(min_opacity=1))
    scannet.check_identity("s", 4, np.zeros(4), tmp_path / "labels.ply")
    for count in (3, 5):
        with pytest.raises(InputError, match=rf"{count} Gaussians, .*labels\.ply has 4"):
            scannet.check_identity("s", count, np.zeros(4), tmp_path / "labels.ply")
