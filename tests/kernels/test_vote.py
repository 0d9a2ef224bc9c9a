"""The kernel's vote against the plain one."""

from dataclasses import replace
from typing import Any

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from normlift_ns import Neighbors, RefineConfig, nearest_neighbors, refine, unsupported
from normlift_ns.core.partition import spatial_order
from normlift_ns.core.refine import decay_width, posterior_weights, voting_weights
from normlift_ns.kernels.vote import has_reliable_neighbor, vote, voters_and_neighbors
from tests.examples import examples
from tests.random_scenes import generator, unit_rows

DEVICE = "cuda" if torch.cuda.is_available() else "cpu"
BFLOAT16 = [torch.bfloat16] if torch.cuda.is_available() else []
"""Triton's interpreter multiplies the bits of such numbers as if they were integers."""
pytestmark = pytest.mark.filterwarnings("ignore:(overflow|invalid value) encountered:RuntimeWarning")  # of infinity


def own_evidence(reliability: torch.Tensor) -> torch.Tensor:
    """As of 0 to 8 views, by reliability only in that nobody has the one without the other."""
    views = 8 * torch.rand(len(reliability), generator=generator(len(reliability)))
    return torch.where(reliability > 0, views.to(reliability), 0.0)


def cast(neighbors: Neighbors, directions, reliability, config: RefineConfig, voters=None, **options: Any):
    """The winners of the first voters or of all, with `own_evidence` in a posterior vote; -1 if unwritten."""
    n = len(reliability)
    every = torch.arange(n, dtype=torch.int32)
    source = torch.full((n,), -1, dtype=torch.int32).to(DEVICE)
    arrays = (every.long()[:voters], neighbors.index, neighbors.distance, directions, every, reliability)
    if config.vote == "posterior":
        options = {"own": own_evidence(reliability).to(DEVICE), "prior": config.prior, **options}
    found, width = config.numbers, float(decay_width(neighbors.spacing, config))
    shape = {"tau": found.tau, "gamma": found.gamma, "width": width, "delta": found.delta}
    vote(*(x.to(DEVICE) for x in arrays), source, **shape, **options)
    return source.cpu()


def exact_scores(
    neighbors: Neighbors, directions: torch.Tensor, reliability: torch.Tensor, config: RefineConfig
) -> tuple[torch.Tensor, torch.Tensor]:
    """N+ and its scores in float64, self first with Delta on top, in units of the nearest reliable one's distance."""
    rows, r = torch.arange(len(reliability)), reliability.double()
    group = torch.cat([rows[:, None], neighbors.index], dim=1).long()
    width, found = decay_width(neighbors.spacing, config), config.numbers
    weight, margin = voting_weights(neighbors, width, rows, r), torch.tensor(found.delta)
    if config.vote == "posterior":
        weight = posterior_weights(neighbors, width, rows, r, own_evidence(reliability).double(), config.prior)
    elif found.delta > 0:
        members = torch.where(group < 0, 0.0, r[group.clamp(min=0)])
        square = torch.nn.functional.pad(neighbors.distance / width, (1, 0)) ** 2
        margin = found.delta * torch.exp(0.5 * torch.where(members > 0, square, torch.inf).amin(dim=1))
    u = directions.double()[group.clamp(min=0)]
    agree = torch.sigmoid((u @ u.transpose(1, 2) - found.tau) / found.gamma)
    score = torch.where(group < 0, -1.0, r[group.clamp(min=0)] * (agree @ weight[:, :, None]).squeeze(2))
    score[:, 0] += margin
    return group, score


