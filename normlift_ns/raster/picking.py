"""Compositing weights of Gaussians along a ray, computed in 3D without an image."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from normlift_ns.core.gaussians import GaussianScene

_MAX_ALPHA, _MIN_ALPHA = 0.999, 1 / 255
"""Same values as in the rasterizer: alpha is capped, and alpha below one step of a byte is ignored."""
_MIN_SCALE_RATIO = 1e-4
"""Least ratio of the smallest to the largest standard deviation, so that rays from all sides hit flat Gaussians."""


def ray_weights(
    scene: GaussianScene, origin: Float[Tensor, " 3"], direction: Float[Tensor, " 3"]
) -> Float[Tensor, " n"]:
    """Return the weight alpha_j prod_{k<j} (1 - alpha_k) of every Gaussian for a ray; 0 if the ray misses it.

    alpha_j is the opacity times the largest value of the Gaussian along the ray. The distance of this maximum decides
    the order, nearest first. Nothing is blurred, and the result does not depend on the size of an image.

    Args:
        scene: N Gaussians.
        origin: Start of the ray in world units; Gaussians behind it are not hit.
        direction: Direction of the ray, of any length > 0.
    """
    out = scene.means.new_zeros(len(scene))
    rows = scene.drawable.nonzero().squeeze(1)
    means, quats, scales = (x[rows].double() for x in (scene.means, scene.quats, scene.scales))
    scales = scales.clamp(min=1e-12).maximum(_MIN_SCALE_RATIO * scales.amax(dim=1, keepdim=True))
    forward = torch.nn.functional.normalize(direction.to(means), dim=0)
    quats = torch.nn.functional.normalize(quats, dim=1)
    start = _to_axes(origin.to(means) - means, quats) / scales  # in standard deviations along each Gaussian's axes
    step = _to_axes(forward.expand_as(means), quats) / scales
    distance = -(start * step).sum(1) / (step * step).sum(1)
    square = (start + distance[:, None] * step).square().sum(1)
    alpha = (scene.opacities[rows].double() * torch.exp(-square / 2)).clamp(max=_MAX_ALPHA)
    hit = ((alpha >= _MIN_ALPHA) & (distance > 0)).nonzero().squeeze(1)
    hit = hit[distance[hit].argsort(stable=True)]
    transmittance = (1 - alpha[hit]).cumprod(0)
    before = torch.cat([transmittance.new_ones(1), transmittance])[: len(hit)]
    out[rows[hit]] = (alpha[hit] * before).to(out)
    return out


def _to_axes(vectors: Float[Tensor, "n 3"], quats: Float[Tensor, "n 4"]) -> Float[Tensor, "n 3"]:
    """Rotate world vectors into the axes of Gaussians with unit quaternions (w, x, y, z): the inverse rotation."""
    real, imaginary = quats[:, :1], -quats[:, 1:]
    turn = 2 * torch.linalg.cross(imaginary, vectors)
    return vectors + real * turn + torch.linalg.cross(imaginary, turn)
