"""Explanation of a selection of Gaussians by the images and regions that voted for it.

The selection is treated as one large Gaussian whose evidence is the sum over its members. With E_s = sum_j E_js and F_s
the unit feature of region s::

    W_v  = sum_{s in v} E_s                    weight of image v
    S_v  = sum_{s in v} E_s F_s                vote of image v
    a_v  = cos(S_v, sum_v S_v)                 agreement of image v with the sum of all votes
    C_inter = ||sum_v S_v|| / sum_v ||S_v||    and norm, C_intra, N_eff, R as in `core.lift`

The disagreement 1 - C_inter is the sum over images of ||S_v|| (1 - a_v) / sum_v ||S_v||. The images that disagree most
have the largest terms. If a Gaussian has the direction of a neighbor, the neighbor's evidence replaces its own.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple

import torch
from jaxtyping import Bool, Float, Float64, Int, UInt8
from torch import Tensor
from torch.nn.functional import max_pool2d

from normlift_ns import evidence_collection
from normlift_ns.core.arguments import check_arguments
from normlift_ns.core.consensus import CHANCE_AGREEMENT, consensus
from normlift_ns.core.evidence import Evidence
from normlift_ns.core.field import CHANGED_COSINE, SemanticField
from normlift_ns.core.lift import lift
from normlift_ns.core.lowrank import StoredEvidence
from normlift_ns.core.reliability import norm_of_reliability
from normlift_ns.core.scene import Scene
from normlift_ns.core.sparse import SparseRows, row_offsets
from normlift_ns.encoders.base import FeatureSource
from normlift_ns.encoders.build import restore_source
from normlift_ns.encoders.cache import cached
from normlift_ns.encoders.color import ColorEncoder
from normlift_ns.errors import InputError
from normlift_ns.options import GSPLAT_VERSIONS, UnlabeledMode, option_name, option_setting
from normlift_ns.rasterization.settings import RasterSettings

_UNLISTED_SHARE = 0.1
"""Maximum fraction of an image's weight in regions that are not listed."""


@dataclass(frozen=True)
class RegionVote:
    """Vote of one region of an image."""

    region: int
    """Index of the region within its image."""
    weight: float
    """E_s, the weight of the selection in this region, in pixels."""
    share: float
    """Weight in this region as a fraction of the weight in the whole image, in 0..1."""
    agreement: float
    """Cosine between the region's feature and the direction of the selection."""


@dataclass(frozen=True)
class ViewVote:
    """Vote of one image for a selection."""

    view: int
    """Index of the image in the order of the lift."""
    weight: float
    """W_v, the weight of the selection in this image, in pixels."""
    share: float
    """Weight of this image as a fraction of the weight of all images, in 0..1."""
    agreement: float
    """a_v, the cosine between the vote of this image and the sum of all votes."""
    disagreement: float
    """Fraction of the total disagreement that comes from this image, in 0..1; 0 if all images agree."""
    regions: tuple[RegionVote, ...]
    """Regions by descending weight, which together have at least 90% of the image's weight."""


