"""Reader and encoder for Niantic's SPZ files (https://github.com/nianticlabs/spz).

The files contain quantized and compressed Gaussians. A file of version 2 or 3 is one gzip stream of a header and all
attributes. A file of version 4 has an uncompressed header, a table of sizes, and one zstd stream per attribute.
"""

from __future__ import annotations

import gzip
import math
import struct
import zlib
from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np
import torch
import zstandard
from jaxtyping import Float
from torch import Tensor

from normlift_ns.data.compressed_ply import join_largest, normalize_quats, opacity_logits, split_largest, to_bytes
from normlift_ns.data.splat import SH_DEGREES, SplatFile, SplatParameters, validate_splat
from normlift_ns.errors import InputError
from normlift_ns.io.guard import open_regular
from normlift_ns.io.memory import refuse_small_memory

SPZ_MAGIC, GZIP_MAGIC = b"NGSP", b"\x1f\x8b"
_HEADER = struct.Struct("<4sIIBBBB")
"""Magic number, version, number of Gaussians, SH degree, fractional bits of the positions, flags, number of streams."""
_TABLE_OFFSET, _TABLE_ENTRY = struct.Struct("<16xI12x"), struct.Struct("<QQ")
"""Header of version 4 with the offset of the table, and table entry with the compressed and uncompressed sizes."""
_ANTIALIASED, _HAS_EXTENSIONS = 1, 2
"""Bits of the flags in a header: antialiased Gaussians, and extensions in the file."""
_MAX_FRACTIONAL_BITS, _MAX_FIXED = 23, 2**23 - 1
_COLOR_SCALE, _SCALE_STEPS, _MIN_SCALE = 0.15, 16, -10
_SH_STEPS = (8, 16)
"""Quantization steps of harmonics of degree 1 and of higher degrees, in units of 1/128, as in Niantic's library."""
_COMPONENT_STEPS = 511 * 2**0.5
"""Quantization steps per unit of a quaternion component. Packed components are in -sqrt(1/2)..sqrt(1/2)."""
_MAX_RATIO = 1032
"""Maximum compression ratio of deflate."""
_MAX_WINDOW = 2**27


class _Header(NamedTuple):
    version: int
    gaussians: int
    degree: int
    fractional_bits: int
    flags: int

    @property
    def sizes(self) -> list[int]:
        """Sizes in bytes of positions, opacities, colors, scales, rotations and spherical harmonics."""
        harmonics = 3 * ((self.degree + 1) ** 2 - 1)
        return [self.gaussians * size for size in (9, 1, 3, 3, 3 if self.version == 2 else 4, harmonics)]


def encode_spz(
    splat: SplatParameters, *, antialiased: bool = False, version: Literal[3, 4] = 3, position_step: float = 0.0
) -> bytes:
    """Encode Gaussians as an SPZ file, in the order of their rows and in their own coordinates.

    Positions are rounded to multiples of a power of two, the smallest from 2^-23 to 1 for which all fit into 24 bits.
    Logarithms of scales are rounded in steps of 1/16 and clamped to -10..5.94. Opacities are rounded in steps of 1/255.
    Constant spherical harmonics are rounded in steps of 1/38 and clamped to -3.33..3.33. Other harmonics are rounded in
    steps of 1/16 (degree 1) or 1/8 and clamped to -1..1. Rotations change by at most 0.005 radians. Gaussians that are
    never drawn get opacity 0.

    Args:
        splat: Gaussians to encode.
        antialiased: True if they were trained with the rasterize mode "antialiased".
        version: Version of the format. More programs read version 3 than version 4.
        position_step: Maximum step of a coarser rounding of positions, for a smaller file; 0 for no coarser rounding.
    Raises:
        ValueError: A Gaussian that can be drawn is farther than 8,388,607 from the origin along an axis.
    """
    drawable = splat.activated.drawable.cpu()
    means, quats, scales, logits, colors, rest = (
        torch.where(drawable.view(-1, *[1] * (value.ndim - 1)), value.detach().cpu().double(), 0.0).nan_to_num()
        for value in splat.parameters.values()
    )
    bits = min(_fractional_bits(means), _bits_of_step(position_step))
    fixed = (means * 2**bits).round().to(torch.int32).numpy().astype("<i4")
    fields = (
        fixed.view(np.uint8).reshape(-1, 4)[:, :3],
        to_bytes(torch.where(drawable, logits[:, 0].sigmoid(), 0.0) * 255),
        to_bytes(colors * (_COLOR_SCALE * 255) + 127.5),
        to_bytes((scales - _MIN_SCALE) * _SCALE_STEPS),
        _pack_quats(quats),
        _pack_harmonics(rest),
    )
    streams = [field.tobytes() for field in fields if field.size > 0]
    flags, number = _ANTIALIASED if antialiased else 0, len(streams) if version == 4 else 0
    header = _HEADER.pack(SPZ_MAGIC, version, len(splat), splat.degree, bits, flags, number)
    if version == 3:
        return gzip.compress(b"".join([header, *streams]), compresslevel=6, mtime=0)
    packed = [zstandard.compress(stream, level=12) for stream in streams]
    table = [_TABLE_ENTRY.pack(len(after), len(before)) for before, after in zip(streams, packed)]
    return b"".join([header, struct.pack("<I12x", _TABLE_OFFSET.size), *table, *packed])


