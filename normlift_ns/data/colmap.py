"""Readers for COLMAP reconstructions in text and binary format."""

from __future__ import annotations

import struct
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from normlift_ns.data.frames import FISHEYE_MODELS, PERSPECTIVE_MODELS, Frame, Intrinsics, find_images, find_masks
from normlift_ns.data.transforms import CameraFile, relative_name
from normlift_ns.errors import InputError
from normlift_ns.io.guard import read_file

CAMERA_MODELS = {
    "SIMPLE_PINHOLE": "f cx cy",
    "PINHOLE": "fx fy cx cy",
    "SIMPLE_RADIAL": "f cx cy k1",
    "RADIAL": "f cx cy k1 k2",
    "OPENCV": "fx fy cx cy k1 k2 p1 p2",
    "OPENCV_FISHEYE": "fx fy cx cy k1 k2 k3 k4",
    "FULL_OPENCV": "fx fy cx cy k1 k2 p1 p2 k3 k4 k5 k6",
    "FOV": "fx fy cx cy omega",
    "SIMPLE_RADIAL_FISHEYE": "f cx cy k1",
    "RADIAL_FISHEYE": "f cx cy k1 k2",
    "THIN_PRISM_FISHEYE": "fx fy cx cy k1 k2 p1 p2 k3 k4 sx1 sy1",
    "RAD_TAN_THIN_PRISM_FISHEYE": "fx fy cx cy k0 k1 k2 k3 k4 k5 p0 p1 s0 s1 s2 s3",
    "SIMPLE_DIVISION": "f cx cy k",
    "DIVISION": "fx fy cx cy k",
    "SIMPLE_FISHEYE": "f cx cy",
    "FISHEYE": "fx fy cx cy",
    "EUCM": "fx fy cx cy alpha beta",
    "EQUIRECTANGULAR": "w h",
}
"""Names of the parameters of COLMAP's camera models. The models are in the order of their IDs in binary files."""
_MODELS = (*PERSPECTIVE_MODELS, *FISHEYE_MODELS)
_SIMPLE_IF_ZERO = {
    "FULL_OPENCV": ("k4", "k5", "k6"),
    "FOV": ("omega",),
    "THIN_PRISM_FISHEYE": ("p1", "p2", "sx1", "sy1"),
    "SIMPLE_DIVISION": ("k",),
    "DIVISION": ("k",),
}
"""Camera models that `Intrinsics` can represent only if these parameters are zero."""
_MAX_SIDE, _MAX_VALUE = 2**16, 1e30
_MODEL_FOLDERS = ("sparse/0", "sparse", "colmap/sparse/0", "colmap/sparse")
_ADVICE = "Copy the reconstruction again, or rewrite it with: colmap model_converter"


def find_colmap_model(folder: Path, say: Callable[[str], None] = lambda text: None) -> Path:
    """Return the folder of a COLMAP reconstruction: the given folder, or a subfolder such as sparse/0.

    If the folder itself is not a reconstruction, and several subfolders are, return the one with the most images.

    Args:
        folder: Folder of the project or of the reconstruction.
        say: Function that is called with a message if several subfolders are reconstructions.
    Raises:
        FileNotFoundError: The folder does not exist, or neither it nor one of the subfolders is a reconstruction.
    """
    if not folder.is_dir():
        raise FileNotFoundError(
            f"{folder} is not an existing folder. Give the folder of a COLMAP project, such as one with images/ and "
            "sparse/0."
        )
    if _is_model(folder):
        return folder
    places = [folder / name for name in _MODEL_FOLDERS]
    numbered = [other for place in (folder, *places) if place.is_dir() for other in sorted(place.iterdir())]
    models = list(filter(_is_model, dict.fromkeys([*places, *(other for other in numbered if other.name.isdigit())])))
    if len(models) == 0:
        raise FileNotFoundError(
            f"{folder} contains no COLMAP reconstruction: cameras.bin and cameras.txt are missing from it and from "
            f"its {', '.join(_MODEL_FOLDERS)}. Give the folder that contains sparse/0."
        )
    if len(models) == 1:
        return models[0]
    counts = {model: _count_images(model) for model in models}
    largest = max(models, key=counts.__getitem__)
    listed = ", ".join(f"{relative_name(model, folder)} (images: {count:,})" for model, count in counts.items())
    say(
        f"{folder} contains several reconstructions: {listed}. The largest one, {relative_name(largest, folder)}, is "
        "used. To use another one, give its folder instead."
    )
    return largest


