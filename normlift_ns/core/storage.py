"""How directions are stored: as the evidence (exact), in float16, or as float16 coordinates in a basis."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Float16, Int
from torch import Tensor

from normlift_ns.core.evidence import Evidence
from normlift_ns.core.lift import Lifted, Scalars
from normlift_ns.core.lowrank import Basis, half_precision_error

_QUANTILES = (0.0, 0.5, 0.9, 0.99, 1.0)
_CPU_BLOCK, _GPU_BLOCK = 2**21, 2**25
"""Elements converted to float32 at once for a query; few stay in a processor's cache, which is four times as fast."""


@dataclass(frozen=True)
class StoredEvidence:
    """E and F themselves: exact, and ready for another encoder."""

    evidence: Evidence
    features: Float[Tensor, "s d"]

    def to(self, device: torch.device | str) -> StoredEvidence:
        """A copy on another device."""
        return StoredEvidence(self.evidence.to(device), self.features.to(device))

    def products(self, vectors: Float[Tensor, "q d"], scalars: Scalars) -> Float[Tensor, "n q"]:
        """Cosines to unit vectors, 0 without evidence: E (F t) / (W_j ||f_j||), in float64."""
        table = self.features.double() @ vectors.double().T
        length = scalars.weight.double() * scalars.norm.double()
        sums = self.evidence.rows.matmul(table)
        return torch.where((length > 0)[:, None], sums / length[:, None], 0.0).clamp(-1, 1).float()

    def directions(self, gaussians: Int[Tensor, " m"], scalars: Scalars) -> Float[Tensor, "m d"]:
        """Unit directions of some Gaussians, 0 without evidence."""
        sums = self.evidence.rows.select_rows(gaussians).sums_of_unit_rows(self.features)
        found = (scalars.norm[gaussians] > 0)[:, None]
        return torch.where(found, sums / torch.linalg.vector_norm(sums, dim=1, keepdim=True), 0.0).float()


@dataclass(frozen=True)
class StoredDirections:
    """Directions in float16, of the M Gaussians with evidence only, as they are or as coordinates in a basis."""

    coordinates: Float16[Tensor, "m r"]
    basis: Float[Tensor, "r d"] | None

    def to(self, device: torch.device | str) -> StoredDirections:
        """A copy on another device."""
        return StoredDirections(self.coordinates.to(device), None if self.basis is None else self.basis.to(device))

    def products(self, vectors: Float[Tensor, "q d"], scalars: Scalars) -> Float[Tensor, "n q"]:
        """Cosines to unit vectors, 0 without evidence."""
        projected = vectors.float() if self.basis is None else vectors.float() @ self.basis.T
        out = vectors.new_zeros(scalars.norm.numel(), len(vectors), dtype=torch.float32)
        step = max(1, (_GPU_BLOCK if self.coordinates.is_cuda else _CPU_BLOCK) // projected.shape[1])
        out[scalars.norm > 0] = torch.cat([block.float() @ projected.T for block in self.coordinates.split(step)])
        return out.clamp_(-1, 1)

    def directions(self, gaussians: Int[Tensor, " m"], scalars: Scalars) -> Float[Tensor, "m d"]:
        """Unit directions of some Gaussians, 0 without evidence."""
        found = scalars.norm > 0
        row = (found.cumsum(0) - 1)[gaussians].clamp(min=0)
        rows = self.coordinates[row].float() if self.basis is None else self.coordinates[row].float() @ self.basis
        return torch.where(found[gaussians][:, None], torch.nn.functional.normalize(rows, dim=1), 0.0)


def evidence_bytes(evidence: Evidence) -> int:
    """Bytes of the evidence's arrays."""
    rows, blank = evidence.rows, evidence.unlabeled
    arrays = (rows.offsets, rows.column, rows.weight, evidence.region_view, blank.offsets, blank.column, blank.weight)
    return sum(a.numel() * a.element_size() for a in arrays)


def store_directions(lifted: Lifted, basis: Tensor | None) -> StoredDirections:
    """Directions of the Gaussians with evidence in float16, in the basis if there is one."""
    blocks = []
    for first, block in lifted.iter_directions():
        rows = block[lifted.scalars.norm[first : first + len(block)] > 0]
        blocks.append((rows if basis is None else torch.nn.functional.normalize(rows.double() @ basis.T, dim=1)).half())
    return StoredDirections(torch.cat(blocks), None if basis is None else basis.float())


def sizes_and_bounds(lifted: Lifted, basis: Basis | None) -> dict[str, dict[str, Any]]:
    """What each way of storage costs in bytes, beside scalars and source, and the most that it can change a cosine."""
    found = lifted.scalars.norm > 0
    with_evidence, dimension = int(found.sum()), lifted.features.shape[1]
    exact = evidence_bytes(lifted.evidence) + 4 * lifted.features.numel()
    options: dict[str, dict[str, Any]] = {
        "evidence": {"bytes": exact, "bound": 0.0},
        "float16": {"bytes": 2 * with_evidence * dimension, "bound": half_precision_error(dimension)},
    }
    if basis is not None:
        rank = len(basis.rows)
        bounds = basis.bound[found].cpu().numpy() if with_evidence > 0 else np.zeros(1)
        quantiles = np.quantile(bounds, _QUANTILES) + half_precision_error(rank)
        options["low_rank"] = {
            "bytes": 2 * with_evidence * rank + 4 * rank * dimension,
            "bound": float(quantiles[-1]),
            "rank": rank,
            "bound_quantiles": dict(zip(map(str, _QUANTILES), quantiles.tolist())),
        }
    return options
