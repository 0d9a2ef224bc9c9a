"""Validation of the datasets of trained runs, and cameras, poses and splits as in nerfstudio's data parsers.

All steps are the same as in nerfstudio, in float32, so the cameras are bit-exact.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Int, Int64
from torch import Tensor

from normlift_ns.data.colmap import ColmapCamera, ColmapImage, read_colmap_model
from normlift_ns.data.frames import PERSPECTIVE_MODELS, plain_name, possible_paths, read_image_header
from normlift_ns.data.nerfstudio import config_classes
from normlift_ns.data.transforms import (
    DISTORTION,
    FrameEntry,
    TransformsEntries,
    read_transforms_entries,
    relative_name,
)
from normlift_ns.errors import InputError, summarize_error
from normlift_ns.io.guard import check_files_distinct, read_text

_PARALLEL_TOLERANCE, _MIN_TILT = 1e-6, 0.17


def normalize_poses(
    rows: Any, parser: config_classes.PosedDataParserConfig, orientation: str
) -> tuple[Float[Tensor, "v 3 4"], Float[Tensor, "3 4"], float]:
    """Return poses in the world of the scene, the transform to this world before scaling, and the scale.

    Args:
        rows: 4 x 4 camera-to-world matrices in the world of the dataset.
        parser: Config of the data parser.
        orientation: Orientation method of nerfstudio.
    Raises:
        ValueError: A pose is not a 4 x 4 matrix, or nerfstudio does not have the orientation method.
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
    """Return the map from the original world of the capture that applies first `applied` and then `transform`.

    `applied` is the transform that was applied to the poses before they were stored, or None if there was none.
    """
    if applied is None:
        return transform
    rows = torch.cat([torch.tensor(applied, dtype=transform.dtype), torch.tensor([[0.0, 0.0, 0.0, 1.0]])], 0)
    return transform @ rows


def _orient_and_center(
    poses: Float[Tensor, "v 4 4"], method: str, center: str
) -> tuple[Float[Tensor, "v 3 4"], Float[Tensor, "3 4"]]:
    """Orient and center poses like nerfstudio's `auto_orient_and_center_poses`.

    Returns:
        The poses in the world of the scene before scaling, and the transform to this world.
    Raises:
        ValueError: nerfstudio does not have the orientation method.
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
        transform = torch.cat([torch.eye(3), -translation[:, None]], dim=-1)
    else:
        raise InputError(f"the orientation method is {method!r}, expected pca, up, vertical or none")
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
        oriented[1:3, :] = -1 * oriented[1:3, :]  # also flips the second and third pose in nerfstudio
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
    """Return the rotation matrix that maps direction `a` to direction `b`."""
    a = a / torch.linalg.norm(a)
    b = b / torch.linalg.norm(b)
    axis = torch.linalg.cross(a, b)
    if torch.sum(torch.abs(axis)) < _PARALLEL_TOLERANCE:
        other = torch.tensor([1.0, 0, 0]) if abs(a[0]) < _PARALLEL_TOLERANCE else torch.tensor([0, 1.0, 0])
        axis = torch.linalg.cross(a, other)
    skew = _skew(axis / torch.linalg.norm(axis))
    angle = torch.acos(torch.clip(torch.dot(a, b), -1, 1))
    return torch.eye(3) + torch.sin(angle) * skew + (1 - torch.cos(angle)) * (skew @ skew)


def _skew(axis: Float[Tensor, " 3"]) -> Float[Tensor, "3 3"]:
    """Return the matrix of the cross product with a vector."""
    x, y, z = axis
    return torch.tensor([[0, -z, y], [z, 0, -x], [-y, x, 0]])


def _focus_point(poses: Float[Tensor, "v 4 4"], focus: Float[Tensor, " 3"]) -> Float[Tensor, " 3"]:
    """Return the point closest to the optical axes of the cameras. Cameras that face away from it do not count."""
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
    """Apply the adjustments of nerfstudio's camera optimizer, in mode SO3xR3 or SE3, to camera-to-world poses."""
    exponential = _exp_so3xr3 if mode == "SO3xR3" else _exp_se3
    optimized = []
    for pose, move in zip(poses[:, None], moves.float()[:, None]):  # one by one, for the same rounding as nerfstudio
        change = exponential(move)
        rotation = torch.bmm(change[..., :3, :3], pose[..., :3, :3])
        optimized.append(torch.cat([rotation, pose[..., :3, 3:] + change[..., :3, 3:]], dim=-1))
    return torch.cat(optimized)