def _is_model(folder: Path) -> bool:
    return any((folder / f"cameras.{suffix}").is_file() for suffix in ("bin", "txt"))


def _count_images(model: Path) -> int:
    """Return the number of registered images of a reconstruction; 0 if it cannot be read."""
    try:
        return len(_read(model, "images", _images_text, _images_binary))
    except (InputError, OSError):
        return 0


class ColmapCamera(NamedTuple):
    """Camera as stored in a COLMAP file."""

    camera_id: int
    model: str
    width: int
    height: int
    params: tuple[float, ...]

    def named_parameters(self) -> dict[str, float]:
        """Return the parameters by name; a shared focal length becomes fx and fy.

        The model must be one of `CAMERA_MODELS`.
        """
        values = dict(zip(CAMERA_MODELS[self.model].split(), self.params))
        return {"fx": values["f"], "fy": values.pop("f"), **values} if "f" in values else values


class ColmapImage(NamedTuple):
    """Registered image as stored in a COLMAP file, with a world-to-camera pose in OpenCV convention."""

    image_id: int
    name: str
    rotation: list[float]
    """Rotation from world to camera, as a quaternion (w, x, y, z)."""
    translation: list[float]
    camera_id: int


def read_colmap_model(model: Path, *, text_first: bool = False) -> tuple[dict[int, ColmapCamera], list[ColmapImage]]:
    """Read a reconstruction, and return its cameras by ID and its registered images in file order.

    Args:
        model: Folder of the reconstruction.
        text_first: True to prefer text files, as nerfstudio does; False to prefer binary files, as COLMAP does.
    Raises:
        FileNotFoundError: A file is missing.
        ValueError: A file is damaged, or contains duplicate IDs, invalid image sizes, camera parameters or poses, no
            images, or an image without its camera.
    """
    as_text = text_first and (model / "cameras.txt").exists()
    cameras = _check_cameras(_read(model, "cameras", _cameras_text, _cameras_binary, as_text), model)
    images = _read(model, "images", _images_text, _images_binary, as_text)
    _check_images(images, cameras, model)
    return cameras, images


def _check_cameras(listed: list[ColmapCamera], model: Path) -> dict[int, ColmapCamera]:
    """Return the cameras by ID; raise InputError for duplicate IDs and invalid sizes or parameters."""
    cameras: dict[int, ColmapCamera] = {}
    for camera in listed:
        if camera.camera_id in cameras:
            raise InputError(f"{model}: camera {camera.camera_id} occurs twice. {_ADVICE}")
        if not (0 < camera.width <= _MAX_SIDE and 0 < camera.height <= _MAX_SIDE):
            raise InputError(
                f"{model}: camera {camera.camera_id} has {camera.width:.6g} x {camera.height:.6g} pixels. Expected "
                f"1 to {_MAX_SIDE:,} pixels along a side. {_ADVICE}"
            )
        if not (np.abs(camera.params) < _MAX_VALUE).all():
            raise InputError(
                f"{model}: camera {camera.camera_id} has the parameters {camera.params}. Expected finite numbers "
                f"between {-_MAX_VALUE:g} and {_MAX_VALUE:g}. {_ADVICE}"
            )
        cameras[camera.camera_id] = camera
    return cameras


