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
from tests.scripts.conftest import SMALL, run_entry


@pytest.fixture
def ply(trained: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    return write_ply(tmp_path / "scene.ply", ply_columns(Splat(**open_scene(trained).parameters)))


def cameras(trained: Path) -> tuple[object, ...]:
    folder = trained.parents[4] / "room"
    return (
        "--transforms",
        folder / "transforms.json",
        "--world-transform",
        trained.parent / "dataparser_transforms.json",
    )


def test_lift_query_export_and_evaluate(ply: Path, trained: Path, tmp_path: Path, monkeypatch, capsys) -> None:
    flags = ("--load-ply", ply, *cameras(trained), *SMALL, "--timestamp", "a", "--queries", "red", "yellow")
    assert run_entry(monkeypatch, lift.entrypoint, *flags) == 0
    printed = capsys.readouterr().out
    assert "2 of 14 photographs were held out of the training; they are not lifted." in printed
    assert "Weights are those of gsplat, by the rules of --gsplat-rules" in printed.replace("\n", " ")
    config = tmp_path / "outputs" / "room" / "normlift" / "a" / "config.yml"
    assert str(config.parent) in printed
    found = open_run(config).ask_stored()
    assert found is not None
    assert found["red"].peak > 0.8
    assert run_entry(monkeypatch, query.entrypoint, "--load-config", config, "--text", "red") == 0
    assert run_entry(monkeypatch, export.entrypoint, "--load-config", config, "--output-dir", tmp_path / "e") == 0
    labels = trained.parents[4] / "room" / "instance"
    flags = ("--protocol", "masks", "--labels", labels, "--output-path", tmp_path / "scores.json")
    assert run_entry(monkeypatch, evaluate.entrypoint, "--load-config", config, *flags) == 0
    assert json.loads((tmp_path / "scores.json").read_text())


def test_the_config_names_cameras_that_nerfstudio_leaves_as_they_are(ply: Path, trained: Path, monkeypatch) -> None:
    flags = ("--load-ply", ply, *cameras(trained), *SMALL, "--timestamp", "a", "--max-views", 2)
    assert run_entry(monkeypatch, lift.entrypoint, *flags) == 0
    run_dir = ply.parent / "outputs" / "room" / "normlift" / "a"
    text = (run_dir / "config.yml").read_text()
    config = yaml.unsafe_load(text)
    parser = config.pipeline.datamanager.dataparser
    assert (parser.orientation_method, parser.center_method, parser.eval_mode) == ("none", "none", "all")
    assert (parser.auto_scale_poses, parser.load_3D_points, parser.downscale_factor) == (False, False, 1)
    assert parser.data == config.data == run_dir / "transforms.json"
    frame = json.loads((run_dir / "transforms.json").read_text())["frames"][0]
    assert Path(frame["file_path"]).is_absolute()
    assert {"fl_x", "fl_y", "cx", "cy", "w", "h", "k1", "k2", "p1", "p2"} < set(frame)


@pytest.mark.parametrize(
    ("flags", "message"),
    [
        ((), "Give one trained splat, got 0"),
        (("--load-ply", "scene.ply", "--load-config", "config.yml"), "Give one trained splat, got 2"),
        (("--load-ply", "scene.ply"), "needs one file of cameras, got none"),
        (("--load-ply", "scene.ply", "--images", "."), "needs one file of cameras, got none"),
        (("--load-ply", "scene.ply", "--colmap", "nowhere"), "nowhere, given with --colmap, does not exist"),
        (("--load-ply", "gone.ply", "--transforms", "ROOM"), "gone.ply, given with --load-ply, does not exist"),
        (("--load-ply", "scene.ply", "--transforms", "ROOM", "--data", "x"), "--data is for --load-config"),
        (("--load-ply", "scene.ply", "--transforms", "ROOM", "--views", "some"), "cannot be 'some'"),
        (("--load-config", "config.yml", "--colmap", "x"), "--colmap is for --load-ply and --load-gsplat"),
        (("--load-config", "config.yml", "--background", "white"), "--background is for --load-ply"),
        (("--load-ply", "points.ply", "--transforms", "ROOM"), "is no splat: its 5 vertices have no f_dc_0"),
        (("--load-gsplat", "other.pt", "--transforms", "ROOM"), "normalized the world of the splat by the points"),
        (("--load-ply", "scene.ply", "--transforms", "ROOM"), "does not show what its photographs show"),
        (("--load-ply", "far.ply", "--transforms", "ROOM"), "do not look at this splat"),
    ],
)
def test_what_does_not_fit_is_one_message(ply, trained, monkeypatch, capsys, flags, message) -> None:
    columns = ply_columns(random_splat(5))
    write_ply(ply.parent / "points.ply", {name: columns[name] for name in "xyz"})
    write_gsplat(ply.parent / "other.pt", random_splat(50))
    far = ply_columns(Splat(**open_scene(trained).parameters))
    write_ply(ply.parent / "far.ply", {**far, "z": far["z"] + 1000})
    room = trained.parents[4] / "room"
    words = [room if flag == "ROOM" else flag for flag in flags]
    assert run_entry(monkeypatch, lift.entrypoint, *words, *SMALL) == 1
    printed = capsys.readouterr()
    text = " ".join((printed.out + printed.err).replace("│", " ").split())
    assert message in text
    assert "Traceback" not in text
    assert not (ply.parent / "outputs").exists()


def test_a_lift_that_was_refused_can_be_asked_for(ply: Path, trained: Path, monkeypatch) -> None:
    flags = ("--load-ply", ply, "--transforms", trained.parents[4] / "room", *SMALL, "--timestamp", "a")
    assert run_entry(monkeypatch, lift.entrypoint, *flags, "--check", "False") == 0
    assert (ply.parent / "outputs" / "room" / "normlift" / "a" / "config.yml").is_file()
