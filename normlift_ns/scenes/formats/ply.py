"""Splats in PLY files, as Inria's trainer, gsplat, ns-export and this package write them."""

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

_LONGEST_HEADER = 2**20
_ROWS = 2**18
"""Gaussians read at a time."""
_NEEDED = (
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
    """What a PLY file says."""

    splat: Splat
    rasterize_mode: RasterizeMode | None
    """As the comment SplatRenderMode says; None: there is none, or an unknown one."""


def read_ply(path: Path) -> PlySplat:
    """Reads a splat; properties may stand in any order, others than a splat's are ignored.

    Memory: a little more than the Gaussians once.

    Raises:
        FileNotFoundError: no such file.
        ValueError: no PLY file, a truncated one, no splat, a number of harmonics that fits no degree, values that
            nothing could draw.
    """
    if not path.is_file():
        raise FileNotFoundError(f"There is no PLY file at {path}. Give the file of the splat with --load-ply.")
    check_header(path)
    try:
        found = PlyData.read(str(path), mmap="c")
    except UnicodeDecodeError as error:
        raise InputError(
            f"The header of {path} has characters beyond ASCII, perhaps in a comment ({error}). Remove them from it, "
            f"or write the file again, for example with: splat-transform {path.name} clean.ply"
        ) from error
    except (PlyParseError, ValueError, OSError, EOFError, MemoryError, OverflowError) as error:
        if path.open("rb").read(3) == b"ply":
            raise InputError(
                f"{path} is truncated or damaged ({' '.join(str(error).split())}): its {path.stat().st_size:,} bytes "
                "do not hold what its header says. Copy it again."
            ) from error
        raise InputError(
            f"{path} cannot be read as a PLY file ({' '.join(str(error).split())}). Expected a splat in the PLY "
            "format; splat-transform turns other formats into it, for example: splat-transform scene.sog scene.ply"
        ) from error
    elements = {element.name: element for element in found.elements}
    vertex = elements.get("vertex")
    if vertex is None or vertex.count == 0:
        raise InputError(f"{path} has no vertices, so it is no splat. Give the PLY file of a trained splat.")
    names = {item.name for item in vertex.properties}
    if "packed_position" in names:
        raise InputError(
            f"{path} is a compressed PLY file. Expand it first: splat-transform {path.name} scene.ply, then give that."
        )
    missing = [name for name in _NEEDED if name not in names]
    if missing:
        raise InputError(
            f"{path} is no splat: its {vertex.count:,} vertices have no {', '.join(missing)}. Expected the properties "
            f"x y z, f_dc_*, f_rest_*, opacity, scale_* and rot_*; found "
            f"{', '.join([item for item in sorted(names) if not item.startswith('f_rest_')][:16])}. {_advice(missing)}"
        )
    lists = [item.name for item in vertex.properties if item.name in _NEEDED and hasattr(item, "len_dtype")]
    if lists:
        raise InputError(f"{path} is no splat: {', '.join(lists)} are lists, expected one number per Gaussian.")
    splat = _read_columns(path, vertex.data, _rest_names(path, names))
    check_splat(splat, path)
    return PlySplat(splat, _mode([*found.comments, *vertex.comments]))


def check_header(path: Path) -> None:
    """The rows that a header promises must fit into the file: they would be allocated before they are read."""
    size = path.stat().st_size
    with path.open("rb") as file:
        head = file.read(_LONGEST_HEADER).partition(b"end_header")[0]
    words = [line.split() for line in head.replace(b"\r", b"\n").split(b"\n")]
    promised = 0
    for i, line in enumerate(words):
        if line[:1] != [b"element"]:
            continue
        rest = words[i + 1 :]
        end = next((j for j, other in enumerate(rest) if other[:1] == [b"element"]), len(rest))
        properties = sum(other[:1] == [b"property"] for other in rest[:end])
        count = line[2] if len(line) == 3 else b""
        if not count.isdigit() or len(count) > 18 or (properties == 0 and int(count) > 0):
            raise InputError(
                f"{path} is truncated or damaged: its header has the line {b' '.join(line)[:80]!r} with {properties} "
                "properties. Expected a splat in the PLY format; copy it again."
            )
        promised += int(count) * properties  # a property takes at least one byte
    if promised > size:
        raise InputError(
            f"{path} is truncated or damaged: its {size:,} bytes do not hold what its header says, {promised:,} "
            "numbers. Copy it again."
        )


def _advice(missing: list[str]) -> str:
    if missing == ["scale_2"]:
        return "2D Gaussians have two scales, and are not read; train the scene with 3D Gaussians."
    if all(name.startswith("f_dc_") for name in missing):
        return "Its colours are not spherical harmonics; export it again with f_dc_*."
    return "Give the PLY file that its trainer or ns-export gaussian-splat wrote, not the point cloud it began with."


def _rest_names(path: Path, names: set[str]) -> list[str]:
    """f_rest_0, f_rest_1, … in their order."""
    count = sum(name.startswith("f_rest_") for name in names)
    wanted = [f"f_rest_{i}" for i in range(count)]
    if count % 3 != 0 or count // 3 not in DEGREES or not set(wanted) <= names:
        fitting = ", ".join(f"{3 * k} (degree {degree})" for k, degree in DEGREES.items())
        raise InputError(
            f"{path} has {count} properties f_rest_*, which fits no degree of spherical harmonics. Expected "
            f"f_rest_0, f_rest_1, … and so on, as many as {fitting}. Export the scene again."
        )
    return wanted


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
    """Rows from a first one on; read, not mapped, as mapped pages count as memory of the process."""
    with path.open("rb") as file:
        if isinstance(table, np.memmap):
            file.seek(table.offset)
        for start in range(0, len(table), _ROWS):
            count = min(_ROWS, len(table) - start)
            mapped = isinstance(table, np.memmap)
            yield start, np.fromfile(file, table.dtype, count) if mapped else table[start : start + count]


def _mode(comments: list[str]) -> RasterizeMode | None:
    for comment in comments:
        key, _, value = comment.partition(":")
        if key.strip().lower() == "splatrendermode":
            return _MODES.get(value.strip().lower())
    return None
