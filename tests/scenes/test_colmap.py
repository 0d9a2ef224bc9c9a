from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from normlift_ns.scenes.colmap import model_folder, read_cameras, read_images, read_points
from normlift_ns.scenes.frames import Frame, Intrinsics
from tests.scenes.made import write_colmap

DISTORTED = Intrinsics(500.5, 500.5, 320.25, 240.75, 640, 480, k1=0.05, k2=-0.01, p1=1e-3, p2=-2e-3)
KEPT = {
    "SIMPLE_PINHOLE": (), "PINHOLE": (), "SIMPLE_RADIAL": ("k1",), "RADIAL": ("k1", "k2"),
    "OPENCV": ("k1", "k2", "p1", "p2"),
}  # fmt: skip


def frames(count: int = 5) -> list[Frame]:
    rotations = Rotation.random(count, random_state=0).as_matrix()
    centres = np.random.default_rng(0).normal(size=(count, 3))
    return [
        Frame(Path(f"{i}.jpg"), f"images/photo {i}.jpg", np.column_stack([r, c]), DISTORTED)
        for i, (r, c) in enumerate(zip(rotations, centres))
    ]


@pytest.mark.parametrize("binary", [False, True])
@pytest.mark.parametrize("model", KEPT)
def test_projects_are_read(tmp_path: Path, model: str, binary: bool) -> None:
    points = np.random.default_rng(1).normal(size=(9, 3))
    folder = model_folder(write_colmap(tmp_path, frames(), model, binary=binary, points=points))
    cameras, images = read_cameras(folder), read_images(folder)
    assert [image.name for image in images] == [f"photo {i}.jpg" for i in range(5)]
    for image, frame in zip(images, frames()):
        assert np.allclose(image.pose, frame.pose, atol=1e-12)
        lost = {name: 0.0 for name in ("k1", "k2", "p1", "p2") if name not in KEPT[model]}
        assert cameras[image.camera] == DISTORTED._replace(**lost)
    assert np.array_equal(read_points(folder), points)


def test_the_project_is_found_where_it_lies(tmp_path: Path) -> None:
    write_colmap(tmp_path / "a", frames())
    found = tmp_path / "a" / "sparse" / "0"
    assert model_folder(tmp_path / "a") == found
    assert model_folder(found) == found
    (tmp_path / "b").mkdir()
    with pytest.raises(FileNotFoundError, match="holds no reconstruction of COLMAP"):
        model_folder(tmp_path / "b")
    with pytest.raises(FileNotFoundError, match="There is no folder"):
        model_folder(tmp_path / "c")


@pytest.mark.parametrize("binary", [False, True])
def test_camera_models_that_cannot_be_undistorted_are_refused_by_name(tmp_path: Path, binary: bool) -> None:
    folder = model_folder(write_colmap(tmp_path, frames(), "OPENCV_FISHEYE", binary=binary))
    with pytest.raises(ValueError, match="has the model OPENCV_FISHEYE; read are SIMPLE_PINHOLE, PINHOLE"):
        read_cameras(folder)


def test_unknown_numbers_and_missing_files_are_named(tmp_path: Path) -> None:
    folder = model_folder(write_colmap(tmp_path, frames()))
    data = bytearray((folder / "cameras.bin").read_bytes())
    data[12] = 77
    (folder / "cameras.bin").write_bytes(data)
    with pytest.raises(ValueError, match=r"cameras\.bin is damaged .*model number 77"):
        read_cameras(folder)
    (folder / "images.bin").unlink()
    with pytest.raises(FileNotFoundError, match=r"neither images.bin nor images.txt"):
        read_images(folder)


@pytest.mark.parametrize(
    ("name", "line", "read"),
    [
        ("cameras", "1 PINHOLE 640 480 500 500 320", read_cameras),
        ("cameras", "1 PINHOLE 640", read_cameras),
        ("cameras", "1 PINHOLE wide 480 500 500 320 240", read_cameras),
        ("images", "1 1 0 0 0 0 0 0", read_images),
        ("images", "1 nan 0 0 0 0 0 0 1 a.jpg", read_images),
        ("images", "1 0 0 0 0 0 0 0 1 a.jpg", read_images),
        ("points3D", "1 2 3", read_points),
        ("points3D", "1 nan 3 4 0 0 0 1", read_points),
    ],
)
def test_lines_that_make_no_sense_are_refused(tmp_path: Path, name: str, line: str, read) -> None:
    folder = model_folder(write_colmap(tmp_path, frames(), binary=False))
    (folder / f"{name}.txt").write_text(line + "\n")
    with pytest.raises(ValueError, match=str(folder)):
        read(folder)


def test_text_files_with_blank_lines_and_a_byte_order_mark(tmp_path: Path) -> None:
    folder = model_folder(write_colmap(tmp_path, frames(), binary=False))
    expected = read_images(folder)
    lines = (folder / "images.txt").read_text().splitlines()
    pairs = [f"\n{first}\n{second}\n" for first, second in zip(lines[2::2], lines[3::2])]
    (folder / "images.txt").write_text("\n".join([*lines[:2], *pairs]), "utf-8-sig")
    assert [image.name for image in read_images(folder)] == [image.name for image in expected]
    (folder / "images.txt").write_text("\n".join(lines[2::2]))  # without the lines of points
    with pytest.raises(ValueError, match=r"the line after that of .* holds no points"):
        read_images(folder)


@settings(max_examples=80, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    name=st.sampled_from(["cameras", "images", "points3D"]),
    place=st.integers(0, 600),
    value=st.binary(min_size=1, max_size=8),
    cut=st.none() | st.integers(0, 600),
    binary=st.booleans(),
)
def test_no_damage_gets_through_as_another_error(
    tmp_path_factory: pytest.TempPathFactory, name: str, place: int, value: bytes, cut: int | None, binary: bool
) -> None:
    folder = model_folder(write_colmap(tmp_path_factory.mktemp("c"), frames(), binary=binary, points=np.eye(3)))
    path = folder / f"{name}.{'bin' if binary else 'txt'}"
    data = bytearray(path.read_bytes())
    data[place : place + len(value)] = value
    path.write_bytes(data[:cut])
    read = {"cameras": read_cameras, "images": read_images, "points3D": read_points}[name]
    try:
        assert read(folder) is not None
    except ValueError as error:
        assert str(folder) in str(error)
