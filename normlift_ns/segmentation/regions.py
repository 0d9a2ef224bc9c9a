"""Segmentation of images into superpixels, grids or label maps from files, and a safe reader of image files."""

from __future__ import annotations

import math
import os
import struct
import zlib
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path, PurePath
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Int32, UInt8
from PIL import Image
from torch import Tensor

from normlift_ns.errors import InputError
from normlift_ns.io.arrays import read_npy
from normlift_ns.io.guard import open_regular

_IMAGE_FORMATS = ("PNG", "JPEG", "MPO", "WEBP", "TIFF", "BMP", "PPM")
"""Formats of training images. Pillow passes some other formats to external programs, such as PostScript to
Ghostscript."""
_MASK_CHUNK = {"cuda": 2**29, "cpu": 2**26}
"""Number of elements of the largest temporary array of masks, by device type."""
_MAX_PIXELS = 2**27
"""Largest number of pixels, 16,384 x 8,192. A file of a few bytes can decode to a huge image of equal pixels."""


def read_image(path: Path) -> UInt8[Tensor, "h w 3"]:
    """Read an image file as RGB with values in 0..255, without its alpha channel.

    Raises:
        FileNotFoundError: If the file does not exist.
        ValueError: If the file is not an image, is truncated, or has more than 2**27 pixels.
    """
    with _open_image(path, "image", _IMAGE_FORMATS) as image:
        return torch.from_numpy(np.array(image.convert("RGB")))


@contextmanager
def _open_image(path: Path, what: str, formats: tuple[str, ...]) -> Iterator[Image.Image]:
    """Open an image file and check its size; convert exceptions of Pillow in the `with` block to InputError."""
    if not os.path.isfile(path):
        if os.path.lexists(path):
            raise InputError(f"{what} {path} is not a file; expected an image")
        raise FileNotFoundError(f"{what} {path} does not exist; check the path, or whether the dataset was moved")
    try:
        with open_regular(path) as file, Image.open(file, formats=formats) as image:
            if image.width * image.height > _MAX_PIXELS:
                raise Image.DecompressionBombError(f"{image.width} x {image.height} pixels")
            yield image
    except Image.DecompressionBombError as error:  # Pillow raises it too, above its own limit
        raise InputError(
            f"{what} {path} is too large ({error}), expected at most {_MAX_PIXELS:,} pixels; replace it with a smaller "
            "one"
        ) from error
    except (  # exceptions of Pillow's decoders
        OSError, SyntaxError, ValueError, TypeError, LookupError, EOFError, OverflowError, struct.error, zlib.error,
    ) as error:  # fmt: skip
        raise InputError(
            f"{what} {path} is damaged or not an image ({error}); replace it with a file that Pillow can decode, such "
            f"as {formats[0]}"
        ) from error


def gray_bit_depth(path: Path) -> int | None:
    """Return the bits per pixel of a grayscale PNG, or None for other files.

    Pillow scales values of 2 and 4 bits to 0..255.
    """
    with open_regular(path) as file:
        head = file.read(26)
    return head[24] if head.startswith(b"\x89PNG") and len(head) == 26 and head[25] == 0 else None


# Segmentation of images into superpixels, a grid, or label maps from files.


_MAP_SUFFIXES, _MAP_FORMATS = (".png", ".npy"), ("PNG",)
_MAX_MAP_BYTES = 2**31
"""Largest size of a label map file, in bytes."""
_WORKERS = min(8, os.cpu_count() or 1)
"""Number of images to segment concurrently. Superpixels need many times the memory of their image."""


class RegionDefaults:
    """Defaults of `Regions` for mask sources that have one level and no files, and segment one image at a time."""

    at_once = 1

    @property
    def chosen(self) -> tuple[int, ...]:
        return ()

    def files(self, name: str) -> tuple[Path, ...]:
        return ()


