"""transforms.json: schema, cameras, and transforms between the world of the cameras and that of the splat."""

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
"""Largest side and largest area of an image, in pixels."""
_MAX_VALUE = 1e30
DISTORTION = ("k1", "k2", "k3", "k4", "p1", "p2")
_DISTORTION_VALUES = (*DISTORTION, "k5", "k6", "distortion_params")
_LEGACY_FLIP = [[0.0, 1.0, 0.0, 0.0], [1.0, 0.0, 0.0, 0.0], [0.0, 0.0, -1.0, 0.0]]
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
    """A frame, as stored in the file."""

    file_path: str
    transform_matrix: list[list[float]]
    mask_path: str | None = None


class TransformsEntries(CameraEntry, kw_only=True):
    """The contents of a transforms.json."""

    frames: list[FrameEntry]
    applied_transform: list[list[float]] | None = None
    applied_scale: float = 1.0
    orientation_override: Any = None
    train_filenames: list[str] | None = None
    val_filenames: list[str] | None = None
    test_filenames: list[str] | None = None

    @property
    def lists(self) -> dict[str, list[str] | None]:
        """The lists of files by split."""
        return {"train": self.train_filenames, "val": self.val_filenames, "test": self.test_filenames}

    def value(self, frame: FrameEntry, name: str) -> Any:
        """Return a parameter of a camera. As in nerfstudio, values for all frames take precedence over its own."""
        shared = getattr(self, name)
        return getattr(frame, name) if shared is None else shared

    def applied_rows(self, folder: Path) -> list[list[float]] | None:
        """Return the transform of the poses before they were stored, if any.

        As in nerfstudio, files of an old ns-process-data in a folder imply one without naming it.
        """
        is_legacy = self.applied_transform is None and (folder / "colmap/sparse/0").exists()
        return _LEGACY_FLIP if is_legacy else self.applied_transform


def read_json_file(path: Path, expected: str) -> Any:
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
    text = read_file(path, max_bytes=_MAX_JSON_BYTES).removeprefix(codecs.BOM_UTF8)
    try:
        return msgspec.json.decode(text)
    except (msgspec.DecodeError, ValueError, RecursionError) as error:
        invalid = next((word for word in ("NaN", "Infinity") if word.encode() in text), None)
        reason = str(error) if invalid is None else f"it contains {invalid}"
        raise InputError(f"{path} is not valid JSON ({reason}). Expected {expected}.") from error


def read_transforms_entries(path: Path) -> TransformsEntries:
    """Read and validate a transforms.json, without looking for its images.

    Raises:
        FileNotFoundError: if there is no such file.
        ValueError: if the file is not valid JSON, does not match the schema, or has no frames, invalid poses or
            invalid sizes.
    """
    expected = "a transforms.json of nerfstudio, instant-ngp or Blender's synthetic scenes"
    values = read_json_file(path, expected)
    try:
        entries = msgspec.convert(values, TransformsEntries)
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
        if not _is_matrix(frame.transform_matrix):
            raise InputError(
                f"{path}: the transform_matrix of {frame.file_path} is not 4 x 4 finite numbers. Expected a "
                "camera-to-world matrix."
            )
    return entries


def _is_matrix(rows: list[list[float]], bound: float = _MAX_VALUE) -> bool:
    """Return whether these are 3 or 4 rows of 4 numbers below a bound."""
    return len(rows) in (3, 4) and all(len(row) == 4 for row in rows) and bool((np.abs(rows) < bound).all())


def _check_numbers(entry: CameraEntry, source: str) -> None:
    """Raise if a size is not a whole number in range, a focal length not positive, or a number beyond float32."""
    for name, side in _given(entry, "w", "h"):
        if not (0 < side <= _MAX_SIDE and float(side).is_integer()):
            raise InputError(f"{source}: {name} is {side:g}, expected a whole number of pixels, 1 to {_MAX_SIDE:,}.")
    if (entry.w or 1) * (entry.h or 1) > _MAX_PIXELS:
        raise InputError(f"{source}: w and h are {entry.w:g} and {entry.h:g}, more than {_MAX_PIXELS:,} pixels in all.")
    for name, focal in _given(entry, "fl_x", "fl_y"):
        if not 0 < focal < _MAX_VALUE:
            raise InputError(f"{source}: {name} is {focal:g}, expected a positive number of pixels.")
    parameters = [(f"distortion_params[{i}]", value) for i, value in enumerate(entry.distortion_params or ())]
    for name, value in (*_given(entry, "cx", "cy", *DISTORTION), *parameters):
        if not abs(value) < _MAX_VALUE:
            raise InputError(f"{source}: {name} is {value:g}, expected a number that float32 can hold.")


