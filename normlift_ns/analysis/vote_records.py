"""Votes of a lifted run: evidence, features and regions of the images that it was lifted from.

Runs that store evidence contain the votes; other runs read them from the cache next to the run. Images are read only
for figures. Regions and features that need a network to compute are read from the cache, too.
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

from normlift_ns.analysis.explain import ViewVote, Why, draw_outlines, explain_selection
from normlift_ns.core.consensus import CHANCE_AGREEMENT, consensus
from normlift_ns.core.evidence import Evidence
from normlift_ns.core.field import SemanticField
from normlift_ns.core.lowrank import StoredEvidence
from normlift_ns.core.scene import Scene, View
from normlift_ns.encoders.base import FeatureSource, PatchFeatures, RegionFeatures
from normlift_ns.encoders.build import restore_source
from normlift_ns.encoders.cache import cached
from normlift_ns.encoders.color import ColorEncoder
from normlift_ns.errors import InputError
from normlift_ns.evidence_collection import (
    RasterConfig,
    ViewBatch,
    cached_batch_evidence,
    chunk_views,
    observe_views,
    region_levels,
)
from normlift_ns.options import GSPLAT_VERSIONS
from normlift_ns.rasterization.settings import RasterSettings
from normlift_ns.segmentation.sam import SamMasks

_FEATURE_TOLERANCE = 1e-3
"""Largest difference between a stored feature and the same feature computed again."""
_REMEDY = "restore it by lifting again with: ns-normlift (the same options)"


class VoteImage(NamedTuple):
    """One image with its vote for a selection."""

    name: str
    """Path of the image, relative to the dataset."""
    vote: ViewVote
    image: UInt8[Tensor, "h w 3"]
    """The image, at the resolution of the lift, with outlines of the regions that voted."""


@dataclass(frozen=True, eq=False)
class RecordedVotes:
    """The votes of all images of a lift."""

    scene: Scene
    field: SemanticField
    cache: Path
    """Folder of cached 2D features and evidence."""

    @cached_property
    def names(self) -> tuple[str, ...]:
        """Names of the images in the order of the lift.

        Raises:
            ValueError: the run does not record them, or the dataset no longer has them.
        """
        names = self.field.manifest.get("views_lifted")
        if not isinstance(names, list) or not all(isinstance(name, str) for name in names):
            raise InputError(
                "the run does not record which images were lifted: it is damaged or from an older version; lift again"
            )
        missing = [name for name in names if name not in set(self.scene.train.names)]
        if len(missing) > 0:
            raise InputError(
                f"{len(missing)} of {len(names)} images of the lift, such as {missing[0]}, are no longer in the "
                "dataset; restore them, give the path of the dataset with --data, or lift again"
            )
        store = self.field.store
        if isinstance(store, StoredEvidence) and store.evidence.num_views != len(names):
            raise InputError(
                f"the run lists {len(names)} images, but its evidence is from {store.evidence.num_views}; lift again"
            )
        return tuple(names)

    def explain(self, selected: Bool[Tensor, " n"], *, refined: bool = True) -> Why:
        """Explain a selection by the votes of the images; see `explain_selection`.

        Args:
            refined: for a Gaussian that copied a neighbor's direction, count that neighbor's evidence.
        Raises:
            ValueError: nothing is selected, or the cache no longer holds the votes.
        """
        evidence, features = self._table
        source = self.field.source if refined else None
        beta, unlabeled = self._option("beta", float, 1.0), self._option("unlabeled", str, "ignore")
        return explain_selection(evidence, features, selected, source=source, beta=beta, unlabeled=unlabeled)

    def pictures(self, votes: Iterable[ViewVote]) -> Iterator[VoteImage]:
        """Yield the image of each vote, with outlines of the regions that voted; images are read one at a time.

        Raises:
            FileNotFoundError: an image does not exist any more.
            ValueError: an image has changed, or the cache no longer holds its regions. Features passed from Python
                always raise this error, because no file has their regions.
        """
        for vote in votes:
            block, images = self._observe([vote.view])
            self._check_regions(vote.view, block)
            labels, regions = block.labels[0], block.regions[0]
            masks = [_region_mask(labels, regions, region.region) for region in vote.regions]
            yield VoteImage(self.names[vote.view], vote, draw_outlines(images[0], torch.stack(masks)))

    @cached_property
    def _table(self) -> tuple[Evidence, Float[Tensor, "s d"]]:
        """Evidence of all images, and the feature of every region."""
        store = self.field.store
        if isinstance(store, StoredEvidence):
            return store.evidence, store.features
        parts, tables, levels = [], [], []
        for chunk in chunk_views(range(len(self.names))):
            block, _ = self._observe(chunk)
            parts.append(self._cached_evidence(block))
            tables.extend(block.features)
            levels.extend(region_levels(*x) for x in zip(block.regions, map(len, block.features)))
        evidence, features = Evidence.merge(*parts), torch.cat(tables)
        if self._option("consensus", bool, False):
            features = consensus(
                evidence,
                features,
                level=torch.cat(levels),
                power=self._option("consensus_power", float, 1.0),
                sample=self._option("consensus_sample", int, 50),
                least=self._option("consensus_least", float, CHANCE_AGREEMENT),
            ).features
        return evidence, features

    def _cached_evidence(self, block: ViewBatch) -> Evidence:
        evidence = cached_batch_evidence(
            self.scene.gaussians,
            block,
            self.cache / "evidence",
            RasterConfig(
                gsplat_version=str(self.field.manifest.get("gsplat_rules", GSPLAT_VERSIONS[0])),
                backend=self.field.manifest.get("backend", "auto"),
                dtype=torch.float64 if self._option("precision", str, "standard") == "double" else torch.float32,
                rasterize_mode=self.scene.rasterize_mode,
                weight_power=self._option("weight_power", int, 1),
            ),
        )
        if evidence is None:
            raise InputError(
                f"{self.cache / 'evidence'} no longer holds the evidence of the lift, and the run stores directions "
                f"only; {_REMEDY}. With --storage evidence the run itself keeps the evidence"
            )
        return evidence

    def _observe(self, views: Sequence[int]) -> tuple[ViewBatch, list[Tensor]]:
        """Return labels, regions and features of some images of the lift, and the images at its resolution."""
        index_of = {name: index for index, name in enumerate(self.scene.train.names)}
        indices, images = [index_of[self.names[view]] for view in views], []

        def done(view: View) -> None:
            images.append(view.image)

        rendered = self._option("image_source", str, "photos") == "render"
        settings = RasterSettings.recorded(self.field.manifest) if rendered else None
        divisor = self._option("lift_downscale", int, 1)
        return observe_views(
            self.scene, indices, self._source, render_settings=settings, downscale=divisor, on_view=done
        ), images

    @cached_property
    def _source(self) -> FeatureSource:
        return cached(_without_networks(restore_source(self.field.manifest), self.cache), self.cache)

    def _check_regions(self, view: int, block: ViewBatch) -> None:
        """Raise if an image no longer has the regions that voted."""
        if not isinstance(self.field.store, StoredEvidence):
            return  # cached evidence was looked up by the content of the regions
        expected = self.field.store.features[self.field.store.evidence.columns_of([view])]
        actual = block.features[0]
        changed = expected.shape != actual.shape
        if not changed and not self._option("consensus", bool, False) and actual.numel() > 0:
            changed = float((expected - actual).abs().max()) > _FEATURE_TOLERANCE
        if changed:
            raise InputError(
                f"{self.names[view]} no longer has the regions that were lifted: the image, its label map or the "
                "features have changed since; restore them, or lift again"
            )

    def _option(self, name: str, kind: type, default: Any) -> Any:
        """Return an option of the lift, or the default if the manifest does not record it."""
        options = self.field.manifest.get("options")
        value = options.get(name, default) if isinstance(options, Mapping) else default
        if not isinstance(value, (int, float) if kind is float else kind):
            raise InputError(f"the run's manifest is damaged: its option {name} is {value!r:.40}; lift again")
        return value


def _region_mask(labels: Tensor, regions: Tensor, region: int) -> Bool[Tensor, "h w"]:
    """Return the pixels of one region: those of its cells, at any level."""
    cells = (regions == region).any(dim=0)
    return (labels >= 0) & cells[labels.clamp(min=0).long()]


def _without_networks(source: FeatureSource, cache: Path) -> FeatureSource:
    """Return the source with networks that raise an error instead of computing what the cache does not hold."""
    if isinstance(source, RegionFeatures):
        regions: Any = _CacheOnly(source.regions, cache) if isinstance(source.regions, SamMasks) else source.regions
        is_color = isinstance(source.encoder, ColorEncoder)
        encoder: Any = source.encoder if is_color else _CacheOnly(source.encoder, cache)
        return replace(source, regions=regions, encoder=encoder)
    return _CacheOnlyPatches(source.encoder, source.count, cache) if isinstance(source, PatchFeatures) else source


def _missing_features(cache: Path) -> InputError:
    return InputError(f"{cache / 'features'} no longer holds the features of the images; {_REMEDY}")


@dataclass(frozen=True)
class _CacheOnlyPatches(PatchFeatures):
    """Patch features without a network; see `_CacheOnly`."""

    cache: Path = Path()

    def features(self, image: UInt8[Tensor, "h w 3"], name: str) -> Float[Tensor, "r d"]:
        raise _missing_features(self.cache)


class _CacheOnly:
    """Stand-in for a network whose results are cached; computing a missing one might take minutes, so it raises."""

    def __init__(self, network: Any, cache: Path) -> None:
        self._network, self._cache = network, cache

    def __getattr__(self, name: str) -> Any:
        return getattr(self._network, name)

    def labels(self, image: Tensor, name: str) -> Tensor:
        raise InputError(f"{self._cache / 'regions'} no longer holds the regions of {name}; {_REMEDY}")

    def encode_each(self, views: Iterable[tuple[Tensor, Tensor]]) -> Iterator[Tensor]:
        for _ in views:
            raise _missing_features(self._cache)
        yield from ()
