"""Where nerfstudio puts cameras: its arithmetic in float32, step by step, so that results are equal bit by bit."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from normlift_ns.errors import InputError
from normlift_ns.scenes.nerfstudio.data_classes import ColmapDataParserConfig, NerfstudioDataParserConfig

_NEARLY_PARALLEL, _LEAST_TILT = 1e-6, 0.17


def placed(
    rows: Any, parser: NerfstudioDataParserConfig | ColmapDataParserConfig, orientation: str
) -> tuple[Float[Tensor, "v 3 4"], Float[Tensor, "3 4"], float]:
    """Poses in the scene's world, the transform to it, and its scale.

    Raises:
        ValueError: poses that are no 4 x 4 matrices, or a method that nerfstudio does not have.
    """
    poses = torch.from_numpy(np.array(rows).astype(np.float32))
    if poses.shape[1:] != (4, 4):
        raise InputError(f"a pose has {poses.shape[1]} rows, expected 4")
    poses, transform = orient_and_center(poses, orientation, parser.center_method)
    scale = 1.0
    if parser.auto_scale_poses:
        scale /= float(torch.max(torch.abs(poses[:, :3, 3])))
    scale *= parser.scale_factor
    poses[:, :3, 3] *= scale
    return poses, transform, scale


def with_applied(transform: Float[Tensor, "3 4"], applied: Sequence[Sequence[float]] | None) -> Float[Tensor, "3 4"]:
    """The transform from the capture's own world, where the poses in the file were moved before."""
    if applied is None:
        return transform
    rows = torch.cat([torch.tensor(applied, dtype=transform.dtype), torch.tensor([[0.0, 0.0, 0.0, 1.0]])], 0)
    return transform @ rows


def orient_and_center(
    poses: Float[Tensor, "v 4 4"], method: str, center: str
) -> tuple[Float[Tensor, "v 3 4"], Float[Tensor, "3 4"]]:
    """The poses in the scene's world before it is scaled, and the transform to it: `auto_orient_and_center_poses`.

    Raises:
        ValueError: a method that nerfstudio does not have.
    """
    origins = poses[..., :3, 3]
    mean = torch.mean(origins, dim=0)
    translation = {"poses": lambda: mean, "focus": lambda: _focus(poses, mean), "none": lambda: torch.zeros_like(mean)}[
        center
    ]()
    if method == "pca":
        return _principal(poses, origins - mean, translation)
    if method in ("up", "vertical"):
        rotation = _between(_up(poses, vertical=method == "vertical"), torch.tensor([0.0, 0.0, 1.0]))
        transform = torch.cat([rotation, rotation @ -translation[..., None]], dim=-1)
    elif method == "none":
        transform = torch.eye(4)
        transform[:3, 3] = -translation
        transform = transform[:3, :]
    else:
        raise InputError(f"there is no orientation method {method!r}")
    return transform @ poses, transform


def _principal(
    poses: Float[Tensor, "v 4 4"], offsets: Float[Tensor, "v 3"], translation: Float[Tensor, " 3"]
) -> tuple[Float[Tensor, "v 3 4"], Float[Tensor, "3 4"]]:
    _, axes = torch.linalg.eigh(offsets.T @ offsets)
    axes = torch.flip(axes, dims=(-1,))
    if torch.linalg.det(axes) < 0:
        axes[:, 2] = -axes[:, 2]
    transform = torch.cat([axes, axes @ -translation[..., None]], dim=-1)
    oriented = transform @ poses
    if oriented.mean(dim=0)[2, 1] < 0:
        oriented[1:3, :] = -1 * oriented[1:3, :]  # of the second and third pose, as nerfstudio has it
        transform[1:3, :] = -1 * transform[1:3, :]
    return oriented, transform


def _up(poses: Float[Tensor, "v 4 4"], *, vertical: bool) -> Float[Tensor, " 3"]:
    up = torch.mean(poses[:, :3, 1], dim=0)
    up = up / torch.linalg.norm(up)
    if not vertical:
        return up
    _, sizes, directions = torch.linalg.svd(poses[:, :3, 0], full_matrices=False)
    if sizes[1] > _LEAST_TILT * math.sqrt(poses.shape[0]):
        found = directions[2, :]
        return found if torch.dot(found, up) > 0 else -found
    up = up - directions[0, :] * torch.dot(up, directions[0, :])
    return up / torch.linalg.norm(up)


