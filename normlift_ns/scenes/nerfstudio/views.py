"""Undistorted images and cameras of a run, exactly as splatfacto trained on them."""

from __future__ import annotations

from collections.abc import Iterator
from functools import cached_property, lru_cache
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float, UInt8
from PIL import Image
from torch import Tensor

from normlift_ns.core.gaussians import Camera
from normlift_ns.core.scene import View
from normlift_ns.errors import InputError
from normlift_ns.scenes import photographs
from normlift_ns.scenes.frames import Intrinsics
from normlift_ns.scenes.image_files import check_mask, read_head, remarks
from normlift_ns.scenes.nerfstudio.splits import Photographs
from normlift_ns.scenes.photographs import to_camera

_SUPPORTED_MODES = {"RGB", "RGBA", "L", "CMYK"}
"""Pillow modes that nerfstudio can train on, CMYK with wrong colors."""
_DISTORTION_PARAMS = 6
"""Number of parameters k1, k2, k3, k4, p1, p2."""


class Reading(NamedTuple):
    """Settings by which nerfstudio reads the images of a run."""

    scale: float = 1.0
    """camera_res_scale_factor."""
    alpha_color: tuple[float, float, float] | None = None
    """RGB in 0..1 that nerfstudio blends behind images with an alpha channel when it reads them; None: it blends the
    background later."""
    mask_color: tuple[float, float, float] | None = None
    """Color that nerfstudio writes into pixels whose mask is zero."""


class _Lens(NamedTuple):
    """Projection of one image, in nerfstudio's precision."""

    kind: str
    intrinsics: Intrinsics
    distortion: tuple[float, ...]


