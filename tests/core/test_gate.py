"""The measured gate against loops straight from its definition."""

import pytest
import torch

from normlift_ns import lift, nearest_neighbors
from normlift_ns.core.refine import relative_gate, sample_pairs, shared_region_cosines, shared_views
from tests.random_scenes import dense, generator, random_evidence, unit_rows

COUNTS = [3, 2, 4, 1, 3, 2]


def expected(lifted, pairs, level) -> list[float]:
    evidence = lifted.evidence
    weight, view = dense(evidence.rows, evidence.num_regions), evidence.region_view.tolist()
    u, found = lifted.directions().double(), []
    groups = [
        [s for s in range(len(view)) if (view[s], level[s]) == group]
        for group in dict.fromkeys(zip(view, level.tolist()))
    ]
    for i, k in pairs:
        both = together = 0.0
        for group in groups:
            a, b = weight[i, group], weight[k, group]
            if a.sum() > 0 and b.sum() > 0:
                both += 1
                together += float((a / a.sum() * b / b.sum()).sum())
        if both > 0 and together >= 0.5 * both and lifted.scalars.norm[i] > 0 and lifted.scalars.norm[k] > 0:
            found.append(float(u[i] @ u[k]))
    return found


@pytest.mark.parametrize("levels", [1, 2])
def test_cosines_are_those_of_neighbors_that_share_regions(levels):
    evidence = random_evidence(40, COUNTS, seed=3, fill=0.25)
    lifted = lift(evidence, unit_rows(sum(COUNTS), 5, 0))
    level = torch.arange(sum(COUNTS)) % levels
    pairs = [(i, k) for i in range(40) for k in range(40) if i != k]
    first, second = torch.tensor(pairs).T
    found = shared_region_cosines(lifted, first, second, level)
    wanted = expected(lifted, pairs, level)
    assert 100 < len(wanted) < 1500
    torch.testing.assert_close(found.sort().values, torch.tensor(wanted, dtype=torch.float64).sort().values)
    # Gaussians without evidence share no region
    together, both = shared_views(
        evidence.select_gaussians(torch.tensor([], dtype=torch.int64)), *torch.empty(2, 0).long()
    )
    assert len(together) == len(both) == 0
    empty = random_evidence(6, COUNTS, seed=3, fill=0.0)
    assert [x.tolist() for x in shared_views(empty, torch.tensor([0, 1]), torch.tensor([2, 3]))] == [[0, 0], [0, 0]]


def test_pairs_depend_on_the_index_alone_however_gaussians_are_divided():
    means = torch.rand(500, 3, generator=generator(0))
    neighbors = nearest_neighbors(means, 7).index
    whole = {tuple(x) for x in torch.stack(sample_pairs(torch.arange(500), neighbors, 50_000)).T.tolist()}
    assert 120 < len(whole) < 280  # 40 % of 500
    parts = set()
    for part in torch.randperm(500, generator=generator(1)).split(170):
        row, neighbor = sample_pairs(part, neighbors[part], 50_000)
        assert bool((neighbors[part[row]] == neighbor[:, None]).any(1).all())
        parts |= {tuple(x) for x in torch.stack([part[row], neighbor]).T.tolist()}
    assert parts == whole


def test_gate_is_a_quantile_and_needs_pairs():
    cosines = torch.rand(1000, generator=generator(2), dtype=torch.float64)
    tau, gamma = relative_gate(cosines) or (0.0, 0.0)
    assert abs(float((cosines < tau).double().mean()) - 0.05) < 0.002
    assert gamma == pytest.approx((1 - tau) / 2, abs=1e-4)
    assert (relative_gate(cosines, 0.5) or (0.0, 0.0))[0] == pytest.approx(float(cosines.median()), abs=1e-4)
    assert relative_gate(cosines[:49]) is None
    assert relative_gate(torch.ones(100, dtype=torch.float64)) == (0.9985, 0.0007)
