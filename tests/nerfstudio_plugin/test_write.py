from __future__ import annotations

import errno
import json
import os
import resource
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import pytest
import torch
from nerfstudio.utils.eval_utils import eval_setup

from normlift_ns import open_run
from normlift_ns.core.disk import atomic
from normlift_ns.front_door import open_scene as load_scene
from normlift_ns.nerfstudio_plugin.config import as_nerfstudios, read_config
from normlift_ns.nerfstudio_plugin.model import NormLiftModel, NormLiftModelConfig
from normlift_ns.question import Question
from normlift_ns.runs.files import cache_folder, run_directory
from normlift_ns.runs.question import load_question
from normlift_ns.runs.write import write_run
from tests.nerfstudio_plugin.conftest import field_of, lifted_field, write
from tests.nerfstudio_plugin.stock_run import StockRun, working_directory
from tests.processes import killed_at


def test_a_lifted_run_has_the_files_that_nerfstudio_expects(copied: Path, tmp_path: Path) -> None:
    source = load_scene(copied)
    before = copied.read_bytes()
    run_dir = write(source, lifted_field(source), timestamp="now")
    assert run_dir == tmp_path / "moved" / "outputs" / "scene" / "normlift" / "now"
    assert sorted(os.listdir(run_dir)) == ["config.yml", "dataparser_transforms.json", "nerfstudio_models", "normlift"]
    assert os.listdir(run_dir / "nerfstudio_models") == ["step-000000002.ckpt"]
    assert os.listdir(run_dir.parent) == ["now"]
    transforms = [json.loads((d / "dataparser_transforms.json").read_text()) for d in (run_dir, copied.parent)]
    assert transforms[0] == transforms[1]
    assert copied.read_bytes() == before

    slim = torch.load(run_dir / "nerfstudio_models" / "step-000000002.ckpt", weights_only=True)
    full = torch.load(source.checkpoint.path, weights_only=False)
    assert slim.keys() == {"step", "pipeline"}
    assert slim["pipeline"].keys() == {name for name in full["pipeline"] if "lpips" not in name}
    for name, value in slim["pipeline"].items():
        assert torch.equal(value, full["pipeline"][name])


def test_the_config_is_the_sources_with_another_method_and_model(copied: Path) -> None:
    source = load_scene(copied)
    run_dir = write(source, lifted_field(source), question=Question(("a",), torch.eye(8)[:1]))
    config: Any = read_config(run_dir / "config.yml")
    stored: Any = as_nerfstudios(source.config)
    assert config.method_name == "normlift"
    assert type(config.pipeline.model) is NormLiftModelConfig
    question = load_question(run_dir / "normlift")
    assert question is not None
    assert question.texts == ("a",)
    assert config.pipeline.model.semantics == Path("normlift")
    assert config.timestamp == run_dir.name
    for name in ("output_dir", "data", "experiment_name", "optimizers", "relative_model_dir", "viewer", "machine"):
        assert getattr(config, name) == getattr(stored, name)
    assert not config.pipeline.datamanager.dataparser.load_3D_points
    assert stored.method_name == "splatfacto"
    assert stored.pipeline.datamanager.dataparser.load_3D_points


def test_stock_eval_setup_loads_it_from_the_directory_of_the_training(
    copied: Path, tmp_path: Path, registered: None
) -> None:
    source = load_scene(copied)
    field = lifted_field(source)
    run_dir = write(source, field)
    with working_directory(tmp_path / "moved"):
        _, pipeline, path, step = eval_setup((run_dir / "config.yml").relative_to(tmp_path / "moved"))
    assert step == 2
    assert path.name == "step-000000002.ckpt"
    assert type(pipeline.model) is NormLiftModel
    assert torch.equal(pipeline.model.means.cpu(), source.gaussians.means)
    assert pipeline.model.field is not None
    assert torch.equal(pipeline.model.field.scalars.reliability.cpu(), field.scalars.reliability)


def test_our_loader_reads_it_from_anywhere_and_can_lift_it_again(copied: Path, tmp_path: Path) -> None:
    source = load_scene(copied)
    run_dir = write(source, lifted_field(source), timestamp="first")
    with working_directory(tmp_path):
        again = load_scene(run_dir / "config.yml")
        field = field_of(again)
        second = write(again, field, timestamp="second")
    assert torch.equal(again.gaussians.means, source.gaussians.means)
    assert again.train.cameras[3].world_to_camera.tolist() == source.train.cameras[3].world_to_camera.tolist()
    assert second == run_dir.parent / "second"
    assert read_config(second / "config.yml").output_dir == Path("outputs")
    assert torch.equal(field_of(load_scene(second / "config.yml")).source, field.source)