def _between(a: Float[Tensor, " 3"], b: Float[Tensor, " 3"]) -> Float[Tensor, "3 3"]:
    """The rotation from one direction to another."""
    a = a / torch.linalg.norm(a)
    b = b / torch.linalg.norm(b)
    axis = torch.linalg.cross(a, b)
    if torch.sum(torch.abs(axis)) < _NEARLY_PARALLEL:
        other = torch.tensor([1.0, 0, 0]) if abs(a[0]) < _NEARLY_PARALLEL else torch.tensor([0, 1.0, 0])
        axis = torch.linalg.cross(a, other)
    x, y, z = axis / torch.linalg.norm(axis)
    skew = torch.tensor([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    angle = torch.acos(torch.clip(torch.dot(a, b), -1, 1))
    return torch.eye(3) + torch.sin(angle) * skew + (1 - torch.cos(angle)) * (skew @ skew)


def _focus(poses: Float[Tensor, "v 4 4"], focus: Float[Tensor, " 3"]) -> Float[Tensor, " 3"]:
    """The point that is closest to the axes of all cameras which have it in front of them."""
    directions, origins = -poses[:, :3, 2:3], poses[:, :3, 3:4]
    active = torch.sum(directions.squeeze(-1) * (focus - origins.squeeze(-1)), dim=-1) > 0
    done = False
    while torch.sum(active.int()) > 1 and not done:
        directions, origins = directions[active], origins[active]
        across = torch.eye(3) - directions * torch.transpose(directions, -2, -1)
        squares = torch.transpose(across, -2, -1) @ across
        focus = torch.linalg.inv(squares.mean(0)) @ (squares @ origins).mean(0)[:, 0]
        active = torch.sum(directions.squeeze(-1) * (focus - origins.squeeze(-1)), dim=-1) > 0
        done = bool(active.all())
    return focus


def adjusted(poses: Float[Tensor, "v 3 4"], moves: Float[Tensor, "v 6"], mode: str) -> Float[Tensor, "v 3 4"]:
    """The poses as the camera optimizer moved them: mode SO3xR3 or SE3."""
    exponential = _so3_r3 if mode == "SO3xR3" else _se3
    found = []
    for pose, move in zip(poses[:, None], moves.float()[:, None]):  # one by one, as nerfstudio does: same roundings
        change = exponential(move)
        rotation = torch.bmm(change[..., :3, :3], pose[..., :3, :3])
        found.append(torch.cat([rotation, pose[..., :3, 3:] + change[..., :3, 3:]], dim=-1))
    return torch.cat(found)


def _so3_r3(move: Float[Tensor, "1 6"]) -> Float[Tensor, "1 3 4"]:
    turn = move[:, 3:]
    angle = torch.clamp((turn * turn).sum(1), 1e-4).sqrt()
    inverse = 1.0 / angle
    first, second = inverse * angle.sin(), inverse * inverse * (1.0 - angle.cos())
    skew = torch.zeros(1, 3, 3)
    skew[:, 0, 1], skew[:, 0, 2] = -turn[:, 2], turn[:, 1]
    skew[:, 1, 0], skew[:, 1, 2] = turn[:, 2], -turn[:, 0]
    skew[:, 2, 0], skew[:, 2, 1] = -turn[:, 1], turn[:, 0]
    found = torch.zeros(1, 3, 4)
    found[:, :3, :3] = first[:, None, None] * skew + second[:, None, None] * torch.bmm(skew, skew) + torch.eye(3)[None]
    found[:, :3, 3] = move[:, :3]
    return found


def _se3(move: Float[Tensor, "1 6"]) -> Float[Tensor, "1 3 4"]:
    shift, turn = move[:, :3].view(-1, 3, 1), move[:, 3:].view(-1, 3, 1)
    angle = torch.linalg.norm(turn, dim=1).unsqueeze(1)
    square = angle**2
    small, one = angle < 1e-2, torch.ones(1)
    angle_1, square_1, cube_1 = (torch.where(small, one, value) for value in (angle, square, angle**3))
    sine = angle.sin()
    cosine = torch.where(small, 8 / (4 + square) - 1, angle.cos())
    sine_by = torch.where(small, 0.5 * cosine + 0.5, sine / angle_1)
    rest_by = torch.where(small, 0.5 * sine_by, (1 - cosine) / square_1)
    found = torch.zeros(1, 3, 4)
    found[:, :3, :3] = rest_by * turn @ turn.transpose(1, 2)
    for i in range(3):
        found[:, i, i] += cosine.view(-1)
    part = sine_by.view(-1, 1) * turn.view(-1, 3)
    for i, j, k in ((0, 1, 2), (2, 0, 1), (1, 2, 0)):
        found[:, i, j] -= part[:, k]
        found[:, j, i] += part[:, k]
    sine_by = torch.where(small, 1 - square / 6, sine_by)
    rest_by = torch.where(small, 0.5 - square / 24, rest_by)
    third = torch.where(small, 1.0 / 6 - square / 120, (angle - sine) / cube_1)
    found[:, :, 3:] = sine_by * shift
    found[:, :, 3:] += rest_by * torch.cross(turn, shift, dim=1)
    found[:, :, 3:] += third * (turn @ (turn.transpose(1, 2) @ shift))
    return found
