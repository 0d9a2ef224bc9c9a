"""Methods normlift, normlift-lerf-ovs and normlift-scannet of `ns-train`.

nerfstudio's commands import this module while nerfstudio builds its list of methods. The module must therefore not
import that list (nerfstudio.configs.method_configs, nerfstudio.utils.eval_utils), or slow or optional modules.
"""

from pathlib import Path
from typing import Any

from nerfstudio.configs.base_config import ViewerConfig
from nerfstudio.data.datamanagers.full_images_datamanager import FullImageDatamanagerConfig
from nerfstudio.data.dataparsers.base_dataparser import DataParserConfig
from nerfstudio.data.dataparsers.colmap_dataparser import ColmapDataParserConfig
from nerfstudio.data.dataparsers.nerfstudio_dataparser import NerfstudioDataParserConfig
from nerfstudio.engine.optimizers import AdamOptimizerConfig
from nerfstudio.engine.schedulers import ExponentialDecaySchedulerConfig
from nerfstudio.engine.trainer import TrainerConfig
from nerfstudio.plugins.types import MethodSpecification

from normlift_ns.nerfstudio_plugin.model import NormLiftModelConfig
from normlift_ns.nerfstudio_plugin.pipeline import NormLiftPipelineConfig
from normlift_ns.options import SourceOptions


def trainer_config(
    method_name: str,
    dataparser: DataParserConfig,
    model: NormLiftModelConfig,
    *,
    source: SourceOptions | None = None,
    image_scale: float = 1.0,
    **optimizers: Any,
) -> TrainerConfig:
    """Return splatfacto's trainer config with a lift at the end of training. The viewer listens on 127.0.0.1 only.

    Args:
        source: Options of the 2D features (default: those of ns-normlift).
        image_scale: Size of the training images relative to the image files.
        optimizers: Replacements for splatfacto's optimizers, by parameter name.
    """
    return TrainerConfig(
        method_name=method_name,
        steps_per_eval_image=100,
        steps_per_eval_batch=0,
        steps_per_save=2000,
        steps_per_eval_all_images=1000,
        max_num_iterations=30000,
        mixed_precision=False,
        pipeline=NormLiftPipelineConfig(
            datamanager=FullImageDatamanagerConfig(
                dataparser=dataparser, cache_images_type="uint8", camera_res_scale_factor=image_scale
            ),
            model=model,
            source=source or SourceOptions(),
        ),
        optimizers={**_splatfacto_optimizers(), **optimizers},
        viewer=ViewerConfig(num_rays_per_chunk=1 << 15, websocket_host="127.0.0.1"),
        vis="viewer",
    )


def _optimizer(lr: float, lr_final: float | None = None, **warmup: Any) -> dict[str, Any]:
    decay = lr_final and ExponentialDecaySchedulerConfig(lr_final=lr_final, max_steps=30000, **warmup)
    return {"optimizer": AdamOptimizerConfig(lr=lr, eps=1e-15), "scheduler": decay}


def _splatfacto_optimizers() -> dict[str, Any]:
    rates = {"features_dc": 0.0025, "features_rest": 0.0025 / 20, "opacities": 0.05, "scales": 0.005, "quats": 0.001}
    warmup = {"warmup_steps": 1000, "lr_pre_warmup": 0}
    return {
        "means": _optimizer(1.6e-4, 1.6e-6),
        **{name: _optimizer(rate) for name, rate in rates.items()},
        "camera_opt": _optimizer(1e-4, 5e-7, **warmup),
        "bilateral_grid": _optimizer(2e-3, 1e-4, **warmup),
    }


normlift_method = MethodSpecification(
    config=trainer_config("normlift", NerfstudioDataParserConfig(load_3D_points=True), NormLiftModelConfig()),
    description="splatfacto with open-vocabulary semantics, lifted at the end of training.",
)


# Method of `ns-train normlift-lerf-ovs`, for LERF-OVS scenes, which are COLMAP folders with images/ and sparse/0.
#
# All images are used for training, including the labeled frames, at the size of the labels. Features from LangSplat's
# preprocessing are read from language_features/ of the scene. `--pipeline.source.features none` computes features from
# the images instead.


lerf_ovs_method = MethodSpecification(
    config=trainer_config(
        "normlift-lerf-ovs",
        ColmapDataParserConfig(load_3D_points=True, colmap_path=Path("sparse/0"), downscale_factor=1, eval_mode="all"),
        NormLiftModelConfig(),
        source=SourceOptions(features="langsplat"),
    ),
    description="normlift for scenes of the LERF-OVS benchmark with LangSplat's language_features/.",
)


# Method of `ns-train normlift-scannet`, with one Gaussian per vertex of a ScanNet mesh, in the order of the vertices.
#
# The benchmark compares labels vertex by vertex. Training therefore does not move, split or cull the seed points, which
# are the vertices in `ply_file_path` of transforms.json, and keeps the coordinates of the dataset.


scannet_method = MethodSpecification(
    config=trainer_config(
        "normlift-scannet",
        NerfstudioDataParserConfig(
            load_3D_points=True,
            downscale_factor=1,
            orientation_method="none",
            center_method="none",
            auto_scale_poses=False,
            eval_mode="all",
        ),
        NormLiftModelConfig(stop_split_at=0),
        image_scale=0.5,
        means=_optimizer(0.0),
    ),
    description="normlift for ScanNet, with one fixed Gaussian per vertex of the mesh.",
)
