"""ns-normlift on splats that no nerfstudio run holds, as a user types it."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
import yaml

from normlift_ns import open_run, open_scene
from normlift_ns.scenes.splat import Splat
from normlift_ns.scripts import evaluate, export, lift, query
from tests.scenes.made import ply_columns, random_splat, write_gsplat, write_ply
from tests.scripts.conftest import SMALL, run_entry, said


@pytest.fixture
def ply(little: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    return write_ply(tmp_path / "scene.ply", ply_columns(Splat(**open_scene(little).parameters)))


def test_lift_query_export_and_evaluate(ply: Path, little: Path, tmp_path: Path, monkeypatch, capsys) -> None:
    """The config names cameras that nerfstudio leaves as they are."""
    room, world = little.parents[4] / "room", little.parent / "dataparser_transforms.json"
    cameras = ("--transforms", room / "transforms.json", "--world-transform", world)
    flags = ("--load-ply", ply, *cameras, *SMALL, "--timestamp", "a", "--queries", "red", "yellow")
    assert run_entry(monkeypatch, lift.entrypoint, *flags) == 0
    printed = said(capsys)
    run_dir = tmp_path / "outputs" / "room" / "normlift" / "a"
    assert "2 of 8 photographs" in printed and "--gsplat-rules" in printed and str(run_dir) in printed
    found = open_run(run_dir / "config.yml").ask_stored()
    assert found is not None and found["red"].peak > 0.8
    asked = ("--load-config", run_dir / "config.yml")
    assert run_entry(monkeypatch, query.entrypoint, *asked, "--text", "red") == 0
    assert run_entry(monkeypatch, export.entrypoint, *asked, "--output-dir", tmp_path / "e") == 0
    flags = ("--protocol", "masks", "--labels", room / "instance", "--output-path", tmp_path / "scores.json")
    assert run_entry(monkeypatch, evaluate.entrypoint, *asked, *flags) == 0
    assert json.loads((tmp_path / "scores.json").read_text())
    config = yaml.unsafe_load((run_dir / "config.yml").read_text())
    parser = config.pipeline.datamanager.dataparser
    assert (parser.orientation_method, parser.center_method, parser.eval_mode) == ("none", "none", "all")
    assert (parser.auto_scale_poses, parser.load_3D_points, parser.downscale_factor) == (False, False, 1)
    assert parser.data == config.data == run_dir / "transforms.json"
    frame = json.loads((run_dir / "transforms.json").read_text())["frames"][0]
    assert Path(frame["file_path"]).is_absolute()
    assert {"fl_x", "fl_y", "cx", "cy", "w", "h", "k1", "k2", "p1", "p2"} < set(frame)


def test_what_does_not_fit_is_one_message_unless_it_is_asked_for(ply: Path, little: Path, monkeypatch, capsys) -> None:
    """What shows before the splat is read is in test_early.py."""
    columns, splat = ply_columns(random_splat(5)), ply_columns(Splat(**open_scene(little).parameters))
    write_ply(ply.parent / "points.ply", {name: columns[name] for name in "xyz"})
    write_gsplat(ply.parent / "other.pt", random_splat(50))
    write_ply(ply.parent / "far.ply", {**splat, "z": splat["z"] + 1000})
    given = ("--transforms", little.parents[4] / "room", *SMALL, "--timestamp", "a", "--max-views", "2")
    for kind, name, *facts in (
        ("ply", "points.ply", "no splat", "5", "f_dc_0"),
        ("gsplat", "other.pt", "normalized"),
        ("ply", "scene.ply", "does not show"),
        ("ply", "far.ply", "do not look at this splat"),
    ):
        assert run_entry(monkeypatch, lift.entrypoint, f"--load-{kind}", name, *given) == 1, name
        text = said(capsys).replace("│", " ")
        assert [fact for fact in facts if fact not in text] == [] and "Traceback" not in text, text
        assert not (ply.parent / "outputs").exists()
    assert run_entry(monkeypatch, lift.entrypoint, "--load-ply", ply, *given, "--check", "False") == 0
    assert (ply.parent / "outputs" / "room" / "normlift" / "a" / "config.yml").is_file()
