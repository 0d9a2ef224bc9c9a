"""Reader and writer for transforms.json, and transforms from the world of the cameras to the world of the splat."""

from __future__ import annotations

import codecs
import io
import json
import math
import tokenize
from collections.abc import Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import msgspec
import numpy as np
import torch
from jaxtyping import Float

from normlift_ns.data.frames import (
    FISHEYE_MODELS,
    GIVE_IMAGES,
    PERSPECTIVE_MODELS,
    Frame,
    Intrinsics,
    WorldTransform,
    find_images,
    find_masks,
    plain_name,
    possible_paths,
    read_image_header,
)
from normlift_ns.errors import InputError
from normlift_ns.io.atomic import write_text_file
from normlift_ns.io.guard import check_files_distinct, read_file

_MAX_SIDE, _MAX_PIXELS = 2**16, 2**28
"""Maximum side and maximum area of an image, in pixels."""
_MAX_VALUE = 1e30
DISTORTION = ("k1", "k2", "k3", "k4", "p1", "p2")
_DISTORTION_VALUES = (*DISTORTION, "k5", "k6", "distortion_params")
_LEGACY_FLIP = [[0.0, 1.0, 0.0, 0.0], [1.0, 0.0, 0.0, 0.0], [0.0, 0.0, -1.0, 0.0]]
_MAX_JSON_BYTES = 2**27
"""Maximum size of a JSON file. Ten thousand frames take a tenth of this size."""


class CameraEntry(msgspec.Struct):
    """Camera parameters in a transforms.json, either for all frames or for one frame."""

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
    k5: float | None = None
    k6: float | None = None
    p1: float | None = None
    p2: float | None = None
    distortion_params: list[float] | None = None
    camera_angle_x: float | None = None
    camera_angle_y: float | None = None
    camera_model: str | None = None
    is_fisheye: bool | None = None


class FrameEntry(CameraEntry, kw_only=True):
    """Frame as stored in a transforms.json."""

    file_path: str
    transform_matrix: list[list[float]]
    mask_path: str | None = None


class TransformsEntries(CameraEntry, kw_only=True):
    """Contents of a transforms.json."""

    frames: list[FrameEntry]
    applied_transform: list[list[float]] | None = None
    applied_scale: float = 1.0
    orientation_override: Any = None
    train_filenames: list[str] | None = None
    val_filenames: list[str] | None = None
    test_filenames: list[str] | None = None

    @property
    def lists(self) -> dict[str, list[str] | None]:
        """Lists of file names by split; None for a split without a list."""
        return {"train": self.train_filenames, "val": self.val_filenames, "test": self.test_filenames}

    def value(self, frame: FrameEntry, name: str) -> Any:
        """Return a camera parameter of a frame. As in nerfstudio, a value for all frames takes precedence."""
        shared = getattr(self, name)
        return getattr(frame, name) if shared is None else shared

    def applied_rows(self, folder: Path) -> list[list[float]] | None:
        """Return the transform that was applied to the poses before they were stored, or None.

        As in nerfstudio, a file without this entry next to colmap/sparse/0 counts as the output of an old
        ns-process-data, which applied a fixed transform.
        """
        is_legacy = self.applied_transform is None and (folder / "colmap/sparse/0").exists()
        return _LEGACY_FLIP if is_legacy else self.applied_transform


def read_json_file(path: Path, expected: str) -> Any:
    """Return the decoded content of a JSON file.

    Args:
        path: File to read.
        expected: Noun phrase that describes the expected file, for error messages.
    Raises:
        FileNotFoundError: The file does not exist.
        ValueError: The file is too large, is not valid JSON, or is nested too deeply.
    """
    if not path.is_file():
        problem = "is not a regular file" if path.exists() else "does not exist"
        raise FileNotFoundError(f"{path} {problem}. Expected {expected}.")
    if path.stat().st_size > _MAX_JSON_BYTES:
        raise InputError(
            f"{path} has {path.stat().st_size:,} bytes, expected at most {_MAX_JSON_BYTES:,}. Give {expected}."
        )
    text = read_file(path, max_bytes=_MAX_JSON_BYTES).removeprefix(codecs.BOM_UTF8)
    try:
        return msgspec.json.decode(text)
    except (msgspec.DecodeError, ValueError, RecursionError) as error:
        invalid = next((word for word in ("NaN", "Infinity") if word.encode() in text), None)
        reason = str(error) if invalid is None else f"{error}; JSON does not allow {invalid}"
        raise InputError(f"{path} is not valid JSON ({reason}). Expected {expected}.") from error


