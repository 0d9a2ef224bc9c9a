"""The ideas of other methods on a lifted run: the same scene, regions and features, lifted as they would.

Each is our own implementation of the idea that tells the method from a plain lift, not its authors' code.
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
    "occam": "our centre pixels, after Occam's LGS",
    "vala": "our gated median, after VALA",
    "drsplat": "our 10 heaviest per ray, after Dr.Splat",
}
"""What each does."""
TOP = 10
"""Gaussians of a ray that count in the idea of Dr.Splat."""
VISIBLE = 0.1
"""Share of its heaviest view below which the idea of VALA leaves a view of a Gaussian out."""
_PIXELS = 2**17
"""Rays whose Gaussians are looked at together."""
_BLOCK = 2**12
"""Gaussians whose medians are computed together."""
Rasterize = Callable[..., Evidence]
"""`rasterize_evidence` with all that does not change from call to call."""


def baseline_field(name: Baseline, lifted: EvaluatedRun, device: str) -> SemanticField:
    """What a run would know of its Gaussians by another method, on the CPU, unrefined.

    Raises:
        ValueError, FileNotFoundError: as `seen_blocks`.
    """
    gaussians = lifted.scene.gaussians.to(device)
    how = {"rasterize_mode": lifted.scene.rasterize_mode, "settings": lifted.settings}
    rasterize = partial(rasterize_evidence, gaussians, **how)
    parts, tables = [], []
    for block in seen_blocks(lifted, device):
        parts.append(of_regions(_CELLS[name](rasterize, gaussians, block), block))
        tables += block.features
    evidence, features = Evidence.merge(*parts), torch.cat(tables).to(device)
    options = lifted.field.manifest.get("options", {})
    found = lift(evidence, features, unlabeled=options.get("unlabeled", "ignore"))
    scalars, facts = found.scalars.map(Tensor.cpu), {"dimension": features.shape[1]}
    own = torch.arange(len(gaussians), dtype=torch.int32)
    if name != "vala":
        return SemanticField(scalars, own, StoredEvidence(evidence.to("cpu"), features.cpu()), facts)
    rows = torch.cat([medians.half().cpu() for _, medians in iter_medians(evidence, features)])
    valid = (rows != 0).any(dim=1)
    scalars = replace(scalars, norm=valid.to(scalars.norm))
    return SemanticField(scalars, own, StoredDirections(rows[valid], None), facts)


def with_consensus(lifted: EvaluatedRun, on: bool, device: str) -> EvaluatedRun:
    """The run as it is with consensus or without it, unrefined: itself where it was lifted so, else lifted again from
    its regions and features.

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
    how = {key: options.get(key, getattr(defaults, key)) for key in ("beta", "unlabeled")}
    found = lift(evidence, features, **how)
    if on:
        given = {key: options.get(f"consensus_{key}") for key in ("power", "sample", "least")}
        given = {key: value for key, value in given.items() if value is not None}
        agreed = consensus(evidence, features, level=torch.cat(levels), **given)
        of_agreed = lift(evidence, agreed.features, **how)
        found = replace(of_agreed, scalars=seen_reliability(of_agreed.scalars, found.scalars))
    own = torch.arange(len(gaussians), dtype=torch.int32)
    store = StoredEvidence(evidence.to("cpu"), found.features.cpu())
    changed = {**manifest, "options": {**options, "consensus": on}}
    return replace(lifted, field=SemanticField(found.scalars.map(Tensor.cpu), own, store, changed), refined=False)


def seen_blocks(lifted: EvaluatedRun, device: str, *, most: int | None = None) -> Iterator[Block]:
    """Cameras, labels and features of the views of the lift, some views at a time.

    Args:
        device: where networks run.
        most: views, evenly spread; None: all of the lift.
    Raises:
        ValueError: the run does not say which features it was lifted from, they were the user's own, or they are not
            the same any more.
        FileNotFoundError: files of the features are gone.
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
    how = {"rendered": rendered, "divisor": options.get("lift_downscale", 1), "done": lambda view: None}
    for chunk in in_chunks(used):
        yield observe_views(scene, chunk, source, **how)


def _plain(rasterize: Rasterize, gaussians: GaussianScene, block: Block, *, power: int = 1) -> Evidence:
    counts = [regions.shape[1] for regions in block.regions]
    return rasterize(block.cameras, block.labels, num_regions=counts, weight_power=power)


def _centres(rasterize: Rasterize, gaussians: GaussianScene, block: Block) -> Evidence:
    cells = _plain(rasterize, gaussians, block)
    return centre_evidence(gaussians.means, block.cameras, _columns(block), cells)


def _heaviest(rasterize: Rasterize, gaussians: GaussianScene, block: Block) -> Evidence:
    return top_evidence(rasterize, block.cameras, _columns(block), _plain(rasterize, gaussians, block))


_CELLS: dict[Baseline, Callable[[Rasterize, GaussianScene, Block], Evidence]] = {
    "sfs": partial(_plain, power=2),
    "occam": _centres,
    "vala": _plain,
    "drsplat": _heaviest,
}
"""Evidence of the cells of some views."""


def _columns(block: Block) -> list[Int[Tensor, "h w"]]:
    """Column of every pixel in the evidence of the block's cells, -1 for none."""
    first = torch.tensor([0, *(regions.shape[1] for regions in block.regions)]).cumsum(0).tolist()
    return [torch.where(labels >= 0, labels + start, -1) for labels, start in zip(block.labels, first)]


