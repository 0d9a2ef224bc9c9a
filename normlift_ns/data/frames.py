"""Frames of camera files (images with their cameras), and image headers."""

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
"""Image formats that Pillow reads without other programs; document formats are left out."""
_MAX_SIDE = 2**16
_EXIF_ORIENTATION = 0x0112
_SINGLE_CHANNEL = {"1", "L", "P", "I", "F"}
"""Pillow modes with one number per pixel, in addition to the modes that start with I;16."""


class ImageHeader(NamedTuple):
    """Header of an image file."""

    size: tuple[int, int]
    """Width and height in pixels, before any EXIF rotation."""
    mode: str
    """Pillow's name for the pixel format."""
    rotated: bool
    """True if the EXIF data contain a rotation or a reflection, which training ignores."""
    multi_frame: bool
    """True if the file contains several images, of which only the first is read; always False for the format MPO."""


def read_image_header(file: Path) -> ImageHeader:
    """Read the header of an image file.

    Raises:
        FileNotFoundError: The file does not exist.
        ValueError: The path is not a regular file, or the file is not an image of a supported format and size.
    """
    if not file.exists():
        raise FileNotFoundError(f"{file} is missing, but the camera file lists it. Copy it to this path.")
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
            f"{file} cannot be read as an image: its format is {format_}, and its size is {size[0]} x {size[1]} "
            f"pixels. Expected JPEG, PNG, WebP, TIFF or BMP with at most {_MAX_SIDE:,} pixels along a side."
        )
    return ImageHeader(size, mode, rotated, multi_frame)


def _is_rotated(image: Image.Image) -> bool:
    if image.format == "PNG" and "exif" not in image.info:
        return False  # otherwise Pillow reads all pixels to find EXIF data at the end of the file
    try:
        return image.getexif().get(_EXIF_ORIENTATION, 1) not in (0, 1)
    except Exception:  # damaged EXIF data contain no rotation
        return False


def check_mask(mask: Path, file: Path, size: tuple[int, int]) -> None:
    """Raise unless a mask has one channel and the size of its image.

    Args:
        mask: Path of the mask.
        file: Path of its image, for error messages.
        size: Width and height of the image in pixels.
    Raises:
        FileNotFoundError, ValueError: As in `read_image_header`. Also if the mask has several channels or the wrong
            size; the message then gives both paths.
    """
    header = read_image_header(mask)
    if header.mode not in _SINGLE_CHANNEL and not header.mode.startswith("I;16"):
        raise InputError(
            f"The mask {mask} of {file} has the pixel format {header.mode}. Expected one channel that is zero at "
            "pixels to ignore. Save it in grayscale."
        )
    if header.size != size:
        raise InputError(
            f"The mask {mask} is {header.size[0]} x {header.size[1]} pixels, but its image {file} is {size[0]} x "
            f"{size[1]}. Give a mask of the same size as its image."
        )


def image_warnings(files: Sequence[Path], headers: Sequence[ImageHeader]) -> tuple[str, ...]:
    """Return warnings in whole sentences about images that training may not read as expected."""
    kinds = (
        (
            [header.rotated for header in headers],
            "have an EXIF rotation, which training ignores",
            "They are lifted without this rotation, so queries may miss objects that lie on their side. To fix this, "
            "rotate the pixels and train again",
        ),
        (
            [header.mode == "CMYK" for header in headers],
            "are in CMYK, which training reads with wrong colors",
            "Convert them to RGB",
        ),
        (
            [header.multi_frame for header in headers],
            "contain several images",
            "Only the first image of each file is used",
        ),
    )
    warnings = []
    for affected, problem, advice in kinds:
        if any(affected):
            first = files[affected.index(True)]
            count = f"{sum(affected)} of {len(files)}"
            warnings.append(f"Some image files {problem} ({count}, the first is {first}). {advice}.")
    return tuple(warnings)


_SUFFIXES = (".png", ".jpg", ".jpeg", ".JPG", ".JPEG", ".PNG", ".webp", ".tif", ".tiff", ".bmp")
_ROTATION_TOLERANCE = 1e-3
"""Maximum absolute value in R R^T - I for a rotation matrix R; numbers in files are rounded."""
GIVE_IMAGES = "give the folder of the images with --images"
"""Advice on missing images if the options do not contain their folder."""
PERSPECTIVE_MODELS = ("SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV")
"""Perspective camera models that `Intrinsics` can represent, by their names in COLMAP and nerfstudio."""
FISHEYE_MODELS = ("OPENCV_FISHEYE", "SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE", "SIMPLE_FISHEYE", "FISHEYE")
"""Fisheye camera models that `Intrinsics` can represent, by their names in COLMAP."""
_SMALLEST = 1e-12
"""Value of k1 that replaces 0 for fisheye cameras without distortion, too small to move any pixel.

nerfstudio treats fisheye cameras as pinhole cameras if all their distortion parameters are exactly 0.
"""


