"""Reconstructions of COLMAP, in its text and its binary files."""

from __future__ import annotations

import struct
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from normlift_ns.errors import InputError
from normlift_ns.scenes.frames import Intrinsics

_MODELS = {
    "SIMPLE_PINHOLE": lambda f, cx, cy: (f, f, cx, cy, {}),
    "PINHOLE": lambda fx, fy, cx, cy: (fx, fy, cx, cy, {}),
    "SIMPLE_RADIAL": lambda f, cx, cy, k: (f, f, cx, cy, {"k1": k}),
    "RADIAL": lambda f, cx, cy, k1, k2: (f, f, cx, cy, {"k1": k1, "k2": k2}),
    "OPENCV": lambda fx, fy, cx, cy, k1, k2, p1, p2: (fx, fy, cx, cy, {"k1": k1, "k2": k2, "p1": p1, "p2": p2}),
}
"""fx, fy, cx, cy and distortion by the parameters of COLMAP's camera models."""
_NUMBERED = (
    ("SIMPLE_PINHOLE", 3), ("PINHOLE", 4), ("SIMPLE_RADIAL", 4), ("RADIAL", 5), ("OPENCV", 8), ("OPENCV_FISHEYE", 8),
    ("FULL_OPENCV", 12), ("FOV", 5), ("SIMPLE_RADIAL_FISHEYE", 4), ("RADIAL_FISHEYE", 5), ("THIN_PRISM_FISHEYE", 12),
    ("RAD_TAN_THIN_PRISM_FISHEYE", 16),
)  # fmt: skip
"""Names and numbers of parameters by the numbers in binary files."""
_LARGEST, _FARTHEST = 2**16, 1e30
_PLACES = ("", "sparse/0", "sparse", "colmap/sparse/0", "colmap/sparse")
_ADVICE = "Copy the reconstruction again, or write it anew with: colmap model_converter"


def model_folder(folder: Path) -> Path:
    """Where the reconstruction lies: in the folder itself, or in its sparse/0.

    Raises:
        FileNotFoundError: nowhere; the message names the places.
    """
    if not folder.is_dir():
        raise FileNotFoundError(
            f"There is no folder {folder}. Give the folder of the COLMAP project with --colmap, which holds images and "
            "sparse/0."
        )
    for place in _PLACES:
        if any((folder / place / f"cameras.{kind}").is_file() for kind in ("bin", "txt")):
            return folder / place
    raise FileNotFoundError(
        f"{folder} holds no reconstruction of COLMAP: no cameras.bin and no cameras.txt in it, nor in "
        f"{', '.join(_PLACES[1:])}. Give the folder that holds sparse/0 with --colmap."
    )


class Camera(NamedTuple):
    """One camera as it stands in the file."""

    number: int
    model: str
    width: int
    height: int
    parameters: tuple[float, ...]


class Registered(NamedTuple):
    """One registered image as it stands in the file: a world-to-camera pose in OpenCV convention."""

    number: int
    name: str
    rotation: list[float]
    """w, x, y, z."""
    translation: list[float]
    camera: int


def read_model(model: Path, *, text_first: bool = False) -> tuple[dict[int, Camera], list[Registered]]:
    """Cameras by their numbers, and registered images in the order of the file.

    Args:
        text_first: where there are both, take the text files, as nerfstudio does; else the binary ones, as COLMAP does.
    Raises:
        FileNotFoundError, ValueError: no file, a damaged one, numbers twice, sizes that no photograph has, poses that
            are not finite, no image at all, or an image whose camera is missing.
    """
    text = text_first and (model / "cameras.txt").exists()
    cameras: dict[int, Camera] = {}
    for camera in _read(model, "cameras", _cameras_text, _cameras_binary, text):
        if camera.number in cameras or not (0 < camera.width <= _LARGEST and 0 < camera.height <= _LARGEST):
            raise InputError(
                f"{model}: camera {camera.number} of {camera.width:.6g} x {camera.height:.6g} pixels stands there "
                f"twice, or has sides that are not 1 to {_LARGEST:,} pixels. {_ADVICE}"
            )
        if not (np.abs(camera.parameters) < _FARTHEST).all():
            raise InputError(f"{model}: camera {camera.number} has parameters {camera.parameters}. {_ADVICE}")
        cameras[camera.number] = camera
    images = _read(model, "images", _images_text, _images_binary, text)
    for image in images:
        pose = np.array([*image.rotation, *image.translation])
        if not (np.abs(pose) < _FARTHEST).all() or not np.any(pose[:4]):
            raise InputError(
                f"{model}: the pose of {image.name} is not finite or has no rotation: {image.rotation} "
                f"{image.translation}. {_ADVICE}"
            )
    lost = [image for image in images if image.camera not in cameras]
    if lost or len(images) == 0:
        what = f"{lost[0].name} was taken with camera {lost[0].camera}, which is missing" if lost else "no image"
        raise InputError(
            f"{model} has {len(cameras)} cameras and {len(images)} registered images: {what}. Expected a camera for "
            "every image; copy the whole reconstruction again."
        )
    if len({image.number for image in images}) < len(images):
        raise InputError(f"{model} has two images of the same number. {_ADVICE}")
    return cameras, images


def intrinsics_of(camera: Camera, model: Path) -> Intrinsics:
    """The projection of a camera.

    Raises:
        ValueError: a camera model that cannot be undistorted here.
    """
    if camera.model not in _MODELS:
        raise InputError(
            f"{model}: camera {camera.number} has the model {camera.model}; read are {', '.join(_MODELS)}. Undistort "
            "the images with: colmap image_undistorter, train the scene on those, and give that folder."
        )
    fx, fy, cx, cy, distortion = _MODELS[camera.model](*camera.parameters)
    return Intrinsics(fx, fy, cx, cy, camera.width, camera.height, **distortion)