@dataclass(frozen=True)
class Superpixels(RegionDefaults):
    """Superpixels of CIELAB color and position, which have similar sizes and follow image edges."""

    count: int = 256
    """Approximate number of superpixels per image, at least 1. An image has at most one per pixel."""
    device: str = "cpu"

    at_once = _WORKERS

    @property
    def identity(self) -> dict[str, Any]:
        return {"kind": "superpixel", "version": 2, "count": self.count}

    def labels(self, image: UInt8[Tensor, "h w 3"], name: str) -> Int32[Tensor, "1 1 h w"]:
        from normlift_ns.segmentation.superpixels import superpixels  # noqa: PLC0415 (other regions do not need it)

        return torch.from_numpy(superpixels(image.to(self.device), self.count))[None, None]


@dataclass(frozen=True)
class Grid(RegionDefaults):
    """A grid of equal squares, which can be cut off at the right and lower borders of the image."""

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
    """Label maps from a folder, one per image, each of the size of its image.

    A PNG file is grayscale with 1, 8 or 16 bits, or indexed, with palette indices as labels. An NPY file has any
    integer type, and can contain several levels, [levels, H, W]. The map of "images/left/0001.jpg" is the first of
    images/left/0001.png, left/0001.png and 0001.png that exists in the folder. NPY files have the same names with the
    suffix .npy. All pixels with the same value form one region, even if they are not connected.

    Raises:
        FileNotFoundError: If the folder does not exist.
    """

    folder: Path
    background: int = 0
    """Value of unlabeled pixels. Negative values are always unlabeled, so with -1, the value 0 is a region."""
    level: int | None = None
    """Index of the selected level in NPY files [levels, H, W], or None for files [H, W]."""
    resample: bool = False
    """True to resize maps of a different size by nearest-neighbor interpolation, False to raise an error."""
    divisor: int = 1
    """Factor by which images were downscaled (`lift_downscale`). Maps of full-size images are downscaled to match."""
    undistort: Callable[[str, np.ndarray], np.ndarray] | None = None
    """Function of an image name and its maps [levels, H, W] that undistorts maps of original, distorted images.

    If None, the maps show the undistorted images."""
    description: str = "label map"
    """Description of a file in messages."""
    flag: str = "--regions-dir"
    """Option that sets the folder, for messages."""

    at_once = _WORKERS

    def __post_init__(self) -> None:
        if not os.path.isdir(self.folder):
            raise FileNotFoundError(
                f"the folder of {self.description}s {self.folder} does not exist ({self.flag}); give a folder with one "
                "PNG or NPY file per image"
            )

    @property
    def identity(self) -> dict[str, Any]:
        identity = {"kind": "files", "background": self.background, "resample": self.resample}
        return identity if self.undistort is None else {**identity, "undistort": True}

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
            ValueError: If both a PNG and an NPY file exist.
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
            ValueError: If a map cannot be read, or has color channels or fractional values.
            ValueError: If a map and its image differ in size, and `resample` is False.
        """
        path, maps = self.path(name), self.values(name)
        height, width = image.shape[:2]
        if maps.shape[1:] != (height, width):
            if not self.resample and not is_downscaled(maps.shape[1:], (height, width), self.divisor):
                downscaled = f" after lift_downscale {self.divisor}" if self.divisor > 1 else ""
                raise InputError(
                    f"{self.description} {path} is {maps.shape[2]}x{maps.shape[1]} (width x height), but its image "
                    f"{name} is {width}x{height}{downscaled}. Make {self.description}s of the size of the image, which "
                    "undistortion may have cropped, or resize them with --regions-resample True"
                )
            maps = resample_nearest(maps, height, width)
        return torch.stack([_compact(level, (level != self.background) & (level >= 0)) for level in maps])[:, None]

    def size(self, name: str) -> tuple[Path, int, int]:
        """Return the path, width and height of the label map of an image. Raises the same errors as `values`."""
        path = self.path(name)
        if path.suffix != ".npy":
            with _open_image(path, self.description, _MAP_FORMATS) as image:
                return path, *image.size
        _, height, width = self.values(name).shape
        return path, width, height

    def values(self, name: str) -> np.ndarray:
        """Read the label maps of an image, [levels, H, W], with their stored integer type unless `undistort` is given.

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
                    f"{what} is a grayscale PNG with {bits} bits per pixel. Image readers multiply the values of "
                    f"such files by {255 // (2**bits - 1)}. Save it as "
                    "grayscale with 8 or 16 bits, as an indexed PNG, or as NPY"
                )
        if maps.ndim == 3 and path.suffix == ".png":
            raise InputError(
                f"{what} has {maps.shape[2]} color channels, expected one value per pixel; save "
                "it as an 8-bit or 16-bit grayscale PNG, as an indexed PNG, or as NPY"
            )
        if maps.dtype.kind not in "iub":
            raise InputError(f"{what} has type {maps.dtype}, expected an integer; save it with .astype(numpy.int32)")
        if maps.ndim not in (2, 3) or maps.size == 0:
            raise InputError(f"{what} has shape {maps.shape}, expected [H, W] or [levels, H, W]")
        maps = maps.astype(np.uint8) if maps.dtype == bool else maps
        maps = maps.reshape(-1, *maps.shape[-2:])
        return maps if self.undistort is None else self.undistort(name, maps)


