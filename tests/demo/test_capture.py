from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
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
