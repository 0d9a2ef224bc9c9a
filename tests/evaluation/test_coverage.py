"""Where to look next: gains against a loop, regions and photographs of a wall of which the lift saw one side only."""

import json
from dataclasses import replace
from itertools import permutations
from typing import Any

import numpy as np
import pytest
import torch
from PIL import Image
from torch import Tensor

from normlift_ns import Camera, GaussianScene, SemanticField, lift, rasterize_evidence
from normlift_ns.core.gaussians import facing_pose
from normlift_ns.core.scene import camera_summary
from normlift_ns.core.sparse import SparseRows
from normlift_ns.errors import InputError
from normlift_ns.evaluation import coverage
from normlift_ns.rasterization.settings import RasterSettings
from tests.random_scenes import Photographs, generator, made_scene

NONE = Photographs([], [])


def looking(eye: tuple[float, float, float], target=(0.0, 0.0, 0.0), width=64, height=48) -> Camera:
    pose = facing_pose(*(torch.tensor(x).double() for x in (eye, target, (0.0, 0.0, 1.0))))
    K = torch.tensor([[width * 0.6, 0, width / 2], [0, width * 0.6, height / 2], [0, 0, 1]])
    return Camera(K, pose.float(), width, height)


SIDE = 24
"""Gaussians along an edge of the wall."""


def wall(**changes: Any) -> Any:
    """A thick wall across x = 0, whose two sides are different Gaussians; eight photographs, four of each side, and one
    held out of the far side."""
    line = torch.linspace(-1, 1, SIDE)
    y, z = (x.flatten() for x in torch.meshgrid(line, line, indexing="ij"))
    near, far = (torch.stack([torch.full_like(y, x), y, z], 1) for x in (-0.15, 0.15))
    n = 2 * SIDE * SIDE
    scales = torch.tensor([0.002, 0.055, 0.055]).expand(n, 3).contiguous()
    quats = torch.tensor([[1.0, 0, 0, 0]]).expand(n, 4).contiguous()
    scene = GaussianScene(torch.cat([near, far]), quats, scales, torch.full((n,), 0.99))
    cameras = [looking((x, y, 0.2)) for x in (-3.0, 3.0) for y in (-0.9, -0.3, 0.3, 0.9)]
    facts = {
        "train": Photographs([f"{i}.png" for i in range(8)], cameras),
        "held_out": Photographs(["h.png"], [looking((3.0, 0.0, 0.4))]),
        "colors": lambda camera: torch.full((n, 3), 0.5),
        "renderer": None,
        "background": torch.zeros(3),
    }
    return made_scene(scene, **{**facts, **changes})


def lifted(scene: Any, used: list[int], *, blank: tuple[int, ...] = ()) -> SemanticField:
    """The scene lifted from some photographs, with one region each; those in `blank` have no features."""
    cameras = [scene.train.cameras[i] for i in used]
    labels = [torch.zeros(camera.height, camera.width, dtype=torch.int32) for camera in cameras]
    evidence = rasterize_evidence(scene.gaussians, cameras, labels)
    found = lift(evidence, torch.tensor([[0.8, 0.6]]).expand(len(used), 2).contiguous())
    facts = {
        "views_lifted": [scene.train.names[i] for i in used],
        "views_without_features": [scene.train.names[i] for i in blank],
        "cameras": camera_summary(scene.train.cameras),
        "options": {"reliability_beta": 1.0, "weight_power": 1, "vote": {"k": 6}},
    }
    return SemanticField.build(found, scene.gaussians.means, provenance=facts)


@pytest.fixture(scope="module")
def one_side() -> coverage.Coverage:
    scene = wall()
    return coverage.coverage_of(scene, lifted(scene, [0, 1, 2, 3], blank=(5,)))


def test_the_far_side_is_the_region_and_its_photographs_are_chosen(one_side):
    found = one_side
    region, *others = found.regions
    assert others == []
    assert region.size > 0.95 * SIDE * SIDE
    assert region.centre == pytest.approx([0.15, 0, 0], abs=0.1)
    assert region.box["min"][0] == region.box["max"][0] == pytest.approx(0.15)
    assert 0.4 < region.share < 0.6
    assert region.reliability < 0.2
    assert region.lifted_reliability > 0.7  # four views see it through cracks
    assert region.views < 0.5
    assert found.left_out == {"max_views": 3, "no features": 1, "held out": 1}
    why = {photograph.name: photograph.why for photograph in found.photographs}
    others = dict.fromkeys(("4.png", "6.png", "7.png"), "max_views")
    assert why == {**others, "5.png": "no features", "h.png": "held out"}
    assert all(photograph.regions == [1] for photograph in found.photographs)
    first, second, *_ = (photograph.gain for photograph in found.photographs)
    # R of the far side, half of the surface, goes to 1 / 2, and with two views to 2 / 3
    assert first == pytest.approx(region.share * (1 / 2 - region.reliability), rel=0.2)
    assert second == pytest.approx(region.share / 6, rel=0.3)
    assert found.remarks == []


