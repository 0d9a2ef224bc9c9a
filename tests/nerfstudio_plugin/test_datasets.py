"""Data sets of trained runs: nerfstudio neither asks, nor runs a shell, nor reads what it would read wrong."""

from __future__ import annotations

import json
import math
import os
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from nerfstudio.data.dataparsers.blender_dataparser import BlenderDataParserConfig
from nerfstudio.data.dataparsers.colmap_dataparser import ColmapDataParserConfig
from PIL import Image

from normlift_ns.errors import InputError
from normlift_ns.front_door import open_scene as load_scene
from normlift_ns.scenes.frames import Frame, Intrinsics
from tests.nerfstudio_plugin.stock_run import FOCAL, HEIGHT, WIDTH, StockRun, _pose, train_splatfacto, write_dataset
from tests.scenes.made import write_colmap


def write_project(folder: Path) -> Path:
    """A COLMAP project of the pictures of `write_dataset`."""
    write_dataset(folder)
    (folder / "transforms.json").unlink()
    camera = Intrinsics(FOCAL, FOCAL, WIDTH / 2, HEIGHT / 2, WIDTH, HEIGHT, k1=0.06)
    frames = []
    for i in range(10):
        name = f"{i:03d}.jpg"
        frames.append(Frame(folder / "images" / name, name, _pose(i, 10)[:3], camera))
    points = np.random.default_rng(0).normal(size=(60, 3)) * 0.5
    return write_colmap(folder, frames, points=points)


def colmap(config: Any) -> None:
    """--data … colmap --colmap-path sparse/0"""
    config.pipeline.datamanager.dataparser = ColmapDataParserConfig(colmap_path=Path("sparse/0"))


@pytest.fixture(scope="module")
def project(tmp_path_factory: pytest.TempPathFactory) -> StockRun:
    folder = tmp_path_factory.mktemp("colmap")
    write_project(folder / "scene")
    return train_splatfacto(folder, Path("scene"), configure=colmap)


@pytest.fixture
def moved(project: StockRun, tmp_path: Path) -> Path:
    """config.yml of a copy of the COLMAP run."""
    shutil.copytree(project.workspace, tmp_path / "moved")
    return tmp_path / "moved" / project.config.relative_to(project.workspace)


def test_a_colmap_run_is_read_as_it_was_trained(project: StockRun) -> None:
    views = load_scene(project.config).train
    cached = project.trainer.pipeline.datamanager.cached_train
    assert len(views) == len(cached) == 8
    assert all(torch.equal(view.image, data["image"]) for view, data in zip(views, cached))


def test_a_blender_run_is_read_as_it_was_trained(tmp_path: Path) -> None:
    scene = tmp_path / "scene"
    write_dataset(scene, channels=4)
    angle = 2 * math.atan(0.5 * WIDTH / FOCAL)
    frames = [{"file_path": f"./images/{i:03d}", "transform_matrix": _pose(i, 10).tolist()} for i in range(10)]
    for split, part in (("train", frames[:8]), ("val", frames[8:]), ("test", frames[8:])):
        content = {"camera_angle_x": angle, "frames": part}
        (scene / f"transforms_{split}.json").write_text(json.dumps(content))

    def configure(config: Any) -> None:
        config.pipeline.datamanager.dataparser = BlenderDataParserConfig()
        config.pipeline.model.num_random = 60

    run = train_splatfacto(tmp_path, Path("scene"), configure=configure)
    found = load_scene(run.config)
    assert (len(found.train), len(found.held_out)) == (8, 2)
    for view, data in zip(found.train, run.trainer.pipeline.datamanager.cached_train):
        assert torch.equal(view.image, data["image"])
    (scene / "transforms_test.json").unlink()
    with pytest.raises(FileNotFoundError, match=r"transforms_test\.json is missing from the dataset"):
        load_scene(run.config)
    for value in (None, 0, 4, -1):
        (scene / "transforms_train.json").write_text(json.dumps({"camera_angle_x": value, "frames": frames}))
        with pytest.raises(InputError, match=r"transforms_train\.json: camera_angle_x is"):
            load_scene(run.config)


