import os
import shutil
import struct
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from scipy.spatial.transform import Rotation

from normlift_ns.data.colmap import (
    colmap_intrinsics,
    colmap_pose,
    find_colmap_model,
    read_colmap,
    read_colmap_model,
    read_colmap_points,
)
from normlift_ns.data.frames import Frame, Intrinsics
from normlift_ns.errors import InputError
from tests.data.scene_files import write_colmap
from tests.hostile import damaged, fuzz

DISTORTED = Intrinsics(500.5, 500.5, 320.25, 240.75, 640, 480, k1=0.05, k2=-0.01, p1=1e-3, p2=-2e-3)
KEPT = {
    "SIMPLE_PINHOLE": (), "PINHOLE": (), "SIMPLE_RADIAL": ("k1",), "RADIAL": ("k1", "k2"),
    "OPENCV": ("k1", "k2", "p1", "p2"),
}  # fmt: skip


def read_cameras(folder: Path) -> dict[int, Intrinsics]:
    return {number: colmap_intrinsics(camera, folder) for number, camera in read_colmap_model(folder)[0].items()}


def read_images(folder: Path) -> list:
    return sorted(read_colmap_model(folder)[1], key=lambda image: image.name)


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
            folder = find_colmap_model(project)
            cameras, images = read_cameras(folder), read_images(folder)
            assert [image.name for image in images] == [f"photo {i}.jpg" for i in range(5)]
            lost = {name: 0.0 for name in ("k1", "k2", "p1", "p2") if name not in kept}
            for image, frame in zip(images, frames()):
                assert np.allclose(colmap_pose(image), frame.pose, atol=1e-12)
                assert cameras[image.camera_id] == DISTORTED._replace(**lost), (model, binary)
            assert np.array_equal(read_colmap_points(folder), points)


def test_the_project_is_found_where_it_lies(tmp_path: Path) -> None:
    write_colmap(tmp_path / "a", frames())
    found = tmp_path / "a" / "sparse" / "0"
    assert find_colmap_model(tmp_path / "a") == found == find_colmap_model(found)
    for place in ("d/sparse", "e"):
        there = shutil.copytree(found, tmp_path / place)
        assert find_colmap_model(tmp_path / place[0]) == there
    (tmp_path / "b").mkdir()
    for name, message in (("b", "COLMAP"), ("c", "not an existing folder")):
        with pytest.raises(FileNotFoundError, match=message):
            find_colmap_model(tmp_path / name)


def test_the_largest_of_several_reconstructions_is_read(tmp_path: Path) -> None:
    for name, count in (("0", 2), ("1", 5), ("10", 3)):
        model = write_colmap(tmp_path / name, frames(count), binary=name != "1") / "sparse" / "0"
        (tmp_path / "p" / "sparse").mkdir(parents=True, exist_ok=True)
        model.rename(tmp_path / "p" / "sparse" / name)
    said: list[str] = []
    for folder in (tmp_path / "p", tmp_path / "p" / "sparse"):
        assert find_colmap_model(folder, said.append) == tmp_path / "p" / "sparse" / "1"
        assert all(part in said[-1] for part in ("0 (images: 2)", "1 (images: 5)", "10 (images: 3)", "give its folder"))
    assert find_colmap_model(tmp_path / "p" / "sparse" / "0", said.append).name == "0"
    (tmp_path / "p" / "sparse" / "1" / "images.txt").write_text("damaged")
    assert find_colmap_model(tmp_path / "p").name == "10"
    assert len(said) == 2


def test_two_formats_must_agree(tmp_path: Path) -> None:
    (tmp_path / "images").mkdir()
    for i in range(5):
        Image.new("RGB", (4, 4)).save(tmp_path / "images" / f"photo {i}.jpg")
    folder = write_colmap(tmp_path, frames()) / "sparse" / "0"
    text = write_colmap(tmp_path / "text", frames(), binary=False) / "sparse" / "0"
    for name in ("cameras.txt", "images.txt"):
        shutil.copy(text / name, folder)
    assert len(read_colmap(tmp_path, None, None, advice="").frames) == 5
    for name, old, new in (("cameras.txt", "500.5", "600.5"), ("images.txt", "photo 3", "photo 7")):
        whole = (folder / name).read_text()
        (folder / name).write_text(whole.replace(old, new))
        with pytest.raises(InputError, match=r"contradictory.* rm .*\*\.txt, or rm .*\*\.bin"):
            read_colmap(tmp_path, None, None, advice="")
        (folder / name).write_text(whole)


def test_models_that_are_simpler_than_their_name(tmp_path: Path) -> None:
    for line, kept in (
        ("FULL_OPENCV 640 480 500 501 320 240 0.1 0.2 0.01 0.02 0.3 0 0 0", (0.1, 0.2, 0.3, 0.01, 0.02)),
        ("FULL_OPENCV 640 480 500 501 320 240 0 0 0 0 0 0 0 0", (0, 0, 0, 0, 0)),
        ("FOV 640 480 500 501 320 240 0", (0, 0, 0, 0, 0)),
    ):
        folder = find_colmap_model(write_colmap(tmp_path / line, frames(1), "PINHOLE", binary=False))
        (folder / "cameras.txt").write_text(f"1 {line}\n")
        camera = read_cameras(folder)[1]
        assert (camera.fx, camera.fy, camera.cx, camera.cy, camera.distortion) == (500, 501, 320, 240, kept)
    for line, message in (
        ("FULL_OPENCV 640 480 500 501 320 240 0 0 0 0 0 0 0.1 0", r"FULL_OPENCV, k4 = 0, k5 = 0\.1"),
        ("FOV 640 480 500 501 320 240 0.5", r"FOV, omega = 0\.5"),
        ("THIN_PRISM_FISHEYE 640 480 500 501 320 240 0 0 0 0 0 0 0.1 0", r"THIN_PRISM_FISHEYE, .*sx1 = 0\.1"),
        ("SIMPLE_DIVISION 640 480 500 320 240 -0.1", r"SIMPLE_DIVISION, k = -0\.1"),
        ("EUCM 640 480 500 501 320 240 0.5 1", "EUCM"),
    ):
        (folder / "cameras.txt").write_text(f"1 {line}\n")
        with pytest.raises(InputError, match=f"{message}.*colmap image_undistorter .*--input_path") as caught:
            read_cameras(folder)
        assert "train" not in str(caught.value)


