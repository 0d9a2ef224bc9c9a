"""The compiled parts of the CPU rasterizer: tile lists, compositing tile by tile, and sums by (Gaussian, region).

The rows of a tile are worked on LANES pixels at a time and without branches, so that the compiler makes vector
instructions of them. Every thread writes to places of its own: there are no locks, and sums are the same on every run
and with any number of threads.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numba
import numpy as np
from numba import types
from numba.extending import overload

from normlift_ns.core.evidence import UNLABELED

LANES = 16
_REACH_MARGIN = 1e-2
"""Added to the exponent at which alpha falls below min_alpha, so that rounding in a Gaussian's reach never costs a
pixel.
"""
_MANY_LABELS = 4
"""Labels of a tile beyond which sums are better taken pixel by pixel."""
_FEW_LABELS = 32
"""Labels of a Gaussian that are kept sorted while they are met."""
_ROUNDINGS = 4
"""Bound of the rounding error of an exponent, in units of the precision times a dx^2 + c dy^2."""

_F = np.float32
_MAGIC32, _MAGIC64 = _F(1.5 * 2**23), 1.5 * 2**52
"""A number near 0 added to these is rounded to a whole one, which then stands in the last bits of the sum."""
_LOG2_E32, _LN2_HIGH32, _LN2_LOW32, _LEAST32 = _F(1.44269504088896341), _F(0.693359375), _F(-2.12194440e-4), _F(-87)
_LOG2_E64, _LN2_HIGH64, _LN2_LOW64 = 1.44269504088896341, 6.93147180369123816490e-01, 1.90821492927058770002e-10
_P0, _P1, _P2 = _F(1.9875691500e-4), _F(1.3981999507e-3), _F(8.3334519073e-3)
_P3, _P4, _P5, _ONE = _F(4.1665795894e-2), _F(1.6666665459e-1), _F(5.0000001201e-1), _F(1)


def _compiled(**options: Any) -> Callable[[Callable[..., Any]], Any]:
    """`numba.njit`, with what it compiles kept on disk where there is a place for that."""

    def decorate(function: Callable[..., Any]) -> Any:
        try:
            return numba.njit(cache=True, error_model="numpy", **options)(function)
        except RuntimeError:  # neither beside the code nor in the user's cache
            return numba.njit(error_model="numpy", **options)(function)

    return decorate


kernel = _compiled()
fused_kernel = _compiled(fastmath={"contract"})
"""A product and a sum may be rounded once, as they are on a GPU."""
parallel_kernel = _compiled(parallel=True)


def exp(x: float) -> float:
    """e ** x for x <= 0 in the precision of x, within 1e-7 (float32) or 4e-16; e ** -87 and e ** -700 at the least."""
    return math.exp(x)


@overload(exp, jit_options={"error_model": "numpy", "fastmath": {"contract"}})
def _compiled_exp(x):  # pragma: no cover (compiled)
    """e ** x = 2 ** n e ** r with |r| <= ln(2) / 2, by the polynomials of Cephes' expf and of Taylor."""

    def single(x):
        x = x if x > _LEAST32 else _LEAST32
        shifted = x * _LOG2_E32 + _MAGIC32
        n = shifted - _MAGIC32
        r = (x - n * _LN2_HIGH32) - n * _LN2_LOW32
        p = ((((_P0 * r + _P1) * r + _P2) * r + _P3) * r + _P4) * r + _P5
        power = np.int32((np.float32(shifted).view(np.int32) << 23) + 0x3F800000).view(np.float32)
        return (p * (r * r) + r + _ONE) * power

    def double(x):
        x = x if x > -700.0 else -700.0
        shifted = x * _LOG2_E64 + _MAGIC64
        n = shifted - _MAGIC64
        r = (x - n * _LN2_HIGH64) - n * _LN2_LOW64
        p = ((r / 6227020800 + 1 / 479001600) * r + 1 / 39916800) * r + 1 / 3628800
        p = (((p * r + 1 / 362880) * r + 1 / 40320) * r + 1 / 5040) * r + 1 / 720
        p = (((p * r + 1 / 120) * r + 1 / 24) * r + 1 / 6) * r + 0.5
        power = np.int64((np.float64(shifted).view(np.int64) << 52) + 0x3FF0000000000000).view(np.float64)
        return (p * (r * r) + r + 1.0) * power

    return single if x == types.float32 else double


