"""Cameras of a splat without a nerfstudio run: camera files and learned pose adjustments."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from jaxtyping import Float
from torch import Tensor

from normlift_ns.data.colmap import read_colmap
from normlift_ns.data.frames import GIVE_IMAGES, Frame, check_frames, rescale_intrinsics
from normlift_ns.data.transforms import CameraFile, read_transforms
from normlift_ns.errors import InputError
from normlift_ns.options import SplatOptions

_PARALLEL = 1e-6


def read_camera_file(options: SplatOptions, advice: str | None = None) -> CameraFile:
    """Read the camera file that the options name, and scale its intrinsics to the sizes of the images.

    Args:
        options: Paths of cameras, images and masks.
        advice: Advice on missing images, for error messages; None for advice that depends on the options.
    Raises:
        FileNotFoundError: A file, folder, image or mask is missing.
        ValueError: The options do not name exactly one camera file, or this file, an image or a mask is not valid.
    """
    count = (options.colmap is not None) + (options.transforms is not None)
    if count != 1:
        raise InputError(
            f"A splat needs one camera file, got {'two' if count else 'none'}. Give the folder of a COLMAP project "
            "with --colmap, or a transforms.json with --transforms."
        )
    for name, folder in (("--images", options.images), ("--masks", options.masks)):
        if folder is not None and not folder.is_dir():
            raise FileNotFoundError(f"{folder}, given with {name}, is not an existing folder. Give another path.")
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


def adjust_poses(
    frames: Sequence[Frame], held_out: frozenset[str], deltas: Float[Tensor, "v 9"], path: Path
) -> list[Frame]:
    """Apply the pose adjustments that gsplat's --pose_opt learned for the training views.

    Args:
        frames: Frames of all images.
        held_out: Names of the images that the training did not use; their poses stay unchanged.
        deltas: Adjustments of the training views in the order of `frames`, as in `SplatFile.pose_adjust`.
        path: File of the splat, for error messages.
    Raises:
        ValueError: The numbers of adjustments and training views differ, or the rotation of an adjustment is not valid.
    """
    trained = [frame for frame in frames if frame.name not in held_out]
    if len(trained) != len(deltas):
        without_eighth = len(frames) - len(range(0, len(frames), 8))
        hint = " The trainer holds out every 8th image: give --test-every 8." if len(deltas) == without_eighth else ""
        raise InputError(
            f"{path} has pose adjustments for {len(deltas)} training views (--pose_opt), but {len(trained)} of "
            f"{len(frames)} images are training views. Give the camera file of the training, and its held-out images "
            f"with --test-every or --eval-images.{hint}"
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
