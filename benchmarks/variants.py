"""The refinement's variants and other methods on one damaged observation, as scores of every class.

Classes need no [N, 512] array: u_j t = sum_s E_js F_s t / (W_j ||f_j||). Votes copy rows of these scores; linear
averaging of directions averages them, up to the length, which no arg-max sees (`tests/test_accuracy.py` compares both
with `refine_variant`).
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple, get_args

import torch
from torch import Tensor
from torch.nn.functional import normalize

from benchmarks.damage import Observed
from benchmarks.worlds import World
from normlift_ns import Evidence, Lifted, Neighbors, RefineConfig, rasterize_evidence
from normlift_ns.core.ablations import Variant, variant_config, variant_reliability, variant_source
from normlift_ns.core.refine import decay_width, voting_weights
from normlift_ns.core.sparse import SparseRows, row_offsets

VARIANTS: tuple[Variant, ...] = get_args(Variant)
TOP = 10
"""Gaussians per ray of "top-k registration"."""
VISIBLE = 0.1
"""Share of its heaviest view below which "gated geometric median" leaves a view of a Gaussian out."""


class Scores(NamedTuple):
    """What every Gaussian answers to K classes."""

    cosine: Tensor
    """[N, K], 0 without direction."""
    valid: Tensor
    """[N]"""


def lifted_scores(lifted: Lifted, classes: Tensor) -> Scores:
    """Cosines of the unrefined directions."""
    sums = lifted.evidence.rows.matmul(lifted.features @ classes.T.to(lifted.features))
    length = (lifted.scalars.weight * lifted.scalars.norm)[:, None]
    valid = lifted.scalars.norm > 0
    return Scores(torch.where(valid[:, None], sums / length, 0.0), valid)


def only(neighbors: Neighbors, voters: Tensor | None) -> Neighbors:
    """The neighbours of some Gaussians; the others have none, and so keep their direction. None: of all."""
    if voters is None:
        return neighbors
    votes = torch.zeros(len(neighbors.index), 1, dtype=torch.bool, device=neighbors.index.device)
    votes[voters] = True
    distance = torch.where(votes, neighbors.distance, torch.inf)
    return Neighbors(torch.where(votes, neighbors.index, -1), distance, neighbors.spacing)


def refined_scores(
    variant: Variant, means: Tensor, lifted: Lifted, scores: Scores, neighbors: Neighbors,
    config: RefineConfig | None = None,
) -> Scores:  # fmt: skip
    """Scores after one variant of `refine_variant`."""
    config = config or RefineConfig()
    if variant == "none":
        return scores
    if variant == "linear":
        reliability = variant_reliability(variant, lifted.scalars)
        return _average(reliability, scores, neighbors, variant_config(variant, config))
    source = variant_source(variant, means, lifted.directions, lifted.scalars, config, neighbors=neighbors).long()
    return Scores(scores.cosine[source], scores.valid[source])


def _average(reliability: Tensor, scores: Scores, neighbors: Neighbors, config: RefineConfig) -> Scores:
    cosine, valid, width = scores.cosine.clone(), scores.valid.clone(), decay_width(neighbors, config)
    for i in (neighbors.index >= 0).any(1).nonzero().squeeze(1).split(2**14):
        group = torch.cat([i[:, None], neighbors.index[i].long()], dim=1).clamp(min=0)
        weight = voting_weights(neighbors, width, i, reliability).to(scores.cosine)
        total = torch.einsum("ik,ikc->ic", weight, scores.cosine[group])
        found = weight.sum(1) > 0
        cosine[i] = torch.where(found[:, None], total, cosine[i])
        valid[i] |= found
    return Scores(cosine, valid)


# Other methods on the same evidence; each is our implementation of the idea, not the authors' code.


def centre_evidence(world: World) -> Evidence:
    """Occam's LGS: in every view a Gaussian takes the feature at its projected centre, with its weight in that view."""
    weights, cells = world.evidence.view_weights(), world.cells
    row, view = weights.row_index(), weights.column.long()
    cell = torch.full((len(row),), -1, dtype=torch.int64)
    rows, views = row.cpu(), view.cpu()
    means = world.scene.means.cpu().double()
    for v, camera in enumerate(world.cameras):
        here = (views == v).nonzero().squeeze(1)
        pose = camera.world_to_camera.double()
        place = (means[rows[here]] @ pose[:3, :3].T + pose[:3, 3]) @ camera.K.double().T
        x, y = (place[:, i] / place[:, 2].clamp(min=1e-6) for i in (0, 1))
        inside = (place[:, 2] > 0) & (x >= 0) & (y >= 0) & (x < camera.width) & (y < camera.height)
        x, y = (c.clamp(0, size - 1).long() for c, size in ((x, camera.width), (y, camera.height)))
        cell[here] = torch.where(inside, cells.of_pixel[v, y, x].long(), -1)
    cell = cell.to(row.device)
    kept = cell >= 0
    found = SparseRows.from_coo(row[kept], cell[kept], weights.weight[kept].to(world.evidence.rows.weight), len(means))
    return replace(world.evidence, rows=found)


