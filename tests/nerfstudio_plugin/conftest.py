"""Runs that the plugin's tests share. Importing nerfstudio takes 20 s, so all of them belong in one process."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest
import torch
from nerfstudio.configs.method_configs import all_methods

from benchmarks.captures import SHARED
from normlift_ns import SemanticField, lift, rasterize_evidence
from normlift_ns.method_configs.normlift import normlift_method
from normlift_ns.runs.files import load_field, run_directory
from normlift_ns.runs.write import write_run
from normlift_ns.scenes.nerfstudio.load import NerfstudioScene
from tests.nerfstudio_plugin.stock_run import StockRun, train_splatfacto, write_dataset


@pytest.fixture(scope="session")
def workspace(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The directory of a user: a dataset in scene/, runs below outputs/. Tests that change files take `copied`."""
    folder = tmp_path_factory.mktemp("user")
    write_dataset(folder / "scene")
    return folder


@pytest.fixture(scope="session")
def stock(workspace: Path) -> StockRun:
    """A stock run with view-dependent colours."""

    def prepare(trainer) -> None:
        rest = trainer.pipeline.model.features_rest.data
        rest.copy_(0.2 * torch.randn(rest.shape, generator=torch.Generator().manual_seed(0)))

    return train_splatfacto(workspace, Path("scene"), prepare=prepare, steps=3)


@pytest.fixture
def copied(stock: StockRun, tmp_path: Path) -> Path:
    """config.yml of a copy of the stock run, in a copy of its workspace."""
    shutil.copytree(stock.workspace, tmp_path / "moved", ignore=shutil.ignore_patterns("normlift"))
    return tmp_path / "moved" / stock.config.relative_to(stock.workspace)


@pytest.fixture
def registered(monkeypatch: pytest.MonkeyPatch) -> None:
    """Method normlift in nerfstudio's list, as the entry point of the installed package puts it there."""
    monkeypatch.setitem(all_methods, "normlift", normlift_method.config)


@pytest.fixture(params=["fox", "tabletop"])
def capture(request: pytest.FixtureRequest) -> Path:
    """config.yml of a real run."""
    config = SHARED / "captures" / "outputs" / request.param / "splatfacto" / "run" / "config.yml"
    if not config.exists():
        pytest.skip(f"needs the real captures, which are not part of the project: no {config}")
    return config


def lifted_field(run: NerfstudioScene, views: int | None = None) -> SemanticField:
    """A field of a run: the left half of every photograph shows one thing, the right half another.

    Args:
        views: lift that many, spread over all; None: all.
    """
    cameras = run.train.cameras[:: 1 if views is None else len(run.train) // views]
    labels = [(torch.arange(c.width) >= c.width // 2).int().expand(c.height, c.width) for c in cameras]
    evidence = rasterize_evidence(run.gaussians, cameras, labels, rasterize_mode=run.rasterize_mode)
    features = torch.eye(8)[:2].repeat(len(cameras), 1)
    return SemanticField.build(lift(evidence, features), run.gaussians.means, storage="float16", tolerance=1e-2)


def write(
    scene: NerfstudioScene,
    field: SemanticField,
    *,
    output_dir: Path | None = None,
    timestamp: str | None = None,
    **rest,
) -> Path:
    """Writes a lifted run where ns-normlift would; returns its directory."""
    run_dir = run_directory(output_dir or scene.runs_dir, scene.name, timestamp)
    write_run(scene, field, run_dir, **rest)
    return run_dir


def field_of(scene: NerfstudioScene) -> SemanticField:
    """The field of a lifted run."""
    return load_field(scene.location.run_dir, scene.gaussians.means, checkpoint=scene.checkpoint_path)
