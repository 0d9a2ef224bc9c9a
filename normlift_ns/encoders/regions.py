"""Cutting images into regions: superpixels, a grid, or label maps from files."""

from __future__ import annotations

import math
import os
from dataclasses import dataclass
from pathlib import Path, PurePath
from typing import Any

import numpy as np
import torch
from jaxtyping import Int32, UInt8
from torch import Tensor

from normlift_ns.encoders.images import grey_depth, read_pixels, read_size
from normlift_ns.encoders.npy import read_npy
from normlift_ns.errors import InputError

_SUFFIXES, _FORMATS = (".png", ".npy"), ("PNG",)
_MOST_BYTES = 2**31
"""Of a label map."""
_AT_ONCE = min(4, os.cpu_count() or 1)
"""Images that are cut at a time: superpixels need many times the memory of their image."""


@dataclass(frozen=True)
class Superpixels:
    """Regions of about the same size that follow the edges of the image: SLIC on CIELAB colour and position.

    Raises:
        ValueError: a count below 1, a compactness that is not positive.
    """

    count: int = 256
    """Superpixels per image, about; at least 1. An image gets no more than it has pixels."""
    compactness: float = 10.0
    """How much closeness in space counts against closeness in colour, > 0; higher gives squarer regions."""

    def __post_init__(self) -> None:
        _check_count(self.count)
        if not self.compactness > 0:
            raise InputError(f"compactness of superpixels must be positive, got {self.compactness}")

    @property
    def identity(self) -> dict[str, Any]:
        return {"kind": "superpixel", "count": self.count, "compactness": self.compactness}

    @property
    def at_once(self) -> int:
        return _AT_ONCE

    @property
    def chosen(self) -> tuple[int, ...]:
        return ()

    def files(self, name: str) -> tuple[Path, ...]:
        return ()

    def labels(self, image: UInt8[Tensor, "h w 3"], name: str) -> Int32[Tensor, "1 1 h w"]:
        from skimage.segmentation import slic  # noqa: PLC0415 (0.5 s that other regions need not wait)

        found = slic(image.numpy(), n_segments=self.count, compactness=self.compactness, start_label=0)
        return _compact(found, np.ones(found.shape, dtype=bool))[None, None]


@dataclass(frozen=True)
class Grid:
    """Square cells of one size; those at the right and lower edge are cut off.

    Raises:
        ValueError: a count below 1.
    """

    count: int = 256
    """Cells per image, about; at least 1. The side of a cell is a whole number of pixels."""

    def __post_init__(self) -> None:
        _check_count(self.count)

    @property
    def identity(self) -> dict[str, Any]:
        return {"kind": "grid", "count": self.count}

    @property
    def at_once(self) -> int:
        return 1

    @property
    def chosen(self) -> tuple[int, ...]:
        return ()

    def files(self, name: str) -> tuple[Path, ...]:
        return ()

    def labels(self, image: UInt8[Tensor, "h w 3"], name: str) -> Int32[Tensor, "1 1 h w"]:
        height, width = image.shape[:2]
        side = max(1, round(math.sqrt(height * width / self.count)))
        rows, columns = torch.arange(height) // side, torch.arange(width) // side
        return (rows[:, None] * math.ceil(width / side) + columns).int()[None, None]


