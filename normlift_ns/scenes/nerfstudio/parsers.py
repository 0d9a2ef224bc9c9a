"""Cameras and files of a dataset, bit-identical to those of nerfstudio's data parsers."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch

from normlift_ns.errors import InputError
from normlift_ns.scenes.nerfstudio.appearance import COLORS
from normlift_ns.scenes.nerfstudio.colmap_parser import parse_reconstruction
from normlift_ns.scenes.nerfstudio.data_classes import (
    BlenderDataParserConfig,
    ColmapDataParserConfig,
    DataParser,
    FullImageDatamanagerConfig,
    NerfstudioDataParserConfig,
)
from normlift_ns.scenes.nerfstudio.datasets import MAX_AUTO_RESOLUTION, size_of
from normlift_ns.scenes.nerfstudio.poses import placed, with_applied
from normlift_ns.scenes.nerfstudio.splits import Dataset, Photographs, split_by_lists, split_by_mode
from normlift_ns.scenes.transforms_file import CameraEntry, Entries, read_entries

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


def parse(datamanager: FullImageDatamanagerConfig) -> Dataset:
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
    return Dataset(dataset.train.resized(scale), dataset.held_out.resized(scale), dataset.transform, dataset.scale)


def _parse(parser: DataParser) -> Dataset:
    if isinstance(parser, NerfstudioDataParserConfig):
        return _transforms(parser)
    return parse_reconstruction(parser) if isinstance(parser, ColmapDataParserConfig) else _blender(parser)


def _value(entries: Entries, frame: CameraEntry, name: str) -> float:
    """Return the value for all frames, or the frame's own if there is none."""
    shared = getattr(entries, name)
    return float(getattr(frame, name) if shared is None else shared)


def _distortion(entries: Entries, frame: CameraEntry) -> list[float]:
    is_shared = any(getattr(entries, name) is not None for name in ("k1", "k2", "k3", "p1", "p2", "distortion_params"))
    source = entries if is_shared else frame
    if source.distortion_params is not None:
        return source.distortion_params
    return [float(getattr(source, name) or 0.0) for name in _DISTORTION]


def _transforms(parser: NerfstudioDataParserConfig) -> Dataset:
    path = parser.data if parser.data.suffix == ".json" else parser.data / "transforms.json"
    folder, meta = path.parent, read_entries(path)
    factor = parser.downscale_factor
    if factor is None:
        factor = _downscale_factor(folder, Path(meta.frames[0].file_path), parser)

    def resolve(name: str, prefix: str = "images_") -> Path:
        return folder / f"{prefix}{factor}" / Path(name).name if factor > 1 else folder / name

    order = np.argsort([resolve(frame.file_path) for frame in meta.frames])  # type: ignore[arg-type]
    frames = [meta.frames[i] for i in order]
    files = [resolve(frame.file_path) for frame in frames]
    masks = [resolve(frame.mask_path, "masks_") for frame in frames if frame.mask_path is not None]
    if len(masks) not in (0, len(files)):
        raise InputError(f"{path} lists masks for {len(masks)} of {len(files)} images; expected one for each, or none")
    lists = {
        split: None if names is None else [resolve(name) for name in names]
        for split, names in (
            ("train", meta.train_filenames), ("val", meta.val_filenames), ("test", meta.test_filenames)
        )
    }  # fmt: skip
    split_indices = split_by_lists(lists, files) or split_by_mode(files, parser)
    orientation = parser.orientation_method if meta.orientation_override is None else meta.orientation_override
    poses, transform, scale = placed([frame.transform_matrix for frame in frames], parser, orientation)
    model = "OPENCV" if meta.camera_model is None else meta.camera_model
    if model not in _CAMERA_TYPES:
        raise InputError(f"unknown camera_model {model!r}")
    values = [[_value(meta, frame, name) for name in _INTRINSICS] for frame in frames]
    split = Photographs(
        files,
        masks or None,
        _CAMERA_TYPES[model],
        poses[:, :3, :4],
        torch.tensor([row[:4] for row in values], dtype=torch.float32),
        torch.tensor([[int(side) for side in row[4:]] for row in values], dtype=torch.int64),
        torch.tensor([_distortion(meta, frame) for frame in frames], dtype=torch.float32),
    )
    applied = meta.applied_transform
    if applied is None and (parser.data / "colmap/sparse/0").exists():
        applied = _LEGACY_FLIP
    train, held_out = (split.select(indices).resized(1.0 / factor) for indices in split_indices)
    return Dataset(train, held_out, with_applied(transform, applied), scale * float(meta.applied_scale))


def _downscale_factor(folder: Path, name: Path, parser: DataParser) -> int:
    """Return the factor of the downscaled copies that nerfstudio reads if the images are too large and copies exist."""
    longest, power = max(size_of(folder / name, parser)), 0
    while longest / 2**power > MAX_AUTO_RESOLUTION and (folder / f"images_{2 ** (power + 1)}" / name.name).exists():
        power += 1
    return 2**power


def _blender(parser: BlenderDataParserConfig) -> Dataset:
    if parser.alpha_color is not None and parser.alpha_color.lower() not in COLORS:
        raise InputError(f"alpha_color is {parser.alpha_color!r}, expected {', '.join(COLORS)}")
    train, held_out = (_blender_split(parser, split) for split in ("train", "test"))
    return Dataset(train, held_out, torch.eye(4)[:3, :], parser.scale_factor)


def _blender_split(parser: BlenderDataParserConfig, split: str) -> Photographs:
    meta = read_entries(parser.data / f"transforms_{split}.json")
    files = [parser.data / Path(frame.file_path.replace("./", "") + ".png") for frame in meta.frames]
    width, height = size_of(files[0], parser)
    focal = 0.5 * width / np.tan(0.5 * float(meta.camera_angle_x or 0.0))
    poses = torch.from_numpy(np.array([frame.transform_matrix for frame in meta.frames]).astype(np.float32)[:, :3])
    poses[..., 3] *= parser.scale_factor
    intrinsics = torch.tensor([[focal, focal, width / 2.0, height / 2.0]], dtype=torch.float32)
    count = len(files)
    sizes = torch.tensor([[width, height]], dtype=torch.int64).expand(count, 2)
    return Photographs(files, None, "PERSPECTIVE", poses, intrinsics.expand(count, 4), sizes, None)
