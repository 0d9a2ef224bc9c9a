"""Method of `ns-train normlift-lerf-ovs`, for scenes of LERF-OVS: COLMAP folders with images/ and sparse/0.

All images are used for training, including the labeled frames, at the size of the labels. Features are read from
language_features/ of the scene, as written by LangSplat's preprocessing. `--pipeline.source.features none` computes
them from the images instead.
"""

from pathlib import Path

from nerfstudio.data.dataparsers.colmap_dataparser import ColmapDataParserConfig
from nerfstudio.plugins.types import MethodSpecification

from normlift_ns.method_configs.normlift import trainer_config
from normlift_ns.nerfstudio_plugin.model import NormLiftModelConfig
from normlift_ns.options import SourceOptions

lerf_ovs_method = MethodSpecification(
    config=trainer_config(
        "normlift-lerf-ovs",
        ColmapDataParserConfig(load_3D_points=True, colmap_path=Path("sparse/0"), downscale_factor=1, eval_mode="all"),
        NormLiftModelConfig(),
        source=SourceOptions(features="langsplat"),
    ),
    description="normlift for scenes of the LERF-OVS benchmark: COLMAP folders with LangSplat's language_features/.",
)
