"""Compressed PLY files of PlayCanvas, with chunks of 256 Gaussians and 16 bytes per Gaussian.

Each chunk stores the bounds of its values. Spherical harmonics take one additional byte per coefficient. The format
is that of https://github.com/playcanvas/splat-transform.
"""

from __future__ import annotations

import io
from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float, Int64, UInt8
from plyfile import PlyData, PlyElement
from torch import Tensor
from torch.nn.functional import normalize

from normlift_ns.core.gaussians import SH_C0
from normlift_ns.errors import InputError

PACKED = "packed_position"
"""Vertex property that only compressed PLY files have."""
_CHUNK_ROWS = 256
_VERTEX = (PACKED, "packed_rotation", "packed_scale", "packed_color")
_BOUNDS = {
    group: tuple(f"{end}_{column}" for end in ("min", "max") for column in columns)
    for group, columns in {
        "means": ("x", "y", "z"),
        "scales": ("scale_x", "scale_y", "scale_z"),
        "colors": ("r", "g", "b"),
    }.items()
}
_POSITION_BITS = (11, 10, 11)
_MAX_LOG_SCALE = 20.0
_MAX_HARMONICS = 15
"""Number of spherical harmonics of degrees 1 to 3, per color channel."""
_SH_RANGE = 8.0
"""Width of the range of stored spherical harmonics, -4..4."""


class CompressedPly(NamedTuple):
    """Content of a compressed PLY file, with the order of its Gaussians."""

    data: bytes
    rows: Int64[np.ndarray, " n"]
    """For each Gaussian in the file, its row in the original splat."""
    rounding: str
    """Message about the rounding errors of the file."""


def unpack_compressed_ply(data: PlyData, path: Path) -> tuple[dict[str, Tensor], str]:
    """Return the parameters in a compressed PLY file, by splatfacto's names, and a message about rounding errors.

    Raises:
        ValueError: Elements or properties are missing, have the wrong type, or do not match in number.
    """
    elements = {element.name: element.data for element in data.elements}
    chunk, vertex, harmonics = elements.get("chunk"), elements["vertex"], elements.get("sh")
    n = len(vertex)
    _check_element(path, "chunk", chunk, (*_BOUNDS["means"], *_BOUNDS["scales"]), "f")
    _check_element(path, "vertex", vertex, _VERTEX, "u")
    assert chunk is not None
    if n > len(chunk) * _CHUNK_ROWS or (harmonics is not None and len(harmonics) != n):
        extra = "" if harmonics is None else f", spherical harmonics: {len(harmonics):,}"
        raise _unmatched(path, f"its numbers of rows do not match (Gaussians: {n:,}, chunks: {len(chunk):,}{extra})")
    words = {name: torch.from_numpy(vertex[name].astype(np.int64)) for name in _VERTEX}
    rotation, color = words["packed_rotation"], _units(words["packed_color"], (8, 8, 8, 8))
    means, scales = (_bounds(chunk, group, n) for group in ("means", "scales"))
    parameters = {
        "means": torch.lerp(*means, _units(words[PACKED], _POSITION_BITS)),
        "scales": torch.lerp(*scales, _units(words["packed_scale"], _POSITION_BITS)),
        "quats": join_largest(rotation >> 30, (_units(rotation, (10, 10, 10)) - 0.5) * 2**0.5),
        "opacities": opacity_logits(color[:, 3:]),
        "features_dc": (_colors(chunk, color[:, :3], path) - 0.5) / SH_C0,
        "features_rest": _unpack_harmonics(path, harmonics, n),
    }
    return parameters, _rounding(path.name, means[1] - means[0], scales[1] - scales[0])


