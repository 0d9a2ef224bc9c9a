"""Safe image reading: nothing in a file is executed, and errors name the file."""

from __future__ import annotations

import os
import struct
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import torch
from jaxtyping import UInt8
from PIL import Image
from torch import Tensor

from normlift_ns.errors import InputError

_IMAGE_FORMATS = ("PNG", "JPEG", "MPO", "WEBP", "TIFF", "BMP", "PPM")
"""Formats of training images. Pillow would hand some other formats to external programs: PostScript to Ghostscript."""
_MAX_PIXELS = 2**27
"""16,384 x 8,192. A file of a few bytes can decode to any number of equal pixels."""


def read_image(path: Path) -> UInt8[Tensor, "h w 3"]:
    """Read an image file as RGB, 0..255; an alpha channel is dropped.

    Raises:
        FileNotFoundError: If the file does not exist.
        ValueError: If the file is not an image, or is truncated.
    """
    return torch.from_numpy(read_pixels(path, "RGB"))


def read_pixels(
    path: Path, mode: str | None = None, *, what: str = "image", formats: tuple[str, ...] = _IMAGE_FORMATS
) -> np.ndarray:
    """Read the pixels of an image file, [H, W] or [H, W, channels], in a Pillow mode or as stored; raises as
    `read_image`.

    Args:
        what: Kind of file, for messages.
        formats: Accepted formats, by their Pillow names.
    """
    with _open_image(path, what, formats) as image:
        return np.array(image if mode is None else image.convert(mode))


def read_size(path: Path, *, what: str = "image", formats: tuple[str, ...] = _IMAGE_FORMATS) -> tuple[int, int]:
    """Read width and height of an image file without decoding it; arguments and errors as in `read_pixels`."""
    with _open_image(path, what, formats) as image:
        return image.size


@contextmanager
def _open_image(path: Path, what: str, formats: tuple[str, ...]) -> Iterator[Image.Image]:
    """Open an image file and check its size; turn exceptions that Pillow raises in the block into InputError."""
    if not os.path.isfile(path):
        if os.path.lexists(path):
            raise InputError(f"{what} {path} is not a file; expected an image")
        raise FileNotFoundError(f"{what} {path} does not exist; check the path, or whether the dataset was moved")
    try:
        with Image.open(path, formats=formats) as image:
            if image.width * image.height > _MAX_PIXELS:
                raise InputError(f"it has {image.width} x {image.height} pixels, at most {_MAX_PIXELS:,} are accepted")
            yield image
    except (  # exceptions of Pillow's decoders
        OSError, SyntaxError, ValueError, TypeError, LookupError, EOFError, OverflowError, struct.error, zlib.error,
        Image.DecompressionBombError,
    ) as error:  # fmt: skip
        raise InputError(
            f"{what} {path} is damaged or not an image ({error}); replace it with a file that Pillow can decode, such "
            f"as {formats[0]}"
        ) from error


def grey_depth(path: Path) -> int | None:
    """Return the bits per pixel of a grayscale PNG, else None. Pillow stretches values of 2 and 4 bits to 0..255."""
    with path.open("rb") as file:
        head = file.read(26)
    return head[24] if head.startswith(b"\x89PNG") and len(head) == 26 and head[25] == 0 else None
