"""Splats in worlds that tools produce: which are found, and which are not."""

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import normlift_ns as nl
from normlift_ns.data import open_splat
from normlift_ns.data.extra_images import add_extra_images
from normlift_ns.data.frames import transform_frames
from normlift_ns.data.splat import SplatParameters
from normlift_ns.data.transforms import read_transforms, read_world_transform, write_transforms
from normlift_ns.data.world_search import _is_best_nearby, find_world
from normlift_ns.data.worlds import with_opengl_axes
from tests.captures import SHARED, capture, needs_shared
from tests.data.scene_files import frames_of, in_world, ply_columns, write_ply

QUARTER = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])
"""The rotation of ns-process-data, from z up to y up or from COLMAP's y down to z up."""
TURNS = {
    "after half a turn about x": np.diag([1.0, -1, -1]),
    "after half a turn about y": np.diag([-1.0, 1, -1]),
    "after half a turn about z": np.diag([-1.0, -1, 1]),
    "from y up to z up": QUARTER.T,
    "from z up to y up": QUARTER,
    "after an exchange of x and y": np.array([[0.0, 1, 0], [1, 0, 0], [0, 0, -1]]),
    ", scaled by 2.5": 2.5 * np.eye(3),
    "from y up to z up, scaled by 100": 100 * QUARTER.T,
}


def square(linear: np.ndarray) -> np.ndarray:
    matrix = np.eye(4)
    matrix[:3, :3] = linear
    return matrix


def opened(folder: Path, splat: SplatParameters, transforms: Path) -> tuple[nl.Scene, list[str]]:
    said: list[str] = []
    path = write_ply(folder / "s.ply", ply_columns(splat))
    scene = nl.open_splat(path, nl.SplatOptions(transforms=transforms), say=said.append)
    return scene, [text for text in said if "fits its images" in text]


@pytest.fixture(scope="module")
def native(trained: Path):
    return nl.open_scene(trained)


@pytest.fixture(scope="module")
def splat(native) -> SplatParameters:
    return SplatParameters(**native.parameters)


@pytest.fixture
def transforms(native, tmp_path: Path) -> Path:
    write_transforms(tmp_path / "transforms.json", frames_of(native), [])
    return tmp_path / "transforms.json"


def test_nothing_is_tried_if_the_first_world_fits(native, splat, transforms, tmp_path, monkeypatch) -> None:
    tried = []

    def counted(candidates, scene_in: Callable, **how):
        return find_world(candidates, lambda world: tried.append(world) or scene_in(world), **how)

    monkeypatch.setattr(open_splat, "find_world", counted)
    scene, said = opened(tmp_path, splat, transforms)
    assert len(tried) == 1 and said == []
    assert scene.alignment.is_usual  # and the check before the lift takes this one
    assert scene.identity["source_world"]["name"] == "the world of its cameras"


@pytest.mark.parametrize(
    "name", [name if i in (1, 6) else pytest.param(name, marks=pytest.mark.slow) for i, name in enumerate(TURNS)]
)
def test_a_turned_or_scaled_splat_is_found(splat, transforms, tmp_path: Path, name: str) -> None:
    matrix = square(TURNS[name])
    scene, said = opened(tmp_path, in_world(splat, matrix), transforms)
    world = scene.identity["source_world"]
    assert name in world["name"] and len(said) == 1 and world["name"] in said[0]
    found = np.vstack([world["scale"] * np.array(world["transform"]), [0, 0, 0, 1]])
    np.testing.assert_allclose(found, matrix, rtol=1e-3, atol=1e-3 * np.cbrt(np.linalg.det(matrix)))


def test_the_world_of_ns_train_is_found_exactly(native, splat, tmp_path: Path) -> None:
    scene, said = opened(tmp_path, splat, native.location.folder)
    assert "ns-train's normalized world" in said[0]
    ours, theirs = scene.train.cameras[3], native.train.cameras[3]
    np.testing.assert_allclose(ours.world_to_camera, theirs.world_to_camera, atol=2e-6)


