"""`ns-train normlift` by nerfstudio's own Trainer."""

from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import numpy as np
import pytest
import torch
import yaml
from PIL import Image

from normlift_ns.errors import InputError
from normlift_ns.options import LiftOptions, RefineConfig, SourceOptions
from normlift_ns.query.engine import run_query
from normlift_ns.query.question import load_query, make_query
from normlift_ns.query.text_encoder import text_encoder_for
from tests.nerfstudio_plugin.conftest import field_of, opened, set_up
from tests.nerfstudio_plugin.stock_run import HEIGHT, WIDTH, StockRun, train_splatfacto

LIFT = LiftOptions(vote=RefineConfig(k=6))


@pytest.fixture
def methods() -> dict[str, Any]:
    """Configurations by the names of our methods."""
    from normlift_ns.method_configs import entry  # noqa: PLC0415

    ours = (entry.normlift_method, entry.lerf_ovs_method, entry.scannet_method)
    return {method.config.method_name: method.config for method in ours}


@pytest.fixture
def train(workspace: Path, methods: dict[str, Any], monkeypatch: pytest.MonkeyPatch) -> Iterator[Callable]:
    """`ns-train normlift --pipeline.source.encoder color …`; keywords are those of the pipeline's config."""
    monkeypatch.setattr("normlift_ns.rasterization.gsplat.composite", None)  # splatfacto's is replaced, ours not wanted

    def train(timestamp, method="normlift", model=None, how=None, **pipeline: Any) -> StockRun:
        def configure(config: Any) -> None:
            vars(config.pipeline.model).update({"num_random": 60, **(model or {})})
            config.output_dir = Path("trained")
            source = SourceOptions(encoder="color", region_count=12)
            vars(config.pipeline).update({"source": source, "lift": LIFT, **pipeline})

        what: dict[str, Any] = {"configure": configure, "timestamp": timestamp, "steps": 2, **(how or {})}
        return train_splatfacto(workspace, Path("scene"), method=methods[method], **what)

    serialization: Any = torch.serialization
    allowed = serialization.get_safe_globals() if hasattr(serialization, "get_safe_globals") else None
    yield train
    if allowed is not None:  # our pipeline has allowed numpy's numbers in the whole process
        serialization.clear_safe_globals()
        serialization.add_safe_globals(allowed)


def test_the_run_is_lifted_in_place(train: Any, workspace: Path, registered: None, capsys) -> None:
    from normlift_ns.nerfstudio_plugin.pipeline import TrainingCallbackAttributes  # noqa: PLC0415

    turned, exif = workspace / "scene" / "images" / "002.jpg", Image.Exif()
    exif[0x0112] = 6
    Image.open(turned).save(turned, exif=exif)
    trained = train("whole", queries=("red", "sky blue"))
    assert "Warning: Some image files have an EXIF rotation, which training ignores (1 of 9," in capsys.readouterr().out
    run_dir, expected_names = trained.config.parent, {"config.yml", "dataparser_transforms.json", "normlift"}
    assert {p.name for p in run_dir.glob("[!e]*")} == expected_names | {"nerfstudio_models"}  # and events
    assert [p.name for p in (run_dir / "nerfstudio_models").iterdir()] == ["step-000000001.ckpt"]
    run = opened(trained.config)
    field, question = field_of(run), load_query(run_dir / "normlift")
    assert len(field) == 60 and field.scalars.reliability.max() > 0.2
    assert question is not None and question.texts == ("red", "sky blue")
    asked = make_query(field, text_encoder_for(field).rows, ["red", "sky blue"])
    expected = run_query(field, run.gaussians.means, asked)

    model = trained.pipeline.model  # the viewer of the training
    assert torch.equal(model.normlift.answer.relevancy.cpu(), expected.relevancy)
    loaded = set_up(trained.config).model
    assert torch.equal(loaded.normlift.answer.selected.cpu(), expected.selected)
    assert torch.equal(loaded.means.cpu(), model.means.cpu())

    stored, again = yaml.load(trained.config.read_text(), Loader=yaml.Loader).pipeline, run.config.pipeline
    assert (stored.lift, stored.source.encoder) == (LIFT, "color")
    assert (again.lift, again.queries) == (LIFT, ("red", "sky blue"))
    assert not any("normlift" in name for name in trained.pipeline.state_dict())
    attributes = dict.fromkeys(("optimizers", "grad_scaler", "pipeline", "trainer"))
    assert len(trained.pipeline.get_training_callbacks(TrainingCallbackAttributes(**attributes))) == 2
    assert model.field is model.config.semantics is None  # a training that goes on changes the Gaussians


