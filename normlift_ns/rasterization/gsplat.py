"""Backend that uses stock gsplat on a GPU, and computes evidence as the gradient of its renders.

With colors c_j and the image I_i = sum_j A_ij c_j, the gradient of sum_{i in s} I_i with respect to c_j is E_js. One
backward pass with one-hot pixel gradients computes 32 regions. This backend runs gsplat's own kernels, so it can
verify `rasterization.triton`. It is slower, and its results differ in their last bits between runs, because gsplat uses
atomics.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from functools import cache
from importlib.metadata import PackageNotFoundError, version
from typing import Any, NamedTuple

import torch
from jaxtyping import Float32, Int32
from torch import Tensor

from normlift_ns.core.evidence import Entries
from normlift_ns.core.gaussians import Camera
from normlift_ns.core.sparse import sum_duplicates
from normlift_ns.errors import InputError
from normlift_ns.options import GSPLAT_VERSIONS, option_setting
from normlift_ns.rasterization.projection import camera_depths, prepare_gaussians, project
from normlift_ns.rasterization.rasterize import RasterBatch, RasterJob, check_gpu
from normlift_ns.rasterization.settings import RasterSettings

_CHANNELS = 32
_COMPILED = ("frustum_margin", "min_compensation", "max_alpha", "min_alpha", "min_transmittance")
"""Constants of gsplat's compiled code that must equal those of the scene."""
_EXTENT = ("per_axis", "radius_sigmas", "min_discriminant")
"""Further constants of the compiled code, which must usually equal those of the scene. They may differ if the scene
needs the squares of gsplat 1.4 and a later version is installed, because `_squares` then computes the squares."""
_LARGE = 100.0
"""Scale in world units below which no determinant overflows, for focal lengths below 400,000 pixels."""
_OVERFLOWS = 1e10
"""Radius in pixels below which no determinant overflows. A determinant is of the order of (radius / 3) ** 4."""
_LONGEST_RADIUS = 2**31 - 128
"""Largest int32 number that float32 represents exactly."""


class GsplatProjection(NamedTuple):
    """N Gaussians projected into C cameras of one size, as input of gsplat's rasterizer."""

    means2d: Float32[Tensor, "c n 2"]
    conics: Float32[Tensor, "c n 3"]
    opacities: Float32[Tensor, "c n"]
    indices: Int32[Tensor, " intersections"]
    """Indices c * N + n of projected Gaussians, sorted by camera, tile and depth."""
    offsets: Int32[Tensor, "c tiles_y tiles_x"]
    """Start of every tile in `indices`."""
    depths: Float32[Tensor, "c n"]
    radii: Int32[Tensor, "c n *axes"]
    """Half sides of squares or rectangles in pixels, or 0 for Gaussians that are not drawn."""


