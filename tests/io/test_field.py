"""What is stored answers like the lift that made it, within the bound it states."""

from dataclasses import replace

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from normlift_ns import Lifted, SemanticField, lift, relevancy
from normlift_ns.core.field import fingerprint
from normlift_ns.core.lowrank import StoredEvidence, basis_of_rank, spectral_table
from tests.random_scenes import generator, random_evidence, unit_rows

VIEWS = [6, 5, 0, 7]
S, D, N = sum(VIEWS), 12, 40
FORMS = ["evidence", "float16", "low_rank"]


def low_rank_table(rank: int, seed: int, dtype: torch.dtype) -> torch.Tensor:
    return torch.nn.functional.normalize(unit_rows(S, rank, seed) @ unit_rows(rank, D, seed + 1), dim=1).to(dtype)


def example(seed=0, rank=4, dtype=torch.float32) -> tuple[Lifted, torch.Tensor, torch.Tensor]:
    lifted = lift(random_evidence(N, VIEWS, seed, fill=0.15, dtype=dtype), low_rank_table(rank, seed, dtype))
    means = torch.rand(N, 3, generator=generator(seed))
    return lifted, means, torch.randint(0, N, (N,), generator=generator(seed)).int()


@pytest.mark.parametrize("form", FORMS)
def test_every_form_answers_within_its_bound_after_a_round_trip(form, tmp_path):
    lifted, means, source = example()
    field = SemanticField.build(lifted, means, source, storage=form, tolerance=2e-3)
    field.save(tmp_path / "normlift")
    loaded = SemanticField.load(tmp_path / "normlift", means)
    text = 10 * unit_rows(20, D, 9).float()
    bound = field.manifest["forms"][form]["bound"]
    assert bound <= 2e-3
    for refined in (True, False):
        directions = lifted.directions()[source.long()] if refined else lifted.directions()
        expected, found = directions @ torch.nn.functional.normalize(text, dim=1).T, loaded.query(text, refined=refined)
        assert (found - expected).abs().max() <= bound + 1e-6
        assert torch.equal(found, field.query(text, refined=refined))
        assert (loaded.directions(refined=refined) - directions).norm(dim=1).max() <= bound + 1e-3
        assert torch.equal(loaded.valid(refined=refined), directions.abs().sum(1) > 0)
        assert (found[~loaded.valid(refined=refined)] == 0).all()
    assert torch.equal(loaded.query(text), loaded.query(text, refined=True))
    assert 0 < int((~loaded.valid(refined=False)).sum()) < N  # the example has Gaussians without evidence
    for name in ("norm", "c_intra", "c_inter", "n_eff", "reliability", "view_count", "weight"):
        assert torch.equal(getattr(loaded.scalars, name), getattr(lifted.scalars, name)), name
    stored = sum(p.stat().st_size for p in (tmp_path / "normlift").glob("*.safetensors"))
    shared = 4 * 8 * N  # seven scalars and the source of each Gaussian
    assert 0 < stored - shared - field.manifest["forms"][form]["bytes"] < 3000  # headers


def test_auto_takes_the_smallest_form_within_the_tolerance():
    lifted, means, _ = example(rank=2)
    forms = SemanticField.build(lifted, means, tolerance=2e-3).manifest["forms"]
    assert set(forms) == set(FORMS)
    given = SemanticField.build(lifted, means, tolerance=1e-3, storage="auto")
    assert SemanticField.build(lifted, means).manifest == given.manifest
    assert forms["low_rank"]["rank"] == 2
    for tolerance, expected in ((2e-3, min(FORMS, key=lambda name: forms[name]["bytes"])), (1e-6, "evidence")):
        assert SemanticField.build(lifted, means, tolerance=tolerance).manifest["form"] == expected
    field = SemanticField.build(lifted, means, storage="float16")  # no row is stored without evidence
    assert not isinstance(field.store, StoredEvidence)
    assert len(field.store.coordinates) == int((lifted.scalars.norm > 0).sum()) < N
    assert torch.equal(field.source, torch.arange(N, dtype=torch.int32))  # of an unrefined one


@given(seed=st.integers(0, 2**31), rank=st.integers(0, D - 1))
def test_bound_of_any_basis_holds_for_every_gaussian(seed, rank):
    lifted = lift(random_evidence(N, VIEWS, seed), unit_rows(S, D, seed))
    for size in (rank, D):
        basis = basis_of_rank(lifted, spectral_table(lifted.features), size)
        exact = lifted.directions()
        found = torch.nn.functional.normalize(exact @ basis.rows.T @ basis.rows, dim=1)
        error = (found - exact).norm(dim=1)  # the largest over all unit query vectors
        assert (error <= basis.bound + 1e-9).all()
    assert basis.bound.max() < 2e-5


