"""Reading pictures and arrays that others wrote, with errors that name the file, without running what may be in it."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch
from jaxtyping import UInt8
from PIL import Image
from torch import Tensor

from normlift_ns.errors import InputError


def read_image(path: Path) -> UInt8[Tensor, "h w 3"]:
    """A picture file as RGB, 0..255; an alpha channel is dropped.

    Raises:
        FileNotFoundError: no such file.
        ValueError: a file that is no picture, or a truncated one.
    """
    return torch.from_numpy(read_pixels(path, "RGB"))


def read_pixels(path: Path, mode: str | None = None) -> np.ndarray:
    """The decoded pixels of a picture file, [H, W] or [H, W, channels], in a Pillow mode or as stored; raises as
    `read_image`."""
    if not path.is_file():
        raise FileNotFoundError(f"image {path} does not exist; check the path, or where the dataset was moved to")
    try:
        with Image.open(path) as picture:
            return np.array(picture if mode is None else picture.convert(mode))
    except (OSError, SyntaxError, ValueError, Image.DecompressionBombError) as error:
        raise InputError(
            f"image {path} is damaged or no picture ({error}); expected a file that Pillow can decode, such as PNG "
            "or JPEG: replace it"
        ) from error


def read_npy(path: Path, what: str) -> np.ndarray:
    """The array of an NPY file, of any type but objects, mapped into memory and read-only.

    Args:
        what: what the file is, for the message.
    Raises:
        FileNotFoundError: no such file.
        ValueError: a file that is truncated, no NPY file or holds pickled objects.
    """
    try:
        return np.lib.format.open_memmap(path, mode="r")
    except FileNotFoundError:
        raise FileNotFoundError(f"{what} {path} does not exist; check the folder") from None
    except Exception as error:  # whatever a foreign header makes NumPy's parser raise
        raise InputError(f"{what} {path} is damaged or no NPY file ({error}); write it again with numpy.save") from None
