"""Baselines that apply the lifting ideas of other methods to the scene, regions and features of a run.

Each baseline implements only the idea that distinguishes the method from a plain lift. It is not the authors' code.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import replace
from functools import partial
from typing import Any, Literal

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.nn.functional import normalize

from normlift_ns.core.consensus import consensus
from normlift_ns.core.evidence import MASKED, Evidence
from normlift_ns.core.field import SemanticField
from normlift_ns.core.gaussians import Camera, GaussianScene
from normlift_ns.core.lift import lift
from normlift_ns.core.lowrank import StoredDirections, StoredEvidence
from normlift_ns.core.sparse import SparseRows, row_offsets
from normlift_ns.encoders.build import restore_source
from normlift_ns.encoders.cache import cached
from normlift_ns.errors import InputError
from normlift_ns.evaluation.protocols import EvaluatedRun, Rasterize, rasterizer
from normlift_ns.evidence_collection import (
    ViewBatch,
    ViewObservations,
    cells_to_regions,
    chunk_views,
    observe_views,
    sample_evenly,
)
from normlift_ns.options import LiftOptions
from normlift_ns.pipeline import consensus_options, lift_features, min_agreement
from normlift_ns.rasterization.gsplat import check, compiled_rasterizer, project_views
from normlift_ns.rasterization.rasterize import RasterJob

Baseline = Literal["sfs", "occam", "vala", "drsplat"]
BASELINES: dict[Baseline, str] = {
    "sfs": "A^2 weights, idea of Splat Feature Solver",
    "occam": "center pixels, idea of Occam's LGS",
    "vala": "gated median, idea of VALA",
    "drsplat": "10 largest weights per ray, idea of Dr.Splat",
}
"""Description of every baseline in the table."""
TOP = 10
"""Number of Gaussians per ray that the baseline "drsplat" uses."""
VISIBLE = 0.1
"""Smallest weight of a Gaussian in a view that the baseline "vala" uses, relative to its largest weight in any view."""
_RAYS = 2**17
"""Number of rays to process at a time."""
_BLOCK = 2**12
"""Number of Gaussians whose medians are computed at a time."""


def baseline_field(name: Baseline, lifted: EvaluatedRun, device: str) -> SemanticField:
    """Lift a run again with a baseline, and return the unrefined field on the CPU.

    Raises:
        ValueError, FileNotFoundError: If the features of the run are not available (see `lifted_batches`).
    """
    evidence, features, _ = _observe_again(lifted, device, _CELL_EVIDENCE[name])
    options = lifted.field.manifest.get("options", {})
    scalars = lift(evidence, features, unlabeled=options.get("unlabeled", "ignore")).scalars.to("cpu")
    own, manifest = torch.arange(evidence.num_gaussians, dtype=torch.int32), {"dimension": features.shape[1]}
    if name != "vala":
        return SemanticField(scalars, own, StoredEvidence(evidence.to("cpu"), features.cpu()), manifest)
    rows = torch.cat([medians.half().cpu() for _, medians in iter_medians(evidence, features)])
    valid = (rows != 0).any(dim=1)
    scalars = replace(scalars, norm=valid.to(scalars.norm))
    return SemanticField(scalars, own, StoredDirections(rows[valid], None), manifest)


def with_consensus(lifted: EvaluatedRun, enabled: bool, device: str) -> EvaluatedRun:
    """Return the run with or without consensus.

    If the run has the other setting, it is lifted again from its regions and features, without refinement.

    Raises:
        ValueError, FileNotFoundError: If the features of the run are not available (see `lifted_batches`).
    """
    manifest = lifted.field.manifest
    options = manifest.get("options", {})
    if options.get("consensus", False) == enabled:
        return lifted
    views = _observe_again(lifted, device, partial(_plain, power=options.get("weight_power", 1)))
    names = ("reliability_beta", "unlabeled", "consensus_power", "consensus_sample", "consensus_min_agreement")
    given: dict[str, Any] = {name: options[name] for name in names if options.get(name) is not None}
    relift, table = LiftOptions(consensus=enabled, **given), views.features
    relift = replace(relift, consensus_min_agreement=min_agreement(relift, manifest.get("features", {})))
    if enabled:
        table = consensus(views.evidence, table, level=views.level, **consensus_options(relift)).features
    result, _ = lift_features(views, table, relift)
    own = torch.arange(views.evidence.num_gaussians, dtype=torch.int32)
    store = StoredEvidence(views.evidence.to("cpu"), result.features.cpu())
    manifest = {**manifest, "options": {**options, "consensus": enabled}}
    return replace(lifted, field=SemanticField(result.scalars.to("cpu"), own, store, manifest), refined=False)


def _observe_again(
    lifted: EvaluatedRun, device: str, cells: Callable[[Rasterize, GaussianScene, ViewBatch], Evidence]
) -> ViewObservations:
    """Return evidence, features and levels of the regions of the lift; `cells` computes the evidence of their cells."""
    gaussians = lifted.scene.gaussians.to(device)
    rasterize = rasterizer(lifted.scene, lifted.settings, gaussians)
    views = ViewObservations.merge(
        ViewObservations.of_block(block, cells_to_regions(cells(rasterize, gaussians, block), block))
        for block in lifted_batches(lifted, device)
    )
    return views._replace(features=views.features.to(device))


def lifted_batches(lifted: EvaluatedRun, device: str, *, max_views: int | None = None) -> Iterator[ViewBatch]:
    """Yield cameras, labels and features of the views of the lift, a few views at a time.

    Args:
        device: Device of the networks.
        max_views: Maximum number of views, which are evenly spaced (default: all views of the lift).
    Raises:
        ValueError: If the run does not record its features, or the features came from a Python object or have changed.
        FileNotFoundError: If files of the features are missing.
    """
    manifest, scene = lifted.field.manifest, lifted.scene
    source = restore_source(manifest, device)
    source = source if lifted.cache is None else cached(source, lifted.cache)
    options = manifest.get("options", {})
    names = set(source.available(scene.train.names))
    usable = [index for index, name in enumerate(scene.train.names) if name in names]
    used = [usable[i] for i in sample_evenly(len(usable), options.get("max_views"))]
    used = [used[i] for i in sample_evenly(len(used), max_views)]
    rendered = lifted.settings if options.get("image_source") == "render" else None
    for chunk in chunk_views(used):
        yield observe_views(scene, chunk, source, render_settings=rendered, downscale=options.get("lift_downscale", 1))


def _plain(rasterize: Rasterize, gaussians: GaussianScene, block: ViewBatch, *, power: int = 1) -> Evidence:
    counts = [regions.shape[1] for regions in block.regions]
    return rasterize(block.cameras, block.labels, num_regions=counts, weight_power=power)


_CELL_EVIDENCE: dict[Baseline, Callable[[Rasterize, GaussianScene, ViewBatch], Evidence]] = {
    "sfs": partial(_plain, power=2),
    "occam": lambda r, g, block: center_evidence(g.means, block.cameras, _columns(block), _plain(r, g, block)),
    "vala": _plain,
    "drsplat": lambda r, g, block: top_evidence(r, block.cameras, _columns(block), _plain(r, g, block)),
}
"""Function that computes the evidence of the cells in some views, for each baseline."""


def _columns(block: ViewBatch) -> list[Int[Tensor, "h w"]]:
    """Return the column of every pixel in the evidence of the block's cells, or -1 for pixels without a cell."""
    first = torch.tensor([0, *(regions.shape[1] for regions in block.regions)]).cumsum(0).tolist()
    return [torch.where(labels >= 0, labels + start, -1) for labels, start in zip(block.labels, first)]