def read_transforms_entries(path: Path) -> TransformsEntries:
    """Read and validate a transforms.json, without checking that its images exist.

    Raises:
        FileNotFoundError: The file does not exist.
        ValueError: The file is not valid JSON, does not match the schema, has no frames, or has an invalid name, pose
            or camera parameter.
    """
    expected = "a transforms.json of nerfstudio, instant-ngp or Blender's synthetic scenes"
    values = read_json_file(path, expected)
    try:
        entries = msgspec.convert(values, TransformsEntries)
    except (msgspec.ValidationError, RecursionError, OverflowError) as error:
        raise InputError(f"{path} does not match the schema: {error}. Expected {expected}.") from error
    if len(entries.frames) == 0:
        raise InputError(f"{path} has no frames. Expected a frame for every training image.")
    _check_numbers(entries, str(path))
    for frame in entries.frames:
        _check_numbers(frame, f"{path}: {frame.file_path}")
        for key, name in (("file_path", frame.file_path), ("mask_path", frame.mask_path or "-")):
            if name.strip() == "" or "\0" in name:
                raise InputError(
                    f"{path} has the {key} {name!r}, which is not a valid file name. Correct the entry of this frame."
                )
        if not _is_matrix(frame.transform_matrix):
            raise InputError(
                f"{path}: the transform_matrix of {frame.file_path} is not valid. Expected a camera-to-world matrix of "
                "4 x 4 or 3 x 4 finite numbers."
            )
    return entries


def _is_matrix(rows: list[list[float]], bound: float = _MAX_VALUE) -> bool:
    """Return True if a matrix has 3 or 4 rows of 4 numbers with absolute values below a bound."""
    return len(rows) in (3, 4) and all(len(row) == 4 for row in rows) and bool((np.abs(rows) < bound).all())


def _check_numbers(entry: CameraEntry, source: str) -> None:
    """Raise InputError if a size, a focal length or another parameter of a camera is out of range."""
    for name, side in _given(entry, "w", "h"):
        if not (0 < side <= _MAX_SIDE and float(side).is_integer()):
            raise InputError(f"{source}: {name} is {side:g}, expected a whole number of pixels in 1..{_MAX_SIDE:,}.")
    if (entry.w or 1) * (entry.h or 1) > _MAX_PIXELS:
        raise InputError(f"{source}: w x h is {entry.w:g} x {entry.h:g}, expected at most {_MAX_PIXELS:,} pixels.")
    for name, focal in _given(entry, "fl_x", "fl_y"):
        if not 0 < focal < _MAX_VALUE:
            raise InputError(f"{source}: {name} is {focal:g}, expected a number of pixels above 0 and below 1e30.")
    parameters = [(f"distortion_params[{i}]", value) for i, value in enumerate(entry.distortion_params or ())]
    for name, value in (*_given(entry, "cx", "cy", *DISTORTION), *parameters):
        if not abs(value) < _MAX_VALUE:
            raise InputError(f"{source}: {name} is {value:g}, expected a number between -1e30 and 1e30.")


def _given(entry: CameraEntry, *names: str) -> list[tuple[str, float]]:
    """Return the names and values of the named parameters that are not None."""
    return [(name, value) for name in names if (value := getattr(entry, name)) is not None]


_MIN_DETERMINANT = 1e-6


class CameraFile(NamedTuple):
    """Contents of a transforms.json or a COLMAP reconstruction."""

    frames: list[Frame]
    """All images with their cameras in the world of the file, sorted by file, or by name for COLMAP."""
    held_out: frozenset[str]
    """Names of the images that the file excludes from the training; usually empty."""
    source: Path
    """Path of the file, or of the folder of the COLMAP reconstruction."""
    folder: Path
    """Folder of the dataset."""
    names_root: Path
    """Base folder of the relative image names."""
    applied_transform: Float[np.ndarray, "4 4"] | None = None
    """Transform from the world of the capture to the world of the file, as applied by ns-process-data; None for COLMAP.
    """
    applied_scale: float = 1.0
    """Scale of `applied_transform`."""
    remarks: tuple[str, ...] = ()
    """Messages about ambiguous files, in whole sentences."""


