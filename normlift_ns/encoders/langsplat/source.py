"""Features that LangSplat's preprocessing wrote as a source, and any source's features as such files.

What other programs do to the files is in module files; besides, images may have another size than their masks, as
LangSplat shrinks large ones (nearest neighbour), may lack features, and the folder may be the dataset with its
language_features/, or that folder in itself, as one archive has it.
"""

from __future__ import annotations

import os
import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path, PurePosixPath
from typing import Any, Literal, NamedTuple, get_args

import numpy as np
import torch
from jaxtyping import Float32, UInt8
from torch import Tensor
from torch.nn.functional import normalize

from normlift_ns.encoders.langsplat.files import (
    LEVELS,
    listed,
    open_segments,
    open_table,
    read_segments,
    read_table,
    write_npy,
)
from normlift_ns.encoders.regions import resample_nearest
from normlift_ns.encoders.source import (
    FeatureSource,
    RegionFeatures,
    TextEncoder,
    ViewFeatures,
    joint_partition,
    refuse_shared,
)
from normlift_ns.errors import InputError
from normlift_ns.options import Missing

Level = Literal["default", "s", "m", "l", "sum"]
_NESTED = "language_features"
_ALMOST = 0.02
"""Sizes that differ by less than this share are no other resolution but another crop: that of an undistorted image."""
_CANCELLED = 1e-6
"""Sums of unit vectors shorter than this have no direction."""


class _Files(NamedTuple):
    segments: Path
    features: Path


@dataclass(frozen=True)
class LangSplat:
    """A `FeatureSource` of preprocessed images.

    Raises:
        ValueError: an unknown level or `missing`.
        FileNotFoundError: no such folder, or no features in it.
    """

    root: Path
    """The folder with `*_s.npy` and `*_f.npy`, or one above it."""
    texts: TextEncoder
    """The text encoder of the model that made the features."""
    level: Level = "l"
    """Which channel counts. sum: the vectors of all channels added up in every pixel, as Splat Feature Solver does."""
    missing: Missing = "error"
    """What to do about images without features: refuse, or leave them out with a warning."""
    resample: bool = False
    """Take maps of any other size than the image's, not only the same picture in another resolution."""

    def __post_init__(self) -> None:
        for flag, value, known in (("--level", self.level, Level), ("--features-missing", self.missing, Missing)):
            if value not in get_args(known):
                raise InputError(f"{flag} of features langsplat is one of {', '.join(get_args(known))}; got {value!r}")
        _ = self.folder

    @cached_property
    def folder(self) -> Path:
        """Where the files are."""
        places = [self.root, self.root / _NESTED, self.root / _NESTED / _NESTED]
        for place in places:
            if os.path.isdir(place) and next(place.glob("*_s.npy"), None) is not None:
                return place
        raise FileNotFoundError(
            f"{self.root} holds no features of LangSplat (--features-dir): no *_s.npy in it, nor in {places[1]} or "
            f"{places[2]}"
        )

    @property
    def identity(self) -> dict[str, Any]:
        return {"kind": "langsplat", "level": self.level, "texts": self.texts.identity}

    def available(self, names: Sequence[str]) -> list[str]:
        """As in `FeatureSource`.

        Raises:
            FileNotFoundError: images without features, listed; with `missing` "skip" only if it is all of them.
            ValueError: a file that is damaged or of another shape, tables of different lengths of rows, or two images
                that share their files.
        """
        found = {name: files for name in names if (files := self._files(name)) is not None}
        absent = [name for name in names if name not in found]
        if len(absent) > 0:
            what = f"{len(absent)} of {len(names)} images have no features in {self.folder}: {', '.join(absent)}"
            if self.missing == "error" or len(found) == 0:
                raise FileNotFoundError(
                    f"{what}. Expected <name>_s.npy and <name>_f.npy; preprocess them, or leave these images out: "
                    "--features-missing skip"
                )
            warnings.warn(f"{what}; they are left out", stacklevel=2)
        maps = ((name, files.segments) for name, files in found.items())
        refuse_shared(maps, "features", "and name the images so that they differ before the first dot")
        dimensions: dict[int, Path] = {}
        for files in found.values():
            dimensions.setdefault(open_table(files.features).shape[1], files.features)
            open_segments(files.segments)
        if len(dimensions) > 1:
            (a, first), (b, second) = list(dimensions.items())[:2]
            raise InputError(
                f"the rows of {first} have {a} numbers, those of {second} {b}; all must come from one encoder"
            )
        return list(found)

    def view(self, image: UInt8[Tensor, "h w 3"], name: str) -> ViewFeatures:
        """As in `FeatureSource`; raises as `available`, and ValueError for ids that are no integers."""
        files = self._found(name)
        table, good = read_table(files.features)
        good = torch.cat([good, good.new_zeros(1)])  # row -1
        maps = read_segments(files.segments, len(table))
        cells, rows = joint_partition(torch.from_numpy(self._fitted(maps, image, files.segments)))
        lost = rows[(rows >= 0) & ~good[rows.long()]].unique().tolist()
        if len(lost) > 0:
            warnings.warn(
                f"{files.features}: rows {listed(lost)} of the table are zero or not finite; their pixels count as "
                "unlabelled",
                stacklevel=2,
            )
            rows = torch.where(good[rows.long()], rows, -1)
        if self.level == "sum":
            return _summed(cells, rows, table)
        rows = rows[0 if len(rows) == 1 else LEVELS.index(self.level)]
        used, regions = rows.unique(return_inverse=True)
        absent = int((used == -1).sum())
        return ViewFeatures(cells, table[used[absent:].long()], (regions - absent).int()[None])

    def text(self, prompts: Sequence[str]) -> Float32[Tensor, "q d"]:
        return self.texts.text(prompts)

    def _files(self, name: str) -> _Files | None:
        """LangSplat cuts names at the first dot, other programs at the last one."""
        file = PurePosixPath(name)
        for stem in (file.stem, file.name.split(".")[0]):
            files = _Files(self.folder / f"{stem}_s.npy", self.folder / f"{stem}_f.npy")
            if stem != "" and all(map(os.path.isfile, files)):
                return files
        return None

    def _found(self, name: str) -> _Files:
        files = self._files(name)
        if files is None:
            raise FileNotFoundError(f"image {name} has no features in {self.folder}; expected <name>_s.npy and _f.npy")
        return files

    def _fitted(self, maps: np.ndarray, image: Tensor, path: Path) -> np.ndarray:
        height, width = image.shape[:2]
        if maps.shape[1:] == (height, width):
            return maps
        if not self.resample and not same_picture(maps.shape[2], maps.shape[1], width, height):
            raise InputError(
                f"{path} is {maps.shape[2]}x{maps.shape[1]} (width x height), its image {width}x{height}: another "
                "aspect ratio, or almost the same size, so another crop or orientation; preprocess the images that the "
                "run was trained with (nerfstudio undistorts them, which crops them), or stretch the maps: "
                "--regions-resample True"
            )
        return resample_nearest(maps, height, width)

    def size(self, name: str) -> tuple[Path, int, int]:
        """The map of an image, its width and its height; raises as `view`."""
        files = self._found(name)
        _, height, width = open_segments(files.segments).shape
        return files.segments, width, height


