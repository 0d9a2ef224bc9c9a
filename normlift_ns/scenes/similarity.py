"""Maps from the world of the cameras to the world of the splat."""

from __future__ import annotations

import tokenize
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
from jaxtyping import Float

from normlift_ns.errors import InputError
from normlift_ns.scenes.frames import Frame, World
from normlift_ns.scenes.transforms_file import read_json

_TOLERANCE = 1e-3
"""How far a similarity may be from one: files round."""
_FARTHEST, _MOST_BYTES = 1e30, 2**16
_WRITTEN = "the dataparser_transforms.json that ns-train wrote; copy it again from the run"
_EXPECTED = "4 x 4 numbers in JSON, .npy or .txt, or the dataparser_transforms.json of a nerfstudio run"


class DataparserTransforms(msgspec.Struct):
    """What nerfstudio's dataparser_transforms.json says: p -> scale * (transform @ p) leads to the scene's world."""

    transform: list[list[float]]
    scale: float


def read_dataparser_transforms(path: Path) -> World:
    """dataparser_transforms.json of a nerfstudio run.

    Raises:
        FileNotFoundError, ValueError: no such file, other content, or no finite transform and positive scale.
    """
    return _dataparser(read_json(path, _WRITTEN), path)


def _dataparser(values: Any, path: Path) -> World:
    try:
        found = msgspec.convert(values, DataparserTransforms)
    except (msgspec.ValidationError, RecursionError, OverflowError) as error:
        raise InputError(f"{path} holds no transform ({error}). Expected {_WRITTEN}.") from error
    rows = found.transform
    finite = len(rows) in (3, 4) and all(len(row) == 4 for row in rows) and (np.abs(rows) < _FARTHEST).all()
    if not finite or not 0 < found.scale < _FARTHEST:
        raise InputError(
            f"{path} holds no transform: {len(rows)} rows and scale {found.scale:g}. Expected 3 rows of 4 finite "
            f"numbers and a positive scale: {_WRITTEN}."
        )
    return World(np.array(rows[:3]), found.scale)


def capture_worlds(run_dir: Path, identity: Mapping[str, Any]) -> tuple[World, ...]:
    """The steps from the world of the capture to that of the Gaussians of a lifted run, one after the other.

    Args:
        identity: of the scene: that of a splat without a nerfstudio run says how its cameras were moved to it.
    Raises:
        FileNotFoundError, ValueError: as `read_dataparser_transforms`, also for `source_world` of the identity.
    """
    trained = read_dataparser_transforms(run_dir / "dataparser_transforms.json")
    moved = identity.get("source_world")
    return (trained,) if moved is None else (_dataparser(moved, run_dir / "splat.json"), trained)


def read_world_transform(
    path: Path, applied: Float[np.ndarray, "4 4"] | None = None, applied_scale: float = 1.0
) -> World:
    """The similarity that a file holds.

    Args:
        applied, applied_scale: for dataparser_transforms.json, which starts from the world of the capture: from there
            to the world of the cameras, as their own file says.
    Raises:
        FileNotFoundError, ValueError: no such file, other content, or no similarity.
    """
    try:
        values = _numbers(path)
        if not isinstance(values, dict):
            return similarity(np.array(values, dtype=float), str(path))
    except InputError:
        raise
    except (TypeError, ValueError, EOFError, OverflowError, MemoryError, OSError, tokenize.TokenError) as error:
        raise InputError(f"{path} holds no transform ({error}). Expected {_EXPECTED}.") from error
    found = _dataparser(values, path)
    matrix = np.eye(4)
    matrix[:3] = found.transform
    if applied is not None:
        matrix = matrix @ np.linalg.inv(applied)
    scale = found.scale / applied_scale
    similarity(matrix * scale + np.diag([0, 0, 0, 1 - scale]), str(path))
    return World(matrix[:3], scale, single=True)


def _numbers(path: Path) -> Any:
    if path.suffix not in (".npy", ".txt") or not path.is_file():
        return read_json(path, _EXPECTED)
    if path.stat().st_size > _MOST_BYTES:
        raise InputError(f"{path} has {path.stat().st_size:,} bytes, too many for 4 x 4 numbers. Expected {_EXPECTED}.")
    return (np.load(path, allow_pickle=False) if path.suffix == ".npy" else np.loadtxt(path)).tolist()


