"""The lift against its definition, its identities, and the cases that break floating point."""

import math
from dataclasses import replace

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from normlift_ns import Evidence, lift
from normlift_ns.core.sparse import SparseRows
from tests.scenes import dense, generator, random_evidence, unit_rows

VIEWS = [3, 0, 1, 5, 2]
S, D = sum(VIEWS), 7
SEEDS = st.integers(0, 2**31)
STATISTICS = ("norm", "c_intra", "c_inter", "n_eff", "reliability", "view_count", "weight")


def evidence_of(matrix: list[list[float]], region_view: list[int], dtype: torch.dtype = torch.float64) -> Evidence:
    values = torch.tensor(matrix, dtype=dtype)
    row, column = values.nonzero(as_tuple=True)
    rows = SparseRows.from_coo(row, column, values[row, column], len(values))
    views = max(region_view) + 1
    blank = SparseRows.from_coo(row[:0], row[:0], values[0, :0], len(values))
    return Evidence(rows, torch.tensor(region_view).int(), blank, views)


@given(seed=SEEDS, unlabeled=st.sampled_from(["ignore", "dilute"]), beta=st.floats(0, 10))
def test_equals_the_definition(seed, unlabeled, beta):
    evidence, features = random_evidence(25, VIEWS, seed), unit_rows(S, D, seed)
    lifted = lift(evidence, features, beta=beta, unlabeled=unlabeled)
    matrix, blank = dense(evidence.rows, S), dense(evidence.unlabeled, 5)
    directions = lifted.directions()
    for j in range(25):
        s_jv = [
            sum((matrix[j, s] * features[s] for s in range(S) if evidence.region_view[s] == v), torch.zeros(D).double())
            for v in range(5)
        ]
        w_jv = [sum(matrix[j, s].item() for s in range(S) if evidence.region_view[s] == v) for v in range(5)]
        if unlabeled == "dilute":
            w_jv = [w + blank[j, v].item() for v, w in enumerate(w_jv)]
        w = sum(w_jv)
        total = sum(s_jv)
        if w == 0 or total.norm() == 0:
            assert lifted.scalars.norm[j] == lifted.scalars.reliability[j] == lifted.scalars.n_eff[j] == 0
            continue
        f = total / w
        c_intra = sum(s.norm() for s in s_jv) / w
        n_eff = w**2 / sum(x**2 for x in w_jv)
        expected = {
            "norm": f.norm(),
            "c_intra": c_intra,
            "c_inter": total.norm() / sum(s.norm() for s in s_jv),
            "n_eff": n_eff,
            "reliability": f.norm() * n_eff / (n_eff + beta),
            "view_count": sum(x > 0 for x in w_jv),
            "weight": w,
        }
        for name, value in expected.items():
            assert float(getattr(lifted.scalars, name)[j]) == pytest.approx(float(value), rel=1e-11), name
        assert (directions[j] - f / f.norm()).abs().max() < 1e-11


@given(seed=SEEDS)
def test_identities(seed):
    evidence, features = random_evidence(25, VIEWS, seed), unit_rows(S, D, seed)
    lifted = lift(evidence, features)
    found = lifted.scalars.norm > 0
    assert (lifted.scalars.norm - lifted.scalars.c_intra * lifted.scalars.c_inter).abs().max() <= 1e-10
    for name in ("norm", "c_intra", "c_inter", "reliability"):
        assert (getattr(lifted.scalars, name) >= 0).all()
        assert (getattr(lifted.scalars, name) <= 1).all()
    assert (lifted.scalars.n_eff[found] >= 1 - 1e-12).all()
    assert (lifted.scalars.n_eff <= lifted.scalars.view_count + 1e-12).all()
    assert torch.allclose(lifted.directions()[found].norm(dim=1), torch.ones(int(found.sum())).double(), atol=1e-12)
    weaker = lift(evidence, features, beta=2.0)
    assert (weaker.scalars.reliability <= lifted.scalars.reliability).all()


