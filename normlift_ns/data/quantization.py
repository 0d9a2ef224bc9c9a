"""Conversion of quaternions and opacities for compressed splat formats."""

from __future__ import annotations

import numpy as np
import torch
from jaxtyping import Float, Int64, UInt8
from torch import Tensor
from torch.nn.functional import normalize

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
    """Return the index of the largest component of unit quaternions, and their other three components.

    If the largest component is negative, the signs of the others are changed.
    """
    index = unit.abs().argmax(dim=1, keepdim=True)
    positive = unit * torch.where(unit.gather(1, index) < 0, -1.0, 1.0)  # q and -q are the same rotation
    return index[:, 0], positive.gather(1, _OTHERS[index[:, 0]])


def join_largest(index: Int64[Tensor, " n"], others: Float[Tensor, "n 3"]) -> Float[Tensor, "n 4"]:
    """Return unit quaternions as float32, given the results of `split_largest`."""
    largest = (1 - others.square().sum(dim=1, keepdim=True)).clamp(min=0).sqrt()
    unit = torch.zeros(len(index), 4, dtype=others.dtype).scatter_(1, _OTHERS[index], others)
    return unit.scatter_(1, index[:, None], largest).float()
