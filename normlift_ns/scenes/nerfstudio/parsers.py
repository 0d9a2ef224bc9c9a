"""Cameras and files of a data set as nerfstudio's data parsers make them, bit by bit."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Int, Int64
from torch import Tensor

from normlift_ns.errors import InputError
from normlift_ns.scenes.colmap import Camera, Registered, read_model
from normlift_ns.scenes.nerfstudio.appearance import COLORS
from normlift_ns.scenes.nerfstudio.classes import (
    BlenderDataParserConfig,
    ColmapDataParserConfig,
    DataParser,
    FullImageDatamanagerConfig,
    NerfstudioDataParserConfig,
)
from normlift_ns.scenes.nerfstudio.datasets import MAX_AUTO_RESOLUTION, automatic_factor, size_of
from normlift_ns.scenes.nerfstudio.poses import orient_and_center
from normlift_ns.scenes.transforms_file import CameraEntry, Entries, read_entries

_TYPES = {name: "PERSPECTIVE" for name in ("SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV")} | {
    "OPENCV_FISHEYE": "FISHEYE",
    **{
        name: name
        for name in (
            "EQUIRECTANGULAR", "OMNIDIRECTIONALSTEREO_L", "OMNIDIRECTIONALSTEREO_R", "VR180_L", "VR180_R",
            "ORTHOPHOTO", "FISHEYE624",
        )
    },
}  # fmt: skip
"""Kinds of cameras by the camera_model of a file."""
_NUMBERS = ("fl_x", "fl_y", "cx", "cy", "w", "h")
_BROWN = ("k1", "k2", "k3", "k4", "p1", "p2")
_COLMAP: dict[str, Callable[..., tuple[float, ...]]] = {
    "SIMPLE_PINHOLE": lambda f, cx, cy: (f, f, cx, cy),
    "PINHOLE": lambda fx, fy, cx, cy: (fx, fy, cx, cy),
    "SIMPLE_RADIAL": lambda f, cx, cy, k: (f, f, cx, cy, k),
    "RADIAL": lambda f, cx, cy, k1, k2: (f, f, cx, cy, k1, k2),
    "OPENCV": lambda fx, fy, cx, cy, k1, k2, p1, p2: (fx, fy, cx, cy, k1, k2, 0.0, 0.0, p1, p2),
    "OPENCV_FISHEYE": lambda *values: values,
    "SIMPLE_RADIAL_FISHEYE": lambda f, cx, cy, k: (f, f, cx, cy, k),
    "RADIAL_FISHEYE": lambda f, cx, cy, k1, k2: (f, f, cx, cy, k1, k2),
}
"""fx, fy, cx, cy and distortion k1, k2, k3, k4, p1, p2 by the parameters of COLMAP's camera models."""
_FLIPPED = [[1.0, 0.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0], [0.0, -1.0, 0.0, 0.0]]
_OLD_FLIP = [[0.0, 1.0, 0.0, 0.0], [1.0, 0.0, 0.0, 0.0], [0.0, 0.0, -1.0, 0.0]]


@dataclass(frozen=True)
class Photographs:
    """One split of a data set: V files and their cameras, before undistortion."""

    files: list[Path]
    masks: list[Path] | None
    kind: str
    """PERSPECTIVE, FISHEYE or another of nerfstudio's camera types."""
    poses: Float[Tensor, "v 3 4"]
    projections: Float[Tensor, "v 4"]
    """fx, fy, cx, cy."""
    sizes: Int64[Tensor, "v 2"]
    """Width, height."""
    distortion: Float[Tensor, "v k"] | None

    def __len__(self) -> int:
        return len(self.files)

    def only(self, indices: Int[np.ndarray, " m"]) -> Photographs:
        """Some of them."""
        rows = torch.tensor(indices, dtype=torch.long)
        return Photographs(
            [self.files[i] for i in indices],
            None if self.masks is None else [self.masks[i] for i in indices],
            self.kind,
            self.poses[rows],
            self.projections[rows],
            self.sizes[rows],
            None if self.distortion is None else self.distortion[rows],
        )

    def resized(self, factor: float, rounding: str = "floor") -> Photographs:
        """With the cameras of smaller copies: nerfstudio's `rescale_output_resolution`."""
        scale = torch.tensor([factor])
        sides = self.sizes * scale
        if rounding == "round":
            sides = torch.floor(0.5 + sides)
        elif rounding == "ceil":
            sides = torch.ceil(sides)
        return Photographs(
            self.files, self.masks, self.kind, self.poses, self.projections * scale, sides.to(torch.int64),
            self.distortion,
        )  # fmt: skip


@dataclass(frozen=True)
class Dataset:
    """What a data parser says."""

    train: Photographs
    held_out: Photographs
    transform: Float[Tensor, "3 4"]
    scale: float
    """From the poses in the capture to the scene's world: scale * (transform @ point)."""


