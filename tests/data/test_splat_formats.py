"""Formats of splats that other packages read."""

from pathlib import Path

import pytest
import torch

from normlift_ns.data.open_splat import SPLAT_READERS, open_splat
from normlift_ns.errors import InputError
from normlift_ns.options import SplatOptions
from tests.data.scene_files import random_splat
from tests.data.test_transforms import capture
from tests.encoders.test_plugins import plugged

READER = """
import torch
from normlift_ns.data.splat import SplatFile, SplatParameters
def read(path):
    return {result}
"""
SPLAT = "SplatFile(SplatParameters(**torch.load(path)), 'antialiased', 7)"


def points(value: str) -> str:
    return f"[normlift_ns.scenes]\nzipped = {value}\nply = other:read\n"


@pytest.fixture
def options(tmp_path: Path) -> SplatOptions:
    return SplatOptions(transforms=capture(tmp_path))


def test_a_format_of_another_package_is_read_by_its_suffix(options: SplatOptions, tmp_path: Path) -> None:
    splat, path = random_splat(20), tmp_path / "scene.zipped"
    torch.save(splat.parameters, path)  # begins like the archive of a gsplat checkpoint
    with pytest.raises(InputError, match="not a gsplat checkpoint"):
        open_splat(path, options)
    with plugged(tmp_path / "a", "zipping", points("zipping:read"), READER.format(result=SPLAT)):
        assert SPLAT_READERS.names() == ["glb", "gltf", "ply", "pt", "splat", "spz", "zipped"]
        scene = open_splat(path, options)
        assert (scene.step, scene.rasterize_mode) == (7, "antialiased")
        assert torch.equal(scene.splat.means, splat.means)
        with pytest.raises(FileNotFoundError, match="The PLY file "):  # names of built-in formats are taken
            open_splat(tmp_path / "scene.ply", options)


def test_a_broken_reader_names_itself(options: SplatOptions, tmp_path: Path) -> None:
    splat, path = random_splat(20), tmp_path / "scene.zipped"
    splat.means[0, 0] = float("nan")
    torch.save(splat.parameters, path)
    for number, (value, result, problem) in enumerate((
        ("nowhere:read", SPLAT, "package zipping cannot be loaded .*use another splat format"),
        ("zipping:read", "1 / 0", "'zipped' .ZeroDivisionError"),
        ("zipping:read", "3", "returned int, expected a SplatFile"),
        ("zipping:read", SPLAT, "means that are NaN"),
    )):  # fmt: skip
        code = READER.format(result=result)
        with plugged(tmp_path / str(number), "zipping", points(value), code), pytest.raises(InputError, match=problem):
            open_splat(path, options)
