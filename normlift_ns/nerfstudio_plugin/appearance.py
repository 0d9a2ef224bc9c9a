"""Colours of splatfacto's Gaussians as one camera sees them, on any device."""

from __future__ import annotations

import torch
from gsplat.cuda._torch_impl import _spherical_harmonics
from jaxtyping import Float
from nerfstudio.models.splatfacto import SplatfactoModelConfig
from nerfstudio.utils.colors import get_color
from torch import Tensor

from normlift_ns.core.gaussians import Camera

LOADED_STEP = 30000
"""The step that splatfacto takes a loaded checkpoint for, whatever its own."""
_VIEWER_BACKGROUND = (0.1490, 0.1647, 0.2157)


def background(config: SplatfactoModelConfig) -> Float[Tensor, " 3"]:
    """RGB in 0..1 behind the Gaussians, as splatfacto has it outside training; for "random", that of the viewer."""
    name = config.background_color
    return torch.tensor(_VIEWER_BACKGROUND) if name == "random" else get_color(name)


def shading_degree(config: SplatfactoModelConfig, step: int) -> int | None:
    """Degree of the spherical harmonics in use at a training step; None: colours do not depend on the view."""
    return min(step // config.sh_degree_interval, config.sh_degree) if config.sh_degree > 0 else None


def view_colors(
    means: Float[Tensor, "n 3"], coefficients: Float[Tensor, "n k 3"], camera: Camera, degree: int | None
) -> Float[Tensor, "n 3"]:
    """RGB >= 0 of every Gaussian, as splatfacto and gsplat.rasterization compute it.

    Args:
        coefficients: features_dc and features_rest of a checkpoint, [N, 1 + rest, 3].
        degree: of the spherical harmonics, with (degree + 1) ** 2 <= K; None: coefficients are logits.
    """
    if degree is None:
        return torch.sigmoid(coefficients[:, 0])
    pose = camera.world_to_camera.to(means)
    centre = -pose[:3, :3].T @ pose[:3, 3]
    return (_spherical_harmonics(degree, means - centre, coefficients) + 0.5).clamp(min=0)
