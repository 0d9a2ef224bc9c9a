"""The CLIP encoder on a small random model, loaded from disk by the real code."""

import json
import os
import pickle
import subprocess
import sys
from dataclasses import replace
from importlib import import_module
from itertools import product
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest
import torch
from safetensors.torch import load_file, save_file

from normlift_ns.encoders import open_clip_network
from normlift_ns.encoders.crops import masked_crops, region_boxes
from normlift_ns.encoders.open_clip import import_open_clip
from normlift_ns.encoders.open_clip_network import OpenClipEncoder, load_text_tower
from normlift_ns.encoders.registry import make_encoder
from normlift_ns.encoders.text_files import open_clip_text_identity
from normlift_ns.options import SourceOptions
from normlift_ns.query.text_encoder import encoder_settings, text_encoder_for
from tests.encoders.test_weights import put
from tests.encoders.tiny import CLIP, CLIP_CONFIG, DEVICES, noise, refused

IMAGE = noise(48, 64)
LABELS = torch.full((48, 64), -1, dtype=torch.int32)
LABELS[3:20, 5:50] = 0  # wide
LABELS[10:47, 30:41] = 1  # tall, cuts into the first
LABELS[47, 63] = 2  # a pixel in the corner
MAPS = LABELS[None]


def publish(monkeypatch, hub, weights, **settings) -> str:
    published = import_open_clip().pretrained._PRETRAINED
    monkeypatch.setitem(published, CLIP, {"tag": {"hf_hub": "someone/tiny/", **settings}})
    put(hub, "someone/tiny", "open_clip_model.safetensors", (weights / "tiny.safetensors").read_bytes())
    return "tag"


def square_by_hand(region: int, fill: int) -> np.ndarray:
    """The crop of LangSplat's preprocessing in numpy, with inclusive boxes."""
    rows, columns = np.nonzero(LABELS.numpy() == region)
    box = slice(rows.min(), rows.max() + 1), slice(columns.min(), columns.max() + 1)
    crop = np.where(LABELS.numpy()[box][:, :, None] == region, IMAGE.numpy()[box], np.uint8(fill))
    height, width = crop.shape[:2]
    side = max(height, width)
    square = np.zeros((side, side, 3), np.uint8)
    top, left = (side - height) // 2, (side - width) // 2
    square[top : top + height, left : left + width] = crop
    return square


def test_crops_are_those_of_the_protocol():
    boxes = region_boxes(MAPS)
    assert boxes.tolist() == [[5, 3, 49, 19], [30, 10, 40, 46], [63, 47, 63, 47]]
    for region, (fill, value) in product(range(3), {"black": 0, "white": 255}.items()):
        chosen = torch.tensor([region])
        square = square_by_hand(region, value)
        side = len(square)
        (exact,) = masked_crops(IMAGE, MAPS, chosen, boxes[chosen], (side, side), fill)
        pixels = torch.from_numpy(square).permute(2, 0, 1).float()
        assert torch.equal(exact, pixels), (region, fill)
        for size in ((32, 32), (60, 45)):
            (resized,) = masked_crops(IMAGE, MAPS, chosen, boxes[chosen], size, fill)
            expected = torch.nn.functional.interpolate(pixels[None], size, mode="bilinear", align_corners=False)[0]
            torch.testing.assert_close(resized, expected, rtol=0, atol=1e-3)
            assert np.abs(resized.permute(1, 2, 0).numpy() - cv2.resize(square, size[::-1])).max() <= 1  # cv2 rounds
    # A crop shows all of a region, whatever lies on it
    beneath = torch.full((48, 64), -1, dtype=torch.int32)
    beneath[10:20, 30:41] = 0  # what the second took from the first
    whole = LABELS.where(beneath == -1, 0)
    maps = torch.stack([LABELS, beneath])
    boxes, alone = region_boxes(maps), torch.stack([LABELS[None], whole[None]])
    assert torch.equal(boxes[1:], region_boxes(MAPS)[1:])
    crops = masked_crops(IMAGE, maps, torch.arange(3), boxes, (40, 40), "black")
    assert torch.equal(crops[0], masked_crops(IMAGE, alone[1], torch.tensor([0]), boxes[:1], (40, 40), "black")[0])
    assert torch.equal(crops[1], masked_crops(IMAGE, alone[0], torch.tensor([1]), boxes[1:2], (40, 40), "black")[0])


