"""Summary numbers of the Gaussians that a prompt selects."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Float

_CENTRAL = (0.05, 0.95)


@dataclass(frozen=True, eq=False)
class Selection:
    """M selected Gaussians of N.

    Positions are in units of the scene, and None if nothing is selected. Means are weighted by W_j, the total weight of
    Gaussian j over all views.
    """

    total: int
    """N, the number of Gaussians of the scene."""
    means: Float[np.ndarray, "m 3"]
    reliability: Float[np.ndarray, " m"]
    weight: Float[np.ndarray, " m"]
    """W_j of the selected Gaussians."""

    @property
    def fraction(self) -> float:
        """Fraction of all Gaussians that is selected, in 0..1."""
        return len(self.means) / self.total

    @property
    def centroid(self) -> list[float] | None:
        """Weighted mean of the selected centers, [x, y, z]."""
        return (self._normalized_weight @ self.means.astype(np.float64)).tolist() if len(self.means) > 0 else None

    @property
    def extent(self) -> list[float] | None:
        """Size of the box that holds the central 90 % of the selected centers along each axis."""
        if len(self.means) == 0:
            return None
        low, high = np.quantile(self.means.astype(np.float64), _CENTRAL, axis=0)
        return (high - low).tolist()

    @property
    def mean_reliability(self) -> float | None:
        """Weighted mean of R over the selected Gaussians."""
        return float(self._normalized_weight @ self.reliability.astype(np.float64)) if len(self.means) > 0 else None

    @cached_property
    def _normalized_weight(self) -> Float[np.ndarray, " m"]:
        weight = self.weight.astype(np.float64) + 1e-12
        return weight / weight.sum()
