from __future__ import annotations

import os
import struct
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from normlift_ns.errors import InputError
from normlift_ns.scenes.colmap import intrinsics_of, model_folder, pose_of, read_model, read_points
from normlift_ns.scenes.frames import Frame, Intrinsics
from tests.examples import examples
from tests.scenes.made import write_colmap

DISTORTED = Intrinsics(500.5, 500.5, 320.25, 240.75, 640, 480, k1=0.05, k2=-0.01, p1=1e-3, p2=-2e-3)
KEPT = {
    "SIMPLE_PINHOLE": (), "PINHOLE": (), "SIMPLE_RADIAL": ("k1",), "RADIAL": ("k1", "k2"),
    "OPENCV": ("k1", "k2", "p1", "p2"),
}  # fmt: skip


def read_cameras(folder: Path) -> dict[int, Intrinsics]:
    return {number: intrinsics_of(camera, folder) for number, camera in read_model(folder)[0].items()}


def read_images(folder: Path) -> list:
    return sorted(read_model(folder)[1], key=lambda image: image.name)


def frames(count: int = 5) -> list[Frame]:
    rotations = Rotation.random(count, random_state=0).as_matrix()
    centres = np.random.default_rng(0).normal(size=(count, 3))
    return [
        Frame(Path(f"{i}.jpg"), f"images/photo {i}.jpg", np.column_stack([r, c]), DISTORTED)
        for i, (r, c) in enumerate(zip(rotations, centres))
    ]


def test_projects_are_read(tmp_path: Path) -> None:
    points = np.random.default_rng(1).normal(size=(9, 3))
    for model, kept in KEPT.items():
        for binary in (False, True):
            project = write_colmap(tmp_path / f"{model}{binary}", frames(), model, binary=binary, points=points)
            folder = model_folder(project)
            cameras, images = read_cameras(folder), read_images(folder)
            assert [image.name for image in images] == [f"photo {i}.jpg" for i in range(5)]
            lost = {name: 0.0 for name in ("k1", "k2", "p1", "p2") if name not in kept}
            for image, frame in zip(images, frames()):
                assert np.allclose(pose_of(image), frame.pose, atol=1e-12)
                assert cameras[image.camera] == DISTORTED._replace(**lost), (model, binary)
            assert np.array_equal(read_points(folder), points)


def test_the_project_is_found_where_it_lies(tmp_path: Path) -> None:
    write_colmap(tmp_path / "a", frames())
    found = tmp_path / "a" / "sparse" / "0"
    assert model_folder(tmp_path / "a") == found == model_folder(found)
    (tmp_path / "b").mkdir()
    for name, message in (("b", "COLMAP"), ("c", "no folder")):
        with pytest.raises(FileNotFoundError, match=message):
            model_folder(tmp_path / name)


def test_unknown_models_and_missing_files_are_named(tmp_path: Path) -> None:
    for binary in (False, True):
        folder = model_folder(write_colmap(tmp_path / str(binary), frames(), "OPENCV_FISHEYE", binary=binary))
        with pytest.raises(InputError, match=r"OPENCV_FISHEYE; .* SIMPLE_PINHOLE, PINHOLE"):
            read_cameras(folder)
    folder = model_folder(write_colmap(tmp_path, frames()))
    data = bytearray((folder / "cameras.bin").read_bytes())
    data[12] = 77
    (folder / "cameras.bin").write_bytes(data)
    with pytest.raises(InputError, match=r"cameras\.bin .* 77"):
        read_cameras(folder)
    write_colmap(tmp_path / "whole", frames())
    folder = model_folder(tmp_path / "whole")
    (folder / "images.bin").unlink()
    with pytest.raises(FileNotFoundError, match=r"images\.bin nor images\.txt"):
        read_images(folder)
    os.mkfifo(folder / "images.txt")
    with pytest.raises(FileNotFoundError, match=r"images\.bin nor images\.txt"):
        read_images(folder)


