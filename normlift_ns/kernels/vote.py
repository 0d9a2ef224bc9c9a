"""Triton kernel for the vote of `core.refine`, with one Gaussian per program.

A small matrix product computes the cosines between the Gaussian and its neighbors. Float32 rows u with D components
are split into u = h + l, two float16 numbers with 11 significant bits each. The vote uses the sigmoid
g = 1 / (1 + exp(-(cosine - tau) / gamma)). Three products at the fastest rate of tensor cores, h h + h l + l h, give
cosines with 22 bits. Most votes need only the first product.

Let e be the largest |l| of a Gaussian and its neighbors. Assume that all products and sums are exact except for
rounding errors of 2**-23 relative to values of at most 1. Then |<h_j, h_k> - <u_j, u_k>| <= t with
t = 2.02 e + (D + 16) 2**-23. The derivative of log(g (1 - g)) with respect to the cosine is at most 1 / gamma. Let
f = exp(t / gamma) - 1. An error t of the cosine then changes a sigmoid g by at most f g (1 - g). Let A be the
weighted sum of g, and W the sum of the weights. By Jensen's inequality, the error of A is at most f A (1 - A / W).
The rounding of sums adds at most 3e-5. If the resulting error intervals determine the winner, the vote is finished.
Otherwise, the kernel adds the other products and compares again.
"""

from __future__ import annotations

from typing import Literal, NamedTuple

import torch
import triton
import triton.language as tl
from jaxtyping import Bool, Float, Float16, Float32, Int, Int32, Int64
from torch import Tensor

MAX_VOTE_NEIGHBORS = 63
VotePrecision = Literal["certified", "first", "halves", "tf32", "tf32x3", "ieee"]


class LaunchConfig(NamedTuple):
    """Launch parameters of the kernel `_vote`."""

    columns: int
    """Number of columns of the rows that are loaded per step."""
    columns_later: int
    """Number of columns per step if both halves of the rows are loaded."""
    stages: int
    """Number of pipeline stages of the loads."""
    warps: int
    registers: int | None = None
    """Maximum number of registers per thread, or None for no limit. A low limit lets more programs run in parallel."""


_HALVES = LaunchConfig(columns=64, columns_later=32, stages=3, warps=4, registers=128)
_WHOLE = LaunchConfig(columns=64, columns_later=64, stages=3, warps=4)
_ROWS = 16


@triton.jit
def _winner(score, member, slot, valid, i, delta):
    own = tl.sum(tl.where(slot == 0, score, 0.0), axis=0)
    others = tl.where((slot > 0) & valid, score, -1.0)
    best, winner = tl.max(others, axis=0, return_indices=True, return_indices_tie_break_left=True)
    winner_member = tl.sum(tl.where(slot == winner, member, 0), axis=0)
    return tl.where(best > own + delta, winner_member, i)


@triton.jit
def _certain(agreed, r, weight, slot, valid, spread, delta):
    """Return True if the winner is the same for all scores in their error intervals; False for NaN."""
    share = agreed / tl.sum(weight, axis=0)  # A / W
    score = r * agreed
    error = score * (spread * (tl.maximum(1 - share, 0.0) + 1e-5) + 3e-5)
    low, high = score - error, score + error
    own_low = tl.sum(tl.where(slot == 0, low, 0.0), axis=0)
    own_high = tl.sum(tl.where(slot == 0, high, 0.0), axis=0)
    other = (slot > 0) & valid
    _, winner = tl.max(tl.where(other, score, -1.0), axis=0, return_indices=True, return_indices_tie_break_left=True)
    best_low = tl.sum(tl.where(slot == winner, low, 0.0), axis=0)
    rest_high = tl.max(tl.where(other & (slot != winner), high, -1.0), axis=0)
    all_high = tl.max(tl.where(other, high, -1.0), axis=0)
    wins = (best_low > rest_high) & (best_low > own_high + delta)
    return (wins | (all_high <= own_low + delta)) & (spread < 100.0)


