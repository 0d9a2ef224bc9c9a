"""Worlds in which tools place splats, as maps from the world of the cameras."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import replace
from itertools import product
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from normlift_ns.data.colmap import read_colmap_points
from normlift_ns.data.frames import Frame, WorldTransform, transform_frames
from normlift_ns.data.nerfstudio.config_classes import NerfstudioDataParserConfig
from normlift_ns.data.nerfstudio.dataparsers import normalize_poses
from normlift_ns.data.splat import SplatFile
from normlift_ns.data.transforms import CameraFile, decompose_similarity, gsplat_normalization, read_world_transform
from normlift_ns.errors import InputError
from normlift_ns.options import SplatOptions
from normlift_ns.rasterization.settings import RasterSettings

_MIN_POINTS = 4
_SAME = 1e-3
"""Absolute and relative tolerance of the numbers of two worlds that count as equal."""
_Y_DOWN_TO_Z_UP = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])
"""Rotation that ns-process-data and nerfstudio's COLMAP data parser apply to the cameras of COLMAP."""
_TURNS = {
    "": np.eye(3),
    "half a turn about x": np.diag([1.0, -1, -1]),
    "half a turn about y": np.diag([-1.0, 1, -1]),
    "half a turn about z": np.diag([-1.0, -1, 1]),
    "a quarter turn about x, from y up to z up": _Y_DOWN_TO_Z_UP.T,
    "a quarter turn about x, from z up to y up": _Y_DOWN_TO_Z_UP,
    "an exchange of x and y with z reversed": np.array([[0.0, 1, 0], [1, 0, 0], [0, 0, -1]]),
}
"""Rotations between the axis conventions of tools. Old versions of ns-process-data applied the last one."""
_OPENCV_AXES = np.array([1.0, -1, -1, 1])


class CandidateWorld(NamedTuple):
    """World in which a splat may lie."""

    name: str
    """Noun phrase that names the world in messages."""
    world: WorldTransform
    """Map from the cameras' world to that of the splat."""
    opencv_cameras: bool = False
    """True if the camera file has poses with OpenCV's axes (y down, z forward), although its format has OpenGL's."""
    scale_since_training: float = 1.0
    """Uniform scale that was applied to the splat after its training. It also applies to the clip planes of the
    training."""

    @property
    def matrix(self) -> Float[np.ndarray, "4 4"]:
        """Homogeneous 4 x 4 matrix of `world`."""
        return np.vstack([self.world.scale * self.world.transform, [0, 0, 0, 1]])

    def scaled(self, scale: float) -> CandidateWorld:
        """Return the world, scaled uniformly about its origin."""
        return self._replace(
            name=f"{self.name}, scaled by {scale:g}",
            world=self.world._replace(scale=self.world.scale * scale),
            scale_since_training=self.scale_since_training * scale,
        )

    def clip_planes(self, planes: tuple[float, float] | None) -> tuple[float, float] | None:
        """Return the near and far planes of the training in units of this world; None for those of splatfacto."""
        if self.scale_since_training == 1:
            return planes
        near, far = planes or (RasterSettings.near_plane, RasterSettings.far_plane)
        return near * self.scale_since_training, far * self.scale_since_training

    def place(self, frames: Sequence[Frame]) -> list[Frame]:
        """Return the frames with poses in this world."""
        return transform_frames(with_opengl_axes(frames) if self.opencv_cameras else frames, self.world)


def with_opengl_axes(frames: Sequence[Frame]) -> list[Frame]:
    """Convert the poses of frames from OpenCV's axes to OpenGL's."""
    return [replace(frame, pose=frame.pose * _OPENCV_AXES) for frame in frames]


