"""ns-normlift-eval on a lifted demo room: its protocols as a user types them, with stand-in vectors and labels."""

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from PIL import Image

from normlift_ns.cli import evaluate
from normlift_ns.encoders.color import ColorEncoder
from normlift_ns.evaluation import studies
from normlift_ns.evaluation.baselines import BASELINES
from normlift_ns.evaluation.options import Evaluation
from normlift_ns.evaluation.published import compare_with_paper
from normlift_ns.options import BACKGROUND_WORDS, CANONICAL_NEGATIVES
from tests.cli.conftest import run_entry, said

pytestmark = pytest.mark.slow


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
    assert "next.json" in said(capsys)


def test_masks_of_a_capture_with_studies(scored, little_lifted, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(studies, "SWEEPS", {"beta": (0.5,), "k": (6, 12), "delta": (0.0, 0.1)})
    flags = ("--study", "ablation", "sweeps", "signals", "timing", "baselines")
    labels = little_lifted.parents[4] / "room" / "instance"
    document = scored("masks", labels, *flags)
    results, tables = document["results"], document["studies"]
    told = said(capsys)
    assert all(word in told for word in ("miou_3d", "spearman_bins", "drsplat", "Splat Feature Solver"))
    assert ("GPU" in told) != torch.cuda.is_available()
    assert (document["experiment_name"], document["method_name"]) == ("room", "normlift")
    assert results["miou_3d"] > 0.5 and results["miou_2d"] > 0.4
    assert 0.5 < results["gaussians_with_truth_share"] < 1
    assert len(document["rows"]) == 13 and document["settings"]["held_out_views"] == 2
    plain = scored("masks", labels, "--refined", False)["results"]
    assert plain["miou_3d"] != results["miou_3d"]

    assert list(tables) == ["ablation", "sweeps", "signals", "timing", "baselines"]
    by_variant = {row["variant"]: row["miou_3d"] for row in tables["ablation"]}
    ours = by_variant["consensus_posterior"]  # the defaults, here from stored u
    assert ours == pytest.approx(results["miou_3d"], abs=5e-3)
    assert by_variant["consensus"] == plain["miou_3d"] and len(set(by_variant.values())) > 3
    own = [(row["parameter"], row["miou_3d"]) for row in tables["sweeps"] if row["own"]]
    assert own == [(name, ours) for name in ("beta", "k", "delta")]
    (signals,) = tables["signals"]
    assert signals["zero.share"] == pytest.approx(results["zero_evidence_share"])
    assert signals["seen.accuracy_refined"] == pytest.approx(results["accuracy_3d"], abs=1e-6)
    assert signals["reliability.spearman_bins"] > 0.5
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


WANTED = ("sky blue", "bright blue", "dark green")


def write_polygons(folder: Path, instance: Path, names: tuple[str, ...]) -> None:
    values = np.array(Image.open(instance))
    objects = []
    for name in WANTED:
        mask = (values == names.index(name) + 1).astype(np.uint8)
        outlines, _ = cv2.findContours(mask, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
        objects += [{"category": name, "segmentation": o[:, 0].tolist()} for o in outlines if len(o) > 8]
    folder.mkdir(parents=True, exist_ok=True)
    info = {"name": instance.name, "width": values.shape[1], "height": values.shape[0]}
    (folder / f"{instance.stem}.json").write_text(json.dumps({"info": info, "objects": objects}))


def test_lerf_with_stand_in_words(scored, little_lifted, little_room, tmp_path, capsys):
    labels, hall = tmp_path / "label" / "ramen", tmp_path / "label" / "hall"
    for folder, stem in ((labels, "0000"), (labels, "0006"), (hall, "0000")):  # 0006 is held out
        instance = little_lifted.parents[4] / "room" / "instance" / f"{stem}.png"
        write_polygons(folder, instance, little_room.names)
    (labels / "0099.json").write_text((labels / "0000.json").read_text())
    words = {**{name: name for name in WANTED}, **dict.fromkeys(BACKGROUND_WORDS, "cream")}
    words |= {"floor": "light brown", "object": "chocolate brown", "things": "grey"}
    assert set(CANONICAL_NEGATIVES) <= set(words)
    np.savez(tmp_path / "words.npz", **dict(zip(words, ColorEncoder().text(list(words.values())).numpy())))
    vectors = ("--text-embeddings", tmp_path / "words.npz")
    found = {
        rule: scored("lerf", labels, "--masking", rule, *vectors)
        for rule in ("background", "langsplat", "langsplat_composited", "auto")
    }
    results = found["background"]["results"]
    assert results["loc_acc"] > 0.6 and results["miou"] > 0.3
    assert results["miou_pooled"] == results["miou"] == found["background"]["scenes"][0]["miou"]
    assert found["langsplat"]["results"] != found["langsplat_composited"]["results"]
    assert found["background"]["settings"]["labels_without_image"] == ["ramen/0099"]
    assert {row["frame"] for row in found["auto"]["rows"]} <= {"ramen/0000", "ramen/0006"}
    assert scored("lerf", labels, "--clean", True, *vectors)["results"]["miou"] != results["miou"]

    said(capsys)  # one run under two names, averaged, pooled, and compared with the paper
    two = ("--load-config", little_lifted, little_lifted, "--labels", labels, hall)
    document = scored("lerf", labels, *two, "--compare", "paper", "--study", "signals", "timing", *vectors)
    first, second = document["scenes"]
    assert (first["scene"], first["frames"], second["scene"], second["frames"]) == ("ramen", 2, "hall", 1)
    assert document["results"]["miou"] == pytest.approx((first["miou"] + second["miou"]) / 2)
    assert first["miou"] != second["miou"]
    signals = document["studies"]["signals"]
    assert [row["scene"] for row in signals] == ["ramen", "hall", "all scenes"] and "opacity.spearman" in signals[0]
    assert "all.accuracy_refined" not in signals[0]  # nothing tells the class of a Gaussian
    fifth, _ = document["comparison"].values()
    own = {(row["scene"], row["metric"]): row["yours"] for row in fifth}
    assert (own["ramen", "miou"], own["mean", "miou"]) == (first["miou"], document["results"]["miou"])
    assert own["teatime", "miou"] is None and len(fifth) == 15
    stages = {"evidence_s": 1, "consensus_s": 2, "lift_s": 4, "neighbors_s": 8, "vote_s": 16}
    timing = {"timing": [{"scene": "ramen", **stages}]}
    (third,) = compare_with_paper(Evaluation({}, [], {"protocol": "lerf"}), timing).values()
    assert [row["yours"] for row in third if row["scene"] == "ramen"] == [7, 24]
    assert "hall" in said(capsys) and torch.is_grad_enabled()
