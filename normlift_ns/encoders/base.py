"""Protocols for feature sources, segmentation methods and encoders, and basic implementations of feature sources.

Segmentation and encoding are separate steps. `Regions` segments an image, and an `Encoder` embeds regions and prompts
in a joint space. `RegionFeatures` combines the two into a `FeatureSource`, the protocol that the lift uses. A source
that reads labels and features together, such as an importer, implements `FeatureSource` directly.

An image can be segmented at several levels. The rasterizer computes evidence once, for cells that are common to all
levels (see `joint_partition`). The lift then sums the evidence over the regions of the selected levels.
"""

from __future__ import annotations

import math
import re
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from hashlib import blake2b
from itertools import islice
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

import numpy as np
import torch
from jaxtyping import Bool, Float, Float32, Int, Int32, Int64, UInt8
from torch import Tensor

from normlift_ns.core.arguments import as_tensor
from normlift_ns.core.device import AdaptiveBatches, prefetch_map
from normlift_ns.encoders.text_files import UNIT_TOLERANCE, TextEncoder, check_prompts, look_up_embeddings, unit_rows
from normlift_ns.errors import InputError
from normlift_ns.io.guard import check_files_distinct
from normlift_ns.segmentation.regions import is_downscaled, resample_nearest


@dataclass(frozen=True)
class ViewFeatures:
    """2D features of one image, on the CPU.

    The rasterizer sums compositing weights over the pixels of each cell. A region is a set of cells with a common
    feature. Cells depend on all levels of an image, not only on the selected ones, so the cached evidence is valid for
    any selection.

    Raises:
        ValueError: If a type, device or number of dimensions is wrong, a label or region index is out of range, or a
            feature row is not a unit vector.
    """

    labels: Int32[Tensor, "h w"]
    """Cell of each pixel, in 0..C-1 for C cells, or -1 for none."""
    features: Float32[Tensor, "r d"]
    """Feature of each region, a unit vector."""
    regions: Int32[Tensor, "levels c"] | None = None
    """Region of each cell in each selected level, as a row index of `features`, or -1 if the cell is unlabeled. Each
    pixel counts once per level. If None, each cell is a region."""

    def __post_init__(self) -> None:
        for name, dtype in (("labels", torch.int32), ("features", torch.float32), ("regions", torch.int32)):
            value: Tensor | None = getattr(self, name)
            if value is not None and (value.ndim != 2 or value.dtype != dtype or value.device.type != "cpu"):
                raise InputError(
                    f"ViewFeatures.{name} must be a {dtype} matrix on the CPU, got {value.dtype} "
                    f"{tuple(value.shape)} on {value.device}"
                )
        cells = len(self.features) if self.regions is None else self.regions.shape[1]
        _check_range("labels", self.labels, cells, "cell")
        if self.regions is not None:
            _check_range("regions", self.regions, len(self.features), "feature row")
        length = torch.linalg.vector_norm(self.features.double(), dim=1)
        bad = (~((length - 1).abs() < UNIT_TOLERANCE)).nonzero().squeeze(1)
        if bad.numel() > 0:
            first = int(bad[0])
            raise InputError(
                f"each row of ViewFeatures.features must be a unit vector, but row {first} has length "
                f"{length[first]:.3g} (rows with wrong lengths: {bad.numel()} of {len(self.features)}); normalize "
                "the rows, and use the label -1 for regions without a feature"
            )

    @property
    def region_of_cell(self) -> Int32[Tensor, "levels c"]:
        """`regions`, or the identity mapping if `regions` is None."""
        return torch.arange(len(self.features), dtype=torch.int32)[None] if self.regions is None else self.regions


def _check_range(name: str, values: Tensor, count: int, unit: str) -> None:
    """Raise InputError if a value is not in -1..count-1."""
    if values.numel() > 0 and not -1 <= int(values.min()) <= int(values.max()) < count:
        raise InputError(
            f"ViewFeatures.{name} must be in -1..{count - 1} (number of {unit}s: {count}), found "
            f"{int(values.min())}..{int(values.max())}"
        )