@pytest.mark.parametrize("factor", [2, None])
def test_missing_small_photographs_are_refused_without_a_question(
    moved: Path, tmp_path: Path, monkeypatch, factor: int | None
) -> None:
    scene, name = tmp_path / "moved" / "scene", "$(touch x)"
    shutil.rmtree(scene)
    write_project(scene)
    (scene / "images").rename(scene / name)
    text = moved.read_text()
    text = text.replace("downscale_factor: null", f"downscale_factor: {factor or 'null'}")
    moved.write_text(
        text.replace(
            "images_path: !!python/object/apply:pathlib.PosixPath\n      - images",
            f"images_path: !!python/object/apply:pathlib.PosixPath\n      - '{name}'",
        )
    )
    if factor is None:
        monkeypatch.setattr("normlift_ns.scenes.nerfstudio.datasets.MAX_AUTO_RESOLUTION", 24)
        monkeypatch.setattr("nerfstudio.data.dataparsers.colmap_dataparser.MAX_AUTO_RESOLUTION", 24)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("builtins.input", lambda *args: pytest.fail("nerfstudio asked"))
    monkeypatch.setattr("subprocess.run", lambda *args, **kwargs: pytest.fail("nerfstudio ran a shell"))
    before = sorted(scene.rglob("*"))
    with pytest.raises(
        FileNotFoundError, match=r"There is no folder .*touch x.*_2 of photographs at 1/2 of their size"
    ):
        load_scene(moved)
    assert sorted(scene.rglob("*")) == before
    (scene / f"{name}_2").mkdir()
    for file in (scene / name).iterdir():
        Image.open(file).resize((WIDTH // 2, HEIGHT // 2)).save(scene / f"{name}_2" / file.name)
    assert load_scene(moved).train.cameras[0].width < WIDTH // 2 + 1
    assert not (tmp_path / "x").exists()


def test_what_nerfstudio_reads_first_is_checked_first(moved: Path, tmp_path: Path) -> None:
    """It prefers the text files of COLMAP."""
    model = tmp_path / "moved" / "scene" / "sparse" / "0"
    (model / "cameras.txt").write_text("1 PINHOLE wide")
    with pytest.raises(InputError, match=r"cameras\.txt is damaged"):
        load_scene(moved)
    (model / "cameras.txt").unlink()
    data = bytearray((model / "images.bin").read_bytes())
    data[12:20] = b"\xff" * 8
    (model / "images.bin").write_bytes(data)
    with pytest.raises(InputError, match=r"is not finite or has no rotation"):
        load_scene(moved)
    shutil.rmtree(model)
    with pytest.raises(FileNotFoundError, match=r"sparse/0, COLMAP's reconstruction, is missing"):
        load_scene(moved)


def scene_of(copied: Path) -> Path:
    return copied.parents[4] / "scene"


def change(copied: Path, **values: Any) -> Path:
    path = scene_of(copied) / "transforms.json"
    path.write_text(json.dumps({**json.loads(path.read_text()), **values}))
    return path


def test_cameras_that_no_training_had_are_named(copied: Path) -> None:
    path = scene_of(copied) / "transforms.json"
    whole = json.loads(path.read_text())
    frame = whole["frames"][0]
    turned = [[float("nan"), 0, 0, 0], *frame["transform_matrix"][1:]]
    cases: list[tuple[dict[str, Any], str]] = [
        ({"frames": whole["frames"][:1]}, "all 1 cameras stand at one place"),
        ({"frames": [frame, {**frame, "file_path": "images/001.jpg"}]}, "all 2 cameras stand at one place"),
        ({"frames": [{**frame, "transform_matrix": turned}]}, "it contains NaN"),
        ({"w": 10**9}, "w is 1e[+]09, expected whole numbers of pixels"),
        ({"w": 65536, "h": 65536}, "more than 268,435,456 pixels"),
        ({"fl_x": -1}, "fl_x is -1, expected a positive"),
        ({"k1": 1e38}, "k1 is 1e[+]38"),
        ({"fl_x": None}, "has no fl_x for images/000.jpg"),
        ({"camera_model": "CUBE"}, "CUBE"),
        ({"orientation_override": "sideways"}, "cannot read the dataset"),
        ({"frames": [{**frame, "file_path": "images\0"}]}, "is no name of a file"),
        ({"frames": {}}, "another form"),
        ({"frames": [[[[[[[[]]]]]]]]}, "another form"),
    ]
    for values, message in cases:
        change(copied, **values)
        with pytest.raises(InputError, match=message) as caught:
            load_scene(copied)
        assert str(path) in str(caught.value) or "the dataset" in str(caught.value)
        path.write_text(json.dumps(whole))
    path.write_text("[" * 100_000)
    with pytest.raises(InputError, match=r"transforms\.json is no valid JSON"):
        load_scene(copied)


def test_changes_after_the_training_are_noticed(copied: Path) -> None:
    path = scene_of(copied) / "transforms.json"
    whole = json.loads(path.read_text())
    frames = whole["frames"]
    moved_one = {
        **frames[3],
        "transform_matrix": (np.array(frames[3]["transform_matrix"]) + [[0, 0, 0, 1]] * 4).tolist(),
    }
    for values in ({"frames": frames[1:]}, {"frames": [*frames[:3], moved_one, *frames[4:]]}):
        change(copied, **values)
        with pytest.raises(InputError, match="was trained with: its poses give"):
            load_scene(copied)
    path.write_text(json.dumps({**whole, "w": 40}))
    with pytest.raises(InputError, match=r"000\.jpg is 48 x 36 pixels, its camera 40 x 36"):
        load_scene(copied)
    path.write_text(json.dumps({**whole, "frames": frames[::-1]}))
    assert load_scene(copied).train.names[0] == "images/000.jpg"  # nerfstudio sorts them
    Image.new("RGB", (20, 10)).save(scene_of(copied) / "images" / "005.jpg")
    with pytest.raises(InputError, match=r"005\.jpg is 20 x 10 pixels"):
        load_scene(copied)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ({"transform": np.eye(4)[:3].tolist(), "scale": float("nan")}, "it contains NaN"),
        ({"transform": np.eye(4)[:3].tolist(), "scale": 0}, "3 rows and scale 0"),
        ({"transform": np.eye(4)[:2].tolist(), "scale": 1}, "2 rows and scale 1"),
        ({"transform": [[1, 2], [3]], "scale": 1}, "holds no transform"),
        ({"transform": None, "scale": 1}, "holds no transform"),
        ({"scale": 1}, "missing required field `transform`"),
        ([], "holds no transform"),
        ({"transform": np.eye(4)[:3].tolist(), "scale": True}, "Expected `float`, got `bool`"),
        ({"transform": [[1e200] * 4] * 3, "scale": 1}, "3 rows of 4 finite numbers"),
    ],
)
def test_a_damaged_transform_of_the_training_switches_nothing_off(copied: Path, content: Any, message: str) -> None:
    path = copied.parent / "dataparser_transforms.json"
    path.write_text(json.dumps(content))
    with pytest.raises(InputError, match=message) as caught:
        load_scene(copied)
    assert str(path) in str(caught.value)


