"""Exact nearest neighbours of Gaussian centres, with one answer where distances tie."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
import torch
from jaxtyping import Float, Float64, Int32, Int64
from torch import Tensor

from normlift_ns.core.gpu import kernels_apply
from normlift_ns.core.portions import ALONE, Team
from normlift_ns.errors import InputError
from normlift_ns.ranges import check_number

MOST_NEIGHBORS = 1024
"""Memory grows with their number times that of the Gaussians, and a vote compares every two of them."""
_MOST_UNSURE = 1000
"""Gaussians whose neighbours a GPU finds by looking at all others; with more of them the CPU's tree is faster."""
_BLOCK = 2**14
"""Places that are searched from at a time on the CPU."""
_MOST_RANKED = 2**22
"""Candidates that are ranked at a time."""

Progress = Callable[[int, int], None]
"""Called after every block of Gaussians with (Gaussians done, Gaussians)."""


class Neighbors(NamedTuple):
    """The K nearest other Gaussians of all or some Gaussians, nearest first, equal distances by index.

    >>> import torch
    >>> from normlift_ns import nearest_neighbors
    >>> found = nearest_neighbors(torch.tensor([[0.0, 0, 0], [0, 0, 0], [2, 0, 0]]), k=3)
    >>> found.index.tolist()
    [[1, 2, -1], [0, 2, -1], [0, 1, -1]]
    >>> found.distance[0].tolist(), found.spacing.tolist()
    ([0.0, 2.0, inf], [2.0, 2.0, 2.0])
    """

    index: Int32[Tensor, "m k"]  # pyright: ignore[reportIncompatibleMethodOverride]
    """-1 where there are fewer than K others with finite means."""
    distance: Float[Tensor, "m k"]
    """Euclidean, in the units of the means; inf where index is -1. Computed in float64, stored in float32 on a GPU."""
    spacing: Float64[Tensor, " m"]
    """Distance to the nearest Gaussian that is not at the same place; inf if there is none."""


def nearest_neighbors(
    means: Float[Tensor, "n 3"],
    k: int,
    *,
    of: Int64[Tensor, " m"] | None = None,
    progress: Progress | None = None,
    team: Team = ALONE,
) -> Neighbors:
    """The K nearest neighbours in 3D, N_K(i) of the paper, self excluded, exact.

    On the CPU by a k-d tree over the distinct places: any number of Gaussians may share one, while a tree over all of
    them would need all pairs to answer ties in a fixed order. On a GPU by `kernels.nearest`, which certifies its
    answer; where it cannot (more ties than it keeps candidates) all distances are looked at, or the CPU answers.
    A Gaussian whose mean is not finite has no neighbours and is nobody's neighbour.

    Args:
        of: the Gaussians whose neighbours are asked for, one row of the result each; None: all n.
        progress: called after every block of Gaussians with (Gaussians done, Gaussians).
        team: processes that ask at the same time, each for some of the same Gaussians; they share what work they can.
    Raises:
        ValueError: k < 1, or more than `MOST_NEIGHBORS`.

    >>> import torch
    >>> from normlift_ns import nearest_neighbors
    >>> found = nearest_neighbors(torch.tensor([[0.0, 0, 0], [1, 0, 0], [3, 0, 0]]), k=1)
    >>> found.index.tolist(), found.distance.tolist()
    ([[1], [0], [1]], [[1.0], [1.0], [2.0]])
    """
    if check_number("k", k, int) > MOST_NEIGHBORS:
        raise InputError(f"k must be at most {MOST_NEIGHBORS:,}, got {k:,}: all neighbours are held in memory at once")
    found = _on_gpu(means.detach(), k, of, progress, team) if kernels_apply(means) else None
    found = _on_cpu(means, k, of, progress) if found is None else found
    if progress is not None:
        progress(len(found.index), len(found.index))
    return found


def _on_gpu(
    means: Float[Tensor, "n 3"], k: int, of: Int64[Tensor, " m"] | None, progress: Progress | None, team: Team
) -> Neighbors | None:
    """None where the kernel does not apply, or cannot be sure."""
    from normlift_ns.kernels import nearest  # noqa: PLC0415 (needs triton)

    finite = means.isfinite().all(dim=1)
    if means.dtype != torch.float32 or k > nearest.MOST_NEIGHBORS or not bool(finite.any()):
        return None
    every = bool(finite.all())
    points, known = means if every else means[finite], of
    if not every:  # which of the points are asked for
        of = torch.arange(len(means), device=means.device) if of is None else of
        known = (finite.cumsum(0) - 1)[of[finite[of]]]
    rows = len(means) if of is None else len(of)

    def tell(done: int) -> None:
        torch.cuda.synchronize(means.device)  # what was launched is not yet done
        if progress is not None and done < rows:
            progress(done, rows)

    found = nearest.nearest(points, k, of=known, done=None if progress is None else tell, team=team)
    unsure = (~found.certain).nonzero().squeeze(1)
    if unsure.numel() > _MOST_UNSURE:
        return None
    if unsure.numel() > 0:
        asked = unsure if known is None else known[unsure]
        for array, exact in zip(found, nearest.nearest_of_rows(points, asked, k)):
            array[unsure] = exact
    if every or of is None:
        return Neighbors(found.index, found.distance, found.spacing)
    there, name = finite[of], finite.nonzero().squeeze(1).int()
    index, distance = found.index.new_full((len(of), k), -1), found.distance.new_full((len(of), k), torch.inf)
    spacing = found.spacing.new_full((len(of),), torch.inf)
    index[there] = torch.where(found.index < 0, -1, name[found.index.clamp(min=0)])
    distance[there], spacing[there] = found.distance, found.spacing
    return Neighbors(index, distance, spacing)