@check_arguments
@dataclass(frozen=True)
class Why:
    """Explanation of a selection: votes of all images and their agreement.

    >>> import torch
    >>> from normlift_ns import Evidence
    >>> from normlift_ns.core.evidence import Entries
    >>> from normlift_ns.analysis.explain import explain_selection
    >>> entries = Entries(torch.tensor([0, 0, 1, 1]), torch.tensor([1, 3, 1, 3]), torch.tensor([3.0, 1, 3, 1]), (1, 1))
    >>> evidence = Evidence.from_entries([entries], 3)
    >>> why = explain_selection(evidence, torch.tensor([[1.0, 0.0], [0.0, 1.0]]), torch.tensor([True, True, False]))
    >>> [(vote.view, vote.weight, round(vote.agreement, 3)) for vote in why.views]
    [(0, 6.0, 0.949), (1, 2.0, 0.316)]
    >>> round(why.c_inter, 3), why.n_eff, why.most_different[0].view
    (0.791, 1.6, 1)
    """

    gaussians: int
    """Number of selected Gaussians."""
    changed: float
    """Share of the selected Gaussians whose direction the vote of their neighbors changed, in 0..1, estimated from
    at most 4,096 of them. A direction counts as changed if its cosine with the previous direction is below 0.98."""
    norm: float
    c_intra: float
    c_inter: float
    n_eff: float
    reliability: float
    """R of the selection. For R, `norm`, `c_intra`, `c_inter` and `n_eff`, the selection counts as one Gaussian."""
    views: tuple[ViewVote, ...]
    """Votes of the images with weight > 0, by descending weight."""
    copied: int = 0
    """Number of selected Gaussians that use the direction of another Gaussian. This value of version 0.2 will be
    removed. Use `changed` instead."""

    @property
    def most_different(self) -> tuple[ViewVote, ...]:
        """Votes of the images that disagree, by descending disagreement; empty if all images agree."""
        votes = [vote for vote in self.views if vote.disagreement > 0]
        return tuple(sorted(votes, key=lambda vote: -vote.disagreement))

    def images_to_show(self, count: int = 3) -> tuple[tuple[ViewVote, ...], tuple[ViewVote, ...]]:
        """Return the votes of the images with the largest weights and of others that disagree, at most `count` of each.

        An image disagrees if the cosine between its vote and the sum of all votes is below 0.9.
        """
        heaviest = self.views[:count]
        others = [one for one in self.most_different if one.agreement < _MIN_AGREEMENT and one not in heaviest]
        return heaviest, tuple(others[:count])

    @property
    def words(self) -> str:
        """Agreement and effective number of the images, as English sentences.

        >>> Why(5, 0.0, 0.9, 1.0, 0.97, 3.2, 0.7, ()).words
        'The images agree (C_inter 0.97). Their weights are equivalent to 3.2 images of equal weight (N_eff).'
        """
        if len(self.views) == 0 and self.n_eff == 0:
            return "No image shows the selection in its regions."
        if len(self.views) == 1:
            return "Only one image shows the selection in its regions, so no other image can confirm its features."
        level = next(words for least, words in _LEVELS if self.c_inter >= least)
        count = "a single image" if self.n_eff < 1.05 else f"{self.n_eff:.1f} images of equal weight"
        return f"The images {level} (C_inter {self.c_inter:.2f}). Their weights are equivalent to {count} (N_eff)."

    @property
    def sentence(self) -> str:
        """`words`, followed by a sentence about the share of changed directions, unless the share is 0."""
        if self.changed == 0:
            return self.words
        share = "less than 1%" if self.changed < 0.01 else f"{self.changed:.0%}"
        return f"{self.words} The vote of neighboring Gaussians changed {share} of the directions."

    def to_json(self) -> dict[str, Any]:
        """Return all fields and the words as plain Python types."""
        return {**asdict(self), "words": self.words}


_MIN_AGREEMENT = 0.9
_COMPARED = 4096
"""Maximum number of Gaussians whose directions before and after the vote are compared."""
_LEVELS = (
    (0.95, "agree"),
    (0.85, "agree with few exceptions"),
    (0.6, "agree partly"),
    (0.0, "contradict each other"),
)
"""Pairs of a minimum C_inter and the words that describe this agreement of the images."""