def test_some_of_many_photographs_are_looked_at_whatever_the_scale_of_weights(one_side, monkeypatch):
    """Weights of the lift count pixels of another size than those that the study looks at."""
    scene = wall()
    whole = lifted(scene, [0, 1, 2, 3], blank=(5,))
    larger = replace(whole, scalars=replace(whole.scalars, weight=16 * whole.scalars.weight))
    found = {photograph.name: photograph.gain for photograph in coverage.coverage_of(scene, larger).photographs}
    assert found == pytest.approx({photograph.name: photograph.gain for photograph in one_side.photographs})
    monkeypatch.setattr(coverage, "MAX_IMAGES", 2)
    some = coverage.coverage_of(scene, whole)
    assert {photograph.name for photograph in some.photographs} == {"4.png", "h.png"}
    assert any("5" in remark and "2" in remark for remark in some.remarks)


def random_case(seed: int, n: int = 7, views: int = 5) -> tuple[coverage.ReliabilityModel, SparseRows, Tensor]:
    g = generator(seed)
    dense = torch.rand(n, views, generator=g, dtype=torch.float64) * (torch.rand(n, views, generator=g) < 0.6)
    before = torch.rand(n, 3, generator=g, dtype=torch.float64) * (torch.rand(n, 3, generator=g) < 0.5)
    surface = torch.cat([dense, before], 1).amax(1)
    norm = torch.rand(n, generator=g, dtype=torch.float64)
    row, column = dense.nonzero(as_tuple=True)
    sparse = SparseRows.from_coo(row, column, dense[row, column], n)
    known = coverage.ReliabilityModel(norm, before.sum(1), (before**2).sum(1), surface, 0.7)
    return known, sparse, torch.cat([before, dense], 1)


def looped(known: coverage.ReliabilityModel, columns: Tensor, view: int, chosen: list[int]) -> float:
    total = 0.0
    for j in range(len(known.norm)):
        reliabilities = []
        for views in (chosen, [*chosen, view]):
            w = [float(known.weight[j])] + [float(columns[j, 3 + v]) for v in views]
            squares = float(known.squared[j]) + sum(x**2 for x in w[1:])
            noise = (coverage.FAINT * float(known.surface[j])) ** 2
            n = sum(w) ** 2 / (squares + noise) if squares + noise > 0 else 0.0
            reliabilities.append(float(known.norm[j]) * n / (n + known.beta))
        total += float(known.surface[j]) * max(0.0, reliabilities[1] - reliabilities[0])
    return total / float(known.surface.sum())


def test_gains_are_those_of_a_loop(monkeypatch):
    """Greedy choices under diminishing returns reach at least 1 - 1 / e of the best pair."""
    monkeypatch.setattr(coverage, "_CHUNK", 9)
    for seed in range(5):
        known, views, columns = random_case(seed)
        expected = [looped(known, columns, v, []) for v in range(5)]
        assert coverage.gains(known, views, 5).tolist() == pytest.approx(expected, rel=1e-12)
        chosen = coverage.choose_views(known, views, 5, 3)
        assert all(gain > 0 for _, gain in coverage.choose_views(known, views, 7, 7))  # the last two have no weight
        before: list[int] = []
        for view, found in chosen:
            rest = {v: looped(known, columns, v, before) for v in range(5) if v not in before}
            assert found == pytest.approx(max(rest.values()), rel=1e-12)
            assert view == max(rest, key=rest.__getitem__)
            before.append(view)
        best = max(looped(known, columns, a, []) + looped(known, columns, b, [a]) for a, b in permutations(range(5), 2))
        assert sum(x for _, x in chosen[:2]) >= 0.63 * best