def test_a_missing_transform_of_the_training_is_said(copied: Path) -> None:
    assert load_scene(copied).remarks == ()
    (copied.parent / "dataparser_transforms.json").unlink()
    assert "whether the cameras are still those of the training cannot be told" in load_scene(copied).remarks[0]
    (copied.parent / "dataparser_transforms.json").mkdir()
    with pytest.raises(FileNotFoundError, match=r"dataparser_transforms\.json"):
        load_scene(copied)


def picture(mode: str) -> Image.Image:
    return Image.new("L", (WIDTH, HEIGHT), 100).convert(mode) if mode != "I;16" else Image.new("I;16", (WIDTH, HEIGHT))


@pytest.mark.parametrize("mode", ["1", "P", "LA", "I;16", "I", "F"])
def test_pixels_that_nerfstudio_reads_wrong_are_refused(copied: Path, mode: str) -> None:
    file = scene_of(copied) / "images" / "003.jpg"
    picture(mode).save(file, "TIFF" if mode in "IF" else "PNG")
    with pytest.raises(InputError, match=r"003\.jpg has pixels of kind .*convert the photographs, and train again"):
        load_scene(copied)


def test_pixels_that_people_see_otherwise_are_said_with_count_and_name(copied: Path) -> None:
    images = scene_of(copied) / "images"
    exif = Image.Exif()
    exif[0x0112] = 6
    for name in ("002.jpg", "004.jpg"):
        Image.open(images / name).save(images / name, exif=exif)
    picture("CMYK").save(images / "005.jpg")
    picture("RGB").save(images / "006.jpg", "WEBP", save_all=True, append_images=[Image.new("RGB", (WIDTH, HEIGHT))])
    turned, cmyk, several = load_scene(copied).remarks
    assert f"2 of 9 photographs carry an EXIF rotation, which training ignores; the first is {images}/002.jpg" in turned
    assert "1 of 9 photographs are in CMYK, which training takes for other colours than people see" in cmyk
    assert f"; the first is {images}/005.jpg" in cmyk
    assert f"1 of 9 photographs hold several pictures; the first is {images}/006.jpg" in several


def test_what_is_no_photograph_is_named_and_no_pipe_is_opened(copied: Path) -> None:
    images = scene_of(copied) / "images"
    for make, message in (
        (lambda file: file.write_bytes(b"%!PS-Adobe-3.0 EPSF-3.0\n%%BoundingBox: 0 0 48 36\n"), "cannot be read"),
        (lambda file: file.write_bytes(b""), "cannot be read as an image"),
        (lambda file: Image.new("1", (20_000, 20_000)).save(file, "PNG"), "cannot be read as an image .Image size"),
        (os.mkfifo, "003.jpg, which is no file"),
        (lambda file: file.mkdir(), "003.jpg, which is no file"),
    ):
        file = images / "003.jpg"
        file.rmdir() if file.is_dir() else file.unlink()
        make(file)
        with pytest.raises(InputError, match=message):
            load_scene(copied)


