"""`ns-train normlift` by nerfstudio's own Trainer."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import yaml
from nerfstudio.data.dataparsers.nerfstudio_dataparser import NerfstudioDataParserConfig
from nerfstudio.engine.trainer import TrainerConfig
from nerfstudio.utils.eval_utils import eval_setup
from PIL import Image

from normlift_ns.asking import answer
from normlift_ns.core.refine import RefineConfig
from normlift_ns.encoders.build import SourceOptions
from normlift_ns.errors import InputError
from normlift_ns.front_door import open_scene as load_scene
from normlift_ns.lifting import LiftOptions
from normlift_ns.method_configs.lerf_ovs import lerf_ovs_method
from normlift_ns.method_configs.normlift import normlift_method
from normlift_ns.method_configs.scannet import scannet_method
from normlift_ns.nerfstudio_plugin import pipeline as module
from normlift_ns.nerfstudio_plugin.config import rerooted
from normlift_ns.question import make_question
from normlift_ns.runs.question import load_question
from normlift_ns.text_encoders import encoder_of
from tests.nerfstudio_plugin.conftest import field_of
from tests.nerfstudio_plugin.stock_run import HEIGHT, WIDTH, StockRun, train_splatfacto

LIFT = LiftOptions(vote=RefineConfig(k=6))


@pytest.fixture
def train(workspace: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[..., StockRun]:
    """`ns-train normlift --pipeline.source.encoder colour …`; keywords are those of the pipeline's config."""
    methods = {m.config.method_name: m.config for m in (normlift_method, scannet_method)}
    monkeypatch.setattr("tests.nerfstudio_plugin.stock_run.method_configs", methods)
    monkeypatch.setattr("normlift_ns.raster.gsplat.composite", None)  # splatfacto's is replaced, ours not wanted

    def train(
        timestamp: str,
        method: str = "normlift",
        checkpoint: Path | None = None,
        prepare: Any = lambda trainer: None,
        steps: int = 2,
        model: Mapping[str, Any] | None = None,
        **pipeline: Any,
    ) -> StockRun:
        def configure(config: TrainerConfig) -> None:
            for name, value in (model or {}).items():
                setattr(config.pipeline.model, name, value)
            config.output_dir = Path("trained")
            config.pipeline.model.num_random = 60  # type: ignore[attr-defined]
            config.load_checkpoint = checkpoint
            values = {"source": SourceOptions(encoder="colour", region_count=12), "lift": LIFT, **pipeline}
            for name, value in values.items():
                setattr(config.pipeline, name, value)

        return train_splatfacto(
            workspace,
            Path("scene"),
            method=method,
            timestamp=timestamp,
            steps=steps,
            configure=configure,
            prepare=prepare,
        )

    return train


def test_the_run_is_lifted_in_place(train: Callable[..., StockRun], registered: None) -> None:
    trained = train("whole", queries=("red", "sky blue"))
    run_dir = trained.config.parent
    assert sorted(p.name for p in run_dir.iterdir() if not p.name.startswith("events")) == [
        "config.yml", "dataparser_transforms.json", "nerfstudio_models", "normlift",
    ]  # fmt: skip
    assert [p.name for p in (run_dir / "nerfstudio_models").iterdir()] == ["step-000000001.ckpt"]

    run = load_scene(trained.config)
    field = field_of(run)
    assert len(field) == 60
    assert field.scalars.reliability.max() > 0.2
    question = load_question(run_dir / "normlift")
    assert question is not None
    assert question.texts == ("red", "sky blue")
    expected = answer(field, run.gaussians.means, make_question(field, encoder_of(field).rows, ["red", "sky blue"]))

    model = trained.trainer.pipeline.model  # the viewer of the training
    assert torch.equal(model.normlift.answer.relevancy.cpu(), expected.relevancy)
    loaded = eval_setup(trained.config, update_config_callback=lambda c: rerooted(c, trained.config))[1].model
    assert torch.equal(loaded.normlift.answer.selected.cpu(), expected.selected)
    assert torch.equal(loaded.means.cpu(), model.means.cpu())

    stored = yaml.load(trained.config.read_text(), Loader=yaml.Loader)
    assert stored.pipeline.lift == LIFT
    assert stored.pipeline.source.encoder == "colour"
    again = load_scene(trained.config).config.pipeline
    assert (again.lift, again.queries) == (LIFT, ("red", "sky blue"))  # type: ignore[attr-defined]


