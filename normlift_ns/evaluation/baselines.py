"""Ideas of other methods applied to a lifted run: the same scene, regions and features, lifted in their way.

Each is our own implementation of the idea that distinguishes the method from a plain lift, not its authors' code.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from functools import partial
from typing import Literal

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.nn.functional import normalize

from normlift_ns.core.consensus import consensus, seen_reliability
from normlift_ns.core.evidence import MASKED, Evidence
from normlift_ns.core.field import SemanticField
from normlift_ns.core.gaussians import Camera, GaussianScene
from normlift_ns.core.lift import lift
from normlift_ns.core.sparse import SparseRows, row_offsets
from normlift_ns.core.storage import StoredDirections, StoredEvidence
from normlift_ns.encoders.build import recorded_source
from normlift_ns.encoders.cache import cached
from normlift_ns.evaluation.protocols import EvaluatedRun
from normlift_ns.observing import Block, in_chunks, observe_views, of_regions, region_levels, spread
from normlift_ns.options import LiftOptions
from normlift_ns.raster.rasterize import rasterize_evidence

Baseline = Literal["sfs", "occam", "vala", "drsplat"]
BASELINES: dict[Baseline, str] = {
    "sfs": "our A^2 weights, after SFS",
    "occam": "our center pixels, after Occam's LGS",
    "vala": "our gated median, after VALA",
    "drsplat": "our 10 heaviest per ray, after Dr.Splat",
}
"""Description of each baseline."""
TOP = 10
"""Gaussians per ray that count in the baseline of Dr.Splat."""
VISIBLE = 0.1
"""Minimum weight of a view, relative to a Gaussian's heaviest view, for the baseline of VALA to use it."""
_RAYS = 2**17
"""Number of rays that are processed together."""
_BLOCK = 2**12
"""Number of Gaussians whose medians are computed together."""
Rasterize = Callable[..., Evidence]
"""`rasterize_evidence` with the arguments that are the same in all calls."""


def baseline_field(name: Baseline, lifted: EvaluatedRun, device: str) -> SemanticField:
    """Lift a run again with another method; return its field on the CPU, unrefined.

    Raises:
        ValueError, FileNotFoundError: as `seen_blocks`.
    """
    gaussians = lifted.scene.gaussians.to(device)
    rasterize = partial(
        rasterize_evidence, gaussians, rasterize_mode=lifted.scene.rasterize_mode, settings=lifted.settings
    )
    parts, tables = [], []
    for block in seen_blocks(lifted, device):
        parts.append(of_regions(_CELL_EVIDENCE[name](rasterize, gaussians, block), block))
        tables += block.features
    evidence, features = Evidence.merge(*parts), torch.cat(tables).to(device)
    options = lifted.field.manifest.get("options", {})
    scalars = lift(evidence, features, unlabeled=options.get("unlabeled", "ignore")).scalars.map(Tensor.cpu)
    own, manifest = torch.arange(len(gaussians), dtype=torch.int32), {"dimension": features.shape[1]}
    if name != "vala":
        return SemanticField(scalars, own, StoredEvidence(evidence.to("cpu"), features.cpu()), manifest)
    rows = torch.cat([medians.half().cpu() for _, medians in iter_medians(evidence, features)])
    valid = (rows != 0).any(dim=1)
    scalars = replace(scalars, norm=valid.to(scalars.norm))
    return SemanticField(scalars, own, StoredDirections(rows[valid], None), manifest)