def _on_cpu(
    means: Float[Tensor, "n 3"], k: int, of: Int64[Tensor, " m"] | None = None, progress: Progress | None = None
) -> Neighbors:
    points = means.detach().cpu().double().numpy()
    of_rows = np.arange(len(points)) if of is None else of.cpu().numpy()
    m, is_finite = len(of_rows), np.asarray(np.isfinite(points).all(axis=1))
    finite = np.flatnonzero(is_finite)
    index, distance, spacing = np.full((m, k), -1, dtype=np.int32), np.full((m, k), np.inf), np.full(m, np.inf)
    asked = np.flatnonzero(is_finite[of_rows])
    if finite.size > 1 and asked.size > 0:
        from scipy.spatial import KDTree  # noqa: PLC0415 (a GPU does without)

        places, place_of = np.unique(points[finite], axis=0, return_inverse=True)
        place_of = place_of.reshape(-1)
        tree, member = KDTree(places), _members(place_of, k + 1)
        me = np.searchsorted(finite, of_rows[asked])  # the number of each among the finite ones
        wanted, row_of = np.unique(place_of[me], return_inverse=True)
        which: Any = range(1, min(k + 2, len(places)) + 1)  # a sequence, so that one neighbour is still a column
        blocks = []
        for first in range(0, len(wanted), _BLOCK):
            some = wanted[first : first + _BLOCK]
            reach, near = map(np.asarray, tree.query(places[some], k=which, workers=-1))
            elsewhere = reach[:, 1] if len(places) > 1 else np.full(len(reach), np.inf)
            blocks.append((*_rank_gaussians(tree, member, some, near, reach, k + 1), elsewhere))
            if progress is not None and first + _BLOCK < len(wanted):
                progress((first + _BLOCK) * m // len(wanted), m)
        ranked, ranked_distance, nearest = (np.concatenate(parts)[row_of.reshape(-1)] for parts in zip(*blocks))
        # Leave out self; it is missing from the list only where k + 1 others share its place.
        later = np.cumsum(ranked == me[:, None], axis=1)[:, :k] > 0
        chosen = np.where(later, ranked[:, 1:], ranked[:, :k])
        index[asked] = np.where(chosen < 0, -1, finite[chosen])
        distance[asked] = np.where(later, ranked_distance[:, 1:], ranked_distance[:, :k])
        spacing[asked] = nearest
    return Neighbors(*(torch.from_numpy(x).to(means.device) for x in (index, distance, spacing)))


def _members(place_of: np.ndarray, most: int) -> np.ndarray:
    """The first Gaussians of every place, at most so many, by index; -1 where there are fewer: [places, slots]."""
    by_place = np.argsort(place_of, kind="stable")
    population = np.bincount(place_of)
    first = np.cumsum(population) - population
    slot = np.arange(min(most, population.max()))
    return np.where(slot < population[:, None], by_place[np.minimum(first[:, None] + slot, len(place_of) - 1)], -1)


def _rank_gaussians(
    tree: Any, member: np.ndarray, some: np.ndarray, near: np.ndarray, reach: np.ndarray, count: int
) -> tuple[np.ndarray, np.ndarray]:
    """For each of some places its `count` nearest Gaussians (-1 where there are fewer) and their distances, sorted by
    (distance, index).
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

    step = max(1, _MOST_RANKED // (near.shape[1] * slots))
    blocks = [rank(near[i : i + step], reach[i : i + step]) for i in range(0, len(near), step)]
    ranked, distance = (np.concatenate(parts) for parts in zip(*blocks))
    if near.shape[1] > count:  # places that tie across the end of the list: the tree kept any of them
        for row in np.flatnonzero(reach[:, count - 1] == reach[:, count]):
            place = tree.data[some[row]]
            around = np.array(tree.query_ball_point(place, reach[row, count] * (1 + 1e-12)))
            far = np.linalg.norm(tree.data[around] - place, axis=1)
            far = np.where(np.isclose(far, reach[row, count], rtol=1e-12, atol=0), reach[row, count], far)
            ranked[row : row + 1], distance[row : row + 1] = rank(around[None], far[None])
    return ranked, distance
