"""Reader of trained splatfacto runs. It returns a `Scene` with the images that splatfacto trained on."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float, UInt8
from PIL import Image
from torch import Tensor

from normlift_ns.core.gaussians import Camera, GaussianScene
from normlift_ns.core.scene import Views
from normlift_ns.data.checkpoint import Checkpoint, find_checkpoint, read_checkpoint
from normlift_ns.data.frames import Frame, Intrinsics
from normlift_ns.data.images import SplitViews, camera_type_error, open_scaled
from normlift_ns.data.nerfstudio import config_classes
from normlift_ns.data.nerfstudio.config import RunLocation, locate_run, read_trainer_config, with_absolute_paths
from normlift_ns.data.nerfstudio.dataparsers import DatasetSplit, apply_pose_adjustments, parse_dataset
from normlift_ns.data.transforms import read_dataparser_transforms, relative_name
from normlift_ns.errors import InputError
from normlift_ns.options import RasterizeMode
from normlift_ns.rasterization.rasterize import view_colors

_NUM_DISTORTION = {"PERSPECTIVE": 6, "FISHEYE": 4}
"""Minimum number of distortion parameters of a distorted camera, by camera type.

The parameters are k1, k2, k3, k4, p1 and p2, in this order.
"""


class TrainedViews(SplitViews):
    """Views of a split of a dataset, in the same order, read and undistorted without nerfstudio.

    Images, masks and intrinsics equal those of nerfstudio's `FullImageDatamanager.cached_train`. Each access reads one
    image, whereas nerfstudio keeps all of them in memory.

    Args:
        split: Image files and cameras, before undistortion.
        folder: Folder of the dataset, the base of the relative `names`.
        poses, background: As in `SplitViews`.
        datamanager: Config of the data manager. Some of its settings affect pixels.
    """

    def __init__(
        self,
        split: DatasetSplit,
        folder: Path,
        poses: Float[Tensor, "v 3 4"],
        background: Float[Tensor, " 3"],
        datamanager: config_classes.FullImageDatamanagerConfig,
    ) -> None:
        names, scale = [relative_name(file, folder) for file in split.files], datamanager.camera_res_scale_factor
        super().__init__(split.files, names, split.masks, split.sizes.tolist(), poses, background, scale)
        self._split, parser = split, datamanager.dataparser
        alpha = parser.alpha_color if isinstance(parser, config_classes.BlenderDataParserConfig) else None
        self._alpha_color = None if alpha is None else config_classes.NAMED_COLORS[alpha.lower()]
        """Color, RGB in 0..1, over which nerfstudio blends images with an alpha channel when it reads them.

        None if nerfstudio blends them later.
        """
        self._mask_color = parser.mask_color if isinstance(parser, config_classes.NerfstudioDataParserConfig) else None
        """Color that nerfstudio writes into pixels whose mask is zero."""

    def _lens(self, index: int) -> Intrinsics:
        kind = self._split.camera_type
        if kind not in ("PERSPECTIVE", "FISHEYE"):
            raise InputError(camera_type_error(self.files[index], kind))
        distortion = [] if self._split.distortion is None else self._split.distortion[index].tolist()
        needed = _NUM_DISTORTION[kind]
        if any(distortion) and len(distortion) < needed:
            raise InputError(f"the distortion {distortion} cannot be removed (expected at least {needed} parameters)")
        k1, k2, k3, k4, p1, p2 = [*distortion, *[0.0] * 6][:6]
        fx, fy, cx, cy = self._split.intrinsics[index].tolist()
        width, height = self._sizes[index]
        return Intrinsics(fx, fy, cx, cy, width, height, k1, k2, k3, p1, p2, k4, kind == "FISHEYE")

    def _load(self, index: int) -> tuple[UInt8[np.ndarray, "h w c"], Bool[np.ndarray, "h w"] | None]:
        """Read an image and its mask like nerfstudio's `InputDataset`."""
        image, mask = super()._load(index)
        if mask is not None and self._mask_color is not None and any(self._mask_color):
            filled = torch.ones(image.shape, dtype=torch.uint8) * torch.tensor(self._mask_color)
            image = torch.where(torch.from_numpy(mask)[:, :, None], torch.from_numpy(image), filled).numpy()
        return image, mask

    def _pixels(self, file: Path) -> UInt8[np.ndarray, "h w c"]:
        with open_scaled(file, self._scale, Image.Resampling.BILINEAR) as opened:
            image = np.array(opened, dtype=np.uint8)
        if image.ndim == 2:
            image = image[:, :, None].repeat(3, axis=2)
        if image.ndim != 3 or image.shape[2] not in (3, 4):
            raise InputError(f"its shape is {image.shape}, expected 1, 3 or 4 channels")
        if self._alpha_color is None or image.shape[2] == 3:
            return image
        blended, color = torch.from_numpy(image), torch.tensor(self._alpha_color)
        blended = blended[:, :, :3] * (blended[:, :, -1:] / 255.0) + 255.0 * color * (1.0 - blended[:, :, -1:] / 255.0)
        return torch.clamp(blended, min=0, max=255).to(torch.uint8).numpy()


