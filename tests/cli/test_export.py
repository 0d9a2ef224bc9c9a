import json
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image
from plyfile import PlyData, PlyElement

from normlift_ns import open_run
from normlift_ns.analysis.objects import connected_components
from normlift_ns.cli import export, query
from normlift_ns.exports import answer_instances
from normlift_ns.rendering.figures import view_mask
from tests.cli.conftest import run_entry, said
from tests.nerfstudio_plugin.stock_run import relocate_config

EXTRA = ["reliability", "n_eff", "relevancy_0", "relevancy_1", "class_id", "instance_id"]


@pytest.fixture(scope="module")
def scene_ply(lifted: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("export")
    with pytest.MonkeyPatch.context() as patch:
        assert run_entry(patch, export.entrypoint, "--load-config", lifted, "--output-dir", folder) == 0
    return folder / "splat.ply"


def test_the_file_is_that_of_ns_export_and_more(scene_ply, lifted, nerfstudio, ns_export, monkeypatch, tmp_path):
    from normlift_ns.method_configs.normlift import normlift_method  # noqa: PLC0415

    moved = partial(ns_export.eval_setup, update_config_callback=lambda config: relocate_config(config, lifted))
    monkeypatch.setattr(ns_export, "eval_setup", moved)
    monkeypatch.setitem(nerfstudio.all_methods, "normlift", normlift_method.config)
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
    class_id = torch.where(answer.selected.any(1), answer.relevancy.where(answer.selected, -9.0).argmax(1) + 1, 0)
    assert vertices["class_id"].dtype == vertices["instance_id"].dtype == np.uint32
    assert np.array_equal(vertices["class_id"], class_id.numpy()[rows])
    names = json.loads(scene_ply.with_name("splat_names.json").read_text())
    assert (names["none"], names["class_id"]) == (0, {"1": "red", "2": "yellow"})
    instance_id = answer_instances(answer).instance_id.numpy()
    assert np.array_equal(vertices["instance_id"], instance_id[rows])
    assert [str(i) for i in np.unique(instance_id)] == ["0", *names["instance_id"]]
    for number, about in names["instance_id"].items():  # an object is of one class, and hangs together
        of_object = instance_id == int(number)
        assert set(class_id.numpy()[of_object]) == {about["class_id"]}
        assert names["class_id"][str(about["class_id"])] == about["text"]
        assert of_object.sum() == about["gaussians"]
        parts = connected_components(run.scene.gaussians.means, class_id == about["class_id"])
        assert len(parts[torch.from_numpy(of_object)].unique()) == 1
    assert 0.8 * len(run.scene.gaussians) < len(rows) <= len(run.scene.gaussians)
    assert (run.scene.gaussians.opacities[rows] > 0.0039).all()


@pytest.mark.slow
def test_selection_and_rest_are_the_scene_and_clean_lacks_floaters(scene_ply, lifted, tmp_path, monkeypatch, capsys):
    rows, whole = {}, np.load(scene_ply.with_name("splat_rows.npy"))
    for part in ("selection", "rest", "clean"):
        text = () if part == "clean" else ("--text", "red")
        flags = ("--load-config", lifted, "--output-dir", tmp_path, "--output-filename", f"{part}.ply", *text)
        assert run_entry(monkeypatch, export.entrypoint, *flags, "--select", part) == 0
        rows[part] = np.load(tmp_path / f"{part}_rows.npy")
        assert PlyData.read(tmp_path / f"{part}.ply")["vertex"].count == len(rows[part])
    assert np.array_equal(np.union1d(rows["selection"], rows["rest"]), whole)
    assert len(np.intersect1d(rows["selection"], rows["rest"])) == 0
    mask = open_run(lifted).floaters().mask
    assert np.array_equal(np.setdiff1d(whole, rows["clean"]), np.flatnonzero(mask.numpy()))
    shown = said(capsys)
    assert 0 < int(mask.sum()) < 0.05 * len(mask) and f"left out: {int(mask.sum()):,}" in shown
    limit = ("--select", "clean", "--floater-threshold", "100", "--overwrite")
    assert run_entry(monkeypatch, export.entrypoint, *flags, *limit) == 0
    assert np.array_equal(np.load(tmp_path / "clean_rows.npy"), whole)


def test_mistakes_have_a_message_and_leave_nothing(lifted, tmp_path, monkeypatch, capsys) -> None:
    given = ("--load-config", lifted, "--output-dir", tmp_path / "x", "--text")
    for flags, fact in ((("red", "--threshold", 1.5, "--select", "selection"), "no Gaussian"), (("oragne",), "orange")):
        assert run_entry(monkeypatch, export.entrypoint, *given, *flags) == 1
        assert fact in said(capsys)
        assert list(tmp_path.rglob("*.*")) == []


def test_an_overwritten_export_is_that_of_the_last_one_alone(lifted: Path, tmp_path: Path, monkeypatch) -> None:
    flags = ("--load-config", lifted, "--output-dir", tmp_path)
    for rest in ((), ("--text", "red", "--threshold", "0.8", "--select", "selection", "--overwrite", True)):
        assert run_entry(monkeypatch, export.entrypoint, *flags, *rest) == 0
    count = PlyData.read(tmp_path / "splat.ply")["vertex"].count
    assert count == len(np.load(tmp_path / "splat_rows.npy")) < len(open_run(lifted).scene.gaussians) / 2
    document = json.loads((tmp_path / "splat_objects.json").read_text())
    (red,) = document["queries"]
    assert (document["relevancy"], document["threshold"], red["text"], red["class_id"]) == ("cosine", 0.8, "red", 1)
    sizes = [found["size"] for found in red["objects"]]
    assert sum(sizes) + red["in_smaller_parts"] == red["gaussians"] and sizes == sorted(sizes, reverse=True)
    assert [found["instance_id"] for found in red["objects"]] == [*range(1, len(sizes) + 1)]
    ball = red["objects"][0]
    assert np.all(np.array(ball["box"]["min"]) <= ball["centroid"]) and 0.3 < ball["mean_reliability"] < 1
    assert np.all(np.array(ball["centroid"]) <= ball["box"]["max"])
    open_run(lifted).export(tmp_path / "splat.ply", overwrite=True)  # has no table, and leaves none of another's
    assert sorted(path.name for path in tmp_path.iterdir()) == ["splat.ply", "splat_rows.npy"]


def test_one_option_puts_tables_and_files_into_the_coordinates_of_the_capture(lifted, tmp_path, monkeypatch, capsys):
    run = open_run(lifted)
    found, means = run.ask("red"), run.scene.gaussians.means.double().numpy()
    asked = ("--load-config", lifted, "--text", "red", "--coordinates", "capture")
    assert run_entry(monkeypatch, query.entrypoint, *asked, "--objects", "True", "--output-json", tmp_path / "a") == 0
    assert run_entry(monkeypatch, export.entrypoint, *asked, "--output-dir", tmp_path) == 0
    assert said(capsys).count("positions in capture coordinates") == 3
    rows, vertex = np.load(tmp_path / "splat_rows.npy"), PlyData.read(tmp_path / "splat.ply")["vertex"]
    expected = run.to_capture.transform_points(means)
    assert np.allclose(np.stack([vertex[axis] for axis in "xyz"], 1), expected[rows], atol=1e-4)
    grown = np.stack([vertex[f"scale_{i}"] for i in range(3)], 1) - run.scene.parameters["scales"].numpy()[rows]
    assert np.allclose(grown, np.log(run.to_capture.scale), atol=1e-5)
    place = run.to_capture.transform_points(np.array([found["red"].centroid]))[0]
    (red,) = json.loads((tmp_path / "a").read_text())["queries"]
    assert np.allclose(red["centroid"], place, atol=1e-4)
    written = json.loads((tmp_path / "splat_objects.json").read_text())
    ball = run.catalogue(found).objects[0].capture
    assert written["coordinates"] == "capture"
    assert np.allclose(written["queries"][0]["objects"][0]["centroid"], ball.centroid, atol=1e-4)


def test_masks_arrays_and_labels_of_a_cloud(scene_ply, lifted, room, tmp_path, monkeypatch, capsys) -> None:
    run = open_run(lifted)
    means = run.scene.gaussians.means
    points = np.concatenate([run.to_capture.transform_points(means[:50].double().numpy()), [[1e6, 0, 0]]])
    table = np.array([tuple(point) for point in points], [(axis, "f8") for axis in "xyz"])
    PlyData([PlyElement.describe(table, "vertex")]).write(str(tmp_path / "cloud.ply"))
    flags = ("--load-config", lifted, "--output-dir", tmp_path, "--transfer", tmp_path / "cloud.ply")
    more = ("--masks-dir", tmp_path / "masks", "--arrays-dir", tmp_path / "arrays")
    assert run_entry(monkeypatch, export.entrypoint, *flags, *more) == 0
    assert "98.0%" in said(capsys)
    rows, splat = np.load(scene_ply.with_name("splat_rows.npy")), PlyData.read(scene_ply)["vertex"]
    arrays = {name: np.load(tmp_path / "arrays" / f"{name}.npy") for name in ("coord", "segment", "instance")}
    assert [array.dtype.str for array in arrays.values()] == ["<f4", "<i4", "<i4"]
    assert np.array_equal(arrays["coord"], np.stack([splat[axis] for axis in "xyz"], 1))
    assert np.array_equal(arrays["segment"], splat["class_id"].astype(int) - 1)
    assert np.array_equal(arrays["instance"], splat["instance_id"].astype(int) - 1)
    assert arrays["segment"].min() == -1
    cloud = PlyData.read(tmp_path / "cloud_labels.ply")["vertex"]
    own = np.isin(np.arange(50), rows)  # the others are never drawn, and take those of a neighbour
    assert own.sum() > 30
    place = np.searchsorted(rows, np.arange(50)[own])
    for name in ("class_id", "instance_id", "relevancy_0", "relevancy_1"):
        assert np.array_equal(np.asarray(cloud[name])[:50][own], splat[name][place]), name
        assert cloud[name][50] == 0
    camera = run.scene.train.cameras[3]
    found = np.array(Image.open(tmp_path / "masks" / "0003.png"))
    assert found.shape == (camera.height, camera.width)
    assert set(np.unique(found)) == {0, 255}
    true = torch.isin(room.labels, torch.tensor([room.names.index(name) for name in ("red", "yellow")]))
    wanted = view_mask(run.scene, camera, true).numpy()
    assert ((found > 0) & wanted).sum() / ((found > 0) | wanted).sum() > 0.6
    rest = ("--select", "rest", "--masks-dir", tmp_path / "rest", "--output-filename", "rest.ply")
    assert run_entry(monkeypatch, export.entrypoint, *flags[:4], *rest) == 0
    assert np.array_equal(np.array(Image.open(tmp_path / "rest" / "0003.png")), 255 - found)
    again = ("--masks-dir", tmp_path / "masks", "--output-dir", tmp_path / "again")
    assert run_entry(monkeypatch, export.entrypoint, *flags[:2], *again) == 1
    assert "--masks-dir, or --overwrite True" in said(capsys)
    again = ("--transfer", tmp_path / "cloud_labels.ply", "--output-dir", tmp_path / "again")
    assert run_entry(monkeypatch, export.entrypoint, *flags[:2], *again) == 1
    assert "class_id, instance_id, relevancy_0, relevancy_1" in said(capsys)
    assert not (tmp_path / "again").exists()  # refused before anything is written
