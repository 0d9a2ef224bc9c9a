"""Objects: the parts of a selection that hang together in space, and what is known of each."""

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
    """One object, in the scene's own units. Means are weighted by W_j, what the views saw of each Gaussian."""

    size: int
    """Number of Gaussians."""
    centroid: list[float]
    box: dict[str, list[float]]
    """The corners "min" and "max" of the box that holds the centres."""
    mean_reliability: float


@dataclass(frozen=True)
class Objects:
    """A selection as objects."""

    gaussians: int
    """Size of the selection."""
    in_smaller_parts: int
    """Gaussians of parts too small to be listed."""
    objects: list[SceneObject]
    """The largest first."""

    def to_json(self) -> dict[str, Any]:
        """The same as plain types."""
        return asdict(self)


def find_objects(
    field: SemanticField,
    means: Float[Tensor, "n 3"],
    selected: Bool[Tensor, " n"],
    *,
    reach: float = REACH,
    min_size: int = MIN_SIZE,
) -> Objects:
    """The connected components of a selection.

    Args:
        reach: as in `connected_components`.
        min_size: Gaussians of smaller components are only counted.
    Raises:
        ValueError: as `connected_components`; `min_size` < 1.
    """
    check_number("min_size", min_size, int)
    labels = connected_components(means, selected, reach=reach)
    sizes = torch.bincount(labels[labels >= 0].long())
    count = int((sizes >= min_size).sum())  # the largest come first
    return Objects(
        gaussians=int(selected.sum()),
        in_smaller_parts=int(selected.sum() - sizes[:count].sum()),
        objects=[describe_object(field, means, labels == i) for i in range(count)],
    )


def describe_object(field: SemanticField, means: Tensor, rows: Bool[Tensor, " n"]) -> SceneObject:
    """What is known of some Gaussians as one object."""
    places = means[rows].double().cpu().numpy()
    weight = field.scalars.weight[rows].double().cpu().numpy() + 1e-12
    reliability = field.scalars.reliability[rows].double().cpu().numpy()
    return SceneObject(
        size=int(rows.sum()),
        centroid=np.average(places, axis=0, weights=weight).tolist(),
        box={"min": places.min(axis=0).tolist(), "max": places.max(axis=0).tolist()},
        mean_reliability=float(np.average(reliability, weights=weight)),
    )


def connected_components(
    means: Float[Tensor, "n 3"], selected: Bool[Tensor, " n"], *, reach: float = REACH
) -> Int32[Tensor, " n"]:
    """Number of the component of every selected Gaussian, 0 for the largest; -1 where not selected.

    Two selected Gaussians hang together where one is among the 8 nearest selected neighbours of the other and not
    farther than `reach` times the median distance, over the selection, to the nearest selected one at another place.
    Components of the same size are numbered by their first Gaussian.

    Args:
        reach: > 0, in units of that median.
    Raises:
        ValueError: a reach that is not positive and finite.
    """
    check_number("reach", reach)
    from scipy.sparse import coo_array  # noqa: PLC0415 (a lift does without)
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
    count, found = components_of_graph(graph, directed=False)
    size, start = np.bincount(found, minlength=count), np.unique(found, return_index=True)[1]
    rank = np.empty(count, np.int32)
    rank[np.lexsort((start, -size))] = np.arange(count)
    labels[rows] = torch.from_numpy(rank[found])
    return labels.to(means.device)
