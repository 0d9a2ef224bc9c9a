"""Both votes against Python loops, their invariances and limits, and the ablation variants."""

import copy
import itertools
import math
import pickle
from dataclasses import asdict, replace
from decimal import Decimal, localcontext
from functools import cache
from typing import get_args

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from normlift_ns import InputError, RefineConfig, lift, nearest_neighbors, refine, refine_variant, unsupported
from normlift_ns.core.refine import clamp_k, labeled_share
from normlift_ns.evaluation.studies import Variant, recorded_vote
from normlift_ns.options import VOTE_DEFAULTS, VoteParameters
from tests.examples import examples
from tests.random_scenes import generator, random_evidence, unit_rows

SEEDS = st.integers(0, 2**31)


def scene(seed: int, n: int = 60, classes: int = 3) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Means, directions near one of a few classes, reliabilities, some of them 0 with direction 0."""
    g = generator(seed)
    means = torch.rand(n, 3, generator=g, dtype=torch.float64)
    which = torch.randint(0, classes, (n,), generator=g)
    noise = 0.3 * torch.randn(n, 8, generator=g, dtype=torch.float64)
    u = torch.nn.functional.normalize(unit_rows(classes, 8, seed)[which] + noise, dim=1)
    reliability = torch.rand(n, generator=g, dtype=torch.float64)
    zero = torch.rand(n, generator=g) < 0.2
    return means, torch.where(zero[:, None], 0.0, u), torch.where(zero, 0.0, reliability)


Scores = list[dict[int, Decimal]]


def scores(means, u, r, config, own=None) -> Scores:
    """What every Gaussian and its K nearest neighbours, nearest first, score in both votes as `refine` defines them:
    one term at a time, nothing shifted, in decimal numbers that do not underflow."""
    n, numbers, rely = len(means), config.numbers, [Decimal(x) for x in r.tolist()]
    distance, cosine = (means[:, None] - means[None]).norm(dim=-1), (u @ u.T).tolist()
    nearest = torch.where(distance > 0, distance, math.inf).min(1).values
    unit, distance = sorted(nearest.tolist())[(n - 1) // 2], distance.tolist()  # torch's median

    @cache
    def g(j: int, k: int) -> Decimal:
        return Decimal(1 / (1 + math.exp(-(cosine[k][j] - numbers.tau) / numbers.gamma)))

    found: Scores = []
    with localcontext() as context:
        context.Emin = -(10**9)
        for i in range(n):
            near = [j for _, j in sorted((distance[i][j], j) for j in range(n) if j != i)[: config.k]]
            share = {
                k: rely[k] * (-((Decimal(distance[i][k]) / Decimal(numbers.sigma_d * unit)) ** 2) / 2).exp()
                for k in (i, *near)
            }
            total = sum(share[k] for k in near)
            found.append({})
            for j in (i, *near):
                if config.vote == "paper":
                    found[i][j] = rely[j] * sum(share[k] * g(j, k) for k in (i, *near))
                else:
                    mean = sum(share[k] * g(j, k) for k in near) / total if total > 0 else Decimal(0)
                    found[i][j] = rely[j] * (Decimal(own[i].item()) * g(i, j) + Decimal(config.prior) * mean)
    return found


def vote(means, u, r, config, own=None) -> list[int]:
    source = []
    for i, score in enumerate(scores(means, u, r, config, own)):
        near = [j for j in score if j != i]
        best = max(near, key=lambda j: (score[j], -near.index(j)))
        source.append(best if score[best] > score[i] + Decimal(config.numbers.delta) else i)
    return source


@examples(5)
@given(
    seed=SEEDS,
    k=st.integers(1, 24) | st.just(50),
    sigma_d=st.floats(0.3, 5),
    tau=st.floats(0.2, 0.95),
    delta=st.floats(0, 0.5),
    prior=st.sampled_from([0.0, 0.5, 4.0, 30.0]),
)
def test_equals_the_loop(seed, k, sigma_d, tau, delta, prior):
    for far in (False, True):
        means, u, r = scene(seed, n=25)
        if far:  # of all weights of some Gaussians nothing is left in the numbers of the machine
            means[:3] *= 300
            means[20:] += 40
        own = torch.where(r > 0, 8 * torch.rand(25, generator=generator(seed), dtype=torch.float64), 0.0)
        for kind in VOTE_DEFAULTS:
            config = RefineConfig(vote=kind, k=k, sigma_d=sigma_d, tau=tau, gamma=0.05, delta=delta, prior=prior)
            assert refine(means, u, r, config, own=own).tolist() == vote(means, u, r, config, own)


@examples(5)
@given(seed=SEEDS, kind=st.sampled_from(["paper", "posterior"]))
def test_invariances(seed, kind):
    """Rigid motion, scale of the scene, order of Gaussians, rotation of feature space, unit of reliability."""
    means, u, r = scene(seed)
    config, own = RefineConfig(vote=kind, k=12), 5 * r
    source = refine(means, u, r, config, own=own)
    g = generator(seed)
    rotation = torch.linalg.qr(torch.randn(3, 3, generator=g, dtype=torch.float64)).Q
    assert torch.equal(refine(means @ rotation + 7, u, r, config, own=own), source)
    assert torch.equal(refine(means * 1e-3, u, r, config, own=own), source)
    turn = torch.linalg.qr(torch.randn(8, 8, generator=g, dtype=torch.float64)).Q
    assert torch.equal(refine(means, u @ turn, r, config, own=own), source)
    order = torch.randperm(60, generator=g)
    position = torch.empty_like(order)
    position[order] = torch.arange(60)
    moved = refine(means[order], u[order], r[order], config, own=own[order])
    assert torch.equal(moved, position[source[order].long()].int())
    for factor in (2.0**-40, 4.0) if kind == "posterior" else ():  # where the unit of reliability cancels
        assert torch.equal(refine(means, u, factor * r, config, own=own), source)


@examples(5)
@given(seed=SEEDS, dtype=st.sampled_from([torch.float32, torch.float64]), kind=st.sampled_from(["paper", "posterior"]))
def test_margins_are_compared_with_supports_in_their_own_units(seed, dtype, kind):
    """Delta a little below and above what the best of each neighbourhood is ahead: it wins, and it does not."""
    means, u, r = scene(seed, n=30)
    means[::3] *= 4  # some far from everybody
    own, config = 5 * r, RefineConfig(vote=kind, k=9, sigma_d=2.0)
    arrays, compared = [x.to(dtype) for x in (means, u, r)], 0
    for i, score in enumerate(scores(means, u, r, config, own)[:10]):
        ahead = float(max(score[j] for j in score if j != i) - score[i])
        slack = 1e-12 if dtype == torch.float64 else 1e-5 * float(max(score.values()))
        if ahead > 3 * slack:
            compared += 1
            deltas = (max(0.0, ahead - slack), ahead + slack)
            assert [int(refine(*arrays, replace(config, delta=x), own=own)[i]) != i for x in deltas] == [True, False]
    assert compared > 1


def test_chunks_and_blocks_change_nothing_and_progress_comes_in_blocks(monkeypatch):
    means, u, r = scene(1)
    told: list[tuple[int, int]] = []
    asked: list[int] = []
    config = RefineConfig(vote="paper", k=12)
    whole = refine(means, u, r, config)

    def some(rows):
        asked.append(len(rows))
        return u[rows]

    monkeypatch.setattr("normlift_ns.core.refine._CHUNK_ELEMENTS", (13 * 13 * 3, 13 * 13 * 3))
    assert torch.equal(refine(means, u, r, config), whole)
    monkeypatch.setattr("normlift_ns.core.refine._BLOCK", (7, 7))
    assert torch.equal(refine(means, some, r, config, progress=lambda *step: told.append(step)), whole)
    assert len(told) == len(asked) == 9 and max(asked) < 60
    assert told[-1] == (60, 60) and told == sorted(told)


def test_unreliable_neighbourhoods_stay_untouched_and_are_counted():
    """Nobody in the second of two distant clusters is reliable, so nothing there can be repaired (limitation 4)."""
    means, u, r = scene(3)
    means[30:] += 1000
    r[30:] = 0
    config = RefineConfig(k=12)
    for kind in ("paper", "posterior"):
        source = refine(means, u, r, replace(config, vote=kind), own=1 + r)
        assert torch.equal(source[30:], torch.arange(30, 60, dtype=torch.int32))
    lost = unsupported(nearest_neighbors(means, config.k), r)
    assert int(lost.sum()) == 30
    assert lost[30:].all()


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_one_far_from_everything_is_repaired_as_without_underflow(dtype):
    """A Gaussian without evidence, 1,000 spacings from a cluster: exp(-500,000) is 0 in any format of the machine. It
    takes the mode at Delta = 0, and clears no margin in the paper's vote."""
    means, u, r = scene(3, n=25)
    means[0] = torch.tensor([1000.0, 0, 0])
    u[0], r[0] = 0, 0
    for kind, own in itertools.product(VOTE_DEFAULTS, (torch.zeros(25).double(), 5 * r)):
        config = RefineConfig(vote=kind, k=12)
        best, winner = max(scores(means, u, r, config, own)[0].values()), vote(means, u, r, config, own)[0]
        assert (kind != "paper" or 0 < best < Decimal(10) ** -50_000) and winner != 0
        for delta in (0.0, 1e-30, 0.1):
            found = refine(*(x.to(dtype) for x in (means, u, r)), replace(config, delta=delta), own=own)[0]
            assert int(found) == (0 if kind == "paper" and delta > 0 else winner)


