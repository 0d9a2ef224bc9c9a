"""Runs are read and written without nerfstudio: what comes out is nerfstudio's, bit for bit."""

import itertools
import json
import tempfile
from collections.abc import Callable
from copy import deepcopy
from dataclasses import MISSING, fields
from pathlib import Path
from pkgutil import resolve_name
from typing import Any, get_type_hints

import numpy as np
import pytest
import torch
import yaml
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image
from scipy.spatial.transform import Rotation

from normlift_ns.data.nerfstudio import config_classes
from normlift_ns.data.nerfstudio.config import dump_config, set_dataset, skip_seed_points
from normlift_ns.data.nerfstudio.config_classes import NAMED_COLORS
from normlift_ns.data.nerfstudio.dataparsers import parse_dataset
from normlift_ns.data.nerfstudio.load import TrainedViews
from normlift_ns.errors import InputError
from normlift_ns.io.run_dir import FIELD_FOLDER
from normlift_ns.lifted_run import _lifted_config
from tests.captures import SHARED, needs_shared
from tests.examples import examples
from tests.nerfstudio_plugin.conftest import opened
from tests.nerfstudio_plugin.stock_run import StockRun

GREY = torch.tensor([0.2, 0.4, 0.7])


def as_nerfstudios(config: Any) -> Any:
    return yaml.load(dump_config(config), Loader=yaml.Loader)


def test_mirrors_have_the_fields_and_defaults_of_nerfstudios_classes() -> None:
    for mirror, path in config_classes.CONFIG_CLASS_NAMES.items():
        if mirror is config_classes.EventName:
            continue
        original: Any = resolve_name(":".join(path.rsplit(".", 1)))
        theirs, ours = ({item.name: item for item in fields(cls)} for cls in (original, mirror))
        assert set(ours) == set(theirs) - {"_target"}, path
        hints, known = get_type_hints(mirror), get_type_hints(original)
        for name in ours:
            mine, item = ours[name], theirs[name]
            assert (mine.default is MISSING) == (item.default is MISSING), (path, name)
            assert isinstance(mine.default, tuple) or mine.default == item.default, (path, name)
            if hints[name] in (int, float, bool, str, Path):
                assert hints[name] is known[name] or name == "vis", (path, name)
        assert (mirror in config_classes.CLASS_TARGETS) == ("_target" in theirs), path
    events, colors = (resolve_name(f"nerfstudio.utils.{name}") for name in ("writer:EventName", "colors:COLORS_DICT"))
    assert {item.name: item.value for item in config_classes.EventName} == {item.name: item.value for item in events}
    expected = {name: value.tolist() for name, value in colors.items()}
    assert {name: list(value) for name, value in NAMED_COLORS.items()} == expected


def test_configs_of_splats_have_nerfstudios_defaults() -> None:
    pipeline = config_classes.VanillaPipelineConfig()
    made = as_nerfstudios(config_classes.TrainerConfig(method_name="normlift", pipeline=pipeline))
    for part in (made.pipeline.model, made.pipeline.datamanager, made.viewer, made.logging):  # of splats
        assert part == type(part)() and type(part).__module__.startswith("nerfstudio.")


def test_the_config_of_a_lifted_run_is_the_edited_one(stock: StockRun) -> None:
    from normlift_ns.nerfstudio_plugin.model import NormLiftModelConfig  # noqa: PLC0415

    scene = opened(stock.config)
    for outputs in (stock.workspace / "outputs", Path("/elsewhere")):
        run_dir = outputs / "scene" / "normlift" / "first"
        config: Any = yaml.load(stock.config.read_text(), Loader=yaml.Loader)
        config.method_name, config.timestamp = "normlift", run_dir.name
        config.output_dir = scene.location.relative_to_root(run_dir.parents[2])
        config.relative_model_dir = Path("nerfstudio_models")
        config.load_dir = config.load_step = config.load_config = config.load_checkpoint = None
        values = {name: value for name, value in vars(config.pipeline.model).items() if name != "_target"}
        config.pipeline.model = NormLiftModelConfig(**values, semantics=Path(FIELD_FOLDER))
        if config.output_dir.is_absolute():
            set_dataset(config, scene.location.data)
        skip_seed_points(config)
        config.pipeline.datamanager.cache_images = "gpu"
        assert yaml.load(dump_config(_lifted_config(scene, run_dir)), Loader=yaml.Loader) == config


