"""Errors of a lift on a GPU compared with float64, in samples."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import torch

from normlift_ns import Evidence, Lifted, RefineConfig, lift, rasterize_evidence, refine
from research.cpu import relative_difference
from research.gpu_cases import Case

SAMPLE = 20_000
"""Number of sampled Gaussians."""


def evidence_error(case: Case, evidence: Evidence) -> float:
    """Return the relative Frobenius difference from the float64 reference, in the first view."""
    exact = rasterize_evidence(
        case.scene, case.cameras[:1], case.labels[:1], num_regions=case.counts[:1], dtype=torch.float64
    )
    return relative_difference(evidence.select_views([0]).rows, exact.rows)


def lift_errors(case: Case, evidence: Evidence, table: torch.Tensor, lifted: Lifted) -> tuple[float, float]:
    """Return the largest error of R, and of a direction, in a sample of Gaussians."""
    rows = sample_rows(len(case.scene))
    chosen = evidence.rows.select_rows(rows)
    part = Evidence(
        replace(chosen, weight=chosen.weight.double()),
        evidence.region_view,
        evidence.unlabeled.select_rows(rows),
        evidence.num_views,
    )
    exact = lift(part, table.double())
    reliability = (lifted.scalars.reliability[rows].double() - exact.scalars.reliability).abs().max()
    turned = (lifted.directions(rows).double() - exact.directions()).norm(dim=1).max()
    return float(reliability), float(turned)


def vote_errors(case: Case, lifted: Lifted, config: RefineConfig, neighbors: Any, source: torch.Tensor) -> float:
    """Return the share of sampled Gaussians whose refined direction differs by more than 1e-3 from that of a float64
    vote.

    Copying another Gaussian with the same direction is not an error, for example if only one region contains both.
    """
    rows = sample_rows(len(case.scene))[:: SAMPLE // 2000]
    group = torch.cat([rows[:, None], neighbors.index[rows].long()], dim=1)
    used, local = group.unique(return_inverse=True)
    exact = lifted.directions(used).double()
    k = config.k
    near = type(neighbors)(
        torch.full((len(used), k), -1, device=used.device, dtype=torch.int32),
        torch.full((len(used), k), torch.inf, device=used.device, dtype=torch.float64),
        neighbors.spacing,
    )
    near.index[local[:, 0]] = local[:, 1:].int()
    near.distance[local[:, 0]] = neighbors.distance[rows].double()
    numbers = lifted.scalars.map(lambda values: values[used].double())
    given = {"own": numbers.own_evidence, "neighbors": near}
    found = refine(case.scene.means[used].double(), exact, numbers.reliability, config, **given)[local[:, 0]]
    ours = torch.searchsorted(used, source[rows].long())
    return float(((exact[found.long()] - exact[ours]).norm(dim=1) > 1e-3).float().mean())


def sample_rows(n: int) -> torch.Tensor:
    return torch.randint(0, n, (SAMPLE,), generator=torch.Generator().manual_seed(0)).unique().cuda()
