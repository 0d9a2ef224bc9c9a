"""SAM 2 and HQ-SAM: ours against a call through transformers' own processor and model, in float64."""

import json
from pathlib import Path
from typing import Any

import pytest
import torch
from PIL import Image

from normlift_ns.segmentation.mask_filtering import Suppression
from normlift_ns.segmentation.sam import MaskRules, SamMasks, load_sam_network
from normlift_ns.segmentation.sam3 import Sam3Masks
from tests.encoders.tiny import copied, refused
from tests.segmentation.tiny_sam import SIDE, write_tiny

LOOSE = MaskRules(
    points_per_side=4, predicted_iou=-9.0, stability=0.05, region_area=5, suppression=Suppression(score=-9.0)
)


def photograph(height: int, width: int) -> torch.Tensor:
    """Smooth colours and an edge, so that resizing is well defined."""
    y, x = torch.meshgrid(torch.linspace(0, 1, height), torch.linspace(0, 1, width), indexing="ij")
    image = torch.stack([(6 * x).sin() ** 2, (5 * y + x).cos() ** 2, ((x - 0.4) ** 2 + (y - 0.6) ** 2 < 0.06).float()])
    return (255 * image).round().to(torch.uint8).permute(1, 2, 0)


@pytest.mark.parametrize("kind", ["sam2", "sam_hq"])
def test_answers_are_those_of_transformers(library_weights: Path, kind: str, transformers: Any) -> None:
    folder, points = library_weights / kind, torch.tensor([[3.0, 5.0], [20.5, 30.0], [39.0, 12.0], [10.0, 59.0]])
    network = load_sam_network(str(folder), "cpu")
    side = {"height": SIDE, "width": SIDE}
    if kind == "sam2":
        inside, wrapper, made = transformers.Sam2ImageProcessor(size=side), "Sam2Processor", "Sam2Model"
    else:
        inside = transformers.SamImageProcessor(size={"longest_edge": SIDE}, pad_size=side)
        wrapper, made = "SamHQProcessor", "SamHQModel"
    processor, model = getattr(transformers, wrapper)(inside), getattr(transformers, made).from_pretrained(folder)
    model = model.double()
    for size in ((60, 90), (70, 40), (64, 64)):
        image = photograph(*size)
        (embedding,) = network.embed(network.pixels([image]))
        logits, ious = map(torch.cat, zip(*network.prompt(embedding, points.double(), size)))
        given = {"input_points": [[[p] for p in points.tolist()]], "input_labels": [[[1]] * len(points)]}
        inputs = processor(images=Image.fromarray(image.numpy()), **given, return_tensors="pt")
        sizes = {name: inputs.pop(name) for name in ("original_sizes", "reshaped_input_sizes") if name in inputs}
        exact = {name: x.double() if x.is_floating_point() else x for name, x in inputs.items()}
        with torch.no_grad():
            found = model(**exact, multimask_output=True)
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


def test_checkpoints_for_video_hold_the_model_for_images(tmp_path: Path) -> None:
    """Those of SAM 2.1 that are published: config.json says sam2_video, and the weights are more."""
    state = write_tiny(tmp_path, "sam2_video").state_dict()
    network = load_sam_network(str(tmp_path), "cpu")
    mine = network._model.state_dict()
    assert type(network._model).__name__ == "Sam2Model" and len(mine) < len(state)
    assert all(torch.equal(value, state[name]) for name, value in mine.items())


def test_old_versions_are_refused_with_what_works(library_weights: Path, monkeypatch: Any) -> None:
    versions = {"torch": "2.5.1+cu121", "transformers": "4.50.0"}
    monkeypatch.setattr("normlift_ns.encoders.weights.version", lambda package: versions[package])
    for kind, name in (("sam2", "SAM 2"), ("sam_hq", "HQ-SAM")):
        parts = (name, "torch 2.6", "2.5.1", "sam_vit_h_4b8939.pth")
        refused(lambda kind=kind: SamMasks(str(library_weights / kind)), *parts)
    refused(lambda: Sam3Masks(("mug",), str(library_weights / "sam3")), "SAM 3", "torch 2.6", "2.5.1")
    versions["torch"] = "2.6.0"
    refused(lambda: SamMasks(str(library_weights / "sam2")), "SAM 2", "transformers 4.56", "4.50.0")


def test_folders_that_are_not_what_they_say(library_weights: Path, tmp_path: Path) -> None:
    config = copied(library_weights / "sam2", tmp_path) / "config.json"
    whole = json.loads(config.read_text())
    for values, parts in (
        ({"backbone_config": {"model_type": "bert"}}, ["vision_config.backbone_config", "'bert'"]),
        ({"fpn_hidden_size": 10**9}, ["fpn_hidden_size of config.json is 1000000000"]),
        ({"num_labels": 2**31}, ["num_labels of config.json is "]),
        ({"layer_norm_eps": 1e300}, ["layer_norm_eps of config.json is "]),
    ):
        config.write_text(json.dumps(whole | {"vision_config": whole["vision_config"] | values}))
        refused(lambda: SamMasks(str(tmp_path)).masks(photograph(30, 40)), str(tmp_path), *parts)