class Intrinsics(NamedTuple):
    """Camera intrinsics in pixels, with OpenCV's distortion parameters.

    Perspective cameras use k1, k2, p1, p2 and k3. Fisheye cameras use k1, k2, k3 and k4.
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
        """Distortion parameters k1, k2, k3, p1, p2."""
        return self[6:11]

    @property
    def is_distorted(self) -> bool:
        """True if a distortion parameter is not zero."""
        return any(self[6:12])

    def as_fisheye(self) -> Intrinsics:
        """Return these intrinsics as those of a fisheye camera, with a distortion that is not zero."""
        return self._replace(k1=self.k1 if self.is_distorted else _SMALLEST, fisheye=True)

    def resized(self, width: int, height: int) -> Intrinsics:
        """Return the intrinsics of the same image at a different size in pixels."""
        x, y = width / self.width, height / self.height
        return self._replace(
            fx=self.fx * x, fy=self.fy * y, cx=self.cx * x, cy=self.cy * y, width=width, height=height
        )  # fmt: skip


class WorldTransform(NamedTuple):
    """Similarity p -> scale * (transform @ p) from the world of the cameras to the world of a splat."""

    transform: Float[np.ndarray, "3 4"]
    """Rotation and translation."""
    scale: float
    float32: bool = False
    """True to compute in float32 like nerfstudio, so that the cameras equal those of the training bit for bit."""


@dataclass(frozen=True)
class Frame:
    """Image with its camera."""

    file: Path
    """Absolute path of the image."""
    name: str
    """Path of the image relative to the dataset, with forward slashes."""
    pose: Float[np.ndarray, "3 4"]
    """Camera-to-world pose in OpenGL convention: x right, y up, z backward."""
    intrinsics: Intrinsics
    mask: Path | None = None
    """Absolute path of the mask, which is zero at pixels to ignore and has the size of the image."""


def check_frames(frames: Sequence[Frame], source: Path) -> None:
    """Raise if the cameras of a camera file are not valid.

    Raises:
        ValueError: The file has no cameras, a name occurs twice, or only some of the cameras are fisheye cameras. Also
            if a pose is not rigid, a number is not finite, or a focal length or a size is not positive.
    """
    if len(frames) == 0:
        raise InputError(f"{source} has no cameras with images. Expected a camera for every training image.")
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
        raise InputError(f"{source} lists {duplicates[0]} more than once. Remove all but one of its entries.")
    check_lens_types(frames, source)


def check_lens_types(frames: Sequence[Frame], source: Path) -> None:
    """Raise InputError if only some of the frames have fisheye cameras, because a nerfstudio run cannot store both
    kinds."""
    first = {frame.intrinsics.fisheye: frame.name for frame in reversed(frames)}
    if len(first) > 1:
        raise InputError(
            f"{source}: {first[True]} has a fisheye camera, but {first[False]} has a perspective camera. Expected one "
            "type for all images. Undistort the fisheye images, for example with colmap image_undistorter, and give "
            "the new cameras with the same poses."
        )


def find_images(names: Sequence[str], folder: Path, source: Path, advice: str, *, allow_copies: bool) -> list[Path]:
    """Find images by name in a folder, and return their absolute paths.

    Args:
        names: Image names in the camera file.
        folder: Folder to search.
        source: Path of the camera file, for error messages.
        advice: Advice on missing images, for error messages.
        allow_copies: True to also find copies whose paths lack leading folders of the image names.
    Raises:
        FileNotFoundError: Images are missing. The message gives their number and the first name.
        ValueError: Two names refer to the same file.
    """
    found = [_find_file(folder, name, copies=allow_copies) for name in names]
    missing = [name for name, file in zip(names, found) if file is None]
    if missing:
        raise FileNotFoundError(
            f"Images of {source} are missing from {folder} ({len(missing)} of {len(names)}, the first is "
            f"{missing[0]}). Copy them to this folder, or {advice}."
        )
    files = [file.absolute() for file in found if file is not None]
    check_files_distinct(zip(names, files), "file", f"in the folders that {source} lists, or {advice}")
    return files


def plain_name(name: str) -> str:
    r"""Return a path with forward slashes instead of the backslashes of Windows.

    >>> plain_name("images\\left\\1.png"), plain_name("C:\\a\\1.png"), plain_name("images/1.png")
    ('images/left/1.png', 'C:/a/1.png', 'images/1.png')
    """
    return PureWindowsPath(name).as_posix() if "\\" in name else name


def possible_paths(folder: Path, name: str, *, copies: bool = False) -> list[Path]:
    """Return the possible paths of a file that a camera file names, in order of preference.

    An absolute path may be from another machine, so its trailing parts, such as images/1.png of
    C:\\scene\\images\\1.png, are also joined to the folder.

    Args:
        folder: Folder to search.
        name: Absolute path, or path relative to the folder.
        copies: True for a folder of copies, such as images_2, in which leading folders of relative paths may be
            missing. An absolute path itself is then left out.
    """
    plain = plain_name(name)
    path = PureWindowsPath(plain) if PureWindowsPath(plain).is_absolute() else PurePosixPath(plain)
    is_absolute = path.is_absolute()
    ends = [folder.joinpath(*path.parts[start:]) for start in range(is_absolute, len(path.parts))]
    if is_absolute:
        return ends if copies else [folder / name, *ends]
    return [folder / name, *(ends if copies else ends[:1])]


def _find_file(folder: Path, name: str, *, copies: bool) -> Path | None:
    """Return the first existing file of `possible_paths`, or None. The file may have another or an extra suffix."""
    for candidate in possible_paths(folder, name, copies=copies):
        for file in (
            *(candidate.with_name(candidate.name + suffix) for suffix in ("", *_SUFFIXES)),
            *map(candidate.with_suffix, _SUFFIXES),
        ):
            if file.is_file():
                return file
    return None


def find_masks(names: Sequence[str], folder: Path) -> list[Path]:
    """Find the masks of images, and return their absolute paths.

    The mask of name.jpg is name.jpg.png, as in COLMAP, or an image with the same stem and any supported suffix.

    Raises:
        FileNotFoundError: A mask is missing.
        ValueError: Two images share a mask.
    """
    masks = []
    for name in names:
        mask = _find_file(folder, f"{name}.png", copies=True) or _find_file(folder, name, copies=True)
        if mask is None:
            raise FileNotFoundError(
                f"{folder} has no mask for {name}. Expected {Path(name).stem}.png, and a mask for every other image."
            )
        masks.append(mask.absolute())
    check_files_distinct(zip(names, masks), "mask", "in folders named like those of the images")
    return masks


def rescale_intrinsics(frame: Frame, source: Path, advice: str = GIVE_IMAGES) -> Frame:
    """Return a frame with its intrinsics scaled to the size of its image file, which may be a smaller copy.

    Args:
        frame: Frame as read from the camera file.
        source: Path of the camera file, for error messages.
        advice: Advice on an unsuitable image, for error messages.
    Raises:
        FileNotFoundError: The image or its mask is missing.
        ValueError: The file is not an image, its aspect ratio differs from that of its camera, or its mask is not
            valid.
    """
    width, height = read_image_header(frame.file).size
    camera = frame.intrinsics
    if (width, height) != (camera.width, camera.height):
        scale = (width / camera.width + height / camera.height) / 2
        if abs(camera.width * scale - width) > 1 or abs(camera.height * scale - height) > 1:
            raise InputError(
                f"{frame.file} has {width} x {height} pixels, but its camera in {source} has {camera.width} x "
                f"{camera.height}, a different aspect ratio. Replace the images with those that the cameras were "
                f"computed from, or with proportionally smaller copies, or {advice}."
            )
        camera = camera.resized(width, height)
    if frame.mask is not None:
        check_mask(frame.mask, frame.file, (width, height))
    return replace(frame, intrinsics=camera)


def transform_frames(frames: Sequence[Frame], world: WorldTransform) -> list[Frame]:
    """Return the frames with their poses transformed to the world of a splat."""
    dtype = torch.float32 if world.float32 else torch.float64
    poses = torch.from_numpy(np.array([[*frame.pose, [0, 0, 0, 1]] for frame in frames])).to(dtype)
    poses = torch.from_numpy(world.transform).to(dtype) @ poses  # one product, for the same rounding as nerfstudio
    poses[:, :, 3] *= world.scale
    return [replace(frame, pose=pose.double().numpy()) for frame, pose in zip(frames, poses)]
