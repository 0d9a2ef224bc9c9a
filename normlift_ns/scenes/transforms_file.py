"""transforms.json as it stands in its file: schema, and numbers that a camera can have."""

from __future__ import annotations

import codecs
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from normlift_ns.errors import InputError

_LARGEST, _MOST_PIXELS = 2**16, 2**28
"""Pixels along one side of a photograph, and in all of it."""
_FARTHEST = 1e30
_MOST_BYTES = 2**27
"""Of a JSON file; ten thousand frames take a tenth of that."""


class CameraEntry(msgspec.Struct):
    """What may stand in the file for all frames, or in a frame."""

    fl_x: float | None = None
    fl_y: float | None = None
    cx: float | None = None
    cy: float | None = None
    w: float | None = None
    h: float | None = None
    k1: float | None = None
    k2: float | None = None
    k3: float | None = None
    k4: float | None = None
    p1: float | None = None
    p2: float | None = None
    distortion_params: list[float] | None = None
    camera_angle_x: float | None = None
    camera_angle_y: float | None = None
    camera_model: str | None = None
    is_fisheye: bool | None = None


class FrameEntry(CameraEntry, kw_only=True):
    """One photograph as the file has it."""

    file_path: str
    transform_matrix: list[list[float]]
    mask_path: str | None = None


class Entries(CameraEntry, kw_only=True):
    """The file as it stands."""

    frames: list[FrameEntry]
    applied_transform: list[list[float]] | None = None
    applied_scale: float = 1.0
    orientation_override: Any = None
    train_filenames: list[str] | None = None
    val_filenames: list[str] | None = None
    test_filenames: list[str] | None = None


def read_json(path: Path, expected: str) -> Any:
    """The values of a JSON file.

    Raises:
        FileNotFoundError, ValueError: no file, no JSON, or values nested too deeply; the message names it.
    """
    if not path.is_file():
        raise FileNotFoundError(f"There is no file {path}. Expected {expected}.")
    if path.stat().st_size > _MOST_BYTES:
        raise InputError(
            f"{path} has {path.stat().st_size:,} bytes, more than the {_MOST_BYTES:,} that are read. Expected "
            f"{expected}."
        )
    text = path.read_bytes().removeprefix(codecs.BOM_UTF8)
    try:
        return msgspec.json.decode(text)
    except (msgspec.DecodeError, ValueError, RecursionError) as error:
        found = next((word for word in ("NaN", "Infinity") if word.encode() in text), None)
        reason = str(error) if found is None else f"it contains {found}"
        raise InputError(f"{path} is no valid JSON ({reason}). Expected {expected}.") from error


def read_entries(path: Path) -> Entries:
    """A transforms.json as it stands, with poses and sizes that a camera can have; no photograph is looked for.

    Raises:
        FileNotFoundError, ValueError: no such file, no JSON, another schema, no frames, poses or sizes that are none.
    """
    expected = "a transforms.json as nerfstudio, instant-ngp or Blender's synthetic scenes have it"
    values = read_json(path, expected)
    try:
        found = msgspec.convert(values, Entries)
    except (msgspec.ValidationError, RecursionError, OverflowError) as error:
        raise InputError(f"{path} has another form than expected: {error}. Expected {expected}.") from error
    if len(found.frames) == 0:
        raise InputError(f"{path} has no frames, so no cameras. Expected one for every image of the training.")
    for holder in (found, *found.frames):
        where = f"{path}: {holder.file_path}" if isinstance(holder, FrameEntry) else str(path)
        _check_numbers(holder, where)
        if isinstance(holder, FrameEntry):
            names = (holder.file_path, holder.mask_path or "-")
            if any(name.strip() == "" or "\0" in name for name in names):
                raise InputError(f"{path}: the file_path or mask_path {names} is no name of a file. Expected one.")
            rows = holder.transform_matrix
            if len(rows) not in (3, 4) or any(len(row) != 4 for row in rows) or not (np.abs(rows) < _FARTHEST).all():
                raise InputError(
                    f"{path}: the transform_matrix of {holder.file_path} is not 4 x 4 finite numbers. Expected a "
                    "camera-to-world matrix."
                )
    return found


def _check_numbers(entry: CameraEntry, where: str) -> None:
    """Sizes are whole and in bounds, focal lengths positive, all others within float32."""
    for name in ("w", "h"):
        side = getattr(entry, name)
        if side is not None and not (0 < side <= _LARGEST and float(side).is_integer()):
            raise InputError(f"{where}: {name} is {side:g}, expected whole numbers of pixels, 1 to {_LARGEST:,}.")
    if (entry.w or 1) * (entry.h or 1) > _MOST_PIXELS:
        raise InputError(f"{where}: w and h are {entry.w:g} and {entry.h:g}, more than {_MOST_PIXELS:,} pixels in all.")
    numbers = {name: getattr(entry, name) for name in ("cx", "cy", "k1", "k2", "k3", "k4", "p1", "p2")}
    numbers |= {f"distortion_params[{i}]": value for i, value in enumerate(entry.distortion_params or ())}
    for name in ("fl_x", "fl_y"):
        focal = getattr(entry, name)
        if focal is not None and not 0 < focal < _FARTHEST:
            raise InputError(f"{where}: {name} is {focal:g}, expected a positive number of pixels.")
    for name, value in numbers.items():
        if value is not None and not abs(value) < _FARTHEST:
            raise InputError(f"{where}: {name} is {value:g}, expected a number that float32 can hold.")
