"""Reconstructions of COLMAP, in its text and its binary files."""

from __future__ import annotations

import struct
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

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
_PLACES = ("", "sparse/0", "sparse", "colmap/sparse/0", "colmap/sparse")
_ADVICE = "Copy the reconstruction again, or write it anew with: colmap model_converter"


class ColmapImage(NamedTuple):
    """One registered image."""

    name: str
    pose: Float[np.ndarray, "3 4"]
    """Camera to world in OpenGL convention."""
    camera: int


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


def read_cameras(model: Path) -> dict[int, Intrinsics]:
    """Cameras by their numbers.

    Raises:
        FileNotFoundError, ValueError: no file, a damaged one, a camera model that cannot be undistorted here.
    """
    cameras = {}
    for number, name, width, height, parameters in _read(model, "cameras", _cameras_text, _cameras_binary):
        if name not in _MODELS:
            raise InputError(
                f"{model}: camera {number} has the model {name}; read are {', '.join(_MODELS)}. Undistort the images "
                "with: colmap image_undistorter, train the scene on those, and give that folder."
            )
        fx, fy, cx, cy, distortion = _MODELS[name](*parameters)
        cameras[number] = Intrinsics(fx, fy, cx, cy, width, height, **distortion)
    return cameras


def read_images(model: Path) -> list[ColmapImage]:
    """Registered images in the order of their names, as training tools sort them.

    Raises:
        FileNotFoundError, ValueError: no file, a damaged one, rotations of length zero.
    """
    images = []
    for name, rotation, translation, camera in _read(model, "images", _images_text, _images_binary):
        if not np.isfinite([*rotation, *translation]).all() or not np.any(rotation):
            raise InputError(
                f"{model}: the pose of {name} is not finite or has no rotation: {rotation} {translation}. {_ADVICE}"
            )
        matrix = Rotation.from_quat(np.roll(rotation, -1)).as_matrix()  # SciPy has w last
        pose = np.concatenate([matrix.T * [1.0, -1.0, -1.0], -matrix.T @ np.array(translation)[:, None]], axis=1)
        images.append(ColmapImage(name, pose, camera))
    return sorted(images, key=lambda image: image.name)


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
    model: Path, name: str, text: Callable[[list[str]], Iterator[Any]], binary: Callable[[_Bytes], Iterator[Any]]
) -> list[Any]:
    path = model / f"{name}.bin"
    try:
        if path.is_file():
            data = _Bytes(path.read_bytes())
            found = list(binary(data))
            data.end()
            return found
        path = model / f"{name}.txt"
        lines = [line.strip() for line in path.read_text("utf-8-sig").splitlines()]
        return list(text([line for line in lines if not line.startswith("#")]))
    except FileNotFoundError:
        raise FileNotFoundError(
            f"{model} has neither {name}.bin nor {name}.txt. Expected cameras, images and points3D, as COLMAP's mapper "
            f"writes them. {_ADVICE}"
        ) from None
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


def _cameras_binary(data: _Bytes) -> Iterator[tuple[int, str, int, int, tuple[float, ...]]]:
    for _ in range(data.count()):
        number, model, width, height = data.take("iiQQ")
        if not 0 <= model < len(_NUMBERED):
            raise InputError(f"camera {number} has the model number {model}, which is not known")
        name, count = _NUMBERED[model]
        yield number, name, width, height, data.take(f"{count}d")


def _cameras_text(lines: list[str]) -> Iterator[tuple[int, str, int, int, tuple[float, ...]]]:
    counts = dict(_NUMBERED)
    for line in filter(None, lines):
        number, name, width, height, *parameters = line.split()
        if name in counts and len(parameters) != counts[name]:
            raise InputError(f"camera {number} has {len(parameters)} parameters, {name} needs {counts[name]}")
        yield int(number), name, int(width), int(height), tuple(map(float, parameters))


def _images_binary(data: _Bytes) -> Iterator[tuple[str, list[float], list[float], int]]:
    for _ in range(data.count()):
        _, *pose, camera = data.take("I7dI")
        name = data.text()
        data.skip(24 * data.take("Q")[0])
        yield name, pose[:4], pose[4:], camera


def _images_text(lines: list[str]) -> Iterator[tuple[str, list[float], list[float], int]]:
    rest = iter(lines)
    for line in rest:
        if line == "":
            continue
        points = next(rest, "").split()  # of the image, in the line after it, which may be empty
        if len(points) % 3 != 0 or not all(_is_number(point) for point in points[:9]):
            raise InputError(f"the line after that of {line.split()[-1]} holds no points, as x, y and their numbers")
        _, qw, qx, qy, qz, tx, ty, tz, camera, name = line.split(maxsplit=9)
        yield name, list(map(float, (qw, qx, qy, qz))), list(map(float, (tx, ty, tz))), int(camera)


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
