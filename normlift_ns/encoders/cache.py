"""Disk cache of the regions and features of images, for interrupted and repeated lifts.

The key of an entry is a digest of everything that the entry depends on. Files are written atomically, and damaged or
renamed files are recomputed. The folders can be deleted at any time.
"""

from __future__ import annotations

import os
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import cached_property, partial
from pathlib import Path
from typing import Any, cast

import numpy as np
import torch
from jaxtyping import Bool, Float32, Int32, UInt8
from torch import Tensor

from normlift_ns.core.device import prefetch_map
from normlift_ns.encoders.base import FeatureSource, PatchFeatures, RegionFeatures, ViewFeatures, drop_zero_rows
from normlift_ns.encoders.text_files import UNIT_TOLERANCE, cache_path
from normlift_ns.errors import InputError
from normlift_ns.io.arrays import load_arrays, save_arrays
from normlift_ns.io.guard import read_file
from normlift_ns.segmentation.sam3 import Sam3Network, sam3_identity

REMEDY = "copy it from where the scene was lifted, or lift again with the same options: ns-normlift"


_READERS = 8
"""Number of images whose cached features are read in parallel."""


class NotCachedError(InputError):
    """Error for a result that is not in the cache and must not be computed."""


def cached(source: FeatureSource, folder: Path, *, compute: Callable[[Any], bool] = lambda part: True) -> FeatureSource:
    """Return a source that caches its expensive results in a folder.

    A source that is neither `RegionFeatures` nor `PatchFeatures` is returned unchanged.

    Args:
        compute: Function that returns True if the given regions or encoder may compute results that are not cached.
    Raises (when a view is requested):
        OSError: If the folder is not writable, for example because the disk is full.
        NotCachedError: If a result is not cached and `compute` returns False.
    """
    if isinstance(source, PatchFeatures):
        return cast(Any, CachedPatches(source, folder / "features", compute(source.encoder)))
    if not isinstance(source, RegionFeatures):
        return source
    regions: Any = CachedRegions(source.regions, folder / "regions", compute(source.regions))
    encoder: Any = CachedEncoder(source.encoder, folder / "features", compute(source.encoder))
    return RegionFeatures(regions, encoder)


@dataclass(frozen=True)
class _Cached:
    """Base class of caches. A cache also has all attributes of the object `inner` that it wraps."""

    inner: Any
    """Object that computes the results."""
    folder: Path
    """Folder with one safetensors file per image, or per image and level for an encoder; created if it does not
    exist."""
    compute: bool = True
    """True to compute results that are not cached, False to raise an error."""

    def __getattr__(self, name: str) -> Any:
        return getattr(self.inner, name)


@dataclass(frozen=True)
class CachedRegions(_Cached):
    """An implementation of `Regions` that caches the label maps of all levels.

    The key depends on the image, its name, the files read for it, and all settings except the selected levels.
    """

    def labels(self, image: UInt8[Tensor, "h w 3"], name: str) -> Int32[Tensor, "levels depth h w"]:
        path = self.path(image, name)
        labels = _read(path, "labels", lambda labels: _are_labels(labels, image), self.compute, name)
        if labels is None:
            labels = self.inner.labels(image, name)
            labels = (labels.to(torch.int16) if int(labels.max()) < 2**15 else labels).cpu()
            _write(path, "labels", labels)
        return labels.int()

    def path(self, image: UInt8[Tensor, "h w 3"], name: str) -> Path:
        """Return the cache path of the label maps of an image; the file may not exist."""
        files = [read_file(file, max_bytes=2**31) for file in self.files(name)]
        return cache_path(self.folder, self.identity, name.encode(), *_key_parts(image), *files)


@dataclass(frozen=True)
class CachedEncoder(_Cached):
    """An `Encoder` that caches region features.

    The key depends on the image, the labels and the settings.
    """

    def encode(self, image: UInt8[Tensor, "h w 3"], labels: Int32[Tensor, "depth h w"]) -> Float32[Tensor, "r d"]:
        return next(self.encode_each([(image, labels)]))

    def encode_each(
        self, views: Iterable[tuple[UInt8[Tensor, "h w 3"], Int32[Tensor, "depth h w"]]]
    ) -> Iterator[Float32[Tensor, "r d"]]:
        pending: deque[Tensor | None] = deque()  # cached features of views not yet yielded; None if being encoded
        paths: deque[Path] = deque()  # cache paths of the views being encoded

        def uncached() -> Iterator[tuple[Tensor, Tensor]]:
            for image, labels in views:
                path = self.path(image, labels)
                count = int(labels.max()) + 1 if labels.numel() > 0 else 0
                pending.append(_read(path, "features", partial(_are_units, count=count), self.compute))
                if pending[-1] is None:
                    paths.append(path)
                    yield image, labels

        for features in self.inner.encode_each(uncached()):
            _write(paths.popleft(), "features", features)
            while (rows := pending.popleft()) is not None:
                yield rows
            yield features
        yield from (rows for rows in pending if rows is not None)

    def path(self, image: UInt8[Tensor, "h w 3"], labels: Int32[Tensor, "depth h w"]) -> Path:
        """Return the cache path of the features of the regions in `labels`; the file may not exist."""
        return cache_path(self.folder, self.identity, *_key_parts(image), *_key_parts(labels))


