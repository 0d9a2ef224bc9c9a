"""New poses that would see regions without evidence: where cameras have been or could have been, with nothing between.

A place is free if a camera stood near it, or if a photograph shows something behind it: rays of the photographs have
passed there. Candidates look at a region from free places of the photographs and from a ring around the region, at the
height of the cameras. Of these, poses are chosen by their gain in the regions (`gain`), each beside those before it.
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

REGIONS = 4
"""Regions that candidates look at, those that lack most."""
PLACES, RING = 12, 12
"""Places of photographs, and azimuths of the ring, from which a region is looked at."""
LOOKED_AT = 10
"""Candidates per region whose weights are rasterized."""
SEES = 0.3
"""A view sees a region if it shows at least this share of it as well as any photograph does."""
NEAREST = 0.15
"""Nothing may be nearer to a new camera than this share of the median depth of the photographs, but for few pixels."""
FEW = 0.05
"""Share of the pixels in which something may be nearer."""
_DEPTH_PIXELS = 5_000
_DEPTH_VIEWS = 16


@dataclass(frozen=True)
class Pose:
    """A new camera, in the scene's own coordinates."""

    camera: Camera
    gain: float
    """Expected rise of the mean reliability of all surface, beside the lift and the poses before it."""
    regions: list[int]
    """Numbers of the regions that it sees, from 1."""
    shown: float
    """How much it shows of the region that it sees best: 1 is as well as the best photograph does."""

    @property
    def field_of_view(self) -> float:
        """Vertical, in degrees."""
        return math.degrees(2 * math.atan(self.camera.height / 2 / float(self.camera.K[1, 1])))

    def to_json(self) -> dict[str, Any]:
        """The same as plain types."""
        return {
            "position": self.camera_to_world()[:3, 3].tolist(),
            "camera_to_world": self.camera_to_world().tolist(),
            "field_of_view": self.field_of_view,
            "gain": self.gain,
            "regions": self.regions,
            "shown": self.shown,
        }

    def camera_to_world(self) -> Float64[Tensor, "4 4"]:
        """In OpenGL's convention, as nerfstudio has it: x right, y up, z backward."""
        return self.camera.world_to_camera.double().inverse() * torch.tensor([1.0, -1, -1, 1], dtype=torch.float64)


@dataclass(frozen=True)
class Space:
    """What photographs tell of where there is nothing."""

    eyes: Float64[Tensor, "v 3"]
    up: Float64[Tensor, " 3"]
    cameras: Sequence[Camera]
    depths: Sequence[Float64[Tensor, "h w"]]
    """Of the cameras; infinite where nothing is seen."""

    @property
    def depth(self) -> float:
        """Median depth of what the photographs show."""
        found = torch.cat([depth[depth.isfinite()] for depth in self.depths])
        return float(found.median()) if len(found) > 0 else 1.0

    @property
    def spacing(self) -> float:
        """Median distance from a photograph to the nearest other one; 0 for a single one."""
        if len(self.eyes) < 2:
            return 0.0
        distance = torch.cdist(self.eyes, self.eyes).fill_diagonal_(torch.inf)
        return float(distance.amin(1).median())

    def free(self, places: Float64[Tensor, "p 3"]) -> Bool[Tensor, " p"]:
        """Whether a camera could be there."""
        found = (torch.cdist(places, self.eyes) <= self.spacing + 1e-9).any(1)
        for camera, depth in zip(self.cameras, self.depths):
            pose, K = camera.world_to_camera.double().cpu(), camera.K.double().cpu()
            there = places @ pose[:3, :3].T + pose[:3, 3]
            z = there[:, 2]
            pixel = (there @ K.T)[:, :2] / z[:, None].clamp(min=1e-9)
            inside = (z > 0) & (pixel >= 0).all(1) & (pixel[:, 0] < camera.width) & (pixel[:, 1] < camera.height)
            x, y = (pixel[:, i].long().clamp(0, size - 1) for i, size in ((0, camera.width), (1, camera.height)))
            found |= inside & (depth[y, x] > (1 + FEW) * z)
        return found


def space_of(drawn: Drawn, cameras: Sequence[Camera]) -> Space:
    """Depths as some of the photographs see them."""
    chosen = [smaller(cameras[i], _DEPTH_PIXELS) for i in spread(len(cameras), _DEPTH_VIEWS)]
    to_world = torch.stack([camera.world_to_camera.double().cpu().inverse() for camera in cameras])
    up = normalize(-to_world[:, :3, 1].mean(0), dim=0)
    if not bool(up.norm() > 0):  # cameras of all rolls
        up = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)
    return Space(to_world[:, :3, 3], up, chosen, [depth_of(drawn, camera) for camera in chosen])


