"""The fast GPU path: gsplat's projection and tile lists, our kernel, a sparse and repeatable result."""

from __future__ import annotations

from typing import NoReturn

import torch
from torch import Tensor

from normlift_ns.core.evidence import Entries
from normlift_ns.core.gaussians import Camera
from normlift_ns.core.sparse import sum_equal_keys
from normlift_ns.errors import InputError
from normlift_ns.kernels.regions import region_sums
from normlift_ns.raster import gsplat
from normlift_ns.raster.backend import Batch, Job


def check(job: Job, *, pictures: bool) -> None:
    """Raises ValueError for pictures, and where gsplat's projection cannot be used."""
    if pictures:
        raise InputError(
            'backend "triton" sums evidence and draws no pictures; render with backend="torch" or "gsplat" on a GPU, '
            '"numba" on a CPU, or "auto"'
        )
    gsplat.check(job)


def composite(job: Job, camera: Camera, values: Tensor) -> NoReturn:
    """There is no kernel for pictures; `check` says so."""
    raise NotImplementedError


def views_evidence(job: Job, batch: Batch) -> Entries:
    """Entries of some views of one size, all in flight at once; bitwise the same on every run."""
    seen, settings = gsplat.project_views(job, batch.cameras), job.settings
    offsets = torch.cat([seen.offsets.flatten(), seen.offsets.new_tensor([len(seen.members)])])
    first = torch.tensor([0, *(count + 1 for count in batch.num_regions)]).cumsum(0)
    columns = int(first[-1])
    key, weight = region_sums(
        seen.means2d.flatten(0, 1),
        seen.conics.flatten(0, 1),
        seen.opacities.flatten(),
        seen.members,
        offsets,
        torch.stack(list(batch.labels)),
        first[:-1].int().to(offsets.device),
        columns=columns,
        tile_size=settings.tile_size,
        max_alpha=settings.max_alpha,
        min_alpha=settings.min_alpha,
        min_transmittance=settings.min_transmittance,
        weight_power=job.weight_power,
    )
    key, weight = sum_equal_keys(key, weight)
    gaussian = torch.div(key, columns, rounding_mode="floor")
    return Entries(gaussian.int(), (key - gaussian * columns).int(), weight, tuple(batch.num_regions))