def is_downscaled(before: Sequence[int], after: Sequence[int], divisor: int) -> bool:
    """Return whether the size `after` is the size `before` divided by `divisor`, rounded down.

    >>> is_downscaled((7, 10), (3, 5), 2), is_downscaled((3, 5), (3, 5), 1), is_downscaled((8, 10), (3, 5), 2)
    (True, True, False)
    """
    return tuple(side // divisor for side in before) == tuple(after)


def resample_nearest(maps: np.ndarray, height: int, width: int) -> np.ndarray:
    """Resize maps [levels, H, W] by nearest-neighbor interpolation."""
    return maps[:, _nearest(height, maps.shape[1])][:, :, _nearest(width, maps.shape[2])]


def _nearest(size: int, source_size: int) -> np.ndarray:
    """Return the source pixel that contains the center of each of `size` pixels, along one axis."""
    return (2 * np.arange(size) + 1) * source_size // (2 * size)


def _compact(values: np.ndarray, labeled: np.ndarray) -> Int32[Tensor, "h w"]:
    """Renumber the values of labeled pixels to 0..R-1 in ascending order, and set other pixels to -1."""
    labels = np.full(values.shape, -1, dtype=np.int32)
    labels[labeled] = np.unique(values[labeled], return_inverse=True)[1]
    return torch.from_numpy(labels)


def stack_masks(masks: Bool[Tensor, "m h w"]) -> Int32[Tensor, "depth h w"]:
    """Convert masks to a stack of label maps.

    At each pixel, the first map has the index of the last mask that covers it, and each further map the index of the
    previous one. Remaining entries are -1. The depth of the stack is the largest number of masks that share a pixel, at
    least 1.
    """
    flat = masks.flatten(1)
    depth = max(1, int(flat.sum(dim=0).max()))
    labels = torch.full((depth, flat.shape[1]), -1, dtype=torch.int32, device=masks.device)
    for columns in column_chunks(flat):
        part = flat[:, columns].flip(0)
        pixel, flipped = part.T.nonzero(as_tuple=True)  # by pixel, with the last mask of each pixel first
        count = part.sum(dim=0)
        layer = torch.arange(len(pixel), device=masks.device) - (count.cumsum(0) - count)[pixel]
        labels[layer, columns.start + pixel] = (len(masks) - 1 - flipped).int()
    return labels.reshape(depth, *masks.shape[1:])


def column_chunks(flat: Bool[Tensor, "m p"]) -> Iterator[slice]:
    """Yield slices of columns that are small enough for a temporary array of M rows."""
    step = min(2**24, max(1, _MASK_CHUNK[flat.device.type] // max(1, len(flat))))
    return (slice(start, start + step) for start in range(0, flat.shape[1], step))