def pose_of(image: Registered) -> Float[np.ndarray, "3 4"]:
    """Camera to world in OpenGL convention."""
    from scipy.spatial.transform import Rotation  # noqa: PLC0415 (runs of nerfstudio do without)

    matrix = Rotation.from_quat(np.roll(image.rotation, -1)).as_matrix()  # SciPy has w last
    return np.concatenate([matrix.T * [1.0, -1.0, -1.0], -matrix.T @ np.array(image.translation)[:, None]], axis=1)


def read_points(model: Path) -> Float[np.ndarray, "n 3"]:
    """The points of the reconstruction in the order of their numbers.

    Raises:
        FileNotFoundError, ValueError: no file, a damaged one, points that are not finite.
    """
    found = dict(_read(model, "points3D", _points_text, _points_binary))
    points = np.array([found[number] for number in sorted(found)], dtype=np.float64).reshape(-1, 3)
    if not np.isfinite(points).all():
        raise InputError(f"{model}: points3D has coordinates that are NaN or infinite. {_ADVICE}")
    return points


def _read(
    model: Path,
    name: str,
    text: Callable[[list[str]], Iterator[Any]],
    binary: Callable[[_Bytes], Iterator[Any]],
    as_text: bool = False,
) -> list[Any]:
    path = model / f"{name}.bin"
    if as_text or not path.is_file():
        path = model / f"{name}.txt"
    if not path.is_file():
        raise FileNotFoundError(
            f"{model} has neither {name}.bin nor {name}.txt. Expected cameras, images and points3D, as COLMAP's mapper "
            f"writes them. {_ADVICE}"
        )
    try:
        if path.suffix == ".bin":
            data = _Bytes(path.read_bytes())
            found = list(binary(data))
            data.end()
            return found
        lines = [line.strip() for line in path.read_text("utf-8-sig").splitlines()]
        return list(text([line for line in lines if not line.startswith("#")]))
    except (ValueError, IndexError, struct.error, KeyError, OverflowError) as error:
        raise InputError(f"{path} is damaged or no file of COLMAP ({error}). {_ADVICE}") from error


class _Bytes:
    """Numbers one after the other."""

    def __init__(self, data: bytes) -> None:
        self.data, self.at = data, 0

    def take(self, code: str) -> tuple[Any, ...]:
        values = struct.unpack_from(f"<{code}", self.data, self.at)
        self.at += struct.calcsize(f"<{code}")
        return values

    def text(self) -> str:
        end = self.data.index(b"\0", self.at)
        value = self.data[self.at : end].decode("utf8")
        self.at = end + 1
        return value

    def skip(self, count: int) -> None:
        if self.at + count > len(self.data):
            raise InputError(f"it ends after {len(self.data):,} bytes")
        self.at += count

    def count(self) -> int:
        """How many entries follow: each takes eight bytes or more, so that a damaged number shows at once."""
        number = self.take("Q")[0]
        if number > len(self.data) // 8:
            raise InputError(f"it says {number:,} entries, but has {len(self.data):,} bytes")
        return number

    def end(self) -> None:
        if self.at != len(self.data):
            raise InputError(f"{len(self.data) - self.at:,} bytes too many")


def _cameras_binary(data: _Bytes) -> Iterator[Camera]:
    for _ in range(data.count()):
        number, model, width, height = data.take("iiQQ")
        if not 0 <= model < len(_NUMBERED):
            raise InputError(f"camera {number} has the model number {model}, which is not known")
        name, count = _NUMBERED[model]
        yield Camera(number, name, width, height, data.take(f"{count}d"))


def _cameras_text(lines: list[str]) -> Iterator[Camera]:
    counts = dict(_NUMBERED)
    for line in filter(None, lines):
        number, name, width, height, *parameters = line.split()
        if name in counts and len(parameters) != counts[name]:
            raise InputError(f"camera {number} has {len(parameters)} parameters, {name} needs {counts[name]}")
        yield Camera(int(number), name, int(width), int(height), tuple(map(float, parameters)))


def _images_binary(data: _Bytes) -> Iterator[Registered]:
    for _ in range(data.count()):
        number, *pose, camera = data.take("I7dI")
        name = data.text()
        data.skip(24 * data.take("Q")[0])
        yield Registered(number, name, pose[:4], pose[4:], camera)


def _images_text(lines: list[str]) -> Iterator[Registered]:
    rest = iter(lines)
    for line in rest:
        if line == "":
            continue
        points = next(rest, "").split()  # of the image, in the line after it, which may be empty
        if len(points) % 3 != 0 or not all(_is_number(point) for point in points[:9]):
            raise InputError(f"the line after that of {line.split()[-1]} holds no points, as x, y and their numbers")
        number, *pose, camera, name = line.split(maxsplit=9)
        values = list(map(float, pose))
        yield Registered(int(number), name, values[:4], values[4:], int(camera))


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True


def _points_binary(data: _Bytes) -> Iterator[tuple[int, tuple[float, ...]]]:
    for _ in range(data.count()):
        number, *place = data.take("Q3d")
        data.skip(3 + 8)
        data.skip(8 * data.take("Q")[0])
        yield number, tuple(place)


def _points_text(lines: list[str]) -> Iterator[tuple[int, tuple[float, ...]]]:
    for line in filter(None, lines):
        number, x, y, z, *_ = line.split(maxsplit=4)
        yield int(number), (float(x), float(y), float(z))
