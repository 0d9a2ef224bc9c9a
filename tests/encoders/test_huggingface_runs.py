"""A run that SigLIP 2 lifted: asked through the commands' own code, again without its weights, and with others."""

import json
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import torch

from normlift_ns.encoders.base import PatchFeatures
from normlift_ns.encoders.build import make_source, source_settings
from normlift_ns.encoders.huggingface import MODEL_FAMILIES
from normlift_ns.encoders.huggingface_network import HuggingFaceEncoder
from normlift_ns.options import SourceOptions
from normlift_ns.query.text_encoder import default_rule, encoder_settings, text_encoder_for
from normlift_ns.segmentation.registry import resolve_regions
from tests.encoders.tiny import copied, refused


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
    refused(lambda: again.rows(["wine"]), "siglip2", "--text-embeddings")
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
