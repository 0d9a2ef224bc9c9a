"""A splatfacto run as `ns-train splatfacto` writes it, made by nerfstudio's own Trainer on a CPU in a second.

`train_splatfacto` takes nerfstudio's registered configuration and runs `Trainer.setup()` and `Trainer.train()`; they
write config.yml, dataparser_transforms.json and the checkpoint (optimizers, schedulers with numpy scalars, LPIPS).
What splatfacto cannot do without a GPU, internet or system libraries is replaced while it trains (`splatfacto_on_cpu`):
gsplat by our reference rasterizer, which autograd differentiates, LPIPS, which downloads AlexNet, by a small network.
"""

import json
import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from copy import deepcopy
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np
import torch
import yaml
from PIL import Image
from torch import Tensor

from normlift_ns.core.gaussians import Camera, GaussianScene
from normlift_ns.data.nerfstudio.config import locate_run, with_absolute_paths
from normlift_ns.io.run_dir import FIELD_FOLDER
from normlift_ns.rasterization import projection
from normlift_ns.rasterization.projection import assign_tiles, prepare_gaussians, project
from normlift_ns.rasterization.rasterize import view_colors
from normlift_ns.rasterization.settings import RasterSettings

WIDTH, HEIGHT, FOCAL, K1 = 48, 36, 40.0, 0.06
"""Of the images in the dataset, before undistortion."""


@dataclass
class StockRun:
    """What is left of a training: its working directory, its config.yml, and nerfstudio's Trainer unless another
    process may have trained."""

    workspace: Path
    config: Path
    trainer: Any = None

    @cached_property
    def pipeline(self) -> Any:
        """nerfstudio's pipeline with model and datamanager, of the training or as nerfstudio loads them."""
        if self.trainer is not None:
            return self.trainer.pipeline
        with working_directory(self.workspace), splatfacto_on_cpu():
            pipeline = yaml.load(self.config.read_text(), Loader=yaml.Loader).pipeline.setup(device="cpu")
            (file,) = (self.config.parent / "nerfstudio_models").iterdir()
            stored = torch.load(file, weights_only=False)
            pipeline.load_pipeline(stored["pipeline"], stored["step"])
            _ = pipeline.datamanager.cached_train  # undistorts images and cameras
        return pipeline


