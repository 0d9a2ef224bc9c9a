from __future__ import annotations

import json
import sys
from collections.abc import Iterator
from pathlib import Path
from unittest.mock import MagicMock

import numpy as np
import pytest
import torch
import trimesh
from nerfstudio.configs.method_configs import all_methods
from plyfile import PlyData

from normlift_ns import open_run
from normlift_ns.demo import DemoRoom
from normlift_ns.method_configs.normlift import normlift_method
from normlift_ns.nerfstudio_plugin.config import rerooted
from normlift_ns.scripts import export
from tests.scripts.conftest import run_entry, said

EXTRA = ["reliability", "n_eff", "relevancy_0", "relevancy_1", "label"]


@pytest.fixture(scope="module")
def scene_ply(lifted: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("export")
    with pytest.MonkeyPatch.context() as patch:
        assert run_entry(patch, export.entrypoint, "--load-config", lifted, "--output-dir", folder) == 0
    return folder / "splat.ply"


@pytest.fixture
def ns_export(monkeypatch: pytest.MonkeyPatch) -> Iterator[object]:
    """nerfstudio's exporter; open3d, which it imports for meshes, needs system libraries."""
    monkeypatch.setitem(sys.modules, "open3d", MagicMock())
    from nerfstudio.scripts import exporter  # noqa: PLC0415

    yield exporter
    sys.modules.pop("nerfstudio.scripts.exporter")


def test_the_file_is_that_of_ns_export_and_more(
    scene_ply: Path, lifted: Path, ns_export, monkeypatch, tmp_path
) -> None:
    setup = ns_export.eval_setup

    def spoiled(config: Path, **options):
        config, pipeline, *rest = setup(config, update_config_callback=lambda c: rerooted(c, lifted), **options)
        return config, pipeline, *rest

    monkeypatch.setattr(ns_export, "eval_setup", spoiled)
    monkeypatch.setitem(all_methods, "normlift", normlift_method.config)
    ns_export.ExportGaussianSplat(load_config=lifted, output_dir=tmp_path).main()
    theirs, ours = (PlyData.read(path)["vertex"] for path in (tmp_path / "splat.ply", scene_ply))
    names = [p.name for p in theirs.properties]
    assert [p.name for p in ours.properties] == [*names, *EXTRA]
    for name in names:
        assert np.array_equal(theirs[name], ours[name]), name
    assert theirs.count == ours.count > 5000


def test_properties_are_those_of_the_field(scene_ply: Path, lifted: Path) -> None:
    run = open_run(lifted)
    field = run.field
    vertices, rows = PlyData.read(scene_ply)["vertex"], np.load(scene_ply.with_name("splat_rows.npy"))
    assert (np.diff(rows) > 0).all()
    answer = run.ask("red", "yellow")  # what the run stores
    assert np.array_equal(vertices["reliability"], field.scalars.reliability.numpy()[rows])
    assert np.array_equal(vertices["n_eff"], field.scalars.n_eff.numpy()[rows])
    assert np.allclose(vertices["relevancy_1"], answer.relevancy[:, 1].numpy()[rows], atol=1e-6)
    label = torch.where(answer.selected.any(1), answer.relevancy.where(answer.selected, -9.0).argmax(1), -1)
    assert np.array_equal(vertices["label"], label.numpy()[rows])
    assert 0.8 * len(run.scene.gaussians) < len(rows) <= len(run.scene.gaussians)
    assert (run.scene.gaussians.opacities[rows] > 0.0039).all()


def test_readers_of_other_programs_open_it(scene_ply: Path) -> None:
    """trimesh, and the way in which the reference code of 3D Gaussian splatting picks properties by their prefix."""
    count = len(np.load(scene_ply.with_name("splat_rows.npy")))
    cloud = trimesh.load(scene_ply)
    assert cloud.vertices.shape == (count, 3)
    ply = PlyData.read(scene_ply)
    names = [p.name for p in ply.elements[0].properties]
    assert ply.header.startswith("ply\nformat binary_little_endian 1.0\n")
    for prefix, number in (("f_rest_", 45), ("f_dc_", 3), ("scale_", 3), ("rot", 4), ("opacity", 1)):
        assert len([n for n in names if n.startswith(prefix)]) == number


def test_open3d_opens_it(scene_ply: Path) -> None:
    open3d = pytest.importorskip("open3d", reason="open3d needs system libraries here", exc_type=ImportError)
    cloud = open3d.t.io.read_point_cloud(str(scene_ply))
    assert cloud.point.positions.shape[0] == len(np.load(scene_ply.with_name("splat_rows.npy")))
    assert cloud.point.reliability.numpy().max() < 1


def test_selection_and_rest_make_up_the_scene(
    scene_ply: Path, lifted: Path, tmp_path: Path, monkeypatch, capsys
) -> None:
    rows = {}
    for part in ("selection", "rest"):
        flags = ("--load-config", lifted, "--output-dir", tmp_path, "--part", part, "--text", "red")
        assert run_entry(monkeypatch, export.entrypoint, *flags, "--output-filename", f"{part}.ply") == 0
        rows[part] = np.load(tmp_path / f"{part}_rows.npy")
        assert PlyData.read(tmp_path / f"{part}.ply")["vertex"].count == len(rows[part])
    assert np.array_equal(np.union1d(*rows.values()), np.load(scene_ply.with_name("splat_rows.npy")))
    assert len(np.intersect1d(*rows.values())) == 0
    assert "Objects" in capsys.readouterr().out


def test_objects_of_the_room(lifted: Path, room: DemoRoom, tmp_path: Path, monkeypatch) -> None:
    flags = ("--load-config", lifted, "--output-dir", tmp_path, "--text", "red", "--threshold", "0.8")
    assert run_entry(monkeypatch, export.entrypoint, *flags) == 0
    document = json.loads((tmp_path / "splat_objects.json").read_text())
    (red,) = document["queries"]
    assert (document["relevancy"], document["threshold"]) == ("cosine", 0.8)
    sizes = [found["size"] for found in red["objects"]]
    assert sizes == sorted(sizes, reverse=True)
    assert sum(sizes) + red["in_smaller_parts"] == red["gaussians"]
    ball, run = red["objects"][0], open_run(lifted)
    truth = run.scene.gaussians.means[room.labels == room.names.index("red")]
    assert ball["size"] > 0.6 * len(truth)
    assert np.allclose(ball["centroid"], truth.mean(0), atol=0.05)
    assert np.all(np.array(ball["box"]["min"]) <= ball["centroid"])
    assert np.all(np.array(ball["centroid"]) <= ball["box"]["max"])
    assert 0.3 < ball["mean_reliability"] < 1


@pytest.mark.parametrize(
    ("flags", "message"),
    [
        (("--text", "red", "--threshold", "1.5", "--part", "selection"), "no Gaussian is selected"),
        (("--text", "oragne"), "orange"),
        (("--part", "nothing"), "invalid choice"),
    ],
)
def test_mistakes_have_a_message(flags, message, lifted, tmp_path, monkeypatch, capsys) -> None:
    assert (
        run_entry(monkeypatch, export.entrypoint, "--load-config", lifted, "--output-dir", tmp_path / "x", *flags) == 1
    )
    shown = capsys.readouterr()
    assert message in " ".join((shown.out + shown.err).split())
    assert not list((tmp_path / "x").glob("*"))


def test_nothing_is_overwritten_unasked(scene_ply: Path, lifted: Path, monkeypatch, capsys) -> None:
    before = scene_ply.read_bytes()
    flags = ("--load-config", lifted, "--output-dir", scene_ply.parent, "--part", "selection")
    assert run_entry(monkeypatch, export.entrypoint, *flags) == 1
    assert "exists; give another --output-dir" in said(capsys)
    assert scene_ply.read_bytes() == before
    outside = ("--output-filename", "../../evil.ply")
    assert run_entry(monkeypatch, export.entrypoint, *flags[:-2], *outside) == 0
    assert (scene_ply.parent / "evil.ply").exists()
    assert not (scene_ply.parents[2] / "evil.ply").exists()


def test_an_overwritten_export_is_that_of_the_last_one_alone(lifted: Path, tmp_path: Path, monkeypatch) -> None:
    flags = ("--load-config", lifted, "--output-dir", tmp_path)
    for rest in ((), ("--text", "red", "--part", "selection", "--overwrite", True)):
        assert run_entry(monkeypatch, export.entrypoint, *flags, *rest) == 0
    count = PlyData.read(tmp_path / "splat.ply")["vertex"].count
    assert count == len(np.load(tmp_path / "splat_rows.npy")) < len(open_run(lifted).scene.gaussians) / 2
    (red,) = json.loads((tmp_path / "splat_objects.json").read_text())["queries"]
    assert red["text"] == "red"
    open_run(lifted).export(tmp_path / "splat.ply", overwrite=True)  # has no table, and leaves none of another's
    assert sorted(path.name for path in tmp_path.iterdir()) == ["splat.ply", "splat_rows.npy"]


@pytest.mark.parametrize("existing", ["splat.ply", "splat_rows.npy", "splat_objects.json"])
def test_no_part_of_an_export_is_replaced_unasked(existing, lifted: Path, tmp_path: Path, monkeypatch, capsys) -> None:
    monkeypatch.setattr("normlift_ns.front_door.open_run", None)  # refused before anything is opened
    (tmp_path / existing).write_text("mine")
    assert run_entry(monkeypatch, export.entrypoint, "--load-config", lifted, "--output-dir", tmp_path) == 1
    assert f"{existing} exists; give another --output-dir" in said(capsys)
    assert [path.read_text() for path in tmp_path.iterdir()] == ["mine"]
