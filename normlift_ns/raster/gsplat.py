"""Stock gsplat on the GPU: its projection and its tile lists, and evidence as the gradient of its renders.

With colours c_j and the image I_i = sum_j A_ij c_j, the gradient of sum_{i in s} I_i with respect to c_j is E_js: one
backward pass with one-hot pixel gradients gives 32 regions at once. Slower than `raster.triton` and not bitwise
repeatable (gsplat adds with atomics), but gsplat's own code throughout.
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
from normlift_ns.core.gaussians import Camera, GaussianScene
from normlift_ns.core.sparse import sum_duplicates
from normlift_ns.errors import InputError
from normlift_ns.options import KNOWN_RULES
from normlift_ns.raster.backend import Batch, Job, check_gpu
from normlift_ns.raster.projection import camera_depths, project, to_world
from normlift_ns.raster.settings import RasterSettings

_CHANNELS = 32
_COMPILED = ("frustum_margin", "min_compensation", "max_alpha", "min_alpha", "min_transmittance")
"""Constants that stand in gsplat's compiled code."""
_EXTENT = ("per_axis", "radius_sigmas", "min_discriminant")
"""Those too; but squares, which gsplat computes up to 1.4, can be given to its later versions."""
_LARGE = 100.0
"""Scale in world units up to which no camera (focal length below 400,000 pixels) makes a determinant overflow."""
_OVERFLOWS = 1e10
"""Radius in pixels of every Gaussian whose determinant, of the order of (radius / 3) ** 4, overflows."""
_LONGEST_RADIUS = 2**31 - 128
"""An int32 that is a float32 number too."""


class Projections(NamedTuple):
    """What C cameras of one size see of N Gaussians, and where: the input of gsplat's rasterizer."""

    means2d: Float32[Tensor, "c n 2"]
    conics: Float32[Tensor, "c n 3"]
    opacities: Float32[Tensor, "c n"]
    members: Int32[Tensor, " intersections"]
    """Indices into c * n, by camera, tile and depth."""
    offsets: Int32[Tensor, "c tiles_y tiles_x"]
    """Where each tile starts in `members`."""
    depths: Float32[Tensor, "c n"]
    radii: Int32[Tensor, "c n *axes"]
    """Half sides of squares, or of rectangles; 0: not drawn."""


