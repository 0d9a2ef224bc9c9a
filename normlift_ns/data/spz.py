"""SPZ files of Niantic: Gaussians in a few bytes per attribute, compressed (https://github.com/nianticlabs/spz)."""

from __future__ import annotations

import gzip
import struct

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from normlift_ns.data.splat import SplatParameters
from normlift_ns.errors import InputError

_MAGIC = 0x5053474E  # "NGSP"
_HEADER = struct.Struct("<IIIBBBB")
"""Magic number, version, number of Gaussians, degree, fractional bits of the positions, flags, a reserved byte."""
_ANTIALIASED = 1
_MAX_FRACTIONAL_BITS, _MAX_FIXED = 23, 2**23 - 1
_COLOR_SCALE, _SCALE_STEPS, _MIN_SCALE = 0.15, 16, -10
_SH_STEPS = (8, 16)
"""Steps of the spherical harmonics of degree 1 and of higher degrees, in 1/128: the defaults of Niantic's library."""
_COMPONENT_STEPS = 511 * 2**0.5
"""Steps of a quaternion component per unit; components other than the largest are at most sqrt(1/2)."""


def encode_spz(splat: SplatParameters, *, antialiased: bool = False) -> bytes:
    """Return Gaussians as an SPZ file of version 3, in the order of their rows and in their own coordinates.

    Positions take the finest of the 24 steps between 1 and 2^-23 that holds them all. Logarithms of scales are rounded
    to 1/16 and clamped to -10..5.94, opacities to 1/255, colors to 1/38, spherical harmonics to 1/16 (degree 1) or 1/8
    and clamped to -1..1, and rotations to 0.004 radians. Gaussians that are never drawn are encoded with opacity 0.

    Args:
        splat: the Gaussians, whose colors are spherical harmonics.
        antialiased: True if they were trained with the rasterize mode "antialiased".
    Raises:
        ValueError: if a Gaussian that can be drawn is further than 8,388,607 from the origin along an axis.
    """
    drawable = splat.activated.drawable.cpu()
    means, quats, scales, logits, colors, rest = (
        torch.where(drawable.view(-1, *[1] * (value.ndim - 1)), value.detach().cpu().double(), 0.0).nan_to_num()
        for value in splat.parameters.values()
    )
    fractional_bits = _fractional_bits(means)
    fixed = (means * 2**fractional_bits).round().to(torch.int32).numpy().astype("<i4")
    alphas = torch.where(drawable, logits[:, 0].sigmoid(), 0.0)
    fields = (
        fixed.view(np.uint8).reshape(-1, 4)[:, :3],
        _to_bytes(alphas * 255),
        _to_bytes(colors * (_COLOR_SCALE * 255) + 127.5),
        _to_bytes((scales - _MIN_SCALE) * _SCALE_STEPS),
        _pack_quats(quats),
        _pack_harmonics(rest),
    )
    flags = _ANTIALIASED if antialiased else 0
    header = _HEADER.pack(_MAGIC, 3, len(splat), splat.degree, fractional_bits, flags, 0)
    return gzip.compress(b"".join([header, *(field.tobytes() for field in fields)]), compresslevel=6, mtime=0)


def _fractional_bits(means: Float[Tensor, "n 3"]) -> int:
    """Return the largest number of fractional bits with which all coordinates fit into 24 bits."""
    reach = float(means.abs().max()) if len(means) > 0 else 0.0
    if reach > _MAX_FIXED:
        raise InputError(
            f"A Gaussian has the coordinate {reach:,.0f}, and SPZ holds at most {_MAX_FIXED:,}. Move the scene to the "
            "origin, or write a PLY file."
        )
    return next(bits for bits in range(_MAX_FRACTIONAL_BITS, -1, -1) if round(reach * 2**bits) <= _MAX_FIXED)


def _to_bytes(values: Tensor) -> np.ndarray:
    return values.round().clamp(0, 255).to(torch.uint8).numpy()


def _pack_quats(quats: Float[Tensor, "n 4"]) -> np.ndarray:
    """Return 2 bits for the index of the largest component of (x, y, z, w), and 10 bits for each of the others."""
    identity = torch.tensor([0.0, 0, 0, 1], dtype=quats.dtype)
    unit = quats / quats.abs().amax(dim=1, keepdim=True)
    unit = torch.nn.functional.normalize(unit, dim=1).roll(-1, dims=1)
    unit = torch.where(unit.isfinite().all(dim=1, keepdim=True), unit, identity)
    largest = unit.abs().argmax(dim=1, keepdim=True)
    unit = unit * torch.where(unit.gather(1, largest) < 0, -1.0, 1.0)  # q and -q are the same rotation
    others = torch.tensor([[1, 2, 3], [0, 2, 3], [0, 1, 3], [0, 1, 2]])[largest[:, 0]]
    components = unit.gather(1, others)
    steps = (components.abs() * _COMPONENT_STEPS).round().clamp(max=511).long() | ((components < 0).long() << 9)
    packed = largest[:, 0] << 30 | steps[:, 0] << 20 | steps[:, 1] << 10 | steps[:, 2]
    return packed.numpy().astype("<u4")


def _pack_harmonics(rest: Float[Tensor, "n k 3"]) -> np.ndarray:
    steps = torch.full((rest.shape[1], 1), float(_SH_STEPS[1]), dtype=rest.dtype)
    steps[:3] = _SH_STEPS[0]
    return _to_bytes(((rest * 128 + 128) / steps + 0.5).floor() * steps)