def _given(entry: CameraEntry, *names: str) -> list[tuple[str, float]]:
    """Return the parameters of these names that an entry has."""
    return [(name, value) for name in names if (value := getattr(entry, name)) is not None]


_MIN_DETERMINANT = 1e-6


class CameraFile(NamedTuple):
    """Contents of a transforms.json or a COLMAP reconstruction."""

    frames: list[Frame]
    """All images, sorted by file, with cameras in the file's world."""
    held_out: frozenset[str]
    """Names of the images that the file excludes from the training; most files exclude none."""
    source: Path
    """The file, or the folder of the COLMAP reconstruction."""
    folder: Path
    """Folder of the dataset."""
    names_root: Path
    """Folder that image names are relative to."""
    applied_transform: Float[np.ndarray, "4 4"] | None = None
    """Transform from the world of the capture to that of the file, as ns-process-data applied it."""
    applied_scale: float = 1.0
    """Scale of `applied_transform`."""
    remarks: tuple[str, ...] = ()
    """Messages about the choices that the file left open, in whole sentences."""


def read_transforms(
    path: Path,
    images: Path | None = None,
    masks: Path | None = None,
    *,
    base: Path | None = None,
    advice: str = GIVE_IMAGES,
) -> CameraFile:
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
    """Return whether the file excludes each frame from the training. Like nerfstudio, reject lists of other files."""
    files = [root / plain_name(frame.file_path) for frame in entries.frames]
    for split, names in entries.lists.items():
        unknown = [name for name in names or () if root / plain_name(name) not in files]
        if unknown:
            raise InputError(
                f"{path}: its {split}_filenames list {unknown[0]}, which is not the file_path of any frame. Expected "
                "the same names in both."
            )
    if entries.train_filenames is not None:
        trained = {root / plain_name(name) for name in entries.train_filenames}
        return [file not in trained for file in files]
    excluded = {root / plain_name(name) for name in (*(entries.val_filenames or ()), *(entries.test_filenames or ()))}
    return [file in excluded for file in files]


def relative_name(file: Path, folder: Path) -> str:
    """Return the file relative to the folder, or unchanged if it lies elsewhere, with forward slashes."""
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
            f"{path} lists masks for some images, but none for {unmasked}. Expected one for each, or none."
        )
    files = [_find_mask(name, root, images) for name in names]
    missing = [name for name, file in zip(names, files) if file is None]
    if missing:
        raise FileNotFoundError(
            f"{len(missing)} of the {len(names)} masks that {path} lists are missing; the first is "
            f"{root / missing[0]}. Put them back, or next to the images if those were moved."
        )
    return [file.absolute() for file in files if file is not None]


def _find_mask(name: str, root: Path, images: Path | None) -> Path | None:
    """Find a mask at its path in the file, or in a folder of the same name inside or next to the image folder."""
    own, *ends = possible_paths(root, name)
    tail = Path(*Path(plain_name(str(own))).parts[-2:])
    moved = () if images is None else (images / relative_name(own, root), images / tail, images.parent / tail)
    return next((file for file in (own, *ends, *moved) if file.is_file()), None)


def _is_named_like(mask: Path, frame: FrameEntry) -> bool:
    """Return whether a mask has the name of its image, so that it cannot be the mask of a whole camera."""
    image = Path(plain_name(frame.file_path))
    return mask.stem in (image.name, image.stem)


_SAME = 1e-3
"""Largest difference of equal intrinsics: a fraction of the longer side of the image, or a distortion parameter."""


