"""Images and masks of the demo room as a nerfstudio dataset, and a splatfacto run on this dataset."""

from __future__ import annotations

import copy
import json
import math
from pathlib import Path
from typing import Any
from unittest.mock import patch

import torch
from jaxtyping import Float, UInt8
from PIL import Image
from scipy.spatial.transform import Rotation
from torch import Tensor

from normlift_ns.core.gaussians import Camera, GaussianScene, facing_pose
from normlift_ns.demo.room import DemoRoom
from normlift_ns.io.atomic import atomic_file, write_text_file
from normlift_ns.rasterization.rasterize import render, render_views

WIDTH, HEIGHT = 400, 300
"""Size of an image, in pixels."""
_FIELD_OF_VIEW = 75.0
"""Horizontal field of view, in degrees."""


def demo_cameras(count: int = 24, width: int = WIDTH, height: int = HEIGHT) -> list[Camera]:
    """Return cameras on a circle inside the room, at three alternating heights, that point at the table.

    Sizes are in pixels.
    """
    return [
        _look_at((1.4, 360 * i / count, (1.0, 1.35, 1.7)[i % 3]), (0, 0, (0.55, 0.45, 0.35)[i % 3]), width, height)
        for i in range(count)
    ]


def held_out_cameras(count: int = 4, width: int = WIDTH, height: int = HEIGHT) -> list[Camera]:
    """Return cameras for evaluation, on a different circle from that of `demo_cameras`."""
    return [_look_at((1.25, 360 * (i + 0.4) / count, 1.5), (0, 0, 0.4), width, height) for i in range(count)]


def view_image(room: DemoRoom, camera: Camera) -> UInt8[Tensor, "h w 3"]:
    """Render the room from a camera, in sRGB with values in 0..255, on a black background."""
    return _image(render(room.scene, camera, room.colors)[0])


def view_labels(room: DemoRoom, camera: Camera) -> UInt8[Tensor, "h w"]:
    """Return the true class of each pixel, as 1 + index into `room.names`, or 0 for a pixel that is at most half
    covered.

    The class of a pixel is the class with the largest sum of compositing weights. Floaters do not count.
    """
    return _labels(render(room.scene, camera, _one_hot(room))[0])


def write_capture(
    room: DemoRoom, folder: Path, views: int = 24, held_out: int = 4, width: int = WIDTH, height: int = HEIGHT
) -> None:
    """Write a nerfstudio dataset with true masks, and replace existing files.

    The dataset consists of transforms.json, images/0000.png …, instance/0000.png … with the labels of `view_labels`,
    and labels.json with {"labels": {"1": name, …}, "background": 0}. Images have no distortion. The held-out views come
    last, and form the "val" and "test" splits.
    """
    cameras = [*demo_cameras(views, width, height), *held_out_cameras(held_out, width, height)]
    paths = [f"images/{i:04d}.png" for i in range(len(cameras))]
    channels = torch.cat([room.colors, _one_hot(room)], dim=1)
    for path, (pixels, _) in zip(paths, render_views(room.scene, cameras, channels)):
        color, shares = pixels.tensor_split([3], dim=2)
        for file, picture in ((path, _image(color)), (f"instance/{Path(path).name}", _labels(shares))):
            with atomic_file(folder / file, overwrite=True, own=True) as draft:
                Image.fromarray(picture.numpy()).save(draft, compress_level=1)
    (fx, _, cx), (_, fy, cy), _ = cameras[0].K.tolist()
    transforms = {
        "camera_model": "OPENCV",
        **{"fl_x": fx, "fl_y": fy, "cx": cx, "cy": cy, "w": width, "h": height},
        **dict.fromkeys(("k1", "k2", "p1", "p2"), 0.0),
        "train_filenames": paths[:views],
        "val_filenames": paths[views:],
        "test_filenames": paths[views:],
        "frames": [{"file_path": p, "transform_matrix": c.camera_to_world().tolist()} for p, c in zip(paths, cameras)],
    }
    labels = {"labels": {str(i): name for i, name in enumerate(room.names, 1)}, "background": 0}
    for name, content in (("transforms.json", transforms), ("labels.json", labels)):
        write_text_file(folder / name, json.dumps(content, indent=1), overwrite=True, own=True)


