import numpy as np
import pytest
import torch
from matplotlib.colors import XKCD_COLORS, to_rgb
from skimage.color import rgb2lab

from benchmarks.plain_room import plain_room
from normlift_ns import lift, nearest_neighbors, rasterize_evidence, refine, render
from normlift_ns.demo import DemoRoom, demo_cameras, demo_room, held_out_cameras, view_image, view_labels
from normlift_ns.encoders.texts.colours import ColourTexts, shading_coordinates


def own_colors(room: DemoRoom) -> np.ndarray:
    """Of the classes, as the colour encoder compares them."""
    return shading_coordinates(rgb2lab(np.array([to_rgb(f"xkcd:{name}") for name in room.names])))


def test_same_arguments_same_room():
    one, two, other = plain_room(2000), plain_room(2000, seed=0), plain_room(2000, seed=4)  # built as the demo's is
    for name in ("means", "quats", "scales", "opacities"):
        assert torch.equal(getattr(one.scene, name), getattr(two.scene, name))
    assert torch.equal(one.colors, two.colors)
    assert torch.equal(one.labels, two.labels)
    assert not torch.equal(one.scene.means, other.scene.means)


def test_contents(room: DemoRoom):
    assert len(room.scene) == 20_000
    assert tuple(room.colors.shape) == (20_000, 3)
    assert bool(room.scene.drawable.all())
    counts = torch.bincount(room.labels + 1)
    assert len(counts) == len(room.names) + 1 == 14
    assert counts[0] == 400  # floaters
    assert counts[1:].min() > 200
    assert room.colors.min() >= 0 and room.colors.max() <= 1
    never_drawn = (room.scene.opacities < 1 / 255).float().mean().item()
    assert 0.02 < never_drawn < 0.06


def test_flat_gaussians_lie_along_the_surface(room: DemoRoom):
    floor = (room.labels == room.names.index("slate")) & (room.scene.opacities > 0.9) & (room.scene.means[:, 2] < 0.1)
    assert room.scene.means[floor, 2].abs().median() < 1e-4
    _, x, y, _ = room.scene.quats[floor].unbind(1)
    upright = (1 - 2 * (x * x + y * y)).abs()  # of the third axis
    assert upright.quantile(0.05) > 0.99
    assert (room.scene.scales[floor, 2] < 0.2 * room.scene.scales[floor, 0]).float().mean() > 0.9


def test_names_are_distinct_colours_of_the_survey(room: DemoRoom):
    assert all(f"xkcd:{name}" in XKCD_COLORS for name in room.names)
    lab = own_colors(room)
    distance = np.linalg.norm(lab[:, None] - lab, axis=2) + np.diag(np.full(len(lab), np.inf))
    assert distance.min() > 25


def test_surfaces_are_opaque(room: DemoRoom):
    for camera in demo_cameras(4, 160, 120):
        _, alpha = render(room.scene, camera, room.colors)
        assert alpha.median() > 0.98
        assert alpha.min() > 0.7


def test_every_thing_is_seen_in_its_own_colour(room: DemoRoom):
    cameras = demo_cameras(8, 240, 180)
    pixels = np.concatenate([view_image(room, camera).reshape(-1, 3) for camera in cameras]) / 255
    truth = np.concatenate([view_labels(room, camera).flatten() for camera in cameras])
    seen, own = shading_coordinates(rgb2lab(pixels)), own_colors(room)
    nearest = np.linalg.norm(seen[:, None] - own, axis=2).argmin(axis=1)
    for index, name in enumerate(room.names):
        shown = truth == index + 1
        distance = np.linalg.norm(own - np.median(seen[shown], axis=0), axis=1)
        assert distance.argmin() == index, name
        assert distance[index] < 20, name
        assert (nearest[shown] == index).mean() > 0.7, name
        per_view = shown.reshape(len(cameras), -1).sum(axis=1)
        assert (per_view > 100).sum() >= 3, name


def test_things_have_texture_and_shadow(room: DemoRoom):
    lightness = rgb2lab(room.colors.numpy())[:, 0]
    for index, name in enumerate(room.names):
        mine = lightness[(room.labels == index).numpy()]
        assert np.quantile(mine, 0.9) - np.quantile(mine, 0.1) > 5, name


def test_the_colour_encoder_tells_the_names_apart(room: DemoRoom):
    vectors = ColourTexts().rows(room.names)
    assert (vectors @ vectors.T - np.eye(len(vectors))).max() < 0.72


def test_held_out_views_see_all_classes_from_elsewhere(room: DemoRoom):
    held_out = held_out_cameras(4, 160, 120)
    seen = torch.cat([view_labels(room, camera).unique() for camera in held_out]).unique()
    assert set(range(1, 14)) <= set(seen.tolist())
    here, there = (torch.stack([c.world_to_camera.inverse()[:3, 3] for c in x]) for x in (held_out, demo_cameras()))
    assert torch.cdist(here, there).min() > 0.15


def test_labels_are_zero_where_nothing_is(room: DemoRoom):
    empty = DemoRoom(room.scene, room.colors, torch.full_like(room.labels, -1), room.names)
    assert not view_labels(empty, demo_cameras(1, 64, 48)[0]).any()


def test_lift_finds_the_classes_and_refinement_repairs(room: DemoRoom):
    cameras, generator = demo_cameras(9, 240, 180), torch.Generator().manual_seed(0)
    labels = [view_labels(room, camera).long() - 1 for camera in cameras]
    classes = torch.nn.functional.normalize(torch.randn(len(room.names), 32, generator=generator), dim=1)
    noise = torch.randn(len(cameras), *classes.shape, generator=generator) / 32**0.5
    features = torch.nn.functional.normalize(classes + 0.5 * noise, dim=2).flatten(0, 1)
    evidence = rasterize_evidence(room.scene, cameras, labels, num_regions=[len(classes)] * len(cameras))
    lifted = lift(evidence, features)
    directions = lifted.directions()
    neighbors = nearest_neighbors(room.scene.means, 36)
    own, reliability = lifted.scalars.own_evidence, lifted.scalars.reliability
    source = refine(room.scene.means, directions, reliability, own=own, neighbors=neighbors).long()
    before, after = mean_iou(room, directions @ classes.T), mean_iou(room, directions[source] @ classes.T)
    print(f"mIoU {before:.3f}, refined {after:.3f}")
    assert 0.8 < before < 0.9
    assert after > before + 0.005
    assert after > 0.84
    known = room.labels >= 0
    assert 0.02 < (lifted.scalars.norm[known] == 0).float().mean() < 0.08


def mean_iou(room: DemoRoom, scores: torch.Tensor) -> float:
    known = room.labels >= 0
    predicted = torch.where(scores.any(dim=1), scores.argmax(dim=1), -1)[known]
    pairs = [(predicted == c, room.labels[known] == c) for c in range(len(room.names))]
    return float(np.mean([((p & t).sum() / (p | t).sum()).item() for p, t in pairs]))


def test_too_small_a_room_is_refused():
    with pytest.raises(ValueError, match=r"at least 2000.*got 1999"):
        demo_room(1999)