def _exp_so3xr3(move: Float[Tensor, "1 6"]) -> Float[Tensor, "1 3 4"]:
    axis_angle = move[:, 3:]
    angle = torch.clamp((axis_angle * axis_angle).sum(1), 1e-4).sqrt()
    inverse = 1.0 / angle
    first, second = inverse * angle.sin(), inverse * inverse * (1.0 - angle.cos())
    skew = _skew(axis_angle[0])[None]
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


_ROUNDING = {"floor": torch.floor, "ceil": torch.ceil, "round": lambda sides: torch.floor(0.5 + sides)}


@dataclass(frozen=True)
class DatasetSplit:
    """Split of a dataset, with V image files and their cameras before undistortion."""

    files: list[Path]
    masks: list[Path] | None
    camera_type: str
    """Camera type of nerfstudio, such as PERSPECTIVE or FISHEYE."""
    poses: Float[Tensor, "v 3 4"]
    intrinsics: Float[Tensor, "v 4"]
    """Focal lengths fx, fy and principal point cx, cy, in pixels."""
    sizes: Int64[Tensor, "v 2"]
    """Width and height in pixels."""
    distortion: Float[Tensor, "v k"] | None

    def __len__(self) -> int:
        return len(self.files)

    def select(self, indices: Int[np.ndarray, " m"]) -> DatasetSplit:
        """Return a split with only the images and cameras at the given indices."""
        rows = torch.tensor(indices, dtype=torch.long)
        return replace(
            self,
            files=[self.files[i] for i in indices],
            masks=None if self.masks is None else [self.masks[i] for i in indices],
            poses=self.poses[rows],
            intrinsics=self.intrinsics[rows],
            sizes=self.sizes[rows],
            distortion=None if self.distortion is None else self.distortion[rows],
        )

    def resized(self, factor: float, rounding: str = "floor") -> DatasetSplit:
        """Return the split with cameras for resized images, like nerfstudio's `rescale_output_resolution`.

        Args:
            factor: Factor on the width and the height.
            rounding: Rounding of the new sizes: floor, ceil or round.
        """
        scale = torch.tensor([factor])
        sides = _ROUNDING[rounding](self.sizes * scale)
        return replace(self, intrinsics=self.intrinsics * scale, sizes=sides.to(torch.int64))


@dataclass(frozen=True)
class ParsedDataset:
    """Result of a data parser."""

    train: DatasetSplit
    held_out: DatasetSplit
    transform: Float[Tensor, "3 4"]
    scale: float
    """Scale of the map from the capture to the world of the scene: scale * (transform @ point)."""


def split_files(
    files: Sequence[Path], lists: Mapping[str, Any], parser: config_classes.PosedDataParserConfig
) -> tuple[Any, Any]:
    """Return the indices of the training images and of the evaluation images.

    The lists of the dataset take precedence over eval_mode. The evaluation images are those of the test list, or of the
    validation list if there is no test list. If there is only a training list, there are no evaluation images.

    Raises:
        ValueError: There are lists, but no list of training images, or a listed file is not in `files`. Also if
            eval_mode is filename, and a file name contains neither train nor eval.
    """
    if any(names is not None for names in lists.values()):
        held_out = [lists[split] for split in ("test", "val") if lists[split] is not None]
        return _listed_files(files, lists["train"], "train"), _listed_files(files, (*held_out, ())[0], "test")
    indices = np.arange(len(files))
    if parser.eval_mode == "fraction":
        count = math.ceil(len(files) * parser.train_split_fraction)
        trained = np.linspace(0, len(files) - 1, count, dtype=int)
        return trained, np.setdiff1d(indices, trained)
    if parser.eval_mode == "all":
        return indices, indices
    is_eval = indices % parser.eval_interval == 0
    if parser.eval_mode == "filename":
        for file in files:
            if "train" not in file.name and "eval" not in file.name:
                raise InputError(f"eval_mode is filename, but the name {file.name} contains neither train nor eval")
        is_eval = np.array(["train" not in file.name for file in files], dtype=bool)
    return indices[~is_eval], indices[is_eval]