class FeatureSource(Protocol):
    """A source of 2D image features and of prompt embeddings in the same space."""

    @property
    def identity(self) -> dict[str, Any]:
        """All settings that change the image features, as JSON-serializable values for the manifest.

        The device and the precision of encoders are excluded, because they affect only rounding.
        """
        ...

    def available(self, names: Sequence[str]) -> list[str]:
        """Return the names of the given images that have features; the lift ignores all other images.

        Raises:
            ValueError, FileNotFoundError: If an error of `view` can be detected without reading an image.
        """
        ...

    def view(self, image: UInt8[Tensor, "h w 3"], name: str) -> ViewFeatures:
        """Return the regions and features of one image.

        Args:
            image: RGB, 0..255.
            name: Path of the image relative to its dataset, such as "images/0001.jpg".
        Raises:
            ValueError, FileNotFoundError: If the image or its features are missing or invalid.
        """
        ...

    def text(self, prompts: Sequence[str]) -> Float32[Tensor, "q d"]:
        """Return one unit vector per prompt, on the CPU.

        Raises:
            ValueError: If `prompts` or a prompt is empty, or the encoder cannot embed a prompt.
        """
        ...


@runtime_checkable
class StoredMaps(Protocol):
    """Label maps in files, with or without features. Their size can differ from that of the images."""

    @property
    def resample(self) -> bool:
        """True to accept maps of any size."""
        ...

    def size(self, name: str) -> tuple[Path, int, int]:
        """Return the path, width and height of the map of an image."""
        ...


class Regions(Protocol):
    """A method that segments images into regions."""

    @property
    def identity(self) -> dict[str, Any]:
        """All settings that change `labels`, as JSON-serializable values. They do not include `chosen`."""
        ...

    @property
    def chosen(self) -> tuple[int, ...]:
        """Indices of the selected levels of `labels`; may be empty if there is only one level."""
        ...

    @property
    def at_once(self) -> int:
        """Number of images to segment concurrently, one per thread; 1 if a single image fully uses the device."""
        ...

    def files(self, name: str) -> tuple[Path, ...]:
        """Return the files that `labels` reads for an image, excluding the image itself.

        Raises:
            ValueError, FileNotFoundError: For the same reasons as `labels`.
        """
        ...

    def labels(self, image: UInt8[Tensor, "h w 3"], name: str) -> Int32[Tensor, "levels depth h w"]:
        """Return the region of each pixel in each level, selected or not. The result can be on any device.

        The region ids of a level are consecutive, 0..R-1, and unlabeled pixels are -1. A method without levels returns
        one level. If regions overlap, the lift uses the region at depth 0, and only the encoder uses those at other
        depths. A method without overlaps returns a depth of 1.
        """
        ...


class Encoder(TextEncoder, Protocol):
    """An encoder of image regions and prompts into a joint embedding space."""

    def encode(self, image: UInt8[Tensor, "h w 3"], labels: Int32[Tensor, "depth h w"]) -> Float32[Tensor, "r d"]:
        """Return one unit vector per region, on the CPU, or a zero row if the region has no feature.

        The lift treats the pixels of regions without a feature as unlabeled. `labels` is one level of `Regions.labels`.
        A region consists of all pixels that have its id at any depth.
        """
        ...

    def encode_each(
        self, views: Iterable[tuple[UInt8[Tensor, "h w 3"], Int32[Tensor, "depth h w"]]]
    ) -> Iterator[Float32[Tensor, "r d"]]:
        """Yield the result of `encode` for each view, in order. Results may differ from `encode` by rounding.

        The iterator reads ahead in `views` if it batches the regions of several views or encodes views concurrently.
        """
        return (self.encode(image, labels) for image, labels in views)


