import json
import math
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from normlift_ns import render
from normlift_ns.demo import shapes
from normlift_ns.demo.capture import demo_cameras, held_out_cameras, view_image, view_labels, write_capture
from normlift_ns.demo.room import DemoRoom, demo_room, shade


@pytest.fixture(scope="module")
def room() -> DemoRoom:
    return demo_room(6000)


@pytest.fixture(scope="module")
def labels(room: DemoRoom) -> list[torch.Tensor]:
    """True classes in the views of `demo_cameras(6, 160, 120)`."""
    return [view_labels(room, camera) for camera in demo_cameras(6, 160, 120)]


def test_a_ball_throws_its_shadow_on_the_floor_whatever_the_order_of_points():
    center, rng = np.array([0.3, 0.4, 0.8]), np.random.default_rng(0)
    scene = lambda p: np.minimum(p[:, 2], np.linalg.norm(p - center, axis=1) - 0.3)  # noqa: E731
    floor = np.stack([*rng.uniform(-2, 2, (2, 3000)), np.zeros(3000)], axis=1)
    out = np.eye(3)[rng.integers(0, 3, 200)] * rng.choice([-1, 1], (200, 1))
    points, normals = np.concatenate([floor, center + 0.3 * out]), np.concatenate([floor * 0 + [0, 0, 1], out])
    light, order = shade(scene, points, normals)[0].mean(axis=1), rng.permutation(len(points))
    assert np.allclose(shade(scene, points[order], normals[order])[0].mean(axis=1), light[order])
    to_lamp, to_center = np.array([-0.8, 0.9, 2.6]) - floor, center - floor
    apart = np.linalg.norm(np.cross(to_center, to_lamp), axis=1) / np.linalg.norm(to_lamp, axis=1)
    assert light[:3000][apart < 0.25].max() < 0.65 and light[:3000][apart > 1.2].min() > 0.9


def test_contents(room: DemoRoom):
    assert len(room.scene) == len(room.colors) == 6000
    assert bool(room.scene.drawable.all())
    counts = torch.bincount(room.labels + 1)
    assert len(counts) == len(room.names) + 1 == 14
    assert counts[0] == 120 and counts[1:].min() > 60  # the first are floaters
    assert room.colors.min() >= 0 and room.colors.max() <= 1
    shape = torch.cat([room.scene.means, room.scene.scales, room.scene.quats.abs(), room.colors], dim=1).double()
    assert float(shape.std(dim=0).sum()) == pytest.approx(3.608499, rel=1e-5)  # as recorded
    assert 0.02 < float((room.scene.opacities < 1 / 255).float().mean()) < 0.06
    with pytest.raises(ValueError, match=r"2000.*1999"):
        demo_room(1999)


def test_surfaces_are_opaque_and_flat_gaussians_lie_along_them(room: DemoRoom):
    for camera in demo_cameras(4, 80, 60):
        alpha = render(room.scene, camera, room.colors)[1]
        assert alpha.median() > 0.98 and alpha.min() > 0.7
    floor = (room.labels == room.names.index("slate")) & (room.scene.opacities > 0.9) & (room.scene.means[:, 2] < 0.1)
    assert room.scene.means[floor, 2].abs().median() < 1e-4
    _, x, y, _ = room.scene.quats[floor].unbind(1)
    upright = (1 - 2 * (x * x + y * y)).abs()  # of the third axis
    assert upright.quantile(0.05) > 0.99
    assert (room.scene.scales[floor, 2] < 0.2 * room.scene.scales[floor, 0]).float().mean() > 0.9


def test_every_thing_has_texture_and_is_seen_in_a_color_of_its_own(room: DemoRoom, labels: list[torch.Tensor]):
    from matplotlib.colors import to_rgb  # noqa: PLC0415
    from skimage.color import rgb2lab  # noqa: PLC0415

    from normlift_ns.encoders.color import ColorEncoder, shading_coordinates  # noqa: PLC0415

    vectors = ColorEncoder().rows(room.names)
    assert (vectors @ vectors.T - np.eye(len(vectors))).max() < 0.72  # the encoder tells them apart
    own = shading_coordinates(rgb2lab(np.array([to_rgb(f"xkcd:{name}") for name in room.names])))
    cameras, lightness = demo_cameras(6, 160, 120), rgb2lab(room.colors.numpy())[:, 0]
    pixels = np.concatenate([view_image(room, camera).reshape(-1, 3) for camera in cameras])
    seen = shading_coordinates(rgb2lab(pixels / 255))
    truth = torch.cat([view.flatten() for view in labels]).numpy()
    nearest = np.linalg.norm(seen[:, None] - own, axis=2).argmin(axis=1)
    for index, name in enumerate(room.names):
        shown = truth == index + 1
        distance = np.linalg.norm(own - np.median(seen[shown], axis=0), axis=1)
        assert distance.argmin() == index, name
        assert distance[index] < 20, name
        assert (nearest[shown] == index).mean() > 0.7, name
        assert (shown.reshape(len(cameras), -1).sum(axis=1) > 40).sum() >= 3, name
        shades = lightness[(room.labels == index).numpy()]
        assert np.quantile(shades, 0.9) - np.quantile(shades, 0.1) > 5, name


