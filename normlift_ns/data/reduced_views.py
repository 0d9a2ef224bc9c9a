"""Some training views at reduced size, with renders of the same size, for checks before a lift."""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import torch
from jaxtyping import UInt8
from torch import Tensor

from normlift_ns.core.gaussians import GaussianScene
from normlift_ns.core.scene import Scene, View
from normlift_ns.errors import InputError
from normlift_ns.rasterization.rasterize import render_image
from normlift_ns.rasterization.settings import RasterSettings

_MAX_SIDE = 400
"""Maximum length of the longer side of a reduced view, in pixels."""
_MAX_DIVISOR_AS_TRAINED = 4.0
"""Limit on the divisor of the image size for renders in the trained mode.

Below the limit, 3D Gaussians are rendered in the trained mode, and the rasterizer's blur of 0.3 square pixels is scaled
down. Other reduced renders are antialiased, so that the blur does not add opacity to Gaussians smaller than a pixel.
"""
_SMALL_EPS2D = 0.1
"""Variance in square pixels that these antialiased renders add to projected Gaussians."""


class ReducedView(NamedTuple):
    """View whose image may be downscaled."""

    view: View
    divisor: float
    """Divisor of the sides of the original image, at least 1."""

    def reduced(self, side: int) -> ReducedView:
        """Downscale the view to at most `side` pixels on the longer side, by averaging pixels."""
        camera = self.view.camera
        divisor = max(1.0, max(camera.width, camera.height) / side)
        width, height = max(1, int(camera.width / divisor)), max(1, int(camera.height / divisor))
        return ReducedView(self.view.downscaled(height, width), self.divisor * divisor)

    def psnr(self, image: UInt8[Tensor, "h w 3"]) -> float:
        """Return the PSNR in dB of a render, over the pixels that the mask of the view keeps.

        The PSNR is at most 90 dB, and 0 if the mask keeps no pixel.
        """
        difference = (self.view.image.float() - image.float()) / 255
        if self.view.mask is not None:
            difference = difference[self.view.mask]
        return float(-10 * difference.square().mean().clamp(min=1e-9).log10()) if difference.numel() > 0 else 0.0

    def mean_color(self) -> UInt8[Tensor, "h w 3"]:
        """Return an image of one color, the mean over the pixels that the mask keeps."""
        view = self.view
        pixels = view.image.float() if view.mask is None else view.image[view.mask].float()
        color = pixels.reshape(-1, 3).mean(dim=0).nan_to_num()
        return color.round().to(torch.uint8).expand_as(view.image)

    def render(self, scene: Scene, gaussians: GaussianScene, settings: RasterSettings) -> UInt8[Tensor, "h w 3"]:
        """Render the scene so that it looks like a full-size render after downscaling.

        Args:
            scene: Scene to render.
            gaussians: Gaussians of the scene, on the rendering device.
            settings: Rasterizer settings for a render at full size.
        """
        as_trained = self.divisor < _MAX_DIVISOR_AS_TRAINED
        if gaussians.primitive == "2dgs" and self.divisor > 1:  # as thin 3D Gaussians, whose blur can be reduced
            gaussians, as_trained = replace(gaussians, primitive="3dgs"), False
        eps2d = settings.eps2d / self.divisor**2 if as_trained else _SMALL_EPS2D
        mode = scene.rasterize_mode if as_trained else "antialiased"
        settings = replace(settings, eps2d=eps2d)
        return render_image(scene, self.view.camera, settings=settings, mode=mode, gaussians=gaussians)


def sample_views(scene: Scene) -> list[ReducedView]:
    """Return the first, the middle and the last training view, with at most 400 pixels on the longer side.

    Views whose mask leaves no pixels are left out.

    Raises:
        FileNotFoundError, ValueError: An image is missing or cannot be read, or the masks leave no pixels.
    """
    last = len(scene.train) - 1
    views = [ReducedView(scene.train[index], 1.0).reduced(_MAX_SIDE) for index in sorted({0, last // 2, last})]
    usable = [small for small in views if small.view.mask is None or bool(small.view.mask.any())]
    if len(usable) == 0:
        raise InputError(
            f"The masks of {', '.join(small.view.name for small in views)} leave no pixels. Expected masks that are "
            "zero at pixels to ignore. Check whether they are inverted."
        )
    return usable
