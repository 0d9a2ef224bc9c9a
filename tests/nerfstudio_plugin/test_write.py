import json
import os
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from normlift_ns import InputError, SemanticField
from normlift_ns.io import atomic
from normlift_ns.io.run_dir import cache_folder, read_manifest, run_directory, write_manifest
from normlift_ns.lifted_run import write_run
from normlift_ns.query.question import Query, load_query
from tests.nerfstudio_plugin.conftest import field_of, opened, read, write
from tests.nerfstudio_plugin.stock_run import StockRun, working_directory

CHECKPOINT = "step-000000002.ckpt"


def asking(text: str) -> Query:
    return Query((text,), torch.eye(8)[:1])


def test_a_lifted_run_is_its_source_with_another_model(copied: Path, field: SemanticField, tmp_path: Path) -> None:
    source, before = opened(copied), copied.read_bytes()
    run_dir = write(source, field, timestamp="now", question=asking("a"))
    assert run_dir == tmp_path / "moved" / "outputs" / "scene" / "normlift" / "now"
    assert sorted(os.listdir(run_dir)) == ["config.yml", "dataparser_transforms.json", "nerfstudio_models", "normlift"]
    assert os.listdir(run_dir / "nerfstudio_models") == [CHECKPOINT]
    assert os.listdir(run_dir.parent) == ["now"]
    transforms = [json.loads((d / "dataparser_transforms.json").read_text()) for d in (run_dir, copied.parent)]
    assert transforms[0] == transforms[1]
    assert copied.read_bytes() == before

    slim = torch.load(run_dir / "nerfstudio_models" / CHECKPOINT, weights_only=True)
    full = torch.load(source.checkpoint.path, weights_only=False)
    assert slim.keys() == {"step", "pipeline"}
    assert slim["pipeline"].keys() == {name for name in full["pipeline"] if "lpips" not in name}
    assert all(torch.equal(value, full["pipeline"][name]) for name, value in slim["pipeline"].items())
    config, question = read(run_dir / "config.yml"), load_query(run_dir / "normlift")
    assert (config.method_name, config.pipeline.model.semantics) == ("normlift", Path("normlift"))
    assert question is not None and question.texts == ("a",)


def test_it_is_read_and_can_be_lifted_again(copied: Path, field: SemanticField, tmp_path: Path, registered) -> None:
    from nerfstudio.utils.eval_utils import eval_setup  # noqa: PLC0415

    source = opened(copied)
    first = write(source, field, timestamp="first")
    with working_directory(tmp_path / "moved"):  # that of the training
        _, pipeline, path, step = eval_setup((first / "config.yml").relative_to(tmp_path / "moved"))
    assert (path.name, step, type(pipeline.model).__name__) == (CHECKPOINT, 2, "NormLiftModel")
    assert torch.equal(pipeline.model.field.scalars.reliability.cpu(), field.scalars.reliability)
    with working_directory(tmp_path):
        again = opened(first / "config.yml")
        second = write(again, field_of(again), timestamp="second")
    assert torch.equal(again.gaussians.means, source.gaussians.means)
    assert again.train.cameras[3].world_to_camera.tolist() == source.train.cameras[3].world_to_camera.tolist()
    assert second == first.parent / "second"
    assert read(second / "config.yml").output_dir == Path("outputs")
    assert torch.equal(field_of(opened(second / "config.yml")).source, field.source)


def test_paths_become_absolute_elsewhere(copied: Path, field: SemanticField, tmp_path: Path, registered: None) -> None:
    from nerfstudio.utils.eval_utils import eval_setup  # noqa: PLC0415

    data, source = tmp_path / "moved" / "scene", opened(copied)
    run_dir = write(source, field, output_dir=tmp_path / "moved" / "below")
    assert read(run_dir / "config.yml").output_dir == Path("below")
    for name in ("lifts", "others"):
        with working_directory(tmp_path):
            run_dir = write(source, field, output_dir=Path(name))
        config = read(run_dir / "config.yml")
        assert run_dir.is_relative_to(tmp_path / name / "scene" / "normlift")
        assert config.output_dir == tmp_path / name
        assert config.data == config.pipeline.datamanager.data == data
        assert eval_setup(run_dir / "config.yml")[1].model.field is not None  # from any directory, then
        if name == "lifts":
            data = data.rename(tmp_path / "dataset")
            source = opened(copied, data=data)


