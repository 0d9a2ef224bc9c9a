"""A small trainer of 2D Gaussian splatting, with the rasterizer and the densification of gsplat 1.4, on a GPU.

    python -m research.train_2dgs FOLDER fox tabletop castle

trains on captures of the folder `shared` and writes, as gsplat's simple_trainer_2dgs.py does, FOLDER/NAME/cfg.json and
FOLDER/NAME/ckpts/ckpt_<step>.pt, and the PSNR to FOLDER/NAME/stats.json.
"""

from __future__ import annotations

import argparse
import json
import math
import time
from pathlib import Path
from typing import Any

import numpy as np
import torch
from plyfile import PlyData
from scipy.spatial import KDTree
from torch import Tensor

from normlift_ns.core.gaussians import SH_C0
from normlift_ns.core.scene import View
from normlift_ns.data.cameras import read_camera_file
from normlift_ns.data.frames import transform_frames
from normlift_ns.data.images import held_out_names
from normlift_ns.data.open_scene import split_views
from normlift_ns.data.transforms import read_world_transform
from normlift_ns.options import SplatOptions
from tests.captures import SHARED

CLIP_PLANES, SH_DEGREE, SSIM_SHARE, MOST = (0.05, 200.0), 1, 0.2, 150_000
CAPTURES = SHARED / "captures"


def splat_options(name: str) -> SplatOptions:
    """Return options that read the cameras of a capture in the world of its splatfacto run."""
    world = CAPTURES / "outputs" / name / "splatfacto" / "run" / "dataparser_transforms.json"
    return SplatOptions(
        transforms=CAPTURES / name / "transforms.json",
        world_transform=world,
        eval_images=("0.1",),
        gsplat_normalize=False,
    )


def read_capture(name: str) -> tuple[list[View], list[View], Tensor, Tensor]:
    """Return training views, held-out views, points in the world of the cameras, and their colors in 0..1."""
    options = splat_options(name)
    cameras = read_camera_file(options)
    world = read_world_transform(options.world_transform, cameras.applied_transform, cameras.applied_scale)  # type: ignore[arg-type]
    held_out = held_out_names(
        [frame.name for frame in cameras.frames], test_every=None, eval_images=options.eval_images
    )
    parts = split_views(transform_frames(cameras.frames, world), held_out, "black")
    vertices = PlyData.read(str(CAPTURES / name / "sparse_pc.ply"))["vertex"]
    points = np.stack([vertices[axis] for axis in "xyz"], 1).astype(np.float64)
    points = (points @ world.transform[:, :3].T + world.transform[:, 3]) * world.scale
    colors = np.stack([vertices[channel] for channel in ("red", "green", "blue")], 1) / 255
    train, rest = ([views[index] for index in range(len(views))] for views in parts)
    return train, rest, torch.from_numpy(points).float(), torch.from_numpy(colors).float()


def first_splats(points: Tensor, colors: Tensor, scale: float) -> tuple[torch.nn.ParameterDict, dict[str, Any]]:
    """Return initial parameters by gsplat's names, with the distance to neighbors as size, and an optimizer for
    each."""
    distance, _ = KDTree(points.numpy()).query(points.numpy(), k=4)
    size = torch.from_numpy(np.sqrt((distance[:, 1:] ** 2).mean(1)).clip(1e-6)).float().log()
    n = len(points)
    torch.manual_seed(0)
    values = {
        "means": (points, 1.6e-4 * scale),
        "scales": (size[:, None].repeat(1, 3), 5e-3),
        "quats": (torch.rand(n, 4), 1e-3),
        "opacities": (torch.full((n,), math.log(0.1 / 0.9)), 5e-2),
        "sh0": (((colors - 0.5) / SH_C0)[:, None], 2.5e-3),
        "shN": (torch.zeros(n, (SH_DEGREE + 1) ** 2 - 1, 3), 2.5e-3 / 20),
    }
    splats = torch.nn.ParameterDict({name: value.cuda() for name, (value, _) in values.items()})
    rates = {name: rate for name, (_, rate) in values.items()}
    return splats, {name: torch.optim.Adam([splats[name]], lr=rate, eps=1e-15) for name, rate in rates.items()}


