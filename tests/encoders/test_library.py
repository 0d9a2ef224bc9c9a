"""SAM 2 and HQ-SAM: ours against a call through transformers' own processor and model, in float64."""

import json
from pathlib import Path
from typing import Any

import pytest
import torch
import transformers
from PIL import Image

from normlift_ns.encoders.sam import folders
from normlift_ns.encoders.sam.library import load_network
from normlift_ns.encoders.sam.masks import LEVELS, MaskRules, SamMasks
from normlift_ns.encoders.sam.rules import Suppression
from tests.encoders.tiny_library import SIDE, write_tiny

KINDS = ("sam2", "sam_hq")
LOOSE = MaskRules(
    points_per_side=4, predicted_iou=-9.0, stability=0.05, region_area=5, suppression=Suppression(score=-9.0)
)


@pytest.fixture(scope="module")
def written(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("library")
    for kind in KINDS:
        write_tiny(folder / kind, kind)
    return folder


def photograph(height: int, width: int) -> torch.Tensor:
    """Smooth colours and an edge, so that resizing is well defined."""
    y, x = torch.meshgrid(torch.linspace(0, 1, height), torch.linspace(0, 1, width), indexing="ij")
    image = torch.stack([(6 * x).sin() ** 2, (5 * y + x).cos() ** 2, ((x - 0.4) ** 2 + (y - 0.6) ** 2 < 0.06).float()])
    return (255 * image).round().to(torch.uint8).permute(1, 2, 0)


@pytest.mark.parametrize("size", [(60, 90), (70, 40), (64, 64)])
@pytest.mark.parametrize("kind", KINDS)
def test_answers_are_those_of_transformers(written, kind, size):
    image, points = photograph(*size), torch.tensor([[3.0, 5.0], [20.5, 30.0], [39.0, 12.0], [10.0, 59.0]])
    network = load_network(str(written / kind), "cpu")
    (embedding,) = network.embed(network.pixels([image]))
    logits, ious = map(torch.cat, zip(*network.prompt(embedding, points.double(), size)))

    processor: Any
    if kind == "sam2":
        inside = transformers.Sam2ImageProcessor(size={"height": SIDE, "width": SIDE})
        processor, model = transformers.Sam2Processor(inside), transformers.Sam2Model.from_pretrained(written / kind)
    else:
        inside = transformers.SamImageProcessor(size={"longest_edge": SIDE}, pad_size={"height": SIDE, "width": SIDE})
        processor, model = transformers.SamHQProcessor(inside), transformers.SamHQModel.from_pretrained(written / kind)
    given = {"input_points": [[[p] for p in points.tolist()]], "input_labels": [[[1]] * len(points)]}
    inputs = processor(images=Image.fromarray(image.numpy()), **given, return_tensors="pt")
    sizes = {name: inputs.pop(name) for name in ("original_sizes", "reshaped_input_sizes") if name in inputs}
    exact = {name: x.double() if x.is_floating_point() else x for name, x in inputs.items()}
    with torch.no_grad():
        found = model.double()(**exact, multimask_output=True)
    expected, scores = found.pred_masks[0], found.iou_scores[0]
    if kind == "sam_hq":  # sorted by score there, in the order of the decoder here
        order = ious.sort(dim=1, descending=True).indices
        logits, ious = logits.take_along_dim(order[..., None, None], dim=1), ious.take_along_dim(order, dim=1)
        assert order.tolist() != [[0, 1, 2]] * len(points)  # ours would be sorted too
    scale = float(expected.abs().max())
    assert scale > 1
    torch.testing.assert_close(ious.double(), scores, rtol=0, atol=1e-5)
    torch.testing.assert_close(logits.double(), expected, rtol=0, atol=2e-5 * scale)
    large = processor.post_process_masks([expected.float()], *sizes.values(), binarize=False)[0]
    ours = network.enlarge(logits.flatten(0, 1), size)
    torch.testing.assert_close(ours, large.flatten(0, 1).float(), rtol=0, atol=3e-5 * scale)


@pytest.mark.parametrize("kind", KINDS)
def test_levels_are_the_three_masks_of_a_point(written, kind):
    sam, image = SamMasks(str(written / kind), rules=LOOSE), photograph(60, 90)
    masks = sam.masks(image)
    assert list(masks) == list(LEVELS) and all(len(level) > 0 for level in masks.values())
    assert not torch.equal(masks["s"][0], masks["l"][0])
    labels = sam.labels(image, "a.jpg")
    assert labels.shape[0] == 4 and labels.shape[2:] == (60, 90)
    assert torch.equal(labels, SamMasks(str(written / kind), rules=LOOSE).labels(image, "a.jpg"))


def test_checkpoints_for_video_hold_the_model_for_images(written, tmp_path):
    """Those of SAM 2.1 that are published: config.json says sam2_video, and the weights are more."""
    video = write_tiny(tmp_path / "video", "sam2_video")
    network = load_network(str(tmp_path / "video"), "cpu")
    state = video.state_dict()
    mine = network._model.state_dict()
    assert type(network._model).__name__ == "Sam2Model" and len(mine) < len(state)
    assert all(torch.equal(value, state[name]) for name, value in mine.items())


def test_old_versions_are_refused_with_what_works(written, monkeypatch):
    for kind, name in (("sam2", "SAM 2"), ("sam_hq", "HQ-SAM")):
        with monkeypatch.context() as patch:
            patch.setattr(torch, "__version__", "2.5.1+cu121")
            with pytest.raises(
                ValueError, match=f"{name} needs torch 2.6 or newer, this is 2.5.1.*sam_vit_h_4b8939.pth"
            ):
                SamMasks(str(written / kind))
    monkeypatch.delattr(transformers.models.sam2, "Sam2Model", raising=False)
    old = type("Old", (), {"__version__": "4.50.0"})
    monkeypatch.setattr(folders, "import_transformers", lambda: old)
    with pytest.raises(ValueError, match=r"SAM 2 needs transformers 4\.56 or newer, this is 4\.50\.0"):
        SamMasks(str(written / "sam2"))


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        ("pickle", r"the folder has no model\.safetensors"),
        ("backbone", "vision_config.backbone_config of config.json is of model type 'bert'"),
        ("huge", "blocks_per_stage|num_.* of config.json is|at most"),
        ("lacking", "lacks 1 parameters"),
    ],
)
def test_folders_that_are_not_what_they_say(written, tmp_path, damage, message):
    model = write_tiny(tmp_path, "sam2")
    config = json.loads((tmp_path / "config.json").read_text())
    if damage == "pickle":
        (tmp_path / "model.safetensors").unlink()
        torch.save(model.state_dict(), tmp_path / "pytorch_model.bin")
    elif damage == "backbone":
        config["vision_config"]["backbone_config"]["model_type"] = "bert"
    elif damage == "huge":
        config["vision_config"]["fpn_hidden_size"] = 10**9
    else:
        state = {name: value for name, value in model.state_dict().items() if name != "no_memory_embedding"}
        model.save_pretrained(tmp_path, state_dict=state)
    (tmp_path / "config.json").write_text(json.dumps(config))
    with pytest.raises(ValueError, match=message) as info:
        SamMasks(str(tmp_path)).masks(photograph(30, 40))
    assert str(tmp_path) in str(info.value) and "\n" not in str(info.value)
