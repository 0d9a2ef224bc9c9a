"""One column of the vertices of a PLY file, whose header is held against the size of the file before it is believed."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np

from normlift_ns.errors import InputError

_LONGEST_HEADER = 2**16
_TYPES = {
    "char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4", "float": "f4",
    "double": "f8", "int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2", "int32": "i4", "uint32": "u4",
    "float32": "f4", "float64": "f8",
}  # fmt: skip
_ORDERS = {"binary_little_endian": "<", "binary_big_endian": ">", "ascii": "="}


def read_column(path: Path, name: str) -> np.ndarray:
    """A property of all vertices.

    Raises:
        ValueError: no PLY file, one that begins with something else than vertices, has no such property, or is shorter
            than its header says.
        OSError: it cannot be read.
    """
    with path.open("rb") as file:
        start = file.read(_LONGEST_HEADER)
        end = start.find(b"end_header")
        body = start.find(b"\n", end) + 1
        if not start.startswith(b"ply") or end < 0 or body == 0:
            raise InputError("it has no header of a PLY file")
        encoding, count, table = _header(start[:end].decode("ascii"))
        if name not in (table.names or ()):
            raise InputError(f"its vertices have no property {name} (found {', '.join(table.names or ['none'])})")
        size, least = os.fstat(file.fileno()).st_size - body, table.itemsize
        if encoding == "ascii":
            least = 2 * len(table.names or ())  # a digit, and what parts it from the next one
        if not 0 < count <= (size + 1) // least:
            raise InputError(
                f"its header names {count:,} vertices, for which its {size:,} bytes are too few or too many"
            )
        file.seek(body)
        if encoding != "ascii":
            return np.fromfile(file, table, count)[name]
        found = np.loadtxt(file, ndmin=2, max_rows=count, usecols=(table.names or ()).index(name))[:, 0]
        if len(found) != count:
            raise InputError(f"its header names {count:,} vertices, but it has {len(found):,}")
        return found


def _header(text: str) -> tuple[str, int, np.dtype]:
    """Encoding, number of vertices and the row of one."""
    encoding, count, fields = "", -1, []
    for line in text.splitlines()[1:]:
        match line.split():
            case ["format", found, *_] if found in _ORDERS:
                encoding = found
            case ["element", _, _] if count >= 0:
                break  # what follows the vertices
            case ["element", "vertex", digits] if digits.isdigit() and len(digits) < 16:
                count = int(digits)
            case ["property", kind, name] if kind in _TYPES and count >= 0 and encoding != "":
                fields.append((name, _ORDERS[encoding] + _TYPES[kind]))
            case [] | ["comment" | "obj_info", *_]:
                pass
            case _:
                raise InputError(f"its header has the line {line[:80]!r}, expected numbers of vertices first")
    if count < 0 or len(fields) == 0:
        raise InputError("its header names no vertices, or no numbers of them")
    return encoding, count, np.dtype(fields)
