"""New poses that would show regions without evidence, at positions that cameras have or could have reached.

A position is free if a camera was near it, or if rays of an image pass through it to something behind it. Candidates
look at a region from free positions of the images, and from a ring around the region at the height of the cameras.
Poses are chosen from them by their gain in the regions (`gain`), each in addition to those before it.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import torch
from jaxtyping import Bool, Float64
from torch import Tensor
from torch.nn.functional import normalize

from normlift_ns.core.gaussians import Camera
from normlift_ns.evaluation.coverage.gain import Drawn, Known, gains, shown_shares, smaller, view_weights
from normlift_ns.evaluation.options import POSES
from normlift_ns.observing import spread
from normlift_ns.raster.rasterize import render

_TARGET_REGIONS = 4
"""Number of regions that candidates look at, those with the largest lack of evidence."""
_CAMERA_POSITIONS, _RING_POSITIONS = 12, 12
"""Number of camera positions, and of azimuths on the ring, for candidates of one region."""
_MAX_CANDIDATES = 10
"""Maximum number of candidates per region whose weights are rasterized."""
SEES = 0.3
"""A view shows a region if it shows at least this share of it, compared with the best image."""
_MIN_DEPTH = 0.15
"""Minimum depth in front of a new camera, as a share of the median depth of the images."""
_NEAR_SHARE = 0.05
"""Share of the pixels that may be nearer."""
_DEPTH_PIXELS = 5_000
_DEPTH_VIEWS = 16


@dataclass(frozen=True)
class Pose:
    """A new camera in the coordinates of the scene."""

    camera: Camera
    gain: float
    """Expected increase of the mean reliability of all surfaces, in addition to the lift and the poses before it."""
    regions: list[int]
    """Numbers of the regions that it shows, from 1."""
    shown: float
    """Coverage of the region that it shows best; 1 is as good as the best image."""

    @property
    def field_of_view(self) -> float:
        """Vertical field of view in degrees."""
        return math.degrees(2 * math.atan(self.camera.height / 2 / float(self.camera.K[1, 1])))

    def to_json(self) -> dict[str, Any]:
        """Return the pose as JSON types."""
        return {
            "position": self.camera_to_world()[:3, 3].tolist(),
            "camera_to_world": self.camera_to_world().tolist(),
            "field_of_view": self.field_of_view,
            "gain": self.gain,
            "regions": self.regions,
            "shown": self.shown,
        }

    def camera_to_world(self) -> Float64[Tensor, "4 4"]:
        """Return camera to world in OpenGL's convention, as in nerfstudio: x right, y up, z backward."""
        return self.camera.world_to_camera.double().inverse() * torch.tensor([1.0, -1, -1, 1], dtype=torch.float64)


@dataclass(frozen=True)
class Space:
    """Free space according to the images."""

    eyes: Float64[Tensor, "v 3"]
    up: Float64[Tensor, " 3"]
    cameras: Sequence[Camera]
    depths: Sequence[Float64[Tensor, "h w"]]
    """Depths of the cameras; infinite for empty pixels."""

    @property
    def depth(self) -> float:
        """Median depth of everything that the images show."""
        finite = torch.cat([depth[depth.isfinite()] for depth in self.depths])
        return float(finite.median()) if len(finite) > 0 else 1.0

    @property
    def spacing(self) -> float:
        """Median distance between a camera and its nearest neighbor; 0 for a single camera."""
        if len(self.eyes) < 2:
            return 0.0
        distance = torch.cdist(self.eyes, self.eyes).fill_diagonal_(torch.inf)
        return float(distance.amin(1).median())

    def free(self, positions: Float64[Tensor, "p 3"]) -> Bool[Tensor, " p"]:
        """Return whether a camera could be at each position."""
        free = (torch.cdist(positions, self.eyes) <= self.spacing + 1e-9).any(1)
        for camera, depth in zip(self.cameras, self.depths):
            pose, K = camera.world_to_camera.double().cpu(), camera.K.double().cpu()
            points = positions @ pose[:3, :3].T + pose[:3, 3]
            z = points[:, 2]
            pixel = (points @ K.T)[:, :2] / z[:, None].clamp(min=1e-9)
            inside = (z > 0) & (pixel >= 0).all(1) & (pixel[:, 0] < camera.width) & (pixel[:, 1] < camera.height)
            x, y = (pixel[:, i].long().clamp(0, size - 1) for i, size in ((0, camera.width), (1, camera.height)))
            free |= inside & (depth[y, x] > (1 + _NEAR_SHARE) * z)
        return free


def space_of(drawn: Drawn, cameras: Sequence[Camera]) -> Space:
    """Compute the depths of some of the images."""
    chosen = [smaller(cameras[i], _DEPTH_PIXELS) for i in spread(len(cameras), _DEPTH_VIEWS)]
    to_world = torch.stack([camera.world_to_camera.double().cpu().inverse() for camera in cameras])
    up = normalize(-to_world[:, :3, 1].mean(0), dim=0)
    if not bool(up.norm() > 0):  # cameras with all kinds of roll
        up = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)
    return Space(to_world[:, :3, 3], up, chosen, [depth_of(drawn, camera) for camera in chosen])


