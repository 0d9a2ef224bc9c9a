"""Constants of the rasterizer that trained the scene."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

from normlift_ns.core.arguments import check_arguments
from normlift_ns.errors import InputError
from normlift_ns.options import GSPLAT_VERSIONS


@check_arguments
@dataclass(frozen=True)
class RasterSettings:
    """Constants of gsplat's kernels as called by splatfacto, by default those of gsplat 1.4.0.

    The gsplat sources are fully_fused_projection_fwd.cu, isect_tiles.cu and rasterize_to_pixels_fwd.cu.

    Raises:
        ValueError: If a value is out of range.

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
    """Smallest depth of the center of a Gaussian that is drawn, in world units."""
    far_plane: float = 1e10
    """Largest depth of the center of a Gaussian that is drawn, in world units."""
    eps2d: float = 0.3
    """Blur that is added to the diagonal of the projected covariance, in square pixels."""
    frustum_margin: float = 0.3
    """Margin around the image, as a fraction of half its width and half its height. For Gaussians beyond the margin,
    the projection is linearized at the edge of the margin."""
    min_discriminant: float = 0.01
    """Lower bound of (trace / 2) ** 2 - det in the formula of the projected covariance's larger eigenvalue."""
    min_compensation: float = 0.0
    """Lower bound of the factor by which antialiasing scales opacities."""
    per_axis: bool = False
    """Shape that selects the tiles of a Gaussian. False selects a square with the extent of the longer axis. True, as
    in gsplat 1.5 and later, selects a rectangle around the pixels in which alpha can reach `min_alpha`."""
    radius_sigmas: float = 3.0
    """Half side of the square, or largest half side of the rectangle, in standard deviations."""
    tile_size: int = 16
    """Side of a tile in pixels. Gaussians are drawn only in the tiles that their square or rectangle touches."""
    max_alpha: float = 0.999
    """Upper bound of alpha."""
    min_alpha: float = 1 / 255
    """Smallest alpha with which a Gaussian is drawn in a pixel."""
    min_transmittance: float = 1e-4
    """Transmittance at which a pixel stops, before the first Gaussian that would reduce it to this value or less."""

    def __post_init__(self) -> None:
        for name, low, high in (
            ("far_plane", 0.0, float("inf")), ("near_plane", 0.0, self.far_plane), ("eps2d", 0.0, 1e6),
            ("frustum_margin", 0.0, 1e6), ("min_discriminant", 0.0, 1e6), ("min_compensation", 0.0, 1.0),
            ("radius_sigmas", 0.0, 1e6), ("tile_size", 1, 2**15), ("max_alpha", 0.0, 1.0), ("min_alpha", 0.0, 1.0),
            ("min_transmittance", 0.0, 1.0),
        ):  # fmt: skip
            if not low <= getattr(self, name) <= high:
                raise InputError(f"{name} must be in {low:g}..{high:g}, got {getattr(self, name)}")

    @staticmethod
    @check_arguments
    def of_gsplat(version: str) -> RasterSettings:
        """Return the constants of gsplat 1.4, 1.5 or 1.6. Version 1.6 is not released yet and may change.

        Args:
            version: Version number with at least two parts, such as "1.5" or "1.5.3".

        Raises:
            ValueError: If the version is unknown.

        >>> RasterSettings.of_gsplat("1.4.0") == RasterSettings(), RasterSettings.of_gsplat("1.6").max_alpha
        (True, 0.99)
        """
        minor = ".".join(version.split(".")[:2])
        if minor not in GSPLAT_VERSIONS:
            raise InputError(
                f"gsplat version {version!r} is not supported, expected one of {', '.join(GSPLAT_VERSIONS)}"
            )
        if minor == "1.4":
            return RasterSettings()
        rectangle = RasterSettings(per_axis=True, radius_sigmas=3.33)
        return rectangle if minor == "1.5" else replace(rectangle, max_alpha=0.99, min_compensation=0.005)

    @staticmethod
    @check_arguments
    def recorded(manifest: Mapping[str, Any]) -> RasterSettings:
        """Return the constants for the entries `gsplat_rules` (default: 1.4) and `clip_planes` of a manifest.

        Raises:
            ValueError: If the recorded version is unknown or a plane is out of range.

        >>> RasterSettings.recorded({"gsplat_rules": "1.5"}).per_axis, RasterSettings.recorded({}).per_axis
        (True, False)
        """
        settings = RasterSettings.of_gsplat(str(manifest.get("gsplat_rules", GSPLAT_VERSIONS[0])))
        if (planes := manifest.get("clip_planes")) is None:
            return settings
        near_plane, far_plane = planes
        return replace(settings, near_plane=near_plane, far_plane=far_plane)