def attempt(action: Callable[[], Any]) -> Any:
    """What it returns, or the message with which it refuses."""
    try:
        return action()
    except InputError as error:
        return str(error)


def assert_equal(datamanager: config_classes.FullImageDatamanagerConfig, folder: Path) -> None:
    """The views and the world of a data set are those of nerfstudio's own data manager."""
    from nerfstudio.cameras.cameras import CameraType  # noqa: PLC0415

    from normlift_ns.data.nerfstudio.dataset_views import DatasetViews  # noqa: PLC0415

    config = config_classes.TrainerConfig(pipeline=config_classes.VanillaPipelineConfig(datamanager=datamanager))
    manager: Any = as_nerfstudios(config).pipeline.datamanager.setup(device="cpu", test_mode="test")
    parsed = parse_dataset(datamanager)
    outputs = manager.train_dataparser_outputs
    assert torch.equal(parsed.transform, outputs.dataparser_transform)
    assert parsed.scale == outputs.dataparser_scale
    for split, dataset in ((parsed.train, manager.train_dataset), (parsed.held_out, manager.eval_dataset)):
        assert split.files == dataset.image_filenames
        assert (split.masks or None) == dataset._dataparser_outputs.mask_filenames  # nerfstudio: None for no masks
        assert torch.equal(split.poses, dataset.cameras.camera_to_worlds)
        if len(split) > 0:
            assert split.camera_type == CameraType(int(dataset.cameras.camera_type[0])).name
        ours = TrainedViews(split, folder, split.poses, GREY, datamanager)
        theirs = DatasetViews(dataset, folder, dataset.cameras.camera_to_worlds, GREY)
        remarks = attempt(ours.check_files)
        assert (ours.names, remarks) == (theirs.names, attempt(theirs.check_files))
        if isinstance(remarks, str):  # nerfstudio rounds the sides of cameras and of photographs in two ways
            continue
        found, expected = attempt(lambda ours=ours: list(ours)), attempt(lambda theirs=theirs: list(theirs))
        if isinstance(expected, str):  # nerfstudio's "pca" mirrors some poses, which nothing could draw
            assert "world_to_camera" in expected and "world_to_camera" in found
            continue
        for a, b in zip(found, expected, strict=True):
            assert torch.equal(a.image, b.image) and a.image.dtype == b.image.dtype
            assert (a.mask is None) == (b.mask is None)
            assert a.mask is None or (torch.equal(a.mask, b.mask) and a.mask.dtype == b.mask.dtype)
            assert torch.equal(a.camera.K, b.camera.K)
            assert torch.equal(a.camera.world_to_camera, b.camera.world_to_camera)
            assert (a.camera.width, a.camera.height, a.original) == (b.camera.width, b.camera.height, b.original)


def poses(rng: np.random.Generator, count: int) -> list[list[list[float]]]:
    """Camera-to-world matrices, roughly upright, as captures have them."""
    found = np.tile(np.eye(4), (count, 1, 1))
    found[:, :3, :3] = Rotation.from_euler("zyx", rng.normal([0, 0, 1.4], [1.5, 0.4, 0.4], (count, 3))).as_matrix()
    found[:, :3, 3] = rng.normal(0, 3, (count, 3))
    return found.tolist()


def write_images(rng: np.random.Generator, files: list[Path], size: tuple[int, int], mode: str) -> None:
    for file in files:
        file.parent.mkdir(parents=True, exist_ok=True)
        shape = (size[1], size[0]) if mode == "L" else (size[1], size[0], len(mode))
        Image.fromarray(rng.integers(0, 256, shape, dtype=np.uint8), mode).save(file)


WORLD = {
    "orientation_method": st.sampled_from(["pca", "up", "vertical", "none"]),
    "center_method": st.sampled_from(["poses", "focus", "none"]),
    "auto_scale_poses": st.booleans(),
    "scale_factor": st.sampled_from([1.0, 0.3, 7.0]),
    "eval_mode": st.sampled_from(["fraction", "interval", "filename", "all"]),
    "train_split_fraction": st.sampled_from([0.5, 0.9, 1.0]),
    "eval_interval": st.sampled_from([2, 3, 8]),
    "downscale_factor": st.sampled_from([None, 1, 2]),
}


def with_held_out(parser: dict[str, Any], lists: bool) -> dict[str, Any]:
    """nerfstudio makes no cameras of nothing."""
    everything = parser["eval_mode"] == "fraction" and parser["train_split_fraction"] == 1.0 and not lists
    return {**parser, "train_split_fraction": 0.8} if everything else parser


