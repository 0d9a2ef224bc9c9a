"""SLIC superpixels with the labels of scikit-image, compiled with numba.

The algorithm is k-means on CIELAB color and position, where a segment competes only for pixels near its center (Achanta
et al., "SLIC Superpixels Compared to State-of-the-Art Superpixel Methods", PAMI 2012). Segments that are not connected
are split, and small parts join a neighbor. All sums are in float64 in the order of scikit-image's `slic`, so the labels
are the same. Rows of pixels are compared without branches, so the compiler uses vector instructions.
"""

from __future__ import annotations

import math

import numpy as np
from jaxtyping import Int32, UInt8

from normlift_ns.core.compilation import cached_njit

_kernel = cached_njit(nogil=True)
"""Decorator of kernels that run in several threads at a time."""
_ITERATIONS = 10
_REACH = 2
"""Half the side of the square in which a segment competes for pixels, in steps of a grid of the segments."""
_LEAST, _MOST = 0.5, 3.0
"""Smallest and largest size of a segment, relative to the mean size."""


def slic(image: UInt8[np.ndarray, "h w 3"], count: int, compactness: float) -> Int32[np.ndarray, "h w"]:
    """Return the superpixel of every pixel, as `skimage.segmentation.slic` does with `start_label=0`.

    Args:
        count: Approximate number of superpixels.
        compactness: Weight of distance relative to color.
    """
    from skimage.color import rgb2lab  # noqa: PLC0415 (takes 0.5 s; other regions do not need it)
    from skimage.util import img_as_float, regular_grid  # noqa: PLC0415 (as above)

    height, width = image.shape[:2]
    pixels = img_as_float(image)
    pixels -= pixels.min()
    if pixels.max() > 0:
        pixels /= pixels.max()
    lab = np.ascontiguousarray((rgb2lab(pixels) * (1.0 / compactness)).transpose(2, 0, 1))
    grid = regular_grid((1, height, width), count)
    places = np.mgrid[:height, :width][:, grid[1], grid[2]].reshape(2, -1).T
    centers = np.concatenate([places, np.zeros((len(places), 3))], axis=1)
    step, windows = max(_steps(grid)), _steps(regular_grid((1, height, width), len(centers)))
    nearest = np.zeros((height, width), np.int32)
    _assign(lab, centers, windows[1], windows[2], 1.0 / step**2, nearest)
    size = height * width / len(centers)
    labels = np.full((height, width), -1, np.int32)
    _connect(nearest, int(_LEAST * size), int(_MOST * size), labels)
    return labels


def compile_kernels() -> None:
    """Load the kernels of `slic`, and compile those that are not in a cache."""
    slic(np.zeros((2, 2, 3), np.uint8), 1, 1.0)


def _steps(grid: tuple[slice, ...]) -> list[int]:
    return [1 if axis.step is None else int(axis.step) for axis in grid]


@_kernel
def _assign(lab, centers, step_y, step_x, spatial_weight, nearest):  # pragma: no cover (compiled)
    """Write the segment of every pixel, and update the centers [y, x, L, a, b], by k-means."""
    height, width = nearest.shape
    distance, counts = np.empty((height, width)), np.empty(len(centers), np.int64)
    columns = np.arange(width).astype(np.float64)
    for _ in range(_ITERATIONS):
        changed = 0
        distance[:] = np.finfo(np.float64).max
        for k in range(len(centers)):
            cy, cx, light, a, b = centers[k, 0], centers[k, 1], centers[k, 2], centers[k, 3], centers[k, 4]
            if math.isnan(cy):  # an empty segment
                continue
            top, bottom = int(max(cy - _REACH * step_y, 0.0)), int(min(cy + _REACH * step_y + 1, float(height)))
            left, right = int(max(cx - _REACH * step_x, 0.0)), int(min(cx + _REACH * step_x + 1, float(width)))
            across = (cx - columns[left:right]) ** 2
            for y in range(top, bottom):
                dy = (cy - y) ** 2
                best, owner = distance[y, left:right], nearest[y, left:right]
                lights, reds, yellows = lab[0, y, left:right], lab[1, y, left:right], lab[2, y, left:right]
                for i in range(right - left):
                    color = (lights[i] - light) ** 2 + (reds[i] - a) ** 2 + (yellows[i] - b) ** 2
                    value = (dy + across[i]) * spatial_weight + color
                    nearer = best[i] > value
                    owner[i] = k if nearer else owner[i]
                    best[i] = value if nearer else best[i]
                    changed += nearer
        if changed == 0:
            break
        counts[:] = 0
        centers[:] = 0
        for y in range(height):
            for x in range(width):
                k = nearest[y, x]
                counts[k] += 1
                centers[k, 0] += y
                centers[k, 1] += x
                for channel in range(3):
                    centers[k, 2 + channel] += lab[channel, y, x]
        for k in range(len(centers)):
            for i in range(5):
                centers[k, i] /= counts[k]


@_kernel
def _connect(nearest, least, most, labels):  # pragma: no cover (compiled)
    """Write labels of connected segments. Parts of fewer than `least` pixels join a neighbor; none exceed `most`."""
    height, width = nearest.shape
    steps_y, steps_x = (0, 0, 1, -1), (1, -1, 0, 0)
    queue = np.empty((most, 2), np.int32)
    number = 0
    for y in range(height):
        for x in range(width):
            if labels[y, x] >= 0:
                continue
            neighbor, segment = 0, nearest[y, x]
            labels[y, x] = number
            queue[0, 0], queue[0, 1] = y, x
            size, visited = 1, 0
            while visited < size < most:
                for i in range(4):
                    v, u = queue[visited, 0] + steps_y[i], queue[visited, 1] + steps_x[i]
                    if not (0 <= v < height and 0 <= u < width):
                        continue
                    if nearest[v, u] == segment and labels[v, u] < 0:
                        labels[v, u] = number
                        queue[size, 0], queue[size, 1] = v, u
                        size += 1
                        if size >= most:
                            break
                    elif labels[v, u] >= 0 and labels[v, u] != number:
                        neighbor = labels[v, u]
                visited += 1
            if size < least:
                for i in range(size):
                    labels[queue[i, 0], queue[i, 1]] = neighbor
            else:
                number += 1