def _check_images(images: list[ColmapImage], cameras: Mapping[int, ColmapCamera], model: Path) -> None:
    """Raise InputError unless there are images, and each has a valid pose, a camera and a unique ID."""
    for image in images:
        pose = np.array([*image.rotation, *image.translation])
        if not (np.abs(pose) < _MAX_VALUE).all() or not np.any(pose[:4]):
            raise InputError(
                f"{model}: {image.name} has the quaternion {image.rotation} and the translation {image.translation}. "
                f"Expected numbers between {-_MAX_VALUE:g} and {_MAX_VALUE:g}, and a quaternion that is not zero. "
                f"{_ADVICE}"
            )
    orphans = [image for image in images if image.camera_id not in cameras]
    if orphans or len(images) == 0:
        problem = (
            f"{orphans[0].name} refers to the missing camera {orphans[0].camera_id}"
            if orphans
            else "no image is registered"
        )
        raise InputError(
            f"{model} is incomplete: {problem} (cameras: {len(cameras)}, registered images: {len(images)}). Expected "
            "one or more images, each with its camera. Copy the whole reconstruction again, or run COLMAP again."
        )
    if len({image.image_id for image in images}) < len(images):
        raise InputError(f"{model} has two images with the same ID. {_ADVICE}")


def colmap_intrinsics(camera: ColmapCamera, model: Path) -> Intrinsics:
    """Return the intrinsics of a camera.

    Models in `_SIMPLE_IF_ZERO` are supported only if the parameters listed there are zero.

    Raises:
        ValueError: `normlift_ns` cannot undistort the images of this camera.
    """
    parameters: dict[str, Any] = {}
    if camera.model in (*_MODELS, *_SIMPLE_IF_ZERO):
        parameters = camera.named_parameters()
    extra = {name: parameters.pop(name) for name in _SIMPLE_IF_ZERO.get(camera.model, ())}
    if len(parameters) == 0 or any(extra.values()):
        numbers = "".join(f", {name} = {value:g}" for name, value in extra.items())
        raise InputError(
            f"{model}: camera {camera.camera_id} has the model {camera.model}{numbers}, expected one of "
            f"{', '.join(_MODELS)}. Keep the splat, undistort the images, and give the folder that this "
            f"command writes: colmap image_undistorter --image_path IMAGES --input_path {model} --output_path new"
        )
    lens = Intrinsics(**parameters, width=camera.width, height=camera.height)  # pyrefly: ignore[bad-argument-type]
    return lens.as_fisheye() if "FISHEYE" in camera.model else lens


def colmap_pose(image: ColmapImage) -> Float[np.ndarray, "3 4"]:
    """Return the camera-to-world pose of an image in OpenGL convention."""
    from scipy.spatial.transform import Rotation  # noqa: PLC0415 (nerfstudio runs do not need SciPy)

    matrix = Rotation.from_quat(np.roll(image.rotation, -1)).as_matrix()  # SciPy has w last
    return np.concatenate([matrix.T * [1.0, -1.0, -1.0], -matrix.T @ np.array(image.translation)[:, None]], axis=1)


def read_colmap(folder: Path, images: Path | None, masks: Path | None, *, advice: str) -> CameraFile:
    """Read the cameras of a COLMAP project, and find its images.

    Args:
        folder: Absolute path of the project.
        images: Folder of the images; None for images/ in the project.
        masks: Folder of the masks; None for no masks.
        advice: Advice on missing images, for error messages.
    Raises:
        FileNotFoundError: The reconstruction, an image or a mask is missing.
        ValueError: As in `read_colmap_model` and `colmap_intrinsics`. Also if text and binary files differ, or two
            images share a file or a mask.
    """
    remarks: list[str] = []
    model = find_colmap_model(folder, remarks.append)
    cameras, registered = read_colmap_model(model)
    _check_formats(cameras, registered, model)
    registered.sort(key=lambda image: image.name)  # trainers use this order
    intrinsics = {camera_id: colmap_intrinsics(camera, model) for camera_id, camera in cameras.items()}
    images_dir = (images or folder / "images").absolute()
    if not images_dir.is_dir():
        raise FileNotFoundError(
            f"The image folder {images_dir} does not exist. Copy the images to this path, or {advice}."
        )
    names = [image.name for image in registered]
    files = find_images(names, images_dir, model, advice, allow_copies=True)
    mask_files = [None] * len(files) if masks is None else find_masks(names, masks)
    base = folder if images_dir.is_relative_to(folder) else images_dir.parent
    frames = [
        Frame(file, relative_name(file, base), colmap_pose(image), intrinsics[image.camera_id], mask)
        for image, file, mask in zip(registered, files, mask_files)
    ]
    return CameraFile(frames, frozenset(), model, folder, base, remarks=tuple(remarks))


