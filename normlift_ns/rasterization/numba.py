"""Compiled CPU backend, which computes the same sums as the torch backend on all cores."""

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
from normlift_ns.rasterization import numba_kernels as kernels
from normlift_ns.rasterization.backend import RasterBatch, RasterJob
from normlift_ns.rasterization.projection import AnyProjected, ProjectedGaussians2D
from normlift_ns.rasterization.settings import RasterSettings

_Triple = tuple[Any, Any, Any]


def check(job: RasterJob) -> None:
    """Raise ValueError if the scene is not on the CPU."""
    device = job.scene.means.device
    if device.type != "cpu":
        raise InputError(f'backend "numba" needs a scene on the CPU, got {device}; move it, or use backend="torch"')


def in_flight(job: RasterJob, camera: Camera) -> int:
    """Return 1, because the kernels distribute one view over all cores."""
    return 1


def views_evidence(job: RasterJob, batch: RasterBatch) -> Entries:
    """Return the entries of one view, which are bitwise the same on every run."""
    (camera,), (labels,), (count,) = batch
    projected = job.project(camera)
    arrays, limits, (offsets, members, shapes) = _tiles(projected, camera, job.settings)
    size, label_map = job.settings.tile_size, labels.int().numpy()
    capacity = np.diff(offsets) * kernels.count_labels(label_map, size)
    first_slot, used = np.cumsum(capacity) - capacity, np.zeros(len(capacity), np.int64)
    slots = tuple(
        np.empty(capacity.sum(), dtype) for dtype in (np.int32, np.int32, np.float64)
    )  # memory pages are allocated when they are written
    kernels.sum_tiles(
        *(offsets, members, *arrays, shapes, projected.gaussian.numpy(), label_map),
        *(job.weight_power, size, limits, first_slot, used, slots, numba.get_num_threads()),
    )
    merged = kernels.merge_slots(first_slot, used, slots, len(job.scene), count + 1)
    gaussian, column, weight = map(torch.from_numpy, merged)
    return Entries(gaussian, column, weight.to(job.dtype), (count,))


def composite(
    job: RasterJob, camera: Camera, values: Float[Tensor, "n c"]
) -> tuple[Float[Tensor, "h w c"], Float[Tensor, "h w"]]:
    """Return sum_j A_ij values_j and sum_j A_ij of every pixel."""
    projected = job.project(camera)
    arrays, limits, (offsets, members, shapes) = _tiles(projected, camera, job.settings)
    visible_values = values[projected.gaussian].to(job.dtype).contiguous().numpy()
    image = np.zeros((camera.height, camera.width, values.shape[1]), visible_values.dtype)
    alpha = np.zeros((camera.height, camera.width), visible_values.dtype)
    kernels.composite_tiles(
        *(offsets, members, *arrays, shapes, visible_values, image, alpha),
        *(job.settings.tile_size, limits, numba.get_num_threads()),
    )
    return torch.from_numpy(image), torch.from_numpy(alpha)


def _tiles(projected: AnyProjected, camera: Camera, settings: RasterSettings) -> tuple[_Triple, _Triple, _Triple]:
    """Return the input of the kernels in three groups.

    The first group has the means, the conics or transforms, and the opacities. The second group has the limits of alpha
    and transmittance. The third group has the offsets and members of the tiles, and the shapes of the Gaussians.
    """
    is_2d = isinstance(projected, ProjectedGaussians2D)
    kinds = projected.transforms.flatten(1) if is_2d else projected.conics
    means, conics, opacities = (x.contiguous().numpy() for x in (projected.means2d, kinds, projected.opacities))
    number = means.dtype.type
    max_alpha, min_alpha, min_transmittance = settings.max_alpha, settings.min_alpha, settings.min_transmittance
    ellipses = _bounding_ellipses(projected, settings.min_alpha).numpy() if is_2d else conics
    sizes = (camera.width, camera.height, settings.tile_size)
    tile_lists = kernels.list_tiles(
        means,
        ellipses,
        opacities,
        projected.radii.contiguous().numpy(),
        *sizes,
        number(min_alpha),
        numba.get_num_threads(),
    )
    return (means, conics, opacities), (number(max_alpha), number(min_alpha), number(min_transmittance)), tile_lists