def _listed_files(files: Sequence[Path], names: Any, split: str) -> Int[np.ndarray, " m"]:
    """Return the indices of the files in `names`; raise InputError if it is None or has a name that `files` lacks."""
    if names is None:
        raise InputError(f"the list of files of split {split} is missing")
    listed = set(names)
    unknown = sorted(map(str, listed - set(files)))
    if unknown:
        raise InputError(f"the list of split {split} contains files that belong to no frame; the first is {unknown[0]}")
    return np.array([i for i, file in enumerate(files) if file in listed], dtype=np.int32)


MAX_AUTO_RESOLUTION = 1600
_ADVICE = "Restore the dataset, or give its path with --data."
_ADVICE_IF_GIVEN = "Restore the dataset as it was during the training."
_COLMAP_MODELS = (*PERSPECTIVE_MODELS, "OPENCV_FISHEYE", "SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE")
"""COLMAP's camera models that nerfstudio supports."""
_FLIP = [[1.0, 0.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0], [0.0, -1.0, 0.0, 0.0]]
_CAMERA_TYPES = {
    **dict.fromkeys(PERSPECTIVE_MODELS, "PERSPECTIVE"),
    "OPENCV_FISHEYE": "FISHEYE",
    **{
        name: name
        for name in (
            "EQUIRECTANGULAR", "OMNIDIRECTIONALSTEREO_L", "OMNIDIRECTIONALSTEREO_R", "VR180_L", "VR180_R",
            "ORTHOPHOTO", "FISHEYE624",
        )
    },
}  # fmt: skip
"""Camera types of nerfstudio, by the camera_model in a transforms.json."""
_INTRINSICS = ("fl_x", "fl_y", "cx", "cy", "w", "h")


def parse_dataset(datamanager: config_classes.FullImageDatamanagerConfig, *, data_given: bool = False) -> ParsedDataset:
    """Read the dataset of a run.

    This function raises an error if downscaled images are missing, whereas nerfstudio offers to create them. It also
    checks the numbers in camera files, which nerfstudio does not check.

    Args:
        datamanager: Config of the data manager.
        data_given: True if the dataset was given with --data, so that messages do not advise this option.
    Raises:
        FileNotFoundError: A camera file, an image folder or an image of unknown size is missing.
        ValueError: A camera file is damaged or contains invalid numbers, or nerfstudio cannot read the dataset.
    """
    parser, advice = datamanager.dataparser, _ADVICE_IF_GIVEN if data_given else _ADVICE
    try:
        dataset = _PARSERS[type(parser)](parser)
        if len(dataset.train) == 0:
            raise InputError("the dataset has no training images")
    except FileNotFoundError as error:
        raise FileNotFoundError(f"{error} {advice}") from error
    # Raised for invalid numbers; LinAlgError is a ValueError only in newer versions of NumPy
    except (ValueError, RuntimeError, np.linalg.LinAlgError) as error:  # pyrefly: ignore[unreachable-except-clause]
        if isinstance(error, InputError) and str(parser.data) in str(error):
            raise InputError(f"{str(error).removesuffix('.')}. {advice}") from error
        reason = str(error) if isinstance(error, InputError) else summarize_error(error)
        raise InputError(
            f"nerfstudio cannot read the dataset {parser.data} ({reason}). Expected the dataset of the "
            f"training. {advice}"
        ) from error
    scale = datamanager.camera_res_scale_factor
    return replace(dataset, train=dataset.train.resized(scale), held_out=dataset.held_out.resized(scale))


def _entries(path: Path, data: Path) -> TransformsEntries:
    if not path.exists():
        raise FileNotFoundError(f"{path} is missing from the dataset {data}.")
    return read_transforms_entries(path)


def _image_size(file: Path, data: Path) -> tuple[int, int]:
    """Return the width and height of an image in pixels."""
    if not file.exists():
        raise FileNotFoundError(f"{file} is missing from the dataset {data}.")
    return read_image_header(file).size


def _check_files(files: Sequence[Path], path: Path) -> None:
    """Raise InputError if an existing path is not a regular file, because a pipe would block the reader forever."""
    invalid = next((file for file in files if file.exists() and not file.is_file()), None)
    if invalid is not None:
        raise InputError(f"{path} lists {invalid}, which is not a regular file. Replace it with the image.")


