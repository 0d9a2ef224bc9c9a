"""A trained splatfacto run as a `Scene` of the core. Needs no CUDA and builds no model."""

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
    """Photographs whose files can be looked at."""

    def check_files(self) -> tuple[str, ...]:
        """What a person should know of them."""
        ...


@dataclass(frozen=True)
class NerfstudioScene:
    """A `Scene`: a trained run of splatfacto (or a lifted copy of one), on the CPU."""

    config: TrainerConfig
    """The config as it stands in the file; paths are those of the training."""
    location: RunLocation
    """Where the files are now."""
    checkpoint: Checkpoint
    gaussians: GaussianScene
    """The Gaussians, activated; none cropped away."""
    train: Views
    """Photographs that the run was trained with; where it optimised the camera poses, with the optimised ones."""
    held_out: Views
    """Photographs kept for evaluation."""
    dataparser_transform: Float[Tensor, "3 4"]
    dataparser_scale: float
    """From the poses in the dataset to the scene's world: scale * (transform @ point)."""
    identity: Mapping[str, Any]
    """Config and step, for the manifest; of a lifted run also the rules that it was drawn by."""
    remarks: tuple[str, ...] = ()
    """What a person should know of the photographs, in whole sentences."""
    added: tuple[Frame, ...] = ()
    """The last of the training views, with which the run was not trained; in the world of the Gaussians."""

    renderer = None
    """normlift_ns draws as splatfacto does."""

    @property
    def name(self) -> str:
        """The experiment name."""
        return str(self.config.experiment_name)

    @property
    def checkpoint_path(self) -> Path:
        """The checkpoint that the Gaussians come from."""
        return self.checkpoint.path

    @property
    def runs_dir(self) -> Path:
        """The folder above the runs of this experiment, outputs/ by default."""
        return self.location.output_dir

    @property
    def background(self) -> Float[Tensor, " 3"]:
        """RGB in 0..1 behind the Gaussians."""
        return background(self.model_config)

    @property
    def parameters(self) -> dict[str, Tensor]:
        """gauss_params of the checkpoint by name."""
        prefix, state = "gauss_params.", self.checkpoint.model
        return {name.removeprefix(prefix): value for name, value in state.items() if name.startswith(prefix)}

    @property
    def has_harmonics(self) -> bool:
        """Whether colours depend on the view."""
        return self.model_config.sh_degree > 0

    @property
    def rasterize_mode(self) -> RasterizeMode:
        """How the run was rasterized; lifts must do the same."""
        return self.model_config.rasterize_mode

    @cached_property
    def coefficients(self) -> Float[Tensor, "n k 3"]:
        """Spherical harmonics of the colours, features_dc and features_rest in one."""
        return torch.cat([self.parameters["features_dc"][:, None], self.parameters["features_rest"]], dim=1)

    def colors(self, camera: Camera) -> Float[Tensor, "n 3"]:
        """RGB >= 0 of every Gaussian as the camera sees it."""
        degree = shading_degree(self.model_config, LOADED_STEP)
        return view_colors(self.gaussians.means, self.coefficients, camera, degree)

    @property
    def model_config(self) -> SplatfactoModelConfig:
        """The model's part of the config."""
        return self.config.pipeline.model


ByNerfstudio = Callable[
    [TrainerConfig, Path, Float[Tensor, "v 3 4"], Float[Tensor, " 3"]], tuple[CheckedViews, CheckedViews]
]
"""Trained and held-out photographs of a config with absolute paths, by the folder of the dataset, the poses of the
training and the background."""


def load_scene(
    load_config: Path, *, data: Path | None = None, load_step: int | None = None, by_nerfstudio: ByNerfstudio
) -> NerfstudioScene:
    """Loads a run of stock splatfacto, splatfacto-big or normlift, from any working directory.

    Reads nothing but config, checkpoint and the dataset's transforms; photographs are read as they are asked for.

    Args:
        load_config: config.yml of the run, in output_dir/experiment/method/timestamp.
        data: where the dataset is now, if it was moved.
        load_step: step of the checkpoint; None: the last.
        by_nerfstudio: makes the views of Aria's cameras (FISHEYE624), which nerfstudio alone undistorts.
    Raises:
        FileNotFoundError: config, checkpoint, dataset or an image is missing.
        ValueError: a config of another method or program, a damaged checkpoint, another dataset than the run's.
    """
    stored = read_config(load_config)
    location = locate(stored, load_config, data)
    config = rebased(stored, location)
    checkpoint = read_checkpoint(find_checkpoint(config.relative_model_dir, load_step))
    datamanager, model = config.pipeline.datamanager, config.pipeline.model
    _check_degree(checkpoint, model, load_config)
    gaussians = _scene(checkpoint)
    check_dataset(datamanager.dataparser)
    found = parse(datamanager)
    _check_images([*found.train.files, *(found.train.masks or ())], location)
    remarks = _check_transform(found.transform, found.scale, location)
    poses = _training_poses(found.train, model, checkpoint)
    behind = background(model)
    if found.train.kind == "FISHEYE624":
        train, held_out = by_nerfstudio(config, location.folder, poses, behind)
    else:
        reading = _reading(datamanager)
        train = TrainedViews(found.train, location.folder, poses, behind, reading)
        held_out = TrainedViews(found.held_out, location.folder, found.held_out.poses, behind, reading)
    remarks += train.check_files()
    identity = {"source_config": str(location.run_dir / "config.yml"), "source_step": checkpoint.step}
    return NerfstudioScene(
        stored, location, checkpoint, gaussians, train, held_out, found.transform, found.scale, identity, remarks
    )


