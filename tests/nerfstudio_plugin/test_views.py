import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from PIL import Image

from normlift_ns.errors import InputError
from tests.nerfstudio_plugin.conftest import opened
from tests.nerfstudio_plugin.stock_run import FOCAL, HEIGHT, WIDTH, StockRun, train_splatfacto, write_dataset


def _assert_like_the_training(run: StockRun) -> Any:
    """Compares the views of a run with those of its training; returns its scene."""
    from nerfstudio.models import splatfacto  # noqa: PLC0415

    scene, datamanager, optimizer = opened(run.config), run.pipeline.datamanager, run.pipeline.model.camera_optimizer
    assert len(scene.train) == len(datamanager.cached_train) == len(datamanager.train_dataset)
    intrinsics = datamanager.train_cameras.get_intrinsics_matrices()
    for i, (view, cached) in enumerate(zip(scene.train, datamanager.cached_train)):
        camera = datamanager.train_cameras[i : i + 1]
        camera.metadata = {"cam_idx": i}
        with torch.no_grad(), torch.compiler.set_stance("force_eager"):
            pose = splatfacto.get_viewmat(optimizer.apply_to_camera(camera))[0]
        assert torch.equal(view.image, cached["image"])
        assert (view.mask is None) == ("mask" not in cached)
        assert view.mask is None or torch.equal(view.mask, cached["mask"][:, :, 0])
        assert torch.equal(view.camera.K, intrinsics[i])
        torch.testing.assert_close(view.camera.world_to_camera, pose, atol=1e-6, rtol=0)
        assert (view.camera.height, view.camera.width) == view.image.shape[:2]
    return scene


def test_views_splits_and_world_are_those_of_the_training(stock: StockRun, monkeypatch: pytest.MonkeyPatch) -> None:
    assert "load_3D_points: true" in stock.config.read_text()
    datamanager = stock.pipeline.datamanager
    monkeypatch.setattr("nerfstudio.data.dataparsers.nerfstudio_dataparser.Nerfstudio._load_3D_points", pytest.fail)
    run = _assert_like_the_training(stock)
    for views, dataset in ((run.train, datamanager.train_dataset), (run.held_out, datamanager.eval_dataset)):
        assert [file.name for file in views.files] == [file.name for file in dataset.image_filenames]
        camera = views.cameras[0]  # undistortion changes size and focal length
        assert (camera.width, camera.height) == (WIDTH - 1, HEIGHT - 1) and float(camera.K[0, 0]) > FOCAL + 1
    with pytest.raises(IndexError):
        run.train[9]
    trained = json.loads((stock.config.parent / "dataparser_transforms.json").read_text())
    assert run.dataparser_transform.tolist() == trained["transform"]
    assert run.dataparser_scale == trained["scale"] != 1


def arias(folder: Path, *, masks: bool = False, **more: object) -> None:
    """A dataset of images as Aria's glasses take them; `more` stands in its transforms.json."""
    shutil.rmtree(folder, ignore_errors=True)
    write_dataset(folder, masks=masks)
    path = folder / "transforms.json"
    meta = json.loads(path.read_text())
    del meta["k1"]
    lens = [0.02, -0.01, 0.004, 0.002, -0.001, 0.0005, 0.001, -0.0008, 0.0006, 0.0002, -0.0004, 0.0001]
    path.write_text(json.dumps(meta | {"camera_model": "FISHEYE624", "distortion_params": lens, **more}))


@pytest.mark.slow
def test_cameras_of_aria_are_undistorted_as_in_the_training(tmp_path: Path) -> None:
    arias(tmp_path / "scene", fisheye_crop_radius=15.0)
    run = train_splatfacto(tmp_path, Path("scene"))
    scene = _assert_like_the_training(run)
    view = scene.train[0]
    assert (view.image.shape, view.original) == ((30, 30, 3), (WIDTH, HEIGHT))
    assert 0.5 < view.mask.float().mean() < 1
    assert [camera.width for camera in scene.held_out.cameras] == [30]
    arias(tmp_path / "scene", masks=True, fisheye_crop_radius=15.0)
    with pytest.raises(InputError, match=r"FISHEYE624 .*masks"):
        _ = opened(run.config).train[0]
    for radius in (None, 15, 1e9, 0.0):
        arias(tmp_path / "scene", fisheye_crop_radius=radius)
        with pytest.raises(InputError, match=rf"fisheye_crop_radius is {radius}.*\b{WIDTH + HEIGHT}\b"):
            _ = opened(run.config).train.cameras


