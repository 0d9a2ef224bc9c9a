"""Datasets of trained runs: validation, and cameras as the data parsers of nerfstudio compute them.

If images of the right size are missing, nerfstudio asks on the terminal and creates them through a shell; it trusts all
numbers in the files. These checks raise errors with advice instead.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Int64
from torch import Tensor

from normlift_ns.data.colmap import ColmapCamera, ColmapImage, read_colmap_model
from normlift_ns.data.frames import read_image_header
from normlift_ns.data.nerfstudio.cameras import (
    DatasetSplit,
    ParsedDataset,
    compose_applied_transform,
    normalize_poses,
    split_by_lists,
    split_by_mode,
)
from normlift_ns.data.nerfstudio.config_classes import (
    NAMED_COLORS,
    BlenderDataParserConfig,
    ColmapDataParserConfig,
    FullImageDatamanagerConfig,
    NerfstudioDataParserConfig,
    SupportedDataParserConfig,
)
from normlift_ns.data.transforms import CameraEntry, FrameEntry, TransformsEntries, read_transforms_entries
from normlift_ns.errors import InputError

MAX_AUTO_RESOLUTION = 1600
_ADVICE = "Restore it, or give the path of the dataset with --data."
_REQUIRED = ("fl_x", "fl_y", "cx", "cy", "w", "h")


def check_dataset(parser: SupportedDataParserConfig) -> None:
    """Raise if nerfstudio would ask about a dataset, could not read it, or would misread it.

    Raises:
        FileNotFoundError: if a camera file or an image folder is missing.
        ValueError: if a camera file is damaged or holds invalid numbers.
    """
    if isinstance(parser, NerfstudioDataParserConfig):
        _check_nerfstudio(parser)
    elif isinstance(parser, ColmapDataParserConfig):
        _check_colmap(parser)
    else:
        _check_blender(parser)


def image_size(file: Path, parser: SupportedDataParserConfig) -> tuple[int, int]:
    """Return the width and height of an image.

    Raises:
        FileNotFoundError: if the file is missing.
        ValueError: if the file is not an image.
    """
    if not file.exists():
        raise FileNotFoundError(f"{file} is missing from the dataset {parser.data}. {_ADVICE}")
    return read_image_header(file).size


def _colmap_downscale_factor(file: Path, parser: ColmapDataParserConfig) -> int:
    """Return the factor by which nerfstudio downscales images, which depends on one of them if the config has none."""
    if parser.downscale_factor is not None:
        return parser.downscale_factor
    longest, factor = max(image_size(file, parser)), 1
    while longest / factor > MAX_AUTO_RESOLUTION:
        factor *= 2
    return factor


def _entries(path: Path, data: Path) -> TransformsEntries:
    if not path.exists():
        raise FileNotFoundError(f"{path} is missing from the dataset {data}. {_ADVICE}")
    return read_transforms_entries(path)


def _check_nerfstudio(parser: NerfstudioDataParserConfig) -> None:
    path = _transforms_path(parser)
    entries = _entries(path, parser.data)
    for name in _REQUIRED:
        incomplete = [frame.file_path for frame in entries.frames if getattr(frame, name) is None]
        if getattr(entries, name) is None and incomplete:
            raise InputError(
                f"{path} has no {name} for {incomplete[0]}. Expected focal lengths, principal point and size for every "
                "frame."
            )
    _check_positions([frame.transform_matrix for frame in entries.frames], parser, path)
    _check_files([path.parent / frame.file_path for frame in entries.frames], path)


def _transforms_path(parser: NerfstudioDataParserConfig) -> Path:
    return parser.data if parser.data.suffix == ".json" else parser.data / "transforms.json"


def _check_blender(parser: BlenderDataParserConfig) -> None:
    for split in ("train", "test"):
        path = parser.data / f"transforms_{split}.json"
        entries = _entries(path, parser.data)
        if entries.camera_angle_x is None or not 0 < entries.camera_angle_x < math.pi:
            raise InputError(
                f"{path}: camera_angle_x is {entries.camera_angle_x}, expected radians between 0 and pi. {_ADVICE}"
            )
        files = [parser.data / (frame.file_path.replace("./", "") + ".png") for frame in entries.frames]
        _check_files(files, path)
        image_size(files[0], parser)  # nerfstudio reads all of this image


def _check_colmap(parser: ColmapDataParserConfig) -> None:
    """Check the dataset, and the folder of downscaled images, which nerfstudio would offer to create."""
    model, images = parser.data / parser.colmap_path, parser.data / parser.images_path
    if not model.is_dir():
        raise FileNotFoundError(
            f"{model}, the COLMAP reconstruction, is missing from the dataset {parser.data}. {_ADVICE}"
        )
    _, registered = read_colmap_model(model, text_first=True)
    registered.sort(key=lambda image: image.image_id)
    files = [images / image.name for image in registered]
    _check_files(files, model)
    factor = _colmap_downscale_factor(files[0], parser)
    if factor == 1:
        return
    smaller = images.parent / f"{images.name}_{factor}"
    missing = sorted(
        {file.parent for file in (smaller / image.name for image in registered) if not file.parent.is_dir()}
    )
    if missing:
        raise FileNotFoundError(
            f"There is no folder {missing[0]} of images at 1/{factor} of their size, with which the run was trained. "
            f"Copy it from the machine of the training, or create it by resizing the images in {images}. normlift_ns "
            "does not write into datasets."
        )


def _check_positions(poses: Sequence[list[list[float]]], parser: NerfstudioDataParserConfig, path: Path) -> None:
    positions = {tuple(row[3] for row in pose[:3]) for pose in poses}
    if len(positions) == 1 and parser.auto_scale_poses and parser.center_method == "poses":
        raise InputError(
            f"{path}: all {len(poses)} cameras have the same position, so nerfstudio cannot scale them. Expected the "
            "cameras that the run was trained with; give the path of the dataset with --data."
        )


def _check_files(files: Sequence[Path], path: Path) -> None:
    """Raise if an existing path is not a regular file; reading a pipe would block forever."""
    invalid = next((file for file in files if file.exists() and not file.is_file()), None)
    if invalid is not None:
        raise InputError(f"{path} lists {invalid}, which is not a regular file. Expected images.")


# Cameras and files of a COLMAP dataset, bit-identical to those of nerfstudio's `ColmapDataParser`.


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


def parse_colmap(parser: ColmapDataParserConfig) -> ParsedDataset:
    """Read the dataset of a COLMAP reconstruction.

    Raises:
        FileNotFoundError, ValueError: if a file is missing, or nerfstudio could not read it.
    """
    cameras, images = read_colmap_model(parser.data / parser.colmap_path, text_first=True)
    images = sorted(images, key=lambda image: image.image_id)
    kind, values = _colmap_cameras(cameras, images)
    images_dir = parser.data / parser.images_path
    files = [images_dir / image.name for image in images]
    masks = None
    if parser.masks_path is not None:
        masks = [(parser.data / parser.masks_path / image.name).with_suffix(".png") for image in images]
    flip = parser.assume_colmap_world_coordinate_convention
    poses, transform, scale = normalize_poses(
        [_pose(image, flip) for image in images], parser, parser.orientation_method
    )
    split_indices = split_by_lists(_read_lists(parser), files) or split_by_mode(files, parser)
    factor = _colmap_downscale_factor(files[0], parser)
    if factor > 1:
        files = _downscaled(files, images_dir, factor)
        masks = None if masks is None else _downscaled(masks, parser.data / (parser.masks_path or ""), factor)
    split = DatasetSplit(
        files,
        masks,
        kind,
        poses[:, :3, :4],
        torch.tensor([row[:4] for row in values], dtype=torch.float32),
        torch.tensor(
            [[cameras[image.camera_id].width, cameras[image.camera_id].height] for image in images], dtype=torch.int64
        ),
        torch.tensor([row[4:] for row in values], dtype=torch.float32),
    )
    train, held_out = (
        split.select(indices).resized(1.0 / factor, parser.downscale_rounding_mode) for indices in split_indices
    )
    return ParsedDataset(train, held_out, compose_applied_transform(transform, _FLIP if flip else None), scale)


def _colmap_cameras(
    cameras: Mapping[int, ColmapCamera], images: Sequence[ColmapImage]
) -> tuple[str, list[list[float]]]:
    """Return nerfstudio's type of all cameras, and fx, fy, cx, cy and k1, k2, k3, k4, p1, p2 of each image."""
    intrinsics = {camera_id: _colmap_camera(camera) for camera_id, camera in cameras.items()}
    kinds = {"FISHEYE" if "FISHEYE" in cameras[image.camera_id].model else "PERSPECTIVE" for image in images}
    if len(kinds) > 1:
        raise InputError("multiple camera models are not supported")
    values = [intrinsics[image.camera_id] for image in images]
    if any(row[7] != 0 for row in values):
        raise InputError("the distortion k4 of a camera is not zero")
    return kinds.pop(), values


