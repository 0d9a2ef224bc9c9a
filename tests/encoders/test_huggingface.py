"""SigLIP, SigLIP 2 and MetaCLIP 2: the same numbers as the library's own processor and model, in float64."""

import json
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import torch

from normlift_ns.encoders.base import PatchFeatures, resize_image
from normlift_ns.encoders.build import make_source, source_settings
from normlift_ns.encoders.crops import masked_crops, region_boxes
from normlift_ns.encoders.huggingface import MODEL_FAMILIES
from normlift_ns.encoders.huggingface_network import HuggingFaceEncoder
from normlift_ns.options import SourceOptions
from normlift_ns.query.text_encoder import default_rule, encoder_settings, text_encoder_for
from normlift_ns.segmentation.registry import resolve_regions
from tests.encoders.tiny import HUB, copied, noise, refused

SIDE, PATCH, LENGTH = 32, 8, 16
IMAGE = noise(48, 64)
LABELS = torch.full((1, 48, 64), -1, dtype=torch.int32)
LABELS[0, :32, :32] = 0  # of the network's own size
LABELS[0, 10:47, 30:41] = 1
PROMPTS = ["a red mug", "A Red Mug!", "the table", "wine bottle on the table " * 9, "ÄÖ 漢"]


class Both:
    """An encoder of ours in float64, and the library's own model and processor."""

    def __init__(self, name: str, folder: Path, transformers: Any) -> None:
        self.name, self.encoder = name, HuggingFaceEncoder(MODEL_FAMILIES[HUB[name]], str(folder))
        self.network = self.encoder.network
        self.network.model.double()
        self.network.mean, self.network.std = self.network.mean.double(), self.network.std.double()
        self.model: Any = transformers.AutoModel.from_pretrained(folder).double().eval()
        self.processor: Any = transformers.AutoProcessor.from_pretrained(folder)

    @torch.no_grad()
    def pooled(self, **inputs: torch.Tensor) -> torch.Tensor:
        find = self.model.get_image_features if "pixel_values" in inputs else self.model.get_text_features
        return find(**inputs).pooler_output

    def prepared(self, pixels: torch.Tensor, **how: Any) -> dict[str, torch.Tensor]:
        found = self.processor.image_processor(images=list(pixels), return_tensors="pt", **how)
        return {key: value.double() if value.is_floating_point() else value for key, value in found.items()}


@pytest.fixture(scope="module", params=HUB)
def both(request: pytest.FixtureRequest, hub_weights: Path, transformers: Any) -> Both:
    return Both(request.param, hub_weights / request.param, transformers)


def test_crops_are_seen_as_the_librarys_processor_prepares_them(both: Both) -> None:
    boxes, size = region_boxes(LABELS), both.network.size
    assert size == (SIDE, SIDE)
    crops = masked_crops(IMAGE, LABELS, torch.arange(2), boxes, size, "black").round().to(torch.uint8)
    expected = both.pooled(**both.prepared(crops))
    torch.testing.assert_close(both.network.images(crops), expected, rtol=0, atol=1e-6)
    assert (expected[0] - expected[1]).abs().max() > 1e-3  # which another preparation exceeds
    rows = torch.nn.functional.normalize(expected[:1], dim=1)
    torch.testing.assert_close(both.encoder.encode(IMAGE, LABELS)[:1].double(), rows, rtol=0, atol=1e-6)


def test_texts_are_read_as_the_librarys_processor_reads_them(both: Both) -> None:
    how = {"padding": "max_length", "max_length": LENGTH, "truncation": True, "return_tensors": "pt"}
    prompts = [both.encoder.family.preprocess_text(text) for text in PROMPTS] if both.name == "siglip" else PROMPTS
    expected = both.pooled(**both.processor.tokenizer(prompts, **how))
    found = both.network.texts([both.encoder.family.preprocess_text(text) for text in PROMPTS])
    torch.testing.assert_close(found, expected, rtol=0, atol=1e-12)
    rows = torch.nn.functional.normalize(expected, dim=1)
    torch.testing.assert_close(both.encoder.text(PROMPTS).double(), rows, rtol=0, atol=1e-6)
    assert (expected[0] - expected[2]).abs().max() > 1e-3
    same = bool((found[0] - found[1]).abs().max() < 1e-12)
    assert same == (both.name == "siglip")  # nothing else leaves punctuation out
    lower = both.network.texts([both.encoder.family.preprocess_text(text) for text in ("a red mug", "A RED MUG")])
    assert bool((lower[0] - lower[1]).abs().max() < 1e-12) == (both.name != "metaclip2")
    # The comparison notices what SigLIP's users forget most often, but for MetaCLIP 2, which does not see what follows.
    unpadded = both.pooled(**both.processor.tokenizer(["a red mug"], return_tensors="pt"))
    assert bool((unpadded - lower[:1]).abs().max() > 1e-3) == (both.name != "metaclip2")


