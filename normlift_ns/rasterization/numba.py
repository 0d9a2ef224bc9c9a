"""Compiled CPU backend, which computes the same sums as the torch backend on all cores.

numba caches a compiled kernel until this file changes.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from threading import Thread
from typing import Any

import numba
import numpy as np
import torch
from jaxtyping import Float
from numba import types
from numba.extending import overload
from torch import Tensor

from normlift_ns.core.evidence import UNLABELED, Entries
from normlift_ns.core.gaussians import Camera
from normlift_ns.errors import InputError
from normlift_ns.options import option_setting
from normlift_ns.rasterization.projection import AnyProjected, ProjectedGaussians2D
from normlift_ns.rasterization.rasterize import RasterBatch, RasterJob
from normlift_ns.rasterization.settings import RasterSettings

_Triple = tuple[Any, Any, Any]


def check(job: RasterJob) -> None:
    """Raise ValueError if the scene is not on the CPU."""
    device = job.scene.means.device
    if device.type != "cpu":
        raise InputError(
            f'backend "numba" needs a scene on the CPU, got {device}; move the scene, or use '
            f"{option_setting('backend', 'auto')}"
        )


def in_flight(job: RasterJob, camera: Camera) -> int:
    """Return 1, because the kernels distribute one view over all cores."""
    return 1


def views_evidence(job: RasterJob, batch: RasterBatch) -> Entries:
    """Return the entries of one view, which are bitwise the same on every run."""
    (camera,), (labels,), (count,) = batch
    projected = job.project(camera)
    arrays, limits, (offsets, members, shapes) = _tiles(projected, camera, job.settings)
    size, label_map = job.settings.tile_size, labels.int().numpy()
    capacity = np.diff(offsets) * count_labels(label_map, size)
    first_slot, used = np.cumsum(capacity) - capacity, np.zeros(len(capacity), np.int64)
    slots = tuple(
        np.empty(capacity.sum(), dtype) for dtype in (np.int32, np.int32, np.float64)
    )  # memory pages are allocated when they are written
    sum_tiles(
        *(offsets, members, *arrays, shapes, projected.gaussian.numpy(), label_map),
        *(job.weight_power, size, limits, first_slot, used, slots, numba.get_num_threads()),
    )
    merged = merge_slots(first_slot, used, slots, len(job.scene), count + 1)
    gaussian, column, weight = map(torch.from_numpy, merged)
    return Entries(gaussian, column, weight.to(job.dtype), (count,))


def composite(
    job: RasterJob, camera: Camera, values: Float[Tensor, "n c"]
) -> tuple[Float[Tensor, "h w c"], Float[Tensor, "h w"]]:
    """Return sum_j A_ij values_j and sum_j A_ij of every pixel."""
    projected = job.project(camera)
    arrays, limits, (offsets, members, shapes) = _tiles(projected, camera, job.settings)
    visible_values = values[projected.gaussian].to(job.dtype).contiguous().numpy()
    image = np.zeros((camera.height, camera.width, values.shape[1]), visible_values.dtype)
    alpha = np.zeros((camera.height, camera.width), visible_values.dtype)
    composite_tiles(
        *(offsets, members, *arrays, shapes, visible_values, image, alpha),
        *(job.settings.tile_size, limits, numba.get_num_threads()),
    )
    return torch.from_numpy(image), torch.from_numpy(alpha)


def _tiles(projected: AnyProjected, camera: Camera, settings: RasterSettings) -> tuple[_Triple, _Triple, _Triple]:
    """Return the input of the kernels in three groups.

    The first group has the means, the conics or transforms, and the opacities. The second group has the limits of alpha
    and transmittance. The third group has the offsets and members of the tiles, and the shapes of the Gaussians.
    """
    is_2d = isinstance(projected, ProjectedGaussians2D)
    kinds = projected.transforms.flatten(1) if is_2d else projected.conics
    means, conics, opacities = (x.contiguous().numpy() for x in (projected.means2d, kinds, projected.opacities))
    number = means.dtype.type
    max_alpha, min_alpha, min_transmittance = settings.max_alpha, settings.min_alpha, settings.min_transmittance
    ellipses = _bounding_ellipses(projected, settings.min_alpha).numpy() if is_2d else conics
    sizes = (camera.width, camera.height, settings.tile_size)
    tile_lists = list_tiles(
        means,
        ellipses,
        opacities,
        projected.radii.contiguous().numpy(),
        *sizes,
        number(min_alpha),
        numba.get_num_threads(),
    )
    return (means, conics, opacities), (number(max_alpha), number(min_alpha), number(min_transmittance)), tile_lists


_STRETCH = 0.1
"""Fraction by which a covariance is enlarged, because the bounding and the projected ellipse have different centers."""


def _bounding_ellipses(projected: ProjectedGaussians2D, min_alpha: float) -> Float[Tensor, "m 3"]:
    """Return ellipses around `means2d` that contain every pixel with alpha >= min_alpha, as conics in 1 / pixels^2.

    Let r ** 2 = 2 log(opacity / min_alpha). Such a pixel lies in the projected ellipse of r standard deviations or in a
    disc with a radius of r / sqrt(2) pixels. The returned ellipse with conic C contains the offsets x with
    x^T C x <= r ** 2. A conic is zero if the projection is not an ellipse.
    """
    transforms, means = projected.transforms.double(), projected.means2d.double()
    square = (2 * (projected.opacities.double() / min_alpha).log()).clamp(min=0)
    dual = transforms * torch.stack([square, square, -torch.ones_like(square)], 1)[:, None] @ transforms.mT
    dual = dual / dual[:, 2:, 2:]
    bounded = (transforms[:, 2, :2].square().sum(1) * square < transforms[:, 2, 2].square())[:, None]
    center = dual[:, :2, 2]
    shift = (center - means)[:, :, None]
    covariance = (1 + _STRETCH) * (center[:, :, None] * center[:, None] - dual[:, :2, :2])
    covariance = covariance + (1 + 1 / _STRETCH) * shift * shift.mT + 0.5 * square[:, None, None] * torch.eye(2)
    (xx, xy), (_, yy) = (row.unbind(1) for row in covariance.unbind(1))
    conics = (square / (xx * yy - xy * xy))[:, None] * torch.stack([yy, -xy, xx], 1)
    return torch.where(bounded & conics.isfinite().all(1, keepdim=True), conics, 0.0).to(projected.means2d.dtype)


def compile_kernels(*dtypes: torch.dtype) -> Thread:
    """Load the kernels for some precisions in a background thread, and compile those that are not in a cache.

    Callers do not have to wait for the thread. A call to a kernel waits only until this kernel is compiled.
    """

    def work() -> None:
        for dtype in dtypes:
            for kernel, signature in kernel_signatures(dtype):
                kernel.compile(signature)

    thread = Thread(target=work, name="warm numba", daemon=True)
    thread.start()
    return thread


def kernel_signatures(dtype: torch.dtype) -> list[tuple[Any, Any]]:
    """Return (kernel, types of its arguments) for every kernel of this backend, beginning with those for rendering."""
    number = numba.float64 if dtype == torch.float64 else numba.float32
    integer, integers, numbers, table = numba.int64, numba.int64[::1], number[::1], number[:, ::1]
    labels, members, limits = numba.int32[:, ::1], numba.int32[::1], numba.types.UniTuple(number, 3)
    slots = numba.types.Tuple((numba.int32[::1], numba.int32[::1], numba.float64[::1]))
    tile_lists = (integers, members, table, table, numbers, numba.float64[:, ::1])
    image = number[:, :, ::1]
    return [
        (list_tiles, (table, table, numbers, table, integer, integer, integer, number, integer)),
        (composite_tiles, (*tile_lists, table, image, table, integer, limits, integer)),
        (count_labels, (labels, integer)),
        (
            sum_tiles,
            (*tile_lists, integers, labels, integer, integer, limits, integers, integers, slots, integer),
        ),
        (merge_slots, (integers, integers, slots, integer, integer)),
    ]


# Kernels, compiled with numba.


_F = np.float32
_MAGIC32, _MAGIC64 = _F(1.5 * 2**23), 1.5 * 2**52
"""Constants that round a small number to an integer when added to it. The last bits of the sum are this integer."""
_LOG2_E32, _LN2_HIGH32, _LN2_LOW32, _LEAST32 = _F(1.44269504088896341), _F(0.693359375), _F(-2.12194440e-4), _F(-87)
_LOG2_E64, _LN2_HIGH64, _LN2_LOW64 = 1.44269504088896341, 6.93147180369123816490e-01, 1.90821492927058770002e-10
_P0, _P1, _P2 = _F(1.9875691500e-4), _F(1.3981999507e-3), _F(8.3334519073e-3)
_P3, _P4, _P5, _ONE = _F(4.1665795894e-2), _F(1.6666665459e-1), _F(5.0000001201e-1), _F(1)


def cached_njit(**options: Any) -> Callable[[Callable[..., Any]], Any]:
    """Return a decorator like `numba.njit`, with a cache on disk if a cache folder is writable."""

    def decorate(function: Callable[..., Any]) -> Any:
        try:
            return numba.njit(cache=True, error_model="numpy", **options)(function)
        except RuntimeError:  # numba cannot write to this folder or the user's cache folder
            return numba.njit(error_model="numpy", **options)(function)

    return decorate


kernel = cached_njit()
fused_kernel = cached_njit(fastmath={"contract"})
"""Decorator that allows fused multiply-add, with a single rounding as on a GPU."""
parallel_kernel = cached_njit(parallel=True)


def exp(x: float) -> float:
    """Return e ** x for x <= 0 in the precision of x. The absolute error is below 1e-7 (float32) or 4e-16 (float64).

    Results are clamped from below to e ** -87 (float32) or e ** -700 (float64).
    """
    return math.exp(x)


@overload(exp, jit_options={"error_model": "numpy", "fastmath": {"contract"}})
def _compiled_exp(x):  # pragma: no cover (compiled)
    """Return a function for e ** x = 2 ** n e ** r, |r| <= ln(2) / 2, by the Cephes polynomial or a Taylor series."""

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
def interleaved_index(position, count, threads):  # pragma: no cover (compiled)
    """Return the work item at a position of a static schedule in which each of n threads gets every n-th item.

    The caller must skip items that are not below `count`.
    """
    per_thread = (count + threads - 1) // threads
    return position % per_thread * threads + position // per_thread


# Compiled tile lists of the CPU rasterizer, with the Gaussians that can contribute to each tile.


_REACH_MARGIN = 1e-2
"""Margin added to the exponent at which alpha falls below min_alpha, so that rounding does not drop pixels."""
_ROUNDINGS = 4
"""Bound on the rounding error of an exponent, in units of machine epsilon times (a dx^2 + c dy^2)."""


@kernel
def _axis(reach, own, mixed, other):  # pragma: no cover (compiled)
    """Return the parameters for `ellipse_extent`. The ellipse is own s^2 + 2 mixed s t + other t^2 <= reach.

    The extent is infinite if `reach` is infinite or rounding makes the ellipse degenerate.
    """
    det = own * other - mixed * mixed
    if own > 0 and other > 0 and det > 0 and reach < np.inf:
        peak = -mixed * math.sqrt(reach / (other * det))
        if abs(peak) < np.inf:
            return peak, -mixed / own, reach / own, det / (own * own)
    return 0.0, 0.0, np.inf, 0.0


@kernel
def ellipse_extent(axis, low, high):  # pragma: no cover (compiled)
    """Return the smallest and largest s of the ellipse for low <= t <= high."""
    peak, slope, reach, curvature = axis
    near, far = min(max(-peak, low), high), min(max(peak, low), high)
    return (
        slope * near - math.sqrt(max(0.0, reach - curvature * near * near)),
        slope * far + math.sqrt(max(0.0, reach - curvature * far * far)),
    )


@kernel
def _touched_tiles(center, radius, size, count):  # pragma: no cover (compiled)
    """Return the range (first, stop) of tiles along one axis that the rectangle of a Gaussian touches.

    The result is the same as in `assign_tiles`.
    """
    low, high = center / size - radius / size, center / size + radius / size
    return math.floor(min(max(low, 0), count)), math.ceil(min(max(high, 0), count))


@kernel
def _shape(g, means2d, conics, opacities, radii, width, height, size, min_alpha, eps):  # pragma: no cover (compiled)
    """Return the ellipse in which alpha can reach min_alpha, as `_axis` of x, `_axis` of y and half of its height.

    The height is negative if alpha is below min_alpha everywhere.
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
    return across, down, ellipse_extent(down, -np.inf, np.inf)[1] if down[2] < np.inf else np.inf


