"""Mirrors of the nerfstudio configuration classes in splatfacto's config.yml, with fields, types and defaults only.

The import of nerfstudio's own classes takes 13 s of CPU time, because each imports the class that it configures, its
`_target`. The mirrors store only the name of this class.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from enum import Enum
from pathlib import Path
from typing import Any, Literal, TypeVar

from typing_extensions import dataclass_transform

from normlift_ns.options import LiftOptions, RefineConfig, SourceOptions

_Class = TypeVar("_Class", bound=type)
_BASE, _DATA, _OURS = "nerfstudio.configs.base_config", "nerfstudio.data", "normlift_ns.nerfstudio_plugin"
_SCHEDULERS = "nerfstudio.engine.schedulers"
CONFIG_CLASS_NAMES: dict[type, str] = {}
"""Name of each mirror class in a config.yml."""
CLASS_TARGETS: dict[type, str] = {}
"""Name of the class or function that each mirror class configures, if it has a `_target`."""


@dataclass_transform(field_specifiers=(field,))
def _mirror(module: str, target: str | None = None) -> Callable[[_Class], _Class]:
    """Return a decorator that turns a class into a dataclass, and registers it as a mirror.

    The mirrored class has the same name, and is in `module`.

    Args:
        module: Module of the mirrored class.
        target: Name of the `_target` of the mirrored class, with its module unless that is `module`; None for no
            target.
    """

    def register(cls: _Class) -> _Class:
        CONFIG_CLASS_NAMES[cls] = f"{module}.{cls.__name__}"
        if target is not None:
            CLASS_TARGETS[cls] = target if "." in target else f"{module}.{target}"
        return dataclass(cls)  # pyrefly: ignore[bad-return]

    return register


@dataclass
class PosedDataParserConfig:
    """Options that nerfstudio's data parsers for posed images share."""

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


@_mirror(f"{_DATA}.dataparsers.nerfstudio_dataparser", "Nerfstudio")
class NerfstudioDataParserConfig(PosedDataParserConfig):
    """Options of nerfstudio-data, the data parser for transforms.json."""

    mask_color: tuple[float, float, float] | None = None
    load_3D_points: bool = False


@_mirror(f"{_DATA}.dataparsers.colmap_dataparser", "ColmapDataParser")
class ColmapDataParserConfig(PosedDataParserConfig):
    """Options of colmap, the data parser for COLMAP projects."""

    downscale_rounding_mode: Literal["floor", "round", "ceil"] = "floor"
    assume_colmap_world_coordinate_convention: bool = True
    eval_mode: Literal["fraction", "filename", "interval", "all"] = "interval"
    images_path: Path = Path("images")
    masks_path: Path | None = None
    depths_path: Path | None = None
    colmap_path: Path = Path("colmap/sparse/0")
    load_3D_points: bool = True
    max_2D_matches_per_3D_point: int = 0


@_mirror(f"{_DATA}.dataparsers.blender_dataparser", "Blender")
class BlenderDataParserConfig:
    """Options of blender-data, the data parser for synthetic scenes made with Blender."""

    data: Path = Path("data/blender/lego")
    scale_factor: float = 1.0
    alpha_color: str | None = "white"
    ply_path: Path | None = None


SupportedDataParserConfig = NerfstudioDataParserConfig | ColmapDataParserConfig | BlenderDataParserConfig
"""Options of the supported data parsers."""


@_mirror(f"{_DATA}.datamanagers.full_images_datamanager", "FullImageDatamanager")
class FullImageDatamanagerConfig:
    """Options of the data manager that splatfacto uses, which loads whole images."""

    data: Path | None = None
    masks_on_gpu: bool = False
    images_on_gpu: bool = False
    dataparser: SupportedDataParserConfig = field(default_factory=NerfstudioDataParserConfig)
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


@_mirror("nerfstudio.engine.optimizers", "torch.optim.adam.Adam")
class OptimizerConfig:
    """Options that nerfstudio's optimizers share."""

    lr: float = 0.0005
    eps: float = 1e-08
    max_norm: float | None = None


@_mirror("nerfstudio.engine.optimizers", "torch.optim.adam.Adam")
class AdamOptimizerConfig(OptimizerConfig):
    """Options of the optimizer Adam."""

    weight_decay: float = 0


@_mirror("nerfstudio.engine.optimizers", "torch.optim.radam.RAdam")
class RAdamOptimizerConfig(OptimizerConfig):
    """Options of the optimizer RAdam."""

    weight_decay: float = 0


@_mirror(_SCHEDULERS, "Scheduler")
class SchedulerConfig:
    """Base class of the options of learning rate schedulers."""


@_mirror(_SCHEDULERS, "MultiStepScheduler")
class MultiStepSchedulerConfig(SchedulerConfig):
    """Options of the scheduler that multiplies the learning rate by gamma at each milestone."""

    max_steps: int = 1000000
    gamma: float = 0.33
    milestones: tuple[int, ...] = (500000, 750000, 900000)