def encode_compressed_ply(parameters: Mapping[str, Tensor], name: str, comments: tuple[str, ...] = ()) -> CompressedPly:
    """Sort Gaussians into chunks that cover small boxes, and encode them as a compressed PLY file.

    Opacities and color channels have 8 bits, and the three smaller components of a quaternion have 10 bits each.
    Coordinates and logarithms of scales have 10 or 11 bits for their range in a chunk. Spherical harmonics have steps
    of 1/32 between -4 and 4.

    Args:
        parameters: Finite parameters by splatfacto's names. Spherical harmonics of degree 4 are left out.
        name: Name of the file, for `CompressedPly.rounding`.
        comments: Comments for the header of the file.
    """
    rows = _chunk_order(parameters["means"].detach().cpu().numpy())
    values = {key: value.detach().cpu().double()[rows] for key, value in parameters.items()}
    colors = values["features_dc"] * SH_C0 + 0.5
    scales = values["scales"].clamp(-_MAX_LOG_SCALE, _MAX_LOG_SCALE)
    index, others = split_largest(normalize_quats(values["quats"]))
    unit_rotation = others / 2**0.5 + 0.5
    chunk, units, ranges = {}, {}, []
    for group, column in (("means", values["means"]), ("scales", scales), ("colors", colors)):
        low, high = _chunk_bounds(column)
        chunk |= dict(zip(_BOUNDS[group], torch.cat([low, high], dim=1).T))
        spread = [bound.repeat_interleave(_CHUNK_ROWS, 0)[: len(rows)].double() for bound in (low, high)]
        ranges.append(high - low)
        units[group] = ((column - spread[0]) / (spread[1] - spread[0])).nan_to_num().clamp(0, 1)
    color = torch.cat([units["colors"], values["opacities"].sigmoid()], dim=1)
    words = (
        _words(units["means"], _POSITION_BITS),
        index << 30 | _words(unit_rotation, (10, 10, 10)),
        _words(units["scales"], _POSITION_BITS),
        _words(color, (8, 8, 8, 8)),
    )
    elements = [
        _element("chunk", {key: value.numpy() for key, value in chunk.items()}, "<f4"),
        _element("vertex", {key: word.numpy() for key, word in zip(_VERTEX, words)}, "<u4"),
    ]
    rest = (
        values["features_rest"][:, :_MAX_HARMONICS].transpose(1, 2).reshape(len(rows), -1)
    )  # all coefficients of red, then green, then blue
    if rest.shape[1] > 0:
        packed = to_bytes(((rest / _SH_RANGE + 0.5) * 256).floor())
        elements.append(_element("sh", {f"f_rest_{i}": packed[:, i] for i in range(rest.shape[1])}, "u1"))
    buffer = io.BytesIO()
    PlyData(elements, byte_order="<", comments=list(comments)).write(buffer)
    return CompressedPly(buffer.getvalue(), rows, _rounding(name, *ranges[:2]))