@dataclass(frozen=True)
class LabelFiles:
    """Label maps from a folder, one per image: PNG (grey of 1, 8 or 16 bit, or palette, whose indices count) or NPY of
    any integer type, of the size of the image. An NPY file may hold several levels, [levels, H, W].

    The map of "images/left/0001.jpg" is the first that exists of images/left/0001.png, left/0001.png and 0001.png in
    the folder, or the same with .npy. Every value is one region, whether connected or not.

    Raises:
        FileNotFoundError: no such folder.
    """

    folder: Path
    background: int = 0
    """The value of pixels that belong to no region. Negative values are never a region. With -1 for the background, 0
    is a region like any other."""
    level: int | None = None
    """Which map of an NPY file [levels, H, W] counts; None for files [H, W]."""
    resample: bool = False
    """Bring maps of another size to the image's by nearest neighbour, instead of refusing them."""
    what: str = "label map"
    """What messages call a file."""
    flag: str = "--regions-dir"
    """What messages call the option that gives the folder."""

    def __post_init__(self) -> None:
        if not os.path.isdir(self.folder):
            raise FileNotFoundError(
                f"folder of {self.what}s {self.folder} does not exist ({self.flag}); give the folder that holds one "
                "PNG or NPY file per image"
            )

    @property
    def identity(self) -> dict[str, Any]:
        return {"kind": "files", "background": self.background, "resample": self.resample}

    @property
    def at_once(self) -> int:
        return _AT_ONCE

    @property
    def chosen(self) -> tuple[int, ...]:
        return () if self.level is None else (self.level,)

    def files(self, name: str) -> tuple[Path, ...]:
        path = self.path(name)
        if not path.is_file():
            raise InputError(f"{self.what} {path} is no file; expected a PNG or NPY file with one value per pixel")
        if path.stat().st_size > _MOST_BYTES:
            raise InputError(f"{self.what} {path} has {path.stat().st_size:,} bytes, expected {_MOST_BYTES:,} at most")
        return (path,)

    def path(self, name: str) -> Path:
        """The label map of an image.

        Raises:
            FileNotFoundError: there is none.
            ValueError: there are a PNG and an NPY file.
        """
        relative = PurePath(name)
        parts = [part for part in relative.parts if part not in ("..", relative.anchor)]
        for first in range(len(parts)):
            base = self.folder.joinpath(*parts[first:])
            found = [path for suffix in _SUFFIXES if os.path.lexists(path := base.with_suffix(suffix))]
            if len(found) > 1:
                raise InputError(f"image {name} has two {self.what}s, {found[0]} and {found[1]}; keep one of them")
            if len(found) == 1:
                return found[0]
        raise FileNotFoundError(
            f"image {name} has no {self.what} in {self.folder}; expected {relative.stem}.png or {relative.stem}.npy"
        )

    def labels(self, image: UInt8[Tensor, "h w 3"], name: str) -> Int32[Tensor, "levels 1 h w"]:
        """As in `Regions`.

        Raises:
            FileNotFoundError: no label map.
            ValueError: a map that cannot be read, has colour channels or fractional values, or has another size than
                the image while `resample` is off.
        """
        path, found = self.path(name), self.values(name)
        height, width = image.shape[:2]
        if found.shape[1:] != (height, width):
            if not self.resample:
                raise InputError(
                    f"{self.what} {path} is {found.shape[2]}x{found.shape[1]} (width x height), its image {name} is "
                    f"{width}x{height}; make {self.what}s of the image's size (undistorting an image crops it), or "
                    "resample them by nearest neighbour: --regions-resample True"
                )
            found = resample_nearest(found, height, width)
        return torch.stack([_compact(level, (level != self.background) & (level >= 0)) for level in found])[:, None]

    def size(self, name: str) -> tuple[Path, int, int]:
        """The map of an image, its width and its height; raises as `values`."""
        path = self.path(name)
        if path.suffix != ".npy":
            return path, *read_size(path, what=self.what, formats=_FORMATS)
        _, height, width = self.values(name).shape
        return path, width, height

    def values(self, name: str) -> np.ndarray:
        """The maps of an image as they are stored, [levels, H, W], of an integer type or booleans.

        Raises:
            FileNotFoundError: no label map.
            ValueError: a map that cannot be read, or has colour channels or fractional values.
        """
        path = self.path(name)
        if path.suffix == ".npy":
            found = read_npy(path, self.what)
        else:
            found = read_pixels(path, what=self.what, formats=_FORMATS)
            depth = grey_depth(path)
            if depth in (2, 4):
                raise InputError(
                    f"{self.what} {path} is a grey PNG of {depth} bits, whose values readers multiply by "
                    f"{255 // (2**depth - 1)}; save it as grey of 8 or 16 bits, as a palette PNG, or as NPY"
                )
        if found.ndim == 3 and path.suffix == ".png":
            raise InputError(
                f"{self.what} {path} has {found.shape[2]} colour channels; expected one value per pixel: save it as "
                "grey, 16-bit grey or palette PNG, or as NPY"
            )
        if found.dtype.kind not in "iub":
            raise InputError(
                f"{self.what} {path} holds {found.dtype}; expected an integer type: save it with .astype(numpy.int32)"
            )
        if found.ndim not in (2, 3) or found.size == 0:
            raise InputError(f"{self.what} {path} has shape {found.shape}, expected [H, W] or [levels, H, W]")
        found = found.astype(np.uint8) if found.dtype == bool else found
        return found.reshape(-1, *found.shape[-2:])


def _check_count(count: int) -> None:
    if count < 1:
        raise InputError(f"number of regions per image must be at least 1, got {count}")


def resample_nearest(maps: np.ndarray, height: int, width: int) -> np.ndarray:
    """Maps [levels, H, W] at another size, by nearest neighbour."""
    return maps[:, _nearest(height, maps.shape[1])][:, :, _nearest(width, maps.shape[2])]


def _nearest(size: int, source_size: int) -> np.ndarray:
    """For every pixel of a line, the pixel of a line of another size whose area holds its centre."""
    return (2 * np.arange(size) + 1) * source_size // (2 * size)


def _compact(found: np.ndarray, labelled: np.ndarray) -> Int32[Tensor, "h w"]:
    """Renumbers the values of labelled pixels 0..R-1, in ascending order; -1 elsewhere."""
    labels = np.full(found.shape, -1, dtype=np.int32)
    labels[labelled] = np.unique(found[labelled], return_inverse=True)[1]
    return torch.from_numpy(labels)
