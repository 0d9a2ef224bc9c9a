"""The steps of docs/paper.md on tiny made scenes in the formats of ScanNet and LERF-OVS."""

import json
import math
import re
import runpy
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from plyfile import PlyData, PlyElement

from normlift_ns.cli import evaluate, lift
from normlift_ns.data.frames import Frame, Intrinsics
from normlift_ns.evaluation.scannet import NYU40
from normlift_ns.options import BACKGROUND_WORDS, SourceOptions
from tests.cli.conftest import run_entry, said
from tests.data.scene_files import write_colmap
from tests.nerfstudio_plugin.stock_run import FOCAL, HEIGHT, WIDTH, pose, train_splatfacto, write_dataset

pytestmark = pytest.mark.slow
PAGE = (Path(__file__).parents[2] / "docs" / "paper.md").read_text("utf8")
WORDS = tuple(dict.fromkeys((*NYU40.values(), *BACKGROUND_WORDS, "left", "right")))
POINTS = 60
"""In the clouds that the datasets have."""
PAPER = ("--level", "l", "--vote", "paper", "--consensus", False, "--timestamp", "paper")


def write_features(scene: Path, images: str, left: str, right: str) -> Path:
    """LangSplat's files: four levels in which the halves of each image are two regions."""
    folder = scene / "language_features"
    folder.mkdir()
    for image in (scene / images).iterdir():
        half = (np.arange(WIDTH) >= WIDTH // 2).astype(np.float32)
        levels = np.stack([np.tile(half + 2 * level, (HEIGHT, 1)) for level in range(4)])
        np.save(folder / f"{image.stem}_s.npy", levels)
        rows = np.eye(len(WORDS), dtype=np.float32)[[WORDS.index(left), WORDS.index(right)]]
        np.save(folder / f"{image.stem}_f.npy", np.tile(rows, (4, 1)))
    np.savez(scene / "names.npz", **dict(zip(WORDS, np.eye(len(WORDS), dtype=np.float32))))
    return folder


def trained(workspace: Path, scene: Path, method: str, features: Path) -> Path:
    from normlift_ns.method_configs import entry  # noqa: PLC0415

    def configure(config: Any) -> None:
        config.output_dir, config.pipeline.model.num_random = Path("outputs"), POINTS
        vectors = scene / "names.npz"
        config.pipeline.source = SourceOptions(features="langsplat", features_dir=features, text_embeddings=vectors)

    def prepare(trainer: Any) -> None:
        """Put small Gaussians at the seed points, which splatfacto does on a GPU."""
        points = trainer.pipeline.datamanager.train_dataparser_outputs.metadata["points3D_xyz"]
        parameters = trainer.pipeline.model.gauss_params
        parameters["means"].data.copy_(points)
        parameters["scales"].data.fill_(math.log(0.05))  # those of random points are large, and hide others

    ours = getattr(entry, f"{method}_method").config
    how = {"method": ours, "configure": configure, "prepare": prepare, "steps": 2}
    return train_splatfacto(workspace, scene.relative_to(workspace), **how).config


@pytest.fixture
def score(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Callable[..., dict[str, Any]]:
    def score(config: Path, features: Path, *flags: object) -> dict[str, Any]:
        vectors = ("--text-embeddings", features.parent / "names.npz")
        source = ("--features", "langsplat", "--features-dir", features, *vectors)
        assert run_entry(monkeypatch, lift.entrypoint, "--load-config", config, *source, *PAPER) == 0
        lifted = config.parents[2] / "normlift" / "paper" / "config.yml"
        given = ("--load-config", lifted, *vectors, "--compare", "paper", "--output-path", tmp_path / "o.json")
        assert run_entry(monkeypatch, evaluate.entrypoint, *given, *flags) == 0
        return json.loads((tmp_path / "o.json").read_text())

    return score


def test_scannet(score: Callable[..., dict[str, Any]], tmp_path: Path, monkeypatch, capsys) -> None:
    scene = tmp_path / "scannet" / "scene0000_00"
    write_dataset(scene)
    cloud = np.loadtxt(scene / "sparse_pc.ply", skiprows=10)
    (scene / "transforms.json").unlink()
    (scene / "images").rename(scene / "color")
    for folder in ("pose", "intrinsic"):
        (scene / folder).mkdir()
    for i, image in enumerate(sorted((scene / "color").iterdir())):
        image.rename(scene / "color" / f"{20 * i}.jpg")
        np.savetxt(scene / "pose" / f"{20 * i}.txt", pose(i) * [1, -1, -1, 1] if i != 3 else np.full((4, 4), -np.inf))
    matrix = np.eye(4)
    matrix[[0, 1, 0, 1], [0, 1, 2, 2]] = FOCAL, FOCAL, WIDTH / 2, HEIGHT / 2
    np.savetxt(scene / "intrinsic" / "intrinsic_color.txt", matrix)
    colors = ("red", "green", "blue")
    kinds = [(axis, "f4") for axis in "xyz"] + [(color, "u1") for color in colors]
    for name, extra in (("", []), (".labels", [("label", "u2")])):
        vertices = np.zeros(len(cloud), dtype=[*kinds, *extra])
        for i, (column, _) in enumerate(kinds):
            vertices[column] = cloud[:, i]
        if extra:
            vertices["label"] = np.where(np.arange(len(cloud)) % 2, 1, 5)  # wall and chair
        path = scene / f"scene0000_00_vh_clean_2{name}.ply"
        PlyData([PlyElement.describe(vertices, "vertex")], text=not extra).write(str(path))

    (script,) = re.findall(r"```python\n(.*?)```", PAGE, flags=re.DOTALL)
    (tmp_path / "scannet_transforms.py").write_text(script)
    monkeypatch.setattr("sys.argv", ["scannet_transforms.py", str(scene)])
    runpy.run_path(str(tmp_path / "scannet_transforms.py"))
    written = json.loads((scene / "transforms.json").read_text())
    assert np.allclose(written["frames"][2]["transform_matrix"], pose(2)) and len(written["frames"]) == 9

    features = write_features(scene, "color", "wall", "chair")
    config = trained(tmp_path, scene, "scannet", features)
    labels = scene / "scene0000_00_vh_clean_2.labels.ply"
    flags = ("--protocol", "scannet", "--labels", labels, "--study", "ablation", "signals")
    document = score(config, features, *flags)
    first, second, fourth = document["comparison"].values()
    assert [(row["metric"], row["NormLift"]) for row in first[:2]] == [("miou_19", 35.77), ("macc_19", 54.02)]
    assert first[0]["yours"] == pytest.approx(100 * document["results"]["miou_19"])
    assert first[0]["difference"] == pytest.approx(first[0]["yours"] - 35.77)
    ours = next(row for row in document["studies"]["ablation"] if row["variant"] == "paper")
    assert next(row["yours"] for row in second if row["variant"] == "paper") == pytest.approx(100 * ours["miou_19"])
    assert fourth[0]["yours"] == document["studies"]["signals"][0]["zero.share"]
    assert "35.770" in said(capsys)


def test_lerf_ovs(score: Callable[..., dict[str, Any]], tmp_path: Path) -> None:
    scene, labels = tmp_path / "lerf_ovs" / "ramen", tmp_path / "lerf_ovs" / "label" / "ramen"
    write_dataset(scene)
    camera = Intrinsics(FOCAL, FOCAL, WIDTH / 2, HEIGHT / 2, WIDTH, HEIGHT)
    names = [f"{i:03d}.jpg" for i in range(10)]
    frames = [Frame(scene / "images" / name, name, pose(i)[:3], camera) for i, name in enumerate(names)]
    write_colmap(scene, frames, "PINHOLE", points=np.random.default_rng(0).normal(size=(POINTS, 3)) * 0.5)
    (scene / "transforms.json").unlink()
    labels.mkdir(parents=True)
    square = [[2, 2], [20, 2], [20, 30], [2, 30]]
    objects = [{"category": "left", "segmentation": square, "bbox": [2, 2, 20, 30], "area": 504, "group": 1}]
    info = {"name": "004.jpg", "width": WIDTH, "height": HEIGHT, "depth": 3, "note": ""}
    (labels / "004.json").write_text(json.dumps({"info": info, "objects": objects}))
    features = write_features(scene, "images", "left", "right")
    config = trained(tmp_path, scene, "lerf_ovs", features)
    document = score(config, features, "--protocol", "lerf", "--labels", labels, "--study", "timing")
    fifth, third = document["comparison"].values()
    own = {(row["scene"], row["metric"]): row["yours"] for row in fifth}
    assert own["ramen", "miou"] == own["mean", "miou"] == document["results"]["miou"]
    assert own["teatime", "miou"] is None and len(fifth) == 15
    assert next(row["yours"] for row in third if row["scene"] == "ramen") > 0
