import json
import math
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from normlift_ns.data.cameras import read_camera_file
from normlift_ns.data.frames import Intrinsics, check_frames
from normlift_ns.data.transforms import read_transforms, write_transforms
from normlift_ns.errors import InputError
from normlift_ns.options import SplatOptions

INTRINSICS = {"fl_x": 50.0, "fl_y": 51.0, "cx": 20.5, "cy": 14.5, "w": 40, "h": 30}


def capture(folder: Path, content: dict | None = None, *, names=("images/b.png", "images/a.png"), **frame) -> Path:
    for name in names:
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        Image.new("RGB", (40, 30)).save(folder / name)
    frames = [{"file_path": name, "transform_matrix": np.eye(4).tolist(), **frame} for name in names]
    path = folder / "transforms.json"
    path.write_text(json.dumps({**INTRINSICS, "frames": frames} if content is None else {**content, "frames": frames}))
    return path


def test_what_stands_in_the_file_and_in_a_frame_must_agree(tmp_path: Path) -> None:
    own = {"fl_x": 50.001, "fl_y": 71.0, "k1": 0.5, "k2": 0.6, "w": 40, "h": 30}
    camera = read_transforms(capture(tmp_path, {"fl_x": 50.0, "k1": 0.5, "k2": 0.6}, **own)).frames[0].intrinsics
    assert (camera.fx, camera.fy, camera.cx, camera.cy) == (50, 71, 20, 15)
    assert camera.distortion == (0.5, 0.6, 0, 0, 0)
    angle = 2 * math.atan(20 / 70)
    for shared, frame, places in (
        ({"fl_x": 50.0}, {"fl_x": 70.0}, (".fl_x", ".frames[].fl_x")),
        ({"fl_x": 50.0}, {"camera_angle_x": angle}, (".fl_x", ".frames[].camera_angle_x")),
        ({"fl_x": 50.0, "camera_angle_x": angle}, {}, (".fl_x", ".camera_angle_x")),
        ({"cx": 20.0}, {"cx": 21.0}, (".cx", ".frames[].cx")),
        ({"k1": 0.1, "k2": 0.2}, {"k1": 0.1}, (".k1, .k2", ".frames[].k1")),
        ({"w": 40, "h": 30}, {"w": 80, "h": 60}, (".w, .h", ".frames[].w, .frames[].h")),
        ({"camera_model": "OPENCV"}, {"camera_model": "PINHOLE"}, (".camera_model", ".frames[].camera_model")),
    ):
        path = capture(tmp_path, {"fl_x": 50.0, **shared}, **frame)
        with pytest.raises(InputError, match=r"contradictory.*images/b\.png") as caught:
            read_transforms(path)
        for place in places:
            assert f"jq 'del({place})' transforms.json > new.json" in str(caught.value), place
    path = capture(tmp_path, {}, distortion_params=[0.1, 0.2, 0.3, 0.0, 0.5, 0.6], fl_x=1.0)
    assert read_transforms(path).frames[0].intrinsics.distortion == (0.1, 0.2, 0.3, 0.5, 0.6)
    path = capture(tmp_path, {"camera_model": "full_opencv", "k3": 0.1, "k6": 0}, fl_x=1.0)
    assert read_transforms(path).frames[0].intrinsics.k3 == 0.1
    with pytest.raises(InputError, match=r"k6 = 0\.2"):
        read_transforms(capture(tmp_path, {"k6": 0.2}, fl_x=1.0))


def test_blenders_scenes_have_an_angle_and_names_without_suffix(tmp_path: Path) -> None:
    path = capture(tmp_path, {"camera_angle_x": 0.69}, names=("train/r_0.png",))
    path.write_text(path.read_text().replace("train/r_0.png", "./train/r_0"))
    frame = read_transforms(path).frames[0]
    assert frame.file == tmp_path / "train" / "r_0.png"
    assert frame.name == "train/r_0.png"
    assert frame.intrinsics.fx == pytest.approx(20 / math.tan(0.345))
    assert frame.intrinsics[1:6] == (frame.intrinsics.fx, 20, 15, 40, 30)
    path = capture(tmp_path, names=("images/frame.0000.png", "images/frame.0001.png"))  # and names may have dots
    path.write_text(path.read_text().replace(".png", ""))
    assert [frame.file.name for frame in read_transforms(path).frames] == ["frame.0000.png", "frame.0001.png"]