@dataclass(frozen=True)
class RegionFeatures:
    """A `FeatureSource` that consists of a segmentation method and an encoder."""

    regions: Regions
    encoder: Encoder
    filled: Callable[[str, int, int], Bool[Tensor, "h w"]] | None = None
    """Function that returns a mask of valid pixels, given the name, height and width of an image; None if all pixels
    are valid. Undistorted fisheye images can have invalid pixels, which do not belong to any region."""

    @property
    def identity(self) -> dict[str, Any]:
        chosen = {"levels": list(self.regions.chosen)}
        return {"regions": self.regions.identity, **chosen, "encoder": self.encoder.identity}

    def available(self, names: Sequence[str]) -> list[str]:
        files = ((name, file) for name in names for file in self.regions.files(name))
        check_files_distinct(files, "label map", "in folders named like those of the images")
        return list(names)

    def view(self, image: UInt8[Tensor, "h w 3"], name: str) -> ViewFeatures:
        return next(self.views([(image, name)]))

    def views(self, images: Iterable[tuple[UInt8[Tensor, "h w 3"], str]]) -> Iterator[ViewFeatures]:
        """Yield the features of several images; see `iterate_view_features`."""
        pending: deque[tuple[Tensor, Tensor]] = deque()  # cells, and their regions in the selected levels

        def selected_levels() -> Iterator[tuple[Tensor, Tensor]]:
            chosen = list(self.regions.chosen or (0,))
            for image, maps, cells, regions in prefetch_map(self._segment, images, self.regions.at_once):
                pending.append((cells, regions[chosen]))
                for level in chosen:
                    yield image, maps[level]

        encoded = self.encoder.encode_each(selected_levels())
        for rows in encoded:
            cells, regions = pending.popleft()
            features = [rows, *islice(encoded, len(regions) - 1)]
            offsets = torch.tensor([0, *map(len, features)]).cumsum(0)[:-1, None].int()
            yield ViewFeatures(
                cells, *drop_zero_rows(torch.cat(features), torch.where(regions >= 0, regions + offsets, -1))
            )

    def _segment(
        self, view: tuple[Tensor, str]
    ) -> tuple[
        UInt8[Tensor, "h w 3"], Int32[Tensor, "levels depth h w"], Int32[Tensor, "h w"], Int32[Tensor, "levels c"]
    ]:
        """Return the image, its label maps, the cell of each pixel, and the region of each cell in each level.

        All tensors except the label maps are on the CPU.

        Raises:
            InputError: If the image is invalid, a selected level is missing, or there are several levels and none is
                selected.
        """
        image, name = view
        check_image(image, name)
        image = image.cpu()
        maps = self.regions.labels(image, name)
        chosen = self.regions.chosen or (0,) * (len(maps) == 1)
        if len(chosen) == 0 or max(chosen) >= len(maps):
            origin = ", ".join(map(str, self.regions.files(name))) or f"image {name}"
            several = f"the levels 0..{len(maps) - 1}; select one of them with --level"
            raise InputError(f"{origin} has {'only level 0; leave out --level' if len(maps) == 1 else several}")
        maps = maps if self.filled is None else _limit_regions(maps, self.filled(name, *image.shape[:2]))
        cells, regions = joint_partition(maps[:, 0])
        return image, maps, cells.cpu(), regions.cpu()

    def text(self, prompts: Sequence[str]) -> Float32[Tensor, "q d"]:
        return self.encoder.text(prompts)


def _limit_regions(
    maps: Int32[Tensor, "levels depth h w"], kept: Bool[Tensor, "h w"]
) -> Int32[Tensor, "levels depth h w"]:
    """Set pixels outside the mask `kept` to -1, and renumber the regions that remain in each level."""
    if bool(kept.all()):
        return maps
    levels = []
    for level in maps.where(kept.to(maps.device), -1):
        ids, labels = level.unique(return_inverse=True)
        levels.append((labels - int(ids[0] == -1)).int())
    return torch.stack(levels)