def _colmap_camera(camera: ColmapCamera) -> list[float]:
    """Return fx, fy, cx, cy and k1, k2, k3, k4, p1, p2."""
    if camera.model not in _INTRINSICS_AND_DISTORTION:
        raise InputError(f"{camera.model} camera model is not supported yet")
    values = _INTRINSICS_AND_DISTORTION[camera.model](*camera.params)
    return [*values, *[0.0] * (10 - len(values))]


def _pose(image: ColmapImage, flip: bool) -> Float[np.ndarray, "4 4"]:
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


# Cameras and files of a dataset, bit-identical to those of nerfstudio's data parsers.


_CAMERA_TYPES = {name: "PERSPECTIVE" for name in ("SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV")} | {
    "OPENCV_FISHEYE": "FISHEYE",
    **{
        name: name
        for name in (
            "EQUIRECTANGULAR", "OMNIDIRECTIONALSTEREO_L", "OMNIDIRECTIONALSTEREO_R", "VR180_L", "VR180_R",
            "ORTHOPHOTO", "FISHEYE624",
        )
    },
}  # fmt: skip
"""nerfstudio's camera types by the camera_model of a file."""
_INTRINSICS = ("fl_x", "fl_y", "cx", "cy", "w", "h")
_DISTORTION = ("k1", "k2", "k3", "k4", "p1", "p2")
_LEGACY_FLIP = [[0.0, 1.0, 0.0, 0.0], [1.0, 0.0, 0.0, 0.0], [0.0, 0.0, -1.0, 0.0]]


