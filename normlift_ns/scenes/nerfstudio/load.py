"""Trained splatfacto runs as a `Scene` of the core, without CUDA and without building a model."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, Protocol

import torch
from jaxtyping import Float
from torch import Tensor

from normlift_ns.core.gaussians import Camera, GaussianScene
from normlift_ns.core.scene import Views
from normlift_ns.errors import InputError
from normlift_ns.options import RasterizeMode
from normlift_ns.raster.colors import view_colors
from normlift_ns.scenes.checkpoint import Checkpoint, find_checkpoint, read_checkpoint
from normlift_ns.scenes.frames import Frame
from normlift_ns.scenes.nerfstudio.appearance import COLORS, LOADED_STEP, background, shading_degree
from normlift_ns.scenes.nerfstudio.classes import SplatfactoModelConfig, TrainerConfig
from normlift_ns.scenes.nerfstudio.config import RunLocation, locate, read_config, rebased
from normlift_ns.scenes.nerfstudio.data_classes import (
    BlenderDataParserConfig,
    FullImageDatamanagerConfig,
    NerfstudioDataParserConfig,
)
from normlift_ns.scenes.nerfstudio.datasets import check_dataset
from normlift_ns.scenes.nerfstudio.parsers import parse
from normlift_ns.scenes.nerfstudio.poses import adjusted
from normlift_ns.scenes.nerfstudio.splits import Photographs
from normlift_ns.scenes.nerfstudio.views import Reading, TrainedViews
from normlift_ns.scenes.similarity import read_dataparser_transforms

_TRANSFORM_TOLERANCE = 1e-3


class CheckedViews(Views, Protocol):
    """`Views` that can check their image files."""

    def check_files(self) -> tuple[str, ...]:
        """Check the image files, and return warnings in whole sentences."""
        ...


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
    added: tuple[Frame, ...] = ()
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
        return background(self.model_config)

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
        degree = shading_degree(self.model_config, LOADED_STEP)
        return view_colors(self.gaussians.means, self.coefficients, camera, degree)

    @property
    def model_config(self) -> SplatfactoModelConfig:
        """The model's part of the config."""
        return self.config.pipeline.model


ViewsFactory = Callable[
    [TrainerConfig, Path, Float[Tensor, "v 3 4"], Float[Tensor, " 3"]], tuple[CheckedViews, CheckedViews]
]
"""Function that returns the training and evaluation views. Its arguments are a config with absolute paths, the folder
of the dataset, the training poses and the background color."""


def load_scene(
    load_config: Path, *, data: Path | None = None, load_step: int | None = None, by_nerfstudio: ViewsFactory
) -> NerfstudioScene:
    """Load a run of stock splatfacto, splatfacto-big or normlift, from any working directory.

    Only the config, the checkpoint, the dataset's cameras and image headers are read; images are read on access.

    Args:
        load_config: config.yml of the run, in output_dir/experiment/method/timestamp.
        data: current path of the dataset, if it was moved.
        load_step: step of the checkpoint; None: the last.
        by_nerfstudio: creates the views for Aria's cameras (FISHEYE624), which only nerfstudio can undistort.
    Raises:
        FileNotFoundError: if the config, the checkpoint, the dataset or an image is missing.
        ValueError: if the config belongs to another method or program, the checkpoint is damaged, or the dataset is not
            the one of the run.
    """
    stored = read_config(load_config)
    location = locate(stored, load_config, data)
    config = rebased(stored, location)
    checkpoint = read_checkpoint(find_checkpoint(config.relative_model_dir, load_step))
    datamanager, model = config.pipeline.datamanager, config.pipeline.model
    _check_degree(checkpoint, model, load_config)
    gaussians = _activated_gaussians(checkpoint)
    check_dataset(datamanager.dataparser)
    dataset = parse(datamanager)
    _check_images([*dataset.train.files, *(dataset.train.masks or ())], location)
    remarks = _check_transform(dataset.transform, dataset.scale, location)
    poses = _training_poses(dataset.train, model, checkpoint)
    color = background(model)
    if dataset.train.kind == "FISHEYE624":
        train, held_out = by_nerfstudio(config, location.folder, poses, color)
    else:
        reading = _reading(datamanager)
        train = TrainedViews(dataset.train, location.folder, poses, color, reading)
        held_out = TrainedViews(dataset.held_out, location.folder, dataset.held_out.poses, color, reading)
    remarks += train.check_files()
    identity = {"source_config": str(location.run_dir / "config.yml"), "source_step": checkpoint.step}
    return NerfstudioScene(
        stored, location, checkpoint, gaussians, train, held_out, dataset.transform, dataset.scale, identity, remarks
    )


def _reading(datamanager: FullImageDatamanagerConfig) -> Reading:
    parser = datamanager.dataparser
    alpha_color = mask_color = None
    if isinstance(parser, BlenderDataParserConfig) and parser.alpha_color is not None:
        alpha_color = COLORS[parser.alpha_color.lower()]
    if isinstance(parser, NerfstudioDataParserConfig):
        mask_color = parser.mask_color
    return Reading(datamanager.camera_res_scale_factor, alpha_color, mask_color)


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


def _training_poses(split: Photographs, model: SplatfactoModelConfig, checkpoint: Checkpoint) -> Float[Tensor, "v 3 4"]:
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
    return adjusted(split.poses, adjustment, model.camera_optimizer.mode)
