"""Comparison of a few renders with training images before a lift, to detect cameras that do not match the splat."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import asdict, replace
from pathlib import Path
from statistics import fmean, median
from typing import NamedTuple

import msgspec
from jaxtyping import Bool, Float, UInt8
from torch import Tensor

from normlift_ns.core.gaussians import Camera, GaussianScene
from normlift_ns.core.scene import Scene
from normlift_ns.data.misfit import explain_misfit
from normlift_ns.data.reduced_views import ReducedView, sample_views
from normlift_ns.errors import InputError
from normlift_ns.io.arrays import array_digest, load_arrays, save_arrays
from normlift_ns.rasterization.settings import RasterSettings

MIN_PSNR = 24.0
"""Lower bound of the usual PSNR in dB. Real scenes reach 25 to 40 dB on their training images."""
MIN_MARGIN = 3.0
"""Minimum `Alignment.margin` in dB. In `python -m research.worlds`, the margin is smaller for cameras in the wrong
world, and at least 4 dB for cameras in the right world."""
_MIN_VISIBLE = 0.001
"""Minimum `Alignment.visible_fraction`."""
_CACHE_VERSION = "normlift_ns.alignment/1"
"""Version in every cache key; increase it when `measure_alignment` returns a different result for the same input."""


class Alignment(NamedTuple):
    """Agreement between renders and images."""

    psnr: float
    """Mean PSNR of the renders, in dB."""
    worst: tuple[str, float]
    """Name of the image whose render has the lowest PSNR, and this PSNR in dB."""
    visible_fraction: float
    """Largest fraction over the views, in 0..1, of Gaussians whose centers project into the image."""
    mean_color_psnr: float
    """Mean PSNR in dB if each image is compared with its mean color instead of a render."""
    margin: float
    """Median over the views, in dB, of the PSNR of the render minus the PSNR of the image's mean color."""
    cause: str | None = None
    """Sentence about another lens or primitive that fits the images better; None if no search found one."""

    @property
    def is_usual(self) -> bool:
        """True if `psnr` is at least `MIN_PSNR` and `margin` is at least `MIN_MARGIN`."""
        return self.psnr >= MIN_PSNR and self.margin >= MIN_MARGIN


def measure_alignment(
    scene: Scene, settings: RasterSettings | None = None, *, device: str = "cpu", explain: bool = True
) -> Alignment:
    """Render the views that `sample_views` selects, and compare the renders with the images.

    Args:
        scene: Gaussians, cameras and images.
        settings: Constants of the rasterizer at the original image size. None: the constants recorded in the scene.
        device: torch device to render on.
        explain: If False, search for a `cause` with `explain_misfit` only if `Alignment.is_usual` is True.
    Raises:
        FileNotFoundError, ValueError: An image is missing or cannot be read.
    """
    views, settings, gaussians = (
        sample_views(scene),
        settings or RasterSettings.recorded(scene.identity),
        scene.gaussians.to(device),
    )
    renders = [small.render(scene, gaussians, settings) for small in views]
    match = _compare(scene.gaussians, views, renders)
    if not (match.is_usual or explain):
        return match

    def render_flat(small: ReducedView) -> UInt8[Tensor, "h w 3"]:
        flat = replace(gaussians, scales=gaussians.scales * gaussians.scales.new_tensor([1.0, 1.0, 0.0]))
        return small.render(scene, flat, settings)

    is_flat = gaussians.primitive == "2dgs"
    other = None if match.is_usual or is_flat or scene.renderer is not None else render_flat
    return match._replace(cause=explain_misfit(views, renders, other, MIN_PSNR, MIN_MARGIN))


def cached_alignment(
    scene: Scene, settings: RasterSettings, folder: Path, *, device: str, wait_for_kernels: Callable[[], None]
) -> Alignment:
    """Return the result of `measure_alignment` from a cache, or compute and store it.

    Results of different devices count as equal, because they differ only by rounding. Results for scenes that another
    package renders are not cached.

    Args:
        folder: Folder of the cache. It may be missing or read-only.
        wait_for_kernels: Function that is called before the views are rendered.
        scene, settings, device: As in `measure_alignment`.
    """
    path = None if scene.renderer is not None else folder / f"{_alignment_key(scene, settings)}.safetensors"
    if path is not None and path.is_file():
        with suppress(OSError, ValueError, KeyError, TypeError, msgspec.ValidationError):
            return msgspec.convert(json.loads(load_arrays(path, key=path.stem).metadata["alignment"]), Alignment)
    wait_for_kernels()
    match = measure_alignment(scene, settings, device=device)
    if path is not None:
        with suppress(OSError):
            save_arrays(path, {}, {"alignment": json.dumps(match)}, key=path.stem, overwrite=True)
    return match


