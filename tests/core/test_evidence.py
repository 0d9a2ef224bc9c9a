from dataclasses import replace

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from normlift_ns import Evidence, consensus, lift
from normlift_ns.core.evidence import Entries, _join, _join_by_sorting
from tests.random_scenes import dense, generator, random_evidence, same_evidence, unit_rows

VIEWS = [3, 0, 1, 5, 2]
SEEDS = st.integers(0, 2**31)


@given(seed=SEEDS)
def test_view_weights_add_up_regions(seed):
    evidence = random_evidence(30, VIEWS, seed)
    by_region = dense(evidence.rows, sum(VIEWS))
    expected = torch.stack([by_region[:, evidence.region_view == v].sum(1) for v in range(len(VIEWS))], 1)
    weights = evidence.view_weights()
    assert torch.allclose(dense(weights, len(VIEWS)), expected, rtol=1e-14, atol=0)
    assert weights.weight.numel() == int((expected > 0).sum())


@given(seed=SEEDS, views=st.permutations(range(5)), keep=st.integers(0, 5))
def test_views_are_selected_in_the_order_asked_and_shards_give_the_whole(seed, views, keep):
    evidence = random_evidence(20, VIEWS, seed)
    chosen = list(views)[:keep]
    part = evidence.select_views(chosen)
    columns = evidence.columns_of(chosen)
    assert part.num_views == keep
    assert torch.equal(dense(part.rows, columns.numel()), dense(evidence.rows, sum(VIEWS))[:, columns])
    assert torch.equal(dense(part.unlabeled, keep), dense(evidence.unlabeled, 5)[:, chosen])
    assert part.region_view.tolist() == [i for i, v in enumerate(chosen) for _ in range(VIEWS[v])]
    shards = [evidence.select_views(range(keep)), evidence.select_views(range(keep, 5))]
    assert same_evidence(Evidence.merge(*shards), evidence) and same_evidence(Evidence.merge(evidence), evidence)


def test_fewer_gaussians_can_be_selected_than_are_excluded():
    entries = Entries(torch.tensor([0, 0, 1, 1]), torch.tensor([1, 3, 1, 3]), torch.ones(4), (1, 1))
    evidence = Evidence.from_entries([entries], 10, num_excluded=6)
    assert evidence.select_gaussians(torch.tensor([0, 1])).num_excluded == 2
    assert evidence.select_gaussians(torch.arange(10)).num_excluded == 6
    assert consensus(evidence, torch.eye(2)).gaussians == 2


@given(seed=SEEDS)
def test_regrouping_adds_up_columns(seed):
    evidence = random_evidence(30, VIEWS, seed)
    g = generator(seed)
    region_view = torch.tensor([0, 0, 2, 3, 3, 3, 4]).int()
    first, count = torch.tensor([0, 2, 2, 3, 6]), torch.tensor([2, 0, 1, 3, 1])
    view = evidence.region_view.long()
    local = torch.randint(-1, 4, (2, sum(VIEWS)), generator=g)
    columns = torch.where((local >= 0) & (local < count[view]), first[view] + local, -1)
    regrouped = evidence.regroup(columns, region_view)
    before, blank = dense(evidence.rows, sum(VIEWS)), 2 * dense(evidence.unlabeled, 5)
    expected = torch.zeros(30, 7, dtype=torch.float64)
    for level in columns:
        for old, new in enumerate(level.tolist()):
            if new >= 0:
                expected[:, new] += before[:, old]
            else:
                blank[:, evidence.region_view[old]] += before[:, old]
    assert torch.allclose(dense(regrouped.rows, 7), expected, rtol=1e-14, atol=0)
    assert torch.allclose(dense(regrouped.unlabeled, 5), blank, rtol=1e-14, atol=0)
    assert torch.equal(regrouped.region_view, region_view)
    assert same_evidence(evidence.regroup(columns, region_view), regrouped)


def test_regrouping_columns_into_themselves_changes_nothing():
    evidence = random_evidence(20, VIEWS, 0)
    assert evidence.regroup(torch.arange(sum(VIEWS))[None], evidence.region_view) is evidence
    twice = evidence.regroup(torch.arange(sum(VIEWS)).expand(2, -1), evidence.region_view)
    features = unit_rows(sum(VIEWS), 8, 0)
    one, two = (lift(e, features, unlabeled="dilute") for e in (evidence, twice))
    assert torch.allclose(two.scalars.weight, 2 * one.scalars.weight, rtol=1e-14)
    for name in ("norm", "c_intra", "c_inter", "n_eff", "reliability"):
        assert torch.allclose(getattr(two.scalars, name), getattr(one.scalars, name), rtol=1e-12), name


def test_columns_and_views_that_do_not_fit_are_refused():
    evidence = random_evidence(5, [1, 2], 0)
    for columns, message in (
        ([[0, 1]], r"columns .*\[levels, 3\].*\(1, 2\)"),
        ([[0, 1, 3]], r"columns .* -1\.\.2, got 3"),
        ([[0, -2, 1]], r"columns .* -1\.\.2, got -2"),
        ([[0, 1, 0]], "same view"),
    ):
        with pytest.raises(ValueError, match=message):
            evidence.regroup(torch.tensor(columns), evidence.region_view)
    for views in ([2], [-1], [1, 1]):
        with pytest.raises(ValueError, match=r"views .* 0\.\.1"):
            evidence.select_views(views)
    with pytest.raises(ValueError, match=r"num_gaussians.* \[5, 6\]"):
        Evidence.merge(evidence, random_evidence(6, [2], 0))
    with pytest.raises(ValueError, match="at least one"):
        Evidence.merge()
    for change, message in (
        ({"region_view": evidence.region_view[:2]}, r"column .* 0\.\.1"),
        ({"rows": evidence.rows.select_rows(torch.arange(4))}, "one per Gaussian"),
        ({"rows": replace(evidence.rows, offsets=evidence.rows.offsets[:-1])}, "rows .*offsets"),
        ({"region_view": evidence.region_view.flip(0)}, "region_view .*non-decreasing"),
    ):
        with pytest.raises(ValueError, match=message):
            replace(evidence, **change)


@st.composite
def parts_of_a_scene(draw):
    gaussians, parts = draw(st.integers(1, 9)), []
    for _ in range(draw(st.integers(1, 4))):
        counts = tuple(draw(st.lists(st.integers(0, 3), min_size=1, max_size=3)))
        columns = sum(counts) + len(counts)
        place = sorted(draw(st.sets(st.integers(0, gaussians * columns - 1), max_size=20)))
        row, column = (torch.tensor(x, dtype=torch.int32) for x in ([p // columns for p in place],
                                                                    [p % columns for p in place]))  # fmt: skip
        parts.append(Entries(row, column, torch.arange(1.0, len(place) + 1), counts))
    return gaussians, parts


@given(parts_of_a_scene())
def test_both_ways_to_join_give_the_same_matrices(case):
    gaussians, parts = case
    device = torch.device("cpu")
    for ours, theirs in zip(_join_by_sorting(parts, gaussians, device), _join(parts, gaussians, device)):
        for name in ("offsets", "column", "weight"):
            assert torch.equal(getattr(ours, name), getattr(theirs, name))
            assert getattr(ours, name).dtype == getattr(theirs, name).dtype
    evidence = Evidence.from_entries(parts, gaussians)
    counts = [count for part in parts for count in part.num_regions]
    assert evidence.region_view.tolist() == [v for v, count in enumerate(counts) for _ in range(count)]
    total = sum(float(part.weight.sum()) for part in parts)
    assert float(evidence.rows.weight.sum() + evidence.unlabeled.weight.sum()) == total
