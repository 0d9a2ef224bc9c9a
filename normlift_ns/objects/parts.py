"""Objects: the connected components of a selection, and a summary of each."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float, Int32
from torch import Tensor

from normlift_ns.core.field import SemanticField
from normlift_ns.core.neighbors import nearest_neighbors
from normlift_ns.options import MIN_SIZE, REACH
from normlift_ns.ranges import check_number

_NEIGHBORS = 8


@dataclass(frozen=True)
class SceneObject:
    """One object, in units of the scene; means are weighted by W_j, the total weight of Gaussian j over all views."""

    size: int
    """Number of Gaussians."""
    centroid: list[float]
    box: dict[str, list[float]]
    """Corners "min" and "max" of the axis-aligned box of the centers."""
    mean_reliability: float


@dataclass(frozen=True)
class Objects:
    """A selection, divided into objects."""

    gaussians: int
    """Number of selected Gaussians."""
    in_smaller_parts: int
    """Number of those in components that are too small to be listed."""
    objects: list[SceneObject]
    """Objects by descending size."""

    def to_json(self) -> dict[str, Any]:
        """Return all fields as plain Python types."""
        return asdict(self)


def find_objects(
    field: SemanticField,
    means: Float[Tensor, "n 3"],
    selected: Bool[Tensor, " n"],
    *,
    reach: float = REACH,
    min_size: int = MIN_SIZE,
) -> Objects:
    """Divide a selection into objects, its connected components.

    Args:
        reach: as in `connected_components`.
        min_size: components with fewer Gaussians are counted but not listed.
    Raises:
        ValueError: `min_size` is less than 1, or as in `connected_components`.
    """
    check_number("min_size", min_size, int)
    labels = connected_components(means, selected, reach=reach)
    sizes = torch.bincount(labels[labels >= 0].long())
    count = int((sizes >= min_size).sum())  # sizes are in descending order
    return Objects(
        gaussians=int(selected.sum()),
        in_smaller_parts=int(selected.sum() - sizes[:count].sum()),
        objects=[describe_object(field, means, labels == i) for i in range(count)],
    )


def describe_object(field: SemanticField, means: Tensor, rows: Bool[Tensor, " n"]) -> SceneObject:
    """Summarize some Gaussians as one object."""
    centers = means[rows].double().cpu().numpy()
    weight = field.scalars.weight[rows].double().cpu().numpy() + 1e-12
    reliability = field.scalars.reliability[rows].double().cpu().numpy()
    return SceneObject(
        size=int(rows.sum()),
        centroid=np.average(centers, axis=0, weights=weight).tolist(),
        box={"min": centers.min(axis=0).tolist(), "max": centers.max(axis=0).tolist()},
        mean_reliability=float(np.average(reliability, weights=weight)),
    )


def connected_components(
    means: Float[Tensor, "n 3"], selected: Bool[Tensor, " n"], *, reach: float = REACH
) -> Int32[Tensor, " n"]:
    """Label each selected Gaussian with its connected component, 0 for the largest; label the others -1.

    Two selected Gaussians are connected if one is among the 8 nearest selected neighbors of the other, within `reach`
    times the median spacing. The spacing of a selected Gaussian is its distance to the nearest selected one at a
    different position. Components of equal size are ordered by their first Gaussian.

    Args:
        reach: maximum distance in units of the median spacing, > 0.
    Raises:
        ValueError: `reach` is not positive and finite.
    """
    check_number("reach", reach)
    from scipy.sparse import coo_array  # noqa: PLC0415 (a lift does not need it)
    from scipy.sparse.csgraph import connected_components as components_of_graph  # noqa: PLC0415

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
    count, component = components_of_graph(graph, directed=False)
    size, start = np.bincount(component, minlength=count), np.unique(component, return_index=True)[1]
    rank = np.empty(count, np.int32)
    rank[np.lexsort((start, -size))] = np.arange(count)
    labels[rows] = torch.from_numpy(rank[component])
    return labels.to(means.device)
