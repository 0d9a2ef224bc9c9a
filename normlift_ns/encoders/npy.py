"""Safe reading of NPY files without NumPy's own parser: headers are checked before anything is allocated, and nothing
in a file is executed."""

from __future__ import annotations

import ast
import io
import math
import os
from pathlib import Path
from typing import IO, NamedTuple

import numpy as np

from normlift_ns.errors import InputError

_MAGIC = b"\x93NUMPY"
_MAX_HEADER_BYTES = 4096
"""In bytes; headers of numeric arrays have 118."""
_NUMERIC_KINDS = "biuf"
"""Booleans, integers and floats, of at most 64 bits."""


class _Header(NamedTuple):
    dtype: np.dtype
    shape: tuple[int, ...]
    order: str


def read_npy(path: Path, what: str) -> np.ndarray:
    """Return the numeric array in an NPY file, memory-mapped and read-only.

    Args:
        what: Kind of file, for messages.
    Raises:
        FileNotFoundError: If the file does not exist.
        ValueError: If the file is not an NPY file, holds anything but numbers, or is shorter or longer than its header
            says.
    """
    if not os.path.isfile(path):
        if os.path.lexists(path):
            raise InputError(f"{what} {path} is not a file; expected an NPY file as written by numpy.save")
        raise FileNotFoundError(f"{what} {path} does not exist; check the folder")
    try:
        with path.open("rb") as file:
            header = read_header(file)
            start, end = file.tell(), file.seek(0, os.SEEK_END)
        check_size(header, end - start)
        if 0 in header.shape:
            return np.empty(header.shape, header.dtype)
        return np.memmap(path, header.dtype, "r", start, header.shape, header.order)  # pyright: ignore[reportCallIssue, reportArgumentType]
    except (OSError, ValueError) as error:
        raise InputError(
            f"{what} {path} is damaged or not an NPY file ({error}); write it again with numpy.save"
        ) from None


def read_header(file: IO[bytes]) -> _Header:
    """Read the header of an array, up to the first byte of its data.

    Raises:
        ValueError: If the header is not that of a numeric array.
    """
    start = file.read(8)
    if start[:6] != _MAGIC or len(start) < 8 or start[6] not in (1, 2, 3):
        raise InputError("it does not begin like an NPY file of version 1 to 3")
    size = file.read(2 if start[6] == 1 else 4)
    length = int.from_bytes(size, "little")
    text = file.read(length) if length <= _MAX_HEADER_BYTES else b""
    if len(size) < 2 or len(text) != length:
        raise InputError(f"its header should have {length} bytes, of which {len(text)} can be read")
    try:
        fields = ast.literal_eval(text.decode("latin1").strip())
        descr, fortran, shape = fields["descr"], fields["fortran_order"], fields["shape"]
        if not isinstance(descr, str) or not isinstance(fortran, bool) or not isinstance(shape, tuple):
            raise InputError("it holds objects or records, expected plain numbers")
        dtype = np.dtype(descr)
    except InputError:
        raise
    except (ValueError, TypeError, KeyError, IndexError, SyntaxError, MemoryError, RecursionError) as error:
        raise InputError(f"its header cannot be read: {type(error).__name__}") from None
    if dtype.kind not in _NUMERIC_KINDS or dtype.itemsize > 8:
        kind = "objects" if dtype.hasobject else str(dtype)
        raise InputError(f"it holds {kind}; expected integers or floats")
    if not all(type(length) is int and length >= 0 for length in shape) or len(shape) > 8:
        raise InputError(f"its header has the invalid shape {str(shape)[:80]}")
    return _Header(dtype, shape, "F" if fortran else "C")


def check_size(header: _Header, size: int) -> None:
    """Raise ValueError unless the data has as many bytes as the header says."""
    expected = math.prod(header.shape) * header.dtype.itemsize
    if expected != size:
        shape = " x ".join(map(str, header.shape))
        raise InputError(f"{shape[:80]} {header.dtype} needs {expected:,} bytes, found {size:,}")


def read_array(data: bytes) -> np.ndarray:
    """Read an NPY file in memory; raises as `read_header`, and ValueError if its size differs from its header."""
    file = io.BytesIO(data)
    header = read_header(file)
    check_size(header, len(data) - file.tell())
    values = np.frombuffer(data, header.dtype, offset=file.tell()).astype(header.dtype.newbyteorder("="))
    return values.reshape(header.shape, order=header.order)  # pyright: ignore[reportArgumentType, reportCallIssue]