@pytest.mark.parametrize("broken", ["lift_scene", "save_query"])
def test_a_failing_lift_leaves_the_training_whole(train, registered, monkeypatch, capsys, tmp_path, broken) -> None:
    fail = Mock(side_effect=RuntimeError("out of luck"))
    monkeypatch.setattr(f"normlift_ns.nerfstudio_plugin.pipeline.{broken}", fail)
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "state"))
    trained = train(broken, queries=("red",))
    shown = capsys.readouterr()
    (log,) = (tmp_path / "state" / "normlift_ns").iterdir()
    config = trained.trainer.base_dir / "config.yml"
    for part in ("RuntimeError: out of luck", str(log), f"ns-normlift --load-config {config}"):
        assert part in shown.out
    assert "Traceback" in log.read_text() and "Traceback" not in shown.out + shown.err
    run = opened(trained.config)
    assert torch.equal(run.gaussians.means, trained.pipeline.model.means.detach())
    assert not (trained.config.parent / "normlift").exists()
    assert set_up(trained.config).model.field is None
    with pytest.raises(FileNotFoundError, match="without semantics"):
        field_of(run)


def test_mistakes_show_before_the_training(train: Any, workspace: Path, methods: Any, monkeypatch) -> None:
    from nerfstudio.data.dataparsers.nerfstudio_dataparser import NerfstudioDataParserConfig  # noqa: PLC0415

    class Other(NerfstudioDataParserConfig):
        """As of a plugin."""

    lift = LiftOptions()
    vars(lift)["max_views"] = 0  # as --load-config brings it, past the constructor
    for how, error, message in (
        ({"queries": ("oragne",)}, ValueError, "orange"),
        ({"source": SourceOptions(encoder_pretrained="missing.pt")}, FileNotFoundError, r"missing\.pt"),
        ({"source": SourceOptions(encoder="color", regions="files")}, ValueError, "regions-dir"),
        ({"lift": lift}, InputError, r"--pipeline\.lift: max_views .* 1"),
    ):
        with pytest.raises(error, match=message):
            train("mistake", **how)
    with monkeypatch.context() as patched:
        patched.setattr(methods["normlift"].pipeline.datamanager, "dataparser", Other(load_3D_points=True))
        with pytest.raises(InputError, match=r"dataparser is \S*Other, expected NerfstudioDataParserConfig"):
            train("parser")
    with monkeypatch.context() as patched:
        patched.setattr("normlift_ns.nerfstudio_plugin.pipeline.os.access", lambda path, mode: False)
        with pytest.raises(PermissionError, match=r"trained/.* cannot be written"):
            train("locked")
    Image.new("P", (WIDTH, HEIGHT)).save(workspace / "scene" / "images" / "003.jpg", "PNG")
    with pytest.raises(InputError, match=r"003\.jpg has the pixel format P"):
        train("palette")


def test_the_features_of_lerf_ovs_lie_in_the_scene(train: Any, workspace: Path, methods: Any, tmp_path: Path) -> None:
    options = methods["normlift-lerf-ovs"].pipeline.source
    assert options == SourceOptions(features="langsplat")
    how = r"--pipeline\.source\.features-dir.* --pipeline\.source\.features none"
    with pytest.raises(FileNotFoundError, match=rf"scene contains no LangSplat features(?s:.*){how}"):
        train("nothing", source=options)
    folder = workspace / "scene" / "language_features"
    folder.mkdir()
    vectors = tmp_path / "texts.npz"
    np.savez(vectors, thing=np.eye(16)[0], wall=np.eye(16)[1])
    images = sorted((workspace / "scene" / "images").iterdir())
    for image in images:
        labels = np.zeros((HEIGHT - 1, WIDTH - 1), np.int32)
        labels[:, WIDTH // 2 :] = 1
        np.save(folder / f"{image.stem}_s.npy", labels)
        np.save(folder / f"{image.stem}_f.npy", np.eye(16, dtype=np.float32)[:2])
    given = replace(options, text_embeddings=vectors)
    field = field_of(opened(train("features", source=given, queries=("thing", "wall")).config))
    assert (field.dimension, field.manifest["features"]["kind"]) == (16, "langsplat")
    (folder / f"{images[0].stem}_s.npy").unlink()
    with pytest.raises(FileNotFoundError, match=r"1 of \d+ images"):
        train("one missing", source=given)


def test_frozen_points_stay_where_they_are(train: Callable[..., StockRun], methods: dict[str, Any]) -> None:
    before: dict[str, torch.Tensor] = {}

    def remember(trainer: Any) -> None:
        before.update({name: value.detach().clone() for name, value in trainer.pipeline.model.gauss_params.items()})

    eager = {"warmup_length": 0, "refine_every": 1, "densify_grad_thresh": 0.0, "cull_alpha_thresh": 0.9}
    # the method's own; all else would split and cull at once
    eager["stop_split_at"] = methods["normlift-scannet"].pipeline.model.stop_split_at
    trained = train("frozen", "normlift-scannet", model=eager, how={"prepare": remember, "steps": 5})
    after = trained.pipeline.model.gauss_params
    assert torch.equal(before["means"], after["means"])
    assert all(not torch.equal(before[name], after[name]) for name in ("scales", "opacities", "features_dc"))
    outputs = trained.pipeline.datamanager.train_dataparser_outputs
    assert (outputs.dataparser_scale, len(outputs.image_filenames)) == (1, 10)
    assert torch.equal(outputs.dataparser_transform, torch.eye(4)[:3])
    run = opened(trained.config)
    assert (run.train.cameras[0].width, run.train.cameras[0].height) == (23, 17)  # half of 48 x 36, undistorted
    assert len(field_of(run)) == 60