def read_transforms(
    path: Path,
    images: Path | None = None,
    masks: Path | None = None,
    *,
    base: Path | None = None,
    advice: str = GIVE_IMAGES,
) -> CameraFile:
    """Read the frames of a transforms.json, and find their images.

    The function opens an image only if the file does not contain its size.

    Args:
        path: Path of the file or of its folder.
        images: Folder of the images, which replaces the paths in the file.
        masks: Folder of the masks, which replaces the paths in the file.
        base: Base folder of the image names. If None, the parent of `images`, or else the folder of the file.
        advice: Advice on missing images, for error messages.
    Raises:
        FileNotFoundError: The file, an image or a mask is missing.
        ValueError: The file is not valid JSON, does not match the schema, or has invalid or contradictory values. Also
            if a camera model cannot be undistorted, or two images share a file.
    """
    path = path / "transforms.json" if path.is_dir() else path
    entries = read_transforms_entries(path)
    root = path.parent if base is None else base
    names_root = (root if images is None or base is not None else images.parent).absolute()
    names = [relative_name(Path(frame.file_path), root) for frame in entries.frames]
    files = find_images(names, images or root, path, advice, allow_copies=images is not None)
    if base is None:
        names = [relative_name(file, names_root) for file in files]
    frames = [
        Frame(file, name, np.array(entry.transform_matrix[:3]), _intrinsics(entries, entry, file, path), mask)
        for entry, file, name, mask in zip(entries.frames, files, names, _masks(entries, root, images, masks, path))
    ]
    held_out = _held_out(entries, root, path)
    return CameraFile(
        sorted(frames, key=lambda frame: frame.file),
        frozenset(name for name, is_held_out in zip(names, held_out) if is_held_out),
        path.absolute(),
        path.absolute().parent,
        names_root,
        _applied_transform(entries, path),
        entries.applied_scale,
    )


def _held_out(entries: TransformsEntries, root: Path, path: Path) -> list[bool]:
    """Return a list with True for each frame that the file excludes from the training.

    As in nerfstudio, a list must not contain files without a frame.
    """
    files = [root / plain_name(frame.file_path) for frame in entries.frames]
    for split, names in entries.lists.items():
        unknown = [name for name in names or () if root / plain_name(name) not in files]
        if unknown:
            raise InputError(
                f"{path}: {split}_filenames contains {unknown[0]}, expected only names that are the file_path of a "
                "frame. Correct the list."
            )
    if entries.train_filenames is not None:
        trained = {root / plain_name(name) for name in entries.train_filenames}
        return [file not in trained for file in files]
    excluded = {root / plain_name(name) for name in (*(entries.val_filenames or ()), *(entries.test_filenames or ()))}
    return [file in excluded for file in files]


def relative_name(file: Path, folder: Path) -> str:
    """Return the path of a file relative to a folder, with forward slashes; unchanged if the file is outside of it."""
    return (file.relative_to(folder) if file.is_relative_to(folder) else file).as_posix()


def _masks(
    entries: TransformsEntries, root: Path, images: Path | None, masks: Path | None, path: Path
) -> Sequence[Path] | Sequence[None]:
    if masks is not None:
        return find_masks([frame.file_path for frame in entries.frames], masks)
    if all(frame.mask_path is None for frame in entries.frames):
        return [None] * len(entries.frames)
    found = _listed_masks(entries, root, images, path)
    owned = [(frame.file_path, file) for frame, file in zip(entries.frames, found) if _is_named_like(file, frame)]
    check_files_distinct(owned, "mask", f"in the mask_path of {path}")
    return found


def _listed_masks(entries: TransformsEntries, root: Path, images: Path | None, path: Path) -> list[Path]:
    names = [frame.mask_path for frame in entries.frames if frame.mask_path is not None]
    if len(names) < len(entries.frames):
        unmasked = next(frame.file_path for frame in entries.frames if frame.mask_path is None)
        raise InputError(
            f"{path} lists masks for some images, but not for {unmasked}. Expected a mask for each image, or no masks."
        )
    files = [_find_mask(name, root, images) for name in names]
    missing = [name for name, file in zip(names, files) if file is None]
    if missing:
        raise FileNotFoundError(
            f"Masks of {path} are missing ({len(missing)} of {len(names)}, the first is {root / missing[0]}). Copy "
            "them to these paths. For a new lift of a splat, you can instead give their folder with --masks."
        )
    return [file.absolute() for file in files if file is not None]


