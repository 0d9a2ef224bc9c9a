"""A trained splatfacto run as a `Scene`, with its images as splatfacto trained on them."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float, UInt8
from PIL import Image
from torch import Tensor

from normlift_ns.core.gaussians import Camera, GaussianScene
from normlift_ns.core.scene import View, Views
from normlift_ns.data import images
from normlift_ns.data.checkpoint import Checkpoint, find_checkpoint, read_checkpoint
from normlift_ns.data.frames import Frame, Intrinsics, check_mask, image_warnings, read_image_header
from normlift_ns.data.images import blend_background, to_camera
from normlift_ns.data.nerfstudio.cameras import DatasetSplit, apply_pose_adjustments
from normlift_ns.data.nerfstudio.config import RunLocation, locate_run, read_trainer_config, with_absolute_paths
from normlift_ns.data.nerfstudio.config_classes import (
    NAMED_COLORS,
    BlenderDataParserConfig,
    FullImageDatamanagerConfig,
    NerfstudioDataParserConfig,
    SplatfactoModelConfig,
    TrainerConfig,
)
from normlift_ns.data.nerfstudio.dataparsers import check_dataset, parse_dataset
from normlift_ns.data.transforms import read_dataparser_transforms, relative_name
from normlift_ns.errors import InputError
from normlift_ns.options import RasterizeMode
from normlift_ns.rasterization.rasterize import view_colors

_SUPPORTED_MODES = {"RGB", "RGBA", "L", "CMYK"}
"""Pillow modes that nerfstudio can train on, CMYK with wrong colors."""
_DISTORTION_PARAMS = 6
"""Number of parameters k1, k2, k3, k4, p1, p2."""


class ImageReadOptions(NamedTuple):
    """Settings by which nerfstudio reads the images of a run."""

    scale: float = 1.0
    """camera_res_scale_factor."""
    alpha_color: tuple[float, float, float] | None = None
    """RGB in 0..1 that nerfstudio blends behind images with an alpha channel when it reads them; None: it blends the
    background later."""
    mask_color: tuple[float, float, float] | None = None
    """Color that nerfstudio writes into pixels whose mask is zero."""


class _Lens(NamedTuple):
    """Projection of one image, in nerfstudio's precision."""

    kind: str
    intrinsics: Intrinsics
    distortion: tuple[float, ...]


