"""Transforms from the world of the cameras to the world of the splat."""

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
"""Largest deviation of a matrix from a similarity, because files round."""
_MAX_ENTRY, _MAX_MATRIX_BYTES = 1e30, 2**16
_EXPECTED_DATAPARSER = "the dataparser_transforms.json that ns-train wrote; copy it again from the run"
_EXPECTED_MATRIX = "4 x 4 numbers in JSON, .npy or .txt, or the dataparser_transforms.json of a nerfstudio run"


class _DataparserTransforms(msgspec.Struct):
    """nerfstudio's dataparser_transforms.json: p -> scale * (transform @ p) maps to the scene's world."""

    transform: list[list[float]]
    scale: float


def read_dataparser_transforms(path: Path) -> World:
    """Read the dataparser_transforms.json of a nerfstudio run.

    Raises:
        FileNotFoundError: if there is no such file.
        ValueError: if the file does not hold a finite transform and a positive scale.
    """
    return _to_world(read_json(path, _EXPECTED_DATAPARSER), path)


def _to_world(values: Any, path: Path) -> World:
    try:
        stored = msgspec.convert(values, _DataparserTransforms)
    except (msgspec.ValidationError, RecursionError, OverflowError) as error:
        raise InputError(f"{path} does not hold a transform ({error}). Expected {_EXPECTED_DATAPARSER}.") from error
    rows = stored.transform
    is_valid = len(rows) in (3, 4) and all(len(row) == 4 for row in rows) and (np.abs(rows) < _MAX_ENTRY).all()
    if not is_valid or not 0 < stored.scale < _MAX_ENTRY:
        raise InputError(
            f"{path} does not hold a transform: {len(rows)} rows and scale {stored.scale:g}. Expected 3 rows of 4 "
            f"finite numbers and a positive scale: {_EXPECTED_DATAPARSER}."
        )
    return World(np.array(rows[:3]), stored.scale)


def capture_worlds(run_dir: Path, identity: Mapping[str, Any]) -> tuple[World, ...]:
    """Return the successive transforms from the world of the capture to that of a lifted run's Gaussians.

    Args:
        run_dir: folder of the lifted run.
        identity: identity of the scene; for a splat without a nerfstudio run, it stores the transform of its cameras.
    Raises:
        FileNotFoundError, ValueError: as in `read_dataparser_transforms`, also for `source_world` of the identity.
    """
    trained = read_dataparser_transforms(run_dir / "dataparser_transforms.json")
    source = identity.get("source_world")
    return (trained,) if source is None else (_to_world(source, run_dir / "splat.json"), trained)


def read_world_transform(
    path: Path, applied: Float[np.ndarray, "4 4"] | None = None, applied_scale: float = 1.0
) -> World:
    """Read a similarity.

    Args:
        path: a 4 x 4 matrix in JSON, .npy or .txt, or a dataparser_transforms.json.
        applied, applied_scale: only used for a dataparser_transforms.json, which starts from the world of the capture:
            the transform from there to the world of the cameras, as their file states it.
    Raises:
        FileNotFoundError: if there is no such file.
        ValueError: if the file does not hold a similarity.
    """
    try:
        values = _read_values(path)
        if not isinstance(values, dict):
            return similarity(np.array(values, dtype=float), str(path))
    except InputError:
        raise
    except (TypeError, ValueError, EOFError, OverflowError, MemoryError, OSError, tokenize.TokenError) as error:
        raise InputError(f"{path} does not hold a transform ({error}). Expected {_EXPECTED_MATRIX}.") from error
    world = _to_world(values, path)
    matrix = np.eye(4)
    matrix[:3] = world.transform
    if applied is not None:
        matrix = matrix @ np.linalg.inv(applied)
    scale = world.scale / applied_scale
    similarity(matrix * scale + np.diag([0, 0, 0, 1 - scale]), str(path))
    return World(matrix[:3], scale, single=True)


def _read_values(path: Path) -> Any:
    if path.suffix not in (".npy", ".txt") or not path.is_file():
        return read_json(path, _EXPECTED_MATRIX)
    if path.stat().st_size > _MAX_MATRIX_BYTES:
        raise InputError(
            f"{path} has {path.stat().st_size:,} bytes, too many for 4 x 4 numbers. Expected {_EXPECTED_MATRIX}."
        )
    return (np.load(path, allow_pickle=False) if path.suffix == ".npy" else np.loadtxt(path)).tolist()


