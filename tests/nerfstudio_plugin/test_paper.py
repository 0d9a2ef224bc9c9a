"""The steps of docs/paper.md on a tiny made scene in the format of ScanNet; tests/cli/test_evaluate.py has LERF-OVS."""

import json
import math
import re
import runpy
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from plyfile import PlyData, PlyElement

from normlift_ns.cli import evaluate, lift
from normlift_ns.evaluation.scannet import NYU40
from normlift_ns.options import BACKGROUND_WORDS, SourceOptions
from tests.cli.conftest import run_entry, said
from tests.nerfstudio_plugin.stock_run import FOCAL, HEIGHT, WIDTH, pose, train_splatfacto, write_dataset

WORDS = tuple(dict.fromkeys((*NYU40.values(), *BACKGROUND_WORDS)))


def write_scene(scene: Path) -> None:
    """ScanNet's files; the fourth image has no pose."""
    write_dataset(scene)
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
    cloud = PlyData.read(scene / "sparse_pc.ply")["vertex"].data
    labels = np.zeros(len(cloud), [*((axis, "f4") for axis in "xyz"), ("label", "u2")])
    labels["x"], labels["y"], labels["z"] = cloud["x"], cloud["y"], cloud["z"]
    labels["label"] = np.where(np.arange(len(cloud)) % 2, 1, 5)  # wall and chair
    for name, vertices in (("", cloud), (".labels", labels)):
        file = PlyData([PlyElement.describe(vertices, "vertex")], text=name == "")
        file.write(str(scene / f"scene0000_00_vh_clean_2{name}.ply"))


def write_features(scene: Path, features: Path) -> None:
    """LangSplat's files: four levels in which the halves of each image are a wall and a chair; vectors of all words."""
    features.mkdir()
    for image in (scene / "color").iterdir():
        half = (np.arange(WIDTH) >= WIDTH // 2).astype(np.float32)
        levels = np.stack([np.tile(half + 2 * level, (HEIGHT, 1)) for level in range(4)])
        np.save(features / f"{image.stem}_s.npy", levels)
        rows = np.eye(len(WORDS), dtype=np.float32)[[WORDS.index("wall"), WORDS.index("chair")]]
        np.save(features / f"{image.stem}_f.npy", np.tile(rows, (4, 1)))
    np.savez(scene / "names.npz", **dict(zip(WORDS, np.eye(len(WORDS), dtype=np.float32))))


@pytest.mark.slow
def test_scannet(tmp_path: Path, monkeypatch, capsys) -> None:
    from normlift_ns.method_configs.entry import scannet_method  # noqa: PLC0415

    scene, output = tmp_path / "scannet" / "scene0000_00", tmp_path / "o.json"
    features, vectors = scene / "language_features", scene / "names.npz"
    write_scene(scene)
    page = (Path(__file__).parents[2] / "docs" / "paper.md").read_text("utf8")
    (script,) = re.findall(r"```python\n(.*?)```", page, flags=re.DOTALL)
    (tmp_path / "scannet_transforms.py").write_text(script)
    monkeypatch.setattr("sys.argv", ["scannet_transforms.py", str(scene)])
    runpy.run_path(str(tmp_path / "scannet_transforms.py"))
    written = json.loads((scene / "transforms.json").read_text())
    assert np.allclose(written["frames"][2]["transform_matrix"], pose(2)) and len(written["frames"]) == 9
    write_features(scene, features)

    def configure(config: Any) -> None:
        config.output_dir, config.pipeline.model.num_random = Path("outputs"), 60
        config.pipeline.source = SourceOptions(features="langsplat", features_dir=features, text_embeddings=vectors)

    def prepare(trainer: Any) -> None:
        """Put small Gaussians at the seed points, which splatfacto does on a GPU."""
        points = trainer.pipeline.datamanager.train_dataparser_outputs.metadata["points3D_xyz"]
        trainer.pipeline.model.gauss_params["means"].data.copy_(points)
        trainer.pipeline.model.gauss_params["scales"].data.fill_(math.log(0.05))  # large ones would hide others

    how = {"method": scannet_method.config, "configure": configure, "prepare": prepare, "steps": 2}
    config = train_splatfacto(tmp_path, scene.relative_to(tmp_path), **how).config
    source = ("--features", "langsplat", "--features-dir", features, "--text-embeddings", vectors)
    paper = ("--level", "l", "--vote", "paper", "--consensus", False, "--timestamp", "paper")
    assert run_entry(monkeypatch, lift.entrypoint, "--load-config", config, *source, *paper) == 0
    lifted = config.parents[2] / "normlift" / "paper" / "config.yml"
    flags = ("--load-config", lifted, *source[-2:], "--compare", "paper", "--output-path", output)
    flags += ("--protocol", "scannet", "--labels", scene / "scene0000_00_vh_clean_2.labels.ply")
    assert run_entry(monkeypatch, evaluate.entrypoint, *flags, "--study", "ablation", "signals") == 0
    document = json.loads(output.read_text())
    first, second, fourth = document["comparison"].values()
    assert [(row["metric"], row["NormLift"]) for row in first[:2]] == [("miou_19", 35.77), ("macc_19", 54.02)]
    assert first[0]["yours"] == pytest.approx(100 * document["results"]["miou_19"])
    assert first[0]["difference"] == pytest.approx(first[0]["yours"] - 35.77)
    ours = next(row for row in document["studies"]["ablation"] if row["variant"] == "paper")
    assert next(row["yours"] for row in second if row["variant"] == "paper") == pytest.approx(100 * ours["miou_19"])
    assert fourth[0]["yours"] == document["studies"]["signals"][0]["zero.share"]
    assert (document["settings"]["scenes"], document["settings"]["spelling"]) == (["scene0000_00"], "script")
    assert "35.770" in said(capsys)
