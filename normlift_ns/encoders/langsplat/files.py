"""The files of LangSplat's preprocessing, read with all that other programs do to them, and written.

Two files belong to every image. `<stem>_f.npy` holds one CLIP vector per mask, [T, D], of four lists of masks one after
the other: all of SAM's masks, its subparts, its parts, its wholes. `<stem>_s.npy`, [4, H, W], says for each list which
row of that table a pixel has, -1 for none. What is read besides:

* `_s` of any float or integer type, with one channel or four;
* ids past the table, NaN or negative ids, and rows of the table that are zero or not finite: no region, with a warning.
"""

from __future__ import annotations

import io
import os
import warnings
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Bool, Float32, Int32
from torch import Tensor

from normlift_ns.core.files import new_file
from normlift_ns.encoders.npy import read_npy
from normlift_ns.encoders.texts.prompts import UNIT_TOLERANCE
from normlift_ns.errors import InputError

LEVELS = ("default", "s", "m", "l")
"""Channels of `_s`."""
_LARGEST_HALF = 2048
"""From here on half precision cannot tell integers apart."""
_LEAST_LENGTH = 1e-30
"""Below, vectors are zero: their numbers have lost their digits."""
_SMALLEST_DIMENSION = 16
"""LangSplat's autoencoder leaves 3 numbers; no CLIP has so few."""


def open_segments(path: Path) -> np.ndarray:
    """[C, H, W], mapped into memory, its values unchecked.

    Raises:
        FileNotFoundError, ValueError: no such file, a damaged one, or one of another type or shape.
    """
    found = read_npy(path, "segment map")
    found = found[None] if found.ndim == 2 else found
    if found.dtype.kind not in "fiu" or found.ndim != 3 or len(found) not in (1, len(LEVELS)) or found.size == 0:
        raise InputError(
            f"segment map {path} holds {found.dtype} {found.shape}, expected numbers [4, H, W], [1, H, W] or [H, W]"
        )
    return found


def read_segments(path: Path, rows: int) -> Int32[np.ndarray, "c h w"]:
    """Row of the table of every pixel in every channel, -1 for none.

    Args:
        rows: length of the table.
    Raises:
        ValueError: ids that are no integers, or that half precision has rounded; and as `open_segments`.
    """
    found = open_segments(path)
    values = found.astype(np.float64)
    finite = np.isfinite(values)
    values[~finite] = -1
    broken = np.argwhere(values != np.round(values))
    if len(broken) > 0:
        channel, y, x = broken[0].tolist()
        raise InputError(
            f"segment map {path}: channel {channel}, row {y}, column {x} holds {values[channel, y, x]:g}, which is no "
            "id; the map was interpolated: make it again, with nearest neighbour"
        )
    if found.dtype.kind == "f" and found.dtype.itemsize == 2 and bool((values >= _LARGEST_HALF).any()):
        raise InputError(
            f"segment map {path} holds float16 with ids of {_LARGEST_HALF} and more, which are rounded; save it as "
            "float32"
        )
    past = values >= rows
    for wrong, what in ((~finite, "that are not finite"), (past, f"past the {rows} rows of its table")):
        if wrong.any():
            channels = listed(np.flatnonzero(wrong.any(axis=(1, 2))).tolist())
            ids = listed([f"{value:g}" for value in np.unique(found[wrong])])
            warnings.warn(
                f"segment map {path}: channels {channels} hold ids {what} ({ids}), in {int(wrong.sum())} pixels; they "
                "count as unlabelled",
                stacklevel=2,
            )
    return np.where(past | (values < 0), -1, values).astype(np.int32)


def open_table(path: Path) -> np.ndarray:
    """[T, D], mapped into memory, its values unchecked; raises as `open_segments`."""
    found = read_npy(path, "feature table")
    if found.dtype.kind != "f" or found.ndim != 2 or found.shape[1] < _SMALLEST_DIMENSION:
        raise InputError(
            f"feature table {path} holds {found.dtype} {found.shape}, expected floats [T, D], one CLIP vector per mask "
            "(codes of LangSplat's autoencoder, language_features_dim3, cannot be asked: give language_features)"
        )
    return found


def read_table(path: Path) -> tuple[Float32[Tensor, "t d"], Bool[Tensor, " t"]]:
    """Unit rows, and which of them are good; raises as `open_segments`.

    Rows of unit length stay as they are, bit for bit.
    """
    found = torch.from_numpy(np.array(open_table(path), dtype=np.float64))
    length = torch.linalg.vector_norm(found, dim=1)
    good = length.isfinite() & (length > _LEAST_LENGTH)
    unit = torch.where(((length - 1).abs() < UNIT_TOLERANCE / 2)[:, None], found, found / length[:, None])
    return torch.where(good[:, None], unit, 0.0).float(), good


def write_npy(path: Path, array: np.ndarray, overwrite: bool) -> None:
    """Writes an NPY file, completely or not at all; one of the same content is left alone.

    Raises:
        FileExistsError: a file of other content is there and `overwrite` is False.
    """
    buffer = io.BytesIO()
    np.save(buffer, array)
    content = buffer.getvalue()
    if os.path.lexists(path):
        if os.path.isfile(path) and path.read_bytes() == content:
            return
        if not overwrite:
            raise FileExistsError(f"{path} exists with other content; export to another folder, or --overwrite True")
    with new_file(path, overwrite=overwrite) as draft:
        draft.write_bytes(content)


def listed(values: Sequence[object]) -> str:
    """The first ten of some values, for a message."""
    return ", ".join(map(str, values[:10])) + (", ..." if len(values) > 10 else "")