def with_consensus(lifted: EvaluatedRun, on: bool, device: str) -> EvaluatedRun:
    """Return the run with or without consensus, unrefined.

    If it was lifted otherwise, it is lifted again from its regions and features.

    Raises:
        ValueError, FileNotFoundError: as `seen_blocks`.
    """
    manifest, defaults = lifted.field.manifest, LiftOptions()
    options = manifest.get("options", {})
    if options.get("consensus", False) == on:
        return lifted
    power = options.get("weight_power", 1)
    gaussians = lifted.scene.gaussians.to(device)
    rasterize = partial(
        rasterize_evidence, gaussians, rasterize_mode=lifted.scene.rasterize_mode, settings=lifted.settings
    )
    parts, tables, levels = [], [], []
    for block in seen_blocks(lifted, device):
        parts.append(of_regions(_plain(rasterize, gaussians, block, power=power), block))
        tables += block.features
        levels += [region_levels(*x) for x in zip(block.regions, map(len, block.features))]
    evidence, features = Evidence.merge(*parts), torch.cat(tables).to(device)
    lift_kwargs = {key: options.get(key, getattr(defaults, key)) for key in ("beta", "unlabeled")}
    result = lift(evidence, features, **lift_kwargs)
    if on:
        kwargs = {key: options.get(f"consensus_{key}") for key in ("power", "sample", "least")}
        kwargs = {key: value for key, value in kwargs.items() if value is not None}
        table = consensus(evidence, features, level=torch.cat(levels), **kwargs).features
        after = lift(evidence, table, **lift_kwargs)
        result = replace(after, scalars=seen_reliability(after.scalars, result.scalars))
    own = torch.arange(len(gaussians), dtype=torch.int32)
    store = StoredEvidence(evidence.to("cpu"), result.features.cpu())
    manifest = {**manifest, "options": {**options, "consensus": on}}
    return replace(lifted, field=SemanticField(result.scalars.map(Tensor.cpu), own, store, manifest), refined=False)


def seen_blocks(lifted: EvaluatedRun, device: str, *, most: int | None = None) -> Iterator[Block]:
    """Yield cameras, labels and features of the views of the lift, a few views at a time.

    Args:
        device: device of the networks.
        most: maximum number of views, evenly spaced. If None, use all views of the lift.
    Raises:
        ValueError: the run does not record its features, they were the user's own, or they have changed.
        FileNotFoundError: files of the features are missing.
    """
    manifest, scene = lifted.field.manifest, lifted.scene
    source = recorded_source(manifest, device)
    source = source if lifted.cache is None else cached(source, lifted.cache)
    options = manifest.get("options", {})
    names = set(source.available(scene.train.names))
    usable = [index for index, name in enumerate(scene.train.names) if name in names]
    used = [usable[i] for i in spread(len(usable), options.get("max_views"))]
    used = [used[i] for i in spread(len(used), most)]
    rendered = lifted.settings if options.get("image_source") == "render" else None
    kwargs = {"rendered": rendered, "divisor": options.get("lift_downscale", 1), "done": lambda view: None}
    for chunk in in_chunks(used):
        yield observe_views(scene, chunk, source, **kwargs)


def _plain(rasterize: Rasterize, gaussians: GaussianScene, block: Block, *, power: int = 1) -> Evidence:
    counts = [regions.shape[1] for regions in block.regions]
    return rasterize(block.cameras, block.labels, num_regions=counts, weight_power=power)


def _centers(rasterize: Rasterize, gaussians: GaussianScene, block: Block) -> Evidence:
    cells = _plain(rasterize, gaussians, block)
    return centre_evidence(gaussians.means, block.cameras, _columns(block), cells)


def _heaviest(rasterize: Rasterize, gaussians: GaussianScene, block: Block) -> Evidence:
    return top_evidence(rasterize, block.cameras, _columns(block), _plain(rasterize, gaussians, block))


_CELL_EVIDENCE: dict[Baseline, Callable[[Rasterize, GaussianScene, Block], Evidence]] = {
    "sfs": partial(_plain, power=2),
    "occam": _centers,
    "vala": _plain,
    "drsplat": _heaviest,
}
"""Functions that compute the evidence of the cells in some views."""


def _columns(block: Block) -> list[Int[Tensor, "h w"]]:
    """Return the column of every pixel in the evidence of the block's cells, -1 for none."""
    first = torch.tensor([0, *(regions.shape[1] for regions in block.regions)]).cumsum(0).tolist()
    return [torch.where(labels >= 0, labels + start, -1) for labels, start in zip(block.labels, first)]


