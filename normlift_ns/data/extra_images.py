"""Extra images, taken after the training and registered together with the training images."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path, PurePosixPath

import numpy as np
import torch

from normlift_ns.core.gaussians import Camera
from normlift_ns.data.cameras import read_camera_file
from normlift_ns.data.frames import WorldTransform, transform_frames
from normlift_ns.data.open_scene import AnyScene, SplatScene, with_frames
from normlift_ns.data.transforms import CameraFile, relative_name
from normlift_ns.data.worlds import with_opengl_axes
from normlift_ns.errors import InputError
from normlift_ns.options import SplatOptions

_MAX_SHIFT, _MAX_ROTATION = 1e-3, 0.1
"""Maximum shift of a known camera, as a fraction of the largest distance of known cameras from their mean position, and
maximum rotation in degrees."""


def add_extra_images(scene: AnyScene, cameras: Path, images: Path | None = None) -> AnyScene:
    """Return the scene with extra images added to its training views.

    The camera file must contain new images and known images, which are training or held-out images of the scene. Images
    are matched by name. The cameras of the known images align the world of the file with the world of the scene.

    Args:
        scene: Scene to extend.
        cameras: Folder of a COLMAP project, transforms.json, or folder of a transforms.json.
        images: Folder of the images; if None, the default of `SplatOptions.images`.
    Raises:
        FileNotFoundError, ValueError: As in `read_camera_file` and `with_frames`. Also if no image is new, fewer than
            two images are known, or known cameras have moved relative to each other.
    """
    path = cameras.absolute()
    is_transforms = path.suffix == ".json" or (path / "transforms.json").is_file()
    options = (
        SplatOptions(transforms=path, images=images) if is_transforms else SplatOptions(colmap=path, images=images)
    )
    extended = read_camera_file(options, f"remove them from {path}")
    if scene.identity.get("source_world", {}).get("opencv_cameras", False):  # so the extended file has them, too
        extended = extended._replace(frames=with_opengl_axes(extended.frames))
    splits = (scene.train, scene.held_out)
    known = {_key(name): camera for views in splits for name, camera in zip(views.names, views.cameras)}
    new = [frame for frame in extended.frames if _key(frame.name) not in known]
    if len(new) == 0:
        raise InputError(
            f"All images in {extended.source} already belong to {scene.name}. Give a camera file that contains both "
            "new and old images, or omit --add-images."
        )
    world = _align(extended, known)
    base = scene.names_root if isinstance(scene, SplatScene) else scene.location.folder
    placed = [replace(frame, name=relative_name(frame.file, base)) for frame in transform_frames(new, world)]
    placed.sort(key=lambda frame: frame.file)  # a lifted run reads them in this order
    identity = {**scene.identity, "added_photographs": [frame.name for frame in placed]}
    extended_scene = with_frames(scene, placed)
    return replace(extended_scene, identity=identity, remarks=(*extended_scene.remarks, *extended.remarks))


def _key(name: str) -> str:
    """Return an image name without a top folder such as images/ or images_4/, which some camera files omit.

    >>> _key("images_4/left/0001.jpg"), _key("0001.jpg")
    ('left/0001.jpg', '0001.jpg')
    """
    first, *rest = PurePosixPath(name).parts
    return "/".join(rest) if len(rest) > 0 and first.startswith("images") else name


def _align(extended: CameraFile, known: dict[str, Camera]) -> WorldTransform:
    """Return the similarity from the world of the file to the world of the scene, fitted to their common cameras.

    Raises:
        ValueError: There are no two common cameras at different positions, or some have moved relative to each other.
    """
    old = [frame for frame in extended.frames if _key(frame.name) in known]
    source = np.stack([frame.pose for frame in old]) if len(old) > 0 else np.zeros((0, 3, 4))
    inverses = [torch.linalg.inv(known[_key(frame.name)].world_to_camera.double())[:3].numpy() for frame in old]
    target = np.array(inverses).reshape(-1, 3, 4) * [1, -1, -1, 1]  # x right, y up, z backward
    centered_source, centered_target = (
        poses[:, :, 3] - poses[:, :, 3].sum(axis=0) / max(1, len(old)) for poses in (source, target)
    )
    extent = float(np.linalg.norm(centered_target, axis=1).max(initial=0.0))
    if len(old) < 2 or extent == 0 or not np.linalg.norm(centered_source) > 0:
        raise InputError(
            f"{extended.source} contains {len(old)} of the {len(known)} images of the scene (such as "
            f"{next(iter(known))}). Expected at least two at different positions, to align the new cameras. Give a "
            "camera file that contains both new and old images."
        )
    u, _, vt = np.linalg.svd(np.einsum("vij,vkj->ik", target[:, :, :3], source[:, :, :3]))
    rotation = u @ np.diag([1, 1, np.sign(np.linalg.det(u @ vt))]) @ vt
    scale = float((centered_target * (centered_source @ rotation.T)).sum() / (centered_source**2).sum())
    translation = target[:, :, 3].mean(axis=0) - scale * rotation @ source[:, :, 3].mean(axis=0)
    shifts = np.linalg.norm(scale * source[:, :, 3] @ rotation.T + translation - target[:, :, 3], axis=1) / extent
    cosines = (np.einsum("ij,vjk,vik->v", rotation, source[:, :, :3], target[:, :, :3]) - 1) / 2
    angles = np.degrees(np.arccos(cosines.clip(-1, 1)))
    worst = int(np.argmax(np.maximum(shifts / _MAX_SHIFT, angles / _MAX_ROTATION)))
    if not (shifts[worst] <= _MAX_SHIFT and angles[worst] <= _MAX_ROTATION and 0 < scale < math.inf):
        raise InputError(
            f"In {extended.source}, the camera of {old[worst].name} has moved since the training, by "
            f"{shifts[worst]:.2%} of the extent of the cameras and {angles[worst]:.2g} degrees. {len(old)} old images "
            "were compared. Register the new images without moving the old ones: in COLMAP, use image_registrator on "
            "the old model, without bundle adjustment. Training that optimizes the cameras moves them as well."
        )
    return WorldTransform(np.concatenate([rotation, translation[:, None] / scale], axis=1), scale)
