"""View-dependent colors of Gaussians, on any device."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from normlift_ns.core.gaussians import Camera


def view_colors(
    means: Float[Tensor, "n 3"], coefficients: Float[Tensor, "n k 3"], camera: Camera, degree: int | None
) -> Float[Tensor, "n 3"]:
    """Return RGB >= 0 of every Gaussian, as splatfacto and gsplat.rasterization compute it.

    Args:
        means: Centers of the Gaussians.
        coefficients: features_dc and features_rest of a checkpoint, [N, 1 + rest, 3].
        camera: Camera that views the Gaussians.
        degree: Degree of the spherical harmonics, with (degree + 1) ** 2 <= K; None: the coefficients are logits.
    """
    if degree is None:
        return torch.sigmoid(coefficients[:, 0])
    from gsplat.cuda._torch_impl import _spherical_harmonics  # noqa: PLC0415 (slow import)

    pose = camera.world_to_camera.to(means)
    center = -pose[:3, :3].T @ pose[:3, 3]
    return (_spherical_harmonics(degree, means - center, coefficients) + 0.5).clamp(min=0)
