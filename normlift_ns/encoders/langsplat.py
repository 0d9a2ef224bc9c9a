"""Reader and writer of LangSplat's preprocessed features, including the variants that other programs write.

Each image has two files. The feature table `<stem>_f.npy`, [T, D], holds one CLIP vector per mask. Its rows are four
consecutive lists of masks: all SAM masks, subparts, parts and wholes. The segment map `<stem>_s.npy`, [4, H, W], holds
the table row of each pixel in each list, or -1 for none. The reader also accepts:

* segment maps of any float or integer type, with one channel or four;
* ids that are negative, not finite or past the end of the table, and table rows that are zero or not finite. Pixels
  with such ids or rows are unlabeled. The reader warns about them, except for negative ids.
"""

from __future__ import annotations

import io
import os
import warnings
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path, PurePosixPath
from typing import Any, Literal, NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float32, Int32, UInt8
from torch import Tensor
from torch.nn.functional import normalize

from normlift_ns.encoders.base import (
    FeatureSource,
    RegionFeatures,
    ViewFeatures,
    joint_partition,
)
from normlift_ns.encoders.text_files import UNIT_TOLERANCE, TextEncoder
from normlift_ns.errors import InputError
from normlift_ns.io.arrays import read_npy
from normlift_ns.io.atomic import atomic_file
from normlift_ns.io.guard import check_files_distinct, read_file
from normlift_ns.options import MissingFeatures, option_setting
from normlift_ns.segmentation.regions import resample_nearest

LANGSPLAT_LEVELS = ("default", "s", "m", "l")
"""Names of the channels of a segment map, in order."""
_MAX_EXACT_HALF = 2048
"""Largest integer up to which half precision represents all integers exactly."""
_MIN_LENGTH = 1e-30
"""Length below which a vector counts as zero, because its components have lost precision."""
_MIN_DIMENSION = 16
"""Smallest accepted vector length. CLIP vectors are longer; the codes of LangSplat's autoencoder have length 3."""


def open_segment_map(path: Path) -> np.ndarray:
    """Open a segment map, [C, H, W], as a memory map without checking its values.

    Raises:
        FileNotFoundError, ValueError: If the file does not exist, is damaged, or has the wrong type or shape.
    """
    segments = read_npy(path, "segment map")
    segments = segments[None] if segments.ndim == 2 else segments
    shape_fits = segments.ndim == 3 and len(segments) in (1, len(LANGSPLAT_LEVELS)) and segments.size > 0
    if segments.dtype.kind not in "fiu" or not shape_fits:
        raise InputError(
            f"segment map {path} is {segments.dtype} {segments.shape}, expected a non-empty array of numbers, "
            "[4, H, W], [1, H, W] or [H, W]; preprocess the image again"
        )
    return segments


def read_segment_map(path: Path, rows: int) -> Int32[np.ndarray, "c h w"]:
    """Read the table row of each pixel in each channel, or -1 for none.

    Args:
        rows: Number of rows of the table.
    Raises:
        ValueError: If ids are not integers, or may have been rounded by half precision.
        FileNotFoundError, ValueError: For the same reasons as `open_segment_map`.
    """
    segments = open_segment_map(path)
    values = segments.astype(np.float64)
    finite = np.isfinite(values)
    values[~finite] = -1
    fractional = np.argwhere(values != np.round(values))
    if len(fractional) > 0:
        channel, y, x = fractional[0].tolist()
        raise InputError(
            f"segment map {path}: channel {channel}, row {y}, column {x} has the value {values[channel, y, x]:g}, "
            "which is not an integer, so the map was probably interpolated; make it again with nearest-neighbor "
            "interpolation"
        )
    if segments.dtype.kind == "f" and segments.dtype.itemsize == 2 and bool((values >= _MAX_EXACT_HALF).any()):
        raise InputError(
            f"segment map {path} is float16 and has ids of {_MAX_EXACT_HALF} or more, which float16 may have rounded; "
            "preprocess the image again, and save the ids as float32"
        )
    past = values >= rows
    for invalid, problem in ((~finite, "that are not finite"), (past, "past the end of its table")):
        if invalid.any():
            channels = shorten_list(np.flatnonzero(invalid.any(axis=(1, 2))).tolist())
            ids = shorten_list([f"{value:g}" for value in np.unique(segments[invalid])])
            warnings.warn(
                f"segment map {path} has ids {problem} (ids: {ids}; channels: {channels}; pixels: "
                f"{int(invalid.sum())}); these pixels are treated as unlabeled",
                stacklevel=2,
            )
    return np.where(past | (values < 0), -1, values).astype(np.int32)