@kernel
def _axis(reach, mine, mixed, other):  # pragma: no cover (compiled)
    """How far the ellipse mine s^2 + 2 mixed s t + other t^2 <= reach extends in s: what `_extent` needs; everywhere,
    where rounding has made it no ellipse.
    """
    det = mine * other - mixed * mixed
    if mine > 0 and other > 0 and det > 0 and reach < np.inf:
        peak = -mixed * math.sqrt(reach / (other * det))
        if abs(peak) < np.inf:
            return peak, -mixed / mine, reach / mine, det / (mine * mine)
    return 0.0, 0.0, np.inf, 0.0


@kernel
def _extent(axis, low, high):  # pragma: no cover (compiled)
    """Least and greatest s of the ellipse where low <= t <= high."""
    peak, slope, reach, bend = axis
    near, far = min(max(-peak, low), high), min(max(peak, low), high)
    return (
        slope * near - math.sqrt(max(0.0, reach - bend * near * near)),
        slope * far + math.sqrt(max(0.0, reach - bend * far * far)),
    )


@kernel
def _touched_tiles(centre, radius, size, count):  # pragma: no cover (compiled)
    """First tile along one axis that the square of a Gaussian touches, and the one behind the last: `assign_tiles`."""
    low, high = centre / size - radius / size, centre / size + radius / size
    return math.floor(min(max(low, 0), count)), math.ceil(min(max(high, 0), count))


@kernel
def _interleaved(position, count, threads):  # pragma: no cover (compiled)
    """The number, below `count` or to be skipped, at a position that a static schedule gives to one of the threads, so
    that each of them gets every n-th.
    """
    share = (count + threads - 1) // threads
    return position % share * threads + position // share


@kernel
def _shape(g, means2d, conics, opacities, radii, width, height, size, min_alpha, eps):  # pragma: no cover (compiled)
    """Extents of the ellipse in which alpha can reach min_alpha: `_axis` of x and of y, and half its height; the height
    is negative if there is none.
    """
    a, b, c = np.float64(conics[g, 0]), np.float64(conics[g, 1]), np.float64(conics[g, 2])
    if not opacities[g] >= min_alpha:
        none = (0.0, 0.0, 0.0, 0.0)
        return none, none, -1.0
    u, v = np.float64(means2d[g, 0]), np.float64(means2d[g, 1])
    far_x = min(max(abs(u), abs(u - width)), radii[g, 0] + size)
    far_y = min(max(abs(v), abs(v - height)), radii[g, 1] + size)
    margin = _REACH_MARGIN + _ROUNDINGS * eps * (a * far_x * far_x + c * far_y * far_y)
    reach = 2 * (math.log(opacities[g] / np.float64(min_alpha)) + margin)
    if not reach < np.inf:
        reach = np.inf
    across, down = _axis(reach, a, b, c), _axis(reach, c, b, a)
    return across, down, _extent(down, -np.inf, np.inf)[1] if down[2] < np.inf else np.inf


