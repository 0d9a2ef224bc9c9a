"""Cameras of a splat without a nerfstudio run: camera files, world transforms and learned pose adjustments."""

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
    """Read the camera file in the options, and check that its images exist.

    Args:
        options: Paths of cameras, images and masks.
        advice: Advice on missing images, for error messages; None for advice that suits the options.
    Raises:
        FileNotFoundError: A file, folder, image or mask is missing.
        ValueError: The options do not contain exactly one camera file, or it cannot be read.
    """
    count = (options.colmap is not None) + (options.transforms is not None)
    if count != 1:
        raise InputError(
            f"A splat needs one camera file, got {'two' if count else 'none'}. Give the folder of a COLMAP project "
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


_TURNED = "The splat matches its images after a rotation of gsplat's normalized world by half a turn, which is used."
_NORMALIZED = "The splat matches its images in gsplat's normalized world, which is used instead of the cameras' world."


def candidate_worlds(file: SplatFile, options: SplatOptions, cameras: CameraFile) -> list[tuple[str, WorldTransform]]:
    """Return possible transforms from the world of the cameras to the world of the splat.

    If there are several, the caller compares renders with the images, and shows the message of the transform that it
    chooses. PLY files may come from gsplat's trainer, so its normalized world is an alternative for PLY files too.
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
    """Compute the normalizations that gsplat's trainer may have applied to its COLMAP project."""
    if options.colmap is None:
        raise InputError(
            "gsplat's trainer normalized the world of the splat with the points of its COLMAP project, which a "
            "transforms.json does not contain. Give the project with --colmap, or a known transform with "
            "--world-transform. If the training used --no-normalize-world-space, give --gsplat-normalize False."
        )
    try:
        points = read_colmap_points(cameras.source)
    except FileNotFoundError as error:
        raise FileNotFoundError(f"{error} gsplat's trainer used points3D to normalize the world.") from error
    if len(points) < _MIN_POINTS:
        raise InputError(
            f"{cameras.source} has {len(points)} points, too few to compute the normalization of gsplat's trainer. "
            "Give the project that the splat was trained with. If the training used --no-normalize-world-space, give "
            "--gsplat-normalize False."
        )
    return gsplat_normalization(cameras.frames, points)


def adjust_poses(
    frames: Sequence[Frame], held_out: frozenset[str], deltas: Float[Tensor, "v 9"], path: Path
) -> list[Frame]:
    """Apply the pose adjustments that gsplat's --pose_opt learned for the training views.

    Args:
        frames: Frames of all images.
        held_out: Names of the images that the training did not use; their poses stay unchanged.
        deltas: Adjustments of the training views, as in `SplatFile.pose_adjust`.
        path: File of the splat, for error messages.
    Raises:
        ValueError: The numbers of adjustments and training views differ, or an adjustment is not a rotation.
    """
    trained = [frame for frame in frames if frame.name not in held_out]
    if len(trained) != len(deltas):
        without_eighth = len(frames) - len(range(0, len(frames), 8))
        hint = " The trainer holds out every 8th image: give --test-every 8." if len(deltas) == without_eighth else ""
        raise InputError(
            f"{path} has pose adjustments for {len(deltas)} training views (--pose_opt), but {len(trained)} of "
            f"{len(frames)} images are training views. Give the other images with --test-every or --eval-images.{hint}"
        )
    by_name = {}
    for frame, delta in zip(trained, deltas.numpy()):
        first, second = delta[3:6] + np.eye(3)[0], delta[6:9] + np.eye(3)[1]
        if np.linalg.norm(np.cross(first, second)) < _PARALLEL:
            raise InputError(
                f"{path}: the `pose_adjust` of {frame.name} is not a valid rotation. Expected two axes that are not "
                "parallel. Copy the file again."
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
