"""Splats in PLY files written by Inria's trainer, gsplat, ns-export or this package."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from plyfile import PlyData, PlyParseError

from normlift_ns.errors import InputError
from normlift_ns.options import RasterizeMode
from normlift_ns.scenes.splat import DEGREES, Splat, check_splat

_MAX_HEADER_BYTES = 2**20
_PLY_BLOCK_ROWS = 2**18
"""Number of Gaussians read at a time."""
_REQUIRED = (
    *"xyz",
    *(f"f_dc_{i}" for i in range(3)),
    "opacity",
    *(f"scale_{i}" for i in range(3)),
    *(f"rot_{i}" for i in range(4)),
)
_MODES: dict[str, RasterizeMode] = {
    "mip": "antialiased", "antialiased": "antialiased", "classic": "classic", "default": "classic",
}  # fmt: skip


class PlySplat(NamedTuple):
    """Contents of a PLY file."""

    splat: Splat
    rasterize_mode: RasterizeMode | None
    """Value of the comment SplatRenderMode; None if there is no such comment or its value is unknown."""


def read_ply(path: Path) -> PlySplat:
    """Read a splat. Its properties may be in any order; other properties are ignored.

    Peak memory is a little more than one copy of the Gaussians.

    Raises:
        FileNotFoundError: if there is no such file.
        ValueError: if the file is not a PLY file, is truncated, does not hold a splat or has Gaussians that cannot be
            drawn. The number of spherical harmonics must match a degree.
    """
    if not path.is_file():
        raise FileNotFoundError(f"There is no PLY file at {path}. Give the file of the splat with --load-ply.")
    check_header(path)
    try:
        data = PlyData.read(str(path), mmap="c")
    except UnicodeDecodeError as error:
        raise InputError(
            f"The header of {path} has non-ASCII characters, perhaps in a comment ({error}). Remove them, or rewrite "
            f"the file, for example with: splat-transform {path.name} clean.ply"
        ) from error
    except (PlyParseError, ValueError, OSError, EOFError, MemoryError, OverflowError) as error:
        if path.open("rb").read(3) == b"ply":
            raise InputError(
                f"{path} is truncated or damaged ({' '.join(str(error).split())}): its {path.stat().st_size:,} bytes "
                "do not match its header. Copy it again."
            ) from error
        raise InputError(
            f"{path} cannot be read as a PLY file ({' '.join(str(error).split())}). Expected a splat in PLY format; "
            "splat-transform converts other formats, for example: splat-transform scene.sog scene.ply"
        ) from error
    elements = {element.name: element for element in data.elements}
    vertex = elements.get("vertex")
    if vertex is None or vertex.count == 0:
        raise InputError(f"{path} has no vertices, so it is not a splat. Give the PLY file of a trained splat.")
    names = {item.name for item in vertex.properties}
    if "packed_position" in names:
        raise InputError(
            f"{path} is a compressed PLY file. Expand it with: splat-transform {path.name} scene.ply, and give that."
        )
    missing = [name for name in _REQUIRED if name not in names]
    if missing:
        raise InputError(
            f"{path} is not a splat: its {vertex.count:,} vertices lack {', '.join(missing)}. Expected the properties "
            f"x y z, f_dc_*, f_rest_*, opacity, scale_* and rot_*; found "
            f"{', '.join([item for item in sorted(names) if not item.startswith('f_rest_')][:16])}. {_advice(missing)}"
        )
    lists = [item.name for item in vertex.properties if item.name in _REQUIRED and hasattr(item, "len_dtype")]
    if lists:
        raise InputError(f"{path} is not a splat: {', '.join(lists)} are lists, expected one number per Gaussian.")
    splat = _read_columns(path, vertex.data, _rest_names(path, names))
    check_splat(splat, path)
    return PlySplat(splat, _mode([*data.comments, *vertex.comments]))


def check_header(path: Path) -> None:
    """Raise if the file is too small for the rows that its header declares, which are allocated before reading.

    Raises:
        ValueError: if the header is invalid or declares more data than the file holds.
    """
    size = path.stat().st_size
    with path.open("rb") as file:
        header = file.read(_MAX_HEADER_BYTES).partition(b"end_header")[0]
    lines = [line.split() for line in header.replace(b"\r", b"\n").split(b"\n")]
    declared = 0
    for i, words in enumerate(lines):
        if words[:1] != [b"element"]:
            continue
        rest = lines[i + 1 :]
        end = next((j for j, other in enumerate(rest) if other[:1] == [b"element"]), len(rest))
        properties = sum(other[:1] == [b"property"] for other in rest[:end])
        count = words[2] if len(words) == 3 else b""
        if not count.isdigit() or len(count) > 18 or (properties == 0 and int(count) > 0):
            raise InputError(
                f"{path} is truncated or damaged: its header has the line {b' '.join(words)[:80]!r} with {properties} "
                "properties. Expected a splat in PLY format; copy it again."
            )
        declared += int(count) * properties  # a property takes at least one byte
    if declared > size:
        raise InputError(
            f"{path} is truncated or damaged: its header declares {declared:,} numbers, but the file has only "
            f"{size:,} bytes. Copy it again."
        )


def _advice(missing: list[str]) -> str:
    if missing == ["scale_2"]:
        return "2D Gaussians, which have two scales, are not supported; train the scene with 3D Gaussians."
    if all(name.startswith("f_dc_") for name in missing):
        return "Its colors are not spherical harmonics; export it again with f_dc_*."
    return "Give the PLY file that its trainer or ns-export gaussian-splat wrote, not the initial point cloud."


def _rest_names(path: Path, names: set[str]) -> list[str]:
    """Return f_rest_0, f_rest_1, … in order."""
    count = sum(name.startswith("f_rest_") for name in names)
    expected = [f"f_rest_{i}" for i in range(count)]
    if count % 3 != 0 or count // 3 not in DEGREES or not set(expected) <= names:
        counts = ", ".join(f"{3 * k} (degree {degree})" for k, degree in DEGREES.items())
        raise InputError(
            f"{path} has {count} properties f_rest_*, which matches no degree of spherical harmonics. Expected "
            f"f_rest_0, f_rest_1, … with one of the counts {counts}. Export the scene again."
        )
    return expected


def _read_columns(path: Path, table: np.ndarray, rest: list[str]) -> Splat:
    n, k = len(table), len(rest) // 3
    groups = {
        "means": ["x", "y", "z"],
        "quats": [f"rot_{i}" for i in range(4)],
        "scales": [f"scale_{i}" for i in range(3)],
        "opacities": ["opacity"],
        "features_dc": [f"f_dc_{i}" for i in range(3)],
    }
    columns = {name: torch.empty(n, len(group)) for name, group in groups.items()}
    harmonics = torch.empty(n, k, 3)
    for start, rows in _blocks(path, table):
        for name, group in groups.items():
            for i, column in enumerate(group):
                columns[name].numpy()[start : start + len(rows), i] = rows[column]
        for i, column in enumerate(rest):  # all of red, then green, then blue
            harmonics.numpy()[start : start + len(rows), i % k, i // k] = rows[column]
    return Splat(**columns, features_rest=harmonics)


def _blocks(path: Path, table: np.ndarray) -> Iterator[tuple[int, np.ndarray]]:
    """Yield blocks of rows, each with the index of its first row.

    Blocks are read rather than mapped, because mapped pages count as memory of the process.
    """
    with path.open("rb") as file:
        is_mapped = isinstance(table, np.memmap)
        if isinstance(table, np.memmap):
            file.seek(table.offset)
        for start in range(0, len(table), _PLY_BLOCK_ROWS):
            count = min(_PLY_BLOCK_ROWS, len(table) - start)
            yield start, np.fromfile(file, table.dtype, count) if is_mapped else table[start : start + count]


def _mode(comments: list[str]) -> RasterizeMode | None:
    for comment in comments:
        key, _, value = comment.partition(":")
        if key.strip().lower() == "splatrendermode":
            return _MODES.get(value.strip().lower())
    return None
