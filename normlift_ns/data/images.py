"""Views of image files, their undistortion to pinhole cameras, and the selection of held-out images."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from functools import cached_property, lru_cache
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float, UInt8
from PIL import Image
from torch import Tensor

from normlift_ns.core.gaussians import Camera
from normlift_ns.core.scene import View, Views
from normlift_ns.data.fisheye import filled_pixels, fisheye_pinhole, undistort_fisheye, undistort_labels
from normlift_ns.data.frames import Frame, ImageHeader, Intrinsics, check_mask, image_warnings, read_image_header
from normlift_ns.errors import InputError
from normlift_ns.io.guard import open_regular, protect_inputs, read_text


def held_out_names(names: Sequence[str], *, test_every: int | None, eval_images: Sequence[str]) -> frozenset[str]:
    """Return the names of the images that the training did not use.

    Args:
        names: Sorted names of all images.
        test_every: Interval of the held-out images, starting with the first image, as in gsplat's trainer and in
            Inria's trainer with --eval.
        eval_images: Image names with or without folder and suffix, a text file with one name per line, or the fraction
            of held-out images. For a fraction, the training images are evenly spaced, as in ns-train's data parser.
    Raises:
        ValueError: A name matches no image or several images, a value is invalid, or both arguments are given.
    """
    if test_every is not None and len(eval_images) > 0:
        raise InputError("--test-every and --eval-images cannot be combined; omit one of them")
    if test_every is not None:
        if test_every < 2:
            raise InputError(f"--test-every must be at least 2, got {test_every}; omit it if nothing was held out")
        return frozenset(names[::test_every])
    fraction = _fraction(eval_images)
    if fraction is not None:
        trained = np.linspace(0, len(names) - 1, int(np.ceil(len(names) * (1 - fraction))), dtype=int)
        return frozenset(np.delete(np.array(names, dtype=object), trained).tolist())
    requested = list(eval_images)
    if len(requested) == 1 and requested[0].endswith(".txt"):
        requested = _read_names(Path(requested[0]))
    return frozenset(name for request in requested for name in _matching(request, names))


def _fraction(eval_images: Sequence[str]) -> float | None:
    if len(eval_images) != 1:
        return None
    try:
        fraction = float(eval_images[0])
    except ValueError:
        return None
    if fraction.is_integer() and not 0 <= fraction <= 1:
        return None  # an image name
    if not 0 < fraction < 1:
        raise InputError(
            f"--eval-images {eval_images[0]} is not a valid fraction; give a number above 0 and below 1, or image names"
        )
    return fraction


def _read_names(file: Path) -> list[str]:
    """Read image names from a text file, one per line."""
    if not file.is_file():
        raise InputError(
            f"The file {file}, given with --eval-images, does not exist. Give a file with one name per line."
        )
    try:
        names = [line.strip() for line in read_text(file, "utf-8-sig").splitlines()]
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
                f"--eval-images {requested} matches {len(matches)} images; the first two are {matches[0]} and "
                f"{matches[1]}. Give the full name."
            )
        if matches:
            return matches
    matches = [name for name in names if path.as_posix().endswith(f"/{name}")]
    if len(matches) != 1:
        raise InputError(
            f"--eval-images {requested} matches {len(matches) or 'none'} of the {len(names)} images, expected one. "
            f"Give the name of an image, from {names[0]} to {names[-1]}."
        )
    return matches


def to_camera(
    camera_to_world: Float[Tensor, "3 4"], intrinsics: Float[Tensor, "3 3"], width: int, height: int
) -> Camera:
    """Convert an OpenGL pose (x right, y up, z backward) and intrinsics to an OpenCV camera, as splatfacto does."""
    rotation = (camera_to_world[:, :3] * camera_to_world.new_tensor([1.0, -1.0, -1.0])).T
    pose = torch.eye(4, dtype=camera_to_world.dtype, device=camera_to_world.device)
    pose[:3, :3] = rotation
    pose[:3, 3] = -rotation @ camera_to_world[:, 3]
    return Camera(intrinsics.to(pose.device), pose, width, height)  # nerfstudio keeps intrinsics on the CPU


def blend_background(image: UInt8[Tensor, "h w c"], background: Float[Tensor, " 3"]) -> UInt8[Tensor, "h w 3"]:
    """Blend an image with an alpha channel over a background color, RGB in 0..1; return other images unchanged."""
    if image.shape[2] != 4:
        return image
    alpha = image[:, :, 3:].float() / 255
    return (alpha * image[:, :, :3] + (1 - alpha) * 255 * background).round().to(torch.uint8)


_NERFSTUDIO_MODES = {"RGB", "RGBA", "L", "CMYK"}
"""Pillow modes that are accepted in the datasets of runs, because nerfstudio misreads others. It reads CMYK with wrong
colors, too; such images cause a warning."""


def _scaled_size(size: tuple[int, int], scale: float) -> tuple[int, int]:
    return int(size[0] * scale), int(size[1] * scale)


@contextmanager
def open_scaled(file: Path, scale: float, resampling: Image.Resampling) -> Iterator[Image.Image]:
    """Open an image file with Pillow, and yield the image resized by `scale`, nerfstudio's camera_res_scale_factor."""
    with open_regular(file) as stream, Image.open(stream) as opened:
        yield opened if scale == 1 else opened.resize(_scaled_size(opened.size, scale), resampling)


