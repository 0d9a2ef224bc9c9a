import itertools
import math
import sys
import urllib.error
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import pytest
import torch

from normlift_ns import SemanticField
from normlift_ns.query import engine
from normlift_ns.query.question import Query
from normlift_ns.rasterization.rasterize import render, render_image
from normlift_ns.rasterization.settings import RasterSettings
from normlift_ns.rendering.figures import make_display
from tests.nerfstudio_plugin.conftest import asking, lifted_field, opened, set_up, write
from tests.nerfstudio_plugin.stock_run import SmallLpips, StockRun, splatfacto_on_cpu, train_splatfacto

STOCK = ["rgb", "depth", "accumulation", "background"]
LPIPS = "torchmetrics.image.lpip.LearnedPerceptualImagePatchSimilarity"
SEMANTIC = ["reliability", "reliability_value", "n_eff", "selection", "segmentation", "overlay"]


@pytest.fixture
def pipeline(stock_lifted: Path, registered: None, monkeypatch: pytest.MonkeyPatch) -> Any:
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    return set_up(stock_lifted)


def _outputs(pipeline: Any, index: int = 0, obb_box: Any = None) -> dict[str, torch.Tensor]:
    _ = pipeline.datamanager.cached_train  # rewrites the cameras
    return pipeline.model.get_outputs_for_camera(pipeline.datamanager.train_dataset.cameras[index : index + 1], obb_box)


@contextmanager
def renderer(pipeline: Any, on_cpu: bool) -> Iterator[None]:
    """That of the CPU, or the way of CUDA: stock splatfacto, and gsplat for the scalars."""
    with pytest.MonkeyPatch.context() as patch, splatfacto_on_cpu():
        patch.setattr(type(pipeline.model), "renders_on_cpu", on_cpu)
        yield


def test_outputs_are_those_of_stock_splatfacto_and_of_the_run(pipeline: Any, stock: StockRun) -> None:
    run = opened(stock.config)
    for index in (0, 5):
        ours = _outputs(pipeline, index)
        with splatfacto_on_cpu():
            cameras = stock.pipeline.datamanager.train_cameras
            theirs = stock.pipeline.model.eval().get_outputs_for_camera(cameras[index : index + 1])
        assert theirs["rgb"].std() > 0.02
        for name, value in theirs.items():
            torch.testing.assert_close(ours[name], value, atol=2e-5, rtol=1e-4)
        picture = render_image(run, run.train.cameras[index])
        torch.testing.assert_close(picture.float() / 255, ours["rgb"], atol=0.51 / 255, rtol=0)


def test_a_run_is_drawn_by_the_rules_of_its_lift(pipeline: Any, stock: StockRun, monkeypatch) -> None:
    field, later = pipeline.model._field, RasterSettings.of_gsplat("1.6")
    monkeypatch.setattr(pipeline.model, "_field", replace(field, manifest={**field.manifest, "gsplat_rules": "1.6"}))
    pipeline.model.opacities.data.fill_(9)  # alpha is cut off at 0.99 by these rules, at 0.999 by those of 1.4
    camera, scene = opened(stock.config).train.cameras[2], pipeline.model._scene(None)
    alphas = [render(scene, camera, scene.means, settings=rules)[1] for rules in (later, RasterSettings())]
    assert (alphas[0] - alphas[1]).abs().max() > 1e-3
    torch.testing.assert_close(_outputs(pipeline, 2)["accumulation"][:, :, 0], alphas[0], atol=1e-6, rtol=0)