@_mirror(_SCHEDULERS, "ExponentialDecayScheduler")
class ExponentialDecaySchedulerConfig(SchedulerConfig):
    """Options of the scheduler with exponential decay of the learning rate."""

    lr_pre_warmup: float = 1e-8
    lr_final: float | None = None
    warmup_steps: int = 0
    max_steps: int = 100000
    ramp: Literal["linear", "cosine"] = "cosine"


@_mirror(_SCHEDULERS, "CosineDecayScheduler")
class CosineDecaySchedulerConfig(SchedulerConfig):
    """Options of the scheduler with cosine decay of the learning rate."""

    warm_up_end: int = 5000
    learning_rate_alpha: float = 0.05
    max_steps: int = 300000


class EventName(Enum):
    """Quantities that nerfstudio prints during training."""

    ITER_TRAIN_TIME = "Train Iter (time)"
    TOTAL_TRAIN_TIME = "Train Total (time)"
    ETA = "ETA (time)"
    TRAIN_RAYS_PER_SEC = "Train Rays / Sec"
    TEST_RAYS_PER_SEC = "Test Rays / Sec"
    VIS_RAYS_PER_SEC = "Vis Rays / Sec"
    CURR_TEST_PSNR = "Test PSNR"


CONFIG_CLASS_NAMES[EventName] = "nerfstudio.utils.writer.EventName"


@_mirror(_BASE)
class MachineConfig:
    """Random seed and devices of a training run."""

    seed: int = 42
    num_devices: int = 1
    num_machines: int = 1
    machine_rank: int = 0
    dist_url: str = "auto"
    device_type: Literal["cpu", "cuda", "mps"] = "cuda"


@_mirror(_BASE, "nerfstudio.utils.writer.LocalWriter")
class LocalWriterConfig:
    """Options of the statistics that nerfstudio prints during training."""

    enable: bool = False
    stats_to_track: tuple[EventName, ...] = (
        EventName.ITER_TRAIN_TIME,
        EventName.TRAIN_RAYS_PER_SEC,
        EventName.CURR_TEST_PSNR,
        EventName.VIS_RAYS_PER_SEC,
        EventName.TEST_RAYS_PER_SEC,
        EventName.ETA,
    )
    max_log_size: int = 10


@_mirror(_BASE)
class LoggingConfig:
    """Options of nerfstudio's logs and profiler."""

    relative_log_dir: Path = Path()
    steps_per_log: int = 10
    max_buffer_size: int = 20
    local_writer: LocalWriterConfig = field(default_factory=lambda: LocalWriterConfig(enable=True))
    profiler: Literal["none", "basic", "pytorch"] = "basic"


@_mirror(_BASE)
class ViewerConfig:
    """Options of nerfstudio's viewer."""

    relative_log_filename: str = "viewer_log_filename.txt"
    websocket_port: int | None = None
    websocket_port_default: int = 7007
    websocket_host: str = "0.0.0.0"
    num_rays_per_chunk: int = 32768
    max_num_display_images: int = 512
    quit_on_train_completion: bool = False
    image_format: Literal["jpeg", "png"] = "jpeg"
    jpeg_quality: int = 75
    make_share_url: bool = False
    camera_frustum_scale: float = 0.1
    default_composite_depth: bool = True


@_mirror("nerfstudio.cameras.camera_optimizers", "CameraOptimizer")
class CameraOptimizerConfig:
    """Options of the camera optimizer, which adjusts camera poses during training."""

    mode: Literal["off", "SO3xR3", "SE3"] = "off"
    trans_l2_penalty: float = 1e-2
    rot_l2_penalty: float = 1e-3
    optimizer: OptimizerConfig | None = None
    scheduler: SchedulerConfig | None = None


@_mirror("nerfstudio.models.splatfacto", "SplatfactoModel")
class SplatfactoModelConfig:
    """Options of the splatfacto model."""

    enable_collider: bool = True
    collider_params: dict[str, float] | None = field(default_factory=lambda: {"near_plane": 2.0, "far_plane": 6.0})
    loss_coefficients: dict[str, float] = field(default_factory=lambda: {"rgb_loss_coarse": 1.0, "rgb_loss_fine": 1.0})
    eval_num_rays_per_chunk: int = 4096
    prompt: str | None = None
    warmup_length: int = 500
    refine_every: int = 100
    resolution_schedule: int = 3000
    background_color: Literal["random", "black", "white"] = "random"
    num_downscales: int = 2
    cull_alpha_thresh: float = 0.1
    cull_scale_thresh: float = 0.5
    reset_alpha_every: int = 30
    densify_grad_thresh: float = 0.0008
    use_absgrad: bool = True
    densify_size_thresh: float = 0.01
    n_split_samples: int = 2
    sh_degree_interval: int = 1000
    cull_screen_size: float = 0.15
    split_screen_size: float = 0.05
    stop_screen_size_at: int = 4000
    random_init: bool = False
    num_random: int = 50000
    random_scale: float = 10.0
    ssim_lambda: float = 0.2
    stop_split_at: int = 15000
    sh_degree: int = 3
    use_scale_regularization: bool = False
    max_gauss_ratio: float = 10.0
    output_depth_during_training: bool = False
    rasterize_mode: Literal["classic", "antialiased"] = "classic"
    camera_optimizer: CameraOptimizerConfig = field(default_factory=CameraOptimizerConfig)
    use_bilateral_grid: bool = False
    grid_shape: tuple[int, int, int] = (16, 16, 8)
    color_corrected_metrics: bool = False


