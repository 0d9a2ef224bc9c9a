"""Lifting of feature maps channel by channel through stock gsplat, as in Splat Feature Solver (SFS), for timing."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Sequence
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from normlift_ns.core.gaussians import Camera
from normlift_ns.core.lift import lift
from normlift_ns.errors import InputError
from normlift_ns.evaluation.baselines import seen_blocks
from normlift_ns.evaluation.protocols import EvaluatedRun
from normlift_ns.observing import Block, of_regions
from normlift_ns.raster.backend import Job
from normlift_ns.raster.gsplat import check, compiled_rasterizer, project_views
from normlift_ns.raster.rasterize import rasterize_evidence

_TIMED_VIEWS = 6
"""Number of views that are timed; each of the others would take as long."""
_CHANNELS = 32
_ROUNDS = 3


def dense_sums(
    job: Job, cameras: Sequence[Camera], maps: Iterable[Float[Tensor, "h w d"]], dimension: int
) -> Float[Tensor, "n d"]:
    """Return sum_i A_ij B_i of every Gaussian over the pixels i of all views.

    It is the gradient of gsplat's render with respect to colors: one forward pass per view, and one backward pass per
    32 channels.

    Args:
        maps: feature B_i of every pixel, for each view.
        dimension: D.
    """
    forward, backward = compiled_rasterizer()
    total = torch.zeros(len(job.scene), dimension, device=job.scene.means.device)
    blank = torch.zeros(1, len(job.scene), _CHANNELS, device=total.device)
    for camera, features in zip(cameras, maps):
        projected = project_views(job, [camera])
        splats = (projected.means2d, projected.conics, blank, projected.opacities, None, None)
        tiles = (job.settings.tile_size, projected.offsets, projected.members)
        inputs = (*splats, camera.width, camera.height, *tiles)
        _, alphas, last = forward(*inputs)
        alpha_gradient = torch.zeros_like(alphas)
        for first in range(0, dimension, _CHANNELS):
            gradient = features[None, :, :, first : first + _CHANNELS]
            padding = _CHANNELS - gradient.shape[3]
            gradient = torch.nn.functional.pad(gradient, (0, padding)).contiguous()
            sums = backward(*inputs, alphas, last, gradient, alpha_gradient, False)[3][0]
            total[:, first : first + _CHANNELS] += sums[:, : _CHANNELS - padding]
    return total


def why_not_timed(lifted: EvaluatedRun, device: str) -> str | None:
    """Return why SFS's method cannot be timed; None if it can."""
    if not device.startswith("cuda"):
        return f"it needs a GPU, because gsplat is compiled for GPUs only; this is --device {device}"
    try:
        check(_job(lifted, device))
    except InputError as error:
        return str(error)
    return None


def time_sfs_way(lifted: EvaluatedRun, device: str) -> dict[str, float]:
    """Time SFS's method and this package's, from labels and features to sums per Gaussian.

    Both process the same few views of the lift. Each time is the median of three rounds after a warm-up round. The time
    of SFS's method is also extrapolated to all views of the lift.

    Raises:
        ValueError, FileNotFoundError: as `seen_blocks`.
    """
    blocks = list(seen_blocks(lifted, device, most=_TIMED_VIEWS))
    job = _job(lifted, device)
    timed = {"dense": lambda: _dense(job, blocks), "ours": lambda: _sparse(lifted, job, blocks)}
    seconds = {name: _median_seconds(run) for name, run in timed.items()}
    views = sum(len(block.cameras) for block in blocks)
    all_views = lifted.field.manifest.get("statistics", {}).get("views", views)
    return {
        "timed_views": float(views),
        "dense512_s": seconds["dense"],
        "evidence_lift_s": seconds["ours"],
        "dense512_over_evidence_lift": seconds["dense"] / seconds["ours"],
        "dense512_all_views_s": seconds["dense"] * all_views / views,
    }


def _job(lifted: EvaluatedRun, device: str) -> Job:
    antialiased = lifted.scene.rasterize_mode == "antialiased"
    return Job(lifted.scene.gaussians.to(device), antialiased, lifted.settings, torch.float32)


def _dense(job: Job, blocks: Sequence[Block]) -> None:
    for block in blocks:
        dense_sums(job, block.cameras, feature_maps(block, job.scene.means.device), block.features[0].shape[1])


def feature_maps(block: Block, device: torch.device | str) -> Iterable[Float[Tensor, "h w d"]]:
    """Yield the feature of every pixel for each view, summed over levels; 0 without a region."""
    for labels, regions, features in zip(block.labels, block.regions, block.features):
        table = torch.nn.functional.pad(features.to(device), (0, 0, 1, 0))  # row 0: none
        cells = torch.stack([table[level.to(device).long() + 1] for level in regions]).sum(0)
        rows = torch.nn.functional.pad(cells, (0, 0, 1, 0))
        yield rows[labels.to(device).long().clamp(min=-1) + 1]


def _sparse(lifted: EvaluatedRun, job: Job, blocks: Sequence[Block]) -> None:
    for block in blocks:
        cells = rasterize_evidence(
            job.scene,
            block.cameras,
            block.labels,
            num_regions=[regions.shape[1] for regions in block.regions],
            rasterize_mode=lifted.scene.rasterize_mode,
            settings=lifted.settings,
        )
        lift(of_regions(cells, block), torch.cat(block.features).to(job.scene.means)).directions(dtype=torch.float16)


def _median_seconds(run: Callable[[], Any]) -> float:
    run()
    seconds = []
    for _ in range(_ROUNDS):
        torch.cuda.synchronize()
        start = time.perf_counter()
        run()
        torch.cuda.synchronize()
        seconds.append(time.perf_counter() - start)
    return sorted(seconds)[_ROUNDS // 2]