def test_any_size_and_field_of_view_give_a_picture(pipeline: Any) -> None:
    from nerfstudio.cameras.cameras import CameraType  # noqa: PLC0415
    from nerfstudio.viewer.utils import CameraState, get_camera  # noqa: PLC0415

    pose = pipeline.datamanager.train_dataset.cameras.camera_to_worlds[0]
    cases = [(1.0, pose, size) for size in ((0, 0), (-7, -7), (9, 0))]
    widths = (0.0, 1e-30, math.pi, 3.2, 2 * math.pi, -1.0, math.inf, math.nan)
    cases += [(fov, c2w, (8, 12)) for fov in widths for c2w in (pose, torch.full_like(pose, math.nan))]
    for fov, c2w, (height, width) in cases:
        state = CameraState(fov=fov, aspect=1.5, c2w=c2w, camera_type=CameraType.PERSPECTIVE)
        outputs = pipeline.model.get_outputs_for_camera(get_camera(state, height, width))
        assert [*STOCK, *SEMANTIC] == [name for name in outputs if not name.startswith("relevancy_")]
        expected = (height, width) if height == 8 else (1, 1)
        assert all(value.shape[:2] == expected and value.isfinite().all() for value in outputs.values()), (fov, width)


def test_colors_without_spherical_harmonics(workspace: Path, registered: None, tmp_path: Path) -> None:
    def configure(config) -> None:
        how = {"sh_degree": 0, "background_color": "white", "rasterize_mode": "antialiased"}
        vars(config.pipeline.model).update(how)

    trained = train_splatfacto(workspace, Path("scene"), configure=configure)
    run = opened(trained.config)
    pipeline = set_up(write(run, lifted_field(run), output_dir=tmp_path) / "config.yml")
    with splatfacto_on_cpu():
        cameras = trained.pipeline.datamanager.train_cameras
        theirs = trained.pipeline.model.eval().get_outputs_for_camera(cameras[1:2])
    torch.testing.assert_close(_outputs(pipeline, 1)["rgb"].cpu(), theirs["rgb"], atol=2e-5, rtol=1e-4)
    picture = render_image(run, run.train.cameras[1])
    torch.testing.assert_close(picture.float() / 255, theirs["rgb"], atol=0.51 / 255, rtol=0)
    assert pipeline.model.splat_parameters()[1:] == (False, "antialiased")  # as a PLY file of it has to say


def test_scalars_are_composited(pipeline: Any, stock: StockRun, field: SemanticField) -> None:
    run = opened(stock.config)
    asked = Query(("left", "right"), torch.eye(8)[:2], ("right",), torch.eye(8)[1:2], rule="margin")
    pipeline.model.attach(field, asked)
    answer = engine.run_query(field, run.gaussians.means, asked)
    chosen = answer.selected.any(dim=1).float()
    columns = {"relevancy_0": answer.relevancy[:, 0], "relevancy_1": answer.relevancy[:, 1], "selection": chosen}
    columns |= {"reliability_value": field.scalars.reliability, "n_eff": field.scalars.n_eff}
    expected, _ = render(run.gaussians, run.train.cameras[3], torch.stack(list(columns.values()), dim=1))
    for on_cpu in (False, True):
        with renderer(pipeline, on_cpu):
            outputs = _outputs(pipeline, 3)
        assert list(outputs) == [*STOCK, "relevancy_0", "relevancy_1", *SEMANTIC]
        for i, name in enumerate(columns):
            assert outputs[name].shape == (35, 47, 1)
            torch.testing.assert_close(outputs[name][..., 0], expected[..., i], atol=1e-6, rtol=1e-4)
    for name in ("overlay", "segmentation", "reliability"):
        assert outputs[name].shape == (35, 47, 3)
        assert 0 <= float(outputs[name].min()) <= float(outputs[name].max()) <= 1


def test_no_tracer_reaches_the_renderer(pipeline: Any) -> None:
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


@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs CUDA")
def test_cuda_outputs_are_those_of_the_cpu(stock_lifted: Path, registered: None) -> None:
    pipeline = set_up(stock_lifted)
    on_cuda = _outputs(pipeline)
    model = pipeline.model.cpu()
    model.attach(model.field.to("cpu"), asking("left", "right"))
    for name, value in _outputs(pipeline).items():
        gap = (on_cuda[name].cpu() - value).abs() - 1e-3 * value.abs()
        assert float((gap > 1e-3).float().mean()) < 1e-3, name  # pixels where an alpha is on the other side of 1/255
        assert float(gap.max()) < 0.02, name


