"""The commands on a small demo room, as a user types them: results, files, messages and exit codes."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from normlift_ns.demo import DemoRoom
from normlift_ns.plugin import lifting
from normlift_ns.plugin.adapters import load_run
from normlift_ns.plugin.asking import ask, encoder_of
from normlift_ns.plugin.queries import load_question
from normlift_ns.plugin.run_dir import load_field
from normlift_ns.scripts import lift, query
from normlift_ns.scripts.demo import iou_per_class
from tests.scripts.conftest import SMALL, run_entry


def test_lifting_writes_a_run_that_finds_the_colours(lifted: Path, room: DemoRoom):
    run = load_run(lifted)
    field = load_field(run)
    answer = encoder_of(field).text(room.names)
    before, after = (
        float(iou_per_class(field.query(answer, refined=refined).argmax(1), room.labels, len(room.names)).mean())
        for refined in (False, True)
    )
    print(f"mIoU {before:.3f} before, {after:.3f} after refinement")
    assert after > 0.7
    assert field.manifest["encoder"]["encoder"] == "colour"
    assert field.manifest["statistics"]["views"] == 12
    question = load_question(lifted.parent / "normlift")
    assert question is not None
    assert question.texts == ("red", "yellow")
    assert sorted(p.name for p in lifted.parent.iterdir()) == [
        "config.yml", "dataparser_transforms.json", "nerfstudio_models", "normlift",
    ]  # fmt: skip


def test_querying_prints_a_table_and_writes_files(lifted, tmp_path, monkeypatch, capsys):
    outputs = (
        "--json",
        tmp_path / "a.json",
        "--output-path",
        tmp_path / "a.npz",
        "--render-dir",
        tmp_path / "pictures",
    )
    flags = ("--load-config", lifted, "--text", "red", "sky blue", *outputs, "--render-views", "0003", "0007")
    assert run_entry(monkeypatch, query.entrypoint, *flags) == 0
    shown = capsys.readouterr().out
    assert "sky blue" in shown
    assert "mean reliability" in shown

    document = json.loads((tmp_path / "a.json").read_text())
    red, blue = document["queries"]
    assert {"text", "fraction", "centroid", "peak", "mean_reliability"} <= set(red)
    assert 0.005 < red["fraction"] < 0.1
    assert red["peak"] > 0.9
    assert 0.3 < red["mean_reliability"] < 1
    run = load_run(lifted)
    scores = np.load(tmp_path / "a.npz")
    assert scores["relevancy"].shape == (len(run.scene), 2)
    assert scores["names"].tolist() == ["red", "sky blue"]
    assert scores["valid"].dtype == bool
    chosen = (scores["relevancy"][:, 0] > document["threshold"]) & scores["valid"]
    assert chosen.mean() == pytest.approx(red["fraction"])
    assert np.allclose(red["centroid"], np.average(run.scene.means[chosen], axis=0), atol=0.1)
    assert blue["extent"][0] > red["extent"][0]

    pictures = sorted((tmp_path / "pictures").iterdir())
    assert [path.name for path in pictures] == [
        "0003_0_red.png", "0003_1_sky_blue.png", "0007_0_red.png", "0007_1_sky_blue.png",
    ]  # fmt: skip
    for path in pictures:
        pixels = np.asarray(Image.open(path).convert("RGB")).astype(int)
        assert (np.ptp(pixels, axis=2) > 60).mean() > 0.001, path  # something is coloured, over a grey image


def test_a_second_lift_rasterizes_and_encodes_nothing(trained, monkeypatch, capsys):
    def never(*_args, **_kwargs):
        raise AssertionError("rasterized again")

    monkeypatch.setattr("normlift_ns.plugin.observe.rasterize_evidence", never)
    monkeypatch.setattr("normlift_ns.encoders.colour.ColourEncoder.encode", never)
    flags = ("--load-config", trained, *SMALL, "--timestamp", "two", "--beta", "2.0", "--refine", "False")
    assert run_entry(monkeypatch, lift.entrypoint, *flags) == 0
    first, second = (load_field(load_run(trained.parents[2] / "normlift" / t / "config.yml")) for t in ("one", "two"))
    assert torch.equal(first.scalars.norm, second.scalars.norm)
    assert (second.scalars.reliability <= first.scalars.reliability).all()
    assert torch.equal(second.source, torch.arange(len(second), dtype=torch.int32))


def test_an_interrupted_lift_leaves_nothing_half_written_and_resumes(trained, monkeypatch, tmp_path, capsys):
    monkeypatch.setattr(lifting, "BLOCK", 4)
    rasterize = lifting.block_evidence
    calls = []

    def interrupted(*args, **kwargs):
        calls.append(1)
        if len(calls) == 3:
            raise KeyboardInterrupt
        return rasterize(*args, **kwargs)

    flags = ("--load-config", trained, *SMALL, "--output-dir", tmp_path / "out", "--timestamp", "t")
    monkeypatch.setattr(lifting, "block_evidence", interrupted)
    assert run_entry(monkeypatch, lift.entrypoint, *flags) == 130
    assert "the same command goes on where it stopped" in capsys.readouterr().out
    written = [p for p in (tmp_path / "out").rglob("*") if p.is_file()]
    assert {p.suffix for p in written} == {".safetensors"}
    assert all(".cache" in p.parts for p in written)

    fresh = []
    monkeypatch.setattr(lifting, "block_evidence", rasterize)
    original = lifting.Evidence.save
    monkeypatch.setattr(lifting.Evidence, "save", lambda self, path: (fresh.append(path), original(self, path))[1])
    assert run_entry(monkeypatch, lift.entrypoint, *flags) == 0
    assert len(fresh) == 1  # of three blocks, two were kept


@pytest.mark.parametrize(
    ("flags", "message"),
    [
        (("--encoder", "words"), "invalid choice"),
        (("--encoder", "colour", "--queries", ""), "is empty"),
        (("--encoder", "colour", "--queries", "oragne"), "orange"),
        (("--encoder", "colour", "--max-views", "0"), "max_views must be at least 1, got 0"),
        (("--encoder", "colour", "--device", "tpu"), "--device must be auto, cpu or cuda"),
        (("--encoder", "colour", "--timestamp", "one"), "exists; give another --timestamp"),
        (("--encoder", "colour", "--regions", "files"), "--regions-dir"),
        (("--encoder", "colour", "--regions", "files", "--regions-dir", "nowhere"), "nowhere"),
        (("--encoder", "colour", "--data", "nowhere"), "nowhere"),
        (("--encoder", "open_clip", "--encoder-pretrained", "missing.pt"), "missing.pt"),
        (("--encoder", "colour", "--tau", "2"), "RefineConfig.tau must be in -1..1"),
    ],
)
def test_bad_flags_have_a_message_and_exit_code_1(flags, message, trained, lifted, monkeypatch, capsys):
    assert run_entry(monkeypatch, lift.entrypoint, "--load-config", trained, *flags) == 1
    shown = capsys.readouterr()
    assert message in " ".join((shown.out + shown.err).split())
    assert "Traceback" not in shown.out + shown.err


def test_label_maps_of_another_size_are_refused_or_resampled(trained, tmp_path, monkeypatch, capsys):
    folder = tmp_path / "labels"
    folder.mkdir()
    for path in (trained.parents[4] / "room" / "instance").iterdir():
        Image.open(path).resize((80, 60), Image.Resampling.NEAREST).save(folder / path.name)
    flags = ("--load-config", trained, *SMALL, "--regions", "files", "--regions-dir", folder, "--timestamp", "maps")
    assert run_entry(monkeypatch, lift.entrypoint, *flags) == 1
    shown = " ".join(capsys.readouterr().out.split())
    assert "80" in shown
    assert "160" in shown
    assert run_entry(monkeypatch, lift.entrypoint, *flags, "--regions-resample", "True") == 0


def test_fewer_smaller_and_rendered_views(trained, monkeypatch, capsys):
    flags = ("--max-views", "5", "--lift-downscale", "2", "--image-source", "render", "--timestamp", "less")
    assert run_entry(monkeypatch, lift.entrypoint, "--load-config", trained, *SMALL, *flags) == 0
    field = load_field(load_run(trained.parents[2] / "normlift" / "less" / "config.yml"))
    assert field.manifest["statistics"]["views"] == 5
    assert 0 < field.manifest["statistics"]["zero_evidence_share"] < 0.5


def test_pictures_of_an_unknown_view_are_refused(lifted, monkeypatch, capsys):
    flags = ("--load-config", lifted, "--text", "red", "--render-views", "9999")
    assert run_entry(monkeypatch, query.entrypoint, *flags) == 1
    shown = " ".join(capsys.readouterr().out.split())
    assert "no training image '9999'; there are 12, from '0000' to '0011'" in shown


def test_a_query_of_a_run_without_semantics_says_what_to_do(trained, monkeypatch, capsys):
    assert run_entry(monkeypatch, query.entrypoint, "--load-config", trained, "--text", "red") == 1
    assert "ns-normlift --load-config" in " ".join(capsys.readouterr().out.split())


def test_a_field_of_another_checkpoint_is_refused(lifted, tmp_path, monkeypatch, capsys):
    copy = tmp_path / "outputs" / "room" / "normlift" / "one"
    shutil.copytree(lifted.parent, copy)
    checkpoint = next((copy / "nerfstudio_models").iterdir())
    state = torch.load(checkpoint, weights_only=True)
    state["pipeline"]["_model.gauss_params.means"] += 1
    torch.save(state, checkpoint)
    data = lifted.parents[4] / "room"
    flags = ("--load-config", copy / "config.yml", "--text", "red", "--data", data)
    assert run_entry(monkeypatch, query.entrypoint, *flags) == 1
    assert "was lifted from other Gaussians" in " ".join(capsys.readouterr().out.split())


def test_selection_follows_threshold_and_reliability(lifted):
    run = load_run(lifted)
    field = load_field(run)
    encoder = encoder_of(field)
    loose, strict = (ask(field, encoder, ["red"], threshold=t).selected for t in (0.2, 0.8))
    assert int(loose.sum()) > int(strict.sum()) > 0
    assert not (strict & ~loose).any()
    sure = ask(field, encoder, ["red"], threshold=0.2, min_reliability=0.8).selected[:, 0]
    assert (field.scalars.reliability[sure] >= 0.8).all()
    assert 0 < int(sure.sum()) < int(loose.sum())
    lead = ask(field, encoder, ["red"], negatives=["orange", "brown"], form="margin")
    assert lead.threshold == 0.02
    assert (lead.relevancy[lead.selected] > 0.02).all()
