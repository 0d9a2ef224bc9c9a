"""Reliability R_j of every Gaussian, from the length of its mean feature and the number of views that show it.

The paper's R shrinks the agreement ||f_j|| of the views by their effective number (eq. 8)::

    R_j  = ||f_j|| N_eff / (N_eff + beta)                     paper

The other kinds measure the agreement of pairs of views, optionally weighted by the angles between views. Features of
one Gaussian in two views differ more if the angle between the views is larger. Views from nearby cameras therefore tend
to have the same errors. Let theta_vw be the angle between the directions from Gaussian j to the cameras of views v and
w::

    s_vw = exp(-theta_vw / 21.7 degrees)
    N_j  = N_eff                                              pairs
    N_j  = W_j ** 2 / sum_vw W_jv W_jw s_vw                   angular; it equals N_eff if s_vw = 0 for v != w
    R_j  = (max(0, N_j ||f_j|| ** 2 - 1) + beta r) / (N_j - 1 + beta),   r = 0.02

For N views of equal weight with unit features, (N ||f|| ** 2 - 1) / (N - 1) is the mean cosine of these features over
pairs of views. A single view has no pairs, so R = r if beta > 0, and R = 0 if beta = 0.
"""

from __future__ import annotations

import torch
from jaxtyping import Float, Float64
from torch import Tensor

from normlift_ns.core.sparse import SparseRows

DRIFT = 21.7
"""Angle between two views, in degrees, at which the correlation between their features of the same object part falls to
1/e, measured on real images."""
LEAST_RELIABILITY = 0.02
"""r, the R of a Gaussian in a single view if beta > 0. It is positive, because R = 0 means no evidence."""
_CHUNK_ELEMENTS = 2**22


def reliability(norm: Float[Tensor, "*n"] | float, n_eff: Float[Tensor, "*n"], beta: float) -> Float[Tensor, "*n"]:
    """Return R_j, equation 8 of the paper, or 0 without evidence.

    Args:
        norm: ||f_j||. With 1, the result is the factor N_eff / (N_eff + beta).
        n_eff: N_eff, or 0 without evidence.
        beta: Prior strength as a number of views, >= 0.

    >>> reliability(0.6, torch.tensor([0.0, 2.0]), beta=1.0)
    tensor([0.0000, 0.4000])
    """
    return torch.where(n_eff > 0, norm * n_eff / (n_eff + beta), 0.0)


def norm_of_reliability(
    reliability: Float[Tensor, " n"], n_eff: Float[Tensor, " n"], beta: float
) -> Float64[Tensor, " n"]:
    """Return ||f_j|| from R_j, as the inverse of `reliability`.

    After a consensus, R_j and therefore the result are those of the features before the consensus.

    Args:
        reliability: The paper's R_j.
        n_eff: N_eff, or 0 without evidence.
        beta: As in `reliability`.
    """
    views = n_eff.double()
    return torch.where(views > 0, reliability.double() * (views + beta) / views, 0.0).clamp(max=1)


def pair_reliability(norm: Float[Tensor, " n"], views: Float[Tensor, " n"], beta: float) -> Float[Tensor, " n"]:
    """Return R_j from pairs of views by the last formula at the top of this module, or 0 without evidence.

    Args:
        norm: ||f_j||.
        views: N_j, from `Scalars.n_eff` or `independent_views`.
        beta: Prior strength as a number of views, >= 0.

    >>> pair_reliability(torch.tensor([1.0, 1.0, 0.0]), torch.tensor([1.0, 2.0, 0.0]), beta=1.0)
    tensor([0.0200, 0.5100, 0.0000])
    """
    agreed = (views * norm**2 - 1).clamp(min=0) + beta * LEAST_RELIABILITY
    value = agreed / (views - 1 + beta).clamp(min=1e-6)
    return torch.where((norm > 0) & (views > 0), value.clamp(max=1), 0.0)


def independent_views(
    view_weights: SparseRows, means: Float[Tensor, "n 3"], centers: Float[Tensor, "v 3"], drift: float = DRIFT
) -> Float64[Tensor, " n"]:
    """Return N_j, the number of independent views of every Gaussian, in 1..N_eff, or 0 for a Gaussian without weight.

    Args:
        view_weights: W_jv, [N, views].
        centers: Camera centers of the views.
        drift: Angle in degrees at which s_vw is 1/e.
    """
    count = view_weights.offsets.diff()
    out = torch.zeros(len(view_weights), dtype=torch.float64, device=means.device)
    order = count.argsort(stable=True)  # rows of similar length are padded together
    order = order[count[order] > 0]
    while len(order) > 0:
        width = int(count[order[-1]])
        step = max(1, _CHUNK_ELEMENTS // (width * width))
        rows, order = order[-step:], order[:-step]
        part = view_weights.select_rows(rows)
        row = part.row_index()
        slot = torch.arange(len(row), device=row.device) - part.offsets[row]
        weight = means.new_zeros(len(rows), width)
        weight[row, slot] = part.weight.to(weight)
        weight = weight / weight.sum(1, keepdim=True).clamp(min=1e-30)
        toward = means.new_zeros(len(rows), width, 3)
        toward[row, slot] = torch.nn.functional.normalize(
            centers.to(means)[part.column.long()] - means[rows[row]], dim=1
        )
        angle = torch.rad2deg((toward @ toward.transpose(1, 2)).clamp(-1, 1).acos())
        repeated = torch.exp(-angle / drift)
        repeated.diagonal(dim1=1, dim2=2).fill_(1.0)
        shared = ((weight[:, :, None] * repeated).sum(1) * weight).sum(1).double()
        out[rows] = torch.where(shared > 0, 1 / shared, 0.0)
    return out