def test_timm_is_imported_without_wandb(monkeypatch):
    monkeypatch.delitem(sys.modules, "wandb", raising=False)
    found = []
    monkeypatch.setattr("importlib.import_module", lambda name: found.append((name, sys.modules["wandb"])))
    import_open_clip()
    assert found == [("open_clip", None)]
    assert "wandb" not in sys.modules


@torch.no_grad()
def test_features_and_texts_are_those_of_the_model(clip, open_clip):
    model = open_clip.create_model(CLIP, pretrained=clip.pretrained).eval()
    mean, std = (np.array(value, np.float32) for value in (model.visual.image_mean, model.visual.image_std))
    crops = [(cv2.resize(square_by_hand(region, 0), (32, 32)) / 255 - mean) / std for region in range(3)]
    expected = model.encode_image(torch.from_numpy(np.stack(crops)).permute(0, 3, 1, 2).float(), normalize=True)
    features = clip.encode(IMAGE, MAPS)
    assert features.dtype == torch.float32 and features.shape == (3, 24)
    assert torch.linalg.vector_norm(features, dim=1).tolist() == pytest.approx([1, 1, 1], abs=1e-6)
    assert (features * expected).sum(dim=1).min() > 0.999  # but for the rounding of cv2
    assert (features @ features.T).fill_diagonal_(0).max() < 0.999  # the crops do differ
    prompts = ["a red mug", "a wine bottle"]
    expected = model.encode_text(open_clip.get_tokenizer(CLIP)(prompts), normalize=True)
    torch.testing.assert_close(clip.text(prompts), expected, rtol=0, atol=1e-6)


def test_templates_and_their_ensemble(clip, open_clip):
    photo = replace(clip, template="a photo of a {}, {}")
    assert torch.equal(photo.text(["mug"]), clip.text(["a photo of a mug, mug"]))
    prompts = ["red mug", "table"]
    for prompt, row in zip(prompts, replace(clip, template="ensemble").text(prompts), strict=True):
        every = [template(prompt) for template in open_clip.SIMPLE_IMAGENET_TEMPLATES]
        assert len(every) == 7
        expected = torch.nn.functional.normalize(clip.text(every).double().mean(dim=0), dim=0)
        torch.testing.assert_close(row.double(), expected, rtol=0, atol=1e-6)
    assert photo.identity == clip.identity  # features of images stay what they are
    ours, others = (open_clip_text_identity(x.model, x.pretrained, x.template) for x in (clip, photo))
    assert ours != others


def test_what_else_changes_features(clip):
    """A pickle and safetensors hold the same."""
    unread = replace(clip)
    assert unread.encode(IMAGE, torch.full((1, 48, 64), -1, dtype=torch.int32)).shape == (0, 24)
    assert "network" not in vars(unread)  # no region needs no weights
    features = clip.encode(IMAGE, MAPS)
    other = replace(clip, pretrained=clip.pretrained.replace(".pt", ".safetensors"))
    assert torch.equal(other.encode(IMAGE, MAPS), features)
    assert not torch.allclose(replace(clip, fill="white").encode(IMAGE, MAPS), features, atol=1e-3)


class Bomb:
    def __init__(self, path):
        self.path = path

    def __reduce__(self):
        return os.mkdir, (self.path,)


