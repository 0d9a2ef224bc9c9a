"""The ScanNet protocol against a loop over points, and by hand."""

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


def loop(scene: scannet.SceneLabels, classes: int, first: bool, least: float) -> tuple[float, float]:
    """OpenGaussian's protocol, point by point: labels 1..C, 0 ignored, opacity rule, prediction of ignored points 0."""
    ids = scannet.CLASS_SETS[classes]
    columns = [list(scannet.NYU40).index(i) for i in ids]
    truth, found = [], []
    for j in range(len(scene.nyu40)):
        label = ids.index(int(scene.nyu40[j])) + 1 if int(scene.nyu40[j]) in ids else 0
        label = 0 if float(scene.opacity[j]) < least else label
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
    scenes = [random_scene(seed, n=30 + 200 * seed) for seed in range(3)]  # the first lacks classes
    for least, options in ((0.1, ScannetOptions()), (0.0, ScannetOptions(min_opacity=0.0))):
        evaluation = scannet.evaluate_scannet(scenes, options)
        found = evaluation.results
        for classes in scannet.CLASS_SETS:
            for suffix, first in (("", True), ("_none", False)):
                scores = [loop(scene, classes, first, least) for scene in scenes]
                miou, macc = (sum(part) / 3 for part in zip(*scores))
                assert found[f"miou_{classes}{suffix}"] == pytest.approx(miou, abs=1e-12)
                assert found[f"macc_{classes}{suffix}"] == pytest.approx(macc, abs=1e-12)
        assert found["macc_19"] != found["macc_19_none"]
        without = sum(float((~scene.valid).float().mean()) for scene in scenes) / 3
        assert found["without_direction_share"] == pytest.approx(without)
        counted = scenes[0].nyu40[scenes[0].opacity >= least].tolist()
        rows = {row["class"] for row in evaluation.rows if row["scene"] == "scene0"}
        assert rows == {name for i, name in scannet.NYU40.items() if i in counted} != set(scannet.NYU40.values())


def test_sets_are_those_of_the_protocol():
    assert [len(ids) for ids in scannet.CLASS_SETS.values()] == [19, 15, 10]
    most, some, few = ({scannet.NYU40[i] for i in ids} for ids in scannet.CLASS_SETS.values())
    assert most - some == {"picture", "refrigerator", "showercurtain", "bathtub"}
    assert some - few == {"cabinet", "counter", "desk", "curtain", "sink"}


def test_what_cannot_be_scored_is_refused(tmp_path):
    half = torch.full((3,), 0.5)
    scene = scannet.SceneLabels("s", torch.zeros(3, 19), half > 0, half, torch.tensor([1, 2, 3]))
    with pytest.raises(InputError, match=r" s .*--min-opacity"):
        scannet.evaluate_scannet([scene], ScannetOptions(min_opacity=1))
    scannet.check_identity("s", 4, np.zeros(4), tmp_path / "labels.ply")
    for count in (3, 5):
        with pytest.raises(InputError, match=rf"{count} Gaussians, .*labels\.ply has 4"):
            scannet.check_identity("s", count, np.zeros(4), tmp_path / "labels.ply")
