"""The votes of a lifted run, opened again: evidence, features and regions of the photographs that it was lifted from.

Runs that store evidence hold the votes themselves; the others find them in the cache beside the run. Photographs are
read where pictures are wanted, and regions of them that only a network could make again come from the cache too.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple

import torch
from jaxtyping import Bool, Float, UInt8
from torch import Tensor

from normlift_ns.core.consensus import CHANCE, consensus
from normlift_ns.core.evidence import Evidence
from normlift_ns.core.field import SemanticField
from normlift_ns.core.scene import Scene, View
from normlift_ns.core.storage import StoredEvidence
from normlift_ns.encoders.build import recorded_source
from normlift_ns.encoders.cache import cached
from normlift_ns.encoders.colour import ColourEncoder
from normlift_ns.encoders.patches import PatchFeatures
from normlift_ns.encoders.sam.masks import SamMasks
from normlift_ns.encoders.source import FeatureSource, RegionFeatures
from normlift_ns.errors import InputError
from normlift_ns.insight.outline import outlined
from normlift_ns.insight.why import ViewVote, Why, explain_selection
from normlift_ns.observing import Block, in_chunks, kept_evidence, observe_views, region_levels
from normlift_ns.raster.settings import RasterSettings

_SAME = 1e-3
"""Largest difference of a feature that was made again."""
_AGAIN = "lift again with: ns-normlift (the same options), which makes it again"


class Picture(NamedTuple):
    """One photograph with what it says of a selection."""

    name: str
    """Of the photograph, relative to the dataset."""
    vote: ViewVote
    image: UInt8[Tensor, "h w 3"]
    """The photograph, at the size that it was lifted at, with the outlines of the regions that voted."""


@dataclass(frozen=True, eq=False)
class Votes:
    """Everything that photographs said in a lift."""

    scene: Scene
    field: SemanticField
    cache: Path
    """Folder of 2D features and evidence."""

    @cached_property
    def names(self) -> tuple[str, ...]:
        """Photographs of the lift, in its order.

        Raises:
            ValueError: the run does not tell which, or the data set no longer has them.
        """
        names = self.field.manifest.get("views_lifted")
        if not isinstance(names, list) or not all(isinstance(name, str) for name in names):
            raise InputError(
                "the run does not tell which photographs were lifted: it is of an older version, or damaged; lift again"
            )
        gone = [name for name in names if name not in set(self.scene.train.names)]
        if len(gone) > 0:
            raise InputError(
                f"{len(gone)} of {len(names)} photographs of the lift, such as {gone[0]}, are no longer in the data "
                "set; restore it, say where it is with --data, or lift again"
            )
        store = self.field.store
        if isinstance(store, StoredEvidence) and store.evidence.num_views != len(names):
            raise InputError(
                f"the run names {len(names)} photographs, but its evidence is of {store.evidence.num_views}; lift again"
            )
        return tuple(names)

    def explain(self, selected: Bool[Tensor, " n"], *, refined: bool = True) -> Why:
        """What the photographs say of a selection, as `explain_selection`.

        Args:
            refined: a Gaussian that has copied a neighbour's direction brings the evidence of that neighbour.
        Raises:
            ValueError: nothing is selected; what the cache no longer holds.
        """
        evidence, features = self._table
        source = self.field.source if refined else None
        how = {"beta": self._option("beta", float, 1.0), "unlabeled": self._option("unlabeled", str, "ignore")}
        return explain_selection(evidence, features, selected, source=source, **how)

    def pictures(self, votes: Iterable[ViewVote]) -> Iterator[Picture]:
        """The photographs of some votes, with the outlines of the regions that voted, read one after the other.

        Raises:
            FileNotFoundError: a photograph is gone.
            ValueError: another photograph has taken its place; regions that the cache no longer holds; features that
                were given from Python, whose regions no file has.
        """
        for vote in votes:
            block, image = self._observe([vote.view])
            self._check(vote.view, block)
            labels, regions = block.labels[0], block.regions[0]
            masks = [_pixels(labels, regions, region.region) for region in vote.regions]
            yield Picture(self.names[vote.view], vote, outlined(image[0], torch.stack(masks)))

    @cached_property
    def _table(self) -> tuple[Evidence, Float[Tensor, "s d"]]:
        """Evidence of all photographs, and the feature of every region."""
        store = self.field.store
        if isinstance(store, StoredEvidence):
            return store.evidence, store.features
        parts, tables, levels = [], [], []
        for chunk in in_chunks(range(len(self.names))):
            block, _ = self._observe(chunk)
            parts.append(self._kept(block))
            tables.extend(block.features)
            levels.extend(region_levels(*x) for x in zip(block.regions, map(len, block.features)))
        evidence, features = Evidence.merge(*parts), torch.cat(tables)
        if self._option("consensus", bool, False):
            power, sample = self._option("consensus_power", float, 1.0), self._option("consensus_sample", int, 50)
            how = {"power": power, "sample": sample, "least": self._option("consensus_least", float, CHANCE)}
            features = consensus(evidence, features, level=torch.cat(levels), **how).features
        return evidence, features

    def _kept(self, block: Block) -> Evidence:
        settings, double = RasterSettings.recorded(self.field.manifest), self._option("precision", str, "standard")
        found = kept_evidence(
            self.scene.gaussians,
            block,
            self.cache / "evidence",
            rasterize_mode=self.scene.rasterize_mode,
            settings=settings,
            backend=self.field.manifest.get("backend", "auto"),
            weight_power=self._option("weight_power", int, 1),
            dtype=torch.float64 if double == "double" else torch.float32,
        )
        if found is None:
            raise InputError(
                f"{self.cache / 'evidence'} no longer holds the evidence of the lift, and the run stores directions "
                f"only; {_AGAIN}. With --storage evidence the run itself keeps it"
            )
        return found

    def _observe(self, views: Sequence[int]) -> tuple[Block, list[Tensor]]:
        """Labels, regions and features of some photographs of the lift, and these themselves as the lift saw them."""
        place = {name: index for index, name in enumerate(self.scene.train.names)}
        chosen, images = [place[self.names[view]] for view in views], []

        def done(view: View) -> None:
            images.append(view.image)

        rendered = self._option("image_source", str, "photos") == "render"
        settings = RasterSettings.recorded(self.field.manifest) if rendered else None
        divisor = self._option("lift_downscale", int, 1)
        return observe_views(self.scene, chosen, self._source, rendered=settings, divisor=divisor, done=done), images

    @cached_property
    def _source(self) -> FeatureSource:
        return cached(_without_networks(recorded_source(self.field.manifest), self.cache), self.cache)

    def _check(self, view: int, block: Block) -> None:
        """Makes sure that a photograph still has the regions that voted."""
        if not isinstance(self.field.store, StoredEvidence):
            return  # its evidence was found by the content of the regions
        wanted = self.field.store.features[self.field.store.evidence.columns_of([view])]
        found = block.features[0]
        changed = wanted.shape != found.shape
        if not changed and not self._option("consensus", bool, False) and found.numel() > 0:
            changed = float((wanted - found).abs().max()) > _SAME
        if changed:
            raise InputError(
                f"{self.names[view]} no longer has the regions that were lifted: the photograph, its label map or the "
                "features have changed since; restore them, or lift again"
            )

    def _option(self, name: str, kind: type, default: Any) -> Any:
        """An option of the lift; the default where the manifest does not say it."""
        options = self.field.manifest.get("options")
        value = options.get(name, default) if isinstance(options, Mapping) else default
        if not isinstance(value, (int, float) if kind is float else kind):
            raise InputError(f"the run's manifest is damaged: its option {name} is {value!r:.40}; lift again")
        return value


def _pixels(labels: Tensor, regions: Tensor, region: int) -> Bool[Tensor, "h w"]:
    """The pixels of one region: those of its cells, in any level."""
    cells = (regions == region).any(dim=0)
    return (labels >= 0) & cells[labels.clamp(min=0).long()]


def _without_networks(source: FeatureSource, cache: Path) -> FeatureSource:
    """The source, which refuses to compute what only a network can."""
    if isinstance(source, RegionFeatures):
        regions: Any = _Kept(source.regions, cache) if isinstance(source.regions, SamMasks) else source.regions
        encoder: Any = source.encoder if isinstance(source.encoder, ColourEncoder) else _Kept(source.encoder, cache)
        return replace(source, regions=regions, encoder=encoder)
    return _KeptPatches(source.encoder, source.count, cache) if isinstance(source, PatchFeatures) else source


def _features_gone(cache: Path) -> InputError:
    return InputError(f"{cache / 'features'} no longer holds the features of the photographs; {_AGAIN}")


@dataclass(frozen=True)
class _KeptPatches(PatchFeatures):
    """As `_Kept`."""

    cache: Path = Path()

    def features(self, image: UInt8[Tensor, "h w 3"], name: str) -> Float[Tensor, "r d"]:
        raise _features_gone(self.cache)


class _Kept:
    """A network whose results are kept; what is not there is an error, for it might take minutes."""

    def __init__(self, network: Any, cache: Path) -> None:
        self._network, self._cache = network, cache

    def __getattr__(self, name: str) -> Any:
        return getattr(self._network, name)

    def labels(self, image: Tensor, name: str) -> Tensor:
        raise InputError(f"{self._cache / 'regions'} no longer holds the regions of {name}; {_AGAIN}")

    def encode_each(self, views: Iterable[tuple[Tensor, Tensor]]) -> Iterator[Tensor]:
        for _ in views:
            raise _features_gone(self._cache)
        yield from ()
