"""Consensus of regions across views, against loops straight from the formula in float64."""

import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from normlift_ns import Evidence
from normlift_ns.core.consensus import (
    apply_consensus,
    consensus,
    region_overlaps,
    sample_gaussians,
    with_original_reliability,
)
from normlift_ns.core.lift import lift
from normlift_ns.core.reliability import norm_of_reliability
from normlift_ns.core.sparse import SparseRows
from normlift_ns.errors import InputError
from tests.encoders.tiny import DEVICES
from tests.examples import examples
from tests.random_scenes import dense, generator, random_evidence, unit_rows

ROOT = Path(__file__).resolve().parents[2]
VIEWS = [3, 0, 1, 5, 2, 4, 0]
SEEDS = st.integers(0, 2**31)


def things(seed: int, gaussians: int = 60, views: int = 5, count: int = 4) -> Evidence:
    """Every view has a region per thing; a few Gaussians lie between two, and some views miss some."""
    g = generator(seed)
    own = torch.randint(0, count, (gaussians,), generator=g)
    weight = torch.zeros(gaussians, views, count, dtype=torch.float64)
    seen = torch.rand(gaussians, views, generator=g, dtype=torch.float64) + 0.5
    weight.scatter_(2, own[:, None, None].expand(-1, views, 1), seen[:, :, None])
    other = torch.randint(0, count, (gaussians, views, 1), generator=g)
    weight.scatter_add_(2, other, 0.3 * torch.rand(gaussians, views, 1, generator=g, dtype=torch.float64))
    weight[torch.rand(gaussians, views, generator=g) < 0.2] = 0
    return of_dense(weight.flatten(1), [count] * views)


def of_dense(weight: torch.Tensor, counts: list[int]) -> Evidence:
    row, column = weight.nonzero(as_tuple=True)
    rows = SparseRows.from_coo(row, column.int(), weight[row, column], len(weight))
    view = torch.repeat_interleave(torch.arange(len(counts)), torch.tensor(counts, dtype=torch.int64)).int()
    nothing = torch.zeros(0, dtype=torch.int32)
    blank = SparseRows.from_coo(nothing, nothing, torch.zeros(0, dtype=torch.float64), len(weight))
    return Evidence(rows, view, blank, len(counts))


def oracle(evidence: Evidence, features: torch.Tensor, power: float, level: torch.Tensor) -> torch.Tensor:
    """The formula, in loops; every view's median weight is taken over its Gaussians that any region holds."""
    n, size, view = evidence.num_gaussians, evidence.num_regions, evidence.region_view.tolist()
    whole, count = dense(evidence.view_weights(), evidence.num_views), len(level.unique())
    whole = (whole + dense(evidence.unlabeled, evidence.num_views)) / count  # of every level
    weight, out = dense(evidence.rows, size).double(), features.double().clone()
    held = (weight > 0).any(dim=1)
    for number in level.unique().tolist():
        mine = [s for s in range(size) if level[s] == number]
        p, sees = torch.zeros(n, size, dtype=torch.float64), torch.zeros(n, evidence.num_views, dtype=torch.bool)
        for v in range(evidence.num_views):
            of_view = [s for s in mine if view[s] == v]
            total = torch.maximum(whole[:, v], weight[:, of_view].sum(1))
            for j in (held & (total > 0)).nonzero().flatten().tolist():
                if total[j] >= 0.5 * total[held & (total > 0)].median():
                    kept = [s for s in of_view if weight[j, s] >= 0.02 * total[j]]
                    p[j, kept] = weight[j, kept] / total[j]
                    sees[j, v] = True
        J, c = torch.zeros(size, size, dtype=torch.float64), torch.zeros(size, size, dtype=torch.float64)
        met, area = 0.0, 0.0
        for s in mine:
            for t in mine:
                both = (sees[:, view[s]] & sees[:, view[t]]).double()
                if view[s] != view[t] and (p[:, s] * p[:, t]).sum() > 0:
                    inner = (p[:, s] * p[:, t]).sum()
                    c[s, t] = inner / (p[:, s] * both).sum()
                    J[s, t] = inner / ((p[:, s] * both).sum() + (p[:, t] * both).sum() - inner)
        J[J < 0.1] = 0
        for s in mine:
            for v in set(range(evidence.num_views)) - {view[s]}:
                a = (p[:, s] * p[:, [t for t in mine if view[t] == v]].sum(1)).sum()
                area += float(a)
                met += float(a) * max([float(J[s, t]) for t in mine if view[t] == v] or [0.0])
        strength = min(1.0, max(0.0, (met / area - 0.4) / 0.1)) if area > 0 else 0.0
        for s in mine:
            total = features[s].double().clone()
            for t in mine:
                total += strength * J[s, t] * c[t, s] ** power * features[t]
            if features[s].abs().sum() > 0 and J[s].sum() > 0 and strength > 0:
                out[s] = total / total.norm()
    return out