def camera_type_error(file: Path, kind: str) -> str:
    """Return an error message for an image with a camera type that splatfacto does not support."""
    return f"{file} has a camera of type {kind}; splatfacto supports only perspective and fisheye cameras."


class SplitViews:
    """Lazy `Views` of V images on disk; each access reads and undistorts one image.

    Args:
        files: Paths of the images.
        names: Paths of the images relative to the dataset.
        masks: One path per image, with None for an image without a mask; None if no image has a mask.
        sizes: Width and height of each camera in pixels, before undistortion.
        poses: Camera-to-world poses [V, 3, 4] in OpenGL convention, from the dataset or optimized by the training.
        background: Color behind images with an alpha channel, RGB in 0..1.
        scale: Resize factor of images and masks, nerfstudio's camera_res_scale_factor.
    """

    _LISTED_IN, _TRAINED = "the dataset", "run"
    """Words for the source of the image list and for the trained model, used in error messages."""

    def __init__(
        self,
        files: Sequence[Path],
        names: Sequence[str],
        masks: Sequence[Path | None] | None,
        sizes: Sequence[Sequence[int]],
        poses: Float[Tensor, "v 3 4"],
        background: Float[Tensor, " 3"],
        scale: float = 1.0,
    ) -> None:
        self.files = list(files)
        """Absolute paths of the images."""
        self.names = list(names)
        """Paths of the images relative to the dataset, with forward slashes."""
        self._masks, self._sizes, self._poses = masks or [None] * len(self.files), sizes, poses
        self._background, self._scale = background, scale
        protect_inputs(*self.files, *self._masks)

    def _pixels(self, file: Path) -> UInt8[np.ndarray, "h w c"]:
        """Read an image at the size of its camera. Subclasses must override this method or `_load`."""
        raise NotImplementedError

    def _lens(self, index: int) -> Intrinsics:
        """Return the intrinsics of an image. Subclasses must override this method, or `_undistort` and `_pinhole`."""
        raise NotImplementedError

    def _load(self, index: int) -> tuple[Any, Any]:
        """Read an image [H, W, C] and its mask (None if there is no mask), at the size of the camera."""
        image, file = self._pixels(self.files[index]), self._masks[index]
        if file is None:
            return image, None
        with open_scaled(file, self._scale, Image.Resampling.NEAREST) as opened:
            mask = np.array(opened).astype(bool)
        if mask.shape != image.shape[:2]:
            raise InputError(
                f"the mask has shape {mask.shape}, but must have one channel and the size of the image, "
                f"{image.shape[:2]}; save it in grayscale and in this size"
            )
        return image, mask

    def _check_header(self, index: int, header: ImageHeader) -> None:
        """Raise InputError if nerfstudio would misread an image, or if its size or its mask is not valid."""
        file, mask = self.files[index], self._masks[index]
        if header.mode not in _NERFSTUDIO_MODES:
            raise InputError(
                f"{file} has the pixel format {header.mode}, which nerfstudio misreads. Expected 8-bit RGB, RGBA or "
                "grayscale. Convert the images."
            )
        self._check_size(index, header.size if self._scale == 1 else _scaled_size(header.size, self._scale))
        if mask is not None:
            check_mask(mask, file, header.size)

    def _undistort(self, index: int, image: Any, mask: Any) -> tuple[Tensor, Bool[Tensor, "h w"] | None, bool]:
        """Return the undistorted image and mask, and True if they were distorted."""
        lens = self._lens(index)
        values = None if mask is None else torch.from_numpy(_undistort_mask(mask, lens)).bool()
        return torch.from_numpy(undistort_image(image, lens)[0]), values, lens.is_distorted

    def _pinhole(self, index: int) -> tuple[Float[Tensor, "3 3"], int, int]:
        """Return the camera matrix, width and height of an undistorted image."""
        return _undistorted_intrinsics(self._lens(index))

    def __len__(self) -> int:
        return len(self.files)

    def __getitem__(self, index: int) -> View:
        """Read and undistort one image.

        Raises:
            IndexError: The index is out of range.
            FileNotFoundError, ValueError: A file is missing, cannot be read, or differs in size from its camera. The
                message gives its path.
        """
        if not -len(self) <= index < len(self):
            raise IndexError(f"view {index} does not exist; the number of views is {len(self)}")
        index %= len(self)
        distorted, distorted_mask = self._read(index)
        camera = self.cameras[index]  # its errors give the path of the image
        image, mask, was_distorted = self._undistort(index, distorted, distorted_mask)
        original_size = (distorted.shape[1], distorted.shape[0]) if was_distorted else None
        image = blend_background(image, self._background)
        return View(camera, image, mask, self.names[index], original_size)

    @property
    def cameras(self) -> list[Camera]:
        """Cameras of the undistorted images, computed without reading images."""
        return self._cameras

    @cached_property
    def _cameras(self) -> list[Camera]:
        return [self._camera(i) for i in range(len(self))]

    def _camera(self, index: int) -> Camera:
        try:
            return to_camera(self._poses[index], *self._pinhole(index))
        except InputError as error:
            raise InputError(f"The camera of {self.files[index]} cannot be used: {error}") from error

    def check_files(self) -> tuple[str, ...]:
        """Check the headers of all images, and return warnings in whole sentences.

        Raises:
            FileNotFoundError, ValueError: A file is missing, is not an image, or has an unsupported pixel format. In
                nerfstudio runs, images and masks must also have the right size. The message gives the path.
        """
        headers = [read_image_header(file) for file in self.files]
        for index, header in enumerate(headers):
            self._check_header(index, header)
        return image_warnings(self.files, headers)

    def _check_size(self, index: int, size: Sequence[int]) -> None:
        expected, scaled = self._sizes[index], "" if self._scale == 1 else f" (scaled by {self._scale:g})"
        if list(size) != list(expected):
            raise InputError(
                f"{self.files[index]}{scaled} is {size[0]} x {size[1]} pixels, but its camera has {expected[0]} x "
                f"{expected[1]} (width x height). Use the images that the {self._TRAINED} was trained with."
            )

    def _read(self, index: int) -> tuple[Any, Any]:
        """Load an image and its mask, and check the size of the image."""
        try:
            image, mask = self._load(index)
        except FileNotFoundError as error:
            raise FileNotFoundError(
                f"{error.filename} is missing, but {self._LISTED_IN} lists it. Copy it to this path."
            ) from error
        except MemoryError:
            raise
        except Exception as error:  # Pillow's readers and nerfstudio's checks raise any kind of exception
            mask = self._masks[index]
            advice = (
                "" if isinstance(error, InputError) else " Expected an 8-bit image; copy it again from the capture."
            )
            raise InputError(
                f"{self.files[index]}{'' if mask is None else f' or its mask {mask}'} cannot be read: {error}.{advice}"
            ) from error
        self._check_size(index, image.shape[1::-1])
        return image, mask


