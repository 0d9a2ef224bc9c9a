"""Reading and writing of the files of LangSplat's preprocessing, including the variants that other programs produce.

Every image has two files. `<stem>_f.npy` holds one CLIP vector per mask, [T, D], from four consecutive lists of masks:
all SAM masks, subparts, parts and wholes. `<stem>_s.npy`, [4, H, W], holds for each list the row of that table that a
pixel belongs to, -1 for none. The reader also accepts:

* `_s` files of any float or integer type, with one channel or four;
* ids past the end of the table, NaN or negative ids, and table rows that are zero or not finite. These pixels have no
  region; the reader warns, except for negative ids.
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
_MAX_EXACT_HALF = 2048
"""Half precision cannot represent all integers above this one."""
_MIN_LENGTH = 1e-30
"""Shorter vectors count as zero, because their components have lost their precision."""
_MIN_DIMENSION = 16
"""LangSplat's autoencoder outputs 3 numbers; no CLIP model has so few."""


def open_segments(path: Path) -> np.ndarray:
    """Open a segment map, [C, H, W], memory-mapped; values are not checked.

    Raises:
        FileNotFoundError, ValueError: If the file does not exist, is damaged, or has another type or shape.
    """
    segments = read_npy(path, "segment map")
    segments = segments[None] if segments.ndim == 2 else segments
    shape_fits = segments.ndim == 3 and len(segments) in (1, len(LEVELS)) and segments.size > 0
    if segments.dtype.kind not in "fiu" or not shape_fits:
        raise InputError(
            f"segment map {path} holds {segments.dtype} {segments.shape}, expected numbers [4, H, W], [1, H, W] or "
            "[H, W]"
        )
    return segments


def read_segments(path: Path, rows: int) -> Int32[np.ndarray, "c h w"]:
    """Read the table row of every pixel in every channel; -1: none.

    Args:
        rows: Number of rows of the table.
    Raises:
        ValueError: If ids are not integers, or may have been rounded by half precision; and as `open_segments`.
    """
    segments = open_segments(path)
    values = segments.astype(np.float64)
    finite = np.isfinite(values)
    values[~finite] = -1
    fractional = np.argwhere(values != np.round(values))
    if len(fractional) > 0:
        channel, y, x = fractional[0].tolist()
        raise InputError(
            f"segment map {path}: channel {channel}, row {y}, column {x} holds {values[channel, y, x]:g}, which is "
            "not an id; the map was interpolated: make it again with nearest-neighbor interpolation"
        )
    if segments.dtype.kind == "f" and segments.dtype.itemsize == 2 and bool((values >= _MAX_EXACT_HALF).any()):
        raise InputError(
            f"segment map {path} holds float16 with ids of {_MAX_EXACT_HALF} or more, which float16 rounds; save it as "
            "float32"
        )
    past = values >= rows
    for invalid, problem in ((~finite, "that are not finite"), (past, f"past the {rows} rows of its table")):
        if invalid.any():
            channels = listed(np.flatnonzero(invalid.any(axis=(1, 2))).tolist())
            ids = listed([f"{value:g}" for value in np.unique(segments[invalid])])
            warnings.warn(
                f"segment map {path}: channels {channels} hold ids {problem} ({ids}), in {int(invalid.sum())} pixels; "
                "these count as unlabeled",
                stacklevel=2,
            )
    return np.where(past | (values < 0), -1, values).astype(np.int32)


def open_table(path: Path) -> np.ndarray:
    """Open a feature table, [T, D], memory-mapped; values are not checked. Raises as `open_segments`."""
    table = read_npy(path, "feature table")
    if table.dtype.kind != "f" or table.ndim != 2 or table.shape[1] < _MIN_DIMENSION:
        raise InputError(
            f"feature table {path} holds {table.dtype} {table.shape}, expected floats [T, D], one CLIP vector per mask "
            "(the autoencoder's codes in language_features_dim3 cannot be compared with text: give language_features)"
        )
    return table


def read_table(path: Path) -> tuple[Float32[Tensor, "t d"], Bool[Tensor, " t"]]:
    """Read the unit rows of a feature table, and which rows are valid; raises as `open_segments`.

    Rows of unit length are kept bit for bit.
    """
    table = torch.from_numpy(np.array(open_table(path), dtype=np.float64))
    length = torch.linalg.vector_norm(table, dim=1)
    valid = length.isfinite() & (length > _MIN_LENGTH)
    unit = torch.where(((length - 1).abs() < UNIT_TOLERANCE / 2)[:, None], table, table / length[:, None])
    return torch.where(valid[:, None], unit, 0.0).float(), valid


def write_npy(path: Path, array: np.ndarray, overwrite: bool) -> None:
    """Write an NPY file atomically; an existing file with the same content is left alone.

    Raises:
        FileExistsError: If the file exists with other content, and `overwrite` is False.
    """
    buffer = io.BytesIO()
    np.save(buffer, array)
    content = buffer.getvalue()
    if os.path.lexists(path):
        if os.path.isfile(path) and path.read_bytes() == content:
            return
        if not overwrite:
            raise FileExistsError(
                f"{path} exists with other content; export to another folder, or give --overwrite True"
            )
    with new_file(path, overwrite=overwrite) as draft:
        draft.write_bytes(content)


def listed(values: Sequence[object]) -> str:
    """Return the first ten values as text, for messages."""
    return ", ".join(map(str, values[:10])) + (", ..." if len(values) > 10 else "")
