"""A few numbers about the Gaussians that a text selects."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Float

_CENTRAL = (0.05, 0.95)


@dataclass(frozen=True, eq=False)
class Selection:
    """M selected Gaussians of N. Places are in the scene's own units; None where nothing is selected.

    Means are weighted by W_j, what the views saw of each Gaussian.
    """

    total: int
    """N."""
    means: Float[np.ndarray, "m 3"]
    reliability: Float[np.ndarray, " m"]
    weight: Float[np.ndarray, " m"]
    """W_j."""

    @property
    def fraction(self) -> float:
        """Share of all Gaussians that is selected."""
        return len(self.means) / self.total

    @property
    def centroid(self) -> list[float] | None:
        """Weighted mean of the selected centres, x, y, z."""
        return (self._share @ self.means.astype(np.float64)).tolist() if len(self.means) > 0 else None

    @property
    def extent(self) -> list[float] | None:
        """Size of the box that holds the central 90 % of the selected centres along each axis."""
        if len(self.means) == 0:
            return None
        low, high = np.quantile(self.means.astype(np.float64), _CENTRAL, axis=0)
        return (high - low).tolist()

    @property
    def mean_reliability(self) -> float | None:
        """Weighted mean of R of the selected Gaussians."""
        return float(self._share @ self.reliability.astype(np.float64)) if len(self.means) > 0 else None

    @cached_property
    def _share(self) -> Float[np.ndarray, " m"]:
        weight = self.weight.astype(np.float64) + 1e-12
        return weight / weight.sum()
