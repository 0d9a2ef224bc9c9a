"""The commands on a small demo room, as a user types them: results, files, messages and exit codes."""

import functools
import json
import shutil
from datetime import datetime
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
import yaml
from PIL import Image

from normlift_ns import evidence_collection, open_run, open_scene
from normlift_ns.cli import evaluate, export, lift, query
from normlift_ns.core.metrics import class_scores, confusion
from normlift_ns.data.splat import SplatParameters
from normlift_ns.demo.room import DemoRoom
from normlift_ns.encoders.color import ColorEncoder
from normlift_ns.query.question import load_query
from normlift_ns.segmentation.sam import MaskRules, SamMasks
from tests.cli.conftest import QUICK, SMALL, run_entry, said
from tests.data.scene_files import ply_columns, write_ply

TWO = ("--max-views", "2", "--refine", "False")


def field_of(outputs: Path, name: str) -> Any:
    """Of a lifted run in the folder that --output-dir names."""
    return open_run(outputs / "room" / "normlift" / name / "config.yml").field


def test_lifting_writes_a_run_that_finds_the_colours(lifted: Path, room: DemoRoom):
    run = open_run(lifted)
    field, vectors = run.field, run.texts.text(room.names)
    found = [field.query(vectors, refined=refined).argmax(1) for refined in (False, True)]
    before, after = (class_scores(confusion(room.labels, classes, len(room.names))).miou for classes in found)
    assert after > 0.7 and after > before
    assert field.manifest["encoder"]["encoder"] == "colour"
    assert field.manifest["statistics"]["views"] == 12
    question = load_query(lifted.parent / "normlift")
    assert question is not None and question.texts == ("red", "yellow")
    assert sorted(p.name for p in lifted.parent.iterdir()) == [
        "config.yml", "dataparser_transforms.json", "nerfstudio_models", "normlift",
    ]  # fmt: skip


def test_querying_prints_a_table_and_writes_files(lifted, tmp_path, monkeypatch, capsys):
    outputs = ("--output-json", tmp_path / "a.json", "--output-npz", tmp_path / "a.npz")
    outputs += ("--render-dir", tmp_path / "pictures")
    flags = ("--load-config", lifted, *outputs, "--render-views", "0003", "0007", "--text", "red", "sky blue")
    for overwrite in ("False", "True"):
        assert run_entry(monkeypatch, query.entrypoint, *flags, "--overwrite", overwrite) == 0
    shown = capsys.readouterr().out
    assert "sky blue" in shown and "reliability" in shown and str(tmp_path / "pictures") in shown
    document = json.loads((tmp_path / "a.json").read_text())
    red, blue = document["queries"]
    assert {"text", "fraction", "centroid", "peak", "mean_reliability"} <= set(red)
    assert 0.005 < red["fraction"] < 0.1 and red["peak"] > 0.9 and 0.3 < red["mean_reliability"] < 1
    run = open_scene(lifted)
    scores = np.load(tmp_path / "a.npz")
    assert scores["relevancy"].shape == (len(run.gaussians), 2)
    assert scores["names"].tolist() == ["red", "sky blue"] and scores["valid"].dtype == bool
    chosen = (scores["relevancy"][:, 0] > document["threshold"]) & scores["valid"]
    assert chosen.mean() == pytest.approx(red["fraction"])
    assert np.allclose(red["centroid"], np.average(run.gaussians.means[chosen], axis=0), atol=0.1)
    assert blue["extent"][0] > red["extent"][0]

    pictures = sorted((tmp_path / "pictures").iterdir())
    assert [path.name for path in pictures] == [
        "0003_0_red.png", "0003_1_sky_blue.png", "0007_0_red.png", "0007_1_sky_blue.png",
        "contact_sheet_0_red.png", "contact_sheet_1_sky_blue.png",
    ]  # fmt: skip
    for path in pictures:
        pixels = np.asarray(Image.open(path).convert("RGB")).astype(int)
        assert (np.ptp(pixels, axis=2) > 60).mean() > 0.001, path  # something is coloured, over a grey image
    unknown = ("--text", "red", "--render-views", "9999", "--render-dir", tmp_path / "new", "--output-json")
    assert run_entry(monkeypatch, query.entrypoint, *flags[:2], *unknown, tmp_path / "b.json") == 1
    shown = said(capsys)
    assert all(word in shown for word in ("'9999'", "12", "'0000'", "'0011'"))
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a.json", "a.npz", "pictures"]


