"""Camera poses and splits of a dataset, with nerfstudio's own float32 steps."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Int, Int64
from torch import Tensor

from normlift_ns.data.nerfstudio.config_classes import ColmapDataParserConfig, NerfstudioDataParserConfig
from normlift_ns.errors import InputError

_PARALLEL_TOLERANCE, _MIN_TILT = 1e-6, 0.17


def normalize_poses(
    rows: Any, parser: NerfstudioDataParserConfig | ColmapDataParserConfig, orientation: str
) -> tuple[Float[Tensor, "v 3 4"], Float[Tensor, "3 4"], float]:
    """Return poses in the scene's world, the transform to that world, and its scale.

    Args:
        rows: 4 x 4 camera-to-world matrices in the dataset's world.
        parser: config of the data parser.
        orientation: nerfstudio's orientation method.
    Raises:
        ValueError: if poses are not 4 x 4 matrices, or nerfstudio does not have the orientation method.
    """
    poses = torch.from_numpy(np.array(rows).astype(np.float32))
    if poses.shape[1:] != (4, 4):
        raise InputError(f"a pose has {poses.shape[1]} rows, expected 4")
    poses, transform = _orient_and_center(poses, orientation, parser.center_method)
    scale = 1.0
    if parser.auto_scale_poses:
        scale /= float(torch.max(torch.abs(poses[:, :3, 3])))
    scale *= parser.scale_factor
    poses[:, :3, 3] *= scale
    return poses, transform, scale


def compose_applied_transform(
    transform: Float[Tensor, "3 4"], applied: Sequence[Sequence[float]] | None
) -> Float[Tensor, "3 4"]:
    """Return the transform from the capture's original world if its poses were transformed before they were stored."""
    if applied is None:
        return transform
    rows = torch.cat([torch.tensor(applied, dtype=transform.dtype), torch.tensor([[0.0, 0.0, 0.0, 1.0]])], 0)
    return transform @ rows


def _orient_and_center(
    poses: Float[Tensor, "v 4 4"], method: str, center: str
) -> tuple[Float[Tensor, "v 3 4"], Float[Tensor, "3 4"]]:
    """Orient and center poses like nerfstudio's `auto_orient_and_center_poses`.

    Returns:
        The poses in the scene's world before scaling, and the transform to that world.
    Raises:
        ValueError: if nerfstudio does not have the orientation method.
    """
    origins = poses[..., :3, 3]
    mean = torch.mean(origins, dim=0)
    translation = {
        "poses": lambda: mean,
        "focus": lambda: _focus_point(poses, mean),
        "none": lambda: torch.zeros_like(mean),
    }[center]()
    if method == "pca":
        return _orient_by_pca(poses, origins - mean, translation)
    if method in ("up", "vertical"):
        rotation = _rotation_between(_up_direction(poses, vertical=method == "vertical"), torch.tensor([0.0, 0.0, 1.0]))
        transform = torch.cat([rotation, rotation @ -translation[..., None]], dim=-1)
    elif method == "none":
        transform = torch.eye(4)
        transform[:3, 3] = -translation
        transform = transform[:3, :]
    else:
        raise InputError(f"unknown orientation method {method!r}")
    return transform @ poses, transform


def _orient_by_pca(
    poses: Float[Tensor, "v 4 4"], offsets: Float[Tensor, "v 3"], translation: Float[Tensor, " 3"]
) -> tuple[Float[Tensor, "v 3 4"], Float[Tensor, "3 4"]]:
    _, axes = torch.linalg.eigh(offsets.T @ offsets)
    axes = torch.flip(axes, dims=(-1,))
    if torch.linalg.det(axes) < 0:
        axes[:, 2] = -axes[:, 2]
    transform = torch.cat([axes, axes @ -translation[..., None]], dim=-1)
    oriented = transform @ poses
    if oriented.mean(dim=0)[2, 1] < 0:
        oriented[1:3, :] = -1 * oriented[1:3, :]  # flips the second and third pose, as nerfstudio does
        transform[1:3, :] = -1 * transform[1:3, :]
    return oriented, transform


def _up_direction(poses: Float[Tensor, "v 4 4"], *, vertical: bool) -> Float[Tensor, " 3"]:
    up = torch.mean(poses[:, :3, 1], dim=0)
    up = up / torch.linalg.norm(up)
    if not vertical:
        return up
    _, sizes, directions = torch.linalg.svd(poses[:, :3, 0], full_matrices=False)
    if sizes[1] > _MIN_TILT * math.sqrt(poses.shape[0]):
        direction = directions[2, :]
        return direction if torch.dot(direction, up) > 0 else -direction
    up = up - directions[0, :] * torch.dot(up, directions[0, :])
    return up / torch.linalg.norm(up)


