"""Removal of small holes and pieces, for all masks at once and on their device.

A mask is represented by its edges: the positions, row by row, where it changes, including at the borders of the image.
Each row has an even number of edges. The first two enclose a run of pixels, the third and fourth the next run. Pixels
are read once, to find the edges, and written only where they change. Components are those of a graph of runs.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Int64
from torch import Tensor

_CHUNK = {"cuda": 2**29, "cpu": 2**25}
"""Pixels per chunk."""


def clean_masks(masks: Bool[Tensor, "m h w"], least: int) -> tuple[Bool[Tensor, "m h w"], Bool[Tensor, " m"]]:
    """Fill holes, then drop pieces, of fewer than `least` pixels, 8-connected; the largest piece is always kept.

    An area between a mask and the border of the image is also a hole.

    Returns:
        The cleaned masks, and a flag for each mask that had such holes or pieces.
    """
    cleaned = masks.clone(memory_format=torch.contiguous_format)
    changed = torch.zeros(len(masks), dtype=torch.bool, device=masks.device)
    step = max(1, _CHUNK[masks.device.type] // masks[0].numel()) if len(masks) > 0 else 1
    for part, flags in zip(cleaned.split(step), changed.split(step)):
        grid = _Grid(*part.shape)
        edges = grid.edges(part)
        holes = _runs(_symmetric_difference(edges, *grid.row_bounds(edges, least)), grid, least)
        holes = holes.at(holes.area < least)
        pieces = _runs(_symmetric_difference(edges, holes.start, holes.stop), grid, least)
        small = pieces.area < least
        for runs in (holes, pieces.at(small)):
            flags[runs.start // grid.size] = True
        grid.paint(part, holes, True)
        grid.paint(part, pieces.at(small & ~_in_largest(pieces, grid)), False)
    return cleaned, changed


class _Runs(NamedTuple):
    """Runs of neighboring pixels in a row, in ascending order."""

    start: Int64[Tensor, " n"]
    stop: Int64[Tensor, " n"]
    """First position after the run."""
    piece: Int64[Tensor, " n"]
    """Number of the component; large components may share a number."""
    area: Int64[Tensor, " n"]
    """Pixels of the component if it is small, else a number that is not small."""

    def at(self, index: Tensor) -> _Runs:
        return _Runs(*(value[index] for value in self))


class _Grid(NamedTuple):
    """Numbering of pixel positions in all masks.

    Rows are wider than the image, so no row begins where another one ends. An empty row follows each mask.
    """

    masks: int
    height: int
    width: int

    @property
    def row(self) -> int:
        """Positions per row, a multiple of eight."""
        return 8 * (self.width // 8 + 1)

    @property
    def size(self) -> int:
        """Positions per mask."""
        return (self.height + 1) * self.row

    def edges(self, masks: Bool[Tensor, "m h w"]) -> Int64[Tensor, " e"]:
        """Return the edges of masks."""
        changes = masks.new_zeros(self.masks, self.height + 1, self.row)
        inside = changes[:, :-1]
        inside[:, :, 0], inside[:, :, self.width] = masks[:, :, 0], masks[:, :, -1]
        torch.ne(masks[:, :, 1:], masks[:, :, :-1], out=inside[:, :, 1 : self.width])
        word = changes.view(torch.int64).flatten().nonzero()[:, 0]  # eight positions at a time
        index, offset = changes.view(-1, 8)[word].nonzero(as_tuple=True)
        return 8 * word[index] + offset

    def row_bounds(self, edges: Int64[Tensor, " e"], least: int) -> tuple[Int64[Tensor, " k"], Int64[Tensor, " k"]]:
        """Return the first position of rows, and the position after their last pixel.

        A whole row of at least `least` pixels is large by itself. In this case, only rows with edges and their
        neighbors above and below are returned, else all rows.
        """
        near = torch.full((self.masks, self.height + 1), self.width < least, device=edges.device)
        near.view(-1)[edges // self.row] = True
        near[:, :-1] |= near[:, 1:].clone()
        near[:, 1:] |= near[:, :-1].clone()
        near[:, self.height] = False
        first = near.view(-1).nonzero()[:, 0] * self.row
        return first, first + self.width

    def paint(self, masks: Bool[Tensor, "m h w"], runs: _Runs, value: bool) -> None:
        """Set the pixels of runs to a value."""
        line, column = runs.start // self.row, runs.start % self.row
        first = (line - line // (self.height + 1)) * self.width + column
        masks.view(-1)[_spans(first, runs.stop - runs.start)[1]] = value


def _symmetric_difference(edges: Int64[Tensor, " e"], *others: Int64[Tensor, " n"]) -> Int64[Tensor, " f"]:
    """Return the edges of the symmetric difference of two masks."""
    positions, counts = torch.cat([edges, *others]).sort().values.unique_consecutive(return_counts=True)
    return positions[counts == 1]


def _runs(edges: Int64[Tensor, " e"], grid: _Grid, least: int) -> _Runs:
    """Return the runs between edges; those of at least `least` pixels are a single node of the graph."""
    start, stop = edges[0::2].contiguous(), edges[1::2].contiguous()
    first = torch.searchsorted(stop, start - grid.row)  # in the row above, including diagonal neighbors
    last = torch.searchsorted(start, stop - grid.row, right=True)
    lower, upper = _spans(first, last - first)
    short = stop - start < least
    relevant = short[lower] | short[upper]
    node = short.cumsum(0) * short
    pairs = torch.stack([node[lower[relevant]], node[upper[relevant]]])
    nodes = 1 + int(short.sum())
    piece = (_components_by_torch if edges.is_cuda else _components_by_scipy)(nodes, pairs)[node]
    area = stop.new_zeros(nodes).index_add(0, piece, stop - start)
    return _Runs(start, stop, piece, area[piece])


def _components_by_scipy(nodes: int, pairs: Int64[Tensor, "2 p"]) -> Int64[Tensor, " nodes"]:
    """Return the component of every node of a graph; components are numbered in the order of their first nodes."""
    from scipy.sparse import coo_array  # noqa: PLC0415 (not needed on a GPU)
    from scipy.sparse.csgraph import connected_components  # noqa: PLC0415

    ones = np.ones(pairs.shape[1], dtype=bool)
    graph = coo_array((ones, tuple(pairs.numpy())), shape=(nodes, nodes))
    return torch.from_numpy(connected_components(graph, directed=False)[1]).long()


def _components_by_torch(nodes: int, pairs: Int64[Tensor, "2 p"]) -> Int64[Tensor, " nodes"]:
    """Return the component of every node on any device; components are numbered by their first node.

    Every node points to itself or to an earlier node, at first to itself. In each round, an edge redirects its two
    nodes, and the nodes that they point to, to the lesser of their grandparents. Rounds end when no pointer changes.
    """
    one, other = pairs
    parent = torch.arange(nodes, device=pairs.device)
    while True:
        grandparent = parent[parent]
        least = torch.minimum(grandparent[one], grandparent[other])
        updated = grandparent.clone()
        for index in (parent[one], parent[other], one, other):
            updated.scatter_reduce_(0, index, least, "amin")
        if torch.equal(updated, parent):
            return parent
        parent = updated


def _in_largest(runs: _Runs, grid: _Grid) -> Bool[Tensor, " n"]:
    """Return a mask of the runs in the largest piece of their mask."""
    mask, none = runs.start // grid.size, len(runs.piece)
    area = mask.new_zeros(grid.masks).scatter_reduce(0, mask, runs.area, "amax")
    piece = torch.where(runs.area == area[mask], runs.piece, none)
    return runs.piece == mask.new_full((grid.masks,), none).scatter_reduce(0, mask, piece, "amin")[mask]


def _spans(first: Int64[Tensor, " n"], length: Int64[Tensor, " n"]) -> tuple[Int64[Tensor, " k"], Int64[Tensor, " k"]]:
    """Return (owner, number) of `length[i]` consecutive numbers from `first[i]` on, for each owner i."""
    owner = torch.repeat_interleave(length)
    return owner, torch.arange(len(owner), device=first.device) + (first - length.cumsum(0) + length)[owner]