def drop_zero_rows(
    features: Float32[Tensor, "r d"], regions: Int32[Tensor, "*n"]
) -> tuple[Float32[Tensor, "s d"], Int32[Tensor, "*n"]]:
    """Remove zero rows from `features`, and renumber `regions` accordingly; the ids of removed rows become -1.

    >>> drop_zero_rows(torch.tensor([[0.0], [1.0]]), torch.tensor([0, 1, -1], dtype=torch.int32))
    (tensor([[1.]]), tensor([-1,  0, -1], dtype=torch.int32))
    """
    found = features.any(dim=1)
    number = torch.cat([torch.where(found, found.cumsum(0) - 1, -1), torch.tensor([-1])]).int()  # -1 stays -1
    return features[found], number[regions.long()]


def segmentation_workers(source: FeatureSource) -> int:
    """Return the number of images that a source segments concurrently."""
    return source.regions.at_once if isinstance(source, RegionFeatures) else 1


def iterate_view_features(
    source: FeatureSource, images: Iterable[tuple[UInt8[Tensor, "h w 3"], str]]
) -> Iterator[ViewFeatures]:
    """Yield the features of several images in order. Results may differ from `source.view` by rounding.

    The iterator reads ahead in `images` if the source processes several images at the same time.
    """
    if hasattr(source, "views") and not isinstance(source, PrecomputedFeatures):
        several: Any = source
        return several.views(images)
    return (source.view(image, name) for image, name in images)


def check_image(image: Tensor, name: str) -> None:
    """Raise ValueError unless `image` is a non-empty uint8 RGB image [H, W, 3]."""
    if image.ndim != 3 or image.shape[2] != 3 or image.dtype != torch.uint8 or image.numel() == 0:
        raise InputError(
            f"image {name} must be a non-empty uint8 tensor [H, W, 3] (RGB, 0..255), got {image.dtype} "
            f"{tuple(image.shape)}"
        )


def joint_partition(maps: Int32[Tensor, "levels h w"]) -> tuple[Int32[Tensor, "h w"], Int32[Tensor, "levels c"]]:
    """Partition an image into cells. Two pixels are in the same cell if they have the same label in each level.

    Args:
        maps: Region of each pixel in each level, or -1 for none.
    Returns:
        The cell of each pixel, and the region of each cell in each level. Cells have consecutive ids from 0. Pixels
        that are unlabeled in all levels have the cell id -1. The region of a cell is -1 in levels in which the cell is
        unlabeled. For one level with consecutive ids, cells equal regions.
    """
    if len(maps) == 1:
        counts = torch.bincount(maps.flatten() + 1)
        if bool(counts[1:].all()):
            return maps[0].int(), torch.arange(len(counts) - 1, dtype=torch.int32, device=maps.device)[None]
    key = torch.zeros_like(maps[0], dtype=torch.int64)
    key_count = 1
    for labels in maps:
        count = int(labels.max()) + 2
        key, key_count = key * count + labels + 1, key_count * count
        if len(maps) > 2:  # keep the product of the region counts within 64 bits
            key, key_count = _renumber(key, key_count)
    number, count = _renumber(key, key_count)
    unlabeled = int((maps == -1).all(dim=0).any())  # these pixels have key 0, the smallest
    regions = torch.empty(len(maps), count, dtype=torch.int32, device=maps.device)
    regions.scatter_(1, number.flatten().expand(len(maps), -1), maps.flatten(1).int())  # equal keys, equal labels
    return (number - unlabeled).int(), regions[:, unlabeled:].contiguous()


def _renumber(key: Int64[Tensor, "h w"], key_count: int) -> tuple[Int64[Tensor, "h w"], int]:
    """Replace each key by its rank among the distinct keys, from 0; return the ranks and the number of distinct keys.

    Keys are in 0..key_count-1.
    """
    if key_count > 8 * key.numel():
        values, number = key.unique(return_inverse=True)
        return number, len(values)
    present = torch.zeros(key_count, dtype=torch.bool, device=key.device)
    present[key] = True
    number = present.cumsum(0)
    return number[key] - 1, int(number[-1])


# Dense features without masks: each patch of a grid is a region with its own feature.


