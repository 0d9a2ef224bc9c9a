from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from normlift_ns.demo.capture import demo_cameras, held_out_cameras, view_image, view_labels, write_capture
from normlift_ns.demo.room import DemoRoom


@pytest.fixture(scope="module")
def folder(small: DemoRoom, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("capture") / "room"
    write_capture(small, folder, views=2, held_out=2, width=60, height=44)
    return folder


def test_images_and_masks_are_the_views_and_labels_name_their_values(folder: Path, small: DemoRoom):
    cameras = [*demo_cameras(2, 60, 44), *held_out_cameras(2, 60, 44)]
    for kind, mode, view in (("images", "RGB", view_image), ("instance", "L", view_labels)):
        assert sorted(path.name for path in (folder / kind).iterdir()) == [f"{i:04d}.png" for i in range(4)]
        for i, camera in enumerate(cameras):
            with Image.open(folder / kind / f"{i:04d}.png") as image:
                assert (image.size, image.mode) == ((60, 44), mode)
                assert np.array_equal(np.asarray(image), view(small, camera).numpy())
    names = {str(i): name for i, name in enumerate(small.names, 1)}
    assert json.loads((folder / "labels.json").read_text()) == {"labels": names, "background": 0}


def test_transforms(folder: Path):
    transforms = json.loads((folder / "transforms.json").read_text())
    camera = demo_cameras(2, 60, 44)[1]
    assert transforms["camera_model"] == "OPENCV"
    assert [transforms[k] for k in ("k1", "k2", "p1", "p2", "w", "h")] == [0, 0, 0, 0, 60, 44]
    focal = [camera.K[0, 0].item(), camera.K[1, 1].item()]
    assert [transforms[k] for k in ("fl_x", "fl_y", "cx", "cy")] == pytest.approx([*focal, 30, 22])
    assert transforms["train_filenames"] == ["images/0000.png", "images/0001.png"]
    assert transforms["val_filenames"] == transforms["test_filenames"] == ["images/0002.png", "images/0003.png"]
    assert [frame["file_path"] for frame in transforms["frames"]] == [f"images/{i:04d}.png" for i in range(4)]
    pose = torch.tensor(transforms["frames"][1]["transform_matrix"])
    point = torch.tensor([0.0, 0.0, 0.4, 1.0])  # the table: in front of every camera
    right, up, back, _ = (torch.linalg.inv(pose) @ point).tolist()
    x, y, z, _ = (camera.world_to_camera @ point).tolist()
    assert back < -1
    assert [right, up, back] == pytest.approx([x, -y, -z], abs=1e-5)