class ImageViews(SplitViews):
    """Lazy `Views` of the images that a camera file lists; each access reads and undistorts one image.

    Images of perspective cameras are undistorted as in nerfstudio's FullImageDatamanager, so nerfstudio's commands use
    the same images. The camera matrix becomes OpenCV's optimal one without black borders, and images are cropped to its
    region of interest. Images of fisheye cameras keep their size, and at least 90 % of their pixels if a pinhole camera
    can show that many (see `fisheye_pinhole`). Their masks are undistorted without interpolation, and are False at
    pixels that the original image does not show.

    Args:
        frames: Image files and their cameras.
        background: Color behind images with an alpha channel, RGB in 0..1.
    """

    _LISTED_IN, _TRAINED = "the camera file", "splat"
    frames: list[Frame]
    """Cameras of the images before undistortion, and paths of the images and masks."""

    def __init__(self, frames: Sequence[Frame], background: Float[Tensor, " 3"]) -> None:
        self.frames = list(frames)
        super().__init__(
            [frame.file for frame in frames],
            [frame.name for frame in frames],
            [frame.mask for frame in frames],
            [(frame.intrinsics.width, frame.intrinsics.height) for frame in frames],
            torch.from_numpy(np.array([frame.pose for frame in frames])).float(),
            background,
        )

    def _lens(self, index: int) -> Intrinsics:
        return self.frames[index].intrinsics

    def _undistort(self, index: int, image: Any, mask: Any) -> tuple[Tensor, Bool[Tensor, "h w"] | None, bool]:
        lens = self._lens(index)
        if not lens.fisheye:
            return super()._undistort(index, image, mask)
        used = filled_pixels(lens) if mask is None else undistort_labels(mask[None].astype(int), lens)[0] == 1
        return torch.from_numpy(undistort_fisheye(image, lens)), None if used.all() else torch.from_numpy(used), True

    def _pinhole(self, index: int) -> tuple[Float[Tensor, "3 3"], int, int]:
        lens = self._lens(index)
        if not lens.fisheye:
            return super()._pinhole(index)
        return torch.from_numpy(fisheye_pinhole(lens)).float(), lens.width, lens.height

    def _check_header(self, index: int, header: ImageHeader) -> None:
        if problem := _mode_problem(header.mode):
            raise InputError(f"{self.files[index]} cannot be read: {problem}.")

    def _pixels(self, file: Path) -> UInt8[np.ndarray, "h w c"]:
        with open_regular(file) as stream, Image.open(stream) as image:
            if problem := _mode_problem(image.mode):
                raise InputError(problem)
            mode = "RGBA" if image.mode in ("LA", "PA", "La") or "transparency" in image.info else "RGB"
            return np.array(image if image.mode in (mode, "RGBA") else image.convert(mode), np.uint8)


