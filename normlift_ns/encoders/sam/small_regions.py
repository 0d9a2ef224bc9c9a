"""Small holes and pieces of masks, of all masks at once, where the masks are.

A mask is held as its edges: the places, row by row, at which it changes, the borders of the image included. There is an
even number of them in each row; the first and second of them enclose a run of pixels, the third and fourth the next.
Pixels are looked at once, to find the edges, and touched again only where they change. Components are those of a graph
of runs.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Int64
from torch import Tensor

_CHUNK = {"cuda": 2**29, "cpu": 2**25}
"""Pixels looked at together."""


def clean_masks(masks: Bool[Tensor, "m h w"], least: int) -> tuple[Bool[Tensor, "m h w"], Bool[Tensor, " m"]]:
    """Fills holes, then drops pieces of fewer than `least` pixels, 8-connected; the largest piece stays in any case.

    What lies between a mask and the border of the image is a hole as well.

    Returns:
        the masks, and which of them had such holes or pieces.
    """
    cleaned = masks.clone(memory_format=torch.contiguous_format)
    changed = torch.zeros(len(masks), dtype=torch.bool, device=masks.device)
    step = max(1, _CHUNK[masks.device.type] // masks[0].numel()) if len(masks) > 0 else 1
    for part, different in zip(cleaned.split(step), changed.split(step)):
        grid = _Grid(*part.shape)
        edges = grid.edges(part)
        holes = _runs(_toggled(edges, *grid.frame(edges, least)), grid, least)
        holes = holes.at(holes.area < least)
        pieces = _runs(_toggled(edges, holes.start, holes.stop), grid, least)
        small = pieces.area < least
        for runs in (holes, pieces.at(small)):
            different[runs.start // grid.size] = True
        grid.paint(part, holes, True)
        grid.paint(part, pieces.at(small & ~_in_largest(pieces, grid)), False)
    return cleaned, changed


class _Runs(NamedTuple):
    """Neighbouring pixels of a row, in ascending order."""

    start: Int64[Tensor, " n"]
    stop: Int64[Tensor, " n"]
    """The first place after it."""
    piece: Int64[Tensor, " n"]
    """Number of its component; large ones may share a number."""
    area: Int64[Tensor, " n"]
    """Pixels of its component if it is small, else some number that is not."""

    def at(self, index: Tensor) -> _Runs:
        return _Runs(*(value[index] for value in self))


class _Grid(NamedTuple):
    """Places of pixels: rows are wider than the image, so that none begins where another ends, and an empty one lies
    below each mask."""

    masks: int
    height: int
    width: int

    @property
    def row(self) -> int:
        """Places per row, a multiple of eight."""
        return 8 * (self.width // 8 + 1)

    @property
    def size(self) -> int:
        """Places per mask."""
        return (self.height + 1) * self.row

    def edges(self, masks: Bool[Tensor, "m h w"]) -> Int64[Tensor, " e"]:
        """Of masks."""
        changes = masks.new_zeros(self.masks, self.height + 1, self.row)
        inside = changes[:, :-1]
        inside[:, :, 0], inside[:, :, self.width] = masks[:, :, 0], masks[:, :, -1]
        torch.ne(masks[:, :, 1:], masks[:, :, :-1], out=inside[:, :, 1 : self.width])
        word = changes.view(torch.int64).flatten().nonzero()[:, 0]  # eight places at a time
        which, place = changes.view(-1, 8)[word].nonzero(as_tuple=True)
        return 8 * word[which] + place

    def frame(self, edges: Int64[Tensor, " e"], least: int) -> tuple[Int64[Tensor, " k"], Int64[Tensor, " k"]]:
        """First places of rows, and those after their last pixels: of the rows with edges and those above and below,
        since rows of `least` pixels are large by themselves; else of all rows."""
        near = torch.full((self.masks, self.height + 1), self.width < least, device=edges.device)
        near.view(-1)[edges // self.row] = True
        near[:, :-1] |= near[:, 1:].clone()
        near[:, 1:] |= near[:, :-1].clone()
        near[:, self.height] = False
        first = near.view(-1).nonzero()[:, 0] * self.row
        return first, first + self.width

    def paint(self, masks: Bool[Tensor, "m h w"], runs: _Runs, value: bool) -> None:
        """Sets the pixels of runs."""
        line, column = runs.start // self.row, runs.start % self.row
        first = (line - line // (self.height + 1)) * self.width + column
        masks.view(-1)[_spans(first, runs.stop - runs.start)[1]] = value


def _toggled(edges: Int64[Tensor, " e"], *others: Int64[Tensor, " n"]) -> Int64[Tensor, " f"]:
    """Edges of the pixels that lie in one of two masks but not in both."""
    places, times = torch.cat([edges, *others]).sort().values.unique_consecutive(return_counts=True)
    return places[times == 1]


def _runs(edges: Int64[Tensor, " e"], grid: _Grid, least: int) -> _Runs:
    """The runs between edges; those of `least` pixels and more are a single node of the graph."""
    start, stop = edges[0::2].contiguous(), edges[1::2].contiguous()
    first = torch.searchsorted(stop, start - grid.row)  # in the row above, diagonal neighbours too
    last = torch.searchsorted(start, stop - grid.row, right=True)
    lower, upper = _spans(first, last - first)
    short = stop - start < least
    matters = short[lower] | short[upper]
    node = short.cumsum(0) * short
    pairs = torch.stack([node[lower[matters]], node[upper[matters]]])
    nodes = 1 + int(short.sum())
    piece = (_joined_by_torch if edges.is_cuda else _joined_by_scipy)(nodes, pairs)[node]
    area = stop.new_zeros(nodes).index_add(0, piece, stop - start)
    return _Runs(start, stop, piece, area[piece])


def _joined_by_scipy(nodes: int, pairs: Int64[Tensor, "2 p"]) -> Int64[Tensor, " nodes"]:
    """The component of every node of a graph, in the order of their first nodes."""
    from scipy.sparse import coo_array  # noqa: PLC0415 (a GPU does without)
    from scipy.sparse.csgraph import connected_components  # noqa: PLC0415

    ones = np.ones(pairs.shape[1], dtype=bool)
    graph = coo_array((ones, tuple(pairs.numpy())), shape=(nodes, nodes))
    return torch.from_numpy(connected_components(graph, directed=False)[1]).long()


def _joined_by_torch(nodes: int, pairs: Int64[Tensor, "2 p"]) -> Int64[Tensor, " nodes"]:
    """The same on any device: a component has the number of its first node.

    Every node points to one that is not after it, at first to itself. In each round what nodes point to, and the nodes
    themselves, are turned to the least that a neighbour's pointer points to, until none of them changes.
    """
    one, other = pairs
    to = torch.arange(nodes, device=pairs.device)
    while True:
        beyond = to[to]
        least = torch.minimum(beyond[one], beyond[other])
        turned = beyond.clone()
        for index in (to[one], to[other], one, other):
            turned.scatter_reduce_(0, index, least, "amin")
        if torch.equal(turned, to):
            return to
        to = turned


def _in_largest(runs: _Runs, grid: _Grid) -> Bool[Tensor, " n"]:
    """Which runs are in the largest piece of their mask."""
    mask, none = runs.start // grid.size, len(runs.piece)
    area = mask.new_zeros(grid.masks).scatter_reduce(0, mask, runs.area, "amax")
    piece = torch.where(runs.area == area[mask], runs.piece, none)
    return runs.piece == mask.new_full((grid.masks,), none).scatter_reduce(0, mask, piece, "amin")[mask]


def _spans(first: Int64[Tensor, " n"], length: Int64[Tensor, " n"]) -> tuple[Int64[Tensor, " k"], Int64[Tensor, " k"]]:
    """Consecutive numbers from each first one on: whose they are, and the numbers."""
    owner = torch.repeat_interleave(length)
    return owner, torch.arange(len(owner), device=first.device) + (first - length.cumsum(0) + length)[owner]