def _rotation_between(a: Float[Tensor, " 3"], b: Float[Tensor, " 3"]) -> Float[Tensor, "3 3"]:
    """Return the rotation from one direction to another."""
    a = a / torch.linalg.norm(a)
    b = b / torch.linalg.norm(b)
    axis = torch.linalg.cross(a, b)
    if torch.sum(torch.abs(axis)) < _PARALLEL_TOLERANCE:
        other = torch.tensor([1.0, 0, 0]) if abs(a[0]) < _PARALLEL_TOLERANCE else torch.tensor([0, 1.0, 0])
        axis = torch.linalg.cross(a, other)
    x, y, z = axis / torch.linalg.norm(axis)
    skew = torch.tensor([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    angle = torch.acos(torch.clip(torch.dot(a, b), -1, 1))
    return torch.eye(3) + torch.sin(angle) * skew + (1 - torch.cos(angle)) * (skew @ skew)


def _focus_point(poses: Float[Tensor, "v 4 4"], focus: Float[Tensor, " 3"]) -> Float[Tensor, " 3"]:
    """Return the point closest to the optical axes of all cameras that have it in front of them."""
    directions, origins = -poses[:, :3, 2:3], poses[:, :3, 3:4]
    active = torch.sum(directions.squeeze(-1) * (focus - origins.squeeze(-1)), dim=-1) > 0
    converged = False
    while torch.sum(active.int()) > 1 and not converged:
        directions, origins = directions[active], origins[active]
        across = torch.eye(3) - directions * torch.transpose(directions, -2, -1)
        squares = torch.transpose(across, -2, -1) @ across
        focus = torch.linalg.inv(squares.mean(0)) @ (squares @ origins).mean(0)[:, 0]
        active = torch.sum(directions.squeeze(-1) * (focus - origins.squeeze(-1)), dim=-1) > 0
        converged = bool(active.all())
    return focus


def apply_pose_adjustments(
    poses: Float[Tensor, "v 3 4"], moves: Float[Tensor, "v 6"], mode: str
) -> Float[Tensor, "v 3 4"]:
    """Return the poses after the camera optimizer's adjustments, in mode SO3xR3 or SE3."""
    exponential = _exp_so3xr3 if mode == "SO3xR3" else _exp_se3
    optimized = []
    for pose, move in zip(poses[:, None], moves.float()[:, None]):  # one by one, as in nerfstudio, for equal rounding
        change = exponential(move)
        rotation = torch.bmm(change[..., :3, :3], pose[..., :3, :3])
        optimized.append(torch.cat([rotation, pose[..., :3, 3:] + change[..., :3, 3:]], dim=-1))
    return torch.cat(optimized)


def _exp_so3xr3(move: Float[Tensor, "1 6"]) -> Float[Tensor, "1 3 4"]:
    axis_angle = move[:, 3:]
    angle = torch.clamp((axis_angle * axis_angle).sum(1), 1e-4).sqrt()
    inverse = 1.0 / angle
    first, second = inverse * angle.sin(), inverse * inverse * (1.0 - angle.cos())
    skew = torch.zeros(1, 3, 3)
    skew[:, 0, 1], skew[:, 0, 2] = -axis_angle[:, 2], axis_angle[:, 1]
    skew[:, 1, 0], skew[:, 1, 2] = axis_angle[:, 2], -axis_angle[:, 0]
    skew[:, 2, 0], skew[:, 2, 1] = -axis_angle[:, 1], axis_angle[:, 0]
    transform = torch.zeros(1, 3, 4)
    transform[:, :3, :3] = (
        first[:, None, None] * skew + second[:, None, None] * torch.bmm(skew, skew) + torch.eye(3)[None]
    )
    transform[:, :3, 3] = move[:, :3]
    return transform


def _exp_se3(move: Float[Tensor, "1 6"]) -> Float[Tensor, "1 3 4"]:
    translation, axis_angle = move[:, :3].view(-1, 3, 1), move[:, 3:].view(-1, 3, 1)
    angle = torch.linalg.norm(axis_angle, dim=1).unsqueeze(1)
    square = angle**2
    small, ones = angle < 1e-2, torch.ones(1)
    angle_1, square_1, cube_1 = (torch.where(small, ones, value) for value in (angle, square, angle**3))
    sine = angle.sin()
    cosine = torch.where(small, 8 / (4 + square) - 1, angle.cos())
    sin_ratio = torch.where(small, 0.5 * cosine + 0.5, sine / angle_1)
    cos_ratio = torch.where(small, 0.5 * sin_ratio, (1 - cosine) / square_1)
    transform = torch.zeros(1, 3, 4)
    transform[:, :3, :3] = cos_ratio * axis_angle @ axis_angle.transpose(1, 2)
    for i in range(3):
        transform[:, i, i] += cosine.view(-1)
    scaled_axis = sin_ratio.view(-1, 1) * axis_angle.view(-1, 3)
    for i, j, k in ((0, 1, 2), (2, 0, 1), (1, 2, 0)):
        transform[:, i, j] -= scaled_axis[:, k]
        transform[:, j, i] += scaled_axis[:, k]
    sin_ratio = torch.where(small, 1 - square / 6, sin_ratio)
    cos_ratio = torch.where(small, 0.5 - square / 24, cos_ratio)
    cubic_ratio = torch.where(small, 1.0 / 6 - square / 120, (angle - sine) / cube_1)
    transform[:, :, 3:] = sin_ratio * translation
    transform[:, :, 3:] += cos_ratio * torch.cross(axis_angle, translation, dim=1)
    transform[:, :, 3:] += cubic_ratio * (axis_angle @ (axis_angle.transpose(1, 2) @ translation))
    return transform


# Dataset splits: images and cameras for training and evaluation.


@dataclass(frozen=True)
class DatasetSplit:
    """One split of a dataset: V image files and their cameras, before undistortion."""

    files: list[Path]
    masks: list[Path] | None
    camera_type: str
    """PERSPECTIVE, FISHEYE or another of nerfstudio's camera types."""
    poses: Float[Tensor, "v 3 4"]
    intrinsics: Float[Tensor, "v 4"]
    """fx, fy, cx, cy."""
    sizes: Int64[Tensor, "v 2"]
    """Width, height."""
    distortion: Float[Tensor, "v k"] | None

    def __len__(self) -> int:
        return len(self.files)

    def select(self, indices: Int[np.ndarray, " m"]) -> DatasetSplit:
        """Return the images and cameras at these indices."""
        rows = torch.tensor(indices, dtype=torch.long)
        return DatasetSplit(
            [self.files[i] for i in indices],
            None if self.masks is None else [self.masks[i] for i in indices],
            self.camera_type,
            self.poses[rows],
            self.intrinsics[rows],
            self.sizes[rows],
            None if self.distortion is None else self.distortion[rows],
        )

    def resized(self, factor: float, rounding: str = "floor") -> DatasetSplit:
        """Return the split with cameras for resized images, like nerfstudio's `rescale_output_resolution`."""
        scale = torch.tensor([factor])
        sides = self.sizes * scale
        if rounding == "round":
            sides = torch.floor(0.5 + sides)
        elif rounding == "ceil":
            sides = torch.ceil(sides)
        return DatasetSplit(
            self.files, self.masks, self.camera_type, self.poses, self.intrinsics * scale, sides.to(torch.int64),
            self.distortion,
        )  # fmt: skip


@dataclass(frozen=True)
class ParsedDataset:
    """Result of a data parser."""

    train: DatasetSplit
    held_out: DatasetSplit
    transform: Float[Tensor, "3 4"]
    scale: float
    """Map from the poses in the capture to the scene's world: scale * (transform @ point)."""


def split_by_mode(
    files: Sequence[Path], parser: NerfstudioDataParserConfig | ColmapDataParserConfig
) -> tuple[Any, Any]:
    """Return the indices of the training and the evaluation images by the parser's eval_mode.

    Raises:
        ValueError: if eval_mode is filename and a file name does not tell its split.
    """
    indices = np.arange(len(files))
    if parser.eval_mode == "fraction":
        count = math.ceil(len(files) * parser.train_split_fraction)
        trained = np.linspace(0, len(files) - 1, count, dtype=int)
        return trained, np.setdiff1d(indices, trained)
    if parser.eval_mode == "interval":
        is_eval = indices % parser.eval_interval == 0
        return indices[~is_eval], indices[is_eval]
    if parser.eval_mode == "all":
        return indices, indices
    for file in files:
        if "train" not in file.name and "eval" not in file.name:
            raise InputError(f"eval_mode is filename, but {file.name} has neither train nor eval in its name")
    is_train = np.array(["train" in file.name for file in files], dtype=bool)
    return indices[is_train], indices[~is_train]


def split_by_lists(lists: Mapping[str, Any], files: Sequence[Path]) -> tuple[Any, Any] | None:
    """Return the indices of the training and the evaluation images from the dataset's lists; None if it has none.

    Raises:
        ValueError: if only one of the train and test lists exists, or a listed file is missing.
    """
    if all(names is None for names in lists.values()):
        return None
    splits = []
    for split in ("train", "test"):
        names = lists[split]
        if names is None:
            raise InputError(f"the dataset's list of filenames for split {split} is missing")
        unknown = sorted(map(str, set(names) - set(files)))
        if unknown:
            raise InputError(f"some filenames for split {split} were not found, the first is {unknown[0]}")
        listed = set(names)
        splits.append(np.array([i for i, file in enumerate(files) if file in listed], dtype=np.int32))
    return splits[0], splits[1]