def similarity(matrix: Float[np.ndarray, "4 4"], source: str) -> World:
    """A matrix in its parts.

    Raises:
        ValueError: it is no rotation, scale and translation.
    """
    if matrix.shape != (4, 4) or not (np.abs(matrix) < _FARTHEST).all():
        raise InputError(f"{source} holds numbers of shape {matrix.shape} or not finite. Expected {_EXPECTED}.")
    linear = matrix[:3, :3]
    scale = float(np.cbrt(np.linalg.det(linear)))
    last = np.abs(matrix[3] - [0, 0, 0, 1]).max()
    if not (scale > 0 and last <= _TOLERANCE and np.abs(linear @ linear.T / scale**2 - np.eye(3)).max() <= _TOLERANCE):
        raise InputError(
            f"{source} holds no similarity: {matrix.tolist()}. Expected one rotation without mirror, one scale for all "
            "axes and a translation, with 0 0 0 1 in the last row."
        )
    return World(matrix[:3] / scale, scale)


def gsplat_normalization(frames: list[Frame], points: Float[np.ndarray, "n 3"]) -> list[World]:
    """How gsplat's simple_trainer turns, scales and flips the world of a COLMAP project, which it does not save.

    The steps of its datasets/normalize.py and datasets/colmap.py (1.5): cameras stand upright around the origin at a
    median distance of 1, the points' principal axes become the axes, and the half with more points goes to the bottom.

    Args:
        frames: all registered images, in the order of their names.
        points: of the reconstruction, at least four.
    Raises:
        ValueError: the trainer's formula mirrors the world.
    Returns:
        The trainer's similarity, and then the three others that differ by half a turn about an axis: gsplat before
        1.5 did not flip, and the signs of the axes depend on the linear algebra library of the training.
    """
    poses = np.array([np.concatenate([frame.pose, [[0, 0, 0, 1]]]) for frame in frames]) * [1, -1, -1, 1]
    with np.errstate(all="ignore"):
        upright = _upright(poses)
    if not np.isfinite(upright).all():
        raise InputError(
            "gsplat's normalization cannot be computed from these cameras: all of them stand at one point, or look up "
            "in opposite directions. Give --world-transform; or --gsplat-normalize False, if the training had "
            "--no-normalize-world-space."
        )
    if np.linalg.det(upright[:3, :3]) < 0:
        raise InputError(
            "The mean up axis of the cameras is exactly +y, and gsplat's trainer mirrors such a world. Train the splat "
            "again with --no-normalize-world-space, and give --gsplat-normalize False."
        )
    turned = _principal_axes(_apply(upright, points.astype(np.float32))) @ upright
    height = _apply(turned, points.astype(np.float32))[:, 2]
    half_turns = [np.diag(signs) for signs in ([1, 1, 1, 1], [1, -1, -1, 1], [-1, 1, -1, 1], [-1, -1, 1, 1])]
    if np.median(height) > np.mean(height):
        half_turns[:2] = half_turns[1::-1]
    return [similarity(half_turn @ turned, "the normalization") for half_turn in half_turns]


def _apply(matrix: Float[np.ndarray, "4 4"], points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
    return points @ matrix[:3, :3].T + matrix[:3, 3]


def _upright(poses: Float[np.ndarray, "v 4 4"]) -> Float[np.ndarray, "4 4"]:
    """The mean up axis of cameras in OpenCV convention goes to -y, what they look at to the origin."""
    up = -poses[:, :3, 1].mean(axis=0)
    up /= np.linalg.norm(up)
    axis, cosine = np.cross(up, [0.0, -1.0, 0.0]), -up[1]
    if cosine > -1:
        skew = np.cross(np.eye(3), axis)
        rotation = np.eye(3) + skew + skew @ skew / (1 + cosine)
    else:
        rotation = np.diag([-1.0, 1.0, 1.0])  # a mirror, as it stands there
    centres, forward = poses[:, :3, 3] @ rotation.T, poses[:, :3, 2] @ rotation.T
    nearest = centres - (forward * centres).sum(axis=1)[:, None] * forward  # of the viewing ray to the origin
    shift = -np.median(nearest, axis=0)
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = rotation, shift
    matrix[:3] /= np.median(np.linalg.norm(centres + shift, axis=1))
    return matrix


def _principal_axes(points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "4 4"]:
    """The median of the points goes to the origin, their widest direction to x, their narrowest to z."""
    centre = np.median(points, axis=0)
    covariance = np.cov(points - centre, rowvar=False)
    if not np.isfinite(covariance).all():
        raise InputError("gsplat's normalization cannot be computed: the points of the project lie too far away.")
    axes = np.linalg.eigh(covariance)[1][:, ::-1].copy()
    if np.linalg.det(axes) < 0:
        axes[:, 0] *= -1
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = axes.T, -axes.T @ centre
    return matrix
