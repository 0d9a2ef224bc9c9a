"""Superpixels: k-means of CIELAB color and position in the windows of a grid, on a CPU or a GPU.

The clustering is that of SLIC (Achanta et al., SLIC Superpixels Compared to State-of-the-Art Superpixel Methods, 2012),
arranged as products of matrices. The image is divided into cells of equal size, one per superpixel. Each cell has a
center, which starts as the mean of its pixels. A pixel joins the nearest center of its own cell and of the eight cells
around it. For each cell, the distances of its pixels to nine centers are one product of matrices, and the sums of the
pixels that joined each center are another one. Sums thus always have the same order, without atomic additions. Every
second pixel of every second row moves the centers.

Last, small connected pieces become part of the neighbor with which they share the longest boundary.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float32, Int32, Int64, UInt8
from torch import Tensor

COMPACTNESS = 10.0
"""Weight of spatial distance relative to color distance. Larger values produce squarer superpixels."""
_ROUNDS = 5
_SMALLEST = 0.25
"""Number of pixels of the smallest piece that stays a superpixel, relative to that of a cell."""
_FAR = 1e4
"""Coordinates of centers that no pixel joins."""
_AROUND = tuple((y, x) for y in (-1, 0, 1) for x in (-1, 0, 1))
_WHITE = (0.95047, 1.0, 1.08883)
_XYZ = ((0.412453, 0.357580, 0.180423), (0.212671, 0.715160, 0.072169), (0.019334, 0.119193, 0.950227))
"""XYZ of the sRGB primaries, and that of white, for the illuminant D65."""
_LAB = ((0.0, 116.0, 0.0), (500.0, -500.0, 0.0), (0.0, 200.0, -200.0))


def superpixels(image: UInt8[Tensor, "h w 3"], count: int) -> Int32[np.ndarray, "h w"]:
    """Divide an image into connected regions of similar size and color.

    An image always has the same regions on the same device. Those of another device differ by rounding.

    Args:
        image: RGB, 0..255, on the device that computes.
        count: Approximate number of regions, at least 1. An image has at most one per pixel.
    Returns:
        Region of each pixel, 0..R-1, without gaps.
    """
    height, width = image.shape[:2]
    grid = _Grid.of(height, width, count)
    cells = grid.cells(image)
    sample = cells[..., ::2, ::2].flatten(2)
    sums = sample.sum(dim=2).view(grid.rows, grid.columns, 6)
    for _ in range(_ROUNDS):
        sums = grid.sums(sample, grid.nearest(sample, sums))
    nearest = grid.nearest(cells.flatten(2), sums)
    number = torch.arange(len(cells), device=image.device).view(grid.rows, grid.columns, 1)
    joined = _windows(number, 0)[..., 0].gather(1, nearest).view(grid.rows, grid.columns, grid.height, grid.width)
    labels = joined.transpose(1, 2).flatten(2).flatten(0, 1)[:height, :width]
    return _join_fragments(labels.int().cpu().numpy(), _SMALLEST * grid.side**2)


@dataclass(frozen=True)
class _Grid:
    """A grid of cells over an image, the last of which can extend beyond its right and lower borders."""

    rows: int
    columns: int
    height: int
    """Height of a cell in pixels."""
    width: int
    side: float
    """Side of a square of the mean size of a superpixel, the unit of positions."""

    @classmethod
    def of(cls, height: int, width: int, count: int) -> _Grid:
        side = max(1.0, math.sqrt(height * width / count))
        rows, columns = max(1, round(height / side)), max(1, round(width / side))
        return cls(rows, columns, math.ceil(height / rows), math.ceil(width / columns), side)

    def cells(self, image: UInt8[Tensor, "h w 3"]) -> Float32[Tensor, "cells 6 y x"]:
        """Return CIELAB / compactness, position relative to the cell's middle, and 1, or 0 for pixels without color."""
        rows, columns = torch.arange(image.shape[0]), torch.arange(image.shape[1])
        points = torch.zeros(6, self.rows * self.height, self.columns * self.width, device=image.device)
        inside = points[:, : len(rows), : len(columns)]
        inside[:3] = _cielab(image) / COMPACTNESS
        inside[3] = (((rows % self.height) - (self.height - 1) / 2) / self.side)[:, None]
        inside[4] = ((columns % self.width) - (self.width - 1) / 2) / self.side
        inside[5] = 1
        cells = points.view(6, self.rows, self.height, self.columns, self.width)
        return cells.permute(1, 3, 0, 2, 4).flatten(0, 1).contiguous()

    def shifts(self, like: Tensor) -> Float32[Tensor, "9 6"]:
        """Return the position of the nine cells of a window relative to the middle one."""
        size = (self.height / self.side, self.width / self.side)
        return like.new_tensor([(0, 0, 0, y * size[0], x * size[1], 0) for y, x in _AROUND])

    def nearest(
        self, points: Float32[Tensor, "cells 6 p"], sums: Float32[Tensor, "rows columns 6"]
    ) -> Int64[Tensor, "cells p"]:
        """Return the number in its window, 0..8, of the center that is nearest to each point."""
        centers = torch.where(sums[..., 5:] > 0, sums / sums[..., 5:].clamp(min=1), _FAR)
        around = (_windows(centers, _FAR) + self.shifts(points))[..., :5]
        lengths = around.square().sum(dim=2, keepdim=True)
        return torch.bmm(torch.cat([2 * around, -lengths], dim=2), points).max(dim=1).indices  # argmax is slower

    def sums(
        self, points: Float32[Tensor, "cells 6 p"], nearest: Int64[Tensor, "cells p"]
    ) -> Float32[Tensor, "rows columns 6"]:
        """Return the sum of the points that joined each center, with positions relative to its own cell."""
        joined = (nearest[:, None] == torch.arange(9, device=nearest.device)[:, None]).float()
        parts = torch.bmm(joined, points.transpose(1, 2))
        parts = (parts - self.shifts(points) * parts[..., 5:]).view(self.rows, self.columns, 9, 6)
        sums = parts.new_zeros(self.rows + 2, self.columns + 2, 6)
        for part, (y, x) in zip(parts.unbind(dim=2), _AROUND):
            sums[1 + y : 1 + y + self.rows, 1 + x : 1 + x + self.columns] += part
        return sums[1:-1, 1:-1]


