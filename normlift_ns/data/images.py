"""Training images, undistorted with their pinhole cameras, and the selection of those held out."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property, lru_cache
from pathlib import Path

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float, UInt8
from PIL import Image
from torch import Tensor

from normlift_ns.core.gaussians import Camera
from normlift_ns.core.scene import View
from normlift_ns.data.frames import Frame, Intrinsics, image_warnings, read_image_header
from normlift_ns.errors import InputError


def held_out_names(names: Sequence[str], *, test_every: int | None, holdout: Sequence[str]) -> frozenset[str]:
    """Return the names of the images that the training did not use.

    Args:
        names: sorted names of all images.
        test_every: hold out every n-th image, starting with the first, as gsplat's trainer does, and Inria's with
            --eval.
        holdout: image names, with or without folder and suffix; or a text file with one name per line; or a fraction
            below 1. As in ns-train's dataparser, the training images are then evenly spaced, and the rest is held out.
    Raises:
        ValueError: if no image has one of the names, or both options are given.
    """
    if test_every is not None and len(holdout) > 0:
        raise InputError("--test-every and --holdout both select held-out images; give only one of them")
    if test_every is not None:
        if test_every < 2:
            raise InputError(f"--test-every must be at least 2, got {test_every}; omit it if nothing was held out")
        return frozenset(names[::test_every])
    fraction = _fraction(holdout)
    if fraction is not None:
        trained = np.linspace(0, len(names) - 1, int(np.ceil(len(names) * (1 - fraction))), dtype=int)
        return frozenset(np.delete(np.array(names, dtype=object), trained).tolist())
    requested = list(holdout)
    if len(requested) == 1 and requested[0].endswith(".txt"):
        requested = _read_names(Path(requested[0]))
    return frozenset(name for request in requested for name in _matching(request, names))


def _fraction(holdout: Sequence[str]) -> float | None:
    if len(holdout) != 1:
        return None
    try:
        fraction = float(holdout[0])
    except ValueError:
        return None
    if fraction.is_integer() and not 0 <= fraction <= 1:
        return None  # an image name
    if not 0 < fraction < 1:
        raise InputError(
            f"--holdout {holdout[0]} is not a fraction: expected a number between 0 and 1, such as 0.1, or image names"
        )
    return fraction


def _read_names(file: Path) -> list[str]:
    """Read image names from a text file, one per line."""
    if not file.is_file():
        raise InputError(f"--holdout names the file {file}, which does not exist. Expected one image name per line.")
    try:
        names = [line.strip() for line in file.read_text("utf-8-sig").splitlines()]
    except UnicodeDecodeError as error:
        raise InputError(f"{file} is not UTF-8 text ({error}). Expected one image name per line.") from error
    if not any(names):
        raise InputError(f"{file} is empty. Expected the names of the held-out images, one per line.")
    return [name for name in names if name != ""]


def _matching(requested: str, names: Sequence[str]) -> list[str]:
    path = Path(requested)
    for short in (lambda name: name, lambda name: name.name, lambda name: name.with_suffix(""), lambda name: name.stem):
        matches = [name for name in names if str(short(Path(name))) == str(path)]
        if len(matches) > 1:
            raise InputError(
                f"--holdout {requested} matches {len(matches)} images: {', '.join(matches)}. Give full names."
            )
        if matches:
            return matches
    matches = [name for name in names if path.as_posix().endswith(f"/{name}")]
    if len(matches) != 1:
        raise InputError(
            f"--holdout names {requested}, but no image has this name; there are {len(names)}, "
            f"{names[0]} to {names[-1]}"
        )
    return matches


# Undistorted images, as splats are trained on them, with their pinhole cameras.


def to_camera(
    camera_to_world: Float[Tensor, "3 4"], intrinsics: Float[Tensor, "3 3"], width: int, height: int
) -> Camera:
    """Convert an OpenGL pose (x right, y up, z backward) to an OpenCV camera, by splatfacto's own steps."""
    rotation = (camera_to_world[:, :3] * camera_to_world.new_tensor([1.0, -1.0, -1.0])).T
    pose = torch.eye(4, dtype=camera_to_world.dtype, device=camera_to_world.device)
    pose[:3, :3] = rotation
    pose[:3, 3] = -rotation @ camera_to_world[:, 3]
    return Camera(intrinsics.to(pose.device), pose, width, height)  # nerfstudio keeps intrinsics on the CPU


