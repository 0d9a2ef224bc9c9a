"""Every constant of the rasterizer that trained the scene."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

from normlift_ns.errors import InputError
from normlift_ns.options import KNOWN_RULES


@dataclass(frozen=True)
class RasterSettings:
    """Constants of gsplat's kernels, as splatfacto calls them; by default those of gsplat 1.4.0
    (fully_fused_projection_fwd.cu, isect_tiles.cu, rasterize_to_pixels_fwd.cu).

    >>> import torch
    >>> from normlift_ns import Camera, GaussianScene, RasterSettings, render
    >>> means, quats = torch.tensor([[0.0, 0, 1]]), torch.tensor([[1.0, 0, 0, 0]])
    >>> scene = GaussianScene(means, quats, scales=torch.ones(1, 3), opacities=torch.ones(1))
    >>> camera = Camera(torch.tensor([[1.0, 0, 0.5], [0, 1, 0.5], [0, 0, 1]]), torch.eye(4), width=1, height=1)
    >>> choices = RasterSettings(), RasterSettings(max_alpha=0.75), RasterSettings(near_plane=2.0)
    >>> [render(scene, camera, torch.ones(1, 1), settings=settings)[1] for settings in choices]
    [tensor([[0.9990]]), tensor([[0.7500]]), tensor([[0.]])]
    >>> RasterSettings.of_gsplat("1.5").per_axis
    True
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
    min_compensation: float = 0.0
    """Lower bound of the factor by which antialiasing scales an opacity."""
    per_axis: bool = False
    """False: a square around the longer axis selects the tiles of a Gaussian. True, from gsplat 1.5 on: a rectangle
    around its extent along each axis of the image, not larger than where alpha falls below `min_alpha`."""
    radius_sigmas: float = 3.0
    """Half side of that square or, at most, of that rectangle, in standard deviations."""
    tile_size: int = 16
    """Side of a tile in pixels. A Gaussian is drawn in whole tiles only, so this changes the result."""
    max_alpha: float = 0.999
    """Upper bound of alpha."""
    min_alpha: float = 1 / 255
    """Pixels with a smaller alpha skip the Gaussian."""
    min_transmittance: float = 1e-4
    """A pixel stops before the first Gaussian that would leave this or less transmittance."""

    @staticmethod
    def of_gsplat(version: str) -> RasterSettings:
        """The constants of a version of gsplat: 1.4, 1.5, or 1.6, which is not released yet and may change.

        Args:
            version: two or more numbers with dots, such as "1.5" or "1.5.3".
        Raises:
            ValueError: a version of which nothing is known.

        >>> RasterSettings.of_gsplat("1.4.0") == RasterSettings(), RasterSettings.of_gsplat("1.6").max_alpha
        (True, 0.99)
        """
        rules = ".".join(version.split(".")[:2])
        if rules not in KNOWN_RULES:
            raise InputError(f"nothing is known of the rules of gsplat {version}; known are {', '.join(KNOWN_RULES)}")
        if rules == "1.4":
            return RasterSettings()
        rectangle = RasterSettings(per_axis=True, radius_sigmas=3.33)
        return rectangle if rules == "1.5" else replace(rectangle, max_alpha=0.99, min_compensation=0.005)

    @staticmethod
    def recorded(facts: Mapping[str, Any]) -> RasterSettings:
        """The constants that a manifest names as `gsplat_rules`; of one without, those of gsplat 1.4.

        Raises:
            ValueError: rules of which nothing is known.

        >>> RasterSettings.recorded({"gsplat_rules": "1.5"}).per_axis, RasterSettings.recorded({}).per_axis
        (True, False)
        """
        return RasterSettings.of_gsplat(str(facts.get("gsplat_rules", KNOWN_RULES[0])))
