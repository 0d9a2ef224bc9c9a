"""transforms.json: cameras in the format of nerfstudio, instant-ngp and Blender's synthetic scenes."""

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

_SINGULAR = 1e-6
_PERSPECTIVE = ("OPENCV", "PINHOLE", "SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL")


@dataclass(frozen=True)
class TransformsFile:
    """What a transforms.json says."""

    frames: list[Frame]
    """In the order of their files, as nerfstudio sorts them."""
    held_out: frozenset[str]
    """Names of the frames that the file keeps from the training; most files keep none."""
    applied: Float[np.ndarray, "4 4"]
    """From the world of the capture to that of the file, as ns-process-data turned it."""
    applied_scale: float


def read_transforms(
    path: Path,
    images: Path | None = None,
    masks: Path | None = None,
    *,
    base: Path | None = None,
    advice: str = "say where the images are with --images",
) -> TransformsFile:
    """Frames of a transforms.json; photographs are found, but not opened, unless a size is missing.

    Args:
        path: the file, or the folder that holds it.
        images, masks: folders to take the photographs and masks from, instead of those that the file names.
        base: folder that names are relative to; None: that of the file, or the one above `images`.
        advice: what to do about missing photographs.
    Raises:
        FileNotFoundError: no such file, or a photograph or mask is missing.
        ValueError: no JSON, another schema, a camera model that cannot be undistorted here.
    """
    path = path / "transforms.json" if path.is_dir() else path
    found = read_entries(path)
    place = path.parent if base is None else base
    listed = [relative_name(Path(frame.file_path), place) for frame in found.frames]
    files = find_photographs(listed, images or place, path, advice, copies=images is not None)
    names = listed
    if base is None:
        names = [relative_name(file, (place if images is None else images.parent).absolute()) for file in files]
    frames = [
        Frame(file, name, np.array(entry.transform_matrix[:3]), _intrinsics(found, entry, file, path), mask)
        for entry, file, name, mask in zip(found.frames, files, names, _masks(found, place, images, masks, path))
    ]
    held_out = _held_out(found, place, path)
    return TransformsFile(
        sorted(frames, key=lambda frame: frame.file),
        frozenset(name for name, out in zip(names, held_out) if out),
        _applied(found, path),
        found.applied_scale,
    )


def _held_out(found: Entries, place: Path, path: Path) -> list[bool]:
    """Which frames the file keeps from the training; like nerfstudio it refuses lists that name other files."""
    lists = {"train": found.train_filenames, "val": found.val_filenames, "test": found.test_filenames}
    known = [place / frame.file_path for frame in found.frames]
    for split, names in lists.items():
        strange = [name for name in names or () if place / name not in known]
        if strange:
            raise InputError(
                f"{path}: its {split}_filenames name {strange[0]}, which is no file_path of its frames. Expected the "
                "same names in both."
            )
    if found.train_filenames is not None:
        trained = {place / name for name in found.train_filenames}
        return [file not in trained for file in known]
    kept = {place / name for name in (*(found.val_filenames or ()), *(found.test_filenames or ()))}
    return [file in kept for file in known]


def relative_name(file: Path, folder: Path) -> str:
    """The file relative to the folder, or as it is if it lies elsewhere; with forward slashes."""
    return (file.relative_to(folder) if file.is_relative_to(folder) else file).as_posix()


def _masks(
    found: Entries, place: Path, images: Path | None, masks: Path | None, path: Path
) -> Sequence[Path] | Sequence[None]:
    named = [frame.mask_path for frame in found.frames]
    if masks is not None:
        return find_masks([frame.file_path for frame in found.frames], masks)
    given = [name for name in named if name is not None]
    if len(given) == 0:
        return [None] * len(named)
    if len(given) < len(named):
        bare = next(frame.file_path for frame in found.frames if frame.mask_path is None)
        raise InputError(f"{path} names masks for some images, but none for {bare}. Expected one for each, or none.")
    found_masks = [_mask(name, place, images) for name in given]
    missing = [name for name, file in zip(given, found_masks) if file is None]
    if missing:
        raise FileNotFoundError(
            f"{len(missing)} of the {len(given)} masks that {path} names are missing, the first is "
            f"{place / missing[0]}. Put them back, beside the photographs if those were moved."
        )
    return [file.absolute() for file in found_masks if file is not None]