def depth_of(drawn: Drawn, camera: Camera) -> Float64[Tensor, "h w"]:
    """Return the mean depth at each pixel of a camera; infinite if less than half of the pixel is covered."""
    pose = camera.world_to_camera.to(drawn.gaussians.means)
    z = (drawn.gaussians.means @ pose[2, :3] + pose[2, 3])[:, None]
    kwargs = {"rasterize_mode": drawn.rasterize_mode, "settings": drawn.settings}
    values, alpha = render(drawn.gaussians, camera, torch.nan_to_num(z, 0.0, 0.0, 0.0), **kwargs)
    return torch.where(alpha > 0.5, values[:, :, 0] / alpha, torch.inf).double().cpu()


def places_around(space: Space, target: Float64[Tensor, " 3"]) -> Float64[Tensor, "p 3"]:
    """Return free positions that face a target: those of images, and two rings around it at the height of the
    cameras."""
    away = space.eyes - target
    height = away @ space.up
    radius = (away - height[:, None] * space.up).norm(dim=1).median()
    axis = torch.eye(3, dtype=torch.float64)[space.up.abs().argmin()]
    first = normalize(torch.linalg.cross(space.up, axis), dim=0)
    second = torch.linalg.cross(space.up, first)
    angle = torch.arange(_RING_POSITIONS, dtype=torch.float64) * (2 * math.pi / _RING_POSITIONS)
    circle = angle.cos()[:, None] * first + angle.sin()[:, None] * second
    rings = [target + height.median() * space.up + factor * radius * circle for factor in (1.0, 0.5)]
    positions = torch.cat([space.eyes[spread(len(space.eyes), _CAMERA_POSITIONS)], *rings])
    far = (positions - target).norm(dim=1) > _MIN_DEPTH * space.depth
    return positions[space.free(positions) & far]


def look_at(
    eye: Float64[Tensor, " 3"], target: Float64[Tensor, " 3"], up: Float64[Tensor, " 3"], like: Camera
) -> Camera:
    """Return a camera with the size and focal length of another, and the principal point in the middle, as in
    ns-render."""
    forward = normalize(target - eye, dim=0)
    right = torch.linalg.cross(forward, up)
    if float(right.norm()) < 1e-6:  # straight up or down: choose any roll
        right = torch.linalg.cross(forward, torch.eye(3, dtype=torch.float64)[forward.abs().argmin()])
    right = normalize(right, dim=0)
    pose = torch.eye(4, dtype=torch.float64)
    pose[:3, :3] = torch.stack([right, torch.linalg.cross(forward, right), forward])
    pose[:3, 3] = -pose[:3, :3] @ eye
    width, height = (max(2, side - side % 2) for side in (like.width, like.height))  # videos need even sizes
    focal = float(like.K[1, 1])
    K = torch.tensor([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]])
    return Camera(K, pose.float(), width, height)


def suggest_poses(
    drawn: Drawn,
    cameras: Sequence[Camera],
    model: Known,
    targets: Sequence[Sequence[float]],
    parts: Sequence[Tensor],
) -> list[Pose]:
    """Suggest the poses that show regions best, greedily.

    Args:
        targets: centers of the regions.
        parts: Gaussians of the regions.
    """
    if len(parts) == 0:
        return []
    space = space_of(drawn, cameras)
    candidates: list[Camera] = []
    for target in targets[:_TARGET_REGIONS]:
        center = torch.tensor(target, dtype=torch.float64)
        positions = places_around(space, center)
        candidates += [
            look_at(positions[i], center, space.up, cameras[0])
            for i in spread(len(positions), _MAX_CANDIDATES)
            if len(positions) > 0
        ]
    if len(candidates) == 0:
        return []
    weights = view_weights(drawn, candidates)
    shown = shown_shares(weights, len(candidates), model.surface, parts)
    inside = torch.zeros_like(model.surface)
    inside[torch.cat(list(parts))] = 1
    share = float((inside * model.surface).sum() / model.surface.sum())
    lacking = replace(model, surface=inside * model.surface)
    available = shown.amax(0) >= SEES
    poses: list[Pose] = []
    while len(poses) < POSES and bool(available.any()):
        gain = gains(lacking, weights, len(candidates)).cpu()
        gain[~available] = 0.0
        best = int(gain.argmax())
        if not float(gain[best]) > 0:
            break
        available[best] = False
        if _near_depth(drawn, candidates[best]) < _MIN_DEPTH * space.depth:
            continue
        numbers = [i for i, x in enumerate(shown[:, best].tolist(), 1) if x >= SEES]
        poses.append(Pose(candidates[best], share * float(gain[best]), numbers, float(shown[:, best].max())))
        lacking = lacking.seen_by(weights, best)
    return poses


def _near_depth(drawn: Drawn, camera: Camera) -> float:
    """Return the depth that all but a few pixels exceed."""
    depth = depth_of(drawn, smaller(camera, _DEPTH_PIXELS))
    return float(depth.flatten().sort().values[int(_NEAR_SHARE * depth.numel())])