def similarity(matrix: Float[np.ndarray, "4 4"], source: str) -> World:
    """Split a 4 x 4 matrix into scale and transform.

    Args:
        matrix: the matrix.
        source: its origin, for error messages.
    Raises:
        ValueError: if the matrix does not consist of a rotation, a scale and a translation.
    """
    if matrix.shape != (4, 4) or not (np.abs(matrix) < _MAX_ENTRY).all():
        raise InputError(
            f"{source} has the shape {matrix.shape}, or its numbers are not finite. Expected {_EXPECTED_MATRIX}."
        )
    linear = matrix[:3, :3]
    scale = float(np.cbrt(np.linalg.det(linear)))
    last = np.abs(matrix[3] - [0, 0, 0, 1]).max()
    if not (scale > 0 and last <= _TOLERANCE and np.abs(linear @ linear.T / scale**2 - np.eye(3)).max() <= _TOLERANCE):
        raise InputError(
            f"{source} is not a similarity: {matrix.tolist()}. Expected a rotation without mirroring, one scale for "
            "all axes and a translation, with 0 0 0 1 in the last row."
        )
    return World(matrix[:3] / scale, scale)


def gsplat_normalization(frames: list[Frame], points: Float[np.ndarray, "n 3"]) -> list[World]:
    """Recompute the normalization of a COLMAP project by gsplat's simple_trainer, which does not save it.

    The steps are those of its datasets/normalize.py and datasets/colmap.py (1.5). First, put the cameras upright around
    the origin at a median distance of 1. Then turn the points' principal axes to x, y and z, and flip the half with
    more points to the bottom.

    Args:
        frames: all registered images, sorted by name.
        points: points of the reconstruction, at least four.
    Raises:
        ValueError: if the normalization cannot be computed, or the trainer's formula mirrors the world.
    Returns:
        The trainer's similarity, followed by the three that differ from it by half a turn about an axis. gsplat before
        1.5 did not flip, and the signs of the axes depend on the linear algebra library of the training.
    """
    poses = np.array([np.concatenate([frame.pose, [[0, 0, 0, 1]]]) for frame in frames]) * [1, -1, -1, 1]
    with np.errstate(all="ignore"):
        upright = _upright(poses)
    if not np.isfinite(upright).all():
        raise InputError(
            "gsplat's normalization cannot be computed from these cameras: all are at one point, or their up axes "
            "cancel out. Give --world-transform, or --gsplat-normalize False if the training used "
            "--no-normalize-world-space."
        )
    if np.linalg.det(upright[:3, :3]) < 0:
        raise InputError(
            "The mean up axis of the cameras is exactly +y, and gsplat's trainer mirrors such a world. Train the splat "
            "again with --no-normalize-world-space, and give --gsplat-normalize False."
        )
    aligned = _principal_axes(_apply(upright, points.astype(np.float32))) @ upright
    height = _apply(aligned, points.astype(np.float32))[:, 2]
    half_turns = [np.diag(signs) for signs in ([1, 1, 1, 1], [1, -1, -1, 1], [-1, 1, -1, 1], [-1, -1, 1, 1])]
    if np.median(height) > np.mean(height):
        half_turns[:2] = half_turns[1::-1]
    return [similarity(half_turn @ aligned, "the normalization") for half_turn in half_turns]


def _apply(matrix: Float[np.ndarray, "4 4"], points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
    return points @ matrix[:3, :3].T + matrix[:3, 3]


def _upright(poses: Float[np.ndarray, "v 4 4"]) -> Float[np.ndarray, "4 4"]:
    """Return the transform that maps the cameras' mean up axis to -y and the point that they look at to the origin.

    Args:
        poses: camera-to-world matrices in OpenCV convention.
    """
    up = -poses[:, :3, 1].mean(axis=0)
    up /= np.linalg.norm(up)
    axis, cosine = np.cross(up, [0.0, -1.0, 0.0]), -up[1]
    if cosine > -1:
        skew = np.cross(np.eye(3), axis)
        rotation = np.eye(3) + skew + skew @ skew / (1 + cosine)
    else:
        rotation = np.diag([-1.0, 1.0, 1.0])  # mirrors, as gsplat's code does
    centers, forward = poses[:, :3, 3] @ rotation.T, poses[:, :3, 2] @ rotation.T
    nearest = centers - (forward * centers).sum(axis=1)[:, None] * forward  # points of viewing rays nearest the origin
    shift = -np.median(nearest, axis=0)
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = rotation, shift
    matrix[:3] /= np.median(np.linalg.norm(centers + shift, axis=1))
    return matrix


def _principal_axes(points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "4 4"]:
    """Return the transform that maps the points' median to the origin, their widest axis to x, their narrowest to z."""
    center = np.median(points, axis=0)
    covariance = np.cov(points - center, rowvar=False)
    if not np.isfinite(covariance).all():
        raise InputError("gsplat's normalization cannot be computed: the points of the project are too far away.")
    axes = np.linalg.eigh(covariance)[1][:, ::-1].copy()
    if np.linalg.det(axes) < 0:
        axes[:, 0] *= -1
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = axes.T, -axes.T @ center
    return matrix
