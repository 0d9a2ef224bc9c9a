"""Method of `ns-train normlift-scannet`: one Gaussian per vertex of a ScanNet mesh, at its position and in its order.

The benchmark compares labels vertex by vertex. Training therefore does not move, split or cull the seed points
(`ply_file_path` of transforms.json: the vertices), and keeps the coordinates of the dataset.
"""

from nerfstudio.data.dataparsers.nerfstudio_dataparser import NerfstudioDataParserConfig
from nerfstudio.engine.optimizers import AdamOptimizerConfig
from nerfstudio.plugins.types import MethodSpecification

from normlift_ns.method_configs.normlift import trainer_config
from normlift_ns.nerfstudio_plugin.model import NormLiftModelConfig

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
        means={"optimizer": AdamOptimizerConfig(lr=0.0, eps=1e-15), "scheduler": None},
    ),
    description="normlift with frozen points, for ScanNet: Gaussian i is vertex i.",
)
