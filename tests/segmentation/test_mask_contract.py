"""What every source of masks promises, whatever network or file is behind it."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from PIL import Image
from safetensors.torch import load_file, save_file

from normlift_ns.encoders.cache import CachedRegions
from normlift_ns.segmentation import regions, sam3
from normlift_ns.segmentation.mask_filtering import Suppression
from normlift_ns.segmentation.regions import Grid, LabelFiles, Superpixels
from normlift_ns.segmentation.sam import SAM_LEVELS, SamMasks, load_sam_network
from normlift_ns.segmentation.sam3 import Sam3Masks, Sam3Network
from tests.encoders.test_contract import changed, cut
from tests.encoders.tiny import Largest, copied, refused
from tests.segmentation.test_edges import tiny_regions
from tests.segmentation.test_sam2 import LOOSE, photograph

EVERY = replace(LOOSE, box_iou=0.99, suppression=Suppression(iou=1.0, score=-9.0, outer=0.0, inner=2.0))
pytestmark = pytest.mark.usefixtures("unsure")
NETWORKS = ("sam", "sam2", "sam_hq", "sam3")
IMAGE, NAME = photograph(40, 60), "a.png"


@pytest.fixture(scope="module")
def folders(sam_weights, library_weights, tmp_path_factory) -> dict[str, Path]:
    files = tmp_path_factory.mktemp("files")
    values = np.array([0, 7, 3, 200], np.uint8)[(IMAGE[:, :, 0] // 64).numpy()]
    Image.fromarray(values).save(files / NAME)
    return {"sam": sam_weights / "eager", **{kind: library_weights / kind for kind in NETWORKS[1:]}, "files": files}


def make(kind: str, folder: Path) -> Any:
    if kind in NETWORKS:
        return Sam3Masks(("mug", "red mug"), str(folder)) if kind == "sam3" else SamMasks(str(folder), rules=EVERY)
    if kind == "edges":
        return tiny_regions()
    return {"files": LabelFiles(folder), "superpixel": Superpixels(20), "grid": Grid(20)}[kind]


@pytest.mark.parametrize("kind", (*NETWORKS, "edges", "files", "superpixel", "grid"))
def test_labels_have_no_gaps_and_repeat(folders, kind, tmp_path):
    folder = folders.get(kind, tmp_path)
    source = make(kind, folder)
    labels = source.labels(IMAGE, NAME)
    levels, depth, height, width = labels.shape
    assert labels.dtype == torch.int32 and (height, width) == IMAGE.shape[:2] and levels >= 1 and depth >= 1
    for level in labels:
        ids = level.unique()
        assert torch.equal(ids[ids >= 0], torch.arange(int(level.max()) + 1, dtype=torch.int32)) and int(ids[0]) >= -1
        beneath = (level[:-1] >= 0) | (level[1:] < 0)  # nothing lies beneath nothing
        assert bool(beneath.all())
    assert int(labels.max()) >= 0
    if kind in NETWORKS[:3]:
        masks = source.masks(IMAGE)
        assert tuple(masks) == SAM_LEVELS and levels == 4 and all(len(level) > 0 for level in masks.values())
        assert not torch.equal(masks["s"][0], masks["l"][0])  # of the three masks of a point
    assert max(source.chosen, default=0) < levels
    kept = CachedRegions(make(kind, folder), tmp_path)
    assert torch.equal(kept.labels(IMAGE.clone(), NAME), labels) and torch.equal(kept.labels(IMAGE, NAME), labels)
    assert json.loads(json.dumps(source.identity)) == source.identity


@pytest.mark.parametrize("kind", NETWORKS)
def test_identity_changes_with_any_weight(folders, kind, tmp_path):
    mine = make(kind, folders[kind]).identity
    assert make(kind, copied(folders[kind], tmp_path)).identity == mine  # wherever it lies
    state = load_file(tmp_path / "model.safetensors")
    for name in (min(state), max(state)):
        changed = {key: value.clone() for key, value in state.items()}
        changed[name].view(-1)[-1] += 1e-3
        save_file(changed, tmp_path / "model.safetensors")
        assert make(kind, tmp_path).identity != mine
    assert replace(make(kind, folders[kind]), precision="bfloat16").identity != mine


@pytest.mark.parametrize("kind", NETWORKS)
def test_damaged_files_are_refused_by_name(folders, kind, tmp_path):
    def absent(folder: Path) -> None:
        (folder / "model.safetensors").unlink()

    def lacking(folder: Path) -> None:
        state = load_file(folder / "model.safetensors")
        state.pop(next(name for name in state if name.startswith("mask_decoder")))
        save_file(state, folder / "model.safetensors")

    part, name = ("detr_decoder_config", "layers") if kind == "sam3" else ("mask_decoder_config", "hidden_layers")
    longer = changed("config.json", part, **{f"num_{name}": 5})
    for number, damage in enumerate((cut("model.safetensors"), cut("config.json"), longer, lacking, absent)):
        folder = copied(folders[kind], tmp_path / str(number))
        damage(folder)
        parts = ["no model.safetensors"] if damage is absent else ["--regions patches"] if kind == "sam" else []
        refused(lambda folder=folder: make(kind, folder).labels(IMAGE, NAME), "SAM", str(folder), *parts)


@pytest.mark.parametrize("kind", NETWORKS[1:])  # of SAM: test_precision.py
def test_half_precision_is_within_its_error(folders, kind):
    """bfloat16 has 8 bits: answers of a few layers differ by some hundredths, more where weights are large."""
    folder, points = str(folders[kind]), torch.tensor([[20.0, 30.0], [70.0, 10.0]])
    answers = []
    for precision in ("float32", "bfloat16"):
        if kind == "sam3":
            network, out = Sam3Network.load(folder, "cpu", precision), []
            network._model.register_forward_hook(lambda module, given, found, out=out: out.append(found))
            network.segment(IMAGE, ["mug"])
            answers.append((out[0].pred_masks.float(), out[0].pred_logits.float()))
        else:
            network = load_sam_network(folder, "cpu", precision)
            (embedding,) = network.embed(network.pixels([IMAGE]))
            logits, ious = next(network.prompt(embedding, points, (60, 90)))
            answers.append((logits.float(), ious.float()))
    (exact, scores), (half, near) = answers
    error = float((half - exact).norm() / exact.norm())
    assert 0 < error < 0.15, error
    assert 0 < float((near - scores).abs().max()) < 0.15 * float(scores.abs().max())


@pytest.mark.parametrize("kind", NETWORKS)
def test_memory_on_a_cpu_is_that_of_a_batch_of_masks(folders, kind, monkeypatch):
    """However many masks there are, few are enlarged at a time."""
    image = photograph(150, 220)
    monkeypatch.setattr(sam3, "_TOGETHER", 2)
    monkeypatch.setitem(regions._MASK_CHUNK, "cpu", 2**17)  # of the suppression
    source = make(kind, folders[kind])
    if kind != "sam3":
        source = replace(source, rules=replace(EVERY, points_per_side=5))
        source.network.masks.batch_size = 4
    together = 2 if kind == "sam3" else 4
    _ = source.network
    with Largest() as largest:
        labels = source.labels(image, NAME)
    assert int(labels.max()) >= 0
    network = 75 * 3 * 32 * 32 if kind != "sam3" else 0  # all logits of a crop, at the resolution of the network
    assert largest.most <= max(together * max(image.shape[0] * image.shape[1], 128 * 128), network, 300_000)