def test_held_out_views_see_all_classes_from_elsewhere(room: DemoRoom):
    held_out = held_out_cameras(4, 160, 120)
    seen = torch.cat([view_labels(room, camera).unique() for camera in held_out]).unique()
    assert set(range(1, 14)) <= set(seen.tolist())
    here, there = (torch.stack([c.world_to_camera.inverse()[:3, 3] for c in x]) for x in (held_out, demo_cameras()))
    assert torch.cdist(here, there).min() > 0.15
    first = [1.25 * math.cos(math.radians(36)), 1.25 * math.sin(math.radians(36)), 1.5]
    assert here[0].tolist() == pytest.approx(first, rel=1e-6)
    sizes = [(len(cameras), cameras[0].width, cameras[0].height) for cameras in (demo_cameras(), held_out_cameras())]
    assert sizes == [(24, 400, 300), (4, 400, 300)]
    empty = DemoRoom(room.scene, room.colors, torch.full_like(room.labels, -1), room.names)
    assert not view_labels(empty, held_out[0]).any()


LOW, HIGH = np.full(3, -1.0), np.full(3, 1.0)


def sampled(shape: shapes.Distance, density: float) -> shapes.Array:
    near = shapes.sample_near_surface(shape, LOW, HIGH, density, np.random.default_rng(0))
    return shapes.project_to_surface(shape, near, LOW, HIGH)


def test_surface_points_are_even_and_on_the_surface_and_normals_point_outward():
    solids = {
        "sphere": (shapes.sphere(0.5), math.pi),
        "box": (shapes.box(1.0, 0.8, 0.6), 2 * (0.8 + 0.6 + 0.48)),
        "round": (shapes.box(1.0, 0.8, 0.6, 0.1), 2 * (0.48 + 0.32 + 0.24) + math.pi * (0.2 * 1.8 + 0.04)),
        "cylinder": (shapes.cone(0.3, 0.3, 1.0), math.pi * (0.6 + 2 * 0.09)),
        "frustum": (shapes.cone(0.4, 0.1, 0.4), math.pi * (0.5 * 0.5 + 0.16 + 0.01)),
        "torus": (shapes.torus(0.5, 0.1), 4 * math.pi**2 * 0.05),
        "capsule": (shapes.capsule((0, 0, 0), (0.5, 0, 0), 0.2), math.pi * 0.4 * 0.9),
        "moved": (shapes.place(shapes.box(1.0, 0.8, 0.6), 0.1, -0.2, 0.05, 30), 2 * (0.8 + 0.6 + 0.48)),
        "apart": (shapes.union(shapes.sphere(0.25), shapes.place(shapes.sphere(0.25), 0.6, 0, 0)), math.pi / 2),
    }
    for name, (shape, area) in solids.items():
        points = sampled(shape, 5000)
        assert np.abs(shape(points)).max() < shapes.ON_SURFACE, name
        assert len(points) == pytest.approx(5000 * area, rel=0.05), name
        points = sampled(shape, 500)
        normals = shapes.normals(shape, points)
        assert np.linalg.norm(normals, axis=1) == pytest.approx(1), name
        outward, inward = shape(points + 0.01 * normals), shape(points - 0.01 * normals)
        assert (outward > 0.009).mean() > 0.99, name
        assert (inward < -0.009).mean() > 0.85, name  # not near sharp edges


def test_images_and_masks_are_the_views_and_labels_name_their_values(tmp_path: Path):
    from tests.plain_room import plain_room  # noqa: PLC0415

    small, folder = plain_room(2000), tmp_path / "room"
    write_capture(small, folder, views=2, held_out=2, width=60, height=44)
    cameras = [*demo_cameras(2, 60, 44), *held_out_cameras(2, 60, 44)]
    for kind, mode, view in (("images", "RGB", view_image), ("instance", "L", view_labels)):
        assert sorted(path.name for path in (folder / kind).iterdir()) == [f"{i:04d}.png" for i in range(4)]
        for i, camera in enumerate(cameras):
            with Image.open(folder / kind / f"{i:04d}.png") as image:
                assert (image.size, image.mode) == ((60, 44), mode)
                assert np.array_equal(np.asarray(image), view(small, camera).numpy())
    names = {str(i): name for i, name in enumerate(small.names, 1)}
    assert json.loads((folder / "labels.json").read_text()) == {"labels": names, "background": 0}