def open_feature_table(path: Path) -> np.ndarray:
    """Open a feature table, [T, D], as a memory map without checking its values.

    Raises:
        FileNotFoundError, ValueError: For the same reasons as `open_segment_map`.
    """
    table = read_npy(path, "feature table")
    if table.dtype.kind != "f" or table.ndim != 2 or table.shape[1] < _MIN_DIMENSION:
        raise InputError(
            f"feature table {path} is {table.dtype} {table.shape}, expected floats [masks, D] with D >= "
            f"{_MIN_DIMENSION}, one CLIP vector per mask. If these are autoencoder codes (language_features_dim3), "
            "give the folder language_features instead"
        )
    return table


def read_feature_table(path: Path) -> tuple[Float32[Tensor, "t d"], Bool[Tensor, " t"]]:
    """Read a feature table as unit vectors, with a mask of valid rows; invalid rows are zero.

    Rows that already have unit length are not scaled again. Raises the same errors as `open_feature_table`.
    """
    table = torch.from_numpy(np.array(open_feature_table(path), dtype=np.float64))
    length = torch.linalg.vector_norm(table, dim=1)
    valid = length.isfinite() & (length > _MIN_LENGTH)
    unit = torch.where(((length - 1).abs() < UNIT_TOLERANCE / 2)[:, None], table, table / length[:, None])
    return torch.where(valid[:, None], unit, 0.0).float(), valid


def write_npy(path: Path, array: np.ndarray, overwrite: bool) -> None:
    """Write an NPY file atomically, unless a file with the same content exists.

    Raises:
        FileExistsError: If the file exists with different content, and `overwrite` is False.
    """
    buffer = io.BytesIO()
    np.save(buffer, array)
    content = buffer.getvalue()
    if os.path.lexists(path):
        if (
            os.path.isfile(path)
            and os.path.getsize(path) == len(content)
            and read_file(path, max_bytes=2**40) == content
        ):
            return
        if not overwrite:
            raise FileExistsError(
                f"{path} exists with different content; export to another folder, or give "
                f"{option_setting('overwrite', True)}"
            )
    with atomic_file(path, overwrite=overwrite) as draft:
        draft.write_bytes(content)


def shorten_list(values: Sequence[object]) -> str:
    """Format the first ten values for a message."""
    return ", ".join(map(str, values[:10])) + (", ..." if len(values) > 10 else "")


# Source of LangSplat's preprocessed features, and export of the features of any source in the same format.
#
# The module docstring lists the accepted variants of the files. Images can also be larger than their maps, because
# LangSplat shrinks large images. The maps are then resized by nearest-neighbor interpolation. The folder can be
# language_features/ itself, or the dataset that contains it. language_features/ can also contain another folder of that
# name, as in one published archive.


LangSplatLevel = Literal["default", "s", "m", "l", "sum"]
_NESTED = "language_features"
_CROP_TOLERANCE = 0.02
"""Relative difference between the sides of a map and of its image below which the map counts as another crop.

Undistortion causes such crops. Larger differences indicate another resolution.
"""
_RENAME = "by renaming the images so that their file names differ before the first dot"
_MIN_SUM = 1e-6
"""Length below which a sum of unit vectors has no direction."""


class _Files(NamedTuple):
    segments: Path
    features: Path


