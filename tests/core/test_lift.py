"""The lift against its definition and its identities; tests/test_numerics.py has what breaks floating point."""

import math
from dataclasses import replace

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from normlift_ns import Evidence, lift
from normlift_ns.core.sparse import SparseRows
from tests.core.test_consensus import of_dense
from tests.examples import examples
from tests.random_scenes import dense, generator, random_evidence, unit_rows

VIEWS = [3, 0, 1, 5, 2]
S, D = sum(VIEWS), 7
SEEDS = st.integers(0, 2**31)
STATISTICS = ("norm", "c_intra", "c_inter", "n_eff", "reliability", "view_count", "weight")


def evidence_of(matrix: list[list[float]], region_view: list[int], dtype: torch.dtype = torch.float64) -> Evidence:
    return of_dense(torch.tensor(matrix, dtype=dtype), torch.bincount(torch.tensor(region_view)).tolist())


@examples(5)
@given(seed=SEEDS, unlabeled=st.sampled_from(["ignore", "dilute"]), beta=st.floats(0, 10))
def test_equals_the_definition(seed, unlabeled, beta):
    evidence, features = random_evidence(25, VIEWS, seed), unit_rows(S, D, seed)
    lifted = lift(evidence, features, beta=beta, unlabeled=unlabeled)
    matrix, blank = dense(evidence.rows, S), dense(evidence.unlabeled, 5)
    directions, views = lifted.directions(), [evidence.region_view == v for v in range(5)]
    some = torch.randperm(25, generator=generator(seed))[:7]
    assert torch.equal(lifted.directions(some), directions[some])
    for j in range(25):
        s_jv = [matrix[j, view] @ features[view] for view in views]
        w_jv = [matrix[j, view].sum() + (blank[j, v] if unlabeled == "dilute" else 0) for v, view in enumerate(views)]
        w, total = sum(w_jv), sum(s_jv)
        if w == 0 or total.norm() == 0:
            assert lifted.scalars.norm[j] == lifted.scalars.reliability[j] == lifted.scalars.n_eff[j] == 0
            continue
        f, lengths, n_eff = total / w, sum(s.norm() for s in s_jv), w**2 / sum(x**2 for x in w_jv)
        expected = {
            "norm": f.norm(),
            "c_intra": lengths / w,
            "c_inter": total.norm() / lengths,
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
    same = lift(evidence, features, beta=1.0, unlabeled="ignore")  # the defaults
    assert torch.equal(same.scalars.reliability, lifted.scalars.reliability)
    # the direction beats others on sum_i A_ij <u, B_i>, and its value is W_j ||f_j|| (equations 4 and 5)
    gradient = dense(evidence.rows, S) @ features
    value = (lifted.directions() * gradient).sum(1)
    assert (value[:, None] >= gradient @ unit_rows(200, D, seed + 1).T - 1e-9).all()
    assert torch.allclose(value, lifted.scalars.weight * lifted.scalars.norm, rtol=1e-10, atol=1e-12)


def test_chunks_do_not_change_directions(monkeypatch):
    evidence, features = random_evidence(40, VIEWS, 0, dtype=torch.float32), unit_rows(S, D, 0, torch.float32)
    whole = lift(evidence, features)
    for module in ("sparse", "lift"):
        monkeypatch.setattr(f"normlift_ns.core.{module}.CHUNK_ELEMENTS", 3 * D)
    parts = lift(evidence, features)
    for name in STATISTICS:
        assert torch.equal(getattr(parts.scalars, name), getattr(whole.scalars, name))
    assert torch.equal(parts.directions(), whole.directions())


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_weights_too_small_for_float32_are_no_evidence_and_too_large_ones_refused(dtype):
    """Squares of large ones overflow: C_inter was NaN from 1e19 on."""
    table = unit_rows(2, D, 0, dtype)
    for weight in (1e-16, 1e-20, 1e-30, 1e-38, 1e-44):
        lifted = lift(evidence_of([[weight, 0.0], [1.0, weight]], [0, 1], dtype), table)
        for name in STATISTICS[:5]:
            assert getattr(lifted.scalars, name)[0] == 0, (weight, name)
            assert getattr(lifted.scalars, name)[1] > 0, (weight, name)
        assert lifted.directions()[0].abs().max() == 0
    for weight in (1.1e15, 1e30, math.inf, math.nan, -1.0):
        with pytest.raises(ValueError, match=r"weights of regions .* 0\.\.1e\+15"):
            lift(evidence_of([[1.0, weight]], [0, 1], dtype), table)
        blank = SparseRows(torch.tensor([0, 1]), torch.tensor([0]).int(), torch.tensor([weight], dtype=dtype))
        evidence = replace(evidence_of([[1.0, 1.0]], [0, 1], dtype), unlabeled=blank)
        with pytest.raises(ValueError, match="weights of unlabeled pixels"):
            lift(evidence, table)


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


def test_unlabelled_pixels_are_no_evidence_and_dilute_if_asked():
    lifted = lift(random_evidence(6, [0, 0], 0), torch.zeros(0, D))
    assert lifted.scalars.norm.tolist() == [0] * 6
    assert lifted.directions().shape == (6, D)
    diluted = lift(random_evidence(6, [0, 0], 0), torch.zeros(0, D), unlabeled="dilute")
    assert diluted.scalars.reliability.tolist() == [0] * 6
    assert diluted.scalars.view_count.sum() > 0
    # A second view without any label: ignored by default, half of the weight if diluted
    row, column = torch.tensor([0]), torch.tensor([1])
    evidence = evidence_of([[2.0]], [0])
    blank = SparseRows.from_coo(row, column, torch.tensor([2.0]).double(), 1)
    evidence = Evidence(evidence.rows, evidence.region_view, blank, 2)
    ignored, diluted = (lift(evidence, unit_rows(1, D, 0), unlabeled=mode) for mode in ("ignore", "dilute"))
    names = ("norm", "n_eff", "view_count", "c_intra", "c_inter")
    for lifted, expected in ((ignored, [1, 1, 1, 1, 1]), (diluted, [0.5, 2, 2, 0.5, 1])):
        assert [getattr(lifted.scalars, name).item() for name in names] == pytest.approx(expected)


def test_half_precision_features_are_normalised_again():
    features = unit_rows(4, 512, 0)
    lifted = lift(evidence_of([[1.0, 1, 1, 1]], [0, 0, 1, 1], torch.float32), features.half())
    assert lifted.features.dtype == torch.float32 and (lifted.features.norm(dim=1) - 1).abs().max() < 1e-6
    assert lifted.scalars.norm.item() == pytest.approx(features.mean(0).norm().item(), rel=1e-3)


@pytest.mark.usefixtures("unchecked")
def test_bad_input_is_named():
    good, evidence = unit_rows(4, D, 0), evidence_of([[1.0, 1, 1, 1]], [0, 0, 1, 1])
    for features, kwargs, message in (
        (unit_rows(3, D, 0), {}, r"features .*\[4, D\]"),
        (torch.zeros(4, D).int(), {}, "int32"),
        (good, {"beta": -1.0}, "beta .*>= 0"),
        (good, {"beta": math.inf}, "beta .*>= 0"),
        (good, {"unlabeled": "drop"}, "unlabeled .*ignore.*dilute"),
    ):
        with pytest.raises(ValueError, match=message):
            lift(evidence, features, **kwargs)
