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
    """What a label file holds."""

    info: _Info
    objects: list[_Object]


class LabeledFrame(NamedTuple):
    """One annotated frame."""

    stem: str
    """Of the image that it annotates."""
    masks: dict[str, Bool[Tensor, "h w"]]
    """By category; several objects of a category are one mask."""
    boxes: dict[str, list[tuple[float, float, float, float]]]
    """(x1, y1, x2, y2) of every object of a category, in pixels."""


def read_frames(folder: Path) -> list[Path]:
    """The JSON files of a folder such as lerf_ovs/label/figurines, by name.

    Raises:
        FileNotFoundError: no such folder, or none in it.
    """
    files = sorted(folder.glob("*.json")) if os.path.isdir(folder) else []
    if len(files) == 0:
        raise FileNotFoundError(
            f"{folder} holds no label files; give the folder with frame_00041.json and the like, lerf_ovs/label/SCENE"
        )
    return files


def read_frame(file: Path, width: int, height: int) -> LabeledFrame:
    """Reads one file and fills its polygons at the size of the image, to which they are scaled.

    Raises:
        ValueError: a file of another form, or of an image with another aspect ratio; the message names it.
    """
    try:
        found = read_document(file, _File)
        labelled = found.info.width, found.info.height
        shapes = [(o.category, _points(o.segmentation, *labelled), _box(o.bbox, *labelled)) for o in found.objects]
    except ValueError as error:
        raise InputError(
            f"{file} is no label file of LERF-OVS ({error}); expected "
            '{"info": {"width", "height"}, "objects": [{"category", "segmentation": [[x, y], ...], "bbox"}]}'
        ) from error
    if abs(labelled[0] * height - labelled[1] * width) > 0.01 * labelled[0] * height:
        raise InputError(
            f"{file} labels an image of {labelled[0]} x {labelled[1]} pixels, the run's is {width} x {height}; use the "
            "images that the labels were drawn on"
        )
    scale = np.array([width / labelled[0], height / labelled[1]])
    masks: dict[str, np.ndarray] = {}
    boxes: dict[str, list[tuple[float, float, float, float]]] = {}
    for category, points, box in shapes:
        mask = masks.setdefault(category, np.zeros((height, width), np.uint8))
        scaled = points * scale
        drawn = np.zeros_like(mask)
        cv2.fillPoly(drawn, [np.int32(scaled)], 1)  # pyright: ignore[reportCallIssue, reportArgumentType]
        if not drawn.any():
            raise InputError(
                f"{file}: a segmentation of {category!r} lies wholly outside of its image of {labelled[0]} x "
                f"{labelled[1]} pixels; correct or remove it"
            )
        mask |= drawn
        low, high = (scaled.min(0), scaled.max(0)) if box is None else box * scale
        boxes.setdefault(category, []).append((low[0], low[1], high[0], high[1]))
    return LabeledFrame(file.stem, {name: torch.from_numpy(m).bool() for name, m in masks.items()}, boxes)


def _points(segmentation: Sequence[_Point], width: int, height: int) -> np.ndarray:
    """Polygons may be drawn a little past the border, but not a whole image past it."""
    points = np.array(segmentation, dtype=float)
    if np.abs(points / (width, height) - 0.5).max() > 1.5:
        raise InputError(f"a segmentation of an image of {width} x {height} pixels has {np.abs(points).max():g} in it")
    return points


def _box(box: tuple[float, float, float, float] | None, width: int, height: int) -> np.ndarray | None:
    return None if box is None else _points([box[:2], box[2:]], width, height)


def match_views(files: Sequence[Path], names: Sequence[str]) -> tuple[dict[Path, str], list[str]]:
    """The image of every label file, which has the same stem, and the stems of the files without one.

    Raises:
        ValueError: none has an image, or one has several.
    """
    images: dict[str, list[str]] = {}
    for name in names:
        images.setdefault(PurePosixPath(name).stem, []).append(name)
    found = {file: images[file.stem] for file in files if file.stem in images}
    if len(found) == 0:
        some = ", ".join(sorted(images)[:3])
        raise InputError(
            f"none of the {len(files)} label files in {files[0].parent} has an image in the run; the first is "
            f"{files[0].name}, the run has {some}, …"
        )
    for file, candidates in found.items():
        if len(candidates) > 1:
            raise InputError(
                f"{file} labels one image, but {' and '.join(candidates)} of the run are both called {file.stem}; "
                "rename the images so that one of them is"
            )
    return {file: candidates[0] for file, candidates in found.items()}, [f.stem for f in files if f not in found]