def blend_background(image: UInt8[Tensor, "h w c"], background: Float[Tensor, " 3"]) -> UInt8[Tensor, "h w 3"]:
    """Return the image with the background, RGB in 0..1, behind its alpha channel if it has one."""
    if image.shape[2] != 4:
        return image
    alpha = image[:, :, 3:].float() / 255
    return (alpha * image[:, :, :3] + (1 - alpha) * 255 * background).round().to(torch.uint8)


class ImageViews:
    """Lazy `Views` of images on disk: indexing reads and undistorts one image.

    Undistortion is that of nerfstudio's FullImageDatamanager, with which stock commands see the same images: OpenCV's
    optimal new camera matrix without black borders, cropped to its region of interest.

    Args:
        frames: image files and their cameras.
        background: RGB in 0..1, blended behind images with an alpha channel.
    """

    def __init__(self, frames: Sequence[Frame], background: Float[Tensor, " 3"]) -> None:
        self.frames = list(frames)
        """The frames, as the camera file describes them."""
        self.names = [frame.name for frame in frames]
        self._background = background

    def __len__(self) -> int:
        return len(self.frames)

    @property
    def cameras(self) -> list[Camera]:
        """Cameras of the undistorted images; no image is read."""
        return self._cameras

    @cached_property
    def _cameras(self) -> list[Camera]:
        return [_camera(frame) for frame in self.frames]

    def check_files(self) -> tuple[str, ...]:
        """Check the headers of all images, and return warnings in whole sentences.

        Raises:
            FileNotFoundError, ValueError: if an image is missing, not an image, or has more than 8 bits per channel.
        """
        files = [frame.file for frame in self.frames]
        headers = [read_image_header(file) for file in files]
        for file, header in zip(files, headers):
            _check_mode(file, header.mode)
        return image_warnings(files, headers)

    def __getitem__(self, index: int) -> View:
        """Read and undistort one image.

        Raises:
            IndexError: if there is no such view.
            FileNotFoundError, ValueError: if the file is missing, cannot be read or has changed its size.
        """
        if not -len(self) <= index < len(self):
            raise IndexError(f"view {index} of {len(self)}")
        frame = self.frames[index % len(self)]
        pixels = torch.from_numpy(undistort_image(_read(frame), frame.intrinsics)[0])
        image = blend_background(pixels, self._background)
        size = (frame.intrinsics.width, frame.intrinsics.height) if any(frame.intrinsics.distortion) else None
        return View(self.cameras[index], image, _mask(frame), frame.name, size)


def _camera(frame: Frame) -> Camera:
    try:
        return _pinhole(frame)
    except (InputError, cv2.error) as error:
        raise InputError(f"The camera of {frame.file} cannot be used: {error}") from error


def _pinhole(frame: Frame) -> Camera:
    matrix, width, height = _undistorted_intrinsics(frame.intrinsics)
    return to_camera(torch.from_numpy(frame.pose).float(), torch.from_numpy(matrix).float(), width, height)


@lru_cache  # images of one camera differ only in their poses
def _undistorted_intrinsics(intrinsics: Intrinsics) -> tuple[Float[np.ndarray, "3 3"], int, int]:
    """Return the camera matrix, width and height of the undistorted image."""
    if not any(intrinsics.distortion):
        return _matrix(intrinsics), intrinsics.width, intrinsics.height
    pixels, matrix = undistort_image(np.empty((intrinsics.height, intrinsics.width, 1), np.uint8), intrinsics)
    return matrix, pixels.shape[1], pixels.shape[0]


