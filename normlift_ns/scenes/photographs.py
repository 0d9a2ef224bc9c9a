"""Undistorted images, as splats are trained on them, with their pinhole cameras."""

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
from normlift_ns.errors import InputError
from normlift_ns.scenes.frames import Frame, Intrinsics
from normlift_ns.scenes.image_files import read_head, remarks


def to_camera(
    camera_to_world: Float[Tensor, "3 4"], intrinsics: Float[Tensor, "3 3"], width: int, height: int
) -> Camera:
    """Convert an OpenGL pose (x right, y up, z backward) to an OpenCV camera, by splatfacto's own steps."""
    rotation = (camera_to_world[:, :3] * camera_to_world.new_tensor([1.0, -1.0, -1.0])).T
    pose = torch.eye(4, dtype=camera_to_world.dtype, device=camera_to_world.device)
    pose[:3, :3] = rotation
    pose[:3, 3] = -rotation @ camera_to_world[:, 3]
    return Camera(intrinsics.to(pose.device), pose, width, height)  # nerfstudio keeps intrinsics on the CPU


class PhotographViews:
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
        headers = [read_head(file) for file in files]
        for file, header in zip(files, headers):
            _check_mode(file, header.mode)
        return remarks(files, headers)

    def __getitem__(self, index: int) -> View:
        """Read and undistort one image.

        Raises:
            IndexError: if there is no such view.
            FileNotFoundError, ValueError: if the file is missing, cannot be read or has changed its size.
        """
        if not -len(self) <= index < len(self):
            raise IndexError(f"view {index} of {len(self)}")
        frame = self.frames[index % len(self)]
        image = torch.from_numpy(undistorted(_read(frame), frame.intrinsics)[0])
        if image.shape[2] == 4:
            alpha = image[:, :, 3:].float() / 255
            image = (alpha * image[:, :, :3] + (1 - alpha) * 255 * self._background).round().to(torch.uint8)
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
    pixels, matrix = undistorted(np.empty((intrinsics.height, intrinsics.width, 1), np.uint8), intrinsics)
    return matrix, pixels.shape[1], pixels.shape[0]


def _matrix(intrinsics: Intrinsics) -> Float[np.ndarray, "3 3"]:
    """Return the camera matrix in nerfstudio's precision, float32."""
    fx, fy, cx, cy = intrinsics[:4]
    return np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]], np.float32)


def undistorted(
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
    return torch.from_numpy(undistorted(mask, frame.intrinsics)[0][:, :, 0]).bool()