def test_queries_are_stored_and_replaced(lifted, tmp_path, monkeypatch) -> None:
    copy = tmp_path / "outputs" / "room" / "normlift" / "one" / "config.yml"
    shutil.copytree(lifted.parent, copy.parent)
    flags = ("--load-config", copy, "--data", lifted.parents[4] / "room", "--save-query", "True")
    rule = ("--threshold", "0.7", "--min-reliability", "0.25", "--refined", "False")
    assert run_entry(monkeypatch, query.entrypoint, *flags, "--text", "teal", "pink", "orange", *rule) == 0
    stored = load_query(copy.parent / "normlift")
    assert stored is not None and stored.texts == ("teal", "pink", "orange")
    assert (stored.threshold, stored.min_reliability, stored.refined) == (0.7, 0.25, False)
    before = (copy.parent / "normlift" / "queries.safetensors").read_bytes()
    assert run_entry(monkeypatch, query.entrypoint, *flags, "--text", "oragne") == 1
    assert (copy.parent / "normlift" / "queries.safetensors").read_bytes() == before
    assert run_entry(monkeypatch, query.entrypoint, *flags[:-2], "--text", "red") == 0
    assert (copy.parent / "normlift" / "queries.safetensors").read_bytes() == before


def test_lifts_without_a_name_at_the_same_second_both_remain(little, tmp_path, monkeypatch):
    clock = SimpleNamespace(now=lambda: datetime(2024, 5, 1, 12))
    monkeypatch.setattr("normlift_ns.io.run_dir.datetime", clock)
    flags = ("--load-config", little, *QUICK, *TWO, "--output-dir", tmp_path)
    names = ["2024-05-01_120000", "2024-05-01_120000_2"]
    for overwrite in ("False", "True"):
        assert run_entry(monkeypatch, lift.entrypoint, *flags, "--overwrite", overwrite) == 0
    assert sorted(path.name for path in (tmp_path / "room" / "normlift").iterdir()) == [".cache", *names]
    assert [len(field_of(tmp_path, name)) > 0 for name in names] == [True, True]


def test_an_interrupted_lift_leaves_nothing_half_written_and_resumes(little, monkeypatch, tmp_path, capsys):
    monkeypatch.setattr("normlift_ns.evidence_collection._MAX_CHUNK", 2)
    rasterize, calls = evidence_collection.batch_evidence, []

    def interrupted(*args, **kwargs):
        calls.append(1)
        if len(calls) == 3:
            raise KeyboardInterrupt
        return rasterize(*args, **kwargs)

    flags = ("--load-config", little, *QUICK, "--refine", "False", "--output-dir", tmp_path / "out", "--timestamp", "t")
    monkeypatch.setattr(evidence_collection, "batch_evidence", interrupted)
    assert run_entry(monkeypatch, lift.entrypoint, *flags) == 130
    assert "rerun the command" in capsys.readouterr().err
    written = [p for p in (tmp_path / "out").rglob("*") if p.is_file()]
    assert {p.suffix for p in written} == {".safetensors"} and all(".cache" in p.parts for p in written)
    fresh: list[Any] = []
    evidence, save = evidence_collection.Evidence, evidence_collection.Evidence.save
    monkeypatch.setattr(evidence, "save", lambda self, *a, **how: (fresh.append(a), save(self, *a, **how))[1])
    assert run_entry(monkeypatch, lift.entrypoint, *flags) == 0
    assert len(fresh) == 1  # of three blocks, two were kept


@pytest.fixture(scope="module")
def clip(tmp_path_factory) -> tuple[object, ...]:
    from tests.encoders.tiny import CLIP, write_clip  # noqa: PLC0415

    folder = tmp_path_factory.mktemp("clip")
    write_clip(folder)
    return ("--encoder-model", CLIP, "--encoder-pretrained", folder / "tiny.pt", *TWO, "--check-alignment", "False")


