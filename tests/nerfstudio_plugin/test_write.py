import json
import os
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from normlift_ns import InputError, SemanticField
from normlift_ns.io.run_dir import read_manifest, write_manifest
from normlift_ns.query.question import load_query
from tests.nerfstudio_plugin.conftest import asking, field_of, opened, read, write
from tests.nerfstudio_plugin.stock_run import working_directory

CHECKPOINT = "step-000000002.ckpt"


def test_a_lifted_run_is_its_source_with_another_model(copied: Path, field: SemanticField, tmp_path: Path) -> None:
    source, before = opened(copied), copied.read_bytes()
    run_dir = write(source, field, timestamp="now", question=asking("left"))
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
    assert question is not None and question.texts == ("left",)


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
    with pytest.raises(FileExistsError, match=rf"{run_dir} exists; .*timestamp .*output_dir.*overwrite=True"):
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
    with pytest.raises(InputError, match="which the lift reads"):
        write(lifted, field, timestamp="now", overwrite=True)
    (run_dir / "added_photographs.json").write_text("mine")  # a name of ours that the manifest does not list
    assert write(source, field, timestamp="now", overwrite=True) == run_dir
    assert (run_dir / "added_photographs.json").read_text() == "mine" and stale.exists() is False


def test_a_field_of_another_run_is_refused(copied: Path, field: SemanticField) -> None:
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