@kernel
def _columns(across, half_height, u, v, row, x0, x1, size, width, height):  # pragma: no cover (compiled)
    """Return the range (first, stop) of tile columns in which the ellipse covers pixel centers of a row of tiles."""
    low, high = row * size + 0.5 - v, min((row + 1) * size, height) - 0.5 - v
    if low > half_height or high < -half_height:
        return 0, 0
    left, right = ellipse_extent(across, low, high)
    first = math.ceil(min(max(u + left - 0.5, x0 * size), width))
    last = math.floor(max(min(u + right - 0.5, min(x1 * size, width) - 1), -1.0))
    return (first // size, last // size + 1) if first <= last else (0, 0)


@parallel_kernel
def list_tiles(
    means2d, conics, opacities, radii, width, height, size, min_alpha, threads
):  # pragma: no cover (compiled)
    """Return lists of the Gaussians that can contribute to pixels of each tile.

    The rectangle of each Gaussian in a list touches the tile as in `projection.assign_tiles`, and its alpha can reach
    min_alpha in the tile.

    Returns:
        The offsets and indices of `projection.TileLists`, and nine values of `_shape` for every Gaussian.
    """
    m, columns, rows = len(means2d), (width + size - 1) // size, (height + size - 1) // size
    side, eps = means2d.dtype.type(size), np.finfo(means2d.dtype).eps
    squares, shapes = np.empty((m, 4), np.int32), np.empty((m, 9))
    parts = 4 * threads
    cursor = np.zeros((parts, rows * columns), np.int64)
    for position in numba.prange(parts):
        part = interleaved_index(position, parts, threads)
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
        part = interleaved_index(position, parts, threads)
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


# Compiled compositing of the CPU rasterizer, tile by tile, and its sums by (Gaussian, region).
#
# The rows of a tile are processed LANES pixels at a time without branches, so the compiler uses vector instructions.
# Every thread writes to its own memory. Locks are not needed, and the sums do not depend on the run or the number of
# threads.


LANES = 16
_MANY_LABELS = 4
"""Number of labels in a tile above which sums are computed pixel by pixel."""
_FEW_LABELS = 32
"""Largest number of labels of a Gaussian that are sorted on insertion."""


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
    """Write the smallest and largest label number of each row of a tile to `ranges`."""
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
    """Return the number of distinct labels in every tile."""
    height, width = labels.shape
    counts = np.empty(((height + size - 1) // size) * ((width + size - 1) // size), np.int64)
    for tile in numba.prange(counts.size):
        box = _tile_box(tile, height, width, size)
        local = np.empty((size, (size + LANES - 1) // LANES, LANES), np.int32)
        counts[tile] = _tile_labels(labels, box, local, np.empty(size * size, np.int32))
    return counts


@kernel
def _reset_transmittance(box, transmittance):  # pragma: no cover (compiled)
    """Set the transmittance of the pixels of a tile to 1 in the image, and to 0 outside it."""
    top, left, bottom, right = box
    transmittance[:] = 0
    for y in range(bottom - top):
        for x in range(right - left):
            transmittance[y, x // LANES, x % LANES] = 1


@kernel
def _first_active(pixels, index):  # pragma: no cover (compiled)
    """Return the first index from `index` on with a transmittance > 0, or the number of pixels if there is none."""
    while index < pixels.size and not pixels[index] > 0:
        index += 1
    return index


@fused_kernel
def _rows(g, box, means2d, shapes):  # pragma: no cover (compiled)
    """Return the range (first, stop) of rows of a tile that a Gaussian may reach."""
    top, left, bottom, right = box
    u, v = means2d[g, 0], means2d[g, 1]
    down = (shapes[g, 0], shapes[g, 1], shapes[g, 2], shapes[g, 3])
    above, below = ellipse_extent(down, left + 0.5 - u, right - 0.5 - u)
    first = math.ceil(min(max(v + above - 0.5 - top, 0.0), bottom - top))
    stop = math.floor(min(max(v + below - 0.5 - top, -1.0), bottom - top - 1)) + 1
    return first, stop


@fused_kernel
def _blend_2d(
    g, box, means2d, transforms, opacities, shapes, transmittance, weights, limits
):  # pragma: no cover (compiled)
    """Composite one 2D Gaussian over a tile; see `_blend`."""
    top, left, _, _ = box
    max_alpha, min_alpha, min_transmittance = limits
    u, v, opacity = means2d[g, 0], means2d[g, 1], opacities[g]
    u0, u1, u2 = transforms[g, 0], transforms[g, 1], transforms[g, 2]
    v0, v1, v2 = transforms[g, 3], transforms[g, 4], transforms[g, 5]
    w0, w1, w2 = transforms[g, 6], transforms[g, 7], transforms[g, 8]
    number = means2d.dtype.type
    half, one, zero = number(0.5), number(1), number(0)
    first, stop = _rows(g, box, means2d, shapes)
    for row in range(first, stop):
        y = number(top + row) + half
        b0, b1, b2 = y * w0 - v0, y * w1 - v1, y * w2 - v2
        dy = v - y
        for chunk in range(transmittance.shape[1]):
            left_x = number(left + chunk * LANES) + half
            for lane in range(LANES):
                before = transmittance[row, chunk, lane]
                x = left_x + number(lane)
                a0, a1, a2 = x * w0 - u0, x * w1 - u1, x * w2 - u2
                c = a0 * b1 - a1 * b0
                meets = c != zero
                inverse = one / (c if meets else one)
                a, b = (a1 * b2 - a2 * b1) * inverse, (a2 * b0 - a0 * b2) * inverse
                dx = u - x
                in_plane, in_image = half * (a * a + b * b), dx * dx + dy * dy
                sigma = in_plane if in_plane < in_image else in_image
                alpha = opacity * exp(-sigma)
                alpha = alpha if alpha < max_alpha else max_alpha
                after = before * (one - alpha)
                drawn = (before > zero) & meets & (alpha >= min_alpha)
                continues = after > min_transmittance
                weights[row, chunk, lane] = alpha * before if drawn & continues else zero
                transmittance[row, chunk, lane] = (after if continues else -before) if drawn else before
    return first, stop


@fused_kernel
def _blend(g, box, means2d, conics, opacities, shapes, transmittance, weights, limits):  # pragma: no cover (compiled)
    """Composite one Gaussian over a tile. Write A_ij, or 0 if it is not drawn, to weights[row, chunk, lane].

    The transmittance of a pixel that has stopped is stored with a minus sign. Nine numbers in place of a conic are the
    transform of a 2D Gaussian.

    Returns:
        The range (first, stop) of rows that the Gaussian may reach. Other rows are not written.
    """
    if conics.shape[1] == 9:
        return _blend_2d(g, box, means2d, conics, opacities, shapes, transmittance, weights, limits)
    top, left, _, _ = box
    max_alpha, min_alpha, min_transmittance = limits
    u, v, opacity = means2d[g, 0], means2d[g, 1], opacities[g]
    a, b, c = conics[g, 0], conics[g, 1], conics[g, 2]
    number = means2d.dtype.type
    half, one, zero = number(0.5), number(1), number(0)
    half_a, half_c = half * a, half * c
    first, stop = _rows(g, box, means2d, shapes)
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
    """Return the smallest label number in rows first..stop - 1 of a tile, and the largest one plus 1."""
    least, greatest = ranges[first, 0], ranges[first, 1]
    for row in range(first + 1, stop):
        least, greatest = min(least, ranges[row, 0]), max(greatest, ranges[row, 1])
    return least, greatest + 1


@kernel
def _sum_by_lane(weights, local, number, first, stop, power, lanes):  # pragma: no cover (compiled)
    """Sum A_ij ** power over the pixels of label `number` in rows first..stop - 1. `lanes` is a buffer of zeros."""
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
    """Add A_ij ** power of each pixel in rows first..stop - 1 to the sum of its label, sums[number]."""
    for row in range(first, stop):
        for chunk in range(weights.shape[1]):
            for lane in range(LANES):
                weight = np.float64(weights[row, chunk, lane])
                if weight > 0:
                    sums[local[row, chunk, lane]] += weight if power == 1 else weight**power


@parallel_kernel
def sum_tiles(  # pragma: no cover (compiled)
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
    """Write one slot (Gaussian, label, sum of A_ij ** power) per tile, Gaussian and label >= -1 with a positive sum.

    The slots of a tile start at first_slot[tile], and their number is written to used[tile].
    """
    slot_gaussian, slot_label, slot_weight = slots
    tiles, wide = offsets.size - 1, (size + LANES - 1) // LANES
    for position in numba.prange((tiles + threads - 1) // threads * threads):
        tile = interleaved_index(position, tiles, threads)
        if tile >= tiles or offsets[tile] == offsets[tile + 1]:
            continue
        local, ranges = np.zeros((size, wide, LANES), np.int32), np.empty((size, 2), np.int32)
        distinct = np.empty(size * size, np.int32)
        transmittance = np.empty((size, wide, LANES), means2d.dtype)
        weights = np.empty_like(transmittance)
        box = _tile_box(tile, labels.shape[0], labels.shape[1], size)
        count = _tile_labels(labels, box, local, distinct)
        _label_ranges(local, box, ranges)
        _reset_transmittance(box, transmittance)
        sums, lanes = np.zeros(count), np.zeros(LANES)
        many = count > _MANY_LABELS  # the same for all Gaussians of a tile, so sums do not depend on their rows
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
def merge_slots(first_slot, used, slots, num_gaussians, num_columns):  # pragma: no cover (compiled)
    """Sort slots by (Gaussian, label + 1), and add up the weights of equal pairs in the order of the tiles.

    A counting sort orders slots by Gaussian. The labels of each Gaussian are summed in a dense row and then sorted.
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
def composite_tiles(  # pragma: no cover (compiled)
    offsets, members, means2d, conics, opacities, shapes, values, image, alpha, size, limits, threads
):
    """Compute image[y, x] = sum of A_ij values[j] and alpha[y, x] = sum of A_ij."""
    tiles, wide = offsets.size - 1, (size + LANES - 1) // LANES
    for position in numba.prange((tiles + threads - 1) // threads * threads):
        tile = interleaved_index(position, tiles, threads)
        if tile >= tiles:
            continue
        transmittance = np.empty((size, wide, LANES), means2d.dtype)
        weights = np.empty_like(transmittance)
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
