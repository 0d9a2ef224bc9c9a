"""The front door: a run lifted, opened, asked, drawn and exported from Python."""

import json
import shutil
import warnings
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from PIL import Image
from plyfile import PlyData

import normlift_ns as nl
from normlift_ns.cli import query
from normlift_ns.demo.room import DemoRoom
from normlift_ns.evaluation.protocols import EvaluatedRun
from normlift_ns.query.question import Query
from normlift_ns.rasterization import rasterize
from normlift_ns.rasterization.rasterize import RasterJob, choose_backend
from tests.cli.conftest import run_entry, said


@pytest.fixture(scope="module")
def run(lifted: Path) -> nl.LiftedRun:
    return nl.open_run(lifted)


@pytest.fixture(scope="module")
def scene(trained: Path) -> nl.Scene:
    return nl.open_scene(trained)


def test_vectors_are_asked_like_texts_and_arrays_come_out_as_numpy(run: nl.LiftedRun, lifted: Path) -> None:
    red = run.texts.rows(["red"])[0]
    by_text = run.ask("red", "yellow")
    for kind in (np.asarray(red), torch.as_tensor(red).half(), np.asarray(red).tolist()):
        answer = run.ask("yellow", vectors={"mine": kind})
        assert answer.texts == ("yellow", "mine")
        assert torch.allclose(answer["mine"].relevancy, by_text["red"].relevancy, atol=1e-3)
    arrays, finding = by_text.numpy(), by_text["red"].numpy()
    assert {type(x) for x in (*arrays.values(), *finding.values())} == {np.ndarray}
    assert np.array_equal(arrays["selected"][:, 0], finding["mask"]) and finding["mask"].any()
    assert np.array_equal(finding["reliability"], run.reliability.numpy())
    assert torch.equal(run.scalars.reliability, run.reliability)
    cosine = run.features.double() @ torch.as_tensor(np.asarray(red), dtype=torch.float64)
    assert torch.allclose(cosine, run.field.query(torch.as_tensor(red)[None])[:, 0].double(), atol=1e-3)
    assert np.array_equal(np.asarray(run.image("0003", by_text)), run.render("0003", by_text).numpy())
    assert len(nl.open_run(lifted.parent).field) == len(run.field)
    size = run.field.dimension
    for wrong, expected in ((np.ones(3), rf"shape \({size},\)"), (np.zeros(size), "not zero")):
        with pytest.raises(ValueError, match=rf"vectors\['x'\] .*{expected}"):
            run.ask(vectors={"x": wrong})


def test_an_answer_says_what_is_where(run: nl.LiftedRun, room: DemoRoom) -> None:
    answer = run.ask("red", "yellow", min_reliability=0.3)
    red, yellow = answer
    assert (red.text, yellow.text) == answer.texts == ("red", "yellow")
    assert torch.equal(answer["yellow"].mask, yellow.mask)
    assert torch.equal(answer.mask, red.mask | yellow.mask)
    assert (run.field.scalars.reliability[answer.mask] >= 0.3).all()
    lead = run.ask("red", negatives=["orange", "brown"], relevancy="margin")
    assert lead.question.threshold == 0.02 and (lead.relevancy[lead.selected] > 0.02).all()
    loose, sure = (run.ask("red", threshold=0.2, min_reliability=least).mask for least in (0.0, 0.8))
    assert 0 < int(sure.sum()) < int(loose.sum())
    assert (red.relevancy[red.mask] > 0.5).all()

    truth = room.labels == room.names.index("red")
    assert float(truth[red.mask].float().mean()) > 0.8
    means, weight = run.scene.gaussians.means[red.mask].double(), run.field.scalars.weight[red.mask].double()
    assert red.centroid == pytest.approx(((weight[:, None] * means).sum(0) / weight.sum()).tolist(), rel=1e-9)
    ball = red.objects[0]
    assert ball.size > 0.6 * int(truth.sum())
    assert np.allclose(ball.centroid, run.scene.gaussians.means[truth].mean(0), atol=0.05)
    assert np.all(np.array(ball.box["min"]) <= ball.centroid) and np.all(np.array(ball.centroid) <= ball.box["max"])
    with pytest.raises(KeyError, match=r"'blue' .* 'red', 'yellow'"):
        answer["blue"]
    nothing = run.ask("red", threshold=2.0)["red"]
    assert (nothing.fraction, nothing.centroid, nothing.extent, nothing.objects) == (0.0, None, None, [])
    assert nothing.mean_reliability is None
    assert nothing.peak is not None and nothing.peak > 0.5