def render(splats: torch.nn.ParameterDict, view: View) -> tuple[Tensor, dict[str, Any]]:
    """Return the image [H, W, 3] on black, and the data that gsplat's strategies need."""
    from gsplat import rasterization_2dgs  # noqa: PLC0415 (needs a GPU)

    camera = view.camera
    image, *_, info = rasterization_2dgs(
        splats["means"], splats["quats"], splats["scales"].exp(), splats["opacities"].sigmoid(),
        torch.cat([splats["sh0"], splats["shN"]], 1), camera.world_to_camera.float().cuda()[None],
        camera.K.float().cuda()[None], camera.width, camera.height, near_plane=CLIP_PLANES[0],
        far_plane=CLIP_PLANES[1], sh_degree=SH_DEGREE,
    )  # fmt: skip
    return image[0], info


def mean_psnr(splats: torch.nn.ParameterDict, views: list[View]) -> float:
    """Return the mean PSNR of images in 0..1, in dB."""
    with torch.no_grad():
        errors = [(render(splats, view)[0].clamp(0, 1) - view.image.cuda() / 255).square().mean() for view in views]
    return float((-10 * torch.stack(errors).log10()).mean())


def train(name: str, folder: Path, steps: int) -> None:
    """Train on one capture, and write checkpoint, settings and PSNR."""
    from gsplat.strategy import DefaultStrategy  # noqa: PLC0415 (needs a GPU)
    from pytorch_msssim import ssim  # noqa: PLC0415

    start = time.perf_counter()
    views, held_out, points, colors = read_capture(name)
    images = [(view.image.cuda() / 255).permute(2, 0, 1)[None] for view in views]
    centers = torch.stack([view.camera.world_to_camera.double().inverse()[:3, 3] for view in views])
    scale = 1.1 * float((centers - centers.mean(0)).norm(dim=1).max())
    splats, optimizers = first_splats(points, colors, scale)
    strategy = DefaultStrategy(refine_stop_iter=steps * 2 // 3, reset_every=10**9, key_for_gradient="gradient_2dgs")
    strategy.check_sanity(splats, optimizers)
    state = strategy.initialize_state(scene_scale=scale)
    decay = torch.optim.lr_scheduler.ExponentialLR(optimizers["means"], gamma=0.01 ** (1 / steps))
    order, turn = torch.Generator().manual_seed(0), list[int]()
    for step in range(steps):
        if step % len(views) == 0:
            turn = torch.randperm(len(views), generator=order).tolist()
        index = turn[step % len(views)]
        image, info = render(splats, views[index])
        strategy.step_pre_backward(splats, optimizers, state, step, info)
        image = image.permute(2, 0, 1)[None]
        loss = (1 - SSIM_SHARE) * (image - images[index]).abs().mean()
        loss = loss + SSIM_SHARE * (1 - ssim(image, images[index], data_range=1.0))
        loss.backward()
        if len(splats["means"]) < MOST:
            strategy.step_post_backward(splats, optimizers, state, step, info)
        for optimizer in optimizers.values():
            optimizer.step()
            optimizer.zero_grad(set_to_none=True)
        decay.step()
    result = folder / name
    (result / "ckpts").mkdir(parents=True, exist_ok=True)
    tensors = {key: value.detach().cpu() for key, value in splats.items()}
    torch.save({"step": steps - 1, "splats": tensors}, result / "ckpts" / f"ckpt_{steps - 1}.pt")
    near_plane, far_plane = CLIP_PLANES
    settings = {"data_dir": name, "result_dir": name, "model_type": "2dgs", "antialiased": False}
    settings |= {"near_plane": near_plane, "far_plane": far_plane}
    (result / "cfg.json").write_text(json.dumps(settings))
    stats = {
        "gaussians": len(splats["means"]),
        "psnr_train": mean_psnr(splats, views),
        "psnr_held_out": mean_psnr(splats, held_out),
        "seconds": time.perf_counter() - start,
    }
    (result / "stats.json").write_text(json.dumps(stats))
    print(name, stats, flush=True)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path, help="folder of the results")
    parser.add_argument("names", nargs="+", help="captures")
    parser.add_argument("--steps", type=int, default=5000, help="steps of the training")
    arguments = parser.parse_args()
    for capture in arguments.names:
        train(capture, arguments.folder, arguments.steps)
