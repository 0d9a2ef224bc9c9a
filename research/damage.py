"""A ladder of damage to masks and their features, and the resulting input of a lift; pure functions with a seed.

`research.features` describes the features. `LADDER` has version 0.1's 13 steps, whose results do not change, because
later steps use a separate random generator. `STEPS` adds two steps whose mistakes are not independent between masks.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn.functional import normalize

from normlift_ns import Evidence
from research.features import Lengths, Looks, mask_features, mask_looks, mistaken
from research.real_features import Cosines, Regions, real_features
from research.synthetic_scenes import PARTS, Cells, Words, World, block_side

LATER = 2**20
"""Number added to the seed of the random numbers of later steps, so that the results of the others do not change."""
GROUP = (3, 6)
"""Smallest and largest number of objects that share one mask in a view of damage `grouped`."""


@dataclass(frozen=True)
class Damage:
    """Amounts of damage. The default is the first step of the ladder, features with noise and no other damage."""

    noise: float = 1.2
    """Length of the noise of every mask in every view; a text vector has length 1."""
    wrong: float = 0.0
    """Share of masks with the feature of another class; similar classes are more likely."""
    merged: float = 0.0
    """Share of masks that are merged with another mask of their view. The larger mask determines the class."""
    split: float = 0.0
    """Share of masks that are cut in two through their middle. Each half has its own noise and its own mistakes."""
    dropped: float = 0.0
    """Share of masks that are missing; their pixels are unlabeled."""
    shifted: float = 0.0
    """Shift of each mask in a random direction, in blocks (fortieths of the image width). Later masks cover earlier
    ones."""
    boundary: float = 0.0
    """Share of cells with the label found two blocks away in a random direction, which frays edges."""
    pose: float = 0.0
    """Common shift of all masks of a view, in blocks. To first order, this is the effect of a rotation error of the
    pose."""
    views: int | None = None
    """Number of views to use, spread evenly from a random start, or None for all."""
    dominant: float = 1.0
    """Factor on the weight of one random view in five, as if these images had so many times the pixels."""
    floaters: bool = False
    """True if the scene has 5 % more Gaussians that float in front of the cameras; see
    `synthetic_scenes.with_floaters`."""
    grouped: float = 0.0
    """Share of the views in which 3 to 6 visible objects share one mask. These are the objects whose masks are nearest
    to that of a random one of them. The largest mask determines the class."""
    arc: float = 0.0
    """Share of all views, neighbors by azimuth around an object, in which the object has the same wrong class."""


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
"""Steps of version 0.1."""
STEPS = LADDER | {"group": replace(MILD, grouped=0.4), "arc": replace(MILD, arc=0.4)}


class Observed(NamedTuple):
    """Input of a lift."""

    evidence: Evidence
    features: Tensor
    """[S, D] unit rows."""
    columns: Tensor
    """[1, C'] region of every cell of the chosen views, or -1 for none."""
    views: list[int]


def observe(
    world: World, words: Words | Looks, damage: Damage, seed: int, lengths: Lengths | Cosines | None = None
) -> Observed:
    """Return masks and features of the world after the damage. The same arguments give the same result on any device.

    Args:
        words: Vectors of the features; with `Looks`, features are histograms of the content of the damaged masks.
        lengths: Lengths of the parts of features made of words, or measured cosines, for regions of parts of objects.
    """
    g, later = (torch.Generator().manual_seed(seed + more) for more in (0, LATER))
    cells = world.cells
    label = masks_of_cells(cells, world.classes, damage, g)
    size = torch.bincount(_key(cells.view, label, world.classes)[label >= 0], minlength=len(cells.maps) * world.classes)
    size = size.view(-1, world.classes)
    joined, dropped = _merge_and_drop(size, damage, g)
    if damage.grouped > 0:
        joined = _grouped(cells, label, size, damage, later).gather(1, joined)
    half = _halves(cells, label, world.classes, damage, g)
    final = torch.where(label >= 0, joined[cells.view, label.clamp(min=0)], -1)
    gone = (final < 0) | dropped[cells.view, final.clamp(min=0)]
    chosen = choose_views(len(cells.maps), damage, g)
    keep = torch.zeros(len(cells.maps), dtype=torch.bool)
    keep[chosen] = True
    key = torch.where(gone, -1, _key(cells.view, final, world.classes) * 2 + half)
    pieces = 2
    if isinstance(lengths, Cosines):  # regions of parts; what joins another mask joins one of its parts
        pieces = 2 * PARTS
        key = torch.where(gone, -1, key * PARTS + torch.where(final == label, world.parts, 0))
    present, index = key[keep[cells.view]].unique(return_inverse=True)
    index = index - int(len(present) > 0 and int(present[0]) < 0)
    present = present[present >= 0]
    masks, view = present // pieces % world.classes, present // (pieces * world.classes)
    forced = _arc(world, words.classes, damage, later)[view, masks] if damage.arc > 0 else torch.full_like(masks, -1)
    if isinstance(words, Looks):
        whole = torch.full((len(cells.view),), -1)
        whole[keep[cells.view]] = index
        features = mask_looks(words, whole, masks, forced, damage.wrong, g)
    elif isinstance(lengths, Cosines):
        regions = Regions(view, masks, present % PARTS, forced)
        features = real_features(words, regions, world.angles, damage.wrong, damage.noise, g, lengths)
    else:
        features = mask_features(words, masks, forced, damage.wrong, damage.noise, lengths or Lengths(), g)
    evidence = world.evidence
    if damage.dominant > 1:
        evidence = _weighted(evidence, _factors(len(cells.maps), damage, g).to(evidence.rows.weight))
    if len(chosen) < len(cells.maps):
        evidence = evidence.select_views(chosen)
    renumbered = torch.full((len(cells.maps),), -1)
    renumbered[chosen] = torch.arange(len(chosen))
    region_view = renumbered[view].int()
    columns = index[None]
    return Observed(evidence.regroup(columns, region_view), features.to(world.scene.means.device), columns, chosen)


def masks_of_cells(cells: Cells, classes: int, damage: Damage, g: torch.Generator) -> Tensor:
    """Return [C], the class of the mask of every cell after masks have moved and frayed, or -1 for none."""
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
    """Return the exact class at positions [C, 2] in the views of the cells, or of the nearest pixel outside of the
    image."""
    height, width = cells.maps.shape[1:]
    x, y = place[:, 0].floor().long().clamp(0, width - 1), place[:, 1].floor().long().clamp(0, height - 1)
    return cells.maps[cells.view, y, x]


def _merge_and_drop(size: Tensor, damage: Damage, g: torch.Generator) -> tuple[Tensor, Tensor]:
    """Return [V, K] the mask that each mask is merged into, and [V, K] whether the resulting mask is missing."""
    views, classes = size.shape
    joins = torch.rand(views, classes, generator=g) < damage.merged
    chance = torch.rand(views, classes, classes, generator=g) * (size > 0)[:, None] * (1 - torch.eye(classes))
    partner = chance.argmax(dim=2)
    partner = torch.where(joins & (size.gather(1, partner) > size), partner, torch.arange(classes))
    return partner, torch.rand(views, classes, generator=g) < damage.dropped


def _grouped(cells: Cells, label: Tensor, size: Tensor, damage: Damage, g: torch.Generator) -> Tensor:
    """Return [V, K], the mask that each mask is merged into."""
    views, classes = size.shape
    partner = torch.arange(classes).repeat(views, 1)
    key, there = _key(cells.view, label.clamp(min=0), classes), (label >= 0).float()
    middle = torch.zeros(views * classes, 2).index_add_(0, key, cells.centre * there[:, None])
    middle = (middle / size.view(-1, 1).clamp(min=1)).view(views, classes, 2)
    for view in torch.randperm(views, generator=g)[: round(damage.grouped * views)].tolist():
        things = (size[view] > 0).nonzero().squeeze(1)
        count = int(torch.randint(GROUP[0], GROUP[1] + 1, (), generator=g))
        first = int(torch.randint(0, max(1, len(things)), (), generator=g))
        if len(things) >= GROUP[0]:
            far = (middle[view, things] - middle[view, things[first]]).norm(dim=1)
            group = things[far.argsort()[:count]]
            partner[view, group] = group[size[view, group].argmax()]
    return partner


def _arc(world: World, classes: Tensor, damage: Damage, g: torch.Generator) -> Tensor:
    """Return [V, K], the wrong class of every object in the views of its arc, or -1 in other views."""
    rank = world.azimuth_rank
    views = len(rank)
    start = torch.randint(0, views, (world.classes,), generator=g)
    wrong = mistaken(torch.arange(world.classes), classes, g)
    return torch.where((rank - start) % views < round(damage.arc * views), wrong, -1)


def _halves(cells: Cells, label: Tensor, classes: int, damage: Damage, g: torch.Generator) -> Tensor:
    """Return [C], 0 or 1 for the side of the cut of its mask on which a cell lies."""
    views = len(cells.maps)
    key = _key(cells.view, label.clamp(min=0), classes)
    count = torch.bincount(key, minlength=views * classes).clamp(min=1)[:, None]
    middle = torch.zeros(views * classes, 2).index_add_(0, key, cells.centre) / count
    across = _unit(views * classes, g)
    cut = torch.rand(views * classes, generator=g) < damage.split
    return (((cells.centre - middle[key]) * across[key]).sum(1) > 0).long() * cut[key]


def choose_views(views: int, damage: Damage, g: torch.Generator) -> list[int]:
    """Return the indices of the views that are used, in ascending order."""
    if damage.views is None:
        return list(range(views))
    start = int(torch.randint(0, views, (), generator=g))
    return sorted({(start + i * views // damage.views) % views for i in range(damage.views)})


def _factors(views: int, damage: Damage, g: torch.Generator) -> Tensor:
    factor = torch.ones(views)
    factor[torch.randperm(views, generator=g)[: max(1, views // 5)]] = damage.dominant
    return factor


def _weighted(evidence: Evidence, factor: Tensor) -> Evidence:
    """Return evidence with a factor [V] on the weight of each view."""
    rows, blank = evidence.rows, evidence.unlabeled
    return replace(
        evidence,
        rows=replace(rows, weight=rows.weight * factor[evidence.region_view[rows.column.long()].long()]),
        unlabeled=replace(blank, weight=blank.weight * factor[blank.column.long()]),
    )


def _key(view: Tensor, mask: Tensor, classes: int) -> Tensor:
    return view * classes + mask


def _unit(count: int, g: torch.Generator) -> Tensor:
    """Return [count, 2] random unit vectors."""
    return normalize(torch.randn(count, 2, generator=g), dim=1)
