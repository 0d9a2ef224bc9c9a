"""Whether weights are on this machine, told without importing anything heavy."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest
from huggingface_hub import constants
from open_clip.pretrained import list_pretrained

from normlift_ns import InputError
from normlift_ns.encoders.clip.weights import check_names
from normlift_ns.encoders.sam.weights import check_sam
from normlift_ns.encoders.weights import clip_weights_at_hand, is_cached, sam_weights_at_hand
from normlift_ns.options import DEFAULT_MODEL, DEFAULT_PRETRAINED, DEFAULT_SAM

REPOSITORY = "laion/CLIP-ViT-B-16-laion2B-s34B-b88K"


@pytest.fixture(autouse=True)
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setattr(constants, "HF_HUB_CACHE", str(tmp_path / "hub"))
    return tmp_path / "hub"


def put(cache: Path, repository: str, file: str) -> None:
    folder = cache / f"models--{repository.replace('/', '--')}"
    (folder / "refs").mkdir(parents=True, exist_ok=True)
    (folder / "refs" / "main").write_text("abc")
    (folder / "snapshots" / "abc").mkdir(parents=True, exist_ok=True)
    (folder / "snapshots" / "abc" / file).touch()


def test_weights_of_openclip(cache: Path, tmp_path: Path) -> None:
    assert clip_weights_at_hand(DEFAULT_MODEL, DEFAULT_PRETRAINED) is False
    put(cache, REPOSITORY, "README.md")
    assert clip_weights_at_hand(DEFAULT_MODEL, DEFAULT_PRETRAINED) is False
    put(cache, REPOSITORY, "open_clip_model.safetensors")
    assert clip_weights_at_hand(DEFAULT_MODEL, DEFAULT_PRETRAINED) is True
    assert clip_weights_at_hand(DEFAULT_MODEL, DEFAULT_PRETRAINED.replace("_", "-")) is True
    put(cache, "jienengchen/ViTamin-S", "pytorch_model.bin")
    assert clip_weights_at_hand("ViTamin-S", "datacomp1b") is True
    (tmp_path / "my.pt").touch()
    assert clip_weights_at_hand("whatever", str(tmp_path / "my.pt")) is True


@pytest.mark.parametrize(("model", "tag"), [("nothing", "x"), (DEFAULT_MODEL, "x"), (DEFAULT_MODEL, "a\0b"), ("", "")])
def test_what_cannot_be_told(model: str, tag: str) -> None:
    assert clip_weights_at_hand(model, tag) is None


def test_all_published_weights_are_known() -> None:
    """The table is read from open_clip's source: this fails where another release writes it in another way."""
    assert all(clip_weights_at_hand(model, tag) is False for model, tag in list_pretrained())


def test_weights_of_sam(cache: Path, tmp_path: Path) -> None:
    assert not sam_weights_at_hand(DEFAULT_SAM)
    put(cache, DEFAULT_SAM, "config.json")
    assert not sam_weights_at_hand(DEFAULT_SAM)
    put(cache, DEFAULT_SAM, "model.safetensors")
    assert sam_weights_at_hand(DEFAULT_SAM)
    assert sam_weights_at_hand(str(tmp_path))
    assert not sam_weights_at_hand("a/b")


def test_a_broken_cache_holds_nothing(cache: Path) -> None:
    folder = cache / f"models--{REPOSITORY.replace('/', '--')}" / "refs"
    folder.mkdir(parents=True)
    for content in (b"\xff\xfe", b"a\0b", b"x" * 5000, b""):
        (folder / "main").write_bytes(content)
        assert not is_cached(REPOSITORY, "config.json")


def test_asking_is_cheap() -> None:
    code = """
import sys, time
started = time.process_time()
from normlift_ns.encoders.weights import clip_weights_at_hand
clip_weights_at_hand("ViT-B-16", "laion2b_s34b_b88k")
spent = time.process_time() - started
heavy = sorted({"torch", "open_clip", "transformers", "numpy", "skimage"} & set(sys.modules))
assert heavy == [] and spent < 0.3, (heavy, spent)
"""
    subprocess.run([sys.executable, "-c", code], check=True)


def test_what_is_no_weight_file_is_never_opened(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "a.pt")
    with pytest.raises(InputError, match=r"a\.pt is no weight file"):
        check_names(DEFAULT_MODEL, str(tmp_path / "a.pt"))
    with pytest.raises(InputError, match="is no weight file"):
        check_names(DEFAULT_MODEL, str(tmp_path))
    with pytest.raises(InputError, match="neither a file nor a folder"):
        check_sam(str(tmp_path / "a.pt"))