def test_lines_that_make_no_sense_are_refused(tmp_path: Path) -> None:
    folder = model_folder(write_colmap(tmp_path, frames(), binary=False))
    for name, line, read in (
        ("cameras", "1 PINHOLE 640 480 500 500 320", read_cameras),
        ("cameras", "1 PINHOLE 640", read_cameras),
        ("cameras", "1 PINHOLE wide 480 500 500 320 240", read_cameras),
        ("images", "1 1 0 0 0 0 0 0", read_images),
        ("images", "1 nan 0 0 0 0 0 0 1 a.jpg", read_images),
        ("images", "1 0 0 0 0 0 0 0 1 a.jpg", read_images),
        ("points3D", "1 2 3", read_points),
        ("points3D", "1 nan 3 4 0 0 0 1", read_points),
    ):
        whole = (folder / f"{name}.txt").read_text()
        (folder / f"{name}.txt").write_text(line + "\n")
        with pytest.raises(InputError, match=str(folder)):
            read(folder)
        (folder / f"{name}.txt").write_text(whole)


def test_what_no_reconstruction_has_is_refused(tmp_path: Path) -> None:
    folder = model_folder(write_colmap(tmp_path, frames(), "PINHOLE", binary=False))
    cameras, images = (folder / "cameras.txt").read_text(), (folder / "images.txt").read_text()
    for changed, message in (
        (cameras + cameras.splitlines()[-1], "twice"),
        (cameras.replace("640", "1000000000"), "65,536"),
        (cameras.replace("500.5", "inf"), "inf"),
        ("# nothing", "camera 5"),
    ):
        (folder / "cameras.txt").write_text(changed)
        with pytest.raises(InputError, match=message):
            read_model(folder)
    (folder / "cameras.txt").write_text(cameras)
    (folder / "images.txt").write_text(images + "\n".join(images.splitlines()[-2:]))
    with pytest.raises(InputError, match="same number"):
        read_model(folder)
    (folder / "images.txt").write_text("# none")
    with pytest.raises(InputError, match="0 registered images"):
        read_model(folder)


def test_counts_beyond_the_file_are_refused(tmp_path: Path) -> None:
    folder = model_folder(write_colmap(tmp_path, frames()))
    for name in ("cameras", "images"):
        whole = (folder / f"{name}.bin").read_bytes()
        (folder / f"{name}.bin").write_bytes(struct.pack("<Q", 10**12) + whole[8:])
        with pytest.raises(InputError, match="1,000,000,000,000"):
            read_model(folder)
        (folder / f"{name}.bin").write_bytes(whole)


def test_text_files_with_blank_lines_and_a_byte_order_mark(tmp_path: Path) -> None:
    folder = model_folder(write_colmap(tmp_path, frames(), binary=False))
    expected = read_images(folder)
    lines = (folder / "images.txt").read_text().splitlines()
    pairs = [f"\n{first}\n{second}\n" for first, second in zip(lines[2::2], lines[3::2])]
    (folder / "images.txt").write_text("\n".join([*lines[:2], *pairs]), "utf-8-sig")
    assert [image.name for image in read_images(folder)] == [image.name for image in expected]
    (folder / "images.txt").write_text("\n".join(lines[2::2]))  # without the lines of points
    with pytest.raises(ValueError, match="points"):
        read_images(folder)


@examples(25)
@given(
    name=st.sampled_from(["cameras", "images", "points3D"]),
    place=st.integers(0, 600),
    value=st.binary(min_size=1, max_size=8),
    cut=st.none() | st.integers(0, 600),
    binary=st.booleans(),
)
def test_no_damage_gets_through_as_another_error(tmp_path_factory, name, place, value, cut, binary) -> None:
    folder = tmp_path_factory.mktemp("c")
    model = model_folder(write_colmap(folder, frames(2), binary=binary, points=np.eye(3)))
    path = model / f"{name}.{'bin' if binary else 'txt'}"
    data = bytearray(path.read_bytes())
    data[place : place + len(value)] = value
    path.write_bytes(data[:cut])
    try:
        read_points(model) if name == "points3D" else (read_cameras(model), [pose_of(i) for i in read_images(model)])
    except (InputError, FileNotFoundError) as error:
        assert str(folder) in str(error)
