"""Headers of image files, checked before a lift without decoding any pixels."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

from PIL import Image

from normlift_ns.errors import InputError

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
    """Whether EXIF data ask viewers to rotate the image, which training ignores."""
    multi_frame: bool
    """Whether the file holds several images; only the first is read."""


def read_head(file: Path) -> ImageHeader:
    """Read the header of an image file.

    Raises:
        FileNotFoundError: if there is no such file.
        ValueError: if the path is not a regular file, not an image, or an image of unsupported format or size.
    """
    if not file.exists():
        raise FileNotFoundError(
            f"{file} is missing, but the camera file lists it. Give the folder of the images with --images."
        )
    if not file.is_file():
        raise InputError(f"{file} is not a regular file. Expected an image; copy it again from the capture.")
    try:
        with Image.open(file) as image:
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
        FileNotFoundError, ValueError: as in `read_head`, or if the mask does not fit; the message names both files.
    """
    header = read_head(mask)
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


def remarks(files: Sequence[Path], headers: Sequence[ImageHeader]) -> tuple[str, ...]:
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
            "Convert them to RGB and train again",
        ),
        ([header.multi_frame for header in headers], "hold several images", "Only the first image of each is used"),
    )
    warnings = []
    for affected, problem, advice in kinds:
        if any(affected):
            first = files[affected.index(True)]
            warnings.append(f"{sum(affected)} of {len(files)} images {problem}; the first is {first}. {advice}.")
    return tuple(warnings)