class TrainedViews:
    """Lazy `Views` of one split of a dataset, in its order: indexing reads and undistorts one image.

    Images, masks and intrinsics are those of nerfstudio's `FullImageDatamanager.cached_train`, which holds all of them
    in memory (and pins that memory, which needs CUDA).

    Args:
        split: image files and cameras, before undistortion.
        folder: folder of the dataset, to which `names` are relative.
        poses: camera-to-world poses [V, 3, 4] in OpenGL convention: the split's, or those optimized by the training.
        background: RGB in 0..1, blended behind images with an alpha channel.
        reading: other settings of the config that affect pixels.
    """

    def __init__(
        self,
        split: Photographs,
        folder: Path,
        poses: Float[Tensor, "v 3 4"],
        background: Float[Tensor, " 3"],
        reading: Reading,
    ) -> None:
        self._split, self._poses, self._background, self._reading = split, poses, background, reading
        self.files = list(split.files)
        """Absolute paths of the images."""
        self.names = [image_name(file, folder) for file in self.files]
        """Image files relative to the dataset, with forward slashes."""

    def __len__(self) -> int:
        return len(self.files)

    def __iter__(self) -> Iterator[View]:
        return (self[i] for i in range(len(self)))

    def __getitem__(self, index: int) -> View:
        """Read and undistort one image.

        Raises:
            IndexError: if there is no such view.
            FileNotFoundError, ValueError: if a file is missing, cannot be read or differs in size from its camera; the
                message names it.
        """
        if not -len(self) <= index < len(self):
            raise IndexError(f"view {index} of {len(self)}")
        index %= len(self)
        lens = self._lens(index)
        pixels, mask_values = self._read(index)
        image = torch.from_numpy(_undistorted(pixels, lens)[0])
        mask = None if mask_values is None else torch.from_numpy(_undistorted_mask(mask_values, lens)).bool()
        if image.shape[2] == 4:
            alpha = image[:, :, 3:].float() / 255
            image = (alpha * image[:, :, :3] + (1 - alpha) * 255 * self._background).round().to(torch.uint8)
        original_size = (pixels.shape[1], pixels.shape[0]) if any(lens.distortion) else None
        return View(self.cameras[index], image, mask, self.names[index], original_size)

    @property
    def cameras(self) -> list[Camera]:
        """Cameras of the undistorted images; no image is read."""
        return self._cameras

    @cached_property
    def _cameras(self) -> list[Camera]:
        return [self._camera(i) for i in range(len(self))]

    def _camera(self, index: int) -> Camera:
        lens = self._lens(index)
        try:
            if lens.kind not in ("PERSPECTIVE", "FISHEYE"):
                raise InputError(
                    f"{self.files[index]} was taken with a {lens.kind} camera; splatfacto supports only perspective "
                    "and fisheye cameras."
                )
            return to_camera(self._poses[index], *_pinhole(lens))
        except InputError as error:
            raise InputError(f"The camera of {self.files[index]} cannot be used: {error}") from error

    def _lens(self, index: int) -> _Lens:
        width, height = self._split.sizes[index].tolist()
        distortion = () if self._split.distortion is None else tuple(self._split.distortion[index].tolist())
        fx, fy, cx, cy = self._split.intrinsics[index].tolist()
        return _Lens(self._split.kind, Intrinsics(fx, fy, cx, cy, width, height), distortion)

    def check_files(self) -> tuple[str, ...]:
        """Check the headers of all images and masks, and return warnings in whole sentences.

        Raises:
            FileNotFoundError, ValueError: if an image or mask is missing, not an image, misread by nerfstudio, or not
                of the size of its camera or image; the message names it.
        """
        headers, scale = [read_head(file) for file in self.files], self._reading.scale
        for index, (file, header) in enumerate(zip(self.files, headers)):
            if header.mode not in _SUPPORTED_MODES:
                raise InputError(
                    f"{file} has the pixel format {header.mode}, whose values nerfstudio misreads. Expected 8-bit RGB, "
                    "RGBA or grayscale; convert the images, and train again."
                )
            self._check_size(index, header.size if scale == 1 else _scaled(header.size, scale))
            if self._split.masks is not None:
                check_mask(self._split.masks[index], file, header.size)
        return remarks(self.files, headers)

    def _check_size(self, index: int, size: tuple[int, int]) -> None:
        expected = self._split.sizes[index].tolist()
        if list(size) != expected:
            raise InputError(
                f"{self.files[index]} is {size[0]} x {size[1]} pixels, but its camera has {expected[0]} x "
                f"{expected[1]} (width x height). Use the images that the run was trained with."
            )

    def _read(self, index: int) -> tuple[Any, Bool[np.ndarray, "h w"] | None]:
        """Read pixels and mask like nerfstudio's `InputDataset`."""
        file, masks = self.files[index], self._split.masks
        try:
            image = self._pixels(file)
            mask = None if masks is None else _mask(masks[index], self._reading.scale)
            if mask is not None and mask.shape != image.shape[:2]:
                raise InputError(f"the mask has shape {mask.shape}, the image {image.shape[:2]}")
        except FileNotFoundError as error:
            raise FileNotFoundError(
                f"{error.filename} is missing, but the dataset lists it. Put it back, or give the path of the dataset "
                "with --data."
            ) from error
        except Exception as error:  # Pillow's readers raise any kind of exception on a damaged file
            raise InputError(
                f"{file}{'' if masks is None else ' or its mask'} cannot be read ({error}). Expected an 8-bit image; "
                "copy it again from the capture."
            ) from error
        if self._reading.mask_color is not None and any(self._reading.mask_color) and mask is not None:
            filled = torch.ones(image.shape, dtype=torch.uint8) * torch.tensor(self._reading.mask_color)
            image = torch.where(torch.from_numpy(mask)[:, :, None], torch.from_numpy(image), filled).numpy()
        self._check_size(index, image.shape[1::-1])
        return image, mask

    def _pixels(self, file: Path) -> UInt8[np.ndarray, "h w c"]:
        with Image.open(file) as opened:
            scale = self._reading.scale
            resized = opened if scale == 1 else opened.resize(_scaled(opened.size, scale), Image.Resampling.BILINEAR)
            image = np.array(resized, dtype=np.uint8)
        if image.ndim == 2:
            image = image[:, :, None].repeat(3, axis=2)
        if image.ndim != 3 or image.shape[2] not in (3, 4):
            raise InputError(f"its shape is {image.shape}")
        if self._reading.alpha_color is None or image.shape[2] == 3:
            return image
        blended, color = torch.from_numpy(image), torch.tensor(self._reading.alpha_color)
        blended = blended[:, :, :3] * (blended[:, :, -1:] / 255.0) + 255.0 * color * (1.0 - blended[:, :, -1:] / 255.0)
        return torch.clamp(blended, min=0, max=255).to(torch.uint8).numpy()


