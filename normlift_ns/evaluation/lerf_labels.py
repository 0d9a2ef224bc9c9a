"""Labels of LERF-OVS: one JSON file per annotated frame, with polygons of named objects."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
import torch
from jaxtyping import Bool
from torch import Tensor

from normlift_ns.errors import InputError


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
    files = sorted(folder.glob("*.json"))
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
        document = json.loads(file.read_text("utf8"))
        info, objects = document["info"], document["objects"]
        labelled = int(info["width"]), int(info["height"])
        shapes = [(str(o["category"]), _points(o["segmentation"]), o.get("bbox")) for o in objects]
    except (json.JSONDecodeError, UnicodeDecodeError, KeyError, TypeError, ValueError) as error:
        raise InputError(
            f"{file} is no label file of LERF-OVS ({type(error).__name__}: {error}); expected "
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
        cv2.fillPoly(mask, [np.int32(scaled)], 1)  # pyright: ignore[reportCallIssue, reportArgumentType]
        low, high = (scaled.min(0), scaled.max(0)) if box is None else np.array(box, float).reshape(2, 2) * scale
        boxes.setdefault(category, []).append((low[0], low[1], high[0], high[1]))
    return LabeledFrame(file.stem, {name: torch.from_numpy(m).bool() for name, m in masks.items()}, boxes)


def _points(segmentation: Any) -> np.ndarray:
    points = np.array(segmentation, dtype=float)
    if points.ndim != 2 or points.shape[1] != 2 or len(points) < 3 or not np.isfinite(points).all():
        raise InputError(f"a segmentation has shape {points.shape}, expected at least three points [x, y]")
    return points


def match_views(files: list[Path], names: Mapping[str, Any]) -> tuple[list[Path], list[str]]:
    """Label files whose stem is that of an image, and the stems of those without one.

    Raises:
        ValueError: none has an image.
    """
    found = [file for file in files if file.stem in names]
    if len(found) == 0:
        some = ", ".join(sorted(names)[:3])
        raise InputError(
            f"none of the {len(files)} label files in {files[0].parent} has an image in the run; the first is "
            f"{files[0].name}, the run has {some}, …"
        )
    return found, [file.stem for file in files if file.stem not in names]
