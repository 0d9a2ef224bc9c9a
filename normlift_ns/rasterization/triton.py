"""Fast GPU backend, with Triton kernels for projection, cell lists, sums and compositing."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import torch
from jaxtyping import Float32
from torch import Tensor

from normlift_ns.core.evidence import Entries
from normlift_ns.core.gaussians import Camera, GaussianScene
from normlift_ns.core.sparse import sum_equal_keys
from normlift_ns.errors import InputError
from normlift_ns.kernels import compositing as kernel
from normlift_ns.kernels.compositing import AlphaLimits, CellGrid, CellLists, build_cell_lists, decode_keys, sum_regions
from normlift_ns.kernels.projection import SPLAT, ProjectedSplats, ProjectionSettings, project_gaussians
from normlift_ns.kernels.projection_2dgs import SPLAT_2D, Settings2D, project_gaussians_2d
from normlift_ns.options import RasterizeMode, option_setting
from normlift_ns.rasterization.rasterize import RasterBatch, RasterJob, check_gpu
from normlift_ns.rasterization.settings import RasterSettings

CELL, SMALL_CELL = (16, 16), (16, 8)
"""Largest width and height of cells in pixels, for fewer than `_MANY` Gaussians, and for `_MANY` or more.

With many Gaussians, smaller cells are faster, because the pixels of a cell share fewer Gaussians.
"""
_MANY = 4_000_000
"""Smallest number of Gaussians for which `SMALL_CELL` is used."""
_ELEMENTS, _MAX_VIEWS = 2**26, 16
"""Limits of a batch: number of views times number of Gaussians, and number of views.