def test_near_cancelled_gaussians_force_an_exact_form_whose_answers_are_right():
    """||f|| = 5e-5: any basis short of the whole space would turn that direction, so none is offered."""
    u = unit_rows(1, D, 0)
    pair = torch.cat([u, torch.nn.functional.normalize(-u + 1e-4 * unit_rows(1, D, 1), dim=1)])
    rows = random_evidence(2, [11], 0, fill=1.0)
    weight = torch.cat([torch.ones(2), torch.full((9,), 1e-9), torch.ones(11)]).double()
    lifted = lift(replace(rows, rows=replace(rows.rows, weight=weight)), torch.cat([pair, unit_rows(9, D, 2)]))
    assert lifted.scalars.norm[0] < 1e-4
    forms = SemanticField.build(lifted, torch.rand(2, 3), tolerance=1e-3).manifest["forms"]
    assert "low_rank" not in forms or forms["low_rank"]["rank"] == 11

    rows = random_evidence(1, [2], 0, fill=1.0, dtype=torch.float32)
    lifted = lift(replace(rows, rows=replace(rows.rows, weight=torch.ones(2))), pair.float())
    field = SemanticField.build(lifted, torch.zeros(1, 3), storage="evidence")
    text = unit_rows(50, D, 3).float()
    exact = torch.nn.functional.normalize(pair.float().double().sum(0, keepdim=True), dim=1)
    assert (field.query(text, refined=False) - exact @ text.double().T).abs().max() < 1e-4


def test_relevancy_never_finds_gaussians_without_evidence():
    lifted, means, _ = example()
    field = SemanticField.build(lifted, means, storage="evidence")
    text, negatives = unit_rows(3, D, 1).float(), unit_rows(4, D, 2).float()
    empty = ~field.valid()
    for form, least in (("cosine", 0), ("lerf", 0), ("margin", -2)):
        values = field.relevancy(text, negatives, rule=form)
        assert (values[empty] == least).all()
        expected = relevancy(field.query(text), field.query(negatives), rule=form)
        assert torch.allclose(values[~empty], expected[~empty], atol=1e-6)


def test_a_field_of_other_gaussians_is_refused_and_none_is_replaced_unasked(tmp_path):
    lifted, means, source = example()
    SemanticField.build(lifted, means, source, storage="evidence").save(tmp_path / "a")
    with pytest.raises(ValueError, match=r"/a .*40.* step-1\.ckpt .*39.*ns-normlift"):
        SemanticField.load(tmp_path / "a", means[1:], checkpoint="step-1.ckpt")
    with pytest.raises(ValueError, match=r"/a .*other Gaussians.* step-1\.ckpt"):
        SemanticField.load(tmp_path / "a", means + 1, checkpoint="step-1.ckpt")
    assert fingerprint(means) == fingerprint(means.double()) != fingerprint(means + 1)
    other = SemanticField.build(lifted, means, source, storage="float16")
    with pytest.raises(FileExistsError, match="already contains a semantic field"):
        other.save(tmp_path / "a")
    other.save(tmp_path / "a", overwrite=True)
    assert sorted(p.name for p in (tmp_path / "a").iterdir()) == ["field.safetensors", "manifest.json"]
    assert SemanticField.load(tmp_path / "a", means).manifest["form"] == "float16"


@pytest.mark.usefixtures("unchecked")
def test_bad_arguments_are_named():
    lifted, means, source = example()
    field = SemanticField.build(lifted, means, provenance={"encoder": "test"})
    assert field.manifest["encoder"] == "test"
    for vectors, message in (
        (torch.ones(1, D + 1), rf"text vectors .*\[Q, {D}\]"),
        (torch.zeros(1, D), "must be finite and not zero"),
        (torch.full((1, D), torch.nan), "must be finite and not zero"),
    ):
        with pytest.raises(ValueError, match=message):
            field.query(vectors)
    for kwargs, message in (
        ({"tolerance": 0.0}, "tolerance must be positive"),
        ({"source": source[1:]}, "source must be"),
    ):
        with pytest.raises(ValueError, match=message):
            SemanticField.build(lifted, means, **kwargs)
    with pytest.raises(ValueError, match=r"basis .*1e-05"):
        SemanticField.build(lifted, means, storage="low_rank", tolerance=1e-5)