@_mirror(f"{_OURS}.model", "NormLiftModel")
class NormLiftModelConfig(SplatfactoModelConfig):
    """Options of the model of a lifted run: splatfacto's options and the path of the semantic field."""

    semantics: Path | None = None


@_mirror("nerfstudio.pipelines.base_pipeline", "VanillaPipeline")
class VanillaPipelineConfig:
    """Options of the data manager and the model of a run."""

    datamanager: FullImageDatamanagerConfig = field(default_factory=FullImageDatamanagerConfig)
    model: SplatfactoModelConfig = field(default_factory=SplatfactoModelConfig)


@_mirror(f"{_OURS}.pipeline", "NormLiftPipeline")
class NormLiftPipelineConfig(VanillaPipelineConfig):
    """Options of the pipeline of a lifted run, with the options of its lift."""

    source: SourceOptions = field(default_factory=SourceOptions)
    lift: LiftOptions = field(default_factory=LiftOptions)
    queries: tuple[str, ...] = ()


@_mirror("nerfstudio.engine.trainer", "Trainer")
class TrainerConfig:
    """Options of a training run, the root object of a config.yml."""

    output_dir: Path = Path("outputs")
    method_name: str | None = None
    experiment_name: str | None = None
    project_name: str | None = "nerfstudio-project"
    timestamp: str = "{timestamp}"
    machine: MachineConfig = field(default_factory=MachineConfig)
    logging: LoggingConfig = field(default_factory=LoggingConfig)
    viewer: ViewerConfig = field(default_factory=ViewerConfig)
    pipeline: VanillaPipelineConfig = field(default_factory=VanillaPipelineConfig)
    optimizers: dict[str, Any] = field(
        default_factory=lambda: {"fields": {"optimizer": OptimizerConfig(), "scheduler": SchedulerConfig()}}
    )
    vis: str = "wandb"
    data: Path | None = None
    prompt: str | None = None
    relative_model_dir: Path = Path("nerfstudio_models")
    load_scheduler: bool = True
    steps_per_save: int = 1000
    steps_per_eval_batch: int = 500
    steps_per_eval_image: int = 500
    steps_per_eval_all_images: int = 25000
    max_num_iterations: int = 1000000
    mixed_precision: bool = False
    use_grad_scaler: bool = False
    save_only_latest_checkpoint: bool = True
    load_dir: Path | None = None
    load_step: int | None = None
    load_config: Path | None = None
    load_checkpoint: Path | None = None
    log_gradients: bool = False
    gradient_accumulation_steps: dict[str, int] = field(default_factory=dict)
    start_paused: bool = False


CONFIG_CLASSES: dict[str, type] = {
    **{
        name: cls
        for cls, name in CONFIG_CLASS_NAMES.items()
        if cls not in (OptimizerConfig, SchedulerConfig, EventName)
    },
    "normlift_ns.plugin.model.NormLiftModelConfig": NormLiftModelConfig,  # names of version 0.1
    "normlift_ns.plugin.pipeline.NormLiftPipelineConfig": NormLiftPipelineConfig,
    "normlift_ns.plugin.lifting.LiftOptions": LiftOptions,
    "normlift_ns.core.refine.RefineConfig": RefineConfig,
    "normlift_ns.encoders.build.SourceOptions": SourceOptions,
    "normlift_ns.options.LiftOptions": LiftOptions,
    "normlift_ns.options.SourceOptions": SourceOptions,
    "normlift_ns.options.RefineConfig": RefineConfig,
}
"""Classes that a config.yml may contain, keyed by their names in the file."""


NAMED_COLORS = {
    "white": (1.0, 1.0, 1.0), "black": (0.0, 0.0, 0.0), "red": (1.0, 0.0, 0.0), "green": (0.0, 1.0, 0.0),
    "blue": (0.0, 0.0, 1.0),
}  # fmt: skip
"""nerfstudio's named colors, RGB in 0..1."""
