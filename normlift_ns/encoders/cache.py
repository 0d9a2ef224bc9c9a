"""Regions and features kept on disk per image, so that an interrupted run resumes and a second one computes neither.

An entry is found again by the content of all that it was made from. Files appear complete or not at all; one that is
damaged, or stands under the name of another, is computed again. The folders may be deleted at any time.
"""

from __future__ import annotations

import os
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float32, Int32, UInt8
from torch import Tensor

from normlift_ns.core.disk.tensors import load_tensors, save_tensors
from normlift_ns.encoders.clip.patches import PatchFeatures
from normlift_ns.encoders.source import (
    Encoder,
    FeatureSource,
    RegionFeatures,
    Regions,
    ViewFeatures,
)
from normlift_ns.encoders.texts.kept import cache_path
from normlift_ns.encoders.texts.prompts import UNIT_TOLERANCE


def cached(source: FeatureSource, folder: Path) -> FeatureSource:
    """The source with everything kept in a folder that is expensive to compute again.

    Raises (later, where a view is asked for):
        OSError: the folder cannot be written to, as when the disk is full.
    """
    if isinstance(source, PatchFeatures):
        return CachedPatches(source, folder / "features")
    if not isinstance(source, RegionFeatures):
        return source
    regions, encoder = (
        CachedRegions(source.regions, folder / "regions"),
        CachedEncoder(source.encoder, folder / "features"),
    )
    return replace(source, regions=regions, encoder=encoder)


@dataclass(frozen=True)
class CachedRegions:
    """`Regions` that keep the label maps, of all levels, of images that they have seen.

    The key: the image, its name, the files that are read for it, and the settings but the chosen level.
    """

    regions: Regions
    folder: Path
    """Holds one safetensors file per image; made if it does not exist."""

    @property
    def identity(self) -> dict[str, Any]:
        return self.regions.identity

    @property
    def chosen(self) -> tuple[int, ...]:
        return self.regions.chosen

    def files(self, name: str) -> tuple[Path, ...]:
        return self.regions.files(name)

    def labels(self, image: UInt8[Tensor, "h w 3"], name: str) -> Int32[Tensor, "levels depth h w"]:
        path = self.path(image, name)
        found = _read(path, "labels", lambda labels: _are_labels(labels, image))
        if found is None:
            found = self.regions.labels(image, name)
            found = (found.to(torch.int16) if int(found.max()) < 2**15 else found).cpu()
            _write(path, "labels", found)
        return found.int()

    def path(self, image: UInt8[Tensor, "h w 3"], name: str) -> Path:
        """Where the label maps of an image are kept, whether they exist or not."""
        files = [file.read_bytes() for file in self.files(name)]
        return cache_path(self.folder, self.identity, name.encode(), *_parts(image), *files)


@dataclass(frozen=True)
class CachedEncoder:
    """An `Encoder` that keeps the features of regions that it has seen.

    The key: the image, the labels, and the settings.
    """

    encoder: Encoder
    folder: Path
    """Holds one safetensors file per image and level; made if it does not exist."""

    @property
    def identity(self) -> dict[str, Any]:
        return self.encoder.identity

    def encode(self, image: UInt8[Tensor, "h w 3"], labels: Int32[Tensor, "depth h w"]) -> Float32[Tensor, "r d"]:
        return next(self.encode_each([(image, labels)]))

    def encode_each(
        self, views: Iterable[tuple[UInt8[Tensor, "h w 3"], Int32[Tensor, "depth h w"]]]
    ) -> Iterator[Float32[Tensor, "r d"]]:
        kept: deque[Tensor | None] = deque()  # of the views asked for and not given; None: the encoder has them
        paths: deque[Path] = deque()  # of those that the encoder has

        def new() -> Iterator[tuple[Tensor, Tensor]]:
            for image, labels in views:
                path = self.path(image, labels)
                count = int(labels.max()) + 1 if labels.numel() > 0 else 0
                kept.append(_read(path, "features", partial(_are_units, count=count)))
                if kept[-1] is None:
                    paths.append(path)
                    yield image, labels

        for features in self.encoder.encode_each(new()):
            _write(paths.popleft(), "features", features)
            while (found := kept.popleft()) is not None:
                yield found
            yield features
        yield from (found for found in kept if found is not None)

    def text(self, prompts: Sequence[str]) -> Float32[Tensor, "q d"]:
        return self.encoder.text(prompts)

    def path(self, image: UInt8[Tensor, "h w 3"], labels: Int32[Tensor, "depth h w"]) -> Path:
        """Where the features of an image's regions are kept, whether they exist or not."""
        return cache_path(self.folder, self.identity, *_parts(image), *_parts(labels))


@dataclass(frozen=True)
class CachedPatches:
    """A `PatchFeatures` that keeps the features of images that it has seen.

    The key: the image, and the settings.
    """

    source: PatchFeatures
    folder: Path
    """Holds one safetensors file per image; made if it does not exist."""

    @property
    def identity(self) -> dict[str, Any]:
        return self.source.identity

    def available(self, names: Sequence[str]) -> list[str]:
        return self.source.available(names)

    def view(self, image: UInt8[Tensor, "h w 3"], name: str) -> ViewFeatures:
        path = cache_path(self.folder, self.identity, *_parts(image))
        labels = self.source.labels(image)
        found = _read(path, "features", partial(_are_units, count=int(labels.max()) + 1))
        if found is None:
            found = self.source.features(image, name)
            _write(path, "features", found)
        return ViewFeatures(labels, found)

    def text(self, prompts: Sequence[str]) -> Float32[Tensor, "q d"]:
        return self.source.text(prompts)


def _parts(tensor: Tensor) -> tuple[bytes, bytes]:
    return str((tensor.dtype, tuple(tensor.shape))).encode(), tensor.cpu().contiguous().numpy().tobytes()


def _read(path: Path, name: str, fits: Callable[[Tensor], bool]) -> Tensor | None:
    """What was kept; None also where the file is damaged, is that of another image, or holds what does not fit."""
    try:
        found = load_tensors(path, key=path.stem).tensors[name] if os.path.isfile(path) else None
    except (FileNotFoundError, ValueError, KeyError):
        return None
    return found if found is not None and fits(found) else None


def _are_labels(found: Tensor, image: Tensor) -> bool:
    fitting = found.dtype in (torch.int16, torch.int32) and found.ndim == 4 and found.shape[2:] == image.shape[:2]
    return fitting and found.numel() > 0 and int(found.min()) >= -1


def _are_units(found: Tensor, count: int) -> bool:
    if found.dtype != torch.float32 or found.ndim != 2 or found.shape[-1] == 0 or len(found) != count:
        return False
    return bool(((torch.linalg.vector_norm(found, dim=-1) - 1).abs() < UNIT_TOLERANCE).all())


def _write(path: Path, name: str, tensor: Tensor) -> None:
    try:
        save_tensors(path, {name: tensor}, key=path.stem, overwrite=True)
    except OSError as error:
        raise OSError(f"cannot keep 2D {name}: {error}; the views that are done are found there") from error
