"""Summaries of many prompts, computed together on a GPU. They equal those of `Finding.to_json` up to rounding.

Sums, sorts and counts over Gaussians are operations on blocks of prompts. Only a few numbers per prompt are copied to
the CPU, where `query.threshold` computes the rest.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float, Float64, Int64
from torch import Tensor

from normlift_ns.query.threshold import Histogram, make_histograms, picked_ranks

_CENTRAL = (0.05, 0.95)
"""Quantiles of the selected centers that bound their extent."""
_BLOCK_ELEMENTS = 2**24
"""Number of relevancies that are sorted at a time."""


def summarize(
    relevancy: Float[Tensor, "n q"],
    selected: Bool[Tensor, "n q"],
    valid: Bool[Tensor, " n"],
    means: Float[Tensor, "n 3"],
    reliability: Float[Tensor, " n"],
    weight: Float[Tensor, " n"],
    *,
    threshold: float,
    positions: tuple[float, float],
) -> list[dict[str, Any]]:
    """Return the entries of `query.engine.Finding.to_json` for each prompt, except text, verdict and read_as.

    Args:
        valid: True for Gaussians that have a direction, of which there must be at least one.
        threshold: Relevancy above which a Gaussian is selected, for the histograms.
        positions: Result of `suggested_range`.
    """
    values = torch.cat([means, reliability[:, None], torch.ones_like(means[:, :1])], dim=1).double()
    weighted = (weight.double() + 1e-12)[:, None] * values
    ascending = [means[:, axis].double().sort() for axis in range(3)]
    step = max(1, _BLOCK_ELEMENTS // len(means))
    found = []
    for first in range(0, relevancy.shape[1], step):
        block, inside = (x[:, first : first + step].T.contiguous() for x in (relevancy, selected))
        sorted_block = block[:, valid].sort(dim=1).values
        histograms = _histograms(sorted_block, threshold, positions)
        top = block.new_tensor([histogram.top for histogram in histograms])
        near = _weighted_means(valid & (block >= top[:, None]), weighted)
        rows = zip(
            histograms, inside.sum(dim=1).tolist(), _weighted_means(inside, weighted),
            _extents(inside, ascending), near, sorted_block[:, -1].tolist(),
        )  # fmt: skip
        for histogram, count, mean, extent, nearest, peak in rows:
            found.append(
                {
                    "fraction": count / len(means),
                    "centroid": mean[:3] if count > 0 else None,
                    "extent": extent if count > 0 else None,
                    "peak": peak,
                    "mean_reliability": mean[3] if count > 0 else None,
                    "nearest": nearest[:3],
                    "suggested_threshold": histogram.suggested,
                    "histogram": histogram.to_json(),
                }
            )
    return found


def _histograms(values: Float[Tensor, "q m"], threshold: float, positions: tuple[float, float]) -> list[Histogram]:
    """Return the histogram of each prompt from its relevancies in ascending order."""
    count, exact = values.shape[1], values.double()

    def count_below(edges: Float64[np.ndarray, "q e"]) -> Int64[np.ndarray, "q e"]:
        return torch.searchsorted(exact, torch.from_numpy(edges).to(exact.device).contiguous()).cpu().numpy()

    picked = exact[:, picked_ranks(count)].cpu().numpy()
    return make_histograms(picked, count_below, count, threshold, positions)


def _weighted_means(chosen: Bool[Tensor, "q n"], weighted: Float64[Tensor, "n 5"]) -> list[list[float]]:
    """Return the weighted mean of x, y, z and R over the Gaussians that are chosen for each prompt.

    Args:
        weighted: x, y, z and R of every Gaussian, multiplied by its weight, and the weight itself.
    """
    sums = chosen.double() @ weighted
    return (sums[:, :4] / sums[:, 4:]).tolist()


def _extents(
    chosen: Bool[Tensor, "q n"], ascending: Sequence[tuple[Float64[Tensor, " n"], Int64[Tensor, " n"]]]
) -> list[list[float]]:
    """Return, for each prompt, the distance along each axis between the quantiles `_CENTRAL` of the chosen centers.

    Args:
        ascending: Sorted coordinates of all centers and the indices that sort them, one pair per axis.
    """
    extents = []
    for values, order in ascending:
        number = chosen[:, order].cumsum(dim=1, dtype=torch.int32)
        bounds = []
        for quantile in _CENTRAL:
            place = (number[:, -1:] - 1).clamp(min=0).double() * quantile
            low = place.int()
            ranks = torch.cat([low, low + 1], dim=1) + 1
            at = torch.searchsorted(number, ranks.minimum(number[:, -1:])).clamp(max=len(values) - 1)
            below, above = values[at].unbind(dim=1)
            bounds.append(torch.lerp(below, above, (place - low).squeeze(1)))
        extents.append(bounds[1] - bounds[0])
    return torch.stack(extents, dim=1).tolist()