def _alignment_key(scene: Scene, settings: RasterSettings) -> str:
    """Return a digest of everything that `measure_alignment` depends on, except the device."""
    gaussians, views = scene.gaussians, [small.view for small in sample_views(scene)]
    arrays = {name: getattr(gaussians, name) for name in ("means", "quats", "scales", "opacities")}
    arrays["background"] = scene.background
    for number, view in enumerate(views):
        camera = view.camera
        parts = {"image": view.image, "mask": view.mask, "K": camera.K, "pose": camera.world_to_camera}
        parts["colors"] = scene.colors(camera)
        arrays |= {f"{name} {number}": part for name, part in parts.items() if part is not None}
    facts = [_CACHE_VERSION, gaussians.primitive, scene.rasterize_mode, asdict(settings), [view.name for view in views]]
    return array_digest(arrays, {"facts": json.dumps(facts)}).rpartition(":")[2]


def _compare(
    gaussians: GaussianScene, views: Sequence[ReducedView], renders: Sequence[UInt8[Tensor, "h w 3"]]
) -> Alignment:
    """Compare the images of the views with their renders, without a search for a `cause`."""
    visible = max(float(in_frustum(gaussians.means, small.view.camera).float().mean()) for small in views)
    psnrs = {small.view.name: small.psnr(image) for small, image in zip(views, renders)}
    worst = min(psnrs, key=lambda name: psnrs[name])
    constants = {small.view.name: small.psnr(small.mean_color()) for small in views}
    margin = median(psnrs[name] - constants[name] for name in psnrs)
    return Alignment(fmean(psnrs.values()), (worst, psnrs[worst]), visible, fmean(constants.values()), margin)


def alignment_warning(match: Alignment, *, trained_cameras: bool) -> str | None:
    """Return a warning in whole sentences, or None if renders and images agree.

    Args:
        match: Result of `measure_alignment`.
        trained_cameras: True if, according to the files, the splat was trained with these cameras.
    Raises:
        ValueError: The views contain almost none of the Gaussians. Also if the margin is below `MIN_MARGIN` and
            `trained_cameras` is False.
    """
    other_cameras = (
        "cameras of another capture, or in another world than the splat (see --world-transform and, for gsplat's "
        "trainer, --gsplat-normalize)"
    )
    if match.visible_fraction < _MIN_VISIBLE:
        cause = "cameras that have changed since the training" if trained_cameras else other_cameras
        raise InputError(
            "The cameras do not show this splat: each training view that was checked contains at most "
            f"{match.visible_fraction:.2%} of the Gaussians. Likely cause: {cause}. To lift anyway, give "
            "--check-alignment False."
        )
    causes = "Likely causes: " + (
        "the images, their exposure or the cameras have changed since the training, or the training was stopped early"
        if trained_cameras
        else f"{other_cameras}; images that are distorted, have a different exposure or are much smaller than the "
        "training images; or another --rasterize-mode or --background"
    )
    reason = match.cause or f"{causes}."
    if match.margin < MIN_MARGIN:
        problem = (
            f"The splat does not match its images: renders of training views reach a PSNR of {match.psnr:.1f} dB, "
            f"{abs(match.margin):.1f} dB {'less' if match.margin < 0 else 'more'} than the mean color of an image. "
            f"Expected at least {MIN_MARGIN:.0f} dB more. {reason}"
        )
        if not trained_cameras:
            raise InputError(f"{problem} To lift anyway, give --check-alignment False.")
        return problem
    name, lowest = match.worst
    if match.cause is not None:
        return match.cause
    if match.psnr >= MIN_PSNR > lowest:
        return (
            f"The render of {name}, one of the training images that were checked, has a PSNR of only {lowest:.1f} "
            f"dB; {MIN_PSNR:.0f} dB or more is usual. Check whether this image or its camera has changed since the "
            "training. If so, other images may have changed too."
        )
    if match.psnr < MIN_PSNR:
        return (
            f"Renders of training views have a mean PSNR of {match.psnr:.1f} dB; {MIN_PSNR:.0f} dB or more is usual. "
            f"Expect less accurate semantics. {causes}."
        )
    return None


def in_frustum(means: Float[Tensor, "n 3"], camera: Camera) -> Bool[Tensor, " n"]:
    """Return a mask of the Gaussians whose centers are in front of the camera and project into the image."""
    _, _, depth, inside = camera.project(means)
    return inside & (depth > 0)