@examples(5)
@given(seed=SEEDS, power=st.sampled_from([0.0, 1.0, 2.0]), levels=st.integers(1, 2))
def test_equals_the_formula(seed, power, levels):
    for evidence, of in ((things(seed, gaussians=25), levels), (random_evidence(20, VIEWS, seed), 1)):
        features = unit_rows(evidence.num_regions, 6, seed)
        features[seed % 3 :: 5] = 0
        level = torch.arange(evidence.num_regions) % of
        found = consensus(evidence, features, level=level, power=power)
        assert torch.allclose(found.features, oracle(evidence, features, power, level), rtol=0, atol=1e-12)
        if power == 1 and of == 1:
            assert torch.equal(consensus(evidence, features).features, found.features)  # that is the default


def test_a_region_that_overlaps_nothing_keeps_its_feature():
    weight = dense(things(0).rows, 20)
    weight = torch.cat([weight, torch.zeros(len(weight), 2)], 1)
    weight = torch.cat([weight, torch.zeros(5, 22)])
    weight[-5:, 20] = 1.0  # seen by one view alone; the last region by none
    evidence = of_dense(weight, [4, 4, 4, 4, 4, 2])
    features = unit_rows(22, 9, 1, torch.float32)
    found = consensus(evidence, features).features
    assert torch.equal(found[20:], features[20:])
    assert bool((found[:20] != features[:20]).any(dim=1).all())


@pytest.mark.parametrize("device", DEVICES)
@examples(5)
@given(seed=SEEDS)
def test_levels_together_are_levels_apart(device, seed):
    """Two levels of masks of the same pictures in one evidence, columns in any order within their view: the same as
    each on its own, though regions of both hold the same Gaussians."""
    weights = [dense(things(seed + i, count=n).rows, 5 * n).view(60, 5, n) for i, n in enumerate((3, 4))]
    seen = weights[0].sum(2, keepdim=True) * (weights[1].sum(2, keepdim=True) > 0)  # a pixel counts in either level
    weights = [torch.nan_to_num(weight / weight.sum(2, keepdim=True)) * seen for weight in weights]
    apart = [of_dense(weight.flatten(1), [weight.shape[2]] * 5) for weight in weights]
    tables = [unit_rows(evidence.num_regions, 6, seed + i) for i, evidence in enumerate(apart)]
    expected = [consensus(evidence, table) for evidence, table in zip(apart, tables)]
    order = torch.stack([7 * view + torch.randperm(7, generator=generator(seed + view)) for view in range(5)])
    together = torch.cat(weights, 2).flatten(1)[:, order.flatten()]
    features = torch.cat([table.view(5, -1, 6) for table in tables], 1).flatten(0, 1)[order.flatten()]
    level = torch.tensor([4] * 3 + [1] * 4).repeat(5)[order.flatten()]
    found = consensus(of_dense(together, [7] * 5).to(device), features.to(device), level=level, sample=10**6)
    tolerance = 1e-12 if device == "cpu" else 1e-5
    for of_level, number in zip(expected, (4, 1)):
        place = order.flatten().argsort()[level[order.flatten().argsort()] == number]
        assert torch.allclose(found.features.cpu()[place], of_level.features, rtol=0, atol=tolerance)
    assert found.agreement == pytest.approx([of_level.agreement[0] for of_level in expected[::-1]], abs=1e-6)
    mixed = consensus(of_dense(together, [7] * 5), features).features
    assert not torch.allclose(mixed, found.features.cpu(), atol=1e-3)  # as one level they are another thing