def _find_mask(name: str, root: Path, images: Path | None) -> Path | None:
    """Return the path of an existing mask, or None.

    The function tries the path in the file, and then folders named like the mask's folder, inside and next to `images`.
    """
    own, *ends = possible_paths(root, name)
    tail = Path(*Path(plain_name(str(own))).parts[-2:])
    moved = () if images is None else (images / relative_name(own, root), images / tail, images.parent / tail)
    return next((file for file in (own, *ends, *moved) if file.is_file()), None)


def _is_named_like(mask: Path, frame: FrameEntry) -> bool:
    """Return True if a mask has the name of its image; other masks may be shared by all images of a camera."""
    image = Path(plain_name(frame.file_path))
    return mask.stem in (image.name, image.stem)


_UNDISTORT = "Undistort the images, and write a camera file for them in the same coordinate system."
_SAME = 1e-3
"""Tolerance for equal intrinsics: relative to the longer image side for pixels, and absolute for distortion."""


def _check_readings(entries: TransformsEntries, frame: FrameEntry, lens: Intrinsics, path: Path) -> None:
    """Raise InputError if the file has two different values for a parameter, because programs read different ones."""
    found: dict[str, tuple[str, float]] = {}
    differ: list[tuple[str, tuple[str, float], tuple[str, float]]] = []
    pixels = _SAME * max(lens.width, lens.height)
    readings = [
        (*reading, pixels)
        for names in (("fl_x", "fl_y", "cx", "cy", "w", "h"), ("camera_angle_x", "camera_angle_y"))
        for entry, start in ((entries, "."), (frame, ".frames[]."))
        for reading in _readings(entry, start, names, lens)
    ]
    given = [(e, s) for e, s in ((entries, "."), (frame, ".frames[].")) if _given(e, *_DISTORTION_VALUES)]
    for entry, start in given:
        label = ", ".join(f"{start}{name}" for name, _ in _given(entry, *_DISTORTION_VALUES))
        distortion = _distortion(entry, f"{path}: {frame.file_path}", is_fisheye=lens.fisheye)
        values = zip(("k1", "k2", "k3", "p1", "p2", "k4"), distortion)
        readings += [(name, label, value, _SAME) for name, value in values]
    for name, label, value, allowed in readings:
        first = found.setdefault(name, (label, value))
        if abs(first[1] - value) > allowed:
            differ.append((name, first, (label, value)))
    if len(differ) > 0:
        name, first, second = differ[0]
        kept, others = (", ".join(dict.fromkeys(item[i][0] for item in differ)) for i in (1, 2))  # type: ignore[index]
        raise InputError(
            f"{path} is contradictory. For {frame.file_path}, {name} is {first[1]:g} from {first[0]}, which "
            f"nerfstudio reads, and {second[1]:g} from {second[0]}, which programs such as instant-ngp and Brush read. "
            f"Remove the values that the splat was not trained with, and give new.json instead: "
            f"jq 'del({others})' {path.name} > new.json, or jq 'del({kept})' {path.name} > new.json"
        )


def _readings(
    entry: CameraEntry, start: str, names: Sequence[str], lens: Intrinsics
) -> Iterator[tuple[str, str, float]]:
    """Yield the name, key in the file and value of each given parameter.

    Angles of view are converted to focal lengths in pixels.
    """
    for name, value in _given(entry, *names):
        if name.startswith("camera_angle"):
            if 0 < value < math.pi:
                side = lens.width if name.endswith("x") else lens.height
                yield f"fl_{name[-1]}", f"{start}{name}", 0.5 * side / math.tan(0.5 * value)
        else:
            yield name, f"{start}{name}", value


