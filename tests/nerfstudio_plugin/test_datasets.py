"""Data sets of trained runs: nerfstudio neither asks, nor runs a shell, nor reads what it would read wrong."""

import json
import os
import re
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from PIL import Image

from normlift_ns.data.frames import Frame, Intrinsics
from normlift_ns.errors import InputError
from tests.data.scene_files import write_colmap
from tests.hostile import fuzz, hostile_json
from tests.nerfstudio_plugin.conftest import opened, trained_once
from tests.nerfstudio_plugin.stock_run import FOCAL, HEIGHT, WIDTH, StockRun, pose, write_dataset


@pytest.fixture(scope="session")
def project(made_once: Callable[..., Path], _imported: None) -> StockRun:
    """A run of `ns-train splatfacto --data scene colmap --colmap-path sparse/0`, of the images of `write_dataset`."""
    from nerfstudio.data.dataparsers.colmap_dataparser import ColmapDataParserConfig  # noqa: PLC0415

    def write(folder: Path) -> None:
        write_dataset(folder)
        (folder / "transforms.json").unlink()
        camera = Intrinsics(FOCAL, FOCAL, WIDTH / 2, HEIGHT / 2, WIDTH, HEIGHT, k1=0.06)
        names = [f"{i:03d}.jpg" for i in range(10)]
        frames = [Frame(folder / "images" / name, name, pose(i)[:3], camera) for i, name in enumerate(names)]
        write_colmap(folder, frames, points=np.random.default_rng(0).normal(size=(60, 3)) * 0.5)

    def configure(config: Any) -> None:
        config.pipeline.datamanager.dataparser = ColmapDataParserConfig(colmap_path=Path("sparse/0"))

    return trained_once(made_once, "colmap-run", write, configure=configure)


@pytest.fixture
def moved(project: StockRun, tmp_path: Path) -> Path:
    """config.yml of a copy of the COLMAP run."""
    shutil.copytree(project.workspace, tmp_path / "moved")
    return tmp_path / "moved" / project.config.relative_to(project.workspace)


