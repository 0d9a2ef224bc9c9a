"""2D features kept on disk per view, so that an interrupted run resumes and a second one encodes nothing."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from hashlib import blake2b
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float32, UInt8
from safetensors import SafetensorError
from safetensors.torch import load, save
from torch import Tensor

from normlift_ns.core.files import atomic_path
from normlift_ns.encoders.source import FeatureSource, ViewFeatures

_FORMAT = "normlift_ns.view/1"
"""Part of every key: to be raised when labels or features change for the same settings."""


@dataclass(frozen=True)
class CachedFeatures:
    """A `FeatureSource` that keeps what another one has computed.

    A view is found again by the content of its image and of the files that the source reads for it, its name and the
    settings of the source. Files appear complete or not at all; a damaged one is computed again.
    """

    source: FeatureSource
    folder: Path
    """Holds one safetensors file per view; made if it does not exist. It may be deleted at any time."""

    @property
    def identity(self) -> dict[str, Any]:
        return self.source.identity

    def files(self, name: str) -> tuple[Path, ...]:
        return self.source.files(name)

    def view(self, image: UInt8[Tensor, "h w 3"], name: str) -> ViewFeatures:
        """As in `FeatureSource`.

        Raises:
            OSError: the folder cannot be written to, as when the disk is full.
        """
        path = self.path(image, name)
        found = _read(path)
        if found is None:
            found = self.source.view(image, name)
            _write(path, found)
        return found

    def text(self, prompts: Sequence[str]) -> Float32[Tensor, "q d"]:
        return self.source.text(prompts)

    def path(self, image: UInt8[Tensor, "h w 3"], name: str) -> Path:
        """Where a view is kept, whether it exists or not."""
        parts = [
            _FORMAT.encode(),
            json.dumps(self.identity, sort_keys=True).encode(),
            name.encode(),
            str((image.dtype, tuple(image.shape))).encode(),
            image.cpu().numpy().tobytes(),
            *(file.read_bytes() for file in self.files(name)),
        ]
        key = blake2b(b"".join(blake2b(part).digest() for part in parts), digest_size=16)
        return self.folder / f"{key.hexdigest()}.safetensors"


def _read(path: Path) -> ViewFeatures | None:
    try:
        tensors = load(path.read_bytes())
        return ViewFeatures(tensors["labels"].int(), tensors["features"])
    except (FileNotFoundError, SafetensorError, KeyError, ValueError):
        return None


def _write(path: Path, view: ViewFeatures) -> None:
    labels = view.labels.to(torch.int16) if len(view.features) < 2**15 else view.labels
    content = save({"labels": labels.contiguous(), "features": view.features.contiguous()})
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with atomic_path(path) as temporary:
            temporary.write_bytes(content)
    except OSError as error:
        raise OSError(
            f"cannot keep 2D features in {path.parent} ({error}); free disk space or choose another folder, then run "
            "again: the views that are done are found there"
        ) from error
