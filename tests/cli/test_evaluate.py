"""ns-normlift-eval on a lifted demo room: its protocols as a user types them, with stand-in vectors and labels."""

import json
from pathlib import Path
from typing import get_args

import cv2
import numpy as np
import pytest
import torch
from PIL import Image
from plyfile import PlyData, PlyElement

from normlift_ns.cli import evaluate
from normlift_ns.encoders.color import ColorEncoder
from normlift_ns.evaluation import studies
from normlift_ns.evaluation.baselines import BASELINES
from normlift_ns.evaluation.scannet import NYU40
from normlift_ns.evaluation.studies import Variant
from normlift_ns.options import BACKGROUND_WORDS, CANONICAL_NEGATIVES
from tests.cli.conftest import run_entry, said

pytestmark = pytest.mark.slow


@pytest.fixture
def capture(little_lifted: Path) -> Path:
    return little_lifted.parents[4] / "room"


@pytest.fixture
def scored(little_lifted: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):

    def score(protocol: str, labels: Path, *flags: object) -> dict:
        given = ("--protocol", protocol, "--load-config", little_lifted, "--labels", labels, "--overwrite", True)
        assert run_entry(monkeypatch, evaluate.entrypoint, *given, "--output-path", tmp_path / "s.json", *flags) == 0
        return json.loads((tmp_path / "s.json").read_text())

    return score


def test_coverage_needs_no_truth(little_lifted, tmp_path, monkeypatch, capsys):
    flags = ("--load-config", little_lifted, "--study", "coverage", "--output-path", tmp_path / "next.json")
    assert run_entry(monkeypatch, evaluate.entrypoint, *flags) == 0
    document = json.loads((tmp_path / "next.json").read_text())
    assert document["results"] == {}
    (found,) = document["studies"]["coverage"]
    assert found["left_out"] == {"held out": 2}
    assert {photograph["why"] for photograph in found["photographs"]} == {"held out"}
    assert 0 < found["reliability"] < 1
    pictures = {f"next_coverage_pose_{i}.png" for i in range(1, len(found["poses"]) + 1)}
    path = {"next_coverage_camera_path.json"} if len(pictures) > 0 else set()
    assert {path.name for path in tmp_path.iterdir()} == {"next.json"} | pictures | path
    shown = said(capsys)
    assert "photographs" in shown and "next.json" in shown


def stand_ins(path: Path, words: dict[str, str]) -> Path:
    """Vectors of words, each that of a colour."""
    vectors = ColorEncoder().text(list(words.values())).numpy()
    np.savez(path, **dict(zip(words, vectors)))
    return path