@pytest.mark.parametrize("mode", ["SO3xR3", pytest.param("SE3", marks=pytest.mark.slow)])
def test_optimized_poses_are_applied(stock: StockRun, workspace: Path, mode: str) -> None:
    def configure(config) -> None:
        config.pipeline.model.camera_optimizer.mode = mode
        if mode == "SE3":
            config.pipeline.model.rasterize_mode = "antialiased"
        else:
            config.pipeline.datamanager.cache_images = "cpu"

    def prepare(trainer) -> None:
        trainer.pipeline.datamanager.config.cache_images = "gpu"  # nerfstudio pins memory, which fails without a GPU
        adjustment = trainer.pipeline.model.camera_optimizer.pose_adjustment.data
        sizes = torch.tensor([1e-3, 0.05, 0.3]).repeat(3)[:, None]  # for small ones nerfstudio sums a series
        adjustment.copy_(sizes * torch.randn(adjustment.shape, generator=torch.Generator().manual_seed(1)))

    run = train_splatfacto(workspace, Path("scene"), configure=configure, prepare=prepare)
    assert f"cache_images: {'cpu' if mode == 'SO3xR3' else 'gpu'}" in run.config.read_text()
    loaded, raw = _assert_like_the_training(run), opened(stock.config)
    assert loaded.rasterize_mode == ("classic" if mode == "SO3xR3" else "antialiased")
    moved = [a.world_to_camera - b.world_to_camera for a, b in zip(loaded.train.cameras, raw.train.cameras)]
    assert min(float(x.abs().max()) for x in moved) > 1e-4
    for ours, theirs in zip(loaded.held_out.cameras, raw.held_out.cameras):  # splatfacto optimises training views only
        assert torch.equal(ours.world_to_camera, theirs.world_to_camera)

    file = workspace / "scene" / "transforms.json"
    meta = json.loads(file.read_text())
    file.write_text(json.dumps({**meta, "frames": meta["frames"][:-2]}))
    (run.config.parent / "dataparser_transforms.json").unlink()
    with pytest.raises(InputError, match=rf"{mode}.* 9 .* 8 .*--data"):
        opened(run.config)


def test_masks_are_undistorted_with_their_images_and_named_with_them(tmp_path: Path) -> None:
    write_dataset(tmp_path / "masked", masks=True)
    run = train_splatfacto(tmp_path, Path("masked"))
    mask = _assert_like_the_training(run).train[0].mask
    assert (mask.dtype, mask.shape) == (torch.bool, (35, 47))
    assert mask[:, 13:].all() and not mask[:, :11].any()
    file = tmp_path / "masked" / "masks" / "004.png"
    for made, message in (
        (Image.new("RGB", (WIDTH, HEIGHT)), r"masks/004\.png .*images/004\.jpg .* RGB"),
        (Image.new("L", (WIDTH, 7)), r"masks/004\.png is 48 x 7 .*images/004\.jpg is 48 x 36"),
        (None, r"masks/004\.png cannot be read"),
    ):
        file.write_bytes(b"x") if made is None else made.save(file)
        with pytest.raises(InputError, match=message):
            opened(run.config)
    Image.fromarray(np.eye(HEIGHT, WIDTH, dtype=np.uint8)).save(file)  # any value that is not zero
    assert 0 < int(opened(run.config).train[4].mask.sum()) < 3 * HEIGHT


def test_images_that_are_missing_or_change_later_are_named(copied: Path) -> None:
    run = opened(copied)
    file = run.train.files[3]
    file.write_bytes(file.read_bytes()[:300])
    with pytest.raises(InputError, match=r"images/003\.jpg cannot be read"):
        run.train[3]
    Image.new("RGB", (20, 10)).save(file)
    with pytest.raises(InputError, match=r"003\.jpg .*20 x 10.*48 x 36"):
        run.train[3]
    file.unlink()
    with pytest.raises(FileNotFoundError, match=r"003\.jpg"):
        run.train[3]
    run.train.files[0].unlink()  # which nerfstudio opens to guess the downscaling
    with pytest.raises(FileNotFoundError, match=r"images/000\.jpg"):
        opened(copied)
