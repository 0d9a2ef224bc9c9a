"""Photographs as splats are trained on them: undistorted, with the pinhole cameras that belong to them."""

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
    """An OpenGL pose (x right, y up, z backward) as an OpenCV camera, by splatfacto's own steps."""
    rotation = (camera_to_world[:, :3] * camera_to_world.new_tensor([1.0, -1.0, -1.0])).T
    pose = torch.eye(4, dtype=camera_to_world.dtype, device=camera_to_world.device)
    pose[:3, :3] = rotation
    pose[:3, 3] = -rotation @ camera_to_world[:, 3]
    return Camera(intrinsics.to(pose.device), pose, width, height)  # nerfstudio makes intrinsics on the CPU


class PhotographViews:
    """`Views`: photographs on the disk; each is read and undistorted when it is asked for.

    Undistortion is that of nerfstudio's FullImageDatamanager, so that a lifted run gives stock commands the same
    pictures: OpenCV's optimal new camera matrix without black borders, cropped to its region of interest.

    Args:
        background: RGB in 0..1 behind images with an alpha channel.
    """

    def __init__(self, frames: Sequence[Frame], background: Float[Tensor, " 3"]) -> None:
        self.frames = list(frames)
        """As the camera file describes them."""
        self.names = [frame.name for frame in frames]
        self._background = background

    def __len__(self) -> int:
        return len(self.frames)

    @property
    def cameras(self) -> list[Camera]:
        """All cameras, those of the undistorted images; reads no image."""
        return self._cameras

    @cached_property
    def _cameras(self) -> list[Camera]:
        return [_camera(frame) for frame in self.frames]

    def check_files(self) -> tuple[str, ...]:
        """Looks at the heads of all photographs; returns what a person should know, in whole sentences.

        Raises:
            FileNotFoundError, ValueError: a photograph that is missing, no image, or of more than 8 bits.
        """
        files = [frame.file for frame in self.frames]
        heads = [read_head(file) for file in files]
        for file, head in zip(files, heads):
            _check_mode(file, head.mode)
        return remarks(files, heads)

    def __getitem__(self, index: int) -> View:
        """Reads one photograph.

        Raises:
            IndexError: no such view.
            FileNotFoundError, ValueError: a file that is missing, cannot be read or has changed its size.
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
    matrix, width, height = without_distortion(frame.intrinsics)
    return to_camera(torch.from_numpy(frame.pose).float(), torch.from_numpy(matrix).float(), width, height)


@lru_cache  # photographs of one camera differ in their poses only
def without_distortion(intrinsics: Intrinsics) -> tuple[Float[np.ndarray, "3 3"], int, int]:
    """Camera matrix and size of the undistorted photograph."""
    if not any(intrinsics.distortion):
        return _matrix(intrinsics), intrinsics.width, intrinsics.height
    pixels, matrix = undistorted(np.empty((intrinsics.height, intrinsics.width, 1), np.uint8), intrinsics)
    return matrix, pixels.shape[1], pixels.shape[0]


def _matrix(intrinsics: Intrinsics) -> Float[np.ndarray, "3 3"]:
    """In the precision in which nerfstudio keeps it."""
    fx, fy, cx, cy = intrinsics[:4]
    return np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]], np.float32)


def undistorted(
    image: UInt8[np.ndarray, "h w c"], intrinsics: Intrinsics
) -> tuple[UInt8[np.ndarray, "h2 w2 c"], Float[np.ndarray, "3 3"]]:
    """The image without distortion, and its camera matrix."""
    matrix = _matrix(intrinsics)
    if not any(intrinsics.distortion):
        return image, matrix
    k1, k2, k3, p1, p2 = (float(np.float32(value)) for value in intrinsics.distortion)
    coefficients = np.array([k1, k2, p1, p2, k3, 0, 0, 0])
    matrix[:2, 2] -= 0.5  # OpenCV has pixel centres at whole numbers
    pinhole, (x, y, w, h) = cv2.getOptimalNewCameraMatrix(matrix, coefficients, image.shape[1::-1], 0)
    if w < 1 or h < 1:
        raise InputError(f"its distortion {intrinsics.distortion} leaves no pixel of the image")
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
            f"{frame.file} is missing, which the cameras name. Put it back, or say where the images are."
        ) from None
    except InputError:
        raise
    except Exception as error:  # Pillow's readers raise whatever a damaged file leads them to
        raise InputError(f"{frame.file} cannot be read ({error}). Copy it again from the capture.") from error
    found, expected = pixels.shape[1::-1], (frame.intrinsics.width, frame.intrinsics.height)
    if found != expected:
        raise InputError(
            f"{frame.file} is {found[0]} x {found[1]} pixels, its camera {expected[0]} x {expected[1]} (width x "
            "height). Use the images that the splat was trained with."
        )
    return pixels


def _check_mode(file: Path, mode: str) -> None:
    if mode[0] in "IF":
        raise InputError(
            f"{file} cannot be read: its pixels are of mode {mode}, expected 8 bits per channel. Convert the "
            "photographs to those that the splat was trained with."
        )


def _mask(frame: Frame) -> Bool[Tensor, "h w"] | None:
    if frame.mask is None:
        return None
    size = (frame.intrinsics.height, frame.intrinsics.width)
    try:
        with Image.open(frame.mask) as image:
            values = np.array(image)
    except Exception as error:  # as above
        raise InputError(f"The mask {frame.mask} cannot be read ({error}). Copy it again from the capture.") from error
    if values.shape != size:
        raise InputError(
            f"The mask {frame.mask} of {frame.file} has shape {values.shape}, expected {size}: one channel, as large "
            "as its image. Save it in grey."
        )
    kept = np.where(values != 0, np.uint8(255), np.uint8(0))[:, :, None]
    return torch.from_numpy(undistorted(kept, frame.intrinsics)[0][:, :, 0]).bool()