def centre_evidence(
    means: Float[Tensor, "n 3"], cameras: Sequence[Camera], columns: Sequence[Int[Tensor, "h w"]], evidence: Evidence
) -> Evidence:
    """Occam's LGS: in every view, a Gaussian takes the feature at its projected center, with its weight in that view.

    Args:
        columns: column of every pixel in the evidence, for each view; negative for none.
    """
    weights = evidence.view_weights()
    row, view = weights.row_index(), weights.column.long()
    column = torch.full((len(row),), -1, dtype=torch.int64)
    rows, views, points = row.cpu(), view.cpu(), means.cpu().double()
    for v, (camera, pixel_columns) in enumerate(zip(cameras, columns)):
        entries = (views == v).nonzero().squeeze(1)
        pose = camera.world_to_camera.cpu().double()
        projected = (points[rows[entries]] @ pose[:3, :3].T + pose[:3, 3]) @ camera.K.cpu().double().T
        x, y = (projected[:, i] / projected[:, 2].clamp(min=1e-6) for i in (0, 1))
        inside = (projected[:, 2] > 0) & (x >= 0) & (y >= 0) & (x < camera.width) & (y < camera.height)
        x, y = (c.clamp(0, size - 1).long() for c, size in ((x, camera.width), (y, camera.height)))
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
    """Dr.Splat: only the `top` Gaussians with the largest weights count for a ray.

    Args:
        rasterize: computes evidence from cameras and labels.
        columns: as in `centre_evidence`.
        evidence: evidence of those columns; only its rows are replaced.
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
            gaussian, pixel, weight = _heaviest_of_rays(
                rasterize([camera], [labels], num_regions=[count]).rows, count, top
            )
            rows = SparseRows.from_coo(gaussian, flat[first + pixel], weight, size)
            parts.append((rows.row_index(), rows.column.long(), rows.weight))
    row, column, weight = (torch.cat(part) for part in zip(*parts))
    return replace(evidence, rows=SparseRows.from_coo(row, column, weight, size))


def _heaviest_of_rays(weights: SparseRows, pixels: int, top: int) -> tuple[Tensor, Tensor, Tensor]:
    """Return Gaussian, pixel and weight of the `top` largest entries in every column."""
    by_pixel = SparseRows.from_coo(weights.column.long(), weights.row_index(), weights.weight, pixels)
    order = by_pixel.weight.argsort(descending=True)
    order = order[by_pixel.row_index()[order].argsort(stable=True)]
    pixel = by_pixel.row_index()[order]
    keep = torch.arange(len(order), device=order.device) - by_pixel.offsets[pixel] < top
    return by_pixel.column[order[keep]].long(), pixel[keep], by_pixel.weight[order[keep]]


def iter_medians(
    evidence: Evidence, features: Float[Tensor, "s d"], gaussians: Int[Tensor, " m"] | None = None, *, steps: int = 10
) -> Iterator[tuple[Int[Tensor, " b"], Float[Tensor, "b d"]]]:
    """VALA: leave out views that hardly see a Gaussian, and take the geometric median of the others by cosine distance.

    The median uses Weiszfeld iterations with weights E / (1 - cosine), renormalized to the sphere. Yield blocks of
    Gaussians with their unit directions, 0 without evidence.

    Args:
        gaussians: Gaussians to compute, all if None.
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
    """Select the entries whose view has at least `VISIBLE` of the weight of the Gaussian's heaviest view."""
    keys, group = (row * views + view).unique(return_inverse=True)
    view_weight = weight.new_zeros(len(keys)).index_add_(0, group, weight)
    heaviest = weight.new_zeros(count).scatter_reduce_(0, keys // views, view_weight, "amax")
    return view_weight[group] >= VISIBLE * heaviest[row]


def _weighted_sum(row: Tensor, weight: Tensor, values: Tensor, count: int) -> Tensor:
    offsets = row_offsets(row, count)
    product = SparseRows(offsets, torch.arange(len(row), device=row.device, dtype=torch.int32), weight)
    return normalize(product.matmul(values), dim=1)