def test_gaussians_outside_of_regions_keep_their_direction():
    means, u, r = scene(4)
    labeled, own = torch.rand(60, generator=generator(5), dtype=torch.float64), 5 * r
    free = refine(means, u, r, RefineConfig(k=12), own=own)
    held = refine(means, u, r, RefineConfig(k=12, min_labeled=0.5), own=own, labeled=labeled)
    itself = torch.arange(60, dtype=torch.int32)
    assert torch.equal(held, torch.where(labeled >= 0.5, free, itself)) and not torch.equal(held, free)
    assert torch.equal(refine(means, u, r, RefineConfig(k=12, min_labeled=0.0), own=own, labeled=labeled), free)
    evidence = random_evidence(40, [2, 3], 0, fill=0.3)
    whole = evidence.rows.row_sums() + evidence.unlabeled.row_sums()
    expected = torch.where(whole > 0, evidence.rows.row_sums() / whole, 1.0)
    assert torch.equal(labeled_share(evidence), expected) and bool((whole == 0).any())


def test_coincident_gaussians_copy_the_most_reliable_and_half_precision_votes_alike():
    means = torch.zeros(6, 3, dtype=torch.float64)
    u = unit_rows(1, 8, 0).repeat(6, 1)
    r = torch.tensor([0, 0, 0.2, 0.9, 0.9, 0.1], dtype=torch.float64)
    source = refine(means, torch.where(r[:, None] > 0, u, 0.0), r, RefineConfig(vote="paper", k=5))
    assert source.tolist() == [3, 3, 3, 3, 4, 3]
    means, u, r = scene(6)
    single, half = refine(means, u.float(), r), refine(means, u.half(), r)
    assert (single == half).float().mean() > 0.95