def _check_readings(entries: TransformsEntries, frame: FrameEntry, lens: Intrinsics, path: Path) -> None:
    """Raise if programs read different intrinsics, because two values of the file differ."""
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
        values = zip(("k1", "k2", "k3", "p1", "p2"), _distortion(entry, f"{path}: {frame.file_path}"))
        readings += [(name, label, value, _SAME) for name, value in values]
    for name, label, value, allowed in readings:
        first = found.setdefault(name, (label, value))
        if abs(first[1] - value) > allowed:
            differ.append((name, first, (label, value)))
    if len(differ) > 0:
        name, first, second = differ[0]
        kept, others = (", ".join(dict.fromkeys(item[i][0] for item in differ)) for i in (1, 2))  # type: ignore[index]
        raise InputError(
            f"{path} can be read in two ways: for {frame.file_path}, {name} is {first[1]:g} by {first[0]}, which "
            f"nerfstudio reads, and {second[1]:g} by {second[0]}, which other programs such as instant-ngp and Brush "
            f"read. Remove those that the splat was not trained with, and give the new file with --transforms: "
            f"jq 'del({others})' {path.name} > new.json, or jq 'del({kept})' {path.name} > new.json"
        )


def _readings(
    entry: CameraEntry, start: str, names: Sequence[str], lens: Intrinsics
) -> Iterator[tuple[str, str, float]]:
    """Yield parameters in pixels: name, place in the file and value."""
    for name, value in _given(entry, *names):
        if name.startswith("camera_angle"):
            if 0 < value < math.pi:
                side = lens.width if name.endswith("x") else lens.height
                yield f"fl_{name[-1]}", f"{start}{name}", 0.5 * side / math.tan(0.5 * value)
        else:
            yield name, f"{start}{name}", value


def _check_model(entries: TransformsEntries, frame: FrameEntry, path: Path) -> None:
    """Raise if there are two camera models, or one that cannot be undistorted."""
    models = [item.camera_model for item in (entries, frame) if item.camera_model is not None]
    if len(set(models)) > 1:
        raise InputError(
            f"{path} can be read in two ways: the camera_model is {models[0]}, but that of {frame.file_path} is "
            f"{models[1]}. Remove the one that the splat was not trained with: jq 'del(.frames[].camera_model)' "
            f"{path.name} > new.json, or jq 'del(.camera_model)' {path.name} > new.json"
        )
    model = "OPENCV_FISHEYE" if entries.value(frame, "is_fisheye") else [*models, "OPENCV"][0].upper()
    if model not in (*PERSPECTIVE_MODELS, "FULL_OPENCV", "PERSPECTIVE"):
        raise InputError(
            f"{path}: {frame.file_path}: the camera_model is {model}; supported models are "
            f"{', '.join(PERSPECTIVE_MODELS)}. Undistort the images, and give their cameras, in the same world."
        )


def _intrinsics(entries: TransformsEntries, frame: FrameEntry, file: Path, path: Path) -> Intrinsics:
    """Return the intrinsics of a frame.

    Raises:
        ValueError: if values of the file and of the frame, or focal lengths and angles of view, differ.
    """
    value, source = partial(entries.value, frame), f"{path}: {frame.file_path}"
    _check_model(entries, frame, path)
    size = (value("w"), value("h"))
    width, height = read_image_header(file).size if None in size else size
    angles = value("camera_angle_x"), value("camera_angle_y")
    for angle in angles:
        if angle is not None and not 0 < angle < math.pi:
            raise InputError(f"{source}: a camera_angle is {angle}, expected radians between 0 and pi.")
    fx, fy = _focal(value("fl_x"), angles[0], width), _focal(value("fl_y"), angles[1], height)
    if fx is None:
        raise InputError(f"{source} has neither fl_x nor camera_angle_x. Expected a focal length.")
    cx, cy = value("cx"), value("cy")
    is_shared = len(_given(entries, *_DISTORTION_VALUES)) > 0
    lens = Intrinsics(
        fx,
        fx if fy is None else fy,
        width / 2 if cx is None else cx,
        height / 2 if cy is None else cy,
        int(width),
        int(height),
        *_distortion(entries if is_shared else frame, source),
    )
    _check_readings(entries, frame, lens, path)
    return lens


def _focal(focal: float | None, angle: float | None, side: float) -> float | None:
    """Return a focal length in pixels: the given one, or that of an angle of view in radians."""
    return 0.5 * side / math.tan(0.5 * angle) if focal is None and angle is not None else focal