@triton.jit(do_not_specialize=["voters"])
def _vote(
    voters, neighbors, distance, high, low, rough, row_of, reliability, own, source, dimension, k, tau, gamma, width,
    delta, prior, GROUP: tl.constexpr, COLUMNS: tl.constexpr, COLUMNS_LATER: tl.constexpr, STAGES: tl.constexpr,
    PRECISION: tl.constexpr, CERTIFY: tl.constexpr, FINISH: tl.constexpr, HALVES: tl.constexpr,
    POSTERIOR: tl.constexpr,
):  # fmt: skip
    i = tl.load(voters + tl.program_id(0)).to(tl.int64)
    slot = tl.arange(0, GROUP)  # slot 0 is i itself
    listed = (slot > 0) & (slot <= k)
    member = tl.load(neighbors + i * k + slot - 1, mask=listed, other=-1).to(tl.int64)
    member = tl.where(slot == 0, i, member)
    valid = member >= 0
    r = tl.load(reliability + member, mask=valid, other=0.0)
    d = tl.load(distance + i * k + slot - 1, mask=listed & valid, other=0.0).to(tl.float32) / width
    row_index = tl.load(row_of + member, mask=valid, other=0).to(tl.int64)
    if POSTERIOR:
        own_views = tl.load(own + i)
    if tl.max(tl.where(slot > 0, r, 0.0), axis=0) > 0:  # else no neighbor can win
        if CERTIFY:
            residual = tl.load(rough + row_index, mask=valid & (r > 0), other=0.0)
        row = row_index * dimension
        cosine = tl.zeros([GROUP, GROUP], tl.float32)
        for first in tl.range(0, dimension, COLUMNS, num_stages=STAGES):
            column = first + tl.arange(0, COLUMNS)
            inside = valid[:, None] & (column < dimension)[None, :]
            part = tl.load(high + row[:, None] + column[None, :], mask=inside, other=0.0)
            cosine = tl.dot(part, tl.trans(part), cosine, input_precision=PRECISION)
        votes = (r > 0) & (slot > 0) if POSTERIOR else r > 0
        nearest = tl.min(tl.where(votes, d, float("inf")), axis=0)
        excess = tl.maximum(d - nearest, 0.0) * (d + nearest)  # d * d - nearest ** 2 without a fused product
        weight = r * tl.exp(-0.5 * excess)
        if POSTERIOR:
            near = tl.where(slot > 0, weight, 0.0)
            weight = tl.where(slot > 0, near / tl.sum(near, axis=0) * prior, own_views)
        else:  # multiplied by the same factor as the weights
            delta = tl.where(delta > 0, delta * tl.exp(0.5 * nearest * nearest), 0.0)
        undecided = True
        if CERTIFY:
            agreed = tl.sum(tl.sigmoid((cosine - tau) / gamma) * weight[None, :], axis=1)
            spread = tl.exp((2.02 * tl.max(residual, axis=0) + (dimension + 16) * 1.1920929e-7) / gamma) - 1
            certain = _certain(agreed, r, weight, slot, valid, spread, delta)
            undecided = certain == 0
            if certain:
                tl.store(source + i, _winner(r * agreed, member, slot, valid, i, delta).to(tl.int32))
        if FINISH:  # noqa: SIM102 (only this condition is known at compile time)
            if undecided:
                if HALVES:
                    cross = tl.zeros([GROUP, GROUP], tl.float32)
                    for first in tl.range(0, dimension, COLUMNS_LATER, num_stages=STAGES):
                        column = first + tl.arange(0, COLUMNS_LATER)
                        inside = valid[:, None] & (column < dimension)[None, :]
                        high_part = tl.load(high + row[:, None] + column[None, :], mask=inside, other=0.0)
                        low_part = tl.load(low + row[:, None] + column[None, :], mask=inside, other=0.0)
                        cross = tl.dot(high_part, tl.trans(low_part), cross)
                    cosine += (cross + tl.trans(cross)) * (1 / 2048)
                agreed = tl.sum(tl.sigmoid((cosine - tau) / gamma) * weight[None, :], axis=1)
                tl.store(source + i, _winner(r * agreed, member, slot, valid, i, delta).to(tl.int32))


@triton.jit
def _halve(rows, high, low, rough, dimension, BLOCK: tl.constexpr):
    j, column = tl.program_id(0).to(tl.int64), tl.arange(0, BLOCK)
    inside = column < dimension
    u = tl.load(rows + j * dimension + column, mask=inside, other=0.0)
    h = u.to(tl.float16)
    residual = u - h.to(tl.float32)
    tl.store(high + j * dimension + column, h, mask=inside)
    tl.store(low + j * dimension + column, (residual * 2048).to(tl.float16), mask=inside)
    length = tl.sum(u * u, axis=0)
    error = tl.sqrt(tl.sum(residual * residual, axis=0)) * 1.001
    tl.store(rough + j, tl.where(length < 1.01, error, float("inf")))


