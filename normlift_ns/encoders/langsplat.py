"""Reading and writing of the files of LangSplat's preprocessing, including the variants that other programs produce.

Every image has two files. `<stem>_f.npy` holds one CLIP vector per mask, [T, D], from four consecutive lists of masks:
all SAM masks, subparts, parts and wholes. `<stem>_s.npy`, [4, H, W], holds for each list the row of that table that a
pixel belongs to, -1 for none. The reader also accepts:

* `_s` files of any float or integer type, with one channel or four;
* ids past the end of the table, NaN or negative ids, and table rows that are zero or not finite. These pixels have no
  region; the reader warns, except for negative ids.
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
from normlift_ns.options import MissingFeatures
from normlift_ns.segmentation.regions import resample_nearest

LANGSPLAT_LEVELS = ("default", "s", "m", "l")
"""Channels of `_s`."""
_MAX_EXACT_HALF = 2048
"""Half precision cannot represent all integers above this one."""
_MIN_LENGTH = 1e-30
"""Shorter vectors count as zero, because their components have lost their precision."""
_MIN_DIMENSION = 16
"""LangSplat's autoencoder outputs 3 numbers; no CLIP model has so few."""


def open_segment_map(path: Path) -> np.ndarray:
    """Open a segment map, [C, H, W], memory-mapped; values are not checked.

    Raises:
        FileNotFoundError, ValueError: If the file does not exist, is damaged, or has another type or shape.
    """
    segments = read_npy(path, "segment map")
    segments = segments[None] if segments.ndim == 2 else segments
    shape_fits = segments.ndim == 3 and len(segments) in (1, len(LANGSPLAT_LEVELS)) and segments.size > 0
    if segments.dtype.kind not in "fiu" or not shape_fits:
        raise InputError(
            f"segment map {path} holds {segments.dtype} {segments.shape}, expected numbers [4, H, W], [1, H, W] or "
            "[H, W]"
        )
    return segments


def read_segment_map(path: Path, rows: int) -> Int32[np.ndarray, "c h w"]:
    """Read the table row of every pixel in every channel; -1: none.

    Args:
        rows: Number of rows of the table.
    Raises:
        ValueError: If ids are not integers, or may have been rounded by half precision. Also for the same reasons as
            `open_segment_map`.
    """
    segments = open_segment_map(path)
    values = segments.astype(np.float64)
    finite = np.isfinite(values)
    values[~finite] = -1
    fractional = np.argwhere(values != np.round(values))
    if len(fractional) > 0:
        channel, y, x = fractional[0].tolist()
        raise InputError(
            f"segment map {path}: channel {channel}, row {y}, column {x} holds {values[channel, y, x]:g}, which is "
            "not an id; the map was interpolated: make it again with nearest-neighbor interpolation"
        )
    if segments.dtype.kind == "f" and segments.dtype.itemsize == 2 and bool((values >= _MAX_EXACT_HALF).any()):
        raise InputError(
            f"segment map {path} holds float16 with ids of {_MAX_EXACT_HALF} or more, which float16 rounds; save it as "
            "float32"
        )
    past = values >= rows
    for invalid, problem in ((~finite, "that are not finite"), (past, f"past the {rows} rows of its table")):
        if invalid.any():
            channels = shorten_list(np.flatnonzero(invalid.any(axis=(1, 2))).tolist())
            ids = shorten_list([f"{value:g}" for value in np.unique(segments[invalid])])
            warnings.warn(
                f"segment map {path}: channels {channels} hold ids {problem} ({ids}), in {int(invalid.sum())} pixels; "
                "these count as unlabeled",
                stacklevel=2,
            )
    return np.where(past | (values < 0), -1, values).astype(np.int32)


def open_feature_table(path: Path) -> np.ndarray:
    """Open a feature table, [T, D], memory-mapped; values are not checked. Raises as `open_segment_map`."""
    table = read_npy(path, "feature table")
    if table.dtype.kind != "f" or table.ndim != 2 or table.shape[1] < _MIN_DIMENSION:
        raise InputError(
            f"feature table {path} holds {table.dtype} {table.shape}, expected floats [T, D], one CLIP vector per mask "
            "(the autoencoder's codes in language_features_dim3 cannot be compared with text: give language_features)"
        )
    return table


