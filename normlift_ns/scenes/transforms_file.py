"""Schema and validation of transforms.json."""

from __future__ import annotations

import codecs
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from normlift_ns.errors import InputError

_MAX_SIDE, _MAX_PIXELS = 2**16, 2**28
"""Largest side and largest area of an image, in pixels."""
_MAX_VALUE = 1e30
_MAX_JSON_BYTES = 2**27
"""Largest JSON file that is read; ten thousand frames take a tenth of that."""


class CameraEntry(msgspec.Struct):
    """Camera parameters, given for all frames or for a single frame."""

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
    """A frame, as stored in the file."""

    file_path: str
    transform_matrix: list[list[float]]
    mask_path: str | None = None


class Entries(CameraEntry, kw_only=True):
    """The contents of a transforms.json."""

    frames: list[FrameEntry]
    applied_transform: list[list[float]] | None = None
    applied_scale: float = 1.0
    orientation_override: Any = None
    train_filenames: list[str] | None = None
    val_filenames: list[str] | None = None
    test_filenames: list[str] | None = None


def read_json(path: Path, expected: str) -> Any:
    """Read a JSON file.

    Args:
        path: the file.
        expected: noun phrase for error messages that describes the expected file.
    Raises:
        FileNotFoundError: if there is no such file.
        ValueError: if the file is too large, is not valid JSON or is nested too deeply.
    """
    if not path.is_file():
        raise FileNotFoundError(f"There is no file {path}. Expected {expected}.")
    if path.stat().st_size > _MAX_JSON_BYTES:
        raise InputError(
            f"{path} has {path.stat().st_size:,} bytes, more than the limit of {_MAX_JSON_BYTES:,}. Expected "
            f"{expected}."
        )
    text = path.read_bytes().removeprefix(codecs.BOM_UTF8)
    try:
        return msgspec.json.decode(text)
    except (msgspec.DecodeError, ValueError, RecursionError) as error:
        invalid = next((word for word in ("NaN", "Infinity") if word.encode() in text), None)
        reason = str(error) if invalid is None else f"it contains {invalid}"
        raise InputError(f"{path} is not valid JSON ({reason}). Expected {expected}.") from error


def read_entries(path: Path) -> Entries:
    """Read and validate a transforms.json, without looking for its images.

    Raises:
        FileNotFoundError: if there is no such file.
        ValueError: if the file is not valid JSON, does not match the schema, or has no frames, invalid poses or
            invalid sizes.
    """
    expected = "a transforms.json of nerfstudio, instant-ngp or Blender's synthetic scenes"
    values = read_json(path, expected)
    try:
        entries = msgspec.convert(values, Entries)
    except (msgspec.ValidationError, RecursionError, OverflowError) as error:
        raise InputError(f"{path} does not match the schema: {error}. Expected {expected}.") from error
    if len(entries.frames) == 0:
        raise InputError(f"{path} has no frames, so no cameras. Expected a frame for every training image.")
    _check_numbers(entries, str(path))
    for frame in entries.frames:
        _check_numbers(frame, f"{path}: {frame.file_path}")
        names = (frame.file_path, frame.mask_path or "-")
        if any(name.strip() == "" or "\0" in name for name in names):
            raise InputError(f"{path}: the file_path or mask_path {names} is not a valid file name.")
        rows = frame.transform_matrix
        if len(rows) not in (3, 4) or any(len(row) != 4 for row in rows) or not (np.abs(rows) < _MAX_VALUE).all():
            raise InputError(
                f"{path}: the transform_matrix of {frame.file_path} is not 4 x 4 finite numbers. Expected a "
                "camera-to-world matrix."
            )
    return entries


def _check_numbers(entry: CameraEntry, source: str) -> None:
    """Raise if a size is not a whole number in range, a focal length not positive, or a number beyond float32."""
    for name in ("w", "h"):
        side = getattr(entry, name)
        if side is not None and not (0 < side <= _MAX_SIDE and float(side).is_integer()):
            raise InputError(f"{source}: {name} is {side:g}, expected a whole number of pixels, 1 to {_MAX_SIDE:,}.")
    if (entry.w or 1) * (entry.h or 1) > _MAX_PIXELS:
        raise InputError(f"{source}: w and h are {entry.w:g} and {entry.h:g}, more than {_MAX_PIXELS:,} pixels in all.")
    numbers = {name: getattr(entry, name) for name in ("cx", "cy", "k1", "k2", "k3", "k4", "p1", "p2")}
    numbers |= {f"distortion_params[{i}]": value for i, value in enumerate(entry.distortion_params or ())}
    for name in ("fl_x", "fl_y"):
        focal = getattr(entry, name)
        if focal is not None and not 0 < focal < _MAX_VALUE:
            raise InputError(f"{source}: {name} is {focal:g}, expected a positive number of pixels.")
    for name, value in numbers.items():
        if value is not None and not abs(value) < _MAX_VALUE:
            raise InputError(f"{source}: {name} is {value:g}, expected a number that float32 can hold.")
