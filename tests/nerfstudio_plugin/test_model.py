from __future__ import annotations

import math
import sys
import urllib.error
from dataclasses import fields, replace
from pathlib import Path

import pytest
import torch
import yaml
from nerfstudio.cameras.cameras import CameraType
from nerfstudio.data.scene_box import OrientedBox
from nerfstudio.models.splatfacto import SplatfactoModel, SplatfactoModelConfig
from nerfstudio.utils.eval_utils import eval_setup
from nerfstudio.viewer.utils import CameraState, get_camera

from normlift_ns import asking
from normlift_ns.front_door import open_scene as load_scene
from normlift_ns.nerfstudio_plugin.config import rerooted
from normlift_ns.nerfstudio_plugin.model import NormLiftModel, NormLiftModelConfig
from normlift_ns.question import Question
from normlift_ns.raster.rasterize import render, render_picture
from normlift_ns.raster.settings import RasterSettings
from normlift_ns.viewer.display import make_display
from tests.nerfstudio_plugin.conftest import lifted_field, write
from tests.nerfstudio_plugin.stock_run import SmallLpips, StockRun, rasterization, splatfacto_on_cpu, train_splatfacto

QUESTION = Question(("left", "right"), torch.eye(8)[:2])
STOCK = ["rgb", "depth", "accumulation", "background"]
SEMANTIC = ["reliability", "reliability_value", "n_eff", "selection", "segmentation", "overlay"]


def _setup(config: Path):
    """`eval_setup` of stock nerfstudio, from any directory."""
    return eval_setup(config, update_config_callback=lambda loaded: rerooted(loaded, config))[1]


