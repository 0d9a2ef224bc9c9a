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
from jaxtyping import Bool, Float32, Int32, Int64, UInt8
from PIL import Image
from torch import Tensor

from normlift_ns.errors import InputError
from normlift_ns.io.arrays import read_npy
from normlift_ns.io.guard import open_regular

_IMAGE_FORMATS = ("PNG", "JPEG", "MPO", "WEBP", "TIFF", "BMP", "PPM")
"""Formats of training images. Pillow passes some other formats to external programs, such as PostScript to
Ghostscript."""
_MASK_CHUNK = {"cuda": 2**29, "cpu": 2**26}
"""Approximate maximum number of elements in a temporary array of masks, by device type."""
_MAX_PIXELS = 2**27
"""Maximum number of pixels of an image, 16,384 x 8,192. A small file can decode to a huge image of equal pixels."""


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
            f"{what} {path} cannot be read as an image ({error}); replace it with a valid {formats[0]} file"
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
WORKERS = min(8, os.cpu_count() or 1)
"""Number of images to segment concurrently, at most 8 because superpixels need many times the memory of their image."""


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
    """Superpixels of similar size that follow image edges, from k-means of CIELAB color and position."""

    count: int = 256
    """Approximate number of superpixels per image, at least 1. An image has at most one per pixel."""
    device: str = "cpu"

    at_once = WORKERS

    @property
    def identity(self) -> dict[str, Any]:
        return {"kind": "superpixel", "version": 2, "count": self.count}

    def labels(self, image: UInt8[Tensor, "h w 3"], name: str) -> Int32[Tensor, "1 1 h w"]:
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
    """Label maps from a folder, one per image.

    A PNG file is grayscale with 1, 8 or 16 bits, or indexed, with palette indices as labels. An NPY file has an integer
    or Boolean type, and can contain several levels, [levels, H, W]. The map of "images/left/0001.jpg" is the first of
    images/left/0001.png, left/0001.png and 0001.png that exists in the folder. NPY files have the same names with the
    suffix .npy. All pixels with the same value form one region, even if they are not connected.

    Raises:
        FileNotFoundError: If `folder` does not exist or is not a folder.
    """

    folder: Path
    background: int = 0
    """Value of unlabeled pixels. Negative values are always unlabeled, so with -1, the value 0 is a region."""
    level: int | None = None
    """Index of the selected level in NPY files [levels, H, W], or None for files [H, W]."""
    resample: bool = False
    """True to resize maps of any size (nearest neighbor), False to accept only sizes that match `divisor`."""
    divisor: int = 1
    """Factor by which images were downscaled (`lift_downscale`). Maps of full-size images are downscaled to match."""
    undistort: Callable[[str, np.ndarray], np.ndarray] | None = None
    """Function of an image name and its maps [levels, H, W] that undistorts maps of original, distorted images.

    If None, the maps already match the undistorted images."""
    description: str = "label map"
    """Description of a file in messages."""
    flag: str = "--regions-dir"
    """Option that sets the folder, for messages."""

    at_once = WORKERS

    def __post_init__(self) -> None:
        if not os.path.isdir(self.folder):
            problem = "is not a folder" if os.path.lexists(self.folder) else "does not exist"
            raise FileNotFoundError(
                f"{self.flag} {self.folder} {problem}; give a folder of {self.description}s, with one PNG or NPY file "
                "per image"
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
            FileNotFoundError, ValueError: For the same reasons as `values`.
            ValueError: If a map and its image differ in size, unless `resample` is True or `divisor` explains
                the difference.
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
        """Read the label maps of an image as integers, [levels, H, W].

        Raises:
            FileNotFoundError, ValueError: For the same reasons as `path`.
            ValueError: If the file cannot be read, has several channels, or has values that are not integers.
            ValueError: If a PNG file is grayscale with 2 or 4 bits, which readers scale.
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
                f"{what} has {maps.shape[2]} channels, expected one value per pixel; save "
                "it as an 8-bit or 16-bit grayscale PNG, as an indexed PNG, or as NPY"
            )
        if maps.dtype.kind not in "iub":
            raise InputError(f"{what} has type {maps.dtype}, expected integers; save it with .astype(numpy.int32)")
        if maps.ndim not in (2, 3) or maps.size == 0:
            raise InputError(f"{what} has shape {maps.shape}, expected [H, W] or [levels, H, W] without empty axes")
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

    At each pixel, the maps contain the indices of the masks that cover it, in descending order, followed by -1. The
    depth of the stack is the largest number of masks that share a pixel, at least 1.
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
    """Yield slices of the columns of masks, each with at most 2^24 columns and about `_MASK_CHUNK` elements."""
    step = min(2**24, max(1, _MASK_CHUNK[flat.device.type] // max(1, len(flat))))
    return (slice(start, start + step) for start in range(0, flat.shape[1], step))


# Superpixels: k-means of CIELAB color and position in the windows of a grid, on a CPU or a GPU.
#
# The clustering is that of SLIC (Achanta et al., SLIC Superpixels Compared to State-of-the-Art Superpixel Methods,
# 2012), arranged as products of matrices. The image is divided into cells of equal size, one per superpixel. Each cell
# has a center, which starts as the mean of its pixels. A pixel joins the nearest center of its own cell and of the
# eight cells around it. For each cell, the distances of its pixels to nine centers are one product of matrices, and the
# sums of the pixels that joined each center are another one. Sums thus always have the same order, without atomic
# additions. Every second pixel of every second row moves the centers.
#
# Last, small connected pieces become part of the neighbor with which they share the longest boundary.


COMPACTNESS = 10.0
"""Weight of spatial distance relative to color distance. Larger values produce squarer superpixels."""
_ROUNDS = 5
_SMALLEST = 0.25
"""Number of pixels below which a piece joins a neighbor, as a fraction of the mean number per superpixel."""
_FAR = 1e4
"""Coordinates that prevent pixels from joining a center."""
_AROUND = tuple((y, x) for y in (-1, 0, 1) for x in (-1, 0, 1))
_WHITE = (0.95047, 1.0, 1.08883)
"""XYZ of white for the illuminant D65."""
_XYZ = ((0.412453, 0.357580, 0.180423), (0.212671, 0.715160, 0.072169), (0.019334, 0.119193, 0.950227))
"""XYZ of the sRGB primaries for the illuminant D65, one column each."""
_LAB = ((0.0, 116.0, 0.0), (500.0, -500.0, 0.0), (0.0, 200.0, -200.0))


def superpixels(image: UInt8[Tensor, "h w 3"], count: int) -> Int32[np.ndarray, "h w"]:
    """Divide an image into connected regions of similar size and color.

    The regions of an image are reproducible on the same device. On another device, rounding can change them.

    Args:
        image: RGB image with values in 0..255, on the device that computes the regions.
        count: Approximate number of regions, at least 1. An image has at most one per pixel.
    Returns:
        Region of each pixel, 0..R-1, without gaps.
    """
    height, width = image.shape[:2]
    grid = _Grid.of(height, width, count)
    cells = grid.cells(image)
    sample = cells[..., ::2, ::2].flatten(2)
    sums = sample.sum(dim=2).view(grid.rows, grid.columns, 6)
    for _ in range(_ROUNDS):
        sums = grid.sums(sample, grid.nearest(sample, sums))
    nearest = grid.nearest(cells.flatten(2), sums)
    number = torch.arange(len(cells), device=image.device).view(grid.rows, grid.columns, 1)
    joined = _windows(number, 0)[..., 0].gather(1, nearest).view(grid.rows, grid.columns, grid.height, grid.width)
    labels = joined.transpose(1, 2).flatten(2).flatten(0, 1)[:height, :width]
    return _join_fragments(labels.int().cpu().numpy(), _SMALLEST * grid.side**2)


@dataclass(frozen=True)
class _Grid:
    """A grid of cells over an image. The last row and column can extend beyond the image."""

    rows: int
    columns: int
    height: int
    """Height of a cell in pixels."""
    width: int
    side: float
    """Side in pixels of a square with the mean area of a superpixel, used as the unit of positions."""

    @classmethod
    def of(cls, height: int, width: int, count: int) -> _Grid:
        side = max(1.0, math.sqrt(height * width / count))
        rows, columns = max(1, round(height / side)), max(1, round(width / side))
        return cls(rows, columns, math.ceil(height / rows), math.ceil(width / columns), side)

    def cells(self, image: UInt8[Tensor, "h w 3"]) -> Float32[Tensor, "cells 6 y x"]:
        """Return six values per pixel: CIELAB / COMPACTNESS, the position relative to the middle of the cell, and 1.

        All six are 0 outside the image.
        """
        rows, columns = torch.arange(image.shape[0]), torch.arange(image.shape[1])
        points = torch.zeros(6, self.rows * self.height, self.columns * self.width, device=image.device)
        inside = points[:, : len(rows), : len(columns)]
        inside[:3] = _cielab(image) / COMPACTNESS
        inside[3] = (((rows % self.height) - (self.height - 1) / 2) / self.side)[:, None]
        inside[4] = ((columns % self.width) - (self.width - 1) / 2) / self.side
        inside[5] = 1
        cells = points.view(6, self.rows, self.height, self.columns, self.width)
        return cells.permute(1, 3, 0, 2, 4).flatten(0, 1).contiguous()

    def shifts(self, like: Tensor) -> Float32[Tensor, "9 6"]:
        """Return the positions of the nine cells of a window relative to the middle one."""
        size = (self.height / self.side, self.width / self.side)
        return like.new_tensor([(0, 0, 0, y * size[0], x * size[1], 0) for y, x in _AROUND])

    def nearest(
        self, points: Float32[Tensor, "cells 6 p"], sums: Float32[Tensor, "rows columns 6"]
    ) -> Int64[Tensor, "cells p"]:
        """Return the nearest center of each point, as its index 0..8 in the window around the cell of the point."""
        centers = torch.where(sums[..., 5:] > 0, sums / sums[..., 5:].clamp(min=1), _FAR)
        around = (_windows(centers, _FAR) + self.shifts(points))[..., :5]
        lengths = around.square().sum(dim=2, keepdim=True)
        return torch.bmm(torch.cat([2 * around, -lengths], dim=2), points).max(dim=1).indices  # argmax is slower

    def sums(
        self, points: Float32[Tensor, "cells 6 p"], nearest: Int64[Tensor, "cells p"]
    ) -> Float32[Tensor, "rows columns 6"]:
        """Return the sum of the points that joined each center, with positions relative to the cell of this center."""
        joined = (nearest[:, None] == torch.arange(9, device=nearest.device)[:, None]).float()
        parts = torch.bmm(joined, points.transpose(1, 2))
        parts = (parts - self.shifts(points) * parts[..., 5:]).view(self.rows, self.columns, 9, 6)
        sums = parts.new_zeros(self.rows + 2, self.columns + 2, 6)
        for part, (y, x) in zip(parts.unbind(dim=2), _AROUND):
            sums[1 + y : 1 + y + self.rows, 1 + x : 1 + x + self.columns] += part
        return sums[1:-1, 1:-1]


def _windows(values: Tensor, outside: float) -> Tensor:
    """Return the values [rows, columns, C] of each cell and its eight neighbors as [cells, 9, C]."""
    rows, columns = values.shape[:2]
    padded = torch.nn.functional.pad(values, (0, 0, 1, 1, 1, 1), value=outside)
    return torch.stack([padded[1 + y :, 1 + x :][:rows, :columns] for y, x in _AROUND], dim=2).flatten(0, 1)


def _cielab(image: UInt8[Tensor, "h w 3"]) -> Float32[Tensor, "3 h w"]:
    """Convert sRGB to CIELAB with the illuminant D65."""
    level = torch.arange(256, dtype=torch.float64) / 255
    linear = torch.where(level > 0.04045, ((level + 0.055) / 1.055) ** 2.4, level / 12.92).float().to(image.device)
    primaries = (torch.tensor(_XYZ).T / torch.tensor(_WHITE)).T.to(image.device)
    xyz = primaries @ linear[image.permute(2, 0, 1).flatten(1).int()]
    root = torch.where(xyz > 0.008856, xyz.clamp(min=0.008856).pow_(1 / 3), 7.787 * xyz + 16 / 116)
    lab = torch.tensor(_LAB, device=image.device) @ root
    lab[0] -= 16
    return lab.view(3, *image.shape[:2])


def _join_fragments(labels: Int32[np.ndarray, "h w"], smallest: float) -> Int32[np.ndarray, "h w"]:
    """Number the connected pieces of a label map, after merging small pieces into neighbors.

    Args:
        labels: Any labels. Separate pieces with the same label become separate regions.
        smallest: Number of pixels below which a piece is small. A small piece joins the region of a neighbor that is
            not small or has already joined a region. If several neighbors qualify, it joins the one with which it
            shares the longest boundary.
    """
    pieces, count = _connected_pieces(labels)
    size = np.bincount(pieces.ravel())
    region = np.where(size >= min(smallest, size.max()), np.arange(count), -1)
    first, second = _boundaries(pieces, region[pieces] < 0)
    pair, length = np.unique(first.astype(np.int64) * count + second, return_counts=True)
    piece, neighbor = np.divmod(pair, count)
    order = np.lexsort((-length, piece))
    piece, neighbor = piece[order], neighbor[order]
    while len(piece) > 0:
        ready = region[neighbor] >= 0
        joining, longest = np.unique(piece[ready], return_index=True)
        region[joining] = region[neighbor[ready][longest]]
        waiting = region[piece] < 0
        piece, neighbor = piece[waiting], neighbor[waiting]
    return np.unique(region, return_inverse=True)[1].astype(np.int32)[pieces]


def _connected_pieces(labels: Int32[np.ndarray, "h w"]) -> tuple[Int32[np.ndarray, "h w"], int]:
    """Return the 4-connected piece of equal labels that contains each pixel, and the number of pieces."""
    import cv2  # noqa: PLC0415 (other regions do not need it)

    height, width = labels.shape
    links = np.zeros((2 * height - 1, 2 * width - 1), dtype=np.uint8)  # pixels at even places, links between them
    links[::2, ::2] = 1
    links[::2, 1::2] = labels[:, 1:] == labels[:, :-1]
    links[1::2, ::2] = labels[1:] == labels[:-1]
    count, pieces = cv2.connectedComponents(links, connectivity=4, ltype=cv2.CV_32S)
    return pieces[::2, ::2] - 1, count - 1


def _boundaries(
    pieces: Int32[np.ndarray, "h w"], small: Bool[np.ndarray, "h w"]
) -> tuple[Int32[np.ndarray, " n"], Int32[np.ndarray, " n"]]:
    """Return pairs of adjacent pieces, one for each pixel of a small piece and each neighbor of it in another piece."""
    found = []
    for one, other, at in (
        (pieces[:, 1:], pieces[:, :-1], small[:, 1:]),
        (pieces[:, :-1], pieces[:, 1:], small[:, :-1]),
        (pieces[1:], pieces[:-1], small[1:]),
        (pieces[:-1], pieces[1:], small[:-1]),
    ):
        boundary = at & (one != other)
        found.append((one[boundary], other[boundary]))
    first, second = (np.concatenate(part) for part in zip(*found))
    return first, second