@pytest.mark.parametrize("moved", [False, True])
def test_with_an_output_directory_elsewhere_all_paths_become_absolute(
    copied: Path, tmp_path: Path, registered: None, moved: bool
) -> None:
    data = tmp_path / "moved" / "scene"
    if moved:
        data = data.rename(tmp_path / "dataset")
    source = load_scene(copied, data=data if moved else None)
    with working_directory(tmp_path):
        run_dir = write(source, lifted_field(source), output_dir=Path("lifts"))
        config = read_config(run_dir / "config.yml")
        assert run_dir.is_relative_to(tmp_path / "lifts" / "scene" / "normlift")
        assert config.output_dir == tmp_path / "lifts"
        assert config.data == config.pipeline.datamanager.data == data
    _, pipeline, _, _ = eval_setup(run_dir / "config.yml")  # from any directory, then
    assert pipeline.model.field is not None


def test_an_output_directory_below_the_training_stays_relative(copied: Path, tmp_path: Path) -> None:
    source = load_scene(copied)
    run_dir = write(source, lifted_field(source), output_dir=tmp_path / "moved" / "lifts")
    assert read_config(run_dir / "config.yml").output_dir == Path("lifts")


def test_an_existing_directory_is_kept_unless_told(copied: Path, tmp_path: Path) -> None:
    source = load_scene(copied)
    field = lifted_field(source)
    run_dir = write(source, field, timestamp="now")
    (run_dir / "note.txt").touch()
    with pytest.raises(
        FileExistsError, match=rf"{run_dir} exists; give another --timestamp or --output-dir, or --overw"
    ):
        write(source, field, timestamp="now")
    assert (run_dir / "note.txt").exists()
    assert write(source, field, timestamp="now", overwrite=True) == run_dir
    assert not (run_dir / "note.txt").exists()
    assert os.listdir(run_dir.parent) == ["now"]
    lifted = load_scene(run_dir / "config.yml")  # a run may also replace the one that it was made from
    write(lifted, field, timestamp="now", overwrite=True)
    assert torch.equal(load_scene(run_dir / "config.yml").gaussians.means, source.gaussians.means)


@pytest.mark.parametrize("failure", [OSError(errno.ENOSPC, "No space left on device"), KeyboardInterrupt()])
def test_a_failure_leaves_nothing_and_keeps_what_was_there(
    copied: Path, monkeypatch: pytest.MonkeyPatch, failure: BaseException
) -> None:
    source = load_scene(copied)
    field = lifted_field(source)
    run_dir = write(source, field, timestamp="now")

    def fail(*args) -> None:
        raise failure

    monkeypatch.setattr(torch, "save", fail)
    with pytest.raises(type(failure)):
        write(source, field, timestamp="other")
    with pytest.raises(type(failure)):
        write(source, field, timestamp="now", overwrite=True)
    assert os.listdir(run_dir.parent) == ["now"]
    field_of(load_scene(run_dir / "config.yml"))


@pytest.mark.parametrize("limit", [500, 4000])  # the first file, the checkpoint
def test_a_full_disk_is_an_os_error(copied: Path, limit: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "dont_write_bytecode", True)  # what is imported now would be cut off in Python's cache
    source = load_scene(copied)
    field = lifted_field(source)
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (limit, hard))
    try:
        with pytest.raises(OSError, match=r"cannot be written|too large"):
            write(source, field, timestamp="now")
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert os.listdir(source.runs_dir / "scene" / "normlift") == []


def test_a_field_of_another_run_is_refused(copied: Path, stock: StockRun) -> None:
    source = load_scene(copied)
    field = lifted_field(source)
    run_dir = write(source, field, timestamp="now")
    other = source.gaussians.means.clone()
    other[0] += 1
    field.manifest["means_fingerprint"] = "0"  # type: ignore[index]
    with pytest.raises(
        ValueError, match=r"field has 60 Gaussians and was not lifted from the 60 of .*step-000000002\.ckpt"
    ):
        write(source, field)

    path = run_dir / "nerfstudio_models" / "step-000000002.ckpt"
    slim = torch.load(path, weights_only=True)
    torch.save({**slim, "pipeline": {**slim["pipeline"], "_model.gauss_params.means": other}}, path)
    with pytest.raises(
        ValueError, match=rf"normlift was lifted from other Gaussians than those of {path} \(same number"
    ):
        field_of(load_scene(run_dir / "config.yml"))
    fewer = {name: value[1:] if "gauss_params" in name else value for name, value in slim["pipeline"].items()}
    torch.save({"step": 2, "pipeline": fewer}, path)
    with pytest.raises(ValueError, match=rf"normlift has 60 Gaussians, but {path} has 59"):
        field_of(load_scene(run_dir / "config.yml"))