@pytest.mark.parametrize("broken", ["lift_scene", "save_question", "make_question"])
def test_a_failing_lift_leaves_the_training_whole(
    train: Callable[..., StockRun], registered: None, monkeypatch, capsys, tmp_path: Path, broken: str
) -> None:
    def fail(*args: Any, **kwargs: Any) -> None:
        raise RuntimeError("out of luck")

    monkeypatch.setattr(module, broken, fail)
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path))
    trained = train(broken, queries=("red",))
    shown = capsys.readouterr()
    (log,) = (tmp_path / "normlift_ns").iterdir()
    assert f"RuntimeError: out of luck. The details are in {log}" in shown.out
    assert "Traceback" in log.read_text()
    assert "Traceback" not in shown.out + shown.err
    assert "The training is complete and saved" in shown.out
    assert f"ns-normlift --load-config {trained.trainer.base_dir / 'config.yml'}" in shown.out
    run = load_scene(trained.config)
    assert torch.equal(run.gaussians.means, trained.trainer.pipeline.model.means.detach())
    assert not (trained.config.parent / "normlift").exists()
    loaded = eval_setup(trained.config, update_config_callback=lambda c: rerooted(c, trained.config))[1].model
    assert loaded.field is None
    with pytest.raises(FileNotFoundError, match="without semantics"):
        field_of(run)


def test_mistakes_show_before_the_training(train: Callable[..., StockRun]) -> None:
    with pytest.raises(ValueError, match="orange"):
        train("typo", queries=("oragne",))
    with pytest.raises(FileNotFoundError, match=r"missing\.pt"):
        train("weights", source=SourceOptions(encoder_pretrained="missing.pt"))
    with pytest.raises(ValueError, match="regions-dir"):
        train("regions", source=SourceOptions(encoder="colour", regions="files"))
    lift = LiftOptions()
    vars(lift)["max_views"] = 0  # as --load-config brings it, past the constructor
    with pytest.raises(InputError, match=r"--pipeline\.lift: max_views must be at least 1"):
        train("range", lift=lift)