def test_missing_small_images_are_refused_without_a_question(moved: Path, tmp_path: Path, monkeypatch) -> None:
    scene, name = tmp_path / "moved" / "scene", "$(touch x)"
    (scene / "images").rename(scene / name)
    folder = "images_path: !!python/object/apply:pathlib.PosixPath\n      - "
    text = moved.read_text().replace(f"{folder}images", f"{folder}'{name}'")
    monkeypatch.setattr("normlift_ns.data.nerfstudio.dataparsers.MAX_AUTO_RESOLUTION", 24)
    monkeypatch.setattr("nerfstudio.data.dataparsers.colmap_dataparser.MAX_AUTO_RESOLUTION", 24)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("builtins.input", lambda *args: pytest.fail("nerfstudio asked"))
    monkeypatch.setattr("subprocess.run", lambda *args, **kwargs: pytest.fail("nerfstudio ran a shell"))
    before = sorted(scene.rglob("*"))
    factors = {"as given": text.replace("downscale_factor: null", "downscale_factor: 2"), "as guessed": text}
    for content in factors.values():
        moved.write_text(content)
        with pytest.raises(FileNotFoundError, match=r"touch x.*_2\b.* 1/2 "):
            opened(moved)
        assert sorted(scene.rglob("*")) == before
    (scene / f"{name}_2").mkdir()
    for file in (scene / name).iterdir():
        Image.open(file).resize((WIDTH // 2, HEIGHT // 2)).save(scene / f"{name}_2" / file.name)
    for content in factors.values():
        moved.write_text(content)
        assert opened(moved).train.cameras[0].width < WIDTH // 2 + 1
    assert not (tmp_path / "x").exists()


def scene_of(copied: Path) -> Path:
    return copied.parents[4] / "scene"


def test_cameras_that_no_training_had_are_named(copied: Path) -> None:
    path = scene_of(copied) / "transforms.json"
    whole = json.loads(path.read_text())
    frame, keep = whole["frames"][0], whole["frames"][1:]
    turned = [[float("nan"), 0, 0, 0], *frame["transform_matrix"][1:]]
    cases: list[tuple[dict[str, Any] | str, str]] = [
        ({"frames": [frame]}, "same position .*: 1"),
        ({"frames": [frame, {**frame, "file_path": "images/001.jpg"}]}, "same position .*: 2"),
        ({"frames": [{**frame, "transform_matrix": turned}]}, "NaN"),
        ({"w": 65536, "h": 65536}, "268,435,456 pixels"),
        ({"k1": 1e38}, "k1 is 1e[+]38"),
        ({"fl_x": None}, "fl_x .* images/000.jpg"),
        ({"camera_model": "CUBE"}, "CUBE"),
        ({"orientation_override": "sideways"}, "cannot read the dataset"),
        ({"frames": [{**frame, "file_path": "images\0"}, *keep]}, "not a valid file name"),
        ({"frames": []}, "has no frames"),
        ({"w": 40}, r"000\.jpg .*48 x 36.*40 x 36"),
        ("{}", "`frames`"),
        ("[" * 20_000, "JSON"),
    ]
    for content, message in cases:
        path.write_text(content if isinstance(content, str) else json.dumps(whole | content))
        with pytest.raises(InputError, match=message) as caught:
            opened(copied)
        assert any(part in str(caught.value) for part in (str(path), "the dataset", "000.jpg")), message
    path.write_text(json.dumps({**whole, "camera_model": "EQUIRECTANGULAR", "k1": 0}))
    run = opened(copied)
    with pytest.raises(InputError, match=r"000\.jpg .* EQUIRECTANGULAR"):
        run.train[0]
    path.unlink()
    with pytest.raises(FileNotFoundError, match=r"transforms\.json"):
        opened(copied)


def test_changes_after_the_training_are_noticed(copied: Path) -> None:
    path, trained = scene_of(copied) / "transforms.json", copied.parent / "dataparser_transforms.json"
    whole, scale = json.loads(path.read_text()), json.loads(trained.read_text())["scale"]
    frames = whole["frames"]
    place = (np.array(frames[3]["transform_matrix"]) + [[0, 0, 0, 1]] * 4).tolist()
    one_moved = [*frames[:3], {**frames[3], "transform_matrix": place}, *frames[4:]]
    for changed in (frames[:8], frames[1:], one_moved):
        path.write_text(json.dumps({**whole, "frames": changed}))
        with pytest.raises(InputError, match=rf"scale \S+, .*{trained.name}.* {scale:.6g}\b"):
            opened(copied)
    path.write_text(json.dumps({**whole, "frames": frames[::-1]}))
    run = opened(copied)
    assert (run.train.names[0], run.remarks) == ("images/000.jpg", ())  # nerfstudio sorts them


def test_a_damaged_transform_of_the_training_switches_nothing_off(copied: Path) -> None:
    path, unit = copied.parent / "dataparser_transforms.json", np.eye(4)[:3].tolist()
    cases: list[tuple[Any, str]] = [
        ({"transform": unit, "scale": float("nan")}, "NaN"),
        ({"transform": unit, "scale": 0}, "its scale is 0"),
        ({"transform": [[1, 2], [3]], "scale": 1}, "transform"),
        ({"transform": unit, "scale": True}, "`float`, got `bool`"),
        ({"transform": [[1e200] * 4] * 3, "scale": 1}, "3 rows of 4 finite numbers"),
    ]
    for content, message in cases:
        path.write_text(json.dumps(content))
        with pytest.raises(InputError, match=message) as caught:
            opened(copied)
        assert str(path) in str(caught.value)
    path.unlink()
    assert str(path) in opened(copied).remarks[0]  # whether the cameras are those of the training is unknown
    path.mkdir()
    with pytest.raises(FileNotFoundError, match=path.name):
        opened(copied)


def test_pixels_that_nerfstudio_reads_wrong_are_refused(copied: Path) -> None:
    file = scene_of(copied) / "images" / "003.jpg"
    for mode in ("1", "P", "LA", "I;16", "I", "F"):
        Image.new(mode, (WIDTH, HEIGHT)).save(file, "TIFF" if mode in "IF" else "PNG")
        with pytest.raises(InputError, match=rf"003\.jpg .* {mode}, "):
            opened(copied)
    for make, message in (
        (lambda file: file.write_bytes(b"%!PS-Adobe-3.0 EPSF-3.0\n%%BoundingBox: 0 0 48 36\n"), "cannot be read"),
        (lambda file: Image.new("RGB", (20, 10)).save(file), "is 20 x 10 pixels"),
        (os.mkfifo, "regular file"),
        (lambda file: file.mkdir(), "regular file"),
    ):
        file.unlink()
        make(file)
        with pytest.raises(InputError, match=rf"003\.jpg,? .*{message}"):
            opened(copied)


def test_pixels_that_people_see_otherwise_are_said_with_count_and_name(copied: Path) -> None:
    file = scene_of(copied) / "images" / "005.jpg"
    Image.new("CMYK", (WIDTH, HEIGHT)).save(file)
    (remark,) = opened(copied).remarks
    assert all(part in remark for part in ("1 of 9", "CMYK", str(file)))


def test_checkpoint_and_config_must_be_of_one_training(copied: Path) -> None:
    (path,) = (copied.parent / "nerfstudio_models").iterdir()
    whole, text, nothing = torch.load(path, weights_only=False), copied.read_text(), torch.full((60, 3), torch.nan)
    copied.write_text(text.replace("sh_degree: 3", "sh_degree: 2"))
    with pytest.raises(InputError, match=r" 15 .* sh_degree 2, .* 8"):
        opened(copied)
    copied.write_text(text)
    for name in ("means", "scales"):
        torch.save({"step": 2, "pipeline": {**whole["pipeline"], f"_model.gauss_params.{name}": nothing}}, path)
        with pytest.raises(InputError, match=r"\b60 Gaussians"):
            opened(copied)


def test_lists_without_test_images(copied: Path) -> None:
    path = scene_of(copied) / "transforms.json"
    names = [f"images/{i:03d}.jpg" for i in range(10)]
    whole, trained = json.loads(path.read_text()), opened(copied).train.names
    rest = [name for name in names if name not in trained]
    for lists, held_out in (
        ({"train_filenames": trained, "val_filenames": rest}, rest),
        ({"train_filenames": trained}, []),
        ({"train_filenames": trained, "val_filenames": [], "test_filenames": rest}, rest),
    ):
        path.write_text(json.dumps(whole | lists))
        scene = opened(copied)
        assert (scene.train.names, scene.held_out.names) == (trained, held_out)
    path.write_text(json.dumps(whole | {"val_filenames": rest}))
    with pytest.raises(InputError, match="split train"):
        opened(copied)


def test_lists_of_a_project_without_test_images(moved: Path) -> None:
    scene = opened(moved)
    expected = sorted(scene.train.names), sorted(scene.held_out.names)
    for name in ("validation", "val"):
        for split, listed in (("train", expected[0]), (name, expected[1])):
            text = "\n".join(item.removeprefix("images/") for item in listed)
            (scene_of(moved) / f"{split}_list.txt").write_text(text)
        scene = opened(moved)
        assert (sorted(scene.train.names), sorted(scene.held_out.names)) == expected
        (scene_of(moved) / f"{name}_list.txt").unlink()
    model, folder = scene_of(moved) / "sparse" / "0", scene_of(moved) / "images"
    (model / "images.bin").write_bytes((model / "images.bin").read_bytes().replace(b"00", b"a\\00"))
    shutil.copytree(folder, folder / "a")
    (scene_of(moved) / "train_list.txt").unlink()
    assert sum(name.startswith("images/a/00") for name in opened(moved).train.names) >= 8  # names of Windows
    (model / "images.bin").write_bytes(b"")
    with pytest.raises(InputError, match=r"images\.bin is damaged"):
        opened(moved)
    shutil.rmtree(model)
    with pytest.raises(FileNotFoundError, match=r"sparse/0, the COLMAP reconstruction, is missing"):
        opened(moved)


def test_datasets_of_another_machine(copied: Path) -> None:
    folder = scene_of(copied)
    path, trained = folder / "transforms.json", opened(copied).train.names
    whole = json.loads(path.read_text())
    for frame in whole["frames"]:
        frame["file_path"] = "C:\\scene\\" + frame["file_path"].replace("/", "\\")
    path.write_text(json.dumps(whole))
    assert opened(copied, data=folder).train.names == trained
    file = folder / trained[2]
    file.rename(folder / "elsewhere.jpg")
    for how in ({}, {"data": folder}):
        with pytest.raises(FileNotFoundError, match=r"1 of 9, .*00[23]") as caught:
            opened(copied, **how)
        assert ("--data" in str(caught.value)) == (how == {})  # not what was done already
    path.unlink()
    with pytest.raises(FileNotFoundError, match=r"transforms\.json is missing.* as it was during the training"):
        opened(copied, data=folder)


def test_settings_of_other_versions(copied: Path) -> None:
    text = copied.read_text()
    for old, new, said in (
        ("cache_images: gpu", "cache_images: disk", "cache_images is 'disk'.* ignored"),
        ("profiler: basic", "profiler: full", "profiler is 'full'"),
        ("masks_on_gpu: false", "masks_on_gpu: false\n\\1prefetch_factor: 4", r"Config\.prefetch_factor"),
        ("sh_degree: 3", "sh_degree: 3\n\\1strategy: mcmc\n\\1max_gs_num: 9", r"Config\.strategy, .*max_gs_num"),
    ):
        changed, count = re.subn(rf"^( *){old}", rf"\1{new}", text, flags=re.MULTILINE)
        assert count == 1
        copied.write_text(changed)
        remark, *_ = opened(copied).remarks
        assert re.search(said, remark), remark
    for name, value in (("kernel_size", "0.1"), ("render_mode", "RGB+2D"), ("use_2dgs", "true")):
        copied.write_text(re.sub(r"^( *)sh_degree: 3", rf"\1sh_degree: 3\n\1{name}: {value}", text, flags=re.MULTILINE))
        with pytest.raises(InputError, match=rf"{name}: .*ns-export gaussian-splat .*--load-ply .*--world-transform"):
            opened(copied)
    copied.write_text(text.replace("NerfstudioDataParserConfig", "ScanNetppDataParserConfig"))
    with pytest.raises(InputError, match=r"ScanNetpp.*ns-export gaussian-splat --load-config .*--load-ply"):
        opened(copied)


def test_damage_of_json_is_a_message(copied: Path) -> None:
    for file in (scene_of(copied) / "transforms.json", copied.parent / "dataparser_transforms.json"):
        whole = file.read_bytes()
        fuzz(6, hostile_json(json.loads(whole)), file, lambda: opened(copied).train.cameras)
        file.write_bytes(whole)


def test_smaller_copies_of_images_of_one_name_are_refused(copied: Path) -> None:
    """nerfstudio looks for all of them in images_2, without their folders."""
    folder = scene_of(copied)
    path, config = folder / "transforms.json", copied.read_text()
    whole = json.loads(path.read_text())
    for side in ("left", "right"):
        (folder / side).mkdir()
        shutil.copy(folder / "images" / "000.jpg", folder / side / "000.jpg")
    shutil.copytree(folder / "images", folder / "images_2")
    for i, side in enumerate(("left", "right")):
        whole["frames"][i]["file_path"] = f"{side}/000.jpg"
    path.write_text(json.dumps(whole))
    copied.write_text(config.replace("downscale_factor: null", "downscale_factor: 2"))
    with pytest.raises(InputError, match=r"left/000\.jpg and right/000\.jpg .*share the file .*images_2/000\.jpg"):
        opened(copied)