class DenseEncoder(Encoder, Protocol):
    """An encoder that can also embed the patches of an image."""

    @property
    def why_not_dense(self) -> str | None:
        """Error message, with a remedy, if the network cannot embed patches; else None."""
        ...

    def patches(self, image: UInt8[Tensor, "h w 3"], rows: int, columns: int) -> Float32[Tensor, "r d"]:
        """Return one unit vector or zero row per patch of a grid over the image, in row-major order.

        Raises:
            FileNotFoundError: If the weights are not available.
            ValueError: If the weight file is damaged or of a different architecture.
        """
        ...


@dataclass(frozen=True)
class PatchFeatures:
    """A `FeatureSource` whose regions are the patches of a grid.

    Raises:
        ValueError: If the encoder cannot embed patches.
    """

    encoder: DenseEncoder
    """Encoder of patches and prompts."""
    count: int = 1024
    """Approximate number of patches per image, at least 1."""

    def __post_init__(self) -> None:
        reason = self.encoder.why_not_dense
        if reason is not None:
            raise InputError(reason)

    @property
    def identity(self) -> dict[str, Any]:
        return {"kind": "patches", "count": self.count, "encoder": self.encoder.identity}

    def available(self, names: Sequence[str]) -> list[str]:
        return list(names)

    def view(self, image: UInt8[Tensor, "h w 3"], name: str) -> ViewFeatures:
        """Return the regions and features of one image. Raises the same errors as `features`."""
        features, labels = drop_zero_rows(self.features(image, name), self.labels(image))
        return ViewFeatures(labels, features)

    def labels(self, image: UInt8[Tensor, "h w 3"]) -> Int32[Tensor, "h w"]:
        """Return the patch that contains each pixel, numbered in row-major order."""
        height, width = image.shape[:2]
        rows, columns = patch_grid(height, width, self.count)
        patches = np.arange(rows * columns, dtype=np.int32).reshape(1, rows, columns)
        return torch.from_numpy(resample_nearest(patches, height, width)[0])

    def features(self, image: UInt8[Tensor, "h w 3"], name: str) -> Float32[Tensor, "r d"]:
        """Return one unit vector per patch, or a zero row if the patch has no feature.

        Raises:
            FileNotFoundError: If the weights are not available.
            ValueError: If the image is invalid, or the weight file is damaged or of a different architecture.
            MemoryError: If the image does not fit into the memory of the device.
        """
        check_image(image, name)
        rows, columns = patch_grid(image.shape[0], image.shape[1], self.count)
        return next(self._batches(lambda batch: self.encoder.patches(batch[0], rows, columns), image[None]))

    def text(self, prompts: Sequence[str]) -> Float32[Tensor, "q d"]:
        return self.encoder.text(prompts)

    @cached_property
    def _batches(self) -> AdaptiveBatches:
        return AdaptiveBatches(1)


def patch_grid(height: int, width: int, count: int) -> tuple[int, int]:
    """Return the numbers of rows and columns of a grid of about `count` squares, each at least one pixel wide.

    >>> patch_grid(960, 540, 1024)
    (43, 24)
    """
    side = max(1.0, math.sqrt(height * width / count))
    return max(1, round(height / side)), max(1, round(width / side))


def resize_image(image: UInt8[Tensor, "h w 3"], height: int, width: int) -> Float32[Tensor, "1 3 y x"]:
    """Resize an image by bicubic interpolation with antialiasing; values stay in 0..255."""
    pixels = image.permute(2, 0, 1)[None].float()
    size = height, width
    return torch.nn.functional.interpolate(pixels, size, mode="bicubic", antialias=True, align_corners=False).clamp(
        0, 255
    )


