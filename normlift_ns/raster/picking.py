"""What a ray meets: the compositing weights of Gaussians along it, in 3D and without any image."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from normlift_ns.core.gaussians import GaussianScene

_MAX_ALPHA, _MIN_ALPHA = 0.999, 1 / 255
"""As the rasterizer's: opacity is capped, and what is fainter than one step of a byte does not count."""
_THINNEST = 1e-4
"""Least standard deviation in a Gaussian, as a share of its largest: flat ones are met by rays from all sides."""


def ray_weights(
    scene: GaussianScene, origin: Float[Tensor, " 3"], direction: Float[Tensor, " 3"]
) -> Float[Tensor, " n"]:
    """Weight alpha_j prod_{k<j} (1 - alpha_k) of every Gaussian for a ray, nearest first; 0 where the ray misses it.

    alpha_j is the opacity times the largest value of the Gaussian along the ray, which it takes at the distance that
    the order goes by. Nothing is blurred, and the result does not depend on the size of any image.

    Args:
        origin: start of the ray in world units; what lies behind is not met.
        direction: of any length > 0.
    """
    out = scene.means.new_zeros(len(scene))
    rows = scene.drawable.nonzero().squeeze(1)
    means, quats, scales = (x[rows].double() for x in (scene.means, scene.quats, scene.scales))
    scales = scales.clamp(min=1e-12).maximum(_THINNEST * scales.amax(dim=1, keepdim=True))
    forward = torch.nn.functional.normalize(direction.to(means), dim=0)
    quats = torch.nn.functional.normalize(quats, dim=1)
    start = _to_axes(origin.to(means) - means, quats) / scales  # in standard deviations along each Gaussian's axes
    step = _to_axes(forward.expand_as(means), quats) / scales
    distance = -(start * step).sum(1) / (step * step).sum(1)
    square = (start + distance[:, None] * step).square().sum(1)
    alpha = (scene.opacities[rows].double() * torch.exp(-square / 2)).clamp(max=_MAX_ALPHA)
    met = ((alpha >= _MIN_ALPHA) & (distance > 0)).nonzero().squeeze(1)
    met = met[distance[met].argsort(stable=True)]
    through = (1 - alpha[met]).cumprod(0)
    before = torch.cat([through.new_ones(1), through])[: len(met)]
    out[rows[met]] = (alpha[met] * before).to(out)
    return out


def _to_axes(vectors: Float[Tensor, "n 3"], quats: Float[Tensor, "n 4"]) -> Float[Tensor, "n 3"]:
    """World vectors in the axes of Gaussians with unit quaternions (w, x, y, z): the inverse rotation."""
    real, imaginary = quats[:, :1], -quats[:, 1:]
    turn = 2 * torch.linalg.cross(imaginary, vectors)
    return vectors + real * turn + torch.linalg.cross(imaginary, turn)
