import random
import zipfile
from pathlib import Path

import pytest
import torch

from normlift_ns.data.checkpoint import GAUSSIAN_PARAMETERS, find_checkpoint, read_checkpoint
from tests.io.test_digests import flipped
from tests.nerfstudio_plugin.conftest import opened
from tests.nerfstudio_plugin.stock_run import StockRun

NAME = "step-000000002.ckpt"


@pytest.fixture
def full(stock: StockRun) -> Path:
    return stock.config.parent / "nerfstudio_models" / NAME


def test_a_full_stock_checkpoint_is_read(stock: StockRun, full: Path) -> None:
    with zipfile.ZipFile(full) as content:
        (name,) = (name for name in content.namelist() if name.endswith("data.pkl"))
        assert b"numpy" in content.read(name)  # it does hold numpy scalars
    stored = torch.load(full, weights_only=False)
    assert all(len(optimizer["state"]) > 0 for optimizer in stored["optimizers"].values())
    assert any(name.startswith("_model.lpips.") for name in stored["pipeline"])

    checkpoint, scene, model = read_checkpoint(full), opened(stock.config).gaussians, stock.pipeline.model
    assert checkpoint.step == 2 and not any("lpips" in name for name in checkpoint.model)
    found = {name for name in checkpoint.model if name.startswith("gauss_params.")}
    assert found == {f"gauss_params.{name}" for name in GAUSSIAN_PARAMETERS}
    for name in GAUSSIAN_PARAMETERS:
        assert torch.equal(checkpoint.model[f"gauss_params.{name}"], model.gauss_params[name].data)
    torch.testing.assert_close(scene.scales, model.scales.data.exp())
    torch.testing.assert_close(scene.opacities, model.opacities.data.sigmoid()[:, 0])
    assert torch.equal(scene.quats, model.quats.data)


def test_what_other_versions_and_trainings_on_several_gpus_write_is_read(full: Path, tmp_path: Path) -> None:
    target, (new, old) = tmp_path / NAME, (b"numpy._core.multiarray", b"numpy.core.multiarray")
    with zipfile.ZipFile(full) as source, zipfile.ZipFile(target, "w", zipfile.ZIP_STORED) as other:
        for item in source.infolist():
            data = source.read(item)
            if item.filename.endswith("data.pkl"):  # scalars of numpy 1 where it is 2, and the other way around
                data = data.replace(new, old) if new in data else data.replace(old, new)
            other.writestr(item.filename, data)
    assert read_checkpoint(target).step == 2
    stored, expected = torch.load(full, weights_only=False), read_checkpoint(full).model.keys()
    for number, prefix in enumerate(("_model.module.", "module._model.")):
        pipeline = {name.replace("_model.", prefix): value for name, value in stored["pipeline"].items()}
        torch.save({"step": 5, "pipeline": pipeline}, tmp_path / f"{number}.ckpt")
        assert read_checkpoint(tmp_path / f"{number}.ckpt").model.keys() == expected


def test_the_last_step_is_taken_and_any_can_be_chosen(copied: Path) -> None:
    folder = copied.parent / "nerfstudio_models"
    stored = torch.load(folder / NAME, weights_only=False)
    stored["pipeline"]["_model.gauss_params.means"] += 1
    torch.save({**stored, "step": 1}, folder / "step-000000001.ckpt")
    (folder / "notes.json").write_text("{}")  # crashes nerfstudio's own loader
    last, earlier = opened(copied), opened(copied, load_step=1)
    assert (last.checkpoint.step, earlier.checkpoint.step) == (2, 1)
    torch.testing.assert_close(earlier.gaussians.means, last.gaussians.means + 1)
    with pytest.raises(FileNotFoundError, match=r"step 7\..* 1, 2\..*--load-step"):
        opened(copied, load_step=7)


def test_a_missing_checkpoint_is_named(copied: Path, tmp_path: Path) -> None:
    folder = copied.parent / "nerfstudio_models"
    (folder / NAME).rename(tmp_path / "taken.ckpt")
    for _ in range(2):  # empty, then absent
        with pytest.raises(FileNotFoundError, match=rf"{folder} has no checkpoint.* step-000029999\.ckpt"):
            opened(copied)
        folder.rmdir() if folder.exists() else None
    for name in ("step-000000001.ckpt", "step-final.ckpt", "step-000000009.ckpt.tmp", "other.ckpt"):
        (tmp_path / name).touch()
    assert find_checkpoint(tmp_path).name == "step-000000001.ckpt"  # the others only look like checkpoints


def test_flipped_bits_are_noticed_or_change_nothing(full: Path, tmp_path: Path) -> None:
    path, expected, whole = tmp_path / NAME, read_checkpoint(full).model, full.read_bytes()
    noticed = 0
    for bit in random.Random(0).sample(range(8 * len(whole)), 40):
        path.write_bytes(flipped(whole, bit))
        try:
            found = read_checkpoint(path).model
        except ValueError as error:
            assert str(path) in str(error)
            noticed += 1
        else:  # dates and names of entries, and the gaps between them
            assert found.keys() == expected.keys()
            assert all(torch.equal(found[name], expected[name]) for name in expected)
    assert noticed > 20
