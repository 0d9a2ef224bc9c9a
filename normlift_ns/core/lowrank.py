"""Low-rank bases of a scene's feature table, with a bound on the query error of every Gaussian."""

from __future__ import annotations

from typing import NamedTuple

import torch
from jaxtyping import Float, Float64
from torch import Tensor

from normlift_ns.core.lift import Lifted
from normlift_ns.core.portions import ALONE, Team

_ROUNDING = 1e-6
"""Relative rounding error of weights, norms and directions stored in float32, added to x_j."""


def half_precision_error(dimension: int) -> float:
    """Return a bound on the length of the error of a unit vector rounded to float16.

    It is 2**-11 relative, plus 2**-25 for every component near zero.
    """
    return 2.0**-11 + dimension**0.5 * 2.0**-25


class Basis(NamedTuple):
    """Orthonormal basis of rank r, and the error bound of every Gaussian."""

    rows: Float64[Tensor, "r d"]
    bound: Float64[Tensor, " n"]
    """Bound on |<u_j, t> - <u'_j, t>| over all unit t, with u' the projected and renormalized direction; 0 without
    evidence."""


class SpectralTable(NamedTuple):
    """Eigenvectors of F^T F by descending eigenvalue, and the residual of every feature row for every rank."""

    vectors: Float64[Tensor, "d d"]
    residual: Float64[Tensor, "s ranks"]
    """|F_s - F_s B B^T| in column r, with B the first r eigenvectors, r = 0 ... D."""


def spectral_table(features: Float[Tensor, "s d"], team: Team = ALONE) -> SpectralTable:
    """Compute the eigenvectors of the feature table in float64; all processes use those of process 0."""
    exact = features.double()
    vectors = team.spread(torch.linalg.eigh(exact.T @ exact).eigenvectors.flip(1))
    power = (exact @ vectors) ** 2
    tail = power.flip(1).cumsum(1).flip(1)  # energy in directions r, r + 1, ...
    return SpectralTable(vectors, torch.cat([tail, tail.new_zeros(len(tail), 1)], dim=1).sqrt())


def basis_of_rank(lifted: Lifted, table: SpectralTable, rank: int) -> Basis:
    """Return the first `rank` eigenvectors with their bound.

    Let r_s be the residual of row s and x_j = sum_s E_js r_s / (W_j ||f_j||). The part of u_j outside the basis then
    has at most the length x_j. Projecting and renormalizing moves u_j by at most sqrt(2 - 2 sqrt(1 - x_j^2)) if
    x_j <= 1, else by at most 2.
    """
    residual = table.residual[:, rank : rank + 1].contiguous()
    lost = lifted.evidence.rows.matmul(residual).squeeze(1)
    length = lifted.scalars.weight.double() * lifted.scalars.norm.double()
    x = torch.where(length > 0, lost / length, 0.0) + _ROUNDING * (lifted.scalars.norm > 0)
    bound = (2 - 2 * (1 - x.clamp(max=1) ** 2).sqrt()).clamp(min=0).sqrt()
    return Basis(table.vectors[:, :rank].T.contiguous(), torch.where(x > 1, 2.0, bound))


def smallest_basis(lifted: Lifted, tolerance: float, team: Team = ALONE) -> Basis | None:
    """Return the basis of lowest rank for which the bound of every Gaussian is within `tolerance`, or None.

    The bound includes the rounding of coordinates to float16. Processes with different Gaussians get the same basis.
    """
    table = spectral_table(lifted.features, team)
    low, high, best = 1, lifted.features.shape[1] + 1, None
    while low < high:  # the bound falls with the rank
        rank = (low + high) // 2
        basis = basis_of_rank(lifted, table, rank)
        worst = torch.cat([basis.bound.new_zeros(1), basis.bound]).max()
        if float(team.join(worst[None]).max()) + half_precision_error(rank) <= tolerance:
            best, high = basis, rank
        else:
            low = rank + 1
    return best