def explain_selection(
    evidence: Evidence,
    features: Float[Tensor, "s d"],
    selected: Bool[Tensor, " n"],
    *,
    source: Int[Tensor, " n"] | None = None,
    beta: float = 1.0,
    unlabeled: UnlabeledMode = "ignore",
) -> Why:
    """Explain a selection by the votes of the images.

    Args:
        features: One unit row per column (region) of the evidence.
        selected: True for the selected Gaussians.
        source: Index of the Gaussian whose direction each Gaussian uses, from `refine`; None if each uses its own.
        beta, unlabeled: As in `lift`.
    Raises:
        ValueError: Nothing is selected, or the arguments have different numbers of Gaussians or regions.
    """
    n = evidence.num_gaussians
    if selected.dtype != torch.bool or selected.shape != (n,):
        raise InputError(f"selected must be {n:,} booleans, got {selected.dtype} {tuple(selected.shape)}")
    rows = selected.to(evidence.rows.offsets.device).nonzero().squeeze(1)
    if len(rows) == 0:
        raise InputError("nothing is selected; select one or more Gaussians")
    origin = rows if source is None else source.to(rows.device).long()[rows]
    joined = _summed(evidence, origin)
    lifted = lift(joined, features, beta=beta, unlabeled=unlabeled)
    scalars = {
        name: float(getattr(lifted.scalars, name)[0]) for name in ("norm", "c_intra", "c_inter", "n_eff", "reliability")
    }
    table = features.to(joined.rows.weight.device)[joined.rows.column.long()].double()
    views = _votes(joined, torch.nn.functional.normalize(table, dim=1))
    copied = int((origin != rows).sum())
    return Why(len(rows), _changed_share(evidence, features, rows, origin), **scalars, views=views, copied=copied)