A view takes one byte per Gaussian and 120 bytes per visible Gaussian.
"""
_SAMPLE = 4096
"""Number of Gaussians that `kernel_calls` projects."""
_SHORT = 2**15
"""Number of cells in a batch below which int16 can index them. Sorting int16 takes half as long as sorting int32."""


def check(job: RasterJob) -> None:
    """Raise ValueError if the scene is not in float32 on a GPU, or the tile size is not a power of two."""
    size = job.settings.tile_size
    check_gpu("triton", job)
    if size < 1 or size & (size - 1) != 0:
        raise InputError(
            f'backend "triton" needs a tile_size that is a power of two, got {size}; use '
            f"{option_setting('backend', 'torch')}"
        )


def project_and_bin(
    job: RasterJob, cameras: Sequence[Camera], *, cull: bool = True
) -> tuple[CellGrid, ProjectedSplats, CellLists]:
    """Project the Gaussians into cameras of one size, and list them by cell.

    Args:
        job: Scene and options.
        cameras: Cameras of one size.
        cull: As in `build_cell_lists`.
    """
    grid, projected = _grid(job, cameras[0]), _project(job, cameras)
    cull = cull and not job.is_2d
    return grid, projected, build_cell_lists(projected, len(cameras), grid, job.settings.min_alpha, cull=cull)


def _project(job: RasterJob, cameras: Sequence[Camera]) -> ProjectedSplats:
    scene, settings = job.scene, job.settings
    rows = [
        torch.cat([camera.world_to_camera[:3].flatten(), camera.K[[0, 1, 0, 1], [0, 1, 2, 2]]]).float()
        for camera in cameras
    ]
    views = torch.stack(rows).to(scene.means.device)
    width, height = cameras[0].width, cameras[0].height
    inputs = (scene.means, scene.quats, scene.scales, scene.opacities, scene.drawable, views, width, height)
    if job.is_2d:
        rules = Settings2D(*(getattr(settings, name) for name in Settings2D._fields))
        return project_gaussians_2d(*inputs, rules)
    rules = ProjectionSettings(*(getattr(settings, name) for name in ProjectionSettings._fields))
    return project_gaussians(*inputs, rules, antialiased=job.antialiased, per_axis=settings.per_axis)


def in_flight(job: RasterJob, camera: Camera) -> int:
    """Return the number of views of this camera's size that memory and int16 cell indices allow in a batch."""
    cells = _grid(job, camera).cells
    return max(1, min(_ELEMENTS // max(1, len(job.scene)), (_SHORT - 1) // max(1, cells), _MAX_VIEWS))


def _grid(job: RasterJob, camera: Camera) -> CellGrid:
    tile = job.settings.tile_size
    across, down = CELL if len(job.scene) < _MANY else SMALL_CELL
    return CellGrid(camera.width, camera.height, tile, min(across, tile), min(down, tile))


def views_evidence(job: RasterJob, batch: RasterBatch, *, cull: bool = True) -> Entries:
    """Return the entries of views of one size, which are bitwise the same on every run.

    Args:
        job: Scene and options.
        batch: Views to rasterize together.
        cull: As in `build_cell_lists`. This does not change the entries.
    """
    grid, projected, lists = project_and_bin(job, batch.cameras, cull=cull)
    columns = max(batch.num_regions) + 1
    labels = torch.stack(list(batch.labels))
    sums = sum_regions(
        projected.splats, lists, labels, grid, columns=columns, limits=_limits(job.settings),
        weight_power=job.weight_power,
    )  # fmt: skip
    key, weight = sum_equal_keys(*sums)
    # Splats are sorted by Gaussian and then by view, so ascending keys have the order of entries.
    first = torch.tensor([0, *(count + 1 for count in batch.num_regions)]).cumsum(0).int().to(key.device)
    return Entries(*decode_keys(key, projected.keys, first, columns), weight, tuple(batch.num_regions))


def composite(
    job: RasterJob, camera: Camera, values: Float32[Tensor, "n c"]
) -> tuple[Float32[Tensor, "h w c"], Float32[Tensor, "h w"]]:
    """Return sum_j A_ij values_j and sum_j A_ij of every pixel."""
    grid, projected, lists = project_and_bin(job, [camera])
    return kernel.composite(
        projected.splats, lists, projected.keys, values.to(job.scene.means), grid, _limits(job.settings)
    )


def kernel_calls(
    scene: GaussianScene, camera: Camera, *, rasterize_mode: RasterizeMode, settings: RasterSettings,
    dtype: torch.dtype, weight_power: int, **_: Any,
) -> tuple[list[Callable[[], Any]], list[Callable[[], Any]]]:  # fmt: skip
    """Return functions that compile the kernels of this backend, by running them on a splat or a part of the scene.

    Returns:
        Functions for the kernels of `composite`, and for the other kernels of `views_evidence`.
    """
    job = RasterJob(scene, rasterize_mode == "antialiased", settings, dtype, weight_power)
    grid, device, limits = _grid(job, camera), scene.means.device, _limits(settings)
    sample = replace(job, scene=scene.select(slice(_SAMPLE)))
    splats = torch.ones(1, SPLAT_2D if job.is_2d else SPLAT, device=device)  # it covers the first pixels
    row = torch.zeros(1, dtype=torch.int64, device=device)
    projected = ProjectedSplats(row, splats, splats[0, :1])
    offsets = torch.ones(grid.cells + 1, dtype=torch.int32, device=device)
    offsets[0] = 0
    lists = CellLists(offsets, row.int())
    labels = torch.zeros(1, camera.height, camera.width, dtype=torch.int32, device=device)
    columns = torch.tensor([0, 2], dtype=torch.int32, device=device)

    def sum_labels() -> None:
        sum_regions(splats, lists, labels, grid, columns=2, limits=limits, weight_power=weight_power)

    rendering = [
        lambda: _project(sample, [camera]),
        lambda: build_cell_lists(projected, 1, grid, settings.min_alpha, cull=not job.is_2d),
        lambda: kernel.composite(splats, lists, row, splats[:, :3].contiguous(), grid, limits),
    ]
    return rendering, [sum_labels, lambda: decode_keys(row.int(), row, columns, 2)]


def _limits(settings: RasterSettings) -> AlphaLimits:
    return AlphaLimits(*(getattr(settings, name) for name in AlphaLimits._fields))
