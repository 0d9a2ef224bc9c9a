"""Objects: parts of a selection that hang together in space."""

from __future__ import annotations

import numpy as np
import torch
from jaxtyping import Bool, Float, Int32
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components as scipy_components
from torch import Tensor

from normlift_ns.core.neighbors import nearest_neighbors

_NEIGHBORS = 8


def connected_components(
    means: Float[Tensor, "n 3"], selected: Bool[Tensor, " n"], *, reach: float = 4.0
) -> Int32[Tensor, " n"]:
    """Number of the component of every selected Gaussian, 0 for the largest; -1 where not selected.

    Two selected Gaussians hang together where one is among the 8 nearest selected neighbours of the other and not
    farther than `reach` times the median distance, over the selection, to the nearest selected one at another place.
    Components of the same size are numbered by their first Gaussian.

    Args:
        reach: > 0, in units of that median.
    """
    labels = torch.full((len(means),), -1, dtype=torch.int32)
    rows = (selected.cpu() & means.cpu().isfinite().all(dim=1)).nonzero().squeeze(1)
    if len(rows) == 0:
        return labels.to(means.device)
    neighbors = nearest_neighbors(means.cpu()[rows], _NEIGHBORS)
    spacing = neighbors.spacing[neighbors.spacing.isfinite()]
    limit = reach * float(spacing.median()) if len(spacing) > 0 else 0.0
    near = ((neighbors.index >= 0) & (neighbors.distance <= limit)).numpy()
    first, slot = np.nonzero(near)
    second = neighbors.index.numpy()[first, slot]
    graph = coo_array((np.ones(len(first), bool), (first, second)), shape=(len(rows), len(rows)))
    count, found = scipy_components(graph, directed=False)
    size, start = np.bincount(found, minlength=count), np.unique(found, return_index=True)[1]
    rank = np.empty(count, np.int32)
    rank[np.lexsort((start, -size))] = np.arange(count)
    labels[rows] = torch.from_numpy(rank[found])
    return labels.to(means.device)
