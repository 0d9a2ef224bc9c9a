"""Interface of the rasterization backends, and the backend in plain torch."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple, Protocol

import torch
from jaxtyping import Float, Int32
from torch import Tensor

from normlift_ns.core.evidence import Entries
from normlift_ns.core.gaussians import Camera, GaussianScene
from normlift_ns.errors import InputError
from normlift_ns.rasterization import projection
from normlift_ns.rasterization.settings import RasterSettings


@dataclass(frozen=True)
class RasterJob:
    """Scene and options of one call, shared by all its views."""

    scene: GaussianScene
    antialiased: bool
    settings: RasterSettings
    dtype: torch.dtype
    """Precision of the computation."""
    weight_power: int = 1
    """Exponent p of the weights. The evidence is the sum of A_ij ** p."""

    @cached_property
    def prepared(self) -> projection.AnyPrepared:
        """The drawable Gaussians, prepared for any camera."""
        prepare = projection.prepare_gaussians_2d if self.is_2d else projection.prepare_gaussians
        return prepare(self.scene, self.dtype)

    @property
    def is_2d(self) -> bool:
        """True for a scene of 2D Gaussian Splatting."""
        return self.scene.primitive == "2dgs"

    def project(self, camera: Camera) -> projection.AnyProjected:
        """Project the Gaussians into a camera."""
        if isinstance(self.prepared, projection.PreparedGaussians2D):
            return projection.project_2d(self.prepared, camera, self.settings)
        return projection.project(self.prepared, camera, self.settings, self.antialiased)


def check_gpu(backend: str, job: RasterJob) -> None:
    """Raise ValueError if a job is not in float32 on a GPU."""
    means = job.scene.means
    if not means.dtype == job.dtype == torch.float32 or means.device.type != "cuda":
        other = str(job.dtype if means.dtype == torch.float32 else means.dtype).removeprefix("torch.")
        raise InputError(
            f'backend "{backend}" needs float32 on a GPU, got {other} on {means.device.type}; use backend="auto" to '
            "choose a backend that supports these"
        )


class RasterBatch(NamedTuple):
    """Views of the same size that are rasterized together."""

    cameras: Sequence[Camera]
    labels: Sequence[Int32[Tensor, "h w"]]
    num_regions: Sequence[int]


class Backend(Protocol):
    """Interface of a backend, implemented by `TileBackend` and the modules `numba`, `gsplat` and `triton`."""

    def check(self, job: RasterJob) -> None:
        """Raise ValueError if the backend does not support the job. The message suggests an alternative."""
        ...

    def in_flight(self, job: RasterJob, camera: Camera) -> int:
        """Return the number of views of this camera's size to pass to one call of `views_evidence`."""
        ...

    def views_evidence(self, job: RasterJob, batch: RasterBatch) -> Entries:
        """Return the sums of A_ij ** weight_power by (Gaussian, region)."""
        ...

    def composite(
        self, job: RasterJob, camera: Camera, values: Float[Tensor, "n c"]
    ) -> tuple[Float[Tensor, "h w c"], Float[Tensor, "h w"]]:
        """Return sum_j A_ij values_j and sum_j A_ij of every pixel."""
        ...


class TileBackend:
    """Backend in plain torch for any device and precision, which processes one view at a time."""

    def check(self, job: RasterJob) -> None:
        """Accept every job on any device."""

    def in_flight(self, job: RasterJob, camera: Camera) -> int:
        """Return 1, because views are processed one at a time."""
        return 1

    def views_evidence(self, job: RasterJob, batch: RasterBatch) -> Entries:  # noqa: D102 (as in the protocol)
        (camera,), (labels,), (count,) = batch
        projected, tiles = _with_tiles(job, camera)
        return projection.view_evidence(projected, tiles, labels, count, job.weight_power, job.settings)

    def composite(  # noqa: D102 (as in the protocol)
        self, job: RasterJob, camera: Camera, values: Float[Tensor, "n c"]
    ) -> tuple[Float[Tensor, "h w c"], Float[Tensor, "h w"]]:
        projected, tiles = _with_tiles(job, camera)
        visible_values = values[projected.gaussian].to(projected.opacities.dtype)
        return projection.composite(projected, tiles, visible_values, camera.width, camera.height, job.settings)


def _with_tiles(job: RasterJob, camera: Camera) -> tuple[projection.AnyProjected, projection.TileLists]:
    projected = job.project(camera)
    return projected, projection.assign_tiles(projected, camera.width, camera.height, job.settings.tile_size)