def _one_hot(room: DemoRoom) -> Float[Tensor, "n classes"]:
    """Return the class of each Gaussian as a one-hot row, or a zero row for a floater."""
    return torch.nn.functional.one_hot(room.labels + 1, len(room.names) + 1)[:, 1:].to(room.colors.dtype)


def _image(color: Float[Tensor, "h w 3"]) -> UInt8[Tensor, "h w 3"]:
    return (color.clamp(0, 1) * 255).round().byte()


def _labels(shares: Float[Tensor, "h w classes"]) -> UInt8[Tensor, "h w"]:
    return torch.where(shares.sum(dim=2) > 0.5, shares.argmax(dim=2) + 1, 0).byte()


def _look_at(
    position: tuple[float, float, float], target: tuple[float, float, float], width: int, height: int
) -> Camera:
    """Return a camera that points at a target.

    Args:
        position: Horizontal distance from the center of the room in meters, azimuth in degrees, and height in meters.
        target: Position (x, y, z) in meters.
        width: Width of the image in pixels.
        height: Height of the image in pixels.
    """
    distance, azimuth, up = position[0], math.radians(position[1]), position[2]
    eye = torch.tensor([distance * math.cos(azimuth), distance * math.sin(azimuth), up], dtype=torch.float64)
    pose = facing_pose(eye, eye.new_tensor(target), eye.new_tensor([0, 0, 1]))
    focal = width / 2 / math.tan(math.radians(_FIELD_OF_VIEW) / 2)
    K = torch.tensor([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]])
    return Camera(K, pose.float(), width, height)


def write_splatfacto_run(room: DemoRoom, capture_folder: Path, output_dir: Path) -> Path:
    """Write a run like that of `ns-train splatfacto` to output_dir/<capture>/splatfacto/<time>.

    This takes seconds on a CPU. nerfstudio's own trainer saves its full checkpoint, including optimizers and
    schedulers. It does so after one step with zero gradients, which does not change the Gaussians of the room. The
    checkpoint lacks only the weights of the LPIPS metric.

    Args:
        capture_folder: Folder from `write_capture`. The config contains this path unchanged, relative or absolute.
    Returns:
        The path of the run's config.yml.
    Raises:
        AssertionError: `capture_folder` does not exist; nerfstudio raises this error.
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
    config.vis = "none"  # no log is needed, and its thread would write until the process ends
    trainer = config.setup()
    with (
        # The metric would download its weights.
        patch("torchmetrics.image.lpip.LearnedPerceptualImagePatchSimilarity", lambda **_: torch.nn.Identity()),
        patch("nerfstudio.utils.writer.EVENT_WRITERS", []),  # keep the writers of other training runs in this process
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
    """Return the config of nerfstudio's method splatfacto, without the slow import of nerfstudio's list of methods."""
    from nerfstudio.models.splatfacto import SplatfactoModelConfig  # noqa: PLC0415
    from nerfstudio.pipelines.base_pipeline import VanillaPipelineConfig  # noqa: PLC0415

    from normlift_ns.method_configs.normlift import normlift_method  # noqa: PLC0415

    config = copy.deepcopy(normlift_method.config)
    config.method_name = "splatfacto"
    config.pipeline = VanillaPipelineConfig(datamanager=config.pipeline.datamanager, model=SplatfactoModelConfig())
    return config


def to_dataparser_world(scene: GaussianScene, transform: Float[Tensor, "3 4"], scale: float) -> GaussianScene:
    """Transform a scene to the world of nerfstudio's data parser, p' = scale (R p + t) for transform = [R | t]."""
    rotation = Rotation.from_matrix(transform[:, :3].numpy())
    means = scale * (scene.means @ transform[:, :3].T + transform[:, 3])
    quats = (rotation * Rotation.from_quat(scene.quats.roll(-1, dims=1).numpy())).as_quat()  # SciPy puts w last
    return GaussianScene(
        means, torch.from_numpy(quats).roll(1, dims=1).to(means), scale * scene.scales, scene.opacities
    )