def _is_fisheye(entries: TransformsEntries, frame: FrameEntry, path: Path) -> bool:
    """Return True for a fisheye camera.

    Raises:
        ValueError: The frame has two camera models, or a model that cannot be undistorted.
    """
    models = [item.camera_model for item in (entries, frame) if item.camera_model is not None]
    if len(set(models)) > 1:
        raise InputError(
            f"{path} is contradictory: the camera_model is {models[0]} for the file, but {frame.file_path} has "
            f"{models[1]}. Remove the model that the splat was not trained with: jq 'del(.frames[].camera_model)' "
            f"{path.name} > new.json, or jq 'del(.camera_model)' {path.name} > new.json"
        )
    is_fisheye = bool(entries.value(frame, "is_fisheye"))
    model = [*models, "OPENCV_FISHEYE" if is_fisheye else "OPENCV"][0].upper()
    if is_fisheye and model not in FISHEYE_MODELS:
        raise InputError(
            f"{path} is contradictory: is_fisheye is true for {frame.file_path}, but its camera_model is "
            f"{model}. nerfstudio reads the camera_model. Set it to OPENCV_FISHEYE, or remove is_fisheye: "
            f"jq 'del(.is_fisheye, .frames[].is_fisheye)' {path.name} > new.json"
        )
    if model not in (*PERSPECTIVE_MODELS, "FULL_OPENCV", "PERSPECTIVE", *FISHEYE_MODELS):
        raise InputError(
            f"{path}: the camera_model of {frame.file_path} is {model}, expected one of "
            f"{', '.join((*PERSPECTIVE_MODELS, *FISHEYE_MODELS))}. {_UNDISTORT}"
        )
    return model in FISHEYE_MODELS


def _intrinsics(entries: TransformsEntries, frame: FrameEntry, file: Path, path: Path) -> Intrinsics:
    """Return the intrinsics of a frame.

    Raises:
        ValueError: A value is missing or invalid, or two entries give different values for the same parameter.
    """
    value, source = partial(entries.value, frame), f"{path}: {frame.file_path}"
    is_fisheye = _is_fisheye(entries, frame, path)
    size = (value("w"), value("h"))
    width, height = read_image_header(file).size if None in size else size
    angles = value("camera_angle_x"), value("camera_angle_y")
    for angle in angles:
        if angle is not None and not 0 < angle < math.pi:
            raise InputError(f"{source}: a camera_angle is {angle}, expected an angle between 0 and pi radians.")
    fx, fy = _focal(value("fl_x"), angles[0], width), _focal(value("fl_y"), angles[1], height)
    if fx is None:
        raise InputError(f"{source} has neither fl_x nor camera_angle_x. Add fl_x, the focal length in pixels.")
    cx, cy = value("cx"), value("cy")
    is_shared = len(_given(entries, *_DISTORTION_VALUES)) > 0
    lens = Intrinsics(
        fx,
        fx if fy is None else fy,
        width / 2 if cx is None else cx,
        height / 2 if cy is None else cy,
        int(width),
        int(height),
        *_distortion(entries if is_shared else frame, source, is_fisheye=is_fisheye),
    )
    lens = lens.as_fisheye() if is_fisheye else lens
    _check_readings(entries, frame, lens, path)
    return lens


def _focal(focal: float | None, angle: float | None, side: float) -> float | None:
    """Return the focal length in pixels. If `focal` is None, compute it from the angle of view in radians."""
    return 0.5 * side / math.tan(0.5 * angle) if focal is None and angle is not None else focal


def _distortion(
    entry: CameraEntry, source: str, *, is_fisheye: bool
) -> tuple[float, float, float, float, float, float]:
    """Return the distortion parameters k1, k2, k3, p1, p2 and k4.

    Raises:
        ValueError: A parameter that the camera type does not have is nonzero. Such parameters are k4 of perspective
            cameras, p1 and p2 of fisheye cameras, and k5 and k6.
    """
    values = [getattr(entry, name) or 0.0 for name in DISTORTION]
    if entry.distortion_params is not None:
        values = [*entry.distortion_params, *[0.0] * 6][:6]
    k1, k2, k3, k4, p1, p2 = values
    unsupported = (("p1", p1), ("p2", p2)) if is_fisheye else (("k4", k4),)
    others = [(name, number) for name, number in (*unsupported, *_given(entry, "k5", "k6")) if number != 0]
    if others:
        name, number = others[0]
        raise InputError(
            f"{source} has the distortion {name} = {number:g}, but only k1, k2, k3"
            f"{' and k4' if is_fisheye else ', p1 and p2'} are supported. {_UNDISTORT}"
        )
    return k1, k2, k3, p1, p2, k4


