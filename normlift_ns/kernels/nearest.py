"""Exact nearest neighbours on the GPU: a balanced k-d tree, one warp per leaf of 32 points.

All points of a leaf search together. They walk through the tree from their own leaf outwards and skip every subtree
whose box is farther than the worst candidate of any of them. Candidates are kept by float32 distance, a few more than
asked, ranked by float64 distance and index in the end, and certified: where a point that was not kept could be as near
as the last one that was, the query is reported as uncertain.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple, Protocol

import torch
import triton
import triton.language as tl
from jaxtyping import Bool, Float32, Float64, Int32, Int64
from torch import Tensor

LEAF = 32
SLOTS = 64
SPARE = 4
"""Candidates kept beyond K, so that float32 may confuse the last few."""
MOST_NEIGHBORS = SLOTS - SPARE
_PAIRS = 2**24
"""Distances at once, of 8 bytes and as much again for their parts."""
_SORTED_IN_A_BLOCK = 4096
"""Points that torch sorts with one block of a GPU, without passes over the memory."""
_LEAVES = 2**14
"""Leaves at once: half a million points, 320 bytes each at K = 36."""


class Sharing(Protocol):
    """Some processes, of which `core.portions.Team` is one."""

    @property
    def rank(self) -> int:
        """Of this one."""
        ...

    @property
    def size(self) -> int:
        """How many there are."""
        ...

    def join(self, rows: Tensor, /) -> Tensor:
        """The rows of all, one behind the other, at every process."""
        ...


class Tree(NamedTuple):
    """A balanced k-d tree of L = 2 ** depth leaves; nodes in heap order, root 1, leaves L..2 L - 1."""

    index: Int64[Tensor, " slots"]
    """Leaf l holds the points index[32 l:32 l + 32]; -1 for none, behind all points."""
    points: Float32[Tensor, "slots 3"]
    boxes: Float32[Tensor, "nodes 6"]
    """Least and greatest coordinates of each node; the box of an empty node is at infinity."""


class Found(NamedTuple):
    """The K nearest other points of each point, by (distance, index)."""

    index: Int32[Tensor, "n k"]
    distance: Float32[Tensor, "n k"]
    """Rounded from float64, inf where index is -1."""
    spacing: Float64[Tensor, " n"]
    """Distance to the nearest point at another place among the candidates; inf if there is none."""
    certain: Bool[Tensor, " n"]
    """False where the answer may be wrong."""


def build_tree(points: Float32[Tensor, "n 3"], team: Sharing | None = None) -> Tree:
    """Splits in the middle of the longest side, level by level; one sort per level, of small nodes each for itself.

    Args:
        team: processes that have the same points, of which each splits a part of the nodes; all get the same tree.
    """
    n, device = len(points), points.device
    depth = max(0, (-(-n // LEAF) - 1).bit_length())
    size = LEAF << depth
    index = torch.full((size,), -1, dtype=torch.int64, device=device)
    index[:n] = torch.arange(n, device=device)
    padded = torch.full((size, 3), torch.inf, device=device)
    padded[:n] = points
    shared = 0 if team is None or team.size == 1 else min(depth, (team.size - 1).bit_length())
    for level in range(shared):
        index, padded = _split(index, padded, 1 << level)
    if team is not None and shared > 0:
        first, last = (rank * (1 << shared) // team.size for rank in (team.rank, team.rank + 1))
        width = size >> shared
        some = slice(first * width, last * width)
        index, padded = index[some], padded[some]
        for level in range(shared, depth):
            if last > first:
                index, padded = _split(index, padded, (last - first) << (level - shared))
        index, padded = team.join(index), team.join(padded)
    else:
        for level in range(shared, depth):
            index, padded = _split(index, padded, 1 << level)
    boxes = torch.full((2 << depth, 6), torch.inf, device=device)
    low, high = _box(padded.view(1 << depth, LEAF, 3))
    for level in range(depth, -1, -1):
        boxes[1 << level : 2 << level] = torch.cat([low, high], dim=1)
        if level > 0:
            low, high = low.view(-1, 2, 3).amin(dim=1), high.view(-1, 2, 3).amax(dim=1)
    boxes[boxes[:, 0] == torch.inf] = torch.inf
    return Tree(index, padded, boxes)


def _split(
    index: Int64[Tensor, " slots"], points: Float32[Tensor, "slots 3"], count: int
) -> tuple[Int64[Tensor, " slots"], Float32[Tensor, "slots 3"]]:
    """The points of so many nodes, the lower half of each along its longest side first."""
    nodes = points.view(count, -1, 3)
    low, high = _box(nodes)
    axis = (high - low).nan_to_num(-1).argmax(dim=1)
    along = nodes.gather(2, axis[:, None, None].expand(-1, nodes.shape[1], 1)).squeeze(2)
    node, bits = torch.arange(count, device=points.device)[:, None], _ascending_bits(along)
    if nodes.shape[1] <= _SORTED_IN_A_BLOCK:
        order = (bits.sort(dim=1, stable=True).indices + node * nodes.shape[1]).flatten()
    else:
        order = ((node << 32) + bits.long()).flatten().sort(stable=True).indices
    return index[order], points[order]


def _box(nodes: Float32[Tensor, "nodes m 3"]) -> tuple[Float32[Tensor, "nodes 3"], Float32[Tensor, "nodes 3"]]:
    return nodes.amin(dim=1), torch.where(nodes.isinf(), -torch.inf, nodes).amax(dim=1)


def _ascending_bits(x: Tensor) -> Tensor:
    """Integers of 32 bits in the order of the numbers."""
    bits = (x + 0.0).view(torch.int32)  # + 0.0: no negative zero
    return torch.where(bits < 0, -(bits & 0x7FFFFFFF), bits)


@triton.jit
def _search(points, boxes, index, candidates, asked, leaves, stride, wanted, LEAF: tl.constexpr, SLOTS: tl.constexpr):
    """Keeps the `wanted` nearest points of each point of a leaf: candidates[slot, point], float32 bits and position."""
    leaf = tl.load(asked + tl.program_id(0))
    lane = tl.arange(0, LEAF)
    mine = leaf * LEAF + lane
    x, y, z = tl.load(points + 3 * mine), tl.load(points + 3 * mine + 1), tl.load(points + 3 * mine + 2)
    asks = tl.load(index + mine) >= 0
    node = leaf + leaves
    x0, y0, z0 = tl.load(boxes + 6 * node), tl.load(boxes + 6 * node + 1), tl.load(boxes + 6 * node + 2)
    x1, y1, z1 = tl.load(boxes + 6 * node + 3), tl.load(boxes + 6 * node + 4), tl.load(boxes + 6 * node + 5)
    LAST: tl.constexpr = 0x7FFFFFFFFFFFFFFF
    FAR: tl.constexpr = 0x7F800000 << 32  # infinity, with room for a distinct number in each free slot
    slot = tl.arange(0, SLOTS).to(tl.int64)
    best = tl.where(slot < wanted, FAR + slot, -1)[:, None] + tl.zeros([SLOTS, LEAF], tl.int64)
    root, path = node, node
    reach = float("inf")
    while root > 0:
        dx = tl.maximum(tl.maximum(tl.load(boxes + 6 * node) - x1, x0 - tl.load(boxes + 6 * node + 3)), 0.0)
        dy = tl.maximum(tl.maximum(tl.load(boxes + 6 * node + 1) - y1, y0 - tl.load(boxes + 6 * node + 4)), 0.0)
        dz = tl.maximum(tl.maximum(tl.load(boxes + 6 * node + 2) - z1, z0 - tl.load(boxes + 6 * node + 5)), 0.0)
        empty = tl.load(boxes + 6 * node) == float("inf")
        near = ((dx * dx + dy * dy + dz * dz) * 0.99999 <= reach) & (empty == 0)
        if near & (node < leaves):
            node = 2 * node
        else:
            if near:
                other = (node - leaves) * LEAF + lane
                ox, oy, oz = (
                    tl.load(points + 3 * other),
                    tl.load(points + 3 * other + 1),
                    tl.load(points + 3 * other + 2),
                )
                there = tl.load(index + other) >= 0
                ex, ey, ez = ox[:, None] - x[None, :], oy[:, None] - y[None, :], oz[:, None] - z[None, :]
                square = ex * ex + ey * ey + ez * ez
                bits = square.to(tl.int32, bitcast=True).to(tl.int64) << 32
                usable = there[:, None] & (other[:, None] != mine[None, :]) & asks[None, :]
                new = tl.where(usable, bits | other[:, None].to(tl.int64), LAST)
                least, worst = tl.min(new, axis=0), tl.max(best, axis=0)
                while tl.max(tl.where(least < worst, 1, 0), axis=0) > 0:
                    enters = (least < worst)[None, :]
                    best = tl.where((best == worst[None, :]) & enters, least[None, :], best)
                    new = tl.where(new == least[None, :], LAST, new)
                    least, worst = tl.min(new, axis=0), tl.max(best, axis=0)
                worst_square = (worst >> 32).to(tl.int32).to(tl.float32, bitcast=True)
                reach = tl.max(tl.where(asks, worst_square, 0.0), axis=0)
            while (node != root) & (node % 2 == 1):
                node = node // 2
            if node != root:
                node += 1
            elif path == 1:
                root = 0
            else:  # this ancestor is done: its sibling is next
                root = path ^ 1
                node = root
                path = path // 2
    place = slot[:, None] * stride + tl.program_id(0) * LEAF + lane[None, :]
    tl.store(candidates + place, best, mask=(slot < wanted)[:, None])


@triton.jit
def _rank(
    points, index, candidates, out_index, out_distance, out_spacing, out_certain, asked, row_of, stride, wanted, k,
    LEAF: tl.constexpr, SLOTS: tl.constexpr,
):  # fmt: skip
    """Ranks the candidates of one point by float64 distance, then index."""
    mine = tl.load(asked + tl.program_id(0) // LEAF) * LEAF + tl.program_id(0) % LEAF
    name_of_mine = tl.load(index + mine)
    me = tl.load(row_of + name_of_mine, mask=name_of_mine >= 0, other=-1).to(tl.int64)
    if me >= 0:
        slot = tl.arange(0, SLOTS)
        key = tl.load(candidates + slot.to(tl.int64) * stride + tl.program_id(0), mask=slot < wanted, other=-1)
        found = (key >= 0) & (key < (0x7F800000 << 32))
        other = tl.where(found, key & 0xFFFFFFFF, 0)
        dx = tl.load(points + 3 * other).to(tl.float64) - tl.load(points + 3 * mine).to(tl.float64)
        dy = tl.load(points + 3 * other + 1).to(tl.float64) - tl.load(points + 3 * mine + 1).to(tl.float64)
        dz = tl.load(points + 3 * other + 2).to(tl.float64) - tl.load(points + 3 * mine + 2).to(tl.float64)
        distance = tl.where(found, tl.sqrt(dx * dx + dy * dy + dz * dz), float("inf"))
        name = tl.load(index + other)
        name = tl.where(found, name, 0x7FFFFFFF + slot)
        nearer = (distance[None, :] < distance[:, None]) | (
            (distance[None, :] == distance[:, None]) & (name[None, :] < name[:, None])
        )
        rank = tl.sum(nearer.to(tl.int32), axis=1)
        keep = rank < k
        tl.store(out_index + me * k + rank, tl.where(found, name, -1).to(tl.int32), mask=keep)
        tl.store(out_distance + me * k + rank, distance.to(tl.float32), mask=keep)
        elsewhere = tl.min(tl.where(distance > 0, distance, float("inf")), axis=0)
        tl.store(out_spacing + me, elsewhere)
        # Whoever was not kept is at least as far as the farthest that was, up to rounding.
        full = tl.sum(found.to(tl.int32), axis=0) == wanted
        worst = tl.max(tl.where(found, (key >> 32).to(tl.int32).to(tl.float32, bitcast=True), 0.0), axis=0)
        last = tl.max(tl.where(keep & found, distance, 0.0), axis=0)
        horizon = tl.sqrt(worst.to(tl.float64)) * (1 - 3e-7)
        certain = (full == 0) | ((last < horizon) & (elsewhere < float("inf")))
        tl.store(out_certain + me, certain.to(tl.int8))


def nearest(
    points: Float32[Tensor, "n 3"],
    k: int,
    *,
    of: Int64[Tensor, " m"] | None = None,
    done: Callable[[int], None] | None = None,
    team: Sharing | None = None,
) -> Found:
    """The K nearest other points of all or some points.

    Args:
        points: finite.
        k: 1..MOST_NEIGHBORS.
        of: the distinct points that are asked for, one row of the result each; None: all.
        done: called with the number of rows whose search has been launched.
        team: processes that ask at the same time, each for some of the same points, as in `build_tree`.
    """
    tree, device, wanted = build_tree(points, team), points.device, k + SPARE
    n, leaves = len(points) if of is None else len(of), len(tree.index) // LEAF
    row_of = torch.arange(len(points), dtype=torch.int32, device=device)
    asked = torch.arange(-(-len(points) // LEAF), dtype=torch.int32, device=device)  # the others are empty
    if of is not None:
        row_of = torch.full_like(row_of, -1).index_copy_(0, of, row_of[:n])
        rows = torch.where(tree.index < 0, -1, row_of[tree.index.clamp(min=0)])
        asked = (rows.view(leaves, LEAF) >= 0).any(dim=1).nonzero().squeeze(1).int()
    found = Found(
        torch.empty(n, k, dtype=torch.int32, device=device),
        torch.empty(n, k, device=device),
        torch.empty(n, dtype=torch.float64, device=device),
        torch.empty(n, dtype=torch.int8, device=device),
    )
    stride = min(len(asked), _LEAVES) * LEAF
    candidates = torch.empty(wanted, stride, dtype=torch.int64, device=device)
    first = 0
    for some in asked.split(_LEAVES) if len(asked) > 0 else ():
        _search[(len(some),)](
            tree.points, tree.boxes, tree.index, candidates, some, leaves, stride, wanted,
            LEAF=LEAF, SLOTS=SLOTS, num_warps=1,
        )  # fmt: skip
        _rank[(len(some) * LEAF,)](
            tree.points, tree.index, candidates, *found, some, row_of, stride, wanted, k,
            LEAF=LEAF, SLOTS=SLOTS, num_warps=1,
        )  # fmt: skip
        first += len(some)
        if done is not None:
            done(first * n // len(asked))
    return found._replace(certain=found.certain.bool())


def nearest_of_rows(points: Float32[Tensor, "n 3"], rows: Int64[Tensor, " r"], k: int) -> Found:
    """The K nearest other points of some points by looking at all: for the few that `nearest` is not sure of."""
    exact, parts = points.double(), []
    n = len(points)
    for some in rows.split(max(1, _PAIRS // n)):
        distance = torch.linalg.vector_norm(exact[some, None] - exact, dim=2)
        distance[torch.arange(len(some), device=rows.device), some] = torch.inf
        spacing = torch.where(distance > 0, distance, torch.inf).amin(dim=1)
        last = distance.topk(min(k, n), largest=False).values[:, -1:]
        row, index = (distance <= last).nonzero(as_tuple=True)  # by row, then index; more than K where they tie
        order = distance[row, index].sort(stable=True).indices
        order = order[row[order].sort(stable=True).indices]
        row, index = row[order], index[order]
        rank = torch.arange(len(row), device=rows.device) - torch.searchsorted(row, row)
        keep = (rank < k) & (distance[row, index] < torch.inf)
        place = (row[keep], rank[keep])
        found = Found(
            torch.full((len(some), k), -1, dtype=torch.int32, device=rows.device),
            torch.full((len(some), k), torch.inf, device=rows.device),
            spacing,
            torch.ones(len(some), dtype=torch.bool, device=rows.device),
        )
        found.index[place] = index[keep].int()
        found.distance[place] = distance[row, index][keep].float()
        parts.append(found)
    return Found(*(torch.cat(x) for x in zip(*parts)))