def test_transforms_of_ns_process_data(tmp_path: Path) -> None:
    """As it converts files of RealityScan and Metashape: intrinsics in every frame, with k4."""
    lens = {"k1": 0.01, "k2": -0.02, "k3": 0.003, "p1": 0.001, "p2": 0.002}
    shared = {"camera_model": "OPENCV", "applied_transform": np.eye(4)[[2, 0, 1]].tolist()}
    found = read_transforms(capture(tmp_path, shared, **INTRINSICS, **lens, k4=0.0))
    assert {frame.intrinsics for frame in found.frames} == {Intrinsics(*INTRINSICS.values(), **lens)}


def test_lists_of_names_say_what_is_held_out(tmp_path: Path) -> None:
    split = {"train_filenames": ["images/a.png"], "test_filenames": ["images/b.png"]}
    assert read_transforms(capture(tmp_path, {**INTRINSICS, **split})).held_out == {"images/b.png"}
    only = read_transforms(capture(tmp_path, {**INTRINSICS, "test_filenames": ["images/a.png"]}))
    assert only.held_out == {"images/a.png"}
    assert only.frames[0].intrinsics[:6] == (50, 51, 20.5, 14.5, 40, 30)
    with pytest.raises(InputError, match=r"train_filenames .*images/c.png"):
        read_transforms(capture(tmp_path, {**INTRINSICS, "train_filenames": ["images/a.png", "images/c.png"]}))


def test_images_and_masks_from_other_folders(tmp_path: Path) -> None:
    path = capture(tmp_path / "a")
    for name in ("images_2/a.png", "images_2/b.png", "masks/a.png.png", "masks/b.png"):
        (tmp_path / "b" / name).parent.mkdir(parents=True, exist_ok=True)
        Image.new("L", (20, 15)).save(tmp_path / "b" / name)
    found = read_transforms(path, tmp_path / "b" / "images_2", tmp_path / "b" / "masks").frames
    assert [frame.name for frame in found] == ["images_2/a.png", "images_2/b.png"]
    assert [frame.mask for frame in found] == [tmp_path / "b/masks/a.png.png", tmp_path / "b/masks/b.png"]
    (tmp_path / "b/masks/b.png").unlink()
    with pytest.raises(FileNotFoundError, match=r"masks has no mask for .*b\.png"):
        read_transforms(path, None, tmp_path / "b" / "masks")


def test_a_file_that_two_images_share_is_refused(tmp_path: Path) -> None:
    names = ("images/left/1.png", "images/right/1.png")
    masks = tmp_path / "masks"
    for name in ("1.png", "static.png"):
        masks.mkdir(exist_ok=True)
        Image.new("L", (40, 30)).save(masks / name)
    path = capture(tmp_path, names=names, mask_path="masks/1.png")
    with pytest.raises(InputError, match=r"share the mask .*mask_path of .*transforms\.json"):
        read_transforms(path)
    with pytest.raises(InputError, match=r"share the mask .*masks/1\.png"):
        read_camera_file(SplatOptions(transforms=capture(tmp_path, names=names), masks=masks))
    path = capture(tmp_path, names=names, mask_path="masks/static.png")  # of the whole camera
    assert {frame.mask for frame in read_transforms(path).frames} == {masks / "static.png"}


@pytest.mark.parametrize("start", ["C:\\Users\\me\\scene\\", "D:/scene/", "/home/me/scene/", ".\\", "\\\\nas\\x\\"])
def test_paths_of_another_machine(tmp_path: Path, start: str) -> None:
    names = ("images/left/1.png", "images/right/1.png")
    path = capture(tmp_path / "scene", {**INTRINSICS, "test_filenames": [names[1]]}, names=names)
    Image.new("L", (40, 30)).save(tmp_path / "scene" / "mask.png")
    content = json.loads(path.read_text())

    def there(name: str) -> str:
        return start + (name.replace("/", "\\") if "\\" in start else name)

    for frame in content["frames"]:
        frame["file_path"], frame["mask_path"] = there(frame["file_path"]), there("mask.png")
    content["test_filenames"] = [there(name) for name in content["test_filenames"]]
    path.write_text(json.dumps(content))
    for images in (None, tmp_path / "scene" / "images"):
        found = read_transforms(path, images)
        assert [frame.name for frame in found.frames] == list(names)
        assert {frame.mask.name for frame in found.frames} == {"mask.png"}
        assert found.held_out == {names[1]}
    (tmp_path / "scene" / names[0]).unlink()
    options = SplatOptions(transforms=path, images=tmp_path / "scene" / "images")
    with pytest.raises(FileNotFoundError, match=r"1 of 2, .*remove them from the camera file") as caught:
        read_camera_file(options)
    assert "--images" not in str(caught.value)  # which was given


