"""Fisheye images of camera files: a float64 projection of Kannala and Brandt is the reference."""

import json
import warnings
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

import normlift_ns as nl
from normlift_ns.core.evidence import MASKED
from normlift_ns.data.cameras import read_camera_file
from normlift_ns.data.fisheye import kept_share, undistort_labels
from normlift_ns.data.frames import Frame, Intrinsics, check_frames
from normlift_ns.data.images import ImageViews, label_undistortion
from normlift_ns.data.open_scene import open_saved_splat
from normlift_ns.data.transforms import read_transforms, write_transforms
from normlift_ns.encoders.base import RegionFeatures
from normlift_ns.encoders.color import ColorEncoder
from normlift_ns.errors import InputError
from normlift_ns.evidence_collection import observe_views
from normlift_ns.options import SplatOptions
from normlift_ns.segmentation.regions import Grid, LabelFiles
from tests.data.scene_files import ply_columns, random_splat, saved_run, write_colmap, write_ply

LENS = Intrinsics(150.0, 152.0, 104.0, 77.0, 200, 160, k1=0.03, k2=-0.01, k3=0.004, k4=-0.001, fisheye=True)
WIDE = LENS._replace(fx=100.0, fy=100.0, k1=0.0)
"""A lens of 115 by 92 degrees."""
MODELS = {
    "OPENCV_FISHEYE": LENS,
    "THIN_PRISM_FISHEYE": LENS,
    "RADIAL_FISHEYE": LENS._replace(fy=150.0, k3=0.0, k4=0.0),
    "SIMPLE_RADIAL_FISHEYE": LENS._replace(fy=150.0, k2=0.0, k3=0.0, k4=0.0),
    "SIMPLE_FISHEYE": LENS._replace(fy=150.0, k1=1e-12, k2=0.0, k3=0.0, k4=0.0),
    "FISHEYE": LENS._replace(k1=1e-12, k2=0.0, k3=0.0, k4=0.0),
}
POINTS = np.array([[0.0, 0.0], [0.3, -0.2], [-0.45, 0.35], [0.5, 0.4], [-0.55, -0.42]])
"""Tangents x/z and y/z of points in front of the camera."""


def project(tangents: np.ndarray, lens: Intrinsics) -> np.ndarray:
    """Pixels of directions [..., 2], with pixel centers at half integers."""
    r = np.linalg.norm(tangents, axis=-1)
    theta = np.arctan(r)
    bent = theta * (1 + lens.k1 * theta**2 + lens.k2 * theta**4 + lens.k3 * theta**6 + lens.k4 * theta**8)
    scale = np.where(r > 0, bent / np.where(r > 0, r, 1), 1)[..., None]
    return tangents * scale * [lens.fx, lens.fy] + [lens.cx, lens.cy]


def unproject(lens: Intrinsics) -> np.ndarray:
    """Tangents [H, W, 2] of all pixels, by a table of the angle."""
    theta = np.linspace(0, 1.3, 200_001)
    bent = (project(np.stack([np.tan(theta), 0 * theta], 1), lens)[:, 0] - lens.cx) / lens.fx
    y, x = np.mgrid[: lens.height, : lens.width] + 0.5
    offset = np.stack([(x - lens.cx) / lens.fx, (y - lens.cy) / lens.fy], -1)
    r = np.linalg.norm(offset, axis=-1, keepdims=True)
    return offset / np.maximum(r, 1e-12) * np.tan(np.interp(r, bent, theta))


def transforms(folder: Path, lens: Intrinsics, shared: dict, **frame) -> Path:
    names = ("fl_x", "fl_y", "cx", "cy", "w", "h", "k1", "k2", "k3", "p1", "p2", "k4")
    entry = {"file_path": "images/a.png", "transform_matrix": np.eye(4).tolist(), **dict(zip(names, lens)), **frame}
    (folder / "transforms.json").write_text(json.dumps({**shared, "frames": [entry]}))
    return folder / "transforms.json"


