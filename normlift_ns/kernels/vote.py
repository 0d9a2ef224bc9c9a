"""The vote of one Gaussian per program: the cosines among its neighbours are one small matrix product."""

from __future__ import annotations

from typing import Literal

import triton
import triton.language as tl
from jaxtyping import Float, Float32, Int, Int32
from torch import Tensor

GROUP = 64
MOST_NEIGHBORS = GROUP - 1
_SLICE = 64


@triton.jit
def _vote(
    order, neighbors, distance, directions, row_of, reliability, source, dimension, k, tau, gamma, width, delta,
    GROUP: tl.constexpr, SLICE: tl.constexpr, PRECISION: tl.constexpr,
):  # fmt: skip
    i = tl.load(order + tl.program_id(0)).to(tl.int64)
    slot = tl.arange(0, GROUP)  # 0: i itself
    listed = (slot > 0) & (slot <= k)
    member = tl.load(neighbors + i * k + slot - 1, mask=listed, other=-1).to(tl.int64)
    member = tl.where(slot == 0, i, member)
    there = member >= 0
    r = tl.load(reliability + member, mask=there, other=0.0)
    if tl.max(tl.where(slot > 0, r, 0.0), axis=0) > 0:  # else nobody can win
        d = tl.load(distance + i * k + slot - 1, mask=listed & there, other=0.0).to(tl.float32) / width
        nearest = tl.min(tl.where(r > 0, d, float("inf")), axis=0)
        beyond = tl.maximum(d - nearest, 0.0) * (d + nearest)  # d * d - nearest ** 2, which a fused product rounds
        weight = r * tl.exp(-0.5 * beyond)
        row = tl.load(row_of + member, mask=there, other=0).to(tl.int64) * dimension
        cosine = tl.zeros([GROUP, GROUP], tl.float32)
        for first in range(0, dimension, SLICE):
            column = first + tl.arange(0, SLICE)
            part = tl.load(
                directions + row[:, None] + column[None, :],
                mask=there[:, None] & (column < dimension)[None, :],
                other=0.0,
            )
            cosine = tl.dot(part, tl.trans(part), cosine, input_precision=PRECISION)
        agree = tl.sigmoid((cosine - tau) / gamma)
        score = r * tl.sum(agree * weight[None, :], axis=1)
        own = tl.sum(tl.where(slot == 0, score, 0.0), axis=0)
        others = tl.where((slot > 0) & there, score, -1.0)
        best, winner = tl.max(others, axis=0, return_indices=True, return_indices_tie_break_left=True)
        chosen = tl.sum(tl.where(slot == winner, member, 0), axis=0)
        tl.store(source + i, tl.where(best > own + delta, chosen, i).to(tl.int32))


def vote(
    voters: Int[Tensor, " v"],
    neighbors: Int32[Tensor, "n k"],
    distance: Float[Tensor, "n k"],
    directions: Float[Tensor, "m d"],
    row_of: Int32[Tensor, " n"],
    reliability: Float32[Tensor, " n"],
    source: Int32[Tensor, " n"],
    *,
    tau: float,
    gamma: float,
    width: float,
    delta: float,
    precision: Literal["tf32", "tf32x3", "ieee"] = "tf32x3",
) -> None:
    """Writes to `source` whose direction each of the voters takes; formulas in `core.refine`.

    Args:
        voters: neighbours in space should stand near each other, since they read the same.
        neighbors: nearest first, -1 for none; at most MOST_NEIGHBORS.
        directions: unit rows or 0, multiplied on tensor cores and added in float32.
        row_of: the row of a Gaussian's direction; those of voters and their neighbours are read.
        width: sigma_d, in the units of `distance`.
        precision: of products of float32 directions: rounded to 11 bits, in three such parts, or unrounded.
    """
    if len(voters) > 0:
        _vote[(len(voters),)](
            voters, neighbors, distance, directions, row_of, reliability, source, directions.shape[1],
            neighbors.shape[1], tau, gamma, width, delta, GROUP=GROUP, SLICE=_SLICE, PRECISION=precision, num_warps=4,
        )  # fmt: skip