def _distortion(entry: CameraEntry, source: str) -> tuple[float, float, float, float, float]:
    """Return k1, k2, k3, p1, p2."""
    values = [getattr(entry, name) or 0.0 for name in DISTORTION]
    if entry.distortion_params is not None:
        values = [*entry.distortion_params, *[0.0] * 6][:6]
    k1, k2, k3, k4, p1, p2 = values
    others = [(name, number) for name, number in (("k4", k4), *_given(entry, "k5", "k6")) if number != 0]
    if others:
        name, number = others[0]
        raise InputError(
            f"{source} has the distortion {name} = {number:g}; only k1, k2, k3, p1 and p2 can be undistorted. "
            "Undistort the images, and give their cameras, in the same world."
        )
    return k1, k2, k3, p1, p2


def _applied_transform(entries: TransformsEntries, path: Path) -> Float[np.ndarray, "4 4"]:
    rows = entries.applied_rows(path.parent)
    matrix = np.eye(4)
    if rows is not None:
        if not _is_matrix(rows, math.inf):
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
    write_text_file(path, json.dumps(content, indent=1) + "\n")


def _entry(frame: Frame) -> dict[str, Any]:
    camera = frame.intrinsics
    pose = torch.from_numpy(np.concatenate([frame.pose, [[0.0, 0.0, 0.0, 1.0]]])).float().tolist()
    numbers = dict(zip(("fl_x", "fl_y", "cx", "cy", "w", "h", "k1", "k2", "k3", "p1", "p2"), camera))
    mask = {} if frame.mask is None else {"mask_path": str(frame.mask)}
    return {"file_path": str(frame.file), **mask, **numbers, "transform_matrix": pose}


_TOLERANCE = 1e-3
"""Largest deviation of a matrix from a similarity, because files round."""
_MAX_MATRIX_BYTES = 2**16
_EXPECTED_DATAPARSER = "the dataparser_transforms.json that ns-train wrote; copy it again from the run"
_EXPECTED_MATRIX = "4 x 4 numbers in JSON, .npy or .txt, or the dataparser_transforms.json of a nerfstudio run"


class _DataparserTransforms(msgspec.Struct):
    """nerfstudio's dataparser_transforms.json: p -> scale * (transform @ p) maps to the scene's world."""

    transform: list[list[float]]
    scale: float


def read_dataparser_transforms(path: Path) -> WorldTransform:
    """Read the dataparser_transforms.json of a nerfstudio run.

    Raises:
        FileNotFoundError: if there is no such file.
        ValueError: if the file does not hold a finite transform and a positive scale.
    """
    return _to_world(read_json_file(path, _EXPECTED_DATAPARSER), path)


def _to_world(values: Any, path: Path) -> WorldTransform:
    try:
        stored = msgspec.convert(values, _DataparserTransforms)
    except (msgspec.ValidationError, RecursionError, OverflowError) as error:
        raise InputError(f"{path} does not hold a transform ({error}). Expected {_EXPECTED_DATAPARSER}.") from error
    rows = stored.transform
    if not _is_matrix(rows) or not 0 < stored.scale < _MAX_VALUE:
        raise InputError(
            f"{path} does not hold a transform: {len(rows)} rows and scale {stored.scale:g}. Expected 3 rows of 4 "
            f"finite numbers and a positive scale: {_EXPECTED_DATAPARSER}."
        )
    return WorldTransform(np.array(rows[:3]), stored.scale)


def capture_transforms(run_dir: Path, identity: Mapping[str, Any]) -> tuple[WorldTransform, ...]:
    """Return the successive transforms from the world of the capture to that of a lifted run's Gaussians.

    Args:
        run_dir: folder of the lifted run.
        identity: identity of the scene; for a splat without a nerfstudio run, it stores the transform of its cameras.
    Raises:
        FileNotFoundError, ValueError: as in `read_dataparser_transforms`, also for `source_world` of the identity.
    """
    trained = read_dataparser_transforms(run_dir / "dataparser_transforms.json")
    source = identity.get("source_world")
    return (trained,) if source is None else (_to_world(source, run_dir / "splat.json"), trained)