def parse(datamanager: FullImageDatamanagerConfig) -> Dataset:
    """The data set of a run, which `check_dataset` has looked at.

    Raises:
        FileNotFoundError, ValueError: a file that is missing or that nerfstudio could not read.
    """
    parser = datamanager.dataparser
    try:
        found = _parse(parser)
        if len(found.train) == 0:
            raise InputError("no photograph is left for the training")
    except FileNotFoundError:
        raise
    except (ValueError, RuntimeError, np.linalg.LinAlgError) as error:  # of numbers that torch and numpy cannot use
        if isinstance(error, InputError) and str(parser.data) in str(error):
            raise
        raise InputError(
            f"nerfstudio cannot read the dataset {parser.data} ({type(error).__name__}: {error}). Expected the dataset "
            "that the run was trained with; say where it is with --data."
        ) from error
    scale = datamanager.camera_res_scale_factor
    return Dataset(found.train.resized(scale), found.held_out.resized(scale), found.transform, found.scale)


def _parse(parser: DataParser) -> Dataset:
    if isinstance(parser, NerfstudioDataParserConfig):
        return _transforms(parser)
    return _reconstruction(parser) if isinstance(parser, ColmapDataParserConfig) else _blender(parser)


def _placed(
    rows: Any, parser: NerfstudioDataParserConfig | ColmapDataParserConfig, orientation: str
) -> tuple[Float[Tensor, "v 3 4"], Float[Tensor, "3 4"], float]:
    """Poses in the scene's world, the transform to it, and its scale."""
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


def _applied(transform: Float[Tensor, "3 4"], applied: Sequence[Sequence[float]] | None) -> Float[Tensor, "3 4"]:
    if applied is None:
        return transform
    rows = torch.cat([torch.tensor(applied, dtype=transform.dtype), torch.tensor([[0.0, 0.0, 0.0, 1.0]])], 0)
    return transform @ rows


def _split(files: Sequence[Path], parser: NerfstudioDataParserConfig | ColmapDataParserConfig) -> tuple[Any, Any]:
    """Which photographs were trained on, and which were kept for evaluation."""
    everything = np.arange(len(files))
    if parser.eval_mode == "fraction":
        count = math.ceil(len(files) * parser.train_split_fraction)
        trained = np.linspace(0, len(files) - 1, count, dtype=int)
        return trained, np.setdiff1d(everything, trained)
    if parser.eval_mode == "interval":
        kept = everything % parser.eval_interval == 0
        return everything[~kept], everything[kept]
    if parser.eval_mode == "all":
        return everything, everything
    for file in files:
        if "train" not in file.name and "eval" not in file.name:
            raise InputError(f"eval_mode is filename, but {file.name} has neither train nor eval in its name")
    trains = np.array(["train" in file.name for file in files], dtype=bool)
    return everything[trains], everything[~trains]


def _listed(lists: dict[str, Any], files: Sequence[Path]) -> tuple[Any, Any] | None:
    """The same, where the data set says it itself for train and test."""
    if all(names is None for names in lists.values()):
        return None
    found = []
    for split in ("train", "test"):
        names = lists[split]
        if names is None:
            raise InputError(f"the dataset's list of filenames for split {split} is missing")
        strange = sorted(map(str, set(names) - set(files)))
        if strange:
            raise InputError(f"some filenames for split {split} were not found, the first is {strange[0]}")
        wanted = set(names)
        found.append(np.array([i for i, file in enumerate(files) if file in wanted], dtype=np.int32))
    return found[0], found[1]


def _value(common: Entries, entry: CameraEntry, name: str) -> float:
    """Of the file, else of the frame."""
    found = getattr(common, name)
    return float(getattr(entry, name) if found is None else found)


def _distortion(common: Entries, entry: CameraEntry) -> list[float]:
    fixed = any(getattr(common, name) is not None for name in ("k1", "k2", "k3", "p1", "p2", "distortion_params"))
    holder = common if fixed else entry
    if holder.distortion_params is not None:
        return holder.distortion_params
    return [float(getattr(holder, name) or 0.0) for name in _BROWN]


