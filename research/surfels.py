"""2D Gaussian splatting on a GPU: weights against those of gsplat 1.4's kernels, evidence and lift against its render.

    python -m research.train_2dgs FOLDER fox tabletop castle
    python -m research.surfels FOLDER fox tabletop castle

Writes results/surfels.json. The weights of the first view are compared pixel by pixel: gsplat renders one-hot colors of
all Gaussians in view, 128 at a time. All views are compared by random combinations of the weights (weights.norm).
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from normlift_ns import Camera, GaussianScene, RasterSettings, lift, rasterize_evidence, render
from normlift_ns.data.open_splat import open_splat
from normlift_ns.kernels.compositing import AlphaLimits, composite
from normlift_ns.rasterization.rasterize import RasterJob
from normlift_ns.rasterization.triton import project_and_bin
from research.gpu_cases import CELL, Case, features, grid_labels, once
from research.report import RESULTS, Report
from research.train_2dgs import splat_options

CHANNELS, ROUNDS = 128, 7


class StockView:
    """One view with gsplat's own projection, lists and kernel."""

    def __init__(self, scene: GaussianScene, camera: Camera, settings: RasterSettings) -> None:
        from gsplat.cuda._wrapper import fully_fused_projection_2dgs, isect_offset_encode, isect_tiles  # noqa: PLC0415

        pose, K = camera.world_to_camera.float().cuda()[None], camera.K.float().cuda()[None]
        self.width, self.height = camera.width, camera.height
        arrays: Any = fully_fused_projection_2dgs(
            scene.means, scene.quats, scene.scales, pose, K, self.width, self.height, near_plane=settings.near_plane,
            far_plane=settings.far_plane,
        )  # fmt: skip
        self.radii, self.means2d, depths, self.transforms, self.normals = arrays
        across, down = -(-self.width // 16), -(-self.height // 16)
        _, keys, self.members = isect_tiles(self.means2d, self.radii, depths, 16, across, down)
        self.offsets = isect_offset_encode(keys, 1, across, down)
        self.opacities = scene.opacities[None].contiguous()

    def composite(self, colors: Tensor) -> tuple[Tensor, Tensor]:
        """Return the image [H, W, C] and alpha [H, W] of colors [N, C]."""
        from gsplat.cuda._wrapper import rasterize_to_pixels_2dgs  # noqa: PLC0415

        image, alpha, *_ = rasterize_to_pixels_2dgs(
            self.means2d, self.transforms, colors[None].contiguous(), self.opacities, self.normals,
            torch.zeros_like(self.means2d), self.width, self.height, 16, self.offsets, self.members,
        )  # fmt: skip
        return image[0], alpha[0, :, :, 0]


def one_hot(rows: Tensor, n: int) -> Tensor:
    """Return colors [N, CHANNELS] that give every row a separate channel."""
    colors = torch.zeros(n, CHANNELS, device="cuda")
    colors[rows, torch.arange(len(rows), device="cuda")] = 1
    return colors


def weight_errors(scene: GaussianScene, camera: Camera, settings: RasterSettings) -> dict[str, float]:
    """Return differences of the weights of every Gaussian in every pixel, and in every region of 60 x 60 pixels.

    They are the largest absolute difference (pixel, region), the relative Frobenius norm (pixel_rel, region_rel) and
    the number of pairs of a Gaussian and a pixel that differ by more than 1e-5 (differing).
    """
    stock, n = StockView(scene, camera, settings), len(scene)
    labels = grid_labels(camera).cuda()
    count = int(labels.max()) + 1
    evidence = rasterize_evidence(scene, [camera], [labels], num_regions=[count], settings=settings)
    rows = evidence.rows
    ours = torch.zeros(n, count, device="cuda")
    ours[rows.row_index(), rows.column.long()] = rows.weight
    job = RasterJob(scene, False, settings, torch.float32, 1)
    grid, projected, lists = project_and_bin(job, [camera])
    limits = AlphaLimits(*(getattr(settings, name) for name in AlphaLimits._fields))
    largest, sums = (torch.zeros(size, device="cuda", dtype=torch.float64) for size in (2, 5))
    for part in stock.members.long().unique().split(CHANNELS):
        colors = one_hot(part, n)
        theirs, _ = stock.composite(colors)
        exact = region_sums(theirs)[:, : len(part)].T
        pixels, _ = composite(projected.splats, lists, projected.keys, colors, grid, limits)
        pixels, apart = (pixels - theirs).abs(), (ours[part] - exact).abs()
        largest = torch.maximum(largest, torch.stack([pixels.max().double(), apart.max()]))
        norms = torch.stack([torch.linalg.vector_norm(x, dtype=torch.float64) for x in (pixels, theirs, apart, exact)])
        sums += torch.cat([norms.square(), (pixels > 1e-5).sum()[None]])
    pixel, all_pixels, region, all_regions, differing = sums.tolist()
    return {
        "pixel": float(largest[0]),
        "pixel_rel": (pixel / all_pixels) ** 0.5,
        "differing": differing,
        "region": float(largest[1]),
        "region_rel": (region / all_regions) ** 0.5,
    }


def region_sums(image: Tensor) -> Tensor:
    """Return float64 sums [R, C] of an image [H, W, C] over the regions of `grid_labels`."""
    height, width, channels = image.shape
    padded = torch.nn.functional.pad(image, (0, 0, 0, -width % CELL, 0, -height % CELL))
    cells = padded.view(padded.shape[0] // CELL, CELL, padded.shape[1] // CELL, CELL, channels)
    return cells.sum(dim=(1, 3), dtype=torch.float64).flatten(0, 1)


def norm_of_errors(scene: GaussianScene, camera: Camera, settings: RasterSettings) -> float:
    """Return an upper estimate of the largest norm, over pixels, of the differences of the weights of all Gaussians.

    No single difference exceeds it. The norm is estimated by random combinations: if every Gaussian has a random sign
    as its color, the squared difference of two renders is on average the squared norm. The estimate from 128
    combinations is at least two thirds of the norm in all but one of 10^7 pixels, so the function returns 1.5 times the
    estimate.
    """
    signs = torch.randint(0, 2, (len(scene), CHANNELS), device="cuda").mul(2).sub(1).float()
    theirs, _ = StockView(scene, camera, settings).composite(signs)
    image, _ = render(scene, camera, signs, settings=settings)
    return 1.5 * float((image - theirs).square().mean(dim=2).max().sqrt())


def stock_renders(case: Case, settings: RasterSettings) -> dict[str, Callable[[], None]]:
    """Return functions for the RGB render of all views by gsplat, and for its kernels alone."""
    from gsplat import rasterization_2dgs  # noqa: PLC0415

    scene, colors = case.scene, torch.rand(len(case.scene), 3, device="cuda")
    poses = torch.stack([camera.world_to_camera.float() for camera in case.cameras]).cuda()
    intrinsics = torch.stack([camera.K.float() for camera in case.cameras]).cuda()

    def rgb() -> None:
        for v, camera in enumerate(case.cameras):
            rasterization_2dgs(
                scene.means, scene.quats, scene.scales, scene.opacities, colors, poses[v : v + 1],
                intrinsics[v : v + 1], camera.width, camera.height, near_plane=settings.near_plane,
                far_plane=settings.far_plane,
            )  # fmt: skip

    def kernels() -> None:
        for camera in case.cameras:
            StockView(scene, camera, settings).composite(colors)

    return {"rgb": rgb, "rgb_kernels": kernels}


def measure(report: Report, name: str, folder: Path) -> None:
    """Add the metrics NAME.* of a trained scene."""
    checkpoint = next((folder / name / "ckpts").glob("*.pt"))
    opened = open_splat(checkpoint, splat_options(name), say=print)
    scene, settings = opened.gaussians.to("cuda"), RasterSettings.recorded(opened.identity)
    assert scene.primitive == "2dgs"
    cameras = list(opened.train.cameras)
    case = Case(name, scene, cameras, [grid_labels(camera).cuda() for camera in cameras])

    def add(key: str, value: Any, unit: str, error: Any = None) -> None:
        report.add(f"{name}.{key}", value, unit, error)

    stats = json.loads((folder / name / "stats.json").read_text())
    add("gaussians", len(scene), "")
    add("views", len(cameras), "")
    add("psnr_train", stats["psnr_train"], "dB")
    add("psnr_held_out", stats["psnr_held_out"], "dB")
    for key, error in weight_errors(scene, cameras[0], settings).items():
        add(f"weights.{key}", error, "of the first view")
    norms = [norm_of_errors(scene, camera, settings) for camera in cameras]
    add("weights.norm", max(norms), "largest of all views")
    steps: dict[str, Callable[[], Any]] = dict(stock_renders(case, settings))
    table = features(sum(case.counts))
    evidence = case.evidence(settings=settings)
    lifted = lift(evidence, table)
    steps["evidence"] = lambda: case.evidence(settings=settings)
    steps["reliability"] = lambda: lift(evidence, table)
    steps["directions"] = lambda: lifted.directions(dtype=torch.float16)
    seconds: dict[str, list[float]] = {key: [] for key in steps}
    for turn in range(ROUNDS + 1):
        for key, step in steps.items():
            spent = once(step)
            if turn > 0:  # the first one warms up
                seconds[key].append(spent)
    for key, spent in seconds.items():
        add(f"{key}_s", sorted(spent)[ROUNDS // 2], "s, median of the turns")
    for key in ("rgb", "rgb_kernels"):
        parts = zip(*(seconds[part] for part in ("evidence", "reliability", "directions", key)))
        ratios = sorted((e + r + d) / whole for e, r, d, whole in parts)
        add(f"evidence_lift_over_{key}", ratios[ROUNDS // 2], "times the render of the same turn, median")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path, help="folder that research.train_2dgs wrote")
    parser.add_argument("names", nargs="+", help="captures")
    parser.add_argument("--output", type=Path, default=RESULTS, help="folder of the JSON file")
    arguments = parser.parse_args()
    results = Report("surfels")
    with torch.no_grad():
        for capture in arguments.names:
            measure(results, capture, arguments.folder)
    results.write(arguments.output)
