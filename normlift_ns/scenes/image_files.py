"""What the heads of image files say: looked at before a lift, without reading a pixel."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

from PIL import Image

from normlift_ns.errors import InputError

_FORMATS = {"JPEG", "MPO", "PNG", "WEBP", "TIFF", "BMP", "DIB", "PPM", "GIF", "TGA", "JPEG2000", "AVIF"}
"""Others need programs besides Pillow, or are no photographs."""
_LONGEST = 2**16
_ORIENTATION = 0x0112
_GREY = {"1", "L", "P", "I", "F"}
"""Kinds of one number per pixel; also those whose names begin with I;16."""


class Head(NamedTuple):
    """Of one image file."""

    size: tuple[int, int]
    """Width and height of the pixels as they are stored."""
    mode: str
    """As Pillow calls the kind of its pixels."""
    turned: bool
    """Whether EXIF data tell viewers to turn it, which training does not."""
    several: bool
    """Whether it holds several pictures, of which the first is read."""


def read_head(file: Path) -> Head:
    """Kind and size of an image.

    Raises:
        FileNotFoundError: no such file.
        ValueError: no file, no image, one of a format that is not read, or one of absurd size.
    """
    if not file.exists():
        raise FileNotFoundError(f"{file} is missing, which the cameras name. Say where the images are: --images.")
    if not file.is_file():
        raise InputError(f"{file} is no file. Expected an image; copy it again from the capture.")
    try:
        with Image.open(file) as image:
            size, format_, mode = image.size, image.format, image.mode
            turned, several = _is_turned(image), format_ != "MPO" and bool(getattr(image, "is_animated", False))
    except Exception as error:  # Pillow's readers raise whatever a damaged head leads them to
        raise InputError(
            f"{file} cannot be read as an image ({str(error)[:200]}). Copy it again from the capture."
        ) from error
    if format_ not in _FORMATS or max(size) > _LONGEST or min(size) < 1:
        raise InputError(
            f"{file} cannot be read as an image: it is a {format_} of {size[0]} x {size[1]} pixels. Expected JPEG, "
            f"PNG, WebP, TIFF or BMP with at most {_LONGEST:,} pixels along a side."
        )
    return Head(size, mode, turned, several)


def _is_turned(image: Image.Image) -> bool:
    if image.format == "PNG" and "exif" not in image.info:
        return False  # Pillow would read all pixels to look for it at the end
    try:
        return image.getexif().get(_ORIENTATION, 1) not in (0, 1)
    except Exception:  # damaged EXIF data turn nothing
        return False


def check_mask(mask: Path, file: Path, size: tuple[int, int]) -> None:
    """Refuses a mask that is not of one channel, or of another size than its image.

    Raises:
        FileNotFoundError, ValueError: as `read_head`, or a mask that does not fit; the message names both files.
    """
    head = read_head(mask)
    if head.mode not in _GREY and not head.mode.startswith("I;16"):
        raise InputError(
            f"The mask {mask} of {file} has pixels of kind {head.mode}, expected one channel: zero where a pixel does "
            "not count. Save it in grey."
        )
    if head.size != size:
        raise InputError(
            f"The mask {mask} is {head.size[0]} x {head.size[1]} pixels, its image {file} {size[0]} x {size[1]}. "
            "Expected masks of the size of the images."
        )


def remarks(files: Sequence[Path], heads: Sequence[Head]) -> tuple[str, ...]:
    """What a person should know of photographs that training sees otherwise than people do; whole sentences."""
    kinds = (
        (
            [head.turned for head in heads],
            "carry an EXIF rotation, which training ignores",
            "They are lifted as their pixels lie in the file, not as viewers show them: things that lie on their side "
            "there are found less well. To mend that, turn the pixels and train again",
        ),
        (
            [head.mode == "CMYK" for head in heads],
            "are in CMYK, which training takes for other colours than people see",
            "Convert them to RGB and train again",
        ),
        ([head.several for head in heads], "hold several pictures", "The first of each is used"),
    )
    found = []
    for which, what, advice in kinds:
        if any(which):
            first = files[which.index(True)]
            found.append(f"{sum(which)} of {len(files)} photographs {what}; the first is {first}. {advice}.")
    return tuple(found)
