"""Sums of compositing weights by (Gaussian, region): one program of a single warp per tile, no atomics.

A program holds the pixels of its tile in registers and walks through the Gaussians, nearest first, with the arithmetic
of gsplat 1.4.0's rasterize_to_pixels_fwd.cu. For every (Gaussian, region in the tile) it owns one slot of the output,
so that the result does not depend on the order in which programs run.
"""

from __future__ import annotations

from itertools import pairwise
from typing import NamedTuple

import torch
import triton
import triton.language as tl
from jaxtyping import Float32, Int, Int32
from torch import Tensor

_UNROLL = 4
"""Gaussians between two looks at whether a tile is finished."""
_MOST_SLOTS = 2**26
"""Slots at once, of 8 or 12 bytes each."""


class RegionSums(NamedTuple):
    """Nonzero sums, one per tile, Gaussian and region, ordered by tile: places occur as often as tiles show them."""

    key: Int[Tensor, " m"]
    """gaussian * columns + column."""
    weight: Float32[Tensor, " m"]


@triton.jit
def _pixels(tile, tiles_across, TILE: tl.constexpr):
    p = tl.arange(0, TILE * TILE)
    return (tile // tiles_across) * TILE + p // TILE, (tile % tiles_across) * TILE + p % TILE


@triton.jit
def _number_labels(labels, local, table, counts, width, height, tiles_across, tiles, TILE: tl.constexpr):
    """Numbers the labels >= -1 of a tile in ascending order: local[tile, pixel], -1 for none; table[tile, number]."""
    tile = tl.program_id(0).to(tl.int64)
    view = tile // tiles
    y, x = _pixels((tile % tiles).to(tl.int32), tiles_across, TILE)
    label = tl.load(labels + (view * height + y) * width + x, mask=(y < height) & (x < width), other=-2)
    END: tl.constexpr = 2147483647
    number = tl.full([TILE * TILE], -1, tl.int32)
    count = 0
    current = tl.min(tl.where(label >= -1, label, END), axis=0)
    while current != END:
        number = tl.where(label == current, count, number)
        tl.store(table + tile * TILE * TILE + count, current)
        count += 1
        current = tl.min(tl.where(label > current, label, END), axis=0)
    tl.store(local + tile * TILE * TILE + tl.arange(0, TILE * TILE), number.to(tl.int16))
    tl.store(counts + tile, count)


@triton.jit
def _sum_regions(
    means2d, conics, opacities, members, offsets, local, table, counts, base, first_column, out_weight, out_key,
    gaussians, first_tile, first_slot, columns, tiles_across, tiles, max_alpha, min_alpha, min_transmittance,
    POWER: tl.constexpr, TILE: tl.constexpr, UNROLL: tl.constexpr,
):  # fmt: skip
    tile = first_tile + tl.program_id(0).to(tl.int64)
    start, stop = tl.load(offsets + tile), tl.load(offsets + tile + 1)
    count = tl.load(counts + tile)
    if (start < stop) & (count > 0):
        y, x = _pixels((tile % tiles).to(tl.int32), tiles_across, TILE)
        px, py = x.to(tl.float32) + 0.5, y.to(tl.float32) + 0.5
        number = tl.load(local + tile * TILE * TILE + tl.arange(0, TILE * TILE)).to(tl.int32)
        view = tile // tiles
        column = tl.load(first_column + view) + 1  # of label 0
        only = tl.load(table + tile * TILE * TILE)
        slot = tl.load(base + tile) - first_slot
        T = tl.where(number >= 0, 1.0, 0.0)  # transmittance; a finished pixel has none
        i = start
        alive = 1
        # Values of the next Gaussian are on their way while the present one is computed.
        m = tl.load(members + i)
        u, v = tl.load(means2d + 2 * m), tl.load(means2d + 2 * m + 1)
        a, b, c = tl.load(conics + 3 * m), tl.load(conics + 3 * m + 1), tl.load(conics + 3 * m + 2)
        o = tl.load(opacities + m)
        later = tl.load(members + i + 1, mask=i + 1 < stop, other=0)
        while (i < stop) & (alive > 0):
            for _ in tl.static_range(UNROLL):
                next_m = later
                more = i + 1 < stop
                later = tl.load(members + i + 2, mask=i + 2 < stop, other=0)
                next_u = tl.load(means2d + 2 * next_m, mask=more, other=0.0)
                next_v = tl.load(means2d + 2 * next_m + 1, mask=more, other=0.0)
                next_a = tl.load(conics + 3 * next_m, mask=more, other=0.0)
                next_b = tl.load(conics + 3 * next_m + 1, mask=more, other=0.0)
                next_c = tl.load(conics + 3 * next_m + 2, mask=more, other=0.0)
                next_o = tl.load(opacities + next_m, mask=more, other=0.0)

                dx, dy = u - px, v - py
                sigma = 0.5 * (a * dx * dx + c * dy * dy) + b * dx * dy
                alpha = tl.minimum(o * tl.exp(-sigma), max_alpha)
                alpha = tl.where((sigma >= 0) & (alpha >= min_alpha), alpha, 0.0)
                after = T * (1.0 - alpha)
                goes_on = after > min_transmittance
                weight = tl.where(goes_on, alpha * T, 0.0)
                T = tl.where(goes_on, after, 0.0)
                if POWER == 2:
                    weight = weight * weight
                if POWER == 0:
                    weight = tl.where(weight > 0, 1.0, 0.0)
                total = tl.sum(weight, axis=0)
                if total > 0:
                    place = (m - view * gaussians) * columns + column
                    if count == 1:
                        tl.store(out_weight + slot, total)
                        tl.store(out_key + slot, (place + only).to(out_key.dtype.element_ty))
                    else:
                        for r in range(count):
                            part = tl.sum(tl.where(number == r, weight, 0.0), axis=0)
                            label = tl.load(table + tile * TILE * TILE + r)
                            tl.store(out_weight + slot + r, part)
                            tl.store(out_key + slot + r, (place + label).to(out_key.dtype.element_ty))
                slot += count
                i += 1
                m, u, v, a, b, c, o = next_m, next_u, next_v, next_a, next_b, next_c, next_o
            alive = tl.max(tl.where(T > 0, 1, 0), axis=0)


def region_sums(
    means2d: Float32[Tensor, "m 2"],
    conics: Float32[Tensor, "m 3"],
    opacities: Float32[Tensor, " m"],
    members: Int32[Tensor, " intersections"],
    offsets: Int[Tensor, " tiles_plus_1"],
    labels: Int32[Tensor, "views h w"],
    first_column: Int32[Tensor, " views"],
    *,
    columns: int,
    tile_size: int,
    max_alpha: float,
    min_alpha: float,
    min_transmittance: float,
    weight_power: int,
) -> RegionSums:
    """Sums of A_ij ** weight_power over the pixels of each region in each tile, for views of one size.

    Args:
        means2d, conics, opacities: projected Gaussians in pixels, those of the first view, of the second, ...
        members: indices of Gaussians by tile, nearest first.
        offsets: tile t of all views (view by view, row by row) holds members[offsets[t]:offsets[t + 1]].
        labels: region of every pixel; -1: unlabelled, summed like a region; below -1: no pixel.
        first_column: of each view, where its unlabelled pixels go; its regions follow. `columns`: of all views.
        tile_size: a power of two.
    """
    views, height, width = labels.shape
    across = -(-width // tile_size)
    tiles, pixels, device = across * -(-height // tile_size), tile_size**2, means2d.device
    local = torch.empty(views * tiles, pixels, dtype=torch.int16, device=device)
    table = torch.empty(views * tiles, pixels, dtype=torch.int32, device=device)
    counts = torch.empty(views * tiles, dtype=torch.int32, device=device)
    gaussians = len(means2d) // views
    _number_labels[(views * tiles,)](
        labels, local, table, counts, width, height, across, tiles, TILE=tile_size, num_warps=1
    )

    slots = torch.cat([counts.new_zeros(1), counts * offsets.diff()]).cumsum(
        0
    )  # slot of the first Gaussian of each tile
    parts = [_no_sums(device)]
    for first, last, low, high in _chunks(slots):
        weight = torch.zeros(high - low, device=device)
        key = torch.empty(high - low, dtype=_key_type(gaussians * columns), device=device)
        _sum_regions[(last - first,)](
            means2d, conics, opacities, members, offsets, local, table, counts, slots, first_column, weight, key,
            gaussians, first, low, columns, across, tiles, max_alpha, min_alpha, min_transmittance,
            POWER=weight_power, TILE=tile_size, UNROLL=_UNROLL, num_warps=1,
        )  # fmt: skip
        found = weight.nonzero().squeeze(1)
        parts.append(RegionSums(key[found], weight[found]))
    return parts[1] if len(parts) == 2 else RegionSums(*(torch.cat(x) for x in zip(*parts)))


def _chunks(slots: Int[Tensor, " tiles_plus_1"]) -> list[tuple[int, int, int, int]]:
    """Runs of tiles of at most _MOST_SLOTS slots, or of one tile: first and last tile, first and last slot."""
    total = int(slots[-1])
    if total <= _MOST_SLOTS:
        return [(0, len(slots) - 1, 0, total)] if total > 0 else []
    bounds = torch.arange(0, total + _MOST_SLOTS, _MOST_SLOTS, device=slots.device)
    tile = torch.cat([torch.searchsorted(slots, bounds, right=True) - 1, slots.new_tensor([len(slots) - 1])]).unique()
    return [
        (first, last, low, high) for (first, low), (last, high) in pairwise(zip(tile.tolist(), slots[tile].tolist()))
    ]


def _no_sums(device: torch.device) -> RegionSums:
    return RegionSums(torch.zeros(0, dtype=torch.int32, device=device), torch.zeros(0, device=device))


def _key_type(keys: int) -> torch.dtype:
    """int32 halves the work of sorting, where it is wide enough."""
    return torch.int32 if keys < 2**31 else torch.int64