def _check_formats(cameras: Mapping[int, ColmapCamera], images: Sequence[ColmapImage], model: Path) -> None:
    """Raise InputError if a reconstruction has different cameras or poses in its text files and its binary files."""
    if not all((model / f"{name}.{suffix}").is_file() for name in ("cameras", "images") for suffix in ("bin", "txt")):
        return
    others, other_images = read_colmap_model(model, text_first=True)

    def numbers(cameras: Mapping[int, ColmapCamera], images: Sequence[ColmapImage]) -> dict[str, list[float]]:
        found = {}
        for image in images:
            camera, turned = cameras[image.camera_id], np.outer(image.rotation, image.rotation)  # equal for q and -q
            found[image.name] = [camera.width, camera.height, *camera.params, *turned.ravel(), *image.translation]
        return found

    first, second = numbers(cameras, images), numbers(others, other_images)
    differ = [
        name
        for name in {**first, **second}
        if not (name in first and name in second and len(first[name]) == len(second[name]))
        or not np.allclose(first[name], second[name], rtol=1e-4, atol=1e-4)
    ]
    if len(differ) > 0:
        raise InputError(
            f"{model} is contradictory: its .bin and .txt files differ in the camera of {differ[0]} (number of such "
            f"images: {len(differ)} of {len({**first, **second})}). COLMAP and gsplat read the .bin files; nerfstudio "
            "reads the .txt files. Keep only those that the splat was trained with: "
            f"rm {model / '*.txt'}, or rm {model / '*.bin'}"
        )


def read_colmap_points(model: Path) -> Float[np.ndarray, "n 3"]:
    """Return the points of a reconstruction, sorted by their IDs.

    Raises:
        FileNotFoundError: The points3D file is missing.
        ValueError: The file is damaged, or contains points that are not finite.
    """
    positions = dict(_read(model, "points3D", _points_text, _points_binary))
    points = np.array([positions[point_id] for point_id in sorted(positions)], dtype=np.float64).reshape(-1, 3)
    if not np.isfinite(points).all():
        raise InputError(f"{model}: points3D has coordinates that are NaN or infinite. {_ADVICE}")
    return points


def _read(
    model: Path,
    name: str,
    parse_text: Callable[[list[str]], Iterator[Any]],
    parse_binary: Callable[[_ByteReader], Iterator[Any]],
    as_text: bool = False,
) -> list[Any]:
    path = model / f"{name}.bin"
    if as_text or not path.is_file():
        path = model / f"{name}.txt"
    if not path.is_file():
        found = f"has cameras.txt, but not {name}.txt" if as_text else f"has neither {name}.bin nor {name}.txt"
        raise FileNotFoundError(
            f"{model} {found}. Expected cameras, images and points3D, as COLMAP's mapper writes them. Copy the whole "
            "reconstruction again."
        )
    try:
        if path.suffix == ".bin":
            data = _ByteReader(read_file(path, max_bytes=2**34))
            entries = list(parse_binary(data))
            if data.offset != len(data.data):
                raise InputError(f"it has data after its last entry (bytes: {len(data.data) - data.offset:,})")
            return entries
        lines = [line.strip() for line in read_file(path, max_bytes=2**34).decode("utf-8-sig").splitlines()]
        return list(parse_text([line for line in lines if not line.startswith("#")]))
    except (ValueError, IndexError, struct.error, KeyError, OverflowError) as error:
        raise InputError(f"{path} is damaged or not a COLMAP file ({error}). {_ADVICE}") from error