def test_parts_are_exported(run: nl.LiftedRun, tmp_path: Path) -> None:
    answer = run.ask("red", "yellow")
    parts = {"red": answer["red"], "both": answer, "mask": answer["red"].mask, "all": None}
    rows = {name: run.export(tmp_path / f"{name}.ply", part) for name, part in parts.items()}
    assert np.array_equal(rows["red"], rows["mask"])
    assert set(rows["red"]) < set(rows["both"]) < set(rows["all"])
    assert set(rows["red"]) <= set(answer["red"].mask.nonzero().squeeze(1).tolist())
    columns = {name: set(PlyData.read(tmp_path / f"{name}.ply")["vertex"].data.dtype.names) for name in parts}
    assert "relevancy_1" in columns["red"] and "relevancy_1" in columns["both"]
    assert "relevancy_0" not in columns["mask"] | columns["all"]
    with pytest.raises(FileExistsError, match=r"red\.ply .*overwrite"):
        run.export(tmp_path / "red.ply", answer)
    assert len(run.export(tmp_path / "red.ply", answer, overwrite=True)) == len(rows["both"])


def test_pictures_show_the_answer(run: nl.LiftedRun) -> None:
    answer = run.ask("red", "yellow")
    plain, red, both = (run.render("0003", found) for found in (None, answer["red"], answer))
    photo = run.scene.train[3].image
    assert (plain.int() - photo.int()).abs().float().mean() < 3
    coloured = [int((np.ptp(x.numpy().astype(int), axis=2) > 60).sum()) for x in (red, both)]
    assert 20 < coloured[0] < coloured[1] < 0.5 * plain[:, :, 0].numel()
    assert torch.equal(run.render(3), plain)
    assert torch.equal(run.render(run.scene.train.cameras[3]), plain)
    assert torch.equal(run.render("images/0003.png"), plain)
    with pytest.raises(KeyError, match=r"images/0000\.png to .*0\.\.11, got 'x'"):
        run.render("x")


def test_features_of_ones_own(trained: Path, scene, room: DemoRoom, tmp_path: Path, monkeypatch, capsys) -> None:
    """Masks of the capture with made-up vectors: the run can be asked from Python and on the command line."""
    vectors = torch.eye(len(room.names))
    masks = [trained.parents[4] / "room" / "instance" / Path(view.name).name for view in scene.train]
    features = [(np.array(Image.open(mask)).astype(int) - 1, vectors) for mask in masks]
    texts = {name: 3 * vector for name, vector in zip(room.names, vectors)} | {"file": vectors[0]}
    run = nl.lift_run(scene, features=features, texts=texts, output_dir=tmp_path, timestamp="own", queries=["red"])
    assert run.folder == tmp_path / "room" / "normlift" / "own"
    found = run.ask("red", threshold=0.9)["red"].mask
    truth = room.labels == room.names.index("red")
    assert (found & truth).sum() / (found | truth).sum() > 0.7

    opened = nl.open_run(run.config)
    assert torch.equal(opened.ask("red", threshold=0.9)["red"].mask, found)
    stored = opened.ask_stored()
    assert stored is not None and stored.texts == ("red",)
    assert opened.field.manifest["features"]["kind"] == "given"
    moved = (tmp_path / "room" / "normlift" / "own").rename(tmp_path / "moved")  # the texts go with the run
    flags = ("--load-config", moved / "config.yml", "--text", "red", "file", "--output-json", tmp_path / "a.json")
    assert run_entry(monkeypatch, query.entrypoint, *flags) == 0
    assert json.loads((tmp_path / "a.json").read_text())["queries"][0]["peak"] == pytest.approx(1, abs=1e-3)
    assert run_entry(monkeypatch, query.entrypoint, *flags[:2], "--text", "rde") == 1
    assert "such as red" in said(capsys)