def test_masks_of_a_capture_with_studies(scored, capture, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(studies, "SWEEPS", {"beta": (0.5,), "k": (6, 12), "delta": (0.0, 0.1)})
    flags = ("--study", "ablation", "sweeps", "signals", "timing", "baselines")
    document = scored("masks", capture / "instance", *flags)
    results, tables = document["results"], document["studies"]
    told = said(capsys)
    assert all(word in told for word in ("miou_3d", "spearman_bins", "drsplat", "Splat Feature Solver"))
    assert ("GPU" in told) != torch.cuda.is_available()
    assert (document["experiment_name"], document["method_name"]) == ("room", "normlift")
    assert results["miou_3d"] > 0.5 and results["miou_2d"] > 0.4
    assert 0.5 < results["gaussians_with_truth_share"] < 1
    assert len(document["rows"]) == 13 and document["settings"]["held_out_views"] == 2
    plain = scored("masks", capture / "instance", "--refined", False)["results"]
    assert plain["miou_3d"] != results["miou_3d"]

    assert list(tables) == ["ablation", "sweeps", "signals", "timing", "baselines"]
    by_variant = {row["variant"]: row["miou_3d"] for row in tables["ablation"]}
    assert list(by_variant) == [*get_args(Variant), *studies.CONSENSUS_VARIANTS]
    ours = by_variant["consensus_posterior"]  # the defaults, here from stored u
    assert ours == pytest.approx(results["miou_3d"], abs=5e-3)
    assert by_variant["consensus"] == plain["miou_3d"] and len(set(by_variant.values())) > 3
    own = [(row["parameter"], row["miou_3d"]) for row in tables["sweeps"] if row["own"]]
    assert own == [(name, ours) for name in ("beta", "k", "delta")]
    (signals,) = tables["signals"]
    assert signals["zero.share"] == pytest.approx(results["zero_evidence_share"])
    assert signals["zero.accuracy_unrefined"] is None  # no mask tells the class of what nobody sees
    assert signals["zero.accuracy_refined"] is None
    assert signals["seen.accuracy_refined"] == pytest.approx(results["accuracy_3d"], abs=1e-6)
    assert 0 <= signals["opacity.kendall_p"] <= 1 and signals["reliability.spearman_bins"] > 0.5
    (cost,) = tables["timing"]
    stages = ("features_s", "evidence_s", "consensus_s", "recognition_s", "lift_s", "neighbors_s", "vote_s", "store_s")
    assert cost["vote_s"] > 0 and cost["store_s"] > 0
    assert cost["total_s"] == pytest.approx(sum(cost[stage] for stage in stages))
    assert {p.name for p in tmp_path.glob("*.svg")} == {"s_sweeps.svg", "s_signals.svg"}

    rows = {row["method"]: row for row in tables["baselines"]}
    assert list(rows) == ["normlift", "unrefined", "sfs", "occam", "vala", "drsplat"]
    assert rows["normlift"]["miou_3d"] == results["miou_3d"]
    assert [rows[name]["what"] for name in BASELINES] == list(BASELINES.values())
    assert len({(row["miou_3d"], row["miou_2d"]) for row in rows.values()}) == 6
    assert min(row["miou_3d"] for row in rows.values()) > 0.2


def test_scannet_with_stand_in_names(scored, little_room, tmp_path):
    ids = list(NYU40)[: len(little_room.names)]
    vertices = np.zeros(len(little_room.labels), dtype=[("x", "f4"), ("y", "f4"), ("z", "f4"), ("label", "u2")])
    vertices["label"] = [ids[label] if label >= 0 else 0 for label in little_room.labels.tolist()]
    path = tmp_path / "scene0000_00_vh_clean_2.labels.ply"
    PlyData([PlyElement.describe(vertices, "vertex")]).write(str(path))
    colours = [*little_room.names, *["black", "white", "grey", "beige", "magenta", "lime"]]
    names = [*NYU40.values(), "shower curtain"]
    vectors = ("--text-embeddings", stand_ins(tmp_path / "names.npz", dict(zip(names, [*colours, "cyan"]))))
    document = scored("scannet", path, "--study", "signals", "ablation", *vectors)
    results, settings, studies = (document[name] for name in ("results", "settings", "studies"))
    assert settings["scenes"] == ["scene0000_00"] and len(settings["missing_scenes"]) == 9
    assert results["miou_19"] > 0.5 and results["miou_10"] >= results["miou_19"] - 0.2
    assert {row["class"] for row in document["rows"] if row["classes"] == 19} == {NYU40[i] for i in ids}
    assert studies["signals"][0]["scene"] == "scene0000_00"
    assert 0.5 < studies["signals"][0]["seen.accuracy_unrefined"] < 1
    assert studies["ablation"][-1]["variant"] == "consensus_posterior"
    assert studies["ablation"][-1]["miou_19"] == pytest.approx(results["miou_19"], abs=5e-3)
    spelled = scored("scannet", path, "--spelling", "paper", *vectors)
    assert [settings["spelling"], spelled["settings"]["spelling"]] == ["script", "paper"]
    assert spelled["results"]["miou_19"] > results["miou_19"] - 0.2  # that name is found too


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


WANTED = ("sky blue", "bright blue", "dark green")


def test_lerf_with_stand_in_words(scored, little_lifted, little_room, capture, tmp_path, monkeypatch, capsys):
    labels = tmp_path / "label" / "room"
    for stem in ("0000", "0006"):  # a training view and a held-out one
        write_polygons(labels, capture / "instance" / f"{stem}.png", little_room.names, WANTED)
    (labels / "0099.json").write_text((labels / "0000.json").read_text())
    words = {**{name: name for name in WANTED}, **dict.fromkeys(BACKGROUND_WORDS, "cream")}
    words |= {"floor": "light brown", "object": "chocolate brown", "things": "grey"}
    assert set(CANONICAL_NEGATIVES) <= set(words)
    vectors = ("--text-embeddings", stand_ins(tmp_path / "words.npz", words))
    found = {
        rule: scored("lerf", labels, "--masking", rule, *vectors, *(("--study", "signals") if rule == "auto" else ()))
        for rule in ("background", "langsplat", "langsplat_composited", "auto")
    }
    results = found["background"]["results"]
    assert results["loc_acc"] > 0.6 and results["miou"] > 0.3
    assert results["miou_pooled"] == results["miou"] == found["background"]["scenes"][0]["miou"]
    assert found["langsplat"]["results"] != found["langsplat_composited"]["results"]
    assert found["background"]["settings"]["labels_without_image"] == ["room/0099"]
    assert {row["frame"] for row in found["auto"]["rows"]} <= {"room/0000", "room/0006"}
    (signals,) = found["auto"]["studies"]["signals"]
    assert "opacity.spearman" in signals
    assert "all.accuracy_refined" not in signals  # nothing tells the class of a Gaussian
    assert scored("lerf", labels, "--clean", True, *vectors)["results"]["miou"] != results["miou"]

    hall, output = tmp_path / "label" / "hall", tmp_path / "two.json"  # one run under two names, averaged and pooled
    write_polygons(hall, capture / "instance" / "0000.png", little_room.names, WANTED)
    flags = ("--protocol", "lerf", "--load-config", little_lifted, little_lifted, "--labels", labels, hall)
    flags += ("--output-path", output, "--study", "signals", *vectors)
    said(capsys)
    assert run_entry(monkeypatch, evaluate.entrypoint, *flags) == 0
    document = json.loads(output.read_text())
    room, hall = document["scenes"]
    assert (room["scene"], room["frames"], hall["scene"], hall["frames"]) == ("room", 2, "hall", 1)
    assert document["results"]["miou"] == pytest.approx((room["miou"] + hall["miou"]) / 2)
    assert room["miou"] != hall["miou"]
    assert [row["scene"] for row in document["studies"]["signals"]] == ["room", "hall", "all scenes"]
    assert "hall" in said(capsys) and torch.is_grad_enabled()
