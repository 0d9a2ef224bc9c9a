"""Compiled tile lists of the CPU rasterizer: the Gaussians that can contribute to each tile."""

from __future__ import annotations

import math

import numba
import numpy as np

from normlift_ns.raster.numba_compiling import interleaved, kernel, parallel_kernel

_REACH_MARGIN = 1e-2
"""Added to the exponent at which alpha falls below min_alpha, so that rounding never drops a pixel of a Gaussian."""
_ROUNDINGS = 4
"""Bound on the rounding error of an exponent, in units of machine epsilon times a dx^2 + c dy^2."""


@kernel
def _axis(reach, own, mixed, other):  # pragma: no cover (compiled)
    """Return the parameters of `extent` for s in the ellipse own s^2 + 2 mixed s t + other t^2 <= reach.

    The extent is infinite if rounding has destroyed the ellipse.
    """
    det = own * other - mixed * mixed
    if own > 0 and other > 0 and det > 0 and reach < np.inf:
        peak = -mixed * math.sqrt(reach / (other * det))
        if abs(peak) < np.inf:
            return peak, -mixed / own, reach / own, det / (own * own)
    return 0.0, 0.0, np.inf, 0.0


@kernel
def extent(axis, low, high):  # pragma: no cover (compiled)
    """Return the least and greatest s of the ellipse for low <= t <= high."""
    peak, slope, reach, curvature = axis
    near, far = min(max(-peak, low), high), min(max(peak, low), high)
    return (
        slope * near - math.sqrt(max(0.0, reach - curvature * near * near)),
        slope * far + math.sqrt(max(0.0, reach - curvature * far * far)),
    )


@kernel
def _touched_tiles(center, radius, size, count):  # pragma: no cover (compiled)
    """Return the range (first, stop) of tiles along one axis that the square of a Gaussian touches.

    The result equals that of `assign_tiles`.
    """
    low, high = center / size - radius / size, center / size + radius / size
    return math.floor(min(max(low, 0), count)), math.ceil(min(max(high, 0), count))


@kernel
def _shape(g, means2d, conics, opacities, radii, width, height, size, min_alpha, eps):  # pragma: no cover (compiled)
    """Return the ellipse in which alpha can reach min_alpha: `_axis` of x and of y, and half its height.

    The height is negative if there is no such ellipse.
    """
    a, b, c = np.float64(conics[g, 0]), np.float64(conics[g, 1]), np.float64(conics[g, 2])
    if not opacities[g] >= min_alpha:
        empty = (0.0, 0.0, 0.0, 0.0)
        return empty, empty, -1.0
    u, v = np.float64(means2d[g, 0]), np.float64(means2d[g, 1])
    far_x = min(max(abs(u), abs(u - width)), radii[g, 0] + size)
    far_y = min(max(abs(v), abs(v - height)), radii[g, 1] + size)
    margin = _REACH_MARGIN + _ROUNDINGS * eps * (a * far_x * far_x + c * far_y * far_y)
    reach = 2 * (math.log(opacities[g] / np.float64(min_alpha)) + margin)
    if not reach < np.inf:
        reach = np.inf
    across, down = _axis(reach, a, b, c), _axis(reach, c, b, a)
    return across, down, extent(down, -np.inf, np.inf)[1] if down[2] < np.inf else np.inf


@kernel
def _columns(across, half_height, u, v, row, x0, x1, size, width, height):  # pragma: no cover (compiled)
    """Return the range (first, stop) of tile columns with pixel centers that the ellipse reaches in a row of tiles."""
    low, high = row * size + 0.5 - v, min((row + 1) * size, height) - 0.5 - v
    if low > half_height or high < -half_height:
        return 0, 0
    left, right = extent(across, low, high)
    first = math.ceil(min(max(u + left - 0.5, x0 * size), width))
    last = math.floor(max(min(u + right - 0.5, min(x1 * size, width) - 1), -1.0))
    return (first // size, last // size + 1) if first <= last else (0, 0)


@parallel_kernel
def assign(means2d, conics, opacities, radii, width, height, size, min_alpha, threads):  # pragma: no cover (compiled)
    """List, for every tile, the Gaussians that can contribute to one of its pixels.

    Their square touches the tile as in `projection.assign_tiles`, and alpha can reach min_alpha in the tile.

    Returns:
        The offsets and members of `Tiles`, and `_axis` of y of every Gaussian.
    """
    m, columns, rows = len(means2d), (width + size - 1) // size, (height + size - 1) // size
    side, eps = means2d.dtype.type(size), np.finfo(means2d.dtype).eps
    squares, shapes = np.empty((m, 4), np.int32), np.empty((m, 9))
    parts = 4 * threads
    cursor = np.zeros((parts, rows * columns), np.int64)
    for position in numba.prange(parts):
        part = interleaved(position, parts, threads)
        for g in range(part * m // parts, (part + 1) * m // parts):
            across, down, half_height = _shape(
                g, means2d, conics, opacities, radii, width, height, size, min_alpha, eps
            )
            u, v = np.float64(means2d[g, 0]), np.float64(means2d[g, 1])
            x0, x1 = _touched_tiles(means2d[g, 0], radii[g, 0], side, columns)
            y0, y1 = _touched_tiles(means2d[g, 1], radii[g, 1], side, rows)
            y1 = y1 if half_height >= 0 else y0
            squares[g, 0], squares[g, 1], squares[g, 2], squares[g, 3] = x0, x1, y0, y1
            for i in range(4):
                shapes[g, i], shapes[g, 4 + i] = down[i], across[i]
            shapes[g, 8] = half_height
            for row in range(y0, y1):
                first, stop = _columns(across, half_height, u, v, row, x0, x1, size, width, height)
                for column in range(first, stop):
                    cursor[part, row * columns + column] += 1
    offsets, total = np.empty(rows * columns + 1, np.int64), 0
    for tile in range(rows * columns):
        offsets[tile] = total
        for part in range(parts):
            count = cursor[part, tile]
            cursor[part, tile] = total
            total += count
    offsets[rows * columns] = total
    members = np.empty(total, np.int32)
    for position in numba.prange(parts):
        part = interleaved(position, parts, threads)
        for g in range(part * m // parts, (part + 1) * m // parts):
            across = (shapes[g, 4], shapes[g, 5], shapes[g, 6], shapes[g, 7])
            u, v = np.float64(means2d[g, 0]), np.float64(means2d[g, 1])
            x0, x1, y0, y1 = squares[g, 0], squares[g, 1], squares[g, 2], squares[g, 3]
            for row in range(y0, y1):
                first, stop = _columns(across, shapes[g, 8], u, v, row, x0, x1, size, width, height)
                for column in range(first, stop):
                    members[cursor[part, row * columns + column]] = g
                    cursor[part, row * columns + column] += 1
    return offsets, members, shapes
