"""Where 2D semantics come from: an image becomes labelled regions with one unit feature each, a text a unit vector.

The two concerns are kept apart. `Regions` cuts an image into pieces, an `Encoder` puts pieces and texts into one space,
`RegionFeatures` joins one of each to a `FeatureSource`, which is all that the rest of the package knows. Whatever
brings labels and features together, as the importer of a preprocessed data set does, is a `FeatureSource` of its own.

An image may be cut in several ways, its levels. Evidence is rasterized once, on the pieces that all of them have in
common (`joint_partition`), and added up to the regions of the level that counts.
"""

from __future__ import annotations

import os
from collections import deque
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import Any, Protocol

import torch
from jaxtyping import Float32, Int32, Int64, UInt8
from torch import Tensor

from normlift_ns.encoders.ahead import ahead
from normlift_ns.encoders.texts.prompts import UNIT_TOLERANCE
from normlift_ns.errors import InputError


@dataclass(frozen=True)
class ViewFeatures:
    """The 2D semantics of one image, on the CPU: cells, the pieces that the rasterizer sums weights over, and regions,
    the sets of cells that have a feature.

    Cells depend on everything that is known of the image, not on what is chosen of it: another level of a source has
    the same cells, so that its evidence is there already.

    Raises:
        ValueError: wrong types or shapes, a label without a cell, a cell without a feature row, rows that are not unit
            vectors.
    """

    labels: Int32[Tensor, "h w"]
    """Cell of every pixel, in -1..C-1; -1: none."""
    features: Float32[Tensor, "r d"]
    """One unit row per region."""
    regions: Int32[Tensor, "levels c"] | None = None
    """Region of every cell in each level that counts, in -1..R-1; -1: none, as if the pixels were unlabelled. With
    several levels every pixel is seen once in each. None: every cell is a region."""

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
                f"{bad.numel()} of {len(self.features)} rows of ViewFeatures.features are not unit vectors (row "
                f"{first} has length {length[first]:.3g}); normalise them, and label regions without a feature -1"
            )

    @property
    def region_of_cell(self) -> Int32[Tensor, "levels c"]:
        """`regions`, also where they are the cells."""
        return torch.arange(len(self.features), dtype=torch.int32)[None] if self.regions is None else self.regions


def _check_range(name: str, values: Tensor, count: int, what: str) -> None:
    if values.numel() > 0 and not -1 <= int(values.min()) <= int(values.max()) < count:
        raise InputError(
            f"ViewFeatures.{name} must be in -1..{count - 1} (there are {count} {what}s), found "
            f"{int(values.min())}..{int(values.max())}"
        )


class FeatureSource(Protocol):
    """2D semantics of images, and texts in the same space."""

    @property
    def identity(self) -> dict[str, Any]:
        """Every setting that changes the result, ready for JSON; it stands in the manifest.

        Device and precision are left out: they change rounding only.
        """
        ...

    def available(self, names: Sequence[str]) -> list[str]:
        """The images, of those given, that have semantics; the others are left out of a lift, as if never taken.

        Raises:
            ValueError, FileNotFoundError: what `view` would raise, as far as it shows without looking at any image.
        """
        ...

    def view(self, image: UInt8[Tensor, "h w 3"], name: str) -> ViewFeatures:
        """Regions and features of one image.

        Args:
            image: RGB, 0..255.
            name: path of the image relative to its dataset, such as "images/0001.jpg".
        Raises:
            ValueError, FileNotFoundError: with what was found, what was expected and what to do.
        """
        ...

    def text(self, prompts: Sequence[str]) -> Float32[Tensor, "q d"]:
        """One unit row per prompt, on the CPU.

        Raises:
            ValueError: no prompt, an empty one, or one that the encoder does not understand.
        """
        ...


