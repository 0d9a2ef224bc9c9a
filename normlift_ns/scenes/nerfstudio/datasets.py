"""Data sets of trained runs, checked before nerfstudio reads them.

nerfstudio asks on the terminal where photographs of the right size are missing, and makes them through a shell; it
trusts whatever numbers stand in the files. What is looked at here is refused instead, with what to do.
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
_ADVICE = "Restore it, or say where the dataset is with --data."
_NEEDED = ("fl_x", "fl_y", "cx", "cy", "w", "h")


def check_dataset(parser: DataParser) -> None:
    """Refuses what nerfstudio would ask about, could not read, or would read into something else.

    Raises:
        FileNotFoundError: a file of cameras or a folder of photographs is missing.
        ValueError: a file of cameras that is damaged or holds numbers that no camera has.
    """
    if isinstance(parser, NerfstudioDataParserConfig):
        _check_nerfstudio(parser)
    elif isinstance(parser, ColmapDataParserConfig):
        _check_colmap(parser)
    else:
        _check_blender(parser)


def size_of(file: Path, parser: DataParser) -> tuple[int, int]:
    """Width and height of a photograph.

    Raises:
        FileNotFoundError, ValueError: none there, or no image.
    """
    if not file.exists():
        raise FileNotFoundError(f"{file} is missing from the dataset {parser.data}. {_ADVICE}")
    return read_head(file).size


def automatic_factor(file: Path, parser: ColmapDataParserConfig) -> int:
    """By which factor nerfstudio takes smaller photographs, where the config does not say it."""
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
    found = _entries(path, parser.data)
    for name in _NEEDED:
        bare = [frame.file_path for frame in found.frames if getattr(frame, name) is None]
        if getattr(found, name) is None and bare:
            raise InputError(
                f"{path} has no {name} for {bare[0]}. Expected a focal length, centre and size for every frame."
            )
    _check_places([frame.transform_matrix for frame in found.frames], parser, path)
    _check_files([path.parent / frame.file_path for frame in found.frames], path)


def _check_blender(parser: BlenderDataParserConfig) -> None:
    for split in ("train", "test"):
        path = parser.data / f"transforms_{split}.json"
        found = _entries(path, parser.data)
        if found.camera_angle_x is None or not 0 < found.camera_angle_x < math.pi:
            raise InputError(
                f"{path}: camera_angle_x is {found.camera_angle_x}, expected radians between 0 and pi. {_ADVICE}"
            )
        files = [parser.data / (frame.file_path.replace("./", "") + ".png") for frame in found.frames]
        _check_files(files, path)
        size_of(files[0], parser)  # which nerfstudio reads whole


def _check_colmap(parser: ColmapDataParserConfig) -> None:
    """Also the folder of smaller photographs, for which nerfstudio would ask whether to make it."""
    model, images = parser.data / parser.colmap_path, parser.data / parser.images_path
    if not model.is_dir():
        raise FileNotFoundError(
            f"{model}, COLMAP's reconstruction, is missing from the dataset {parser.data}. {_ADVICE}"
        )
    _, registered = read_model(model, text_first=True)
    registered.sort(key=lambda image: image.number)
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
            f"There is no folder {missing[0]} of photographs at 1/{factor} of their size, with which the run was "
            f"trained. Copy it from where it was trained; or make it by resizing the photographs in {images}. "
            "normlift_ns writes nothing into data sets."
        )


def _check_places(poses: Sequence[list[list[float]]], parser: NerfstudioDataParserConfig, path: Path) -> None:
    places = {tuple(row[3] for row in pose[:3]) for pose in poses}
    if len(places) == 1 and parser.auto_scale_poses and parser.center_method == "poses":
        raise InputError(
            f"{path}: all {len(poses)} cameras stand at one place, so nerfstudio cannot scale them. Expected the "
            "cameras that the run was trained with; say where the dataset is with --data."
        )


def _check_files(files: Sequence[Path], path: Path) -> None:
    """What is there must be files: a pipe would make the program wait for ever."""
    strange = next((file for file in files if file.exists() and not file.is_file()), None)
    if strange is not None:
        raise InputError(f"{path} names {strange}, which is no file. Expected photographs.")