def blobs(lens: Intrinsics, centers: np.ndarray, matrix: np.ndarray) -> np.ndarray:
    """A fisheye image of spots that are round in the undistorted image."""
    pixels = unproject(lens) * matrix[[0, 1], [0, 1]] + matrix[:2, 2]
    distance = ((pixels[:, :, None] - centers) ** 2).sum(-1)
    return np.rint(255 * np.exp(-distance / (2 * 2.5**2)).sum(-1)).astype(np.uint8)


@pytest.mark.parametrize("model", [*MODELS, "transforms.json", "instant-ngp"])
def test_a_point_lands_where_a_pinhole_shows_it(tmp_path: Path, model: str) -> None:
    lens = MODELS.get(model, LENS)
    (tmp_path / "images").mkdir()
    file = tmp_path / "images" / "a.png"
    Image.new("RGB", (200, 160)).save(file)
    if model in MODELS:
        write_colmap(tmp_path, [Frame(file, "images/a.png", np.eye(4)[:3], lens)], model)
        options = SplatOptions(colmap=tmp_path)
    else:
        shared = {"camera_model": "OPENCV_FISHEYE"} if model == "transforms.json" else {"is_fisheye": True}
        options = SplatOptions(transforms=transforms(tmp_path, lens, shared))
    views = ImageViews(read_camera_file(options).frames, torch.zeros(3))
    assert views.frames[0].intrinsics == lens
    matrix = views.cameras[0].K.double().numpy()
    expected = POINTS * matrix[[0, 1], [0, 1]] + matrix[:2, 2]
    Image.fromarray(blobs(lens, expected, matrix)).convert("RGB").save(file)
    view = views[0]
    assert view.image.shape == (160, 200, 3)
    assert view.mask is None or view.mask.float().mean() > 0.99
    image = view.image[:, :, 0].double().numpy()
    for x, y in expected:
        rows, columns = slice(int(y) - 9, int(y) + 10), slice(int(x) - 9, int(x) + 10)
        weights = image[rows, columns]
        v, u = np.mgrid[rows, columns] + 0.5
        found = np.array([(u * weights).sum(), (v * weights).sum()]) / weights.sum()
        assert np.abs(found - [x, y]).max() < 0.1


def test_labels_and_masks_are_undistorted_without_interpolation(tmp_path: Path) -> None:
    file, maps = tmp_path / "a.png", tmp_path / "maps"
    rng = np.random.default_rng(0)
    labels, mask = rng.integers(1, 9, (20, 25)).repeat(8, 0).repeat(8, 1), rng.random((160, 200)) > 0.5
    maps.mkdir()
    np.save(maps / "a.npy", labels)
    Image.fromarray(rng.integers(0, 255, (160, 200, 3), np.uint8)).save(file)
    Image.fromarray(mask).save(tmp_path / "mask.png")
    lens = WIDE._replace(cy=70.0, k1=0.01)  # the upper and lower rim lie outside of the original image
    frame = Frame(file, "a.png", np.eye(4)[:3], lens)
    views = ImageViews([frame], torch.zeros(3))
    matrix = views.cameras[0].K.double().numpy()
    y, x = np.mgrid[:160, :200] + 0.5
    source = project((np.stack([x, y], -1) - matrix[:2, 2]) / matrix[[0, 1], [0, 1]], lens)
    column, row = np.floor(source).astype(int).transpose(2, 0, 1)
    inside = (column >= 0) & (column < 200) & (row >= 0) & (row < 160)
    clear = (np.abs(source - np.rint(source)) > 1e-3).all(-1)  # float32 decides at borders of pixels
    assert 0 < (~inside).sum() < 0.1 * inside.size
    for taken, file_of_mask in ((np.ones((160, 200), bool), None), (mask, tmp_path / "mask.png")):
        found = ImageViews([replace(frame, mask=file_of_mask)], torch.zeros(3))[0].mask
        assert found is not None
        expected = inside & taken[row.clip(0, 159), column.clip(0, 199)]
        assert np.array_equal(found.numpy()[clear], expected[clear])
    undistort = label_undistortion(views)
    assert undistort is not None
    expected = np.where(inside, labels[row.clip(0, 159), column.clip(0, 199)], -1)
    assert np.array_equal(undistort("a.png", labels[None])[0][clear], expected[clear])
    regions = LabelFiles(maps, undistort=undistort).labels(views[0].image, "a.png")[0, 0].numpy()
    assert np.array_equal(regions[clear], (expected - (expected > 0))[clear])
    flat = replace(frame, intrinsics=lens._replace(fisheye=False))
    assert label_undistortion(ImageViews([flat], torch.zeros(3))) is None


