"""Compiled compositing of the CPU rasterizer, tile by tile, and its sums by (Gaussian, region).

The rows of a tile are processed LANES pixels at a time and without branches, which the compiler turns into vector
instructions. Every thread writes to its own memory. So locks are not needed, and the sums are the same on every run and
with any number of threads.
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
"""Number of labels in a tile above which sums are taken pixel by pixel."""
_FEW_LABELS = 32
"""Number of labels of a Gaussian up to which they are sorted on insertion."""


@kernel
def _tile_labels(labels, box, local, distinct):  # pragma: no cover (compiled)
    """Number the labels of a tile 0, 1, ... in order of appearance, and return their count.

    The numbers are written to local[row, chunk, lane], and the labels to distinct[number].
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
    """Write the least and greatest label number of each row of a tile to `ranges`."""
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
    """Return the number of labels of every tile."""
    height, width = labels.shape
    counts = np.empty(((height + size - 1) // size) * ((width + size - 1) // size), np.int64)
    for tile in numba.prange(counts.size):
        box = _tile_box(tile, height, width, size)
        local = np.empty((size, (size + LANES - 1) // LANES, LANES), np.int32)
        counts[tile] = _tile_labels(labels, box, local, np.empty(size * size, np.int32))
    return counts


@kernel
def _reset_transmittance(box, transmittance):  # pragma: no cover (compiled)
    """Set the transmittance of a tile to 1, and to 0 outside the image."""
    top, left, bottom, right = box
    transmittance[:] = 0
    for y in range(bottom - top):
        for x in range(right - left):
            transmittance[y, x // LANES, x % LANES] = 1


@kernel
def _first_active(pixels, index):  # pragma: no cover (compiled)
    """Return the first index from `index` on with a transmittance above 0; the number of pixels if there is none."""
    while index < pixels.size and not pixels[index] > 0:
        index += 1
    return index


@fused_kernel
def _blend(g, box, means2d, conics, opacities, shapes, transmittance, weights, limits):  # pragma: no cover (compiled)
    """Composite one Gaussian over a tile: weights[row, chunk, lane] = A_ij, or 0 if it is not drawn.

    The transmittance of a pixel that has stopped is stored with a minus sign.

    Returns:
        The range (first, stop) of rows that the Gaussian may reach; other rows are not written.
    """
    top, left, bottom, right = box
    max_alpha, min_alpha, min_transmittance = limits
    u, v, opacity = means2d[g, 0], means2d[g, 1], opacities[g]
    a, b, c = conics[g, 0], conics[g, 1], conics[g, 2]
    number = means2d.dtype.type
    half, one, zero = number(0.5), number(1), number(0)
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
                drawn = (before > zero) & (sigma >= zero) & (alpha >= min_alpha)
                continues = after > min_transmittance
                weights[row, chunk, lane] = alpha * before if drawn & continues else zero
                transmittance[row, chunk, lane] = (after if continues else -before) if drawn else before
    return first, stop


@kernel
def _label_span(ranges, first, stop):  # pragma: no cover (compiled)
    """Return the range (least, stop) of label numbers in some rows."""
    least, greatest = ranges[first, 0], ranges[first, 1]
    for row in range(first + 1, stop):
        least, greatest = min(least, ranges[row, 0]), max(greatest, ranges[row, 1])
    return least, greatest + 1


@kernel
def _sum_by_lane(weights, local, number, first, stop, power, lanes):  # pragma: no cover (compiled)
    """Return the sum of A_ij ** power over the pixels with one label in some rows; `lanes` is 0 before and after."""
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
    """Add A_ij ** power of the pixels in some rows to sums[number], for all labels."""
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
    """Write one slot (Gaussian, label, sum of A_ij ** power) per tile list entry and label with a positive weight.

    The slots of a tile start at first_slot[tile], and used[tile] of them are written.
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
        _reset_transmittance(box, transmittance)
        sums, lanes = np.zeros(count), np.zeros(LANES)
        many = count > _MANY_LABELS  # independent of the rows that a Gaussian reaches, so these do not change its sums
        pixels, slot, active = transmittance.reshape(-1), first_slot[tile], 0
        for entry in range(offsets[tile], offsets[tile + 1]):
            active = _first_active(pixels, active)
            if active == pixels.size:
                break
            g = members[entry]
            first, stop = _blend(g, box, means2d, conics, opacities, shapes, transmittance, weights, limits)
            if first >= stop:
                continue
            least, end = _label_span(ranges, first, stop)
            if many:
                _sum_by_pixel(weights, local, first, stop, power, sums)
            for number in range(least, end):
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
    """Sort the slots by (Gaussian, label + 1), and add up equal ones in the order of the tiles.

    This is a counting sort by Gaussian; the labels of each Gaussian are added up in a dense row and sorted.
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
            position = end[slot_gaussian[slot]]
            columns[position], weights[position] = slot_label[slot] + 1, slot_weight[slot]
            end[slot_gaussian[slot]] = position + 1
    rows, sums, touched = np.empty(total, np.int32), np.zeros(num_columns), np.empty(num_columns, np.int32)
    written, start = 0, 0
    for g in range(num_gaussians):
        count = 0
        for i in range(start, end[g]):
            column = columns[i]
            if sums[column] == 0:
                position = count
                while position > 0 and count < _FEW_LABELS and touched[position - 1] > column:
                    touched[position] = touched[position - 1]
                    position -= 1
                touched[position] = column
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
    """Compute image[y, x] = sum of A_ij values[j] and alpha[y, x] = sum of A_ij."""
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
        _reset_transmittance(box, transmittance)
        pixels, active = transmittance.reshape(-1), 0
        for entry in range(offsets[tile], offsets[tile + 1]):
            active = _first_active(pixels, active)
            if active == pixels.size:
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
