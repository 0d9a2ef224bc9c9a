"""Validation of a trained run's dataset, before nerfstudio reads it.

If images of the right size are missing, nerfstudio asks on the terminal and creates them through a shell; it trusts all
numbers in the files. These checks raise errors with advice instead.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path

from normlift_ns.errors import InputError
from normlift_ns.scenes.colmap import read_model
from normlift_ns.scenes.image_files import read_head
from normlift_ns.scenes.nerfstudio.data_classes import (
    BlenderDataParserConfig,
    ColmapDataParserConfig,
    DataParser,
    NerfstudioDataParserConfig,
)
from normlift_ns.scenes.transforms_file import Entries, read_entries

MAX_AUTO_RESOLUTION = 1600
_ADVICE = "Restore it, or give the path of the dataset with --data."
_REQUIRED = ("fl_x", "fl_y", "cx", "cy", "w", "h")


def check_dataset(parser: DataParser) -> None:
    """Raise if nerfstudio would ask about a dataset, could not read it, or would misread it.

    Raises:
        FileNotFoundError: if a camera file or an image folder is missing.
        ValueError: if a camera file is damaged or holds invalid numbers.
    """
    if isinstance(parser, NerfstudioDataParserConfig):
        _check_nerfstudio(parser)
    elif isinstance(parser, ColmapDataParserConfig):
        _check_colmap(parser)
    else:
        _check_blender(parser)


def size_of(file: Path, parser: DataParser) -> tuple[int, int]:
    """Return the width and height of an image.

    Raises:
        FileNotFoundError: if the file is missing.
        ValueError: if the file is not an image.
    """
    if not file.exists():
        raise FileNotFoundError(f"{file} is missing from the dataset {parser.data}. {_ADVICE}")
    return read_head(file).size


def automatic_factor(file: Path, parser: ColmapDataParserConfig) -> int:
    """Return the factor by which nerfstudio downscales images if the config does not name one."""
    longest, factor = max(size_of(file, parser)), 1
    while longest / factor > MAX_AUTO_RESOLUTION:
        factor *= 2
    return factor


def _entries(path: Path, data: Path) -> Entries:
    if not path.exists():
        raise FileNotFoundError(f"{path} is missing from the dataset {data}. {_ADVICE}")
    return read_entries(path)


def _check_nerfstudio(parser: NerfstudioDataParserConfig) -> None:
    path = parser.data if parser.data.suffix == ".json" else parser.data / "transforms.json"
    entries = _entries(path, parser.data)
    for name in _REQUIRED:
        incomplete = [frame.file_path for frame in entries.frames if getattr(frame, name) is None]
        if getattr(entries, name) is None and incomplete:
            raise InputError(
                f"{path} has no {name} for {incomplete[0]}. Expected focal lengths, principal point and size for every "
                "frame."
            )
    _check_positions([frame.transform_matrix for frame in entries.frames], parser, path)
    _check_files([path.parent / frame.file_path for frame in entries.frames], path)


def _check_blender(parser: BlenderDataParserConfig) -> None:
    for split in ("train", "test"):
        path = parser.data / f"transforms_{split}.json"
        entries = _entries(path, parser.data)
        if entries.camera_angle_x is None or not 0 < entries.camera_angle_x < math.pi:
            raise InputError(
                f"{path}: camera_angle_x is {entries.camera_angle_x}, expected radians between 0 and pi. {_ADVICE}"
            )
        files = [parser.data / (frame.file_path.replace("./", "") + ".png") for frame in entries.frames]
        _check_files(files, path)
        size_of(files[0], parser)  # nerfstudio reads all of this image


def _check_colmap(parser: ColmapDataParserConfig) -> None:
    """Check the dataset, and the folder of downscaled images, which nerfstudio would offer to create."""
    model, images = parser.data / parser.colmap_path, parser.data / parser.images_path
    if not model.is_dir():
        raise FileNotFoundError(
            f"{model}, the COLMAP reconstruction, is missing from the dataset {parser.data}. {_ADVICE}"
        )
    _, registered = read_model(model, text_first=True)
    registered.sort(key=lambda image: image.image_id)
    files = [images / image.name for image in registered]
    _check_files(files, model)
    factor = parser.downscale_factor
    if factor is None:
        factor = automatic_factor(files[0], parser)
    if factor == 1:
        return
    smaller = images.parent / f"{images.name}_{factor}"
    missing = sorted(
        {file.parent for file in (smaller / image.name for image in registered) if not file.parent.is_dir()}
    )
    if missing:
        raise FileNotFoundError(
            f"There is no folder {missing[0]} of images at 1/{factor} of their size, with which the run was trained. "
            f"Copy it from the machine of the training, or create it by resizing the images in {images}. normlift_ns "
            "does not write into datasets."
        )


def _check_positions(poses: Sequence[list[list[float]]], parser: NerfstudioDataParserConfig, path: Path) -> None:
    positions = {tuple(row[3] for row in pose[:3]) for pose in poses}
    if len(positions) == 1 and parser.auto_scale_poses and parser.center_method == "poses":
        raise InputError(
            f"{path}: all {len(poses)} cameras have the same position, so nerfstudio cannot scale them. Expected the "
            "cameras that the run was trained with; give the path of the dataset with --data."
        )


def _check_files(files: Sequence[Path], path: Path) -> None:
    """Raise if an existing path is not a regular file; reading a pipe would block forever."""
    invalid = next((file for file in files if file.exists() and not file.is_file()), None)
    if invalid is not None:
        raise InputError(f"{path} lists {invalid}, which is not a regular file. Expected images.")