def _reading(datamanager: FullImageDatamanagerConfig) -> Reading:
    parser = datamanager.dataparser
    behind = instead = None
    if isinstance(parser, BlenderDataParserConfig) and parser.alpha_color is not None:
        behind = COLORS[parser.alpha_color.lower()]
    if isinstance(parser, NerfstudioDataParserConfig):
        instead = parser.mask_color
    return Reading(datamanager.camera_res_scale_factor, behind, instead)


def _check_degree(checkpoint: Checkpoint, model: SplatfactoModelConfig, load_config: Path) -> None:
    found = checkpoint.model["gauss_params.features_rest"].shape[1]
    if found != (model.sh_degree + 1) ** 2 - 1:
        raise InputError(
            f"{checkpoint.path} has {found} spherical harmonics beyond the first, but {load_config} says sh_degree "
            f"{model.sh_degree}, which needs {(model.sh_degree + 1) ** 2 - 1}. Expected the checkpoint and the config "
            "of one training; copy both again."
        )


def _scene(checkpoint: Checkpoint) -> GaussianScene:
    state = checkpoint.model
    scene = GaussianScene(
        means=state["gauss_params.means"],
        quats=state["gauss_params.quats"],
        scales=state["gauss_params.scales"].exp(),
        opacities=state["gauss_params.opacities"].sigmoid().squeeze(-1),
    )
    if not bool(scene.drawable.any()):
        raise InputError(
            f"{checkpoint.path}: none of its {len(scene):,} Gaussians can be drawn, because all have parameters that "
            "are NaN, infinite or rotations of zeros. Give another checkpoint with --load-step, or train again."
        )
    return scene


def _check_images(files: Sequence[Path], location: RunLocation) -> None:
    """A lift takes minutes; a file that is missing should show before."""
    missing = [file for file in files if not file.is_file()]
    if missing:
        raise FileNotFoundError(
            f"{len(missing)} of {len(files)} image files of the dataset {location.data} are missing, the first is "
            f"{missing[0]}. Put them back, or say where the dataset is with --data."
        )


def _check_transform(transform: Float[Tensor, "3 4"], scale: float, location: RunLocation) -> tuple[str, ...]:
    """The dataset must give the world that the Gaussians live in: nerfstudio derives it from all poses together."""
    file = location.run_dir / "dataparser_transforms.json"
    if not file.exists():
        return (
            f"{file} is missing, which ns-train writes: whether the cameras are still those of the training cannot be "
            "told.",
        )
    trained = read_dataparser_transforms(file)
    known = torch.from_numpy(trained.transform).to(transform)
    gap = float((_world(known, trained.scale) - _world(transform, scale)).abs().max())
    if not (gap <= _TRANSFORM_TOLERANCE and abs(scale / trained.scale - 1) <= _TRANSFORM_TOLERANCE):  # nor NaN
        raise InputError(
            f"The dataset {location.data} is not the one that {location.run_dir} was trained with: its poses give "
            f"scale {scale:.6g}, the training had {trained.scale:.6g}, and the world coordinates differ by up to "
            f"{gap:.3g} ({file.name}). Frames were added, removed or moved; restore transforms.json or name the right "
            "dataset with --data."
        )
    return ()


def _world(transform: Tensor, scale: float) -> Tensor:
    """Rotation, and the translation in scene units."""
    return transform * torch.tensor([1.0, 1.0, 1.0, scale])


def _training_poses(split: Photographs, model: SplatfactoModelConfig, checkpoint: Checkpoint) -> Float[Tensor, "v 3 4"]:
    """Poses that the Gaussians fit: where the run optimised its cameras, splatfacto applies that in training only."""
    if model.camera_optimizer.mode == "off":
        return split.poses
    adjustment = checkpoint.model.get("camera_optimizer.pose_adjustment")
    found = 0 if adjustment is None or adjustment.ndim == 0 else len(adjustment)
    if adjustment is None or found != len(split):
        raise InputError(
            f"The run optimised its camera poses (mode {model.camera_optimizer.mode}), but {checkpoint.path} has "
            f"{found} of them for {len(split)} training images. Use the checkpoint and the dataset of the run; say "
            "where the dataset is with --data."
        )
    if adjustment.shape[1:] != (6,) or not bool(adjustment.isfinite().all()):
        raise InputError(
            f"{checkpoint.path}: its camera_optimizer.pose_adjustment is {adjustment.dtype} {tuple(adjustment.shape)}, "
            f"or not finite. Expected finite numbers of shape ({len(split)}, 6); copy the checkpoint again."
        )
    return adjusted(split.poses, adjustment, model.camera_optimizer.mode)