class Regions(Protocol):
    """A rule that cuts images into regions."""

    @property
    def identity(self) -> dict[str, Any]:
        """Every setting that changes `labels`, ready for JSON; not `chosen`."""
        ...

    @property
    def chosen(self) -> tuple[int, ...]:
        """The levels of `labels` that count, by number; (): the only one."""
        ...

    @property
    def at_once(self) -> int:
        """How many images to ask `labels` for at a time, each in a thread; 1 for a network, which fills its device."""
        ...

    def files(self, name: str) -> tuple[Path, ...]:
        """The files beside the image that `labels` reads for it.

        Raises:
            ValueError, FileNotFoundError: as `labels`.
        """
        ...

    def labels(self, image: UInt8[Tensor, "h w 3"], name: str) -> Int32[Tensor, "levels depth h w"]:
        """Region of every pixel in every level that there is, chosen or not; in each, ids 0..R-1 without gaps, -1 for
        none. A rule without levels returns one. They may be on any device.

        Where regions overlap, the one that counts is on top, at depth 0; those beneath are seen by the encoder only. A
        rule without overlaps returns depth 1.
        """
        ...


class TextEncoder(Protocol):
    """What queries need."""

    @property
    def identity(self) -> dict[str, Any]:
        """As in `FeatureSource`."""
        ...

    def text(self, prompts: Sequence[str]) -> Float32[Tensor, "q d"]:
        """As in `FeatureSource`."""
        ...


class Encoder(TextEncoder, Protocol):
    """A joint space of image regions and texts."""

    def encode(self, image: UInt8[Tensor, "h w 3"], labels: Int32[Tensor, "depth h w"]) -> Float32[Tensor, "r d"]:
        """One unit row per region, on the CPU; `labels` as `Regions.labels` returns them, of one level: a region is all
        pixels that have its id at any depth."""
        ...

    def encode_each(
        self, views: Iterable[tuple[UInt8[Tensor, "h w 3"], Int32[Tensor, "depth h w"]]]
    ) -> Iterator[Float32[Tensor, "r d"]]:
        """`encode` of several views, in their order, but for rounding. A view is asked for when the features of those
        before it are given, or can be found better together with its own."""
        ...


@dataclass(frozen=True)
class RegionFeatures:
    """A `FeatureSource` made of regions and an encoder."""

    regions: Regions
    encoder: Encoder

    @property
    def identity(self) -> dict[str, Any]:
        chosen = {"levels": list(self.regions.chosen)}
        return {"regions": self.regions.identity, **chosen, "encoder": self.encoder.identity}

    def available(self, names: Sequence[str]) -> list[str]:
        files = ((name, file) for name in names for file in self.regions.files(name))
        refuse_shared(files, "label map", "in folders that are named like those of the images")
        return list(names)

    def view(self, image: UInt8[Tensor, "h w 3"], name: str) -> ViewFeatures:
        return next(self.views([(image, name)]))

    def views(self, images: Iterable[tuple[UInt8[Tensor, "h w 3"], str]]) -> Iterator[ViewFeatures]:
        """As `each_view`."""
        cut: deque[tuple[Tensor, Tensor]] = deque()  # cells, and their regions in the chosen levels

        def levels() -> Iterator[tuple[Tensor, Tensor]]:
            chosen = list(self.regions.chosen or (0,))
            for image, maps in ahead(self._cut, images, self.regions.at_once):
                cells, regions = joint_partition(maps[:, 0])
                cut.append((cells.cpu(), regions[chosen].cpu()))
                for level in chosen:
                    yield image, maps[level]

        encoded = self.encoder.encode_each(levels())
        for rows in encoded:
            cells, regions = cut.popleft()
            features = [rows, *islice(encoded, len(regions) - 1)]
            first = torch.tensor([0, *map(len, features)]).cumsum(0)[:-1, None].int()
            yield ViewFeatures(cells, torch.cat(features), torch.where(regions >= 0, regions + first, -1))

    def _cut(self, view: tuple[Tensor, str]) -> tuple[UInt8[Tensor, "h w 3"], Int32[Tensor, "levels depth h w"]]:
        """An image, on the CPU, and its label maps, which have the chosen levels."""
        image, name = view
        check_image(image, name)
        image = image.cpu()
        maps = self.regions.labels(image, name)
        chosen = self.regions.chosen or (0,) * (len(maps) == 1)
        if len(chosen) == 0 or max(chosen) >= len(maps):
            found = ", ".join(map(str, self.regions.files(name))) or f"image {name}"
            raise InputError(f"{found} has {len(maps)} levels of regions, 0..{len(maps) - 1}; choose one with --level")
        return image, maps

    def text(self, prompts: Sequence[str]) -> Float32[Tensor, "q d"]:
        return self.encoder.text(prompts)


