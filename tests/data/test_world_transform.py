import json
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from normlift_ns.data.frames import Frame, Intrinsics, transform_frames
from normlift_ns.data.transforms import gsplat_normalization, read_world_transform
from normlift_ns.errors import InputError

ROTATION = Rotation.from_euler("xyz", [0.3, -1.0, 2.0]).as_matrix()
MATRIX = np.block([[2.5 * ROTATION, np.array([[1.0], [2.0], [3.0]])], [np.array([[0.0, 0, 0, 1]])]])


def test_a_matrix_is_read_in_its_parts_and_dataparser_transforms_from_the_capture(tmp_path: Path) -> None:
    (tmp_path / "world.json").write_text(json.dumps(MATRIX.tolist()))
    np.save(tmp_path / "world.npy", MATRIX)
    np.savetxt(tmp_path / "world.txt", MATRIX)
    np.savetxt(tmp_path / "commas.txt", MATRIX, delimiter=",")
    for path in tmp_path.iterdir():
        world = read_world_transform(path)
        assert world.scale == pytest.approx(2.5)
        assert np.allclose(world.scale * world.transform, MATRIX[:3]), path
        assert not world.float32
    # Of nerfstudio: p = scale (T A^-1) p_file, with A the turn that ns-process-data applied
    applied = np.eye(4)
    applied[:3, :3] = [[1, 0, 0], [0, 0, 1], [0, -1, 0]]
    transform = np.column_stack([ROTATION, [1.0, 2.0, 3.0]])
    (tmp_path / "a.json").write_text(json.dumps({"transform": transform.tolist(), "scale": 0.5}))
    world = read_world_transform(tmp_path / "a.json", applied, 2.0)
    assert world.float32
    assert world.scale == 0.25
    point = np.array([3.0, -1.0, 2.0])
    assert np.allclose(world.transform @ np.append(applied[:3, :3] @ point, 1), transform @ np.append(point, 1))


def test_what_is_not_a_similarity_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "world.json"
    for content, message in (
        (np.diag([1.0, 1, -1, 1]).tolist(), "similarity"),
        (np.diag([1.0, 1, 2, 1]).tolist(), "similarity"),
        (np.zeros((4, 4)).tolist(), "similarity"),
        ([[1, 2], [3, 4]], r"shape \(2, 2\)"),
        ("eye", "does not contain a transform"),
        ({"transform": [[1, 0, 0, 0]] * 3}, "`scale`"),
        ({"transform": [[1, 0, 0, 0]] * 3, "scale": 1}, "similarity"),
        ({"transform": np.eye(4)[:3].tolist(), "scale": -1}, "its scale is -1"),
        ({"transform": np.eye(4)[:3].tolist(), "scale": "big"}, "does not contain a transform"),
    ):
        path.write_text(json.dumps(content))
        with pytest.raises(InputError, match=message) as caught:
            read_world_transform(path)
        assert str(path) in str(caught.value)


_CAMERA = Intrinsics(1, 1, 1, 1, 2, 2)


def _ring(tilt: Rotation, size: float) -> tuple[list[Frame], np.ndarray]:
    """Cameras on a level ring that look at its middle, over a flat floor with more points below; then all turned."""
    poses = []
    for angle in np.linspace(0, 2 * np.pi, 12, endpoint=False):
        back, right = [np.cos(angle), np.sin(angle), 0], [-np.sin(angle), np.cos(angle), 0]
        poses.append(
            np.column_stack([tilt.apply(right), tilt.apply([0, 0, 1]), tilt.apply(back), size * tilt.apply(back)])
        )
    rng = np.random.default_rng(0)
    points = rng.normal(size=(4000, 3)) * [2.0, 1.0, 0.1]
    points[:, 2] += np.where(rng.random(4000) < 0.3, np.abs(rng.normal(size=4000)), 0)
    return [Frame(Path("a"), "a", pose, _CAMERA) for pose in poses], size * tilt.apply(points)


@pytest.mark.parametrize("seed", [0, 3])
def test_gsplats_normalization_undoes_any_similarity(seed: int) -> None:
    """However the world of the project is turned and scaled: cameras at distance 1 over a level floor."""
    tilt = Rotation.random(random_state=seed)
    frames, points = _ring(tilt, 0.1 + seed)
    world = gsplat_normalization(frames, points)
    there = world.scale * (points @ world.transform[:, :3].T + world.transform[:, 3])
    assert np.allclose(np.median(there, axis=0), 0, atol=0.05)  # medians do not turn with the axes
    spread = there.std(axis=0)
    assert spread[0] > spread[1] > spread[2]
    assert np.mean(there[:, 2]) >= np.median(there[:, 2])  # the tail points up
    poses = np.array([frame.pose for frame in transform_frames(frames, world)])
    assert np.allclose(np.linalg.norm(poses[:, :, 3] - poses[:, :, 3].mean(axis=0), axis=1), 1, atol=0.01)


def test_a_world_that_gsplat_mirrors_is_refused() -> None:
    frames = [Frame(Path("a"), "a", np.column_stack([np.eye(3), [x, 0.0, 0.0]]), _CAMERA) for x in (-1.0, 3.0)]
    with pytest.raises(ValueError, match=r"\+y"):
        gsplat_normalization(frames, np.eye(3))