@dataclass(frozen=True)
class LangSplat:
    """A `FeatureSource` that reads LangSplat's preprocessed features.

    Raises:
        FileNotFoundError: If the folder does not exist, or contains no features.
    """

    root: Path
    """Folder with `*_s.npy` and `*_f.npy`, or a parent folder."""
    texts: TextEncoder
    """Text encoder of the model that computed the features."""
    level: LangSplatLevel = "l"
    """Channel to use, or "sum" for the normalized sum of the vectors of all channels at each pixel, as in Splat Feature
    Solver. A map with one channel is used as it is."""
    missing: MissingFeatures = "error"
    """Handling of images without features: "error" raises an error, "skip" skips them with a warning."""
    resample: bool = False
    """True to accept maps of any size, even if they may show another crop of the image."""

    def __post_init__(self) -> None:
        _ = self.folder

    @cached_property
    def folder(self) -> Path:
        """Folder that contains the files of the images: `root`, or a folder inside it.

        Raises:
            FileNotFoundError: For the same reasons as the class.
        """
        folders = [self.root, self.root / _NESTED, self.root / _NESTED / _NESTED]
        for folder in folders:
            if os.path.isdir(folder) and next(folder.glob("*_s.npy"), None) is not None:
                return folder
        raise FileNotFoundError(
            f"{self.root} contains no LangSplat features; expected *_s.npy files in it, in {folders[1]} or in "
            f"{folders[2]}. Give their folder with --features-dir"
        )

    @property
    def identity(self) -> dict[str, Any]:
        return {"kind": "langsplat", "level": self.level, "texts": self.texts.identity}

    def available(self, names: Sequence[str]) -> list[str]:
        """Return the given images that have features; see `FeatureSource.available`.

        Raises:
            FileNotFoundError: If an image has no features, or, with `missing="skip"`, if no image has features.
            ValueError: If a file is damaged or has the wrong shape, tables have rows of different lengths, or two
                images share their files.
        """
        files_of: dict[str, _Files] = {}
        for name in names:
            with suppress(FileNotFoundError):
                files_of[name] = self._files(name)
        absent = [name for name in names if name not in files_of]
        if len(absent) > 0:
            problem = f"no features in {self.folder} for {len(absent)} of {len(names)} images: {shorten_list(absent)}"
            if self.missing == "error" or len(files_of) == 0:
                remedy = "give another folder with --features-dir"
                remedy = "skip them with --features-missing skip" if len(files_of) > 0 else remedy
                raise FileNotFoundError(
                    f"{problem}. Expected <name>_s.npy and <name>_f.npy for each; preprocess these images, or {remedy}"
                )
            warnings.warn(f"{problem}; the lift skips these images", stacklevel=2)
        maps = ((name, files.segments) for name, files in files_of.items())
        check_files_distinct(maps, "segment map", _RENAME)
        dimensions: dict[int, Path] = {}
        for files in files_of.values():
            dimensions.setdefault(open_feature_table(files.features).shape[1], files.features)
            open_segment_map(files.segments)
        if len(dimensions) > 1:
            (a, first), (b, second) = list(dimensions.items())[:2]
            raise InputError(
                f"the rows of {first} have {a} numbers, but those of {second} have {b}; preprocess all images with the "
                "same encoder"
            )
        return list(files_of)

    def view(self, image: UInt8[Tensor, "h w 3"], name: str) -> ViewFeatures:
        """Return the regions and features of an image.

        Raises:
            FileNotFoundError, ValueError: For the same reasons as `available` and `read_segment_map`.
            ValueError: If the segment map may show another crop of the image, and `resample` is False.
        """
        files = self._files(name)
        table, valid = read_feature_table(files.features)
        valid = torch.cat([valid, valid.new_zeros(1)])  # for the row -1
        maps = read_segment_map(files.segments, len(table))
        cells, rows = joint_partition(torch.from_numpy(self._fit(maps, image, files.segments)))
        invalid = rows[(rows >= 0) & ~valid[rows.long()]].unique().tolist()
        if len(invalid) > 0:
            warnings.warn(
                f"{files.features} has rows that are zero or not finite: {shorten_list(invalid)}; their pixels are "
                "treated as unlabeled",
                stacklevel=2,
            )
            rows = torch.where(valid[rows.long()], rows, -1)
        if self.level == "sum":
            return _sum_levels(cells, rows, table)
        rows = rows[0 if len(rows) == 1 else LANGSPLAT_LEVELS.index(self.level)]
        used, regions = rows.unique(return_inverse=True)
        absent = int((used == -1).sum())
        return ViewFeatures(cells, table[used[absent:].long()], (regions - absent).int()[None])

    def text(self, prompts: Sequence[str]) -> Float32[Tensor, "q d"]:
        return self.texts.text(prompts)

    def _files(self, name: str) -> _Files:
        """Return the files of an image, or raise FileNotFoundError if it has none.

        LangSplat cuts image names at the first dot, and other programs at the last.
        """
        file = PurePosixPath(name)
        for stem in (file.stem, file.name.split(".")[0]):
            files = _Files(self.folder / f"{stem}_s.npy", self.folder / f"{stem}_f.npy")
            if stem != "" and all(map(os.path.isfile, files)):
                return files
        raise FileNotFoundError(
            f"image {name} has no features in {self.folder}; expected <name>_s.npy and <name>_f.npy. Preprocess the "
            "image, or skip it with --features-missing skip"
        )

    def _fit(self, maps: np.ndarray, image: Tensor, path: Path) -> np.ndarray:
        """Resize maps to the image; raise InputError if they may show another crop and `resample` is False."""
        height, width = image.shape[:2]
        if maps.shape[1:] == (height, width):
            return maps
        if not self.resample and not is_same_image(maps.shape[2], maps.shape[1], width, height):
            raise InputError(
                f"{path} is {maps.shape[2]}x{maps.shape[1]} (width x height), but its image is {width}x{height}. These "
                "sizes indicate another crop or orientation. Preprocess the undistorted images, or stretch the maps "
                "with --regions-resample True"
            )
        return resample_nearest(maps, height, width)

    def size(self, name: str) -> tuple[Path, int, int]:
        """Return the path, width and height of the segment map of an image. Raises the same errors as `view`."""
        files = self._files(name)
        _, height, width = open_segment_map(files.segments).shape
        return files.segments, width, height