class _ByteReader:
    """Sequential reader of little-endian binary data."""

    def __init__(self, data: bytes) -> None:
        self.data, self.offset = data, 0

    def unpack(self, code: str) -> tuple[Any, ...]:
        values = struct.unpack_from(f"<{code}", self.data, self.offset)
        self.offset += struct.calcsize(f"<{code}")
        return values

    def string(self) -> str:
        end = self.data.index(b"\0", self.offset)
        value = self.data[self.offset : end].decode("utf8")
        self.offset = end + 1
        return value

    def skip(self, count: int) -> None:
        if self.offset + count > len(self.data):
            raise InputError(f"it ends after {len(self.data):,} bytes")
        self.offset += count

    def count(self) -> int:
        """Read the number of entries that follow; raise InputError if the data are too short for them.

        An entry has at least 8 bytes.
        """
        number = self.unpack("Q")[0]
        if number > len(self.data) // 8:
            raise InputError(f"it declares {number:,} entries, but has only {len(self.data):,} bytes")
        return number


def _cameras_binary(data: _ByteReader) -> Iterator[ColmapCamera]:
    for _ in range(data.count()):
        camera_id, model_id, width, height = data.unpack("iiQQ")
        if not 0 <= model_id < len(CAMERA_MODELS):
            raise InputError(f"camera {camera_id} has the unknown model ID {model_id}")
        name, parameters = list(CAMERA_MODELS.items())[model_id]
        yield ColmapCamera(camera_id, name, width, height, data.unpack(f"{len(parameters.split())}d"))


def _cameras_text(lines: list[str]) -> Iterator[ColmapCamera]:
    counts = {name: len(parameters.split()) for name, parameters in CAMERA_MODELS.items()}
    for line in filter(None, lines):
        camera_id, name, width, height, *parameters = line.split()
        if name in counts and len(parameters) != counts[name]:
            raise InputError(
                f"camera {camera_id} has the wrong number of parameters for {name}: {len(parameters)}, expected "
                f"{counts[name]}"
            )
        yield ColmapCamera(int(camera_id), name, int(width), int(height), tuple(map(float, parameters)))


def _images_binary(data: _ByteReader) -> Iterator[ColmapImage]:
    for _ in range(data.count()):
        image_id, *pose, camera_id = data.unpack("I7dI")
        name = data.string()
        data.skip(24 * data.unpack("Q")[0])
        yield ColmapImage(image_id, name, pose[:4], pose[4:], camera_id)


def _images_text(lines: list[str]) -> Iterator[ColmapImage]:
    iterator = iter(lines)
    for line in iterator:
        if line == "":
            continue
        points = next(iterator, "").split()  # the next line lists the image's points and may be empty
        if len(points) % 3 != 0 or not all(_is_number(point) for point in points[:9]):
            raise InputError(f"the line after {line.split()[-1]} does not list points as x, y and point ID")
        image_id, *values, camera_id, name = line.split(maxsplit=9)
        pose = list(map(float, values))
        yield ColmapImage(int(image_id), name, pose[:4], pose[4:], int(camera_id))


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True


def _points_binary(data: _ByteReader) -> Iterator[tuple[int, tuple[float, ...]]]:
    for _ in range(data.count()):
        point_id, *position = data.unpack("Q3d")
        data.skip(3 + 8)
        data.skip(8 * data.unpack("Q")[0])
        yield point_id, tuple(position)


def _points_text(lines: list[str]) -> Iterator[tuple[int, tuple[float, ...]]]:
    for line in filter(None, lines):
        point_id, x, y, z, *_ = line.split(maxsplit=4)
        yield int(point_id), (float(x), float(y), float(z))