def _mode_problem(mode: str) -> str | None:
    if mode[0] not in "IF":
        return None
    return (
        f"its pixel format is {mode}, expected 8 bits per channel; give 8-bit images, converted in the same way as for "
        "the training"
    )


@lru_cache  # the images of a camera share their intrinsics
def _undistorted_intrinsics(lens: Intrinsics) -> tuple[Float[Tensor, "3 3"], int, int]:
    """Return the camera matrix, width and height of the undistorted images of a camera."""
    if not lens.is_distorted:
        return torch.from_numpy(_matrix(lens)), lens.width, lens.height
    image, matrix = undistort_image(np.zeros((lens.height, lens.width, 1), np.uint8), lens)
    return torch.from_numpy(matrix).float(), image.shape[1], image.shape[0]


def _matrix(lens: Intrinsics) -> Float[np.ndarray, "3 3"]:
    """Return the camera matrix in float32, the precision of nerfstudio."""
    fx, fy, cx, cy = lens[:4]
    return np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]], np.float32)


def undistort_image(
    image: UInt8[np.ndarray, "h w c"], lens: Intrinsics
) -> tuple[UInt8[np.ndarray, "h2 w2 c"], Float[np.ndarray, "3 3"]]:
    """Undistort an image, and return it with its new camera matrix.

    Raises:
        ValueError: The distortion cannot be removed.
    """
    if not lens.is_distorted:
        return image, _matrix(lens)
    try:
        pixels, pinhole, (x, y) = _undistorted_fisheye(image, lens) if lens.fisheye else _undistorted(image, lens)
    except (InputError, cv2.error, ValueError) as error:
        parameters = [*lens[6:9], lens.k4, lens.p1, lens.p2]
        raise InputError(f"the distortion {parameters} cannot be removed ({error})") from error
    fx, fy = pinhole[0, 0], pinhole[1, 1]
    return pixels, np.array([[fx, 0, pinhole[0, 2] - x + 0.5], [0, fy, pinhole[1, 2] - y + 0.5], [0, 0, 1]])