def test_data_that_cannot_be_lifted_show_before_the_training(
    train: Callable[..., StockRun], workspace: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    class Other(NerfstudioDataParserConfig):
        """As of a plugin."""

    with monkeypatch.context() as patched:
        patched.setattr(normlift_method.config.pipeline.datamanager, "dataparser", Other(load_3D_points=True))
        with pytest.raises(InputError, match=r"dataparser is a Other, expected NerfstudioDataParserConfig or Colmap"):
            train("parser")
    with monkeypatch.context() as patched:
        patched.setattr(module.os, "access", lambda path, mode: False)
        with pytest.raises(PermissionError, match=r"cannot be written, so the lift at the end of the training would"):
            train("locked")
    photograph = workspace / "scene" / "images" / "003.jpg"
    whole = photograph.read_bytes()
    try:
        Image.new("P", (WIDTH, HEIGHT)).save(photograph, "PNG")
        with pytest.raises(InputError, match=r"003\.jpg has pixels of kind P"):
            train("palette")
    finally:
        photograph.write_bytes(whole)


@pytest.fixture
def langsplat_options() -> SourceOptions:
    """Those of `ns-train normlift-lerf-ovs`."""
    pipeline: Any = lerf_ovs_method.config.pipeline
    return pipeline.source


def test_the_features_of_lerf_ovs_lie_in_the_scene(
    train: Callable[..., StockRun], workspace: Path, langsplat_options: SourceOptions, tmp_path: Path
) -> None:
    assert langsplat_options == SourceOptions(features="langsplat")
    with pytest.raises(FileNotFoundError) as caught:
        train("nothing", source=langsplat_options)
    for part in ("scene holds no features", "--pipeline.source.features-dir", "--pipeline.source.features none"):
        assert part in str(caught.value)

    folder = workspace / "scene" / "language_features"
    folder.mkdir()
    vectors = tmp_path / "texts.npz"
    np.savez(vectors, thing=np.eye(16)[0], wall=np.eye(16)[1])
    images = sorted((workspace / "scene" / "images").iterdir())
    try:
        for image in images:
            labels = np.zeros((HEIGHT - 1, WIDTH - 1), np.int32)
            labels[:, WIDTH // 2 :] = 1
            np.save(folder / f"{image.stem}_s.npy", labels)
            np.save(folder / f"{image.stem}_f.npy", np.eye(16, dtype=np.float32)[:2])
        given = replace(langsplat_options, text_vectors=vectors)
        trained = train("features", source=given, queries=("thing", "wall"))
        field = field_of(load_scene(trained.config))
        assert field.dimension == 16
        assert field.manifest["features"]["kind"] == "langsplat"
        (folder / f"{images[0].stem}_s.npy").unlink()
        with pytest.raises(FileNotFoundError, match=r"1 of \d+ images have no features"):
            train("one missing", source=given)
    finally:
        shutil.rmtree(folder)


def test_training_a_lifted_checkpoint_further_forgets_its_field(train: Callable[..., StockRun]) -> None:
    first = train("first")
    field = first.trainer.pipeline.model.field
    assert field is not None
    state = first.trainer.pipeline.state_dict()
    assert not any("normlift" in name for name in state)
    callbacks = first.trainer.pipeline.get_training_callbacks(
        module.TrainingCallbackAttributes(optimizers=None, grad_scaler=None, pipeline=None, trainer=None)
    )
    assert len(callbacks) == 2
    assert first.trainer.pipeline.model.field is None
    assert first.trainer.pipeline.model.config.semantics is None


def test_frozen_points_stay_where_they_are(train: Callable[..., StockRun]) -> None:
    before: dict[str, torch.Tensor] = {}

    def remember(trainer: Any) -> None:
        before.update({name: value.detach().clone() for name, value in trainer.pipeline.model.gauss_params.items()})

    model: Any = scannet_method.config.pipeline.model
    eager = {"warmup_length": 0, "refine_every": 1, "densify_grad_thresh": 0.0, "cull_alpha_thresh": 0.9}
    eager["stop_split_at"] = model.stop_split_at  # the method's own; all else would split and cull at once
    trained = train("frozen", method="normlift-scannet", prepare=remember, steps=5, model=eager)
    after = trained.trainer.pipeline.model.gauss_params
    assert torch.equal(before["means"], after["means"])
    assert all(not torch.equal(before[name], after[name]) for name in ("scales", "opacities", "features_dc"))
    outputs = trained.trainer.pipeline.datamanager.train_dataparser_outputs
    assert outputs.dataparser_scale == 1
    assert torch.equal(outputs.dataparser_transform, torch.eye(4)[:3])
    assert len(outputs.image_filenames) == 10
    run = load_scene(trained.config)
    assert (run.train.cameras[0].width, run.train.cameras[0].height) == (23, 17)  # half of 48 x 36, undistorted
    assert len(field_of(run)) == 60


def test_a_stock_checkpoint_is_trained_on_and_lifted(train: Callable[..., StockRun], stock: StockRun) -> None:
    """`ns-train normlift --load-checkpoint …`, with a full checkpoint, optimizers included."""
    (checkpoint,) = (stock.config.parent / "nerfstudio_models").iterdir()
    trained = train("further", checkpoint=checkpoint)
    run = load_scene(trained.config)
    assert run.checkpoint.step == 4  # the stock run ended with step 2
    assert len(field_of(run)) == 60
    before = load_scene(stock.config).gaussians
    assert (run.gaussians.means - before.means).abs().max() < 1e-2