_TRANSFORM_TOLERANCE = 1e-3
_ASSUMED_STEP = 30000
"""Step that splatfacto assumes for all loaded checkpoints."""
_VIEWER_BACKGROUND = (0.1490, 0.1647, 0.2157)


def _background_color(config: config_classes.SplatfactoModelConfig) -> Float[Tensor, " 3"]:
    """Return splatfacto's background color after the training, RGB in 0..1; for "random", the color of the viewer."""
    name = config.background_color
    return torch.tensor(_VIEWER_BACKGROUND) if name == "random" else torch.tensor(config_classes.NAMED_COLORS[name])


def active_sh_degree(config: Any, step: int) -> int | None:
    """Return the active degree of the spherical harmonics at a training step; None if colors do not use harmonics.

    Args:
        config: Config of the splatfacto model, from nerfstudio or a mirror class.
        step: Training step.
    """
    return min(step // config.sh_degree_interval, config.sh_degree) if config.sh_degree > 0 else None


@dataclass(frozen=True)
class NerfstudioScene:
    """Scene made from a trained splatfacto run, or a lifted copy of such a run, on the CPU."""

    config: config_classes.TrainerConfig
    """Config as stored, with the paths of the training."""
    location: RunLocation
    """Current paths of the files of the run."""
    checkpoint: Checkpoint
    gaussians: GaussianScene
    """Gaussians with activated scales and opacities, without cropping."""
    train: Views
    """Training views, with optimized camera poses if the run optimized them."""
    held_out: Views
    """Evaluation views."""
    dataparser_transform: Float[Tensor, "3 4"]
    dataparser_scale: float
    """Scale of the map from the capture to the world of the scene: scale * (dataparser_transform @ point)."""
    identity: Mapping[str, Any]
    """Path of the config and step of the checkpoint for the manifest; for lifted runs, also the version of gsplat."""
    remarks: tuple[str, ...] = ()
    """Warnings about the config, the cameras and the images, in whole sentences."""
    extra_frames: tuple[Frame, ...] = ()
    """Frames of the extra views at the end of `train`, in the world of the Gaussians.

    The run was not trained with these views.
    """

    renderer = None
    """Renderer of another package; None, because `normlift_ns` renders the scene like splatfacto."""

    @property
    def name(self) -> str:
        """Name of the experiment."""
        return str(self.config.experiment_name)

    @property
    def checkpoint_path(self) -> Path:
        """Path of the checkpoint of the Gaussians."""
        return self.checkpoint.path

    @property
    def runs_dir(self) -> Path:
        """Folder of the experiments (default: outputs/); for a moved run, a folder in the current directory."""
        return self.location.output_dir

    @property
    def background(self) -> Float[Tensor, " 3"]:
        """Background color, RGB in 0..1."""
        return _background_color(self.model_config)

    @property
    def parameters(self) -> dict[str, Tensor]:
        """Tensors gauss_params.* of the checkpoint, by name without this prefix."""
        return self.checkpoint.splat.parameters

    @property
    def has_harmonics(self) -> bool:
        """True if colors depend on the view direction."""
        return self.model_config.sh_degree > 0

    @property
    def rasterize_mode(self) -> RasterizeMode:
        """Rasterize mode of the training, which a lift must also use."""
        return self.model_config.rasterize_mode

    @cached_property
    def coefficients(self) -> Float[Tensor, "n k 3"]:
        """Spherical harmonics of the colors: features_dc, followed by features_rest."""
        splat = self.checkpoint.splat
        return torch.cat([splat.features_dc[:, None], splat.features_rest], dim=1)

    def colors(self, camera: Camera) -> Float[Tensor, "n 3"]:
        """Return the RGB color of each Gaussian as seen from a camera, with values >= 0."""
        degree = active_sh_degree(self.model_config, _ASSUMED_STEP)
        return view_colors(self.gaussians.means, self.coefficients, camera, degree)

    @property
    def model_config(self) -> config_classes.SplatfactoModelConfig:
        """Config of the model."""
        return self.config.pipeline.model


def load_nerfstudio_scene(
    load_config: Path, *, data: Path | None = None, load_step: int | None = None
) -> NerfstudioScene:
    """Load a run of one of `SUPPORTED_METHODS`, from any working directory.

    The function reads the config, the checkpoint, the cameras of the dataset and the image headers. Views read their
    images when they are accessed.

    Args:
        load_config: Path of the config.yml of the run, in output_dir/experiment/method/timestamp.
        data: Current path of the dataset, if it was moved.
        load_step: Step of the checkpoint; None for the last step.
    Raises:
        FileNotFoundError: The config, the checkpoint, the dataset or an image is missing.
        ValueError: The config is from another method or program, the checkpoint is damaged, or the dataset is not the
            dataset of the run.
    """
    said: list[str] = []
    stored = read_trainer_config(load_config, said.append)
    location = locate_run(stored, load_config, data)
    config = with_absolute_paths(stored, location)
    checkpoint = read_checkpoint(find_checkpoint(config.relative_model_dir, load_step))
    datamanager, model = config.pipeline.datamanager, config.pipeline.model
    count, expected = checkpoint.splat.features_rest.shape[1], (model.sh_degree + 1) ** 2 - 1
    if count != expected:
        raise InputError(
            f"{checkpoint.path} has {count} spherical harmonics above degree 0, but {load_config} has "
            f"sh_degree {model.sh_degree}, which needs {expected}. Copy the checkpoint and the config of the same "
            "training run again."
        )
    gaussians = checkpoint.splat.activated
    if not bool(gaussians.drawable.any()):
        raise InputError(
            f"{checkpoint.path}: all {len(gaussians):,} Gaussians have parameters that are NaN, infinite or too large, "
            "or zero quaternions, so they cannot be rendered. Give another checkpoint with --load-step."
        )
    dataset = parse_dataset(datamanager, data_given=data is not None)
    advice = "" if data is not None else ", or give the path of the dataset with --data"
    files = [*dataset.train.files, *(dataset.train.masks or ())]
    missing = [file for file in files if not file.is_file()]
    if missing:  # report missing files before a long lift
        raise FileNotFoundError(
            f"Image files of the dataset {location.data} are missing ({len(missing)} of {len(files)}, the first is "
            f"{missing[0]}). Copy them to these paths{advice}."
        )
    remarks = _check_transform(dataset.transform, dataset.scale, location, advice)
    poses = _training_poses(dataset.train, model, checkpoint, advice)
    color = _background_color(model)
    if dataset.train.camera_type == "FISHEYE624":  # only nerfstudio can undistort Aria's cameras
        from normlift_ns.data.nerfstudio.dataset_views import nerfstudio_views  # noqa: PLC0415 (nerfstudio takes 13 s)

        train, held_out = nerfstudio_views(config, location.folder, poses, color)
    else:
        train = TrainedViews(dataset.train, location.folder, poses, color, datamanager)
        held_out = TrainedViews(dataset.held_out, location.folder, dataset.held_out.poses, color, datamanager)
    remarks = (*said, *remarks, *train.check_files())
    identity = {"source_config": str(location.run_dir / "config.yml"), "source_step": checkpoint.step}
    return NerfstudioScene(
        stored, location, checkpoint, gaussians, train, held_out, dataset.transform, dataset.scale, identity, remarks
    )


def _check_transform(
    transform: Float[Tensor, "3 4"], scale: float, location: RunLocation, advice: str
) -> tuple[str, ...]:
    """Raise InputError if the worlds of the dataset and of the training differ.

    nerfstudio computes the world of the Gaussians from all poses, so a changed dataset leads to another world.

    Args:
        transform, scale: Map from the world of the capture to the world of the Gaussians, computed from the dataset.
        location: Paths of the run.
        advice: Alternative to restoring the dataset, for error messages.
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
    if not is_close:  # or NaN
        raise InputError(
            f"The cameras of the dataset {location.data} are not those of the training of {location.run_dir}. Their "
            f"poses give the scale {scale:.6g}, and {file.name} has {trained.scale:.6g}; the numbers of the transforms "
            f"differ by up to {gap:.3g}. Restore the camera file of the dataset{advice}."
        )
    return ()


def _in_scene_units(transform: Tensor, scale: float) -> Tensor:
    """Return the transform with its translation in scene units."""
    return transform * torch.tensor([1.0, 1.0, 1.0, scale])


def _training_poses(
    split: DatasetSplit, model: config_classes.SplatfactoModelConfig, checkpoint: Checkpoint, advice: str
) -> Float[Tensor, "v 3 4"]:
    """Return the poses of the training views, with the adjustments of the camera optimizer if the run used it."""
    if model.camera_optimizer.mode == "off":
        return split.poses
    adjustment = checkpoint.model.get("camera_optimizer.pose_adjustment")
    count = 0 if adjustment is None or adjustment.ndim == 0 else len(adjustment)
    if adjustment is None or count != len(split):
        raise InputError(
            f"The run optimized its camera poses (mode {model.camera_optimizer.mode}), but {checkpoint.path} has "
            f"{count} pose adjustments for {len(split)} training images. Restore the checkpoint and the dataset of the "
            f"run{advice}."
        )
    if adjustment.shape[1:] != (6,) or not bool(adjustment.isfinite().all()):
        is_shape_wrong = adjustment.shape[1:] != (6,)
        problem = f"shape {tuple(adjustment.shape)}" if is_shape_wrong else "numbers that are NaN or infinite"
        raise InputError(
            f"{checkpoint.path}: camera_optimizer.pose_adjustment has {problem}, expected finite numbers of shape "
            f"({len(split)}, 6). Copy the checkpoint again."
        )
    return apply_pose_adjustments(split.poses, adjustment, model.camera_optimizer.mode)
