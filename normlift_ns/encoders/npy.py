"""NPY files that others wrote, read without NumPy's own parser: their headers are checked before anything is allocated,
and nothing in them is ever run."""

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
_LONGEST_HEADER = 4096
"""Bytes; those of arrays of numbers have 118."""
_KINDS = "biuf"
"""Booleans, integers and floats, of 64 bits at most."""


class _Header(NamedTuple):
    dtype: np.dtype
    shape: tuple[int, ...]
    order: str


def read_npy(path: Path, what: str) -> np.ndarray:
    """The array of numbers in an NPY file, mapped into memory and read-only.

    Args:
        what: what the file is, for the message.
    Raises:
        FileNotFoundError: no such file.
        ValueError: a file that is no NPY file, holds something else than numbers, or is shorter or longer than its
            header says.
    """
    if not os.path.isfile(path):
        if os.path.lexists(path):
            raise InputError(f"{what} {path} is no file; expected an NPY file, as numpy.save writes it")
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
        raise InputError(f"{what} {path} is damaged or no NPY file ({error}); write it again with numpy.save") from None


def read_header(file: IO[bytes]) -> _Header:
    """The header of an array, up to where its numbers begin.

    Raises:
        ValueError: no header of an array of numbers.
    """
    start = file.read(8)
    if start[:6] != _MAGIC or len(start) < 8 or start[6] not in (1, 2, 3):
        raise InputError("it does not begin as NPY files of version 1 to 3 do")
    size = file.read(2 if start[6] == 1 else 4)
    length = int.from_bytes(size, "little")
    text = file.read(length) if length <= _LONGEST_HEADER else b""
    if len(size) < 2 or len(text) != length:
        raise InputError(f"its header is of {length} bytes, of which {len(text)} can be read")
    try:
        found = ast.literal_eval(text.decode("latin1").strip())
        described, fortran, shape = found["descr"], found["fortran_order"], found["shape"]
        if not isinstance(described, str) or not isinstance(fortran, bool) or not isinstance(shape, tuple):
            raise InputError("it holds objects or records, expected plain numbers")
        dtype = np.dtype(described)
    except InputError:
        raise
    except (ValueError, TypeError, KeyError, IndexError, SyntaxError, MemoryError, RecursionError) as error:
        raise InputError(f"its header cannot be read: {type(error).__name__}") from None
    if dtype.kind not in _KINDS or dtype.itemsize > 8:
        kind = "objects" if dtype.hasobject else str(dtype)
        raise InputError(f"it holds {kind}; expected an integer type or floats")
    if not all(type(length) is int and length >= 0 for length in shape) or len(shape) > 8:
        raise InputError(f"its header has the shape {str(shape)[:80]}")
    return _Header(dtype, shape, "F" if fortran else "C")


def check_size(header: _Header, found: int) -> None:
    """Raises ValueError unless an array has as many bytes as its header says."""
    expected = math.prod(header.shape) * header.dtype.itemsize
    if expected != found:
        shape = " x ".join(map(str, header.shape))
        raise InputError(f"{shape[:80]} {header.dtype} take {expected:,} bytes, found {found:,}")


def read_array(data: bytes) -> np.ndarray:
    """The array of an NPY file in memory; raises as `read_header`, and ValueError for another size than it says."""
    file = io.BytesIO(data)
    header = read_header(file)
    check_size(header, len(data) - file.tell())
    values = np.frombuffer(data, header.dtype, offset=file.tell()).astype(header.dtype.newbyteorder("="))
    return values.reshape(header.shape, order=header.order)  # pyright: ignore[reportArgumentType, reportCallIssue]