@pytest.mark.usefixtures("unchecked")
def test_what_does_not_fit_is_named():
    means, u, r = scene(7)
    with pytest.raises(ValueError, match=r"n = 60.*\(59, "):
        refine(means, u[1:], r)
    with pytest.raises(ValueError, match=r"neighbors.index .*\(60, 5\).*\(60, 36\)"):
        refine(means, u, r, neighbors=nearest_neighbors(means, 5))
    config = RefineConfig(vote="posterior", k=5)
    for own, told in ((None, "own.*None"), (r[1:], r"n = 60.*\(59,\)")):
        with pytest.raises(InputError, match=told):
            refine(means, u, r, config, own=own)
    with pytest.raises(InputError, match=r"n = 60.*\(59,\)"):
        refine(means, u, r, config, own=r, labeled=r[1:])
    with pytest.raises(ValueError, match=f"variant.*{', '.join(get_args(Variant))}.*mean"):
        refine_variant("mean", means, lift(random_evidence(60, [2], 0), unit_rows(2, 8, 0)))


def test_defaults_are_those_of_the_kind_of_vote():
    """A number given counts for either kind."""
    assert RefineConfig(vote="posterior", tau=0.5).numbers == VOTE_DEFAULTS["posterior"]._replace(tau=0.5)
    assert RefineConfig(vote="paper") == replace(RefineConfig(vote="posterior"), vote="paper")
    assert RefineConfig().numbers == VOTE_DEFAULTS["posterior"] == VoteParameters(2.0, 0.9, 0.05, 0.0, 0.2)
    assert VOTE_DEFAULTS["paper"] == VoteParameters(1.0, 0.95, 0.4, 0.0, 0.0) and RefineConfig().vote == "posterior"