def test_features_by_name_and_without_texts(trained: Path, scene: nl.Scene, tmp_path: Path) -> None:
    half = (torch.arange(160).expand(120, 160) // 80, np.eye(2, dtype=np.float32))
    some = {name: half for name in scene.train.names[::3]}
    run = nl.lift_run(trained, features=some, output_dir=tmp_path, lift=nl.LiftOptions(refine=False))
    assert run.field.manifest["statistics"]["views"] == 4
    assert run.field.manifest["statistics"]["left_out"] == 8
    assert list(run.seconds) == ["check", "features", "evidence", "consensus", "recognition", "lift", "store", "write"]
    assert min(run.seconds.values()) > 0
    with pytest.raises(ValueError, match="texts"):
        run.ask("left")

    labels = torch.arange(160).expand(120, 160) // 80  # zero vectors are no features
    zero, none = (labels, torch.eye(2) * torch.tensor([[1.0], [0.0]])), (-labels, torch.eye(2))
    how = {"lift": nl.LiftOptions(refine=False, max_views=4), "check_alignment": False}
    first, second = (
        nl.lift_run(scene, features=[half] * 12, output_dir=tmp_path / name, **how).reliability
        for name, half in (("zero", zero), ("none", none))
    )
    assert torch.equal(first, second) and 0 < int((first > 0).sum()) < len(first)
    with pytest.raises(ValueError, match="nothing was labeled"):
        nl.lift_run(scene, features=[(labels, 0 * torch.eye(2))] * 12, output_dir=tmp_path / "all", **how)


def test_what_cannot_be_lifted_is_named_and_leaves_nothing(scene: nl.Scene, tmp_path: Path) -> None:
    labels, vectors = torch.arange(160).expand(120, 160) // 80, torch.eye(2)
    half = (labels, vectors)
    wrong: list[tuple[dict[str, Any], str]] = [
        ({"features": [half] * 3}, " 12.* 3;"),
        ({"features": {"nowhere.png": half}}, r"nowhere\.png"),
        ({"features": [(labels[:, :80], vectors)] * 12}, r"images/0000\.png .*\(120, 80\).*\(120, 160\)"),
        ({"features": [(labels + 1, vectors)] * 12}, r"images/0000\.png .* -1\.\.1, .* 1\.\.2"),
        ({"features": [(labels, torch.nan * vectors)] * 12}, r"images/0000\.png must be finite"),
        ({"features": [*[half] * 11, (labels, torch.eye(3))]}, r"\[2, 3\]"),
        ({"features": {}}, "empty"),
        ({"features": [labels.numpy()] * 12}, "must be a tuple of 2"),
        ({"features": [(labels * 0.5, vectors)] * 12}, "integers, got float32"),
        ({"texts": {"a": np.zeros(2)}}, r"'a' must be finite, not zero and of shape \[D\]"),
        ({"texts": {"a": np.ones((1, 2))}}, r"texts\['a'\] must be"),
        ({"texts": {"fox.npy": [1, 2]}}, "'fox.npy' in texts is not"),
        ({"texts": {5: [1, 2]}}, "dictionary"),
        ({"texts": {"a": ["x", "y"]}}, "numbers"),
        ({"texts": {"a": [1, 2, 3]}}, r"\[2, 3\]"),
        ({"texts": {"a": [1, 2]}, "queries": ["b"]}, "'b' .*such as a"),
        ({"queries": ["b"]}, "is empty"),
        ({"texts": {"a": [1, 2]}, "queries": "a"}, "queries must be a list"),
        ({"features": None, "texts": {"a": [1, 2]}, "source": nl.SourceOptions(encoder="color")}, "texts"),
        ({"source": nl.SourceOptions(encoder="color")}, "source"),
        ({"load_step": 3}, "open_scene"),
        *(({name: 5}, name) for name in ("source", "timestamp", "check", "export", "features")),
        *(({"timestamp": x}, "folder name") for x in ("..", "a/b", "", ".cache", "x\ny")),
        ({"timestamp": "a" * 300}, "300 .* 200"),
    ]
    for arguments, message in wrong:
        with pytest.raises(nl.InputError, match=message):
            nl.lift_run(scene, **{"output_dir": tmp_path, "features": [half] * 12, "overwrite": True, **arguments})
    assert list(tmp_path.iterdir()) == []


def test_mistakes_are_named(trained: Path, lifted: Path) -> None:
    with pytest.raises(FileExistsError, match="another timestamp"):
        nl.lift_run(trained, source=nl.SourceOptions(encoder="color"), timestamp="one")
    with pytest.raises(TypeError, match=r"config_or_scene must be .* got 3"):
        nl.lift_run(3, features=[])  # type: ignore[arg-type]
    with pytest.raises(nl.InputError, match="folder name"):  # before a scene is looked for
        nl.lift_run("nowhere/config.yml", source=nl.SourceOptions(encoder="color"), timestamp="a/b", device="cpu")
    with pytest.raises(FileNotFoundError, match="without semantics"):
        nl.open_run(trained)


def test_cameras_that_changed_after_the_lift_are_warned_of(lifted: Path, tmp_path: Path) -> None:
    room = shutil.copytree(lifted.parents[4] / "room", tmp_path / "room")
    file = room / "transforms.json"
    whole = file.read_text()
    with warnings.catch_warnings():
        warnings.simplefilter("error", UserWarning)
        nl.open_run(lifted, data=room)  # a copy has the same cameras
    both = "training and held-out"
    for change, changed in (("focal", both), ("order", "training"), ("one pose", both), ("held out", "held-out")):
        content = json.loads(whole)
        frames = content["frames"]
        if change == "focal":
            content["fl_x"] *= 1.003
        elif change in ("order", "held out"):
            held_out = [frame for frame in frames if frame["file_path"] in content["test_filenames"]]
            (first, second), key = frames[1:3] if change == "order" else held_out[:2], "transform_matrix"
            first[key], second[key] = second[key], first[key]
        else:
            frames[1]["transform_matrix"][0][3] += 4e-4
        file.write_text(json.dumps(content))
        with pytest.warns(UserWarning, match=f"The {changed} cameras"):
            nl.open_run(lifted, data=room)


def test_wrong_kinds_are_named(run: nl.LiftedRun, tmp_path: Path) -> None:
    answer = run.ask("red")
    assert "red" in answer and "blue" not in answer
    assert answer != run.ask("red") and len(repr(answer)) < 200 and len(repr(run)) < 300
    with pytest.raises(ValueError, match="each of \\*texts"):
        run.ask(["red", "blue"])  # type: ignore[arg-type]
    with pytest.raises(nl.InputError, match="null characters"):
        run.ask("red\0")
    for part in (answer.mask[:-1], answer.mask.int(), "x", [[1], 2]):
        with pytest.raises(ValueError, match="part must be"):
            run.export(tmp_path / "new" / "a.ply", part)
    with pytest.raises(nl.InputError, match="valid file name"):
        run.export("")
    for value in (object(), float("nan")):
        with pytest.raises(nl.InputError):
            run.export(tmp_path / "b.ply", objects={"a": value})
    assert list(tmp_path.iterdir()) == []
    assert len(run.export(tmp_path / "a.ply", answer["red"].mask.numpy())) > 0
    with pytest.raises(ValueError, match=r" 3 .* 343"):
        run.save(Query(("a",), torch.ones(1, 3)))
    stored = run.ask_stored()
    assert stored is not None
    assert run.save(stored).name == "queries.safetensors"  # other tests expect it as it was
    assert torch.equal(run.render(np.int64(3)), run.render(Path("images/0003")))


@pytest.mark.slow
def test_everything_is_drawn_by_the_rules_of_the_lift(trained: Path, tmp_path: Path, monkeypatch) -> None:
    drawn: list[nl.RasterSettings] = []

    def recording(backend: str, job: RasterJob, **how: Any) -> Any:
        drawn.append(job.settings)
        return choose_backend(backend, job, **how)

    monkeypatch.setattr(rasterize, "choose_backend", recording)
    half = (torch.arange(160).expand(120, 160) // 80, torch.eye(2))
    given: Any = {"features": [half] * 12, "texts": {"left": torch.tensor([1.0, 0.0])}, "timestamp": "rules"}
    plain, later = nl.LiftOptions(refine=False), nl.LiftOptions(refine=False, gsplat_version="1.6")
    run = nl.lift_run(trained, **given, lift=later, output_dir=tmp_path)
    again = nl.lift_run(run.config, **given, lift=plain, output_dir=tmp_path / "again")
    assert run.field.manifest["gsplat_rules"] == again.field.manifest["gsplat_rules"] == "1.6"
    lifts = len(drawn)
    evaluated = EvaluatedRun(run.scene, run.field, run.texts, True)
    evaluated.composite(run.scene.train.cameras[0], torch.ones(len(run.field), 1))
    run.render(0, run.ask("left"))
    flags = ("--load-config", run.config, "--text", "left", "--render-dir", tmp_path / "pictures")
    assert run_entry(monkeypatch, query.entrypoint, *flags) == 0
    assert lifts >= 2 * (3 + 1) and len(drawn) >= lifts + 1 + 2 + 3
    assert set(drawn) == {nl.RasterSettings.of_gsplat("1.6")}

    drawn.clear()
    run = nl.lift_run(trained, **given, lift=plain, output_dir=tmp_path / "plain")
    assert run.field.manifest["gsplat_rules"] == "1.4"
    assert set(drawn) == {nl.RasterSettings()}


def test_nothing_that_is_kept_depends_on_our_version(trained: Path, lifted: Path) -> None:
    """A later version opens runs and finds what is in the cache: schemas and digests say what fits."""
    folder = trained.parents[2]
    kept = [path for path in folder.rglob("*") if path.is_file() and path.suffix not in (".png", ".jpg")]
    assert lifted in kept and any(path.suffix == ".safetensors" for path in kept)
    assert [path for path in kept if f"{nl.__version__}".encode() in path.read_bytes()] == []