@given(seed=SEEDS)
def test_direction_is_the_optimum_of_cosine_alignment(seed):
    """u* beats random directions on sum_i A_ij <u, B_i>, and its value is W_j ||f_j|| (eq. 4, 5)."""
    evidence, features = random_evidence(25, VIEWS, seed), unit_rows(S, D, seed)
    lifted = lift(evidence, features)
    gradient = dense(evidence.rows, S) @ features
    value = (lifted.directions() * gradient).sum(1)
    rivals = gradient @ unit_rows(200, D, seed + 1).T
    assert (value[:, None] >= rivals - 1e-9).all()
    assert torch.allclose(value, lifted.scalars.weight * lifted.scalars.norm, rtol=1e-10, atol=1e-12)


@given(seed=SEEDS, scale=st.floats(1e-3, 1e3), cut=st.integers(1, 4))
def test_invariances(seed, scale, cut):
    """Order of views, shards, subsets of Gaussians, a common scale of all weights, rotation of the feature space."""
    evidence, features = random_evidence(25, VIEWS, seed), unit_rows(S, D, seed)
    lifted, directions = lift(evidence, features), lift(evidence, features).directions()

    order = torch.randperm(5, generator=generator(seed)).tolist()
    shuffled = lift(evidence.select_views(order), features[evidence.columns_of(order)])
    shards = Evidence.merge(evidence.select_views(range(cut)), evidence.select_views(range(cut, 5)))
    scaled = replace(evidence, rows=replace(evidence.rows, weight=evidence.rows.weight * scale))
    for other in (shuffled, lift(shards, features), lift(scaled, features)):
        for name in STATISTICS[:-1]:
            assert torch.allclose(
                getattr(other.scalars, name), getattr(lifted.scalars, name), rtol=1e-10, atol=1e-12
            ), name
        assert (other.directions() - directions).abs().max() < 1e-10

    rotation = torch.linalg.qr(torch.randn(D, D, generator=generator(seed), dtype=torch.float64)).Q
    turned = lift(evidence, features @ rotation)
    assert torch.allclose(turned.scalars.reliability, lifted.scalars.reliability, rtol=1e-9, atol=1e-12)
    assert (turned.directions() - directions @ rotation).abs().max() < 1e-9

    some = torch.randperm(25, generator=generator(seed))[:7]
    assert torch.equal(lifted.directions(some), directions[some])
    assert torch.equal(torch.cat([block for _, block in lifted.iter_directions()]), directions)


def test_chunks_do_not_change_directions(monkeypatch):
    evidence, features = random_evidence(40, VIEWS, 0, dtype=torch.float32), unit_rows(S, D, 0, torch.float32)
    whole = lift(evidence, features)
    for module in ("sparse", "lift"):
        monkeypatch.setattr(f"normlift_ns.core.{module}.CHUNK_ELEMENTS", 3 * D)
    parts = lift(evidence, features)
    for name in STATISTICS:
        assert torch.equal(getattr(parts.scalars, name), getattr(whole.scalars, name))
    assert torch.equal(parts.directions(), whole.directions())


def test_identical_observations_are_fully_consistent():
    features = unit_rows(1, D, 0).repeat(3, 1)
    lifted = lift(evidence_of([[1, 2, 3]], [0, 1, 2]), features)
    assert (lifted.scalars.norm.item(), lifted.scalars.c_intra.item(), lifted.scalars.c_inter.item()) == pytest.approx(
        (1, 1, 1), abs=1e-12
    )
    assert lifted.scalars.n_eff.item() == pytest.approx(36 / 14)
    assert lifted.scalars.reliability.item() == pytest.approx((36 / 14) / (36 / 14 + 1))


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_observations_that_cancel_exactly_have_no_direction(dtype):
    u = unit_rows(1, D, 0, dtype)
    lifted = lift(evidence_of([[1, 1], [0, 0], [1, 0]], [0, 1], dtype), torch.cat([u, -u]))
    for name in ("norm", "c_intra", "c_inter", "n_eff", "reliability"):
        values = getattr(lifted.scalars, name)
        assert values[:2].tolist() == [0, 0]
        assert values[2] > 0
    assert lifted.scalars.view_count.tolist() == [2, 0, 1]
    assert lifted.directions()[:2].abs().max() == 0


