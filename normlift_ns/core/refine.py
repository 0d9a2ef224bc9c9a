"""Reliability-guided mode voting, in which a Gaussian copies the direction that reliable neighbors agree on."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import torch
from jaxtyping import Bool, Float, Float64, Int, Int32, Int64
from torch import Tensor

from normlift_ns.core.arguments import check_arguments, check_rows
from normlift_ns.core.consensus import hash_to_unit
from normlift_ns.core.device import can_use_triton, retry_in_halves
from normlift_ns.core.evidence import Evidence, check_not_negative
from normlift_ns.core.lift import Lifted, check_unit_rows
from normlift_ns.core.neighbors import Neighbors, Progress, nearest_neighbors
from normlift_ns.core.partition import PARTITION_BLOCK, spatial_order
from normlift_ns.core.sparse import SparseRows, sum_equal_keys
from normlift_ns.errors import InputError
from normlift_ns.options import RefineConfig, option_name

_CHUNK_ELEMENTS = (2**22, 2**24)
"""Maximum number of elements of a tensor in a vote in torch, on CPU and GPU. On the CPU, such a tensor fits into the
caches."""
_BLOCK = (2 * PARTITION_BLOCK, 16 * PARTITION_BLOCK)
"""Number of Gaussians per block, on CPU and GPU. Only the directions of one block and its neighbors are in memory at a
time."""
MAX_VOTERS = 256
"""Largest K that `clamp_k` allows. The time of a vote grows with the square of K, because it compares all pairs of
neighbors."""
_MAX_KERNEL_NEIGHBORS = 63
"""Largest K that `kernels.vote` supports."""


@check_arguments
def refine(
    means: Float[Tensor, "n 3"],
    directions: Float[Tensor, "n d"] | Callable[[Int64[Tensor, " m"]], Float[Tensor, "m d"]],
    reliability: Float[Tensor, " n"],
    config: RefineConfig | None = None,
    *,
    own: Float[Tensor, " n"] | None = None,
    labeled: Float[Tensor, " n"] | None = None,
    neighbors: Neighbors | None = None,
    progress: Progress | None = None,
) -> Int32[Tensor, " n"]:
    """Select source[i] for every Gaussian i by a vote of its neighbors; the refined direction is directions[source[i]].

    Let N be the K nearest neighbors of i, and N+ these neighbors and i itself::

        d_ik = exp(-|mu_i - mu_k|^2 / (2 sigma_d^2)),   g_jk = sigmoid((<u_k, u_j> - tau) / gamma)
        paper:      S_ij = R_j sum_{k in N+} R_k d_ik g_jk                                    (equation 9)
        posterior:  S_ij = R_j (own_i g_ij + P sum_{k in N} R_k d_ik g_jk / sum_{k in N} R_k d_ik)
        source_i = argmax_{j in N} S_ij   if that S_ij > S_ii + Delta,   else i               (equation 10)

    In the paper's vote, i is one of up to K + 1 voters, with a weight R_i <= 1 for any number of views. The posterior
    vote counts views instead. Its first term is the support of i itself for the direction u_j. Here, own_i =
    ||f_i|| N_eff_i is the effective number of views that agree on u_i. The second term is the support of the neighbors,
    a mean in 0..1 that counts as much as P views. Neighbors therefore have less influence if i has more views.

    All votes use the unrefined directions. In a tie, the nearer neighbor wins. If no neighbor is reliable, i keeps its
    direction (see `unsupported`). Gaussian i also keeps its direction if less than `min_labeled` of its weight lies in
    regions. If R_i = 0, S_ii is 0 too, and the best neighbor wins if its S_ij exceeds Delta.

    Args:
        config: Options of the vote (default: the posterior vote if `own` is given, else the paper's vote).
        directions: u, as unit or zero rows of any floating-point type. Float64 rows are used in float64, others in
            float32. If `directions` is a function of indices, such as `Lifted.directions`, only one block is in memory
            at a time.
        reliability: R in 0..1.
        own: `Lifted.scalars.own_evidence`, required by the posterior vote and ignored by the paper's vote.
        labeled: `labeled_share` of the evidence. Gaussians below `config.min_labeled` keep their direction (default:
            all may change).
        neighbors: Result of `nearest_neighbors(means, config.k)`, to share one search among several votes (default:
            search for the K of `clamp_k(config, n)`).
        progress: Function called after every block of Gaussians with the number processed so far and the total number.
    Raises:
        ValueError: If shapes disagree, a direction is neither a unit vector nor 0, `reliability` or `own` is invalid,
            `neighbors` has an invalid index, or `own` is missing.

    >>> import torch
    >>> from normlift_ns import RefineConfig, refine
    >>> means = torch.tensor([[0.0, 0, 0], [1, 0, 0], [2, 0, 0]])
    >>> directions = torch.tensor([[1.0, 0], [0, 1], [1, 0]])
    >>> source = refine(means, directions, torch.tensor([0.9, 0.1, 0.9]), RefineConfig(vote="paper", k=2))
    >>> source.tolist(), directions[source.long()].tolist()
    ([0, 0, 2], [[1.0, 0.0], [1.0, 0.0], [1.0, 0.0]])
    >>> own = torch.tensor([9.0, 1.0, 9.0])
    >>> refine(means, directions, torch.tensor([0.9, 0.1, 0.9]), RefineConfig(k=2), own=own).tolist()
    [0, 0, 2]
    """
    config = config or RefineConfig(vote="paper" if own is None else "posterior")
    _check_inputs(directions, reliability, own, posterior=config.vote != "paper")
    own = None if config.vote == "paper" else own
    config = config if neighbors is not None else clamp_k(config, len(means))
    neighbors = neighbors or nearest_neighbors(means, config.k)
    if tuple(neighbors.index.shape) != (len(means), config.k):
        raise InputError(
            f"neighbors.index has shape {tuple(neighbors.index.shape)}, expected {(len(means), config.k)}; pass the "
            "result of nearest_neighbors(means, config.k)"
        )
    check_rows("neighbors.index", neighbors.index, len(means), low=-1)
    neighbors = Neighbors(*(x.contiguous() for x in neighbors))
    if isinstance(directions, Tensor) and can_use_triton(means) and directions.dtype == torch.float32:
        directions = directions.__getitem__  # in blocks, because the kernel copies its rows
    order, width = spatial_order(means), decay_width(neighbors.spacing, config)
    if labeled is not None:
        order = order[labeled[order] >= config.numbers.min_labeled]
    return refine_subset(order, neighbors, directions, reliability, config, own=own, width=width, progress=progress)


def labeled_share(evidence: Evidence) -> Float64[Tensor, " n"]:
    """Return the share of every Gaussian's weight, over all views, that lies in regions, or 1 without weight."""
    labeled, blank = evidence.rows.row_sums(), evidence.unlabeled.row_sums()
    return torch.where(labeled + blank > 0, labeled / (labeled + blank), 1.0)


def _check_inputs(
    directions: Tensor | Callable[[Tensor], Tensor], reliability: Tensor, own: Tensor | None, *, posterior: bool
) -> None:
    """Raise ValueError if an input of a vote is invalid or missing."""
    if posterior and own is None:
        raise InputError("a posterior vote needs own, got None; pass own=lifted.scalars.own_evidence")
    check_not_negative("reliability", reliability)
    if posterior and own is not None:
        check_not_negative("own", own)
    if isinstance(directions, Tensor):
        advice = "give rows of length 1, or of zeros for Gaussians without a direction"
        check_unit_rows(directions, "rows of directions", advice, allow_zeros=True)


@dataclass(frozen=True)
class _VoteInputs:
    """Inputs shared by all blocks of a vote."""

    neighbors: Neighbors
    reliability: Float[Tensor, " n"]
    own: Float[Tensor, " n"] | None
    """Own evidence of every Gaussian, or None for the paper's vote."""
    config: RefineConfig
    width: Float64[Tensor, ""]
    """sigma_d, in the units of the distances."""


def refine_subset(
    voters: Int64[Tensor, " v"],
    neighbors: Neighbors,
    directions: Float[Tensor, "n d"] | Callable[[Tensor], Tensor],
    reliability: Float[Tensor, " n"],
    config: RefineConfig,
    *,
    own: Float[Tensor, " n"] | None,
    width: Float64[Tensor, ""],
    progress: Progress | None = None,
) -> Int32[Tensor, " n"]:
    """Run `refine` for some of the first m Gaussians. The other Gaussians only serve as neighbors.

    Args:
        voters: Indices of the Gaussians to refine, in processing order. Neighbors in space should be close to
            each other in this order.
        neighbors: Neighbors of the first m Gaussians, which include all voters.
        directions, reliability: As in `refine`, for all n Gaussians.
        own: As in `refine`, used for voters only, or None for the paper's vote.
        width: sigma_d, in the units of the distances.
        progress: As in `refine`.
    """
    n, device, on_gpu = len(reliability), reliability.device, can_use_triton(reliability)
    inputs = _VoteInputs(neighbors, reliability, own, config, width)
    decay = float(width)
    source, row_of = (torch.arange(n, dtype=torch.int32, device=device) for _ in range(2))
    can_change = _any_reliable(neighbors, reliability)[voters]  # a neighbor that is not reliable cannot win

    def vote(voters: Tensor) -> None:
        if isinstance(directions, Tensor):
            rows = directions
        else:
            gaussians = _members(voters, neighbors, n)
            rows = directions(gaussians)
            row_of[gaussians] = torch.arange(len(gaussians), dtype=torch.int32, device=device)
        if on_gpu and rows.dtype != torch.float64 and config.k <= _MAX_KERNEL_NEIGHBORS:
            from normlift_ns.kernels.vote import vote as vote_on_gpu  # noqa: PLC0415 (needs triton)

            scores = reliability.float().contiguous()
            arrays = (voters, neighbors.index, neighbors.distance, rows.contiguous(), row_of, scores, source)
            numbers: Any = {name: getattr(config.numbers, name) for name in ("tau", "gamma", "delta")}
            evidence = None if own is None else own.float().contiguous()
            vote_on_gpu(*arrays, own=evidence, prior=config.prior, width=decay, **numbers)
        else:
            _vote(inputs, voters, rows, row_of, source)

    size, done = _BLOCK[on_gpu] if callable(directions) else max(1, n), 0
    ends = can_change.cumsum(0)[size - 1 : -1 : size].tolist()
    for block in voters[can_change].tensor_split(ends):
        if len(block) > 0:
            retry_in_halves(vote, block, "lift on the CPU (--device cpu), or give `refine` tensors on the CPU")
        done = min(done + size, len(voters))
        if progress is not None and len(voters) > 0:
            progress(done, len(voters))
    return source


def clamp_k(config: RefineConfig, n: int) -> RefineConfig:
    """Limit K to the number of other Gaussians and to `MAX_VOTERS`, and warn if this reduces K.

    Other options that are None, except tau and gamma, are set to the defaults for the kind of vote.

    >>> import warnings
    >>> with warnings.catch_warnings(record=True) as caught:
    ...     clamp_k(RefineConfig(k=100), 5).k, str(caught[0].message)
    (4, 'k is 100, but only 4 other Gaussians can vote; the vote uses 4 neighbors')
    """
    gate: dict[str, Any] = {"tau": config.tau, "gamma": config.gamma}  # the pipeline may measure those that are None
    config = replace(config, **(config.numbers._asdict() | gate))
    k = min(config.k, max(1, n - 1), MAX_VOTERS)
    if k == config.k:
        return config
    if n < 2:
        warnings.warn(f"{n} Gaussian{'s' * (n != 1)} cannot have neighbors, so no direction is refined", stacklevel=2)
        return replace(config, k=k)
    reason = (
        f"only {n - 1:,} other Gaussian{'s' * (n != 2)} can vote"
        if k < MAX_VOTERS
        else f"at most {MAX_VOTERS:,} neighbors can vote"
    )
    used = f"the vote uses {k:,} neighbor{'s' * (k != 1)}"
    warnings.warn(f"{option_name('k')} is {config.k:,}, but {reason}; {used}", stacklevel=2)
    return replace(config, k=k)


def _vote(inputs: _VoteInputs, voters: Tensor, directions: Tensor, row_of: Tensor, source: Tensor) -> None:
    """Write source[voters]. row_of[j] is the row of u_j in `directions`."""
    neighbors, config, own, width = inputs.neighbors, inputs.config, inputs.own, inputs.width
    dtype, numbers = torch.promote_types(directions.dtype, torch.float32), config.numbers
    reliability = inputs.reliability.to(dtype)
    step = max(1, _CHUNK_ELEMENTS[reliability.is_cuda] // ((config.k + 1) * max(directions.shape[1], config.k + 1)))
    for i in voters.split(step):
        group = torch.cat([i[:, None], neighbors.index[i]], dim=1)  # N+, self first
        r = _gather(reliability, group)
        if own is None:
            weight = voting_weights(neighbors, width, i, reliability)
            margin = _margin(neighbors, width, i, reliability, numbers.delta)
        else:
            weight = posterior_weights(neighbors, width, i, reliability, own, config.prior)
            margin = numbers.delta
        u = directions[row_of[group.clamp(min=0)]].to(dtype)
        g = torch.sigmoid((u @ u.transpose(1, 2) - numbers.tau) / numbers.gamma)
        score = r * (g @ weight.to(dtype)[:, :, None]).squeeze(2)
        best, choice = score[:, 1:].max(dim=1)
        wins = best > score[:, 0] + margin
        source[i[wins]] = group[wins].gather(1, choice[wins, None] + 1).squeeze(1).int()


def decay_width(spacing: Float64[Tensor, " n"], config: RefineConfig) -> Float64[Tensor, ""]:
    """Return sigma_d in the units of the means: the option `sigma_d` times the median spacing.

    If no spacing is finite, return the option itself.
    """
    finite = spacing[spacing.isfinite()]
    sigma = config.numbers.sigma_d
    if finite.numel() == 0:
        return sigma * spacing.new_ones(())
    # torch.median is slow on a GPU, because it uses a single block
    median = finite.sort().values[(finite.numel() - 1) // 2] if finite.is_cuda else finite.median()
    return sigma * median


def voting_weights(
    neighbors: Neighbors, width: Float64[Tensor, ""], rows: Int[Tensor, " m"], reliability: Float[Tensor, " n"]
) -> Float64[Tensor, "m k_plus_1"]:
    """Return R_k d_ik for every given Gaussian i and member k of N+, with i itself first, or 0 for a missing neighbor.

    Squared distances are relative to that of the nearest reliable member of N+, which is i itself unless R_i = 0. This
    multiplies all weights of i by one factor, so the winner stays the same, and the weights do not underflow. `_margin`
    multiplies Delta by the same factor.
    """
    r, square = _within(neighbors, width, rows, reliability)
    return r * _decay(r, square)


def posterior_weights(
    neighbors: Neighbors,
    width: Float64[Tensor, ""],
    rows: Int[Tensor, " m"],
    reliability: Float[Tensor, " n"],
    own: Float[Tensor, " n"],
    prior: float,
) -> Float64[Tensor, "m k_plus_1"]:
    """Return own_i, followed by P R_k d_ik / sum_k R_k d_ik of every neighbor k.

    The weight of a missing neighbor is 0, and so are the weights of all neighbors if none is reliable. Squared
    distances are relative to that of the nearest reliable neighbor. This multiplies every d_ik by the same factor,
    which cancels, and avoids underflow.
    """
    r, square = _within(neighbors, width, rows, reliability)
    near = r[:, 1:] * _decay(r[:, 1:], square[:, 1:])
    total = near.sum(dim=1, keepdim=True)
    near = torch.where(total > 0, prior * near / total, 0.0)
    return torch.cat([own[rows, None].to(near), near], dim=1)


def _within(
    neighbors: Neighbors, width: Tensor, rows: Int[Tensor, " m"], reliability: Tensor
) -> tuple[Float[Tensor, "m k_plus_1"], Float64[Tensor, "m k_plus_1"]]:
    """Return R and the squared distances in units of sigma_d of the members of N+, with i itself first."""
    r = _gather(reliability, torch.cat([rows[:, None], neighbors.index[rows]], dim=1))
    return r, torch.nn.functional.pad(neighbors.distance[rows].double() / width, (1, 0)) ** 2


def _nearest(r: Tensor, square: Tensor) -> Tensor:
    """Return the squared distance of the nearest reliable member, [M, 1], or infinity if there is none."""
    return torch.where(r > 0, square, torch.inf).amin(dim=1, keepdim=True)


def _decay(r: Tensor, square: Tensor) -> Tensor:
    """Return d_ik, computed from squared distances relative to that of the nearest reliable member."""
    return torch.exp(-0.5 * (square - _nearest(r, square)).nan_to_num(0).clamp(min=0))


def _margin(
    neighbors: Neighbors, width: Tensor, rows: Int[Tensor, " m"], reliability: Tensor, delta: float
) -> Float64[Tensor, " m"] | float:
    """Return Delta times the factor of `voting_weights`; infinity if Delta > 0 and no member is reliable."""
    if delta == 0:
        return 0.0
    return delta * torch.exp(0.5 * _nearest(*_within(neighbors, width, rows, reliability)).squeeze(1))


@check_arguments
def unsupported(neighbors: Neighbors, reliability: Float[Tensor, " n"]) -> Bool[Tensor, " m"]:
    """Return a mask of the Gaussians that voting cannot repair, because neither they nor their neighbors have R > 0.

    This is limitation 4 of the paper. The mask covers the first m Gaussians, those with a list of neighbors.

    >>> import torch
    >>> from normlift_ns import nearest_neighbors, unsupported
    >>> neighbors = nearest_neighbors(torch.tensor([[0.0, 0, 0], [1, 0, 0], [8, 0, 0], [9, 0, 0]]), k=1)
    >>> unsupported(neighbors, torch.tensor([0.5, 0.0, 0.0, 0.0])).tolist()
    [False, False, True, True]
    """
    check_rows("neighbors.index", neighbors.index, len(reliability), low=-1)
    return (reliability[: len(neighbors.index)] <= 0) & ~_any_reliable(neighbors, reliability)


def _any_reliable(neighbors: Neighbors, reliability: Float[Tensor, " n"]) -> Bool[Tensor, " m"]:
    """Return a mask of the Gaussians with a neighbor that has R > 0."""
    if can_use_triton(neighbors.index):
        from normlift_ns.kernels.vote import has_reliable_neighbor  # noqa: PLC0415 (needs triton)

        return has_reliable_neighbor(neighbors.index.contiguous(), reliability)
    return (_gather(reliability, neighbors.index) > 0).any(dim=1)


def _members(voters: Int[Tensor, " v"], neighbors: Neighbors, n: int) -> Int64[Tensor, " m"]:
    """Return the distinct indices of voters and their neighbors among n Gaussians, in ascending order."""
    if can_use_triton(neighbors.index):
        from normlift_ns.kernels.vote import voters_and_neighbors  # noqa: PLC0415 (needs triton)

        return voters_and_neighbors(voters, neighbors.index, n)
    group = torch.cat([voters, neighbors.index[voters].flatten().long()])
    mask = torch.zeros(n, dtype=torch.bool, device=voters.device)
    mask[group[group >= 0]] = True
    return mask.nonzero().squeeze(1)


def _gather(values: Tensor, index: Tensor) -> Tensor:
    """Return values[index], or 0 if the index is -1."""
    return torch.where(index >= 0, values[index.clamp(min=0)], 0.0)


# Gate of the vote, measured on neighbors that share their regions.
#
# A gate decides from a cosine whether two directions belong to the same object. Texts of one scene have cosines to each
# other of 0.73 to 0.95 in CLIP and near 0 in a classifier, so no fixed cosine suits both. After a consensus, directions
# of one object agree closely, and this agreement can be measured in the lift. Let `same` be the cosines of lifted
# directions of neighbors that share a region in at least half of the views that show both:
#
#     tau   = 5 % quantile of same, at most 0.9985
#     gamma = (1 - tau) / 2


GATE_QUANTILE = 0.05
"""Fraction of the measured pairs of neighbors that have a cosine below tau, if tau is below `MAX_TAU`. Their gate is
less than one half."""
SHARED_VIEWS = 0.5
"""Minimum fraction of views with a shared region, among the views that show both Gaussians."""
MAX_TAU = 0.9985
"""Largest tau. A sharper gate would depend on rounding."""
_PAIRS = 20_000
"""Approximate number of pairs to measure. For this number, the rank of the 5 % quantile has a standard error of about
0.15 % of the pairs."""
_LEAST_PAIRS = 50


def sample_pairs(
    gaussians: Int64[Tensor, " m"], neighbors: Int32[Tensor, "m k"], n: int
) -> tuple[Int64[Tensor, " p"], Int64[Tensor, " p"]]:
    """Return the rows of sampled Gaussians, and one neighbor of each.

    The sample and the choice of neighbors depend only on n, k and the indices of the Gaussians.

    Args:
        gaussians: Index of every row among all n Gaussians.
        neighbors: Neighbors of every row, -1 for none. Rows for which -1 is chosen are left out.
    """
    number, share = hash_to_unit(gaussians), min(1.0, _PAIRS / max(1, n))
    row = (number < share).nonzero().squeeze(1)
    slot = (number[row] / share * neighbors.shape[1]).long().clamp(max=neighbors.shape[1] - 1)
    neighbor = neighbors[row].long().gather(1, slot[:, None]).squeeze(1)
    return row[neighbor >= 0], neighbor[neighbor >= 0]


def shared_region_cosines(
    lifted: Lifted, first: Int64[Tensor, " p"], second: Int64[Tensor, " p"], level: Int64[Tensor, " s"] | None = None
) -> Float64[Tensor, " q"]:
    """Return <u_i, u_k> of the pairs that share a region in at least half of the views that show both.

    Pairs with a Gaussian without a direction are left out.

    Args:
        first, second: Rows of the two Gaussians of every pair.
        level: Level of every region (default: the same for all). Each level of a view counts as a separate view.
    """
    norm = lifted.scalars.norm
    usable = (norm[first] > 0) & (norm[second] > 0)
    first, second = first[usable], second[usable]
    together, both = shared_views(lifted.evidence, first, second, level)
    same = (both > 0) & (together >= SHARED_VIEWS * both)
    u, v = lifted.directions(first[same]), lifted.directions(second[same])
    return (u.double() * v.double()).sum(1)


def shared_views(
    evidence: Evidence,
    first: Int64[Tensor, " p"],
    second: Int64[Tensor, " p"],
    level: Int64[Tensor, " s"] | None = None,
) -> tuple[Float64[Tensor, " p"], Float64[Tensor, " p"]]:
    """Return, for every pair, the numbers of views with a shared region and of views with regions of both Gaussians.

    A Gaussian may lie in several regions of a view. The first number then counts the view with the probability that
    both Gaussians lie in the same region.

    Args:
        first, second, level: As in `shared_region_cosines`.
    """
    if len(first) == 0:
        return first.double(), first.double()
    group = evidence.region_view.long()
    if level is not None and len(level) > 0:
        group = group * (int(level.max()) + 1) + level.to(group.device)
    rows = [evidence.rows.select_rows(x) for x in (first, second)]
    seen, share = zip(*(_shares(x, group) for x in rows))
    width = len(group)
    entry = [x.row_index() * width + x.column.long() for x in rows]
    together = _matched(entry[0], entry[1], share[0], share[1], width, len(first))
    groups = int(group.max()) + 1
    both = _matched(seen[0], seen[1], torch.ones_like(seen[0]), torch.ones_like(seen[1]), groups, len(first))
    return together, both


def relative_gate(cosines: Float64[Tensor, " q"], quantile: float = GATE_QUANTILE) -> tuple[float, float] | None:
    """Return tau and gamma for the cosines of `shared_region_cosines`, or None if there are fewer than 50 cosines.

    Tau and gamma are rounded to four decimal places, so that rounding errors of the lift do not change them.

    Args:
        quantile: Fraction of the cosines below tau, in 0..1, unless tau would exceed `MAX_TAU`.

    >>> relative_gate(torch.linspace(0.8, 1.0, 101, dtype=torch.float64))
    (0.81, 0.095)
    """
    if len(cosines) < _LEAST_PAIRS:
        return None
    position = quantile * (len(cosines) - 1)
    tau = round(min(float(cosines.sort().values[int(position)]), MAX_TAU), 4)
    return tau, round((1 - tau) / 2, 4)


def _shares(rows: SparseRows, group: Int64[Tensor, " s"]) -> tuple[Int64[Tensor, " g"], Float64[Tensor, " nnz"]]:
    """Return the sorted keys of (row, group) pairs with entries, and the share of every entry in its pair's weight."""
    key = rows.row_index() * (int(group.max()) + 1) + group[rows.column.long()]
    seen, total = sum_equal_keys(key, rows.weight.double())
    return seen, rows.weight.double() / total.clamp(min=1e-30)[torch.searchsorted(seen, key)]


def _matched(
    a: Int64[Tensor, " x"], b: Int64[Tensor, " y"], at: Tensor, bt: Tensor, width: int, pairs: int
) -> Float64[Tensor, " p"]:
    """Return, for every pair, the sum of at * bt over the keys that `a` and `b` have in common.

    `at` and `bt` are the values of the keys in `a` and `b`. Keys are in ascending order, and pair i has the keys from
    i * width to (i + 1) * width - 1.
    """
    if len(b) == 0:
        return torch.zeros(pairs, dtype=torch.float64, device=a.device)
    place = torch.searchsorted(b, a).clamp(max=len(b) - 1)
    equal = b[place] == a
    products = at[equal].double() * bt[place[equal]].double()
    pair, total = sum_equal_keys(torch.div(a[equal], width, rounding_mode="floor"), products)
    return torch.zeros(pairs, dtype=torch.float64, device=a.device).index_put((pair,), total)
