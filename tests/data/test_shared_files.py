"""A file that two images share is refused, whatever its kind."""

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from PIL import Image

from normlift_ns.encoders.base import RegionFeatures
from normlift_ns.encoders.color import ColorEncoder
from normlift_ns.errors import InputError
from normlift_ns.evaluation.protocols import MaskOptions, mask_truth
from normlift_ns.segmentation.regions import LabelFiles


def save(folder: Path, *names: str) -> Path:
    for name in names:
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        Image.fromarray(np.ones((30, 40), np.uint8)).save(folder / name)
    return folder


def test_a_file_that_two_images_share_is_refused(tmp_path: Path) -> None:
    sides = ("left/1.jpg", "right/1.jpg")
    maps = LabelFiles(save(tmp_path / "maps", "left/1.png"))
    (tmp_path / "maps" / "right").symlink_to(tmp_path / "maps" / "left")
    save(tmp_path / "masks", "1.png")
    scene: Any = SimpleNamespace(train=SimpleNamespace(names=sides[:1]), held_out=SimpleNamespace(names=sides[1:]))
    for file, read in (
        ("label map .*right/1.png", lambda: RegionFeatures(maps, ColorEncoder()).available(sides)),
        ("instance mask .*1.png", lambda: mask_truth(scene, tmp_path / "masks", MaskOptions())),
    ):
        with pytest.raises(InputError, match=f"share the {file}.* give each image its own file") as caught:
            read()
        assert all(name in str(caught.value) for name in sides)