def test_an_existing_directory_is_replaced_only_if_told(copied: Path, field: SemanticField) -> None:
    source = opened(copied)
    run_dir = write(source, field, timestamp="now")
    (run_dir / "note.txt").touch()
    with pytest.raises(FileExistsError, match=rf"{run_dir} exists; .*--timestamp .*--output-dir.*--overwrite"):
        write(source, field, timestamp="now")
    assert (run_dir / "note.txt").exists()
    names = ("note.txt", "normlift/mine.json", "nerfstudio_models/a.ckpt", "exports/a")
    mine = {run_dir / name: name for name in names}
    (run_dir / "exports").mkdir()
    for path, text in mine.items():
        path.write_text(text)
    stale = run_dir / "nerfstudio_models" / "step-000000099.ckpt"  # of an earlier lift of this run, says its manifest
    stale.write_bytes(b"")
    facts, digests = read_manifest(run_dir / "normlift")
    (run_dir / "normlift" / "manifest.json").unlink()
    write_manifest(run_dir / "normlift", facts, {**(digests or {}), f"../nerfstudio_models/{stale.name}": "x"})
    assert write(source, field, timestamp="now", overwrite=True) == run_dir
    assert {path: path.read_text() for path in mine} == mine and os.listdir(run_dir.parent) == ["now"]
    assert sorted(os.listdir(run_dir / "nerfstudio_models")) == ["a.ckpt", CHECKPOINT]
    lifted = opened(run_dir / "config.yml")
    with pytest.raises(InputError, match="contains the run to lift"):
        write(lifted, field, timestamp="now", overwrite=True)
    (run_dir / "added_photographs.json").write_text("mine")  # a name of ours that the manifest does not list
    assert write(source, field, timestamp="now", overwrite=True) == run_dir
    assert (run_dir / "added_photographs.json").read_text() == "mine" and stale.exists() is False


def test_a_failure_leaves_nothing_and_keeps_what_was_there(copied: Path, field: SemanticField, monkeypatch) -> None:
    def fail(*args: object) -> None:
        raise KeyboardInterrupt

    source = opened(copied)
    run_dir = write(source, field, timestamp="now")
    monkeypatch.setattr(torch, "save", fail)
    for how in ({"timestamp": "other"}, {"timestamp": "now", "overwrite": True}):
        with pytest.raises(KeyboardInterrupt):
            write(source, field, **how)
    assert os.listdir(run_dir.parent) == ["now"]
    field_of(opened(run_dir / "config.yml"))


def test_a_field_of_another_run_is_refused(copied: Path, stock: StockRun, field: SemanticField) -> None:
    source = opened(copied)
    run_dir = write(source, field, timestamp="now")
    strange = replace(field, manifest={**field.manifest, "means_fingerprint": "0"})
    with pytest.raises(ValueError, match=rf" 60 Gaussians .* 60 .*{CHECKPOINT}"):
        write(source, strange)

    path = run_dir / "nerfstudio_models" / CHECKPOINT
    slim = torch.load(path, weights_only=True)
    fewer = {name: value[1:] if "gauss_params" in name else value for name, value in slim["pipeline"].items()}
    torch.save({"step": 2, "pipeline": fewer}, path)
    with pytest.raises(ValueError, match=rf"normlift has 60 Gaussians, but {path} has 59"):
        field_of(opened(run_dir / "config.yml"))
    with pytest.raises(FileNotFoundError, match=r"without semantics.* normlift/"):
        field_of(opened(stock.config))


def test_what_a_killed_lift_left_is_cleaned_and_a_running_one_is_not(copied: Path, field: SemanticField) -> None:
    source = opened(copied)
    place = run_directory(source.runs_dir, source.name, "now")
    folders = (place.parent, cache_folder(place) / "features")
    dead, live = (f".normlift-{name * 4}" for name in ("dead", "beef"))
    for folder in folders:
        (folder / dead / "now").mkdir(parents=True)
        (folder / live / "now").mkdir(parents=True)
    held = [atomic.acquire_lock(folder / live) for folder in folders]
    try:
        write_run(source, field, place)
        assert [[path.name for path in folder.glob(".normlift-*")] for folder in folders] == [[live]] * 2
    finally:
        for descriptor in held:
            atomic.release_lock(descriptor)
    write_run(source, field, place, overwrite=True)
    assert list(place.parent.rglob(".normlift-*")) == []
