"""The plugin on real captures, which are not part of the project."""

from pathlib import Path

import numpy as np
import pytest

from normlift_ns.rasterization.rasterize import render_image
from tests.captures import SHARED
from tests.nerfstudio_plugin.conftest import opened

pytestmark = pytest.mark.slow

EXPECTED = {  # photographs and Gaussians; PSNR against the first photographs, as nerfstudio measured it over all
    "fox": {"train": 45, "held_out": 5, "gaussians": 165578, "step": 11999, "psnr": 35.5},
    "tabletop": {"train": 44, "held_out": 4, "gaussians": 143471, "step": 6999, "psnr": 37.3},
}


def test_the_run_is_loaded_whole(capture: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    run = opened(capture)
    name = run.location.data.name
    counts = {"train": len(run.train), "held_out": len(run.held_out), "gaussians": len(run.gaussians)}
    assert {**counts, "step": run.checkpoint.step, "psnr": EXPECTED[name]["psnr"]} == EXPECTED[name]
    assert run.location.root == SHARED / "captures"
    files = sorted((SHARED / "fixtures" / "gsplat_weights").glob(f"{name}_view*_classic.npz"))
    assert len(files) >= 2
    for file in files:  # cameras are those that gsplat's kernels got
        fixture = np.load(file)
        camera = run.train.cameras[int(file.name.split("_view")[1][:2])]
        assert np.array_equal(camera.K.numpy(), fixture["K"])
        assert np.abs(camera.world_to_camera.numpy() - fixture["w2c"]).max() < 1e-6
        assert (camera.height, camera.width) == fixture["labels"].shape
    views = [run.train[i] for i in range(0, len(run.train), 6)]
    gaps = [(render_image(run, view.camera).float() - view.image.float()) / 255 for view in views]
    measured = [float(-10 * gap.square().mean().log10()) for gap in gaps]
    assert abs(np.mean(measured) - EXPECTED[name]["psnr"]) < 0.7
