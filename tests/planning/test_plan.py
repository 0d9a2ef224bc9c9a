"""The arithmetic of a plan: against sums by hand."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from normlift_ns.evidence_collection import ViewBatch
from normlift_ns.io.run_dir import SCHEMA_VERSION, write_manifest
from normlift_ns.planning import (
    Measurements,
    Rate,
    _observe_loaded,
    _Observed,
    _per_view,
    diagnose_recognition,
    make_plan,
)

FACTS = Measurements(
    device="cpu, 2 threads", views=40, gaussians=1000, dimension=8, regions=10, entries=500, entry_bytes=8,
    preparation_s={"start": 1.0, "open": 2.0}, load_s=5.0, features_s=0.5, cached_features_s=0.1,
    cached_features_share=0.25, evidence_s=0.2, cached_evidence_s=0.01, cached_evidence_share=0.5,
    core_s={"lift": Rate(1.0, 0.001, 2000), "vote": Rate(0.5, 0.002, 1000)},
    field_bytes=Rate(100, 10, 1000), run_bytes=900, write_bytes_s=1000, view_bytes=50,
    host_bytes=10_000, device_bytes=None, measured_views=4,
)  # fmt: skip


def test_seconds_are_those_of_the_views_and_gaussians_which_devices_share() -> None:
    plan = make_plan(FACTS)
    seconds = {stage.name: stage.seconds for stage in plan.stages}
    assert seconds == pytest.approx({
        "start": 1, "open": 2, "features": 5 + 30 * 0.5 + 10 * 0.1, "evidence": 20 * 0.2 + 20 * 0.01,
        "lift": 3, "vote": 2.5, "write": 11,
    })  # fmt: skip
    assert plan.seconds == pytest.approx(sum(seconds.values()))
    assert plan.to_json()["total_s"] == plan.seconds and plan.to_json()["seconds"] == seconds
    remarks = {stage.name: stage.remark for stage in plan.stages}
    assert remarks["features"] == "about 10 of 40 views cached" and remarks["start"] == ""
    shared = {stage.name: stage.seconds for stage in make_plan(FACTS, num_devices=2).stages}
    assert shared == pytest.approx({
        "start": 1, "open": 2, "features": 5 + (30 * 0.5 + 10 * 0.1) / 2, "evidence": (20 * 0.2 + 20 * 0.01) / 2,
        "lift": 2, "vote": 1.5, "write": 11,
    })  # fmt: skip
    with pytest.raises(ValueError, match="at least 1, got 0"):
        make_plan(FACTS, num_devices=0)


def test_memory_holds_evidence_and_directions() -> None:
    held = 3 * 500 * 40 * 8 + 2 * 1000 * 8 * 4
    table = 10 * 40 * 8 * 4
    assert make_plan(FACTS).host_bytes == 10_000 + held + 2 * table
    assert make_plan(FACTS).device_bytes is None
    on_gpu = make_plan(replace(FACTS, device_bytes=7000), num_devices=2)
    assert on_gpu.device_bytes == 7000 + held / 2 + 2 * table
    assert on_gpu.host_bytes == 10_000 + table


def test_what_is_cached_costs_no_disk_and_no_network() -> None:
    new = make_plan(replace(FACTS, cached_features_share=0.0, cached_evidence_share=0.0))
    kept = make_plan(replace(FACTS, cached_features_share=1.0, cached_evidence_share=1.0, features_s=None))
    run = 100 + 10 * 1000 + 900
    assert kept.disk_bytes == run
    assert new.disk_bytes == run + 40 * 50 + 500 * 40 * 8 + 1000 * 16 * 40 // 16
    seconds = {stage.name: stage for stage in kept.stages}
    assert seconds["features"].seconds == pytest.approx(4.0) and seconds["features"].remark == "cached"
    assert (kept.features_kept, kept.evidence_kept, new.features_kept) == (40, 40, 0)


@pytest.mark.parametrize(("first_s", "at_once", "looked_at"), [(5.0, 1, 4), (60.0, 1, 2), (60.0, 2, 3)])
def test_the_time_until_networks_are_loaded_is_no_view_s(first_s: float, at_once: int, looked_at: int) -> None:
    seen: list[int] = []

    def observe(indices: Sequence[int]) -> _Observed:
        seconds = sum(0.5 if seen or i > 0 else first_s for i in range(len(indices)))
        seen.extend(indices)
        return _Observed(ViewBatch([], [], [], []), seconds)

    found, load_s = _observe_loaded([3, 5, 7, 9], observe, at_once)
    assert seen == [3, 5, 7, 9][:looked_at]
    assert found.seconds == pytest.approx(0.5 * looked_at)
    assert load_s == pytest.approx(first_s - 0.5)


def test_recognition_of_a_lifted_run_is_shown(tmp_path: Path) -> None:
    facts = {"num_gaussians": 3, "dimension": 2, "means_fingerprint": "", "form": "float16"}
    recognition = {"recognized": 12, "confirmed": 15, "agreement": 0.5}
    assert diagnose_recognition([tmp_path / "absent", tmp_path]) == []
    for name, statistics, told in (("new", {"recognition": recognition}, "12 of 15"), ("old", {}, "old")):
        folder = tmp_path / name / "normlift"
        folder.mkdir(parents=True)
        write_manifest(folder, {**facts, "schema_version": SCHEMA_VERSION, "statistics": statistics}, {})
        (found,) = diagnose_recognition([tmp_path / "absent", tmp_path / name])
        assert found.state == "ok" and told in found.found


def test_no_views_have_no_seconds() -> None:
    for cameras, seconds in (([], None), ([1, 2], 1.5)):
        observed: Any = SimpleNamespace(block=SimpleNamespace(cameras=cameras), seconds=3.0)
        assert _per_view(observed) == seconds
