"""Frames (images with their cameras) of camera files, and image headers."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path, PurePosixPath, PureWindowsPath
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float
from PIL import Image

from normlift_ns.errors import InputError
from normlift_ns.io.guard import check_files_distinct, open_regular

_FORMATS = {"JPEG", "MPO", "PNG", "WEBP", "TIFF", "BMP", "DIB", "PPM", "GIF", "TGA", "JPEG2000", "AVIF"}
"""Formats that Pillow reads without other programs and that hold images rather than documents."""
_MAX_SIDE = 2**16
_EXIF_ORIENTATION = 0x0112
_SINGLE_CHANNEL = {"1", "L", "P", "I", "F"}
"""Pillow modes with one number per pixel; modes that start with I;16 also have one."""


class ImageHeader(NamedTuple):
    """Header of an image file."""

    size: tuple[int, int]
    """Width and height of the pixels as stored."""
    mode: str
    """Pillow's name of the pixel format."""
    rotated: bool
    """True if EXIF data ask viewers to rotate the image, which training ignores."""
    multi_frame: bool
    """True if the file holds several images; only the first is read."""


def read_image_header(file: Path) -> ImageHeader:
    """Read the header of an image file.

    Raises:
        FileNotFoundError: if there is no such file.
        ValueError: if the path is not a regular file, not an image, or an image of unsupported format or size.
    """
    if not file.exists():
        raise FileNotFoundError(f"{file} is missing, but the camera file lists it. Put it back.")
    if not file.is_file():
        raise InputError(f"{file} is not a regular file. Expected an image; copy it again from the capture.")
    try:
        with open_regular(file) as stream, Image.open(stream) as image:
            size, format_, mode = image.size, image.format, image.mode
            rotated, multi_frame = _is_rotated(image), format_ != "MPO" and bool(getattr(image, "is_animated", False))
    except Exception as error:  # Pillow's readers raise any kind of exception on a damaged header
        raise InputError(
            f"{file} cannot be read as an image ({str(error)[:200]}). Copy it again from the capture."
        ) from error
    if format_ not in _FORMATS or max(size) > _MAX_SIDE or min(size) < 1:
        raise InputError(
            f"{file} cannot be read as an image: it is a {format_} of {size[0]} x {size[1]} pixels. Expected JPEG, "
            f"PNG, WebP, TIFF or BMP with at most {_MAX_SIDE:,} pixels along a side."
        )
    return ImageHeader(size, mode, rotated, multi_frame)


def _is_rotated(image: Image.Image) -> bool:
    if image.format == "PNG" and "exif" not in image.info:
        return False  # otherwise Pillow would read all pixels to look for EXIF data at the end of the file
    try:
        return image.getexif().get(_EXIF_ORIENTATION, 1) not in (0, 1)
    except Exception:  # damaged EXIF data cannot ask for a rotation
        return False


def check_mask(mask: Path, file: Path, size: tuple[int, int]) -> None:
    """Raise if a mask does not have one channel and the size of its image.

    Args:
        mask: file of the mask.
        file: file of its image, for messages.
        size: width and height of the image.
    Raises:
        FileNotFoundError, ValueError: as in `read_image_header`, or if the mask does not fit. The message names both.
    """
    header = read_image_header(mask)
    if header.mode not in _SINGLE_CHANNEL and not header.mode.startswith("I;16"):
        raise InputError(
            f"The mask {mask} of {file} has the pixel format {header.mode}. Expected one channel that is zero at "
            "pixels to ignore; save it in grayscale."
        )
    if header.size != size:
        raise InputError(
            f"The mask {mask} is {header.size[0]} x {header.size[1]} pixels, but its image {file} is {size[0]} x "
            f"{size[1]}. Expected a mask of the same size as its image."
        )


def image_warnings(files: Sequence[Path], headers: Sequence[ImageHeader]) -> tuple[str, ...]:
    """Return warnings, in whole sentences, about images that training reads differently from image viewers."""
    kinds = (
        (
            [header.rotated for header in headers],
            "have an EXIF rotation, which training ignores",
            "They are lifted as stored in the file, not as viewers show them, so objects that lie on their side "
            "are found less reliably. To fix this, rotate the pixels and train again",
        ),
        (
            [header.mode == "CMYK" for header in headers],
            "are in CMYK, which training reads as different colors",
            "Convert them to RGB",
        ),
        ([header.multi_frame for header in headers], "hold several images", "Only the first image of each is used"),
    )
    warnings = []
    for affected, problem, advice in kinds:
        if any(affected):
            first = files[affected.index(True)]
            warnings.append(f"{sum(affected)} of {len(files)} images {problem}; the first is {first}. {advice}.")
    return tuple(warnings)


