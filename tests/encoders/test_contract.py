"""What every encoder keeps to."""

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from safetensors.torch import load_file, save_file

from normlift_ns.encoders.huggingface import MODEL_FAMILIES
from normlift_ns.encoders.huggingface_network import HuggingFaceEncoder
from normlift_ns.encoders.registry import make_encoder
from normlift_ns.errors import InputError
from normlift_ns.options import SourceOptions
from tests.encoders.tiny import CLIP, HUB, Largest, copied, needs_cuda, noise, refused
from tests.examples import FACTOR
from tests.hostile import damaged, fuzz, hostile_json

IMAGE = noise(48, 64)
MANY = (torch.arange(48 * 64).reshape(1, 48, 64) * 70 // (48 * 64)).int()  # 70 regions: more than a batch
FEW = torch.where(MANY < 6, MANY, -1).int()
NONE = torch.full((1, 48, 64), -1, dtype=torch.int32)
TEXTS = ["red", "sky blue"]  # which the colour encoder knows too
NAMES = ["open_clip", "color", *HUB]


def options_of(name: str, folder: Path) -> SourceOptions:
    """Of an encoder by its files, which lie in the folder."""
    if name == "color":
        return SourceOptions(encoder="color")
    if name == "open_clip":
        return SourceOptions("open_clip", encoder_model=CLIP, encoder_pretrained=str(folder / "tiny.safetensors"))
    return SourceOptions(encoder=HUB[name], encoder_model=str(folder))


@pytest.fixture(scope="module", params=NAMES)
def options(request: pytest.FixtureRequest, clip_weights: Path, hub_weights: Path) -> SourceOptions:
    return options_of(request.param, clip_weights if request.param == "open_clip" else hub_weights / request.param)


@pytest.fixture(scope="module")
def encoder(options: SourceOptions) -> Any:
    return make_encoder(options)


def test_rows_are_unit_vectors_in_one_space(options: SourceOptions) -> None:
    encoder: Any = make_encoder(options)
    assert json.loads(json.dumps(encoder.identity)) == encoder.identity
    assert encoder.identity["kind"] == options.encoder.replace("color", "colour")  # as in version 0.2
    assert "network" not in vars(encoder)  # is not needed to tell the identity
    images, texts = encoder.encode(IMAGE, MANY), encoder.text(TEXTS)
    assert (len(images), len(texts)) == (70, 2) and images.shape[1] == texts.shape[1]
    for rows in (images, texts):
        assert rows.dtype == torch.float32 and rows.device.type == "cpu"
        assert (torch.linalg.vector_norm(rows.double(), dim=1) - 1).abs().max() < 1e-6
    assert encoder.encode(IMAGE, NONE).shape[0] == 0
    assert (images[0] - images[40]).abs().max() > 1e-3 and (texts[0] - texts[1]).abs().max() > 1e-3
    for prompts in ([], [" "], "red"):
        with pytest.raises(InputError):
            encoder.text(prompts)


def test_what_else_is_in_the_batch_changes_nothing(encoder: Any) -> None:
    together = encoder.encode(IMAGE, MANY)
    for region in (0, 63, 64, 69):
        alone = encoder.encode(IMAGE, torch.where(region == MANY, 0, -1).int())
        torch.testing.assert_close(alone[0], together[region], rtol=0, atol=1e-5)
    views = [(IMAGE, NONE), (255 - IMAGE, FEW), (IMAGE, MANY)]
    expected = encoder.encode(*views[0]), encoder.encode(*views[1]), together
    for rows, alone in zip(encoder.encode_each(iter(views)), expected, strict=True):
        torch.testing.assert_close(rows, alone, rtol=0, atol=1e-5)
    prompts = [f"red {i}" for i in range(70)]
    torch.testing.assert_close(encoder.text(prompts)[64:65], encoder.text(prompts[64:65]), rtol=0, atol=1e-5)


@pytest.mark.parametrize("name", HUB)
def test_half_precision_costs_little(name: str, hub_weights: Path) -> None:
    """As on a GPU, which open_clip's test needs (test_open_clip.py); what overflows is found again in float32."""
    exact, half = (HuggingFaceEncoder(MODEL_FAMILIES[HUB[name]], str(hub_weights / name)) for _ in range(2))
    half.network.model.half()
    for found, expected in (
        (half.encode(IMAGE, FEW), exact.encode(IMAGE, FEW)),
        (half.patches(IMAGE, 4, 5), exact.patches(IMAGE, 4, 5)),
        (half.text(TEXTS), exact.text(TEXTS)),
    ):
        assert half.network.model.logit_scale.dtype == torch.float16
        assert 1e-9 < float((1 - (found.double() * expected.double()).sum(dim=1)).abs().max()) < 1e-4
    for encoder in (exact, half):
        encoder.network.model.vision_model.post_layernorm.weight.mul_(3e4)
    torch.testing.assert_close(half.encode(IMAGE, FEW), exact.encode(IMAGE, FEW), rtol=0, atol=1e-2)
    assert half.network.model.logit_scale.dtype == torch.float32


@needs_cuda
def test_a_gpu_sees_what_the_cpu_sees(options: SourceOptions, encoder: Any) -> None:
    there, learned = make_encoder(options, "cuda"), options.encoder != "color"
    for found, expected in (
        (there.encode(IMAGE, MANY), encoder.encode(IMAGE, MANY)),
        (there.text(TEXTS), encoder.text(TEXTS)),
        *([(there.patches(IMAGE, 4, 5), encoder.patches(IMAGE, 4, 5))] if learned else []),
    ):
        assert found.dtype == torch.float32 and found.device.type == "cpu"
        assert (found * expected).sum(dim=1).min() > 0.999
        assert (torch.linalg.vector_norm(found, dim=1) - 1).abs().max() < 1e-6
    assert not learned or torch.float16 in {x.dtype for x in there.network.model.parameters()}


def test_no_step_takes_memory_for_all_regions_or_texts_at_once(encoder: Any) -> None:
    """Of 96 crops and 192 texts after 16 and 64."""
    many, sizes = (torch.arange(48 * 64).reshape(1, 48, 64) // 32).int(), []
    _ = encoder.text(TEXTS), encoder.encode(IMAGE, FEW)  # weights are large
    for crops, texts in ((16, 64), (96, 192)):
        with Largest() as largest:
            rows = encoder.encode(IMAGE, torch.where(many < crops, many, -1)), encoder.text(["red"] * texts)
        sizes.append(max(largest.most, rows[0].numel(), rows[1].numel()))
    assert sizes[1] <= max(sizes[0], rows[0].numel(), rows[1].numel())


@pytest.mark.parametrize("name", ["open_clip", *HUB])
def test_the_identity_changes_with_any_weight(name: str, clip_weights: Path, hub_weights: Path, tmp_path: Path) -> None:
    folder = copied(clip_weights if name == "open_clip" else hub_weights / name, tmp_path / "here")
    options = options_of(name, folder)
    before = make_encoder(options).identity
    file = folder / ("tiny.safetensors" if name == "open_clip" else "model.safetensors")
    whole, state = file.read_bytes(), load_file(file)
    names = sorted(state)
    for key in {names[0], *names[5 :: 12 // min(FACTOR, 12)], names[-1]}:
        save_file({**state, key: state[key] + 1}, file)
        assert make_encoder(options).identity != before
    file.write_bytes(whole)
    assert make_encoder(options).identity == before
    assert make_encoder(replace(options, crop_fill="white")).identity != before
    if name == "open_clip":
        return
    for other in (one for one in folder.iterdir() if one != file):
        content = other.read_bytes()
        other.write_bytes(content + b" ")
        assert make_encoder(options).identity != before, other
        other.write_bytes(content)
    moved = folder.rename(tmp_path / "moved")
    assert make_encoder(options_of(name, moved)).identity == before


def use(folder: Path, name: str = "siglip2") -> None:
    encoder = make_encoder(options_of(name, folder))
    json.dumps(encoder.identity)
    encoder.text(TEXTS)
    encoder.encode(IMAGE, torch.where(MANY < 2, MANY, -1))


@pytest.mark.parametrize("name", ["siglip", "naflex", "metaclip2"])
def test_damaged_files_are_refused_or_read(name: str, hub_weights: Path, tmp_path: Path) -> None:
    copied(hub_weights / name, tmp_path)
    for file in sorted(tmp_path.iterdir()):
        whole = file.read_bytes()
        fuzz(2, damaged(whole), file, lambda: use(tmp_path, name))
        if file.suffix == ".json" and file.name != "tokenizer.json":
            fuzz(2, hostile_json(json.loads(whole)), file, lambda: use(tmp_path, name))
        file.write_bytes(whole)
    use(tmp_path, name)


def cut(file: str) -> Callable[[Path], object]:
    return lambda folder: (folder / file).write_bytes((folder / file).read_bytes()[:-100])


def gone(file: str, instead: str = "gone") -> Callable[[Path], object]:
    return lambda folder: (folder / file).rename(folder / instead)


def changed(file: str, part: str | None, **values: Any) -> Callable[[Path], object]:
    """A JSON file with other values, in an object of it or at its top."""

    def change(folder: Path) -> None:
        found = json.loads((folder / file).read_text())
        (found if part is None else found.setdefault(part, {})).update(values)
        (folder / file).write_text(json.dumps(found))

    return change


def sharded(name: str) -> Callable[[Path], object]:
    """The weights under another name, which an index tells."""

    def shard(folder: Path) -> None:
        (folder / "model.safetensors").rename(folder / "model-00001-of-00001.safetensors")
        (folder / "model.safetensors.index.json").write_text(json.dumps({"weight_map": {"logit_scale": name}}))

    return shard


def test_what_is_wrong_with_a_folder_is_said(hub_weights: Path, tmp_path: Path) -> None:
    vision, text, tokens = "vision_config", "text_config", "tokenizer_config.json"
    table: list[tuple[Callable[[Path], object], list[str]]] = [
        (cut("model.safetensors"), ["SigLIP 2", "--encoder-model", "--encoder open_clip"]),
        (cut("config.json"), ["config.json"]),
        (gone("tokenizer.json"), ["tokenizer.json"]),
        (gone("processor_config.json"), ["preprocessor_config.json"]),
        (gone("config.json"), ["config.json"]),
        (gone("model.safetensors", "pytorch_model.bin"), ["model.safetensors", "pytorch_model.bin"]),
        (changed("config.json", None, model_type="sam"), ["'sam'", "'siglip' or 'siglip2'"]),
        (changed("config.json", vision, hidden_size=10**9), ["hidden_size", vision, "1000000000"]),
        (changed("config.json", text, hidden_size=48), ["SigLIP 2"]),
        (changed("config.json", text, hidden_act="../x"), ["hidden_act", text, "'../x'"]),
        (changed("config.json", vision, image_size=64), ["32 pixels", "64"]),
        (changed("config.json", vision, vision_use_head=False), ["pooling head"]),
        (changed("processor_config.json", "image_processor", image_std=[0, 1, 1]), ["image_std", "processor_config"]),
        (changed("processor_config.json", "image_processor", image_mean=[0.5, 0.5]), ["image_mean", "[0.5, 0.5]"]),
        (changed("processor_config.json", "image_processor", rescale_factor=0), ["rescale_factor", "0"]),
        (changed("processor_config.json", None, image_processor=[]), ["image_processor", "list"]),
        (changed(tokens, None, tokenizer_class="SiglipTokenizer"), ["SiglipTokenizer", "--encoder siglip"]),
        (changed(tokens, None, pad_token="<nothing>"), ["'<nothing>'"]),
        (sharded("../model.safetensors"), ["weight_map"]),
        (sharded("model-00002-of-00002.safetensors"), ["model-00002-of-00002.safetensors"]),
    ]
    for number, (damage, parts) in enumerate(table):
        folder = copied(hub_weights / "siglip2", tmp_path / str(number))
        damage(folder)
        refused(lambda folder=folder: use(folder), str(folder), *parts, error=InputError)


def test_weights_in_several_files_are_one_network_and_no_code_is_taken(hub_weights: Path, tmp_path: Path) -> None:
    """Keys that make transformers import, download or quantize have no effect."""
    options = options_of("siglip2", copied(hub_weights / "siglip2", tmp_path))
    expected = make_encoder(options).text(TEXTS)
    sharded("model-00001-of-00001.safetensors")(tmp_path)
    assert torch.equal(make_encoder(options).text(TEXTS), expected)
    named = {"auto_map": {"AutoModel": "evil.M"}, "attn_implementation": "some/kernel", "quantization_config": {}}
    for part in (None, "text_config", "vision_config"):
        changed("config.json", part, **named)(tmp_path)
    encoder: Any = make_encoder(options)
    assert torch.equal(encoder.text(TEXTS), expected)
    assert encoder.network.model.config.to_dict().keys().isdisjoint(named)
