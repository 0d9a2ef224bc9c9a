"""One scene by every way in: evidence and answers are those of the nerfstudio run."""

import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

import normlift_ns as nl
from normlift_ns.data.frames import Frame
from normlift_ns.data.images import ImageViews
from normlift_ns.data.open_scene import open_saved_splat
from normlift_ns.data.splat import SplatParameters
from normlift_ns.data.transforms import gsplat_normalization, read_transforms, write_transforms
from normlift_ns.encoders.langsplat import FeatureExport
from normlift_ns.rasterization.rasterize import rasterize_evidence
from tests.data.scene_files import (
    frames_of,
    in_file_world,
    in_world,
    ply_columns,
    rows_of,
    saved_run,
    write_colmap,
    write_gsplat,
    write_ply,
)
from tests.random_scenes import generator

ROUNDED = 5e-4
"""Where the Gaussians themselves were moved to another world in float32, single pixels cross thresholds: 9e-5 seen."""
OPTIONS = {
    "source": nl.SourceOptions(encoder="color", regions="grid"),
    "lift": nl.LiftOptions(storage="evidence", max_views=4, vote=nl.RefineConfig(k=12)),
}


@pytest.fixture(scope="module")
def native(trained: Path):
    return nl.open_scene(trained)


@pytest.fixture(scope="module")
def splat(native) -> SplatParameters:
    return SplatParameters(**native.parameters)


@pytest.fixture(scope="module")
def frames(native) -> list[Frame]:
    """The cameras of the run, as nerfstudio has them, in the world of the splat."""
    return frames_of(native)


