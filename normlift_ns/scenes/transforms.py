"""Cameras in transforms.json, the format of nerfstudio, instant-ngp and Blender's synthetic scenes."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float

from normlift_ns.core.files import write_text
from normlift_ns.errors import InputError
from normlift_ns.scenes.frames import Frame, Intrinsics, find_masks, find_photographs
from normlift_ns.scenes.image_files import read_head
from normlift_ns.scenes.transforms_file import Entries, FrameEntry, read_entries

_MIN_DETERMINANT = 1e-6
_PERSPECTIVE_MODELS = ("OPENCV", "PINHOLE", "SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL")


@dataclass(frozen=True)
class TransformsFile:
    """Contents of a transforms.json."""

    frames: list[Frame]
    """Frames sorted by file, as in nerfstudio."""
    held_out: frozenset[str]
    """Names of the frames that the file excludes from the training; most files exclude none."""
    applied_transform: Float[np.ndarray, "4 4"]
    """Transform from the world of the capture to that of the file, as ns-process-data applied it."""
    applied_scale: float
    """Scale of that transform."""


def read_transforms(
    path: Path,
    images: Path | None = None,
    masks: Path | None = None,
    *,
    base: Path | None = None,
    advice: str = "give the folder of the images with --images",
) -> TransformsFile:
    """Read the frames of a transforms.json; images are located, but only opened if the file does not give their size.

    Args:
        path: the file, or the folder that holds it.
        images, masks: folders of the images and masks, instead of those that the file names.
        base: folder that names are relative to; None: that of the file, or the parent of `images`.
        advice: what to do about missing images, for error messages.
    Raises:
        FileNotFoundError: if the file, an image or a mask is missing.
        ValueError: if the file is not valid JSON, does not match the schema, or names a camera model that cannot be
            undistorted.
    """
    path = path / "transforms.json" if path.is_dir() else path
    entries = read_entries(path)
    root = path.parent if base is None else base
    names = [relative_name(Path(frame.file_path), root) for frame in entries.frames]
    files = find_photographs(names, images or root, path, advice, copies=images is not None)
    if base is None:
        names = [relative_name(file, (root if images is None else images.parent).absolute()) for file in files]
    frames = [
        Frame(file, name, np.array(entry.transform_matrix[:3]), _intrinsics(entries, entry, file, path), mask)
        for entry, file, name, mask in zip(entries.frames, files, names, _masks(entries, root, images, masks, path))
    ]
    held_out = _held_out(entries, root, path)
    return TransformsFile(
        sorted(frames, key=lambda frame: frame.file),
        frozenset(name for name, is_held_out in zip(names, held_out) if is_held_out),
        _applied_transform(entries, path),
        entries.applied_scale,
    )


def _held_out(entries: Entries, root: Path, path: Path) -> list[bool]:
    """Return whether the file excludes each frame from the training. Like nerfstudio, reject lists of other files."""
    lists = {"train": entries.train_filenames, "val": entries.val_filenames, "test": entries.test_filenames}
    files = [root / frame.file_path for frame in entries.frames]
    for split, names in lists.items():
        unknown = [name for name in names or () if root / name not in files]
        if unknown:
            raise InputError(
                f"{path}: its {split}_filenames list {unknown[0]}, which is not the file_path of any frame. Expected "
                "the same names in both."
            )
    if entries.train_filenames is not None:
        trained = {root / name for name in entries.train_filenames}
        return [file not in trained for file in files]
    excluded = {root / name for name in (*(entries.val_filenames or ()), *(entries.test_filenames or ()))}
    return [file in excluded for file in files]


def relative_name(file: Path, folder: Path) -> str:
    """Return the file relative to the folder, or unchanged if it lies elsewhere, with forward slashes."""
    return (file.relative_to(folder) if file.is_relative_to(folder) else file).as_posix()


def _masks(
    entries: Entries, root: Path, images: Path | None, masks: Path | None, path: Path
) -> Sequence[Path] | Sequence[None]:
    if masks is not None:
        return find_masks([frame.file_path for frame in entries.frames], masks)
    names = [frame.mask_path for frame in entries.frames if frame.mask_path is not None]
    if len(names) == 0:
        return [None] * len(entries.frames)
    if len(names) < len(entries.frames):
        unmasked = next(frame.file_path for frame in entries.frames if frame.mask_path is None)
        raise InputError(
            f"{path} lists masks for some images, but none for {unmasked}. Expected one for each, or none."
        )
    files = [_find_mask(name, root, images) for name in names]
    missing = [name for name, file in zip(names, files) if file is None]
    if missing:
        raise FileNotFoundError(
            f"{len(missing)} of the {len(names)} masks that {path} lists are missing, the first is "
            f"{root / missing[0]}. Put them back, or next to the images if those were moved."
        )
    return [file.absolute() for file in files if file is not None]


def _find_mask(name: str, root: Path, images: Path | None) -> Path | None:
    """Find a mask at its path in the file, or in a folder of the same name inside or next to the image folder."""
    own = root / name
    tail = Path(own.parent.name, own.name)
    moved = () if images is None else (images / relative_name(own, root), images / tail, images.parent / tail)
    return next((file for file in (own, *moved) if file.is_file()), None)


def _intrinsics(entries: Entries, frame: FrameEntry, file: Path, path: Path) -> Intrinsics:
    """Return the intrinsics of a frame. As in nerfstudio, values for all frames take precedence over its own."""

    def value(name: str) -> Any:
        shared = getattr(entries, name)
        return getattr(frame, name) if shared is None else shared

    model = value("camera_model") or "OPENCV"
    model = "OPENCV_FISHEYE" if value("is_fisheye") else model
    if model not in _PERSPECTIVE_MODELS:
        raise InputError(
            f"{path}: the camera_model is {model}; supported models are {', '.join(_PERSPECTIVE_MODELS)}. Undistort "
            "the images, train the scene on those, and give their cameras."
        )
    size = (value("w"), value("h"))
    width, height = read_head(file).size if None in size else size
    fx, fy = value("fl_x"), value("fl_y")
    for angle in (value("camera_angle_x"), value("camera_angle_y")):
        if angle is not None and not 0 < angle < math.pi:
            raise InputError(f"{path}: a camera_angle is {angle}, expected radians between 0 and pi.")
    if fx is None and value("camera_angle_x") is not None:
        fx = 0.5 * width / math.tan(0.5 * value("camera_angle_x"))
    if fy is None and value("camera_angle_y") is not None:
        fy = 0.5 * height / math.tan(0.5 * value("camera_angle_y"))
    if fx is None:
        raise InputError(f"{path} has neither fl_x nor camera_angle_x for {frame.file_path}. Expected a focal length.")
    cx, cy = value("cx"), value("cy")
    return Intrinsics(
        fx,
        fx if fy is None else fy,
        width / 2 if cx is None else cx,
        height / 2 if cy is None else cy,
        int(width),
        int(height),
        *_distortion(entries, frame, path),
    )


def _distortion(entries: Entries, frame: FrameEntry, path: Path) -> tuple[float, ...]:
    """Return k1, k2, k3, p1, p2: the values for all frames if there are any, otherwise the frame's own."""
    names = ("k1", "k2", "k3", "k4", "p1", "p2")
    source = entries if any(getattr(entries, name) is not None for name in (*names, "distortion_params")) else frame
    values = [getattr(source, name) or 0.0 for name in names]
    if source.distortion_params is not None:
        values = [*source.distortion_params, *[0.0] * 6][:6]
    k1, k2, k3, k4, p1, p2 = values
    if k4 != 0:
        raise InputError(
            f"{path}: {frame.file_path} has the distortion k4 = {k4:g}; only k1, k2, k3, p1 and p2 can be undistorted. "
            "Undistort the images, train the scene on those, and give their cameras."
        )
    return k1, k2, k3, p1, p2


