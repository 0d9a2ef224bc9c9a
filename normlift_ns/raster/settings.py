"""Every constant of the rasterizer that trained the scene."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class RasterSettings:
    """Constants of gsplat 1.4.0's kernels, as splatfacto calls them (fully_fused_projection_fwd.cu, isect_tiles.cu,
    rasterize_to_pixels_fwd.cu).

    >>> import torch
    >>> from normlift_ns import Camera, GaussianScene, RasterSettings, render
    >>> means, quats = torch.tensor([[0.0, 0, 1]]), torch.tensor([[1.0, 0, 0, 0]])
    >>> scene = GaussianScene(means, quats, scales=torch.ones(1, 3), opacities=torch.ones(1))
    >>> camera = Camera(torch.tensor([[1.0, 0, 0.5], [0, 1, 0.5], [0, 0, 1]]), torch.eye(4), width=1, height=1)
    >>> choices = RasterSettings(), RasterSettings(max_alpha=0.75), RasterSettings(near_plane=2.0)
    >>> [render(scene, camera, torch.ones(1, 1), settings=settings)[1] for settings in choices]
    [tensor([[0.9990]]), tensor([[0.7500]]), tensor([[0.]])]
    """

    near_plane: float = 0.01
    """Gaussians whose centre is nearer than this (world units) are not drawn."""
    far_plane: float = 1e10
    """Gaussians whose centre is farther than this (world units) are not drawn."""
    eps2d: float = 0.3
    """Added to the diagonal of the projected covariance, in square pixels."""
    frustum_margin: float = 0.3
    """Beyond the image by this share of half its field of view, the Jacobian of the projection is held constant."""
    min_discriminant: float = 0.01
    """Lower bound of b ** 2 - det in the larger eigenvalue of the projected covariance."""
    radius_sigmas: float = 3.0
    """Half side, in standard deviations of the larger axis, of the square that selects the tiles of a Gaussian."""
    tile_size: int = 16
    """Side of a tile in pixels. A Gaussian is drawn in whole tiles only, so this changes the result."""
    max_alpha: float = 0.999
    """Upper bound of alpha."""
    min_alpha: float = 1 / 255
    """Pixels with a smaller alpha skip the Gaussian."""
    min_transmittance: float = 1e-4
    """A pixel stops before the first Gaussian that would leave this or less transmittance."""
