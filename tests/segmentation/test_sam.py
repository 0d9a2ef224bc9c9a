"""SAM's automatic masks: the real network with few random weights, against Meta's own implementation."""

import json
import sys
from dataclasses import replace
from importlib import import_module

import numpy as np
import pytest
import torch

from normlift_ns.segmentation.checkpoint import config_from_weights, load_sam_checkpoint, transformers_name
from normlift_ns.segmentation.mask_filtering import Suppression
from normlift_ns.segmentation.sam import SAM_LEVELS, MaskRules, SamMasks, SamNetwork, load_sam_network, point_grid
from tests.encoders.test_weights import put
from tests.encoders.tiny import SIDE, copied, needs_cuda, noise, refused, tiny_sam
from tests.segmentation.test_mask_filtering import nms_by_hand, pixels

EVERYTHING = Suppression(iou=1.0, score=-1.0, outer=0.0, inner=2.0)
LOOSE = MaskRules(points_per_side=6, predicted_iou=0.5, stability=0.3, suppression=Suppression(score=0.1))


def test_the_network_is_that_of_meta(sam_weights):
    meta, network = tiny_sam(seed=1), load_sam_network(str(sam_weights / "sam_tiny.pth"), "cpu")
    for size in ((96, 54), (128, 128), (40, 200)):
        image, predictor = noise(*size), import_module("segment_anything").SamPredictor(meta)
        predictor.set_image(image.numpy())
        (embedding,) = network.embed(network.pixels([image]))
        torch.testing.assert_close(embedding, predictor.features, rtol=0, atol=1e-5)
        points = point_grid(5) * torch.tensor([size[1], size[0]])
        logits, ious = map(torch.cat, zip(*network.prompt(embedding, points, size)))
        scaled = torch.from_numpy(predictor.transform.apply_coords(points.numpy(), size))[:, None]
        large, expected_ious, expected = predictor.predict_torch(scaled, torch.ones(25, 1), return_logits=True)
        close = 1e-5 * float(expected.abs().max())
        torch.testing.assert_close(logits, expected, rtol=0, atol=close)
        torch.testing.assert_close(ious, expected_ious, rtol=0, atol=1e-5)
        enlarged = network.enlarge(logits.flatten(0, 1), size)
        torch.testing.assert_close(enlarged, large.flatten(0, 1), rtol=0, atol=close)


def test_a_folder_a_file_and_a_download_of_the_same_weights_agree(sam_weights, empty_hub):
    for file in (sam_weights / "tiny").iterdir():
        put(empty_hub, "someone/tiny", file.name, file.read_bytes())
    expected = load_sam_checkpoint(str(sam_weights / "sam_tiny.pth"))[1].state_dict()
    for place in (sam_weights / "tiny", sam_weights / "tiny" / "model.safetensors", "someone/tiny"):
        found = load_sam_checkpoint(str(place))[1].state_dict()
        assert set(found) == set(expected) and all(torch.equal(found[name], expected[name]) for name in found)


def test_a_config_names_no_code(sam_weights, tmp_path):
    """Keys that make transformers import or download code have no effect."""
    config = copied(sam_weights / "tiny", tmp_path) / "config.json"
    named = {"auto_map": {"AutoModel": "evil.M"}, "attn_implementation": "some/kernel", "_attn_implementation": "x/y"}
    config.write_text(json.dumps(json.loads(config.read_text()) | named))
    model = load_sam_checkpoint(str(tmp_path))[1]
    assert model.config.to_dict().keys().isdisjoint(named)
    assert model.config._attn_implementation in (None, "eager", "sdpa")


def test_metas_files_fit(transformers):
    """Names and shapes of all parameters, without any weights."""
    for kind in ("vit_b", "vit_l", "vit_h"):
        with torch.device("meta"):
            state = import_module("segment_anything").sam_model_registry[kind]().state_dict()
            expected = transformers.SamModel(config_from_weights(state)).state_dict()
        found = {transformers_name(name): value.shape for name, value in state.items()}
        assert {name: value.shape for name, value in expected.items() if not name.startswith("shared_image")} == found