def depth_of(drawn: Drawn, camera: Camera) -> Float64[Tensor, "h w"]:
    """Mean depth of what a camera sees; infinite where it sees less than half of anything."""
    pose = camera.world_to_camera.to(drawn.gaussians.means)
    z = (drawn.gaussians.means @ pose[2, :3] + pose[2, 3])[:, None]
    how = {"rasterize_mode": drawn.rasterize_mode, "settings": drawn.settings}
    values, alpha = render(drawn.gaussians, camera, torch.nan_to_num(z, 0.0, 0.0, 0.0), **how)
    return torch.where(alpha > 0.5, values[:, :, 0] / alpha, torch.inf).double().cpu()


def places_around(space: Space, target: Float64[Tensor, " 3"]) -> Float64[Tensor, "p 3"]:
    """Free places from which to look at a target: of photographs, and on two rings around it at the cameras' height."""
    away = space.eyes - target
    height = away @ space.up
    radius = (away - height[:, None] * space.up).norm(dim=1).median()
    axis = torch.eye(3, dtype=torch.float64)[space.up.abs().argmin()]
    first = normalize(torch.linalg.cross(space.up, axis), dim=0)
    second = torch.linalg.cross(space.up, first)
    angle = torch.arange(RING, dtype=torch.float64) * (2 * math.pi / RING)
    circle = angle.cos()[:, None] * first + angle.sin()[:, None] * second
    rings = [target + height.median() * space.up + factor * radius * circle for factor in (1.0, 0.5)]
    found = torch.cat([space.eyes[spread(len(space.eyes), PLACES)], *rings])
    far = (found - target).norm(dim=1) > NEAREST * space.depth
    return found[space.free(found) & far]


def look_at(
    eye: Float64[Tensor, " 3"], target: Float64[Tensor, " 3"], up: Float64[Tensor, " 3"], like: Camera
) -> Camera:
    """A camera of the size and the focal length of another, its principal point in the middle, as ns-render has it."""
    forward = normalize(target - eye, dim=0)
    right = torch.linalg.cross(forward, up)
    if float(right.norm()) < 1e-6:  # straight up or down: any roll will do
        right = torch.linalg.cross(forward, torch.eye(3, dtype=torch.float64)[forward.abs().argmin()])
    right = normalize(right, dim=0)
    pose = torch.eye(4, dtype=torch.float64)
    pose[:3, :3] = torch.stack([right, torch.linalg.cross(forward, right), forward])
    pose[:3, 3] = -pose[:3, :3] @ eye
    width, height = (max(2, side - side % 2) for side in (like.width, like.height))  # as videos must have
    focal = float(like.K[1, 1])
    K = torch.tensor([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]])
    return Camera(K, pose.float(), width, height)


def suggest_poses(
    drawn: Drawn,
    photographs: Sequence[Camera],
    known: Known,
    targets: Sequence[Sequence[float]],
    parts: Sequence[Tensor],
) -> list[Pose]:
    """Poses that see regions best, greedily.

    Args:
        targets: centres of the regions.
        parts: Gaussians of the regions.
    """
    if len(parts) == 0:
        return []
    space = space_of(drawn, photographs)
    candidates: list[Camera] = []
    for target in targets[:REGIONS]:
        centre = torch.tensor(target, dtype=torch.float64)
        places = places_around(space, centre)
        candidates += [
            look_at(places[i], centre, space.up, photographs[0])
            for i in spread(len(places), LOOKED_AT)
            if len(places) > 0
        ]
    if len(candidates) == 0:
        return []
    weights = view_weights(drawn, candidates)
    seen = shown_shares(weights, len(candidates), known.surface, parts)
    inside = torch.zeros_like(known.surface)
    inside[torch.cat(list(parts))] = 1
    share = float((inside * known.surface).sum() / known.surface.sum())
    lacking = replace(known, surface=inside * known.surface)
    open_ = seen.amax(0) >= SEES
    poses: list[Pose] = []
    while len(poses) < POSES and bool(open_.any()):
        found = gains(lacking, weights, len(candidates)).cpu()
        found[~open_] = 0.0
        best = int(found.argmax())
        if not float(found[best]) > 0:
            break
        open_[best] = False
        if _near(drawn, candidates[best]) < NEAREST * space.depth:
            continue
        numbers = [i for i, x in enumerate(seen[:, best].tolist(), 1) if x >= SEES]
        poses.append(Pose(candidates[best], share * float(found[best]), numbers, float(seen[:, best].max())))
        lacking = lacking.seen_by(weights, best)
    return poses


def _near(drawn: Drawn, camera: Camera) -> float:
    """Depth that all but few pixels exceed."""
    depth = depth_of(drawn, smaller(camera, _DEPTH_PIXELS))
    return float(depth.flatten().sort().values[int(FEW * depth.numel())])
