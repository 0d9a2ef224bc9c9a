"""Measurement and suppression of binary masks, and removal of their small holes and pieces."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float, Float64, Int32, Int64
from torch import Tensor
from torch.nn.functional import pad

from normlift_ns.segmentation.regions import column_chunks

_MIN_KEPT = 3
"""Number of highest-scoring masks that pass the score threshold if no score is above it."""


@dataclass(frozen=True)
class Suppression:
    """Thresholds of LangSplat's mask suppression. The defaults are LangSplat's settings.

    Mask A is inside mask B if A covers less than `outer` of B, and B covers at least `inner` of A.
    Masks inside other masks are dropped, regardless of their scores.
    """

    iou: float = 0.8
    """Drop a mask if its IoU with a higher-scoring mask is above this threshold."""
    score: float = 0.7
    """Drop a mask if its score is not above this threshold. If no score is above it, the best three masks pass."""
    outer: float = 0.5
    """Drop a mask inside a larger one only if it covers less than this fraction of the larger mask."""
    inner: float = 0.85
    """Drop a mask inside a larger one only if the larger mask covers at least this fraction of it."""


class MaskMeasurements(NamedTuple):
    """Areas and boxes of masks."""

    inner: Int32[Tensor, " m"]
    """Number of pixels of each mask with a logit above the `offset` of `measure_logits`."""
    outer: Int32[Tensor, " m"]
    """Number of pixels of each mask with a logit above -`offset`."""
    boxes: Int64[Tensor, "m 4"]
    """Boxes of the pixels with a positive logit, in the format of `masks_to_boxes`."""

    @property
    def stability(self) -> Float[Tensor, " m"]:
        """IoU of each mask at the two logit thresholds, inner / outer, or NaN if both areas are 0."""
        return self.inner / self.outer


def measure_logits(logits: Float[Tensor, "m h w"], offset: float) -> MaskMeasurements:
    """Return the boxes of masks, and their areas at the two logit thresholds `offset` and -`offset`."""
    inner, outer = ((logits > bound).flatten(1).view(torch.uint8) for bound in (offset, -offset))
    return MaskMeasurements(
        inner.sum(dim=1, dtype=torch.int32), outer.sum(dim=1, dtype=torch.int32), masks_to_boxes(logits > 0)
    )


def mask_nms(
    masks: Bool[Tensor, "m h w"], scores: Float[Tensor, " m"], rules: Suppression | None = None
) -> Bool[Tensor, " m"]:
    """Select the masks to keep by LangSplat's rules.

    A mask is kept if its score is high enough, it does not repeat a better mask, and it is not inside another mask.
    Each mask is compared with all others, including dropped ones. Intersections are counted exactly, and ratios are
    compared in float64. If two scores are equal, the earlier mask is the better one.

    LangSplat also requires 1 - (inter/area_i)(inter/area_j) > 0.5 for a mask inside another mask. The default `outer`
    implies this.

    Args:
        scores: Stability times predicted IoU.
        rules: Thresholds (default: LangSplat's).
    """
    rules = Suppression() if rules is None else rules
    if len(masks) == 0:
        return torch.zeros(0, dtype=torch.bool, device=masks.device)
    order = torch.sort(scores, descending=True, stable=True).indices
    both = _intersections(masks)[order][:, order]
    area = both.diagonal()
    iou = both / (area[:, None] + area - both)
    repeats = (iou.triu(diagonal=1) > rules.iou).any(dim=0)
    inside = ((both / area[:, None] < rules.outer) & (both / area >= rules.inner)).any(dim=0)
    confident = scores[order] > rules.score
    if not bool(confident.any()):
        confident[:_MIN_KEPT] = True
    keep = torch.empty_like(confident)
    keep[order] = confident & ~repeats & ~inside
    return keep


def masks_to_boxes(masks: Bool[Tensor, "m h w"]) -> Int64[Tensor, "m 4"]:
    """Return the box (x0, y0, x1, y1) of each mask, in pixels and with inclusive ends; zeros for an empty mask."""
    ends = []
    for line in (masks.any(dim=1), masks.any(dim=2)):
        index = torch.arange(line.shape[1], device=masks.device)
        ends.append((torch.where(line, index, line.shape[1]).amin(dim=1), torch.where(line, index, -1).amax(dim=1)))
    (x0, x1), (y0, y1) = ends
    return torch.stack([x0, y0, x1, y1], dim=1) * (x1 >= 0)[:, None]


def _intersections(masks: Bool[Tensor, "m h w"]) -> Float64[Tensor, "m m"]:
    """Return the number of pixels that each pair of masks shares.

    Float32 sums of ones are exact up to 2^24, the maximum number of pixels in a chunk.
    """
    flat = masks.flatten(1)
    both = torch.zeros(len(flat), len(flat), dtype=torch.float64, device=masks.device)
    for columns in column_chunks(flat):
        both += _row_products(flat[:, columns])
    return both


def _row_products(part: Bool[Tensor, "m p"]) -> Tensor:
    """Return the dot products of all pairs of rows.

    On a GPU, tensor cores multiply in int8 and add in int32 if torch supports this.
    """
    if part.is_cuda and hasattr(torch, "_int_mm"):
        count, pixels = part.shape
        padded = pad(part.view(torch.int8), (0, -pixels % 16, 0, max(32 - count, -count % 16)))  # tensor core sizes
        return torch._int_mm(padded, padded.T)[:count, :count]
    exact = part.float()
    return exact @ exact.T


# Removal of small holes and pieces, for all masks together and on their device.
#
# A mask is represented by its edges, the positions at which it changes, in row-major order. The borders of the image
# count as changes, so each row has an even number of edges. The first two edges enclose a run of pixels, the third and
# fourth the next run. Each pixel is read once to find the edges, and written only if it changes. Components are those
# of a graph of runs.


_REGION_CHUNK = {"cuda": 2**29, "cpu": 2**25}
"""Maximum number of pixels in a chunk of several masks, by device type."""


def remove_small_regions(masks: Bool[Tensor, "m h w"], least: int) -> tuple[Bool[Tensor, "m h w"], Bool[Tensor, " m"]]:
    """Fill holes of fewer than `least` pixels, and then remove pieces of fewer than `least` pixels.

    Holes and pieces are 8-connected. An area between a mask and the border of the image is also a hole. The largest
    piece of a mask is always kept.

    Returns:
        The cleaned masks, and whether each mask had such holes or pieces.
    """
    cleaned = masks.clone(memory_format=torch.contiguous_format)
    changed = torch.zeros(len(masks), dtype=torch.bool, device=masks.device)
    step = max(1, _REGION_CHUNK[masks.device.type] // masks[0].numel()) if len(masks) > 0 else 1
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
    """Runs of neighboring pixels in the rows of masks, in ascending order."""

    start: Int64[Tensor, " n"]
    stop: Int64[Tensor, " n"]
    """First position after each run."""
    piece: Int64[Tensor, " n"]
    """Index of the component of each run. Large components may share an index."""
    area: Int64[Tensor, " n"]
    """Number of pixels of the component that contains each run. It can be inexact for large components."""

    def at(self, index: Tensor) -> _Runs:
        return _Runs(*(value[index] for value in self))


class _Grid(NamedTuple):
    """Numbering of pixel positions in all masks.

    Rows are wider than the image, so that the end of a row differs from the start of the next one. An empty row follows
    each mask.
    """

    masks: int
    height: int
    width: int

    @property
    def row(self) -> int:
        """Number of positions per row, a multiple of eight."""
        return 8 * (self.width // 8 + 1)

    @property
    def size(self) -> int:
        """Number of positions per mask."""
        return (self.height + 1) * self.row

    def edges(self, masks: Bool[Tensor, "m h w"]) -> Int64[Tensor, " e"]:
        """Return the positions of the edges of masks, in ascending order."""
        changes = masks.new_zeros(self.masks, self.height + 1, self.row)
        inside = changes[:, :-1]
        inside[:, :, 0], inside[:, :, self.width] = masks[:, :, 0], masks[:, :, -1]
        torch.ne(masks[:, :, 1:], masks[:, :, :-1], out=inside[:, :, 1 : self.width])
        word = changes.view(torch.int64).flatten().nonzero()[:, 0]  # eight positions at a time
        index, offset = changes.view(-1, 8)[word].nonzero(as_tuple=True)
        return 8 * word[index] + offset

    def row_bounds(self, edges: Int64[Tensor, " e"], least: int) -> tuple[Int64[Tensor, " k"], Int64[Tensor, " k"]]:
        """Return the first position of each row that can contain small holes, and the position after its last pixel.

        If images are at least `least` pixels wide, components that contain a whole row are large. The result then has
        only the rows with edges and the rows above and below them. Otherwise, it has all rows.
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
    """Return the edges of the symmetric difference of a mask and another one, whose edges are the arrays `others`."""
    positions, counts = torch.cat([edges, *others]).sort().values.unique_consecutive(return_counts=True)
    return positions[counts == 1]


def _runs(edges: Int64[Tensor, " e"], grid: _Grid, least: int) -> _Runs:
    """Return the runs between edges with their components. All runs of at least `least` pixels are in one component."""
    start, stop = edges[0::2].contiguous(), edges[1::2].contiguous()
    first = torch.searchsorted(stop, start - grid.row)  # neighbors in the row above, including diagonal ones
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
    """Return the component of each node of a graph. Components are numbered in the order of their first nodes."""
    from scipy.sparse import coo_array  # noqa: PLC0415 (not needed on a GPU)
    from scipy.sparse.csgraph import connected_components  # noqa: PLC0415

    ones = np.ones(pairs.shape[1], dtype=bool)
    graph = coo_array((ones, tuple(pairs.numpy())), shape=(nodes, nodes))
    return torch.from_numpy(connected_components(graph, directed=False)[1]).long()


def _components_by_torch(nodes: int, pairs: Int64[Tensor, "2 p"]) -> Int64[Tensor, " nodes"]:
    """Return the component of each node of a graph, on any device. The number of a component is its first node.

    Each node has a parent, which is initially the node itself. In each round, each edge selects the smaller of the
    grandparents of its two nodes. This grandparent becomes the parent of both nodes and of their parents, unless
    another edge selects a smaller one. The rounds end when no parent changes.
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
    """Return whether each run belongs to the largest piece of its mask."""
    mask, none = runs.start // grid.size, len(runs.piece)
    area = mask.new_zeros(grid.masks).scatter_reduce(0, mask, runs.area, "amax")
    piece = torch.where(runs.area == area[mask], runs.piece, none)
    return runs.piece == mask.new_full((grid.masks,), none).scatter_reduce(0, mask, piece, "amin")[mask]


def _spans(first: Int64[Tensor, " n"], length: Int64[Tensor, " n"]) -> tuple[Int64[Tensor, " k"], Int64[Tensor, " k"]]:
    """Concatenate ranges first[i]..first[i] + length[i] - 1; return the index i and the value of each element."""
    owner = torch.repeat_interleave(length)
    return owner, torch.arange(len(owner), device=first.device) + (first - length.cumsum(0) + length)[owner]