@pytest.mark.parametrize("gap", [1e-1, 1e-3, 1e-4, 1e-5])
@pytest.mark.parametrize("same_view", [True, False])
def test_observations_that_nearly_cancel_keep_their_digits(gap, same_view):
    """float32 features half turned against each other by all but `gap`: norm and direction as float64 gives them for
    the same numbers.
    """
    g = generator(1)
    features = torch.nn.functional.normalize(torch.randn(1, 512, generator=g).double(), dim=1)
    other = torch.nn.functional.normalize(-features + gap * torch.randn(1, 512, generator=g).double() / 512**0.5, dim=1)
    table = torch.cat([features, other]).float()
    views = [0, 0] if same_view else [0, 1]
    single = lift(evidence_of([[1.0, 1.0]], views, torch.float32), table)
    exact = lift(evidence_of([[1.0, 1.0]], views), single.features.double())
    assert exact.scalars.norm.item() == pytest.approx(gap / 2, rel=0.1)
    # Renormalising float32 rows in float64 moves them by 6e-8, the resolution that a float32 table has.
    assert single.scalars.norm.item() == pytest.approx(exact.scalars.norm.item(), abs=1e-7)
    assert (single.directions().double() - exact.directions()).norm() < 2e-7 / gap
    assert single.scalars.c_intra.item() * single.scalars.c_inter.item() == pytest.approx(
        single.scalars.norm.item(), rel=1e-5
    )


def test_one_dominant_view():
    u, v = unit_rows(2, D, 0)
    lifted = lift(evidence_of([[1e6, 1.0, 1.0]], [0, 1, 2]), torch.stack([u, v, v]))
    assert lifted.scalars.n_eff.item() == pytest.approx(1, abs=1e-5)
    assert lifted.scalars.norm.item() == pytest.approx(1, abs=1e-5)
    assert lifted.scalars.reliability.item() == pytest.approx(0.5, abs=1e-5)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_weights_from_1e_minus_12_to_1e6(dtype):
    """Rows of tiny weights next to rows of huge ones, and both in one sum."""
    features = unit_rows(3, D, 0, dtype)
    matrix = [[1e-12, 2e-12, 0], [1e6, 1e-12, 3.0], [1e-12, 2e-12, 1e-12], [1e6, 1e6, 1e6]]
    lifted = lift(evidence_of(matrix, [0, 1, 2], dtype), features)
    exact = lift(evidence_of(matrix, [0, 1, 2]), features.double())
    for name in STATISTICS:
        assert torch.allclose(
            getattr(lifted.scalars, name).double(), getattr(exact.scalars, name).double(), rtol=1e-6
        ), name
    assert lifted.scalars.norm[0].item() == pytest.approx(((features[0] + 2 * features[1]) / 3).norm().item(), rel=1e-6)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("weight", [1e-16, 1e-20, 1e-30, 1e-38, 1e-44])
def test_weights_too_small_for_float32_are_no_evidence(dtype, weight):
    lifted = lift(evidence_of([[weight, 0.0], [1.0, weight]], [0, 1], dtype), unit_rows(2, D, 0, dtype))
    for name in STATISTICS[:5]:
        assert getattr(lifted.scalars, name)[0] == 0
        assert getattr(lifted.scalars, name)[1] > 0
    assert lifted.directions()[0].abs().max() == 0


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("weight", [1.1e15, 1e30, math.inf, math.nan, -1.0])
def test_weights_too_large_for_float32_are_refused(dtype, weight):
    """Their squares overflow: C_inter was NaN from 1e19 on."""
    with pytest.raises(ValueError, match=r"weights of regions must be in 0\.\.1e\+15, found"):
        lift(evidence_of([[1.0, weight]], [0, 1], dtype), unit_rows(2, D, 0, dtype))
    blank = SparseRows(torch.tensor([0, 1]), torch.tensor([0], dtype=torch.int32), torch.tensor([weight], dtype=dtype))
    evidence = replace(evidence_of([[1.0, 1.0]], [0, 1], dtype), unlabeled=blank)
    with pytest.raises(ValueError, match="weights of unlabelled pixels must be in"):
        lift(evidence, unit_rows(2, D, 0, dtype))