def test_everything_reliable_and_one_camera_are_said():
    scene = wall(held_out=NONE)
    found = coverage.coverage_of(scene, lifted(scene, list(range(8))))
    assert (found.regions, found.photographs, found.left_out, len(found.remarks)) == ([], [], {}, 2)
    scene = wall(train=Photographs(["0.png"], [looking((-3.0, -0.9, 0.2))]), held_out=NONE)
    found = coverage.coverage_of(scene, lifted(scene, [0]), min_reliability=0.6)
    n_eff = 1 / (1 + coverage.FAINT**2)
    assert found.regions[0].reliability == pytest.approx(n_eff / (n_eff + 1))
    assert found.regions[0].lifted_reliability == pytest.approx(0.5)  # one view that agrees with itself
    assert any("single camera" in remark for remark in found.remarks)


def test_records_of_what_was_lifted():
    scene = wall()
    old = {"statistics": {"views": 3, "left_out": 0}, "options": {"max_views": 3}}
    assert coverage.lifted_names(scene, old) == ({"0.png", "4.png", "7.png"}, set())
    for facts in ({}, {"statistics": {"views": 6, "left_out": 2}}, {"statistics": {"views": 4, "left_out": 0}}):
        with pytest.raises(InputError, match="does not record"):
            coverage.lifted_names(scene, facts)
    with pytest.raises(InputError, match="no longer has"):
        coverage.lifted_names(scene, {"views_lifted": ["gone.png"]})
    for facts in (
        {"views_lifted": [3]},
        {"views_lifted": ["0.png"], "views_without_features": None},
        {"statistics": {"views": 8.5, "left_out": 0}},
        {"statistics": {"views": 8, "left_out": 0}, "options": {"max_views": 0}},
    ):
        with pytest.raises(InputError, match="damaged"):
            coverage.lifted_names(scene, facts)


def test_cameras_that_see_nothing_and_wrong_bounds_are_refused(unchecked):
    scene = wall()
    found = lifted(scene, [0, 1])
    for wrong in (-0.1, 1.1, float("nan"), True):
        with pytest.raises(InputError, match="min_reliability"):
            coverage.coverage_of(scene, found, min_reliability=wrong)
    away = [looking((-3.0, 0.0, 0.0), (-9.0, 0.0, 0.0)) for _ in range(8)]
    blind = wall(train=Photographs(scene.train.names, away), held_out=NONE)
    with pytest.raises(InputError, match="no image shows a Gaussian"):
        coverage.coverage_of(blind, found)


