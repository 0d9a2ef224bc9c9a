"""Whether weights are on this machine, told without importing anything heavy."""

import os
from pathlib import Path
from typing import Any

from normlift_ns.encoders.open_clip import check_open_clip_names, has_local_clip_weights
from normlift_ns.encoders.weights import find_in_hub_cache, find_local_sam
from normlift_ns.options import DEFAULT_MODEL, DEFAULT_PRETRAINED, DEFAULT_SAM
from normlift_ns.segmentation.checkpoint import check_sam_checkpoint
from tests.encoders.tiny import refused

REPOSITORY = "laion/CLIP-ViT-B-16-laion2B-s34B-b88K"


def put(hub: Path, repository: str, file: str, content: bytes = b"") -> None:
    folder = hub / f"models--{repository.replace('/', '--')}"
    (folder / "refs").mkdir(parents=True, exist_ok=True)
    (folder / "refs" / "main").write_text("abc")
    (folder / "snapshots" / "abc").mkdir(parents=True, exist_ok=True)
    (folder / "snapshots" / "abc" / file).write_bytes(content)


def test_weights_of_openclip(empty_hub: Path, tmp_path: Path) -> None:
    assert has_local_clip_weights(DEFAULT_MODEL, DEFAULT_PRETRAINED) is False
    put(empty_hub, REPOSITORY, "README.md")
    assert has_local_clip_weights(DEFAULT_MODEL, DEFAULT_PRETRAINED) is False
    put(empty_hub, REPOSITORY, "open_clip_model.safetensors")
    assert has_local_clip_weights(DEFAULT_MODEL, DEFAULT_PRETRAINED) is True
    assert has_local_clip_weights(DEFAULT_MODEL, DEFAULT_PRETRAINED.replace("_", "-")) is True
    put(empty_hub, "jienengchen/ViTamin-S", "pytorch_model.bin")
    assert has_local_clip_weights("ViTamin-S", "datacomp1b") is True
    (tmp_path / "my.pt").touch()
    assert has_local_clip_weights("whatever", str(tmp_path / "my.pt")) is True
    for model, tag in (("nothing", "x"), (DEFAULT_MODEL, "x"), (DEFAULT_MODEL, "a\0b"), ("", "")):
        assert has_local_clip_weights(model, tag) is None, "cannot be told"


def test_all_published_weights_are_known(empty_hub: Path, open_clip: Any) -> None:
    """The table is read from open_clip's source: this fails where another release writes it in another way."""
    published = open_clip.list_pretrained()
    assert len(published) > 100
    assert all(has_local_clip_weights(model, tag) is False for model, tag in published[::9])


def test_weights_of_sam_and_a_broken_cache(empty_hub: Path, tmp_path: Path) -> None:
    for file in ("config.json", "model.safetensors"):
        assert find_local_sam(DEFAULT_SAM) is None
        put(empty_hub, DEFAULT_SAM, file)
    assert find_local_sam(DEFAULT_SAM) is not None
    assert find_local_sam(str(tmp_path)) == tmp_path
    assert find_local_sam("a/b") is None
    # A broken cache holds nothing
    put(empty_hub, REPOSITORY, "config.json")
    assert find_in_hub_cache(REPOSITORY, "config.json") is not None
    for content in (b"\xff\xfe", b"a\0b", b"x" * 5000, b""):
        (empty_hub / f"models--{REPOSITORY.replace('/', '--')}" / "refs" / "main").write_bytes(content)
        assert find_in_hub_cache(REPOSITORY, "config.json") is None


def test_what_is_no_weight_file_is_never_opened(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "a.pt")
    for path in (tmp_path / "a.pt", tmp_path):
        refused(lambda path=path: check_open_clip_names(DEFAULT_MODEL, str(path)), f"{path} is not a weight file")
    refused(lambda: check_sam_checkpoint(str(tmp_path / "a.pt")), str(tmp_path / "a.pt"), "neither a file nor a folder")
