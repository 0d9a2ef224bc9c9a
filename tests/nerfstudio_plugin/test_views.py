from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
import torch
from nerfstudio.data.dataparsers.nerfstudio_dataparser import Nerfstudio
from nerfstudio.models import splatfacto
from PIL import Image

from normlift_ns.front_door import open_scene as load_scene
from tests.nerfstudio_plugin.stock_run import FOCAL, HEIGHT, WIDTH, StockRun, train_splatfacto, write_dataset


def _stock_viewmats(run: StockRun) -> torch.Tensor:
    """World-to-camera poses as splatfacto computes them while it trains."""
    datamanager, model = run.trainer.pipeline.datamanager, run.trainer.pipeline.model
    poses = []
    with torch.no_grad(), torch.compiler.set_stance("force_eager"):
        for i in range(len(datamanager.train_dataset)):
            camera = datamanager.train_cameras[i : i + 1]
            camera.metadata = {"cam_idx": i}
            poses.append(splatfacto.get_viewmat(model.camera_optimizer.apply_to_camera(camera))[0])
    return torch.stack(poses)


def _assert_like_the_training(run: StockRun) -> None:
    views, datamanager = load_scene(run.config).train, run.trainer.pipeline.datamanager
    assert len(views) == len(datamanager.cached_train) == 9
    intrinsics = datamanager.train_cameras.get_intrinsics_matrices()
    for i, (view, cached, pose) in enumerate(zip(views, datamanager.cached_train, _stock_viewmats(run))):
        assert torch.equal(view.image, cached["image"])
        assert (view.mask is None) == ("mask" not in cached)
        assert view.mask is None or torch.equal(view.mask, cached["mask"][:, :, 0])
        assert torch.equal(view.camera.K, intrinsics[i])
        torch.testing.assert_close(view.camera.world_to_camera, pose, atol=1e-6, rtol=0)
        assert (view.camera.height, view.camera.width) == view.image.shape[:2]


def test_views_are_those_of_the_training(stock: StockRun) -> None:
    _assert_like_the_training(stock)


def arias(folder: Path, *, masks: bool = False, **more: object) -> None:
    """A dataset of photographs as Aria's glasses take them; `more` stands in its transforms.json."""
    write_dataset(folder, masks=masks)
    path = folder / "transforms.json"
    meta = json.loads(path.read_text())
    del meta["k1"]
    lens = [0.02, -0.01, 0.004, 0.002, -0.001, 0.0005, 0.001, -0.0008, 0.0006, 0.0002, -0.0004, 0.0001]
    path.write_text(json.dumps(meta | {"camera_model": "FISHEYE624", "distortion_params": lens, **more}))


def test_cameras_of_aria_are_undistorted_as_in_the_training(tmp_path: Path) -> None:
    arias(tmp_path / "scene", fisheye_crop_radius=15.0)
    run = train_splatfacto(tmp_path, Path("scene"), steps=1)
    _assert_like_the_training(run)
    opened = load_scene(run.config)
    view = opened.train[0]
    assert view.image.shape == (30, 30, 3)
    assert view.mask is not None and 0.5 < view.mask.float().mean() < 1
    assert view.original == (WIDTH, HEIGHT)
    assert [camera.width for camera in opened.held_out.cameras] == [30]
    shutil.rmtree(tmp_path / "scene")
    arias(tmp_path / "scene", masks=True, fisheye_crop_radius=15.0)
    with pytest.raises(ValueError, match=r"FISHEYE624 cameras without masks only"):
        _ = load_scene(run.config).train[0]
    for radius in (None, 15, 1e9, 0.0):
        shutil.rmtree(tmp_path / "scene")
        arias(tmp_path / "scene", fisheye_crop_radius=radius)
        with pytest.raises(ValueError, match=r"its fisheye_crop_radius is .*, where nerfstudio needs the radius"):
            _ = load_scene(run.config).train.cameras


def test_undistortion_changes_size_and_focal_length(stock: StockRun) -> None:
    run = load_scene(stock.config)
    for views in (run.train, run.held_out):
        camera = views.cameras[0]
        assert (camera.width, camera.height) == (WIDTH - 1, HEIGHT - 1)
        assert float(camera.K[0, 0]) > FOCAL + 1
        assert views[0].image.dtype == torch.uint8
    folder = run.location.data
    distorted = torch.from_numpy(np.array(Image.open(folder / run.train.names[0])))
    assert (run.train[0].image.int() - distorted[:-1, :-1].int()).abs().max() > 15