@examples(8)
@given(
    parser=st.fixed_dictionaries(WORLD),
    seed=st.integers(0, 2**32 - 1),
    model=st.sampled_from([None, "OPENCV", "SIMPLE_PINHOLE", "OPENCV_FISHEYE"]),
    flags=st.tuples(*[st.booleans()] * 5),
    mode=st.sampled_from(["RGB", "RGBA", "L"]),
    extra=st.sampled_from([
        {}, {"applied_transform": [[0, 1, 0, 0.5], [1, 0, 0, 0], [0, 0, -1, 2]], "applied_scale": 0.7},
        {"orientation_override": "none"},
    ]),
)  # fmt: skip
def test_data_sets_with_transforms(parser, seed: int, model: Any, flags: Any, mode: str, extra: Any) -> None:
    per_frame, distorted, masks, shrunk, lists = flags
    rng = np.random.default_rng(seed)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        factor = parser["downscale_factor"] or 1
        names = [f"{'eval' if i % 3 == 0 else 'train'}_{9 - i}.png" for i in range(7)]
        sub = "images" if factor == 1 else f"images_{factor}"
        size = (40 // factor, 32 // factor)
        write_images(rng, [folder / sub / n for n in names], size, mode)
        write_images(rng, [folder / "images" / names[0]], (40, 32), mode)
        frames: list[dict[str, Any]] = []
        for n, pose in zip(names, poses(rng, len(names))):
            numbers = dict(zip(("fl_x", "fl_y", "cx", "cy"), (rng.normal([35, 36, 20, 16], 0.7)).tolist()))
            numbers |= {"w": 40, "h": 32}
            if distorted:
                numbers |= dict(zip(("k1", "k2", "k3"), rng.normal(0, 0.02, 3).tolist()))
                tail = ("p1", "p2") if model != "OPENCV_FISHEYE" else ("k4",)
                numbers |= dict(zip(tail, rng.normal(0, 0.005, 2).tolist()))
            frames.append({"file_path": f"images/{n}", "transform_matrix": pose, **numbers})
            if masks:
                frames[-1]["mask_path"] = f"masks/{n}"
        if masks:
            place = "masks" if factor == 1 else f"masks_{factor}"
            write_images(rng, [folder / place / n for n in names], size, "L")
        meta: dict[str, Any] = {"frames": frames, **extra, **({} if model is None else {"camera_model": model})}
        if not per_frame:
            meta |= {key: value for key, value in frames[0].items() if "_path" not in key and "matrix" not in key}
        if lists:
            meta |= {"train_filenames": [f["file_path"] for f in frames[2:]]}
            meta |= {"test_filenames": [f["file_path"] for f in frames[:2]], "val_filenames": []}
        (folder / "transforms.json").write_text(json.dumps(meta))
        parser = with_held_out(parser, lists)
        config = config_classes.NerfstudioDataParserConfig(data=folder, **parser)
        how: Any = {"dataparser": config, "camera_res_scale_factor": 0.5 if shrunk else 1.0}
        assert_equal(config_classes.FullImageDatamanagerConfig(data=folder, **how), folder)


@examples(6)
@given(
    parser=st.fixed_dictionaries(WORLD),
    seed=st.integers(0, 2**32 - 1),
    model=st.sampled_from(["SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV", "OPENCV_FISHEYE"]),
    flags=st.tuples(*[st.booleans()] * 3),
    rounding=st.sampled_from(["floor", "round", "ceil"]),
)
def test_data_sets_of_colmap(parser: dict[str, Any], seed: int, model: str, flags: Any, rounding: Any) -> None:
    flip, masks, lists = flags
    rng = np.random.default_rng(seed)
    tail = {"SIMPLE_RADIAL": 1, "RADIAL": 2, "OPENCV": 4, "OPENCV_FISHEYE": 3}.get(model, 0)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        factor = parser["downscale_factor"] or 1
        size = {"floor": (20, 15), "round": (20, 16), "ceil": (21, 16)}[rounding] if factor == 2 else (41, 31)
        names = [f"a/{'eval' if i % 3 == 0 else 'train'}_{i}.png" for i in range(7)]
        suffix = "" if factor == 1 else f"_{factor}"
        write_images(rng, [folder / f"images{suffix}" / n for n in names], size, "RGB")
        write_images(rng, [folder / "images" / names[-1]], (41, 31), "RGB")
        if masks:
            write_images(rng, [folder / f"masks{suffix}" / n for n in names], size, "L")
        model_folder = folder / "colmap/sparse/0"
        model_folder.mkdir(parents=True)
        cameras, images = [], []
        for i, n in enumerate(names):
            numbers = [*rng.normal([36, 35], 0.5)[: 1 if model.startswith("SIMPLE") or model == "RADIAL" else 2], 20.4]
            numbers += [15.3, *rng.normal(0, 0.004, tail), *([0.0] if model == "OPENCV_FISHEYE" else [])]
            cameras.append(f"{i + 1} {model} 41 31 {' '.join(repr(float(x)) for x in numbers)}")
            pose = [*np.roll(Rotation.random(random_state=seed % 1000 + i).as_quat(), 1), *rng.normal(0, 2, 3)]
            images.append(f"{9 - i} {' '.join(repr(float(x)) for x in pose)} {i + 1} {n}\n")
        (model_folder / "cameras.txt").write_text("\n".join(cameras) + "\n")
        (model_folder / "images.txt").write_text("\n".join(images) + "\n")
        if lists:
            (folder / "train_list.txt").write_text("\n".join(names[2:]) + "\n")
            (folder / "test_list.txt").write_text("\n".join(names[:2]) + "\n")
        parser = with_held_out(parser, lists)
        config = config_classes.ColmapDataParserConfig(
            data=folder, **parser, load_3D_points=False, assume_colmap_world_coordinate_convention=flip,
            masks_path=Path("masks") if masks else None, downscale_rounding_mode=rounding,
        )  # fmt: skip
        assert_equal(config_classes.FullImageDatamanagerConfig(data=folder, dataparser=config), folder)


def test_data_sets_of_blender(tmp_path: Path) -> None:
    for number, (color, mode) in enumerate(itertools.product(["white", "Blue", None], ["RGB", "RGBA"])):
        folder, rng = tmp_path / str(number), np.random.default_rng(3)
        for split in ("train", "test"):
            write_images(rng, [folder / split / f"r_{i}.png" for i in range(3)], (37, 26), mode)
            frames = [{"file_path": f"./{split}/r_{i}", "transform_matrix": p} for i, p in enumerate(poses(rng, 3))]
            meta = {"camera_angle_x": 0.691, "frames": frames}
            (folder / f"transforms_{split}.json").write_text(json.dumps(meta))
        parser = config_classes.BlenderDataParserConfig(data=folder, alpha_color=color, scale_factor=0.6)
        how = {"data": folder, "dataparser": parser, "camera_res_scale_factor": 0.5 if number % 3 == 0 else 1.0}
        assert_equal(config_classes.FullImageDatamanagerConfig(**how), folder)
    manager = config_classes.FullImageDatamanagerConfig(data=folder, dataparser=parser)
    for value in (None, 0, 4, -1):
        (folder / "transforms_train.json").write_text(json.dumps({**meta, "camera_angle_x": value}))
        with pytest.raises(InputError, match=r"transforms_train\.json: camera_angle_x is"):
            parse_dataset(manager)
    (folder / "transforms_train.json").unlink()
    with pytest.raises(FileNotFoundError, match=r"transforms_train\.json"):
        parse_dataset(manager)


@needs_shared
@pytest.mark.slow
def test_a_capture_whose_lens_is_distorted(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    scene = opened(SHARED / "captures" / "outputs" / "fox" / "splatfacto" / "run" / "config.yml")
    assert (scene.location.root, scene.checkpoint.step) == (SHARED / "captures", 11999)
    datamanager = deepcopy(scene.config.pipeline.datamanager)
    datamanager.data = datamanager.dataparser.data = scene.location.data
    datamanager.dataparser.load_3D_points = False
    assert_equal(datamanager, scene.location.folder)
    files = sorted((SHARED / "fixtures" / "gsplat_weights").glob("fox_view*_classic.npz"))
    assert len(files) >= 2
    for file in files:  # cameras are those that gsplat's kernels got
        fixture, camera = np.load(file), scene.train.cameras[int(file.name.split("_view")[1][:2])]
        assert np.array_equal(camera.K.numpy(), fixture["K"])
        assert np.abs(camera.world_to_camera.numpy() - fixture["w2c"]).max() < 1e-6
        assert (camera.height, camera.width) == fixture["labels"].shape