def _applied_transform(entries: TransformsEntries, path: Path) -> Float[np.ndarray, "4 4"]:
    rows = entries.applied_rows(path.parent)
    matrix = np.eye(4)
    if rows is not None:
        if not _is_matrix(rows, math.inf):
            raise InputError(f"{path}: applied_transform is not valid, expected 3 x 4 or 4 x 4 finite numbers.")
        matrix[:3] = rows[:3]
    if abs(np.linalg.det(matrix)) < _MIN_DETERMINANT or not 0 < entries.applied_scale < math.inf:
        is_singular = abs(np.linalg.det(matrix)) < _MIN_DETERMINANT
        problem = "applied_transform cannot be inverted" if is_singular else f"applied_scale is {entries.applied_scale}"
        raise InputError(f"{path}: {problem}. Expected an invertible transform and a positive scale.")
    return matrix


def write_transforms(path: Path, frames: Sequence[Frame], held_out: Sequence[Frame]) -> None:
    """Write frames to a transforms.json for the data parser nerfstudio-data.

    The data parser sorts frames by file, and reads numbers as float32. It reads one camera model for all frames.
    """
    splits = {"train_filenames": frames, "val_filenames": held_out, "test_filenames": held_out}
    is_fisheye = any(frame.intrinsics.fisheye for frame in (*frames, *held_out))
    content: dict[str, Any] = {"camera_model": "OPENCV_FISHEYE" if is_fisheye else "OPENCV"}
    if len(held_out) > 0:
        content |= {name: [str(frame.file) for frame in split] for name, split in splits.items()}
    content["frames"] = [_entry(frame) for frame in sorted((*frames, *held_out), key=lambda frame: frame.file)]
    write_text_file(path, json.dumps(content, indent=1) + "\n")


def _entry(frame: Frame) -> dict[str, Any]:
    camera = frame.intrinsics
    pose = torch.from_numpy(np.concatenate([frame.pose, [[0.0, 0.0, 0.0, 1.0]]])).float().tolist()
    names = ("fl_x", "fl_y", "cx", "cy", "w", "h", "k1", "k2", "k3", "p1", "p2", *(("k4",) if camera.fisheye else ()))
    numbers = dict(zip(names, camera))
    mask = {} if frame.mask is None else {"mask_path": str(frame.mask)}
    return {"file_path": str(frame.file), **mask, **numbers, "transform_matrix": pose}


_TOLERANCE = 1e-3
"""Maximum deviation of a matrix from a similarity, because numbers in files are rounded."""
_MAX_MATRIX_BYTES = 2**16
_EXPECTED_DATAPARSER = "the dataparser_transforms.json of a run; copy it again"
_EXPECTED_MATRIX = "4 x 4 numbers in JSON, .npy or .txt, or the dataparser_transforms.json of a nerfstudio run"


class _DataparserTransforms(msgspec.Struct):
    """Contents of nerfstudio's dataparser_transforms.json, which maps a point p to scale * (transform @ p)."""

    transform: list[list[float]]
    scale: float


def read_dataparser_transforms(path: Path) -> WorldTransform:
    """Read the dataparser_transforms.json of a nerfstudio run.

    Raises:
        FileNotFoundError: The file does not exist.
        ValueError: The file does not contain a finite transform and a positive scale.
    """
    return _to_world(read_json_file(path, _EXPECTED_DATAPARSER), path)


def _to_world(values: Any, path: Path, expected: str = _EXPECTED_DATAPARSER) -> WorldTransform:
    try:
        stored = msgspec.convert(values, _DataparserTransforms)
    except (msgspec.ValidationError, RecursionError, OverflowError) as error:
        raise InputError(f"{path} does not contain a transform ({error}). Expected {expected}.") from error
    rows = stored.transform
    if not _is_matrix(rows) or not 0 < stored.scale < _MAX_VALUE:
        problem = f"its scale is {stored.scale:g}" if _is_matrix(rows) else "its matrix is not valid"
        raise InputError(
            f"{path} does not contain a valid transform: {problem}. Expected 3 rows of 4 finite numbers and a "
            f"positive scale, as in {expected}."
        )
    return WorldTransform(np.array(rows[:3]), stored.scale)


