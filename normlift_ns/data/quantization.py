"""Quaternions and opacities in compressed splat formats."""

from __future__ import annotations

import numpy as np
import torch
from jaxtyping import Float, Int64, UInt8
from torch import Tensor
from torch.nn.functional import normalize

_OTHERS = torch.tensor([[1, 2, 3], [0, 2, 3], [0, 1, 3], [0, 1, 2]])
"""Components of a quaternion other than its largest one."""
_MIN_OPACITY = 1e-6


def opacity_logits(opacities: Float[Tensor, "*n"]) -> Float[Tensor, "*n"]:
    """Return finite logits of opacities in 0..1; the outermost ones become 1e-6 and 1 - 1e-6."""
    return opacities.double().logit(eps=_MIN_OPACITY).float()


def to_bytes(values: Float[Tensor, "*n"]) -> UInt8[np.ndarray, "*n"]:
    """Round values, and clamp them to 0..255."""
    return values.round().clamp(0, 255).to(torch.uint8).numpy()


def normalize_quats(quats: Float[Tensor, "n 4"]) -> Float[Tensor, "n 4"]:
    """Return unit quaternions (w, x, y, z); the identity in place of zeros."""
    unit = normalize(quats / quats.abs().amax(dim=1, keepdim=True), dim=1)
    return torch.where(unit.isfinite().all(dim=1, keepdim=True), unit, unit.new_tensor([1.0, 0, 0, 0]))


def split_largest(unit: Float[Tensor, "n 4"]) -> tuple[Int64[Tensor, " n"], Float[Tensor, "n 3"]]:
    """Return the index of the largest component of unit quaternions, and the others, for a positive largest one."""
    index = unit.abs().argmax(dim=1, keepdim=True)
    positive = unit * torch.where(unit.gather(1, index) < 0, -1.0, 1.0)  # q and -q are the same rotation
    return index[:, 0], positive.gather(1, _OTHERS[index[:, 0]])


def join_largest(index: Int64[Tensor, " n"], others: Float[Tensor, "n 3"]) -> Float[Tensor, "n 4"]:
    """Return the unit quaternions of `split_largest`, as float32."""
    largest = (1 - others.square().sum(dim=1, keepdim=True)).clamp(min=0).sqrt()
    unit = torch.zeros(len(index), 4, dtype=others.dtype).scatter_(1, _OTHERS[index], others)
    return unit.scatter_(1, index[:, None], largest).float()
