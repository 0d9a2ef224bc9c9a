"""Data that all cells of one scene and one kind of region share: evidence, neighbors, voters, words and histograms."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache

import torch
from torch import Tensor

from normlift_ns import Evidence, lift, nearest_neighbors
from normlift_ns.core.consensus import apply_consensus, region_overlaps, sample_gaussians, total_view_weights
from research.batched_votes import Result, Voters, results, voters_of
from research.candidates import Candidate
from research.damage import Observed, observe
from research.features import LENGTHS, Looks, orthogonal_words, world_looks
from research.pseudo_regions import Pieces, observe_pieces, pieces
from research.real_features import FOX
from research.rule import REAL, Cell, damage_of
from research.second_room import second
from research.synthetic_scenes import Words, World, demo, made_words, real_words, tabletop, with_floaters
from research.third_room import third

NEIGHBORS = 36
SAMPLE = 50
"""Number of Gaussians per region that the consensus samples."""


@dataclass(frozen=True)
class Settings:
    """Sizes of scenes, samples and regions."""

    voters: int | None = None
    """Number of Gaussians that vote and count, or None for all with a known class."""
    gaussians: int | None = None
    """Number of Gaussians of the rooms, or None for their default."""
    views: int | None = None
    """Number of training views of the tabletop, or None for all."""
    room_views: int | None = None
    room_width: int | None = None
    """Views of the rooms, and width of these views in pixels, or None for their defaults."""
    pieces: int | None = None
    """Number of pieces per image, or None for the default of the source."""
    device: str = "cpu"


@dataclass(frozen=True)
class Place:
    """Scene, kind of region and floaters of a site."""

    scene: str
    kind: str
    floaters: bool

    @staticmethod
    def of(cell: Cell) -> Place:
        """Return the place of a cell."""
        return Place(cell.scene, cell.kind, cell.damage == "floaters")


class Site:
    """Runner of the cells of one place."""

    def __init__(self, place: Place, settings: Settings) -> None:
        base = base_world(place.scene, settings)
        whole = with_floaters(base) if place.floaters else base
        self.words = words_of(place.scene, whole.classes)
        near = nearest_neighbors(whole.scene.means.to(settings.device), NEIGHBORS)
        voters = voters_of(near, whole.truth.to(settings.device), whole.classes, sample_of(whole.truth, settings))
        kept = None
        if settings.voters is not None:
            kept = voters.group[voters.group >= 0].unique()
            voters = renumbered(voters, kept)
        self.voters, self.kept = voters, kept
        if place.kind == "masks":
            self.cut: Pieces | None = None
            self._whole = whole
            self.world = ready(whole, restricted(whole.evidence, kept), settings.device)
        else:
            cut = pieces(whole, place.kind, settings.pieces)
            self.world = ready(whole, whole.evidence, settings.device)
            evidence = restricted(cut.evidence, kept).to(settings.device)
            self._looks = cut.looks
            self.cut = replace(cut, world=self.world, evidence=evidence)

    @cached_property
    def looks(self) -> Looks:
        """Histograms of the cells, or of the pieces."""
        return world_looks(self._whole) if self.cut is None else self._looks

    def observed(self, cell: Cell, seed: int) -> Observed:
        """Return the input of a lift in a cell."""
        if cell.statistic == "histogram":
            words, lengths = self.looks, None
        elif cell.statistic == REAL:
            return observe(self.world, self.words[REAL], damage_of(cell), seed, FOX)
        else:
            words, lengths = self.words[cell.statistic], LENGTHS[cell.statistic]
        if self.cut is None:
            return observe(self.world, words, damage_of(cell), seed, lengths)
        return observe_pieces(self.cut, words, damage_of(cell), seed, lengths)

    def run(self, cell: Cell, seed: int, candidates: Sequence[Candidate]) -> dict[str, Result]:
        """Return the results of all candidates on one observation, in their order."""
        observed = self.observed(cell, seed)
        classes = (self.looks if cell.statistic == "histogram" else self.words[cell.statistic]).classes
        by_table: dict[float | None, list[Candidate]] = {}
        for one in candidates:
            by_table.setdefault(one.consensus, []).append(one)
        tables = agreed_tables(observed.evidence, observed.features, [p for p in by_table if p is not None])
        found: dict[str, Result] = {}
        seen = lift(observed.evidence, observed.features)
        for power, some in by_table.items():  # R as regions were seen, as `normlift_ns.pipeline` has it
            lifted = seen if power is None else replace(lift(observed.evidence, tables[power]), scalars=seen.scalars)
            found |= results(some, lifted, self.voters, classes.to(observed.features.device))
        return {one.name: found[one.name] for one in candidates}


def agreed_tables(evidence: Evidence, features: Tensor, powers: Sequence[float]) -> dict[float, Tensor]:
    """Return the features after the consensus for each power. The overlaps of regions are computed once."""
    if len(powers) == 0:
        return {}
    chosen, chance = sample_gaussians(evidence.rows, evidence.num_regions, SAMPLE)
    rows, total = evidence.rows.select_rows(chosen), total_view_weights(evidence.select_gaussians(chosen))
    overlaps = region_overlaps(rows, evidence.region_view, chance, total)
    return {power: apply_consensus(features, overlaps, power) for power in powers}


@lru_cache(maxsize=1)
def base_world(scene: str, settings: Settings) -> World:
    """Return a scene on the CPU."""
    if scene == "tabletop":
        return tabletop(settings.views)
    given = {"num_gaussians": settings.gaussians, "views": settings.room_views, "width": settings.room_width}
    room = {"demo": demo, "second": second, "third": third}[scene]
    return room(**{key: value for key, value in given.items() if value is not None})


def words_of(scene: str, classes: int) -> dict[str, Words]:
    """Return the class vectors by statistic: CLIP's for the tabletop, and made vectors with similar cosines for the
    rooms."""
    close = real_words() if scene == "tabletop" else made_words(classes)
    apart = orthogonal_words(classes)
    return {name: apart if name in ("orthogonal", REAL) else close for name in (*LENGTHS, REAL)}


def sample_of(truth: Tensor, settings: Settings) -> Tensor | None:
    """Return the Gaussians that vote, in ascending order, or None for all with a known class."""
    if settings.voters is None:
        return None
    known = (truth >= 0).nonzero().squeeze(1)
    chosen = known[torch.randperm(len(known), generator=torch.Generator().manual_seed(0))[: settings.voters]]
    return chosen.sort().values.to(settings.device)


def renumbered(voters: Voters, kept: Tensor) -> Voters:
    """Return the voters of a scene that has only the Gaussians `kept`."""
    group = torch.searchsorted(kept, voters.group.clamp(min=0))
    return replace(voters, group=torch.where(voters.group >= 0, group, -1))


def restricted(evidence: Evidence, kept: Tensor | None) -> Evidence:
    """Return the evidence of the Gaussians `kept`, or of all Gaussians for None."""
    if kept is None:
        return evidence
    rows, unlabeled = (x.select_rows(kept.cpu()) for x in (evidence.rows, evidence.unlabeled))
    return replace(evidence, rows=rows, unlabeled=unlabeled)


def ready(world: World, evidence: Evidence, device: str) -> World:
    """Return the world on a device with other evidence, for observations."""
    kept = {key: getattr(world, key) for key in ("azimuth_rank", "angles", "parts")}
    moved = replace(world, evidence=evidence).to(device)
    moved.__dict__.update(kept)
    return moved