def test_without_a_question_only_the_relevancies_are_missing(pipeline: Any) -> None:
    pipeline.model.attach(pipeline.model.field)
    outputs = _outputs(pipeline)
    assert list(outputs) == [*STOCK, *SEMANTIC]
    assert not outputs["selection"].any()
    grey = outputs["rgb"].mean(dim=2, keepdim=True).expand_as(outputs["rgb"])
    for name in ("overlay", "segmentation"):
        torch.testing.assert_close(outputs[name], grey)
    pipeline.model.show(None)
    assert list(_outputs(pipeline)) == STOCK


def test_hidden_gaussians_are_not_drawn_at_all(pipeline: Any, stock: StockRun) -> None:
    model, run = pipeline.model, opened(stock.config)
    answer = engine.run_query(model.field, model.means, asking("left", "right"))
    for alone, on_cpu in itertools.product((False, True), (False, True)):
        drawn = answer.selected[:, 0] == alone
        assert 5 < int(drawn.sum()) < 55
        scene = run.gaussians
        part = type(scene)(*(values[drawn] for values in (scene.means, scene.quats, scene.scales, scene.opacities)))
        _, alpha = render(part, run.train.cameras[0], torch.ones(int(drawn.sum()), 1))
        with renderer(pipeline, on_cpu):
            model.show(make_display(model.field, answer, shown=0, drawn=drawn))
            outputs = _outputs(pipeline)
            torch.testing.assert_close(outputs["accumulation"][..., 0], alpha, atol=1e-5, rtol=1e-4)
            selection = outputs["accumulation"] if alone else torch.zeros_like(outputs["accumulation"])
            torch.testing.assert_close(outputs["selection"], selection, atol=1e-5, rtol=1e-4)
            model.show(make_display(model.field, answer, shown=0))
            assert model.crop_box is None
            assert float(_outputs(pipeline)["accumulation"].sum()) > float(alpha.sum())


def test_a_crop_box_crops_the_scalars_too(pipeline: Any) -> None:
    from nerfstudio.data.scene_box import OrientedBox  # noqa: PLC0415

    model = pipeline.model
    middle = float(model.means[:, 2].detach().median())
    above = OrientedBox(torch.eye(3), torch.tensor([0.0, 0.0, middle + 5]), torch.tensor([10.0, 10.0, 10.0]))
    nowhere = OrientedBox(torch.eye(3), torch.tensor([0.0, 0.0, 50.0]), torch.tensor([1.0, 1.0, 1.0]))
    assert 0 < int(above.within(model.means).sum()) < 60
    everyone = engine.run_query(model.field, model.means, Query(("all",), torch.eye(8)[:1], threshold=-2.0))
    assert bool(everyone.valid.all())
    model.show(make_display(model.field, everyone))
    for on_cpu in (False, True):
        with renderer(pipeline, on_cpu):
            boxes = (None, above, nowhere, None)
            everything, cropped, empty, again = (_outputs(pipeline, obb_box=box) for box in boxes)
        torch.testing.assert_close(cropped["selection"], cropped["accumulation"], atol=1e-5, rtol=0)
        assert cropped["accumulation"].sum() < everything["accumulation"].sum()
        assert {name: value.shape for name, value in empty.items()} == {n: v.shape for n, v in cropped.items()}
        assert float(empty["accumulation"].abs().max()) == float(empty["selection"].abs().max()) == 0
        assert torch.equal(empty["rgb"], empty["background"])
        assert all(bool(value.isfinite().all()) for value in empty.values())
        assert again["accumulation"].sum() == everything["accumulation"].sum()  # the box is not left over


