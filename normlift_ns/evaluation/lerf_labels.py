"""Labels of LERF-OVS: one JSON file per annotated frame, with polygons of named objects."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path, PurePosixPath
from typing import Annotated, NamedTuple

import cv2
import msgspec
import numpy as np
import torch
from jaxtyping import Bool
from torch import Tensor

from normlift_ns.errors import InputError
from normlift_ns.evaluation.documents import Name, read_document

_Point = tuple[float, float]


class _Info(msgspec.Struct):
    width: Annotated[int, msgspec.Meta(ge=1, le=2**15)]
    height: Annotated[int, msgspec.Meta(ge=1, le=2**15)]


class _Object(msgspec.Struct):
    category: Name
    segmentation: Annotated[list[_Point], msgspec.Meta(min_length=3)]
    bbox: tuple[float, float, float, float] | None = None


class _File(msgspec.Struct):
    """Content of a label file."""

    info: _Info
    objects: list[_Object]


class LabeledFrame(NamedTuple):
    """Masks and boxes of an annotated frame."""

    stem: str
    """File stem of the annotated image."""
    masks: dict[str, Bool[Tensor, "h w"]]
    """Mask of each category, the union of its objects."""
    boxes: dict[str, list[tuple[float, float, float, float]]]
    """(x1, y1, x2, y2) of every object of a category, in pixels."""


def read_frames(folder: Path) -> list[Path]:
    """Return the JSON files of a folder such as lerf_ovs/label/figurines, sorted by name.

    Raises:
        FileNotFoundError: the folder does not exist or has no JSON files.
    """
    files = sorted(folder.glob("*.json")) if os.path.isdir(folder) else []
    if len(files) == 0:
        raise FileNotFoundError(
            f"{folder} has no label files; give the folder with files such as frame_00041.json, lerf_ovs/label/SCENE"
        )
    return files


def read_frame(file: Path, width: int, height: int) -> LabeledFrame:
    """Read a label file and fill its polygons, scaled to the size of the image.

    Raises:
        ValueError: the file has another format, or is for an image with another aspect ratio. The message names the
            file.
    """
    try:
        document = read_document(file, _File)
        size = document.info.width, document.info.height
        shapes = [(o.category, _points(o.segmentation, *size), _box(o.bbox, *size)) for o in document.objects]
    except ValueError as error:
        raise InputError(
            f"{file} is not a LERF-OVS label file ({error}); expected "
            '{"info": {"width", "height"}, "objects": [{"category", "segmentation": [[x, y], ...], "bbox"}]}'
        ) from error
    if abs(size[0] * height - size[1] * width) > 0.01 * size[0] * height:
        raise InputError(
            f"{file} labels an image of {size[0]} x {size[1]} pixels, but that of the run has {width} x {height}; use "
            "the images that the labels were drawn on"
        )
    scale = np.array([width / size[0], height / size[1]])
    masks: dict[str, np.ndarray] = {}
    boxes: dict[str, list[tuple[float, float, float, float]]] = {}
    for category, points, box in shapes:
        mask = masks.setdefault(category, np.zeros((height, width), np.uint8))
        scaled = points * scale
        drawn = np.zeros_like(mask)
        cv2.fillPoly(drawn, [np.int32(scaled)], 1)  # pyright: ignore[reportCallIssue, reportArgumentType]
        if not drawn.any():
            raise InputError(
                f"{file}: a segmentation of {category!r} lies completely outside its image of {size[0]} x {size[1]} "
                "pixels; correct or remove it"
            )
        mask |= drawn
        low, high = (scaled.min(0), scaled.max(0)) if box is None else box * scale
        boxes.setdefault(category, []).append((low[0], low[1], high[0], high[1]))
    return LabeledFrame(file.stem, {name: torch.from_numpy(m).bool() for name, m in masks.items()}, boxes)


def _points(segmentation: Sequence[_Point], width: int, height: int) -> np.ndarray:
    """Return the points of a polygon, which may lie slightly outside the image, but not by its whole size."""
    points = np.array(segmentation, dtype=float)
    if np.abs(points / (width, height) - 0.5).max() > 1.5:
        raise InputError(
            f"a segmentation of an image of {width} x {height} pixels has the coordinate {np.abs(points).max():g}"
        )
    return points


def _box(box: tuple[float, float, float, float] | None, width: int, height: int) -> np.ndarray | None:
    return None if box is None else _points([box[:2], box[2:]], width, height)


def match_views(files: Sequence[Path], names: Sequence[str]) -> tuple[dict[Path, str], list[str]]:
    """Match label files with images by their stems.

    Returns:
        The image of every label file that has one, and the stems of the files without one.
    Raises:
        ValueError: no file has an image, or a file has several.
    """
    images: dict[str, list[str]] = {}
    for name in names:
        images.setdefault(PurePosixPath(name).stem, []).append(name)
    matches = {file: images[file.stem] for file in files if file.stem in images}
    if len(matches) == 0:
        stems = ", ".join(sorted(images)[:3])
        raise InputError(
            f"none of the {len(files)} label files in {files[0].parent} has an image in the run; the first file is "
            f"{files[0].name}, but the run has {stems}, …"
        )
    for file, candidates in matches.items():
        if len(candidates) > 1:
            raise InputError(
                f"{file} labels one image, but {' and '.join(candidates)} of the run are all called {file.stem}; "
                "rename all but one of them"
            )
    return {file: candidates[0] for file, candidates in matches.items()}, [f.stem for f in files if f not in matches]
