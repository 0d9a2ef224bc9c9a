"""Storage forms of directions, and low-rank bases of the feature table with a query error bound per Gaussian."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import torch
from jaxtyping import Float, Float16, Float64, Int, Int64
from torch import Tensor

from normlift_ns.core.device import TensorRecord
from normlift_ns.core.evidence import Evidence
from normlift_ns.core.lift import Lifted, Scalars
from normlift_ns.core.partition import PARTITION_BLOCK, Communicator, Partition

_ROUNDING = 1e-6
"""Relative rounding error of weights, norms and directions stored in float32. `basis_of_rank` adds it to x_j."""


def half_precision_error(dimension: int) -> float:
    """Return a bound on the Euclidean error of a unit vector with D components that is rounded to float16.

    The bound is 2**-11, plus 2**-25 sqrt(D) for components near zero.
    """
    return 2.0**-11 + dimension**0.5 * 2.0**-25


class Basis(NamedTuple):
    """Orthonormal basis of rank r, with the error bound of every Gaussian."""

    rows: Float64[Tensor, "r d"]
    bound: Float64[Tensor, " n"]
    """Bound on |<u_j, t> - <u'_j, t>| for all unit vectors t, or 0 without a direction. u'_j is the projected and
    renormalized direction."""


class SpectralTable(NamedTuple):
    """Eigenvectors of F^T F by descending eigenvalue, and the residual of every feature row for every rank."""

    vectors: Float64[Tensor, "d d"]
    residual: Float64[Tensor, "s ranks"]
    """Column r is |F_s - F_s B B^T|, with the first r eigenvectors as the columns of B, for r in 0..D."""


def spectral_table(features: Float[Tensor, "s d"], team: Communicator | None = None) -> SpectralTable:
    """Compute the eigenvectors and residuals in float64. All processes use the eigenvectors of process 0."""
    exact = features.double()
    vectors = torch.linalg.eigh(exact.T @ exact).eigenvectors.flip(1)
    vectors = vectors if team is None else team.broadcast(vectors)
    power = (exact @ vectors) ** 2
    tail = power.flip(1).cumsum(1).flip(1)  # energy in directions r, r + 1, ...
    return SpectralTable(vectors, torch.cat([tail, tail.new_zeros(len(tail), 1)], dim=1).sqrt())


def basis_of_rank(lifted: Lifted, table: SpectralTable, rank: int) -> Basis:
    """Return the basis of the first `rank` eigenvectors, with the error bound of every Gaussian.

    Let r_s be the residual of row s, and x_j = sum_s E_js r_s / (W_j ||f_j||). Then the component of u_j outside the
    basis has a length of at most x_j. Projecting and renormalizing moves u_j by at most sqrt(2 - 2 sqrt(1 - x_j^2)) if
    x_j <= 1, else by at most 2.
    """
    residual = table.residual[:, rank : rank + 1].contiguous()
    lost = lifted.evidence.rows.matmul(residual).squeeze(1)
    length = lifted.scalars.weight.double() * lifted.scalars.norm.double()
    x = torch.where(length > 0, lost / length, 0.0) + _ROUNDING * (lifted.scalars.norm > 0)
    bound = (2 - 2 * (1 - x.clamp(max=1) ** 2).sqrt()).clamp(min=0).sqrt()
    return Basis(table.vectors[:, :rank].T.contiguous(), torch.where(x > 1, 2.0, bound))


def smallest_basis(lifted: Lifted, tolerance: float, team: Communicator | None = None) -> Basis | None:
    """Return the basis of lowest rank that keeps all error bounds within `tolerance`, or None if no rank does.

    The bounds here include the rounding of coordinates to float16. All processes get the same basis.
    """
    table = spectral_table(lifted.features, team)
    low, high, best = 1, lifted.features.shape[1] + 1, None
    while low < high:  # the bound decreases with increasing rank
        rank = (low + high) // 2
        basis = basis_of_rank(lifted, table, rank)
        worst = torch.cat([basis.bound.new_zeros(1), basis.bound]).max()
        worst = worst if team is None else team.all_gather(worst[None]).max()
        if float(worst) + half_precision_error(rank) <= tolerance:
            best, high = basis, rank
        else:
            low = rank + 1
    return best


# Storage forms of directions: the evidence (exact), float16, and float16 coordinates in a basis.


_QUANTILES = (0.0, 0.5, 0.9, 0.99, 1.0)
_BLOCK_ROWS = 1024
_CPU_BLOCK, _GPU_BLOCK = 2**19, 2**25
"""Number of elements that a query converts to float32 at a time, on CPU and GPU. On the CPU, a query is four times as
fast if the blocks fit into the cache."""


@dataclass(frozen=True)
class StoredEvidence(TensorRecord):
    """Storage form that keeps the evidence E and the features F. Directions are exact, and another encoder can reuse
    E."""

    evidence: Evidence
    features: Float[Tensor, "s d"]

    def products(self, vectors: Float[Tensor, "q d"], scalars: Scalars) -> Float[Tensor, "n q"]:
        """Return the cosines to unit vectors t as E (F t) / (W_j ||f_j||), computed in float64.

        They are 0 for Gaussians without a direction.
        """
        transposed = vectors.double().T  # block by block, because each block of float64 fits into the CPU cache
        table = torch.cat([block.double() @ transposed for block in self.features.split(_BLOCK_ROWS)])
        length = scalars.weight.double() * scalars.norm.double()
        sums = self.evidence.rows.matmul(table)
        return torch.where((length > 0)[:, None], sums / length[:, None], 0.0).clamp(-1, 1).float()

    def directions(self, gaussians: Int[Tensor, " m"], scalars: Scalars) -> Float[Tensor, "m d"]:
        """Return the unit directions of some Gaussians, or 0 for those without a direction."""
        sums = self.evidence.rows.select_rows(gaussians).sums_of_unit_rows(self.features)
        mask = (scalars.norm[gaussians] > 0)[:, None]
        return torch.where(mask, sums / torch.linalg.vector_norm(sums, dim=1, keepdim=True), 0.0).float()


@dataclass(frozen=True)
class StoredDirections(TensorRecord):
    """Directions of the M Gaussians that have one, as float16 vectors or as float16 coordinates in a basis."""

    coordinates: Float16[Tensor, "m r"]
    basis: Float[Tensor, "r d"] | None

    @property
    def dimension(self) -> int:
        """D, the length of the directions."""
        return (self.coordinates if self.basis is None else self.basis).shape[1]

    def products(self, vectors: Float[Tensor, "q d"], scalars: Scalars) -> Float[Tensor, "n q"]:
        """Return the cosines to unit vectors, or 0 for Gaussians without a direction."""
        projected = vectors.float() if self.basis is None else vectors.float() @ self.basis.T
        out = vectors.new_zeros(scalars.norm.numel(), len(vectors), dtype=torch.float32)
        step = max(1, (_GPU_BLOCK if self.coordinates.is_cuda else _CPU_BLOCK) // projected.shape[1])
        out[scalars.norm > 0] = torch.cat([block.float() @ projected.T for block in self.coordinates.split(step)])
        return out.clamp_(-1, 1)

    def directions(self, gaussians: Int[Tensor, " m"], scalars: Scalars) -> Float[Tensor, "m d"]:
        """Return the unit directions of some Gaussians, or 0 for those without a direction."""
        mask = scalars.norm > 0
        row = (mask.cumsum(0) - 1)[gaussians].clamp(min=0)
        rows = self.coordinates[row].float() if self.basis is None else self.coordinates[row].float() @ self.basis
        return torch.where(mask[gaussians][:, None], torch.nn.functional.normalize(rows, dim=1), 0.0)


def store_directions(lifted: Lifted, basis: Tensor | None, order: Int64[Tensor, " n"]) -> StoredDirections:
    """Convert the directions of a lift to their storage form.

    Args:
        basis: Basis vectors as rows, to store coordinates, or None to store full directions.
        order: Indices of all Gaussians from `spatial_order`.
    """
    coordinates, gaussians = encode_directions(lifted, basis, order.split(PARTITION_BLOCK))
    return arrange_directions([coordinates], [gaussians], basis, len(order))


def encode_directions(
    lifted: Lifted, basis: Tensor | None, blocks: Iterable[Int64[Tensor, " _"]]
) -> tuple[Float16[Tensor, "m r"], Int64[Tensor, " m"]]:
    """Return the float16 coordinates of every Gaussian with a direction, and its row in the lift, in block order.

    Rounding may depend on which rows are multiplied together. The blocks are therefore the same for any number of
    processes.

    Args:
        blocks: Row indices in the lift. The rows of each block are encoded together.
    """
    dimension = lifted.features.shape[1] if basis is None else len(basis)
    mask, coordinates = lifted.scalars.norm > 0, [lifted.features.new_zeros(0, dimension, dtype=torch.float16)]
    rows_of = [mask.new_zeros(0, dtype=torch.int64)]
    for block in blocks:
        rows_of.append(block[mask[block]])
        rows = lifted.directions(rows_of[-1])
        rows = rows if basis is None else torch.nn.functional.normalize(rows.double() @ basis.T, dim=1)
        coordinates.append(rows.half())
    return torch.cat(coordinates), torch.cat(rows_of)


def arrange_directions(
    parts: Sequence[Float16[Tensor, "_ r"]], gaussians: Sequence[Int64[Tensor, " _"]], basis: Tensor | None, n: int
) -> StoredDirections:
    """Arrange the stored directions of n Gaussians by Gaussian index.

    Args:
        parts: Parts of the directions or coordinates.
        gaussians: Index of the Gaussian of every row, for each part.
        basis: As in `store_directions`.
    """
    row_of = torch.zeros(n + 1, dtype=torch.int64, device=parts[0].device)
    for index in gaussians:
        row_of[index + 1] = 1
    row_of = row_of.cumsum(0)
    stored = parts[0].new_empty(sum(map(len, parts)), parts[0].shape[1])
    for index, part in zip(gaussians, parts):
        stored[row_of[index]] = part
    return StoredDirections(stored, None if basis is None else basis.float())


def sizes_and_bounds(
    lifted: Lifted, basis: Basis | None, portion: Partition | None = None
) -> dict[str, dict[str, Any]]:
    """Return the size in bytes (without scalars and source) and the bound on the cosine error of each storage form.

    Args:
        basis: Basis of the form "low_rank", or None to leave this form out.
        portion: As in `core.field.choose_form`.
    """
    mask, evidence = lifted.scalars.norm > 0, lifted.evidence
    sizes = torch.stack([mask.sum(), mask.new_tensor(evidence.nnz, dtype=torch.int64), evidence.unlabeled.offsets[-1]])
    with_evidence, *entries = (sizes if portion is None else portion.communicator.all_reduce(sizes)).tolist()
    n = len(mask) if portion is None else len(portion.order)
    dimension, matrices = lifted.features.shape[1], (evidence.rows, evidence.unlabeled)
    exact = 4 * (lifted.features.numel() + evidence.num_regions)
    for count, rows in zip(entries, matrices):
        exact += 8 * (n + 1) + count * (4 + rows.weight.element_size())
    forms: dict[str, dict[str, Any]] = {
        "evidence": {"bytes": exact, "bound": 0.0},
        "float16": {"bytes": 2 * with_evidence * dimension, "bound": half_precision_error(dimension)},
    }
    if basis is not None:
        rank = len(basis.rows)
        bounds = basis.bound[mask] if portion is None else portion.communicator.all_gather(basis.bound[mask])
        bounds = bounds.cpu().numpy() if with_evidence > 0 else np.zeros(1)
        quantiles = np.quantile(bounds, _QUANTILES) + half_precision_error(rank)
        forms["low_rank"] = {
            "bytes": 2 * with_evidence * rank + 4 * rank * dimension,
            "bound": float(quantiles[-1]),
            "rank": rank,
            "bound_quantiles": dict(zip(map(str, _QUANTILES), quantiles.tolist())),
        }
    return forms