def close_calls(seed: int, n: int, dimension: int, noise: float) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Means, directions that differ by `noise` in each of three classes, reliabilities that differ by as little."""
    g = generator(seed)
    means = torch.rand(n, 3, generator=g)
    classes = unit_rows(3, dimension, seed, torch.float32)[torch.randint(0, 3, (n,), generator=g)]
    spread = noise * torch.randn(n, dimension, generator=g) / dimension**0.5
    reliability = 0.5 * (1 + noise * torch.rand(n, generator=g))
    empty = torch.rand(n, generator=g) < 0.1
    directions = torch.nn.functional.normalize(classes + spread, dim=1)
    return means, torch.where(empty[:, None], 0.0, directions), torch.where(empty, 0.0, reliability)


@examples(2)
@given(
    kind=st.sampled_from(["paper", "posterior"]),
    prior=st.sampled_from([0.0, 0.5, 4.0, 100.0]),
    far=st.sampled_from([1.0, 1.0, 100.0]),
    seed=st.integers(0, 2**31),
    k=st.sampled_from([1, 7, 15, 16, 36, 63]),
    dimension=st.sampled_from([1, 16, 70]),
    noise=st.sampled_from([1e-6, 1e-4, 1e-3, 1e-2, 0.3]),
    gamma=st.sampled_from([0.003, 0.05, 0.4, 3.0]),
    tau=st.floats(-0.5, 1.0),
    sigma_d=st.floats(0.3, 4),
    delta=st.sampled_from([0.0, 1e-4, 0.3]),
    dtype=st.sampled_from([torch.float32, torch.float32, torch.float16, *BFLOAT16]),
)
def test_winners_are_those_of_float64_up_to_rounding(
    kind, prior, far, seed, k, dimension, noise, gamma, tau, sigma_d, delta, dtype
):
    means, directions, reliability = close_calls(seed, 16, dimension, noise)
    means[:4] *= far
    shape = {"k": k, "tau": tau, "gamma": gamma, "sigma_d": sigma_d}
    directions, config = directions.to(dtype), RefineConfig(vote=kind, prior=prior, delta=delta, **shape)
    neighbors = nearest_neighbors(means, k)
    group, score = exact_scores(neighbors, directions, reliability, config)
    best = score[:, 1:].max(dim=1)
    expected = torch.where(
        best.values > score[:, 0], group.gather(1, best.indices[:, None] + 1).squeeze(1), group[:, 0]
    )
    untouched = ~((group >= 0) & (reliability[group.clamp(min=0)] > 0))[:, 1:].any(dim=1)
    slack = (1e-5 + 4e-6 / gamma) * best.values + 2e-5 * torch.where(score[:, 0].isfinite(), score[:, 0], 0.0)

    found = cast(neighbors, directions, reliability, config)
    assert torch.equal(found < 0, untouched)
    scored = torch.where(group == found[:, None], score, -1.0).amax(dim=1)
    assert bool((untouched | (scored >= torch.maximum(best.values, score[:, 0]) - slack)).all())
    margin = score.topk(2, dim=1).values.diff(dim=1).squeeze(1).abs()
    assert bool((untouched | (margin <= slack) | (found == expected)).all())
    if dtype == torch.float32:
        sure, full = (cast(neighbors, directions, reliability, config, precision=p) for p in ("first", "halves"))
        assert bool(((sure < 0) | (sure == expected)).all())  # whatever the margin
        assert bool(((sure < 0) | (sure == full)).all())
        assert torch.equal(torch.where(sure < 0, full, sure), found)


def test_the_first_halves_decide_what_is_clear_and_nothing_else():
    means, directions, reliability = close_calls(5, 24, 40, 0.3)
    neighbors = nearest_neighbors(means, 12)
    known = has_reliable_neighbor(neighbors.index.to(DEVICE), reliability.to(DEVICE)).cpu()[:14]

    def sure(neighbors, directions, reliability, **shape):
        return cast(neighbors, directions, reliability, RefineConfig(**shape), voters=14, precision="first")[:14] >= 0

    clear = sure(neighbors, directions, reliability, k=12)
    assert clear[known].float().mean() > 0.8
    # a little softness is enough for the rounding of a half to matter
    assert sure(neighbors, directions, reliability, k=12, gamma=1e-5).sum() < 0.2 * clear.sum()
    # the same twice: neither wins by rounding; rows that are not unit vectors are outside of the bound
    u, r = torch.cat([directions, directions]), torch.cat([reliability, reliability])
    neighbors = nearest_neighbors(torch.cat([means, means]), 13)
    assert not sure(neighbors, u, r, k=13).any() and not sure(neighbors, 1.2 * u, r, k=13).any()


@pytest.mark.parametrize("kind", ["paper", "posterior"])
def test_a_margin_counts_in_the_units_of_supports(kind):
    """The best neighbour of one without evidence wins with Delta a little below its support, not a little above."""
    means, directions, reliability = close_calls(2, 20, 20, 0.3)
    means[0] = torch.tensor([2.0, 0.5, 0.5])
    directions[0], reliability[0] = 0, 0
    neighbors = nearest_neighbors(means, 9)
    config = RefineConfig(vote=kind, k=9)
    width, r = decay_width(neighbors.spacing, config), reliability.double()
    square = ((neighbors.distance[0] / width) ** 2)[reliability[neighbors.index[0].long()] > 0]
    assert 5 < square.min() < 150
    scale = torch.exp(-0.5 * square.min()) if kind == "paper" else 1.0
    ahead = float(exact_scores(neighbors, directions, reliability, config)[1][0, 1:].max() * scale)
    for precision in ("certified", "tf32x3"):
        for delta, wins in ((0.999 * ahead, True), (1.001 * ahead, False), (1e-30, True), (1e30, False)):
            found = cast(neighbors, directions, r.float(), replace(config, delta=delta), 1, precision=precision)
            assert (int(found[0]) != 0) == wins


def test_ties_go_to_the_nearer():
    r = torch.tensor([0, 0, 0.2, 0.9, 0.9, 0.1])
    u = torch.where(r[:, None] > 0, unit_rows(1, 40, 0, torch.float32), 0.0)
    neighbors = nearest_neighbors(torch.zeros(6, 3), 5)
    for precision in ("certified", "halves", "tf32x3"):
        found = cast(neighbors, u, r, RefineConfig(k=5), precision=precision)
        assert found.tolist() == [3, 3, 3, 3, 4, 3], precision
        assert cast(neighbors, u, r, RefineConfig(k=5), 0, precision=precision).tolist() == [-1] * 6


def test_members_and_their_reliability():
    for n, k in ((0, 3), (1, 1), (50, 7), (40, 36)):
        g = generator(n)
        index = torch.randint(-1, max(n, 1), (n, k), generator=g, dtype=torch.int32)
        index[: n // 4] = -1
        reliability = torch.where(torch.rand(n, generator=g) < 0.9, 0.0, torch.rand(n, generator=g))
        found = has_reliable_neighbor(index.to(DEVICE), reliability.to(DEVICE)).cpu()
        assert found.tolist() == [any(j >= 0 and reliability[j] > 0 for j in row) for row in index.tolist()]
        voters = torch.randperm(n, generator=g)[: n // 3]
        held = {j for i in voters.tolist() for j in (i, *index[i].tolist()) if j >= 0}
        assert voters_and_neighbors(voters.to(DEVICE), index.to(DEVICE), len(index)).tolist() == sorted(held)


@pytest.mark.parametrize("kind", [pytest.param("paper", marks=pytest.mark.extra), "posterior"])
def test_refine_with_kernels_gives_one_answer_however_directions_are_given(monkeypatch, kind):
    """The route of a GPU, here also through Triton's interpreter."""
    monkeypatch.setattr("normlift_ns.core.refine.can_use_triton", lambda tensor: True)
    monkeypatch.setattr("normlift_ns.core.refine._BLOCK", (17, 17))
    means, directions, reliability = (x.to(DEVICE) for x in close_calls(3, 45, 33, 0.3))
    means[35:] += 100
    reliability[35:] = 0
    config, own = RefineConfig(vote=kind, k=9), own_evidence(reliability.cpu()).to(DEVICE)
    whole_own = torch.stack([own, own], dim=1)[:, 0]  # not contiguous
    told = []
    neighbors = nearest_neighbors(means.cpu(), 18)
    wide = Neighbors(neighbors.index.to(DEVICE), neighbors.distance.to(DEVICE), neighbors.spacing.to(DEVICE))
    near = Neighbors(wide.index[:, :9], wide.distance[:, :9], wide.spacing)  # views: every other part of the memory
    given = {"own": own, "neighbors": near}
    whole = refine(means, directions, reliability, config, own=whole_own, neighbors=near)
    read = refine(
        means, lambda rows: directions[rows], reliability, config, progress=lambda *x: told.append(x), **given
    )
    exact = refine(means, directions.double(), reliability.double(), config, **given)
    assert torch.equal(whole, read)
    assert torch.equal(whole, exact)
    assert 3 < int((whole != torch.arange(45, device=DEVICE)).sum()) < 35
    assert told == [(17, 45), (34, 45), (45, 45)]
    half = refine(means, directions.half(), reliability, config, **given)
    rounded = refine(means, directions.half().double(), reliability, config, **given)
    assert torch.equal(half, rounded)
    lost = unsupported(near, reliability)
    assert lost.tolist() == [False] * 35 + [True] * 10


def test_spatial_order_is_a_permutation_that_keeps_neighbours_together():
    means = torch.rand(2000, 3, generator=generator(4))
    means[3], means[7] = torch.inf, torch.nan
    order = spatial_order(means)
    assert torch.equal(order.sort().values, torch.arange(2000))
    step = means[order].diff(dim=0).norm(dim=1)
    assert step[step.isfinite()].mean() < 0.15  # 0.66 in a random order
    assert torch.equal(spatial_order(means[[7, 7, 7]]), torch.arange(3))
