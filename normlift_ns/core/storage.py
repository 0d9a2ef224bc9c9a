"""Storage forms of directions: the evidence (exact), float16, and float16 coordinates in a basis."""

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
"""Number of elements that a query converts to float32 at a time. Blocks that fit into the CPU cache are four times as
fast."""


@dataclass(frozen=True)
class StoredEvidence:
    """E and F themselves: exact, and E can be reused with another encoder."""

    evidence: Evidence
    features: Float[Tensor, "s d"]

    def to(self, device: torch.device | str) -> StoredEvidence:
        """Return a copy on another device."""
        return StoredEvidence(self.evidence.to(device), self.features.to(device))

    def products(self, vectors: Float[Tensor, "q d"], scalars: Scalars) -> Float[Tensor, "n q"]:
        """Return cosines to unit vectors, 0 without evidence: E (F t) / (W_j ||f_j||), computed in float64."""
        table = self.features.double() @ vectors.double().T
        length = scalars.weight.double() * scalars.norm.double()
        sums = self.evidence.rows.matmul(table)
        return torch.where((length > 0)[:, None], sums / length[:, None], 0.0).clamp(-1, 1).float()

    def directions(self, gaussians: Int[Tensor, " m"], scalars: Scalars) -> Float[Tensor, "m d"]:
        """Return the unit directions of some Gaussians, 0 without evidence."""
        sums = self.evidence.rows.select_rows(gaussians).sums_of_unit_rows(self.features)
        mask = (scalars.norm[gaussians] > 0)[:, None]
        return torch.where(mask, sums / torch.linalg.vector_norm(sums, dim=1, keepdim=True), 0.0).float()


@dataclass(frozen=True)
class StoredDirections:
    """Directions of the M Gaussians with evidence, in float16, either directly or as coordinates in a basis."""

    coordinates: Float16[Tensor, "m r"]
    basis: Float[Tensor, "r d"] | None

    def to(self, device: torch.device | str) -> StoredDirections:
        """Return a copy on another device."""
        return StoredDirections(self.coordinates.to(device), None if self.basis is None else self.basis.to(device))

    def products(self, vectors: Float[Tensor, "q d"], scalars: Scalars) -> Float[Tensor, "n q"]:
        """Return cosines to unit vectors, 0 without evidence."""
        projected = vectors.float() if self.basis is None else vectors.float() @ self.basis.T
        out = vectors.new_zeros(scalars.norm.numel(), len(vectors), dtype=torch.float32)
        step = max(1, (_GPU_BLOCK if self.coordinates.is_cuda else _CPU_BLOCK) // projected.shape[1])
        out[scalars.norm > 0] = torch.cat([block.float() @ projected.T for block in self.coordinates.split(step)])
        return out.clamp_(-1, 1)

    def directions(self, gaussians: Int[Tensor, " m"], scalars: Scalars) -> Float[Tensor, "m d"]:
        """Return the unit directions of some Gaussians, 0 without evidence."""
        mask = scalars.norm > 0
        row = (mask.cumsum(0) - 1)[gaussians].clamp(min=0)
        rows = self.coordinates[row].float() if self.basis is None else self.coordinates[row].float() @ self.basis
        return torch.where(mask[gaussians][:, None], torch.nn.functional.normalize(rows, dim=1), 0.0)


def store_evidence(lifted: Lifted, portion: Portion) -> StoredEvidence | None:
    """Return E and F of all portions in process 0, and None in the others."""
    rows, unlabeled = (portion.deliver_sparse(x) for x in (lifted.evidence.rows, lifted.evidence.unlabeled))
    if rows is None or unlabeled is None:
        return None
    return StoredEvidence(replace(lifted.evidence, rows=rows, unlabeled=unlabeled), lifted.features.float())


def store_directions(lifted: Lifted, basis: Tensor | None, portion: Portion) -> StoredDirections | None:
    """Return the directions of all Gaussians with evidence in process 0, and None in the others.

    Rounding may depend on which rows are multiplied together. Blocks are therefore the same for any number of
    processes.

    Args:
        basis: rows of the basis for coordinates; None: directions are stored directly.
    """
    dimension = lifted.features.shape[1] if basis is None else len(basis)
    mask, blocks = lifted.scalars.norm > 0, [lifted.features.new_zeros(0, dimension, dtype=torch.float16)]
    rows_of = [mask.new_zeros(0, dtype=torch.int64)]
    for block in portion.blocks():
        rows_of.append(block[mask[block]])
        rows = lifted.directions(rows_of[-1])
        blocks.append((rows if basis is None else torch.nn.functional.normalize(rows.double() @ basis.T, dim=1)).half())
    coordinates, gaussians = torch.cat(blocks), portion.gaussians[torch.cat(rows_of)]
    blocks.clear()
    parts, indices = portion.team.deliver(coordinates), portion.team.deliver(gaussians)
    if parts is None or indices is None:
        return None
    row_of = torch.zeros(len(portion.order) + 1, dtype=torch.int64, device=mask.device)
    for index in indices:
        row_of[index + 1] = 1
    row_of = row_of.cumsum(0)
    stored = coordinates.new_empty(sum(map(len, parts)), dimension)
    for index, part in zip(indices, parts):
        stored[row_of[index]] = part
    return StoredDirections(stored, None if basis is None else basis.float())


def sizes_and_bounds(lifted: Lifted, basis: Basis | None, portion: Portion) -> dict[str, dict[str, Any]]:
    """Return the size in bytes of each storage form, without scalars and source, and its bound on the cosine error."""
    mask, evidence, team = lifted.scalars.norm > 0, lifted.evidence, portion.team
    sizes = [mask.sum(), mask.new_tensor(evidence.nnz, dtype=torch.int64), evidence.unlabeled.offsets[-1]]
    with_evidence, *entries = team.add(torch.stack(sizes)).tolist()
    dimension, matrices = lifted.features.shape[1], (evidence.rows, evidence.unlabeled)
    exact = 4 * (lifted.features.numel() + evidence.num_regions)
    for count, rows in zip(entries, matrices):
        exact += 8 * (len(portion.order) + 1) + count * (4 + rows.weight.element_size())
    forms: dict[str, dict[str, Any]] = {
        "evidence": {"bytes": exact, "bound": 0.0},
        "float16": {"bytes": 2 * with_evidence * dimension, "bound": half_precision_error(dimension)},
    }
    if basis is not None:
        rank = len(basis.rows)
        bounds = team.join(basis.bound[mask]).cpu().numpy() if with_evidence > 0 else np.zeros(1)
        quantiles = np.quantile(bounds, _QUANTILES) + half_precision_error(rank)
        forms["low_rank"] = {
            "bytes": 2 * with_evidence * rank + 4 * rank * dimension,
            "bound": float(quantiles[-1]),
            "rank": rank,
            "bound_quantiles": dict(zip(map(str, _QUANTILES), quantiles.tolist())),
        }
    return forms