def read_spz(path: Path) -> SplatFile:
    """Read an SPZ file of version 2, 3 or 4, in its own coordinates.

    Raises:
        FileNotFoundError: The file does not exist.
        ValueError: The file is not an SPZ file, is truncated or damaged, or its Gaussians cannot be rendered.
        MemoryError: The Gaussians do not fit into memory.
    """
    if not path.is_file():
        raise FileNotFoundError(f"The SPZ file {path} does not exist. Give an existing file with --load-ply.")
    with open_regular(path) as file:
        return decode_spz(file.read(), path)


def decode_spz(data: bytes, path: Path) -> SplatFile:
    """Decode the bytes of an SPZ file. Errors are those of `read_spz`, and their messages contain `path`."""
    is_gzip = data.startswith(GZIP_MAGIC)
    header, streams = _read_gzip(data, path) if is_gzip else _read_zstd(data, path)
    n, k = header.gaussians, (header.degree + 1) ** 2 - 1
    positions, alphas, colors, scales, rotations, rest = (np.frombuffer(stream, np.uint8) for stream in streams)
    fixed = np.zeros((n, 3, 4), np.uint8)
    fixed[:, :, 1:] = positions.reshape(n, 3, 3)
    means = (fixed.view("<i4")[:, :, 0] >> 8) * 0.5**header.fractional_bits
    quats = _unpack_first_three(rotations) if header.version == 2 else _unpack_quats(rotations)
    splat = SplatParameters(
        means=torch.from_numpy(means).float(),
        quats=quats,
        scales=_floats(scales, n, 3) / _SCALE_STEPS + _MIN_SCALE,
        opacities=opacity_logits(_floats(alphas, n, 1) / 255),
        features_dc=(_floats(colors, n, 3) / 255 - 0.5) / _COLOR_SCALE,
        features_rest=_floats(rest, n, k, 3) / 128 - 1,
    )
    validate_splat(splat, path)
    remarks = [spz_rounding(path.name, header.fractional_bits, header.version)]
    if header.flags & _HAS_EXTENSIONS:
        remarks.append(
            f"{path.name} has extensions, such as the name of its coordinate system, which are not applied. If the "
            "cameras are in another system, give a file with --world-transform."
        )
    return SplatFile(splat, "antialiased" if header.flags & _ANTIALIASED else None, remarks=tuple(remarks))


def spz_rounding(name: str, fractional_bits: int, version: int = 3) -> str:
    """Return a message about the rounding errors of an SPZ file."""
    turn = "0.3" if version == 2 else "0.005"
    return (
        f"{name} contains rounded numbers. Maximum errors: {0.5 ** (fractional_bits + 1):.2g} for positions, 0.032 for "
        f"logarithms of scales in -10..5.9, {turn} radians for rotations, and 0.002 for opacities."
    )