def center_evidence(
    means: Float[Tensor, "n 3"], cameras: Sequence[Camera], columns: Sequence[Int[Tensor, "h w"]], evidence: Evidence
) -> Evidence:
    """Return evidence as in Occam's LGS, which assigns a Gaussian to the pixel at its projected center in every view.

    The weight is that of the Gaussian in all labeled pixels of the view.

    Args:
        columns: Column of every pixel in the evidence, for each view; negative for pixels without a column.
        evidence: Evidence whose rows are replaced.
    """
    weights = evidence.view_weights()
    row, view = weights.row_index(), weights.column.long()
    column = torch.full((len(row),), -1, dtype=torch.int64)
    rows, views, points = row.cpu(), view.cpu(), means.cpu().double()
    for v, (camera, pixel_columns) in enumerate(zip(cameras, columns)):
        entries = (views == v).nonzero().squeeze(1)
        y, x, _, inside = camera.project(points[rows[entries]])
        column[entries] = torch.where(inside, pixel_columns.cpu()[y, x].long(), -1)
    column = column.to(row.device)
    valid = column >= 0
    weight = weights.weight[valid].to(evidence.rows.weight)
    return replace(evidence, rows=SparseRows.from_coo(row[valid], column[valid], weight, len(means)))


def top_evidence(
    rasterize: Rasterize,
    cameras: Sequence[Camera],
    columns: Sequence[Int[Tensor, "h w"]],
    evidence: Evidence,
    top: int = TOP,
) -> Evidence:
    """Return evidence as in Dr.Splat, which uses only the `top` Gaussians with the largest weights on every ray.

    Args:
        rasterize: Function that computes evidence from cameras and labels.
        columns: As in `center_evidence`.
        evidence: Evidence whose rows are replaced.
    """
    device, size = evidence.rows.weight.device, evidence.num_gaussians
    parts = []
    for camera, pixel_columns in zip(cameras, columns):
        flat = pixel_columns.flatten().to(device).long()
        pixels = torch.arange(len(flat), dtype=torch.int32)
        for first in range(0, len(flat), _RAYS):
            count = min(_RAYS, len(flat) - first)
            chosen = (pixels >= first) & (pixels < first + count) & (pixel_columns.flatten().cpu() >= 0)
            labels = torch.where(chosen, pixels - first, MASKED).view(pixel_columns.shape)
            rays = rasterize([camera], [labels], num_regions=[count]).rows
            gaussian, pixel, weight = _heaviest_of_rays(rays, count, top)
            rows = SparseRows.from_coo(gaussian, flat[first + pixel], weight, size)
            parts.append((rows.row_index(), rows.column.long(), rows.weight))
    row, column, weight = (torch.cat(part) for part in zip(*parts))
    return replace(evidence, rows=SparseRows.from_coo(row, column, weight, size))