def _scaled(size: tuple[int, int], scale: float) -> tuple[int, int]:
    return int(size[0] * scale), int(size[1] * scale)


def _mask(file: Path, scale: float) -> Bool[np.ndarray, "h w"]:
    with Image.open(file) as opened:
        resized = opened if scale == 1 else opened.resize(_scaled(opened.size, scale), Image.Resampling.NEAREST)
        return np.array(resized).astype(bool)


@lru_cache  # images of one camera differ only in their poses
def _pinhole(lens: _Lens) -> tuple[Float[Tensor, "3 3"], int, int]:
    """Return intrinsics, width and height of the undistorted image."""
    blank = np.zeros((lens.intrinsics.height, lens.intrinsics.width, 3), np.uint8)
    image, matrix = _undistorted(blank, lens)
    return torch.from_numpy(matrix).float(), image.shape[1], image.shape[0]


def _undistorted(image: Any, lens: _Lens) -> tuple[Any, Float[np.ndarray, "3 3"]]:
    """Undistort an image like `FullImageDatamanager`, and return it with its camera matrix."""
    if not any(lens.distortion):
        return photographs.undistorted(image, lens.intrinsics)
    try:
        if lens.kind == "PERSPECTIVE":
            return photographs.undistorted(image, _with_distortion(lens))
        matrix, coefficients, pinhole = _fisheye(lens)
        maps = cv2.fisheye.initUndistortRectifyMap(
            matrix, coefficients, np.eye(3), pinhole, image.shape[1::-1], cv2.CV_32FC1
        )
        pixels = cv2.remap(image, maps[0], maps[1], interpolation=cv2.INTER_LINEAR)
    except (InputError, cv2.error, ValueError) as error:
        raise InputError(f"its distortion {list(lens.distortion)} cannot be undistorted ({error})") from error
    shift = np.array([[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]])
    return pixels, np.asarray(pinhole) * [[1, 0, 1], [0, 1, 1], [0, 0, 1]] + shift


def _undistorted_mask(mask: Bool[np.ndarray, "h w"], lens: _Lens) -> UInt8[np.ndarray, "h w"]:
    values = mask.astype(np.uint8) * np.uint8(255)
    if not any(lens.distortion) or lens.kind == "PERSPECTIVE":
        return _undistorted(values[:, :, None], lens)[0][:, :, 0]
    matrix, coefficients, pinhole = _fisheye(lens)
    return cv2.fisheye.undistortImage(values, matrix, coefficients, None, pinhole)


def _with_distortion(lens: _Lens) -> Intrinsics:
    if len(lens.distortion) < _DISTORTION_PARAMS or lens.distortion[3] != 0:
        raise InputError("only k1, k2, k3, p1 and p2 can be undistorted")
    k1, k2, k3, _, p1, p2, *_ = lens.distortion
    return lens.intrinsics._replace(k1=k1, k2=k2, k3=k3, p1=p1, p2=p2)


def _fisheye(lens: _Lens) -> tuple[Any, Any, Any]:
    """Return camera matrix, coefficients and pinhole camera matrix, with pixel centers at integers."""
    fx, fy, cx, cy, width, height = lens.intrinsics[:6]
    matrix = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]], np.float32)
    matrix[:2, 2] -= 0.5
    if len(lens.distortion) < 4:
        raise InputError("a fisheye camera needs four distortion coefficients")
    coefficients = np.array(lens.distortion[:4], np.float32)
    pinhole = cv2.fisheye.estimateNewCameraMatrixForUndistortRectify(
        matrix, coefficients, (width, height), np.eye(3), balance=0
    )
    return matrix, coefficients, pinhole


def image_name(file: Path, folder: Path) -> str:
    """Return the file relative to its dataset's folder, or unchanged if it lies elsewhere, with forward slashes."""
    return (file.relative_to(folder) if file.is_relative_to(folder) else file).as_posix()