def centre_evidence(
    means: Float[Tensor, "n 3"], cameras: Sequence[Camera], columns: Sequence[Int[Tensor, "h w"]], evidence: Evidence
) -> Evidence:
    """Occam's LGS: in every view a Gaussian takes the feature at its projected centre, with its weight in that view.

    Args:
        columns: per view, the column of every pixel in the evidence, negative for none.
    """
    weights = evidence.view_weights()
    row, view = weights.row_index(), weights.column.long()
    column = torch.full((len(row),), -1, dtype=torch.int64)
    rows, views, places = row.cpu(), view.cpu(), means.cpu().double()
    for v, (camera, of_pixel) in enumerate(zip(cameras, columns)):
        here = (views == v).nonzero().squeeze(1)
        pose = camera.world_to_camera.cpu().double()
        place = (places[rows[here]] @ pose[:3, :3].T + pose[:3, 3]) @ camera.K.cpu().double().T
        x, y = (place[:, i] / place[:, 2].clamp(min=1e-6) for i in (0, 1))
        inside = (place[:, 2] > 0) & (x >= 0) & (y >= 0) & (x < camera.width) & (y < camera.height)
        x, y = (c.clamp(0, size - 1).long() for c, size in ((x, camera.width), (y, camera.height)))
        column[here] = torch.where(inside, of_pixel.cpu()[y, x].long(), -1)
    column = column.to(row.device)
    kept = column >= 0
    found = weights.weight[kept].to(evidence.rows.weight)
    return replace(evidence, rows=SparseRows.from_coo(row[kept], column[kept], found, len(means)))


def top_evidence(
    rasterize: Rasterize,
    cameras: Sequence[Camera],
    columns: Sequence[Int[Tensor, "h w"]],
    evidence: Evidence,
    top: int = TOP,
) -> Evidence:
    """Dr.Splat: a ray counts for the `top` Gaussians of largest weight only.

    Args:
        rasterize: makes evidence from cameras and labels.
        columns: as in `centre_evidence`.
        evidence: of those columns; only its rows change.
    """
    device, size = evidence.rows.weight.device, evidence.num_gaussians
    parts = []
    for camera, of_pixel in zip(cameras, columns):
        flat = of_pixel.flatten().to(device).long()
        pixels = torch.arange(len(flat), dtype=torch.int32)
        for first in range(0, len(flat), _PIXELS):
            count = min(_PIXELS, len(flat) - first)
            chosen = (pixels >= first) & (pixels < first + count) & (of_pixel.flatten().cpu() >= 0)
            labels = torch.where(chosen, pixels - first, MASKED).view(of_pixel.shape)
            gaussian, pixel, weight = _heaviest_of_rays(
                rasterize([camera], [labels], num_regions=[count]).rows, count, top
            )
            found = SparseRows.from_coo(gaussian, flat[first + pixel], weight, size)
            parts.append((found.row_index(), found.column.long(), found.weight))
    row, column, weight = (torch.cat(part) for part in zip(*parts))
    return replace(evidence, rows=SparseRows.from_coo(row, column, weight, size))


def _heaviest_of_rays(weights: SparseRows, pixels: int, top: int) -> tuple[Tensor, Tensor, Tensor]:
    """Gaussian, pixel and weight of the `top` largest entries of every column."""
    by_pixel = SparseRows.from_coo(weights.column.long(), weights.row_index(), weights.weight, pixels)
    order = by_pixel.weight.argsort(descending=True)
    order = order[by_pixel.row_index()[order].argsort(stable=True)]
    pixel = by_pixel.row_index()[order]
    keep = torch.arange(len(order), device=order.device) - by_pixel.offsets[pixel] < top
    return by_pixel.column[order[keep]].long(), pixel[keep], by_pixel.weight[order[keep]]


def iter_medians(
    evidence: Evidence, features: Float[Tensor, "s d"], gaussians: Int[Tensor, " m"] | None = None, *, steps: int = 10
) -> Iterator[tuple[Int[Tensor, " b"], Float[Tensor, "b d"]]]:
    """VALA: views that hardly see a Gaussian are left out, the others give the geometric median by cosine distance
    (Weiszfeld iterations with weights E / (1 - cosine), renormalised to the sphere). Blocks of Gaussians with their
    unit directions, 0 without evidence.

    Args:
        gaussians: some of them; None: all.
    """
    rows = evidence.rows
    chosen = torch.arange(len(rows), device=features.device) if gaussians is None else gaussians
    for block in chosen.split(_BLOCK):
        part = rows.select_rows(block)
        row, column = part.row_index(), part.column.long()
        keep = _seen_enough(row, evidence.region_view[column].long(), part.weight, len(block), evidence.num_views)
        row, weight, seen = row[keep], part.weight[keep], features[column[keep]]
        u = _weighted_sum(row, weight, seen, len(block))
        for _ in range(steps):
            distance = (1 - (u[row] * seen).sum(1)).clamp(min=1e-4)
            u = _weighted_sum(row, weight / distance, seen, len(block))
        yield block, u


def _seen_enough(row: Tensor, view: Tensor, weight: Tensor, count: int, views: int) -> Bool[Tensor, " nnz"]:
    """The entries whose view has at least `VISIBLE` of the weight of the Gaussian's heaviest view."""
    keys, group = (row * views + view).unique(return_inverse=True)
    of_view = weight.new_zeros(len(keys)).index_add_(0, group, weight)
    heaviest = weight.new_zeros(count).scatter_reduce_(0, keys // views, of_view, "amax")
    return of_view[group] >= VISIBLE * heaviest[row]


def _weighted_sum(row: Tensor, weight: Tensor, values: Tensor, count: int) -> Tensor:
    offsets = row_offsets(row, count)
    product = SparseRows(offsets, torch.arange(len(row), device=row.device, dtype=torch.int32), weight)
    return normalize(product.matmul(values), dim=1)