@pytest.mark.parametrize("lens", [LENS, LENS._replace(k1=0.5, k2=0.5), WIDE._replace(cx=90.0, cy=90.0, k1=-0.05)])
def test_the_longest_focal_length_that_keeps_nine_tenths(tmp_path: Path, lens: Intrinsics) -> None:
    views = ImageViews([Frame(tmp_path, "a", np.eye(4)[:3], lens)], torch.zeros(3))
    matrix, tangents = views.cameras[0].K.double().numpy(), unproject(lens)
    assert np.allclose(matrix[:2, 2], lens[2:4])
    assert matrix[0, 0] / matrix[1, 1] == pytest.approx(lens.fx / lens.fy)

    def kept(factor: float) -> float:
        pixels = tangents * matrix[[0, 1], [0, 1]] * factor + matrix[:2, 2]
        return ((pixels > 0) & (pixels < lens[4:6])).all(-1).mean()

    assert kept(1.02) < 0.9 <= kept(1) < 0.92
    assert kept_share(lens) == pytest.approx(kept(1), abs=5e-3)


def test_pixels_that_no_pinhole_shows_are_named(tmp_path: Path) -> None:
    """A lens of 230 by 184 degrees: all pixels within 80 degrees are kept."""
    Image.new("RGB", (200, 160)).save(tmp_path / "a.png")
    splat = write_ply(tmp_path / "a.ply", ply_columns(random_splat(50)))

    def opened(lens: Intrinsics) -> list[str]:
        said: list[str] = []
        path = transforms(tmp_path, lens, {"camera_model": "OPENCV_FISHEYE"}, file_path="a.png")
        nl.open_splat(splat, nl.SplatOptions(transforms=path, world_transform=None), say=said.append)
        return said

    lens = LENS._replace(fx=50.0, fy=50.0, cx=100.0, cy=80.0, k1=0.0, k2=0.0, k3=0.0, k4=0.0)
    y, x = np.mgrid[:160, :200] + 0.5
    seen = (np.hypot(x - 100, y - 80) / 50 < np.radians(80)).mean()
    assert kept_share(lens) == pytest.approx(seen, abs=5e-3)
    assert any(f"{kept_share(lens):.0%}" in text and "80 degrees" in text for text in opened(lens))
    with pytest.raises(InputError, match=r"a\.png .*fx 10.*colmap image_undistorter"):
        opened(LENS._replace(fx=10.0, fy=10.0))