def blobs(points: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """In place of the mask decoder: blobs of three sizes around points, with ragged edges, holes and specks."""
    p = points.double().round(decimals=3)[:, None, None, None, :] / SIDE
    line = (torch.arange(32, dtype=torch.float64) + 0.5) / 32
    y, x = torch.meshgrid(line, line, indexing="ij")
    radius = torch.tensor([0.08, 0.13, 0.2])[:, None, None] * (1 + 0.5 * torch.sin(9 * p[..., 0] + 5 * p[..., 1]))
    waves = torch.sin(40 * x + 17 * p[..., 0]) * torch.sin(31 * y + 23 * p[..., 1])
    distance = ((x - p[..., 0]) ** 2 + (y - p[..., 1]) ** 2).sqrt()
    score = 0.75 + 0.25 * torch.sin(13 * p[:, 0, 0, :, 0] + 29 * p[:, 0, 0, :, 1] + torch.arange(3))
    return (200 * (radius - distance) + 9 * waves).float(), score.float()


@pytest.mark.parametrize("size", [(75, 55), pytest.param((70, 120), marks=pytest.mark.extra)])
def test_the_masks_are_those_of_metas_generator(sam_weights, monkeypatch, size):
    """Same masks in the same order, level by level, for the same answers of the network; then LangSplat's rules."""
    monkeypatch.setattr(SamNetwork, "decode", lambda self, embedding, points: blobs(points))
    rules = MaskRules(points_per_side=5, predicted_iou=0.6, stability=0.6, edge=20, region_area=15)
    image = noise(*size)
    kept = SamMasks(str(sam_weights / "tiny"), rules=replace(rules, suppression=EVERYTHING)).masks(image)
    chosen = SamMasks(str(sam_weights / "tiny"), rules=rules).masks(image)

    same = {"points_per_side": 5, "pred_iou_thresh": 0.6, "stability_score_thresh": 0.6, "min_mask_region_area": 15}
    made = import_module("segment_anything").SamAutomaticMaskGenerator
    generator = made(tiny_sam(seed=1), **same, box_nms_thresh=0.7, crop_n_layers=1)
    predictor = generator.predictor
    for level, channels in zip(SAM_LEVELS, (slice(0, 3), slice(0, 1), slice(1, 2), slice(2, 3)), strict=True):

        def predict(points, *_, channels=channels, **__):
            logits, score = blobs(points[:, 0])
            large = predictor.model.postprocess_masks(logits, predictor.input_size, predictor.original_size)
            return large[:, channels], score[:, channels], None

        monkeypatch.setattr(predictor, "predict_torch", predict)
        expected = generator.generate(image.numpy())
        assert len(expected) > 5
        assert len(kept[level]) == len(expected)
        for mask, one in zip(kept[level], expected):
            assert np.array_equal(mask.numpy(), one["segmentation"])
        scores = [float(np.float32(one["stability_score"]) * np.float32(one["predicted_iou"])) for one in expected]
        stay = nms_by_hand([pixels(one["segmentation"]) for one in expected], scores, Suppression())
        assert torch.equal(chosen[level], kept[level][torch.tensor(stay)])
        assert 0 < sum(stay) < len(stay)


@needs_cuda
def test_a_gpu_finds_what_the_cpu_finds(sam_weights, monkeypatch):
    image, path = noise(160, 120), str(sam_weights / "tiny")
    networks = [load_sam_network(path, device) for device in ("cpu", "cuda")]
    exact, half = (network.embed(network.pixels([image]))[0].cpu() for network in networks)
    assert 0 < float((half - exact).norm() / exact.norm()) < 0.01 and half.dtype == torch.float32

    def decode(network, _, points):
        return tuple(x.to(network._device) for x in blobs(points.cpu()))

    monkeypatch.setattr(SamNetwork, "decode", decode)
    rules = MaskRules(points_per_side=5, predicted_iou=0.6, stability=0.6, region_area=15)
    cpu, gpu = (SamMasks(path, device=device, rules=rules).masks(image) for device in ("cpu", "cuda"))
    for level in SAM_LEVELS:
        assert gpu[level].shape == cpu[level].shape
        assert float((gpu[level].cpu() != cpu[level]).float().mean()) < 1e-4  # bilinear weights are rounded otherwise


def test_label_maps_hold_all_levels_with_overlaps_beneath(sam_weights, monkeypatch):
    monkeypatch.setattr(SamNetwork, "decode", lambda self, embedding, points: blobs(points))
    sam = SamMasks(str(sam_weights / "tiny"), rules=MaskRules(points_per_side=4, predicted_iou=0.6, stability=0.6))
    image = noise(65, 85)
    labels, masks = sam.labels(image, "a.jpg"), sam.masks(image)
    assert labels.shape[0] == 4 and labels.shape[1] > 1
    for level, maps in zip(masks.values(), labels):
        for i, mask in enumerate(level):
            assert torch.equal((maps == i).any(dim=0), mask)
        assert int(maps.max()) == len(level) - 1
    assert [replace(sam, level=level).chosen for level in SAM_LEVELS] == [(0,), (1,), (2,), (3,)]
    assert SamMasks(str(sam_weights / "tiny")).chosen == (3,)
    # No mask is good enough
    sam = SamMasks(str(sam_weights / "tiny"), rules=MaskRules(points_per_side=2, predicted_iou=9.0))
    labels = sam.labels(noise(30, 40), "a.jpg")
    assert labels.shape == (4, 1, 30, 40) and bool((labels == -1).all())


def test_identity_holds_the_content_and_the_rules_but_no_level(sam_weights, tmp_path):
    sam = SamMasks(str(sam_weights / "sam_tiny.pth"))
    assert sam.identity == replace(sam, level="s").identity  # all levels are found
    assert replace(sam, rules=LOOSE).identity != sam.identity
    copy = tmp_path / "other.pth"
    copy.write_bytes((sam_weights / "sam_tiny.pth").read_bytes())
    assert SamMasks(str(copy)).identity == sam.identity
    copy.write_bytes(copy.read_bytes() + b"x")
    assert SamMasks(str(copy)).identity != sam.identity
    assert SamMasks("facebook/sam-vit-huge").identity["checkpoint"] == "facebook/sam-vit-huge"


def test_what_is_no_checkpoint(sam_weights, empty_hub, tmp_path, monkeypatch):
    refused(lambda: SamMasks("/nowhere/sam_vit_h.pth"), "/nowhere/sam_vit_h.pth", "--regions", error=FileNotFoundError)
    refused(lambda: SamMasks("sam_vit_h.pth"), "sam_vit_h.pth does not exist", error=FileNotFoundError)
    refused(lambda: SamMasks("vit_h"), "'vit_h'", "facebook/sam-vit-huge")
    parts = ("facebook/sam-vit-huge", "Name or service not known", "--sam-model", "--regions patches")
    refused(lambda: SamMasks().masks(noise(30, 40)), *parts, error=FileNotFoundError)
    monkeypatch.setitem(sys.modules, "transformers", None)
    refused(SamMasks, "transformers", 'pip install "normlift-ns[sam]"', "patches")


def test_other_kinds_of_sam_are_named(sam_weights, tmp_path):
    hq = {**tiny_sam().state_dict(), "mask_decoder.hf_token.weight": torch.zeros(1, 8)}
    for number, (kind, parts) in enumerate((
        ({"model": {"image_encoder.trunk.pos_embed": torch.zeros(2)}}, ["SAM 2", "trunk.pos_embed"]),
        ({"image_encoder.layers.0.x": torch.zeros(2)}, ["MobileSAM", "image_encoder.layers.0.x"]),
        (hq, ["HQ-SAM", "mask_decoder.hf_token.weight"]),
        ({"weight": torch.zeros(2)}, ["image_encoder.pos_embed"]),
        ({"image_encoder.pos_embed": torch.zeros(1, 8, 8, 32)}, ["image_encoder.patch_embed.proj.weight"]),
        ("edgetam", ["config.json", "'edgetam'", "'sam', 'sam2', 'sam2_video', 'sam_hq'"]),
        ("sam3", ["config.json", "'sam3'", "--regions sam3"]),
        ("", ["config.json"]),
    )):  # fmt: skip
        if isinstance(kind, dict):
            path = tmp_path / f"{number}.pt"
            torch.save(kind, path)
        else:
            path = copied(sam_weights / "tiny", tmp_path / str(number))
            (path / "config.json").write_text(json.dumps({"model_type": kind}))
            if kind == "":
                (path / "config.json").unlink()
        remedies = ("facebook/sam-vit-huge", "sam_vit_h_4b8939.pth", "--regions patches")
        refused(lambda path=path: SamMasks(str(path)).masks(noise(30, 40)), str(path), *remedies, *parts)


def test_weights_of_another_network_are_not_downloaded(empty_hub, monkeypatch, tmp_path):
    asked = []

    def download(name, allow_patterns):
        asked.append((name, allow_patterns))
        (tmp_path / "config.json").write_text(json.dumps({"model_type": "edgetam_video"}))
        return str(tmp_path)

    monkeypatch.setattr("normlift_ns.encoders.weights.check_hub_access", lambda: None)
    monkeypatch.setattr(import_module("huggingface_hub"), "snapshot_download", download)
    refused(lambda: SamMasks("someone/edgetam").masks(noise(30, 40)), "'edgetam_video'", "'sam', ")
    assert len(asked) > 0 and all(patterns == ["config.json"] for _, patterns in asked)