def project_views(job: Job, cameras: Sequence[Camera]) -> Projections:
    """gsplat's projection and tile lists for cameras of one size."""
    from gsplat.cuda._wrapper import (  # noqa: PLC0415 (needs a GPU)
        fully_fused_projection,
        isect_offset_encode,
        isect_tiles,
    )

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
    if radii.ndim == 3 and not settings.per_axis:  # a later gsplat, and a scene of an earlier one
        radii = torch.where((radii > 0).all(2, keepdim=True), _squares(conics, settings), 0)
    radii = radii * (scene.drawable if radii.ndim == 2 else scene.drawable[:, None])
    opacities = scene.opacities.expand(len(cameras), -1)
    opacities = opacities * compensations if job.antialiased else opacities.contiguous()
    _project_enormous(job, cameras, radii, means2d, depths, conics, opacities)
    across, down = -(-width // settings.tile_size), -(-height // settings.tile_size)
    _, keys, members = isect_tiles(means2d, radii, depths, settings.tile_size, across, down)
    offsets = isect_offset_encode(keys, len(cameras), across, down)
    return Projections(means2d, conics, opacities, members, offsets, depths, radii)


def _squares(conics: Float32[Tensor, "c n 3"], settings: RasterSettings) -> Int32[Tensor, "c n 2"]:
    """Half sides of the squares that gsplat 1.4 computes from the covariances."""
    a, b, c = conics.unbind(2)
    det = 1 / (a * c - b * b)
    mean = 0.5 * det * (a + c)
    larger = mean + (mean * mean - det).clamp(min=settings.min_discriminant).sqrt()
    radius = (settings.radius_sigmas * larger.sqrt()).ceil().nan_to_num(0).clamp(max=_LONGEST_RADIUS)
    return radius.int()[:, :, None].expand(-1, -1, 2)


def _project_enormous(
    job: Job,
    cameras: Sequence[Camera],
    radii: Tensor,
    means2d: Tensor,
    depths: Tensor,
    conics: Tensor,
    opacities: Tensor,
) -> None:
    """Replaces what gsplat projected of Gaussians whose determinant is no float32 number there: inf or NaN."""
    scene = job.scene
    rows = (scene.drawable & (scene.scales.amax(dim=1) > _LARGE)).nonzero().squeeze(1)
    if len(rows) == 0:
        return
    some = GaussianScene(*(x[rows] for x in (scene.means, scene.quats, scene.scales, scene.opacities)))
    world = to_world(some, torch.float32)
    for view, camera in enumerate(cameras):
        seen = project(world, camera, job.settings, job.antialiased)
        there = seen.radii.amax(dim=1) > _OVERFLOWS
        place = rows[seen.gaussian[there]]
        radii[view, place], means2d[view, place] = _LONGEST_RADIUS, seen.means2d[there]
        conics[view, place] = seen.conics[there]
        depths[view, place] = camera_depths(scene.means[place], camera)
        if job.antialiased:
            opacities[view, place] = seen.opacities[there]


def check(job: Job, *, pictures: bool = False) -> None:
    """Raises ValueError for a scene that is not float32 on a GPU, and for other constants than those that the
    installed gsplat has compiled."""
    check_gpu("gsplat", job)
    compiled = installed_rules()
    ours = compiled.per_axis and not job.settings.per_axis
    names = _COMPILED if ours else (*_COMPILED, *_EXTENT)
    other = [name for name in names if getattr(job.settings, name) != getattr(compiled, name)]
    if len(other) > 0:
        raise InputError(
            f"gsplat {installed_version()} has compiled another {', '.join(other)} than the scene is drawn with; use "
            'backend="triton" or "torch", which know all rules'
        )


def installed_rules() -> RasterSettings:
    """The constants of the installed gsplat.

    Raises:
        ValueError: none is installed, or a version of which nothing is known.
    """
    return RasterSettings.of_gsplat(installed_version())


@cache
def installed_version() -> str:
    """Of gsplat.

    Raises:
        ValueError: none is installed.
    """
    try:
        return version("gsplat")
    except PackageNotFoundError as error:
        raise InputError("gsplat is not installed (pip install gsplat)") from error


def rules_named(wanted: str, recorded: str | None) -> str:
    """The version of gsplat by whose rules a scene is drawn.

    Args:
        wanted: one of `GsplatRules`.
        recorded: what is known of the training; None: nothing, which means 1.4, as nerfstudio 1.1.5 trains.
    Raises:
        ValueError: "installed" without a gsplat whose rules are known.
    """
    if wanted == "auto":
        return recorded or KNOWN_RULES[0]
    if wanted != "installed":
        return wanted
    return ".".join(installed_version().split(".")[:2])


def in_flight(job: Job, camera: Camera) -> int:
    """One: its lists of a view take 60 bytes per Gaussian."""
    return 1


def views_evidence(job: Job, batch: Batch) -> Entries:
    """Entries of some views, from gsplat's forward and backward pass alone.

    Raises:
        ValueError: weight_power other than 1, which a gradient cannot give.
    """
    if job.weight_power != 1:
        raise InputError(
            f'backend "gsplat" sums A_ij alone, weight_power {job.weight_power} is not a gradient; use backend="triton"'
        )
    parts, before = [], 0
    for camera, label_map, count in zip(*batch):
        for first, gradient in _gradients(job, camera, label_map, count):
            gaussian, column = gradient.nonzero(as_tuple=True)
            parts.append((gaussian, before + first + column, gradient[gaussian, column]))
        before += count + 1
    return Entries(*sum_duplicates(*(torch.cat(part) for part in zip(*parts))), tuple(batch.num_regions))


def composite(
    job: Job, camera: Camera, values: Float32[Tensor, "n c"]
) -> tuple[Float32[Tensor, "h w c"], Float32[Tensor, "h w"]]:
    """sum_j A_ij values_j and sum_j A_ij of every pixel, by gsplat's own kernel."""
    from gsplat.cuda._wrapper import rasterize_to_pixels  # noqa: PLC0415 (needs a GPU)

    size = (camera.height, camera.width)
    if len(job.scene) == 0 or values.shape[1] == 0:
        return values.new_zeros(*size, values.shape[1]), values.new_zeros(size)
    seen = project_views(job, [camera])
    drawing = (camera.width, camera.height, job.settings.tile_size, seen.offsets, seen.members)
    parts = [
        rasterize_to_pixels(seen.means2d, seen.conics, part[None].contiguous(), seen.opacities, *drawing)
        for part in values.to(job.scene.means).split(_CHANNELS, dim=1)
    ]
    return torch.cat([image[0] for image, _ in parts], dim=-1), parts[0][1][0, :, :, 0]


def _gradients(job: Job, camera: Camera, labels: Tensor, count: int) -> Iterator[tuple[int, Float32[Tensor, "n c"]]]:
    """(first column, sums of A_ij by column) of 32 columns at once; column 0 holds the unlabelled pixels.

    The compiled functions are called as gsplat's own autograd function calls them (cuda/_wrapper.py). Its backward pass
    starts from 1 - alpha, which has lost up to 3e-4 of a transmittance near 1e-4. All weights of a pixel are multiples
    of it, so the true one, which is what a white background adds to a black scene, over that one mends them.
    """
    seen, settings = project_views(job, [camera]), job.settings
    colors = torch.zeros(1, len(job.scene), _CHANNELS, device=labels.device)
    splats = (seen.means2d, seen.conics, colors, seen.opacities)
    lists = (None, camera.width, camera.height, settings.tile_size, seen.offsets, seen.members)
    forward, backward = compiled_rasterizer()
    transmittance, alphas, last = forward(*splats, colors.new_ones(1, _CHANNELS), *lists)
    mended = transmittance[..., :1] / (1 - alphas)
    column = labels.long() + 1
    for first in range(0, count + 1, _CHANNELS):
        channels = torch.arange(first, first + _CHANNELS, device=column.device)
        one_hot = (column[None, :, :, None] == channels) * mended
        gradients = backward(*splats, None, *lists, alphas, last, one_hot, torch.zeros_like(alphas), False)
        yield first, gradients[3][0]


def compiled_rasterizer() -> tuple[Callable[..., Any], Callable[..., Any]]:
    """gsplat's compiled forward and backward pass over pixels, whatever its version calls them."""
    from gsplat.cuda._backend import _C  # noqa: PLC0415 # pyright: ignore[reportAttributeAccessIssue]

    name = "rasterize_to_pixels_3dgs" if hasattr(_C, "rasterize_to_pixels_3dgs_fwd") else "rasterize_to_pixels"
    return getattr(_C, f"{name}_fwd"), getattr(_C, f"{name}_bwd")
