"""The fast GPU path, all of it our own kernels: projection, exact lists of cells, sums and pictures."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from jaxtyping import Float32
from torch import Tensor

from normlift_ns.core.evidence import Entries
from normlift_ns.core.gaussians import Camera
from normlift_ns.core.sparse import sum_equal_keys
from normlift_ns.errors import InputError
from normlift_ns.kernels import composite as pictures
from normlift_ns.kernels.lists import Grid, Lists, list_cells
from normlift_ns.kernels.projection import Rules, Splats, project
from normlift_ns.kernels.regions import Limits, region_sums
from normlift_ns.raster.backend import Batch, Job
from normlift_ns.raster.settings import RasterSettings

CELL = (16, 8)
"""Largest width and height in pixels of the cells that have lists of their own."""


def check(job: Job, *, pictures: bool = False) -> None:
    """Raises ValueError for a scene that is not float32 on a GPU, and for tiles that cannot be halved into cells."""
    means, size = job.scene.means, job.settings.tile_size
    if not means.dtype == job.dtype == torch.float32 or means.device.type != "cuda":
        raise InputError(
            f'backend "triton" computes in float32 on a GPU; this scene is {means.dtype} on {means.device}, and wanted '
            f'is {job.dtype}. Move it (scene.to("cuda")), or use backend="torch", which knows every device and '
            "precision"
        )
    if size < 1 or size & (size - 1) != 0:
        raise InputError(f'backend "triton" needs a tile_size that is a power of two, got {size}; use backend="torch"')


def see(job: Job, cameras: Sequence[Camera], *, cull: bool = True) -> tuple[Grid, Splats, Lists]:
    """What cameras of one size see of a scene, and in which cells of their images.

    Args:
        cull: see `list_cells`.
    """
    scene, settings = job.scene, job.settings
    rows = [
        torch.cat([camera.world_to_camera[:3].flatten(), camera.K[[0, 1, 0, 1], [0, 1, 2, 2]]]).float()
        for camera in cameras
    ]
    views = torch.stack(rows).to(scene.means.device)
    tile, width, height = settings.tile_size, cameras[0].width, cameras[0].height
    grid = Grid(width, height, tile, min(CELL[0], tile), min(CELL[1], tile))
    seen = project(
        scene.means, scene.quats, scene.scales, scene.opacities, scene.drawable, views, width, height,
        Rules(*(getattr(settings, name) for name in Rules._fields)),
        antialiased=job.antialiased, per_axis=settings.per_axis,
    )  # fmt: skip
    return grid, seen, list_cells(seen, len(cameras), grid, settings.min_alpha, cull=cull)


def views_evidence(job: Job, batch: Batch, *, cull: bool = True) -> Entries:
    """Entries of some views of one size, all in flight at once; bitwise the same on every run.

    Args:
        cull: see `list_cells`; the entries do not depend on it.
    """
    grid, seen, lists = see(job, batch.cameras, cull=cull)
    views, columns = len(batch.cameras), max(batch.num_regions) + 1
    labels = torch.stack(list(batch.labels))
    found = region_sums(
        seen.splats, lists, labels, grid, columns=columns, limits=_limits(job.settings), weight_power=job.weight_power
    )
    key, weight = sum_equal_keys(*found)
    # Splats are numbered by Gaussian and then by view: keys in ascending order are entries in theirs.
    splat = torch.div(key, columns, rounding_mode="floor")
    place = seen.seen[splat.long()]
    gaussian = torch.div(place, views, rounding_mode="floor")
    first = torch.tensor([0, *(count + 1 for count in batch.num_regions)]).cumsum(0).to(key.device)
    column = first[place - gaussian * views] + (key - splat * columns)
    return Entries(gaussian.int(), column.int(), weight, tuple(batch.num_regions))


def composite(
    job: Job, camera: Camera, values: Float32[Tensor, "n c"]
) -> tuple[Float32[Tensor, "h w c"], Float32[Tensor, "h w"]]:
    """sum_j A_ij values_j and sum_j A_ij of every pixel."""
    grid, seen, lists = see(job, [camera])
    return pictures.composite(
        seen.splats, lists, seen.seen, values.to(job.scene.means), grid, _limits(job.settings)
    )  # fmt: skip


def _limits(settings: RasterSettings) -> Limits:
    return Limits(*(getattr(settings, name) for name in Limits._fields))