def _windows(values: Tensor, outside: float) -> Tensor:
    """Return the values [rows, columns, C] of each cell and of its neighbors, [cells, 9, C]."""
    rows, columns = values.shape[:2]
    padded = torch.nn.functional.pad(values, (0, 0, 1, 1, 1, 1), value=outside)
    return torch.stack([padded[1 + y :, 1 + x :][:rows, :columns] for y, x in _AROUND], dim=2).flatten(0, 1)


def _cielab(image: UInt8[Tensor, "h w 3"]) -> Float32[Tensor, "3 h w"]:
    """Convert sRGB to CIELAB with the illuminant D65."""
    level = torch.arange(256, dtype=torch.float64) / 255
    linear = torch.where(level > 0.04045, ((level + 0.055) / 1.055) ** 2.4, level / 12.92).float().to(image.device)
    primaries = (torch.tensor(_XYZ).T / torch.tensor(_WHITE)).T.to(image.device)
    xyz = primaries @ linear[image.permute(2, 0, 1).flatten(1).int()]
    root = torch.where(xyz > 0.008856, xyz.clamp(min=0.008856).pow_(1 / 3), 7.787 * xyz + 16 / 116)
    lab = torch.tensor(_LAB, device=image.device) @ root
    lab[0] -= 16
    return lab.view(3, *image.shape[:2])


def _join_fragments(labels: Int32[np.ndarray, "h w"], smallest: float) -> Int32[np.ndarray, "h w"]:
    """Number the connected pieces of the labels, and add small ones to a neighbor.

    Args:
        labels: Any labels. Two pieces with the same label become two regions.
        smallest: Number of pixels below which a piece joins the neighbor with which it shares the longest boundary. A
            piece that has only small neighbors joins one of them, once these have joined a larger one.
    """
    pieces, count = _connected_pieces(labels)
    size = np.bincount(pieces.ravel())
    region = np.where(size >= min(smallest, size.max()), np.arange(count), -1)
    first, second = _boundaries(pieces, region[pieces] < 0)
    pair, length = np.unique(first.astype(np.int64) * count + second, return_counts=True)
    piece, neighbor = np.divmod(pair, count)
    order = np.lexsort((-length, piece))
    piece, neighbor = piece[order], neighbor[order]
    while len(piece) > 0:
        ready = region[neighbor] >= 0
        joining, longest = np.unique(piece[ready], return_index=True)
        region[joining] = region[neighbor[ready][longest]]
        waiting = region[piece] < 0
        piece, neighbor = piece[waiting], neighbor[waiting]
    return np.unique(region, return_inverse=True)[1].astype(np.int32)[pieces]


def _connected_pieces(labels: Int32[np.ndarray, "h w"]) -> tuple[Int32[np.ndarray, "h w"], int]:
    """Return the piece of each pixel, and the number of pieces. Pixels connect to equal ones on their four sides."""
    height, width = labels.shape
    links = np.zeros((2 * height - 1, 2 * width - 1), dtype=np.uint8)  # pixels at even places, links between them
    links[::2, ::2] = 1
    links[::2, 1::2] = labels[:, 1:] == labels[:, :-1]
    links[1::2, ::2] = labels[1:] == labels[:-1]
    count, pieces = cv2.connectedComponents(links, connectivity=4, ltype=cv2.CV_32S)
    return pieces[::2, ::2] - 1, count - 1


def _boundaries(
    pieces: Int32[np.ndarray, "h w"], small: Bool[np.ndarray, "h w"]
) -> tuple[Int32[np.ndarray, " n"], Int32[np.ndarray, " n"]]:
    """Return the pieces of each pixel of a small piece and of its neighbor in another piece."""
    found = []
    for one, other, at in (
        (pieces[:, 1:], pieces[:, :-1], small[:, 1:]),
        (pieces[:, :-1], pieces[:, 1:], small[:, :-1]),
        (pieces[1:], pieces[:-1], small[1:]),
        (pieces[:-1], pieces[1:], small[:-1]),
    ):
        boundary = at & (one != other)
        found.append((one[boundary], other[boundary]))
    first, second = (np.concatenate(part) for part in zip(*found))
    return first, second