@pytest.mark.parametrize("side", [0.2, 0.4])
def test_cells_of_an_arbitrary_partition_are_left_alone(side):
    """Squares of every view lie where they lie: what they have in common is chance, whatever the features."""
    g = generator(1)
    place = torch.rand(4000, 2, generator=g)
    count = int(1 / side) + 2
    weight = torch.zeros(4000, 8, count * count)
    for view in range(8):
        cell = ((place + side * torch.rand(2, generator=g)) / side).long()
        weight[torch.arange(4000), view, cell[:, 0] * count + cell[:, 1]] = 1
    evidence = of_dense(weight.flatten(1), [count * count] * 8)
    features = unit_rows(evidence.num_regions, 8, 1)
    found = consensus(evidence, features)
    assert found.agreement[0] < 0.45
    assert (found.features * features).sum(1).mean() > 0.9
    asked = consensus(evidence, features, least=0.0)  # whoever asks says that they are things
    assert asked.agreement == found.agreement
    assert (asked.features * features).sum(1).mean() < 0.85


def test_strength_rises_by_a_tenth_above_the_least():
    evidence = random_evidence(40, [5, 6, 7], 3)
    features = unit_rows(18, 8, 3)
    overlaps = region_overlaps(evidence.rows, evidence.region_view)
    whole, b = apply_consensus(features, overlaps, least=0.0), overlaps.agreement
    assert b > 0.1
    assert torch.equal(apply_consensus(features, overlaps, least=b), features)
    assert torch.equal(apply_consensus(features, overlaps, least=b - 0.11), whole)
    others = dense(SparseRows(overlaps.iou.offsets, overlaps.iou.column, overlaps.iou.weight * overlaps.inside), 18)
    half = features + 0.5 * others.to(features.dtype) @ features
    expected = torch.nn.functional.normalize(half, dim=1)
    assert torch.allclose(apply_consensus(features, overlaps, least=b - 0.05), expected, atol=1e-5)


