"""config.yml of a lifted run that came from a splat, for which nerfstudio has none."""

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
    """A config by which stock nerfstudio finds the cameras in the directory of the run, and leaves them as they are.

    Paths but that of the field are absolute: there is no directory of a training that they could be relative to.
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
        cache_images="gpu",  # that is, on the pipeline's device; "cpu" pins memory, which needs CUDA
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