def test_a_run_without_semantics_is_named(stock: StockRun) -> None:
    with pytest.raises(FileNotFoundError, match=r"is a run without semantics \(no normlift/ in it\)\. Lift it"):
        field_of(load_scene(stock.config))


def test_default_names_of_the_same_second_are_numbered(copied: Path) -> None:
    """Two lifts at once, and two one after the other, under a name that nobody chose."""
    source = load_scene(copied)
    field = lifted_field(source)
    place = run_directory(source.runs_dir, source.name, "2024-05-01_120000")

    def lift(_: int) -> str:
        return write_run(source, field, place, exact=False).name

    expected = ["2024-05-01_120000", "2024-05-01_120000_2", "2024-05-01_120000_3"]
    with ThreadPoolExecutor(2) as pool:
        names = [*pool.map(lift, range(2)), lift(2)]
    assert sorted(names) == sorted(os.listdir(place.parent)) == expected
    for name in names:
        config: Any = read_config(place.with_name(name) / "config.yml")
        assert config.timestamp == name
        assert config.pipeline.model.semantics == Path("normlift")
        assert len(field_of(load_scene(place.with_name(name) / "config.yml"))) == len(field)


def test_of_two_lifts_with_the_same_timestamp_one_is_refused(copied: Path) -> None:
    source = load_scene(copied)
    field = lifted_field(source)
    place = run_directory(source.runs_dir, source.name, "now")

    def lift(seed: int) -> Exception | Path:
        question = Question((str(seed),), torch.eye(8)[:1])
        try:
            return write_run(source, field, place, question=question)
        except FileExistsError as error:
            return error

    with ThreadPoolExecutor(2) as pool:
        found = list(pool.map(lift, range(2)))
    (refused,) = (error for error in found if isinstance(error, FileExistsError))
    assert str(refused).startswith(f"{place} exists; give another --timestamp or --output-dir")
    kept = load_question(place / "normlift")
    assert kept is not None
    assert kept.texts == (str(found.index(place)),)
    assert os.listdir(place.parent) == ["now"]


@pytest.mark.slow
@pytest.mark.parametrize("exchanged", [True, False])
def test_a_lift_that_is_killed_while_it_replaces_a_run_loses_nothing(
    copied: Path, exchanged: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """At every seventh access to the disk; the command that opens the run completes what was under way."""
    source = load_scene(copied)
    field = lifted_field(source)
    run_dir = write(source, field, question=Question(("old",), torch.eye(8)[:1]), timestamp="now")
    (run_dir.parent / ".cache" / "features").mkdir(parents=True)
    if not exchanged:
        monkeypatch.setattr(atomic, "_rename", lambda *_: False)

    def lift() -> None:
        write(source, field, question=Question(("new",), torch.eye(8)[:1]), timestamp="now", overwrite=True)

    step, seen, gone = 1, [], 0
    while killed_at(step, lift, run_dir.parent):
        gone += not run_dir.exists()
        run = open_run(run_dir / "config.yml")
        stored = run.ask_stored()
        assert stored is not None
        assert len(run.field) == len(field)
        seen.append(stored.texts[0])
        step += 7 if seen[-1] == "old" and step < 250 else 1
    assert set(seen) == {"old", "new"}
    assert gone == 0 or not exchanged
    lift()
    assert sorted(os.listdir(run_dir.parent)) == [".cache", "now"]
    print(f"{step} accesses, {len(seen)} kills, the run was out of its place {gone} times")


def test_what_a_killed_lift_left_is_cleaned_and_a_running_one_is_not(copied: Path) -> None:
    source = load_scene(copied)
    field = lifted_field(source)
    place = run_directory(source.runs_dir, source.name, "now")
    cache = cache_folder(place) / "features"
    dead, live = (f".normlift-{name * 4}" for name in ("dead", "beef"))
    for folder in (place.parent, cache):
        (folder / dead / "now").mkdir(parents=True)
        (folder / live / "now").mkdir(parents=True)
    held = [atomic.hold(folder / live) for folder in (place.parent, cache)]
    try:
        write_run(source, field, place)
        left = [sorted(path.name for path in folder.glob(".normlift-*")) for folder in (place.parent, cache)]
        assert left == [[live]] * 2
    finally:
        for descriptor in held:
            atomic.release(descriptor)
    write_run(source, field, place, overwrite=True)
    assert list(place.parent.rglob(".normlift-*")) == []