def capture_transforms(run_dir: Path, identity: Mapping[str, Any]) -> tuple[WorldTransform, ...]:
    """Return the successive transforms from the world of the capture to the world of a lifted run.

    Args:
        run_dir: Folder of the lifted run.
        identity: Identity of the scene. For a splat without a nerfstudio run, `source_world` maps the world of the
            cameras to the world of the splat.
    Raises:
        FileNotFoundError, ValueError: As in `read_dataparser_transforms`; also if `source_world` is invalid.
    """
    trained = read_dataparser_transforms(run_dir / "dataparser_transforms.json")
    source = identity.get("source_world")
    file, expected = run_dir / "splat.json", "the splat.json that ns-normlift wrote; copy the whole run again"
    return (trained,) if source is None else (_to_world(source, file, expected), trained)


def read_world_transform(
    path: Path, applied: Float[np.ndarray, "4 4"] | None = None, applied_scale: float = 1.0
) -> WorldTransform:
    """Read a similarity from the world of the cameras to the world of the splat.

    A dataparser_transforms.json starts from the world of the capture, so the inverse of `applied` precedes it.

    Args:
        path: A 4 x 4 matrix in JSON, .npy or .txt, or a dataparser_transforms.json.
        applied: Transform from the world of the capture to the world of the cameras, from the camera file.
        applied_scale: Scale of `applied`.
    Raises:
        FileNotFoundError: The file does not exist.
        ValueError: The file does not contain a similarity.
    """
    try:
        values = _read_values(path)
        if not isinstance(values, dict):
            return decompose_similarity(np.array(values, dtype=float), str(path))
    except (InputError, FileNotFoundError):
        raise
    except (TypeError, ValueError, EOFError, OverflowError, MemoryError, OSError, tokenize.TokenError) as error:
        raise InputError(f"{path} does not contain a transform ({error}). Expected {_EXPECTED_MATRIX}.") from error
    world = _to_world(values, path)
    matrix = np.eye(4)
    matrix[:3] = world.transform
    if applied is not None:
        matrix = matrix @ np.linalg.inv(applied)
    scale = world.scale / applied_scale
    decompose_similarity(matrix * scale + np.diag([0, 0, 0, 1 - scale]), str(path))
    return WorldTransform(matrix[:3], scale, float32=True)


def _read_values(path: Path) -> Any:
    if path.suffix not in (".npy", ".txt") or not path.is_file():
        return read_json_file(path, _EXPECTED_MATRIX)
    if path.stat().st_size > _MAX_MATRIX_BYTES:
        raise InputError(
            f"{path} has {path.stat().st_size:,} bytes, too many for 4 x 4 numbers. Expected {_EXPECTED_MATRIX}."
        )
    content = read_file(path)
    if path.suffix == ".npy":
        return np.load(io.BytesIO(content), allow_pickle=False).tolist()
    if content.strip() == b"":
        raise InputError(f"{path} is empty. Expected {_EXPECTED_MATRIX}.")
    return np.loadtxt(io.BytesIO(content.replace(b",", b" "))).tolist()


def decompose_similarity(matrix: Float[np.ndarray, "4 4"], source: str) -> WorldTransform:
    """Split a 4 x 4 matrix into a scale and a rigid transform.

    Args:
        matrix: Matrix of a similarity.
        source: File or step that the matrix comes from, for error messages.
    Raises:
        ValueError: The matrix does not consist of a rotation, a scale and a translation.
    """
    if matrix.shape != (4, 4):
        raise InputError(f"{source} has the shape {matrix.shape}. Expected 4 x 4 numbers.")
    if not (np.abs(matrix) < _MAX_VALUE).all():
        raise InputError(
            f"{source} has numbers that are not finite or are too large. Expected 4 x 4 numbers between -1e30 and 1e30."
        )
    linear = matrix[:3, :3]
    scale = float(np.cbrt(np.linalg.det(linear)))
    last = np.abs(matrix[3] - [0, 0, 0, 1]).max()
    if not (scale > 0 and last <= _TOLERANCE and np.abs(linear @ linear.T / scale**2 - np.eye(3)).max() <= _TOLERANCE):
        raise InputError(
            f"{source} is not a similarity: {matrix.tolist()}. Expected a rotation without mirroring, one scale for "
            "all axes and a translation, with 0 0 0 1 in the last row."
        )
    return WorldTransform(matrix[:3] / scale, scale)


