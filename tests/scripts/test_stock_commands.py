"""Stock ns-render and ns-eval on a lifted run: the queries stored in the run are rendered, without a text encoder."""

from __future__ import annotations

import gzip
import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from PIL import Image

from normlift_ns import open_run, render
from normlift_ns.front_door import open_scene as load_scene
from normlift_ns.runs.question import load_question
from normlift_ns.scripts import query
from tests.scripts.conftest import run_entry

SCALARS = ["selection", "reliability_value", "n_eff", "relevancy_0", "relevancy_1"]
NAMES = ["overlay", "segmentation", "reliability", *SCALARS]


@pytest.fixture(autouse=True)
def without_encoders(nerfstudio: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    from normlift_ns.method_configs.normlift import normlift_method  # noqa: PLC0415

    def never(*args: object) -> None:
        raise AssertionError("an encoder was made")

    monkeypatch.setitem(nerfstudio.all_methods, "normlift", normlift_method.config)
    monkeypatch.setattr("normlift_ns.nerfstudio_plugin.asker.encoder_of", never)


def test_ns_render_dataset(lifted: Path, tmp_path: Path) -> None:
    from nerfstudio.scripts.render import DatasetRender  # noqa: PLC0415

    names = [*NAMES, "raw-relevancy_1", "raw-selection", "depth"]
    DatasetRender(lifted, output_path=tmp_path, rendered_output_names=names, split="test", image_format="png").main()
    run = open_run(lifted)
    answer = run.ask("red", "yellow")  # as stored
    values = torch.stack([answer.relevancy[:, 1], answer.selected.any(dim=1).float()], dim=1)
    for name, camera in zip(run.scene.held_out.names, run.scene.held_out.cameras):
        expected, _ = render(run.scene.gaussians, camera, values)
        for i, output in enumerate(("raw-relevancy_1", "raw-selection")):
            with gzip.open(tmp_path / "test" / output / f"{Path(name).stem}.npy.gz") as file:
                assert np.allclose(np.load(file)[..., 0], expected[..., i].numpy(), atol=1e-5)
        overlay = np.asarray(Image.open(tmp_path / "test" / "overlay" / f"{Path(name).stem}.png")).astype(int)
        found = expected[..., 1].numpy() > 0.9
        assert found.sum() > 50
        assert (np.ptp(overlay[found], axis=1) > 20).mean() > 0.95  # the least relevant are faint
        assert (np.ptp(overlay[expected[..., 1].numpy() < 0.01], axis=1) < 8).mean() > 0.99
    assert {path.name for path in (tmp_path / "test").iterdir()} == set(names)


def test_ns_render_draws_every_output(little_lifted: Path, tmp_path: Path) -> None:
    from nerfstudio.scripts.render import DatasetRender  # noqa: PLC0415

    DatasetRender(little_lifted, output_path=tmp_path, split="test", image_format="png").main()
    stock = {"gt-rgb", "rgb", "depth", "accumulation", "background"}
    assert {path.name for path in (tmp_path / "test").iterdir()} == stock | set(NAMES)


def test_ns_render_camera_path_and_interpolate(lifted: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from nerfstudio.scripts.render import RenderCameraPath, RenderInterpolated  # noqa: PLC0415

    monkeypatch.setattr("nerfstudio.utils.install_checks.check_ffmpeg_installed", lambda: None)  # for videos only
    pose = np.vstack([load_scene(lifted).train._poses[0].numpy(), [0, 0, 0, 1]])
    camera = {"camera_to_world": pose.flatten().tolist(), "fov": 60, "aspect": 1}
    path = {"camera_type": "perspective", "render_height": 40, "render_width": 60, "camera_path": [camera] * 2}
    (tmp_path / "path.json").write_text(json.dumps({**path, "seconds": 1, "fps": 2}))
    options = {"rendered_output_names": ["overlay", "relevancy_0"], "output_format": "images", "image_format": "png"}
    of_a: Any = {"camera_path_filename": tmp_path / "path.json", "output_path": tmp_path / "a" / "x.mp4", **options}
    of_b: Any = {"pose_source": "eval", "interpolation_steps": 2, "output_path": tmp_path / "b" / "x.mp4", **options}
    RenderCameraPath(lifted, **of_a).main()
    RenderInterpolated(lifted, **of_b).main()
    for folder, size in (("a", (120, 40)), ("b", (320, 120))):
        pictures = sorted((tmp_path / folder / "x").iterdir())
        assert len(pictures) == 2
        assert Image.open(pictures[0]).size == size


def test_ns_eval(lifted: Path, tmp_path: Path) -> None:
    from nerfstudio.scripts.eval import ComputePSNR  # noqa: PLC0415

    with pytest.warns(UserWarning, match="LPIPS"):
        ComputePSNR(lifted, output_path=tmp_path / "eval.json", render_output_path=tmp_path / "pictures").main()
    document = json.loads((tmp_path / "eval.json").read_text())
    assert document["method_name"] == "normlift" and document["results"]["psnr"] > 25
    assert (tmp_path / "pictures").exists()


def test_queries_are_stored_and_replaced(lifted: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    copy = tmp_path / "outputs" / "room" / "normlift" / "one" / "config.yml"
    shutil.copytree(lifted.parent, copy.parent)
    flags = ("--load-config", copy, "--data", lifted.parents[4] / "room", "--save", "True")
    rule = ("--threshold", "0.7", "--min-reliability", "0.25", "--refined", "False")
    assert run_entry(monkeypatch, query.entrypoint, *flags, "--text", "teal", "pink", "orange", *rule) == 0
    stored = load_question(copy.parent / "normlift")
    assert stored is not None and stored.texts == ("teal", "pink", "orange")
    assert (stored.threshold, stored.min_reliability, stored.refined) == (0.7, 0.25, False)
    before = (copy.parent / "normlift" / "queries.safetensors").read_bytes()
    assert run_entry(monkeypatch, query.entrypoint, *flags, "--text", "oragne") == 1
    assert (copy.parent / "normlift" / "queries.safetensors").read_bytes() == before
    assert run_entry(monkeypatch, query.entrypoint, *flags[:-2], "--text", "red") == 0
    assert (copy.parent / "normlift" / "queries.safetensors").read_bytes() == before