def project_views(job: RasterJob, cameras: Sequence[Camera]) -> GsplatProjection:
    """Return gsplat's projection and tile lists for cameras of one size."""
    from gsplat.cuda._wrapper import fully_fused_projection, isect_offset_encode, isect_tiles  # noqa: PLC0415

    scene, settings = job.scene, job.settings
    device, (width, height) = scene.means.device, (cameras[0].width, cameras[0].height)
    poses = torch.stack([camera.world_to_camera.float() for camera in cameras]).to(device)
    intrinsics = torch.stack([camera.K.float() for camera in cameras]).to(device)
    rectangle: dict[str, Any] = {"opacities": scene.opacities} if settings.per_axis else {}
    radii, means2d, depths, conics, compensations = fully_fused_projection(
        scene.means, None, scene.quats, scene.scales, poses, intrinsics, width, height,
        eps2d=settings.eps2d, near_plane=settings.near_plane, far_plane=settings.far_plane,
        calc_compensations=job.antialiased, **rectangle,
    )  # fmt: skip
    if radii.ndim == 3 and not settings.per_axis:  # gsplat 1.5 or later with a scene trained by gsplat 1.4
        radii = torch.where((radii > 0).all(2, keepdim=True), _squares(conics, settings), 0)
    radii = radii * (scene.drawable if radii.ndim == 2 else scene.drawable[:, None])
    opacities = scene.opacities.expand(len(cameras), -1)
    opacities = opacities * compensations if job.antialiased else opacities.contiguous()
    _project_enormous(job, cameras, radii, means2d, depths, conics, opacities)
    across, down = -(-width // settings.tile_size), -(-height // settings.tile_size)
    _, keys, indices = isect_tiles(means2d, radii, depths, settings.tile_size, across, down)
    offsets = isect_offset_encode(keys, len(cameras), across, down)
    return GsplatProjection(means2d, conics, opacities, indices, offsets, depths, radii)


def _squares(conics: Float32[Tensor, "c n 3"], settings: RasterSettings) -> Int32[Tensor, "c n 2"]:
    """Return the half sides in pixels of the squares that gsplat 1.4 computes from the covariances."""
    a, b, c = conics.unbind(2)
    det = 1 / (a * c - b * b)
    mean = 0.5 * det * (a + c)
    larger = mean + (mean * mean - det).clamp(min=settings.min_discriminant).sqrt()
    radius = (settings.radius_sigmas * larger.sqrt()).ceil().nan_to_num(0).clamp(max=_LONGEST_RADIUS)
    return radius.int()[:, :, None].expand(-1, -1, 2)


def _project_enormous(
    job: RasterJob,
    cameras: Sequence[Camera],
    radii: Tensor,
    means2d: Tensor,
    depths: Tensor,
    conics: Tensor,
    opacities: Tensor,
) -> None:
    """Replace gsplat's projection of Gaussians whose determinant overflows in float32."""
    scene = job.scene
    rows = (scene.drawable & (scene.scales.amax(dim=1) > _LARGE)).nonzero().squeeze(1)
    if len(rows) == 0:
        return
    world = prepare_gaussians(scene.select(rows), torch.float32)
    for view, camera in enumerate(cameras):
        projected = project(world, camera, job.settings, job.antialiased)
        overflows = projected.radii.amax(dim=1) > _OVERFLOWS
        index = rows[projected.gaussian[overflows]]
        radii[view, index], means2d[view, index] = _LONGEST_RADIUS, projected.means2d[overflows]
        conics[view, index] = projected.conics[overflows]
        depths[view, index] = camera_depths(scene.means[index], camera)
        if job.antialiased:
            opacities[view, index] = projected.opacities[overflows]


def check(job: RasterJob) -> None:
    """Raise ValueError if gsplat cannot compute a job.

    This backend supports 3D Gaussians in float32 on a GPU. The installed version must have the constants of the
    scene, and weight_power must be 1, because sums of other powers are not gradients.
    """
    check_gpu("gsplat", job)
    if job.weight_power != 1:
        raise InputError(
            f'backend "gsplat" needs weight_power 1, got {job.weight_power}; use '
            f"{option_setting('backend', 'auto')} for other powers"
        )
    if job.is_2d:
        raise InputError(
            f'backend "gsplat" draws 3D Gaussians only; use {option_setting("backend", "auto")} for 2D Gaussians'
        )
    compiled = installed_settings()
    squares = compiled.per_axis and not job.settings.per_axis
    names = _COMPILED if squares else (*_COMPILED, *_EXTENT)
    different = [name for name in names if getattr(job.settings, name) != getattr(compiled, name)]
    if len(different) > 0:
        raise InputError(
            f"gsplat {installed_gsplat_version()} is compiled with other values of {', '.join(different)} than the "
            f"scene needs; use {option_setting('backend', 'triton')} or {option_setting('backend', 'torch')}"
        )


def installed_settings() -> RasterSettings:
    """Return the constants of the installed gsplat version.

    Raises:
        ValueError: If gsplat is not installed or its version is unknown.
    """
    return RasterSettings.of_gsplat(installed_gsplat_version())


@cache
def installed_gsplat_version() -> str:
    """Return the version of the installed gsplat.

    Raises:
        ValueError: If gsplat is not installed.
    """
    try:
        return version("gsplat")
    except PackageNotFoundError as error:
        raise InputError("gsplat is not installed; run pip install gsplat") from error


def resolve_gsplat_rules(rules: str, recorded: str | None) -> str:
    """Return the gsplat version whose constants apply to a scene, such as "1.4".

    Args:
        rules: One of `GsplatVersion`.
        recorded: Version that trained the scene, or None if it is unknown. "auto" then selects 1.4, the version of
            nerfstudio 1.1.5.

    Raises:
        ValueError: If `rules` is "installed" and gsplat is not installed.
    """
    if rules == "auto":
        return recorded or GSPLAT_VERSIONS[0]
    if rules != "installed":
        return rules
    return ".".join(installed_gsplat_version().split(".")[:2])


def in_flight(job: RasterJob, camera: Camera) -> int:
    """Return 1, to save memory: gsplat's lists of a view take 60 bytes per Gaussian."""
    return 1


def views_evidence(job: RasterJob, batch: RasterBatch) -> Entries:
    """Return the entries of views, computed with gsplat's forward and backward passes."""
    parts, before = [], 0
    for camera, label_map, count in zip(*batch):
        for first, gradient in _gradients(job, camera, label_map, count):
            gaussian, column = gradient.nonzero(as_tuple=True)
            parts.append((gaussian, before + first + column, gradient[gaussian, column]))
        before += count + 1
    return Entries(*sum_duplicates(*(torch.cat(part) for part in zip(*parts))), tuple(batch.num_regions))


def composite(
    job: RasterJob, camera: Camera, values: Float32[Tensor, "n c"]
) -> tuple[Float32[Tensor, "h w c"], Float32[Tensor, "h w"]]:
    """Return sum_j A_ij values_j and sum_j A_ij of every pixel, computed by gsplat's kernel."""
    from gsplat.cuda._wrapper import rasterize_to_pixels  # noqa: PLC0415 (needs a GPU)

    size = (camera.height, camera.width)
    if len(job.scene) == 0 or values.shape[1] == 0:
        return values.new_zeros(*size, values.shape[1]), values.new_zeros(size)
    projections = project_views(job, [camera])
    tiles = (camera.width, camera.height, job.settings.tile_size, projections.offsets, projections.indices)
    parts = [
        rasterize_to_pixels(
            projections.means2d, projections.conics, part[None].contiguous(), projections.opacities, *tiles
        )
        for part in values.to(job.scene.means).split(_CHANNELS, dim=1)
    ]
    return torch.cat([image[0] for image, _ in parts], dim=-1), parts[0][1][0, :, :, 0]


def _gradients(
    job: RasterJob, camera: Camera, labels: Tensor, count: int
) -> Iterator[tuple[int, Float32[Tensor, "n c"]]]:
    """Yield (first column, sums of A_ij by column) for 32 columns at a time. Column 0 is for unlabeled pixels.

    The compiled functions are called as in gsplat's autograd function (cuda/_wrapper.py). Its backward pass computes
    the transmittance as 1 - alpha, with a relative error of up to 3e-4 for a transmittance near 1e-4. All weights of a
    pixel are proportional to this number. They are therefore multiplied by the ratio of the exact transmittance to 1 -
    alpha. The exact transmittance is the render of a black scene on a white background.
    """
    projections, settings = project_views(job, [camera]), job.settings
    colors = torch.zeros(1, len(job.scene), _CHANNELS, device=labels.device)
    splats = (projections.means2d, projections.conics, colors, projections.opacities)
    lists = (None, camera.width, camera.height, settings.tile_size, projections.offsets, projections.indices)
    forward, backward = compiled_rasterizer()
    transmittance, alphas, last = forward(*splats, colors.new_ones(1, _CHANNELS), *lists)
    correction = transmittance[..., :1] / (1 - alphas)
    column = labels.long() + 1
    for first in range(0, count + 1, _CHANNELS):
        channels = torch.arange(first, first + _CHANNELS, device=column.device)
        one_hot = (column[None, :, :, None] == channels) * correction
        gradients = backward(*splats, None, *lists, alphas, last, one_hot, torch.zeros_like(alphas), False)
        yield first, gradients[3][0]


def compiled_rasterizer() -> tuple[Callable[..., Any], Callable[..., Any]]:
    """Return gsplat's compiled forward and backward functions for pixels. Their names depend on the gsplat version."""
    from gsplat.cuda._backend import _C  # noqa: PLC0415

    name = "rasterize_to_pixels_3dgs" if hasattr(_C, "rasterize_to_pixels_3dgs_fwd") else "rasterize_to_pixels"
    return getattr(_C, f"{name}_fwd"), getattr(_C, f"{name}_bwd")