def _row(entries: TransformsEntries, frame: FrameEntry) -> list[float]:
    """Return the focal lengths, principal point, size and distortion of an image as one row of numbers."""
    is_shared = any(getattr(entries, name) is not None for name in ("k1", "k2", "k3", "p1", "p2", "distortion_params"))
    source = entries if is_shared else frame
    distortion = source.distortion_params
    if distortion is None:
        distortion = [float(getattr(source, name) or 0.0) for name in DISTORTION]
    return [*(float(entries.value(frame, name)) for name in _INTRINSICS), *distortion]


def _check_transforms(meta: TransformsEntries, path: Path, parser: config_classes.NerfstudioDataParserConfig) -> None:
    for name in _INTRINSICS:
        incomplete = [frame.file_path for frame in meta.frames if meta.value(frame, name) is None]
        if incomplete:
            raise InputError(
                f"{path} has no {name} for {incomplete[0]}. Expected focal lengths, principal point and size of every "
                "frame."
            )
    positions = {tuple(row[3] for row in frame.transform_matrix[:3]) for frame in meta.frames}
    if len(positions) == 1 and parser.auto_scale_poses and parser.center_method == "poses":
        raise InputError(
            f"{path}: all cameras have the same position (number of cameras: {len(meta.frames)}), so nerfstudio cannot "
            "scale them. Expected the cameras that the run was trained with."
        )
    _check_files([path.parent / frame.file_path for frame in meta.frames], path)
    count, masked = len(meta.frames), sum(frame.mask_path is not None for frame in meta.frames)
    if masked not in (0, count):
        raise InputError(
            f"{path} lists masks for {masked} of {count} images, expected masks for all images or for none"
        )


def _transforms(parser: config_classes.NerfstudioDataParserConfig) -> ParsedDataset:
    path = parser.data if parser.data.suffix == ".json" else parser.data / "transforms.json"
    folder, meta = path.parent, _entries(path, parser.data)
    _check_transforms(meta, path, parser)
    factor = _transforms_factor(folder, meta, parser)

    def resolve(name: str, prefix: str = "images_") -> Path:
        file = _listed(folder, name)
        return folder / f"{prefix}{factor}" / file.name if factor > 1 else file

    order = np.argsort([resolve(frame.file_path) for frame in meta.frames])  # type: ignore[arg-type]
    frames = [meta.frames[i] for i in order]
    files = [resolve(frame.file_path) for frame in frames]
    masks = [resolve(frame.mask_path, "masks_") for frame in frames if frame.mask_path is not None]
    lists = {split: names if names is None else list(map(resolve, names)) for split, names in meta.lists.items()}
    split_indices = split_files(files, lists, parser)
    orientation = parser.orientation_method if meta.orientation_override is None else meta.orientation_override
    poses, transform, scale = normalize_poses([frame.transform_matrix for frame in frames], parser, orientation)
    files, masks = _locate_all(frames, files, masks, path, are_copies=factor > 1)
    split = DatasetSplit(
        files, masks or None, _camera_type(meta), poses[:, :3, :4], *_lenses([_row(meta, frame) for frame in frames])
    )
    train, held_out = (split.select(indices).resized(1.0 / factor) for indices in split_indices)
    transform = compose_applied_transform(transform, meta.applied_rows(parser.data))
    return ParsedDataset(train, held_out, transform, scale * float(meta.applied_scale))


def _transforms_factor(folder: Path, meta: TransformsEntries, parser: config_classes.NerfstudioDataParserConfig) -> int:
    first = _locate(_listed(folder, meta.frames[0].file_path), folder)
    return _downscale_factor(first, parser, lambda factor: (folder / f"images_{factor}" / first.name).exists())


def _locate_all(
    frames: Sequence[FrameEntry], files: Sequence[Path], masks: Sequence[Path], path: Path, *, are_copies: bool
) -> tuple[list[Path], list[Path]]:
    """Apply `_locate` to all images and masks; raise InputError if two frames share an image or a copy of a mask."""
    found = [[_locate(file, path.parent) for file in group] for group in (files, masks)]
    remedy = f"in the folders that {path} lists"
    check_files_distinct(zip((frame.file_path for frame in frames), found[0]), "file", remedy)
    if are_copies:
        check_files_distinct(zip((frame.mask_path or "" for frame in frames), found[1]), "mask", remedy)
    return found[0], found[1]