def split_float16(
    rows: Float32[Tensor, "m d"],
) -> tuple[Float16[Tensor, "m d"], Float16[Tensor, "m d"], Float32[Tensor, " m"]]:
    """Return h, 2048 l and a bound on |l| for unit rows u = h + l. The bound is inf if |u| ** 2 is 1.01 or more."""
    high, low = (torch.empty_like(rows, dtype=torch.float16) for _ in range(2))
    rough = torch.empty(len(rows), device=rows.device)
    if len(rows) > 0:
        _halve[(len(rows),)](
            rows, high, low, rough, rows.shape[1], BLOCK=triton.next_power_of_2(rows.shape[1]), num_warps=2
        )
    return high, low, rough


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
    own: Float32[Tensor, " n"] | None = None,
    prior: float = 0.0,
    precision: VotePrecision = "certified",
) -> None:
    """Write to `source` the index of the Gaussian whose direction each voter takes, by the formulas of `core.refine`.

    Args:
        voters: Gaussians to refine. Spatial neighbors should be close in this list, because they read the same rows.
        neighbors: Neighbors of every Gaussian, nearest first, padded with -1. K is at most MAX_VOTE_NEIGHBORS.
        distance: Distances of the neighbors.
        directions: Unit or zero rows. Tensor cores multiply them and sum in float32.
        row_of: Row of every Gaussian's direction, valid for the voters and their neighbors.
        reliability: Reliability of every Gaussian.
        source: Output. Entries of other Gaussians, and of voters without a reliable neighbor, are not changed.
        tau: Threshold of the sigmoid.
        gamma: Width of the sigmoid.
        width: sigma_d, in the units of `distance`.
        delta: Amount by which the support of a neighbor must exceed that of the Gaussian itself.
        own: Number of views that agree on each Gaussian's own direction, or None for the paper's vote.
        prior: Weight of the neighbors in a posterior vote, as a number of views.
        precision: Precision of the products of float32 directions. "halves" uses two halves of 11 bits each.
            "certified" gives the same winners, but uses only the first halves if these determine the winner. "first"
            writes only winners that the first halves determine. "tf32" rounds to 11 bits, "tf32x3" adds three such
            products, and "ieee" does not round. Directions in half precision are not rounded.
    """
    if len(voters) == 0:
        return
    halves = directions.dtype == torch.float32 and precision in ("certified", "first", "halves")
    high, low, rough = split_float16(directions) if halves else (directions, directions, reliability)
    tuning = _HALVES if halves else _WHOLE
    _vote[(len(voters),)](
        voters, neighbors, distance, high, low, rough, row_of, reliability, reliability if own is None else own,
        source, directions.shape[1], neighbors.shape[1], tau, gamma, width, delta, prior,
        GROUP=max(16, triton.next_power_of_2(neighbors.shape[1] + 1)), COLUMNS=tuning.columns,
        COLUMNS_LATER=tuning.columns_later, STAGES=tuning.stages, CERTIFY=halves and precision != "halves",
        FINISH=precision != "first" or not halves, HALVES=halves,
        PRECISION=precision if precision in ("tf32", "ieee") else "tf32x3", POSTERIOR=own is not None,
        num_warps=tuning.warps, maxnreg=tuning.registers,
    )  # fmt: skip


@triton.jit(do_not_specialize=["n"])
def _find_reliable(neighbors, reliability, out, n, k, ROWS: tl.constexpr, SLOTS: tl.constexpr):
    row, slot = tl.program_id(0).to(tl.int64) * ROWS + tl.arange(0, ROWS), tl.arange(0, SLOTS)
    inside = (row < n)[:, None] & (slot < k)[None, :]
    index = tl.load(neighbors + row[:, None] * k + slot[None, :], mask=inside, other=-1)
    reliable = tl.load(reliability + index, mask=index >= 0, other=0.0) > 0
    tl.store(out + row, tl.max(reliable.to(tl.int8), axis=1), mask=row < n)


def has_reliable_neighbor(neighbors: Int32[Tensor, "m k"], reliability: Float[Tensor, " n"]) -> Bool[Tensor, " m"]:
    """Return a mask of the Gaussians that have a neighbor with a reliability above 0."""
    n, k = neighbors.shape
    mask = torch.zeros(n, dtype=torch.int8, device=neighbors.device)
    if n > 0:
        _find_reliable[(triton.cdiv(n, _ROWS),)](
            neighbors, reliability, mask, n, k, ROWS=_ROWS, SLOTS=triton.next_power_of_2(k)
        )
    return mask.bool()


@triton.jit(do_not_specialize=["voters", "count"])
def _mark(voters, neighbors, out, count, k, ROWS: tl.constexpr, SLOTS: tl.constexpr):
    row, slot = tl.program_id(0) * ROWS + tl.arange(0, ROWS), tl.arange(0, SLOTS)
    i = tl.load(voters + row, mask=row < count, other=0).to(tl.int64)
    tl.store(out + i, tl.full([ROWS], 1, tl.int8), mask=row < count)
    inside = (row < count)[:, None] & (slot < k)[None, :]
    index = tl.load(neighbors + i[:, None] * k + slot[None, :], mask=inside, other=-1)
    tl.store(out + index, tl.full([ROWS, SLOTS], 1, tl.int8), mask=index >= 0)


def voters_and_neighbors(voters: Int[Tensor, " v"], neighbors: Int32[Tensor, "r k"], n: int) -> Int64[Tensor, " m"]:
    """Return the distinct indices of the voters and their neighbors among n Gaussians, ascending."""
    k = neighbors.shape[1]
    mask = torch.zeros(n, dtype=torch.int8, device=neighbors.device)
    if len(voters) > 0:
        _mark[(triton.cdiv(len(voters), _ROWS),)](
            voters, neighbors, mask, len(voters), k, ROWS=_ROWS, SLOTS=triton.next_power_of_2(k)
        )
    return mask.nonzero().squeeze(1)
