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
from normlift_ns.kernels.regions import Limits, places, region_sums
from normlift_ns.raster.backend import Batch, Job, check_gpu
from normlift_ns.raster.settings import RasterSettings

CELL, SMALL_CELL = (16, 16), (16, 8)
"""Largest width and height in pixels of the cells that have lists of their own. Where there are many Gaussians, few
pixels of a cell feel the same ones, and smaller cells pay."""
_MANY = 4_000_000
_ELEMENTS, _MOST_VIEWS = 2**26, 16
"""Most views in flight times Gaussians, and most views: each takes a byte per Gaussian, and 120 of those it sees."""
_SHORT = 2**15
"""Cells of all views in flight that an int16 numbers, which takes half the time of an int32 to sort."""


def check(job: Job, *, pictures: bool = False) -> None:
    """Raises ValueError for a scene that is not float32 on a GPU, and for tiles that cannot be halved into cells."""
    size = job.settings.tile_size
    check_gpu("triton", job)
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
    width, height = cameras[0].width, cameras[0].height
    grid = _grid(job, cameras[0])
    seen = project(
        scene.means, scene.quats, scene.scales, scene.opacities, scene.drawable, views, width, height,
        Rules(*(getattr(settings, name) for name in Rules._fields)),
        antialiased=job.antialiased, per_axis=settings.per_axis,
    )  # fmt: skip
    return grid, seen, list_cells(seen, len(cameras), grid, settings.min_alpha, cull=cull)


def in_flight(job: Job, camera: Camera) -> int:
    """How many views of one size are best taken at once."""
    most = min(_ELEMENTS // max(1, len(job.scene)), (_SHORT - 1) // max(1, _grid(job, camera).cells), _MOST_VIEWS)
    return max(1, most)


def _grid(job: Job, camera: Camera) -> Grid:
    tile = job.settings.tile_size
    across, down = CELL if len(job.scene) < _MANY else SMALL_CELL
    return Grid(camera.width, camera.height, tile, min(across, tile), min(down, tile))


def views_evidence(job: Job, batch: Batch, *, cull: bool = True) -> Entries:
    """Entries of some views of one size, all in flight at once; bitwise the same on every run.

    Args:
        cull: see `list_cells`; the entries do not depend on it.
    """
    grid, seen, lists = see(job, batch.cameras, cull=cull)
    columns = max(batch.num_regions) + 1
    labels = torch.stack(list(batch.labels))
    found = region_sums(
        seen.splats, lists, labels, grid, columns=columns, limits=_limits(job.settings), weight_power=job.weight_power
    )
    key, weight = sum_equal_keys(*found)
    # Splats are numbered by Gaussian and then by view: keys in ascending order are entries in theirs.
    first = torch.tensor([0, *(count + 1 for count in batch.num_regions)]).cumsum(0).int().to(key.device)
    return Entries(*places(key, seen.seen, first, columns), weight, tuple(batch.num_regions))


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