def test_masks_are_named_with_their_images(tmp_path: Path) -> None:
    write_dataset(tmp_path / "masked", masks=True)
    run = train_splatfacto(tmp_path, Path("masked"))
    mask = tmp_path / "masked" / "masks" / "004.png"
    for made, message in (
        (Image.new("RGB", (WIDTH, HEIGHT)), r"masks/004\.png of .*images/004\.jpg has pixels of kind RGB"),
        (Image.new("L", (WIDTH, 7)), r"masks/004\.png is 48 x 7 pixels, its image .*images/004\.jpg 48 x 36"),
    ):
        made.save(mask)
        with pytest.raises(InputError, match=message):
            load_scene(run.config)
    mask.write_bytes(b"x")
    with pytest.raises(InputError, match=r"masks/004\.png cannot be read as an image"):
        load_scene(run.config)
    Image.fromarray(np.eye(HEIGHT, WIDTH, dtype=np.uint8)).save(mask)  # any value that is not zero
    kept = load_scene(run.config).train[4].mask
    assert kept is not None
    assert 0 < int(kept.sum()) < 3 * HEIGHT


def test_checkpoint_and_config_must_be_of_one_training(copied: Path) -> None:
    (path,) = (copied.parent / "nerfstudio_models").iterdir()
    whole = torch.load(path, weights_only=False)
    text = copied.read_text()
    copied.write_text(text.replace("sh_degree: 3", "sh_degree: 2"))
    with pytest.raises(InputError, match=r"has 15 spherical harmonics .* sh_degree 2, which needs 8"):
        load_scene(copied)
    copied.write_text(text)
    for name in ("means", "scales"):
        pipeline = {**whole["pipeline"], f"_model.gauss_params.{name}": torch.full((60, 3), torch.nan)}
        torch.save({"step": 2, "pipeline": pipeline}, path)
        with pytest.raises(InputError, match=r"none of its 60 Gaussians can be drawn"):
            load_scene(copied)
    for dtype in (torch.float16, torch.bfloat16, torch.float64):
        pipeline = {k: v.to(dtype) if v.is_floating_point() else v for k, v in whole["pipeline"].items()}
        torch.save({"step": 2, "pipeline": pipeline}, path)
        assert load_scene(copied).gaussians.means.dtype == torch.float32


def hostile(values: Any, path: list[int], value: Any) -> Any:
    """The values with another one in some place: each number of the path chooses an item."""
    if not path or not isinstance(values, dict | list) or len(values) == 0:
        return value
    if isinstance(values, dict):
        key = list(values)[path[0] % len(values)]
        return {**values, key: hostile(values[key], path[1:], value)}
    i = path[0] % len(values)
    return [*values[:i], hostile(values[i], path[1:], value), *values[i + 1 :]]


ANYTHING = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=8) | st.just(10**400),
    lambda part: st.lists(part, max_size=4) | st.dictionaries(st.text(max_size=5), part, max_size=3),
    max_leaves=8,
)
FUZZ = {"path": st.lists(st.integers(0, 20), max_size=6), "value": ANYTHING, "cut": st.none() | st.integers(0, 3000)}


def damaged_json(file: Path, path: list[int], value: Any, cut: int | None) -> None:
    text = json.dumps(hostile(json.loads(file.read_text()), path, value))
    file.write_text(text[:cut], "utf8", "surrogatepass")


def no_other_error(config: Path, tmp: Path, which: str, **damage: Any) -> None:
    """The whole way of a run: its data set, and what its training wrote."""
    file = {"transforms": scene_of(config) / "transforms.json", "parser": config.parent / "dataparser_transforms.json"}[
        which
    ]
    whole = file.read_bytes()
    damaged_json(file, **damage)
    try:
        scene = load_scene(config)
        assert len(scene.train.cameras) == len(scene.train)
    except (InputError, FileNotFoundError) as error:
        assert len(str(error)) > 40
    finally:
        file.write_bytes(whole)


@settings(max_examples=25, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(which=st.sampled_from(["transforms", "parser"]), **FUZZ)
def test_damage_of_json_is_a_message(copied: Path, tmp_path: Path, which: str, **damage: Any) -> None:
    no_other_error(copied, tmp_path, which, **damage)


@pytest.mark.slow
@pytest.mark.parametrize("which", ["transforms", "parser"])
@settings(max_examples=200, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(**FUZZ)
def test_damage_of_json_is_always_a_message(copied: Path, tmp_path: Path, which: str, **damage: Any) -> None:
    no_other_error(copied, tmp_path, which, **damage)