def candidate_worlds(file: SplatFile, options: SplatOptions, cameras: CameraFile) -> list[CandidateWorld]:
    """Return the worlds in which a splat may lie; the first is the one that the options and files state.

    With `--world-transform auto`, further worlds follow. They are the worlds of gsplat's trainer, ns-train and
    `applied_transform`. Every world, including the first, is repeated with rotations between the axes of tools, and
    with cameras that have OpenCV's axes.

    Raises:
        FileNotFoundError, ValueError: The world that the options or files state cannot be read or computed.
    """
    if isinstance(options.world_transform, Path):
        world = read_world_transform(options.world_transform, cameras.applied_transform, cameras.applied_scale)
        return [CandidateWorld("the given world", world)]
    bases = [CandidateWorld("the world of its cameras", WorldTransform(np.eye(4)[:3], 1.0))]
    if options.gsplat_normalize and file.by_gsplat:
        bases.insert(0, _gsplat_world(options, cameras))
    if options.world_transform is None:
        return bases[:1]
    if options.gsplat_normalize and options.colmap is not None and not file.by_gsplat:
        with suppress(ValueError, FileNotFoundError):  # a PLY file may be from another trainer
            bases.append(_gsplat_world(options, cameras))
    bases += [*_applied_worlds(cameras), *_ns_train_worlds(options, cameras)]
    worlds: list[CandidateWorld] = []
    for flipped, (turn, rotation), base in product((False, True), _TURNS.items(), bases):
        name = " after ".join(filter(None, (base.name, turn)))
        world = base.world._replace(transform=rotation @ base.world.transform)
        _append_new(worlds, CandidateWorld(f"{name}{', with OpenCV cameras' if flipped else ''}", world, flipped))
    return worlds


def _append_new(worlds: list[CandidateWorld], candidate: CandidateWorld) -> None:
    """Append a world unless it is listed already."""
    if not any(
        candidate.opencv_cameras == other.opencv_cameras
        and np.allclose(candidate.world.transform, other.world.transform, rtol=_SAME, atol=_SAME)
        and np.isclose(candidate.world.scale, other.world.scale, rtol=_SAME)
        for other in worlds
    ):
        worlds.append(candidate)


def _gsplat_world(options: SplatOptions, cameras: CameraFile) -> CandidateWorld:
    """Recompute the normalization of gsplat's trainer from its COLMAP project."""
    if options.colmap is None:
        raise InputError(
            "gsplat's trainer normalized the world of the splat with the points of its COLMAP project, so a "
            "transforms.json is not enough. Give the project with --colmap, or a file of a known transform with "
            "--world-transform. If the training used --no-normalize-world-space, give --gsplat-normalize False."
        )
    try:
        points = read_colmap_points(cameras.source)
    except FileNotFoundError as error:
        raise FileNotFoundError(f"gsplat's trainer normalized the world with points3D. {error}") from error
    if len(points) < _MIN_POINTS:
        raise InputError(
            f"{cameras.source} has too few points ({len(points)}, expected at least {_MIN_POINTS}) to recompute the "
            "normalization of gsplat's trainer. Give the project that the splat was trained with, or "
            "--gsplat-normalize False if the training used --no-normalize-world-space."
        )
    return CandidateWorld("gsplat's normalized world", gsplat_normalization(cameras.frames, points))


def _applied_worlds(cameras: CameraFile) -> Iterator[CandidateWorld]:
    """Yield the world before `applied_transform` and the world after a second one, if the transform is a similarity."""
    if cameras.applied_transform is None:
        return
    matrix = np.diag([*[cameras.applied_scale] * 3, 1.0]) @ cameras.applied_transform
    try:
        before, after = (decompose_similarity(m, "applied_transform") for m in (np.linalg.inv(matrix), matrix))
    except InputError:
        return
    yield CandidateWorld("the world before applied_transform", before)
    yield CandidateWorld("the world after a second applied_transform", after)


def _ns_train_worlds(options: SplatOptions, cameras: CameraFile) -> Iterator[CandidateWorld]:
    """Yield the world to which ns-train rotates, centers and scales cameras by default, if their positions differ."""
    if len({tuple(frame.pose[:, 3].astype(np.float32)) for frame in cameras.frames}) == 1:
        return
    applied = np.eye(4)
    if options.colmap is not None:
        applied[:3, :3] = _Y_DOWN_TO_Z_UP
    poses = [applied @ np.vstack([frame.pose, [0, 0, 0, 1]]) for frame in cameras.frames]
    _, transform, scale = normalize_poses(poses, NerfstudioDataParserConfig(), "up")
    world = WorldTransform(transform.double().numpy() @ applied, scale, float32=True)
    if np.isfinite([*world.transform.ravel(), world.scale]).all():
        yield CandidateWorld("ns-train's normalized world", world)
