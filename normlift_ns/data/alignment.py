"""Comparison of a few renders with their images before a lift, to detect cameras that do not match the splat."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, UInt8
from torch import Tensor

from normlift_ns.core.gaussians import Camera, GaussianScene
from normlift_ns.core.scene import Scene, View
from normlift_ns.errors import InputError
from normlift_ns.rasterization.rasterize import render_image
from normlift_ns.rasterization.settings import RasterSettings

_MAX_RENDER_SIDE = 400
"""Longer side of the renders in pixels."""
_MAX_DIVISOR_AS_TRAINED = 4.0
"""Divisor of the image size up to which the render uses the rasterize mode of the training, with a scaled eps2d.

For smaller copies, this mode would draw Gaussians too large. They use antialiased mode, which preserves the mean of
Gaussians smaller than a pixel.
"""
_SMALL_EPS2D = 0.1
"""Value of eps2d of the antialiased renders, in square pixels."""
MIN_PSNR = 24.0
"""Usual minimum PSNR in dB. Real scenes reach 25 to 40 dB on their training images."""
_FOCAL_STEP, _FOCAL_GAIN = 1.02, 1.0
"""Factor on the focal length, and minimum gain in dB to report it.

On a sharp scene, a focal length that is wrong by 2 % costs about 15 dB.
"""
_MIN_VISIBLE = 0.001
"""Minimum fraction of the Gaussians in the view that contains most of them."""


_SmallView = tuple[View, float]
"""View of at most 400 pixels on the longer side, and the divisor of its size."""


class Alignment(NamedTuple):
    """Agreement between renders and images."""

    psnr: float
    """Mean PSNR of the renders, in dB."""
    worst: tuple[str, float]
    """Name and PSNR in dB of the image with the lowest PSNR."""
    visible_fraction: float
    """Fraction of the Gaussians in the view that contains most of them, in 0..1."""
    mean_color_psnr: float
    """Mean PSNR in dB if each image is compared with its mean color instead of a render."""
    focal_factor: float
    """Factor 1 / 1.02 or 1.02 on the focal lengths, if it increases the mean PSNR by more than 1 dB; otherwise 1."""


def measure_alignment(scene: Scene, settings: RasterSettings | None = None, *, device: str = "cpu") -> Alignment:
    """Render three training views with at most 400 pixels on the longer side, and compare them with their images.

    Args:
        scene: Scene with Gaussians, cameras and images.
        settings: Constants of the rasterizer at full size; None for the constants of gsplat 1.4.
        device: Device of torch that renders the views.
    Raises:
        FileNotFoundError, ValueError: An image is missing or cannot be read.
    """
    views, settings = _sample_views(scene), settings or RasterSettings()
    render = partial(_render, scene, scene.gaussians.to(device), settings)
    visible = max(float(in_frustum(scene.gaussians.means, view.camera).float().mean()) for view, _ in views)
    psnrs = {small[0].name: _psnr(small[0], render(small, 1.0)) for small in views}
    mean, worst = sum(psnrs.values()) / len(psnrs), min(psnrs, key=lambda name: psnrs[name])
    constant = sum(_psnr(view, _mean_color(view)) for view, _ in views) / len(views)
    others = {factor: _mean_psnr(render, views, factor) for factor in (1 / _FOCAL_STEP, _FOCAL_STEP)}
    best = max(others, key=lambda factor: others[factor])
    focal = best if others[best] > mean + _FOCAL_GAIN else 1.0
    return Alignment(mean, (worst, psnrs[worst]), visible, constant, focal)


def mean_psnr(scene: Scene, factor: float = 1.0) -> float:
    """Return the mean PSNR of `Alignment` in dB, after multiplying the focal lengths by a factor."""
    render = partial(_render, scene, scene.gaussians, RasterSettings())
    return _mean_psnr(render, _sample_views(scene), factor)


def alignment_warning(match: Alignment, *, trained_cameras: bool) -> str | None:
    """Return a warning in whole sentences, or None if renders and images agree.

    Args:
        match: Result of `measure_alignment`.
        trained_cameras: True if, according to the files, the splat was trained with these cameras.
    Raises:
        ValueError: The Gaussians and the cameras do not belong together.
    """
    causes = "Likely causes: " + (
        "the images, their exposure or transforms.json have changed since the training, or the training was stopped "
        "early"
        if trained_cameras
        else "cameras of another capture, or cameras in another world than the splat. Give --world-transform, or for "
        "gsplat's trainer --gsplat-normalize. Other causes are other, distorted or much smaller images, another "
        "exposure, another --rasterize-mode or another --background"
    )
    if match.visible_fraction < _MIN_VISIBLE:
        raise InputError(
            f"The cameras do not show this splat: at most {match.visible_fraction:.2%} of its Gaussians are in any "
            f"of three training views. {causes}. To lift anyway, give --check-alignment False."
        )
    if match.psnr < match.mean_color_psnr and not trained_cameras:
        raise InputError(
            f"The splat does not match its images. Renders of three training views have a PSNR of {match.psnr:.1f} dB, "
            f"less than the mean color of each image ({match.mean_color_psnr:.1f} dB). {causes}. "
            "To lift anyway, give --check-alignment False."
        )
    if match.focal_factor != 1.0:
        return (
            f"Focal lengths that are {abs(match.focal_factor - 1):.0%} "
            f"{'longer' if match.focal_factor > 1 else 'shorter'} increase the PSNR by more than 1 dB. The cameras "
            "may not be those of the training. Check whether the camera file has changed or the images were resized."
        )
    name, lowest = match.worst
    if match.psnr >= MIN_PSNR > lowest:
        return (
            f"The render of {name}, one of three training images that were checked, has a PSNR of only {lowest:.1f} "
            f"dB; {MIN_PSNR:.0f} dB or more is usual. Check whether this image or its camera has changed since the "
            "training. If so, other images may have changed too."
        )
    if match.psnr < MIN_PSNR:
        return (
            f"Renders of three training images have a PSNR of {match.psnr:.1f} dB; {MIN_PSNR:.0f} dB or more is usual. "
            f"The semantics will be equally inexact. {causes}."
        )
    return None


def _sample_views(scene: Scene) -> list[_SmallView]:
    last = len(scene.train) - 1
    views = [_shrink(scene.train[index]) for index in sorted({0, last // 2, last})]
    usable = [(view, divisor) for view, divisor in views if view.mask is None or bool(view.mask.any())]
    if len(usable) == 0:
        raise InputError(
            f"The masks of {', '.join(view.name for view, _ in views)} exclude all pixels. Expected masks that are "
            "zero only at pixels to ignore. If they are inverted, invert them again."
        )
    return usable


def _shrink(view: View) -> _SmallView:
    """Downscale a view to at most 400 pixels on the longer side; also return the divisor of its size."""
    camera = view.camera
    divisor = max(1.0, max(camera.width, camera.height) / _MAX_RENDER_SIDE)
    width, height = max(1, int(camera.width / divisor)), max(1, int(camera.height / divisor))
    return view.downscaled(height, width), divisor


def _mean_psnr(render: Callable[[_SmallView, float], Tensor], views: Sequence[_SmallView], factor: float) -> float:
    return sum(_psnr(small[0], render(small, factor)) for small in views) / len(views)


def _render(
    scene: Scene, gaussians: GaussianScene, settings: RasterSettings, small: _SmallView, factor: float
) -> UInt8[Tensor, "h w 3"]:
    """Render a small view of the scene that looks like a downscaled render at full size."""
    view, divisor = small
    camera = replace(view.camera, K=view.camera.K * torch.tensor([[factor, 1, 1], [1, factor, 1], [1, 1, 1]]))
    as_trained = divisor < _MAX_DIVISOR_AS_TRAINED
    small_settings = replace(settings, eps2d=settings.eps2d / divisor**2 if as_trained else _SMALL_EPS2D)
    mode = scene.rasterize_mode if as_trained else "antialiased"
    return render_image(scene, camera, settings=small_settings, mode=mode, gaussians=gaussians)


def _psnr(view: View, render: UInt8[Tensor, "h w 3"]) -> float:
    difference = (view.image.float() - render.float()) / 255
    if view.mask is not None:
        difference = difference[view.mask]
    return float(-10 * difference.square().mean().clamp(min=1e-9).log10()) if difference.numel() > 0 else 0.0


def _mean_color(view: View) -> UInt8[Tensor, "h w 3"]:
    pixels = view.image.float() if view.mask is None else view.image[view.mask].float()
    color = pixels.reshape(-1, 3).mean(dim=0).nan_to_num()
    return color.round().to(torch.uint8).expand_as(view.image)


def in_frustum(means: Float[Tensor, "n 3"], camera: Camera) -> Bool[Tensor, " n"]:
    """Return a mask of the Gaussians whose centers are inside the image and in front of the camera."""
    _, _, depth, inside = camera.project(means)
    return inside & (depth > 0.01)
