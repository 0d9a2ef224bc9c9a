"""Cameras and files of a COLMAP dataset, bit-identical to those of nerfstudio's `ColmapDataParser`."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float

from normlift_ns.errors import InputError
from normlift_ns.scenes.colmap import Camera, Registered, read_model
from normlift_ns.scenes.nerfstudio.data_classes import ColmapDataParserConfig
from normlift_ns.scenes.nerfstudio.datasets import automatic_factor
from normlift_ns.scenes.nerfstudio.poses import placed, with_applied
from normlift_ns.scenes.nerfstudio.splits import Dataset, Photographs, split_by_lists, split_by_mode

_INTRINSICS_AND_DISTORTION: dict[str, Callable[..., tuple[float, ...]]] = {
    "SIMPLE_PINHOLE": lambda f, cx, cy: (f, f, cx, cy),
    "PINHOLE": lambda fx, fy, cx, cy: (fx, fy, cx, cy),
    "SIMPLE_RADIAL": lambda f, cx, cy, k: (f, f, cx, cy, k),
    "RADIAL": lambda f, cx, cy, k1, k2: (f, f, cx, cy, k1, k2),
    "OPENCV": lambda fx, fy, cx, cy, k1, k2, p1, p2: (fx, fy, cx, cy, k1, k2, 0.0, 0.0, p1, p2),
    "OPENCV_FISHEYE": lambda *values: values,
    "SIMPLE_RADIAL_FISHEYE": lambda f, cx, cy, k: (f, f, cx, cy, k),
    "RADIAL_FISHEYE": lambda f, cx, cy, k1, k2: (f, f, cx, cy, k1, k2),
}
"""COLMAP's camera models: functions from their parameters to fx, fy, cx, cy and k1, k2, k3, k4, p1, p2."""
_FLIP = [[1.0, 0.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0], [0.0, -1.0, 0.0, 0.0]]


def parse_reconstruction(parser: ColmapDataParserConfig) -> Dataset:
    """Read the dataset of a COLMAP reconstruction.

    Raises:
        FileNotFoundError, ValueError: if a file is missing, or nerfstudio could not read it.
    """
    cameras, images = read_model(parser.data / parser.colmap_path, text_first=True)
    images = sorted(images, key=lambda image: image.image_id)
    intrinsics = {camera_id: _colmap_camera(camera) for camera_id, camera in cameras.items()}
    kinds = {"FISHEYE" if "FISHEYE" in cameras[image.camera].model else "PERSPECTIVE" for image in images}
    if len(kinds) > 1:
        raise InputError("multiple camera models are not supported")
    used = [intrinsics[image.camera] for image in images]
    if any(row[7] != 0 for row in used):
        raise InputError("the distortion k4 of a camera is not zero")
    images_dir = parser.data / parser.images_path
    files = [images_dir / image.name for image in images]
    masks = [(parser.data / parser.masks_path / image.name).with_suffix(".png") for image in images] if (
        parser.masks_path is not None
    ) else None  # fmt: skip
    flip = parser.assume_colmap_world_coordinate_convention
    poses, transform, scale = placed([_pose(image, flip) for image in images], parser, parser.orientation_method)
    split_indices = split_by_lists(_read_lists(parser), files) or split_by_mode(files, parser)
    factor = parser.downscale_factor
    if factor is None:
        factor = automatic_factor(files[0], parser)
    if factor > 1:
        files = _downscaled(files, images_dir, factor)
        masks = None if masks is None else _downscaled(masks, parser.data / (parser.masks_path or ""), factor)
    split = Photographs(
        files,
        masks,
        kinds.pop(),
        poses[:, :3, :4],
        torch.tensor([row[:4] for row in used], dtype=torch.float32),
        torch.tensor(
            [[cameras[image.camera].width, cameras[image.camera].height] for image in images], dtype=torch.int64
        ),
        torch.tensor([row[4:] for row in used], dtype=torch.float32),
    )
    train, held_out = (
        split.select(indices).resized(1.0 / factor, parser.downscale_rounding_mode) for indices in split_indices
    )
    return Dataset(train, held_out, with_applied(transform, _FLIP if flip else None), scale)


def _colmap_camera(camera: Camera) -> list[float]:
    """Return fx, fy, cx, cy and k1, k2, k3, k4, p1, p2."""
    if camera.model not in _INTRINSICS_AND_DISTORTION:
        raise InputError(f"{camera.model} camera model is not supported yet")
    values = _INTRINSICS_AND_DISTORTION[camera.model](*camera.parameters)
    return [*values, *[0.0] * (10 - len(values))]


def _pose(image: Registered, flip: bool) -> Float[np.ndarray, "4 4"]:
    """Return the camera-to-world pose in OpenGL convention; with `flip`, the first camera's up direction is along z."""
    w, x, y, z = image.rotation
    rotation = np.array(
        [
            [1 - 2 * y**2 - 2 * z**2, 2 * x * y - 2 * w * z, 2 * z * x + 2 * w * y],
            [2 * x * y + 2 * w * z, 1 - 2 * x**2 - 2 * z**2, 2 * y * z - 2 * w * x],
            [2 * z * x - 2 * w * y, 2 * y * z + 2 * w * x, 1 - 2 * x**2 - 2 * y**2],
        ]
    )
    matrix = np.concatenate([rotation, np.array(image.translation).reshape(3, 1)], 1)
    pose = np.linalg.inv(np.concatenate([matrix, np.array([[0, 0, 0, 1]])], 0))
    pose[0:3, 1:3] *= -1
    if flip:
        pose = pose[np.array([0, 2, 1, 3]), :]
        pose[2, :] *= -1
    return pose


def _read_lists(parser: ColmapDataParserConfig) -> dict[str, Any]:
    lists: dict[str, Any] = {}
    for split in ("train", "test", "validation"):
        path = parser.data / f"{split}_list.txt"
        lists[split] = None
        if path.is_file():
            lists[split] = [parser.data / parser.images_path / name for name in path.read_text("utf8").splitlines()]
    return lists


def _downscaled(files: Sequence[Path], folder: Path, factor: int) -> list[Path]:
    return [folder.parent / f"{folder.name}_{factor}" / file.relative_to(folder) for file in files]