@pytest.mark.slow
def test_clip_by_patches_and_questions_by_a_template(little, clip, tmp_path, monkeypatch, capsys):
    flags = ("--load-config", little, *clip, "--output-dir", tmp_path, "--timestamp", "t")
    assert run_entry(monkeypatch, lift.entrypoint, *flags) == 0
    config = tmp_path / "room" / "normlift" / "t" / "config.yml"
    manifest = open_run(config).field.manifest
    assert (manifest["features"]["kind"], manifest["encoder"]["text_template"]) == ("patches", "{}")
    ask = ("--load-config", config, "--text", "table", "--output-json")
    assert run_entry(monkeypatch, query.entrypoint, *ask, tmp_path / "1.json") == 0
    assert run_entry(monkeypatch, query.entrypoint, *ask, tmp_path / "2.json", "--prompt-template", "ensemble") == 0
    plain, ensemble = (json.loads((tmp_path / f"{i}.json").read_text())["queries"][0] for i in (1, 2))
    assert ensemble["peak"] != plain["peak"]


def test_levels_of_sam(little, clip, tmp_path, monkeypatch, capsys):
    """All levels are found at once, so that another one asks SAM and the rasterizer nothing."""
    from tests.encoders.tiny import write_sam  # noqa: PLC0415

    write_sam(tmp_path / "sam.pth", seed=1, gain=6)
    rules = MaskRules(points_per_side=4, predicted_iou=0.5, stability=0.3)
    monkeypatch.setattr("normlift_ns.segmentation.sam.SamMasks", functools.partial(SamMasks, rules=rules))
    flags = ("--load-config", little, *clip, "--sam-model", tmp_path / "sam.pth", "--output-dir", tmp_path)
    shares = []
    for level in ("l", "s"):
        more = () if level == "l" else ("--level", level)
        assert run_entry(monkeypatch, lift.entrypoint, *flags, *more, "--timestamp", level) == 0
        field = field_of(tmp_path, level)
        assert field.manifest["features"]["regions"]["kind"] == "sam"
        assert field.manifest["features"]["levels"] == [{"l": 3, "s": 1}[level]]
        shares.append(field.manifest["statistics"]["zero_evidence_share"])
        monkeypatch.setattr("normlift_ns.evidence_collection.rasterize_evidence", None)
        monkeypatch.setattr("normlift_ns.segmentation.sam.SamNetwork", None)
    assert shares[0] != shares[1] and max(shares) < 1


def test_fewer_smaller_and_rendered_views(little, tmp_path, monkeypatch):
    flags = ("--max-views", "5", "--lift-downscale", "2", "--image-source", "render", "--timestamp", "less")
    given = ("--load-config", little, *QUICK, "--refine", "False", "--output-dir", tmp_path)
    assert run_entry(monkeypatch, lift.entrypoint, *given, *flags) == 0
    found = field_of(tmp_path, "less").manifest["statistics"]
    assert found["views"] == 5 and 0 < found["zero_evidence_share"] < 0.5


@pytest.mark.slow
def test_features_written_in_langsplats_format_lift_to_the_same_field(little, tmp_path, monkeypatch):
    """Export, then import with text vectors from a file: nothing is rasterized, every number is the same."""
    output = ("--load-config", little, "--vote-k", 12, "--consensus-min-agreement", 0.4, "--output-dir", tmp_path)
    exporting = ("--encoder", "color", "--export-langsplat", tmp_path / "features", "--timestamp", "ours")
    assert run_entry(monkeypatch, lift.entrypoint, *output, *exporting) == 0
    assert len(list((tmp_path / "features").iterdir())) == 2 * 6
    texts = ("red", "sky blue")
    np.savez(tmp_path / "texts.npz", **dict(zip(texts, ColorEncoder().text(texts).numpy())))

    monkeypatch.setattr("normlift_ns.evidence_collection.rasterize_evidence", None)
    importing = ("--features", "langsplat", "--features-dir", tmp_path / "features")
    vectors = ("--text-embeddings", tmp_path / "texts.npz")
    flags = (*output, *importing, *vectors, "--timestamp", "theirs", "--queries", "red")
    assert run_entry(monkeypatch, lift.entrypoint, *flags) == 0
    first, second = (field_of(tmp_path, name) for name in ("ours", "theirs"))
    for name in ("norm", "c_intra", "c_inter", "n_eff", "reliability", "weight"):
        assert torch.equal(getattr(first.scalars, name), getattr(second.scalars, name)), name
    assert torch.equal(first.source, second.source)
    assert torch.equal(first.directions(), second.directions())