def _listed(folder: Path, name: str) -> Path:
    """Return the path of a file in a folder, given a relative name that may have the backslashes of Windows."""
    return folder / (name if (folder / name).exists() else plain_name(name))


def _locate(file: Path, folder: Path) -> Path:
    """Return a listed path, or if it does not exist, the path of the same file in the folder if there is one."""
    if file.exists():
        return file
    name = relative_name(file, folder)
    return next((other for other in possible_paths(folder, name) if other.is_file()), file)


def _camera_type(meta: TransformsEntries) -> str:
    model = "OPENCV" if meta.camera_model is None else meta.camera_model
    if model not in _CAMERA_TYPES:
        raise InputError(f"the camera_model is {model!r}, expected a nerfstudio camera model such as OPENCV")
    return _CAMERA_TYPES[model]


def _lenses(rows: Sequence[Sequence[float]]) -> tuple[Float[Tensor, "v 4"], Int64[Tensor, "v 2"], Float[Tensor, "v k"]]:
    """Split rows of camera parameters, one per image, into tensors of intrinsics, sizes and distortion."""
    return (
        torch.tensor([row[:4] for row in rows], dtype=torch.float32),
        torch.tensor([[int(side) for side in row[4:6]] for row in rows], dtype=torch.int64),
        torch.tensor([row[6:] for row in rows], dtype=torch.float32),
    )


def _downscale_factor(
    file: Path, parser: config_classes.PosedDataParserConfig, has_copies: Callable[[int], bool] = lambda factor: True
) -> int:
    """Return the downscale factor of nerfstudio, from the config or else from the size of an image.

    Args:
        file: Image that determines the factor if the config has none.
        parser: Config of the data parser.
        has_copies: Function that returns True if images downscaled by a factor exist.
    """
    if parser.downscale_factor is not None:
        return parser.downscale_factor
    longest, factor = max(_image_size(file, parser.data)), 1
    while longest / factor > MAX_AUTO_RESOLUTION and has_copies(2 * factor):
        factor *= 2
    return factor


def _blender(parser: config_classes.BlenderDataParserConfig) -> ParsedDataset:
    if parser.alpha_color is not None and parser.alpha_color.lower() not in config_classes.NAMED_COLORS:
        raise InputError(
            f"alpha_color is {parser.alpha_color!r}, expected one of {', '.join(config_classes.NAMED_COLORS)}"
        )
    train, held_out = (_blender_split(parser, split) for split in ("train", "test"))
    return ParsedDataset(train, held_out, torch.eye(4)[:3, :], parser.scale_factor)


def _blender_split(parser: config_classes.BlenderDataParserConfig, split: str) -> DatasetSplit:
    path = parser.data / f"transforms_{split}.json"
    meta = _entries(path, parser.data)
    angle = meta.camera_angle_x
    if angle is None or not 0 < angle < math.pi:
        raise InputError(f"{path}: camera_angle_x is {angle}, expected an angle between 0 and pi radians.")
    files = [parser.data / (frame.file_path.replace("./", "") + ".png") for frame in meta.frames]
    _check_files(files, path)
    width, height = _image_size(files[0], parser.data)
    focal = 0.5 * width / np.tan(0.5 * float(angle))
    poses = torch.from_numpy(np.array([frame.transform_matrix for frame in meta.frames]).astype(np.float32)[:, :3])
    poses[..., 3] *= parser.scale_factor
    intrinsics = torch.tensor([[focal, focal, width / 2.0, height / 2.0]], dtype=torch.float32)
    count = len(files)
    sizes = torch.tensor([[width, height]], dtype=torch.int64).expand(count, 2)
    return DatasetSplit(files, None, "PERSPECTIVE", poses, intrinsics.expand(count, 4), sizes, None)