def _applied_transform(entries: Entries, path: Path) -> Float[np.ndarray, "4 4"]:
    """Return the applied transform. As in nerfstudio, files of an old ns-process-data imply one without naming it."""
    rows = entries.applied_transform
    if rows is None and (path.parent / "colmap/sparse/0").exists():
        rows = [[0.0, 1.0, 0.0, 0.0], [1.0, 0.0, 0.0, 0.0], [0.0, 0.0, -1.0, 0.0]]
    matrix = np.eye(4)
    if rows is not None:
        if len(rows) not in (3, 4) or any(len(row) != 4 for row in rows) or not np.isfinite(rows).all():
            raise InputError(f"{path}: applied_transform is not 3 x 4 finite numbers.")
        matrix[:3] = rows[:3]
    if abs(np.linalg.det(matrix)) < _MIN_DETERMINANT or not 0 < entries.applied_scale < math.inf:
        raise InputError(
            f"{path}: applied_transform cannot be inverted, or applied_scale is {entries.applied_scale}. Expected a "
            "rotation and a positive number."
        )
    return matrix


def write_transforms(path: Path, frames: Sequence[Frame], held_out: Sequence[Frame]) -> None:
    """Write frames for nerfstudio-data, which sorts them by file and reads them as float32."""
    splits = {"train_filenames": frames, "val_filenames": held_out, "test_filenames": held_out}
    content: dict[str, Any] = {"camera_model": "OPENCV"}
    if len(held_out) > 0:
        content |= {name: [str(frame.file) for frame in split] for name, split in splits.items()}
    content["frames"] = [_entry(frame) for frame in sorted((*frames, *held_out), key=lambda frame: frame.file)]
    write_text(path, json.dumps(content, indent=1) + "\n")


def _entry(frame: Frame) -> dict[str, Any]:
    camera = frame.intrinsics
    pose = torch.from_numpy(np.concatenate([frame.pose, [[0.0, 0.0, 0.0, 1.0]]])).float().tolist()
    numbers = dict(zip(("fl_x", "fl_y", "cx", "cy", "w", "h", "k1", "k2", "k3", "p1", "p2"), camera))
    mask = {} if frame.mask is None else {"mask_path": str(frame.mask)}
    return {"file_path": str(frame.file), **mask, **numbers, "transform_matrix": pose}