def same_picture(map_width: int, map_height: int, width: int, height: int) -> bool:
    """Whether a map may be of the same picture in another resolution: the sizes have one factor between them, but for
    the rounding of the smaller one to whole pixels.

    >>> same_picture(606, 1080, 1079, 1921), same_picture(1080, 1920, 1079, 1919), same_picture(606, 1090, 1079, 1921)
    (True, False, False)
    """
    across, down = width / map_width, height / map_height
    if abs(across - 1) < _ALMOST and abs(down - 1) < _ALMOST:
        return (map_width, map_height) == (width, height)
    if across > 1:
        across, down = 1 / across, 1 / down
    return abs(across - down) <= 1 / max(width, map_width) + 1 / max(height, map_height)


def _summed(cells: Tensor, rows: Tensor, table: Tensor) -> ViewFeatures:
    """Cells with the normalised sum of their rows."""
    nothing = table.new_zeros(1, table.shape[1])  # row -1
    sums = torch.cat([table, nothing])[rows.long()].double().sum(dim=0)
    kept = torch.linalg.vector_norm(sums, dim=1) > _CANCELLED
    regions = torch.where(kept, kept.cumsum(0) - 1, -1)
    return ViewFeatures(cells, normalize(sums[kept], dim=1).float(), regions.int()[None])


def refuse_equal_stems(names: Sequence[str]) -> None:
    """Makes sure that files written for some images would not replace each other.

    Raises:
        ValueError: two images whose files would have the same name.
    """
    owner: dict[str, str] = {}
    for name in names:
        other = owner.setdefault(_stem(name), name)
        if other != name:
            raise InputError(
                f"images {other} and {name} would both be exported as {_stem(name)}_s.npy, as LangSplat names its "
                "files; name the images so that they differ before the first dot, or lift without the export"
            )


def _stem(name: str) -> str:
    """What LangSplat calls the files of an image."""
    return PurePosixPath(name).name.split(".")[0]


def write_langsplat(
    source: FeatureSource, image: UInt8[Tensor, "h w 3"], name: str, folder: Path, overwrite: bool
) -> None:
    """Writes the semantics of an image as `<stem>_s.npy` and `<stem>_f.npy`.

    Regions with LangSplat's four levels give its four channels; anything else the level that counts, four times.

    Args:
        overwrite: replace files of other content.
    Raises:
        ValueError: a source that counts several levels at once.
        FileExistsError: a file of other content is there.
    """
    levels: list[tuple[Tensor, Tensor]] = []
    if isinstance(source, RegionFeatures):
        maps = source.regions.labels(image, name).cpu()
        if len(maps) == len(LEVELS):
            levels = [(labels[0], source.encoder.encode(image, labels)) for labels in maps]
    if len(levels) == 0:
        view = source.view(image, name)
        if len(view.region_of_cell) != 1:
            raise InputError("regions of several levels at once cannot be written in LangSplat's format; choose one")
        nothing = torch.tensor([-1], dtype=torch.int32)
        levels = [(torch.cat([view.region_of_cell[0], nothing])[view.labels.long()], view.features)]
    first = torch.tensor([0, *(len(rows) for _, rows in levels)]).cumsum(0).tolist()
    segments = torch.stack([torch.where(labels >= 0, labels + start, -1) for (labels, _), start in zip(levels, first)])
    stem = _stem(name)
    for suffix, array in (
        ("s", segments.float().expand(len(LEVELS), -1, -1)),
        ("f", torch.cat([rows for _, rows in levels])),
    ):
        write_npy(folder / f"{stem}_{suffix}.npy", array.contiguous().numpy(), overwrite)