def _heaviest_of_rays(weights: SparseRows, pixels: int, top: int) -> tuple[Tensor, Tensor, Tensor]:
    """Return the Gaussian, pixel and weight of each of the `top` largest weights in every pixel."""
    by_pixel = SparseRows.from_coo(weights.column.long(), weights.row_index(), weights.weight, pixels)
    order = by_pixel.weight.argsort(descending=True)
    order = order[by_pixel.row_index()[order].argsort(stable=True)]
    pixel = by_pixel.row_index()[order]
    keep = torch.arange(len(order), device=order.device) - by_pixel.offsets[pixel] < top
    return by_pixel.column[order[keep]].long(), pixel[keep], by_pixel.weight[order[keep]]


def iter_medians(
    evidence: Evidence, features: Float[Tensor, "s d"], gaussians: Int[Tensor, " m"] | None = None, *, steps: int = 10
) -> Iterator[tuple[Int[Tensor, " b"], Float[Tensor, "b d"]]]:
    """Yield (Gaussians, unit directions) as in VALA, block by block; Gaussians without evidence have the direction 0.

    Views with a small weight are ignored (see `VISIBLE`). The direction is the geometric median, by cosine distance, of
    the features in the remaining views. It is computed by Weiszfeld iterations with weights evidence / (1 - cosine),
    and is normalized to length 1 after each iteration.

    Args:
        gaussians: Indices of the Gaussians (default: all).
    """
    rows = evidence.rows
    chosen = torch.arange(len(rows), device=features.device) if gaussians is None else gaussians
    for block in chosen.split(_BLOCK):
        part = rows.select_rows(block)
        row, column = part.row_index(), part.column.long()
        keep = _visible(row, evidence.region_view[column].long(), part.weight, len(block), evidence.num_views)
        row, weight, values = row[keep], part.weight[keep], features[column[keep]]
        u = _weighted_sum(row, weight, values, len(block))
        for _ in range(steps):
            distance = (1 - (u[row] * values).sum(1)).clamp(min=1e-4)
            u = _weighted_sum(row, weight / distance, values, len(block))
        yield block, u