@pytest.mark.slow
def test_double_precision_differs_from_the_default_by_rounding(little, tmp_path, monkeypatch):
    for precision in ("standard", "double"):
        flags = ("--precision", precision, "--output-dir", tmp_path, "--timestamp", precision)
        assert run_entry(monkeypatch, lift.entrypoint, "--load-config", little, *QUICK, *flags) == 0
    double, single = field_of(tmp_path, "double"), field_of(tmp_path, "standard")
    difference = (double.scalars.reliability - single.scalars.reliability).abs()
    assert 0 < float(difference.quantile(0.99)) < 1e-6
    assert float(difference.max()) < 1e-2  # where a pixel of a faint Gaussian is on the other side of alpha = 1 / 255
    assert (double.source != single.source).float().mean() < 0.01


def test_a_splat_of_no_run_is_lifted_asked_exported_evaluated_and_drawn(
    nerfstudio, little, tmp_path, monkeypatch, capsys
) -> None:
    """The config names cameras that nerfstudio leaves as they are."""
    from nerfstudio.scripts.render import DatasetRender  # noqa: PLC0415

    from normlift_ns.method_configs.normlift import normlift_method  # noqa: PLC0415

    monkeypatch.chdir(tmp_path)
    ply = write_ply(tmp_path / "scene.ply", ply_columns(SplatParameters(**open_scene(little).parameters)))
    room, world = little.parents[4] / "room", little.parent / "dataparser_transforms.json"
    cameras = ("--transforms", room / "transforms.json", "--world-transform", world)
    flags = ("--load-ply", ply, *cameras, *SMALL, "--timestamp", "a", "--queries", "red", "yellow")
    assert run_entry(monkeypatch, lift.entrypoint, *flags) == 0
    printed = said(capsys)
    run_dir = tmp_path / "outputs" / "room" / "normlift" / "a"
    assert "2 of 8 images" in printed and "--gsplat-version" in printed and str(run_dir) in printed
    found = open_run(run_dir / "config.yml").ask_stored()
    assert found is not None and found["red"].peak > 0.8
    asked = ("--load-config", run_dir / "config.yml")
    assert run_entry(monkeypatch, query.entrypoint, *asked, "--text", "red") == 0
    assert run_entry(monkeypatch, export.entrypoint, *asked, "--output-dir", tmp_path / "e") == 0
    flags = ("--protocol", "masks", "--labels", room / "instance", "--output-path", tmp_path / "scores.json")
    assert run_entry(monkeypatch, evaluate.entrypoint, *asked, *flags) == 0
    assert json.loads((tmp_path / "scores.json").read_text())
    parser = yaml.unsafe_load((run_dir / "config.yml").read_text()).pipeline.datamanager.dataparser
    assert (parser.orientation_method, parser.center_method, parser.eval_mode) == ("none", "none", "all")
    assert (parser.auto_scale_poses, parser.load_3D_points, parser.downscale_factor) == (False, False, 1)
    ply.unlink()  # the run does not need it
    monkeypatch.chdir("/")
    monkeypatch.setitem(nerfstudio.all_methods, "normlift", normlift_method.config)
    how: Any = {"rendered_output_names": ["rgb", "relevancy_0"], "split": "test", "image_format": "png"}
    DatasetRender(asked[1], output_path=tmp_path, **how).main()
    files = (tmp_path / "test" / "rgb" / "0006.png", room / "images" / "0006.png")
    drawn, photo = (np.asarray(Image.open(file).convert("RGB")).astype(float) for file in files)
    assert np.abs(drawn - photo).mean() < 3
