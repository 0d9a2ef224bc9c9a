from __future__ import annotations

import pickle
import random
import zipfile
from pathlib import Path

import pytest
import torch

from normlift_ns.front_door import open_scene as load_scene
from normlift_ns.scenes.checkpoint import GAUSSIAN_PARAMETERS, find_checkpoint, read_checkpoint
from tests.nerfstudio_plugin.stock_run import StockRun, train_splatfacto


@pytest.fixture
def full(stock: StockRun) -> Path:
    return stock.config.parent / "nerfstudio_models" / "step-000000002.ckpt"


def _rewrite(source: Path, target: Path, change) -> None:
    """Copies a checkpoint with another pickle in it."""
    with zipfile.ZipFile(source) as old, zipfile.ZipFile(target, "w", zipfile.ZIP_STORED) as new:
        for item in old.infolist():
            data = old.read(item)
            new.writestr(item.filename, change(data) if item.filename.endswith("data.pkl") else data)


def test_a_full_stock_checkpoint_is_read(stock: StockRun, full: Path) -> None:
    with pytest.raises(pickle.UnpicklingError, match="numpy"):  # it does hold numpy scalars
        torch.load(full, weights_only=True)
    stored = torch.load(full, weights_only=False)
    assert all(len(optimizer["state"]) > 0 for optimizer in stored["optimizers"].values())
    assert any(name.startswith("_model.lpips.") for name in stored["pipeline"])

    checkpoint = read_checkpoint(full)
    assert checkpoint.step == 2
    model = stock.trainer.pipeline.model
    assert {name for name in checkpoint.model if name.startswith("gauss_params.")} == {
        f"gauss_params.{name}" for name in GAUSSIAN_PARAMETERS
    }
    for name in GAUSSIAN_PARAMETERS:
        assert torch.equal(checkpoint.model[f"gauss_params.{name}"], model.gauss_params[name].data)
    assert not any("lpips" in name for name in checkpoint.model)


def test_the_scene_is_activated(stock: StockRun) -> None:
    scene, model = load_scene(stock.config).gaussians, stock.trainer.pipeline.model
    torch.testing.assert_close(scene.scales, model.scales.data.exp())
    torch.testing.assert_close(scene.opacities, model.opacities.data.sigmoid()[:, 0])
    assert torch.equal(scene.quats, model.quats.data)


def test_scalars_of_numpy_1_are_read(full: Path, tmp_path: Path) -> None:
    target = tmp_path / "step-000000002.ckpt"
    new, old = b"numpy._core.multiarray", b"numpy.core.multiarray"
    _rewrite(full, target, lambda data: data.replace(new, old) if new in data else data.replace(old, new))
    assert read_checkpoint(target).step == 2


def test_names_of_a_training_on_several_gpus_are_read(full: Path, tmp_path: Path) -> None:
    stored = torch.load(full, weights_only=False)
    for number, prefix in enumerate(("_model.module.", "module._model.")):
        pipeline = {name.replace("_model.", prefix): value for name, value in stored["pipeline"].items()}
        torch.save({"step": 5, "pipeline": pipeline}, tmp_path / f"{number}.ckpt")
        assert read_checkpoint(tmp_path / f"{number}.ckpt").model.keys() == read_checkpoint(full).model.keys()


def test_the_last_step_is_taken_and_any_can_be_chosen(workspace: Path) -> None:
    def configure(config) -> None:
        config.save_only_latest_checkpoint = False
        config.steps_per_save = 1

    run = train_splatfacto(workspace, Path("scene"), configure=configure, timestamp="steps", steps=3)
    folder = run.config.parent / "nerfstudio_models"
    (folder / "notes.json").write_text("{}")  # crashes nerfstudio's own loader
    assert load_scene(run.config).checkpoint.step == 2
    earlier = load_scene(run.config, load_step=1)
    assert earlier.checkpoint.step == 1
    assert not torch.equal(earlier.gaussians.means, load_scene(run.config).gaussians.means)
    with pytest.raises(
        FileNotFoundError, match=r"No checkpoint of step 7 in .*; it has the steps 1, 2\. .*--load-step"
    ):
        load_scene(run.config, load_step=7)


def test_a_missing_checkpoint_is_named(copied: Path, tmp_path: Path) -> None:
    folder = copied.parent / "nerfstudio_models"
    (folder / "step-000000002.ckpt").rename(tmp_path / "taken.ckpt")
    for _ in range(2):  # empty, then absent
        with pytest.raises(FileNotFoundError, match=rf"No checkpoint in {folder}\. Expected step-000029999\.ckpt"):
            load_scene(copied)
        folder.rmdir() if folder.exists() else None


@pytest.mark.parametrize("share", [0.0, 0.1, 0.5, 0.9, 0.999])
def test_a_truncated_checkpoint_is_named(full: Path, tmp_path: Path, share: float) -> None:
    content = full.read_bytes()
    size = int(len(content) * share)
    (tmp_path / "step-000000002.ckpt").write_bytes(content[:size])
    with pytest.raises(ValueError, match=rf"step-000000002\.ckpt is truncated .* {size:,} bytes .*Copy it again"):
        read_checkpoint(tmp_path / "step-000000002.ckpt")


def test_flipped_bits_are_noticed_or_change_nothing(full: Path, tmp_path: Path) -> None:
    path, expected, whole = tmp_path / "step-000000002.ckpt", read_checkpoint(full).model, full.read_bytes()
    noticed = 0
    for bit in random.Random(0).sample(range(8 * len(whole)), 120):
        changed = bytearray(whole)
        changed[bit // 8] ^= 1 << bit % 8
        path.write_bytes(changed)
        try:
            found = read_checkpoint(path).model
        except ValueError as error:
            assert str(path) in str(error)
            noticed += 1
        else:  # dates and names of entries, and the gaps between them
            assert found.keys() == expected.keys()
            assert all(torch.equal(found[name], expected[name]) for name in expected)
    assert noticed > 60


class _Touch:
    def __init__(self, path: Path) -> None:
        self.path = path

    def __reduce__(self):
        return Path.touch, (self.path,)


def test_a_checkpoint_runs_no_code(full: Path, tmp_path: Path) -> None:
    stored = torch.load(full, weights_only=False)
    torch.save({**stored, "extra": _Touch(tmp_path / "hacked")}, tmp_path / "evil.ckpt")
    with pytest.raises(ValueError, match=r"evil\.ckpt is not read, because it holds Python objects"):
        read_checkpoint(tmp_path / "evil.ckpt")
    assert not (tmp_path / "hacked").exists()


@pytest.mark.parametrize(
    ("content", "problem"),
    [
        ([1, 2], r"no nerfstudio checkpoint: expected `step` and `pipeline` in it, found list"),
        ({"weights": 1}, r"no nerfstudio checkpoint: .* found \['weights'\]"),
        ({"step": 1, "pipeline": {"_model.x": torch.zeros(1)}}, r"no Gaussians of splatfacto: gauss_params\.means, "),
    ],
)
def test_other_content_is_named(content, problem: str, tmp_path: Path) -> None:
    torch.save(content, tmp_path / "x.ckpt")
    with pytest.raises(ValueError, match=rf"x\.ckpt (is|has) {problem}"):
        read_checkpoint(tmp_path / "x.ckpt")


def test_files_that_only_look_like_checkpoints_are_passed_over(tmp_path: Path) -> None:
    for name in ("step-000000001.ckpt", "step-final.ckpt", "step-000000009.ckpt.tmp", "other.ckpt"):
        (tmp_path / name).touch()
    assert find_checkpoint(tmp_path).name == "step-000000001.ckpt"