def test_unknown_models_and_missing_files_are_named(tmp_path: Path) -> None:
    folder = find_colmap_model(write_colmap(tmp_path / "full", frames(), "FULL_OPENCV"))
    with pytest.raises(InputError, match=r"FULL_OPENCV, .* SIMPLE_PINHOLE, PINHOLE"):
        read_cameras(folder)
    folder = find_colmap_model(write_colmap(tmp_path, frames()))
    for name, start, count, message in (
        ("cameras", 12, b"\x4d", r"cameras\.bin .* 77"),
        ("cameras", 0, struct.pack("<Q", 10**12), "1,000,000,000,000"),  # more than the file can hold
        ("images", 0, struct.pack("<Q", 10**12), "1,000,000,000,000"),
    ):
        whole = (folder / f"{name}.bin").read_bytes()
        (folder / f"{name}.bin").write_bytes(whole[:start] + count + whole[start + len(count) :])
        with pytest.raises(InputError, match=message):
            read_cameras(folder)
        (folder / f"{name}.bin").write_bytes(whole)
    (folder / "images.bin").unlink()
    for make in (lambda path: None, os.mkfifo):
        make(folder / "images.txt")
        with pytest.raises(FileNotFoundError, match=r"images\.bin nor images\.txt"):
            read_images(folder)


def test_what_makes_no_sense_is_refused(tmp_path: Path) -> None:
    folder = find_colmap_model(write_colmap(tmp_path, frames(), "PINHOLE", binary=False))
    cameras, images = (folder / "cameras.txt").read_text(), (folder / "images.txt").read_text()
    for name, content, read, message in (
        ("cameras", "1 PINHOLE 640 480 500 500 320", read_cameras, str(folder)),
        ("cameras", "1 PINHOLE 640", read_cameras, str(folder)),
        ("cameras", "1 PINHOLE wide 480 500 500 320 240", read_cameras, str(folder)),
        ("cameras", cameras + cameras.splitlines()[-1], read_colmap_model, "twice"),
        ("cameras", cameras.replace("640", "1000000000"), read_colmap_model, "65,536"),
        ("cameras", cameras.replace("500.5", "inf"), read_colmap_model, "inf"),
        ("cameras", "# nothing", read_colmap_model, "camera 5"),
        ("images", "1 1 0 0 0 0 0 0", read_images, str(folder)),
        ("images", "1 nan 0 0 0 0 0 0 1 a.jpg", read_images, str(folder)),
        ("images", "1 0 0 0 0 0 0 0 1 a.jpg", read_images, str(folder)),
        ("images", images + "\n".join(images.splitlines()[-2:]), read_colmap_model, "same ID"),
        ("images", "# none", read_colmap_model, "registered images: 0"),
        ("points3D", "1 2 3", read_colmap_points, str(folder)),
        ("points3D", "1 nan 3 4 0 0 0 1", read_colmap_points, str(folder)),
    ):
        whole = (folder / f"{name}.txt").read_text()
        (folder / f"{name}.txt").write_text(content + "\n")
        with pytest.raises(InputError, match=message):
            read(folder)
        (folder / f"{name}.txt").write_text(whole)


def test_text_files_with_blank_lines_and_a_byte_order_mark(tmp_path: Path) -> None:
    folder = find_colmap_model(write_colmap(tmp_path, frames(), binary=False))
    expected = read_images(folder)
    lines = (folder / "images.txt").read_text().splitlines()
    pairs = [f"\n{first}\n{second}\n" for first, second in zip(lines[2::2], lines[3::2])]
    (folder / "images.txt").write_text("\n".join([*lines[:2], *pairs]), "utf-8-sig")
    assert [image.name for image in read_images(folder)] == [image.name for image in expected]
    unseen = "\r\n".join(line for first in lines[2::2] for line in (first, ""))  # RealityScan, Metashape
    (folder / "images.txt").write_bytes(unseen.encode())
    assert [image.name for image in read_images(folder)] == [image.name for image in expected]
    (folder / "images.txt").write_text("\n".join(lines[2::2]))  # without the lines of points
    with pytest.raises(ValueError, match="points"):
        read_images(folder)


def test_no_damage_gets_through_as_another_error(tmp_path: Path) -> None:
    for suffix in ("bin", "txt"):
        project = write_colmap(tmp_path / suffix, frames(2), binary=suffix == "bin", points=np.eye(3))
        model = find_colmap_model(project)

        def load(folder: Path = model) -> None:
            try:
                _ = read_colmap_points(folder), read_cameras(folder)
                _ = [colmap_pose(image) for image in read_images(folder)]
            except (InputError, FileNotFoundError) as error:
                assert str(folder) in str(error)
                raise

        for path in sorted(model.iterdir()):
            whole = path.read_bytes()
            fuzz(5, damaged(whole), path, load)
            path.write_bytes(whole)
