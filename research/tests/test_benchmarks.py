"""The benchmarks run and report what they promise, and the errors beside the times are small."""

from types import SimpleNamespace

import pytest
import torch

from normlift_ns import lift
from normlift_ns.core.metrics import class_scores, classify, confusion
from research.coverage import Outcome, Sums
from research.damage import Observed
from research.documents import documents
from research.hard_case import QUANTITIES, Case, Setting
from research.numerics import CASES, main
from research.tests import quick
from research.variants import lifted_scores
from tests.captures import needs_shared
from tests.random_scenes import generator, random_evidence, unit_rows


@needs_shared
def test_quick_cpu_and_latency_benchmarks(tmp_path):
    metrics = quick("cpu", tmp_path)
    assert {"fox_evidence_s", "fox_evidence_peak_gib", "fox_lift_s", "fox_refine_s"} <= set(metrics)
    assert metrics["fox_evidence_rel_error"]["value"] < 1e-4
    for key, most in (("lift", 1e-5), ("directions", 1e-4), ("refine", 5e-3)):
        assert metrics[f"fox_{key}_s"]["error"] < most, key
    assert metrics["fox_evidence_peak_gib"]["value"] < 3
    metrics = quick("latency", tmp_path, "--device", "cpu")
    for form, most in (("evidence", 1e-6), ("float16", 2e-3), ("low_rank", 4e-3)):
        assert metrics[f"fox_{form}_answer_ms"]["value"] > 0  # other work may take all cores: no more is asked
        assert metrics[f"fox_{form}_answer_ms"]["error"] < most
    assert metrics["fox_stock_ms"]["value"] > 0 < metrics["fox_overlay_ms"]["value"]


def test_quick_front_ends_benchmark(tmp_path):
    metrics = quick("front_ends", tmp_path, "--device", "cpu")
    assert {"clean_10_s", "share_10", "share_clean_10", "sam_network_rate", "sam_labels_clean_s"} <= set(metrics)
    assert all(metrics[f"sam_masks_{level}"]["value"] > 0 for level in ("default", "s", "m", "l"))
    assert metrics["sam_labels_s"]["value"] > 0 < metrics["sam2_labels_s"]["value"]
    bounds = dict.fromkeys(("nms_10_s", "view_s", "cold_2_s"), 0)
    bounds |= dict.fromkeys(("encode_10_s", "patches_s", "sam_encoder_s", "sam2_encoder_s"), 1e-5)
    for key, most in (bounds | dict.fromkeys(("sam_decoder_s", "sam2_decoder_s"), 1e-4)).items():
        assert metrics[key]["error"] <= most, key


@pytest.mark.parametrize("views", [[0], [1, 2, 7], list(range(14))])
def test_sums_answer_as_the_lift_does(views):
    """In a world without geometry: random evidence of features that are nearly those of three classes."""
    evidence, truth = random_evidence(40, [5] * 14, 0), torch.randint(0, 3, (40,), generator=generator(1))
    words = SimpleNamespace(classes=unit_rows(3, 8, 2))
    features = torch.nn.functional.normalize(words.classes.repeat(24, 1)[:70] + 0.3 * unit_rows(70, 8, 3), dim=1)
    world, found = SimpleNamespace(truth=truth, classes=3, cameras=[None] * 14), Observed(evidence, features, None, [])
    some = evidence.select_views(views)
    scores = lifted_scores(lift(some, features[evidence.columns_of(views)]), words.classes)
    expected = 100 * class_scores(confusion(truth, classify(scores.cosine, scores.valid), 3)).miou
    assert Sums(world, words, found, torch.arange(40)).miou(views) == pytest.approx(expected)
    assert 0 < expected < 100


def test_percentile_counts_ties_half():
    assert Outcome(0.0, 3.0, [1.0, 2.0, 3.0, 4.0], 5.0).percentile == 62.5


def test_recorded_errors_are_those_of_the_cases_and_within_their_bounds():
    assert len({case.key for case in CASES}) == len(CASES)
    for case in CASES:
        errors = case.measure(Setting(small=True))
        for name in ("numerics", "numerics_gpu"):
            values = documents()[name].values
            recorded = {key.split(".")[1]: x for key, x in values.items() if key.split(".")[0] == case.key}
            assert set(recorded) == (set(errors) if len(values) > 0 else set()), case.key  # else measure again
            assert case.failures(recorded) == []


def test_what_is_not_a_number_fails_and_a_run_that_fails_says_where(monkeypatch, tmp_path):
    case = Case("some", "", "", "", lambda setting: {}, {"direction": 1.0})
    assert case.failures({"direction": 0.5, "scalars": 1e-6, "wrong": 0}) == []
    errors = {"direction": float("nan"), "scalars": 1e-4, "wrong": 1}
    assert [line.split(" ")[1] for line in case.failures(errors)] == list(errors)
    assert all(quantity.bound <= 1e-4 for quantity in QUANTITIES.values())
    monkeypatch.setattr("research.numerics.CASES", (Case("some", "", "", "", lambda setting: {"wrong": 2}),))
    with pytest.raises(SystemExit, match=r"some: wrong 2\.0e\+00, at most 0"):
        main("cpu", tmp_path)
    assert (tmp_path / "numerics.json").exists()
