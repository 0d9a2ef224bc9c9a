"""A file that two images share is refused, whatever its kind."""

from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from PIL import Image

from normlift_ns.data.cameras import read_camera_file
from normlift_ns.data.frames import Frame, Intrinsics
from normlift_ns.encoders.base import RegionFeatures
from normlift_ns.encoders.color import ColorEncoder
from normlift_ns.encoders.langsplat import LangSplat, check_unique_stems
from normlift_ns.errors import InputError
from normlift_ns.evaluation.protocols import MaskOptions, mask_truth
from normlift_ns.options import SplatOptions
from normlift_ns.segmentation.regions import LabelFiles
from tests.data.scene_files import write_colmap
from tests.data.test_transforms import capture


def save(folder: Path, *names: str) -> Path:
    for name in names:
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        Image.fromarray(np.ones((30, 40), np.uint8)).save(folder / name)
    return folder


def colmap(folder: Path, *names: str) -> Path:
    frames = [Frame(folder / n, n, np.eye(3, 4), Intrinsics(50, 50, 20, 15, 40, 30)) for n in names]
    save(folder / "images", *names)
    return write_colmap(folder, frames, "PINHOLE")


SIDES = ("left/1.jpg", "right/1.jpg")
KINDS: dict[str, tuple[Callable[[Path], Any], str]] = {
    "image of transforms.json": (
        lambda p: read_camera_file(
            SplatOptions(transforms=capture(p, names=SIDES), images=save(p / "images_2", "1.jpg"))
        ),
        "share the file .*images_2/1.jpg",
    ),
    "mask of transforms.json": (
        lambda p: read_camera_file(SplatOptions(transforms=capture(p, names=SIDES), masks=save(p / "masks", "1.png"))),
        "share the mask .*masks/1.png",
    ),
    "mask of COLMAP": (
        lambda p: read_camera_file(SplatOptions(colmap=colmap(p, "1.jpg", "1.png"), masks=save(p / "masks", "1.png"))),
        "share the mask .*masks/1.png",
    ),
    "label map": (
        lambda p: RegionFeatures(LabelFiles(save(p, "1.png")), ColorEncoder()).available(SIDES),
        "share the label map .*1.png",
    ),
    "linked label map": (
        lambda p: RegionFeatures(LabelFiles(linked(save(p, "left/1.png"))), ColorEncoder()).available(SIDES),
        "share the label map .*right/1.png",
    ),
    "instance mask": (
        lambda p: mask_truth(
            SimpleNamespace(train=SimpleNamespace(names=SIDES[:1]), held_out=SimpleNamespace(names=SIDES[1:])),  # type: ignore[arg-type]
            save(p, "1.png"),
            MaskOptions(),
        ),
        "share the instance mask .*1.png",
    ),
    "features": (lambda p: langsplat(p).available(SIDES), "share the features .*1_s.npy"),
    "exported features": (lambda p: check_unique_stems(SIDES), "share the exported file 1_s.npy"),
}


def linked(folder: Path) -> Path:
    (folder / "right").symlink_to(folder / "left")
    return folder


def langsplat(folder: Path) -> LangSplat:
    np.save(folder / "1_s.npy", np.zeros((4, 30, 40), np.int32))
    np.save(folder / "1_f.npy", np.ones((1, 3), np.float32))
    return LangSplat(folder, ColorEncoder(), "l")


@pytest.mark.parametrize("kind", KINDS)
def test_a_file_that_two_images_share_is_refused_whatever_its_kind(kind: str, tmp_path: Path) -> None:
    read, message = KINDS[kind]
    with pytest.raises(InputError, match=message) as caught:
        read(tmp_path)
    assert "give each image its own file" in str(caught.value)
    assert all(side in str(caught.value) for side in (("1.jpg", "1.png") if "COLMAP" in kind else SIDES))
