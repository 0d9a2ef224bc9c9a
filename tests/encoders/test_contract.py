"""What every encoder keeps to: one unit row per region and text, whatever else is in the batch; an identity that any
weight changes; damaged files refused in words; memory that does not grow with the number of regions."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest
import torch

from normlift_ns.encoders import SourceOptions, make_encoder
from normlift_ns.encoders.hub.encoder import HubEncoder
from normlift_ns.errors import InputError
from tests.encoders.tiny import CLIP, needs_cuda, write_clip
from tests.encoders.tiny_hub import WRITERS
from tests.hostile import damaged, fuzz, hostile_json

IMAGE = torch.randint(0, 256, (48, 64, 3), generator=torch.Generator().manual_seed(0), dtype=torch.uint8)
MANY = (torch.arange(48 * 64).reshape(1, 48, 64) * 70 // (48 * 64)).int()  # 70 regions: more than a batch
FEW = torch.where(MANY < 6, MANY, -1).int()
NONE = torch.full((1, 48, 64), -1, dtype=torch.int32)
TEXTS = ["red", "sky blue"]  # which the colour encoder knows too
COLOUR = SourceOptions(encoder="colour")


@dataclass(frozen=True)
class Case:
    """An encoder, and the files that it was made from."""

    name: str
    options: SourceOptions
    files: tuple[Path, ...] = ()

    def make(self, device: str = "cpu") -> Any:
        return make_encoder(self.options, device)


def case(name: str, folder: Path) -> Case:
    folder.mkdir(exist_ok=True)
    if name == "colour":
        return Case(name, COLOUR)
    if name == "open_clip":
        write_clip(folder)
        file = folder / "tiny.safetensors"
        return Case(name, SourceOptions(encoder_model=CLIP, encoder_pretrained=str(file)), (file,))
    kind, write = WRITERS[name]
    write(folder)
    options = SourceOptions(encoder=kind, encoder_model=str(folder))
    return Case(name, options, tuple(sorted(folder.iterdir(), key=lambda file: file.suffix != ".safetensors")))


NAMES = ["open_clip", "colour", *WRITERS]
LEARNED = ["open_clip", *WRITERS]


@pytest.fixture(scope="module", params=NAMES)
def one(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Case:
    return case(request.param, tmp_path_factory.mktemp(request.param))


@pytest.fixture(scope="module")
def encoder(one: Case) -> Any:
    return one.make()


def test_rows_are_unit_vectors_in_one_space(encoder: Any) -> None:
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
    views = [(IMAGE, NONE), (255 - IMAGE, MANY), (IMAGE, MANY)]
    for rows, view in zip(encoder.encode_each(iter(views)), views, strict=True):
        torch.testing.assert_close(rows, encoder.encode(*view), rtol=0, atol=1e-5)
    prompts = [f"red {i}" for i in range(70)]
    torch.testing.assert_close(encoder.text(prompts)[64:65], encoder.text(prompts[64:65]), rtol=0, atol=1e-5)


@pytest.mark.parametrize("name", WRITERS)
def test_half_precision_costs_little(name: str, tmp_path: Path) -> None:
    """As on a GPU, which open_clip's test needs (test_open_clip.py)."""
    exact: HubEncoder = case(name, tmp_path).make()
    half: HubEncoder = case(name, tmp_path).make()
    half.network.model.half()
    for found, expected in (
        (half.encode(IMAGE, FEW), exact.encode(IMAGE, FEW)),
        (half.patches(IMAGE, 4, 5), exact.patches(IMAGE, 4, 5)),
        (half.text(TEXTS), exact.text(TEXTS)),
    ):
        assert half.network.model.logit_scale.dtype == torch.float16
        assert 1e-9 < float((1 - (found.double() * expected.double()).sum(dim=1)).abs().max()) < 1e-4


@pytest.mark.parametrize("name", WRITERS)
def test_numbers_too_large_for_half_precision_are_found_in_float32(name: str, tmp_path: Path) -> None:
    one = case(name, tmp_path)
    exact, half = one.make(), one.make()
    for encoder in (exact, half):
        encoder.network.model.vision_model.post_layernorm.weight.mul_(3e4)
    half.network.model.half()
    torch.testing.assert_close(half.encode(IMAGE, FEW), exact.encode(IMAGE, FEW), rtol=0, atol=1e-2)
    assert half.network.model.logit_scale.dtype == torch.float32