def test_new_poses_see_the_region_and_stand_where_a_camera_could_be():
    """With the far side in no photograph but one from aslant, poses see all of it."""
    aslant = looking((1.2, 2.6, 0.2))
    scene = wall(held_out=Photographs(["h.png"], [aslant]))
    scene.train.cameras[4:] = [looking((0.9, 2.8 + 0.1 * i, 0.2)) for i in range(4)]
    found = coverage.coverage_of(scene, lifted(scene, [0, 1, 2, 3]))
    assert 1 <= len(found.poses) <= 5
    pose = found.poses[0]
    drawn = coverage.RasterInputs(scene.gaussians, "classic", RasterSettings(), 1)
    seen = coverage.view_weights(drawn, [pose.camera, aslant]).select_rows(torch.arange(SIDE * SIDE, 2 * SIDE * SIDE))
    whole, slanted = (float(seen.weight[seen.column == view].sum()) for view in (0, 1))
    assert whole > max(0.05, 0.5 * slanted)  # shares of the picture
    eye = pose.camera.camera_to_world()[:3, 3]
    assert float(eye[0]) > 0.3  # not in the wall, nor behind it
    assert pose.regions[0] == 1 and pose.shown >= 0.3
    assert found.poses[0].gain >= found.poses[-1].gain > 0
    assert found.pictures[0].image.shape[:2] == found.pictures[0].reliability.shape
    height, width = found.pictures[0].reliability.shape
    assert float(found.pictures[0].reliability[height // 2, width // 2]) < 0.2  # it looks where R is low


def test_free_places_and_weights_that_are_shares_of_the_picture():
    scene = wall()
    drawn = coverage.RasterInputs(scene.gaussians, "classic", RasterSettings(), 1)
    small, large = (coverage.view_weights(drawn, scene.train.cameras, pixels=pixels) for pixels in (1728, 10**9))
    share = float(large.row_sums().sum())
    assert small.row_sums().sum() == pytest.approx(share, rel=0.1)  # the blur of a pixel is wider in the small one
    assert 0.1 < share / 8 < 1
    space = coverage.free_space(drawn, scene.train.cameras[:4])
    assert space.up.tolist() == pytest.approx([0, 0, 1], abs=0.1)
    assert space.depth == pytest.approx(2.85, abs=0.1)
    assert space.spacing == pytest.approx(0.6)
    places = {
        (-1.0, 0.0, 0.0): True,  # before the wall
        (0.0, 0.0, 0.0): False,  # in it
        (1.0, 0.0, 0.0): False,  # behind it
        (-3.2, 0.3, 0.2): True,  # beside a camera
        (-6.0, 0.0, 0.0): False,  # behind the cameras
    }
    assert space.is_free(torch.tensor(list(places), dtype=torch.float64)).tolist() == list(places.values())


def test_poses_and_pictures_are_written_and_nerfstudio_reads_the_path(nerfstudio, one_side, tmp_path, monkeypatch):
    from nerfstudio.cameras import camera_paths  # noqa: PLC0415

    monkeypatch.chdir(tmp_path)
    found = replace(one_side, poses=one_side.poses[:2], pictures=one_side.pictures[:2])
    written = found.save(tmp_path / "next.json")
    cameras = [pose.camera for pose in found.poses]
    assert [path.name for path in written][:2] == ["next.json", "next_camera_path.json"]
    assert {path.name for path in tmp_path.iterdir()} == {path.name for path in written}
    assert len(written) == len(cameras) + 2
    path = json.loads(written[1].read_text())
    assert (path["camera_type"], path["fps"], path["seconds"]) == ("perspective", 1, len(cameras))
    assert [entry["aspect"] for entry in path["camera_path"]] == [pytest.approx(c.width / c.height) for c in cameras]
    read = camera_paths.get_path_from_json(path)
    for i, camera in enumerate(cameras):
        flipped = camera.world_to_camera.inverse() * torch.tensor([1.0, -1, -1, 1])
        torch.testing.assert_close(read.camera_to_worlds[i], flipped[:3], rtol=0, atol=1e-5)
        torch.testing.assert_close(read.get_intrinsics_matrices()[i], camera.K, rtol=1e-5, atol=1e-4)
        assert (int(read.width[i]), int(read.height[i])) == (camera.width, camera.height)
    document = json.loads(written[0].read_text())
    assert document["regions"][0]["size"] == found.regions[0].size
    assert "pictures" not in document and len(document["poses"]) == len(cameras)
    with pytest.raises(FileExistsError):
        found.save(tmp_path / "next.json")
    for name in ("", ".", ".."):
        with pytest.raises(InputError, match="name"):
            found.save(name)
    fewer = replace(found, poses=found.poses[:1], pictures=found.pictures[:1])
    fewer.save(tmp_path / "next.json", overwrite=True)
    assert {path.name for path in tmp_path.iterdir()} == {"next.json", "next_camera_path.json", "next_pose_1.png"}


def test_the_reliability_is_drawn_over_the_gray_image(tmp_path):
    image = torch.zeros(20, 30, 3, dtype=torch.uint8)
    image[:, 20:] = 160
    render = coverage.PoseRender(image, torch.full((20, 30), torch.nan))
    coverage.save_pose_render(tmp_path / "a.png", "title", render)
    drawn = np.asarray(Image.open(tmp_path / "a.png").convert("L"))
    row = drawn[drawn.shape[0] // 2, drawn.shape[1] // 2 : -drawn.shape[1] // 8]  # without the color bar
    assert (row == 0).sum() / (row == 160).sum() == pytest.approx(2, abs=0.5)  # frames are black too


def test_a_camera_that_looks_straight_down():
    up = torch.tensor([0.0, 0, 1]).double()
    down = coverage.look_at(2 * up, torch.zeros(3).double(), up, looking((1.0, 0, 0)))
    there = down.world_to_camera @ torch.tensor([0.0, 0, 0, 1])
    assert there.tolist() == pytest.approx([0, 0, 2, 1], abs=1e-6)


@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs CUDA")
def test_a_gpu_says_the_same(one_side):
    scene = wall()
    found = coverage.coverage_of(scene, lifted(scene, [0, 1, 2, 3], blank=(5,)), device="cuda")
    assert [photograph.name for photograph in found.photographs] == [x.name for x in one_side.photographs]
    gained = [photograph.gain for photograph in one_side.photographs]
    assert [photograph.gain for photograph in found.photographs] == pytest.approx(gained, rel=1e-3)
    assert found.regions[0].size == pytest.approx(one_side.regions[0].size, abs=2)
    for mine, other in zip(found.poses, one_side.poses):
        torch.testing.assert_close(mine.camera.world_to_camera, other.camera.world_to_camera, rtol=0, atol=1e-2)