class SplitViews(ABC):
    """Lazy `Views` of one split of a dataset, in its order: indexing reads and undistorts one image.

    Images, masks and intrinsics are those of nerfstudio's `FullImageDatamanager.cached_train`, which holds all of them
    in memory (and pins that memory, which needs CUDA).

    Args:
        files: the images.
        masks: one mask per image, or None.
        sizes: width and height of the cameras, before undistortion.
        folder: folder of the dataset, to which `names` are relative.
        poses: camera-to-world poses [V, 3, 4] in OpenGL convention: the split's, or those optimized by the training.
        background: RGB in 0..1, blended behind images with an alpha channel.
        scale: camera_res_scale_factor, by which the files are resized.
    """

    def __init__(
        self,
        files: Sequence[Path],
        masks: Sequence[Path] | None,
        sizes: Sequence[Sequence[int]],
        folder: Path,
        poses: Float[Tensor, "v 3 4"],
        background: Float[Tensor, " 3"],
        scale: float,
    ) -> None:
        self.files = list(files)
        """Absolute paths of the images."""
        self.names = [relative_name(file, folder) for file in self.files]
        """Image files relative to the dataset, with forward slashes."""
        self._masks, self._sizes, self._poses = masks, sizes, poses
        self._background, self._scale = background, scale

    @abstractmethod
    def _load(self, index: int) -> tuple[Any, Any]:
        """Read an image [H, W, C] and its mask or None, at the size of the camera."""

    @abstractmethod
    def _undistort(self, index: int, image: Any, mask: Any) -> tuple[Tensor, Bool[Tensor, "h w"] | None, bool]:
        """Return image and mask without distortion, and whether they had any."""

    @abstractmethod
    def _pinhole(self, index: int) -> tuple[Float[Tensor, "3 3"], int, int]:
        """Return intrinsics, width and height of an undistorted image."""

    def __len__(self) -> int:
        return len(self.files)

    def __iter__(self) -> Iterator[View]:
        return (self[i] for i in range(len(self)))

    def __getitem__(self, index: int) -> View:
        """Read and undistort one image.

        Raises:
            IndexError: if there is no such view.
            FileNotFoundError, ValueError: if a file is missing, cannot be read or differs in size from its camera; the
                message names it.
        """
        if not -len(self) <= index < len(self):
            raise IndexError(f"view {index} of {len(self)}")
        index %= len(self)
        distorted, distorted_mask = self._read(index)
        image, mask, was_distorted = self._undistort(index, distorted, distorted_mask)
        original_size = (distorted.shape[1], distorted.shape[0]) if was_distorted else None
        image = blend_background(image, self._background)
        return View(self.cameras[index], image, mask, self.names[index], original_size)

    @property
    def cameras(self) -> list[Camera]:
        """Cameras of the undistorted images; no image is read."""
        return self._cameras

    @cached_property
    def _cameras(self) -> list[Camera]:
        return [self._camera(i) for i in range(len(self))]

    def _camera(self, index: int) -> Camera:
        try:
            return to_camera(self._poses[index], *self._pinhole(index))
        except InputError as error:
            raise InputError(f"The camera of {self.files[index]} cannot be used: {error}") from error

    def check_files(self) -> tuple[str, ...]:
        """Check the headers of all images and masks, and return warnings in whole sentences.

        Raises:
            FileNotFoundError, ValueError: if an image or mask is missing, not an image, misread by nerfstudio, or not
                of the size of its camera or image; the message names it.
        """
        headers = [read_image_header(file) for file in self.files]
        for index, (file, header) in enumerate(zip(self.files, headers)):
            if header.mode not in _SUPPORTED_MODES:
                raise InputError(
                    f"{file} has the pixel format {header.mode}, whose values nerfstudio misreads. Expected 8-bit RGB, "
                    "RGBA or grayscale; convert the images, and train again."
                )
            self._check_size(index, header.size if self._scale == 1 else _scaled(header.size, self._scale))
            if self._masks is not None:
                check_mask(self._masks[index], file, header.size)
        return image_warnings(self.files, headers)

    def _check_size(self, index: int, size: Sequence[int]) -> None:
        expected = self._sizes[index]
        if list(size) != list(expected):
            raise InputError(
                f"{self.files[index]} is {size[0]} x {size[1]} pixels, but its camera has {expected[0]} x "
                f"{expected[1]} (width x height). Use the images that the run was trained with."
            )

    def _read(self, index: int) -> tuple[Any, Any]:
        """Load an image and its mask, and check their files and size."""
        try:
            image, mask = self._load(index)
        except FileNotFoundError as error:
            raise FileNotFoundError(
                f"{error.filename} is missing, but the dataset lists it. Put it back, or give the path of the dataset "
                "with --data."
            ) from error
        except Exception as error:  # Pillow's readers and nerfstudio's checks raise any kind of exception
            raise InputError(
                f"{self.files[index]}{'' if self._masks is None else ' or its mask'} cannot be read ({error}). "
                "Expected an 8-bit image; copy it again from the capture."
            ) from error
        self._check_size(index, image.shape[1::-1])
        return image, mask