def _read_header(data: bytes, path: Path) -> _Header:
    if len(data) < _HEADER.size and SPZ_MAGIC.startswith(data[:4]):
        raise _damaged(path, f"its header ends after {len(data)} of {_HEADER.size} bytes")
    if not data.startswith(SPZ_MAGIC):
        raise InputError(
            f"{path} is not an SPZ file: its content begins with {data[:4].hex()}, expected {SPZ_MAGIC.hex()}. If "
            "it is a compressed file of a different kind, decompress it first, for example with gunzip."
        )
    _, version, count, degree, fractional_bits, flags, _ = _HEADER.unpack_from(data)
    if not 2 <= version <= 4:
        raise InputError(
            f"{path} is an SPZ file of version {version}, expected 2, 3 or 4. Write it again as version 3."
        )
    if count == 0:
        raise InputError(f"{path} contains no Gaussians. Export the scene again.")
    if degree not in SH_DEGREES.values() or fractional_bits > _MAX_FRACTIONAL_BITS + 1:
        raise InputError(
            f"{path} is damaged: its header has degree {degree} of spherical harmonics and {fractional_bits} "
            f"fractional bits, expected at most {max(SH_DEGREES.values())} and 24. Copy it again."
        )
    return _Header(version, count, degree, fractional_bits, flags)


def _check_size(header: _Header, size: int, path: Path, max_ratio: int = _MAX_RATIO) -> None:
    """Raise if a compressed file of `size` bytes is too small for the Gaussians, or if they do not fit into memory."""
    if sum(header.sizes) > size * max_ratio:
        raise _damaged(path, f"its header declares {header.gaussians:,} Gaussians, too many for {size:,} bytes")
    refuse_small_memory(header.gaussians)


def _damaged(path: Path, problem: str) -> InputError:
    return InputError(f"{path} is truncated or damaged: {problem}. Copy it again.")


def _read_gzip(data: bytes, path: Path) -> tuple[_Header, list[bytes]]:
    """Return the header and the attributes of version 2 or 3.

    The function decompresses at most one byte more than the header declares.
    """
    stream = zlib.decompressobj(16 + zlib.MAX_WBITS)
    try:
        header = _read_header(stream.decompress(data, _HEADER.size), path)
        if header.version == 4:
            raise _damaged(path, "it is compressed like version 3, but its header has version 4")
        _check_size(header, len(data), path)
        content = stream.decompress(stream.unconsumed_tail, sum(header.sizes))
        rest = stream.decompress(stream.unconsumed_tail, 1)  # zlib checks the CRC at the end, unless extensions follow
    except zlib.error as error:
        raise _damaged(path, str(error)) from error
    if len(content) < sum(header.sizes):
        raise _damaged(path, f"it ends after {len(content):,} of {sum(header.sizes):,} bytes")
    if len(rest) == 0 and not stream.eof:
        raise _damaged(path, "it ends before its checksum")
    ends = np.cumsum(header.sizes).tolist()
    return header, [content[end - size : end] for end, size in zip(ends, header.sizes)]


def _read_zstd(data: bytes, path: Path) -> tuple[_Header, list[bytes]]:
    """Return the header and the attributes of version 4."""
    header = _read_header(data, path)
    if header.version != 4:
        raise _damaged(path, f"it is not compressed as a whole, as in version 4, but has version {header.version}")
    if len(data) < _TABLE_OFFSET.size:
        raise _damaged(path, f"it ends after {len(data)} of {_TABLE_OFFSET.size} header bytes")
    _check_size(header, len(data), path, 64 * _MAX_RATIO)  # zstd can reach a higher compression ratio than deflate
    (start,), number = _TABLE_OFFSET.unpack_from(data), data[_HEADER.size - 1]
    sizes = [size for size in header.sizes if size > 0]
    offset = start + number * _TABLE_ENTRY.size
    if number != len(sizes) or start < _TABLE_OFFSET.size or offset > len(data):
        raise _damaged(path, f"its table of {number} streams at byte {start:,} is not valid")
    streams = []
    for i, size in enumerate(sizes):
        packed, unpacked = _TABLE_ENTRY.unpack_from(data, start + i * _TABLE_ENTRY.size)
        if unpacked != size:
            raise _damaged(path, f"its stream {i} declares {unpacked:,} bytes, expected {size:,}")
        if packed > len(data) - offset:
            raise _damaged(path, f"its stream {i} ends after {len(data) - offset:,} of {packed:,} bytes")
        streams.append(_decompress_zstd(data[offset : offset + packed], size, path))
        offset += packed
    return header, [*streams, *[b""] * (len(header.sizes) - len(streams))]


