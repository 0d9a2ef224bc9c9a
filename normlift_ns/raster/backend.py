"""What every way to rasterize looks like. The table of all of them is in `raster.backends`."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple, Protocol

import torch
from jaxtyping import Float, Int32
from torch import Tensor

from normlift_ns.core.evidence import Entries
from normlift_ns.core.gaussians import Camera, GaussianScene
from normlift_ns.errors import InputError
from normlift_ns.raster.projection import Projected, Tiles, World, assign_tiles, project, to_world
from normlift_ns.raster.settings import RasterSettings


@dataclass(frozen=True)
class Job:
    """What all views of one call have in common."""

    scene: GaussianScene
    antialiased: bool
    settings: RasterSettings
    dtype: torch.dtype
    """Precision of the computation."""
    weight_power: int = 1
    """Evidence sums A_ij ** weight_power."""

    @cached_property
    def world(self) -> World:
        """The drawable Gaussians, ready for any camera."""
        return to_world(self.scene, self.dtype)

    def seen_by(self, camera: Camera) -> tuple[Projected, Tiles]:
        """What a camera sees of them, and in which tiles."""
        projected = project(self.world, camera, self.settings, self.antialiased)
        return projected, assign_tiles(projected, camera.width, camera.height, self.settings.tile_size)


def check_gpu(backend: str, job: Job) -> None:
    """Raises ValueError for a job that is not in float32 on a GPU."""
    means = job.scene.means
    if not means.dtype == job.dtype == torch.float32 or means.device.type != "cuda":
        other = str(job.dtype if means.dtype == torch.float32 else means.dtype).removeprefix("torch.")
        raise InputError(
            f'backend "{backend}" computes in float32 on a GPU, not in {other} on {means.device.type}: leave the '
            "backend out, and the fastest that can do it is taken"
        )


class Batch(NamedTuple):
    """Some views of one size."""

    cameras: Sequence[Camera]
    labels: Sequence[Int32[Tensor, "h w"]]
    num_regions: Sequence[int]


class Backend(Protocol):
    """One way to rasterize. `raster.numba`, `raster.gsplat` and `raster.triton` are backends as they stand, as
    modules.
    """

    def check(self, job: Job, *, pictures: bool) -> None:
        """Raises ValueError, with what to use instead, where the backend cannot do the job.

        Args:
            pictures: the job is to composite values; False: to sum evidence.
        """
        ...

    def in_flight(self, job: Job, camera: Camera) -> int:
        """How many views of the size of this one `views_evidence` is best given at once."""
        ...

    def views_evidence(self, job: Job, batch: Batch) -> Entries:
        """Sums of A_ij ** weight_power by (Gaussian, region)."""
        ...

    def composite(
        self, job: Job, camera: Camera, values: Float[Tensor, "n c"]
    ) -> tuple[Float[Tensor, "h w c"], Float[Tensor, "h w"]]:
        """sum_j A_ij values_j and sum_j A_ij of every pixel."""
        ...


@dataclass(frozen=True)
class TileBackend:
    """A backend that goes through projected Gaussians and tile lists, one view at a time, in any precision."""

    kernels: Any
    """Module with `view_evidence` and `composite`."""

    def check(self, job: Job, *, pictures: bool) -> None:
        """Nothing to refuse: any device will do."""

    def in_flight(self, job: Job, camera: Camera) -> int:
        """One: views are independent of each other."""
        return 1

    def views_evidence(self, job: Job, batch: Batch) -> Entries:  # noqa: D102 (as in the protocol)
        (camera,), (labels,), (count,) = batch
        return self.kernels.view_evidence(*job.seen_by(camera), labels, count, job.weight_power, job.settings)

    def composite(  # noqa: D102 (as in the protocol)
        self, job: Job, camera: Camera, values: Float[Tensor, "n c"]
    ) -> tuple[Float[Tensor, "h w c"], Float[Tensor, "h w"]]:
        projected, tiles = job.seen_by(camera)
        drawn = values[projected.gaussian].to(projected.opacities.dtype)
        return self.kernels.composite(projected, tiles, drawn, camera.width, camera.height, job.settings)
