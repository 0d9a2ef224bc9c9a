"""Do photographs, cameras and Gaussians belong together? A few renders tell, before a lift takes minutes."""

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
from normlift_ns.raster.rasterize import render_picture
from normlift_ns.raster.settings import RasterSettings

_LONGEST = 400
"""Longer side of the renders in pixels."""
_FINE = 4.0
"""A photograph made smaller by less than this is met by making the rasterizer's 0.3 square pixels smaller, one made
smaller by more by renders that keep the mean of Gaussians below the size of a pixel. As trained, a render at that size
would be too thick."""
_THIN = 0.1
"""Square pixels added in such renders."""
LEAST_PSNR = 24.0
"""Scenes of people reach 25 to 40 dB on the photographs of their training."""
_FOCAL_STEP, _FOCAL_GAIN = 1.02, 1.0
"""A focal length that is wrong by 2 % costs about 15 dB on a sharp scene: 1 dB is well beyond chance."""
_LEAST_IN_VIEW = 0.001
"""Share of the Gaussians that one of the views must see."""


class _Small(NamedTuple):
    """A view at no more than 400 pixels, and by how much it was made smaller."""

    view: View
    divisor: float


class Match(NamedTuple):
    """How well renders and photographs agree."""

    psnr: float
    """Mean over the views, in dB."""
    worst: tuple[str, float]
    """The photograph that agrees least, and its PSNR in dB."""
    in_view: float
    """Largest share of the Gaussians that lie in a view, in 0..1."""
    grey_psnr: float
    """What pictures of one colour, the mean of each photograph, would reach."""
    focal: float
    """Factor on the focal lengths, of 1 / 1.02, 1 and 1.02, that fits best by at least 1 dB; else 1."""


def match_photographs(scene: Scene, settings: RasterSettings | None = None, *, device: str = "cpu") -> Match:
    """Renders three training views at no more than 400 pixels and compares them with their photographs.

    Args:
        settings: constants of the rasterizer, at full size; those of gsplat 1.4 by default.
        device: where to render.
    Raises:
        FileNotFoundError, ValueError: a photograph that is missing or cannot be read.
    """
    views, settings = _some_views(scene), settings or RasterSettings()
    draw = partial(_picture, scene, scene.gaussians.to(device), settings)
    in_view = max(_share_in_view(scene, small.view.camera) for small in views)
    each = {small.view.name: _psnr(small.view, draw(small, 1.0)) for small in views}
    plain, worst = sum(each.values()) / len(each), min(each, key=lambda name: each[name])
    grey = sum(_psnr(small.view, _mean_color(small.view)) for small in views) / len(views)
    others = {factor: _mean_psnr(draw, views, factor) for factor in (1 / _FOCAL_STEP, _FOCAL_STEP)}
    best = max(others, key=lambda factor: others[factor])
    return Match(plain, (worst, each[worst]), in_view, grey, best if others[best] > plain + _FOCAL_GAIN else 1.0)


def mean_psnr(scene: Scene) -> float:
    """`Match.psnr` alone, in dB."""
    return focal_psnrs(scene, [1.0])[0]


def focal_psnrs(scene: Scene, factors: Sequence[float]) -> list[float]:
    """PSNR in dB on the three views, with the focal lengths times each of the factors."""
    views, draw = _some_views(scene), partial(_picture, scene, scene.gaussians, RasterSettings())
    return [_mean_psnr(draw, views, factor) for factor in factors]


def judge(match: Match, *, own_cameras: bool) -> str | None:
    """None where all is well, or a warning in whole sentences.

    Args:
        own_cameras: whether the cameras are those that the splat was trained with, as far as files tell.
    Raises:
        ValueError: Gaussians and cameras have nothing to do with each other.
    """
    causes = (
        "Likely causes: cameras of another capture; cameras in another world than the splat's (give "
        "--world-transform; for gsplat's trainer see --gsplat-normalize); other photographs, or distorted ones under "
        "cameras of undistorted ones; another exposure than in the training; much smaller copies of the photographs "
        "than those of the training; another --rasterize-mode or --background"
    )
    if own_cameras:
        causes = (
            "Likely causes: the photographs, their exposure or transforms.json have changed since the training, or the "
            "training was stopped early"
        )
    if match.in_view < _LEAST_IN_VIEW:
        raise InputError(
            f"The cameras do not look at this splat: at most {match.in_view:.2%} of its Gaussians are in any of three "
            f"training views. {causes}. --check False lifts nevertheless."
        )
    if match.psnr < match.grey_psnr and not own_cameras:
        raise InputError(
            f"The splat does not show what its photographs show: rendered from three of their cameras, it is further "
            f"from them ({match.psnr:.1f} dB) than their mean colour is ({match.grey_psnr:.1f} dB). {causes}. --check "
            "False lifts nevertheless."
        )
    if match.focal != 1.0:
        return (
            f"Focal lengths that are {abs(match.focal - 1):.0%} {'longer' if match.focal > 1 else 'shorter'} fit the "
            f"photographs better by more than 1 dB. The cameras may not be those of the training: has their file "
            "changed since, or were the images rescaled?"
        )
    name, least = match.worst
    if match.psnr >= LEAST_PSNR > least:
        return (
            f"The splat reaches only {least:.1f} dB on {name}, one of three photographs of its training that were "
            f"looked at; {LEAST_PSNR:.0f} dB or more is usual. Was this photograph, or its camera, changed since the "
            "training? Others may have been as well: only three are looked at."
        )
    if match.psnr < LEAST_PSNR:
        return (
            f"The splat reaches {match.psnr:.1f} dB on three photographs of its training; {LEAST_PSNR:.0f} dB or more "
            f"is usual. Semantics will be as inexact. {causes}."
        )
    return None