def parse_dataset(datamanager: FullImageDatamanagerConfig) -> ParsedDataset:
    """Read the dataset of a run, after `check_dataset` has checked it.

    Raises:
        FileNotFoundError, ValueError: if a file is missing, or nerfstudio could not read it.
    """
    parser = datamanager.dataparser
    try:
        dataset = _parse(parser)
        if len(dataset.train) == 0:
            raise InputError("no image is left for the training")
    except FileNotFoundError:
        raise
    except (ValueError, RuntimeError, np.linalg.LinAlgError) as error:  # raised by torch and NumPy on unusable numbers
        if isinstance(error, InputError) and str(parser.data) in str(error):
            raise
        raise InputError(
            f"nerfstudio cannot read the dataset {parser.data} ({type(error).__name__}: {error}). Expected the dataset "
            "that the run was trained with; give its path with --data."
        ) from error
    scale = datamanager.camera_res_scale_factor
    return ParsedDataset(
        dataset.train.resized(scale), dataset.held_out.resized(scale), dataset.transform, dataset.scale
    )


def _parse(parser: SupportedDataParserConfig) -> ParsedDataset:
    if isinstance(parser, NerfstudioDataParserConfig):
        return _transforms(parser)
    return parse_colmap(parser) if isinstance(parser, ColmapDataParserConfig) else _blender(parser)


def _value(entries: TransformsEntries, frame: CameraEntry, name: str) -> float:
    """Return the value for all frames, or the frame's own if there is none."""
    shared = getattr(entries, name)
    return float(getattr(frame, name) if shared is None else shared)


def _distortion(entries: TransformsEntries, frame: CameraEntry) -> list[float]:
    is_shared = any(getattr(entries, name) is not None for name in ("k1", "k2", "k3", "p1", "p2", "distortion_params"))
    source = entries if is_shared else frame
    if source.distortion_params is not None:
        return source.distortion_params
    return [float(getattr(source, name) or 0.0) for name in _DISTORTION]


