"""2D features as CLIP gives them, and a ladder of damage to masks and features; pure functions with a seed.

The feature of a mask is normalise(t + C c + O o + N n): t the text vector of its class, c one direction that all image
features share (the modality gap), o a direction of the object's own, n noise of this mask in this view, that follows
the covariance of text vectors, so that it is confusion rather than static. c and o are orthogonal to the classes. With
the default lengths C, O and N one object in two views has cosine 0.83, two objects 0.64, image and own text 0.34,
another text 0.25.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn.functional import normalize

from benchmarks.worlds import Cells, Words, World, block_side
from normlift_ns import Evidence


@dataclass(frozen=True)
class Damage:
    """How much goes wrong; the default is the first step of the ladder, features with noise and nothing else."""

    noise: float = 1.2
    """Length of the noise of every mask in every view; a text vector has length 1."""
    wrong: float = 0.0
    """Share of masks whose feature is that of another class, near ones more often."""
    merged: float = 0.0
    """Share of masks that are one with another mask of their view; the larger gives the class."""
    split: float = 0.0
    """Share of masks cut in two through their middle; each half has its own noise and its own mistakes."""
    dropped: float = 0.0
    """Share of masks that are missing: unlabelled pixels."""
    shifted: float = 0.0
    """Blocks (a fortieth of the image's width) by which every mask is off, in a direction of its own; of overlapping
    masks the later wins."""
    boundary: float = 0.0
    """Share of cells that take the label found two blocks away in a random direction: frayed edges."""
    pose: float = 0.0
    """Blocks by which all masks of a view are off together: what a rotation error of the pose does, to first order."""
    views: int | None = None
    """Use so many views, spread evenly from a random start; None: all."""
    dominant: float = 1.0
    """Factor on the weight of one random view of every five, as if their images had so many times the pixels."""
    floaters: bool = False
    """The scene has 5 % more Gaussians floating before the cameras; see `worlds.with_floaters`."""


MILD = Damage(wrong=0.1, merged=0.1, dropped=0.1, boundary=0.15)
LADDER = {
    "noise only": Damage(),
    "mild": MILD,
    "noise": replace(MILD, noise=2.5),
    "wrong classes": replace(MILD, wrong=0.35),
    "merged masks": replace(MILD, merged=0.4),
    "split masks": replace(MILD, split=0.7, wrong=0.25),
    "shifted masks": replace(MILD, shifted=1.0),
    "dropped masks": replace(MILD, dropped=0.6),
    "few views": replace(MILD, views=4),
    "dominant view": replace(MILD, dominant=64.0),
    "pose noise": replace(MILD, pose=1.0),
    "floaters": replace(MILD, floaters=True),
    "hard": Damage(2.0, wrong=0.3, merged=0.2, dropped=0.25, boundary=0.35, shifted=0.4),
}


@dataclass(frozen=True)
class Lengths:
    """Of the parts of a feature, beside a text vector of length 1."""

    common: float = 2.2
    own: float = 1.2


class Observed(NamedTuple):
    """What a lift gets."""

    evidence: Evidence
    features: Tensor
    """[S, D] unit."""
    columns: Tensor
    """[1, C'] region of every cell of the chosen views, -1 for none."""
    views: list[int]


def observe(world: World, words: Words, damage: Damage, seed: int, lengths: Lengths | None = None) -> Observed:
    """Masks and features of the world after the damage. The same arguments give the same result on any device."""
    g = torch.Generator().manual_seed(seed)
    cells = world.cells
    label = masks_of_cells(cells, world.classes, damage, g)
    size = torch.bincount(_key(cells.view, label, world.classes)[label >= 0], minlength=len(cells.maps) * world.classes)
    joined, dropped = _merge_and_drop(size.view(-1, world.classes), damage, g)
    half = _halves(cells, label, world.classes, damage, g)
    final = torch.where(label >= 0, joined[cells.view, label.clamp(min=0)], -1)
    gone = (final < 0) | dropped[cells.view, final.clamp(min=0)]
    chosen = _choose_views(len(cells.maps), damage, g)
    keep = torch.zeros(len(cells.maps), dtype=torch.bool)
    keep[chosen] = True
    key = torch.where(gone, -1, _key(cells.view, final, world.classes) * 2 + half)
    present, index = key[keep[cells.view]].unique(return_inverse=True)
    index = index - int(len(present) > 0 and int(present[0]) < 0)
    present = present[present >= 0]
    features = _features(present // 2 % world.classes, words, damage, lengths or Lengths(), g)
    evidence = world.evidence
    if damage.dominant > 1:
        evidence = _weighted(evidence, _factors(len(cells.maps), damage, g).to(evidence.rows.weight))
    if len(chosen) < len(cells.maps):
        evidence = evidence.select_views(chosen)
    renumbered = torch.full((len(cells.maps),), -1)
    renumbered[chosen] = torch.arange(len(chosen))
    region_view = renumbered[present // (2 * world.classes)].int()
    columns = index[None]
    return Observed(evidence.regroup(columns, region_view), features.to(world.scene.means.device), columns, chosen)


def masks_of_cells(cells: Cells, classes: int, damage: Damage, g: torch.Generator) -> Tensor:
    """[C] class of the mask that every cell lies in after masks moved and frayed, -1 for none."""
    views = len(cells.maps)
    whole = damage.pose * block_side(cells.maps) * _unit(views, g)
    each = damage.shifted * block_side(cells.maps) * _unit(views * classes, g).view(views, classes, 2)
    place = cells.centre - whole[cells.view]
    label = _look_up(cells, place) if damage.pose > 0 else cells.mask.clone()
    if damage.shifted > 0:
        moved = torch.full_like(label, -1)
        for c in range(classes):
            moved[_look_up(cells, place - each[cells.view, c]) == c] = c
        label = moved
    aside = place + 2 * block_side(cells.maps) * _unit(len(place), g)
    frayed = torch.rand(len(place), generator=g) < damage.boundary
    return torch.where(frayed, _look_up(cells, aside), label) if damage.boundary > 0 else label


def _look_up(cells: Cells, place: Tensor) -> Tensor:
    """Exact class at places [C, 2] of the cells' views; that of the nearest pixel outside of the image."""
    height, width = cells.maps.shape[1:]
    x, y = place[:, 0].floor().long().clamp(0, width - 1), place[:, 1].floor().long().clamp(0, height - 1)
    return cells.maps[cells.view, y, x]


def _merge_and_drop(size: Tensor, damage: Damage, g: torch.Generator) -> tuple[Tensor, Tensor]:
    """[V, K] what every mask becomes part of, and whether that is missing."""
    views, classes = size.shape
    joins = torch.rand(views, classes, generator=g) < damage.merged
    chance = torch.rand(views, classes, classes, generator=g) * (size > 0)[:, None] * (1 - torch.eye(classes))
    partner = chance.argmax(dim=2)
    partner = torch.where(joins & (size.gather(1, partner) > size), partner, torch.arange(classes))
    return partner, torch.rand(views, classes, generator=g) < damage.dropped


def _halves(cells: Cells, label: Tensor, classes: int, damage: Damage, g: torch.Generator) -> Tensor:
    """[C] 0 or 1: side of the cut of its mask that a cell lies on."""
    views = len(cells.maps)
    key = _key(cells.view, label.clamp(min=0), classes)
    count = torch.bincount(key, minlength=views * classes).clamp(min=1)[:, None]
    middle = torch.zeros(views * classes, 2).index_add_(0, key, cells.centre) / count
    across = _unit(views * classes, g)
    cut = torch.rand(views * classes, generator=g) < damage.split
    return (((cells.centre - middle[key]) * across[key]).sum(1) > 0).long() * cut[key]


def _choose_views(views: int, damage: Damage, g: torch.Generator) -> list[int]:
    if damage.views is None:
        return list(range(views))
    start = int(torch.randint(0, views, (), generator=g))
    return sorted({(start + i * views // damage.views) % views for i in range(damage.views)})


def _features(masks: Tensor, words: Words, damage: Damage, lengths: Lengths, g: torch.Generator) -> Tensor:
    """[S, D] unit features of masks of the given classes."""
    classes, others = words.classes, words.others
    basis = torch.linalg.qr(classes.T).Q
    random = torch.randn(len(classes) + 1, classes.shape[1], generator=g)
    free = normalize(random - random @ basis @ basis.T, dim=1)
    near = torch.softmax(20 * (classes @ classes.T).fill_diagonal_(-torch.inf), dim=1)
    mistaken = torch.multinomial(near[masks], 1, generator=g).squeeze(1) if len(masks) > 0 else masks
    shown = torch.where(torch.rand(len(masks), generator=g) < damage.wrong, mistaken, masks)
    noise = normalize(torch.randn(len(masks), len(others), generator=g) @ (others - others.mean(0)), dim=1)
    mixed = classes[shown] + lengths.common * free[-1] + lengths.own * free[masks] + damage.noise * noise
    return normalize(mixed, dim=1)


def _factors(views: int, damage: Damage, g: torch.Generator) -> Tensor:
    factor = torch.ones(views)
    factor[torch.randperm(views, generator=g)[: max(1, views // 5)]] = damage.dominant
    return factor


def _weighted(evidence: Evidence, factor: Tensor) -> Evidence:
    """Evidence with a factor [V] on the weight of each view."""
    rows, blank = evidence.rows, evidence.unlabeled
    return replace(
        evidence,
        rows=replace(rows, weight=rows.weight * factor[evidence.region_view[rows.column.long()].long()]),
        unlabeled=replace(blank, weight=blank.weight * factor[blank.column.long()]),
    )


def _key(view: Tensor, mask: Tensor, classes: int) -> Tensor:
    return view * classes + mask


def _unit(count: int, g: torch.Generator) -> Tensor:
    """[count, 2] unit vectors."""
    return normalize(torch.randn(count, 2, generator=g), dim=1)