def test_what_is_hidden_cannot_be_clicked(pipeline: Any, stock: StockRun) -> None:
    model, camera = pipeline.model, opened(stock.config).train.cameras[0]
    pose = camera.world_to_camera.inverse()
    weights = model.ray_weights(pose[:3, 3], pose[:3, 2])
    front = int(weights.argmax())
    assert float(weights[front]) > 0.01
    answer = engine.run_query(model.field, model.means, asking("left", "right"))
    answer.selected[:] = (torch.arange(60) == front)[:, None]
    model.show(make_display(model.field, answer, drawn=~answer.mask))
    behind, others = model.ray_weights(pose[:3, 3], pose[:3, 2]), torch.arange(60) != front
    assert float(behind[front]) == 0 < behind.sum()
    assert (behind[others] >= weights[others]).all()


def test_loading_builds_no_lpips_and_reads_no_seed_points(stock_lifted: Path, registered: None, monkeypatch) -> None:
    from nerfstudio.models.splatfacto import SplatfactoModel  # noqa: PLC0415

    made, neighbors = [], SplatfactoModel.k_nearest_sklearn
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    monkeypatch.setattr(SplatfactoModel, "k_nearest_sklearn", lambda *how: made.append(how[1]) or neighbors(*how))
    monkeypatch.setattr(LPIPS, pytest.fail)
    monkeypatch.setattr("nerfstudio.data.dataparsers.nerfstudio_dataparser.Nerfstudio._load_3D_points", pytest.fail)
    pipeline = set_up(stock_lifted)
    _outputs(pipeline)
    assert not any("lpips" in name for name in pipeline.state_dict())
    assert (pipeline.model.num_points, [len(means) for means in made]) == (60, [4])


def test_eval_has_lpips_or_one_warning_where_there_is_no_internet(pipeline: Any, monkeypatch) -> None:
    monkeypatch.setattr(LPIPS, Mock(side_effect=urllib.error.URLError("no internet")))
    with pytest.warns(UserWarning, match=r"LPIPS .*no internet") as caught:
        metrics = pipeline.get_average_eval_image_metrics()
        again = pipeline.get_average_eval_image_metrics()
    assert len([w for w in caught if "LPIPS" in str(w.message)]) == 1
    assert metrics.keys() == again.keys() == {"psnr", "ssim", "num_rays_per_sec", "fps"}
    assert 5 < metrics["psnr"] < 40
    monkeypatch.setattr(LPIPS, SmallLpips)
    pipeline.model.lpips.available = True
    metrics = pipeline.get_average_eval_image_metrics()
    torch.testing.assert_close(metrics["lpips"], 10 ** (-metrics["psnr"] / 10), rtol=1e-4, atol=0)
    assert not any("lpips" in name for name in pipeline.state_dict())


def test_a_stock_checkpoint_loads_and_a_field_of_other_gaussians_does_not(stock_lifted: Path, stock: StockRun) -> None:
    from normlift_ns.nerfstudio_plugin.model import NormLiftModel, NormLiftModelConfig  # noqa: PLC0415

    how: Any = {"scene_box": None, "num_train_data": 9}
    seeds = (torch.rand(5, 3), torch.zeros(5, 3, dtype=torch.uint8))  # which need CUDA
    model = NormLiftModel(NormLiftModelConfig(num_random=20), seed_points=seeds, **how)
    assert model.num_points == (5 if torch.cuda.is_available() else 20)
    assert model.field is None

    semantics, theirs = stock_lifted.parent / "normlift", stock.pipeline
    state = {name.removeprefix("_model."): value.clone() for name, value in theirs.state_dict().items()}
    assert any(name.startswith("lpips.") for name in state)
    model = NormLiftModel(NormLiftModelConfig(num_random=20, semantics=semantics), **how)
    model.load_state_dict(dict(state), strict=True)
    assert torch.equal(model.means, theirs.model.means)
    assert model.field is not None
    state["gauss_params.means"][0, 0] += 1
    with pytest.raises(ValueError, match=rf"{semantics} was lifted from other Gaussians"):
        model.load_state_dict(dict(state), strict=True)
