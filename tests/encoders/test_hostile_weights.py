"""Weight files that are damaged: only our own errors leave the loaders."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from normlift_ns.encoders.clip.network import load_clip
from normlift_ns.encoders.sam.weights import load_sam
from normlift_ns.errors import InputError
from tests.encoders.tiny import CLIP, write_clip, write_sam
from tests.hostile import damaged, fuzz, hostile_json

EXAMPLES = [pytest.param(5, id="fast"), pytest.param(200, id="slow", marks=pytest.mark.slow)]


@pytest.mark.parametrize("examples", EXAMPLES)
@pytest.mark.parametrize("suffix", [".pt", ".safetensors"])
def test_damaged_weights_of_clip(suffix: str, examples: int, tmp_path: Path) -> None:
    write_clip(tmp_path)
    path = tmp_path / f"tiny{suffix}"
    fuzz(examples, damaged(path.read_bytes()), path, lambda: load_clip(CLIP, str(path), "cpu"))


@pytest.mark.parametrize("examples", EXAMPLES)
def test_damaged_weights_of_sam(examples: int, tmp_path: Path) -> None:
    path = tmp_path / "sam_tiny.pth"
    write_sam(path)
    fuzz(examples, damaged(path.read_bytes()), path, lambda: load_sam(str(path)))


@pytest.mark.parametrize("examples", EXAMPLES)
@pytest.mark.parametrize("file", ["config.json", "model.safetensors"])
def test_damaged_folders_of_sam(file: str, examples: int, tmp_path: Path) -> None:
    write_sam(tmp_path / "sam_tiny.pth")
    folder = tmp_path / "folder"
    load_sam(str(tmp_path / "sam_tiny.pth")).save_pretrained(folder)
    whole = (folder / file).read_bytes()
    fuzz(examples, damaged(whole), folder / file, lambda: load_sam(str(folder)))
    if file == "config.json":
        fuzz(examples, hostile_json(json.loads(whole)), folder / file, lambda: load_sam(str(folder)))


@pytest.mark.parametrize(("name", "value"), [("num_labels", 2**31), ("hidden_size", 10**9), ("layer_norm_eps", 1e300)])
def test_sizes_that_no_network_has_are_refused_before_it_is_built(name: str, value: float, tmp_path: Path) -> None:
    write_sam(tmp_path / "sam_tiny.pth")
    load_sam(str(tmp_path / "sam_tiny.pth")).save_pretrained(tmp_path / "folder")
    config = tmp_path / "folder" / "config.json"
    config.write_text(json.dumps(json.loads(config.read_text()) | {"vision_config": {name: value}}))
    with pytest.raises(InputError, match=f"{name} of config.json is .* expected at most"):
        load_sam(str(tmp_path / "folder"))
