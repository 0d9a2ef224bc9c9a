"""Reader of one vertex property of a PLY file, which validates the header against the file size."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np

from normlift_ns.errors import InputError

_MAX_HEADER = 2**16
_TYPES = {
    "char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4", "float": "f4",
    "double": "f8", "int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2", "int32": "i4", "uint32": "u4",
    "float32": "f4", "float64": "f8",
}  # fmt: skip
_BYTE_ORDERS = {"binary_little_endian": "<", "binary_big_endian": ">", "ascii": "="}


def read_column(path: Path, name: str) -> np.ndarray:
    """Read a property of all vertices.

    Raises:
        ValueError: the file is not a PLY file, does not begin with vertices, lacks the property, or is shorter than its
            header says.
        OSError: the file cannot be read.
    """
    with path.open("rb") as file:
        start = file.read(_MAX_HEADER)
        end = start.find(b"end_header")
        body = start.find(b"\n", end) + 1
        if not start.startswith(b"ply") or end < 0 or body == 0:
            raise InputError("it has no PLY header")
        encoding, count, table = _header(start[:end].decode("ascii"))
        if name not in (table.names or ()):
            raise InputError(f"its vertices have no property {name} (found {', '.join(table.names or ['none'])})")
        size, least = os.fstat(file.fileno()).st_size - body, table.itemsize
        if encoding == "ascii":
            least = 2 * len(table.names or ())  # a digit and a separator
        if not 0 < count <= (size + 1) // least:
            raise InputError(f"its header declares {count:,} vertices, which does not fit its size of {size:,} bytes")
        file.seek(body)
        if encoding != "ascii":
            return np.fromfile(file, table, count)[name]
        column = np.loadtxt(file, ndmin=2, max_rows=count, usecols=(table.names or ()).index(name))[:, 0]
        if len(column) != count:
            raise InputError(f"its header declares {count:,} vertices, but it has {len(column):,}")
        return column


def _header(text: str) -> tuple[str, int, np.dtype]:
    """Return the encoding, the number of vertices and the type of a vertex."""
    encoding, count, fields = "", -1, []
    for line in text.splitlines()[1:]:
        match line.split():
            case ["format", name, *_] if name in _BYTE_ORDERS:
                encoding = name
            case ["element", _, _] if count >= 0:
                break  # the elements after the vertices
            case ["element", "vertex", digits] if digits.isdigit() and len(digits) < 16:
                count = int(digits)
            case ["property", kind, name] if kind in _TYPES and count >= 0 and encoding != "":
                fields.append((name, _BYTE_ORDERS[encoding] + _TYPES[kind]))
            case [] | ["comment" | "obj_info", *_]:
                pass
            case _:
                raise InputError(f"its header has the line {line[:80]!r}, expected vertices with numbers first")
    if count < 0 or len(fields) == 0:
        raise InputError("its header declares no vertices, or vertices without numbers")
    return encoding, count, np.dtype(fields)
