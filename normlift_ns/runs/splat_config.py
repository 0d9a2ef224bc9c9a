"""The config.yml of a run lifted from a PLY file or gsplat checkpoint, for which nerfstudio has written none."""

from __future__ import annotations

from pathlib import Path

from normlift_ns.runs.files import FIELD_FOLDER
from normlift_ns.scenes.nerfstudio.classes import (
    NormLiftModelConfig,
    TrainerConfig,
    VanillaPipelineConfig,
    ViewerConfig,
)
from normlift_ns.scenes.nerfstudio.data_classes import FullImageDatamanagerConfig, NerfstudioDataParserConfig
from normlift_ns.scenes.opening import SplatScene
from normlift_ns.scenes.saved import CHECKPOINT_FOLDER, TRANSFORMS_FILE


def splat_config(scene: SplatScene, run_dir: Path) -> TrainerConfig:
    """Return a config with which stock nerfstudio loads the cameras in the run directory without transforming them.

    All paths except that of the field are absolute, because there is no training directory for relative paths.
    """
    cameras = run_dir / TRANSFORMS_FILE
    dataparser = NerfstudioDataParserConfig(
        data=cameras,
        downscale_factor=1,
        orientation_method="none",
        center_method="none",
        auto_scale_poses=False,
        eval_mode="all",
        load_3D_points=False,
    )
    model = NormLiftModelConfig(
        sh_degree=max(1, scene.splat.degree),
        background_color=scene.background_name,
        rasterize_mode=scene.rasterize_mode,
        semantics=Path(FIELD_FOLDER),
    )
    datamanager = FullImageDatamanagerConfig(
        data=cameras,
        dataparser=dataparser,
        cache_images="gpu",  # means the pipeline's device; "cpu" would pin memory, which needs CUDA
        cache_images_type="uint8",
    )
    return TrainerConfig(
        method_name="normlift",
        experiment_name=scene.name,
        output_dir=run_dir.parents[2],
        timestamp=run_dir.name,
        relative_model_dir=Path(CHECKPOINT_FOLDER),
        data=cameras,
        pipeline=VanillaPipelineConfig(datamanager=datamanager, model=model),
        viewer=ViewerConfig(num_rays_per_chunk=1 << 15),
        vis="viewer",
    )
