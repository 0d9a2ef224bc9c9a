"""The compiled CPU rasterizer: the reference's sums, one thread per tile, touching only what a Gaussian reaches."""

from __future__ import annotations

from threading import Thread
from typing import Any

import numba
import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from normlift_ns.core.evidence import Entries
from normlift_ns.core.gaussians import Camera
from normlift_ns.errors import InputError
from normlift_ns.raster import numba_kernels as kernels
from normlift_ns.raster import numba_lists as lists
from normlift_ns.raster.backend import Batch, Job
from normlift_ns.raster.projection import Projected, project
from normlift_ns.raster.settings import RasterSettings

_Three = tuple[Any, Any, Any]


def check(job: Job, *, pictures: bool) -> None:
    """Raises ValueError for a scene that is not on the CPU."""
    device = job.scene.means.device
    if device.type != "cpu":
        raise InputError(
            f'backend "numba" needs a scene on the CPU, this one is on {device}; move it, or use backend="torch"'
        )


def in_flight(job: Job, camera: Camera) -> int:
    """One: the kernels share a view among all cores."""
    return 1


def views_evidence(job: Job, batch: Batch) -> Entries:
    """Entries of one view; bitwise the same on every run."""
    (camera,), (labels,), (count,) = batch
    projected = project(job.world, camera, job.settings, job.antialiased)
    arrays, limits, (offsets, members, shapes) = _tiles(projected, camera, job.settings)
    size, label_map = job.settings.tile_size, labels.int().numpy()
    most = np.diff(offsets) * kernels.count_labels(label_map, size)
    first_slot, used = np.cumsum(most) - most, np.zeros(len(most), np.int64)
    slots = tuple(np.empty(most.sum(), dtype) for dtype in (np.int32, np.int32, np.float64))  # touched where used
    kernels.fill(
        *(offsets, members, *arrays, shapes, projected.gaussian.numpy(), label_map),
        *(job.weight_power, size, limits, first_slot, used, slots, numba.get_num_threads()),
    )
    found = kernels.merge(first_slot, used, slots, len(job.scene), count + 1)
    gaussian, column, weight = map(torch.from_numpy, found)
    return Entries(gaussian, column, weight.to(job.dtype), (count,))


def composite(
    job: Job, camera: Camera, values: Float[Tensor, "n c"]
) -> tuple[Float[Tensor, "h w c"], Float[Tensor, "h w"]]:
    """sum_j A_ij values_j and sum_j A_ij of every pixel."""
    projected = project(job.world, camera, job.settings, job.antialiased)
    arrays, limits, (offsets, members, shapes) = _tiles(projected, camera, job.settings)
    drawn = values[projected.gaussian].to(job.dtype).contiguous().numpy()
    image = np.zeros((camera.height, camera.width, values.shape[1]), drawn.dtype)
    alpha = np.zeros((camera.height, camera.width), drawn.dtype)
    kernels.draw(
        *(offsets, members, *arrays, shapes, drawn, image, alpha),
        *(job.settings.tile_size, limits, numba.get_num_threads()),
    )
    return torch.from_numpy(image), torch.from_numpy(alpha)


def _tiles(projected: Projected, camera: Camera, settings: RasterSettings) -> tuple[_Three, _Three, _Three]:
    """What the kernels read: means, conics and opacities; limits of alpha and transmittance; offsets and members of the
    tiles, and shapes of the Gaussians.
    """
    means, conics, opacities = (
        x.contiguous().numpy() for x in (projected.means2d, projected.conics, projected.opacities)
    )
    number = means.dtype.type
    max_alpha, min_alpha, least = settings.max_alpha, settings.min_alpha, settings.min_transmittance
    radii = projected.radii if projected.radii.ndim > 1 else projected.radii[:, None].expand(-1, 2)
    sizes = (camera.width, camera.height, settings.tile_size)
    found = lists.assign(
        means, conics, opacities, radii.contiguous().numpy(), *sizes, number(min_alpha), numba.get_num_threads()
    )
    return (means, conics, opacities), (number(max_alpha), number(min_alpha), number(least)), found


def warm(*dtypes: torch.dtype) -> Thread:
    """Loads the kernels for some precisions, or compiles those that no cache holds, while other work goes on.

    Nobody has to wait for the thread: whoever needs a kernel that is not there yet waits for that one only.
    """

    def work() -> None:
        for dtype in dtypes:
            for kernel, signature in kernel_signatures(dtype):
                kernel.compile(signature)

    thread = Thread(target=work, name="warm numba", daemon=True)
    thread.start()
    return thread


def kernel_signatures(dtype: torch.dtype) -> list[tuple[Any, Any]]:
    """Every kernel that is called from here, with the types of its arguments; those that draw pictures first."""
    number = numba.float64 if dtype == torch.float64 else numba.float32
    whole, wholes, numbers, table = numba.int64, numba.int64[::1], number[::1], number[:, ::1]
    labels, members, limits = numba.int32[:, ::1], numba.int32[::1], numba.types.UniTuple(number, 3)
    slots = numba.types.Tuple((numba.int32[::1], numba.int32[::1], numba.float64[::1]))
    listed = (wholes, members, table, table, numbers, numba.float64[:, ::1])
    image = number[:, :, ::1]
    return [
        (lists.assign, (table, table, numbers, table, whole, whole, whole, number, whole)),
        (kernels.draw, (*listed, table, image, table, whole, limits, whole)),
        (kernels.count_labels, (labels, whole)),
        (kernels.fill, (*listed, wholes, labels, whole, whole, limits, wholes, wholes, slots, whole)),
        (kernels.merge, (wholes, wholes, slots, whole, whole)),
    ]
