"""Mirrors of nerfstudio's configuration classes for datasets; see `classes`."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

from normlift_ns.scenes.nerfstudio.targets import Target, target

_DATA_MODULE = "nerfstudio.data"


@dataclass
class NerfstudioDataParserConfig:
    """Mirror of nerfstudio's NerfstudioDataParserConfig."""

    _target: Target = field(default_factory=target(f"{_DATA_MODULE}.dataparsers.nerfstudio_dataparser.Nerfstudio"))
    data: Path = Path()
    scale_factor: float = 1.0
    downscale_factor: int | None = None
    scene_scale: float = 1.0
    orientation_method: Literal["pca", "up", "vertical", "none"] = "up"
    center_method: Literal["poses", "focus", "none"] = "poses"
    auto_scale_poses: bool = True
    eval_mode: Literal["fraction", "filename", "interval", "all"] = "fraction"
    train_split_fraction: float = 0.9
    eval_interval: int = 8
    depth_unit_scale_factor: float = 1e-3
    mask_color: tuple[float, float, float] | None = None
    load_3D_points: bool = False


@dataclass
class ColmapDataParserConfig:
    """Mirror of nerfstudio's ColmapDataParserConfig."""

    _target: Target = field(default_factory=target(f"{_DATA_MODULE}.dataparsers.colmap_dataparser.ColmapDataParser"))
    data: Path = Path()
    scale_factor: float = 1.0
    downscale_factor: int | None = None
    downscale_rounding_mode: Literal["floor", "round", "ceil"] = "floor"
    scene_scale: float = 1.0
    orientation_method: Literal["pca", "up", "vertical", "none"] = "up"
    center_method: Literal["poses", "focus", "none"] = "poses"
    auto_scale_poses: bool = True
    assume_colmap_world_coordinate_convention: bool = True
    eval_mode: Literal["fraction", "filename", "interval", "all"] = "interval"
    train_split_fraction: float = 0.9
    eval_interval: int = 8
    depth_unit_scale_factor: float = 1e-3
    images_path: Path = Path("images")
    masks_path: Path | None = None
    depths_path: Path | None = None
    colmap_path: Path = Path("colmap/sparse/0")
    load_3D_points: bool = True
    max_2D_matches_per_3D_point: int = 0


@dataclass
class BlenderDataParserConfig:
    """Mirror of nerfstudio's BlenderDataParserConfig."""

    _target: Target = field(default_factory=target(f"{_DATA_MODULE}.dataparsers.blender_dataparser.Blender"))
    data: Path = Path("data/blender/lego")
    scale_factor: float = 1.0
    alpha_color: str | None = "white"
    ply_path: Path | None = None


DataParser = NerfstudioDataParserConfig | ColmapDataParserConfig | BlenderDataParserConfig
"""Supported data parsers."""


@dataclass
class FullImageDatamanagerConfig:
    """Mirror of nerfstudio's FullImageDatamanagerConfig."""

    _target: Target = field(
        default_factory=target(f"{_DATA_MODULE}.datamanagers.full_images_datamanager.FullImageDatamanager")
    )
    data: Path | None = None
    masks_on_gpu: bool = False
    images_on_gpu: bool = False
    dataparser: DataParser = field(default_factory=NerfstudioDataParserConfig)
    camera_res_scale_factor: float = 1.0
    eval_num_images_to_sample_from: int = -1
    eval_num_times_to_repeat_images: int = -1
    eval_image_indices: tuple[int, ...] | None = (0,)
    cache_images: Literal["cpu", "gpu"] = "gpu"
    cache_images_type: Literal["uint8", "float32"] = "float32"
    max_thread_workers: int | None = None
    train_cameras_sampling_strategy: Literal["random", "fps"] = "random"
    train_cameras_sampling_seed: int = 42
    fps_reset_every: int = 100
