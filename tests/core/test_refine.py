"""Mode voting against a Python loop, its invariances, and the ablation variants."""

import math
from decimal import Decimal, localcontext

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from normlift_ns import RefineConfig, lift, nearest_neighbors, refine, refine_variant, unsupported
from tests.scenes import generator, random_evidence, unit_rows

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


def vote(means, u, r, config) -> list[int]:
    """Equations 9 and 10, one term at a time; distances from the nearest reliable member."""
    n = len(means)
    distance = (means[:, None] - means[None]).norm(dim=-1)
    nearest = torch.where(distance > 0, distance, math.inf).min(1).values
    unit = sorted(nearest.tolist())[(n - 1) // 2]  # torch's median
    source = []
    for i in range(n):
        near = sorted((distance[i, j].item(), j) for j in range(n) if j != i)[: config.k]
        group = [i] + [j for _, j in near]
        start = min((distance[i, j].item() for j in group if r[j] > 0), default=0.0)

        def score(j: int, i=i, group=group, start=start) -> float:
            total = 0.0
            for k in group:
                d = math.exp(-0.5 * (distance[i, k].item() ** 2 - start**2) / (config.sigma_d * unit) ** 2)
                g = 1 / (1 + math.exp(-((u[k] @ u[j]).item() - config.tau) / config.gamma))
                total += r[k].item() * d * g
            return r[j].item() * total

        scores = [score(j) for j in group]
        best = max(range(1, len(group)), key=lambda place: (scores[place], -place))
        source.append(group[best] if scores[best] > scores[0] + config.delta else i)
    return source


@settings(deadline=None, max_examples=20)
@given(seed=SEEDS, k=st.integers(1, 70), sigma_d=st.floats(0.3, 5), tau=st.floats(0.2, 0.95), delta=st.floats(0, 0.5))
def test_equals_the_loop(seed, k, sigma_d, tau, delta):
    means, u, r = scene(seed, n=40)
    config = RefineConfig(k=k, sigma_d=sigma_d, tau=tau, gamma=0.05, delta=delta)
    assert refine(means, u, r, config).tolist() == vote(means, u, r, config)


def test_the_loop_test_changes_something():
    means, u, r = scene(0)
    changed = refine(means, u, r, RefineConfig(k=12)) != torch.arange(60)
    assert 10 < int(changed.sum()) < 60
    assert changed[r == 0].float().mean() > 0.8


@settings(deadline=None, max_examples=20)
@given(seed=SEEDS)
def test_invariances(seed):
    """Rigid motion, scale of the scene, order of Gaussians, rotation of feature space."""
    means, u, r = scene(seed)
    config = RefineConfig(k=12)
    source = refine(means, u, r, config)
    g = generator(seed)
    rotation = torch.linalg.qr(torch.randn(3, 3, generator=g, dtype=torch.float64)).Q
    assert torch.equal(refine(means @ rotation + 7, u, r, config), source)
    assert torch.equal(refine(means * 1e-3, u, r, config), source)
    turn = torch.linalg.qr(torch.randn(8, 8, generator=g, dtype=torch.float64)).Q
    assert torch.equal(refine(means, u @ turn, r, config), source)
    order = torch.randperm(60, generator=g)
    position = torch.empty_like(order)
    position[order] = torch.arange(60)
    assert torch.equal(refine(means[order], u[order], r[order], config), position[source[order].long()].int())


def test_chunks_do_not_change_the_vote(monkeypatch):
    means, u, r = scene(1)
    whole = refine(means, u, r, RefineConfig(k=12))
    monkeypatch.setattr("normlift_ns.core.refine._CHUNK_ELEMENTS", 13 * 13 * 3)
    assert torch.equal(refine(means, u, r, RefineConfig(k=12)), whole)


@pytest.mark.parametrize("config", [RefineConfig(k=12, delta=1e30), RefineConfig(k=1, delta=5.0)])
def test_a_margin_that_nobody_clears_is_the_identity(config):
    means, u, r = scene(2)
    assert torch.equal(refine(means, u, r, config), torch.arange(60, dtype=torch.int32))


def test_unreliable_neighbourhoods_stay_untouched_and_are_counted():
    """Two clusters far apart; nobody in the second is reliable, so nothing there can be repaired (limitation 4 of the
    paper).
    """
    means, u, r = scene(3)
    means[30:] += 1000
    r[30:] = 0
    config = RefineConfig(k=12)
    source = refine(means, u, r, config)
    assert torch.equal(source[30:], torch.arange(30, 60, dtype=torch.int32))
    lost = unsupported(nearest_neighbors(means, config.k), r)
    assert int(lost.sum()) == 30
    assert lost[30:].all()


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_one_far_from_everything_is_repaired_as_without_underflow(dtype):
    """A Gaussian without evidence, 1,000 spacings from a cluster: exp(-500,000) is 0 in any format of the machine."""
    means, u, r = scene(3)
    means[0] = torch.tensor([1000.0, 0, 0])
    u[0], r[0] = 0, 0
    config = RefineConfig(k=12)
    near = nearest_neighbors(means, config.k)
    scores = {}
    with localcontext() as context:
        context.Emin = -(10**9)
        for j in near.index[0].tolist():
            total = Decimal(0)
            for k, distance in zip(near.index[0].tolist(), near.distance[0].tolist()):
                decay = (-((Decimal(distance) / Decimal(float(near.spacing.median()))) ** 2) / 2).exp()
                agree = torch.sigmoid((u[j] @ u[k] - config.tau) / config.gamma)
                total += Decimal(float(r[k] * agree)) * decay
            scores[j] = Decimal(float(r[j])) * total
    assert 0 < max(scores.values()) < Decimal(10) ** -100_000
    assert int(refine(means.to(dtype), u.to(dtype), r.to(dtype), config)[0]) == max(scores, key=scores.__getitem__)


def test_a_reliable_cluster_far_away_never_changes():
    means, u, r = scene(4)
    means[:20] += 1000
    u[:20], r[:20] = u[0] if u[0].abs().sum() > 0 else unit_rows(1, 8, 0)[0], 0.9
    assert torch.equal(refine(means, u, r, RefineConfig(k=12))[:20], torch.arange(20, dtype=torch.int32))


@pytest.mark.parametrize("n", [1, 2, 5])
def test_more_neighbours_than_gaussians(n):
    means, u, r = scene(5, n=n)
    assert refine(means, u, r, RefineConfig(k=36)).tolist() == vote(means, u, r, RefineConfig(k=36)) if n > 1 else [0]


def test_coincident_gaussians_copy_the_most_reliable():
    means = torch.zeros(6, 3, dtype=torch.float64)
    u = unit_rows(1, 8, 0).repeat(6, 1)
    r = torch.tensor([0, 0, 0.2, 0.9, 0.9, 0.1], dtype=torch.float64)
    source = refine(means, torch.where(r[:, None] > 0, u, 0.0), r, RefineConfig(k=5))
    assert source.tolist() == [3, 3, 3, 3, 4, 3]


def test_half_precision_directions_vote_like_float32():
    means, u, r = scene(6)
    single, half = refine(means, u.float(), r), refine(means, u.half(), r)
    assert (single == half).float().mean() > 0.95


@pytest.mark.parametrize(
    ("kwargs", "message"),
    [
        ({"k": 0}, "k must be at least 1, got 0"),
        ({"sigma_d": 0.0}, "sigma_d must be positive"),
        ({"tau": 1.5}, "tau must be in -1..1"),
        ({"gamma": -1.0}, "gamma must be positive"),
        ({"delta": -0.1}, "delta must be not negative"),
    ],
)
def test_parameters_have_ranges(kwargs, message):
    with pytest.raises(ValueError, match=message):
        RefineConfig(**kwargs)


@pytest.mark.usefixtures("unchecked")
def test_disagreeing_shapes_are_named():
    means, u, r = scene(7)
    with pytest.raises(ValueError, match="must have the same rows, got 60"):
        refine(means, u[1:], r)
    with pytest.raises(ValueError, match=r"neighbors.index has shape \(60, 5\), expected \(60, 36\)"):
        refine(means, u, r, neighbors=nearest_neighbors(means, 5))


def test_ablation_variants_are_what_their_names_say():
    evidence, features = random_evidence(50, [3, 2, 4], 0), unit_rows(9, 8, 0)
    means = torch.rand(50, 3, generator=generator(0), dtype=torch.float64)
    lifted = lift(evidence, features)
    config = RefineConfig(k=8, tau=0.5)
    u = lifted.directions()
    got = {
        name: refine_variant(name, means, lifted, config)
        for name in ("none", "knn", "linear", "norm", "support", "full")
    }
    ones = (lifted.scalars.norm > 0).double()
    support = torch.where(lifted.scalars.n_eff > 0, lifted.scalars.n_eff / (lifted.scalars.n_eff + 1), 0.0)
    assert torch.equal(got["none"], u)
    for name, r in (
        ("knn", ones),
        ("norm", lifted.scalars.norm),
        ("support", support),
        ("full", lifted.scalars.reliability),
    ):
        assert torch.equal(got[name], u[refine(means, u, r, config).long()]), name
    near = nearest_neighbors(means, 8)
    group = [7, *near.index[7].tolist()]
    distance = torch.cat([torch.zeros(1).double(), near.distance[7]])
    weight = (
        torch.exp(-0.5 * (distance / (config.sigma_d * near.spacing.median())) ** 2) * lifted.scalars.reliability[group]
    )
    assert torch.allclose(got["linear"][7], torch.nn.functional.normalize(weight @ u[group], dim=0))
    assert len({value.sum().item() for value in got.values()}) == 6


@pytest.mark.usefixtures("unchecked")
def test_unknown_variant():
    lifted = lift(random_evidence(5, [2], 0), unit_rows(2, 8, 0))
    with pytest.raises(ValueError, match="variant must be one of none, knn, linear, norm, support, full"):
        refine_variant("mean", torch.rand(5, 3), lifted)


def test_directions_given_block_by_block_change_nothing(monkeypatch):
    means, directions, reliability = scene(7, n=300)
    config = RefineConfig(k=9, delta=0.0)
    whole = refine(means, directions, reliability, config)
    monkeypatch.setattr("normlift_ns.core.refine._BLOCK", (40, 40))
    asked = []

    def some(gaussians):
        asked.append(len(gaussians))
        return directions[gaussians]

    assert torch.equal(refine(means, some, reliability, config), whole)
    assert len(asked) == 8
    assert max(asked) < 300


def test_progress_comes_in_blocks_and_blocks_change_nothing(monkeypatch):
    means, u, r = scene(1)
    told: list[tuple[int, int]] = []
    whole = refine(means, u, r, RefineConfig(k=12))
    monkeypatch.setattr("normlift_ns.core.refine._BLOCK", (7, 7))
    found = refine(means, lambda rows: u[rows], r, RefineConfig(k=12), progress=lambda *step: told.append(step))
    assert torch.equal(found, whole)
    assert len(told) == 9
    assert told[-1] == (60, 60)
    assert told == sorted(told)