def write_dataset(folder: Path, *, masks: bool = False, channels: int = 3) -> None:
    """Writes transforms.json, ten images from a circle around the origin, and sparse_pc.ply.

    Args:
        masks: with a mask per image that is 0 in its left quarter.
        channels: 3: JPEG, 4: PNG with an alpha channel that is 0 in the right quarter.
    """
    (folder / "images").mkdir(parents=True)
    rng = np.random.default_rng(0)
    suffix = "png" if channels == 4 else "jpg"
    frames = []
    for i in range(10):
        coarse = Image.fromarray(rng.integers(0, 256, (12, 16, 3), dtype=np.uint8))
        picture = np.asarray(coarse.resize((WIDTH, HEIGHT), Image.Resampling.BICUBIC))
        if channels == 4:
            picture = np.dstack([picture, np.full((HEIGHT, WIDTH), 255, np.uint8)])
            picture[:, 3 * WIDTH // 4 :, 3] = 0
        Image.fromarray(picture).save(folder / "images" / f"{i:03d}.{suffix}")
        frames.append({"file_path": f"images/{i:03d}.{suffix}", "transform_matrix": pose(i).tolist()})
        if masks:
            mask = np.full((HEIGHT, WIDTH), 255, np.uint8)
            mask[:, : WIDTH // 4] = 0
            (folder / "masks").mkdir(exist_ok=True)
            Image.fromarray(mask).save(folder / "masks" / f"{i:03d}.png")
            frames[-1]["mask_path"] = f"masks/{i:03d}.png"
    intrinsics = {"fl_x": FOCAL, "fl_y": FOCAL, "cx": WIDTH / 2, "cy": HEIGHT / 2, "w": WIDTH, "h": HEIGHT, "k1": K1}
    meta = {"camera_model": "OPENCV", **intrinsics, "ply_file_path": "sparse_pc.ply", "frames": frames}
    (folder / "transforms.json").write_text(json.dumps(meta))
    points = rng.normal(scale=0.5, size=(60, 3))
    rows = np.hstack([points, rng.integers(0, 256, (60, 3))])
    names = [f"property float {axis}" for axis in "xyz"] + [f"property uchar {c}" for c in ("red", "green", "blue")]
    header = "\n".join(["ply", "format ascii 1.0", "element vertex 60", *names, "end_header"])
    np.savetxt(folder / "sparse_pc.ply", rows, fmt=["%.4f"] * 3 + ["%d"] * 3, header=header, comments="")


def pose(i: int) -> np.ndarray:
    """Camera-to-world, OpenGL: on a wavy circle of radius 4, looking at the origin."""
    angle = 2 * np.pi * i / 10
    position = np.array([4 * np.cos(angle), 4 * np.sin(angle), 1 + 0.5 * np.sin(3 * angle)])
    back = position / np.linalg.norm(position)
    right = np.cross([0, 0, 1], back)
    right /= np.linalg.norm(right)
    return np.vstack([np.stack([right, np.cross(back, right), back, position], axis=1), [0, 0, 0, 1]])


def train_splatfacto(
    workspace: Path,
    data: Path,
    *,
    method: Any = "splatfacto",
    timestamp: str = "run",
    steps: int = 1,
    configure: Callable[[Any], object] = lambda config: None,
    prepare: Callable[[Any], object] = lambda trainer: None,
) -> StockRun:
    """`ns-train METHOD --data DATA` in the directory `workspace`.

    Args:
        method: its name, or its configuration.
        configure: changes the configuration, like flags of ns-train.
        prepare: changes the Trainer between setup and training.
    """
    from nerfstudio.configs.method_configs import method_configs  # noqa: PLC0415
    from nerfstudio.utils import writer  # noqa: PLC0415

    config: Any = deepcopy(method_configs[method] if isinstance(method, str) else method)
    config.machine.device_type = "cpu"
    config.timestamp, config.max_num_iterations = timestamp, steps
    config.data = config.pipeline.datamanager.data = data
    model = config.pipeline.model
    model.num_downscales = 0  # from the start at full resolution
    model.stop_split_at = 0  # neither densify nor cull
    configure(config)
    with working_directory(workspace), splatfacto_on_cpu():
        config.save_config()
        trainer = config.setup()
        trainer.config.vis = "none"  # no viewer, no tensorboard
        trainer.setup()
        prepare(trainer)
        trainer.train()
        writer.EVENT_WRITERS.clear()  # nerfstudio keeps those of every training in the process
        return StockRun(workspace, workspace / config.get_base_dir() / "config.yml", trainer)


@contextmanager
def splatfacto_on_cpu() -> Iterator[None]:
    """Replaces what stock splatfacto needs a GPU, the internet or system libraries for."""
    with (
        patch("nerfstudio.models.splatfacto.rasterization", rasterization),
        patch.object(torch.Tensor, "cuda", lambda tensor, *args, **kwargs: tensor),
        patch("torchmetrics.image.lpip.LearnedPerceptualImagePatchSimilarity", SmallLpips),
        patch("nerfstudio.data.dataparsers.nerfstudio_dataparser.Nerfstudio._load_3D_points", _load_points),
        torch.compiler.set_stance("force_eager"),
    ):
        yield


@contextmanager
def working_directory(folder: Path) -> Iterator[None]:
    before = Path.cwd()
    os.chdir(folder)
    try:
        yield
    finally:
        os.chdir(before)


def _load_points(parser: Any, file: Path, transform: Tensor, scale: float) -> dict[str, Tensor]:
    rows = np.loadtxt(file, skiprows=file.read_text().split("\n").index("end_header") + 1)
    points = torch.from_numpy(rows[:, :3]).float() @ transform[:, :3].T + transform[:, 3]
    return {"points3D_xyz": points * scale, "points3D_rgb": torch.from_numpy(rows[:, 3:].astype(np.uint8))}


class SmallLpips(torch.nn.Module):
    """Has weights, as LPIPS has, so that they get into the checkpoint."""

    def __init__(self, normalize: bool) -> None:
        super().__init__()
        self.net = torch.nn.Linear(3, 3)

    def forward(self, image: Tensor, target: Tensor) -> Tensor:
        return (image - target).square().mean()


def rasterization(**how: Any) -> tuple[Tensor, Tensor, dict[str, Tensor]]:
    """gsplat.rasterization of one camera, differentiable, as far as splatfacto calls it."""
    means, colors, viewmat, width, height = (how[name] for name in ("means", "colors", "viewmats", "width", "height"))
    settings, camera = RasterSettings(), Camera(how["Ks"][0], viewmat[0], width, height)
    scene = prepare_gaussians(GaussianScene(means, how["quats"], how["scales"], how["opacities"]), means.dtype)
    projected = project(scene, camera, settings, how["rasterize_mode"] == "antialiased")
    tiles = assign_tiles(projected, width, height, settings.tile_size)
    rgb = colors if how["sh_degree"] is None else view_colors(means, colors, camera, how["sh_degree"])
    depth = means @ viewmat[0, 2, :3, None] + viewmat[0, 2, 3]
    values = torch.cat([rgb, depth], dim=1)[projected.gaussian]
    image, alpha = projection.composite(projected, tiles, values, width, height, settings)
    alpha = alpha[..., None]
    channels = [image[..., :-1]]
    if how["render_mode"] == "RGB+ED":
        channels.append(image[..., -1:] / alpha.clamp(min=1e-10))
    return torch.cat(channels, dim=-1)[None], alpha[None], {"means2d": projected.means2d}


def relocate_config(config: Any, path: Path) -> Any:
    """Make the paths of a loaded config absolute, for `eval_setup` from any directory."""
    location = locate_run(config, path)
    config = with_absolute_paths(config, location)
    if getattr(config.pipeline.model, "semantics", None) is not None:
        config.pipeline.model.semantics = location.run_dir / FIELD_FOLDER
    return config