@dataclass(frozen=True)
class CachedPatches(_Cached):
    """A wrapper of `PatchFeatures` that caches the features of images.

    The key depends on the image and the settings.
    """

    def view(self, image: UInt8[Tensor, "h w 3"], name: str) -> ViewFeatures:
        return next(self.views([(image, name)]))

    def views(self, images: Iterable[tuple[UInt8[Tensor, "h w 3"], str]]) -> Iterator[ViewFeatures]:
        """Yield the features of several images; see `iterate_view_features`."""

        def combine(labels: Tensor, features: Tensor) -> ViewFeatures:
            features, labels = drop_zero_rows(features, labels)
            return ViewFeatures(labels, features)

        def look_up(view: tuple[Tensor, str]) -> tuple[Tensor, str, Path, Tensor, ViewFeatures | None]:
            image, name = view
            path, labels = cache_path(self.folder, self.identity, *_key_parts(image)), self.inner.labels(image)
            features = _read(path, "features", partial(_are_units, count=int(labels.max()) + 1), self.compute)
            return image, name, path, labels, None if features is None else combine(labels, features)

        for image, name, path, labels, found in prefetch_map(look_up, images, _READERS):
            if found is not None:
                yield found
            else:
                features = self.inner.features(image, name)
                _write(path, "features", features)
                yield combine(labels, features)


@dataclass(frozen=True)
class CachedTextMasks:
    """A cache of SAM 3 masks for prompts. It loads the network only for prompts that are not cached.

    The key depends on the image, the prompt and the network. Masks are stored as bits.
    """

    checkpoint: str
    """Folder, or name on the Hugging Face hub."""
    device: str
    folder: Path
    """Folder with one safetensors file for each pair of image and prompt, created if it does not exist. If it is not
    writable, nothing is cached."""

    def find(self, image: UInt8[Tensor, "h w 3"], texts: Sequence[str]) -> Bool[Tensor, "q h w"]:
        """Return the union of the masks of each prompt. Raises the errors of `Sam3Network.load` and `segment`."""
        size = (image.shape[0], image.shape[1])
        paths = {text: cache_path(self.folder, self._identity, text.encode(), *_key_parts(image)) for text in texts}
        expected = torch.Size((size[0], -(-size[1] // 8)))  # packed bits

        def are_bits(bits: Tensor) -> bool:
            return bits.dtype == torch.uint8 and bits.shape == expected

        packed = {text: _read(path, "bits", are_bits) for text, path in paths.items()}
        new = [text for text, bits in packed.items() if bits is None]
        for text, masks in zip(new, self._network.segment(image, new) if len(new) > 0 else []):
            packed[text] = bits = torch.from_numpy(np.packbits(masks.union.cpu().numpy(), axis=1))
            with suppress(OSError):
                _write(paths[text], "bits", bits)
        rows = np.stack([bits.numpy() for text in texts if (bits := packed[text]) is not None])
        return torch.from_numpy(np.unpackbits(rows, axis=2, count=size[1]).astype(bool))

    @cached_property
    def _identity(self) -> dict[str, Any]:
        return sam3_identity(self.checkpoint, self.device)

    @cached_property
    def _network(self) -> Sam3Network:
        return Sam3Network.load(self.checkpoint, self.device)


def _key_parts(tensor: Tensor) -> tuple[bytes, bytes]:
    """Return the parts of a cache key that identify a tensor: its type and shape, and its content."""
    return str((tensor.dtype, tuple(tensor.shape))).encode(), tensor.cpu().contiguous().numpy().tobytes()


def _read(
    path: Path, name: str, is_valid: Callable[[Tensor], bool], compute: bool = True, image: str = "an image"
) -> Tensor | None:
    """Return a cached tensor, or None if it is missing, damaged, renamed or invalid.

    Raises:
        NotCachedError: Instead of returning None, if `compute` is False.
    """
    with suppress(FileNotFoundError, ValueError, KeyError):
        tensor = load_arrays(path, key=path.stem, framework="pt").arrays[name] if os.path.isfile(path) else None
        if tensor is not None and is_valid(tensor):
            return tensor
    if not compute:
        raise NotCachedError(f"the cache {path.parent.parent} lacks the {path.parent.name} of {image}; {REMEDY}")
    return None


def _are_labels(labels: Tensor, image: Tensor) -> bool:
    """Return True if a cached tensor contains valid label maps of the image, with consecutive ids in each level."""
    matches = labels.dtype in (torch.int16, torch.int32) and labels.ndim == 4 and labels.shape[2:] == image.shape[:2]
    if not matches or labels.numel() == 0 or int(labels.min()) < -1 or int(labels.max()) >= labels[0].numel():
        return False
    return all(bool(torch.bincount(level.flatten().int() + 1)[1:].all()) for level in labels)


def _are_units(rows: Tensor, count: int) -> bool:
    """Return True if a cached tensor has `count` rows, each a unit vector or zero."""
    if rows.dtype != torch.float32 or rows.ndim != 2 or rows.shape[-1] == 0 or len(rows) != count:
        return False
    length = torch.linalg.vector_norm(rows, dim=-1)
    return bool((((length - 1).abs() < UNIT_TOLERANCE) | (length == 0)).all())


def _write(path: Path, name: str, tensor: Tensor) -> None:
    """Write a tensor to the cache; raise OSError if this fails."""
    try:
        save_arrays(path, {name: tensor}, key=path.stem, overwrite=True)
    except OSError as error:
        raise OSError(f"cannot cache 2D {name} ({error}); the next lift reuses the views cached so far") from error