def test_cameras_with_the_axes_of_opencv_are_found_lifted_and_extended(native, splat, tmp_path: Path) -> None:
    frames = with_opengl_axes(frames_of(native))
    write_transforms(tmp_path / "transforms.json", frames[:-1], [])
    write_transforms(tmp_path / "more.json", frames, [])
    scene, said = opened(tmp_path, splat, tmp_path / "transforms.json")
    assert "with OpenCV cameras" in said[0]
    options = {"source": nl.SourceOptions(encoder="color", regions="grid"), "lift": nl.LiftOptions(max_views=3)}
    run = nl.lift_run(scene, output_dir=tmp_path / "out", timestamp="t", **options)
    assert run.field.manifest["source_world"]["opencv_cameras"] is True
    again = nl.open_run(run.config)
    known = {Path(name).name: camera for name, camera in zip(native.train.names, native.train.cameras)}
    for name, camera in zip(again.scene.train.names, again.scene.train.cameras):
        if Path(name).name in known:
            np.testing.assert_allclose(camera.world_to_camera, known[Path(name).name].world_to_camera, atol=1e-6)
    for opened_scene in (scene, again.scene):
        more = add_extra_images(opened_scene, tmp_path / "more.json").train
        assert len(more) == len(frames)
        expected = native.held_out.cameras[-1].world_to_camera
        np.testing.assert_allclose(more.cameras[-1].world_to_camera, expected, atol=1e-5)


@pytest.mark.parametrize("inverse", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_applied_transform_is_found_either_way(native, splat, transforms, tmp_path: Path, inverse: bool) -> None:
    turn = Rotation.from_euler("xyz", [20, 40, -70], degrees=True).as_matrix()
    applied = np.column_stack([turn, [0.5, -0.2, 1.0]])
    content = json.loads(transforms.read_text()) | {"applied_transform": applied.tolist()}
    transforms.write_text(json.dumps(content))
    matrix = np.vstack([applied, [0, 0, 0, 1]])
    _, said = opened(tmp_path, in_world(splat, np.linalg.inv(matrix) if inverse else matrix), transforms)
    assert ("before applied_transform" if inverse else "after a second applied_transform") in said[0]


@pytest.mark.slow
@pytest.mark.parametrize("seed", [0, *(pytest.param(seed, marks=pytest.mark.extra) for seed in range(1, 10))])
def test_other_rotations_are_not_taken(splat, transforms, tmp_path: Path, seed: int) -> None:
    matrix = square(Rotation.random(random_state=seed).as_matrix())
    scene, said = opened(tmp_path, in_world(splat, matrix), transforms)
    assert said == [] and scene.identity["source_world"]["name"] == "the world of its cameras"
    with pytest.raises(nl.InputError, match="does not match its images"):
        nl.lift_run(scene, output_dir=tmp_path / "out")


@pytest.mark.slow
@pytest.mark.parametrize("degrees", [-1, 0, 1])
def test_a_world_that_a_small_turn_improves_is_not_the_best(splat, transforms, tmp_path: Path, degrees: int) -> None:
    for axis in "xyz":
        turn = Rotation.from_euler(axis, degrees, degrees=True).as_matrix()
        path = write_ply(tmp_path / f"{axis}.ply", ply_columns(in_world(splat, square(turn))))
        scene = nl.open_splat(path, nl.SplatOptions(transforms=transforms, world_transform=None))
        assert _is_best_nearby(scene, "cpu") == (degrees == 0), axis


def test_a_given_world_or_none_is_not_searched(splat, transforms, tmp_path: Path) -> None:
    there = in_world(splat, square(TURNS["after half a turn about y"]))
    path = write_ply(tmp_path / "s.ply", ply_columns(there))
    np.savetxt(tmp_path / "world.txt", square(TURNS["after half a turn about y"]))
    for world, name in ((None, "the world of its cameras"), (tmp_path / "world.txt", "the given world")):
        options = nl.SplatOptions(transforms=transforms, world_transform=world)
        scene = nl.open_splat(path, options)
        assert scene.alignment is None and scene.identity["source_world"]["name"] == name


@pytest.mark.slow
def test_a_splat_opened_again_is_in_the_very_same_world(splat, transforms, tmp_path: Path) -> None:
    there = in_world(splat, square(1.37 * TURNS["after half a turn about y"]))
    first, second = (opened(tmp_path, there, transforms)[0].identity for _ in range(2))  # so the cache has its evidence
    assert first == second


@needs_shared
@pytest.mark.slow
@pytest.mark.parametrize(("name", "turn"), [("fox", "after half a turn about z"), ("tabletop", ", scaled by 2.5")])
def test_worlds_of_real_captures_are_found(name: str, turn: str, tmp_path: Path) -> None:
    scene = capture(name)
    cameras = read_transforms(SHARED / "captures" / name)
    file = scene.location.run_dir / "dataparser_transforms.json"
    world = read_world_transform(file, cameras.applied_transform, cameras.applied_scale)
    write_transforms(tmp_path / "transforms.json", transform_frames(cameras.frames, world), [])
    there = in_world(SplatParameters(**scene.parameters), square(TURNS[turn]))
    found, said = opened(tmp_path, there, tmp_path / "transforms.json")
    assert turn in said[0] and found.alignment.margin > 4