def _parse_colmap(parser: config_classes.ColmapDataParserConfig) -> ParsedDataset:
    model, images_dir = parser.data / parser.colmap_path, parser.data / parser.images_path
    if not model.is_dir():
        raise FileNotFoundError(f"{model}, the COLMAP reconstruction, is missing from the dataset {parser.data}.")
    cameras, images = read_colmap_model(model, text_first=True)
    images.sort(key=lambda image: image.image_id)
    full_size = [_listed(images_dir, image.name) for image in images]
    _check_files(full_size, model)
    factor = _downscale_factor(full_size[0], parser)
    files = _downscaled(full_size, images_dir, factor)
    check_files_distinct(zip((image.name for image in images), files), "file", f"in the folders that {model} lists")
    missing = sorted({file.parent for file in files if factor > 1 and not file.parent.is_dir()})
    if missing:  # nerfstudio offers to create it
        raise FileNotFoundError(
            f"The folder {missing[0]} does not exist. Expected the images at 1/{factor} of their size, which the run "
            f"was trained with. Resize the images in {images_dir}; normlift_ns does not write into datasets."
        )
    masks = None
    if parser.masks_path is not None:
        folder = parser.data / parser.masks_path
        masks = _downscaled([(folder / image.name).with_suffix(".png") for image in images], folder, factor)
    kind, rows = _colmap_rows(cameras, images)
    flip = parser.assume_colmap_world_coordinate_convention
    poses, transform, scale = normalize_poses(
        [_pose(image, flip) for image in images], parser, parser.orientation_method
    )
    split_indices = split_files(full_size, _read_lists(parser), parser)
    split = DatasetSplit(files, masks, kind, poses[:, :3, :4], *_lenses(rows))
    train, held_out = (
        split.select(indices).resized(1.0 / factor, parser.downscale_rounding_mode) for indices in split_indices
    )
    return ParsedDataset(train, held_out, compose_applied_transform(transform, _FLIP if flip else None), scale)


def _colmap_rows(cameras: Mapping[int, ColmapCamera], images: Sequence[ColmapImage]) -> tuple[str, list[list[float]]]:
    """Return nerfstudio's camera type, which all images share, and a row of parameters for each image.

    A row has fx, fy, cx, cy, width, height, k1, k2, k3, k4, p1 and p2.
    """
    rows = {}
    for camera in cameras.values():
        if camera.model not in _COLMAP_MODELS:
            raise InputError(f"nerfstudio does not support the camera model {camera.model}")
        values = {"w": camera.width, "h": camera.height, **camera.named_parameters()}
        rows[camera.camera_id] = [values.get(name, 0.0) for name in ("fx", "fy", "cx", "cy", "w", "h", *DISTORTION)]
    kinds = {"FISHEYE" if "FISHEYE" in cameras[image.camera_id].model else "PERSPECTIVE" for image in images}
    if len(kinds) > 1:
        raise InputError("the images have perspective and fisheye cameras, expected only one of these types")
    if any(rows[image.camera_id][9] != 0 for image in images):
        raise InputError("the distortion parameter k4 of a camera must be zero")
    return kinds.pop(), [rows[image.camera_id] for image in images]


def _pose(image: ColmapImage, flip: bool) -> Float[np.ndarray, "4 4"]:
    """Return the camera-to-world pose of an image in OpenGL convention.

    With `flip`, the world is rotated as in nerfstudio, so that the -y axis of COLMAP becomes z.
    """
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


def _read_lists(parser: config_classes.ColmapDataParserConfig) -> dict[str, Any]:
    folder, lists = parser.data / parser.images_path, {}
    for split, name in (("train", "train"), ("test", "test"), ("val", "validation"), ("val", "val")):
        path = parser.data / f"{name}_list.txt"
        if lists.get(split) is not None or (name == "val" and lists["train"] is None):
            continue  # nerfstudio reads val_list.txt only if validation_list.txt is missing
        lists[split] = [_listed(folder, name) for name in read_text(path).splitlines()] if path.is_file() else None
    return lists


def _downscaled(files: list[Path], folder: Path, factor: int) -> list[Path]:
    """Return the paths of copies of the files, downscaled by a factor. For factor 1, return the paths of the files."""
    smaller = folder.parent / f"{folder.name}_{factor}"
    return files if factor == 1 else [smaller / file.relative_to(folder) for file in files]


_PARSERS: dict[type, Any] = {
    config_classes.NerfstudioDataParserConfig: _transforms,
    config_classes.ColmapDataParserConfig: _parse_colmap,
    config_classes.BlenderDataParserConfig: _blender,
}
"""Functions that read datasets, by the config class of the data parser."""
