import json
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from normlift_ns.demo import (
    DemoRoom,
    demo_cameras,
    held_out_cameras,
    view_image,
    view_labels,
    write_capture,
)


@pytest.fixture(scope="module")
def room(small: DemoRoom) -> DemoRoom:
    return small


@pytest.fixture(scope="module")
def folder(room: DemoRoom, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("capture") / "room"
    write_capture(room, folder, views=3, held_out=2, width=100, height=72)
    return folder


def test_files(folder: Path):
    names = [f"{i:04d}.png" for i in range(5)]
    for kind, mode in (("images", "RGB"), ("instance", "L")):
        assert sorted(path.name for path in (folder / kind).iterdir()) == names
        for name in names:
            with Image.open(folder / kind / name) as image:
                assert (image.size, image.mode) == ((100, 72), mode)


def test_images_and_masks_are_the_views(folder: Path, room: DemoRoom):
    cameras = [*demo_cameras(3, 100, 72), *held_out_cameras(2, 100, 72)]
    for i, camera in enumerate(cameras):
        for kind, view in (("images", view_image), ("instance", view_labels)):
            with Image.open(folder / kind / f"{i:04d}.png") as image:
                assert np.array_equal(np.asarray(image), view(room, camera).numpy())


def test_labels_name_the_mask_values(folder: Path, room: DemoRoom):
    labels = json.loads((folder / "labels.json").read_text())
    assert labels["background"] == 0
    assert [labels["labels"][str(i + 1)] for i in range(len(room.names))] == list(room.names)


def test_transforms(folder: Path):
    transforms = json.loads((folder / "transforms.json").read_text())
    camera = demo_cameras(3, 100, 72)[1]
    assert transforms["camera_model"] == "OPENCV"
    assert [transforms[k] for k in ("k1", "k2", "p1", "p2")] == [0] * 4
    assert [transforms[k] for k in ("fl_x", "fl_y", "cx", "cy")] == pytest.approx(
        [camera.K[0, 0].item(), camera.K[1, 1].item(), 50, 36]
    )
    assert transforms["train_filenames"] == [f"images/{i:04d}.png" for i in range(3)]
    assert transforms["val_filenames"] == transforms["test_filenames"] == ["images/0003.png", "images/0004.png"]
    pose = torch.tensor(transforms["frames"][1]["transform_matrix"])
    point = torch.tensor([0.0, 0.0, 0.4, 1.0])  # the table: in front of every camera
    right, up, back, _ = (torch.linalg.inv(pose) @ point).tolist()
    x, y, z, _ = (camera.world_to_camera @ point).tolist()
    assert back < -1
    assert [right, up, back] == pytest.approx([x, -y, -z], abs=1e-5)
