"""Regions and features kept on disk per image, so that an interrupted run resumes and a second one computes neither.

An entry is found again by the content of all that it was made from. Files appear complete or not at all; one that is
damaged, or stands under the name of another, is computed again. The folders may be deleted at any time.
"""

from __future__ import annotations

import os
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cached_property, partial
from pathlib import Path
from typing import Any, cast

import numpy as np
import torch
from jaxtyping import Bool, Float32, Int32, UInt8
from torch import Tensor

from normlift_ns.core.disk.tensors import load_tensors, save_tensors
from normlift_ns.encoders.patches import PatchFeatures
from normlift_ns.encoders.sam.text_masks import Sam3Network, sam3_identity
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


class NotKeptError(Exception):
    """What was asked for is not in the cache."""


def only_kept(source: FeatureSource, folder: Path) -> FeatureSource:
    """The source with what is kept of it in a folder, which computes nothing that would be kept: `view` raises
    `NotKeptError` for an image of which something is missing. Sources of which nothing is kept are as they were.
    """
    found: Any = cached(source, folder)
    if isinstance(found, CachedPatches):
        return replace(found, source=cast(Any, _AbsentPatches(found.source)))
    if not isinstance(found, RegionFeatures):
        return found
    regions, encoder = cast(Any, found.regions), cast(Any, found.encoder)
    return replace(
        found,
        regions=replace(regions, regions=_AbsentRegions(regions.regions)),
        encoder=replace(encoder, encoder=_AbsentEncoder(encoder.encoder)),
    )


class _Absent:
    """Something that says what it is, and computes nothing."""

    def __init__(self, wanted: Any) -> None:
        self._wanted = wanted

    def __getattr__(self, name: str) -> Any:
        return getattr(self._wanted, name)


class _AbsentPatches(_Absent):
    def features(self, image: Tensor, name: str) -> Tensor:
        raise NotKeptError


class _AbsentRegions(_Absent):
    def labels(self, image: Tensor, name: str) -> Tensor:
        raise NotKeptError


class _AbsentEncoder(_Absent):
    def encode_each(self, views: Iterable[Any]) -> Iterator[Tensor]:
        for _ in views:
            raise NotKeptError
        yield from ()


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
    def at_once(self) -> int:
        return self.regions.at_once

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


@dataclass(frozen=True)
class KeptTextMasks:
    """What SAM 3 finds in photographs: where a text was asked before, its network is not even loaded.

    The key: the image, the text, and the network. Masks are kept as bits.
    """

    checkpoint: str
    """A folder, or a name on the hub."""
    device: str
    folder: Path
    """Holds one safetensors file per image and text; made if it does not exist. Where it cannot be written to, nothing
    is kept."""

    def find(self, image: UInt8[Tensor, "h w 3"], texts: Sequence[str]) -> Bool[Tensor, "q h w"]:
        """What is in any of the masks of each text; raises as `Sam3Network.load` and `Sam3Network.find`."""
        size = (image.shape[0], image.shape[1])
        paths = {text: cache_path(self.folder, self._identity, text.encode(), *_parts(image)) for text in texts}
        found = {text: _read(path, "bits", partial(_are_bits, size=size)) for text, path in paths.items()}
        new = [text for text, bits in found.items() if bits is None]
        for text, masks in zip(new, self._network.find(image, new) if len(new) > 0 else []):
            found[text] = bits = torch.from_numpy(np.packbits(masks.union.cpu().numpy(), axis=1))
            with suppress(OSError):
                _write(paths[text], "bits", bits)
        packed = np.stack([bits.numpy() for text in texts if (bits := found[text]) is not None])
        return torch.from_numpy(np.unpackbits(packed, axis=2, count=size[1]).astype(bool))

    @cached_property
    def _identity(self) -> dict[str, Any]:
        return sam3_identity(self.checkpoint, self.device)

    @cached_property
    def _network(self) -> Sam3Network:
        return Sam3Network.load(self.checkpoint, self.device)


def _are_bits(found: Tensor, size: tuple[int, int]) -> bool:
    return found.dtype == torch.uint8 and found.shape == (size[0], -(-size[1] // 8))


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