def _some_views(scene: Scene) -> list[_Small]:
    last = len(scene.train) - 1
    views = [_small(scene.train[index]) for index in sorted({0, last // 2, last})]
    seen = [small for small in views if small.view.mask is None or bool(small.view.mask.any())]
    if len(seen) == 0:
        raise InputError(
            f"The masks of {', '.join(small.view.name for small in views)} leave no pixel. Expected masks that are "
            "zero where a pixel does not count; are they inverted?"
        )
    return seen


def _small(view: View) -> _Small:
    """Pixels are averaged, so that what is left needs no filter."""
    camera = view.camera
    divisor = max(1.0, max(camera.width, camera.height) / _LONGEST)
    width, height = max(1, int(camera.width / divisor)), max(1, int(camera.height / divisor))
    scale = torch.tensor([[width / camera.width], [height / camera.height], [1.0]])
    channels = view.image.permute(2, 0, 1)[None].float()
    image = torch.nn.functional.interpolate(channels, (height, width), mode="area")[0].permute(1, 2, 0)
    mask = view.mask
    if mask is not None:
        share = torch.nn.functional.interpolate(mask[None, None].float(), (height, width), mode="area")[0, 0]
        mask = share > 0.999
    smaller = Camera(camera.K * scale, camera.world_to_camera, width, height)
    return _Small(View(smaller, image.round().to(torch.uint8), mask, view.name), divisor)


def _mean_psnr(draw: Callable[[_Small, float], Tensor], views: Sequence[_Small], factor: float) -> float:
    return sum(_psnr(small.view, draw(small, factor)) for small in views) / len(views)


def _picture(
    scene: Scene, gaussians: GaussianScene, settings: RasterSettings, small: _Small, factor: float
) -> UInt8[Tensor, "h w 3"]:
    """The scene, as a render at full size would be if it were made smaller."""
    camera = _zoomed(small.view.camera, factor)
    fine = small.divisor < _FINE
    smaller = replace(settings, eps2d=settings.eps2d / small.divisor**2 if fine else _THIN)
    mode = scene.rasterize_mode if fine else "antialiased"
    return render_picture(scene, camera, settings=smaller, mode=mode, gaussians=gaussians)


def _zoomed(camera: Camera, factor: float) -> Camera:
    scale = torch.tensor([[factor, 1, 1], [1, factor, 1], [1, 1, 1]])
    return Camera(camera.K * scale, camera.world_to_camera, camera.width, camera.height)


def _psnr(view: View, picture: UInt8[Tensor, "h w 3"]) -> float:
    gap = (view.image.float() - picture.float()) / 255
    if view.mask is not None:
        gap = gap[view.mask]
    return float(-10 * gap.square().mean().clamp(min=1e-9).log10()) if gap.numel() > 0 else 0.0


def _mean_color(view: View) -> UInt8[Tensor, "h w 3"]:
    pixels = view.image.float() if view.mask is None else view.image[view.mask].float()
    color = pixels.reshape(-1, 3).mean(dim=0).nan_to_num()
    return color.round().to(torch.uint8).expand_as(view.image)


def _share_in_view(scene: Scene, camera: Camera) -> float:
    return float(in_view(scene.gaussians.means, camera).float().mean())


def in_view(means: Float[Tensor, "n 3"], camera: Camera) -> Bool[Tensor, " n"]:
    """Which centres of Gaussians lie in the image and before the camera."""
    pose = camera.world_to_camera.to(means)
    places = means @ pose[:3, :3].T + pose[:3, 3]
    pixels = places @ camera.K.to(means).T
    x, y, depth = (pixels[:, 0] / pixels[:, 2], pixels[:, 1] / pixels[:, 2], places[:, 2])
    return (depth > 0.01) & (x >= 0) & (x < camera.width) & (y >= 0) & (y < camera.height)
