"""ns-normlift-query --why, honest answers in its table, and ns-normlift-export --part clean."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from normlift_ns import open_run
from normlift_ns.scripts import export, query
from tests.scripts.conftest import run_entry, said


def test_why_is_a_table_json_and_pictures(lifted: Path, tmp_path: Path, monkeypatch, capsys) -> None:
    pictures, table = tmp_path / "why", tmp_path / "table.json"
    flags = ("--load-config", lifted, "--text", "red", "--why", "--why-dir", pictures, "--json", table)
    assert run_entry(monkeypatch, query.entrypoint, *flags) == 0
    shown = said(capsys)
    assert "C_inter 0.9" in shown
    (row,) = json.loads(table.read_text())["queries"]
    why = row["why"]
    assert why["gaussians"] == round(row["fraction"] * len(open_run(lifted).field))
    assert sum(view["share"] for view in why["views"]) == pytest.approx(1)
    names = sorted(path.name for path in pictures.iterdir())
    heaviest = [Path(view["photograph"]).stem for view in why["views"][:3]]
    assert names[:3] == [f"0_red_{i}_{stem}.png" for i, stem in enumerate(heaviest, 1)]
    assert len(names) == 6
    assert Image.open(pictures / names[0]).size == (160, 120)
    assert run_entry(monkeypatch, query.entrypoint, *flags[:-2]) == 1
    assert "exists" in said(capsys)


def test_what_is_not_in_the_scene_is_said(lifted: Path, tmp_path: Path, monkeypatch, capsys) -> None:
    flags = ("--load-config", lifted, "--text", "red", "bright magenta", "--json", tmp_path / "x.json")
    assert run_entry(monkeypatch, query.entrypoint, *flags) == 0
    shown = said(capsys)
    assert "bright magenta: probably not in this scene" in shown
    assert "red: probably not" not in shown
    there, absent = json.loads((tmp_path / "x.json").read_text())["queries"]
    assert (there["stands_out"], absent["stands_out"]) == (True, False)
    assert absent["histogram"]["top"] < 0.9 < there["histogram"]["top"]
    assert sum(there["histogram"]["counts"]) == sum(absent["histogram"]["counts"]) > 1000
    nothing = ("--load-config", lifted, "--text", "bright magenta", "--why")
    assert run_entry(monkeypatch, query.entrypoint, *nothing, "--threshold", "0.999") == 0
    assert "bright magenta: nothing is selected" in said(capsys)


def test_a_threshold_can_be_suggested(lifted: Path, tmp_path: Path, monkeypatch) -> None:
    flags = ("--load-config", lifted, "--text", "red", "--threshold", "auto", "--json", tmp_path / "x.json")
    assert run_entry(monkeypatch, query.entrypoint, *flags) == 0
    document = json.loads((tmp_path / "x.json").read_text())
    (row,) = document["queries"]
    assert document["threshold"] == pytest.approx(row["suggested_threshold"])
    found = open_run(lifted).ask("red", threshold="auto")
    assert found.question.threshold == pytest.approx(document["threshold"], abs=1e-5)
    assert found["red"].suggested_threshold == pytest.approx(found.question.threshold)
    assert row["fraction"] == pytest.approx(found["red"].fraction, abs=1e-3)


def test_clean_is_the_scene_without_likely_floaters(lifted: Path, tmp_path: Path, monkeypatch, capsys) -> None:
    rows = {}
    for part in ("scene", "clean"):
        flags = ("--load-config", lifted, "--output-dir", tmp_path, "--output-filename", f"{part}.ply", "--part", part)
        assert run_entry(monkeypatch, export.entrypoint, *flags) == 0
        rows[part] = np.load(tmp_path / f"{part}_rows.npy")
    mask = open_run(lifted).floaters().mask
    assert np.array_equal(np.setdiff1d(rows["scene"], rows["clean"]), np.flatnonzero(mask.numpy()))
    assert 0 < int(mask.sum()) < 0.05 * len(mask)
    assert f"{int(mask.sum()):,} likely floaters are left out" in said(capsys)
    limit = ("--floater-limit", "100", "--overwrite")
    assert run_entry(monkeypatch, export.entrypoint, *flags, *limit) == 0
    assert np.array_equal(np.load(tmp_path / "clean_rows.npy"), rows["scene"])