def gsplat_normalization(frames: Sequence[Frame], points: Float[np.ndarray, "n 3"]) -> WorldTransform:
    """Compute the normalization of a COLMAP project by gsplat's simple_trainer, which does not save it.

    The steps are those of gsplat 1.5, datasets/normalize.py and datasets/colmap.py. The first step makes the cameras
    upright, and places them around the origin at a median distance of 1. The second step rotates the principal axes of
    the points to x, y and z, and turns the scene upside down if the median height of the points exceeds their mean
    height.

    Args:
        frames: All registered images, sorted by name.
        points: Points of the reconstruction, at least four.
    Returns:
        The similarity that the trainer computes. That of the actual training may differ by half a turn about an axis,
        because the signs of the axes depend on the linear algebra library. Versions of gsplat before 1.5 do not turn
        the scene upside down.
    Raises:
        ValueError: The normalization cannot be computed, or the trainer's formula mirrors the world.
    """
    poses = np.array([np.concatenate([frame.pose, [[0, 0, 0, 1]]]) for frame in frames]) * [1, -1, -1, 1]
    with np.errstate(all="ignore"):
        upright = _upright(poses)
    if not np.isfinite(upright).all():
        raise InputError(
            "gsplat's normalization cannot be computed from these cameras: all are at one point, or their up axes "
            "cancel out. Give the transform as a file with --world-transform. If the training used "
            "--no-normalize-world-space, give --gsplat-normalize False."
        )
    if np.linalg.det(upright[:3, :3]) < 0:
        raise InputError(
            "The mean up axis of the cameras is exactly +y, and gsplat's trainer mirrors such a world. Train the splat "
            "again with --no-normalize-world-space, and give --gsplat-normalize False."
        )
    aligned = _principal_axes(_apply(upright, points.astype(np.float32))) @ upright
    height = _apply(aligned, points.astype(np.float32))[:, 2]
    if np.median(height) > np.mean(height):
        aligned = np.diag([1.0, -1, -1, 1]) @ aligned
    return decompose_similarity(aligned, "The normalization by gsplat's trainer")


def _apply(matrix: Float[np.ndarray, "4 4"], points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
    return points @ matrix[:3, :3].T + matrix[:3, 3]


def _upright(poses: Float[np.ndarray, "v 4 4"]) -> Float[np.ndarray, "4 4"]:
    """Return the transform that maps the mean up axis of the cameras to -y, and their focus point to the origin.

    The median distance of the transformed cameras from the origin is 1.

    Args:
        poses: Camera-to-world matrices in OpenCV convention.
    """
    up = -poses[:, :3, 1].mean(axis=0)
    up /= np.linalg.norm(up)
    axis, cosine = np.cross(up, [0.0, -1.0, 0.0]), -up[1]
    if cosine > -1:
        skew = np.cross(np.eye(3), axis)
        rotation = np.eye(3) + skew + skew @ skew / (1 + cosine)
    else:
        rotation = np.diag([-1.0, 1.0, 1.0])  # a reflection, as in gsplat's code
    centers, forward = poses[:, :3, 3] @ rotation.T, poses[:, :3, 2] @ rotation.T
    nearest = centers - (forward * centers).sum(axis=1)[:, None] * forward  # closest point to the origin on each ray
    shift = -np.median(nearest, axis=0)
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = rotation, shift
    matrix[:3] /= np.median(np.linalg.norm(centers + shift, axis=1))
    return matrix


def _principal_axes(points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "4 4"]:
    """Return the transform that maps the median of the points to the origin, and their principal axes to x, y and z.

    The longest axis maps to x, and the shortest axis to z.
    """
    center = np.median(points, axis=0)
    covariance = np.cov(points - center, rowvar=False)
    if not np.isfinite(covariance).all():
        raise InputError(
            "gsplat's normalization cannot be computed, because the points of the COLMAP project are too far away. "
            "Give the transform as a file with --world-transform."
        )
    axes = np.linalg.eigh(covariance)[1][:, ::-1].copy()
    if np.linalg.det(axes) < 0:
        axes[:, 0] *= -1
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = axes.T, -axes.T @ center
    return matrix