def test_the_splits_are_nerfstudios(stock: StockRun) -> None:
    run = load_scene(stock.config)
    trained = stock.trainer.pipeline.datamanager
    for views, dataset in ((run.train, trained.train_dataset), (run.held_out, trained.eval_dataset)):
        assert [file.name for file in views.files] == [file.name for file in dataset.image_filenames]
    assert run.train.names + run.held_out.names == [f"images/{i:03d}.jpg" for i in (*range(8), 9, 8)]
    assert run.train[-1].name == "images/009.jpg"
    with pytest.raises(IndexError):
        run.train[9]


def test_the_transform_is_that_of_the_training(stock: StockRun) -> None:
    run = load_scene(stock.config)
    trained = json.loads((stock.config.parent / "dataparser_transforms.json").read_text())
    assert run.dataparser_transform.tolist() == trained["transform"]
    assert run.dataparser_scale == trained["scale"] != 1


@pytest.mark.parametrize("mode", ["SO3xR3", "SE3"])
def test_optimized_poses_are_applied(workspace: Path, mode: str) -> None:
    def configure(config) -> None:
        config.pipeline.model.camera_optimizer.mode = mode

    def prepare(trainer) -> None:
        adjustment = trainer.pipeline.model.camera_optimizer.pose_adjustment.data
        adjustment.copy_(0.05 * torch.randn(adjustment.shape, generator=torch.Generator().manual_seed(1)))

    run = train_splatfacto(workspace, Path("scene"), configure=configure, prepare=prepare, timestamp=mode)
    _assert_like_the_training(run)
    loaded = load_scene(run.config)
    raw = load_scene(workspace / "outputs" / "scene" / "splatfacto" / "run" / "config.yml")
    moved = [a.world_to_camera - b.world_to_camera for a, b in zip(loaded.train.cameras, raw.train.cameras)]
    assert min(float(x.abs().max()) for x in moved) > 0.01
    for ours, theirs in zip(loaded.held_out.cameras, raw.held_out.cameras):  # splatfacto optimises training views only
        assert torch.equal(ours.world_to_camera, theirs.world_to_camera)

    data = workspace / f"less-{mode}"
    shutil.copytree(workspace / "scene", data)
    meta = json.loads((data / "transforms.json").read_text())
    (data / "transforms.json").write_text(json.dumps({**meta, "frames": meta["frames"][:-2]}))
    (run.config.parent / "dataparser_transforms.json").unlink()
    with pytest.raises(
        ValueError, match=rf"optimised its camera poses \(mode {mode}\), but .* has 9 of them for 8 train"
    ):
        load_scene(run.config, data=data)


def test_masks_are_undistorted_with_their_images(tmp_path: Path) -> None:
    write_dataset(tmp_path / "masked", masks=True)
    run = train_splatfacto(tmp_path, Path("masked"))
    _assert_like_the_training(run)
    mask = load_scene(run.config).train[0].mask
    assert mask is not None
    assert mask.dtype == torch.bool
    assert mask.shape == (35, 47)
    assert not mask[:, :11].any()
    assert mask[:, 13:].all()


@pytest.mark.parametrize("how", ["dataparser", "datamanager"])
def test_downscaled_images_are_used_as_in_training(tmp_path: Path, how: str) -> None:
    write_dataset(tmp_path / "halved", halved=True)

    def configure(config) -> None:
        if how == "dataparser":
            config.pipeline.datamanager.dataparser.downscale_factor = 2
        else:
            config.pipeline.datamanager.camera_res_scale_factor = 0.5

    run = train_splatfacto(tmp_path, Path("halved"), configure=configure)
    _assert_like_the_training(run)
    train = load_scene(run.config).train
    assert train.names[0] == ("images_2/000.jpg" if how == "dataparser" else "images/000.jpg")
    assert (train.cameras[0].width, train.cameras[0].height) == (23, 17)
    assert FOCAL / 2 < float(train.cameras[0].K[0, 0]) < FOCAL


def test_images_with_alpha_are_composited(tmp_path: Path) -> None:
    write_dataset(tmp_path / "cutout", channels=4)
    run = load_scene(train_splatfacto(tmp_path, Path("cutout")).config)
    image = run.train[0].image
    assert image.shape == (35, 47, 3)
    assert image[:, 37:].unique(dim=0).tolist() == [[[38, 42, 55]] * 10]  # the viewer's background


def test_caching_on_the_cpu_needs_no_cuda(workspace: Path) -> None:
    """nerfstudio pins that memory, which fails without a GPU."""

    def configure(config) -> None:
        config.pipeline.datamanager.cache_images = "cpu"

    def prepare(trainer) -> None:
        trainer.pipeline.datamanager.config.cache_images = "gpu"  # after config.yml was written

    run = train_splatfacto(workspace, Path("scene"), configure=configure, prepare=prepare, timestamp="cached")
    assert "cache_images: cpu" in run.config.read_text()
    _assert_like_the_training(run)