class TrainedViews(SplitViews):
    """Views of a split that are read and undistorted without nerfstudio.

    Args:
        split: image files and cameras, before undistortion.
        folder, poses, background: as in `SplitViews`.
        reading: settings of the config that affect pixels.
    """

    def __init__(
        self,
        split: DatasetSplit,
        folder: Path,
        poses: Float[Tensor, "v 3 4"],
        background: Float[Tensor, " 3"],
        reading: ImageReadOptions,
    ) -> None:
        super().__init__(split.files, split.masks, split.sizes.tolist(), folder, poses, background, reading.scale)
        self._split, self._reading = split, reading

    def _pinhole(self, index: int) -> tuple[Float[Tensor, "3 3"], int, int]:
        lens = self._lens(index)
        if lens.kind not in ("PERSPECTIVE", "FISHEYE"):
            raise InputError(camera_type_error(self.files[index], lens.kind))
        return _pinhole(lens)

    def _lens(self, index: int) -> _Lens:
        width, height = self._sizes[index]
        distortion = () if self._split.distortion is None else tuple(self._split.distortion[index].tolist())
        fx, fy, cx, cy = self._split.intrinsics[index].tolist()
        return _Lens(self._split.camera_type, Intrinsics(fx, fy, cx, cy, width, height), distortion)

    def _undistort(self, index: int, image: Any, mask: Any) -> tuple[Tensor, Bool[Tensor, "h w"] | None, bool]:
        lens = self._lens(index)
        pixels = torch.from_numpy(_undistorted(image, lens)[0])
        values = None if mask is None else torch.from_numpy(_undistorted_mask(mask, lens)).bool()
        return pixels, values, any(lens.distortion)

    def _load(self, index: int) -> tuple[UInt8[np.ndarray, "h w c"], Bool[np.ndarray, "h w"] | None]:
        """Read pixels and mask like nerfstudio's `InputDataset`."""
        image, color = self._pixels(self.files[index]), self._reading.mask_color
        if self._masks is None:
            return image, None
        mask = _mask(self._masks[index], self._scale)
        if mask.shape != image.shape[:2]:
            raise InputError(f"the mask has shape {mask.shape}, the image {image.shape[:2]}")
        if color is not None and any(color):
            filled = torch.ones(image.shape, dtype=torch.uint8) * torch.tensor(color)
            image = torch.where(torch.from_numpy(mask)[:, :, None], torch.from_numpy(image), filled).numpy()
        return image, mask

    def _pixels(self, file: Path) -> UInt8[np.ndarray, "h w c"]:
        with Image.open(file) as opened:
            scale = self._scale
            resized = opened if scale == 1 else opened.resize(_scaled(opened.size, scale), Image.Resampling.BILINEAR)
            image = np.array(resized, dtype=np.uint8)
        if image.ndim == 2:
            image = image[:, :, None].repeat(3, axis=2)
        if image.ndim != 3 or image.shape[2] not in (3, 4):
            raise InputError(f"its shape is {image.shape}")
        if self._reading.alpha_color is None or image.shape[2] == 3:
            return image
        blended, color = torch.from_numpy(image), torch.tensor(self._reading.alpha_color)
        blended = blended[:, :, :3] * (blended[:, :, -1:] / 255.0) + 255.0 * color * (1.0 - blended[:, :, -1:] / 255.0)
        return torch.clamp(blended, min=0, max=255).to(torch.uint8).numpy()


def camera_type_error(file: Path, kind: str) -> str:
    """Return the message about an image whose camera is of a type that splatfacto does not support."""
    return f"{file} was taken with a {kind} camera; splatfacto supports only perspective and fisheye cameras."


def _scaled(size: tuple[int, int], scale: float) -> tuple[int, int]:
    return int(size[0] * scale), int(size[1] * scale)


def _mask(file: Path, scale: float) -> Bool[np.ndarray, "h w"]:
    with Image.open(file) as opened:
        resized = opened if scale == 1 else opened.resize(_scaled(opened.size, scale), Image.Resampling.NEAREST)
        return np.array(resized).astype(bool)


@lru_cache  # images of one camera differ only in their poses
def _pinhole(lens: _Lens) -> tuple[Float[Tensor, "3 3"], int, int]:
    """Return intrinsics, width and height of the undistorted image."""
    blank = np.zeros((lens.intrinsics.height, lens.intrinsics.width, 3), np.uint8)
    image, matrix = _undistorted(blank, lens)
    return torch.from_numpy(matrix).float(), image.shape[1], image.shape[0]


def _undistorted(image: Any, lens: _Lens) -> tuple[Any, Float[np.ndarray, "3 3"]]:
    """Undistort an image like `FullImageDatamanager`, and return it with its camera matrix."""
    if not any(lens.distortion):
        return images.undistort_image(image, lens.intrinsics)
    try:
        if lens.kind == "PERSPECTIVE":
            return images.undistort_image(image, _with_distortion(lens))
        matrix, coefficients, pinhole = _fisheye(lens)
        maps = cv2.fisheye.initUndistortRectifyMap(
            matrix, coefficients, np.eye(3), pinhole, image.shape[1::-1], cv2.CV_32FC1
        )
        pixels = cv2.remap(image, maps[0], maps[1], interpolation=cv2.INTER_LINEAR)
    except (InputError, cv2.error, ValueError) as error:
        raise InputError(f"its distortion {list(lens.distortion)} cannot be undistorted ({error})") from error
    shift = np.array([[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]])
    return pixels, np.asarray(pinhole) * [[1, 0, 1], [0, 1, 1], [0, 0, 1]] + shift


