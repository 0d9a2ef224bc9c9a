"""ns-normlift-check and ns-normlift --dry-run: what they tell, what they refuse, and that they leave nothing behind."""

import io
import json
from collections.abc import Callable
from pathlib import Path

import pytest

from normlift_ns import planning
from normlift_ns.cli import check, lift
from normlift_ns.io.memory import free_memory
from normlift_ns.segmentation.regions import Superpixels
from tests.cli.conftest import SMALL, run_entry, said


@pytest.fixture
def checked(trained: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[..., tuple[int, dict]]:
    """Runs the check; its exit code and its JSON."""

    def run(*flags: object) -> tuple[int, dict]:
        file = tmp_path / "check.json"
        given = ("--load-config", trained, *SMALL, "--output-dir", tmp_path / "out", "--device", "cpu", *flags)
        code = run_entry(monkeypatch, check.entrypoint, *given, "--output-json", file, "--overwrite", "True")
        return code, json.loads(file.read_text())

    return run


def states(found: dict) -> dict[str, str]:
    return {row["what"]: row["state"] for row in found["findings"]}


@pytest.mark.slow
def test_a_capture_is_checked_and_lifted_as_planned(checked, trained, tmp_path, monkeypatch, capsys) -> None:
    code, found = checked("--max-views", 6)
    assert code == 0
    rows = states(found)
    assert rows["versions"] == rows["device"] == rows["weights"] == rows["capture"] == rows["disk"] == "ok"
    assert set(rows) >= {"in view", "cameras", "memory"} and "error" not in rows.values()
    plan = found["plan"]
    looked_at = min(6, max(4, 1 + 2 * Superpixels().at_once))
    assert (plan["views"], plan["looked_at"], plan["features_kept"], plan["evidence_kept"]) == (6, looked_at, 0, 0)
    assert {"start", "evidence", "vote", "write"} < set(plan["seconds"]) and plan["total_s"] > 0
    shown = said(capsys)
    assert f"estimated from {looked_at} views" in shown and "GiB of memory" in shown
    assert not (tmp_path / "out").exists()
    given = ("--load-config", trained, *SMALL, "--output-dir", tmp_path / "out", "--max-views", 6, "--device", "cpu")
    assert run_entry(monkeypatch, lift.entrypoint, *given, "--timestamp", "run") == 0
    before = sorted(path for path in (tmp_path / "out").rglob("*"))
    _, again = checked("--max-views", 6)
    assert (again["plan"]["features_kept"], again["plan"]["evidence_kept"]) == (6, 6)
    capsys.readouterr()
    assert run_entry(monkeypatch, lift.entrypoint, *given, "--max-views", 12, "--dry-run", "True") == 0
    assert "about 6 of 12 views cached" in said(capsys)  # 2 of the 6 are not among the others
    assert sorted(path for path in (tmp_path / "out").rglob("*")) == before


def test_what_is_wrong_is_told_in_a_row_with_exit_code_1(checked, tmp_path, monkeypatch, capsys) -> None:
    code, found = checked("--load-config", tmp_path / "config.yml")
    assert code == 1 and states(found) == {"options": "error"} and found["plan"] is None
    assert "config.yml does not exist" in found["findings"][0]["found"]
    code, found = checked("--device", "cuda:7")
    assert code == 1 and states(found)["device"] == "error"
    monkeypatch.setattr(planning, "in_frustum", lambda means, camera: means[:, 0] > 1e9)
    code, found = checked("--check-alignment", "False")
    assert code == 1 and states(found)["in view"] == "error" and found["plan"] is None
    assert "rerun the command" in said(capsys)


def test_weights_that_would_be_downloaded_are_a_warning(checked, monkeypatch, trained, tmp_path, capsys) -> None:
    monkeypatch.setattr("urllib.request.urlopen", lambda request, timeout: io.BytesIO())
    monkeypatch.delenv("HF_HUB_OFFLINE", raising=False)
    code, found = checked("--encoder", "open_clip", "--regions", "patches")
    assert code == 0 and states(found)["weights"] == states(found)["plan"] == "warning"
    assert found["plan"]["total_s"] > 0
    assert "ViT-B-16" in next(row for row in found["findings"] if row["what"] == "weights")["found"]
    given = ("--load-config", trained, "--encoder", "open_clip", "--regions", "patches")
    assert run_entry(monkeypatch, lift.entrypoint, *given, "--output-dir", tmp_path, "--dry-run", "True") == 1
    assert "weights of OpenCLIP, ViT-B-16" in said(capsys)


def test_texts_of_sam3_are_those_of_the_lift(checked, monkeypatch, trained, tmp_path, capsys) -> None:
    (tmp_path / "sam3").mkdir()
    for texts in (("--queries", "mug"), ("--sam3-prompts", "mug")):
        flags = ("--regions", "sam3", "--sam-model", tmp_path / "sam3", *texts)
        code, found = checked(*flags)
        assert code == 1 and states(found)["2D features"] == "error" and "weights" not in states(found)
        (told,) = (row["found"] for row in found["findings"] if row["what"] == "2D features")
        assert "config.json" in told and "--segment-model" in told and "sam-vit" not in told
    given = ("--load-config", trained, *SMALL, "--output-dir", tmp_path / "out", "--device", "cpu", *flags)
    assert run_entry(monkeypatch, lift.entrypoint, *given, "--dry-run", "True") == 1
    assert "SAM 3 checkpoint" in said(capsys)


def test_memory_and_disk_are_compared_with_what_is_free() -> None:
    for needed, state in ((70, "ok"), (90, "warning"), (101, "error")):
        row = planning._check_capacity("disk", needed, 100, "free some")
        assert row.state == state and (row.advice == "") == (state == "ok")
    assert all(free > 2**20 for free in free_memory().values())