def _transforms(parser: NerfstudioDataParserConfig) -> Dataset:
    path = parser.data if parser.data.suffix == ".json" else parser.data / "transforms.json"
    folder, meta = path.parent, read_entries(path)
    factor = parser.downscale_factor
    if factor is None:
        factor = _largest_fitting(folder, Path(meta.frames[0].file_path), parser)

    def place(name: str, prefix: str = "images_") -> Path:
        return folder / f"{prefix}{factor}" / Path(name).name if factor > 1 else folder / name

    order = np.argsort([place(frame.file_path) for frame in meta.frames])  # type: ignore[arg-type]
    frames = [meta.frames[i] for i in order]
    files = [place(frame.file_path) for frame in frames]
    masks = [place(frame.mask_path, "masks_") for frame in frames if frame.mask_path is not None]
    if len(masks) not in (0, len(files)):
        raise InputError(f"{path} names masks for {len(masks)} of {len(files)} images; expected one for each, or none")
    lists = {
        split: None if names is None else [place(name) for name in names]
        for split, names in (
            ("train", meta.train_filenames), ("val", meta.val_filenames), ("test", meta.test_filenames)
        )
    }  # fmt: skip
    chosen = _listed(lists, files) or _split(files, parser)
    orientation = parser.orientation_method if meta.orientation_override is None else meta.orientation_override
    poses, transform, scale = _placed([frame.transform_matrix for frame in frames], parser, orientation)
    model = "OPENCV" if meta.camera_model is None else meta.camera_model
    if model not in _TYPES:
        raise InputError(f"there is no camera_model {model!r}")
    values = [[_value(meta, frame, name) for name in _NUMBERS] for frame in frames]
    photographs = Photographs(
        files,
        masks or None,
        _TYPES[model],
        poses[:, :3, :4],
        torch.tensor([row[:4] for row in values], dtype=torch.float32),
        torch.tensor([[int(side) for side in row[4:]] for row in values], dtype=torch.int64),
        torch.tensor([_distortion(meta, frame) for frame in frames], dtype=torch.float32),
    )
    applied = meta.applied_transform
    if applied is None and (parser.data / "colmap/sparse/0").exists():
        applied = _OLD_FLIP
    train, held_out = (photographs.only(part).resized(1.0 / factor) for part in chosen)
    return Dataset(train, held_out, _applied(transform, applied), scale * float(meta.applied_scale))


def _largest_fitting(folder: Path, name: Path, parser: DataParser) -> int:
    """By which factor nerfstudio takes smaller copies: as long as there are any, and the image is too large."""
    longest, power = max(size_of(folder / name, parser)), 0
    while longest / 2**power > MAX_AUTO_RESOLUTION and (folder / f"images_{2 ** (power + 1)}" / name.name).exists():
        power += 1
    return 2**power


def _reconstruction(parser: ColmapDataParserConfig) -> Dataset:
    cameras, images = read_model(parser.data / parser.colmap_path, text_first=True)
    images = sorted(images, key=lambda image: image.number)
    intrinsics = {number: _colmap_camera(camera) for number, camera in cameras.items()}
    kinds = {"FISHEYE" if "FISHEYE" in cameras[image.camera].model else "PERSPECTIVE" for image in images}
    if len(kinds) > 1:
        raise InputError("multiple camera models are not supported")
    used = [intrinsics[image.camera] for image in images]
    if any(row[7] != 0 for row in used):
        raise InputError("the distortion k4 of a camera is not zero")
    named = parser.data / parser.images_path
    files = [named / image.name for image in images]
    masks = [(parser.data / parser.masks_path / image.name).with_suffix(".png") for image in images] if (
        parser.masks_path is not None
    ) else None  # fmt: skip
    flip = parser.assume_colmap_world_coordinate_convention
    poses, transform, scale = _placed([_pose(image, flip) for image in images], parser, parser.orientation_method)
    chosen = _listed(_lists(parser), files) or _split(files, parser)
    factor = parser.downscale_factor
    if factor is None:
        factor = automatic_factor(files[0], parser)
    if factor > 1:
        files = _smaller(files, named, factor)
        masks = None if masks is None else _smaller(masks, parser.data / (parser.masks_path or ""), factor)
    photographs = Photographs(
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
    train, held_out = (photographs.only(part).resized(1.0 / factor, parser.downscale_rounding_mode) for part in chosen)
    return Dataset(train, held_out, _applied(transform, _FLIPPED if flip else None), scale)


def _colmap_camera(camera: Camera) -> list[float]:
    """fx, fy, cx, cy and k1, k2, k3, k4, p1, p2."""
    if camera.model not in _COLMAP:
        raise InputError(f"{camera.model} camera model is not supported yet")
    values = _COLMAP[camera.model](*camera.parameters)
    return [*values, *[0.0] * (10 - len(values))]


def _pose(image: Registered, flip: bool) -> Float[np.ndarray, "4 4"]:
    """Camera to world in OpenGL convention; flipped: with the first camera's idea of up along z."""
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


def _lists(parser: ColmapDataParserConfig) -> dict[str, Any]:
    lists: dict[str, Any] = {}
    for split in ("train", "test", "validation"):
        path = parser.data / f"{split}_list.txt"
        lists[split] = None
        if path.is_file():
            lists[split] = [parser.data / parser.images_path / name for name in path.read_text("utf8").splitlines()]
    return lists


def _smaller(files: Sequence[Path], folder: Path, factor: int) -> list[Path]:
    return [folder.parent / f"{folder.name}_{factor}" / file.relative_to(folder) for file in files]


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
    numbers = torch.tensor([[focal, focal, width / 2.0, height / 2.0]], dtype=torch.float32)
    count = len(files)
    sizes = torch.tensor([[width, height]], dtype=torch.int64).expand(count, 2)
    return Photographs(files, None, "PERSPECTIVE", poses, numbers.expand(count, 4), sizes, None)
