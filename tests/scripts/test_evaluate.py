"""ns-normlift-eval on a lifted demo room: its protocols as a user types them, with stand-in vectors and labels."""

from __future__ import annotations

import json
from pathlib import Path
from typing import get_args

import cv2
import numpy as np
import pytest
import torch
from PIL import Image
from plyfile import PlyData, PlyElement

import normlift_ns as nl
from benchmarks.plain_room import plain_room
from normlift_ns.core.ablations import Variant
from normlift_ns.demo import DemoRoom, write_capture, write_splatfacto_run
from normlift_ns.encoders.colour import ColourEncoder
from normlift_ns.evaluation import votes
from normlift_ns.evaluation.baselines import BASELINES
from normlift_ns.evaluation.instance_masks import read_names
from normlift_ns.evaluation.scannet import NYU40
from normlift_ns.options import BACKGROUND_WORDS, CANONICAL_NEGATIVES, RefineConfig
from normlift_ns.scripts import evaluate, lift
from tests.scripts.conftest import run_entry, said


@pytest.fixture(scope="module")
def room() -> DemoRoom:
    return plain_room(3000)


@pytest.fixture(scope="module")
def workspace(room: DemoRoom, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Holds the capture in room/ and the lifted run in outputs/."""
    folder = tmp_path_factory.mktemp("evaluated")
    write_capture(room, folder / "room", views=8, held_out=2, width=128, height=96)
    trained = write_splatfacto_run(room, folder / "room", folder / "outputs")
    with pytest.MonkeyPatch.context() as monkeypatch:
        flags = ("--encoder", "colour", "--k", "12", "--timestamp", "t", "--region-count", "400")
        assert run_entry(monkeypatch, lift.entrypoint, "--load-config", trained, *flags) == 0
    return folder


def evaluated(monkeypatch, workspace: Path, protocol: str, labels: Path, *flags: object) -> dict:
    config, output = workspace / "outputs" / "room" / "normlift" / "t" / "config.yml", workspace / f"{protocol}.json"
    given = ("--protocol", protocol, "--load-config", config, "--labels", labels, "--output-path", output)
    given += ("--overwrite", True)
    assert run_entry(monkeypatch, evaluate.entrypoint, *given, *flags) == 0
    return json.loads(output.read_text())


@pytest.mark.parametrize("existing", ["scores.json", "scores_sweeps.svg", "scores_signals.svg"])
def test_nothing_is_replaced_unasked(existing, workspace, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr("normlift_ns.front_door.open_run", None)  # refused before anything is opened
    (tmp_path / existing).write_text("mine")
    config = workspace / "outputs" / "room" / "normlift" / "t" / "config.yml"
    flags = ("--protocol", "masks", "--load-config", config, "--labels", workspace / "room" / "instance")
    flags += ("--output-path", tmp_path / "scores.json", "--study", "sweeps", "signals")
    assert run_entry(monkeypatch, evaluate.entrypoint, *flags) == 1
    shown = said(capsys)
    assert f"{existing} exists; give another --output-path, or --overwrite True." in shown
    assert [path.name for path in tmp_path.iterdir()] == [existing]
    assert (tmp_path / existing).read_text() == "mine"


def test_the_default_output_is_not_replaced_either(workspace, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    Path("output.json").write_text("mine")
    config = workspace / "outputs" / "room" / "normlift" / "t" / "config.yml"
    flags = ("--protocol", "masks", "--load-config", config, "--labels", workspace / "room" / "instance")
    assert run_entry(monkeypatch, evaluate.entrypoint, *flags) == 1
    assert "output.json exists" in said(capsys)
    assert run_entry(monkeypatch, evaluate.entrypoint, *flags, "--overwrite", True) == 0
    assert json.loads(Path("output.json").read_text())["experiment_name"] == "room"


def looked(monkeypatch, workspace: Path, output: Path, *flags: object) -> int:
    config = workspace / "outputs" / "room" / "normlift" / "t" / "config.yml"
    given = ("--load-config", config, "--output-path", output, *flags)
    return run_entry(monkeypatch, evaluate.entrypoint, *given)


def test_coverage_needs_no_truth(workspace, tmp_path, monkeypatch, capsys):
    flags = ("--study", "coverage")
    assert looked(monkeypatch, workspace, tmp_path / "next.json", *flags) == 0
    shown = said(capsys)
    document = json.loads((tmp_path / "next.json").read_text())
    assert document["results"] == {}
    (found,) = document["studies"]["coverage"]
    assert found["left_out"] == {"held out": 2}
    assert {photograph["why"] for photograph in found["photographs"]} == {"held out"}
    assert 0 < found["reliability"] < 1
    files = {path.name for path in tmp_path.iterdir()}
    pictures = {f"next_coverage_pose_{i}.png" for i in range(1, len(found["poses"]) + 1)}
    path = {"next_coverage_camera_path.json"} if len(pictures) > 0 else set()
    assert files == {"next.json"} | pictures | path
    assert "photographs" in shown
    assert "next.json" in shown
    before = {path: path.read_bytes() for path in tmp_path.iterdir()}
    assert looked(monkeypatch, workspace, tmp_path / "next.json", *flags) == 1
    assert "next.json exists" in said(capsys)
    assert {path: path.read_bytes() for path in tmp_path.iterdir()} == before


@pytest.mark.parametrize("existing", ["next_coverage_camera_path.json", "next_coverage_pose_5.png"])
def test_coverage_replaces_nothing_unasked(existing, workspace, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr("normlift_ns.front_door.open_run", None)
    (tmp_path / existing).write_text("mine")
    assert looked(monkeypatch, workspace, tmp_path / "next.json", "--protocol", "none", "--study", "coverage") == 1
    assert f"{existing} exists; give another --output-path, or --overwrite True." in said(capsys)
    assert [path.name for path in tmp_path.iterdir()] == [existing]


@pytest.mark.parametrize("flags", [(), ("--study", "ablation"), ("--study", "coverage", "--labels", ".")])
def test_protocol_none_scores_nothing(flags, workspace, tmp_path, monkeypatch, capsys):
    assert looked(monkeypatch, workspace, tmp_path / "next.json", "--protocol", "none", *flags) == 1
    assert "protocol none takes runs (--load-config), no --labels, and --study coverage" in said(capsys)
    assert list(tmp_path.iterdir()) == []


def stand_ins(path: Path, words: dict[str, str]) -> Path:
    """Vectors of words, each that of a colour."""
    vectors = ColourEncoder().text(list(words.values())).numpy()
    np.savez(path, **dict(zip(words, vectors)))
    return path


def test_masks_of_a_capture(workspace, monkeypatch, capsys):
    document = evaluated(monkeypatch, workspace, "masks", workspace / "room" / "instance")
    results = document["results"]
    assert document["experiment_name"] == "room"
    assert document["method_name"] == "normlift"
    assert results["miou_3d"] > 0.5
    assert results["miou_2d"] > 0.4
    assert 0.5 < results["gaussians_with_truth_share"] < 1
    assert len(document["rows"]) == 13
    assert document["settings"]["held_out_views"] == 2
    assert "miou_3d" in capsys.readouterr().out
    plain = evaluated(monkeypatch, workspace, "masks", workspace / "room" / "instance", "--refined", False)
    assert plain["results"]["miou_3d"] != results["miou_3d"]


def test_studies_of_masks(workspace, monkeypatch, capsys):
    monkeypatch.setattr(votes, "SWEEPS", {"beta": (0.5,), "k": (6, 12), "delta": (0.0, 0.1)})
    flags = ("--study", "ablation", "sweeps", "signals", "timing")
    document = evaluated(monkeypatch, workspace, "masks", workspace / "room" / "instance", *flags)
    studies = document["studies"]
    assert list(studies) == ["ablation", "sweeps", "signals", "timing"]
    by_variant = {row["variant"]: row for row in studies["ablation"]}
    assert list(by_variant) == [*get_args(Variant), *votes.AGREED]
    ours = by_variant["consensus_posterior"]["miou_3d"]  # the defaults, here from stored u
    assert ours == pytest.approx(document["results"]["miou_3d"], abs=5e-3)
    plain = evaluated(monkeypatch, workspace, "masks", workspace / "room" / "instance", "--refined", False)
    assert by_variant["consensus"]["miou_3d"] == plain["results"]["miou_3d"]
    assert len({row["miou_3d"] for row in by_variant.values()}) > 3
    own = [row for row in studies["sweeps"] if row["own"]]
    assert [row["parameter"] for row in own] == ["beta", "k", "delta"]
    assert [row["miou_3d"] for row in own] == [ours] * 3
    of_k = [(row["value"], row["default"], row["own"]) for row in studies["sweeps"] if row["parameter"] == "k"]
    assert of_k == sorted({(6, False, False), (12, False, True), (RefineConfig().k, True, False)})
    (signals,) = studies["signals"]
    assert signals["zero.share"] == pytest.approx(document["results"]["zero_evidence_share"])
    assert signals["zero.accuracy_unrefined"] is None  # no mask tells the class of what nobody sees
    assert signals["zero.accuracy_refined"] is None
    assert signals["seen.accuracy_refined"] == pytest.approx(document["results"]["accuracy_3d"], abs=1e-6)
    assert 0 <= signals["opacity.kendall_p"] <= 1
    assert signals["reliability.spearman_bins"] > 0.5
    assert sum(v for k, v in signals.items() if k.startswith("histogram.")) == pytest.approx(1 - signals["zero.share"])
    (cost,) = studies["timing"]
    assert cost["vote_s"] > 0 and cost["store_s"] > 0
    stages = ("features_s", "evidence_s", "consensus_s", "lift_s", "neighbors_s", "vote_s", "store_s")
    assert cost["total_s"] == pytest.approx(sum(cost[stage] for stage in stages))
    assert {p.name for p in workspace.glob("masks_*.svg")} == {"masks_sweeps.svg", "masks_signals.svg"}
    told = said(capsys)
    assert "spearman_bins" in told
    assert "leaves out SFS's way (512 channels through gsplat): it needs a GPU" in told


def test_baselines_are_lifted_from_the_features_of_the_run(workspace, monkeypatch, capsys):
    document = evaluated(monkeypatch, workspace, "masks", workspace / "room" / "instance", "--study", "baselines")
    rows = {row["method"]: row for row in document["studies"]["baselines"]}
    assert list(rows) == ["normlift", "unrefined", "sfs", "occam", "vala", "drsplat"]
    assert rows["normlift"]["miou_3d"] == document["results"]["miou_3d"]
    assert [rows[name]["what"] for name in BASELINES] == list(BASELINES.values())
    assert len({(row["miou_3d"], row["miou_2d"]) for row in rows.values()}) == 6
    assert min(row["miou_3d"] for row in rows.values()) > 0.2
    assert "drsplat" in said(capsys)


def test_baselines_of_features_of_ones_own_are_refused(workspace, monkeypatch, capsys):
    config = workspace / "outputs" / "room" / "normlift" / "t" / "config.yml"
    scene = nl.open_scene(config)
    halves = [((torch.arange(c.width) * 2 // c.width).expand(c.height, -1), torch.eye(2)) for c in scene.train.cameras]
    texts = dict.fromkeys(read_names(workspace / "room" / "labels.json").classes, torch.tensor([1.0, 1.0]))
    run = nl.lift_run(scene, features=halves, texts=texts, output_dir=workspace / "own", timestamp="own")
    flags = ("--protocol", "masks", "--load-config", run.config, "--labels", workspace / "room" / "instance")
    flags += ("--output-path", workspace / "own.json", "--study", "baselines")
    assert run_entry(monkeypatch, evaluate.entrypoint, *flags) == 1
    assert "does not say how its regions and features were made" in said(capsys)


def test_scannet_with_stand_in_names(workspace, room, monkeypatch):
    ids = list(NYU40)[: len(room.names)]
    vertices = np.zeros(len(room.labels), dtype=[("x", "f4"), ("y", "f4"), ("z", "f4"), ("label", "u2")])
    vertices["label"] = [ids[label] if label >= 0 else 0 for label in room.labels.tolist()]
    path = workspace / "scene0000_00_vh_clean_2.labels.ply"
    PlyData([PlyElement.describe(vertices, "vertex")]).write(str(path))
    colours = [*room.names, *["black", "white", "grey", "beige", "magenta", "lime"]]
    names = [*NYU40.values(), "shower curtain"]
    vectors = stand_ins(workspace / "names.npz", dict(zip(names, [*colours, "cyan"])))
    document = evaluated(monkeypatch, workspace, "scannet", path, "--text-vectors", vectors)
    results = document["results"]
    assert document["settings"]["scenes"] == ["scene0000_00"]
    assert len(document["settings"]["missing_scenes"]) == 9
    assert results["miou_19"] > 0.5
    assert results["miou_10"] >= results["miou_19"] - 0.2
    assert {row["class"] for row in document["rows"] if row["classes"] == 19} == {NYU40[i] for i in ids}
    assert document["settings"]["spelling"] == "script"
    spelled = evaluated(monkeypatch, workspace, "scannet", path, "--spelling", "paper", "--text-vectors", vectors)
    assert spelled["settings"]["spelling"] == "paper"
    assert spelled["results"]["miou_19"] > results["miou_19"] - 0.2  # that name is found too
    flags = ("--study", "signals", "ablation", "--text-vectors", vectors)
    studies = evaluated(monkeypatch, workspace, "scannet", path, *flags)["studies"]
    assert studies["signals"][0]["scene"] == "scene0000_00"
    assert 0.5 < studies["signals"][0]["seen.accuracy_unrefined"] < 1
    assert [row["variant"] for row in studies["ablation"]][-1] == "consensus_posterior"
    (ours,) = (row for row in studies["ablation"] if row["variant"] == "consensus_posterior")
    assert ours["miou_19"] == pytest.approx(results["miou_19"], abs=5e-3)


def write_polygons(folder: Path, instance: Path, names: tuple[str, ...], wanted: tuple[str, ...]) -> None:
    values = np.array(Image.open(instance))
    objects = []
    for name in wanted:
        mask = (values == names.index(name) + 1).astype(np.uint8)
        outlines, _ = cv2.findContours(mask, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
        objects += [{"category": name, "segmentation": o[:, 0].tolist()} for o in outlines if len(o) > 8]
    folder.mkdir(parents=True, exist_ok=True)
    info = {"name": instance.name, "width": values.shape[1], "height": values.shape[0]}
    (folder / f"{instance.stem}.json").write_text(json.dumps({"info": info, "objects": objects}))


def test_lerf_with_stand_in_words(workspace, room, monkeypatch, capsys):
    wanted, labels = ("sky blue", "bright blue", "dark green"), workspace / "label" / "room"
    for stem in ("0000", "0008"):  # a training view and a held-out one
        write_polygons(labels, workspace / "room" / "instance" / f"{stem}.png", room.names, wanted)
    (labels / "0099.json").write_text((labels / "0000.json").read_text())
    words = {**{name: name for name in wanted}, **dict.fromkeys(BACKGROUND_WORDS, "cream")}
    words |= {"floor": "light brown", "object": "chocolate brown", "things": "grey"}
    vectors = stand_ins(workspace / "words.npz", words)
    assert set(CANONICAL_NEGATIVES) <= set(words)
    found = {}
    for rule in ("background", "langsplat", "langsplat_composited", "auto"):
        flags = ("--masking", rule, "--text-vectors", vectors)
        found[rule] = evaluated(monkeypatch, workspace, "lerf", labels, *flags)
    results = found["background"]["results"]
    assert results["loc_acc"] > 0.6
    assert results["miou"] > 0.3
    assert results["miou_pooled"] == results["miou"] == found["background"]["scenes"][0]["miou"]
    assert found["langsplat"]["results"] != found["langsplat_composited"]["results"]
    assert found["background"]["settings"]["labels_without_image"] == ["room/0099"]
    assert {row["frame"] for row in found["auto"]["rows"]} <= {"room/0000", "room/0008"}
    (signals,) = evaluated(monkeypatch, workspace, "lerf", labels, *flags, "--study", "signals")["studies"]["signals"]
    assert "opacity.spearman" in signals
    assert "all.accuracy_refined" not in signals  # nothing tells the class of a Gaussian
    cleaned = evaluated(monkeypatch, workspace, "lerf", labels, "--clean", True, "--text-vectors", vectors)
    assert cleaned["results"]["miou"] != results["miou"]


def test_several_scenes_are_averaged_and_pooled(workspace, room, monkeypatch, capsys):
    """One run under two names, with two frames and one."""
    wanted = ("sky blue", "bright blue", "dark green")
    for scene, stems in (("kitchen", ("0000", "0008")), ("hall", ("0000",))):
        for stem in stems:
            instance = workspace / "room" / "instance" / f"{stem}.png"
            write_polygons(workspace / "two" / scene, instance, room.names, wanted)
    words = {**{name: name for name in wanted}, **dict.fromkeys(BACKGROUND_WORDS, "cream")}
    config, output = workspace / "outputs" / "room" / "normlift" / "t" / "config.yml", workspace / "two.json"
    labels = (workspace / "two" / "kitchen", workspace / "two" / "hall")
    flags = ("--protocol", "lerf", "--load-config", config, config, "--labels", *labels, "--output-path", output)
    flags += ("--text-vectors", stand_ins(workspace / "words.npz", words), "--study", "signals")
    assert run_entry(monkeypatch, evaluate.entrypoint, *flags) == 0
    document = json.loads(output.read_text())
    kitchen, hall = document["scenes"]
    assert (kitchen["scene"], kitchen["frames"], hall["scene"], hall["frames"]) == ("kitchen", 2, "hall", 1)
    results = document["results"]
    assert results["miou"] == pytest.approx((kitchen["miou"] + hall["miou"]) / 2)
    assert results["miou_pooled"] == pytest.approx((2 * kitchen["miou"] + hall["miou"]) / 3)
    assert kitchen["miou"] != hall["miou"]
    assert [row["scene"] for row in document["studies"]["signals"]] == ["kitchen", "hall", "all scenes"]
    assert "kitchen" in said(capsys)


@pytest.mark.parametrize(
    ("flags", "message"),
    [
        (("--protocol", "masks"), "none, given with --labels, does not exist"),
        (("--protocol", "lerf"), "none, given with --labels, does not exist"),
        (("--protocol", "scannet"), "none, given with --labels, does not exist"),
    ],
)
def test_missing_files_are_named(workspace, monkeypatch, capsys, flags, message):
    config = workspace / "outputs" / "room" / "normlift" / "t" / "config.yml"
    (workspace / "labels.json").write_text('{"1": "red"}')
    given = ("--load-config", config, "--labels", workspace / "none", "--output-path", workspace / "no.json")
    assert run_entry(monkeypatch, evaluate.entrypoint, *given, *flags) == 1
    assert message in said(capsys)
    assert not (workspace / "no.json").exists()
    assert torch.is_grad_enabled()
