"""Compositing of images with any number of channels: one single-warp program per cell and group of channels."""

from __future__ import annotations

import torch
import triton
import triton.language as tl
from jaxtyping import Float32, Int64
from torch import Tensor

from normlift_ns.kernels.lists import Grid, Lists
from normlift_ns.kernels.regions import UNROLL, Limits, blend, cell_pixels, load_splat

_CHANNELS = 8
"""Largest number of channels in a program; more channels need more programs, which recompute the weights."""


@triton.jit
def _composite(
    splats, members, offsets, gaussians, values, image, out_alpha, width, height, channels, cells_across,
    max_alpha, min_alpha, min_transmittance,
    CELL_W: tl.constexpr, CELL_H: tl.constexpr, UNROLL: tl.constexpr, CHANNELS: tl.constexpr,
):  # fmt: skip
    cell = tl.program_id(0)
    channel = tl.program_id(1) * CHANNELS + tl.arange(0, CHANNELS)[None, None, :]
    start, stop = tl.load(offsets + cell), tl.load(offsets + cell + 1)
    y, x = cell_pixels(cell, cells_across, CELL_W, CELL_H)
    px, py = x.to(tl.float32) + 0.5, y.to(tl.float32) + 0.5
    inside = (y < height) & (x < width)
    T = tl.where(inside, 1.0, 0.0)
    weight_sum = tl.zeros([CELL_H, CELL_W], tl.float32)
    color = tl.zeros([CELL_H, CELL_W, CHANNELS], tl.float32)
    i = start
    alive = 1
    while (i < stop) & (alive > 0):
        for _ in tl.static_range(UNROLL):
            inside_list = i < stop
            m = tl.load(members + i, mask=inside_list, other=0).to(tl.int64)
            u, v, a, c, b, o = load_splat(splats, m, inside_list)
            gaussian = tl.load(gaussians + m)
            weight, T = blend(u, v, a, c, b, o, px, py, T, max_alpha, min_alpha, min_transmittance)
            value = tl.load(values + gaussian * channels + channel, mask=channel < channels, other=0.0)
            color += weight[:, :, None] * value
            weight_sum += weight
            i += 1
        alive = tl.max(tl.where(T > 0, 1, 0))
    pixel = y.to(tl.int64) * width + x
    tl.store(image + pixel[:, :, None] * channels + channel, color, mask=inside[:, :, None] & (channel < channels))
    if tl.program_id(1) == 0:
        tl.store(out_alpha + pixel, weight_sum, mask=inside)


def composite(
    splats: Float32[Tensor, "m 8"],
    lists: Lists,
    gaussians: Int64[Tensor, " m"],
    values: Float32[Tensor, "n c"],
    grid: Grid,
    limits: Limits,
) -> tuple[Float32[Tensor, "h w c"], Float32[Tensor, "h w"]]:
    """Return sum_j A_ij values_j and sum_j A_ij of every pixel of one view.

    Args:
        splats: Projected Gaussians; see `SPLAT`.
        lists: Splats by cell.
        gaussians: Gaussian of every splat.
        values: Values of every Gaussian.
        grid: Cells of the image.
        limits: Limits of alpha and transmittance.
    """
    channels = values.shape[1]
    image = torch.zeros(grid.height, grid.width, channels, device=splats.device)
    alpha = torch.zeros(grid.height, grid.width, device=splats.device)
    if len(lists.members) == 0:
        return image, alpha
    block = min(_CHANNELS, triton.next_power_of_2(max(1, channels)))
    _composite[(grid.cells, max(1, triton.cdiv(channels, block)))](
        splats.view(torch.int64), lists.members, lists.offsets, gaussians, values.contiguous(), image, alpha,
        grid.width, grid.height, channels, grid.across, *limits, CELL_W=grid.cell_width, CELL_H=grid.cell_height,
        UNROLL=UNROLL, CHANNELS=block, num_warps=1,
    )  # fmt: skip
    return image, alpha
