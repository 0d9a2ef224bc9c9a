"""Cameras of a splat without a nerfstudio run: their file, the splat's world, and learned pose adjustments."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from jaxtyping import Float
from torch import Tensor

from normlift_ns.data.colmap import read_colmap, read_colmap_points
from normlift_ns.data.frames import GIVE_IMAGES, Frame, WorldTransform, check_frames, rescale_intrinsics
from normlift_ns.data.splat import SplatFile
from normlift_ns.data.transforms import CameraFile, gsplat_normalization, read_transforms, read_world_transform
from normlift_ns.errors import InputError
from normlift_ns.options import SplatOptions

_MIN_POINTS, _PARALLEL = 4, 1e-6


def read_camera_file(options: SplatOptions, advice: str | None = None) -> CameraFile:
    """Read the camera file that the options name, and check that its images exist.

    Args:
        options: locations of cameras, images and masks.
        advice: what to do about missing images, for error messages; None: what the options leave to try.
    Raises:
        FileNotFoundError: if a file, folder, image or mask is missing.
        ValueError: if the options name no camera file or two, or the file cannot be read.
    """
    count = (options.colmap is not None) + (options.transforms is not None)
    if count != 1:
        raise InputError(
            f"A splat needs one camera file, got {'two' if count else 'none'}: give the folder of a COLMAP project "
            "with --colmap, or a transforms.json with --transforms."
        )
    for name, folder in (("--images", options.images), ("--masks", options.masks)):
        if folder is not None and not folder.is_dir():
            raise FileNotFoundError(f"There is no folder {folder}, given with {name}. Give an existing folder.")
    if advice is None:
        is_given = options.images is not None
        advice = "remove them from the camera file" if is_given else GIVE_IMAGES
    if options.colmap is None:
        cameras = read_transforms(
            Path(options.transforms or "").absolute(), options.images, options.masks, advice=advice
        )
    else:
        cameras = read_colmap(options.colmap.absolute(), options.images, options.masks, advice=advice)
    check_frames(cameras.frames, cameras.source)
    return cameras._replace(frames=[rescale_intrinsics(frame, cameras.source, advice) for frame in cameras.frames])


_TURNED = "The axes of gsplat's normalization point the other way; rotated by half a turn, the splat fits its images."
_NORMALIZED = "The splat does not fit its images in the world of its cameras, but it does in gsplat's normalized world."


def candidate_worlds(file: SplatFile, options: SplatOptions, cameras: CameraFile) -> list[tuple[str, WorldTransform]]:
    """Return possible maps from the cameras' world to the splat's, each with a message for its use.

    There are several if only the images can decide. A PLY file may come from gsplat's trainer too, so its normalized
    world is the alternative if that of the cameras does not fit.
    """
    if options.world_transform is not None:
        world = read_world_transform(options.world_transform, cameras.applied_transform, cameras.applied_scale)
        return [("", world)]
    same = [("", WorldTransform(np.eye(4)[:3], 1.0))]
    if not options.gsplat_normalize or not (file.by_gsplat or options.colmap):
        return same
    try:
        first, *turned = _normalizations(options, cameras)
    except (ValueError, FileNotFoundError):
        if not file.by_gsplat:
            return same
        raise
    worlds = [("", first)] if file.by_gsplat else [*same, (_NORMALIZED, first)]
    return [*worlds, *((_TURNED, world) for world in turned)]


def _normalizations(options: SplatOptions, cameras: CameraFile) -> list[WorldTransform]:
    """Recompute the normalizations that gsplat's trainer may have applied, from its COLMAP project."""
    if options.colmap is None:
        raise InputError(
            "gsplat's trainer normalized the world of the splat by the points of its COLMAP project, so a "
            "transforms.json is not enough. Give the project with --colmap, or a known transform with "
            "--world-transform, or --gsplat-normalize False if the training used --no-normalize-world-space."
        )
    try:
        points = read_colmap_points(cameras.source)
    except FileNotFoundError as error:
        raise FileNotFoundError(f"{error} gsplat's trainer normalized the world by points3D.") from error
    if len(points) < _MIN_POINTS:
        raise InputError(
            f"{cameras.source} has {len(points)} points, too few to recompute the normalization of gsplat's trainer. "
            "Give the project that the splat was trained with, or --gsplat-normalize False if the training used "
            "--no-normalize-world-space."
        )
    return gsplat_normalization(cameras.frames, points)


def adjust_poses(
    frames: Sequence[Frame], held_out: frozenset[str], deltas: Float[Tensor, "v 9"], path: Path
) -> list[Frame]:
    """Return the frames with the pose adjustments that gsplat's --pose_opt learned for the training views."""
    trained = [frame for frame in frames if frame.name not in held_out]
    if len(trained) != len(deltas):
        without_eighth = len(frames) - len(range(0, len(frames), 8))
        hint = " The trainer holds out every 8th image: give --test-every 8." if len(deltas) == without_eighth else ""
        raise InputError(
            f"{path} has pose adjustments for {len(deltas)} training views (--pose_opt), but {len(trained)} of "
            f"{len(frames)} images are training views. Name the others with --test-every or --eval-images.{hint}"
        )
    by_name = {}
    for frame, delta in zip(trained, deltas.numpy()):
        first, second = delta[3:6] + np.eye(3)[0], delta[6:9] + np.eye(3)[1]
        if np.linalg.norm(np.cross(first, second)) < _PARALLEL:
            raise InputError(
                f"{path}: its `pose_adjust` for {frame.name} is not a valid rotation. Expected two axes that are not "
                "parallel."
            )
        x = first / np.linalg.norm(first)
        y = second - (x @ second) * x
        y /= np.linalg.norm(y)
        rotation = np.stack([x, y, np.cross(x, y)])
        opencv = frame.pose * [1, -1, -1, 1]
        pose = np.concatenate(
            [opencv[:, :3] @ rotation * [1, -1, -1], opencv[:, :3] @ delta[:3, None] + opencv[:, 3:]], axis=1
        )
        by_name[frame.name] = replace(frame, pose=pose)
    return [by_name.get(frame.name, frame) for frame in frames]
