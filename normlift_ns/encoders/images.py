"""Reading pictures that others wrote, with errors that name the file, without running what may be in it."""

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

_FORMATS = ("PNG", "JPEG", "MPO", "WEBP", "TIFF", "BMP", "PPM")
"""Of photographs. Pillow would also hand some formats to other programs: PostScript to Ghostscript."""
_MOST_PIXELS = 2**27
"""16,384 x 8,192. Few bytes of a file can hold any number of equal pixels."""


def read_image(path: Path) -> UInt8[Tensor, "h w 3"]:
    """A picture file as RGB, 0..255; an alpha channel is dropped.

    Raises:
        FileNotFoundError: no such file.
        ValueError: a file that is no picture, or a truncated one.
    """
    return torch.from_numpy(read_pixels(path, "RGB"))


def read_pixels(
    path: Path, mode: str | None = None, *, what: str = "image", formats: tuple[str, ...] = _FORMATS
) -> np.ndarray:
    """The decoded pixels of a picture file, [H, W] or [H, W, channels], in a Pillow mode or as stored; raises as
    `read_image`.

    Args:
        what: what the file is, for the message.
        formats: those that it may have, by Pillow's names.
    """
    with _opened(path, what, formats) as picture:
        return np.array(picture if mode is None else picture.convert(mode))


def read_size(path: Path, *, what: str = "image", formats: tuple[str, ...] = _FORMATS) -> tuple[int, int]:
    """Width and height of a picture file, whose pixels are not decoded; arguments and errors as in `read_pixels`."""
    with _opened(path, what, formats) as picture:
        return picture.size


@contextmanager
def _opened(path: Path, what: str, formats: tuple[str, ...]) -> Iterator[Image.Image]:
    """A picture file whose size is not absurd; what is done with it may raise as Pillow does."""
    if not os.path.isfile(path):
        if os.path.lexists(path):
            raise InputError(f"{what} {path} is no file; expected a picture")
        raise FileNotFoundError(f"{what} {path} does not exist; check the path, or where the dataset was moved to")
    try:
        with Image.open(path, formats=formats) as picture:
            if picture.width * picture.height > _MOST_PIXELS:
                raise InputError(f"{picture.width} x {picture.height} pixels are too many, at most {_MOST_PIXELS:,}")
            yield picture
    except (  # what Pillow's decoders raise
        OSError, SyntaxError, ValueError, TypeError, LookupError, EOFError, OverflowError, struct.error, zlib.error,
        Image.DecompressionBombError,
    ) as error:  # fmt: skip
        raise InputError(
            f"{what} {path} is damaged or no picture ({error}); expected a file that Pillow can decode, such as "
            f"{formats[0]}: replace it"
        ) from error


def grey_depth(path: Path) -> int | None:
    """Bits per pixel of a grey PNG; None of other files. Pillow stretches the values of 2 and 4 bits to 0..255."""
    with path.open("rb") as file:
        head = file.read(26)
    return head[24] if head.startswith(b"\x89PNG") and len(head) == 26 and head[25] == 0 else None
