"""The lift, which computes the direction and reliability of every Gaussian from evidence and unit features.

Let E_js be the evidence of Gaussian j and F_s the unit feature of region s. Equation numbers are those of the paper::

    f_j     = sum_s E_js F_s / W_j,   W_j = sum_s E_js        eq. 3, back-projection
    u_j     = f_j / ||f_j||                                   eq. 5, optimum of the cosine alignment problem, eq. 4
    S_jv    = sum_{s in v} E_js F_s,  W_jv = sum_{s in v} E_js
    C_intra = sum_v ||S_jv|| / W_j                            eq. 7
    C_inter = ||sum_v S_jv|| / sum_v ||S_jv||                 eq. 7, so that ||f_j|| = C_intra C_inter
    N_eff   = W_j ** 2 / sum_v W_jv ** 2
    R_j     = ||f_j|| N_eff / (N_eff + beta)                  eq. 8, in `core.reliability`
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, fields

import torch
from jaxtyping import Float, Float64, Int, Int32
from torch import Tensor

from normlift_ns.core.arguments import check_arguments, check_rows
from normlift_ns.core.device import TensorRecord, can_use_triton
from normlift_ns.core.evidence import Evidence
from normlift_ns.core.reliability import reliability
from normlift_ns.core.sparse import CANCELLATION_RATIO, CHUNK_ELEMENTS, MANY_ENTRIES, SparseRows, segment_sum
from normlift_ns.errors import InputError
from normlift_ns.options import UnlabeledMode

_MIN_WEIGHT, _MAX_WEIGHT = 1e-15, 1e15
"""Smallest W_j that counts as evidence, and largest valid E_js. Within these limits, squared sums fit into float32.
Rasterizers return weights in 1e-13..1e9."""
_LENGTH_TOLERANCE = 1e-2
"""Limit on the deviation of the length of a unit row from 1. It allows for rounding to half precision."""


@check_arguments
@dataclass(frozen=True)
class Scalars(TensorRecord):
    """Norm, consistency, reliability and weight of every Gaussian.

    If W_j < 1e-15, or f_j = 0 up to rounding, all fields except `view_count` and `weight` are 0.

    >>> import torch
    >>> from normlift_ns import Evidence, lift
    >>> from normlift_ns.core.evidence import Entries
    >>> entries = Entries(torch.tensor([0, 0, 1, 1]), torch.tensor([1, 2, 1, 4]), torch.ones(4), num_regions=(2, 1))
    >>> features = torch.tensor([[0.6, 0.8], [0.6, -0.8], [0.6, -0.8]])  # two regions of view 0, one of view 1
    >>> scalars = lift(Evidence.from_entries([entries], 2), features).scalars
    >>> scalars.norm, scalars.c_intra, scalars.c_inter
    (tensor([0.6000, 0.6000]), tensor([0.6000, 1.0000]), tensor([1.0000, 0.6000]))
    >>> scalars.n_eff, scalars.reliability
    (tensor([1., 2.]), tensor([0.3000, 0.4000]))
    """

    norm: Float[Tensor, " n"]
    """||f_j||, the length of the weighted mean of the features, in 0..1."""
    c_intra: Float[Tensor, " n"]
    """Agreement within views, in 0..1."""
    c_inter: Float[Tensor, " n"]
    """Agreement between views, in 0..1."""
    n_eff: Float[Tensor, " n"]
    """Effective number of views, in 1..view_count, or 0 without a direction."""
    reliability: Float[Tensor, " n"]
    """Reliability R_j, in 0..1."""
    weight: Float[Tensor, " n"]
    """W_j, the sum of W_jv over all views. f_j is the weighted sum of the features, divided by W_j."""
    view_count: Int32[Tensor, " n"]
    """Number of views in which the Gaussian has weight."""

    @property
    def own_evidence(self) -> Float[Tensor, " n"]:
        """||f_j|| N_eff, the effective number of views that agree on the direction of each Gaussian."""
        return self.norm * self.n_eff

    def map(self, function: Callable[[Tensor], Tensor]) -> Scalars:
        """Return scalars with the function applied to every array."""
        return Scalars(**{f.name: function(getattr(self, f.name)) for f in fields(Scalars)})


@check_arguments
@dataclass(frozen=True)
class Lifted:
    """Result of a lift: the scalars of every Gaussian, and the evidence and features that determine its direction.

    >>> import torch
    >>> from normlift_ns import Evidence, lift
    >>> from normlift_ns.core.evidence import Entries
    >>> entries = Entries(torch.tensor([0, 0, 1]), torch.tensor([1, 2, 2]), torch.tensor([3.0, 4.0, 1.0]), (2,))
    >>> lifted = lift(Evidence.from_entries([entries], 3), torch.eye(2))
    >>> lifted.directions(torch.tensor([0])), lifted.scalars.weight
    (tensor([[0.6000, 0.8000]]), tensor([7., 1., 0.]))
    """

    scalars: Scalars
    evidence: Evidence
    features: Float[Tensor, "s d"]
    """Feature table with normalized rows, in the precision of the lift."""

    @check_arguments
    def directions(
        self, gaussians: Int[Tensor, " m"] | None = None, *, dtype: torch.dtype | None = None
    ) -> Float[Tensor, "m d"]:
        """Return u_j of all or some Gaussians as unit rows, or 0 for those without a direction.

        The row of a Gaussian does not depend on which other Gaussians are requested.

        Args:
            dtype: Type of the result (default: that of the features). Half precision halves the memory of the result.
        Raises:
            ValueError: If a Gaussian does not exist, or `dtype` is not a floating-point type.
        """
        dtype = dtype or self.features.dtype
        if not dtype.is_floating_point:
            raise InputError(f"dtype must be a floating-point type, got {dtype}")
        n, device = self.evidence.num_gaussians, self.features.device
        gaussians = torch.arange(n, device=device) if gaussians is None else gaussians
        check_rows("gaussians", gaussians, n)
        if _has_kernel(self.features):
            return self._directions(gaussians, dtype)
        result = self.features.new_empty(len(gaussians), self.features.shape[1], dtype=dtype)
        first = 0
        for rows in gaussians.split(max(1, CHUNK_ELEMENTS // max(1, self.features.shape[1]))):
            result[first : first + len(rows)] = self._directions(rows, dtype)
            first += len(rows)
        return result

    def _directions(self, gaussians: Tensor, dtype: torch.dtype) -> Tensor:
        rows, table = self.evidence.rows, self.features
        if _has_kernel(table):
            from normlift_ns.kernels.sparse import unit_sums  # noqa: PLC0415 (needs triton)

            arrays = (rows.offsets, rows.column, rows.weight, table, self.scalars.norm)
            return unit_sums(gaussians.long(), *arrays, dtype, CANCELLATION_RATIO, MANY_ENTRIES)
        sums = rows.select_rows(gaussians).sums_of_unit_rows(table)
        length = torch.linalg.vector_norm(sums, dim=1, keepdim=True)
        return torch.where((self.scalars.norm[gaussians] > 0)[:, None], sums / length, 0.0).to(dtype)


@check_arguments
def lift(
    evidence: Evidence, features: Float[Tensor, "s d"], *, beta: float = 1.0, unlabeled: UnlabeledMode = "ignore"
) -> Lifted:
    """Compute the direction u_j and reliability R_j of every Gaussian with equations 3 to 8 of the paper.

    The formulas are at the top of this module.

    Args:
        evidence: E, from `rasterize_evidence`.
        features: One unit row per column of the evidence. Rows whose lengths differ from 1 by less than 0.01 are
            normalized.
        beta: Prior strength of the shrinkage of R, as a number of views, >= 0.
        unlabeled: "ignore" omits unlabeled pixels. "dilute" counts them in every W_jv, as observations of the zero
            vector.
    Returns:
        `Lifted`, in float64 if the evidence or the features are float64, else in float32.
    Raises:
        ValueError: If `features` has the wrong length, a row is not a unit vector, a weight is outside 0..1e15, or an
            option is invalid.

    >>> import torch
    >>> from normlift_ns import Camera, GaussianScene, lift, rasterize_evidence
    >>> means, quats = torch.tensor([[0.0, 0, 1]]), torch.tensor([[1.0, 0, 0, 0]])
    >>> scene = GaussianScene(means, quats, scales=torch.ones(1, 3), opacities=torch.ones(1))
    >>> camera = Camera(torch.tensor([[1.0, 0, 0.5], [0, 1, 0.5], [0, 0, 1]]), torch.eye(4), width=1, height=1)
    >>> evidence = rasterize_evidence(scene, [camera, camera], [torch.tensor([[0]]), torch.tensor([[0]])])
    >>> lifted = lift(evidence, torch.tensor([[0.6, 0.8], [0.6, -0.8]]))
    >>> lifted.directions(), lifted.scalars.norm, lifted.scalars.reliability  # R = 0.6 * 2 / (2 + 1)
    (tensor([[1., 0.]]), tensor([0.6000]), tensor([0.4000]))
    """
    if not 0 <= beta < math.inf:
        raise InputError(f"beta must be >= 0 and finite, got {beta}")
    for name, rows in (("regions", evidence.rows), ("unlabeled pixels", evidence.unlabeled)):
        if not bool(((rows.weight >= 0) & (rows.weight <= _MAX_WEIGHT)).all()):
            low, high = (float(x) for x in rows.weight.aminmax())
            raise InputError(f"weights of {name} must be in 0..{_MAX_WEIGHT:g}, found {low:g}..{high:g}")
    table = _unit_table(evidence, features)
    total, by_view, weight, weight_squared, view_count = _sums(evidence, table)
    if unlabeled == "dilute":
        weight, weight_squared, view_count = _weights(SparseRows.add(evidence.view_weights(), evidence.unlabeled))

    has_direction = (weight >= _MIN_WEIGHT) & (total > (1e-12 if table.dtype == torch.float64 else 1e-6) * weight)
    norm = _ratio(total, weight, has_direction).clamp(max=1)
    n_eff = _ratio(weight**2, weight_squared, has_direction)
    values = {
        "norm": norm,
        "c_intra": _ratio(by_view, weight, has_direction).clamp(max=1),
        "c_inter": _ratio(total, by_view, has_direction).clamp(max=1),
        "n_eff": n_eff,
        "reliability": reliability(norm, n_eff, beta),
        "weight": weight,
    }
    scalars = Scalars(**{name: x.to(table.dtype) for name, x in values.items()}, view_count=view_count.int())
    return Lifted(scalars, evidence, table)


def _unit_table(evidence: Evidence, features: Tensor) -> Tensor:
    if features.shape[0] != evidence.num_regions:
        raise InputError(
            f"features must have shape [{evidence.num_regions}, D], one row per region of the evidence, got "
            f"{features.dtype} {tuple(features.shape)}"
        )
    exact = features.to(evidence.rows.weight.device, torch.float64)
    length = check_unit_rows(exact, "feature rows", "give rows of length 1, and label regions without a feature -1")
    double = torch.float64 in (evidence.rows.weight.dtype, features.dtype)
    return (exact / length[:, None]).to(torch.float64 if double else torch.float32)


def _sums(evidence: Evidence, table: Tensor) -> tuple[Tensor, ...]:
    """Return ||sum_v S_jv||, sum_v ||S_jv||, and the results of `_weights` for every Gaussian."""
    if _has_kernel(table):
        from normlift_ns.kernels.sparse import row_norms  # noqa: PLC0415 (needs triton)

        rows = evidence.rows
        arrays = (rows.offsets, rows.column, rows.weight, evidence.region_view, table)
        return row_norms(*arrays, CANCELLATION_RATIO, MANY_ENTRIES)
    total, by_view = _row_norms(evidence.rows, table), _sum_of_view_norms(evidence, table)
    return total, by_view, *_weights(evidence.view_weights())


def _weights(view_weights: SparseRows) -> tuple[Tensor, Tensor, Tensor]:
    """Return W_j, sum_v W_jv ** 2 and the number of views with weight for every Gaussian."""
    squared = segment_sum(view_weights.weight.double() ** 2, view_weights.offsets)
    return view_weights.row_sums(), squared, segment_sum((view_weights.weight > 0).float(), view_weights.offsets)


def _row_norms(rows: SparseRows, table: Tensor) -> Tensor:
    norms = [
        torch.linalg.vector_norm(block.sums_of_unit_rows(table), dim=1).double()
        for _, block in rows.chunks(table.shape[1])
    ]
    return torch.cat([table.new_zeros(0, dtype=torch.float64), *norms])


def _sum_of_view_norms(evidence: Evidence, table: Tensor) -> Tensor:
    """Return sum_v ||S_jv|| of every Gaussian.

    Most Gaussians are in only one region of a view. Then ||S_jv|| = E_js, and no vector sum is needed.
    """
    groups = evidence.view_group_offsets
    rows = evidence.rows
    norms = segment_sum(rows.weight, groups)
    several = (groups.diff() > 1).nonzero().squeeze(1)
    norms[several] = _row_norms(SparseRows(groups, rows.column, rows.weight).select_rows(several), table)
    return segment_sum(norms, torch.searchsorted(groups, rows.offsets))


def _has_kernel(table: Tensor) -> bool:
    return can_use_triton(table) and table.dtype == torch.float32


def _ratio(numerator: Tensor, denominator: Tensor, where: Tensor) -> Tensor:
    return torch.where(where, numerator / denominator, 0.0)


# Checks of tensor arguments: invalid input raises an error instead of producing a wrong result.


def check_unit_rows(
    rows: Float[Tensor, "m d"], name: str, advice: str, *, allow_zeros: bool = False
) -> Float64[Tensor, " m"]:
    """Return the lengths of all rows, and raise ValueError unless the rows are unit vectors.

    Args:
        name: Name of the rows in the message, for example "feature rows".
        advice: Suggestion for the user in the message.
        allow_zeros: Also accept rows of zeros.
    Raises:
        ValueError: If a row has the wrong length or is not finite. The message gives the number of these rows and up to
            three examples.

    >>> check_unit_rows(torch.tensor([[0.6, 0.8]]), "feature rows", "normalize").round(decimals=6)
    tensor([1.], dtype=torch.float64)
    """
    blocks = rows.split(max(1, CHUNK_ELEMENTS // max(1, rows.shape[1])))  # rows in float64 would double the memory
    length = torch.cat([torch.linalg.vector_norm(block, dim=1, dtype=torch.float64) for block in blocks])
    good = (length - 1).abs() < _LENGTH_TOLERANCE
    bad = (~(good | (length == 0) if allow_zeros else good)).nonzero().squeeze(1)
    if bad.numel() > 0:
        examples = ", ".join(f"row {i} has length {length[i]:.3g}" for i in bad[:3].tolist())
        fault = "is not a unit vector" if bad.numel() == 1 else "are not unit vectors"
        raise InputError(f"{bad.numel():,} of {len(rows):,} {name} {fault} ({examples}); {advice}")
    return length
