"""A selection as a table of objects."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from jaxtyping import Bool
from torch import Tensor

from normlift_ns.core.components import connected_components
from normlift_ns.core.field import SemanticField
from normlift_ns.core.gaussians import GaussianScene


def object_table(
    field: SemanticField, scene: GaussianScene, selected: Bool[Tensor, " n"], *, reach: float = 4.0, min_size: int = 20
) -> dict[str, Any]:
    """The connected components of a selection, largest first, ready for JSON.

    Each has its size in Gaussians, the centroid and the mean reliability, both weighted by W_j, what the views saw of
    each Gaussian, and the box that holds the centres, all in the scene's own units.

    Args:
        reach: as in `connected_components`.
        min_size: Gaussians of smaller components are only counted.
    """
    labels = connected_components(scene.means, selected, reach=reach)
    sizes = torch.bincount(labels[labels >= 0].long())
    count = int((sizes >= min_size).sum())  # the largest come first
    return {
        "gaussians": int(selected.sum()),
        "in_smaller_parts": int(selected.sum() - sizes[:count].sum()),
        "objects": [_facts(field, scene, labels == i) for i in range(count)],
    }


def _facts(field: SemanticField, scene: GaussianScene, rows: Bool[Tensor, " n"]) -> dict[str, Any]:
    means = scene.means[rows].double().numpy()
    weight = field.scalars.weight[rows].double().numpy() + 1e-12
    reliability = field.scalars.reliability[rows].double().numpy()
    return {
        "size": int(rows.sum()),
        "centroid": np.average(means, axis=0, weights=weight).tolist(),
        "box": {"min": means.min(axis=0).tolist(), "max": means.max(axis=0).tolist()},
        "mean_reliability": float(np.average(reliability, weights=weight)),
    }