def _transforms(parser: NerfstudioDataParserConfig) -> ParsedDataset:
    path = _transforms_path(parser)
    folder, meta = path.parent, read_transforms_entries(path)
    factor = _downscale_factor(folder, Path(meta.frames[0].file_path), parser)

    def resolve(name: str, prefix: str = "images_") -> Path:
        return folder / f"{prefix}{factor}" / Path(name).name if factor > 1 else folder / name

    order = np.argsort([resolve(frame.file_path) for frame in meta.frames])  # type: ignore[arg-type]
    frames = [meta.frames[i] for i in order]
    files = [resolve(frame.file_path) for frame in frames]
    masks = [resolve(frame.mask_path, "masks_") for frame in frames if frame.mask_path is not None]
    if len(masks) not in (0, len(files)):
        raise InputError(f"{path} lists masks for {len(masks)} of {len(files)} images; expected one for each, or none")
    lists = {"train": meta.train_filenames, "val": meta.val_filenames, "test": meta.test_filenames}
    resolved = {split: None if names is None else list(map(resolve, names)) for split, names in lists.items()}
    split_indices = split_by_lists(resolved, files) or split_by_mode(files, parser)
    orientation = parser.orientation_method if meta.orientation_override is None else meta.orientation_override
    poses, transform, scale = normalize_poses([frame.transform_matrix for frame in frames], parser, orientation)
    split = DatasetSplit(files, masks or None, _camera_type(meta), poses[:, :3, :4], *_lenses(meta, frames))
    train, held_out = (split.select(indices).resized(1.0 / factor) for indices in split_indices)
    transform = compose_applied_transform(transform, _applied_transform(meta, parser.data))
    return ParsedDataset(train, held_out, transform, scale * float(meta.applied_scale))


def _applied_transform(meta: TransformsEntries, data: Path) -> list[list[float]] | None:
    """Return the transform of the poses before they were stored, which files of an old ns-process-data do not name."""
    is_legacy = meta.applied_transform is None and (data / "colmap/sparse/0").exists()
    return _LEGACY_FLIP if is_legacy else meta.applied_transform


def _camera_type(meta: TransformsEntries) -> str:
    model = "OPENCV" if meta.camera_model is None else meta.camera_model
    if model not in _CAMERA_TYPES:
        raise InputError(f"unknown camera_model {model!r}")
    return _CAMERA_TYPES[model]


def _lenses(
    meta: TransformsEntries, frames: Sequence[FrameEntry]
) -> tuple[Float[Tensor, "v 4"], Int64[Tensor, "v 2"], Float[Tensor, "v k"]]:
    """Return the intrinsics, sizes and distortion of the frames."""
    values = [[_value(meta, frame, name) for name in _INTRINSICS] for frame in frames]
    return (
        torch.tensor([row[:4] for row in values], dtype=torch.float32),
        torch.tensor([[int(side) for side in row[4:]] for row in values], dtype=torch.int64),
        torch.tensor([_distortion(meta, frame) for frame in frames], dtype=torch.float32),
    )


def _downscale_factor(folder: Path, name: Path, parser: NerfstudioDataParserConfig) -> int:
    """Return the factor of the downscaled copies that nerfstudio reads if the images are too large and copies exist."""
    if parser.downscale_factor is not None:
        return parser.downscale_factor
    longest, power = max(image_size(folder / name, parser)), 0
    while longest / 2**power > MAX_AUTO_RESOLUTION and (folder / f"images_{2 ** (power + 1)}" / name.name).exists():
        power += 1
    return 2**power


def _blender(parser: BlenderDataParserConfig) -> ParsedDataset:
    if parser.alpha_color is not None and parser.alpha_color.lower() not in NAMED_COLORS:
        raise InputError(f"alpha_color is {parser.alpha_color!r}, expected {', '.join(NAMED_COLORS)}")
    train, held_out = (_blender_split(parser, split) for split in ("train", "test"))
    return ParsedDataset(train, held_out, torch.eye(4)[:3, :], parser.scale_factor)


def _blender_split(parser: BlenderDataParserConfig, split: str) -> DatasetSplit:
    meta = read_transforms_entries(parser.data / f"transforms_{split}.json")
    files = [parser.data / Path(frame.file_path.replace("./", "") + ".png") for frame in meta.frames]
    width, height = image_size(files[0], parser)
    focal = 0.5 * width / np.tan(0.5 * float(meta.camera_angle_x or 0.0))
    poses = torch.from_numpy(np.array([frame.transform_matrix for frame in meta.frames]).astype(np.float32)[:, :3])
    poses[..., 3] *= parser.scale_factor
    intrinsics = torch.tensor([[focal, focal, width / 2.0, height / 2.0]], dtype=torch.float32)
    count = len(files)
    sizes = torch.tensor([[width, height]], dtype=torch.int64).expand(count, 2)
    return DatasetSplit(files, None, "PERSPECTIVE", poses, intrinsics.expand(count, 4), sizes, None)