_SUFFIXES = (".png", ".jpg", ".jpeg", ".JPG", ".JPEG", ".PNG", ".webp", ".tif", ".tiff", ".bmp")
_ROTATION_TOLERANCE = 1e-3
"""Largest deviation of a rotation from orthonormal, because files round."""
GIVE_IMAGES = "give the folder of the images with --images"
"""Advice about missing images, unless the folder was given."""
PERSPECTIVE_MODELS = ("SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV")
"""Camera models that `Intrinsics` covers, by the names that COLMAP and nerfstudio give them."""


class Intrinsics(NamedTuple):
    """Intrinsics, in pixels, of a camera with OpenCV's distortion.

    It is k1 k2 p1 p2 k3 of a pinhole camera, or k1 k2 k3 k4 of a fisheye camera.
    """

    fx: float
    fy: float
    cx: float
    cy: float
    width: int
    height: int
    k1: float = 0.0
    k2: float = 0.0
    k3: float = 0.0
    p1: float = 0.0
    p2: float = 0.0
    k4: float = 0.0
    fisheye: bool = False

    @property
    def distortion(self) -> tuple[float, float, float, float, float]:
        """k1, k2, k3, p1, p2."""
        return self[6:11]

    @property
    def is_distorted(self) -> bool:
        """True if a distortion parameter is not zero."""
        return any(self[6:12])

    def resized(self, width: int, height: int) -> Intrinsics:
        """Return the intrinsics of the same image at another size."""
        x, y = width / self.width, height / self.height
        return self._replace(
            fx=self.fx * x, fy=self.fy * y, cx=self.cx * x, cy=self.cy * y, width=width, height=height
        )  # fmt: skip


class WorldTransform(NamedTuple):
    """Similarity p -> scale * (transform @ p) from the world of the cameras to that of a splat."""

    transform: Float[np.ndarray, "3 4"]
    """Rotation and translation."""
    scale: float
    float32: bool = False
    """Compute in float32, as nerfstudio does. Only then are the cameras bit-identical to those of its training."""


@dataclass(frozen=True)
class Frame:
    """An image and its camera."""

    file: Path
    """Absolute path of the image."""
    name: str
    """The file relative to the dataset, with forward slashes."""
    pose: Float[np.ndarray, "3 4"]
    """Camera-to-world pose in OpenGL convention: x right, y up, z backward."""
    intrinsics: Intrinsics
    mask: Path | None = None
    """Absolute path of the mask, an image of the same size that is zero at pixels to ignore."""


def check_frames(frames: Sequence[Frame], source: Path) -> None:
    """Raise if a camera is invalid.

    Raises:
        ValueError: if there are no cameras, names repeat, poses are not rigid, numbers are not finite, or focal lengths
            or sizes are not positive.
    """
    if len(frames) == 0:
        raise InputError(f"{source} has no cameras with images. Expected one for every training image.")
    for frame in frames:
        if not np.isfinite([*frame.pose.ravel(), *frame.intrinsics]).all():
            raise InputError(
                f"{source}: the camera of {frame.name} has numbers that are NaN or infinite. Expected finite numbers; "
                "create the file again, or remove the image from it."
            )
        if min(frame.intrinsics[:2]) <= 0 or min(frame.intrinsics[4:6]) < 1:
            raise InputError(
                f"{source}: the camera of {frame.name} has focal lengths {frame.intrinsics.fx:g}, "
                f"{frame.intrinsics.fy:g} and size {frame.intrinsics.width} x {frame.intrinsics.height}. Expected "
                "positive numbers."
            )
        rotation = frame.pose[:, :3]
        if np.abs(rotation @ rotation.T - np.eye(3)).max() > _ROTATION_TOLERANCE or np.linalg.det(rotation) < 0:
            raise InputError(
                f"{source}: the pose of {frame.name} is not a rotation and translation. Expected a rigid "
                "camera-to-world matrix without scale or mirroring."
            )
    names = [frame.name for frame in frames]
    duplicates = sorted({name for name in names if names.count(name) > 1}) if len(set(names)) < len(names) else []
    if duplicates:
        raise InputError(f"{source} lists {duplicates[0]} more than once. Expected every image once.")


def find_images(names: Sequence[str], folder: Path, source: Path, advice: str, *, allow_copies: bool) -> list[Path]:
    """Find images by name in a folder, and return their absolute paths.

    Args:
        names: image names from the camera file.
        folder: folder to search.
        source: the camera file, for error messages.
        advice: what to do about missing images, for error messages.
        allow_copies: whether the folder may hold copies of the images, which need not lie in the same subfolders.
    Raises:
        FileNotFoundError: if images are missing; the message counts them and names the first.
        ValueError: if two names lead to one file.
    """
    found = [_find_file(folder, name, copies=allow_copies) for name in names]
    missing = [name for name, file in zip(names, found) if file is None]
    if missing:
        raise FileNotFoundError(
            f"{len(missing)} of the {len(names)} images that {source} lists are not in {folder}; the first is "
            f"{missing[0]}. Put them back, or {advice}."
        )
    files = [file.absolute() for file in found if file is not None]
    check_files_distinct(zip(names, files), "file", f"in the folders that {source} lists, or {advice}")
    return files


