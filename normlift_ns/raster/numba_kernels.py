"""The compiled compositing of the CPU rasterizer, tile by tile, and its sums by (Gaussian, region).

The rows of a tile are worked on LANES pixels at a time and without branches, so that the compiler makes vector
instructions of them. Every thread writes to places of its own: there are no locks, and sums are the same on every run
and with any number of threads.
"""

from __future__ import annotations

import math

import numba
import numpy as np

from normlift_ns.core.evidence import UNLABELED
from normlift_ns.raster.numba_compiling import exp, fused_kernel, interleaved, kernel, parallel_kernel
from normlift_ns.raster.numba_lists import extent

LANES = 16
_MANY_LABELS = 4
"""Labels of a tile beyond which sums are better taken pixel by pixel."""
_FEW_LABELS = 32
"""Labels of a Gaussian that are kept sorted while they are met."""


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
    above, below = extent(down, left + 0.5 - u, right - 0.5 - u)
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
        tile = interleaved(position, tiles, threads)
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
        tile = interleaved(position, tiles, threads)
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