def difference(native, scene, views=(0, 3, 6, 9)) -> float:
    """Relative Frobenius difference of the evidence of some cells: of sums and random projections of its rows."""
    sums = []
    for one in (native, scene):
        cameras = [one.train.cameras[i] for i in views]
        labels = [(torch.arange(c.height)[:, None] // 16 * 10 + torch.arange(c.width) // 16).int() for c in cameras]
        evidence = rasterize_evidence(one.gaussians, cameras, labels, rasterize_mode=one.rasterize_mode)
        vectors = torch.randn(evidence.num_regions, 2, generator=generator(0), dtype=torch.float64)
        sums.append(torch.cat([evidence.rows.row_sums()[:, None], evidence.rows.matmul(vectors)], dim=1))
    return float((sums[0] - sums[1]).norm() / sums[0].norm())


@pytest.fixture
def of_run(native, trained: Path) -> nl.SplatOptions:
    world = trained.parent / "dataparser_transforms.json"
    return nl.SplatOptions(transforms=native.location.folder, world_transform=world)


def test_a_ply_file_with_the_transforms_of_the_run(native, splat, of_run, tmp_path: Path) -> None:
    said: list[str] = []
    scene = nl.open_splat(write_ply(tmp_path / "s.ply", ply_columns(splat)), of_run, say=said.append)
    assert scene.train.names == native.train.names
    assert scene.held_out.names == native.held_out.names  # transforms.json names them
    for fact in ("2 of 14", "classic", "Inria"):
        assert any(fact in text for text in said), fact
    for view, other in zip(scene.train, native.train):
        assert torch.equal(view.image, other.image)
        assert torch.equal(view.camera.K, other.camera.K)
        torch.testing.assert_close(view.camera.world_to_camera, other.camera.world_to_camera, atol=1e-7, rtol=0)
    assert difference(native, scene) < 1e-5
    camera = native.train.cameras[0]
    torch.testing.assert_close(scene.colors(camera), native.colors(camera))


@pytest.fixture
def given(native) -> nl.SplatOptions:
    return nl.SplatOptions(
        colmap=Path("p"), images=native.location.folder / "images", eval_images=tuple(native.held_out.names),
        gsplat_normalize=False,
    )  # fmt: skip


def test_a_ply_file_with_a_colmap_project(native, splat, frames, given, tmp_path: Path) -> None:
    matrix = np.diag([3.0, 3, 3, 1]) @ [[0, 0, 1, 2.0], [1, 0, 0, -1], [0, 1, 0, 0.5], [0, 0, 0, 1]]
    (tmp_path / "world.json").write_text(json.dumps(matrix.tolist()))
    path = write_ply(tmp_path / "s.ply", ply_columns(splat))
    there = in_file_world(frames, matrix)
    for binary, turned, world in ((True, frames, None), (False, there, tmp_path / "world.json")):
        project = write_colmap(tmp_path / f"p{binary}", turned, "PINHOLE", binary=binary)
        scene = nl.open_splat(path, replace(given, colmap=project, world_transform=world))
        assert scene.train.names == native.train.names
        assert difference(native, scene) < 1e-5


def _normalization(frames: list[Frame], points: np.ndarray) -> np.ndarray:
    """[4, 4]: the world in which gsplat trains."""
    world = gsplat_normalization(sorted(frames, key=lambda frame: frame.name), points)
    return np.vstack([world.scale * world.transform, [0, 0, 0, 1]])


def _before(frames: list[Frame], moves: torch.Tensor, kept: tuple[str, ...]) -> list[Frame]:
    """Poses to which gsplat's CameraOptModule gives those of the frames: pose = before @ move, by matrices."""
    trained = sorted((f for f in frames if f.name not in kept), key=lambda frame: frame.name)
    found = {frame.name: frame for frame in frames}
    for frame, move in zip(trained, moves.numpy()):
        first, second = move[3:6] + np.eye(3)[0], move[6:9] + np.eye(3)[1]
        third = np.cross(first, second)
        change = np.eye(4)
        change[:3, :3] = [axis / np.linalg.norm(axis) for axis in (first, np.cross(third, first), third)]
        change[:3, 3] = move[:3]
        opencv = np.vstack([frame.pose * [1, -1, -1, 1], [0, 0, 0, 1]])
        pose = (opencv @ np.linalg.inv(change))[:3] * [1, -1, -1, 1]
        found[frame.name] = replace(frame, pose=pose)
    return list(found.values())


@pytest.mark.parametrize("numbers", [(0,), pytest.param((1, 2, 3), marks=pytest.mark.slow)])
def test_a_normalized_world_is_found(native, splat, frames, given, tmp_path: Path, numbers: tuple[int, ...]) -> None:
    """PLY files of gsplat's trainer lie in it too. gsplat before 1.5 does not turn the world over, and signs of axes
    depend on the library that computes them."""
    points = splat.means.numpy()[::3]
    project = write_colmap(tmp_path / "p", frames, "PINHOLE", points=points)
    for number in numbers:
        half_turn = np.diag([*np.where(np.arange(3) == number - 1, 1.0, -1.0 if number else 1.0), 1])
        there = in_world(splat, half_turn @ _normalization(frames, points))
        if number == 0:
            path = write_ply(tmp_path / "point_cloud_29999.ply", ply_columns(there))
        else:
            path = write_gsplat(tmp_path / f"ckpt_{number}_rank0.pt", there)
        said: list[str] = []
        scene = nl.open_splat(path, replace(given, colmap=project, gsplat_normalize=True), say=said.append)
        axis = f" after half a turn about {'xyz'[number - 1]}" if number else ""
        assert scene.identity["source_world"]["name"] == f"gsplat's normalized world{axis}"
        assert any(f"gsplat's normalized world{axis} (" in text for text in said)
        assert not any("have no camera" in text for text in said)
        assert difference(native, scene) < ROUNDED


def test_the_lifted_run_opens_again_also_where_it_moved(native, splat, of_run, tmp_path: Path, monkeypatch) -> None:
    monkeypatch.chdir(tmp_path)
    capture = shutil.copytree(native.location.folder, tmp_path / "capture")
    path = write_ply(tmp_path / "s.ply", ply_columns(splat))
    scene = nl.open_splat(path, replace(of_run, transforms=capture))
    run = nl.lift_run(scene, timestamp="t", **OPTIONS)
    assert run.folder == tmp_path / "outputs" / "capture" / "normlift" / "t"
    path.unlink()  # the run holds its own copy
    of_native = nl.lift_run(native, output_dir=tmp_path / "native", timestamp="t", check_alignment=False, **OPTIONS)
    expected = of_native.ask("red", "yellow")
    again = nl.open_run(run.config)
    assert again.scene.train.names == scene.train.names
    assert again.scene.held_out.names == scene.held_out.names
    for view, other in zip(again.scene.train.cameras, scene.train.cameras):
        assert torch.equal(view.world_to_camera, other.world_to_camera)
        assert torch.equal(view.K, other.K)
    found = again.ask("red", "yellow")
    assert torch.equal(found.selected, expected.selected)
    torch.testing.assert_close(found.relevancy, expected.relevancy, atol=1e-3, rtol=0)
    assert again.field.manifest["source_splat"] == str(path)
    photograph = np.asarray(Image.open(capture / "images" / "0003.png"))
    assert np.abs(again.render("0003").numpy().astype(int) - photograph).mean() < 3
    rows = again.export(tmp_path / "again.ply", found["red"])
    assert 0.9 * int(found["red"].mask.sum()) < len(rows) <= int(found["red"].mask.sum())  # all but the faintest
    second = nl.lift_run(again.config, timestamp="second", check_alignment=False, **OPTIONS)  # and can be lifted again
    assert torch.equal(second.ask("red").selected, again.ask("red").selected)

    capture.rename(tmp_path / "elsewhere")
    with pytest.raises(FileNotFoundError, match=r"14 of 14, .* --data"):
        nl.open_run(run.config)
    assert nl.open_run(run.config, data=tmp_path / "elsewhere").scene.train[0].image.shape == (120, 160, 3)
    moved = (tmp_path / "outputs").rename(tmp_path / "results") / run.config.relative_to(tmp_path / "outputs")
    opened = nl.open_run(moved, data=tmp_path / "elsewhere" / "images")
    assert opened.scene.train.names == scene.train.names
    assert torch.equal(opened.ask("red").selected, found.selected[:, :1])
    with pytest.raises(FileNotFoundError, match=r"nowhere, given with --data"):
        nl.open_run(moved, data=tmp_path / "nowhere")


def test_every_degree_is_saved_and_drawn(splat, of_run, tmp_path: Path) -> None:
    for degree in range(4):
        rest = 0.2 * torch.randn(len(splat), (degree + 1) ** 2 - 1, 3, generator=generator(0))
        scene = nl.open_splat(write_ply(tmp_path / "s.ply", ply_columns(replace(splat, features_rest=rest))), of_run)
        again = open_saved_splat(saved_run(tmp_path / str(degree), scene))
        camera = scene.train.cameras[2]
        assert torch.equal(again.colors(camera), scene.colors(camera))
        assert again.splat.degree == max(1, degree)  # splatfacto takes colours without harmonics for logits


def test_undistortion_and_masks_are_nerfstudios(nerfstudio, tmp_path: Path) -> None:
    from nerfstudio.data.dataparsers.nerfstudio_dataparser import NerfstudioDataParserConfig  # noqa: PLC0415
    from nerfstudio.data.datasets.base_dataset import InputDataset  # noqa: PLC0415

    from normlift_ns.data.nerfstudio.dataset_views import DatasetViews  # noqa: PLC0415
    from tests.nerfstudio_plugin.stock_run import write_dataset  # noqa: PLC0415

    write_dataset(tmp_path / "a", masks=True, channels=4)
    content = json.loads((tmp_path / "a" / "transforms.json").read_text())
    content |= {"k2": -0.02, "k3": 0.01, "p1": 0.004, "p2": -0.003, "fl_y": 43.0, "cx": 22.5}
    (tmp_path / "a" / "transforms.json").write_text(json.dumps(content))
    kept = {"orientation_method": "none", "center_method": "none", "auto_scale_poses": False, "eval_mode": "all"}
    parser = NerfstudioDataParserConfig(data=tmp_path / "a", downscale_factor=1, **kept).setup()
    dataset = InputDataset(parser.get_dataparser_outputs("train"))
    background = torch.tensor([0.2, 0.4, 0.6])
    stock = DatasetViews(dataset, tmp_path / "a", dataset.cameras.camera_to_worlds, background)
    ours = ImageViews(read_transforms(tmp_path / "a").frames, background)
    assert ours.names == stock.names
    for view, other in zip(ours, stock):
        assert torch.equal(view.image, other.image)
        assert torch.equal(view.mask, other.mask)
        assert torch.equal(view.camera.K, other.camera.K)
        assert torch.equal(view.camera.world_to_camera, other.camera.world_to_camera)
        assert view.image.shape[:2] == (view.camera.height, view.camera.width)


def test_what_does_not_fit_is_refused(native, splat, frames, tmp_path: Path, monkeypatch) -> None:
    monkeypatch.chdir(tmp_path)
    images = native.location.folder / "images"
    write_colmap(tmp_path / "p", frames, "PINHOLE")
    write_colmap(tmp_path / "empty", [], "PINHOLE", binary=False)
    for folder, names, size in (("half", frames[:1], (160, 120)), ("flat", frames, (160, 60))):
        (tmp_path / folder).mkdir()
        for frame in names:
            Image.open(frame.file).resize(size).save(tmp_path / folder / frame.file.name)
    (tmp_path / "masks").mkdir()
    write_transforms(tmp_path / "t.json", frames, [])
    path = write_gsplat(tmp_path / "ckpt_1_rank0.pt", rows_of(splat, slice(0, 50)))
    every = {"colmap": "p", "images": str(images)}
    for options, message in (
        ({"images": "."}, "camera file, got none"),
        ({"colmap": "p", "images": "none"}, "none, given with --images"),
        ({"colmap": "p"}, "folder .*p/images"),
        ({"colmap": "p", "images": "half"}, "half .*13 of 14,"),
        ({"colmap": "p", "images": "flat"}, "160 x 60 .* aspect"),
        ({"colmap": "empty", "images": "half"}, "cameras: 0, registered images: 0"),
        ({**every, "test_every": 8, "eval_images": ("0001",)}, "test-every and --eval-images"),
        ({**every, "eval_images": ("1.5",)}, r"1\.5 .* above 0 and below 1"),
        ({**every, "eval_images": ("list.txt",)}, r"list\.txt"),
        ({**every, "eval_images": ("cat",)}, "--eval-images .*cat"),
        ({**every, "masks": "masks"}, r"masks has no mask for .*0000\.png"),
        ({"transforms": "t.json"}, "--colmap"),
        (every, r"too few points \(0,"),
    ):
        with pytest.raises((nl.InputError, FileNotFoundError), match=message):
            nl.open_splat(path, nl.SplatOptions(**options))
    with pytest.raises(TypeError, match="options must be of type SplatOptions"):
        nl.open_splat("x.ply", "capture")  # type: ignore[arg-type]


def test_moves_are_applied_to_as_many_views(native, splat, frames, given, tmp_path: Path) -> None:
    moves = 0.05 * torch.randn(len(native.train), 9, generator=generator(0), dtype=torch.float64)
    project = write_colmap(tmp_path / "moved", _before(frames, moves, given.eval_images), "PINHOLE")
    path = write_gsplat(tmp_path / "ckpt_0_rank0.pt", splat, pose_adjust={"embeds.weight": moves})
    assert difference(native, nl.open_splat(path, replace(given, colmap=project))) < 1e-5
    options = replace(given, colmap=write_colmap(tmp_path / "p", frames, "PINHOLE"), eval_images=())
    for count, hint in ((12, "--test-every 8"), (5, "--test-every or --eval-images")):
        moves = {"embeds.weight": torch.zeros(count, 9)}
        path = write_gsplat(tmp_path / f"ckpt_{count}_rank0.pt", splat, pose_adjust=moves)
        with pytest.raises(nl.InputError, match=f" {count} training views.*{hint}"):
            nl.open_splat(path, options)
    assert len(nl.open_splat(tmp_path / "ckpt_12_rank0.pt", replace(options, test_every=8)).train) == 12


def test_smaller_copies_of_the_images_and_shares_held_out(native, splat, frames, given, tmp_path: Path) -> None:
    project = write_colmap(tmp_path / "p", frames, "PINHOLE")
    path = write_ply(tmp_path / "s.ply", ply_columns(splat))
    base = replace(given, colmap=project, eval_images=())
    (tmp_path / "images_2").mkdir()
    for frame in frames:  # of other format, as gsplat's trainer makes them
        Image.open(frame.file).resize((81, 60)).save(tmp_path / "images_2" / f"{frame.file.stem}.webp")
    scene = nl.open_splat(path, replace(base, images=tmp_path / "images_2", test_every=8, views="all"))
    assert (len(scene.train), len(scene.held_out), scene.train.names[0]) == (14, 0, "images_2/0000.webp")
    camera, full = scene.train.cameras[0], native.train.cameras[0]
    assert (camera.width, camera.height) == (81, 60)
    torch.testing.assert_close(camera.K, full.K * torch.tensor([[81 / 160], [0.5], [1.0]]))

    names = [f"images/{i:04d}.png" for i in range(14)]
    (tmp_path / "list.txt").write_text("0003\nimages/0005.png\n\n")
    shares = [name for i, name in enumerate(names) if i not in np.linspace(0, 13, 13, dtype=int)]  # as ns-train
    for more, expected in (
        ({"test_every": 8}, [names[0], names[8]]),  # as gsplat
        ({"eval_images": (str(tmp_path / "list.txt"),)}, [names[3], names[5]]),
        ({"eval_images": ("0.1",)}, shares),
    ):
        scene = nl.open_splat(path, replace(base, **more))
        assert scene.held_out.names == expected
        assert scene.train.names == [name for name in names if name not in expected]


@pytest.mark.slow
def test_coordinates_of_a_utm_zone_are_named_with_an_offset(splat, frames, given, tmp_path: Path) -> None:
    for shift, fails in ((np.array([500_000.0, 5_200_000, 300]), True), (np.array([40.0, -900, 3]), False)):
        far = [replace(frame, pose=np.column_stack([frame.pose[:, :3], frame.pose[:, 3] + shift])) for frame in frames]
        project = write_colmap(tmp_path / f"p{fails}", far, "PINHOLE")
        moved = replace(splat, means=(splat.means.double() + torch.from_numpy(shift)).float())
        for name, gaussians in (("here.ply", splat), ("far.ply", moved)):
            path = write_ply(tmp_path / name, ply_columns(gaussians))
            if not fails:
                nl.open_splat(path, replace(given, colmap=project))
                continue
            what = "The cameras of .*" if name == "here.ply" else r"far\.ply"
            with pytest.raises(nl.InputError, match=rf"{what}: .*float32 is 0\.5.*500000 5200000 3") as caught:
                nl.open_splat(path, replace(given, colmap=project))
            assert "printf '1 0 0 -500000\\n0 1 0 -5200000\\n" in str(caught.value)
    (tmp_path / "offset.txt").write_text(f"1 0 0 {-shift[0]}\n0 1 0 {-shift[1]}\n0 0 1 {-shift[2]}\n0 0 0 1\n")
    scene = nl.open_splat(
        write_ply(tmp_path / "a.ply", ply_columns(splat)),
        replace(given, colmap=project, world_transform=tmp_path / "offset.txt"),
    )
    assert np.allclose(scene.train.frames[0].pose, frames[0].pose, atol=1e-6)


def test_images_in_subfolders(splat, frames, tmp_path: Path) -> None:
    """Two cameras with images of the same names, in copies outside the dataset, which are moved later."""
    entries = []
    for i, frame in enumerate(frames):
        name = f"{('left', 'right')[i % 2]}/{i // 2:04d}.png"
        for folder in ("cap/images", "photos"):
            (tmp_path / folder / name).parent.mkdir(parents=True, exist_ok=True)
            (tmp_path / folder / name).write_bytes(frame.file.read_bytes())
        entries.append(replace(frame, file=Path("images") / name))
    write_transforms(tmp_path / "cap" / "transforms.json", entries, [])
    path = write_ply(tmp_path / "s.ply", ply_columns(splat))
    options = nl.SplatOptions(transforms=tmp_path / "cap", images=tmp_path / "photos")
    scene = nl.open_splat(path, options)
    assert (scene.train.names[0], scene.train.names[-1]) == ("photos/left/0000.png", "photos/right/0006.png")
    run = saved_run(tmp_path / "run", scene)
    facts = {"name", "rasterize_mode", "background", "photographs", "identity"}
    assert set(json.loads((run / "splat.json").read_text())) == facts  # which runs of older versions have, too
    for move in (False, True):
        again = open_saved_splat(run, data=(tmp_path / "photos").rename(tmp_path / "moved") if move else tmp_path)
        assert again.train.names == scene.train.names
        assert again.train[3].image.shape == (120, 160, 3)
    with pytest.raises(nl.InputError, match=r" 0000_s\.npy"):
        nl.lift_run(again, export=FeatureExport(tmp_path / "e", False), output_dir=tmp_path / "o", **OPTIONS)
    (tmp_path / "moved" / "left" / "0001.png").rename(tmp_path / "moved" / "0001.png")
    (tmp_path / "moved" / "right" / "0001.png").unlink()
    with pytest.raises(nl.InputError, match=r"share the file .*moved/0001\.png"):
        nl.open_splat(path, replace(options, images=tmp_path / "moved"))