def cut_at_once(source: FeatureSource) -> int:
    """How many images a source works on at a time."""
    return source.regions.at_once if isinstance(source, RegionFeatures) else 1


def each_view(source: FeatureSource, images: Iterable[tuple[UInt8[Tensor, "h w 3"], str]]) -> Iterator[ViewFeatures]:
    """`source.view` of several images, in their order, but for rounding. Images are asked for as they are needed:
    several where an encoder sees the regions of several at once."""
    if isinstance(source, RegionFeatures):
        return source.views(images)
    return (source.view(image, name) for image, name in images)


def check_image(image: Tensor, name: str) -> None:
    """Raises ValueError unless `image` is a picture."""
    if image.ndim != 3 or image.shape[2] != 3 or image.dtype != torch.uint8 or image.numel() == 0:
        raise InputError(
            f"image {name} must be a uint8 tensor [H, W, 3] (RGB, 0..255), got {image.dtype} {tuple(image.shape)}"
        )


def refuse_shared(files: Iterable[tuple[str, Path]], what: str, how: str) -> None:
    """Makes sure that every image has files of its own, wherever links lead.

    Args:
        files: names of images, with a file of each.
        what: what the files are, for the message.
        how: to tell them apart.
    Raises:
        ValueError: two images share one.
    """
    owner: dict[str, str] = {}
    for name, file in files:
        other = owner.setdefault(os.path.realpath(file), name)
        if other != name:
            raise InputError(f"images {other} and {name} would share the {what} {file}; give each its own, {how}")


def joint_partition(maps: Int32[Tensor, "levels h w"]) -> tuple[Int32[Tensor, "h w"], Int32[Tensor, "levels c"]]:
    """Cells: the sets of pixels that have the same label in every level.

    Args:
        maps: region of every pixel in every level, -1 for none.
    Returns:
        The cell of every pixel, ids 0..C-1 without gaps, -1 where no level has a label; and the region of every cell in
        every level, -1 for none. With one level without gaps in its ids, cells are its regions.
    """
    key = torch.zeros_like(maps[0], dtype=torch.int64)
    most = 1
    for labels in maps:
        count = int(labels.max()) + 2
        key, most = key * count + labels + 1, most * count
        if len(maps) > 2:  # so that the product of the numbers of regions stays in 64 bits
            key, most = _numbered(key, most)
    cells, count = _numbered(key, most)
    nothing = int((maps == -1).all(dim=0).any())  # their key, 0, is the least
    cells = cells - nothing
    regions = torch.empty(len(maps), count - nothing, dtype=torch.int32, device=maps.device)
    labelled = cells >= 0
    for level, labels in enumerate(maps):
        regions[level, cells[labelled]] = labels[labelled]
    return cells.int(), regions


def _numbered(key: Int64[Tensor, "h w"], most: int) -> tuple[Int64[Tensor, "h w"], int]:
    """Numbers 0..C-1 in the order of the keys, which are in 0..most-1; and C."""
    if most > 8 * key.numel():
        values, number = key.unique(return_inverse=True)
        return number, len(values)
    there = torch.zeros(most, dtype=torch.bool, device=key.device)
    there[key] = True
    number = there.cumsum(0)
    return number[key] - 1, int(number[-1])