@torch.no_grad()
def value_path(both: Both, pixels: torch.Tensor) -> torch.Tensor:
    """The library's own modules, whose last attention looks at one patch alone, patch by patch."""
    more = {"naflex": {"max_num_patches": 40}, "metaclip2": {"do_center_crop": False}}.get(both.name, {})
    model, vision, inputs = both.model, both.model.vision_model, both.prepared(pixels, do_resize=False, **more)
    if both.name == "metaclip2":
        last, heard = vision.encoder.layers[-1], []
        hook = last.register_forward_pre_hook(lambda _, given: heard.append(given[0]))
        model.get_image_features(**inputs, interpolate_pos_encoding=True)
        hook.remove()
        tokens = last.layer_norm1(heard[0])[:, 1:]
        alone = [last.self_attn(tokens[:, i : i + 1])[0] for i in range(tokens.shape[1])]
        return model.visual_projection(vision.post_layernorm(torch.cat(alone, dim=1)))
    more = {} if both.name == "naflex" else {"interpolate_pos_encoding": True}
    tokens = vision(**inputs, **more).last_hidden_state
    count = int(inputs["spatial_shapes"][0].prod()) if both.name == "naflex" else tokens.shape[1]
    return torch.stack([vision.head(tokens[:, i : i + 1]) for i in range(count)], dim=1)


def test_patches_are_those_of_the_value_path(both: Both) -> None:
    for rows, columns in ((4, 4), (3, 5), (6, 2)):
        pixels = resize_image(IMAGE, rows * PATCH, columns * PATCH).round().to(torch.uint8)
        expected = value_path(both, pixels)
        assert expected.shape[:2] == (1, rows * columns)
        torch.testing.assert_close(both.network.patches(pixels), expected, rtol=0, atol=1e-6)
        assert (expected[0, 0] - expected[0, 1]).abs().max() > 1e-3
    view = PatchFeatures(both.encoder, 12).view(IMAGE, "a.jpg")
    assert view.features.shape == (12, both.network.width) and int(view.labels.max()) == 11
    found = both.network.patches(resize_image(IMAGE, 3 * PATCH, 4 * PATCH))[0]
    torch.testing.assert_close(view.features.double(), torch.nn.functional.normalize(found, dim=1), rtol=0, atol=1e-6)


@pytest.fixture
def folder(hub_weights: Path, tmp_path: Path) -> Path:
    return copied(hub_weights / "siglip2", tmp_path / "net")


def lifted(folder: Path, regions: Any) -> Any:
    """What is known of a field."""
    options = SourceOptions(encoder="siglip2", encoder_model=str(folder), regions=regions, region_count=12)
    features = make_source(options).identity
    return SimpleNamespace(manifest={"encoder": encoder_settings(options), "features": features, "dimension": 32})


def test_regions_are_patches_where_there_is_no_gpu(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    options = SourceOptions(encoder="siglip2", encoder_model=str(folder), region_count=12)
    assert resolve_regions(options) == "patches"
    assert make_source(options) == PatchFeatures(HuggingFaceEncoder(MODEL_FAMILIES["siglip2"], str(folder)), 12)
    monkeypatch.chdir(folder.parent)
    assert source_settings(SourceOptions(encoder="siglip2", encoder_model="net"))["encoder_model"] == str(folder)


def test_texts_asked_before_need_no_weights(folder: Path, tmp_path: Path) -> None:
    field, of_grid = lifted(folder, "patches"), lifted(folder, "grid")
    texts = text_encoder_for(field, cache=tmp_path / "texts")
    assert default_rule(field) == ("lerf", ("object", "things", "stuff", "texture"), 0.5)
    expected = texts.rows(["red mug", "table"])
    encoder = HuggingFaceEncoder(MODEL_FAMILIES["siglip2"], str(folder))
    assert torch.equal(torch.from_numpy(expected), encoder.text(["red mug", "table"]))
    assert len(text_encoder_for(of_grid, cache=tmp_path / "texts").rows(["mug"])) == 1
    config = folder / "tokenizer_config.json"  # other weights in the same place answer nothing new
    config.write_text(config.read_text() + " ")
    again = text_encoder_for(of_grid, cache=tmp_path / "texts")
    assert (again.rows(["red mug"]) == expected[:1]).all()
    refused(lambda: again.rows(["wine"]), "siglip2", "text_embeddings")
    folder.rename(tmp_path / "gone")
    (tmp_path / "manifest.json").write_text(json.dumps(field.manifest))
    program = (
        "import json, sys; from pathlib import Path; from normlift_ns.query.text_encoder import text_encoder_for\n"
        "class Field: manifest = json.loads(Path(sys.argv[1]).read_text())\n"
        "rows = text_encoder_for(Field, cache=Path(sys.argv[2])).rows(['table', 'red mug'])\n"
        "assert not {'torch', 'transformers', 'tokenizers'} & set(sys.modules), sys.modules.keys()\n"
        "print(json.dumps(rows.tolist()))"
    )
    words = [sys.executable, "-c", program, str(tmp_path / "manifest.json"), str(tmp_path / "texts")]
    done = subprocess.run(words, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert json.loads(done.stdout) == expected[::-1].tolist()
    asked = text_encoder_for(field, cache=tmp_path / "texts")
    refused(lambda: asked.rows(["wine"]), "net", "--encoder-model", error=FileNotFoundError)