_STRETCH = 0.1
"""Fraction by which a covariance is enlarged, because a bounding ellipse has another center than the bounded one."""


def _bounding_ellipses(projected: ProjectedGaussians2D, min_alpha: float) -> Float[Tensor, "m 3"]:
    """Return ellipses around `means2d` that contain every pixel with alpha >= min_alpha, as conics in 1 / pixels^2.

    Let r ** 2 = 2 log(opacity / min_alpha). Such a pixel lies in the projected ellipse of r standard deviations or in a
    disc with a radius of r / sqrt(2) pixels. The ellipse contains the offsets x with x^T C x <= r ** 2, for its conic
    C. A conic is zero if the projection is not an ellipse.
    """
    transforms, means = projected.transforms.double(), projected.means2d.double()
    square = (2 * (projected.opacities.double() / min_alpha).log()).clamp(min=0)
    dual = transforms * torch.stack([square, square, -torch.ones_like(square)], 1)[:, None] @ transforms.mT
    dual = dual / dual[:, 2:, 2:]
    bounded = (transforms[:, 2, :2].square().sum(1) * square < transforms[:, 2, 2].square())[:, None]
    center = dual[:, :2, 2]
    shift = (center - means)[:, :, None]
    covariance = (1 + _STRETCH) * (center[:, :, None] * center[:, None] - dual[:, :2, :2])
    covariance = covariance + (1 + 1 / _STRETCH) * shift * shift.mT + 0.5 * square[:, None, None] * torch.eye(2)
    (xx, xy), (_, yy) = (row.unbind(1) for row in covariance.unbind(1))
    conics = (square / (xx * yy - xy * xy))[:, None] * torch.stack([yy, -xy, xx], 1)
    return torch.where(bounded & conics.isfinite().all(1, keepdim=True), conics, 0.0).to(projected.means2d.dtype)


def compile_kernels(*dtypes: torch.dtype) -> Thread:
    """Load the kernels for some precisions in a background thread, and compile those that are not in a cache.

    Callers do not have to wait for the thread. A call to a kernel waits only until this kernel is compiled.
    """

    def work() -> None:
        for dtype in dtypes:
            for kernel, signature in kernel_signatures(dtype):
                kernel.compile(signature)

    thread = Thread(target=work, name="warm numba", daemon=True)
    thread.start()
    return thread


def kernel_signatures(dtype: torch.dtype) -> list[tuple[Any, Any]]:
    """Return (kernel, types of its arguments) for every kernel of this backend, beginning with those for rendering."""
    number = numba.float64 if dtype == torch.float64 else numba.float32
    integer, integers, numbers, table = numba.int64, numba.int64[::1], number[::1], number[:, ::1]
    labels, members, limits = numba.int32[:, ::1], numba.int32[::1], numba.types.UniTuple(number, 3)
    slots = numba.types.Tuple((numba.int32[::1], numba.int32[::1], numba.float64[::1]))
    tile_lists = (integers, members, table, table, numbers, numba.float64[:, ::1])
    image = number[:, :, ::1]
    return [
        (kernels.list_tiles, (table, table, numbers, table, integer, integer, integer, number, integer)),
        (kernels.composite_tiles, (*tile_lists, table, image, table, integer, limits, integer)),
        (kernels.count_labels, (labels, integer)),
        (
            kernels.sum_tiles,
            (*tile_lists, integers, labels, integer, integer, limits, integers, integers, slots, integer),
        ),
        (kernels.merge_slots, (integers, integers, slots, integer, integer)),
    ]