def test_other_content_is_refused(tmp_path: Path) -> None:
    for content, frame, message in (
        ({**INTRINSICS, "camera_model": "EQUIRECTANGULAR"}, {}, "EQUIRECTANGULAR, .* OPENCV"),
        ({**INTRINSICS, "camera_model": "OPENCV_FISHEYE", "p1": 0.1}, {}, "p1 = 0.1, .* k3 and k4"),
        ({"w": 40, "h": 30}, {}, "fl_x nor camera_angle_x"),
        ({**INTRINSICS, "k4": 0.1}, {}, "k4 = 0.1"),
        ({**INTRINSICS, "w": 40.5}, {}, "whole number"),
        ({**INTRINSICS, "w": 0}, {}, "w is 0, .*whole number"),
        ({**INTRINSICS, "h": 10**30}, {}, "whole number"),
        ({**INTRINSICS, "is_fisheye": True, "camera_model": "OPENCV"}, {}, "is_fisheye .* OPENCV_FISHEYE"),
        ({"camera_angle_x": 0, "w": 40, "h": 30}, {}, "camera_angle is 0.* 0 and pi"),
        ({**INTRINSICS, "applied_scale": 0}, {}, "applied_scale is 0"),
        ({**INTRINSICS, "applied_transform": [[0, 0, 0, 0]] * 3}, {}, "applied_transform"),
        ({**INTRINSICS, "applied_transform": [[1]]}, {}, "applied_transform .* 3 x 4"),
        ({**INTRINSICS, "fl_x": "wide"}, {}, r"`str` - at `\$.fl_x`"),
        (INTRINSICS, {"transform_matrix": [[1, 0], [0, 1]]}, "transform_matrix of images/b.png .* 4 x 4"),
        (INTRINSICS, {"transform_matrix": np.diag([2, 2, 2, 1]).tolist()}, "pose of images/a.png .* rotation"),
        (INTRINSICS, {"transform_matrix": np.diag([-1, 1, 1, 1])[:3].tolist()}, "rotation"),
        ({**INTRINSICS, "fl_x": -5.0}, {}, "fl_x is -5, .*above 0"),
    ):
        path = capture(tmp_path, content, **frame)
        with pytest.raises(InputError, match=message) as caught:
            check_frames(read_transforms(path).frames, path)
        assert str(path) in str(caught.value)


def test_nan_and_missing_files_are_named(tmp_path: Path) -> None:
    path = capture(tmp_path)
    whole = path.read_text()
    path.write_text(whole.replace("50.0", "NaN"))
    with pytest.raises(InputError, match="NaN"):
        read_transforms(path)
    content = json.loads(whole)
    content["frames"][0]["mask_path"] = "images/a.png"  # and no mask for the other image
    path.write_text(json.dumps(content))
    with pytest.raises(InputError, match=r"masks .* images/a.png"):
        read_transforms(path)
    path.write_text(whole)
    (tmp_path / "images" / "b.png").unlink()
    with pytest.raises(FileNotFoundError, match=r"1 of 2, .* images/b.png"):
        read_transforms(path)
    with pytest.raises(InputError, match="no cameras"):
        check_frames([], path)


def test_what_is_written_is_read_again(tmp_path: Path) -> None:
    found = read_transforms(capture(tmp_path, {**INTRINSICS, "k1": 0.1, "p2": 0.2}))
    write_transforms(tmp_path / "again.json", found.frames[:1], found.frames[1:])
    again = read_transforms(tmp_path / "again.json", base=tmp_path)
    assert again.held_out == {"images/b.png"}
    for frame, before in zip(again.frames, found.frames):
        assert (frame.file, frame.name, frame.intrinsics) == (before.file, before.name, before.intrinsics)
        assert np.array_equal(frame.pose, before.pose.astype(np.float32))