def is_same_image(map_width: int, map_height: int, width: int, height: int) -> bool:
    """Return True if a map can show the same crop as an image, at the same or a different resolution.

    The sizes must have the same aspect ratio, except for rounding of the smaller size to whole pixels. Sizes
    within 2 % of each other must be equal, because a small difference is probably a crop.

    >>> sizes = [(606, 1080, 1079, 1921), (1080, 1920, 1079, 1919), (606, 1090, 1079, 1921)]
    >>> tuple(is_same_image(*size) for size in sizes)
    (True, False, False)
    """
    x_scale, y_scale = width / map_width, height / map_height
    if abs(x_scale - 1) < _CROP_TOLERANCE and abs(y_scale - 1) < _CROP_TOLERANCE:
        return (map_width, map_height) == (width, height)
    if x_scale > 1:
        x_scale, y_scale = 1 / x_scale, 1 / y_scale
    return abs(x_scale - y_scale) <= 1 / max(width, map_width) + 1 / max(height, map_height)


def _sum_levels(cells: Tensor, rows: Tensor, table: Tensor) -> ViewFeatures:
    """Return the features of a view. The feature of a cell is the normalized sum of its table rows."""
    zero = table.new_zeros(1, table.shape[1])  # for the row -1
    sums = torch.cat([table, zero])[rows.long()].double().sum(dim=0)
    valid = torch.linalg.vector_norm(sums, dim=1) > _MIN_SUM
    regions = torch.where(valid, valid.cumsum(0) - 1, -1)
    return ViewFeatures(cells, normalize(sums[valid], dim=1).float(), regions.int()[None])


def check_unique_stems(names: Sequence[str]) -> None:
    """Check that the exported files of different images have different names.

    Raises:
        ValueError: If the files of two images would have the same name.
    """
    files = ((name, Path(f"{_stem(name)}_s.npy")) for name in names)
    check_files_distinct(files, "exported file", f"{_RENAME}, or lift without the export")


def _stem(name: str) -> str:
    """Return the stem of the LangSplat files of an image."""
    return PurePosixPath(name).name.split(".")[0]


class FeatureExport(NamedTuple):
    """Export of 2D features to LangSplat files, in addition to the lift."""

    folder: Path
    overwrite: bool
    """True to replace existing files whose content differs."""

    def write(self, source: FeatureSource, image: UInt8[Tensor, "h w 3"], name: str) -> None:
        """Write the files of an image; see `write_langsplat`."""
        write_langsplat(source, image, name, self.folder, self.overwrite)


def write_langsplat(
    source: FeatureSource, image: UInt8[Tensor, "h w 3"], name: str, folder: Path, overwrite: bool
) -> None:
    """Write the regions and features of an image as `<stem>_s.npy` and `<stem>_f.npy`.

    Regions with four levels fill LangSplat's four channels. For other sources, the selected level fills all four.

    Args:
        overwrite: True to replace existing files that have different content.
    Raises:
        ValueError: If several levels are selected, and the source does not have four levels.
        FileExistsError: If a file with different content exists, and `overwrite` is False.
    """
    levels: list[tuple[Tensor, Tensor]] = []
    if isinstance(source, RegionFeatures):
        maps = source.regions.labels(image, name).cpu()
        if len(maps) == len(LANGSPLAT_LEVELS):
            levels = [(labels[0], source.encoder.encode(image, labels)) for labels in maps]
    if len(levels) == 0:
        view = source.view(image, name)
        if len(view.region_of_cell) != 1:
            raise InputError("several selected levels cannot be written in LangSplat's format; choose one with --level")
        none = torch.tensor([-1], dtype=torch.int32)
        levels = [(torch.cat([view.region_of_cell[0], none])[view.labels.long()], view.features)]
    offsets = torch.tensor([0, *(len(rows) for _, rows in levels)]).cumsum(0).tolist()
    segments = torch.stack(
        [torch.where(labels >= 0, labels + start, -1) for (labels, _), start in zip(levels, offsets)]
    )
    for suffix, array in (
        ("s", segments.float().expand(len(LANGSPLAT_LEVELS), -1, -1)),
        ("f", torch.cat([rows for _, rows in levels])),
    ):
        write_npy(folder / f"{_stem(name)}_{suffix}.npy", array.contiguous().numpy(), overwrite)
