"""The demo room as a splatfacto run, written by nerfstudio's own trainer without training."""

from __future__ import annotations

import copy
from pathlib import Path
from typing import Any
from unittest.mock import patch

import torch
from jaxtyping import Float
from scipy.spatial.transform import Rotation
from torch import Tensor

from normlift_ns.core.gaussians import GaussianScene
from normlift_ns.demo.build import DemoRoom


def write_splatfacto_run(room: DemoRoom, capture_folder: Path, output_dir: Path) -> Path:
    """Write output_dir/<name of the capture>/splatfacto/<time> as `ns-train splatfacto` does, on the CPU, in seconds.

    The stock trainer sets up everything and saves its full checkpoint, including optimizers and schedulers. It does so
    after one step with zero gradients, which does not change the Gaussians of the room. Only the weights of the LPIPS
    metric are missing from the checkpoint.

    Args:
        capture_folder: folder written by `write_capture`. The config contains this path unchanged, relative or
            absolute.
    Returns:
        The run's config.yml.
    Raises:
        AssertionError: `capture_folder` does not exist (nerfstudio's message).
    """
    from nerfstudio.models.splatfacto import RGB2SH  # noqa: PLC0415

    config = splatfacto_config()
    config.data = config.pipeline.datamanager.data = capture_folder
    config.output_dir = output_dir
    config.machine.device_type = "cpu"
    config.vis = "tensorboard"  # the default starts a viewer
    config.max_num_iterations = 1
    config.pipeline.model.num_random = len(room.scene)
    config.set_timestamp()
    config.save_config()
    config.vis = "none"  # no training, so no log, whose thread would write until the process ends
    trainer = config.setup()
    with (
        # The metric would download its weights.
        patch("torchmetrics.image.lpip.LearnedPerceptualImagePatchSimilarity", lambda **_: torch.nn.Identity()),
        patch("nerfstudio.utils.writer.EVENT_WRITERS", []),  # global in the process; another training has its own
    ):
        trainer.setup()
    dataset = trainer.pipeline.datamanager.train_dataparser_outputs
    dataset.save_dataparser_transform(trainer.base_dir / "dataparser_transforms.json")
    scene = to_dataparser_world(room.scene, dataset.dataparser_transform, dataset.dataparser_scale)
    parameters = trainer.pipeline.model.gauss_params
    values = {
        "means": scene.means,
        "scales": scene.scales.log(),
        "quats": scene.quats,
        "opacities": scene.opacities.logit()[:, None],
        "features_dc": RGB2SH(room.colors),
        "features_rest": torch.zeros_like(parameters["features_rest"]),
    }
    for name, value in values.items():
        parameters[name].data.copy_(value)
        parameters[name].grad = torch.zeros_like(value)
    trainer.optimizers.optimizer_step_all()
    trainer.optimizers.scheduler_step_all(0)
    trainer.save_checkpoint(0)
    return trainer.base_dir / "config.yml"


def splatfacto_config() -> Any:
    """Return nerfstudio's method splatfacto without importing the list of all its methods, which takes seconds
    longer."""
    from nerfstudio.models.splatfacto import SplatfactoModelConfig  # noqa: PLC0415
    from nerfstudio.pipelines.base_pipeline import VanillaPipelineConfig  # noqa: PLC0415

    from normlift_ns.method_configs.normlift import normlift_method  # noqa: PLC0415

    config = copy.deepcopy(normlift_method.config)
    config.method_name = "splatfacto"
    config.pipeline = VanillaPipelineConfig(datamanager=config.pipeline.datamanager, model=SplatfactoModelConfig())
    return config


def to_dataparser_world(scene: GaussianScene, transform: Float[Tensor, "3 4"], scale: float) -> GaussianScene:
    """Transform the scene to the world of nerfstudio's dataparser, p' = scale (R p + t) with transform = [R | t]."""
    rotation = Rotation.from_matrix(transform[:, :3].numpy())
    means = scale * (scene.means @ transform[:, :3].T + transform[:, 3])
    quats = (rotation * Rotation.from_quat(scene.quats.roll(-1, dims=1).numpy())).as_quat()  # SciPy puts w last
    return GaussianScene(
        means, torch.from_numpy(quats).roll(1, dims=1).to(means), scale * scene.scales, scene.opacities
    )
