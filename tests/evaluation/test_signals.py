"""What R knows, on Gaussians made by hand, against SciPy and plain loops."""

from __future__ import annotations

import math

import pytest
import torch
from scipy import stats

from normlift_ns.core.lift import Scalars
from normlift_ns.core.metrics import NO_CLASS
from normlift_ns.evaluation.signals import SceneSignals, signals
from normlift_ns.evaluation.studies import POOLED, signal_rows


def scene(seed: int, n: int = 400) -> SceneSignals:
    """A third has no evidence, a fifth no truth; the vote mends some."""
    g = torch.Generator().manual_seed(seed)
    r = torch.rand(n, generator=g) * (torch.arange(n) % 3 > 0)
    zeros = torch.zeros(n)
    scalars = Scalars(r.sqrt(), zeros, zeros, zeros, r, zeros, torch.randint(1, 9, (n,), generator=g).int())
    truth = torch.randint(0, 4, (n,), generator=g)
    unrefined = torch.where(torch.rand(n, generator=g) < r, truth, NO_CLASS)
    refined = torch.where(torch.rand(n, generator=g) < 0.8, truth, unrefined)
    counted = torch.where(torch.rand(n, generator=g) < 0.2, NO_CLASS, truth)
    opacity = (r + 0.3 * torch.rand(n, generator=g)).clamp(0, 1)
    return SceneSignals(scalars, opacity, counted, {"unrefined": unrefined, "refined": refined})


def test_groups_name_refined_and_unrefined_answers():
    one = scene(0)
    found, zero = signals(one), one.scalars.reliability == 0
    counted = one.truth != NO_CLASS
    for name, group in (("zero", zero), ("seen", ~zero), ("all", zero | ~zero)):
        chosen = (group & counted).nonzero().squeeze(1).tolist()
        for kind, answer in one.answers.items():
            right = sum(int(answer[i]) == int(one.truth[i]) for i in chosen)
            assert found[f"{name}.accuracy_{kind}"] == pytest.approx(right / len(chosen))
        assert found[f"{name}.share"] == pytest.approx(float(group.double().mean()))
    assert found["zero.accuracy_refined"] > 0.5 > found["zero.accuracy_unrefined"] == 0
    assert "zero.accuracy" not in found


def test_correlations_are_of_all_gaussians_with_their_p_values():
    one = scene(1, n=30_000)  # of which 20,000 have R > 0
    found, seen = signals(one), one.scalars.reliability > 0
    r, o = (x[seen].double().numpy() for x in (one.scalars.reliability, one.opacity))
    for name, expected in (("spearman", stats.spearmanr(r, o)), ("kendall", stats.kendalltau(r, o))):
        assert found[f"opacity.{name}"] == pytest.approx(expected.statistic, abs=1e-12)
        assert found[f"opacity.{name}_p"] == pytest.approx(expected.pvalue, abs=1e-12)
    assert found["reliability.spearman_bins_p"] < 0.05


def test_scenes_are_pooled_gaussian_by_gaussian():
    scenes = [scene(2, n=300), scene(3, n=900)]
    rows = signal_rows(["a", "b"], scenes)
    assert [row["scene"] for row in rows] == ["a", "b", POOLED]
    of_a, of_b, pooled = rows
    assert pooled["zero.share"] == pytest.approx((300 * of_a["zero.share"] + 900 * of_b["zero.share"]) / 1200)
    r = torch.cat([s.scalars.reliability for s in scenes])
    o = torch.cat([s.opacity for s in scenes])
    assert pooled["opacity.kendall"] == pytest.approx(stats.kendalltau(r[r > 0].double(), o[r > 0].double()).statistic)
    assert pooled["opacity.kendall"] not in (of_a["opacity.kendall"], of_b["opacity.kendall"])
    assert [row["scene"] for row in signal_rows(["a"], scenes[:1])] == ["a"]


def test_without_a_truth_there_are_no_accuracies():
    one = scene(4)
    found = signals(SceneSignals(one.scalars, one.opacity))
    assert not any("accuracy" in key or "bin" in key for key in found)
    assert math.isfinite(found["opacity.kendall_p"])
    assert not any("accuracy" in key for key in signals(one, SceneSignals(one.scalars, one.opacity)))