def _undistorted_mask(mask: Bool[np.ndarray, "h w"], lens: _Lens) -> UInt8[np.ndarray, "h w"]:
    values = mask.astype(np.uint8) * np.uint8(255)
    if not any(lens.distortion) or lens.kind == "PERSPECTIVE":
        return _undistorted(values[:, :, None], lens)[0][:, :, 0]
    matrix, coefficients, pinhole = _fisheye(lens)
    return cv2.fisheye.undistortImage(values, matrix, coefficients, None, pinhole)


def _with_distortion(lens: _Lens) -> Intrinsics:
    if len(lens.distortion) < _DISTORTION_PARAMS or lens.distortion[3] != 0:
        raise InputError("only k1, k2, k3, p1 and p2 can be undistorted")
    k1, k2, k3, _, p1, p2, *_ = lens.distortion
    return lens.intrinsics._replace(k1=k1, k2=k2, k3=k3, p1=p1, p2=p2)


def _fisheye(lens: _Lens) -> tuple[Any, Any, Any]:
    """Return camera matrix, coefficients and pinhole camera matrix, with pixel centers at integers."""
    fx, fy, cx, cy, width, height = lens.intrinsics[:6]
    matrix = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]], np.float32)
    matrix[:2, 2] -= 0.5
    if len(lens.distortion) < 4:
        raise InputError("a fisheye camera needs four distortion coefficients")
    coefficients = np.array(lens.distortion[:4], np.float32)
    pinhole = cv2.fisheye.estimateNewCameraMatrixForUndistortRectify(
        matrix, coefficients, (width, height), np.eye(3), balance=0
    )
    return matrix, coefficients, pinhole


# Trained splatfacto runs as a `Scene` of the core, without CUDA and without building a model.


_TRANSFORM_TOLERANCE = 1e-3
_ASSUMED_STEP = 30000
"""Step that splatfacto assumes for a loaded checkpoint, whatever its actual step."""
_VIEWER_BACKGROUND = (0.1490, 0.1647, 0.2157)


def _background_color(config: SplatfactoModelConfig) -> Float[Tensor, " 3"]:
    """Return splatfacto's background color outside training, RGB in 0..1; for "random", the viewer's."""
    name = config.background_color
    return torch.tensor(_VIEWER_BACKGROUND) if name == "random" else torch.tensor(NAMED_COLORS[name])