def _changed_share(evidence: Evidence, features: Tensor, rows: Tensor, origin: Tensor) -> float:
    """Estimate the share of pairs (rows[i], origin[i]) whose directions differ, from at most `_COMPARED` pairs."""
    step = -(-len(rows) // _COMPARED)
    rows, origin = rows[::step], origin[::step]
    other, table = rows != origin, torch.nn.functional.normalize(features.to(rows.device).float(), dim=1)
    sums = (evidence.rows.select_rows(x[other]).sums_of_unit_rows(table) for x in (rows, origin))
    own, used = (torch.nn.functional.normalize(x, dim=1) for x in sums)
    return int(((own * used).sum(dim=1) < CHANGED_COSINE).sum()) / len(rows)


def _summed(evidence: Evidence, rows: Tensor) -> Evidence:
    """Return the sum of the evidence of the Gaussians `rows` as one row; duplicates in `rows` count several times."""
    parts = []
    for matrix, columns in ((evidence.rows, evidence.num_regions), (evidence.unlabeled, evidence.num_views)):
        selected = matrix.select_rows(rows)
        weight = torch.zeros(columns, dtype=torch.float64, device=rows.device)
        weight.index_add_(0, selected.column.long(), selected.weight.double())
        column = weight.nonzero().squeeze(1)
        offsets = torch.tensor([0, len(column)], device=rows.device)
        parts.append(SparseRows(offsets, column.int(), weight[column]))
    return Evidence(parts[0], evidence.region_view, parts[1], evidence.num_views, evidence.weight_power)


def _votes(joined: Evidence, table: Float64[Tensor, "r d"]) -> tuple[ViewVote, ...]:
    """Return the votes of the images with weight > 0, from evidence with one row and the feature of each entry."""
    column, weight = joined.rows.column.long(), joined.rows.weight
    view = joined.region_view[column].long()
    total = torch.zeros(joined.num_views, dtype=torch.float64, device=weight.device).index_add_(0, view, weight)
    vectors = table.new_zeros(joined.num_views, table.shape[1]).index_add_(0, view, weight[:, None] * table)
    direction = torch.nn.functional.normalize(vectors.sum(0), dim=0)
    length, along = vectors.norm(dim=1), vectors @ direction
    gap = (length - along).clamp(min=0)
    gap = torch.where(gap > 1e-12 * length, gap, 0.0)  # ignore rounding errors
    disagreement = gap / gap.sum() if float(gap.sum()) > 0 else gap
    agreement = torch.where(length > 0, along / length.clamp(min=1e-300), 0.0).clamp(-1, 1)
    cosine, first = table @ direction, row_offsets(joined.region_view, joined.num_views)  # columns of images
    votes = []
    for v in total.argsort(descending=True, stable=True).tolist():
        if not float(total[v]) > 0:
            break
        entries = (view == v).nonzero().squeeze(1)
        entries = entries[weight[entries].argsort(descending=True, stable=True)]
        before = weight[entries].cumsum(0) - weight[entries]
        entries = entries[before <= (1 - _UNLISTED_SHARE) * total[v]]
        numbers = (column - first[v], weight, weight / total[v], cosine.clamp(-1, 1))
        regions = tuple(RegionVote(*row) for row in zip(*(x[entries].tolist() for x in numbers)))
        share = float(total[v] / total.sum())
        votes.append(ViewVote(v, float(total[v]), share, float(agreement[v]), float(disagreement[v]), regions))
    return tuple(votes)


_LINE_COLOR = (255, 176, 0)
"""Orange, which contrasts with dark pixels for all types of color vision."""
_OUTSIDE_BRIGHTNESS = 0.45
_SIDE_PER_LINE_WIDTH = 320
"""Ratio of the longer image side to the line width."""


def draw_outlines(image: UInt8[Tensor, "h w 3"], masks: Bool[Tensor, "r h w"]) -> UInt8[Tensor, "h w 3"]:
    """Darken an image outside all masks, and draw an orange line along the inner edge of each mask.

    In images with a longer side of 480 pixels or more, the line has a dark rim inside the masks.

    >>> image = torch.full((9, 9, 3), 200, dtype=torch.uint8)
    >>> mask = torch.zeros(1, 9, 9, dtype=torch.bool)
    >>> mask[:, 2:7, 2:7] = True
    >>> shown = draw_outlines(image, mask)
    >>> shown[0, 0].tolist(), shown[2, 4].tolist(), shown[4, 4].tolist()
    ([90, 90, 90], [255, 176, 0], [200, 200, 200])
    """
    width = max(1, round(max(image.shape[:2]) / _SIDE_PER_LINE_WIDTH))
    inside = masks.any(dim=0)
    line = (masks & ~_eroded(masks, width)).any(dim=0)
    rim = ~line & (~_eroded(~line[None], width)[0])
    shown = torch.where(inside[:, :, None], image.float(), _OUTSIDE_BRIGHTNESS * image.float())
    shown = torch.where((rim & inside)[:, :, None], 0.25 * shown, shown) if width > 1 else shown
    color = torch.tensor(_LINE_COLOR, dtype=torch.float32)
    return torch.where(line[:, :, None], color, shown).round().to(torch.uint8)


def _eroded(masks: Bool[Tensor, "r h w"], width: int) -> Bool[Tensor, "r h w"]:
    """Erode masks by `width` pixels; pixels beyond the image count as outside."""
    outside = torch.nn.functional.pad((~masks).float(), (width,) * 4, value=1.0)
    return max_pool2d(outside[:, None], 2 * width + 1, stride=1)[:, 0] == 0


# Votes of a lifted run: evidence, features and regions of the lifted images.
#
# Runs that store evidence contain the votes; other runs read them from the cache next to the run. Images are read only
# for figures. Regions and features from networks are also read from the cache.


_FEATURE_TOLERANCE = 1e-3
"""Maximum difference between a component of a stored feature and the same component after recomputation."""


class VoteImage(NamedTuple):
    """Image with its vote for a selection."""

    name: str
    """Path of the image, relative to the dataset."""
    vote: ViewVote
    image: UInt8[Tensor, "h w 3"]
    """Image at the resolution of the lift, with outlines of the regions that voted."""


@dataclass(frozen=True, eq=False)
class RecordedVotes:
    """Votes of all images of a lift."""

    scene: Scene
    field: SemanticField
    cache: Path
    """Folder of cached 2D features and evidence."""

    @cached_property
    def names(self) -> tuple[str, ...]:
        """Names of the images in the order of the lift.

        Raises:
            ValueError: The run does not record the names or has evidence of a different number of images, or the
                dataset no longer has all images.
        """
        names = self.field.manifest.get("views_lifted")
        if not isinstance(names, list) or not all(isinstance(name, str) for name in names):
            raise InputError("the run does not record the names of its lifted images; lift again with: ns-normlift")
        missing = [name for name in names if name not in set(self.scene.train.names)]
        if len(missing) > 0:
            raise InputError(
                f"the dataset no longer has {len(missing)} of {len(names)} images of the lift (first: {missing[0]}). "
                f"Restore the images, set {option_name('data')} to the dataset path, or lift again with: ns-normlift"
            )
        store = self.field.store
        if isinstance(store, StoredEvidence) and store.evidence.num_views != len(names):
            raise InputError(
                f"the run lists {len(names)} images, but has evidence from {store.evidence.num_views} images; lift "
                "again with: ns-normlift"
            )
        return tuple(names)

    def explain(self, selected: Bool[Tensor, " n"], *, refined: bool = True) -> Why:
        """Explain a selection by the votes of the images; see `explain_selection`.

        Args:
            refined: For a Gaussian that took over the direction of a neighbor, use the evidence of that neighbor.
        Raises:
            ValueError: Nothing is selected, or the votes are no longer in the cache.
        """
        evidence, features = self.table
        source = self.field.source if refined else None
        beta, unlabeled = self._option("reliability_beta", float, 1.0), self._option("unlabeled", str, "ignore")
        return explain_selection(evidence, features, selected, source=source, beta=beta, unlabeled=unlabeled)

    def pictures(self, votes: Iterable[ViewVote]) -> Iterator[VoteImage]:
        """Yield the image of each vote, with outlines of the regions that voted.

        Raises:
            FileNotFoundError: An image no longer exists.
            ValueError: An image has changed, or its regions are no longer in the cache. The regions of features passed
                from Python are never in the cache.
        """
        for vote in votes:
            block, images = self._observe([vote.view])
            self._check_regions(vote.view, block)
            labels, regions = block.labels[0], block.regions[0]
            cells = [(regions == region.region).any(dim=0) for region in vote.regions]  # at all levels
            masks = [(labels >= 0) & inside[labels.clamp(min=0).long()] for inside in cells]
            yield VoteImage(self.names[vote.view], vote, draw_outlines(images[0], torch.stack(masks)))

    @cached_property
    def table(self) -> tuple[Evidence, Float[Tensor, "s d"]]:
        """Evidence of all images, and the feature of every region.

        Raises:
            ValueError: The votes are no longer in the cache.
        """
        store = self.field.store
        if isinstance(store, StoredEvidence):
            return store.evidence, store.features
        if not any((self.cache / "evidence").glob("*")):  # do not compute regions first, which takes minutes
            raise self._no_evidence()
        blocks = (self._observe(chunk)[0] for chunk in evidence_collection.chunk_views(range(len(self.names))))
        parts = (evidence_collection.ViewObservations.of_block(block, self._cached_evidence(block)) for block in blocks)
        evidence, features, level = evidence_collection.ViewObservations.merge(parts)
        if self._option("consensus", bool, False):
            power, sample = self._option("consensus_power", float, 1.0), self._option("consensus_sample", int, 50)
            least = self._option("consensus_min_agreement", float, CHANCE_AGREEMENT)
            features = consensus(evidence, features, level=level, power=power, sample=sample, least=least).features
        return evidence, features

    @property
    def disagreement(self) -> float:
        """Typical disagreement of the views about a Gaussian, 1 minus the median norm of the mean features.

        It is the mean of the values before and after the consensus, or the value after the consensus if the value
        before it is unknown. If no Gaussian has evidence, it is 1.
        """
        scalars = self.field.scalars
        if not bool((scalars.norm > 0).any()):
            return 1.0
        norms = [scalars.norm.double()]
        if self._option("reliability", str, "paper") == "paper":
            beta = self._option("reliability_beta", float, 1.0)
            norms.append(norm_of_reliability(scalars.reliability, scalars.n_eff, beta))
        return 1 - sum(float(norm[norm > 0].median()) for norm in norms) / len(norms)

    def _cached_evidence(self, block: evidence_collection.ViewBatch) -> Evidence:
        config = evidence_collection.RasterConfig(
            gsplat_version=str(self.field.manifest.get("gsplat_rules", GSPLAT_VERSIONS[0])),
            backend=self.field.manifest.get("backend", "auto"),
            dtype=torch.float64 if self._option("precision", str, "standard") == "double" else torch.float32,
            rasterize_mode=self.scene.rasterize_mode,
            weight_power=self._option("weight_power", int, 1),
            clip_planes=self.field.manifest.get("clip_planes"),
        )
        evidence = evidence_collection.cached_batch_evidence(
            self.scene.gaussians, block, self.cache / "evidence", config
        )
        if evidence is None:
            raise self._no_evidence()
        return evidence

    def _no_evidence(self) -> InputError:
        return InputError(
            f"{self.cache / 'evidence'} does not have the evidence of the lift, and the run has only directions. Copy "
            "this folder from where the scene was lifted, or lift again with the same options: ns-normlift. With "
            f"{option_setting('storage', 'evidence')}, a lift stores the evidence in the run."
        )

    def _observe(self, views: Sequence[int]) -> tuple[evidence_collection.ViewBatch, list[Tensor]]:
        """Return labels, regions and features of some lifted images, and the images at the resolution of the lift."""
        index_of = {name: index for index, name in enumerate(self.scene.train.names)}
        indices, images = [index_of[self.names[view]] for view in views], []

        rendered = self._option("image_source", str, "photos") == "render"
        settings = RasterSettings.recorded(self.field.manifest) if rendered else None
        kwargs: dict[str, Any] = {"render_settings": settings, "downscale": self._option("lift_downscale", int, 1)}
        kwargs |= {"on_view": lambda view: images.append(view.image)}
        return evidence_collection.observe_views(self.scene, indices, self._source, **kwargs), images

    @cached_property
    def _source(self) -> FeatureSource:
        """Feature source of the lift. SAM and all encoders except color only read the cache; they load no network."""

        def is_quick(part: Any) -> bool:
            return isinstance(part, ColorEncoder) or not (hasattr(part, "text") or hasattr(part, "checkpoint"))

        return cached(restore_source(self.field.manifest), self.cache, compute=is_quick)

    def _check_regions(self, view: int, block: evidence_collection.ViewBatch) -> None:
        """Raise InputError if the regions of an image have changed since the lift."""
        if not isinstance(self.field.store, StoredEvidence):
            return  # the key of cached evidence includes the content of the regions
        expected = self.field.store.features[self.field.store.evidence.columns_of([view])]
        actual = block.features[0]
        changed = expected.shape != actual.shape
        if not changed and not self._option("consensus", bool, False) and actual.numel() > 0:
            changed = float((expected - actual).abs().max()) > _FEATURE_TOLERANCE
        if changed:
            raise InputError(
                f"{self.names[view]} no longer has the regions of the lift, because the image, its label map or the "
                "features have changed. Restore them, or lift again with: ns-normlift"
            )

    def _option(self, name: str, kind: type, default: Any) -> Any:
        """Return an option of the lift, or the default if the manifest does not record it.

        Raises:
            InputError: If the recorded value has the wrong type.
        """
        options = self.field.manifest.get("options")
        value = options.get(name, default) if isinstance(options, Mapping) else default
        if not isinstance(value, (int, float) if kind is float else kind):
            raise InputError(
                f"the run's manifest is damaged: its option {name} is {value!r:.40}, expected a value of type "
                f"{kind.__name__}. Lift the scene again."
            )
        return value
