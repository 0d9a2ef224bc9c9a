"""Regions of images: superpixels, grids and label maps from files, and safe image reading."""

from __future__ import annotations

import math
import os
import struct
import zlib
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path, PurePath
from typing import Any

import numpy as np
import torch
from jaxtyping import Int32, UInt8
from PIL import Image
from torch import Tensor

from normlift_ns.errors import InputError
from normlift_ns.io.arrays import read_npy
from normlift_ns.io.guard import open_regular

_IMAGE_FORMATS = ("PNG", "JPEG", "MPO", "WEBP", "TIFF", "BMP", "PPM")
"""Formats of training images. Pillow would hand some other formats to external programs: PostScript to Ghostscript."""
_MAX_PIXELS = 2**27
"""16,384 x 8,192. A file of a few bytes can decode to any number of equal pixels."""


def read_image(path: Path) -> UInt8[Tensor, "h w 3"]:
    """Read an image file as RGB, 0..255; an alpha channel is dropped.

    Raises:
        FileNotFoundError: If the file does not exist.
        ValueError: If the file is not an image, or is truncated.
    """
    with _open_image(path, "image", _IMAGE_FORMATS) as image:
        return torch.from_numpy(np.array(image.convert("RGB")))


@contextmanager
def _open_image(path: Path, what: str, formats: tuple[str, ...]) -> Iterator[Image.Image]:
    """Open an image file and check its size; turn exceptions that Pillow raises in the block into InputError."""
    if not os.path.isfile(path):
        if os.path.lexists(path):
            raise InputError(f"{what} {path} is not a file; expected an image")
        raise FileNotFoundError(f"{what} {path} does not exist; check the path, or whether the dataset was moved")
    try:
        with open_regular(path) as file, Image.open(file, formats=formats) as image:
            if image.width * image.height > _MAX_PIXELS:
                raise InputError(f"it has {image.width} x {image.height} pixels, at most {_MAX_PIXELS:,} are accepted")
            yield image
    except (  # exceptions of Pillow's decoders
        OSError, SyntaxError, ValueError, TypeError, LookupError, EOFError, OverflowError, struct.error, zlib.error,
        Image.DecompressionBombError,
    ) as error:  # fmt: skip
        raise InputError(
            f"{what} {path} is damaged or not an image ({error}); replace it with a file that Pillow can decode, such "
            f"as {formats[0]}"
        ) from error


def gray_bit_depth(path: Path) -> int | None:
    """Return the bits per pixel of a grayscale PNG, else None. Pillow stretches values of 2 and 4 bits to 0..255."""
    with open_regular(path) as file:
        head = file.read(26)
    return head[24] if head.startswith(b"\x89PNG") and len(head) == 26 and head[25] == 0 else None


# Segmentation of images into regions: superpixels, a grid, or label maps from files.


_MAP_SUFFIXES, _MAP_FORMATS = (".png", ".npy"), ("PNG",)
_MAX_MAP_BYTES = 2**31
"""Largest size of a label map file."""
_COMPACTNESS = 10.0
"""Weight of spatial distance against color distance in superpixels; higher values give squarer regions."""
_WORKERS = min(4, os.cpu_count() or 1)
"""Number of images that are segmented concurrently; superpixels need many times the memory of their image."""


class RegionDefaults:
    """Members of `Regions` for mask sources with one level and no files that segment one image at a time."""

    at_once = 1

    @property
    def chosen(self) -> tuple[int, ...]:
        return ()

    def files(self, name: str) -> tuple[Path, ...]:
        return ()


@dataclass(frozen=True)
class Superpixels(RegionDefaults):
    """Regions of similar size that follow image edges: SLIC on CIELAB color and position."""

    count: int = 256
    """Approximate number of superpixels per image, at least 1. An image has at most one per pixel."""

    at_once = _WORKERS

    @property
    def identity(self) -> dict[str, Any]:
        return {"kind": "superpixel", "count": self.count, "compactness": _COMPACTNESS}

    def labels(self, image: UInt8[Tensor, "h w 3"], name: str) -> Int32[Tensor, "1 1 h w"]:
        from skimage.segmentation import slic  # noqa: PLC0415 (takes 0.5 s; other regions do not need it)

        segments = slic(image.numpy(), n_segments=self.count, compactness=_COMPACTNESS, start_label=0)
        return _compact(segments, np.ones(segments.shape, dtype=bool))[None, None]