def _decompress_zstd(data: bytes, size: int, path: Path) -> bytes:
    try:
        with zstandard.ZstdDecompressor(max_window_size=_MAX_WINDOW).stream_reader(data) as reader:
            content = reader.read(size)
    except zstandard.ZstdError as error:
        raise _damaged(path, str(error)) from error
    if len(content) < size:
        raise _damaged(path, f"a stream ends after {len(content):,} of {size:,} bytes")
    return content


def _fractional_bits(means: Float[Tensor, "n 3"]) -> int:
    """Return the largest number of fractional bits, up to 23, for which all coordinates fit into 24 bits."""
    reach = float(means.abs().max()) if len(means) > 0 else 0.0
    if reach > _MAX_FIXED:
        raise InputError(
            f"A Gaussian has the coordinate {reach:,.0f}, but SPZ files allow at most {_MAX_FIXED:,}. Move the scene "
            "to the origin, or write a PLY file."
        )
    return next(bits for bits in range(_MAX_FRACTIONAL_BITS, -1, -1) if round(reach * 2**bits) <= _MAX_FIXED)


def _bits_of_step(step: float) -> int:
    """Return the smallest number of fractional bits, up to 23, with steps of at most `step`; 23 if `step` is 0."""
    return min(_MAX_FRACTIONAL_BITS, max(0, math.ceil(-math.log2(step)))) if step > 0 else _MAX_FRACTIONAL_BITS


def _floats(values: np.ndarray, *shape: int) -> Tensor:
    return torch.from_numpy(values.astype(np.float32)).reshape(shape)


def _pack_quats(quats: Float[Tensor, "n 4"]) -> np.ndarray:
    """Pack quaternions: 2 bits for the index of the largest of (x, y, z, w), and 10 bits for each other component."""
    index, components = split_largest(normalize_quats(quats).roll(-1, dims=1))
    steps = (components.abs() * _COMPONENT_STEPS).round().clamp(max=511).long() | ((components < 0).long() << 9)
    packed = index << 30 | steps[:, 0] << 20 | steps[:, 1] << 10 | steps[:, 2]
    return packed.numpy().astype("<u4")


def _unpack_quats(packed: np.ndarray) -> Float[Tensor, "n 4"]:
    bits = torch.from_numpy(packed.view("<u4").astype(np.int64))
    steps = torch.stack([bits >> 20, bits >> 10, bits], dim=1)
    components = (steps & 511) / _COMPONENT_STEPS * torch.where((steps & 512) > 0, -1.0, 1.0)
    return join_largest(bits >> 30, components).roll(1, dims=1)


def _unpack_first_three(packed: np.ndarray) -> Float[Tensor, "n 4"]:
    """Unpack quaternions of version 2, which stores x, y and z in one byte each."""
    xyz = _floats(packed, len(packed) // 3, 3) / 127.5 - 1
    w = (1 - xyz.square().sum(dim=1, keepdim=True)).clamp(min=0).sqrt()
    return torch.cat([w, xyz], dim=1)


def _pack_harmonics(rest: Float[Tensor, "n k 3"]) -> np.ndarray:
    steps = torch.full((rest.shape[1], 1), float(_SH_STEPS[1]), dtype=rest.dtype)
    steps[:3] = _SH_STEPS[0]
    return to_bytes(((rest * 128 + 128) / steps + 0.5).floor() * steps)