@pytest.fixture(scope="module")
def lifted(stock: StockRun, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """config.yml of a lifted run with two queries."""
    run = load_scene(stock.config)
    out = tmp_path_factory.mktemp("lifted")
    return write(run, lifted_field(run), question=QUESTION, output_dir=out) / "config.yml"


@pytest.fixture
def pipeline(lifted: Path, registered: None, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    return _setup(lifted)


def _outputs(pipeline, index: int = 0, obb_box: OrientedBox | None = None) -> dict[str, torch.Tensor]:
    pipeline.datamanager.cached_train  # noqa: B018 (rewrites the cameras)
    return pipeline.model.get_outputs_for_camera(pipeline.datamanager.train_dataset.cameras[index : index + 1], obb_box)


def test_cpu_outputs_are_those_of_stock_splatfacto(pipeline, stock: StockRun, monkeypatch: pytest.MonkeyPatch) -> None:
    theirs_model = stock.trainer.pipeline.model
    monkeypatch.setattr(theirs_model, "step", 30000)  # as splatfacto has it after loading
    theirs_model.eval()
    for index in (0, 5):
        ours = _outputs(pipeline, index)
        camera = stock.trainer.pipeline.datamanager.train_cameras[index : index + 1]
        with splatfacto_on_cpu():
            theirs = theirs_model.get_outputs_for_camera(camera)
        assert theirs["rgb"].std() > 0.02
        for name, value in theirs.items():
            torch.testing.assert_close(ours[name], value, atol=2e-5, rtol=1e-4)


def test_the_run_renders_what_the_model_renders(pipeline, stock: StockRun) -> None:
    run = load_scene(stock.config)
    picture = render_picture(run, run.train.cameras[2])
    torch.testing.assert_close(picture.float() / 255, _outputs(pipeline, 2)["rgb"], atol=0.51 / 255, rtol=0)


def test_a_run_is_drawn_by_the_rules_of_its_lift(pipeline, stock: StockRun, monkeypatch: pytest.MonkeyPatch) -> None:
    field, later = pipeline.model._field, RasterSettings.of_gsplat("1.6")
    monkeypatch.setattr(pipeline.model, "_field", replace(field, manifest={**field.manifest, "gsplat_rules": "1.6"}))
    pipeline.model.opacities.data.fill_(9)  # alpha is cut off at 0.99 by these rules, at 0.999 by those of 1.4
    camera, scene = load_scene(stock.config).train.cameras[2], pipeline.model._scene(None)
    alphas = [render(scene, camera, scene.means, settings=rules)[1] for rules in (later, RasterSettings())]
    assert (alphas[0] - alphas[1]).abs().max() > 1e-3
    torch.testing.assert_close(_outputs(pipeline, 2)["accumulation"][:, :, 0], alphas[0], atol=1e-6, rtol=0)


@pytest.mark.parametrize(("resolution", "aspect"), [(0, 1.0), (-7, 1.0), (9, 0.05)])
def test_a_picture_without_pixels_is_one_pixel(pipeline, resolution: int, aspect: float) -> None:
    cameras = pipeline.datamanager.train_dataset.cameras
    state = CameraState(fov=1.0, aspect=aspect, c2w=cameras.camera_to_worlds[0], camera_type=CameraType.PERSPECTIVE)
    camera = get_camera(state, resolution, int(resolution * aspect))
    outputs = pipeline.model.get_outputs_for_camera(camera)
    assert [*STOCK, *SEMANTIC] == [name for name in outputs if not name.startswith("relevancy_")]
    assert all(value.shape[:2] == (1, 1) and value.isfinite().all() for value in outputs.values())


@pytest.mark.parametrize("fov", [0.0, 1e-30, math.pi, 3.2, 2 * math.pi, -1.0, math.inf, math.nan])
def test_any_field_of_view_gives_a_picture(pipeline, fov: float) -> None:
    """nerfstudio's panel takes any number, and a camera that is refused would end its thread that draws."""
    pose = pipeline.datamanager.train_dataset.cameras.camera_to_worlds[0]
    for c2w in (pose, torch.full_like(pose, math.nan)):
        state = CameraState(fov=fov, aspect=1.5, c2w=c2w, camera_type=CameraType.PERSPECTIVE)
        outputs = pipeline.model.get_outputs_for_camera(get_camera(state, 8, 12))
        assert all(value.shape[:2] == (8, 12) and value.isfinite().all() for value in outputs.values())


def test_colours_without_spherical_harmonics(workspace: Path, registered: None, tmp_path: Path) -> None:
    def configure(config) -> None:
        config.pipeline.model.sh_degree = 0
        config.pipeline.model.background_color = "white"
        config.pipeline.model.rasterize_mode = "antialiased"

    trained = train_splatfacto(workspace, Path("scene"), configure=configure, timestamp="flat")
    run = load_scene(trained.config)
    pipeline = _setup(write(run, lifted_field(run), output_dir=tmp_path) / "config.yml")
    model = trained.trainer.pipeline.model.eval()
    with splatfacto_on_cpu():
        theirs = model.get_outputs_for_camera(trained.trainer.pipeline.datamanager.train_cameras[1:2])
    torch.testing.assert_close(_outputs(pipeline, 1)["rgb"].cpu(), theirs["rgb"], atol=2e-5, rtol=1e-4)
    torch.testing.assert_close(
        render_picture(run, run.train.cameras[1]).float() / 255, theirs["rgb"], atol=0.51 / 255, rtol=0
    )


def test_scalars_are_composited(pipeline, stock: StockRun) -> None:
    run = load_scene(stock.config)
    field = lifted_field(run)
    outputs = _outputs(pipeline, 3)
    assert list(outputs) == [*STOCK, "relevancy_0", "relevancy_1", *SEMANTIC]
    answer = asking.answer(field, run.gaussians.means, QUESTION)
    chosen = answer.selected.any(dim=1).float()
    columns = {"relevancy_0": answer.relevancy[:, 0], "relevancy_1": answer.relevancy[:, 1], "selection": chosen}
    columns |= {"reliability_value": field.scalars.reliability, "n_eff": field.scalars.n_eff}
    expected, _ = render(run.gaussians, run.train.cameras[3], torch.stack(list(columns.values()), dim=1))
    for i, name in enumerate(columns):
        assert outputs[name].shape == (35, 47, 1)
        torch.testing.assert_close(outputs[name][..., 0], expected[..., i], atol=1e-6, rtol=1e-5)
    for name in ("overlay", "segmentation", "reliability"):
        assert outputs[name].shape == (35, 47, 3)
        assert 0 <= float(outputs[name].min()) <= float(outputs[name].max()) <= 1
    assert 0 < outputs["reliability_value"].max() <= 1
    left, right = outputs["relevancy_0"][:, :20].mean(), outputs["relevancy_0"][:, 27:].mean()
    assert left > right


def test_no_tracer_reaches_the_renderer(pipeline) -> None:
    """nerfstudio's viewer raises from a tracer to interrupt a picture; in Numba's dispatcher that ends its thread."""
    files = set()

    def tracer(frame, event, arg):
        files.add(frame.f_code.co_filename.replace("\\", "/"))
        return tracer

    before = sys.gettrace()
    sys.settrace(tracer)
    try:
        outputs = _outputs(pipeline)
        assert sys.gettrace() is tracer
    finally:
        sys.settrace(before)
    assert outputs["overlay"].isfinite().all()
    assert any(file.endswith("nerfstudio_plugin/model.py") for file in files)
    assert not any(part in file for file in files for part in ("/raster/", "/numba/", "/matplotlib/", "legend.py"))


@pytest.mark.parametrize("cropped", [False, True])
def test_scalars_are_those_of_the_cpu(pipeline, stock: StockRun, cropped: bool) -> None:
    model, view = pipeline.model, load_scene(stock.config).train.cameras[0]
    rows = model.means[:, 2] > model.means[:, 2].median() if cropped else None
    values = torch.rand(model.num_points, 2)
    _, expected = model._render_on_cpu(view, values, rows)
    torch.testing.assert_close(model._composited(view, values, rows), expected, atol=1e-6, rtol=1e-4)
    assert model._composited(view, values[:, :0], rows).shape == (35, 47, 0)
    nothing = torch.zeros(model.num_points, dtype=torch.bool)
    assert not model._composited(view, values, nothing).any()


@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs CUDA")
def test_cuda_outputs_are_those_of_the_cpu(lifted: Path, registered: None) -> None:
    pipeline = _setup(lifted)
    on_cuda = _outputs(pipeline)
    model = pipeline.model.cpu()
    model.attach(model.field.to("cpu"), QUESTION)
    for name, value in _outputs(pipeline).items():
        gap = (on_cuda[name].cpu() - value).abs() - 1e-3 * value.abs()
        assert float((gap > 1e-3).float().mean()) < 1e-3, name  # pixels where an alpha is on the other side of 1/255
        assert float(gap.max()) < 0.02, name


def test_relevancy_of_stored_queries_uses_their_negatives(pipeline, stock: StockRun) -> None:
    field, negatives = pipeline.model.field, torch.eye(8)[1:2]
    pipeline.model.attach(field, Question(("left",), torch.eye(8)[:1], ("right",), negatives, rule="lerf"))
    values = field.relevancy(torch.eye(8)[:1], negatives, rule="lerf")
    run = load_scene(stock.config)
    expected, _ = render(run.gaussians, run.train.cameras[0], values)
    torch.testing.assert_close(_outputs(pipeline)["relevancy_0"], expected, atol=1e-6, rtol=1e-5)


def test_without_a_question_only_the_relevancies_are_missing(pipeline) -> None:
    pipeline.model.attach(pipeline.model.field)
    outputs = _outputs(pipeline)
    assert list(outputs) == [*STOCK, *SEMANTIC]
    assert not outputs["selection"].any()
    grey = outputs["rgb"].mean(dim=2, keepdim=True).expand_as(outputs["rgb"])
    for name in ("overlay", "segmentation"):
        torch.testing.assert_close(outputs[name], grey)
    pipeline.model.show(None)
    assert list(_outputs(pipeline)) == STOCK


def _by_cuda(pipeline, monkeypatch: pytest.MonkeyPatch) -> None:
    """Lets the model take the way of CUDA: stock splatfacto, and gsplat for the scalars."""
    monkeypatch.setattr(type(pipeline.model), "on_cpu", False)


@pytest.mark.parametrize("part", ["without the selection", "the selection alone"])
@pytest.mark.parametrize("on_cpu", [True, False])
def test_hidden_gaussians_are_not_drawn_at_all(pipeline, stock: StockRun, monkeypatch, part, on_cpu) -> None:
    model = pipeline.model
    answer = asking.answer(model.field, model.means, QUESTION)
    drawn = answer.selected[:, 0] == (part == "the selection alone")
    assert 5 < int(drawn.sum()) < 55
    _, alpha = render(
        _rows(load_scene(stock.config).gaussians, drawn),
        load_scene(stock.config).train.cameras[0],
        torch.ones(int(drawn.sum()), 1),
    )
    if not on_cpu:
        _by_cuda(pipeline, monkeypatch)
    model.show(make_display(model.field, answer, shown=0, drawn=drawn))
    with splatfacto_on_cpu():
        outputs = _outputs(pipeline)
    torch.testing.assert_close(outputs["accumulation"][..., 0], alpha, atol=1e-5, rtol=1e-4)
    whole = outputs["accumulation"] if part == "the selection alone" else torch.zeros_like(outputs["accumulation"])
    torch.testing.assert_close(outputs["selection"], whole, atol=1e-5, rtol=1e-4)
    everything = make_display(model.field, answer, shown=0)
    model.show(everything)
    assert model.crop_box is None
    with splatfacto_on_cpu():
        assert float(_outputs(pipeline)["accumulation"].sum()) > float(alpha.sum())


@pytest.mark.parametrize("prompts", [0, 1, 20])
@pytest.mark.parametrize("on_cpu", [True, False])
def test_an_overlay_costs_one_pass_of_scalars(pipeline, monkeypatch, on_cpu: bool, prompts: int) -> None:
    """None at all on the CPU, where they go with the colours; without semantics nothing is added."""
    model, passes = pipeline.model, []

    def counted(name: str, rasterizer, channels):
        def call(*args, **options):
            if (name, channels(args)) != ("scalars", 0):  # nothing to draw
                passes.append((name, channels(args)))
            return rasterizer(*args, **options)

        return call

    if not on_cpu:
        _by_cuda(pipeline, monkeypatch)
    counting = counted("cpu" if on_cpu else "scalars", render, lambda args: args[2].shape[1])
    monkeypatch.setattr("normlift_ns.nerfstudio_plugin.model.render", counting)
    question = Question(("left",) * prompts, torch.eye(8)[:1].expand(prompts, 8))
    with splatfacto_on_cpu():
        stock = counted("stock", rasterization, lambda _: 0)
        monkeypatch.setattr("nerfstudio.models.splatfacto.rasterization", stock)
        model.show(
            make_display(model.field, None if prompts == 0 else asking.answer(model.field, model.means, question))
        )
        _outputs(pipeline)
        assert passes == ([("cpu", 4 + prompts + 5)] if on_cpu else [("stock", 0), ("scalars", prompts + 5)])
        passes.clear()
        model.show(None)
        _outputs(pipeline)
        assert passes == ([("cpu", 4)] if on_cpu else [("stock", 0)])


def _rows(scene, rows):
    return type(scene)(scene.means[rows], scene.quats[rows], scene.scales[rows], scene.opacities[rows])


@pytest.mark.parametrize("on_cpu", [True, False])
def test_a_crop_box_crops_the_scalars_too(pipeline, monkeypatch, on_cpu) -> None:
    model = pipeline.model
    if not on_cpu:
        _by_cuda(pipeline, monkeypatch)
    middle = float(model.means[:, 2].detach().median())
    above = OrientedBox(torch.eye(3), torch.tensor([0.0, 0.0, middle + 5]), torch.tensor([10.0, 10.0, 10.0]))
    inside = above.within(model.means).reshape(-1)
    assert 0 < int(inside.sum()) < 60
    everyone = asking.answer(model.field, model.means, Question(("all",), torch.eye(8)[:1], threshold=-2.0))
    model.show(make_display(model.field, everyone))
    valid = everyone.valid.float()
    with splatfacto_on_cpu():
        everything = _outputs(pipeline)
        cropped = _outputs(pipeline, obb_box=above)
        nowhere = OrientedBox(torch.eye(3), torch.tensor([0.0, 0.0, 50.0]), torch.tensor([1.0, 1.0, 1.0]))
        empty = _outputs(pipeline, obb_box=nowhere)
        again = _outputs(pipeline)
    if bool(valid.all()):
        torch.testing.assert_close(cropped["selection"], cropped["accumulation"], atol=1e-5, rtol=0)
    assert float(cropped["selection"].sum()) < float(everything["selection"].sum())
    assert cropped["accumulation"].sum() < everything["accumulation"].sum()
    assert empty.keys() == cropped.keys()
    assert {name: value.shape for name, value in empty.items()} == {n: v.shape for n, v in cropped.items()}
    assert float(empty["accumulation"].abs().max()) == float(empty["selection"].abs().max()) == 0
    assert torch.equal(empty["rgb"], empty["background"])
    assert all(bool(value.isfinite().all()) for value in empty.values())
    assert again["accumulation"].sum() == everything["accumulation"].sum()  # the box is not left over


def test_what_is_hidden_cannot_be_clicked(pipeline, stock: StockRun) -> None:
    model, camera = pipeline.model, load_scene(stock.config).train.cameras[0]
    pose = camera.world_to_camera.inverse()
    weights = model.in_sight(pose[:3, 3], pose[:3, 2])
    front = int(weights.argmax())
    assert float(weights[front]) > 0.01
    answer = asking.answer(model.field, model.means, QUESTION)
    answer.selected[:] = (torch.arange(60) == front)[:, None]
    model.show(make_display(model.field, answer, drawn=~answer.mask))
    behind = model.in_sight(pose[:3, 3], pose[:3, 2])
    assert float(behind[front]) == 0
    others = torch.arange(60) != front
    assert (behind[others] >= weights[others]).all()
    assert behind.sum() > 0


def _pretend_lpips(monkeypatch: pytest.MonkeyPatch, replacement) -> None:
    monkeypatch.setattr("torchmetrics.image.lpip.LearnedPerceptualImagePatchSimilarity", replacement)


def test_loading_neither_builds_lpips_nor_reads_seed_points(
    lifted: Path, registered: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(*args, **kwargs) -> None:
        raise AssertionError("not wanted here")

    _pretend_lpips(monkeypatch, fail)
    monkeypatch.setattr("nerfstudio.data.dataparsers.nerfstudio_dataparser.Nerfstudio._load_3D_points", fail)
    pipeline = _setup(lifted)
    _outputs(pipeline)
    assert not any("lpips" in name for name in pipeline.state_dict())


def test_eval_without_internet_leaves_lpips_out_with_one_warning(pipeline, monkeypatch: pytest.MonkeyPatch) -> None:
    def offline(**options) -> None:
        raise urllib.error.URLError("no internet")

    _pretend_lpips(monkeypatch, offline)
    with pytest.warns(UserWarning, match=r"LPIPS is left out: .*no internet") as caught:
        metrics = pipeline.get_average_eval_image_metrics()
        again = pipeline.get_average_eval_image_metrics()
    assert len([w for w in caught if "LPIPS" in str(w.message)]) == 1
    assert metrics.keys() == again.keys() == {"psnr", "ssim", "num_rays_per_sec", "fps"}
    assert 5 < metrics["psnr"] < 40


def test_eval_with_lpips(pipeline, monkeypatch: pytest.MonkeyPatch) -> None:
    _pretend_lpips(monkeypatch, SmallLpips)
    metrics = pipeline.get_average_eval_image_metrics()
    torch.testing.assert_close(metrics["lpips"], 10 ** (-metrics["psnr"] / 10), rtol=1e-4, atol=0)
    assert not any("lpips" in name for name in pipeline.state_dict())


def test_a_lifted_run_opens_without_gaussians_of_chance(
    lifted: Path, stock: StockRun, registered: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    made, neighbours = [], SplatfactoModel.k_nearest_sklearn
    monkeypatch.setattr(SplatfactoModel, "k_nearest_sklearn", lambda *how: made.append(how[1]) or neighbours(*how))
    assert _setup(lifted).model.num_points == len(load_scene(stock.config).gaussians)
    assert [len(means) for means in made] == [4]


def test_seed_points_need_no_cuda(registered: None, workspace: Path) -> None:
    config = NormLiftModelConfig(num_random=20)
    seeds = (torch.rand(5, 3), torch.zeros(5, 3, dtype=torch.uint8))
    model = NormLiftModel(config, scene_box=None, num_train_data=3, seed_points=seeds)  # type: ignore[arg-type]
    assert model.num_points == (5 if torch.cuda.is_available() else 20)
    assert model.field is None


def test_a_stock_checkpoint_loads_whole_and_a_field_of_other_gaussians_does_not(
    lifted: Path, stock: StockRun, registered: None
) -> None:
    semantics = lifted.parent / "normlift"
    state = {name.removeprefix("_model."): value.clone() for name, value in stock.trainer.pipeline.state_dict().items()}
    assert any(name.startswith("lpips.") for name in state)
    model = NormLiftModel(NormLiftModelConfig(num_random=20, semantics=semantics), scene_box=None, num_train_data=9)  # type: ignore[arg-type]
    model.load_state_dict(dict(state), strict=True)
    assert torch.equal(model.means, stock.trainer.pipeline.model.means)
    assert model.field is not None
    state["gauss_params.means"][0, 0] += 1
    with pytest.raises(ValueError, match=rf"field in {semantics} was lifted from other Gaussians than those of .*same"):
        model.load_state_dict(dict(state), strict=True)


def test_every_field_of_a_splatfacto_config_is_taken_over() -> None:
    config = SplatfactoModelConfig()
    for f in fields(config):
        if f.name not in ("_target", "camera_optimizer"):
            setattr(config, f.name, f"value of {f.name}")
    upgraded = NormLiftModelConfig.upgrade(config, semantics=Path("x"))
    assert upgraded._target is NormLiftModel
    for f in fields(SplatfactoModelConfig):
        assert f.name == "_target" or getattr(upgraded, f.name) == getattr(config, f.name)
    assert upgraded.semantics == Path("x")
    assert NormLiftModelConfig.upgrade(upgraded).semantics is None
    assert yaml.load(yaml.dump(upgraded), Loader=yaml.Loader) == upgraded
