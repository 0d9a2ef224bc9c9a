"""Exact nearest neighbors on the GPU, with a balanced k-d tree and one warp per leaf of 32 points.

A warp searches for the neighbors of all points of a leaf together. It visits the tree from this leaf outward, and skips
a subtree if its box is farther than the worst candidate of every point. It keeps a few more candidates than requested,
by float32 distance, and finally ranks them by float64 distance and index. If a dropped point could be as near as the
last neighbor of a query point, the neighbors of the query point are marked as uncertain.
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
"""Number of candidates to keep in addition to the K nearest, because float32 rounding can change their order."""
MAX_TREE_NEIGHBORS = SLOTS - SPARE
_PAIRS = 2**24
"""Number of distances that `brute_force_nearest` computes at a time. A distance takes 8 bytes, and the difference of
the two points another 24."""
_SORTED_IN_A_BLOCK = 4096
"""Largest number of points that torch sorts within one GPU block, without passes over memory."""
_LEAVES = 2**14
"""Maximum number of leaves per launch (half a million points). The candidates of a point take 320 bytes for K = 36."""


class GatheringProcesses(Protocol):
    """Interface of a group of processes, implemented by `core.partition.Communicator`."""

    @property
    def rank(self) -> int:
        """Rank of this process."""
        ...

    @property
    def world_size(self) -> int:
        """Number of processes."""
        ...

    def all_gather(self, rows: Tensor, /) -> Tensor:
        """Return the concatenated rows of all processes in every process."""
        ...


class KdTree(NamedTuple):
    """Balanced k-d tree with L = 2 ** depth leaves. Nodes are in heap order, with root 1 and leaves L..2 L - 1."""

    index: Int64[Tensor, " slots"]
    """Indices of the points, with index[32 l:32 l + 32] for leaf l. Empty slots are -1 and follow all points."""
    points: Float32[Tensor, "slots 3"]
    """Coordinates of the points in `index`, or infinity for empty slots."""
    boxes: Float32[Tensor, "nodes 6"]
    """Smallest and largest coordinates of each node, or infinity for an empty node."""


class NearestNeighbors(NamedTuple):
    """K nearest other points of each point, sorted by distance and then by index."""

    index: Int32[Tensor, "n k"]
    """Indices of the neighbors, padded with -1."""
    distance: Float32[Tensor, "n k"]
    """Distances rounded from float64, padded with inf."""
    spacing: Float64[Tensor, " n"]
    """Distance to the nearest point at another position among those that the search kept, or inf if there is none."""
    certain: Bool[Tensor, " n"]
    """False for points whose neighbors may be wrong."""


def build_kd_tree(points: Float32[Tensor, "n 3"], communicator: GatheringProcesses | None = None) -> KdTree:
    """Build a tree level by level, by splitting nodes at the median along their longest side.

    Each level needs one sort. Small nodes are sorted independently.

    Args:
        points: Points of the tree.
        communicator: Processes with the same points. Each splits a part of the nodes, and all return the same tree.
    """
    n, device = len(points), points.device
    depth = max(0, (-(-n // LEAF) - 1).bit_length())
    size = LEAF << depth
    index = torch.full((size,), -1, dtype=torch.int64, device=device)
    index[:n] = torch.arange(n, device=device)
    padded = torch.full((size, 3), torch.inf, device=device)
    padded[:n] = points
    processes = 1 if communicator is None else communicator.world_size
    shared = min(depth, (processes - 1).bit_length())
    for level in range(shared):
        index, padded = _split(index, padded, 1 << level)
    if communicator is not None and shared > 0:
        first, last = (rank * (1 << shared) // processes for rank in (communicator.rank, communicator.rank + 1))
        width = size >> shared
        own = slice(first * width, last * width)
        index, padded = index[own], padded[own]
        for level in range(shared, depth):
            if last > first:
                index, padded = _split(index, padded, (last - first) << (level - shared))
        index, padded = communicator.all_gather(index), communicator.all_gather(padded)
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
    return KdTree(index, padded, boxes)


def _split(
    index: Int64[Tensor, " slots"], points: Float32[Tensor, "slots 3"], count: int
) -> tuple[Int64[Tensor, " slots"], Float32[Tensor, "slots 3"]]:
    """Sort the points of each of `count` nodes along its longest side, so that each node can be split in the middle."""
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
    """Return int32 numbers that have the same order as the given float32 numbers."""
    bits = (x + 0.0).view(torch.int32)  # + 0.0 replaces -0.0
    return torch.where(bits < 0, -(bits & 0x7FFFFFFF), bits)


@triton.jit
def _search(
    points, boxes, index, candidates, query_leaves, leaves, stride, wanted, LEAF: tl.constexpr, SLOTS: tl.constexpr
):
    """Write the `wanted` nearest points of each point of a leaf to candidates[i, point], in any order.

    A candidate is an int64. Its high half is the squared distance as float32. Its low half is the position of the
    candidate in `KdTree.points`.
    """
    leaf = tl.load(query_leaves + tl.program_id(0))
    lane = tl.arange(0, LEAF)
    own = leaf * LEAF + lane
    x, y, z = tl.load(points + 3 * own), tl.load(points + 3 * own + 1), tl.load(points + 3 * own + 2)
    queries = tl.load(index + own) >= 0
    node = leaf + leaves
    x0, y0, z0 = tl.load(boxes + 6 * node), tl.load(boxes + 6 * node + 1), tl.load(boxes + 6 * node + 2)
    x1, y1, z1 = tl.load(boxes + 6 * node + 3), tl.load(boxes + 6 * node + 4), tl.load(boxes + 6 * node + 5)
    LAST: tl.constexpr = 0x7FFFFFFFFFFFFFFF
    FAR: tl.constexpr = 0x7F800000 << 32  # infinity, plus a distinct number for each free slot
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
                valid = tl.load(index + other) >= 0
                ex, ey, ez = ox[:, None] - x[None, :], oy[:, None] - y[None, :], oz[:, None] - z[None, :]
                square = ex * ex + ey * ey + ez * ez
                bits = square.to(tl.int32, bitcast=True).to(tl.int64) << 32
                usable = valid[:, None] & (other[:, None] != own[None, :]) & queries[None, :]
                new = tl.where(usable, bits | other[:, None].to(tl.int64), LAST)
                least, worst = tl.min(new, axis=0), tl.max(best, axis=0)
                while tl.max(tl.where(least < worst, 1, 0), axis=0) > 0:
                    replaces = (least < worst)[None, :]
                    best = tl.where((best == worst[None, :]) & replaces, least[None, :], best)
                    new = tl.where(new == least[None, :], LAST, new)
                    least, worst = tl.min(new, axis=0), tl.max(best, axis=0)
                worst_square = (worst >> 32).to(tl.int32).to(tl.float32, bitcast=True)
                reach = tl.max(tl.where(queries, worst_square, 0.0), axis=0)
            while (node != root) & (node % 2 == 1):
                node = node // 2
            if node != root:
                node += 1
            elif path == 1:
                root = 0
            else:  # this ancestor is finished; continue with its sibling
                root = path ^ 1
                node = root
                path = path // 2
    offset = slot[:, None] * stride + tl.program_id(0) * LEAF + lane[None, :]
    tl.store(candidates + offset, best, mask=(slot < wanted)[:, None])


@triton.jit
def _rank(
    points, index, candidates, out_index, out_distance, out_spacing, out_certain, query_leaves, row_of, stride,
    wanted, k, LEAF: tl.constexpr, SLOTS: tl.constexpr,
):  # fmt: skip
    """Rank the candidates of one point by float64 distance and then by index."""
    own = tl.load(query_leaves + tl.program_id(0) // LEAF) * LEAF + tl.program_id(0) % LEAF
    own_name = tl.load(index + own)
    row = tl.load(row_of + own_name, mask=own_name >= 0, other=-1).to(tl.int64)
    if row >= 0:
        slot = tl.arange(0, SLOTS)
        key = tl.load(candidates + slot.to(tl.int64) * stride + tl.program_id(0), mask=slot < wanted, other=-1)
        valid = (key >= 0) & (key < (0x7F800000 << 32))
        other = tl.where(valid, key & 0xFFFFFFFF, 0)
        dx = tl.load(points + 3 * other).to(tl.float64) - tl.load(points + 3 * own).to(tl.float64)
        dy = tl.load(points + 3 * other + 1).to(tl.float64) - tl.load(points + 3 * own + 1).to(tl.float64)
        dz = tl.load(points + 3 * other + 2).to(tl.float64) - tl.load(points + 3 * own + 2).to(tl.float64)
        distance = tl.where(valid, tl.sqrt(dx * dx + dy * dy + dz * dz), float("inf"))
        name = tl.load(index + other)
        name = tl.where(valid, name, 0x7FFFFFFF + slot)
        nearer = (distance[None, :] < distance[:, None]) | (
            (distance[None, :] == distance[:, None]) & (name[None, :] < name[:, None])
        )
        rank = tl.sum(nearer.to(tl.int32), axis=1)
        keep = rank < k
        tl.store(out_index + row * k + rank, tl.where(valid, name, -1).to(tl.int32), mask=keep)
        tl.store(out_distance + row * k + rank, distance.to(tl.float32), mask=keep)
        elsewhere = tl.min(tl.where(distance > 0, distance, float("inf")), axis=0)
        tl.store(out_spacing + row, elsewhere)
        # Dropped points are at least as far away as the farthest candidate, up to rounding.
        full = tl.sum(valid.to(tl.int32), axis=0) == wanted
        worst = tl.max(tl.where(valid, (key >> 32).to(tl.int32).to(tl.float32, bitcast=True), 0.0), axis=0)
        last = tl.max(tl.where(keep & valid, distance, 0.0), axis=0)
        horizon = tl.sqrt(worst.to(tl.float64)) * (1 - 3e-7)
        certain = (full == 0) | ((last < horizon) & (elsewhere < float("inf")))
        tl.store(out_certain + row, certain.to(tl.int8))


def find_nearest(
    points: Float32[Tensor, "n 3"],
    k: int,
    *,
    query_indices: Int64[Tensor, " m"] | None = None,
    progress: Callable[[int], None] | None = None,
    communicator: GatheringProcesses | None = None,
) -> NearestNeighbors:
    """Return the K nearest other points of all or some points.

    Args:
        points: Finite points.
        k: Number of neighbors, in 1..MAX_TREE_NEIGHBORS.
        query_indices: Distinct indices of the query points, one per row of the result (default: all points).
        progress: Callback with the number of rows whose search has been launched.
        communicator: Processes that call this function together with the same points, each for its own query points.
    """
    tree, device, wanted = build_kd_tree(points, communicator), points.device, k + SPARE
    n, leaves = len(points) if query_indices is None else len(query_indices), len(tree.index) // LEAF
    row_of = torch.arange(len(points), dtype=torch.int32, device=device)
    query_leaves = torch.arange(-(-len(points) // LEAF), dtype=torch.int32, device=device)  # other leaves are empty
    if query_indices is not None:
        row_of = torch.full_like(row_of, -1).index_copy_(0, query_indices, row_of[:n])
        rows = torch.where(tree.index < 0, -1, row_of[tree.index.clamp(min=0)])
        query_leaves = (rows.view(leaves, LEAF) >= 0).any(dim=1).nonzero().squeeze(1).int()
    result = NearestNeighbors(
        torch.empty(n, k, dtype=torch.int32, device=device),
        torch.empty(n, k, device=device),
        torch.empty(n, dtype=torch.float64, device=device),
        torch.empty(n, dtype=torch.int8, device=device),
    )
    stride = min(len(query_leaves), _LEAVES) * LEAF
    candidates = torch.empty(wanted, stride, dtype=torch.int64, device=device)
    first = 0
    for chunk in query_leaves.split(_LEAVES) if len(query_leaves) > 0 else ():
        _search[(len(chunk),)](
            tree.points, tree.boxes, tree.index, candidates, chunk, leaves, stride, wanted,
            LEAF=LEAF, SLOTS=SLOTS, num_warps=1,
        )  # fmt: skip
        _rank[(len(chunk) * LEAF,)](
            tree.points, tree.index, candidates, *result, chunk, row_of, stride, wanted, k,
            LEAF=LEAF, SLOTS=SLOTS, num_warps=1,
        )  # fmt: skip
        first += len(chunk)
        if progress is not None:
            progress(first * n // len(query_leaves))
    return result._replace(certain=result.certain.bool())


def brute_force_nearest(points: Float32[Tensor, "n 3"], rows: Int64[Tensor, " r"], k: int) -> NearestNeighbors:
    """Return the K nearest other points of some points by computing all distances.

    Use it for the uncertain rows of `find_nearest`.
    """
    exact, parts = points.double(), []
    n = len(points)
    for chunk in rows.split(max(1, _PAIRS // n)):
        distance = torch.linalg.vector_norm(exact[chunk, None] - exact, dim=2)
        distance[torch.arange(len(chunk), device=rows.device), chunk] = torch.inf
        spacing = torch.where(distance > 0, distance, torch.inf).amin(dim=1)
        last = distance.topk(min(k, n), largest=False).values[:, -1:]
        row, index = (distance <= last).nonzero(as_tuple=True)  # by row, then index; more than K with ties
        order = distance[row, index].sort(stable=True).indices
        order = order[row[order].sort(stable=True).indices]
        row, index = row[order], index[order]
        rank = torch.arange(len(row), device=rows.device) - torch.searchsorted(row, row)
        keep = (rank < k) & (distance[row, index] < torch.inf)
        slots = (row[keep], rank[keep])
        result = NearestNeighbors(
            torch.full((len(chunk), k), -1, dtype=torch.int32, device=rows.device),
            torch.full((len(chunk), k), torch.inf, device=rows.device),
            spacing,
            torch.ones(len(chunk), dtype=torch.bool, device=rows.device),
        )
        result.index[slots] = index[keep].int()
        result.distance[slots] = distance[row, index][keep].float()
        parts.append(result)
    return NearestNeighbors(*(torch.cat(x) for x in zip(*parts)))
