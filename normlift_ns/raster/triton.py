"""The fast GPU path: gsplat's projection and tile lists, our kernel, a sparse and repeatable result."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import torch
from jaxtyping import Int32
from torch import Tensor

from normlift_ns.core.evidence import ViewEvidence
from normlift_ns.core.gaussians import Camera, GaussianScene
from normlift_ns.core.sparse import sum_equal_keys
from normlift_ns.kernels.regions import RegionSums, region_sums
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
) -> Iterator[ViewEvidence]:
    """Evidence of some views of one size, all in flight at once; bitwise the same on every run.

    Raises:
        ValueError: as `project_views`.
    """
    seen = project_views(scene, cameras, antialiased, settings)
    offsets = torch.cat([seen.offsets.flatten(), seen.offsets.new_tensor([len(seen.members)])])
    found = region_sums(
        seen.means2d.flatten(0, 1),
        seen.conics.flatten(0, 1),
        seen.opacities.flatten(),
        seen.members,
        offsets,
        torch.stack(list(labels)),
        most_regions=max(num_regions),
        tile_size=settings.tile_size,
        max_alpha=settings.max_alpha,
        min_alpha=settings.min_alpha,
        min_transmittance=settings.min_transmittance,
        weight_power=weight_power,
    )
    return split_views(found, len(scene), num_regions)


def split_views(found: RegionSums, num_gaussians: int, num_regions: Sequence[int]) -> Iterator[ViewEvidence]:
    """Adds up what tiles found of the same Gaussian and region, view by view; `member` is view * N + Gaussian."""
    columns = max(num_regions) + 1
    key, weight = sum_equal_keys(*found)
    starts = torch.arange(len(num_regions) + 1, device=key.device) * (num_gaussians * columns)
    bounds = torch.searchsorted(key.long(), starts).tolist()
    member = torch.div(key, columns, rounding_mode="floor")
    region = (key - member * columns).int() - 1
    for view, count in enumerate(num_regions):
        part = slice(bounds[view], bounds[view + 1])
        yield ViewEvidence((member[part] - view * num_gaussians).int(), region[part], weight[part], count)