@needs_cuda
def test_a_gpu_sees_what_the_cpu_sees(one: Case, encoder: Any) -> None:
    there = one.make("cuda")
    for found, expected in (
        (there.encode(IMAGE, MANY), encoder.encode(IMAGE, MANY)),
        (there.text(TEXTS), encoder.text(TEXTS)),
    ):
        assert (found * expected).sum(dim=1).min() > 0.999


def test_the_identity_is_told_without_the_network(one: Case) -> None:
    encoder = one.make()
    assert json.loads(json.dumps(encoder.identity)) == encoder.identity
    assert encoder.identity["kind"] == one.options.encoder
    assert "network" not in vars(encoder)


@pytest.mark.parametrize("name", LEARNED)
def test_the_identity_changes_with_any_weight(name: str, tmp_path: Path) -> None:
    one = case(name, tmp_path)
    before, file = one.make().identity, one.files[0]
    whole = file.read_bytes()
    size = int.from_bytes(whole[:8], "little")
    places = {
        key: value["data_offsets"] for key, value in json.loads(whole[8 : 8 + size]).items() if key != "__metadata__"
    }
    assert len(places) > 20
    for start, end in places.values():
        content = bytearray(whole)
        content[8 + size + (start + end) // 2] ^= 1
        file.write_bytes(content)
        assert one.make().identity != before
    file.write_bytes(whole)
    assert one.make().identity == before
    if name == "open_clip":
        return
    for other in one.files[1:]:
        content = other.read_bytes()
        other.write_bytes(content + b" ")
        assert one.make().identity != before, other
        other.write_bytes(content)
    moved = tmp_path.with_name(f"moved_{name}")
    tmp_path.rename(moved)
    assert make_encoder(SourceOptions(encoder=one.options.encoder, encoder_model=str(moved))).identity == before
    white = SourceOptions(encoder=one.options.encoder, encoder_model=str(moved), crop_fill="white")
    assert make_encoder(white).identity != before


def use(one: Case) -> None:
    """All that reads a file."""
    encoder = one.make()
    json.dumps(encoder.identity)
    encoder.text(TEXTS)
    encoder.encode(IMAGE, torch.where(MANY < 2, MANY, -1))


@pytest.mark.parametrize("examples", [pytest.param(4, id="fast"), pytest.param(30, id="slow", marks=pytest.mark.slow)])
@pytest.mark.parametrize("name", ["siglip", "naflex", "metaclip2"])
def test_damaged_files_are_refused_or_read(name: str, examples: int, tmp_path: Path) -> None:
    one = case(name, tmp_path)
    for file in one.files:
        whole = file.read_bytes()
        fuzz(examples, damaged(whole), file, lambda: use(one))
        if file.suffix == ".json" and file.name != "tokenizer.json":
            fuzz(examples, hostile_json(json.loads(whole)), file, lambda: use(one))
        file.write_bytes(whole)
    use(one)


def cut(file: str) -> Callable[[Path], object]:
    return lambda folder: (folder / file).write_bytes((folder / file).read_bytes()[:-100])


def changed(file: str, part: str | None, **values: Any) -> Callable[[Path], object]:
    """A JSON file with other values, in an object of it or at its top."""

    def change(folder: Path) -> None:
        found = json.loads((folder / file).read_text())
        (found if part is None else found.setdefault(part, {})).update(values)
        (folder / file).write_text(json.dumps(found))

    return change


def gone(file: str) -> Callable[[Path], object]:
    return lambda folder: (folder / file).unlink()


def sharded(name: str) -> Callable[[Path], object]:
    """The weights under another name, which an index tells."""

    def shard(folder: Path) -> None:
        (folder / "model.safetensors").rename(folder / "model-00001-of-00001.safetensors")
        (folder / "model.safetensors.index.json").write_text(json.dumps({"weight_map": {"logit_scale": name}}))

    return shard


def pickled(folder: Path) -> None:
    (folder / "model.safetensors").unlink()
    torch.save({}, folder / "pytorch_model.bin")


DAMAGE: list[tuple[Callable[[Path], object], str]] = [
    (cut("model.safetensors"), "is damaged or not of SigLIP 2 .*--encoder-model another folder.*--encoder open_clip"),
    (cut("config.json"), "config.json is damaged"),
    (cut("tokenizer.json"), "is damaged or not of SigLIP 2"),
    (gone("tokenizer.json"), "there is no tokenizer.json, without which no text can be read"),
    (gone("processor_config.json"), "there is no preprocessor_config.json, which says how pixels are prepared"),
    (gone("config.json"), "there is no config.json"),
    (pickled, "there is no model.safetensors; pickles such as pytorch_model.bin are not read"),
    (changed("config.json", None, model_type="sam"), "of the architecture 'sam', expected 'siglip' or 'siglip2'"),
    (changed("config.json", "vision_config", hidden_size=10**9), "hidden_size of vision_config is 1000000000"),
    (changed("config.json", "text_config", hidden_size=48), "is damaged or not of SigLIP 2"),
    (changed("config.json", "text_config", hidden_act="../x"), "hidden_act of text_config is '../x', expected one of"),
    (changed("config.json", "vision_config", image_size=64), "images are prepared at 32 pixels, but the network takes"),
    (changed("config.json", "vision_config", vision_use_head=False), "no pooling head"),
    (changed("processor_config.json", "image_processor", image_std=[0, 1, 1]), "image_std of processor_config"),
    (
        changed("tokenizer_config.json", None, tokenizer_class="SiglipTokenizer"),
        "its tokenizer SiglipTokenizer is of SigLIP, expected SigLIP 2: --encoder siglip",
    ),
    (changed("tokenizer_config.json", None, pad_token="<nothing>"), "does not know the token '<nothing>'"),
    (sharded("../model.safetensors"), "names no files of the form"),
    (sharded("model-00002-of-00002.safetensors"), "there is no model-00002-of-00002.safetensors, which"),
]  # fmt: skip


@pytest.mark.parametrize(("damage", "message"), DAMAGE, ids=[message[:30] for _, message in DAMAGE])
def test_what_is_wrong_with_a_folder_is_said(damage: Callable[[Path], object], message: str, tmp_path: Path) -> None:
    one = case("siglip2", tmp_path)
    damage(tmp_path)
    with pytest.raises(InputError, match=message) as caught:
        use(one)
    assert str(tmp_path) in str(caught.value) and "\n" not in str(caught.value)


def test_weights_in_several_files_are_one_network(tmp_path: Path) -> None:
    one = case("siglip2", tmp_path)
    expected = one.make().text(TEXTS)
    sharded("model-00001-of-00001.safetensors")(tmp_path)
    assert torch.equal(one.make().text(TEXTS), expected)


def test_no_code_is_taken_from_a_folder(tmp_path: Path) -> None:
    """Keys that make transformers import, download or quantize have no effect."""
    one = case("siglip2", tmp_path)
    expected = one.make().text(TEXTS)
    named = {
        "auto_map": {"AutoModel": "evil.Model"},
        "attn_implementation": "someone/kernel",
        "quantization_config": {},
    }
    for part in (None, "text_config", "vision_config"):
        changed("config.json", part, **named)(tmp_path)
    encoder = one.make()
    assert torch.equal(encoder.text(TEXTS), expected)
    assert encoder.network.model.config.to_dict().keys().isdisjoint(named)


MEASURED = """
import sys, torch
from pathlib import Path
from tests.encoders import tiny, tiny_hub
from tests.encoders.test_contract import NAMES, case

def peak():
    lines = Path("/proc/self/status").read_text().splitlines()
    return next(int(line.split()[1]) for line in lines if line.startswith("VmHWM")) / 1024

tiny_hub.SIDE, tiny_hub.PATCH = 96, 24
tiny.CLIP_CONFIG["vision_cfg"] |= {"image_size": 96, "patch_size": 24}
image = torch.randint(0, 256, (64, 128, 3), dtype=torch.uint8)
labels = (torch.arange(64 * 128).reshape(1, 64, 128) // 8).int()  # 1024 regions
for name in NAMES:
    encoder = case(name, Path(sys.argv[1]) / name).make()
    encoder.encode(image, torch.where(labels < 64, labels, -1)), encoder.text(["red"] * 64)
    Path("/proc/self/clear_refs").write_text("5")  # peaks begin anew
    before = peak()
    assert len(encoder.encode(image, labels)) == 1024
    encoder.text(["red"] * 512)
    print(name, peak() - before)
"""


@pytest.mark.slow
@pytest.mark.skipif(not Path("/proc/self/clear_refs").exists(), reason="peaks of memory are read as Linux tells them")
def test_memory_does_not_grow_with_the_regions(tmp_path: Path) -> None:
    """1,024 regions and 512 texts after 64 each: all crops at once would take 108 MiB, and as much in each step of
    cutting them."""
    words = [sys.executable, "-c", MEASURED, str(tmp_path)]
    done = subprocess.run(words, capture_output=True, text=True, check=False, cwd=Path(__file__).parents[2])
    assert done.returncode == 0, done.stderr
    print(done.stdout)
    grown = {name: float(size) for name, size in (line.split() for line in done.stdout.splitlines())}
    assert set(grown) == set(NAMES) and max(grown.values()) < 80
