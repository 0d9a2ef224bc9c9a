"""Studies: what R knows, on Gaussians made by hand, against SciPy and plain loops; which votes are tried; figures."""

import math
from dataclasses import replace

import pytest
import torch

from normlift_ns.core.lift import Scalars
from normlift_ns.core.metrics import NO_CLASS
from normlift_ns.evaluation import studies
from normlift_ns.options import RefineConfig
from tests.random_scenes import generator


def scene(seed: int, n: int = 400) -> studies.SceneSignals:
    """A third has no evidence, a fifth no truth; the vote mends some."""
    g = generator(seed)
    r = torch.rand(n, generator=g) * (torch.arange(n) % 3 > 0)
    zeros = torch.zeros(n)
    scalars = Scalars(r.sqrt(), zeros, zeros, zeros, r, zeros, torch.randint(1, 9, (n,), generator=g).int())
    truth = torch.randint(0, 4, (n,), generator=g)
    unrefined = torch.where(torch.rand(n, generator=g) < r, truth, NO_CLASS)
    refined = torch.where(torch.rand(n, generator=g) < 0.8, truth, unrefined)
    counted = torch.where(torch.rand(n, generator=g) < 0.2, NO_CLASS, truth)
    opacity = (r + 0.3 * torch.rand(n, generator=g)).clamp(0, 1)
    return studies.SceneSignals(scalars, opacity, counted, {"unrefined": unrefined, "refined": refined})


def test_groups_name_refined_and_unrefined_answers():
    one = scene(0)
    found, zero = studies.signal_statistics(one), one.scalars.reliability == 0
    counted = one.truth != NO_CLASS
    for name, group in (("zero", zero), ("seen", ~zero), ("all", zero | ~zero)):
        chosen = (group & counted).nonzero().squeeze(1).tolist()
        for kind, answer in one.predictions.items():
            right = sum(int(answer[i]) == int(one.truth[i]) for i in chosen)
            assert found[f"{name}.accuracy_{kind}"] == pytest.approx(right / len(chosen))
        assert found[f"{name}.share"] == pytest.approx(float(group.double().mean()))
    assert found["zero.accuracy_refined"] > 0.5 > found["zero.accuracy_unrefined"] == 0
    assert "zero.accuracy" not in found


def test_correlations_are_of_all_gaussians_with_their_p_values():
    from scipy import stats  # noqa: PLC0415 (slow)

    one = scene(1, n=30_000)  # of which 20,000 have R > 0
    found, seen = studies.signal_statistics(one), one.scalars.reliability > 0
    r, o = (x[seen].double().numpy() for x in (one.scalars.reliability, one.opacity))
    for name, expected in (("spearman", stats.spearmanr(r, o)), ("kendall", stats.kendalltau(r, o))):
        assert found[f"opacity.{name}"] == pytest.approx(expected.statistic, abs=1e-12)
        assert found[f"opacity.{name}_p"] == pytest.approx(expected.pvalue, abs=1e-12)
    assert found["reliability.spearman_bins_p"] < 0.05


def test_scenes_are_pooled_gaussian_by_gaussian():
    from scipy.stats import kendalltau  # noqa: PLC0415 (slow)

    scenes = [scene(2, n=300), scene(3, n=900)]
    rows = studies.signal_rows(["a", "b"], scenes)
    assert [row["scene"] for row in rows] == ["a", "b", studies.POOLED_SCENE]
    of_a, of_b, pooled = rows
    assert pooled["zero.share"] == pytest.approx((300 * of_a["zero.share"] + 900 * of_b["zero.share"]) / 1200)
    r, o = torch.cat([s.scalars.reliability for s in scenes]), torch.cat([s.opacity for s in scenes])
    assert pooled["opacity.kendall"] == pytest.approx(kendalltau(r[r > 0].double(), o[r > 0].double()).statistic)
    assert pooled["opacity.kendall"] not in (of_a["opacity.kendall"], of_b["opacity.kendall"])
    assert [row["scene"] for row in studies.signal_rows(["a"], scenes[:1])] == ["a"]


def test_without_a_truth_there_are_no_accuracies():
    one = scene(4)
    found = studies.signal_statistics(studies.SceneSignals(one.scalars, one.opacity))
    assert not any("accuracy" in key or "bin" in key for key in found)
    assert math.isfinite(found["opacity.kendall_p"])
    both = studies.signal_statistics(one, studies.SceneSignals(one.scalars, one.opacity))
    assert not any("accuracy" in key for key in both)


def test_sweeps_contain_the_default_and_the_values_of_all_runs_and_mark_them():
    config = replace(RefineConfig(), k=17, tau=0.123, sigma_d=0.77)
    facts = ({"reliability_beta": 3.5, "vote": vars(config)}, {"vote": vars(replace(config, sigma_d=1.33))})
    every = list(studies.sweeps([studies.recorded_vote({"options": options}) for options in facts]))
    defaults = {"beta": studies.BETA, "k": RefineConfig().k, **RefineConfig().numbers._asdict()}
    used = {"beta": (3.5, studies.BETA), "k": (17,), "tau": (0.123,), "sigma_d": (0.77, 1.33)}
    for parameter, values in studies.SWEEPS.items():
        some = [each for each in every if each[0].label["parameter"] == parameter]
        default, own = defaults[parameter], used.get(parameter, (defaults[parameter],))
        assert [first.label["value"] for first, _ in some] == sorted({*values, default, *own})
        assert [first.label["value"] for first, _ in some if first.label["default"]] == [default]
        assert [first.label["value"] for first, _ in some if first.label["own"]] == sorted(own)
        for first, second in some:
            assert (first.config.k, second.config.k) == (first.label["value"] if parameter == "k" else 17,) * 2
            swept = (first.label["value"],) * 2 if parameter == "sigma_d" else (0.77, 1.33)
            assert (first.config.sigma_d, second.config.sigma_d) == swept


def test_sweeps_mark_the_default_and_the_run_and_draw_the_result(tmp_path):
    rows = [{"parameter": "$\\frac{$", "value": x, "$\\frac{$": x} for x in (1.0, 2.0)]  # not mathematics
    studies.save_figure(studies.sweeps_figure(rows, "$\\frac{$", "$\\frac{$"), tmp_path / "a.svg")
    assert (tmp_path / "a.svg").stat().st_size > 1000
    values = [("k", 12.0, False, True, 0.4), ("k", 36.0, True, False, 0.5), ("beta", 1.0, True, True, 0.4)]
    rows = [{"parameter": p, "value": v, "default": d, "own": o, "miou": y} for p, v, d, o, y in values]
    of_k, of_beta = studies.sweeps_figure(rows[::-1], "miou", "miou", 0.45).axes[::-1]
    assert [x.get_xlabel() for x in (of_k, of_beta)] == ["k", "beta"]
    curve, default, own, result = of_k.lines
    assert (list(curve.get_xdata()), list(curve.get_ydata())) == ([0, 1], [0.4, 0.5])
    assert [x.get_text() for x in of_k.get_xticklabels()] == ["12", "36"]
    assert (list(default.get_xdata()), list(default.get_ydata())) == ([1], [0.5])
    assert (list(own.get_xdata()), list(own.get_ydata())) == ([0], [0.4])
    assert list(result.get_ydata()) == [0.45, 0.45]
    assert {x.get_text() for x in of_beta.get_legend().get_texts()} == {"default", "this run", "result"}
