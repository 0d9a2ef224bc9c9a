"""2D Gaussians are told by what their files say, never by their scales, and stay what they are in a lifted run."""

import json
from dataclasses import replace
from pathlib import Path

import pytest
import torch

import normlift_ns as nl
from normlift_ns.data.alignment import measure_alignment
from normlift_ns.data.open_splat import _read, _with_primitive
from normlift_ns.data.splat import SplatParameters, read_ply
from normlift_ns.errors import InputError
from normlift_ns.evidence_collection import RasterConfig, ViewBatch, evidence_keys
from tests.data.scene_files import ply_columns, random_splat, write_gsplat, write_ply

CONFIG = {"data_dir": "a", "result_dir": "b", "model_type": "2dgs", "antialiased": True, "near_plane": 0.3}
"""As simple_trainer_2dgs.py writes cfg.json, in part."""


def test_a_ply_file_with_two_scales_holds_2d_gaussians(tmp_path: Path) -> None:
    splat, columns = random_splat(), ply_columns(random_splat())
    del columns["scale_2"]
    path = write_ply(tmp_path / "a.ply", columns)
    found = read_ply(path)
    assert found.primitive == "2dgs"
    assert torch.equal(found.splat.scales[:, :2], splat.scales[:, :2])
    ratio = found.splat.activated.scales[:, 2] / splat.activated.scales[:, :2].amin(dim=1)
    torch.testing.assert_close(ratio, torch.full((200,), 1e-3))
    with pytest.raises(InputError, match=r"a\.ply has 2dgs Gaussians.*--primitive is 3dgs"):
        _with_primitive(found, path, nl.SplatOptions(primitive="3dgs"))


def test_the_primitive_is_that_of_options_settings_or_file_name(tmp_path: Path) -> None:
    flat = random_splat()
    flat.scales[:, 2] = -20  # which says nothing

    def opened(name: str, **options: str) -> tuple[object, ...]:
        path = tmp_path / name
        path.parent.mkdir(exist_ok=True)
        path = write_gsplat(path, flat) if name.endswith(".pt") else write_ply(path, ply_columns(flat))
        file = _with_primitive(_read(path), path, nl.SplatOptions(**options))
        if file.primitive == "3dgs":
            assert torch.equal(file.splat.scales, flat.scales)
        else:
            assert file.rasterize_mode == "classic"
        return file.primitive, file.clip_planes

    assert opened("a.ply") == opened("ckpt_29999.pt") == ("3dgs", None)
    assert opened("Garden_2DGS.ply") == opened("a.ply", primitive="2dgs") == ("2dgs", (0.2, 1e10))
    assert opened("garden_2dgs.ply", primitive="3dgs") == ("3dgs", None)
    with pytest.raises(InputError, match="omit --rasterize-mode antialiased"):
        opened("garden_2dgs.ply", rasterize_mode="antialiased")
    (tmp_path / "cfg.json").write_text(json.dumps({**CONFIG, "far_plane": 200}))
    assert opened("ckpts/ckpt_29999.pt") == opened("a.ply") == ("2dgs", (0.3, 200.0))
    with pytest.raises(InputError, match="--primitive is 3dgs"):
        opened("a.ply", primitive="3dgs")
    (tmp_path / "cfg.json").write_text(json.dumps({**CONFIG, "model_type": "3dgs"}))
    assert opened("a_2dgs.ply") == ("3dgs", None)


def test_a_lifted_run_stays_2d(trained: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    of_run = nl.open_scene(trained)
    path = write_ply(tmp_path / "room_2dgs.ply", ply_columns(SplatParameters(**of_run.parameters)))
    transforms, world = of_run.location.folder / "transforms.json", trained.parent / "dataparser_transforms.json"
    scene = nl.open_splat(path, nl.SplatOptions(transforms=transforms, world_transform=world))
    assert scene.gaussians.primitive == "2dgs"
    source = nl.SourceOptions(encoder="color", regions="grid", region_count=48)
    options = {"lift": nl.LiftOptions(refine=False, max_views=2), "source": source, "device": "cpu"}
    run = nl.lift_run(scene, output_dir=tmp_path / "out", check_alignment=False, **options)
    again = nl.open_run(run.config)
    assert again.scene.gaussians.primitive == again.field.manifest["primitive"] == "2dgs"
    assert again.field.manifest["clip_planes"] == [0.2, 1e10]
    assert measure_alignment(again.scene).psnr == pytest.approx(measure_alignment(scene).psnr, abs=1e-3)
    monkeypatch.setattr("normlift_ns.data.reduced_views._MAX_SIDE", 30)
    assert measure_alignment(scene).psnr > 10
    assert again.scene.gaussians.select(slice(5)).to("cpu").primitive == "2dgs"
    selected = again.field.scalars.reliability > 0
    assert len(again.votes.explain(selected).views) > 0  # its evidence is found in the cache
    rows = again.export(tmp_path / "flat.ply")
    scales = read_ply(tmp_path / "flat.ply").splat.activated.scales
    torch.testing.assert_close(scales, again.scene.gaussians.scales[rows])
    assert float((scales[:, 2] / scales[:, :2].amin(dim=1)).max()) < 1.01e-3


def test_evidence_of_3d_gaussians_is_never_taken_for_that_of_2d_ones() -> None:
    scene = random_splat(5).activated
    camera = nl.Camera(torch.eye(3), torch.eye(4), 2, 2)
    block = ViewBatch([camera], [torch.zeros(2, 2, dtype=torch.int32)], [torch.zeros(1, 1, dtype=torch.int32)], [])
    config = RasterConfig("1.4", "numba", torch.float32, "classic", 1)
    other = replace(config, clip_planes=(0.2, 1e10))
    keys = [evidence_keys(replace(scene, primitive=kind), block, config)[0] for kind in ("3dgs", "2dgs")]
    assert len({*keys, *evidence_keys(scene, block, other)}) == 3
