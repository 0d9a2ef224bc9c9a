"""Exact nearest neighbors of Gaussian centers, with ties resolved by index."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
import torch
from jaxtyping import Float, Float64, Int32, Int64
from torch import Tensor

from normlift_ns.core.arguments import check_arguments, check_rows
from normlift_ns.core.device import can_use_triton
from normlift_ns.core.partition import Communicator
from normlift_ns.errors import InputError
from normlift_ns.options import check_number

MAX_NEIGHBORS = 1024
"""Largest number K of neighbors. Memory grows with K times the number of Gaussians."""
_MAX_UNCERTAIN = 1000
"""Largest number of uncertain rows for which the GPU computes all distances. For more rows, the CPU is faster."""
_BLOCK = 2**14
"""Number of positions per query of the k-d tree."""
_MAX_RANKED = 2**22
"""Largest number of candidates that are ranked at a time."""

Progress = Callable[[int, int], None]
"""Function called after every block of Gaussians with the number processed so far and the total number."""


@check_arguments
class Neighbors(NamedTuple):
    """The K nearest neighbors of all or some Gaussians, nearest first; ties are ordered by index.

    >>> import torch
    >>> from normlift_ns import nearest_neighbors
    >>> neighbors = nearest_neighbors(torch.tensor([[0.0, 0, 0], [0, 0, 0], [2, 0, 0]]), k=3)
    >>> neighbors.index.tolist()
    [[1, 2, -1], [0, 2, -1], [0, 1, -1]]
    >>> neighbors.distance[0].tolist(), neighbors.spacing.tolist()
    ([0.0, 2.0, inf], [2.0, 2.0, 2.0])
    """

    index: Int32[Tensor, "m k"]
    """Indices of the neighbors, padded with -1 if fewer than K other Gaussians have finite means."""
    distance: Float[Tensor, "m k"]
    """Euclidean distances in the units of the means, padded with inf. Float64, or float32 from the search on a GPU."""
    spacing: Float64[Tensor, " m"]
    """Distance to the nearest Gaussian at another position, or inf if there is none."""


@check_arguments
def nearest_neighbors(
    means: Float[Tensor, "n 3"],
    k: int,
    *,
    of: Int64[Tensor, " m"] | None = None,
    progress: Progress | None = None,
    team: Communicator | None = None,
) -> Neighbors:
    """Find the exact K nearest neighbors in 3D, N_K(i) of the paper, excluding the Gaussian itself.

    The CPU uses a k-d tree of the distinct positions, because any number of Gaussians may share a position. The GPU
    uses `kernels.nearest` for float32 means and K up to 60. A row of its result is uncertain if a Gaussian that the
    search dropped could be as near as the last neighbor. For up to 1,000 uncertain rows, the GPU computes all
    distances of these rows. If there are more, the CPU repeats the search. A Gaussian whose mean is not finite has no
    neighbors and is not a neighbor of others.

    Args:
        of: Distinct indices of the Gaussians to find neighbors for, one per row of the result (default: all n).
        progress: Function called after every block of Gaussians with the number processed so far and the total number.
        team: Processes that call this function together, each for a part of the same Gaussians (default: only this
            process).
    Raises:
        ValueError: If `k` is less than 1 or more than `MAX_NEIGHBORS`, or `of` has an invalid index.

    >>> import torch
    >>> from normlift_ns import nearest_neighbors
    >>> neighbors = nearest_neighbors(torch.tensor([[0.0, 0, 0], [1, 0, 0], [3, 0, 0]]), k=1)
    >>> neighbors.index.tolist(), neighbors.distance.tolist()
    ([[1], [0], [1]], [[1.0], [1.0], [2.0]])
    """
    if check_number("k", k, int) > MAX_NEIGHBORS:
        raise InputError(f"k must be at most {MAX_NEIGHBORS:,}, got {k:,}, because all neighbors are kept in memory")
    if of is not None:
        check_rows('the indices "of"', of, len(means))
    neighbors = _on_gpu(means.detach(), k, of, progress, team) if can_use_triton(means) else None
    neighbors = _on_cpu(means, k, of, progress) if neighbors is None else neighbors
    if progress is not None:
        progress(len(neighbors.index), len(neighbors.index))
    return neighbors


def _on_gpu(
    means: Float[Tensor, "n 3"],
    k: int,
    of: Int64[Tensor, " m"] | None,
    progress: Progress | None,
    team: Communicator | None,
) -> Neighbors | None:
    """Find neighbors on the GPU, or return None if the kernel cannot be used or leaves too many rows uncertain."""
    from normlift_ns.kernels import nearest  # noqa: PLC0415 (needs triton)

    finite = means.isfinite().all(dim=1)
    if means.dtype != torch.float32 or k > nearest.MAX_TREE_NEIGHBORS or not bool(finite.any()):
        return None
    if bool(finite.all()):
        return _on_gpu_finite(means, k, of, len(means) if of is None else len(of), progress, team)
    of = torch.arange(len(means), device=means.device) if of is None else of
    mask, gaussian = finite[of], finite.nonzero().squeeze(1).int()
    queries = (finite.cumsum(0) - 1)[of[mask]]
    result = _on_gpu_finite(means[finite], k, queries, len(of), progress, team)
    if result is None:
        return None
    index, distance = result.index.new_full((len(of), k), -1), result.distance.new_full((len(of), k), torch.inf)
    spacing = result.spacing.new_full((len(of),), torch.inf)
    index[mask] = torch.where(result.index < 0, -1, gaussian[result.index.clamp(min=0)])
    distance[mask], spacing[mask] = result.distance, result.spacing
    return Neighbors(index, distance, spacing)


def _on_gpu_finite(
    points: Float[Tensor, "n 3"],
    k: int,
    queries: Int64[Tensor, " m"] | None,
    rows: int,
    progress: Progress | None,
    team: Communicator | None,
) -> Neighbors | None:
    """Find neighbors among finite points, or return None if too many rows are uncertain.

    Args:
        rows: Total number to report as progress.
    """
    from normlift_ns.kernels import nearest  # noqa: PLC0415 (needs triton)

    def report(done: int) -> None:
        torch.cuda.synchronize(points.device)  # wait for the kernels that were launched
        if progress is not None and done < rows:
            progress(done, rows)

    result = nearest.find_nearest(
        points, k, query_indices=queries, progress=None if progress is None else report, communicator=team
    )
    uncertain = (~result.certain).nonzero().squeeze(1)
    if uncertain.numel() > _MAX_UNCERTAIN:
        return None
    if uncertain.numel() > 0:
        uncertain_points = uncertain if queries is None else queries[uncertain]
        for array, exact in zip(result, nearest.brute_force_nearest(points, uncertain_points, k)):
            array[uncertain] = exact
    return Neighbors(result.index, result.distance, result.spacing)


def _on_cpu(
    means: Float[Tensor, "n 3"], k: int, of: Int64[Tensor, " m"] | None = None, progress: Progress | None = None
) -> Neighbors:
    points = means.detach().cpu().double().numpy()
    of_rows = np.arange(len(points)) if of is None else of.cpu().numpy()
    m, is_finite = len(of_rows), np.asarray(np.isfinite(points).all(axis=1))
    finite = np.flatnonzero(is_finite)
    index, distance, spacing = np.full((m, k), -1, dtype=np.int32), np.full((m, k), np.inf), np.full(m, np.inf)
    rows = np.flatnonzero(is_finite[of_rows])
    if finite.size > 1 and rows.size > 0:
        from scipy.spatial import KDTree  # noqa: PLC0415 (not needed on a GPU)

        positions, position_of = np.unique(points[finite], axis=0, return_inverse=True)
        position_of = position_of.reshape(-1)
        tree, member = KDTree(positions), _members(position_of, k + 1)
        self_index = np.searchsorted(finite, of_rows[rows])  # among the finite Gaussians
        queries, query_of = np.unique(position_of[self_index], return_inverse=True)
        ranks: Any = range(1, min(k + 2, len(positions)) + 1)  # a sequence, so one neighbor also gives a column
        blocks = []
        for first in range(0, len(queries), _BLOCK):
            block = queries[first : first + _BLOCK]
            reach, near = map(np.asarray, tree.query(positions[block], k=ranks, workers=-1))
            nearest = reach[:, 1] if len(positions) > 1 else np.full(len(reach), np.inf)
            blocks.append((*_rank_gaussians(tree, member, block, near, reach, k + 1), nearest))
            if progress is not None and first + _BLOCK < len(queries):
                progress((first + _BLOCK) * m // len(queries), m)
        ranked, ranked_distance, nearest = (np.concatenate(parts)[query_of.reshape(-1)] for parts in zip(*blocks))
        # Exclude the Gaussian itself, which is missing from the list only if k + 1 others share its position.
        after_self = np.cumsum(ranked == self_index[:, None], axis=1)[:, :k] > 0
        chosen = np.where(after_self, ranked[:, 1:], ranked[:, :k])
        index[rows] = np.where(chosen < 0, -1, finite[chosen])
        distance[rows] = np.where(after_self, ranked_distance[:, 1:], ranked_distance[:, :k])
        spacing[rows] = nearest
    return Neighbors(*(torch.from_numpy(x).to(means.device) for x in (index, distance, spacing)))


def _members(position_of: np.ndarray, limit: int) -> np.ndarray:
    """Return up to `limit` Gaussians at every position, in index order, as [positions + 1, slots] padded with -1."""
    by_position = np.argsort(position_of, kind="stable")
    count = np.bincount(position_of)
    first = np.cumsum(count) - count
    slot = np.arange(min(limit, count.max()))
    member = np.where(slot < count[:, None], by_position[np.minimum(first[:, None] + slot, len(position_of) - 1)], -1)
    return np.pad(member, ((0, 1), (0, 0)), constant_values=-1)  # the tree returns this row if distances overflow


def _rank_gaussians(
    tree: Any, member: np.ndarray, queries: np.ndarray, near: np.ndarray, reach: np.ndarray, count: int
) -> tuple[np.ndarray, np.ndarray]:
    """Return the `count` Gaussians nearest to each query position and their distances, sorted by (distance, index).

    Args:
        member: Gaussians at every position, from `_members`.
        queries: Indices of the positions to search from.
        near: Indices of the nearest positions of every query, nearest first.
        reach: Distances to `near`.
        count: Number of Gaussians per query. Shorter rows are padded with -1.
    """
    slots = member.shape[1]

    def rank(near: np.ndarray, reach: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        gaussian = member[near].reshape(len(near), -1)
        distance = np.where(gaussian < 0, np.inf, np.repeat(reach, slots, axis=1))
        unsorted = np.flatnonzero((np.diff(distance, axis=1) <= 0).any(axis=1)) if slots == 1 else np.arange(len(near))
        order = np.lexsort((gaussian[unsorted], distance[unsorted]), axis=1)
        gaussian[unsorted] = np.take_along_axis(gaussian[unsorted], order, 1)
        distance[unsorted] = np.take_along_axis(distance[unsorted], order, 1)
        short = max(0, count - gaussian.shape[1])
        gaussian = np.pad(gaussian[:, :count], ((0, 0), (0, short)), constant_values=-1)
        return gaussian, np.pad(distance[:, :count], ((0, 0), (0, short)), constant_values=np.inf)

    step = max(1, _MAX_RANKED // (near.shape[1] * slots))
    blocks = [rank(near[i : i + step], reach[i : i + step]) for i in range(0, len(near), step)]
    ranked, distance = (np.concatenate(parts) for parts in zip(*blocks))
    if near.shape[1] > count:  # the tree returns an arbitrary selection of ties for the last rank
        for row in np.flatnonzero((reach[:, count - 1] == reach[:, count]) & np.isfinite(reach[:, count])):
            position = tree.data[queries[row]]
            around = np.array(tree.query_ball_point(position, reach[row, count] * (1 + 1e-12)))
            radius = np.linalg.norm(tree.data[around] - position, axis=1)
            radius = np.where(np.isclose(radius, reach[row, count], rtol=1e-12, atol=0), reach[row, count], radius)
            ranked[row : row + 1], distance[row : row + 1] = rank(around[None], radius[None])
    return ranked, distance