def top_evidence(world: World, top: int = TOP) -> Evidence:
    """Dr.Splat: a ray counts for the `top` Gaussians of largest weight only."""
    parts, size = [], len(world.scene)
    for camera, cells in zip(world.cameras, world.cells.of_pixel):
        of_pixel = cells.flatten().to(world.scene.means.device)
        pixels = torch.arange(len(of_pixel), dtype=torch.int32).view(cells.shape)
        weights = rasterize_evidence(world.scene, [camera], [pixels], num_regions=[len(of_pixel)]).rows
        by_pixel = SparseRows.from_coo(weights.column.long(), weights.row_index(), weights.weight, len(of_pixel))
        order = by_pixel.weight.argsort(descending=True)
        order = order[by_pixel.row_index()[order].argsort(stable=True)]
        pixel = by_pixel.row_index()[order]
        keep = torch.arange(len(order), device=order.device) - by_pixel.offsets[pixel] < top
        gaussian, pixel, weight = by_pixel.column[order[keep]].long(), pixel[keep], by_pixel.weight[order[keep]]
        found = SparseRows.from_coo(gaussian, of_pixel[pixel].long(), weight, size)
        parts.append((found.row_index(), found.column, found.weight))
    rows = SparseRows.stack(parts, size, world.scene.means.device)
    return replace(world.evidence, rows=rows)


def median_scores(observed: Observed, classes: Tensor, gaussians: Tensor | None = None, *, steps: int = 10) -> Scores:
    """VALA: views that hardly see a Gaussian are left out, the others give the geometric median by cosine distance
    (Weiszfeld iterations with weights E / (1 - cosine), renormalised to the sphere).
    """
    rows, table = observed.evidence.rows, observed.features
    n, device = len(rows), table.device
    cosine = torch.zeros(n, len(classes), device=device)
    valid = torch.zeros(n, dtype=torch.bool, device=device)
    chosen = torch.arange(n, device=device) if gaussians is None else gaussians
    for block in chosen.split(2**12):
        part = rows.select_rows(block)
        row, column = part.row_index(), part.column.long()
        view_key = row * observed.evidence.num_views + observed.evidence.region_view[column].long()
        keys, group = view_key.unique(return_inverse=True)
        view_weight = torch.zeros(len(keys), device=device).index_add_(0, group, part.weight)
        heaviest = torch.zeros(len(block), device=device).scatter_reduce_(
            0, keys // observed.evidence.num_views, view_weight, "amax"
        )
        keep = view_weight[group] >= VISIBLE * heaviest[row]
        row, column, weight = row[keep], column[keep], part.weight[keep]
        seen = table[column]
        u = _weighted_sum(row, weight, seen, len(block))
        for _ in range(steps):
            distance = (1 - (u[row] * seen).sum(1)).clamp(min=1e-4)
            u = _weighted_sum(row, weight / distance, seen, len(block))
        cosine[block] = u @ classes.T
        valid[block] = (u != 0).any(1)
    return Scores(cosine, valid)


def _weighted_sum(row: Tensor, weight: Tensor, values: Tensor, count: int) -> Tensor:
    offsets = row_offsets(row, count)
    product = SparseRows(offsets, torch.arange(len(row), device=row.device, dtype=torch.int32), weight)
    return normalize(product.matmul(values), dim=1)