def active_sh_degree(config: Any, step: int) -> int | None:
    """Return the degree of the spherical harmonics at a training step; None: colors do not depend on the view.

    Args:
        config: splatfacto's model config, nerfstudio's own or its mirror.
        step: training step.
    """
    return min(step // config.sh_degree_interval, config.sh_degree) if config.sh_degree > 0 else None


@dataclass(frozen=True)
class NerfstudioScene:
    """A `Scene` made from a trained splatfacto run, or a lifted copy of one, on the CPU."""

    config: TrainerConfig
    """The config as stored; its paths are those of the training."""
    location: RunLocation
    """Current paths of the run's files."""
    checkpoint: Checkpoint
    gaussians: GaussianScene
    """The activated Gaussians, without cropping."""
    train: Views
    """Training views; if the run optimized its camera poses, with the optimized ones."""
    held_out: Views
    """Evaluation views."""
    dataparser_transform: Float[Tensor, "3 4"]
    dataparser_scale: float
    """Map from the poses in the dataset to the scene's world: scale * (transform @ point)."""
    identity: Mapping[str, Any]
    """Config and step, for the manifest; for a lifted run also the gsplat rules of its rasterization."""
    remarks: tuple[str, ...] = ()
    """Warnings about the images, in whole sentences."""
    extra_frames: tuple[Frame, ...] = ()
    """Frames of the extra views at the end of `train`, which the run was not trained with, in the world of the
    Gaussians."""

    renderer = None
    """No renderer of its own: `normlift_ns` renders the scene as splatfacto does."""

    @property
    def name(self) -> str:
        """The experiment name."""
        return str(self.config.experiment_name)

    @property
    def checkpoint_path(self) -> Path:
        """The checkpoint of the Gaussians."""
        return self.checkpoint.path

    @property
    def runs_dir(self) -> Path:
        """The folder above the runs of this experiment, outputs/ by default."""
        return self.location.output_dir

    @property
    def background(self) -> Float[Tensor, " 3"]:
        """Background color, RGB in 0..1."""
        return _background_color(self.model_config)

    @property
    def parameters(self) -> dict[str, Tensor]:
        """The checkpoint's gauss_params by name."""
        prefix, state = "gauss_params.", self.checkpoint.model
        return {name.removeprefix(prefix): value for name, value in state.items() if name.startswith(prefix)}

    @property
    def has_harmonics(self) -> bool:
        """Whether colors depend on the view."""
        return self.model_config.sh_degree > 0

    @property
    def rasterize_mode(self) -> RasterizeMode:
        """Rasterize mode of the training, which a lift must share."""
        return self.model_config.rasterize_mode

    @cached_property
    def coefficients(self) -> Float[Tensor, "n k 3"]:
        """Spherical harmonics of the colors: features_dc, followed by features_rest."""
        return torch.cat([self.parameters["features_dc"][:, None], self.parameters["features_rest"]], dim=1)

    def colors(self, camera: Camera) -> Float[Tensor, "n 3"]:
        """Return each Gaussian's RGB color, >= 0, as seen from the camera."""
        degree = active_sh_degree(self.model_config, _ASSUMED_STEP)
        return view_colors(self.gaussians.means, self.coefficients, camera, degree)

    @property
    def model_config(self) -> SplatfactoModelConfig:
        """The model's part of the config."""
        return self.config.pipeline.model


ViewsFactory = Callable[
    [TrainerConfig, Path, Float[Tensor, "v 3 4"], Float[Tensor, " 3"]], tuple[SplitViews, SplitViews]
]
"""Function that returns the training and evaluation views. Its arguments are a config with absolute paths, the folder
of the dataset, the training poses and the background color."""


def load_nerfstudio_scene(
    load_config: Path, *, data: Path | None = None, load_step: int | None = None, make_nerfstudio_views: ViewsFactory
) -> NerfstudioScene:
    """Load a run of stock splatfacto, splatfacto-big or normlift, from any working directory.

    Only the config, the checkpoint, the dataset's cameras and image headers are read; images are read on access.

    Args:
        load_config: config.yml of the run, in output_dir/experiment/method/timestamp.
        data: current path of the dataset, if it was moved.
        load_step: step of the checkpoint; None: the last.
        make_nerfstudio_views: creates the views for Aria's cameras (FISHEYE624), which only nerfstudio can undistort.
    Raises:
        FileNotFoundError: if the config, the checkpoint, the dataset or an image is missing.
        ValueError: if the config belongs to another method or program, the checkpoint is damaged, or the dataset is not
            the one of the run.
    """
    stored = read_trainer_config(load_config)
    location = locate_run(stored, load_config, data)
    config = with_absolute_paths(stored, location)
    checkpoint = read_checkpoint(find_checkpoint(config.relative_model_dir, load_step))
    datamanager, model = config.pipeline.datamanager, config.pipeline.model
    _check_degree(checkpoint, model, load_config)
    gaussians = _activated_gaussians(checkpoint)
    check_dataset(datamanager.dataparser)
    dataset = parse_dataset(datamanager)
    _check_images([*dataset.train.files, *(dataset.train.masks or ())], location)
    remarks = _check_transform(dataset.transform, dataset.scale, location)
    poses = _training_poses(dataset.train, model, checkpoint)
    color = _background_color(model)
    if dataset.train.camera_type == "FISHEYE624":
        train, held_out = make_nerfstudio_views(config, location.folder, poses, color)
    else:
        reading = _reading(datamanager)
        train = TrainedViews(dataset.train, location.folder, poses, color, reading)
        held_out = TrainedViews(dataset.held_out, location.folder, dataset.held_out.poses, color, reading)
    remarks += train.check_files()
    identity = {"source_config": str(location.run_dir / "config.yml"), "source_step": checkpoint.step}
    return NerfstudioScene(
        stored, location, checkpoint, gaussians, train, held_out, dataset.transform, dataset.scale, identity, remarks
    )


def _reading(datamanager: FullImageDatamanagerConfig) -> ImageReadOptions:
    parser = datamanager.dataparser
    alpha_color = mask_color = None
    if isinstance(parser, BlenderDataParserConfig) and parser.alpha_color is not None:
        alpha_color = NAMED_COLORS[parser.alpha_color.lower()]
    if isinstance(parser, NerfstudioDataParserConfig):
        mask_color = parser.mask_color
    return ImageReadOptions(datamanager.camera_res_scale_factor, alpha_color, mask_color)


def _check_degree(checkpoint: Checkpoint, model: SplatfactoModelConfig, load_config: Path) -> None:
    count, expected = checkpoint.model["gauss_params.features_rest"].shape[1], (model.sh_degree + 1) ** 2 - 1
    if count != expected:
        raise InputError(
            f"{checkpoint.path} has {count} spherical harmonics beyond the first, but {load_config} has sh_degree "
            f"{model.sh_degree}, which needs {expected}. Expected the checkpoint and the config of one training run; "
            "copy both again."
        )


def _activated_gaussians(checkpoint: Checkpoint) -> GaussianScene:
    state = checkpoint.model
    gaussians = GaussianScene(
        means=state["gauss_params.means"],
        quats=state["gauss_params.quats"],
        scales=state["gauss_params.scales"].exp(),
        opacities=state["gauss_params.opacities"].sigmoid().squeeze(-1),
    )
    if not bool(gaussians.drawable.any()):
        raise InputError(
            f"{checkpoint.path}: none of its {len(gaussians):,} Gaussians can be drawn, because all have parameters "
            "that are NaN or infinite, or zero quaternions. Give another checkpoint with --load-step, or train again."
        )
    return gaussians


def _check_images(files: Sequence[Path], location: RunLocation) -> None:
    """Raise if an image or mask is missing, before a lift that takes minutes."""
    missing = [file for file in files if not file.is_file()]
    if missing:
        raise FileNotFoundError(
            f"{len(missing)} of {len(files)} image files of the dataset {location.data} are missing, the first is "
            f"{missing[0]}. Put them back, or give the path of the dataset with --data."
        )


def _check_transform(transform: Float[Tensor, "3 4"], scale: float, location: RunLocation) -> tuple[str, ...]:
    """Raise if the dataset does not lead to the world of the Gaussians, which nerfstudio derives from all poses.

    Returns:
        Warnings in whole sentences.
    """
    file = location.run_dir / "dataparser_transforms.json"
    if not file.exists():
        return (
            f"{file}, which ns-train writes, is missing, so the cameras cannot be compared with those of the training.",
        )
    trained = read_dataparser_transforms(file)
    trained_transform = torch.from_numpy(trained.transform).to(transform)
    gap = float((_in_scene_units(trained_transform, trained.scale) - _in_scene_units(transform, scale)).abs().max())
    is_close = gap <= _TRANSFORM_TOLERANCE and abs(scale / trained.scale - 1) <= _TRANSFORM_TOLERANCE
    if not is_close:  # also for NaN
        raise InputError(
            f"The dataset {location.data} is not the one that {location.run_dir} was trained with: its poses give "
            f"scale {scale:.6g}, the training had {trained.scale:.6g}, and the world coordinates differ by up to "
            f"{gap:.3g} ({file.name}). Frames were added, removed or moved; restore transforms.json, or give the right "
            "dataset with --data."
        )
    return ()


def _in_scene_units(transform: Tensor, scale: float) -> Tensor:
    """Return the transform with its translation in scene units."""
    return transform * torch.tensor([1.0, 1.0, 1.0, scale])


def _training_poses(
    split: DatasetSplit, model: SplatfactoModelConfig, checkpoint: Checkpoint
) -> Float[Tensor, "v 3 4"]:
    """Return the poses that the Gaussians were fitted to; splatfacto applies optimized poses during training only."""
    if model.camera_optimizer.mode == "off":
        return split.poses
    adjustment = checkpoint.model.get("camera_optimizer.pose_adjustment")
    count = 0 if adjustment is None or adjustment.ndim == 0 else len(adjustment)
    if adjustment is None or count != len(split):
        raise InputError(
            f"The run optimized its camera poses (mode {model.camera_optimizer.mode}), but {checkpoint.path} has "
            f"{count} pose adjustments for {len(split)} training images. Use the checkpoint and the dataset of the "
            "run; give the path of the dataset with --data."
        )
    if adjustment.shape[1:] != (6,) or not bool(adjustment.isfinite().all()):
        raise InputError(
            f"{checkpoint.path}: its camera_optimizer.pose_adjustment is {adjustment.dtype} {tuple(adjustment.shape)} "
            f"or not finite. Expected finite numbers of shape ({len(split)}, 6); copy the checkpoint again."
        )
    return apply_pose_adjustments(split.poses, adjustment, model.camera_optimizer.mode)
