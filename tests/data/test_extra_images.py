"""Photographs that were added after the training: their cameras in the world of the scene, and worlds that differ."""

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from normlift_ns import InputError, LiftOptions, SourceOptions, lift_run, open_run, open_scene
from normlift_ns.data.extra_images import add_extra_images
from normlift_ns.data.nerfstudio.load import NerfstudioScene

TURNED = np.array([[0.0, -3.0, 0.0, 5.0], [0.0, 0.0, -3.0, 1.0], [3.0, 0.0, 0.0, -2.0], [0.0, 0.0, 0.0, 1.0]])
"""Another world: turned, three times as large and elsewhere."""
SAME = np.eye(4)
NEW = ("images/later_1.png", "images/before.png")


@pytest.fixture
def scene(trained: Path) -> NerfstudioScene:
    found = open_scene(trained)
    assert isinstance(found, NerfstudioScene)
    return found


@pytest.fixture
def larger(scene: NerfstudioScene, tmp_path: Path) -> Callable[..., Path]:
    """A copy of the data set with two photographs more: those of views 1 and 4 under other names."""
    folder = tmp_path / "larger"
    shutil.copytree(scene.location.folder, folder)
    known = json.loads((folder / "transforms.json").read_text())
    by_name = {entry["file_path"]: entry for entry in known["frames"]}
    for name, index in zip(NEW, (1, 4)):
        shutil.copy(folder / scene.train.names[index], folder / name)
        known["frames"].append({**by_name[scene.train.names[index]], "file_path": name})

    def write(world: np.ndarray = SAME, move: str | None = None, frames: slice = slice(None)) -> Path:
        changed: dict[str, Any] = {key: value for key, value in known.items() if not key.endswith("_filenames")}
        changed["frames"] = []
        for entry in known["frames"][frames]:
            pose = world @ np.array(entry["transform_matrix"])
            pose[:3, :3] /= np.cbrt(np.linalg.det(world[:3, :3]))
            pose[0, 3] += 0.3 * (entry["file_path"] == move)
            changed["frames"].append({**entry, "transform_matrix": pose.tolist()})
        (folder / "transforms.json").write_text(json.dumps(changed))
        return folder / "transforms.json"

    return write


def test_new_cameras_stand_in_the_world_of_the_scene(scene, larger) -> None:
    found = add_extra_images(scene, larger(TURNED))
    before = len(scene.train)
    assert found.train.names[:before] == list(scene.train.names) and len(found.train) == before + 2
    assert [Path(name).name for name in found.train.names[before:]] == ["before.png", "later_1.png"]
    assert found.identity["added_photographs"] == found.train.names[before:]
    for new, old in ((before + 1, 1), (before, 4)):
        ours, theirs = found.train.cameras[new], scene.train.cameras[old]
        assert torch.allclose(ours.world_to_camera, theirs.world_to_camera, atol=1e-5)
        assert torch.allclose(ours.K, theirs.K, atol=1e-4)
        assert torch.equal(found.train[new].image, scene.train[old].image)
        assert found.train[new - len(found.train)].name == found.train.names[new]
    with pytest.raises(IndexError):
        found.train[len(found.train)]


def test_worlds_that_differ_are_refused_by_name(scene, larger) -> None:
    moved = scene.train.names[3]
    for how, message in (
        ({"move": moved}, rf"{Path(moved).name} .*14 old"),
        ({"frames": slice(0, -2)}, "already belong to"),
        ({"frames": slice(-3, None)}, "contains 1 of the"),
        ({"frames": slice(-2, None)}, "contains 0 of the"),
    ):
        with pytest.raises(InputError, match=message):
            add_extra_images(scene, larger(**how))


def test_a_lifted_run_knows_them(scene, larger, tmp_path: Path) -> None:
    options = {"source": SourceOptions(encoder="color", regions="grid", region_count=48), "device": "cpu"}
    how = {"lift": LiftOptions(refine=False), "output_dir": tmp_path / "out", "check": False, **options}
    run = lift_run(add_extra_images(scene, larger(TURNED)), **how)
    again = open_run(run.config)
    assert again.field.manifest["views_lifted"] == again.scene.train.names
    assert len(again.scene.train) == len(scene.train) + 2
    for ours, theirs in zip(again.scene.train.cameras, run.scene.train.cameras):
        assert torch.equal(ours.world_to_camera, theirs.world_to_camera)
    selected = again.ask("red")["red"].mask
    assert len(again.votes.explain(selected).views) > 0  # its evidence is found in the cache
    stored = run.folder / "added_photographs.json"
    stored.write_text(stored.read_text().replace("later_1", "later_2"))
    with pytest.raises((InputError, FileNotFoundError)):
        open_run(run.config)