def read_world_transform(
    path: Path, applied: Float[np.ndarray, "4 4"] | None = None, applied_scale: float = 1.0
) -> WorldTransform:
    """Read a similarity.

    Args:
        path: a 4 x 4 matrix in JSON, .npy or .txt, or a dataparser_transforms.json.
        applied, applied_scale: only used for a dataparser_transforms.json, which starts from the world of the capture:
            the transform from there to the world of the cameras, as their file states it.
    Raises:
        FileNotFoundError: if there is no such file.
        ValueError: if the file does not hold a similarity.
    """
    try:
        values = _read_values(path)
        if not isinstance(values, dict):
            return decompose_similarity(np.array(values, dtype=float), str(path))
    except InputError:
        raise
    except (TypeError, ValueError, EOFError, OverflowError, MemoryError, OSError, tokenize.TokenError) as error:
        raise InputError(f"{path} does not hold a transform ({error}). Expected {_EXPECTED_MATRIX}.") from error
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
    content = io.BytesIO(read_file(path))
    return (np.load(content, allow_pickle=False) if path.suffix == ".npy" else np.loadtxt(content)).tolist()


def decompose_similarity(matrix: Float[np.ndarray, "4 4"], source: str) -> WorldTransform:
    """Split a 4 x 4 matrix into scale and transform.

    Args:
        matrix: the matrix.
        source: its origin, for error messages.
    Raises:
        ValueError: if the matrix does not consist of a rotation, a scale and a translation.
    """
    if matrix.shape != (4, 4) or not (np.abs(matrix) < _MAX_VALUE).all():
        raise InputError(
            f"{source} has the shape {matrix.shape}, or its numbers are not finite. Expected {_EXPECTED_MATRIX}."
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
    """Recompute the normalization of a COLMAP project by gsplat's simple_trainer, which does not save it.

    The steps are those of its datasets/normalize.py and datasets/colmap.py (1.5). First, put the cameras upright around
    the origin at a median distance of 1. Then turn the points' principal axes to x, y and z, and flip the half with
    more points to the bottom.

    Args:
        frames: all registered images, sorted by name.
        points: points of the reconstruction, at least four.
    Raises:
        ValueError: if the normalization cannot be computed, or the trainer's formula mirrors the world.
    Returns:
        The trainer's similarity. That of a training may differ from it by half a turn about an axis: gsplat before 1.5
        did not flip, and the signs of the axes depend on the linear algebra library of the training.
    """
    poses = np.array([np.concatenate([frame.pose, [[0, 0, 0, 1]]]) for frame in frames]) * [1, -1, -1, 1]
    with np.errstate(all="ignore"):
        upright = _upright(poses)
    if not np.isfinite(upright).all():
        raise InputError(
            "gsplat's normalization cannot be computed from these cameras: all are at one point, or their up axes "
            "cancel out. Give --world-transform, or --gsplat-normalize False if the training used "
            "--no-normalize-world-space."
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
    return decompose_similarity(aligned, "the normalization")


def _apply(matrix: Float[np.ndarray, "4 4"], points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
    return points @ matrix[:3, :3].T + matrix[:3, 3]


def _upright(poses: Float[np.ndarray, "v 4 4"]) -> Float[np.ndarray, "4 4"]:
    """Return the transform that maps the cameras' mean up axis to -y and the point that they look at to the origin.

    Args:
        poses: camera-to-world matrices in OpenCV convention.
    """
    up = -poses[:, :3, 1].mean(axis=0)
    up /= np.linalg.norm(up)
    axis, cosine = np.cross(up, [0.0, -1.0, 0.0]), -up[1]
    if cosine > -1:
        skew = np.cross(np.eye(3), axis)
        rotation = np.eye(3) + skew + skew @ skew / (1 + cosine)
    else:
        rotation = np.diag([-1.0, 1.0, 1.0])  # mirrors, as gsplat's code does
    centers, forward = poses[:, :3, 3] @ rotation.T, poses[:, :3, 2] @ rotation.T
    nearest = centers - (forward * centers).sum(axis=1)[:, None] * forward  # points of viewing rays nearest the origin
    shift = -np.median(nearest, axis=0)
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = rotation, shift
    matrix[:3] /= np.median(np.linalg.norm(centers + shift, axis=1))
    return matrix


def _principal_axes(points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "4 4"]:
    """Return the transform that maps the points' median to the origin, their widest axis to x, their narrowest to z."""
    center = np.median(points, axis=0)
    covariance = np.cov(points - center, rowvar=False)
    if not np.isfinite(covariance).all():
        raise InputError("gsplat's normalization cannot be computed: the points of the project are too far away.")
    axes = np.linalg.eigh(covariance)[1][:, ::-1].copy()
    if np.linalg.det(axes) < 0:
        axes[:, 0] *= -1
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = axes.T, -axes.T @ center
    return matrix
