"""The fast GPU path: gsplat's projection and tile lists, our kernel, a sparse and repeatable result."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from jaxtyping import Int32
from torch import Tensor

from normlift_ns.core.evidence import Entries
from normlift_ns.core.gaussians import Camera, GaussianScene
from normlift_ns.core.sparse import sum_equal_keys
from normlift_ns.kernels.regions import region_sums
from normlift_ns.raster.gsplat import project_views
from normlift_ns.raster.settings import RasterSettings


def views_evidence(
    scene: GaussianScene,
    cameras: Sequence[Camera],
    labels: Sequence[Int32[Tensor, "h w"]],
    num_regions: Sequence[int],
    antialiased: bool,
    weight_power: int,
    settings: RasterSettings,
) -> Entries:
    """Entries of some views of one size, all in flight at once; bitwise the same on every run.

    Raises:
        ValueError: as `project_views`.
    """
    seen = project_views(scene, cameras, antialiased, settings)
    offsets = torch.cat([seen.offsets.flatten(), seen.offsets.new_tensor([len(seen.members)])])
    first = torch.tensor([0, *(count + 1 for count in num_regions)]).cumsum(0)
    columns = int(first[-1])
    key, weight = region_sums(
        seen.means2d.flatten(0, 1),
        seen.conics.flatten(0, 1),
        seen.opacities.flatten(),
        seen.members,
        offsets,
        torch.stack(list(labels)),
        first[:-1].int().to(offsets.device),
        columns=columns,
        tile_size=settings.tile_size,
        max_alpha=settings.max_alpha,
        min_alpha=settings.min_alpha,
        min_transmittance=settings.min_transmittance,
        weight_power=weight_power,
    )
    key, weight = sum_equal_keys(key, weight)
    gaussian = torch.div(key, columns, rounding_mode="floor")
    return Entries(gaussian.int(), (key - gaussian * columns).int(), weight, tuple(num_regions))
