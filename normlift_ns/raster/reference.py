"""Reference rasterizer in plain torch: tile by tile, on any device and in any precision.

It is slow, and all other backends are tested against it.
"""

from __future__ import annotations

from collections.abc import Iterator
from itertools import pairwise

import torch
from jaxtyping import Float, Int
from torch import Tensor

from normlift_ns.core.evidence import UNLABELED, Entries
from normlift_ns.core.sparse import sum_duplicates
from normlift_ns.raster.projection import Projected, Tiles
from normlift_ns.raster.settings import RasterSettings


def compositing_weights(alpha: Float[Tensor, "p k"], min_transmittance: float) -> Float[Tensor, "p k"]:
    """Return A_ij = alpha_ij prod_{k<j} (1 - alpha_ik) (eq. 1 of the paper) of K Gaussians, nearest first, in P pixels.

    A pixel stops before the first Gaussian that would leave `min_transmittance` or less.

    >>> compositing_weights(torch.tensor([[0.3, 0.8, 0.5]]), 1e-4)
    tensor([[0.3000, 0.5600, 0.0700]])
    >>> compositing_weights(torch.tensor([[0.3, 0.8, 0.5]]), 0.1)
    tensor([[0.3000, 0.5600, 0.0000]])
    """
    after = torch.cumprod(1 - alpha, dim=1)
    before = torch.cat([torch.ones_like(after[:, :1]), after[:, :-1]], dim=1)
    return torch.where(after > min_transmittance, alpha * before, 0.0)


def view_evidence(
    projected: Projected,
    tiles: Tiles,
    labels: Int[Tensor, "h w"],
    num_regions: int,
    weight_power: int,
    settings: RasterSettings,
) -> Entries:
    """Return the sums of A_ij ** weight_power by (Gaussian, region) of one view; region -1 is the unlabeled pixels."""
    parts: list[tuple[Tensor, Tensor, Tensor]] = []
    for member, (rows, columns), a in _tiles(projected, tiles, labels.shape[1], labels.shape[0], settings):
        weight = torch.where(a > 0, a.double() ** weight_power, 0.0)
        region, local = labels[rows, columns].flatten().unique(return_inverse=True)
        sums = weight.new_zeros(region.numel(), member.numel()).index_add_(0, local, weight)
        r, k = (sums * (region >= UNLABELED)[:, None]).nonzero(as_tuple=True)
        parts.append((projected.gaussian[member[k]], region[r], sums[r, k]))
    empty = torch.zeros(0, dtype=torch.int64, device=labels.device)
    gaussian, region, weight = (torch.cat(part) for part in zip((empty, empty, empty.double()), *parts))
    gaussian, column, weight = sum_duplicates(gaussian, region + 1, weight)
    return Entries(gaussian, column, weight.to(projected.opacities.dtype), (num_regions,))


def composite(
    projected: Projected, tiles: Tiles, values: Float[Tensor, "m c"], width: int, height: int, settings: RasterSettings
) -> tuple[Float[Tensor, "h w c"], Float[Tensor, "h w"]]:
    """Return sum_j A_ij values_j and sum_j A_ij of every pixel i (eq. 2 of the paper without its background)."""
    image, alpha = values.new_zeros(height, width, values.shape[1]), values.new_zeros(height, width)
    for member, (rows, columns), weight in _tiles(projected, tiles, width, height, settings):
        area = image[rows, columns]
        image[rows, columns] = (weight.to(values.dtype) @ values[member]).view(area.shape)
        alpha[rows, columns] = weight.sum(1).view(area.shape[:2]).to(values.dtype)
    return image, alpha


def _tiles(
    projected: Projected, tiles: Tiles, width: int, height: int, settings: RasterSettings
) -> Iterator[tuple[Tensor, tuple[slice, slice], Tensor]]:
    """Yield the K Gaussians, the pixels as slices of the image, and A_ij [pixels, K] of every tile with Gaussians."""
    size, device, dtype = settings.tile_size, projected.means2d.device, projected.means2d.dtype
    across = -(-width // size)
    bounds = tiles.offsets.tolist()
    for tile, (start, stop) in enumerate(pairwise(bounds)):
        if start == stop:
            continue
        member = tiles.members[start:stop].long()
        top, left = tile // across * size, tile % across * size
        rows, columns = slice(top, min(top + size, height)), slice(left, min(left + size, width))
        dx = (
            projected.means2d[member, 0]
            - (torch.arange(left, columns.stop, device=device).to(dtype) + 0.5)[None, :, None]
        )
        dy = projected.means2d[member, 1] - (torch.arange(top, rows.stop, device=device).to(dtype) + 0.5)[:, None, None]
        a, b, c = projected.conics[member].unbind(1)
        sigma = (0.5 * (a * dx * dx + c * dy * dy) + b * dx * dy).flatten(0, 1)  # [P, K]
        alpha = (projected.opacities[member] * torch.exp(-sigma)).clamp(max=settings.max_alpha)
        alpha = torch.where((sigma >= 0) & (alpha >= settings.min_alpha), alpha, 0.0)
        yield member, (rows, columns), compositing_weights(alpha, settings.min_transmittance)