@kernel
def _columns(across, tall, u, v, row, x0, x1, size, width, height):  # pragma: no cover (compiled)
    """First column of tiles whose pixel centres the ellipse reaches in a row of tiles, and the one behind the last."""
    low, high = row * size + 0.5 - v, min((row + 1) * size, height) - 0.5 - v
    if low > tall or high < -tall:
        return 0, 0
    left, right = _extent(across, low, high)
    first = math.ceil(min(max(u + left - 0.5, x0 * size), width))
    last = math.floor(max(min(u + right - 0.5, min(x1 * size, width) - 1), -1.0))
    return (first // size, last // size + 1) if first <= last else (0, 0)


@parallel_kernel
def assign(means2d, conics, opacities, radii, width, height, size, min_alpha, threads):  # pragma: no cover (compiled)
    """Lists, for every tile, the Gaussians whose square touches it as in `projection.assign_tiles`, but for those of
    which no pixel of the tile can feel anything.

    Returns:
        The offsets and members of `Tiles`, and `_axis` of y of every Gaussian.
    """
    m, columns, rows = len(means2d), (width + size - 1) // size, (height + size - 1) // size
    side, eps = means2d.dtype.type(size), np.finfo(means2d.dtype).eps
    squares, shapes = np.empty((m, 4), np.int32), np.empty((m, 9))
    parts = 4 * threads
    place = np.zeros((parts, rows * columns), np.int64)
    for position in numba.prange(parts):
        part = _interleaved(position, parts, threads)
        for g in range(part * m // parts, (part + 1) * m // parts):
            across, down, tall = _shape(g, means2d, conics, opacities, radii, width, height, size, min_alpha, eps)
            u, v = np.float64(means2d[g, 0]), np.float64(means2d[g, 1])
            x0, x1 = _touched_tiles(means2d[g, 0], radii[g, 0], side, columns)
            y0, y1 = _touched_tiles(means2d[g, 1], radii[g, 1], side, rows)
            y1 = y1 if tall >= 0 else y0
            squares[g, 0], squares[g, 1], squares[g, 2], squares[g, 3] = x0, x1, y0, y1
            for i in range(4):
                shapes[g, i], shapes[g, 4 + i] = down[i], across[i]
            shapes[g, 8] = tall
            for row in range(y0, y1):
                first, stop = _columns(across, tall, u, v, row, x0, x1, size, width, height)
                for column in range(first, stop):
                    place[part, row * columns + column] += 1
    offsets, total = np.empty(rows * columns + 1, np.int64), 0
    for tile in range(rows * columns):
        offsets[tile] = total
        for part in range(parts):
            count = place[part, tile]
            place[part, tile] = total
            total += count
    offsets[rows * columns] = total
    members = np.empty(total, np.int32)
    for position in numba.prange(parts):
        part = _interleaved(position, parts, threads)
        for g in range(part * m // parts, (part + 1) * m // parts):
            across = (shapes[g, 4], shapes[g, 5], shapes[g, 6], shapes[g, 7])
            u, v = np.float64(means2d[g, 0]), np.float64(means2d[g, 1])
            x0, x1, y0, y1 = squares[g, 0], squares[g, 1], squares[g, 2], squares[g, 3]
            for row in range(y0, y1):
                first, stop = _columns(across, shapes[g, 8], u, v, row, x0, x1, size, width, height)
                for column in range(first, stop):
                    members[place[part, row * columns + column]] = g
                    place[part, row * columns + column] += 1
    return offsets, members, shapes


@kernel
def _tile_labels(labels, box, local, distinct):  # pragma: no cover (compiled)
    """Numbers the labels of a tile 0, 1, ... in order of appearance; fills local[row, chunk, lane] and
    distinct[number], returns how many.
    """
    top, left, bottom, right = box
    count, number = 0, 0
    for y in range(top, bottom):
        for x in range(left, right):
            if count == 0 or distinct[number] != labels[y, x]:
                number = 0
                while number < count and distinct[number] != labels[y, x]:
                    number += 1
            if number == count:
                distinct[count] = labels[y, x]
                count += 1
            local[y - top, (x - left) // LANES, (x - left) % LANES] = number
    return count


@kernel
def _label_ranges(local, box, ranges):  # pragma: no cover (compiled)
    """Least and greatest number of the labels of each row of a tile."""
    top, left, bottom, right = box
    for row in range(bottom - top):
        low = high = local[row, 0, 0]
        for x in range(right - left):
            number = local[row, x // LANES, x % LANES]
            low, high = min(low, number), max(high, number)
        ranges[row, 0], ranges[row, 1] = low, high


@kernel
def _tile_box(tile, height, width, size):  # pragma: no cover (compiled)
    columns = (width + size - 1) // size
    top, left = tile // columns * size, tile % columns * size
    return top, left, min(top + size, height), min(left + size, width)


@parallel_kernel
def count_labels(labels, size):  # pragma: no cover (compiled)
    """How many labels every tile has."""
    height, width = labels.shape
    counts = np.empty(((height + size - 1) // size) * ((width + size - 1) // size), np.int64)
    for tile in numba.prange(counts.size):
        box = _tile_box(tile, height, width, size)
        local = np.empty((size, (size + LANES - 1) // LANES, LANES), np.int32)
        counts[tile] = _tile_labels(labels, box, local, np.empty(size * size, np.int32))
    return counts


@kernel
def _open(box, transmittance):  # pragma: no cover (compiled)
    """Sets the transmittance of a tile to 1, and that of its places beyond the image to 0."""
    top, left, bottom, right = box
    transmittance[:] = 0
    for y in range(bottom - top):
        for x in range(right - left):
            transmittance[y, x // LANES, x % LANES] = 1


@kernel
def _first_open(pixels, place):  # pragma: no cover (compiled)
    """The first place from the given one on whose transmittance is not closed; the number of places if all are."""
    while place < pixels.size and not pixels[place] > 0:
        place += 1
    return place


@fused_kernel
def _blend(g, box, means2d, conics, opacities, shapes, transmittance, weights, limits):  # pragma: no cover (compiled)
    """Composites one Gaussian over a tile: weights[row, chunk, lane] = A_ij, 0 where it is not drawn.

    A pixel that has stopped has its transmittance with a minus sign.

    Returns:
        First row that it may reach and the one behind the last; the others are not written.
    """
    top, left, bottom, right = box
    max_alpha, min_alpha, min_transmittance = limits
    u, v, opacity = means2d[g, 0], means2d[g, 1], opacities[g]
    a, b, c = conics[g, 0], conics[g, 1], conics[g, 2]
    number = means2d.dtype.type
    half, one, none = number(0.5), number(1), number(0)
    half_a, half_c = half * a, half * c
    down = (shapes[g, 0], shapes[g, 1], shapes[g, 2], shapes[g, 3])
    above, below = _extent(down, left + 0.5 - u, right - 0.5 - u)
    first = math.ceil(min(max(v + above - 0.5 - top, 0.0), bottom - top))
    stop = math.floor(min(max(v + below - 0.5 - top, -1.0), bottom - top - 1)) + 1
    for row in range(first, stop):
        dy = v - (number(top + row) + half)
        linear, constant = b * dy, half_c * dy * dy
        for chunk in range(transmittance.shape[1]):
            x = number(left + chunk * LANES) + half
            for lane in range(LANES):
                before = transmittance[row, chunk, lane]
                dx = u - (x + number(lane))
                sigma = (half_a * dx + linear) * dx + constant
                alpha = opacity * exp(-sigma)
                alpha = alpha if alpha < max_alpha else max_alpha
                after = before * (one - alpha)
                drawn = (before > none) & (sigma >= none) & (alpha >= min_alpha)
                goes_on = after > min_transmittance
                weights[row, chunk, lane] = alpha * before if drawn & goes_on else none
                transmittance[row, chunk, lane] = (after if goes_on else -before) if drawn else before
    return first, stop


@kernel
def _met_labels(ranges, first, stop):  # pragma: no cover (compiled)
    """The least number of a label in the given rows, and the one behind the greatest."""
    least, most = ranges[first, 0], ranges[first, 1]
    for row in range(first + 1, stop):
        least, most = min(least, ranges[row, 0]), max(most, ranges[row, 1])
    return least, most + 1


@kernel
def _sum_by_lane(weights, local, number, first, stop, power, lanes):  # pragma: no cover (compiled)
    """Sum of A_ij ** power over the pixels with one label in the given rows; `lanes` is 0 before and after."""
    for row in range(first, stop):
        for chunk in range(weights.shape[1]):
            if power == 1:
                for lane in range(LANES):
                    weight = np.float64(weights[row, chunk, lane])
                    lanes[lane] += weight if local[row, chunk, lane] == number else 0.0
            else:
                for lane in range(LANES):
                    weight = np.float64(weights[row, chunk, lane])
                    weight = weight * weight if power == 2 else (1.0 if weight > 0 else 0.0)
                    lanes[lane] += weight if local[row, chunk, lane] == number else 0.0
    total = 0.0
    for lane in range(LANES):
        total += lanes[lane]
        lanes[lane] = 0
    return total


@kernel
def _sum_by_pixel(weights, local, first, stop, power, sums):  # pragma: no cover (compiled)
    """The same for all labels at once, added to sums[number]."""
    for row in range(first, stop):
        for chunk in range(weights.shape[1]):
            for lane in range(LANES):
                weight = np.float64(weights[row, chunk, lane])
                if weight > 0:
                    sums[local[row, chunk, lane]] += weight if power == 1 else weight**power


@parallel_kernel
def fill(  # pragma: no cover (compiled)
    offsets,
    members,
    means2d,
    conics,
    opacities,
    shapes,
    gaussian,
    labels,
    power,
    size,
    limits,
    first_slot,
    used,
    slots,
    threads,
):
    """One slot per (tile list entry, label of the tile) with weight, (Gaussian, label, sum of A_ij ** power): those of
    a tile from first_slot[tile] on, used[tile] of them.
    """
    slot_gaussian, slot_label, slot_weight = slots
    tiles, wide = offsets.size - 1, (size + LANES - 1) // LANES
    for position in numba.prange((tiles + threads - 1) // threads * threads):
        tile = _interleaved(position, tiles, threads)
        if tile >= tiles or offsets[tile] == offsets[tile + 1]:
            continue
        local, ranges = np.zeros((size, wide, LANES), np.int32), np.empty((size, 2), np.int32)
        distinct = np.empty(size * size, np.int32)
        transmittance, weights = (
            np.empty((size, wide, LANES), means2d.dtype),
            np.empty((size, wide, LANES), means2d.dtype),
        )
        box = _tile_box(tile, labels.shape[0], labels.shape[1], size)
        count = _tile_labels(labels, box, local, distinct)
        _label_ranges(local, box, ranges)
        _open(box, transmittance)
        sums, lanes = np.zeros(count), np.zeros(LANES)
        many = count > _MANY_LABELS  # whatever rows a Gaussian reaches, so that they do not change its sums
        pixels, slot, place = transmittance.reshape(-1), first_slot[tile], 0
        for entry in range(offsets[tile], offsets[tile + 1]):
            place = _first_open(pixels, place)
            if place == pixels.size:
                break
            g = members[entry]
            first, stop = _blend(g, box, means2d, conics, opacities, shapes, transmittance, weights, limits)
            if first >= stop:
                continue
            least, behind = _met_labels(ranges, first, stop)
            if many:
                _sum_by_pixel(weights, local, first, stop, power, sums)
            for number in range(least, behind):
                if many:
                    total, sums[number] = sums[number], 0.0
                else:
                    total = _sum_by_lane(weights, local, number, first, stop, power, lanes)
                if total > 0 and distinct[number] >= UNLABELED:
                    slot_gaussian[slot], slot_label[slot] = gaussian[g], distinct[number]
                    slot_weight[slot] = total
                    slot += 1
        used[tile] = slot - first_slot[tile]


@kernel
def merge(first_slot, used, slots, num_gaussians, num_columns):  # pragma: no cover (compiled)
    """The slots sorted by (Gaussian, label + 1), those of the same place added up in the order of the tiles.

    A counting sort by Gaussian; the labels of each are added up in a row of their own and sorted.
    """
    slot_gaussian, slot_label, slot_weight = slots
    end = np.zeros(num_gaussians + 1, np.int64)
    for tile in range(len(used)):
        for slot in range(first_slot[tile], first_slot[tile] + used[tile]):
            end[slot_gaussian[slot]] += 1
    total = 0
    for g in range(num_gaussians + 1):
        total, end[g] = total + end[g], total
    columns, weights = np.empty(total, np.int32), np.empty(total)
    for tile in range(len(used)):
        for slot in range(first_slot[tile], first_slot[tile] + used[tile]):
            place = end[slot_gaussian[slot]]
            columns[place], weights[place] = slot_label[slot] + 1, slot_weight[slot]
            end[slot_gaussian[slot]] = place + 1
    rows, sums, touched = np.empty(total, np.int32), np.zeros(num_columns), np.empty(num_columns, np.int32)
    written, start = 0, 0
    for g in range(num_gaussians):
        count = 0
        for i in range(start, end[g]):
            column = columns[i]
            if sums[column] == 0:
                place = count
                while place > 0 and count < _FEW_LABELS and touched[place - 1] > column:
                    touched[place] = touched[place - 1]
                    place -= 1
                touched[place] = column
                count += 1
            sums[column] += weights[i]
        start = end[g]
        if count > _FEW_LABELS:
            touched[:count].sort()
        for i in range(count):
            column = touched[i]
            rows[written], columns[written], weights[written] = g, column, sums[column]
            sums[column] = 0
            written += 1
    return rows[:written], columns[:written], weights[:written]


@parallel_kernel
def draw(  # pragma: no cover (compiled)
    offsets, members, means2d, conics, opacities, shapes, values, image, alpha, size, limits, threads
):
    """image[y, x] = sum of A_ij values[j], alpha[y, x] = sum of A_ij."""
    tiles, wide = offsets.size - 1, (size + LANES - 1) // LANES
    for position in numba.prange((tiles + threads - 1) // threads * threads):
        tile = _interleaved(position, tiles, threads)
        if tile >= tiles:
            continue
        transmittance, weights = (
            np.empty((size, wide, LANES), means2d.dtype),
            np.empty((size, wide, LANES), means2d.dtype),
        )
        box = _tile_box(tile, image.shape[0], image.shape[1], size)
        top, left, bottom, right = box
        _open(box, transmittance)
        pixels, place = transmittance.reshape(-1), 0
        for entry in range(offsets[tile], offsets[tile + 1]):
            place = _first_open(pixels, place)
            if place == pixels.size:
                break
            g = members[entry]
            first, stop = _blend(g, box, means2d, conics, opacities, shapes, transmittance, weights, limits)
            for row in range(first, stop):
                for x in range(right - left):
                    weight = weights[row, x // LANES, x % LANES]
                    if weight > 0:
                        for channel in range(values.shape[1]):
                            image[top + row, left + x, channel] += weight * values[g, channel]
        for y in range(top, bottom):
            for x in range(left, right):
                alpha[y, x] = 1 - abs(transmittance[y - top, (x - left) // LANES, (x - left) % LANES])
