"""How directions are stored: as the evidence (exact), in float16, or as float16 coordinates in a basis."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Float16, Int
from torch import Tensor

from normlift_ns.core.evidence import Evidence
from normlift_ns.core.lift import Lifted, Scalars
from normlift_ns.core.lowrank import Basis, half_precision_error
from normlift_ns.core.portions import Portion

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


def store_evidence(lifted: Lifted, portion: Portion) -> StoredEvidence | None:
    """E and F of all portions, at process 0 alone."""
    rows, unlabeled = (portion.deliver_sparse(x) for x in (lifted.evidence.rows, lifted.evidence.unlabeled))
    if rows is None or unlabeled is None:
        return None
    return StoredEvidence(replace(lifted.evidence, rows=rows, unlabeled=unlabeled), lifted.features.float())


def store_directions(lifted: Lifted, basis: Tensor | None, portion: Portion) -> StoredDirections | None:
    """Directions of the Gaussians with evidence in float16, in the basis if there is one, at process 0 alone.

    Rounding may depend on which rows are multiplied together, so that these are the same for every team.
    """
    dimension = lifted.features.shape[1] if basis is None else len(basis)
    found, blocks = lifted.scalars.norm > 0, [lifted.features.new_zeros(0, dimension, dtype=torch.float16)]
    rows_of = [found.new_zeros(0, dtype=torch.int64)]
    for block in portion.blocks():
        rows_of.append(block[found[block]])
        rows = lifted.directions(rows_of[-1])
        blocks.append((rows if basis is None else torch.nn.functional.normalize(rows.double() @ basis.T, dim=1)).half())
    coordinates, gaussians = torch.cat(blocks), portion.gaussians[torch.cat(rows_of)]
    blocks.clear()
    parts, numbers = portion.team.deliver(coordinates), portion.team.deliver(gaussians)
    if parts is None or numbers is None:
        return None
    row_of = torch.zeros(len(portion.order) + 1, dtype=torch.int64, device=found.device)
    for number in numbers:
        row_of[number + 1] = 1
    row_of = row_of.cumsum(0)
    stored = coordinates.new_empty(sum(map(len, parts)), dimension)
    for number, part in zip(numbers, parts):
        stored[row_of[number]] = part
    return StoredDirections(stored, None if basis is None else basis.float())


def sizes_and_bounds(lifted: Lifted, basis: Basis | None, portion: Portion) -> dict[str, dict[str, Any]]:
    """What each way of storage costs in bytes, beside scalars and source, and the most that it can change a cosine."""
    found, evidence, team = lifted.scalars.norm > 0, lifted.evidence, portion.team
    sizes = [found.sum(), found.new_tensor(evidence.nnz, dtype=torch.int64), evidence.unlabeled.offsets[-1]]
    with_evidence, *entries = team.add(torch.stack(sizes)).tolist()
    dimension, matrices = lifted.features.shape[1], (evidence.rows, evidence.unlabeled)
    exact = 4 * (lifted.features.numel() + evidence.num_regions)
    for count, rows in zip(entries, matrices):
        exact += 8 * (len(portion.order) + 1) + count * (4 + rows.weight.element_size())
    options: dict[str, dict[str, Any]] = {
        "evidence": {"bytes": exact, "bound": 0.0},
        "float16": {"bytes": 2 * with_evidence * dimension, "bound": half_precision_error(dimension)},
    }
    if basis is not None:
        rank = len(basis.rows)
        bounds = team.join(basis.bound[found]).cpu().numpy() if with_evidence > 0 else np.zeros(1)
        quantiles = np.quantile(bounds, _QUANTILES) + half_precision_error(rank)
        options["low_rank"] = {
            "bytes": 2 * with_evidence * rank + 4 * rank * dimension,
            "bound": float(quantiles[-1]),
            "rank": rank,
            "bound_quantiles": dict(zip(map(str, _QUANTILES), quantiles.tolist())),
        }
    return options
