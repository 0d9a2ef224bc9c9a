"""The compiled CPU rasterizer: the reference's sums, one thread per tile, touching only the pixels that a Gaussian
reaches.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numba
import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from normlift_ns.core.evidence import UNLABELED, Entries
from normlift_ns.core.sparse import sum_duplicates
from normlift_ns.raster.projection import Projected, Tiles
from normlift_ns.raster.settings import RasterSettings

_REACH_MARGIN = 1e-2
"""Added to the exponent at which alpha falls below min_alpha, so that rounding in a Gaussian's reach never costs a
pixel.
"""


def _compiled(**options: Any) -> Callable[[Callable[..., Any]], Any]:
    """`numba.njit`, with what it compiles kept on disk where there is a place for that."""

    def decorate(function: Callable[..., Any]) -> Any:
        try:
            return numba.njit(cache=True, **options)(function)
        except RuntimeError:  # neither beside the code nor in the user's cache
            return numba.njit(**options)(function)

    return decorate


def view_evidence(
    projected: Projected,
    tiles: Tiles,
    labels: Int[Tensor, "h w"],
    num_regions: int,
    weight_power: int,
    settings: RasterSettings,
) -> Entries:
    """The same as `reference.view_evidence`, for tensors on the CPU."""
    label_map = labels.int().numpy()
    offsets = tiles.offsets.numpy()
    counts = _count_labels(label_map, settings.tile_size)
    first_slot = np.concatenate([[0], np.cumsum(np.diff(offsets) * counts)])
    slots = (np.zeros(first_slot[-1]), np.empty(first_slot[-1], np.int32), np.empty(first_slot[-1], np.int32))
    arrays, limits = _inputs(projected, settings)
    _fill_slots(
        offsets, tiles.members.numpy(), *arrays, label_map, first_slot, slots, weight_power, settings.tile_size, limits
    )
    used = np.flatnonzero((slots[0] > 0) & (slots[2] >= UNLABELED))
    weight, member, region = (torch.from_numpy(x[used]) for x in slots)
    gaussian, column, weight = sum_duplicates(projected.gaussian[member.long()], region + 1, weight)
    return Entries(gaussian, column, weight.to(projected.opacities.dtype), (num_regions,))


def composite(
    projected: Projected, tiles: Tiles, values: Float[Tensor, "m c"], width: int, height: int, settings: RasterSettings
) -> tuple[Float[Tensor, "h w c"], Float[Tensor, "h w"]]:
    """The same as `reference.composite`, for tensors on the CPU."""
    arrays, limits = _inputs(projected, settings)
    image = np.zeros((height, width, values.shape[1]), arrays[0].dtype)
    alpha = np.zeros((height, width), arrays[0].dtype)
    _composite(
        *(tiles.offsets.numpy(), tiles.members.numpy(), *arrays),
        *(values.to(projected.opacities.dtype).contiguous().numpy(), image, alpha, settings.tile_size, limits),
    )
    return torch.from_numpy(image), torch.from_numpy(alpha)


def _inputs(projected: Projected, settings: RasterSettings):
    arrays = (projected.means2d.numpy(), projected.conics.numpy(), projected.opacities.numpy())
    limits = (settings.max_alpha, settings.min_alpha, settings.min_transmittance)
    return arrays, tuple(arrays[0].dtype.type(x) for x in limits)


@_compiled()
def _tile_labels(labels, tile, size, local, distinct):  # pragma: no cover (compiled)
    """Numbers the labels of a tile 0, 1, … in order of appearance; fills local[pixel] and distinct[number], returns
    how many.
    """
    height, width = labels.shape
    columns = (width + size - 1) // size
    top, left = tile // columns * size, tile % columns * size
    count = 0
    for y in range(top, min(top + size, height)):
        for x in range(left, min(left + size, width)):
            number = 0
            while number < count and distinct[number] != labels[y, x]:
                number += 1
            if number == count:
                distinct[count] = labels[y, x]
                count += 1
            local[(y - top) * size + x - left] = number
    return count


@_compiled(parallel=True)
def _count_labels(labels, size):  # pragma: no cover (compiled)
    height, width = labels.shape
    counts = np.empty(((height + size - 1) // size) * ((width + size - 1) // size), np.int64)
    for tile in numba.prange(counts.size):
        counts[tile] = _tile_labels(
            labels, tile, size, np.empty(size * size, np.int32), np.empty(size * size, np.int32)
        )
    return counts


@_compiled()
def _splat(g, box, means2d, conics, opacities, transmittance, limits, pixels, weights):  # pragma: no cover (compiled)
    """Composites one Gaussian over the open pixels of a tile: their numbers and A_ij, how many, and how many closed.

    alpha >= min_alpha where (a dx^2 + c dy^2) / 2 + b dx dy <= reach: an ellipse, walked row by row.
    """
    top, left, bottom, right, size = box
    max_alpha, min_alpha, min_transmittance = limits
    u, v, opacity = means2d[g, 0], means2d[g, 1], opacities[g]
    a, b, c = conics[g, 0], conics[g, 1], conics[g, 2]
    half, one = means2d.dtype.type(0.5), means2d.dtype.type(1)
    drawn, closed = 0, 0
    if opacity < min_alpha:
        return drawn, closed
    reach = math.log(np.float64(opacity) / min_alpha) + _REACH_MARGIN
    a64, b64 = np.float64(a), np.float64(b)
    det = a64 * c - b64 * b64
    tall = math.sqrt(2 * reach * a64 / det) + 0.5 if det > 0 else np.inf
    first = max(top, math.floor(max(v - tall, -1.0)))
    last = min(bottom - 1, math.ceil(min(v + tall, np.float64(bottom))))
    for y in range(first, last + 1):
        dy = v - (y + half)
        root = max(0.0, 2 * reach * a64 - det * np.float64(dy) ** 2) if det > 0 else np.inf
        middle, wide = u + b64 * dy / a64, math.sqrt(root) / a64 + 0.5
        start = max(left, math.floor(max(middle - wide, -1.0)))
        stop = min(right - 1, math.ceil(min(middle + wide, np.float64(right))))
        for x in range(start, stop + 1):
            pixel = (y - top) * size + x - left
            before = transmittance[pixel]
            if before < 0:  # closed
                continue
            dx = u - (x + half)
            sigma = half * (a * dx * dx + c * dy * dy) + b * dx * dy
            if sigma < 0:
                continue
            alpha = min(max_alpha, opacity * math.exp(-sigma))
            if alpha < min_alpha:
                continue
            after = before * (one - alpha)
            if after <= min_transmittance:
                transmittance[pixel] = -before
                closed += 1
                continue
            transmittance[pixel] = after
            pixels[drawn], weights[drawn] = pixel, alpha * before
            drawn += 1
    return drawn, closed


@_compiled()
def _tile_box(tile, height, width, size):  # pragma: no cover (compiled)
    columns = (width + size - 1) // size
    top, left = tile // columns * size, tile % columns * size
    return top, left, min(top + size, height), min(left + size, width), size


@_compiled(parallel=True)
def _fill_slots(  # pragma: no cover (compiled)
    offsets, members, means2d, conics, opacities, labels, first_slot, slots, power, size, limits
):
    """One slot per (tile list entry, label of the tile), written by the one thread that owns the tile.

    So there are no locks, and the sums are the same on every run.
    """
    slot_weight, slot_member, slot_region = slots
    for tile in numba.prange(offsets.size - 1):
        local, distinct, pixels = (
            np.empty(size * size, np.int32),
            np.empty(size * size, np.int32),
            np.empty(size * size, np.int32),
        )
        transmittance, weights = np.ones(size * size, means2d.dtype), np.empty(size * size, means2d.dtype)
        count = _tile_labels(labels, tile, size, local, distinct)
        sums = np.zeros(count)
        box = _tile_box(tile, labels.shape[0], labels.shape[1], size)
        open_pixels = (box[2] - box[0]) * (box[3] - box[1])
        slot = first_slot[tile]
        for entry in range(offsets[tile], offsets[tile + 1]):
            if open_pixels == 0:
                break
            g = members[entry]
            drawn, closed = _splat(g, box, means2d, conics, opacities, transmittance, limits, pixels, weights)
            open_pixels -= closed
            for i in range(drawn):
                weight = np.float64(weights[i])
                sums[local[pixels[i]]] += weight if power == 1 else weight**power
            for number in range(count):
                slot_weight[slot] = sums[number]
                slot_member[slot] = g
                slot_region[slot] = distinct[number]
                sums[number] = 0
                slot += 1


@_compiled(parallel=True)
def _composite(  # pragma: no cover (compiled)
    offsets, members, means2d, conics, opacities, values, image, alpha, size, limits
):
    """image[y, x] = sum of A_ij values[j], alpha[y, x] = sum of A_ij."""
    for tile in numba.prange(offsets.size - 1):
        pixels = np.empty(size * size, np.int32)
        transmittance, weights = np.ones(size * size, means2d.dtype), np.empty(size * size, means2d.dtype)
        box = _tile_box(tile, image.shape[0], image.shape[1], size)
        open_pixels = (box[2] - box[0]) * (box[3] - box[1])
        for entry in range(offsets[tile], offsets[tile + 1]):
            if open_pixels == 0:
                break
            g = members[entry]
            drawn, closed = _splat(g, box, means2d, conics, opacities, transmittance, limits, pixels, weights)
            open_pixels -= closed
            for i in range(drawn):
                y, x = box[0] + pixels[i] // size, box[1] + pixels[i] % size
                for channel in range(values.shape[1]):
                    image[y, x, channel] += weights[i] * values[g, channel]
        for y in range(box[0], box[2]):
            for x in range(box[1], box[3]):
                alpha[y, x] = 1 - abs(transmittance[(y - box[0]) * size + x - box[1]])