def _undistorted(image: Any, lens: Intrinsics) -> tuple[Any, Any, tuple[int, int]]:
    """Return an undistorted perspective image, its camera matrix before cropping, and the corner (x, y) of the crop.

    In this matrix, pixel centers are at integers.
    """
    if lens.k4 != 0:
        raise InputError("k4 is not 0; only k1, k2, k3, p1 and p2 are supported")
    k1, k2, k3, p1, p2 = (float(np.float32(value)) for value in lens.distortion)
    coefficients, matrix = np.array([k1, k2, p1, p2, k3, 0, 0, 0]), _matrix(lens)
    matrix[:2, 2] -= 0.5  # OpenCV puts pixel centers at integers
    pinhole, (x, y, w, h) = cv2.getOptimalNewCameraMatrix(matrix, coefficients, image.shape[1::-1], 0)
    if w < 1 or h < 1:
        raise InputError("the undistorted image has no pixels")
    pixels = cv2.undistort(image, matrix, coefficients, None, pinhole)[y : y + h, x : x + w]
    return np.ascontiguousarray(pixels.reshape(*pixels.shape[:2], -1)), pinhole, (x, y)


def _undistorted_fisheye(image: Any, lens: Intrinsics) -> tuple[Any, Any, tuple[int, int]]:
    matrix, coefficients, pinhole = _fisheye(lens)
    size = (lens.width, lens.height)
    maps = cv2.fisheye.initUndistortRectifyMap(matrix, coefficients, np.eye(3), pinhole, size, cv2.CV_32FC1)
    pixels = cv2.remap(image, maps[0], maps[1], interpolation=cv2.INTER_LINEAR)
    return pixels.reshape(*pixels.shape[:2], -1), np.asarray(pinhole), (0, 0)


def label_undistortion(*parts: Views) -> Callable[[str, np.ndarray], np.ndarray] | None:
    """Return a function that undistorts label maps [levels, H, W], given the name of the image and the maps.

    The result is None unless the views are `ImageViews` with fisheye cameras. For all other views, label maps must fit
    the undistorted images.
    """
    lenses = _fisheye_lenses(*parts)
    return None if len(lenses) == 0 else lambda name, maps: undistort_labels(maps, lenses[name])


def filled_function(views: Views) -> Callable[[str, int, int], Bool[Tensor, "h w"]] | None:
    """Return a function from an image name, a height and a width to a mask of the pixels that the original image shows.

    The result is None unless the views are `ImageViews` with fisheye cameras.
    """
    lenses = _fisheye_lenses(views)
    if len(lenses) == 0:
        return None
    return lambda name, height, width: torch.from_numpy(filled_pixels(lenses[name].resized(width, height)))


def _fisheye_lenses(*parts: Views) -> dict[str, Intrinsics]:
    frames = [frame for views in parts if isinstance(views, ImageViews) for frame in views.frames]
    return {frame.name: frame.intrinsics for frame in frames if frame.intrinsics.fisheye}


def _fisheye(lens: Intrinsics) -> tuple[Any, Any, Any]:
    """Return the camera matrix, distortion coefficients and new camera matrix, with pixel centers at integers."""
    matrix, coefficients = _matrix(lens), np.array([*lens[6:9], lens.k4], np.float32)
    matrix[:2, 2] -= 0.5
    pinhole = cv2.fisheye.estimateNewCameraMatrixForUndistortRectify(
        matrix, coefficients, (lens.width, lens.height), np.eye(3), balance=0
    )
    return matrix, coefficients, pinhole


def _undistort_mask(mask: Bool[np.ndarray, "h w"], lens: Intrinsics) -> UInt8[np.ndarray, "h w"]:
    values = mask.astype(np.uint8) * np.uint8(255)
    if not lens.is_distorted or not lens.fisheye:
        return undistort_image(values[:, :, None], lens)[0][:, :, 0]
    matrix, coefficients, pinhole = _fisheye(lens)
    return cv2.fisheye.undistortImage(values, matrix, coefficients, None, pinhole)