def test_configs_and_manifests_of_version_01_keep_the_papers_vote():
    old = RefineConfig.__new__(RefineConfig)
    old.__setstate__({"k": 36, "sigma_d": 1.0, "tau": 0.95, "gamma": 0.4, "delta": 0.0})
    assert (old.vote, old.prior, old.numbers) == ("paper", 4.0, VoteParameters(1.0, 0.95, 0.4, 0.0, 0.0))
    manifest = {
        "options": {"vote": {"k": 36, "sigma_d": 2.5, "tau": 0.9, "gamma": 0.4, "delta": 0.1}, "reliability_beta": 2.0}
    }
    own = recorded_vote(manifest)
    assert own.variant == own.config.vote == "paper" and own.config.numbers == VoteParameters(2.5, 0.9, 0.4, 0.1, 0.0)
    assert recorded_vote({}).config == RefineConfig()
    told = asdict(clamp_k(RefineConfig(vote="posterior", tau=0.5), 1000))  # gamma may still be measured
    numbers = {"k": 36, "prior": 4.0, "delta": 0.0, "gamma": None, "sigma_d": 2.0, "tau": 0.5, "min_labeled": 0.2}
    assert told == {"vote": "posterior", **numbers}
    assert recorded_vote({"options": {"vote": told}}).variant == "posterior"
    new = RefineConfig(vote="posterior", sigma_d=3.0)
    assert copy.copy(new) == pickle.loads(pickle.dumps(new)) == new


def test_ablation_variants_are_what_their_names_say():
    evidence, features = random_evidence(50, [3, 2, 4], 0), unit_rows(9, 8, 0)
    means = torch.rand(50, 3, generator=generator(0), dtype=torch.float64)
    lifted = lift(evidence, features)
    config = RefineConfig(vote="paper", k=8, tau=0.5)
    u = lifted.directions()
    got = {name: refine_variant(name, means, lifted, config) for name in get_args(Variant)}
    scalars = lifted.scalars
    ones = (scalars.norm > 0).double()
    support = torch.where(scalars.n_eff > 0, scalars.n_eff / (scalars.n_eff + 1), 0.0)
    assert torch.equal(got["none"], u)
    rely = {"plain_knn": ones, "norm_only": scalars.norm, "support_only": support, "paper": scalars.reliability}
    for name, r in rely.items():
        assert torch.equal(got[name], u[refine(means, u, r, config).long()]), name
    own = scalars.norm * scalars.n_eff
    assert torch.equal(scalars.own_evidence, own)
    posterior = refine(means, u, scalars.reliability, RefineConfig(vote="posterior", k=8), own=own)
    assert torch.equal(got["posterior"], u[posterior.long()])
    # parameters are those of a kind of vote
    ours = RefineConfig(vote="posterior", k=8, tau=0.5)
    given = u[refine(means, u, scalars.reliability, ours, own=own).long()]
    assert torch.equal(refine_variant("posterior", means, lifted, ours), given)
    plain = u[refine(means, u, scalars.reliability, RefineConfig(vote="paper", k=8)).long()]
    assert torch.equal(refine_variant("paper", means, lifted, ours), plain)
    near = nearest_neighbors(means, 8)
    group = [7, *near.index[7].tolist()]
    distance = torch.cat([torch.zeros(1).double(), near.distance[7]])
    width = config.numbers.sigma_d * near.spacing.median()
    weight = torch.exp(-0.5 * (distance / width) ** 2) * lifted.scalars.reliability[group]
    assert torch.allclose(got["linear"][7], torch.nn.functional.normalize(weight @ u[group], dim=0))
    assert len({value.sum().item() for value in got.values()}) == 7