def _matrix(intrinsics: Intrinsics) -> Float[np.ndarray, "3 3"]:
    """Return the camera matrix in nerfstudio's precision, float32."""
    fx, fy, cx, cy = intrinsics[:4]
    return np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]], np.float32)


def undistort_image(
    image: UInt8[np.ndarray, "h w c"], intrinsics: Intrinsics
) -> tuple[UInt8[np.ndarray, "h2 w2 c"], Float[np.ndarray, "3 3"]]:
    """Undistort an image, and return it with its camera matrix."""
    matrix = _matrix(intrinsics)
    if not any(intrinsics.distortion):
        return image, matrix
    k1, k2, k3, p1, p2 = (float(np.float32(value)) for value in intrinsics.distortion)
    coefficients = np.array([k1, k2, p1, p2, k3, 0, 0, 0])
    matrix[:2, 2] -= 0.5  # OpenCV puts pixel centers at integers
    pinhole, (x, y, w, h) = cv2.getOptimalNewCameraMatrix(matrix, coefficients, image.shape[1::-1], 0)
    if w < 1 or h < 1:
        raise InputError(f"undistortion with {intrinsics.distortion} leaves no pixel of the image")
    pixels = cv2.undistort(image, matrix, coefficients, None, pinhole)[y : y + h, x : x + w]
    fx, fy = pinhole[0, 0], pinhole[1, 1]
    cropped = np.array([[fx, 0, pinhole[0, 2] - x + 0.5], [0, fy, pinhole[1, 2] - y + 0.5], [0, 0, 1]])
    return np.ascontiguousarray(pixels.reshape(*pixels.shape[:2], -1)), cropped


def _read(frame: Frame) -> UInt8[np.ndarray, "h w c"]:
    try:
        with Image.open(frame.file) as image:
            _check_mode(frame.file, image.mode)
            mode = "RGBA" if image.mode in ("LA", "PA", "La") or "transparency" in image.info else "RGB"
            pixels = np.array(image if image.mode in (mode, "RGBA") else image.convert(mode), np.uint8)
    except FileNotFoundError:
        raise FileNotFoundError(
            f"{frame.file} is missing, but the camera file lists it. Put it back, or give the folder of the images."
        ) from None
    except InputError:
        raise
    except Exception as error:  # Pillow's readers raise any kind of exception on a damaged file
        raise InputError(f"{frame.file} cannot be read ({error}). Copy it again from the capture.") from error
    size, expected = pixels.shape[1::-1], (frame.intrinsics.width, frame.intrinsics.height)
    if size != expected:
        raise InputError(
            f"{frame.file} is {size[0]} x {size[1]} pixels, but its camera has {expected[0]} x {expected[1]} (width x "
            "height). Use the images that the splat was trained with."
        )
    return pixels


def _check_mode(file: Path, mode: str) -> None:
    if mode[0] in "IF":
        raise InputError(
            f"{file} cannot be read: its pixel format is {mode}, expected 8 bits per channel. Convert the images to "
            "those that the splat was trained with."
        )


def _mask(frame: Frame) -> Bool[Tensor, "h w"] | None:
    if frame.mask is None:
        return None
    size = (frame.intrinsics.height, frame.intrinsics.width)
    try:
        with Image.open(frame.mask) as image:
            values = np.array(image)
    except Exception as error:  # as in _read
        raise InputError(f"The mask {frame.mask} cannot be read ({error}). Copy it again from the capture.") from error
    if values.shape != size:
        raise InputError(
            f"The mask {frame.mask} of {frame.file} has shape {values.shape}, expected {size}: one channel of the same "
            "size as its image. Save it in grayscale."
        )
    mask = np.where(values != 0, np.uint8(255), np.uint8(0))[:, :, None]
    return torch.from_numpy(undistort_image(mask, frame.intrinsics)[0][:, :, 0]).bool()