def plain_name(name: str) -> str:
    r"""Return a path with forward slashes, also if a program on Windows wrote it.

    >>> plain_name("images\\left\\1.png"), plain_name("C:\\a\\1.png"), plain_name("images/1.png")
    ('images/left/1.png', 'C:/a/1.png', 'images/1.png')
    """
    return PureWindowsPath(name).as_posix() if "\\" in name else name


def possible_paths(folder: Path, name: str, *, copies: bool = False) -> list[Path]:
    """Return the paths at which a file that a camera file lists may be.

    The first is its own. An absolute path may be that of another machine, so the file may also be at the end of its
    path in the folder: images/1.png for C:\\scene\\images\\1.png.

    Args:
        folder: folder to search.
        name: path relative to the folder, or absolute.
        copies: also try a relative path without its leading folders, for copies in folders such as images_2.
    """
    plain = plain_name(name)
    path = PureWindowsPath(plain) if PureWindowsPath(plain).is_absolute() else PurePosixPath(plain)
    is_absolute = path.is_absolute()
    ends = [folder.joinpath(*path.parts[start:]) for start in range(is_absolute, len(path.parts))]
    if is_absolute:
        return ends if copies else [folder / name, *ends]
    return [folder / name, *(ends if copies else ends[:1])]


def _find_file(folder: Path, name: str, *, copies: bool) -> Path | None:
    """Find a file by name in a folder, also with another suffix, as downscaled copies have.

    Args:
        folder, name, copies: as in `possible_paths`.
    """
    for candidate in possible_paths(folder, name, copies=copies):
        for file in (
            *(candidate.with_name(candidate.name + suffix) for suffix in ("", *_SUFFIXES)),
            *map(candidate.with_suffix, _SUFFIXES),
        ):
            if file.is_file():
                return file
    return None


def find_masks(names: Sequence[str], folder: Path) -> list[Path]:
    """Find the masks of images: name.jpg.png, as in COLMAP, or any image with the same stem.

    Raises:
        FileNotFoundError: if a mask is missing.
        ValueError: if two images share a mask.
    """
    masks = []
    for name in names:
        mask = _find_file(folder, f"{name}.png", copies=True) or _find_file(folder, name, copies=True)
        if mask is None:
            raise FileNotFoundError(
                f"There is no mask for {name} in {folder}. Expected {Path(name).name}.png or {Path(name).stem}.png for "
                "every image."
            )
        masks.append(mask.absolute())
    check_files_distinct(zip(names, masks), "mask", "in folders named like those of the images")
    return masks


def rescale_intrinsics(frame: Frame, source: Path, advice: str = GIVE_IMAGES) -> Frame:
    """Return the frame with intrinsics for the size of its file, which may be a smaller copy of the image.

    Args:
        frame: the frame as the camera file describes it.
        source: the camera file, for error messages.
        advice: what to do about an unsuitable image, for error messages.
    Raises:
        FileNotFoundError: if the file is missing.
        ValueError: if the file is not an image, its aspect ratio differs from its camera's, or its mask does not fit.
    """
    width, height = read_image_header(frame.file).size
    camera = frame.intrinsics
    if (width, height) != (camera.width, camera.height):
        scale = (width / camera.width + height / camera.height) / 2
        if abs(camera.width * scale - width) > 1 or abs(camera.height * scale - height) > 1:
            raise InputError(
                f"{frame.file} is {width} x {height} pixels, but its camera in {source} has {camera.width} x "
                f"{camera.height}: the aspect ratios differ. Put the images there that the cameras were computed from, "
                f"or proportionally smaller copies, or {advice}."
            )
        camera = camera.resized(width, height)
    if frame.mask is not None:
        check_mask(frame.mask, frame.file, (width, height))
    return replace(frame, intrinsics=camera)


def transform_frames(frames: Sequence[Frame], world: WorldTransform) -> list[Frame]:
    """Return the frames with poses in another world."""
    dtype = torch.float32 if world.float32 else torch.float64
    poses = torch.from_numpy(np.array([[*frame.pose, [0, 0, 0, 1]] for frame in frames])).to(dtype)
    poses = torch.from_numpy(world.transform).to(dtype) @ poses  # one product, as in nerfstudio, for equal rounding
    poses[:, :, 3] *= world.scale
    return [replace(frame, pose=pose.double().numpy()) for frame, pose in zip(frames, poses)]