def large(regions: int, gaussians: int, views: int) -> Evidence:
    """Every Gaussian in one region of every view, things of neighbouring numbers."""
    g = generator(0)
    per_view = regions // views
    thing = torch.rand(gaussians, generator=g) * per_view
    blur = 0.2 * torch.randn(gaussians, views, generator=g)
    local = (thing[:, None] + blur).clamp(0, per_view - 1e-3).long()
    column = (local + per_view * torch.arange(views)).int()
    offsets = torch.arange(gaussians + 1) * views
    empty = SparseRows(torch.zeros(gaussians + 1, dtype=torch.int64), torch.zeros(0, dtype=torch.int32), torch.zeros(0))
    rows = SparseRows(offsets, column.flatten(), torch.ones(gaussians * views))
    return Evidence(rows, (torch.arange(per_view * views) // per_view).int(), empty, views)


@pytest.mark.parametrize("device", DEVICES)
def test_a_sample_tells_what_the_whole_does_with_the_same_bits_each_time(device):
    evidence, features = large(300, 15_000, 10).to(device), unit_rows(300, 32, 0, torch.float32).to(device)
    sampled, again, whole = (consensus(evidence, features, **how) for how in ({"sample": 50}, {}, {"sample": 10**6}))
    assert sampled.gaussians < 3000 and whole.gaussians == 15_000
    assert torch.equal(again.features, sampled.features) and again.agreement == sampled.agreement
    assert (1 - (sampled.features * whole.features).sum(1)).mean() < 0.01
    assert sampled.agreement[0] == pytest.approx(whole.agreement[0], abs=0.05)


@given(seed=SEEDS, least=st.integers(1, 30))
def test_every_region_has_its_sample(seed, least):
    evidence = random_evidence(300, VIEWS, seed)
    chosen, chance = sample_gaussians(evidence.rows, sum(VIEWS), least)
    count, got = (torch.bincount(r.column, minlength=15) for r in (evidence.rows, evidence.rows.select_rows(chosen)))
    assert bool((got >= count.clamp(max=least)).all())
    assert bool(((chance > 0) & (chance <= 1)).all())


MANY = """
import resource
from normlift_ns.core.consensus import consensus
from tests.core.test_consensus import large
from tests.random_scenes import unit_rows
evidence, features = large(40_000, 60_000, 20), unit_rows(40_000, 8, 0).float()
before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
found = consensus(evidence, features)
more = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before
print(evidence.num_regions, more * 1024, found.agreement[0], float((found.features != features).any(1).double().mean()))
"""


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="peak memory is told in other units")
def test_tens_of_thousands_of_masks_need_no_square_of_them():
    """Which would take 6.4 GB in float32. In a process of its own, whose peak is that of the consensus."""
    done = subprocess.run([sys.executable, "-c", MANY], cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    regions, more, agreement, changed = map(float, done.stdout.split())
    assert regions == 40_000
    assert more < 2**31
    assert agreement > 0.5
    assert changed > 0.99


def test_scale_of_weights_does_not_matter_and_half_precision_stays():
    evidence, features = things(5), unit_rows(20, 6, 5)
    expected = consensus(evidence, features).features
    for scale in (1e-30, 1e-3, 1e30):
        scaled = replace(evidence, rows=replace(evidence.rows, weight=(evidence.rows.weight * scale).float()))
        assert torch.allclose(consensus(scaled, features).features, expected, atol=1e-6), scale
    half = consensus(evidence, features.half()).features
    assert half.dtype == torch.float16
    assert torch.allclose(half.double(), expected, atol=2e-3)


def test_little_evidence_and_opposite_features():
    for gaussians, counts in ((0, []), (0, [2, 1]), (5, []), (5, [0, 0]), (5, [3]), (5, [1, 1])):
        size = sum(counts)
        features = unit_rows(size, 4, 0, torch.float32) if size > 0 else torch.zeros(0, 4)
        for weight in (torch.zeros(gaussians, size), torch.rand(gaussians, size, generator=generator(0))):
            found = consensus(of_dense(weight, counts), features).features
            assert found.isfinite().all() and found.shape == features.shape
            if len([c for c in counts if c > 0]) < 2 or gaussians == 0:
                assert torch.equal(found, features)
    # Opposite features leave a row as it is
    evidence = of_dense(torch.ones(4, 2, dtype=torch.float64), [1, 1])
    features = torch.tensor([[1.0, 0.0], [-1.0, 0.0]])
    assert torch.equal(consensus(evidence, features).features, features)


def test_refusals(unchecked):
    evidence = things(0)
    features = unit_rows(20, 4, 0)
    for arguments, message in (
        ({"features": features[:3]}, r"features.*\b20\b.*\b3"),
        ({"level": torch.zeros(3, dtype=torch.int64)}, r"level .*s = 20.*\(3,\)"),
        ({"power": -1.0}, "power .*-1"),
        ({"sample": 0}, "sample .*0"),
        ({"sample": 1.5}, "sample .*1.5"),
        ({"least": -0.1}, r"least .*-0\.1"),
        ({"least": 1.1}, r"least .*1\.1"),
        ({"features": torch.ones(20)}, r"features .*float32 \(20,\)"),
        ({"level": torch.arange(20) - 1}, "level "),
    ):
        with pytest.raises(InputError, match=message):
            consensus(evidence, **{"features": features, **arguments})


@given(SEEDS)
@examples(5)
def test_norm_before_the_consensus_follows_from_its_reliability(seed: int) -> None:
    evidence, features = things(seed), unit_rows(20, 6, seed)
    before = lift(evidence, features, beta=2.0).scalars
    after = lift(evidence, consensus(evidence, features, least=0.0).features, beta=2.0).scalars
    kept = with_original_reliability(after, before)
    norm = norm_of_reliability(kept.reliability, kept.n_eff, beta=2.0)
    assert torch.allclose(norm, torch.where(after.norm > 0, before.norm, 0.0), atol=1e-12)
    assert not torch.allclose(norm, after.norm, atol=1e-3)
