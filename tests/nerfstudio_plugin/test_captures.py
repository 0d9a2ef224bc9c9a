"""The plugin on real captures, which are no part of the project."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from nerfstudio.utils.eval_utils import eval_setup

from benchmarks.captures import SHARED
from normlift_ns.front_door import open_scene as load_scene
from normlift_ns.nerfstudio_plugin.config import rerooted
from normlift_ns.raster.rasterize import render_picture
from tests.nerfstudio_plugin.conftest import field_of, lifted_field, write

pytestmark = pytest.mark.slow

EXPECTED = {  # photographs and Gaussians; PSNR against the first photographs, as nerfstudio measured it over all
    "fox": {"train": 45, "held_out": 5, "gaussians": 165578, "step": 11999, "psnr": 35.5},
    "tabletop": {"train": 44, "held_out": 4, "gaussians": 143471, "step": 6999, "psnr": 37.3},
}


def _psnr(a: torch.Tensor, b: torch.Tensor) -> float:
    return float(-10 * ((a.float() - b.float()) / 255).square().mean().log10())


def test_the_run_is_loaded_whole(capture: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    run = load_scene(capture)
    found = {
        "train": len(run.train),
        "held_out": len(run.held_out),
        "gaussians": len(run.gaussians),
        "step": run.checkpoint.step,
    }
    assert found == {name: value for name, value in EXPECTED[run.location.data.name].items() if name != "psnr"}
    assert run.location.root == SHARED / "captures"


def test_cameras_are_those_that_the_kernels_saw(capture: Path) -> None:
    run = load_scene(capture)
    files = sorted((SHARED / "fixtures" / "gsplat_weights").glob(f"{run.location.data.name}_view*_classic.npz"))
    assert len(files) >= 2
    for file in files:
        fixture = np.load(file)
        camera = run.train.cameras[int(file.name.split("_view")[1][:2])]
        assert np.array_equal(camera.K.numpy(), fixture["K"])
        assert np.abs(camera.world_to_camera.numpy() - fixture["w2c"]).max() < 1e-6
        assert (camera.height, camera.width) == fixture["labels"].shape


def test_renderings_are_as_close_to_the_photographs_as_the_training_left_them(capture: Path) -> None:
    run = load_scene(capture)
    measured = [
        _psnr(render_picture(run, view.camera), view.image)
        for view in (run.train[i] for i in range(0, len(run.train), 6))
    ]
    assert abs(np.mean(measured) - EXPECTED[run.location.data.name]["psnr"]) < 0.7


def test_a_lift_is_written_and_loaded_by_stock_nerfstudio(capture: Path, tmp_path: Path, registered: None) -> None:
    run = load_scene(capture)
    run_dir = write(run, lifted_field(run, views=5), output_dir=tmp_path)
    config = run_dir / "config.yml"
    pipeline: Any = eval_setup(config, update_config_callback=lambda loaded: rerooted(loaded, config))[1]
    assert torch.equal(pipeline.model.means, run.gaussians.means)
    assert torch.equal(field_of(load_scene(config)).source, pipeline.model.field.source)
    camera, batch = pipeline.datamanager.fixed_indices_eval_dataloader[0]
    outputs = pipeline.model.get_outputs_for_camera(camera)
    assert _psnr(outputs["rgb"] * 255, batch["image"]) > 25
    assert 0.1 < float(outputs["reliability"].mean()) < 1