def _rounding(name: str, means: Float[Tensor, "n 3"], scales: Float[Tensor, "n 3"]) -> str:
    """Return a message about rounding errors, given the ranges of positions and log scales in each chunk."""
    steps = 2 * (2 ** min(_POSITION_BITS) - 1)
    errors = means.amax(dim=1).sort().values / steps
    most = float(errors[(len(errors) * 99 - 1) // 100])
    return (
        f"{name} contains rounded numbers. Maximum errors: {most:.2g} for 99% of the positions and "
        f"{float(errors[-1]):.2g} for all, {float(scales.max()) / steps:.2g} for logarithms of scales, "
        "0.005 radians for rotations, and 0.002 for opacities."
    )


def _check_element(path: Path, element: str, table: np.ndarray | None, names: tuple[str, ...], kind: str) -> None:
    """Raise InputError unless a table has the named properties, with numbers of a NumPy kind such as "f"."""
    types = {} if table is None else {name: table.dtype[name] for name in table.dtype.names or ()}
    wrong = [name for name in names if name not in types or types[name].kind != kind]
    if len(wrong) > 0:
        raise _unmatched(path, f"properties of the element {element!r} are missing or not valid ({', '.join(wrong)})")


def _unmatched(path: Path, problem: str) -> InputError:
    return InputError(
        f"{path} is a damaged compressed PLY file: {problem}. Write it again, or give the uncompressed PLY file."
    )


def _bounds(chunk: np.ndarray, group: str, n: int) -> tuple[Float[Tensor, "n 3"], Float[Tensor, "n 3"]]:
    """Return, for each Gaussian, the lower and the upper bounds of its chunk."""
    table = torch.from_numpy(np.stack([chunk[name].astype(np.float32) for name in _BOUNDS[group]], axis=1))
    rows = table.repeat_interleave(_CHUNK_ROWS, 0)[:n]
    return rows[:, :3], rows[:, 3:]


def _colors(chunk: np.ndarray, units: Float[Tensor, "n 3"], path: Path) -> Float[Tensor, "n 3"]:
    if _BOUNDS["colors"][0] not in (chunk.dtype.names or ()):  # the first version of the format had no color bounds
        return units
    _check_element(path, "chunk", chunk, _BOUNDS["colors"], "f")
    return torch.lerp(*_bounds(chunk, "colors", len(units)), units)


def _unpack_harmonics(path: Path, table: np.ndarray | None, n: int) -> Float[Tensor, "n k 3"]:
    names = () if table is None else tuple(f"f_rest_{i}" for i in range(len(table.dtype.names or ())))
    if table is None or len(names) == 0:
        return torch.zeros(n, 0, 3)
    _check_element(path, "sh", table, names, "u")
    if len(names) not in (9, 24, 45, 72):
        raise _unmatched(path, f"it has {len(names)} spherical harmonics, expected 9, 24, 45 or 72")
    packed = torch.from_numpy(np.stack([table[name].astype(np.float32) for name in names], axis=1))
    units = torch.where(packed == 0, 0.0, torch.where(packed == 255, 1.0, (packed + 0.5) / 256))
    return ((units - 0.5) * _SH_RANGE).reshape(n, 3, -1).transpose(1, 2).contiguous()


def _units(words: Int64[Tensor, " n"], bits: tuple[int, ...]) -> Float[Tensor, "n k"]:
    """Unpack unsigned integers from the low bits of words, and scale each of them to 0..1."""
    shifts = [sum(bits[i + 1 :]) for i in range(len(bits))]
    return torch.stack([(words >> s & (2**b - 1)).float() / (2**b - 1) for s, b in zip(shifts, bits)], dim=1)


def _words(units: Float[Tensor, "n k"], bits: tuple[int, ...]) -> Int64[Tensor, " n"]:
    words = torch.zeros(len(units), dtype=torch.int64)
    for i, count in enumerate(bits):
        words = words << count | (units[:, i] * (2**count - 1)).round().clamp(0, 2**count - 1).long()
    return words


def _chunk_bounds(values: Float[Tensor, "n c"]) -> tuple[Float[Tensor, "k c"], Float[Tensor, "k c"]]:
    """Return the minimum and the maximum of each column in every chunk, as float32."""
    chunks = values.split(_CHUNK_ROWS)
    return torch.stack([x.amin(dim=0) for x in chunks]).float(), torch.stack([x.amax(dim=0) for x in chunks]).float()


def _element(name: str, columns: Mapping[str, np.ndarray], kind: str) -> PlyElement:
    table = np.rec.fromarrays([column.astype(kind) for column in columns.values()], dtype=[(c, kind) for c in columns])
    return PlyElement.describe(table, name)


def _chunk_order(means: Float[np.ndarray, "n 3"]) -> Int64[np.ndarray, " n"]:
    """Return the row indices in the order of a k-d tree, so that each chunk covers a small box."""
    weights = 1 / (2.0 ** np.array(_POSITION_BITS) - 1)
    chunks, boxes = [], [np.arange(len(means))]
    while len(boxes) > 0:
        rows = boxes.pop()
        if len(rows) <= _CHUNK_ROWS:
            chunks.append(rows)
            continue
        axis = int((np.ptp(means[rows], axis=0) * weights).argmax())
        middle = -(-len(rows) // _CHUNK_ROWS) // 2 * _CHUNK_ROWS  # only the last chunk may have fewer rows
        rows = rows[np.argpartition(means[rows, axis], middle)]
        boxes += [rows[middle:], rows[:middle]]
    return np.concatenate(chunks)


# Conversion of quaternions and opacities, for all compressed splat formats.


_OTHERS = torch.tensor([[1, 2, 3], [0, 2, 3], [0, 1, 3], [0, 1, 2]])
"""Indices of the three other components of a quaternion, by the index of its largest component."""
_MIN_OPACITY = 1e-6


def opacity_logits(opacities: Float[Tensor, "*n"]) -> Float[Tensor, "*n"]:
    """Return the logits of opacities, which are clamped to 1e-6..1 - 1e-6 so that the logits are finite."""
    return opacities.double().logit(eps=_MIN_OPACITY).float()


def to_bytes(values: Float[Tensor, "*n"]) -> UInt8[np.ndarray, "*n"]:
    """Round values, clamp them to 0..255, and convert them to bytes."""
    return values.round().clamp(0, 255).to(torch.uint8).numpy()


def normalize_quats(quats: Float[Tensor, "n 4"]) -> Float[Tensor, "n 4"]:
    """Return unit quaternions (w, x, y, z); quaternions that are zero or not finite become the identity."""
    unit = normalize(quats / quats.abs().amax(dim=1, keepdim=True), dim=1)
    return torch.where(unit.isfinite().all(dim=1, keepdim=True), unit, unit.new_tensor([1.0, 0, 0, 0]))


def split_largest(unit: Float[Tensor, "n 4"]) -> tuple[Int64[Tensor, " n"], Float[Tensor, "n 3"]]:
    """Return the index of the largest component (by magnitude) of each unit quaternion, and the other three components.

    If the largest component is negative, the other three change their sign.
    """
    index = unit.abs().argmax(dim=1, keepdim=True)
    positive = unit * torch.where(unit.gather(1, index) < 0, -1.0, 1.0)  # q and -q are the same rotation
    return index[:, 0], positive.gather(1, _OTHERS[index[:, 0]])


def join_largest(index: Int64[Tensor, " n"], others: Float[Tensor, "n 3"]) -> Float[Tensor, "n 4"]:
    """Return unit quaternions as float32, given the results of `split_largest`."""
    largest = (1 - others.square().sum(dim=1, keepdim=True)).clamp(min=0).sqrt()
    unit = torch.zeros(len(index), 4, dtype=others.dtype).scatter_(1, _OTHERS[index], others)
    return unit.scatter_(1, index[:, None], largest).float()