def test_bad_weight_files_are_named_with_a_remedy(clip_weights, tmp_path):
    wrong = {"visual.conv1.weight": torch.zeros(3, 3)}
    for name, save in (("tiny.pt", torch.save), ("tiny.safetensors", save_file)):
        path, whole = tmp_path / name, (clip_weights / name).read_bytes()
        save(wrong, path)
        for content in (path.read_bytes(), whole[: len(whole) // 2], b"", pickle.dumps([1, 2])):
            path.write_bytes(content)
            parts = (str(path), CLIP, "--encoder-model", "--encoder color")
            refused(lambda path=path: OpenClipEncoder(CLIP, str(path)).text(["red"]), *parts)
    torch.save({"state_dict": Bomb(str(tmp_path / "ran"))}, tmp_path / "bad.pt")  # pickles run no code
    refused(lambda: OpenClipEncoder(CLIP, str(tmp_path / "bad.pt")).text(["red"]), "bad.pt")
    assert not (tmp_path / "ran").exists()


def test_absent_weights_give_one_message(empty_hub):
    encoder = make_encoder(SourceOptions("open_clip"))
    assert encoder.identity["pretrained"] == "laion2b_s34b_b88k"
    parts = ("'laion2b_s34b_b88k'", "ViT-B-16", "laion/CLIP-ViT-B-16-laion2B-s34B-b88K", "Name or service not known")
    remedies = ("--encoder-pretrained FILE", "--encoder color")
    refused(lambda: encoder.text(["red"]), *parts, *remedies, error=FileNotFoundError)


def test_cached_downloads_need_no_network(empty_hub, clip_weights, open_clip, monkeypatch):
    tag = publish(monkeypatch, empty_hub, clip_weights, mean=(0.5, 0.5, 0.5), std=(0.25, 0.25, 0.25))
    encoder = OpenClipEncoder(CLIP, tag)
    local = OpenClipEncoder(CLIP, str(clip_weights / "tiny.pt"))
    assert torch.equal(encoder.text(["red"]), local.text(["red"]))
    # Both take the published mean and standard deviation, not those of OpenAI.
    for network in (encoder.network, local.network):
        assert network.mean.flatten().tolist() == [0.5] * 3 and network.std.flatten().tolist() == [0.25] * 3
    assert torch.equal(encoder.encode(IMAGE, MAPS), local.encode(IMAGE, MAPS))
    # The activation is that of the training
    tag = publish(monkeypatch, empty_hub, clip_weights, quick_gelu=True)
    model = open_clip.create_model(CLIP, pretrained=str(clip_weights / "tiny.pt"), force_quick_gelu=True).eval()
    with torch.no_grad():
        expected = model.encode_text(open_clip.get_tokenizer(CLIP)(["red"]), normalize=True)
    torch.testing.assert_close(OpenClipEncoder(CLIP, tag).text(["red"]), expected, rtol=0, atol=1e-6)
    assert not torch.allclose(local.text(["red"]), expected, atol=1e-5)


def test_unknown_names_are_refused_before_loading(monkeypatch):
    timm = import_module("timm")  # nerfstudio's, 0.6.7, does not have SigLIP's model
    if timm.__version__ != "0.6.7":
        monkeypatch.setattr(timm, "is_model", lambda name: name != "vit_base_patch16_siglip_224")
    for options, error, parts in (
        ({"encoder_model": "ViT-B/16"}, ValueError, ["'ViT-B/16'", "ViT-B-16"]),
        ({"encoder_model": "ViT-B-16-SigLIP"}, ValueError, ["--encoder-model", f"timm {timm.__version__}", "ViT-L-14"]),
        ({"encoder_pretrained": "laion2b"}, ValueError, ["'laion2b'", "laion2b_s34b_b88k"]),
        ({"encoder_pretrained": "my/clip"}, FileNotFoundError, ["my/clip does not exist"]),
        ({"encoder_pretrained": "clip.safetensors"}, FileNotFoundError, ["clip.safetensors does not exist", "color"]),
        ({"prompt_template": "a photo"}, ValueError, ["'a photo'", "{}"]),
        ({"encoder": "color", "prompt_template": "a {}"}, ValueError, ["--prompt-template 'a {}'", "open_clip"]),
        ({"crop_fill": "grey"}, ValueError, ["crop_fill", "black, white", "'grey'"]),
    ):
        refused(lambda options=options: make_encoder(SourceOptions(**options)), *parts, error=error)


TEXTS = ["fox", "a red fox that sleeps under a very old tree", "ÄÖ 狐 🦊", "word " * 200, "it's 12,5 %"]


@pytest.mark.parametrize("device", DEVICES)
def test_vectors_are_those_of_open_clip(clip, clip_weights, device, monkeypatch, tmp_path):
    monkeypatch.setattr(open_clip_network, "_TEXT_BATCH_SIZE", 3)
    for file, template in (("tiny.pt", "{}"), ("tiny.pt", "a photo of a {}"), ("tiny.safetensors", "ensemble")):
        path = str(clip_weights / file)
        tower = load_text_tower(CLIP, path, template, device)
        assert tower is not None
        found, expected = tower.text(TEXTS), OpenClipEncoder(CLIP, path, template=template).text(TEXTS)
        assert found.shape == expected.shape == (len(TEXTS), 24)
        assert found.device.type == "cpu"
        assert (found - expected).abs().max() < 2e-6, (file, template)
        assert (found[0] - found[1]).abs().max() > 0.01
    # Half precision, wrapped and prefixed
    state = load_file(clip_weights / "tiny.safetensors")
    torch.save({"state_dict": {f"module.{k}": v.half() for k, v in state.items()}}, tmp_path / "wrapped.pt")
    tower = load_text_tower(CLIP, str(tmp_path / "wrapped.pt"), "{}")
    assert tower is not None
    assert 0 < (tower.text(TEXTS) - clip.text(TEXTS)).abs().max() < 0.01


@pytest.mark.parametrize("quick", [True, False])
def test_both_activations_agree_with_open_clip_in_float64(tmp_path, open_clip, quick):
    name = f"normlift-quick-{quick}"
    config = {**CLIP_CONFIG, "quick_gelu": quick}
    (tmp_path / f"{name}.json").write_text(json.dumps(config))
    open_clip.add_model_config(tmp_path)
    with torch.random.fork_rng(), torch.no_grad():
        torch.manual_seed(0)
        model: Any = open_clip.create_model(name, pretrained_hf=False).eval()
        model.text_projection.normal_()
        model.token_embedding.weight.mul_(30)  # so that the activation matters
        save_file(model.state_dict(), tmp_path / "weights.safetensors")
        rows = model.double().encode_text(open_clip.get_tokenizer(name)(TEXTS))
    expected = torch.nn.functional.normalize(rows, dim=1)
    tower = load_text_tower(name, str(tmp_path / "weights.safetensors"), "{}")
    assert tower is not None
    assert tower.quick_gelu == quick
    assert (tower.text(TEXTS).double() - expected).abs().max() < 2e-6
    assert (replace(tower, quick_gelu=not quick).text(TEXTS).double() - expected).abs().max() > 1e-4


def test_what_is_not_plain_is_left_to_open_clip(clip, clip_weights, tmp_path):
    state = load_file(clip_weights / "tiny.safetensors")
    del state["ln_final.bias"]
    save_file(state, tmp_path / "incomplete.safetensors")
    (tmp_path / "text.pt").write_text("no weights")
    (tmp_path / "empty.safetensors").write_bytes(b"")
    torch.save([1, 2], tmp_path / "list.pt")
    files = [str(file) for file in tmp_path.iterdir()]
    assert len(files) == 4
    of_other_shapes = "ViT-B-32"
    models = ("roberta-ViT-B-32", "coca_ViT-B-32", "ViT-B-16-SigLIP", "no-such-model", of_other_shapes)
    for model, path, template in (
        *((model, clip.pretrained, "{}") for model in models),
        *((CLIP, path, "{}") for path in (*files, "no-such-tag")),
        (CLIP, clip.pretrained, "no place"),
    ):
        assert load_text_tower(model, path, template) is None, (model, path, template)


@pytest.mark.slow
def test_a_text_that_is_new_imports_neither_torchvision_nor_transformers(tmp_path, open_clip):
    with torch.random.fork_rng(), torch.no_grad():
        torch.manual_seed(1)
        model = open_clip.create_model("ViT-S-32-alt", pretrained_hf=False)
        save_file(model.state_dict(), tmp_path / "weights.safetensors")
    program = """
import sys
from normlift_ns.encoders.open_clip_network import load_text_tower
tower = load_text_tower("ViT-S-32-alt", sys.argv[1], "{}")
dimension = len(tower.text(["fox"])[0])
heavy = [name for name in ("open_clip", "torchvision", "transformers", "timm", "nerfstudio") if name in sys.modules]
import open_clip  # the whole of it still works
assert heavy == [] and open_clip.get_model_config("ViT-S-32-alt")["embed_dim"] == dimension, heavy
"""
    words = [sys.executable, "-W", "ignore", "-c", program, str(tmp_path / "weights.safetensors")]
    subprocess.run(words, check=True)


def test_a_question_takes_the_tower_and_open_clip_where_there_is_none(clip, monkeypatch):
    options = SourceOptions(encoder_model=CLIP, encoder_pretrained=clip.pretrained)
    field: Any = SimpleNamespace(manifest={"encoder": encoder_settings(options)})
    made = []
    real = open_clip_network.load_text_tower
    monkeypatch.setattr(open_clip_network, "load_text_tower", lambda *a: made.append(real(*a)) or made[-1])
    found = text_encoder_for(field, "auto").text(["fox"])
    assert isinstance(made[0], open_clip_network.TextTower)
    monkeypatch.setattr(open_clip_network, "load_text_tower", lambda *a: None)
    assert (found - text_encoder_for(field, "cpu").text(["fox"])).abs().max() < 2e-6


def test_only_a_network_that_is_loaded_is_not_drawn_at_random() -> None:
    def draws() -> bool:
        before = torch.get_rng_state()
        torch.nn.Linear(3, 4)
        return not torch.equal(torch.get_rng_state(), before)

    with open_clip_network._Uninitialized():
        assert not draws()
    assert draws()
