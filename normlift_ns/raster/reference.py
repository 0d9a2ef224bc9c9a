"""The reference rasterizer: plain torch, tile by tile, any device and precision. Slow, and the "
"measure of every other backend."""

from __future__ import annotations

import torch
from jaxtyping import Float, Int
from torch import Tensor

from normlift_ns.core.evidence import ViewEvidence
from normlift_ns.core.sparse import sum_duplicates
from normlift_ns.raster.projection import Projected, Tiles
from normlift_ns.raster.settings import RasterSettings


def compositing_weights(alpha: Float[Tensor, "p k"], min_transmittance: float) -> Float[Tensor, "p k"]:
    """A_ij = alpha_ij prod_{k<j} (1 - alpha_ik) (eq. 1 of the paper) of K Gaussians, nearest first, in P pixels.

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
) -> ViewEvidence:
    """Sums of A_ij ** weight_power by (Gaussian, region) of one view; region -1 collects the unlabelled pixels."""
    size = settings.tile_size
    columns = -(-labels.shape[1] // size)
    bounds = tiles.offsets.tolist()
    found: list[tuple[Tensor, Tensor, Tensor]] = []
    for tile in range(len(bounds) - 1):
        member = tiles.members[bounds[tile] : bounds[tile + 1]].long()
        if member.numel() == 0:
            continue
        top, left = tile // columns * size, tile % columns * size
        label = labels[top : top + size, left : left + size]
        v = torch.arange(top, top + label.shape[0], device=labels.device) + 0.5
        u = torch.arange(left, left + label.shape[1], device=labels.device) + 0.5
        mean, (a, b, c) = projected.means2d[member], projected.conics[member].unbind(1)
        dx, dy = (
            mean[:, 0] - u.to(mean.dtype)[None, :, None],
            mean[:, 1] - v.to(mean.dtype)[:, None, None],
        )  # [1, W, K], [H, 1, K]
        sigma = (0.5 * (a * dx * dx + c * dy * dy) + b * dx * dy).flatten(0, 1)  # [P, K]
        alpha = (projected.opacities[member] * torch.exp(-sigma)).clamp(max=settings.max_alpha)
        alpha = torch.where((sigma >= 0) & (alpha >= settings.min_alpha), alpha, 0.0)
        weight = compositing_weights(alpha, settings.min_transmittance).double()
        weight = torch.where(weight > 0, weight**weight_power, 0.0)
        region, local = label.flatten().unique(return_inverse=True)
        sums = weight.new_zeros(region.numel(), member.numel()).index_add_(0, local, weight)
        r, k = sums.nonzero(as_tuple=True)
        found.append((projected.gaussian[member[k]], region[r], sums[r, k]))
    if not found:
        none = torch.zeros(0, dtype=torch.int64, device=labels.device)
        return ViewEvidence(none, none, projected.opacities.new_zeros(0), num_regions)
    gaussian, region, weight = (torch.cat(parts) for parts in zip(*found))
    gaussian, region, weight = sum_duplicates(gaussian, region + 1, weight)
    return ViewEvidence(gaussian, region - 1, weight.to(projected.opacities.dtype), num_regions)
