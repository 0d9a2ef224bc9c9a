"""The text tower in plain torch against that of open_clip, with the same weights."""

import json
import subprocess
import sys
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from safetensors.torch import load_file, save_file

from normlift_ns.encoders import open_clip_network
from normlift_ns.encoders.open_clip_network import OpenClipEncoder, load_text_tower
from normlift_ns.options import SourceOptions
from normlift_ns.query.text_encoder import encoder_settings, text_encoder_for
from tests.encoders.tiny import CLIP, CLIP_CONFIG, DEVICES

TEXTS = ["fox", "a red fox that sleeps under a very old tree", "ÄÖ 狐 🦊", "word " * 200, "it's 12,5 %"]


@pytest.mark.parametrize("device", DEVICES)
def test_vectors_are_those_of_open_clip(clip_weights, device, monkeypatch):
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


def test_half_precision_wrapped_and_prefixed_weights_are_read(clip, clip_weights, tmp_path):
    state = load_file(clip_weights / "tiny.safetensors")
    torch.save({"state_dict": {f"module.{k}": v.half() for k, v in state.items()}}, tmp_path / "wrapped.pt")
    tower = load_text_tower(CLIP, str(tmp_path / "wrapped.pt"), "{}")
    assert tower is not None
    assert 0 < (tower.text(TEXTS) - clip.text(TEXTS)).abs().max() < 0.01


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