@dataclass(frozen=True)
class PrecomputedFeatures:
    """A `FeatureSource` of precomputed labels, region features and prompt embeddings, on the CPU."""

    views: Mapping[str, tuple[Int[Tensor, "h w"], Float[Tensor, "r d"]]]
    """Labels and vectors by image name. A label is the index of a vector, or -1 for none. Vectors can have any norm; a
    region with a zero vector has no feature."""
    texts: Mapping[str, Float[Tensor, " d"]]
    """Embedding of each prompt."""
    divisor: int = 1
    """Factor by which images were downscaled (`lift_downscale`). Labels at full size are downscaled to match."""

    @property
    def identity(self) -> dict[str, Any]:
        """Digest of the labels and vectors of all images."""
        digest = blake2b(digest_size=16)
        for name, (labels, vectors) in self.views.items():
            digest.update(f"{name} {labels.dtype} {tuple(labels.shape)} {vectors.dtype}".encode())
            digest.update(labels.numpy().tobytes())
            digest.update(vectors.numpy().tobytes())
        return {"kind": "given", "content": digest.hexdigest()}

    def available(self, names: Sequence[str]) -> list[str]:
        unknown = sorted(set(self.views) - set(names))
        if len(unknown) > 0:
            raise InputError(
                f"features has an entry for {unknown[0]!r}, which is not a training image; use the names in "
                f"scene.train.names, such as {names[0]!r}"
            )
        return [name for name in names if name in self.views]

    def view(self, image: UInt8[Tensor, "h w 3"], name: str) -> ViewFeatures:
        labels, vectors = self.views[name]
        if not is_downscaled(labels.shape, image.shape[:2], 1):
            if not is_downscaled(labels.shape, image.shape[:2], self.divisor):
                downscaled = f" after lift_downscale {self.divisor}" if self.divisor > 1 else ""
                raise InputError(
                    f"labels of {name} have size {tuple(labels.shape)} (height x width), but the undistorted image has "
                    f"size {tuple(image.shape[:2])}{downscaled}; pass labels of the undistorted image"
                )
            labels = torch.from_numpy(resample_nearest(labels.numpy()[None], *image.shape[:2])[0])
        vectors, labels = drop_zero_rows(vectors, labels.int())
        return ViewFeatures(labels, torch.from_numpy(unit_rows(vectors)))

    def text(self, prompts: Sequence[str]) -> Float32[Tensor, "q d"]:
        check_prompts(prompts)
        return torch.from_numpy(look_up_embeddings(prompts, self.texts, "the argument `texts`"))


def precomputed_features(features: Any, texts: Mapping[str, Any] | None, names: Sequence[str]) -> PrecomputedFeatures:
    """Convert tensors, arrays or lists to a source of precomputed features.

    Args:
        features: Either one (labels, vectors) pair per training image, in order, or a mapping from image names to such
            pairs. A mapping may omit images.
        texts: Vector of each prompt, or None.
        names: Names of all training images.
    Raises:
        ValueError: If `features` or `texts` has the wrong type.
        ValueError: If `features` is empty, or a list whose length differs from that of `names`.
        ValueError: If labels are not a non-empty integer matrix, or a label is neither -1 nor the index of a vector.
        ValueError: If vectors are not finite real numbers, or not [regions, D] with the same D for all images and
            prompts.
        ValueError: If the vector of a prompt is not [D], is zero, or is not finite.
        ValueError: If a prompt is empty, ends in .npy or contains invalid characters.
    """
    if not isinstance(features, Mapping | Sequence) or isinstance(features, str):
        raise InputError(
            f"features must be a list or a dictionary of (labels, vectors) pairs, got {type(features).__name__}"
        )
    if not isinstance(features, Mapping):
        if len(features) != len(names):
            raise InputError(
                "features must have one pair of labels and vectors per training image (number of images: "
                f"{len(names)}), got {len(features)}; pass the pairs in the order of scene.train.names, or a "
                "dictionary with those names as keys"
            )
        features = dict(zip(names, features))
    if len(features) == 0:
        raise InputError("features are empty; pass labels and vectors of at least one training image")
    if texts is not None and not (isinstance(texts, Mapping) and all(isinstance(text, str) for text in texts)):
        raise InputError("texts must be None or a dictionary from prompts to vectors")
    views = {name: _convert_view(name, pair) for name, pair in features.items()}
    vectors = {text: _convert_text(text, vector) for text, vector in (texts or {}).items()}
    lengths = {rows.shape[1] for _, rows in views.values()} | set(map(len, vectors.values()))
    if len(lengths) > 1:
        raise InputError(f"all vectors in features and texts must have the same length, found {sorted(lengths)}")
    return PrecomputedFeatures(views, vectors)