def _mask(name: str, place: Path, images: Path | None) -> Path | None:
    """Where the file says, or in a folder of the same name in or beside the folder of the photographs."""
    own = place / name
    tail = Path(own.parent.name, own.name)
    moved = () if images is None else (images / relative_name(own, place), images / tail, images.parent / tail)
    return next((file for file in (own, *moved) if file.is_file()), None)


def _intrinsics(common: Entries, frame: FrameEntry, file: Path, path: Path) -> Intrinsics:
    """As nerfstudio takes them: what stands in the file counts for all frames, what is missing there stands in them."""

    def value(name: str) -> Any:
        found = getattr(common, name)
        return getattr(frame, name) if found is None else found

    model = value("camera_model") or "OPENCV"
    model = "OPENCV_FISHEYE" if value("is_fisheye") else model
    if model not in _PERSPECTIVE:
        raise InputError(
            f"{path}: the camera_model is {model}; read are {', '.join(_PERSPECTIVE)}. Undistort the images, train the "
            "scene on those, and give their cameras."
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
        *_distortion(common, frame, path),
    )


def _distortion(common: Entries, frame: FrameEntry, path: Path) -> tuple[float, ...]:
    """k1, k2, k3, p1, p2: of the file if any stands there, else of the frame."""
    names = ("k1", "k2", "k3", "k4", "p1", "p2")
    holder = common if any(getattr(common, name) is not None for name in (*names, "distortion_params")) else frame
    values = [getattr(holder, name) or 0.0 for name in names]
    if holder.distortion_params is not None:
        values = [*holder.distortion_params, *[0.0] * 6][:6]
    k1, k2, k3, k4, p1, p2 = values
    if k4 != 0:
        raise InputError(
            f"{path}: {frame.file_path} has the distortion k4 = {k4:g}; only k1, k2, k3, p1 and p2 can be undone. "
            "Undistort the images, train the scene on those, and give their cameras."
        )
    return k1, k2, k3, p1, p2


def _applied(found: Entries, path: Path) -> Float[np.ndarray, "4 4"]:
    """nerfstudio's own rule: folders of an old ns-process-data do not say what was applied."""
    rows = found.applied_transform
    if rows is None and (path.parent / "colmap/sparse/0").exists():
        rows = [[0.0, 1.0, 0.0, 0.0], [1.0, 0.0, 0.0, 0.0], [0.0, 0.0, -1.0, 0.0]]
    matrix = np.eye(4)
    if rows is not None:
        if len(rows) not in (3, 4) or any(len(row) != 4 for row in rows) or not np.isfinite(rows).all():
            raise InputError(f"{path}: applied_transform is not 3 x 4 finite numbers.")
        matrix[:3] = rows[:3]
    if abs(np.linalg.det(matrix)) < _SINGULAR or not 0 < found.applied_scale < math.inf:
        raise InputError(
            f"{path}: applied_transform cannot be inverted, or applied_scale is {found.applied_scale}. Expected a "
            "rotation and a positive number."
        )
    return matrix


def write_transforms(path: Path, frames: Sequence[Frame], held_out: Sequence[Frame]) -> None:
    """Writes frames for nerfstudio-data, which sorts them by their files and reads them as float32."""
    splits = {"train_filenames": frames, "val_filenames": held_out, "test_filenames": held_out}
    content: dict[str, Any] = {"camera_model": "OPENCV"}
    if len(held_out) > 0:
        content |= {name: [str(frame.file) for frame in part] for name, part in splits.items()}
    content["frames"] = [_entry(frame) for frame in sorted((*frames, *held_out), key=lambda frame: frame.file)]
    write_text(path, json.dumps(content, indent=1) + "\n")


def _entry(frame: Frame) -> dict[str, Any]:
    camera = frame.intrinsics
    pose = torch.from_numpy(np.concatenate([frame.pose, [[0.0, 0.0, 0.0, 1.0]]])).float().tolist()
    numbers = dict(zip(("fl_x", "fl_y", "cx", "cy", "w", "h", "k1", "k2", "k3", "p1", "p2"), camera))
    mask = {} if frame.mask is None else {"mask_path": str(frame.mask)}
    return {"file_path": str(frame.file), **mask, **numbers, "transform_matrix": pose}
