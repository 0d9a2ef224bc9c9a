"""nerfstudio's own commands on lifted runs, in this process and as a user starts them, on the CPU."""

import gzip
import os
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from PIL import Image

from normlift_ns import open_run, open_scene, render
from normlift_ns.cli import query
from normlift_ns.data.splat import SplatParameters
from normlift_ns.options import SourceOptions, SplatOptions
from normlift_ns.query.question import load_query
from tests.cli.conftest import run_entry, said
from tests.data.scene_files import ply_columns, write_ply

BIN = Path(sys.executable).parent
ENVIRONMENT = os.environ | {"CUDA_VISIBLE_DEVICES": ""}
SCALARS = ["selection", "reliability_value", "n_eff", "relevancy_0", "relevancy_1"]
NAMES = ["overlay", "segmentation", "reliability", *SCALARS]


@pytest.fixture(scope="module")
def stranger(little: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """config.yml of a lifted run of a PLY file, where no run of nerfstudio ever existed."""
    from normlift_ns.cli.lift import NormLift  # noqa: PLC0415

    folder = tmp_path_factory.mktemp("stock")
    shutil.copytree(little.parents[4] / "room", folder / "room")
    ply = write_ply(folder / "splat.ply", ply_columns(SplatParameters(**open_scene(little).parameters)))
    world = little.parent / "dataparser_transforms.json"
    cameras = SplatOptions(transforms=folder / "room", world_transform=world, rasterize_mode="classic")
    source = SourceOptions(encoder="color", region_count=64)
    options = {"timestamp": "t", "queries": ("red",), "source": source, "output_dir": folder / "outputs"}
    config = NormLift(load_ply=ply, splat=cameras, **options).main().config
    ply.unlink()  # it is not needed any more
    return config


@pytest.mark.slow
def test_ns_render_draws_reliability_and_relevancy(stranger, tmp_path):
    names = ("rgb", "reliability", "relevancy_0")
    flags = ("dataset", "--load-config", stranger, "--output-path", "out", "--image-format", "png", "--split", "test")
    words = [str(BIN / "ns-render"), *map(str, flags), "--rendered-output-names", *names]
    how = {"env": ENVIRONMENT, "capture_output": True, "text": True, "timeout": 300}
    done = subprocess.run(words, cwd=tmp_path, check=False, **how)
    assert done.returncode == 0, done.stdout + done.stderr
    for name in names:
        pictures = sorted((tmp_path / "out" / "test" / name).iterdir())
        assert len(pictures) == 2
        assert all(np.ptp(np.asarray(Image.open(path).convert("RGB"))) > 50 for path in pictures), name
    rendered = np.asarray(Image.open(tmp_path / "out" / "test" / "rgb" / "0006.png").convert("RGB")).astype(float)
    photo = np.asarray(Image.open(stranger.parents[4] / "room" / "images" / "0006.png").convert("RGB"))
    assert np.abs(rendered - photo).mean() < 3


@pytest.fixture(autouse=True)
def without_encoders(nerfstudio: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    from normlift_ns.method_configs.normlift import normlift_method  # noqa: PLC0415

    def never(*args: object) -> None:
        raise AssertionError("an encoder was made")

    monkeypatch.setitem(nerfstudio.all_methods, "normlift", normlift_method.config)
    monkeypatch.setattr("normlift_ns.nerfstudio_plugin.panel.text_encoder_for", never)


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


def test_queries_are_stored_and_replaced_beside_their_checkpoint(lifted, tmp_path, monkeypatch, capsys) -> None:
    copy = tmp_path / "outputs" / "room" / "normlift" / "one" / "config.yml"
    shutil.copytree(lifted.parent, copy.parent)
    flags = ("--load-config", copy, "--data", lifted.parents[4] / "room", "--save-query", "True")
    rule = ("--threshold", "0.7", "--min-reliability", "0.25", "--refined", "False")
    assert run_entry(monkeypatch, query.entrypoint, *flags, "--text", "teal", "pink", "orange", *rule) == 0
    stored = load_query(copy.parent / "normlift")
    assert stored is not None and stored.texts == ("teal", "pink", "orange")
    assert (stored.threshold, stored.min_reliability, stored.refined) == (0.7, 0.25, False)
    before = (copy.parent / "normlift" / "queries.safetensors").read_bytes()
    assert run_entry(monkeypatch, query.entrypoint, *flags, "--text", "oragne") == 1
    assert (copy.parent / "normlift" / "queries.safetensors").read_bytes() == before
    assert run_entry(monkeypatch, query.entrypoint, *flags[:-2], "--text", "red") == 0
    assert (copy.parent / "normlift" / "queries.safetensors").read_bytes() == before
    (checkpoint,) = (copy.parent / "nerfstudio_models").iterdir()
    checkpoint.write_bytes(checkpoint.read_bytes() + b"of another run")
    assert run_entry(monkeypatch, query.entrypoint, *flags[:-2], "--text", "red") == 1
    assert checkpoint.name in said(capsys)