def read_feature_table(path: Path) -> tuple[Float32[Tensor, "t d"], Bool[Tensor, " t"]]:
    """Read the unit rows of a feature table, and which rows are valid; raises like `open_segment_map`.

    Rows of unit length are kept bit for bit.
    """
    table = torch.from_numpy(np.array(open_feature_table(path), dtype=np.float64))
    length = torch.linalg.vector_norm(table, dim=1)
    valid = length.isfinite() & (length > _MIN_LENGTH)
    unit = torch.where(((length - 1).abs() < UNIT_TOLERANCE / 2)[:, None], table, table / length[:, None])
    return torch.where(valid[:, None], unit, 0.0).float(), valid


def write_npy(path: Path, array: np.ndarray, overwrite: bool) -> None:
    """Write an NPY file atomically; an existing file with the same content is left alone.

    Raises:
        FileExistsError: If the file exists with other content, and `overwrite` is False.
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
                f"{path} exists with other content; export to another folder, or give --overwrite True"
            )
    with atomic_file(path, overwrite=overwrite) as draft:
        draft.write_bytes(content)


def shorten_list(values: Sequence[object]) -> str:
    """Return the first ten values as text, for messages."""
    return ", ".join(map(str, values[:10])) + (", ..." if len(values) > 10 else "")


# Features of LangSplat's preprocessing as a source, and export of the features of any source in the same format.
#
# The module docstring lists the accepted variants of the files. Images may also lack features, or be larger than their
# maps, because LangSplat shrinks large images; maps are then resized by nearest neighbor. The folder may be the
# dataset with its language_features/, or language_features/ with another such folder inside, as in one published
# archive.


LangSplatLevel = Literal["default", "s", "m", "l", "sum"]
_NESTED = "language_features"
_CROP_TOLERANCE = 0.02
"""Sizes that differ by a smaller fraction indicate another crop, that of an undistorted image, rather than another
resolution."""
_MIN_SUM = 1e-6
"""Sums of unit vectors shorter than this have no direction."""


class _Files(NamedTuple):
    segments: Path
    features: Path


@dataclass(frozen=True)
class LangSplat:
    """A `FeatureSource` of preprocessed images.

    Raises:
        FileNotFoundError: If the folder does not exist, or contains no features.
    """

    root: Path
    """The folder with `*_s.npy` and `*_f.npy`, or one above it."""
    texts: TextEncoder
    """The text encoder of the model that made the features."""
    level: LangSplatLevel = "l"
    """The channel that counts. sum: the sum of the vectors of all channels at every pixel, as in Splat Feature
    Solver."""
    missing: MissingFeatures = "error"
    """Handling of images without features: raise an error, or skip them with a warning."""
    resample: bool = False
    """Accept maps of any size, not only those of the same image at another resolution."""

    def __post_init__(self) -> None:
        _ = self.folder

    @cached_property
    def folder(self) -> Path:
        """The folder that contains the files."""
        folders = [self.root, self.root / _NESTED, self.root / _NESTED / _NESTED]
        for folder in folders:
            if os.path.isdir(folder) and next(folder.glob("*_s.npy"), None) is not None:
                return folder
        raise FileNotFoundError(
            f"{self.root} contains no LangSplat features (--features-dir): there is no *_s.npy in it, in {folders[1]} "
            f"or in {folders[2]}"
        )

    @property
    def identity(self) -> dict[str, Any]:
        return {"kind": "langsplat", "level": self.level, "texts": self.texts.identity}

    def available(self, names: Sequence[str]) -> list[str]:
        """Return the given images that have features; see `FeatureSource.available`.

        Raises:
            FileNotFoundError: If images have no features; with `missing` "skip", only if none has any. The message
                lists them.
            ValueError: If a file is damaged or has another shape, tables have rows of different lengths, or two images
                share their files.
        """
        files_of: dict[str, _Files] = {}
        for name in names:
            with suppress(FileNotFoundError):
                files_of[name] = self._files(name)
        absent = [name for name in names if name not in files_of]
        if len(absent) > 0:
            problem = f"{len(absent)} of {len(names)} images have no features in {self.folder}: {', '.join(absent)}"
            if self.missing == "error" or len(files_of) == 0:
                raise FileNotFoundError(
                    f"{problem}. Expected <name>_s.npy and <name>_f.npy; preprocess them, or skip these images: "
                    "--features-missing skip"
                )
            warnings.warn(f"{problem}; they are skipped", stacklevel=2)
        maps = ((name, files.segments) for name, files in files_of.items())
        check_files_distinct(maps, "features", "by naming the images such that they differ before the first dot")
        dimensions: dict[int, Path] = {}
        for files in files_of.values():
            dimensions.setdefault(open_feature_table(files.features).shape[1], files.features)
            open_segment_map(files.segments)
        if len(dimensions) > 1:
            (a, first), (b, second) = list(dimensions.items())[:2]
            raise InputError(
                f"the rows of {first} have {a} numbers, those of {second} have {b}; all must come from one encoder"
            )
        return list(files_of)

    def view(self, image: UInt8[Tensor, "h w 3"], name: str) -> ViewFeatures:
        """Return the regions and features of an image; raises like `available`, and ValueError if ids are not
        integers."""
        files = self._files(name)
        table, valid = read_feature_table(files.features)
        valid = torch.cat([valid, valid.new_zeros(1)])  # row -1
        maps = read_segment_map(files.segments, len(table))
        cells, rows = joint_partition(torch.from_numpy(self._fit(maps, image, files.segments)))
        invalid = rows[(rows >= 0) & ~valid[rows.long()]].unique().tolist()
        if len(invalid) > 0:
            warnings.warn(
                f"{files.features}: rows {shorten_list(invalid)} of the table are zero or not finite; their pixels "
                "count as unlabeled",
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
        """Return the files of an image. LangSplat cuts names at the first dot, other programs at the last one."""
        file = PurePosixPath(name)
        for stem in (file.stem, file.name.split(".")[0]):
            files = _Files(self.folder / f"{stem}_s.npy", self.folder / f"{stem}_f.npy")
            if stem != "" and all(map(os.path.isfile, files)):
                return files
        raise FileNotFoundError(f"image {name} has no features in {self.folder}; expected <name>_s.npy and _f.npy")

    def _fit(self, maps: np.ndarray, image: Tensor, path: Path) -> np.ndarray:
        """Return maps of the size of the image; raise InputError if they may show another crop."""
        height, width = image.shape[:2]
        if maps.shape[1:] == (height, width):
            return maps
        if not self.resample and not is_same_image(maps.shape[2], maps.shape[1], width, height):
            raise InputError(
                f"{path} is {maps.shape[2]}x{maps.shape[1]} (width x height), its image is {width}x{height}: another "
                "aspect ratio or almost the same size, which indicates another crop or orientation. Preprocess the "
                "images that the run was trained with (nerfstudio undistorts and crops them), or stretch the maps: "
                "--regions-resample True"
            )
        return resample_nearest(maps, height, width)

    def size(self, name: str) -> tuple[Path, int, int]:
        """Return the path, width and height of the segment map of an image; raises like `view`."""
        files = self._files(name)
        _, height, width = open_segment_map(files.segments).shape
        return files.segments, width, height


def is_same_image(map_width: int, map_height: int, width: int, height: int) -> bool:
    """Return whether a map can show the same image at another resolution. The two sizes must differ by one factor,
    except for rounding of the smaller one to whole pixels.

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
    """Return cells with the normalized sum of their rows as features."""
    zero = table.new_zeros(1, table.shape[1])  # row -1
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
    remedy = "by renaming the images such that they differ before the first dot, or lift without the export"
    check_files_distinct(files, "exported file", remedy)


def _stem(name: str) -> str:
    """Return the stem of the LangSplat files of an image."""
    return PurePosixPath(name).name.split(".")[0]


def write_langsplat(
    source: FeatureSource, image: UInt8[Tensor, "h w 3"], name: str, folder: Path, overwrite: bool
) -> None:
    """Write the regions and features of an image as `<stem>_s.npy` and `<stem>_f.npy`.

    Regions with LangSplat's four levels fill its four channels; other regions fill all four with the selected level.

    Args:
        overwrite: Replace files of other content.
    Raises:
        ValueError: If the source selects several levels.
        FileExistsError: If a file with other content exists, and `overwrite` is False.
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