def test_very_many_entries_keep_their_digits():
    """Added up one after the other in float32 they lose three digits."""
    n = 200_000
    features = unit_rows(1, 8, 0, torch.float32).expand(n, -1)
    offsets, column = torch.tensor([0, n]), torch.arange(n, dtype=torch.int32)
    rows = SparseRows(offsets, column, torch.full((n,), 1.1e-6))
    none = SparseRows(torch.zeros(2, dtype=torch.int64), column[:0], rows.weight[:0])
    lifted = lift(Evidence(rows, torch.zeros(n, dtype=torch.int32), none, 1), features)
    assert abs(lifted.scalars.norm.item() - 1) < 1e-6
    assert (lifted.directions() - features[:1]).norm() < 1e-6


def test_a_single_view():
    lifted = lift(evidence_of([[1.0, 3.0]], [0, 0]), unit_rows(2, D, 0))
    assert lifted.scalars.n_eff.item() == pytest.approx(1)
    assert lifted.scalars.c_inter.item() == pytest.approx(1)
    assert lifted.scalars.reliability.item() == pytest.approx(lifted.scalars.norm.item() / 2)


def test_no_evidence_at_all():
    lifted = lift(random_evidence(6, [0, 0], 0), torch.zeros(0, D))
    assert lifted.scalars.norm.tolist() == [0] * 6
    assert lifted.directions().shape == (6, D)
    diluted = lift(random_evidence(6, [0, 0], 0), torch.zeros(0, D), unlabeled="dilute")
    assert diluted.scalars.reliability.tolist() == [0] * 6
    assert diluted.scalars.view_count.sum() > 0


def test_views_with_unlabelled_pixels_only_dilute():
    """A second view without any label: ignored by default, half of the weight if diluted."""
    row, column = torch.tensor([0]), torch.tensor([1])
    evidence = evidence_of([[2.0]], [0])
    blank = SparseRows.from_coo(row, column, torch.tensor([2.0]).double(), 1)
    evidence = Evidence(evidence.rows, evidence.region_view, blank, 2)
    ignored, diluted = (lift(evidence, unit_rows(1, D, 0), unlabeled=mode) for mode in ("ignore", "dilute"))
    assert (
        ignored.scalars.norm.item(),
        ignored.scalars.n_eff.item(),
        ignored.scalars.view_count.item(),
    ) == pytest.approx((1, 1, 1))
    assert (
        diluted.scalars.norm.item(),
        diluted.scalars.n_eff.item(),
        diluted.scalars.view_count.item(),
    ) == pytest.approx((0.5, 2, 2))
    assert (diluted.scalars.c_intra.item(), diluted.scalars.c_inter.item()) == pytest.approx((0.5, 1))


def test_half_precision_features_are_normalised_again():
    features = unit_rows(4, 512, 0)
    lifted = lift(evidence_of([[1.0, 1, 1, 1]], [0, 0, 1, 1], torch.float32), features.half())
    assert lifted.features.dtype == torch.float32
    assert (lifted.features.norm(dim=1) - 1).abs().max() < 1e-6
    assert lifted.scalars.norm.item() == pytest.approx(features.mean(0).norm().item(), rel=1e-3)


@pytest.mark.parametrize("value", [0.0, math.nan, math.inf, 3.0])
def test_rows_that_are_no_unit_vectors_are_refused(value):
    features = unit_rows(4, D, 0)
    features[2] = value
    with pytest.raises(ValueError, match=r"1 of 4 feature rows are not unit vectors \(row 2 has length"):
        lift(evidence_of([[1.0, 1, 1, 1]], [0, 0, 1, 1]), features)


@pytest.mark.usefixtures("unchecked")
@pytest.mark.parametrize(
    ("features", "kwargs", "message"),
    [
        (unit_rows(3, D, 0), {}, r"features must be \[4, D\]"),
        (torch.zeros(4, D).int(), {}, "got torch.int32"),
        (unit_rows(4, D, 0), {"beta": -1.0}, "beta must be >= 0"),
        (unit_rows(4, D, 0), {"beta": math.nan}, "beta must be >= 0"),
        (unit_rows(4, D, 0), {"unlabeled": "drop"}, 'unlabeled must be "ignore" or "dilute"'),
    ],
)
def test_bad_input_is_named(features, kwargs, message):
    with pytest.raises(ValueError, match=message):
        lift(evidence_of([[1.0, 1, 1, 1]], [0, 0, 1, 1]), features, **kwargs)