@dataclass(frozen=True)
class Grid(RegionDefaults):
    """Square cells of one size; the image border cuts off those at the right and lower edges."""

    count: int = 256
    """Approximate number of cells per image, at least 1. The side of a cell is a whole number of pixels."""

    @property
    def identity(self) -> dict[str, Any]:
        return {"kind": "grid", "count": self.count}

    def labels(self, image: UInt8[Tensor, "h w 3"], name: str) -> Int32[Tensor, "1 1 h w"]:
        height, width = image.shape[:2]
        side = max(1, round(math.sqrt(height * width / self.count)))
        rows, columns = torch.arange(height) // side, torch.arange(width) // side
        return (rows[:, None] * math.ceil(width / side) + columns).int()[None, None]


@dataclass(frozen=True)
class LabelFiles(RegionDefaults):
    """Label maps from a folder, one per image and of the size of the image. A PNG is grayscale with 1, 8 or 16 bits, or
    indexed, with palette indices as labels. An NPY file holds any integer type, and may hold several levels, [levels,
    H, W].

    The map of "images/left/0001.jpg" is the first of images/left/0001.png, left/0001.png and 0001.png that exists in
    the folder, or the same with .npy. Every value is one region, whether connected or not.

    Raises:
        FileNotFoundError: If the folder does not exist.
    """

    folder: Path
    background: int = 0
    """Value of pixels that belong to no region. Negative values never denote a region. With background -1, 0 denotes a
    region."""
    level: int | None = None
    """Index of the map that counts in an NPY file [levels, H, W]; None for files [H, W]."""
    resample: bool = False
    """Resize maps of another size to the image's by nearest neighbor, instead of raising an error."""
    divisor: int = 1
    """Factor by which images were downscaled, lift_downscale. Maps of their size before are downscaled, too."""
    description: str = "label map"
    """Name of a file in messages."""
    flag: str = "--regions-dir"
    """Name, in messages, of the option that sets the folder."""

    at_once = _WORKERS

    def __post_init__(self) -> None:
        if not os.path.isdir(self.folder):
            raise FileNotFoundError(
                f"folder of {self.description}s {self.folder} does not exist ({self.flag}); give a folder with one "
                "PNG or NPY file per image"
            )

    @property
    def identity(self) -> dict[str, Any]:
        return {"kind": "files", "background": self.background, "resample": self.resample}

    @property
    def chosen(self) -> tuple[int, ...]:
        return () if self.level is None else (self.level,)

    def files(self, name: str) -> tuple[Path, ...]:
        path = self.path(name)
        what = f"{self.description} {path}"
        if not path.is_file():
            raise InputError(f"{what} is not a file; expected a PNG or NPY file with one value per pixel")
        if path.stat().st_size > _MAX_MAP_BYTES:
            raise InputError(f"{what} has {path.stat().st_size:,} bytes, expected at most {_MAX_MAP_BYTES:,}")
        return (path,)

    def path(self, name: str) -> Path:
        """Return the path of the label map of an image.

        Raises:
            FileNotFoundError: If the map does not exist.
            ValueError: If there are both a PNG and an NPY file.
        """
        relative = PurePath(name)
        parts = [part for part in relative.parts if part not in ("..", relative.anchor)]
        for first in range(len(parts)):
            base = self.folder.joinpath(*parts[first:])
            paths = [path for suffix in _MAP_SUFFIXES if os.path.lexists(path := base.with_suffix(suffix))]
            if len(paths) > 1:
                raise InputError(
                    f"image {name} has two {self.description}s, {paths[0]} and {paths[1]}; keep one of them"
                )
            if len(paths) == 1:
                return paths[0]
        raise FileNotFoundError(
            f"image {name} has no {self.description} in {self.folder}; expected {relative.stem}.png or "
            f"{relative.stem}.npy"
        )

    def labels(self, image: UInt8[Tensor, "h w 3"], name: str) -> Int32[Tensor, "levels 1 h w"]:
        """Return the regions of an image; see `Regions.labels`.

        Raises:
            FileNotFoundError: If the label map does not exist.
            ValueError: If a map cannot be read, has color channels or fractional values, or differs in size from the
                image while `resample` is off.
        """
        path, maps = self.path(name), self.values(name)
        height, width = image.shape[:2]
        if maps.shape[1:] != (height, width):
            if not self.resample and not is_downscaled(maps.shape[1:], (height, width), self.divisor):
                downscaled = f" after lift_downscale {self.divisor}" if self.divisor > 1 else ""
                raise InputError(
                    f"{self.description} {path} is {maps.shape[2]}x{maps.shape[1]} (width x height), but its image "
                    f"{name} is {width}x{height}{downscaled}; make {self.description}s of the size of the image "
                    "(undistortion crops images), or resample them by nearest neighbor: --regions-resample True"
                )
            maps = resample_nearest(maps, height, width)
        return torch.stack([_compact(level, (level != self.background) & (level >= 0)) for level in maps])[:, None]

    def size(self, name: str) -> tuple[Path, int, int]:
        """Return the path, width and height of the label map of an image; raises like `values`."""
        path = self.path(name)
        if path.suffix != ".npy":
            with _open_image(path, self.description, _MAP_FORMATS) as image:
                return path, *image.size
        _, height, width = self.values(name).shape
        return path, width, height

    def values(self, name: str) -> np.ndarray:
        """Return the stored maps of an image, [levels, H, W], of an integer type.

        Raises:
            FileNotFoundError: If the label map does not exist.
            ValueError: If a map cannot be read, or has color channels or fractional values.
        """
        path = self.path(name)
        what = f"{self.description} {path}"
        if path.suffix == ".npy":
            maps = read_npy(path, self.description)
        else:
            with _open_image(path, self.description, _MAP_FORMATS) as image:
                maps = np.array(image)
            bits = gray_bit_depth(path)
            if bits in (2, 4):
                raise InputError(
                    f"{what} is a grayscale PNG with {bits} bits, whose values readers multiply by "
                    f"{255 // (2**bits - 1)}; save it as grayscale with 8 or 16 bits, as an indexed PNG, or as NPY"
                )
        if maps.ndim == 3 and path.suffix == ".png":
            raise InputError(
                f"{what} has {maps.shape[2]} color channels; expected one value per pixel: save "
                "it as an 8-bit or 16-bit grayscale PNG, as an indexed PNG, or as NPY"
            )
        if maps.dtype.kind not in "iub":
            raise InputError(f"{what} holds {maps.dtype}; expected an integer type: save it with .astype(numpy.int32)")
        if maps.ndim not in (2, 3) or maps.size == 0:
            raise InputError(f"{what} has shape {maps.shape}, expected [H, W] or [levels, H, W]")
        maps = maps.astype(np.uint8) if maps.dtype == bool else maps
        return maps.reshape(-1, *maps.shape[-2:])


def is_downscaled(before: Sequence[int], after: Sequence[int], divisor: int) -> bool:
    """Return whether one size is the other after downscaling.

    >>> is_downscaled((7, 10), (3, 5), 2), is_downscaled((3, 5), (3, 5), 1), is_downscaled((8, 10), (3, 5), 2)
    (True, True, False)
    """
    return tuple(side // divisor for side in before) == tuple(after)


def resample_nearest(maps: np.ndarray, height: int, width: int) -> np.ndarray:
    """Resize maps [levels, H, W] by nearest neighbor."""
    return maps[:, _nearest(height, maps.shape[1])][:, :, _nearest(width, maps.shape[2])]


def _nearest(size: int, source_size: int) -> np.ndarray:
    """Return, for every pixel of a line, the pixel of a line of another size whose area contains its center."""
    return (2 * np.arange(size) + 1) * source_size // (2 * size)


def _compact(values: np.ndarray, labeled: np.ndarray) -> Int32[Tensor, "h w"]:
    """Renumber the values of labeled pixels to 0..R-1, in ascending order; other pixels get -1."""
    labels = np.full(values.shape, -1, dtype=np.int32)
    labels[labeled] = np.unique(values[labeled], return_inverse=True)[1]
    return torch.from_numpy(labels)
