"""Summaries of many prompts at once, for answers on a GPU. They equal those of `Finding.to_json` up to rounding.

The sums, sorts and counts over Gaussians are operations on blocks of prompts. Only a few numbers per prompt leave the
GPU, from which the functions of `query.engine` compute the rest.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from jaxtyping import Bool, Float, Float64, Int64
from torch import Tensor

from normlift_ns.query import engine

if TYPE_CHECKING:
    from normlift_ns.query.engine import Answer

_BLOCK_ELEMENTS = 2**24
"""Number of relevancies that are sorted at a time."""


def summarize(answer: Answer) -> list[dict[str, Any]]:
    """Return the result of `Finding.to_json` for each prompt of an answer of torch tensors with a valid Gaussian."""
    scalars = answer.field.scalars
    weight, reliability, means = (x.double() for x in (scalars.weight, scalars.reliability, answer.means))
    weighted = (weight + 1e-12)[:, None] * torch.cat([means, reliability[:, None], torch.ones_like(means[:, :1])], 1)
    ascending = [means[:, axis].sort() for axis in range(3)]
    step = max(1, _BLOCK_ELEMENTS // len(means))
    found = []
    for first in range(0, len(answer), step):
        relevancy, selected = (x[:, first : first + step].T.contiguous() for x in (answer.relevancy, answer.selected))
        values = relevancy[:, answer.valid].sort(dim=1).values
        histograms = _histograms(values, answer)
        top = relevancy.new_tensor([histogram.top for histogram in histograms])
        near = _weighted_means(answer.valid & (relevancy >= top[:, None]), weighted)
        rows = zip(
            histograms, selected.sum(dim=1).tolist(), _weighted_means(selected, weighted),
            _extents(selected, ascending), near, values[:, -1].tolist(),
        )  # fmt: skip
        for index, (histogram, count, inside, extent, nearest, peak) in enumerate(rows, first):
            finding, verdict = engine.Finding(answer, index), answer.verdicts[index]
            found.append(
                {
                    "text": finding.text,
                    "fraction": count / len(means),
                    "centroid": inside[:3] if count > 0 else None,
                    "extent": extent if count > 0 else None,
                    "peak": peak,
                    "mean_reliability": inside[3] if count > 0 else None,
                    "verdict": "weak match" if verdict == "probably not here" and count > 0 else verdict,
                    "nearest": nearest[:3],
                    "read_as": finding.read_as,
                    "suggested_threshold": histogram.suggested,
                    "histogram": histogram.to_json(),
                }
            )
    return found


def _histograms(values: Float[Tensor, "q m"], answer: Answer) -> list[engine.Histogram]:
    """Return the histogram of each prompt from relevancies in ascending order."""
    count, exact = values.shape[1], values.double()

    def count_below(edges: Float64[np.ndarray, "q e"]) -> Int64[np.ndarray, "q e"]:
        return torch.searchsorted(exact, torch.from_numpy(edges).to(exact.device).contiguous()).cpu().numpy()

    picked = exact[:, engine.picked_ranks(count)].cpu().numpy()
    positions = engine.suggested_range(answer.field)
    return engine.make_histograms(picked, count_below, count, answer.question.threshold, positions)


def _weighted_means(chosen: Bool[Tensor, "q n"], weighted: Float64[Tensor, "n 5"]) -> list[list[float]]:
    """Return the weighted means of the chosen centers and reliabilities; the last column holds the weights."""
    sums = chosen.double() @ weighted
    return (sums[:, :4] / sums[:, 4:]).tolist()


def _extents(
    chosen: Bool[Tensor, "q n"], ascending: Sequence[tuple[Float64[Tensor, " n"], Int64[Tensor, " n"]]]
) -> list[list[float]]:
    """Return the distances between the quantiles of the chosen centers along each axis.

    Args:
        ascending: The coordinates in ascending order and the Gaussian of each, one pair per axis.
    """
    extents = []
    for values, order in ascending:
        number = chosen[:, order].cumsum(dim=1, dtype=torch.int32)
        bounds = []
        for quantile in engine.CENTRAL:
            place = (number[:, -1:] - 1).clamp(min=0).double() * quantile
            low = place.int()
            ranks = torch.cat([low, low + 1], dim=1) + 1
            at = torch.searchsorted(number, ranks.minimum(number[:, -1:])).clamp(max=len(values) - 1)
            below, above = values[at].unbind(dim=1)
            bounds.append(torch.lerp(below, above, (place - low).squeeze(1)))
        extents.append(bounds[1] - bounds[0])
    return torch.stack(extents, dim=1).tolist()
