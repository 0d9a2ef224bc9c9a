"""Small networks on disk, made once for all tests; a test that changes files copies them."""

import urllib.error
import urllib.request
from collections.abc import Callable
from importlib import import_module
from pathlib import Path
from typing import Any

import pytest

from normlift_ns.encoders.open_clip import import_open_clip
from normlift_ns.encoders.open_clip_network import OpenClipEncoder
from normlift_ns.segmentation.checkpoint import load_sam_checkpoint
from tests.encoders.tiny import CLIP, HUB, write_clip, write_sam
from tests.segmentation.tiny_sam import write_tiny


@pytest.fixture(scope="session")
def transformers() -> Any:
    return import_module("transformers")


@pytest.fixture(scope="session")
def open_clip() -> Any:
    return import_open_clip()


@pytest.fixture(scope="session")
def clip_weights(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with tiny.pt and tiny.safetensors of the same CLIP, whose architecture open_clip knows from here on."""
    folder = tmp_path_factory.mktemp("clip")
    write_clip(folder)
    return folder


@pytest.fixture(scope="session")
def clip(clip_weights: Path) -> OpenClipEncoder:
    return OpenClipEncoder(CLIP, str(clip_weights / "tiny.pt"))


@pytest.fixture(scope="session")
def sam_weights(made_once: Callable[..., Path]) -> Path:
    """Meta's files sam_tiny.pth, and sam_eager.pth, whose masks depend on the point; folders `tiny` and `eager` of the
    same weights as transformers writes them."""

    def make(folder: Path) -> None:
        for name, gain in (("tiny", 1.0), ("eager", 6.0)):
            write_sam(folder / f"sam_{name}.pth", seed=1, gain=gain)
            load_sam_checkpoint(str(folder / f"sam_{name}.pth"))[1].save_pretrained(folder / name)

    return made_once("sam", make)


@pytest.fixture(scope="session")
def library_weights(made_once: Callable[..., Path]) -> Path:
    """Folders sam2, sam_hq and sam3, as transformers writes them."""

    def make(folder: Path) -> None:
        for kind in ("sam2", "sam_hq", "sam3"):
            write_tiny(folder / kind, kind, seed=2)

    return made_once("library", make)


@pytest.fixture
def unsure(monkeypatch: pytest.MonkeyPatch) -> None:
    """Random weights are never sure."""
    monkeypatch.setattr("normlift_ns.segmentation.sam3.SCORE_THRESHOLD", 0.2)


@pytest.fixture(scope="session")
def hub_weights(made_once: Callable[..., Path]) -> Path:
    def make(folder: Path) -> None:
        for name in HUB:
            import_module("tests.encoders.tiny_hub").write_hub(folder / name, name)

    return made_once("hub", make)


@pytest.fixture
def empty_hub(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Path:
    """An empty cache of the hub, and no server."""

    def refuse(*args: Any, **kwargs: Any) -> None:
        raise urllib.error.URLError("Name or service not known")

    monkeypatch.setattr(urllib.request, "urlopen", refuse)
    monkeypatch.setattr(import_module("huggingface_hub.constants"), "HF_HUB_CACHE", str(tmp_path / "hub"))
    return tmp_path / "hub"
