from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import yaml
from PIL import Image
from scipy.spatial.transform import Rotation

from normlift_ns import Camera, GaussianScene, render
from normlift_ns.demo.capture import to_dataparser_world, write_capture, write_splatfacto_run
from normlift_ns.demo.room import DemoRoom
from tests.scenes import random_scene


def test_to_dataparser_world_moves_every_gaussian_rigidly():
    generator = torch.Generator().manual_seed(0)
    scene = random_scene(50, dtype=torch.float32)
    rotation = torch.linalg.qr(torch.randn(3, 3, generator=generator)).Q
    rotation = rotation * torch.det(rotation)
    transform = torch.cat([rotation, torch.tensor([[0.3], [-2.0], [1.0]])], dim=1)
    moved = to_dataparser_world(scene, transform, 0.4)
    assert torch.allclose(moved.means, 0.4 * (scene.means @ rotation.T + transform[:, 3]), atol=1e-6)
    expected = 0.16 * rotation @ covariances(scene) @ rotation.T
    assert torch.allclose(covariances(moved), expected, atol=1e-6)
    assert torch.equal(moved.opacities, scene.opacities)


def covariances(scene: GaussianScene) -> torch.Tensor:
    turned = Rotation.from_quat(scene.quats.roll(-1, dims=1).numpy()).as_matrix()
    half = torch.from_numpy(turned).float() * scene.scales[:, None]
    return half @ half.transpose(1, 2)


@pytest.fixture(scope="module")
def run(nerfstudio: Any, small: DemoRoom, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """config.yml of the small room's run."""
    from nerfstudio.utils import writer  # noqa: PLC0415

    folder, writers = tmp_path_factory.mktemp("demo"), list(writer.EVENT_WRITERS)
    write_capture(small, folder / "room", views=4, held_out=2, width=160, height=120)
    config = write_splatfacto_run(small, folder / "room", folder / "outputs")
    assert writers == writer.EVENT_WRITERS  # a thread of tensorboard would write on when the folder is gone
    assert not list(config.parent.glob("events.out.*"))
    return config


@pytest.mark.slow
def test_run_is_complete(run: Path, small: DemoRoom):
    assert run.parts[-4:-2] == ("room", "splatfacto")
    assert (run.parent / "dataparser_transforms.json").is_file()
    [path] = (run.parent / "nerfstudio_models").iterdir()
    assert path.name == "step-000000000.ckpt"
    assert b"numpy" in path.read_bytes()  # scalars, as in every stock checkpoint
    checkpoint = torch.load(path, weights_only=False)
    assert set(checkpoint) == {"step", "pipeline", "optimizers", "schedulers", "scalers"}
    groups = {"means", "scales", "quats", "features_dc", "features_rest", "opacities"}
    assert set(checkpoint["optimizers"]) == groups
    for name in groups:
        value = checkpoint["pipeline"][f"_model.gauss_params.{name}"]
        assert checkpoint["optimizers"][name]["state"][0]["exp_avg"].shape == value.shape
        assert len(value) == len(small.scene)
    assert not checkpoint["pipeline"]["_model.gauss_params.features_rest"].any()


@pytest.mark.slow
def test_gaussians_show_the_capture_in_the_world_of_the_dataparser(run: Path, small: DemoRoom):
    config = yaml.load(run.read_text(), Loader=yaml.Loader)
    assert config.method_name == "splatfacto"
    dataparser = config.pipeline.datamanager.dataparser
    dataparser.data = config.pipeline.datamanager.data
    [path] = (run.parent / "nerfstudio_models").iterdir()
    state = torch.load(path, weights_only=False)["pipeline"]
    means, quats, scales, opacities, color = (
        state[f"_model.gauss_params.{name}"] for name in ("means", "quats", "scales", "opacities", "features_dc")
    )
    scene = GaussianScene(means, quats, scales.exp(), opacities.sigmoid()[:, 0])
    assert not torch.allclose(means, small.scene.means, atol=0.1)
    for split, count in (("train", 4), ("test", 2)):
        outputs = dataparser.setup().get_dataparser_outputs(split)
        assert len(outputs.image_filenames) == count
        for i, file in enumerate(outputs.image_filenames):
            image, _ = render(scene, opencv_camera(outputs.cameras[i]), color * 0.28209479177387814 + 0.5)
            photo = torch.from_numpy(np.array(Image.open(file))) / 255
            assert -10 * (image - photo).square().mean().log10() > 45  # PSNR; rounding to 8 bits alone gives 59


def opencv_camera(camera) -> Camera:
    pose = torch.eye(4)
    pose[:3] = camera.camera_to_worlds * torch.tensor([1, -1, -1, 1])
    return Camera(camera.get_intrinsics_matrices(), pose.inverse(), int(camera.width), int(camera.height))
