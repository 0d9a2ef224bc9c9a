"""ns-normlift-query --objects, --explain and --segment sam3, and honest answers in its table."""

import csv
import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from PIL import Image
from plyfile import PlyData

from normlift_ns import Camera, InputError, LiftOptions, SourceOptions, lift_run, open_run
from normlift_ns.analysis.objects import view_shares
from normlift_ns.cli import query
from normlift_ns.cli.query import print_catalog
from normlift_ns.demo.room import DemoRoom
from normlift_ns.exports import answer_instances
from normlift_ns.rasterization.rasterize import render
from normlift_ns.rasterization.settings import RasterSettings
from normlift_ns.segmentation.sam3 import Sam3Network, TextMasks
from tests.cli.conftest import run_entry, said


@pytest.fixture(scope="module")
def written(lifted: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("objects")
    flags = ("--load-config", lifted, "--text", "red", "yellow", "--objects", "--objects-dir", folder)
    with pytest.MonkeyPatch.context() as patch:
        assert run_entry(patch, query.entrypoint, *flags, "--meters-per-unit", 0.5) == 0
    return folder


def test_places_are_those_of_the_capture(written: Path, lifted: Path, room: DemoRoom) -> None:
    document = json.loads((written / "objects.json").read_text())
    assert (document["unit"], document["metres_per_unit"], document["texts"]) == ("metre", 0.5, ["red", "yellow"])
    ball = document["objects"][0]
    truth = room.scene.means[room.labels == room.names.index("red")].double().numpy()  # the room as it was captured
    assert (ball["id"], ball["text"], ball["class_id"]) == (1, "red", 1)
    assert np.allclose(ball["capture"]["centroid"], 0.5 * truth.mean(0), atol=0.03)
    extent = np.quantile(truth, 0.99, axis=0) - np.quantile(truth, 0.01, axis=0)
    assert np.allclose(ball["capture"]["extent"], 0.5 * extent, atol=0.06)
    transform = json.loads(lifted.with_name("dataparser_transforms.json").read_text())
    there = np.array(ball["capture"]["centroid"]) / 0.5
    back = transform["scale"] * (np.array(transform["transform"]) @ [*there, 1])
    assert np.allclose(back, ball["scene"]["centroid"], atol=1e-5)
    ratio = np.array(ball["scene"]["box"]["size"]) / ball["capture"]["box"]["size"]
    assert ratio == pytest.approx(np.full(3, transform["scale"] / 0.5))


def test_the_renders_use_the_given_device(lifted: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    chosen: list[str] = []
    monkeypatch.setattr("normlift_ns.core.device.choose_device", lambda name="auto": chosen.append(name) or "cpu")
    flags = ("--load-config", lifted, "--text", "red", "--objects", "--device", "cpu")
    assert run_entry(monkeypatch, query.entrypoint, *flags) == 0
    assert chosen == ["cpu"]


def test_of_many_objects_the_table_has_the_largest(lifted: Path, capsys) -> None:
    run = open_run(lifted)
    red = run.ask("red")
    few = run.catalogue(red)
    assert few.num_in_small_components == int(red["red"].mask.sum()) - sum(item.gaussians for item in few.objects)
    many = tuple(replace(few.objects[0], id=i, gaussians=1000 + i) for i in range(1, 43))
    print_catalog(replace(few, objects=many))
    shown = said(capsys)
    assert "1,042" in shown and "1,033" in shown and "1,032" not in shown
    assert "red: 42 objects" in shown and "10 largest" in shown and "--objects-dir" in shown


def test_table_boxes_and_document_say_the_same(written: Path) -> None:
    document = json.loads((written / "objects.json").read_text())
    with (written / "objects.csv").open(newline="", encoding="utf8") as file:
        table = list(csv.DictReader(file))
    assert len(table) == len(document["objects"]) >= 2
    for row, found in zip(table, document["objects"]):
        assert (int(row["id"]), row["text"], int(row["gaussians"])) == (found["id"], found["text"], found["gaussians"])
        assert [row[f"best_view_{i}"] for i in (1, 2, 3)] == found["best_views"]
        for prefix, place in (("", found["capture"]), ("scene_", found["scene"])):
            assert [float(row[prefix + axis]) for axis in "xyz"] == place["centroid"]
            assert [float(row[f"{prefix}box_size_{i}"]) for i in (1, 2, 3)] == place["box"]["size"]
            axes = [[float(row[f"{prefix}box_axis_{i}_{axis}"]) for axis in "xyz"] for i in (1, 2, 3)]
            assert axes == place["box"]["axes"]
    for name, place in (("objects.ply", "capture"), ("objects_scene.ply", "scene")):
        mesh = PlyData.read(written / name)
        corners = np.stack([mesh["vertex"][axis] for axis in "xyz"], 1).reshape(-1, 8, 3)
        faces = np.stack(mesh["face"]["vertex_indices"])
        assert (len(corners), len(faces)) == (len(table), 6 * len(table))
        assert mesh["vertex"]["instance_id"].tolist() == np.repeat([x["id"] for x in document["objects"]], 8).tolist()
        for found, eight in zip(document["objects"], corners):
            box = found[place]["box"]
            along = (eight - box["center"]) @ np.array(box["axes"]).T
            assert np.allclose(np.abs(along), np.array(box["size"]) / 2, atol=1e-4)
        first = corners[0]
        for a, b, c, _ in faces[:6]:  # counter-clockwise from outside
            outwards = np.cross(first[b] - first[a], first[c] - first[b])
            assert outwards @ (first[a] - first.mean(0)) > 0


def share_inside(means: torch.Tensor, camera: Camera) -> float:
    """Of the points that project into the picture."""
    x, y, z = (camera.K @ (camera.world_to_camera[:3, :3] @ means.T + camera.world_to_camera[:3, 3:])).unbind()
    return ((z > 0) & (x >= 0) & (y >= 0) & (x <= z * camera.width) & (y <= z * camera.height)).float().mean().item()


def test_views_are_those_that_show_it(lifted: Path) -> None:
    run = open_run(lifted)
    answer = run.ask("red", "yellow")
    found, instances = run.catalogue(answer), answer_instances(answer)
    shares = view_shares(run.scene, instances, RasterSettings(), "cpu")
    for number, thing in enumerate(found.objects, 1):
        mask = (instances.instance_id == number).float()[:, None]
        drawn = [render(run.scene.gaussians, camera, mask)[0].mean() for camera in run.scene.train.cameras]
        assert np.allclose(shares[number - 1], drawn, atol=1e-6)
        shows = [x >= 0.1 * max(drawn) for x in drawn]
        inside = [share_inside(run.scene.gaussians.means[mask[:, 0] > 0], c) for c in run.scene.train.cameras]
        enough = 0.95 * max(x for x, y in zip(inside, shows) if y)
        best = sorted(range(len(drawn)), key=lambda i: (not shows[i], inside[i] < enough, -drawn[i]))[:3]
        assert thing.best_views == tuple(run.scene.train.names[i] for i in best)
        assert thing.views == sum(shows)
    alone = run.catalogue(answer["yellow"])
    assert {thing.text for thing in alone.objects} == {"yellow"}
    (unnamed, *_) = run.catalogue(answer["red"].mask).objects
    assert (unnamed.text, unnamed.gaussians) == ("", found.objects[0].gaussians)
    assert run.catalogue(answer.mask & False).objects == ()
    for wrong in (0.0, -1.0, float("nan")):
        with pytest.raises(InputError, match="meters_per_unit"):
            run.catalogue(answer, meters_per_unit=wrong)


def test_why_is_a_table_json_and_pictures(lifted: Path, tmp_path: Path, monkeypatch, capsys) -> None:
    pictures, table = tmp_path / "why", tmp_path / "table.json"
    flags = ("--load-config", lifted, "--text", "red", "--explain", "--explain-dir", pictures, "--output-json", table)
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
    different = sum(view["agreement"] < 0.9 for view in why["views"][3:])
    assert len(names) == 3 + min(3, different) and len({name[-8:] for name in names}) == len(names)
    assert Image.open(pictures / names[0]).size == (160, 120)
    assert run_entry(monkeypatch, query.entrypoint, *flags[:-2]) == 1
    assert "exists" in said(capsys)


def test_what_is_not_in_the_scene_is_said(lifted: Path, tmp_path: Path, monkeypatch, capsys) -> None:
    flags = ("--load-config", lifted, "--text", "red", "hot pink", "--output-json", tmp_path / "x.json")
    assert run_entry(monkeypatch, query.entrypoint, *flags) == 0
    shown = said(capsys)
    assert "hot pink: probably not here" in shown
    assert "red: " not in shown
    there, absent = json.loads((tmp_path / "x.json").read_text())["queries"]
    assert (there["verdict"], absent["verdict"]) == ("found", "probably not here")
    assert there["fraction"] > 0.005 and absent["fraction"] == 0
    nothing = ("--load-config", lifted, "--text", "hot pink", "--explain")
    assert run_entry(monkeypatch, query.entrypoint, *nothing, "--threshold", "0.999") == 0
    assert "hot pink: nothing is selected" in said(capsys)


def test_a_threshold_can_be_suggested(lifted: Path, tmp_path: Path, monkeypatch) -> None:
    flags = ("--load-config", lifted, "--text", "red", "--threshold", "auto", "--output-json", tmp_path / "x.json")
    assert run_entry(monkeypatch, query.entrypoint, *flags) == 0
    document = json.loads((tmp_path / "x.json").read_text())
    (row,) = document["queries"]
    assert document["threshold"] == pytest.approx(row["suggested_threshold"])
    found = open_run(lifted).ask("red", threshold="auto")
    assert found.question.threshold == pytest.approx(document["threshold"], abs=1e-5)
    assert row["fraction"] == pytest.approx(found["red"].fraction, abs=1e-3)


@pytest.fixture
def weights(tmp_path, monkeypatch) -> Path:
    """Of SAM 3, whose network finds colors here; `Sam3Network.asked` has the texts."""

    def find(self: Any, image: torch.Tensor, texts: list[str]) -> list[TextMasks]:
        self.asked.extend(texts)
        r, g, b = image.int().unbind(2)
        there = {"red": (r > 2 * g) & (r > 2 * b) & (r > 60), "green": torch.zeros_like(r, dtype=torch.bool)}
        return [TextMasks(there[text][None], torch.tensor([0.9])) for text in texts]

    monkeypatch.setattr(Sam3Network, "asked", [], raising=False)
    monkeypatch.setattr(Sam3Network, "segment", find)
    from tests.segmentation.tiny_sam import write_tiny  # noqa: PLC0415 (transformers)

    write_tiny(tmp_path / "sam3", "sam3")
    return tmp_path / "sam3"


@pytest.fixture
def segmented(own: Path, weights: Path) -> tuple[object, ...]:
    lifted = own.parents[2] / "normlift" / "t" / "config.yml"
    return ("--load-config", lifted, "--segment", "sam3", "--segment-model", weights, "--segment-views", 4)


def test_sam3_answers_beside_the_run(segmented, tmp_path, monkeypatch, capsys) -> None:
    table, arrays = tmp_path / "table.json", tmp_path / "arrays.npz"
    flags = (*segmented, "--text", "red", "--output-json", table, "--output-npz", arrays)
    assert run_entry(monkeypatch, query.entrypoint, *flags) == 0
    shown = said(capsys)
    assert "SAM 3" in shown and "50%" in shown
    (row,) = json.loads(table.read_text())["queries"]
    found = row["segment"]
    assert len(found["views"]) == 4 and 0 < len(found["agree"]) <= len(found["found_in"]) <= 4
    assert 0 < found["fraction"] < 0.3 and found["iou"] > 0.1
    assert np.allclose(found["centroid"], row["centroid"], atol=0.5)
    assert 0.5 < found["agreement"] <= 1 and 0 < found["mean_reliability"] < 1 and found["peak"] > 0.9
    with np.load(arrays) as kept:
        share, reliability = kept["segment_relevancy"], kept["segment_reliability"]
        assert share.shape == reliability.shape == kept["segment_agreement"].shape == kept["relevancy"].shape
    assert float((share > 0.5).mean()) == pytest.approx(found["fraction"])


@pytest.mark.slow
def test_what_was_found_before_is_kept(own, segmented, weights, tmp_path, monkeypatch, capsys) -> None:
    table, kept, asked = tmp_path / "table.json", own.parents[2] / "normlift" / ".cache" / "masks", Sam3Network.asked

    def ask(*more: str) -> dict:
        flags = (*segmented, "--output-json", table, "--overwrite", "True", "--threshold", 0.6)
        assert run_entry(monkeypatch, query.entrypoint, *flags, *more) == 0
        return json.loads(table.read_text())["queries"][0]["segment"]

    first = ask("--text", "red")
    assert asked == ["red"] * 4 and len(list(kept.iterdir())) == 4
    with monkeypatch.context() as without:
        without.setattr(Sam3Network, "load", lambda *_: pytest.fail("the network is not needed"))
        assert ask("--text", "red") == first and len(asked) == 4
    assert ask("--text", "red", "green") == first and asked[4:] == ["green"] * 4
    said(capsys)
    sure = ask("--text", "red", "--min-reliability", "0.6")
    assert 0 < sure["fraction"] < first["fraction"] and sure["mean_reliability"] > max(0.6, first["mean_reliability"])
    assert "0.6" in said(capsys)
    config = weights / "config.json"
    config.write_text(config.read_text() + "\n")  # other weights: another digest
    assert ask("--text", "red") == first and len(asked) == 12


def test_what_sam3_finds_can_be_the_regions(little: Path, weights: Path, tmp_path) -> None:
    source = SourceOptions(encoder="color", regions="sam3", sam_model=str(weights))
    how = LiftOptions(max_views=4, refine=False, consensus=False)
    run = lift_run(little, source=source, lift=how, queries=["red"], output_dir=tmp_path, check_alignment=False)
    manifest = run.field.manifest
    assert manifest["source"]["sam3_prompts"] == ["red"] or manifest["source"]["sam3_prompts"] == ("red",)
    assert manifest["features"]["regions"]["texts"] == ["red"]
    seen = float((run.field.scalars.norm > 0).float().mean())
    assert 0 < seen < 0.7  # the rest is unlabelled
    red = run.ask("red")["red"]
    assert red.peak is not None and red.peak > 0.6