def test_a_run_without_held_out_views(workspace: Path) -> None:
    def configure(config) -> None:
        config.pipeline.datamanager.dataparser.train_split_fraction = 1.0

    run = load_scene(train_splatfacto(workspace, Path("scene"), configure=configure, timestamp="all").config)
    assert (len(run.train), len(run.held_out)) == (10, 0)
    assert list(run.held_out) == run.held_out.cameras == []


def test_seed_points_are_never_read(stock: StockRun, monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(*args) -> None:
        raise AssertionError("the seed points were read")

    monkeypatch.setattr(Nerfstudio, "_load_3D_points", fail)
    assert "load_3D_points: true" in stock.config.read_text()
    assert len(load_scene(stock.config).gaussians) == 60


def test_rasterize_mode_is_that_of_the_run(workspace: Path, stock: StockRun) -> None:
    def configure(config) -> None:
        config.pipeline.model.rasterize_mode = "antialiased"

    run = train_splatfacto(workspace, Path("scene"), configure=configure, timestamp="antialiased")
    assert load_scene(run.config).rasterize_mode == "antialiased"
    assert load_scene(stock.config).rasterize_mode == "classic"


def test_a_missing_image_is_named_before_anything_is_lifted(copied: Path, tmp_path: Path) -> None:
    images = tmp_path / "moved" / "scene" / "images"
    for name in ("003.jpg", "007.jpg"):
        (images / name).unlink()
    with pytest.raises(
        FileNotFoundError, match=rf"2 of 9 image files of the dataset .* first is {images}/003\.jpg.*--data"
    ):
        load_scene(copied)
    (images / "000.jpg").unlink()  # which nerfstudio opens to guess the downscaling
    with pytest.raises(FileNotFoundError, match=rf"{images}/000\.jpg is missing from the dataset"):
        load_scene(copied)


def test_an_image_that_vanishes_later_is_named(copied: Path) -> None:
    run = load_scene(copied)
    run.train.files[3].unlink()
    assert run.train[2].name == "images/002.jpg"
    with pytest.raises(FileNotFoundError, match=r"003\.jpg is missing"):
        run.train[3]


@pytest.mark.parametrize("share", [0.0, 0.5])
def test_an_unreadable_image_is_named(copied: Path, share: float) -> None:
    run = load_scene(copied)
    content = run.train.files[3].read_bytes()
    run.train.files[3].write_bytes(content[: int(share * len(content))])
    with pytest.raises(ValueError, match=r"images/003\.jpg cannot be read \(.*Expected an 8-bit image"):
        run.train[3]


def test_an_image_of_another_size_is_named(copied: Path) -> None:
    run = load_scene(copied)
    Image.new("RGB", (20, 10)).save(run.train.files[3])
    with pytest.raises(ValueError, match=r"003\.jpg is 20 x 10 pixels, its camera 48 x 36 \(width x height\)"):
        run.train[3]


@pytest.mark.parametrize(
    ("content", "problem"),
    [("{", "is no valid JSON"), ("{}", "missing required field `frames`"), ('{"frames": []}', "has no frames")],
)
def test_a_damaged_dataset_is_named(copied: Path, tmp_path: Path, content: str, problem: str) -> None:
    (tmp_path / "moved" / "scene" / "transforms.json").write_text(content)
    with pytest.raises(ValueError, match=rf"transforms\.json .*{problem}"):
        load_scene(copied)


def test_a_dataset_without_transforms_is_named(copied: Path, tmp_path: Path) -> None:
    (tmp_path / "moved" / "scene" / "transforms.json").unlink()
    with pytest.raises(FileNotFoundError, match=r"transforms\.json is missing from the dataset"):
        load_scene(copied)


def test_another_dataset_is_refused(copied: Path, tmp_path: Path) -> None:
    """Poses are centred and scaled together: frames more or less, and nothing lies where the Gaussians think."""
    file = tmp_path / "moved" / "scene" / "transforms.json"
    meta = json.loads(file.read_text())
    file.write_text(json.dumps({**meta, "frames": meta["frames"][:8]}))
    with pytest.raises(
        ValueError, match=r"is not the one that .* was trained with: its poses give scale 0\.2\d+, the tr"
    ):
        load_scene(copied)


def test_cameras_that_splatfacto_cannot_draw_are_refused(copied: Path, tmp_path: Path) -> None:
    file = tmp_path / "moved" / "scene" / "transforms.json"
    meta = json.loads(file.read_text())
    file.write_text(json.dumps({**meta, "camera_model": "EQUIRECTANGULAR", "k1": 0}))
    run = load_scene(copied)
    with pytest.raises(ValueError, match=r"000\.jpg was taken with a EQUIRECTANGULAR camera"):
        run.train[0]
