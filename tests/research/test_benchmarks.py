"""The benchmarks run and report what they promise; the errors beside the times are small; results are easy to read."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

from benchmarks.minutes import minutes
from benchmarks.report import RESULTS, Report, as_text
from tests.captures import needs_shared

ROOT = Path(__file__).resolve().parents[1]


@pytest.mark.slow
@needs_shared
def test_quick_cpu_benchmark(tmp_path):
    command = [sys.executable, "-m", "benchmarks.cpu", "--quick", "--output", str(tmp_path)]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    print(done.stdout)
    document = json.loads((tmp_path / "cpu.json").read_text())
    assert set(document) == {"hardware", "versions", "command", "metrics"}
    metrics = {metric["key"]: metric for metric in document["metrics"]}
    assert all(set(metric) == {"key", "value", "unit", "error"} for metric in metrics.values())
    assert {"fox_evidence_s", "fox_evidence_peak_gib", "fox_lift_s", "fox_refine_s"} <= set(metrics)
    assert metrics["fox_evidence_rel_error"]["value"] < 1e-4
    assert metrics["fox_lift_s"]["error"] < 1e-5
    assert metrics["fox_directions_s"]["error"] < 1e-4
    assert metrics["fox_refine_s"]["error"] < 5e-3
    assert metrics["fox_evidence_peak_gib"]["value"] < 3


@pytest.mark.slow
@needs_shared
def test_quick_latency_benchmark(tmp_path):
    command = [sys.executable, "-m", "benchmarks.latency", "--quick", "--device", "cpu", "--output", str(tmp_path)]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    print(done.stdout)
    metrics = {metric["key"]: metric for metric in json.loads((tmp_path / "latency.json").read_text())["metrics"]}
    for form, most in (("evidence", 1e-6), ("float16", 2e-3), ("low_rank", 4e-3)):
        assert metrics[f"fox_{form}_answer_ms"]["value"] > 0  # other work may take all cores: no more is asked
        assert metrics[f"fox_{form}_answer_ms"]["error"] < most
    assert metrics["fox_stock_ms"]["value"] > 0
    assert metrics["fox_overlay_ms"]["value"] > 0


@pytest.mark.slow
def test_quick_front_ends_benchmark(tmp_path):
    command = [sys.executable, "-m", "benchmarks.front_ends", "--quick", "--device", "cpu", "--output", str(tmp_path)]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    print(done.stdout)
    metrics = {metric["key"]: metric for metric in json.loads((tmp_path / "front_ends.json").read_text())["metrics"]}
    keys = {"nms_10_s", "clean_10_s", "encode_10_s", "share_10", "share_clean_10", "patches_s", "view_s"}
    assert keys | {"sam_network_rate", "sam_labels_s", "sam_labels_clean_s", "cold_2_s"} <= set(metrics)
    assert all(metrics[f"sam_masks_{level}"]["value"] > 0 for level in ("default", "s", "m", "l"))
    assert metrics["nms_10_s"]["error"] == 0
    assert metrics["encode_10_s"]["error"] < 1e-5 and metrics["patches_s"]["error"] < 1e-5
    assert metrics["sam_encoder_s"]["error"] < 1e-5 and metrics["sam_decoder_s"]["error"] < 1e-4
    assert metrics["sam2_encoder_s"]["error"] < 1e-5 and metrics["sam2_decoder_s"]["error"] < 1e-4
    assert metrics["sam2_labels_s"]["value"] > 0
    assert metrics["view_s"]["error"] == 0 == metrics["cold_2_s"]["error"]


@pytest.mark.slow
def test_quick_precision_benchmark(tmp_path):
    """Masks of a network that learned nothing, the same way through."""
    command = [
        sys.executable,
        "-m",
        "benchmarks.sam_precision",
        "--quick",
        "--device",
        "cpu",
        "--output",
        str(tmp_path),
    ]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    metrics = {metric["key"]: metric for metric in json.loads((tmp_path / "sam_precision.json").read_text())["metrics"]}
    for kind in ("float16", "bfloat16", "noise"):
        assert {f"{kind}_truth_iou", f"{kind}_miou", f"{kind}_changed_survivors"} <= set(metrics)
        assert 0.8 < metrics[f"{kind}_mask_iou"]["value"] < 1


@pytest.mark.parametrize("path", sorted(RESULTS.glob("*.json")), ids=lambda path: path.name)
def test_results_have_one_metric_per_line(path):
    document = json.loads(path.read_text())
    assert set(document) == {"hardware", "versions", "command", "metrics"}
    assert all(set(metric) == {"key", "value", "unit", "error"} for metric in document["metrics"])
    assert path.read_text() == as_text(document)
    assert sum(line.startswith('  {"key": ') for line in path.read_text().splitlines()) == len(document["metrics"])


def test_a_report_is_valid_json(tmp_path):
    report = Report("some")
    report.add("time_s", 0.25, "s", 1e-7)
    report.add("of one seed_ci95", float("nan"), "points")
    document = json.loads(report.write(tmp_path).read_text(), parse_constant=pytest.fail)
    assert document["metrics"] == [
        {"key": "time_s", "value": 0.25, "unit": "s", "error": 1e-7},
        {"key": "of one seed_ci95", "value": None, "unit": "points", "error": None},
    ]


def test_minutes_are_summed_by_part(tmp_path):
    cases = (("tests.core.test_lift", 30), ("tests.core.test_query", 90), ("tests.test_grid", 6))
    rows = "".join(f'<testcase classname="{name}" time="{time}"/>' for name, time in cases)
    (tmp_path / "tests.xml").write_text(f"<testsuites><testsuite>{rows}</testsuite></testsuites>")
    assert list(minutes(tmp_path / "tests.xml").items()) == [("tests/core", 2.0), ("tests/test_grid", 0.1)]