def _visible(row: Tensor, view: Tensor, weight: Tensor, count: int, views: int) -> Bool[Tensor, " nnz"]:
    """Return a mask of the entries in views where the Gaussian has at least `VISIBLE` times its largest weight."""
    keys, group = (row * views + view).unique(return_inverse=True)
    view_weight = weight.new_zeros(len(keys)).index_add_(0, group, weight)
    heaviest = weight.new_zeros(count).scatter_reduce_(0, keys // views, view_weight, "amax")
    return view_weight[group] >= VISIBLE * heaviest[row]


def _weighted_sum(row: Tensor, weight: Tensor, values: Tensor, count: int) -> Tensor:
    offsets = row_offsets(row, count)
    product = SparseRows(offsets, torch.arange(len(row), device=row.device, dtype=torch.int32), weight)
    return normalize(product.matmul(values), dim=1)


# Lifting of feature maps channel by channel through stock gsplat, as in Splat Feature Solver (SFS), for timing.


_TIMED_VIEWS = 6
"""Maximum number of views to time. The time for all views is extrapolated in proportion to their number."""
_CHANNELS = 32
_ROUNDS = 3


def dense_sums(
    job: RasterJob, cameras: Sequence[Camera], maps: Iterable[Float[Tensor, "h w d"]], dimension: int
) -> Float[Tensor, "n d"]:
    """Return sum_i A_ij B_i of every Gaussian j over the pixels i of all views, with the compositing weights A_ij.

    The sum is the gradient of a loss with respect to the colors if B is its gradient with respect to gsplat's render.
    Each view needs one forward pass, and one backward pass per 32 channels.

    Args:
        maps: Feature B_i of every pixel, for each view.
        dimension: Number of feature channels D.
    """
    forward, backward = compiled_rasterizer()
    total = torch.zeros(len(job.scene), dimension, device=job.scene.means.device)
    blank = torch.zeros(1, len(job.scene), _CHANNELS, device=total.device)
    for camera, features in zip(cameras, maps):
        projected = project_views(job, [camera])
        splats = (projected.means2d, projected.conics, blank, projected.opacities, None, None)
        tiles = (job.settings.tile_size, projected.offsets, projected.indices)
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


def timing_obstacle(lifted: EvaluatedRun, device: str) -> str | None:
    """Return the reason why the method of Splat Feature Solver cannot be timed, or None if it can be."""
    if not device.startswith("cuda"):
        return f"gsplat needs a GPU, but the device is {device}; use --device cuda on a machine with a GPU"
    try:
        check(_job(lifted, device))
    except InputError as error:
        return str(error)
    return None


def time_dense_lift(lifted: EvaluatedRun, device: str) -> dict[str, float]:
    """Time the methods of Splat Feature Solver and this package, from labels and features to one vector per Gaussian.

    Both process the same few views of the lift. Times are medians of three rounds after a warm-up round, in seconds.
    The time of Splat Feature Solver's method is also extrapolated to all views of the lift.

    Raises:
        ValueError, FileNotFoundError: If the features of the run are not available (see `lifted_batches`).
    """
    blocks = list(lifted_batches(lifted, device, max_views=_TIMED_VIEWS))
    job = _job(lifted, device)
    rasterize = rasterizer(lifted.scene, lifted.settings, job.scene)

    def dense() -> None:
        for block in blocks:
            maps = feature_maps(block, job.scene.means.device)
            dense_sums(job, block.cameras, maps, block.features[0].shape[1])

    def ours() -> None:
        for block in blocks:
            evidence = cells_to_regions(_plain(rasterize, job.scene, block), block)
            lift(evidence, torch.cat(block.features).to(job.scene.means)).directions(dtype=torch.float16)

    dense_seconds, our_seconds = _median_seconds(dense), _median_seconds(ours)
    views = sum(len(block.cameras) for block in blocks)
    all_views = lifted.field.manifest.get("statistics", {}).get("views", views)
    return {
        "timed_views": float(views),
        "dense512_s": dense_seconds,
        "evidence_lift_s": our_seconds,
        "dense512_over_evidence_lift": dense_seconds / our_seconds,
        "dense512_all_views_s": dense_seconds * all_views / views,
    }


def _job(lifted: EvaluatedRun, device: str) -> RasterJob:
    antialiased = lifted.scene.rasterize_mode == "antialiased"
    return RasterJob(lifted.scene.gaussians.to(device), antialiased, lifted.settings, torch.float32)


def feature_maps(block: ViewBatch, device: torch.device | str) -> Iterable[Float[Tensor, "h w d"]]:
    """Yield, for each view, the feature of every pixel, summed over levels; 0 for pixels without a region."""
    for labels, regions, features in zip(block.labels, block.regions, block.features):
        table = torch.nn.functional.pad(features.to(device), (0, 0, 1, 0))  # row 0 for pixels without a region
        cells = torch.stack([table[level.to(device).long() + 1] for level in regions]).sum(0)
        rows = torch.nn.functional.pad(cells, (0, 0, 1, 0))
        yield rows[labels.to(device).long().clamp(min=-1) + 1]


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