def _convert_view(name: str, pair: Any) -> tuple[Tensor, Tensor]:
    """Return the labels and vectors of one image as tensors; raise InputError if they are invalid."""
    if not isinstance(pair, tuple | list) or len(pair) != 2:
        length = f" of length {len(pair)}" if isinstance(pair, tuple | list) else ""
        raise InputError(f"features of {name} must be a pair of labels and vectors, got {type(pair).__name__}{length}")
    _check_dense(f"labels of {name}", pair[0])
    _check_dense(f"vectors of {name}", pair[1])
    try:
        labels = pair[0].detach().cpu().numpy() if isinstance(pair[0], Tensor) else np.asarray(pair[0])
    except ValueError as error:  # rows of different lengths
        raise InputError(f"labels of {name} must be a matrix of integers ({error})") from None
    if labels.dtype.kind not in "iub":
        raise InputError(f"labels of {name} must be integers, got {labels.dtype}")
    labels, vectors = torch.from_numpy(labels.astype(np.int64)), _to_floats(pair[1])
    if vectors.ndim != 2 or vectors.shape[1] == 0 or not bool(vectors.isfinite().all()):
        raise InputError(
            f"vectors of {name} must be finite and of shape [regions, D] with D >= 1, got {_describe(vectors)}"
        )
    low, high = (int(labels.min()), int(labels.max())) if labels.numel() > 0 else (0, 0)
    if labels.ndim != 2 or labels.numel() == 0 or low < -1 or high >= len(vectors):
        values = f" with values in {low}..{high}" if labels.numel() > 0 else ", which is empty"
        raise InputError(
            f"labels of {name} must be an integer matrix with values in -1..{len(vectors) - 1}, got "
            f"{tuple(labels.shape)}{values}"
        )
    return labels, vectors


def _check_dense(name: str, value: Any) -> None:
    """Raise InputError if a tensor is sparse, nested or on the meta device."""
    if isinstance(value, Tensor):
        as_tensor(name, value, "an array")


def _convert_text(text: str, values: Any) -> Tensor:
    """Return the vector of a prompt as a tensor; raise InputError if the prompt or its vector is invalid."""
    vector = _to_floats(values)
    if vector.ndim != 1 or not bool(vector.isfinite().all()) or not bool(vector.any()):
        found = _describe(vector) if bool(vector.any()) else f"a zero vector of shape {tuple(vector.shape)}"
        raise InputError(f"the vector of prompt {text!r} must be finite, not zero and of shape [D], got {found}")
    if text.strip() == "" or text.endswith(".npy") or re.search("[\0\ud800-\udfff]", text):
        raise InputError(
            f"{text!r} in texts is not a valid prompt, because it is empty, ends in .npy or contains invalid "
            "characters; use another prompt"
        )
    return vector


def _describe(vectors: Tensor) -> str:
    """Describe the shape of an array for a message, and note any values that are not finite."""
    return f"{tuple(vectors.shape)}{'' if bool(vectors.isfinite().all()) else ' with values that are not finite'}"


def _to_floats(values: Any) -> Tensor:
    """Convert values to a detached float32 or float64 CPU tensor; raise InputError if they are not real numbers."""
    try:
        tensor = values.detach().cpu() if isinstance(values, Tensor) else torch.from_numpy(np.array(values, order="C"))
    except (TypeError, ValueError) as error:
        raise InputError(f"vectors must be numbers ({error})") from None
    if tensor.is_complex():
        raise InputError("vectors must be real, got complex numbers")
    return tensor if tensor.dtype == torch.float64 else tensor.float()