def test_pixels_that_the_image_does_not_show_have_no_region_and_no_color(tmp_path: Path) -> None:
    (tmp_path / "images").mkdir()
    Image.new("RGB", (200, 160), (180, 40, 30)).save(tmp_path / "images" / "a.png")
    write_colmap(tmp_path, [Frame(tmp_path / "a.png", "images/a.png", np.eye(4)[:3], WIDE)], "OPENCV_FISHEYE")
    splat = write_ply(tmp_path / "a.ply", ply_columns(random_splat(50)))
    scene = nl.open_splat(splat, nl.SplatOptions(colmap=tmp_path, world_transform=None, gsplat_normalize=False))
    view = scene.train[0]
    assert view.mask is not None
    assert 0.8 < view.mask.float().mean() < 0.99
    assert (view.image[~view.mask] == 0).all()
    assert (view.image[view.mask] == torch.tensor([180, 40, 30], dtype=torch.uint8)).all()  # at its rim too
    source = RegionFeatures(Grid(30), ColorEncoder())
    for downscale in (1, 2):
        block = observe_views(scene, [0], source, render_settings=None, downscale=downscale)
        mask = view.downscaled(160 // downscale, 200 // downscale).mask
        assert torch.equal(block.labels[0] == MASKED, ~mask)
        labels = block.labels[0][mask]
        assert set(labels.unique().tolist()) - {-1} <= set(range(len(block.features[0])))
        assert (labels == -1).float().mean() <= 0.02 * (downscale - 1)
        assert (block.features[0] @ block.features[0].T).min() > 0.999  # no black is mixed into them


def test_fisheye_cameras_are_stored_for_nerfstudio(tmp_path: Path) -> None:
    """Zero distortion, which nerfstudio takes for a pinhole; one type of camera only."""
    (tmp_path / "images").mkdir()
    Image.new("RGB", (200, 160)).save(tmp_path / "images" / "a.png")
    zero = LENS._replace(k1=0.0, k2=0.0, k3=0.0, k4=0.0)
    path = transforms(tmp_path, zero, {"camera_model": "OPENCV_FISHEYE"})
    frames = read_transforms(path).frames
    write_transforms(tmp_path / "again.json", frames, ())
    again = read_transforms(tmp_path / "again.json").frames
    assert json.loads((tmp_path / "again.json").read_text())["camera_model"] == "OPENCV_FISHEYE"
    assert again[0].intrinsics == frames[0].intrinsics
    assert again[0].intrinsics.is_distorted
    assert again[0].intrinsics[:6] == zero[:6]
    assert np.allclose(again[0].intrinsics[6:12], zero[6:12], atol=1e-9)
    mixed = [frames[0], Frame(tmp_path / "b.png", "b.png", np.eye(4)[:3], zero._replace(fisheye=False))]
    with pytest.raises(InputError, match=r"images/a\.png has a fisheye .*b\.png has a perspective"):
        check_frames(mixed, path)


def test_a_splat_is_opened_with_fisheye_images(tmp_path: Path) -> None:
    """The views of its stored run are the same; label maps of the original images are undistorted for the lift."""
    said, labels = [], np.arange(160)[:, None] // 20 + np.zeros((1, 200), int)
    for folder in ("images", "maps"):
        (tmp_path / folder).mkdir()
    frames = [Frame(tmp_path / f"{i}.png", f"images/{i}.png", np.eye(4)[:3], LENS) for i in range(3)]
    for i in range(3):
        Image.effect_noise((200, 160), 90).convert("RGB").save(tmp_path / "images" / f"{i}.png")
        np.save(tmp_path / "maps" / f"{i}.npy", labels + 1)
    write_colmap(tmp_path, frames, "OPENCV_FISHEYE")
    splat = write_ply(tmp_path / "a.ply", ply_columns(random_splat(50)))
    scene = nl.open_splat(splat, nl.SplatOptions(colmap=tmp_path, gsplat_normalize=False), say=said.append)
    assert any(f"{kept_share(LENS):.0%}" in text for text in said)
    again = open_saved_splat(saved_run(tmp_path / "run", scene))
    for first, second in ((scene.train[i], again.train[i]) for i in range(3)):
        assert torch.equal(first.camera.K, second.camera.K)
        assert torch.equal(first.image, second.image)
    source = RegionFeatures(LabelFiles(tmp_path / "maps"), ColorEncoder())
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for downscale in (1, 2):
            block = observe_views(scene, [1], source, render_settings=None, downscale=downscale)
            undistorted = undistort_labels(labels[None], LENS)[0]
            step, expected = block.labels[0][:, 100 // downscale].numpy(), undistorted[downscale // 2 :: downscale, 100]
            assert np.abs(step - expected)[step >= 0].max() <= downscale - 1
            assert (step >= 0).mean() > 0.9
            assert (undistorted[:, 100] != labels[:, 100]).any()  # the map is not that of the file
