"""Runs that the plugin's tests share."""

import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
import yaml

from normlift_ns import SemanticField, lift, rasterize_evidence
from normlift_ns.data.nerfstudio.config import dump_config, read_trainer_config
from normlift_ns.data.nerfstudio.load import NerfstudioScene
from normlift_ns.data.open_scene import load_field
from normlift_ns.io.run_dir import run_directory
from normlift_ns.lifted_run import write_run
from normlift_ns.options import SourceOptions
from normlift_ns.query.question import Query
from normlift_ns.query.text_encoder import encoder_settings
from tests.nerfstudio_plugin.stock_run import StockRun, relocate_config, train_splatfacto, write_dataset


@pytest.fixture(scope="session", autouse=True)
def _imported(nerfstudio: Any) -> None:
    """Imports nerfstudio the fast way, before anything else imports it."""


@pytest.fixture
def workspace(tmp_path: Path) -> Path:
    write_dataset(tmp_path / "user" / "scene")
    return tmp_path / "user"


@pytest.fixture(scope="session")
def stock(made_once: Callable[..., Path], _imported: None) -> StockRun:
    """A stock run with view-dependent colors; tests that change its files take `copied`."""

    def prepare(trainer: Any) -> None:
        rest = trainer.pipeline.model.features_rest.data
        rest.copy_(0.2 * torch.randn(rest.shape, generator=torch.Generator().manual_seed(0)))

    return trained_once(made_once, "stock", write_dataset, prepare=prepare, steps=3)


@pytest.fixture
def copied(stock: StockRun, tmp_path: Path) -> Path:
    """config.yml of a copy of the stock run, in a copy of its workspace."""
    shutil.copytree(stock.workspace, tmp_path / "moved")
    return tmp_path / "moved" / stock.config.relative_to(stock.workspace)


@pytest.fixture(scope="session")
def field(stock: StockRun) -> SemanticField:
    return lifted_field(opened(stock.config))


@pytest.fixture(scope="session")
def stock_lifted(stock: StockRun, field: SemanticField, made_once: Callable[..., Path]) -> Path:
    """config.yml of a lifted copy of the stock run with two stored queries."""
    encoder = encoder_settings(SourceOptions(encoder="color"))
    colored = replace(field, manifest={**field.manifest, "encoder": encoder})
    how = {"question": asking("left", "right"), "timestamp": "run"}

    def make(folder: Path) -> None:
        write(opened(stock.config), colored, output_dir=folder, **how)

    return made_once("stock-lifted", make) / "scene" / "normlift" / "run" / "config.yml"


@pytest.fixture
def registered(nerfstudio: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    """Method normlift in nerfstudio's list, as the entry point of the installed package puts it there."""
    from normlift_ns.method_configs.normlift import normlift_method  # noqa: PLC0415

    monkeypatch.setitem(nerfstudio.all_methods, "normlift", normlift_method.config)


def trained_once(made_once: Callable[..., Path], name: str, write: Callable[[Path], Any], **how: Any) -> StockRun:
    def make(folder: Path) -> None:
        write(folder / "scene")
        train_splatfacto(folder, Path("scene"), **how)

    folder = made_once(name, make)
    return StockRun(folder, folder / "outputs" / "scene" / "splatfacto" / "run" / "config.yml")


def asking(*texts: str) -> Query:
    """About the two objects of `lifted_field`, and up, which nothing is."""
    return Query(texts, torch.eye(8)[[("left", "right", "up").index(text) for text in texts]])


def opened(config: Path, **how: Any) -> Any:
    from normlift_ns.data.open_scene import open_scene  # noqa: PLC0415

    return open_scene(config, **how)


def read(path: Path) -> Any:
    """config.yml in nerfstudio's classes."""
    return yaml.load(dump_config(read_trainer_config(path)), Loader=yaml.Loader)


def set_up(config: Path) -> Any:
    """The pipeline that stock nerfstudio's `eval_setup` makes of a run, from any directory; takes `registered`."""
    from nerfstudio.utils.eval_utils import eval_setup  # noqa: PLC0415

    return eval_setup(config, update_config_callback=lambda loaded: relocate_config(loaded, config))[1]


def lifted_field(run: NerfstudioScene) -> SemanticField:
    """A field of a run: the left half of every image shows one object, the right half another."""
    cameras = run.train.cameras
    labels = [(torch.arange(c.width) >= c.width // 2).int().expand(c.height, c.width) for c in cameras]
    evidence = rasterize_evidence(run.gaussians, cameras, labels, rasterize_mode=run.rasterize_mode)
    lifted = lift(evidence, torch.eye(8)[:2].repeat(len(cameras), 1))
    return SemanticField.build(lifted, run.gaussians.means, storage="float16", tolerance=1e-2)


def write(scene: NerfstudioScene, field: SemanticField, *, output_dir=None, timestamp=None, **rest: Any) -> Path:
    run_dir = run_directory(output_dir or scene.runs_dir, scene.name, timestamp)
    write_run(scene, field, run_dir, **rest)
    return run_dir


def field_of(scene: NerfstudioScene) -> SemanticField:
    return load_field(scene.location.run_dir, scene.gaussians.means, checkpoint=scene.checkpoint_path)
