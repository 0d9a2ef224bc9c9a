"""Coverage study, which finds regions without reliable evidence, helpful unused images, and new poses."""

from __future__ import annotations

import json
import math
import warnings
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, fields, replace
from functools import cache
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple

import msgspec
import torch
from jaxtyping import Bool, Float, Float64, Int, Int64, UInt8
from torch import Tensor
from torch.nn.functional import normalize

from normlift_ns.analysis.objects import connected_components
from normlift_ns.core.arguments import check_arguments
from normlift_ns.core.device import choose_device
from normlift_ns.core.field import SemanticField
from normlift_ns.core.gaussians import Camera, GaussianScene, facing_pose
from normlift_ns.core.lift import Scalars
from normlift_ns.core.neighbors import nearest_neighbors
from normlift_ns.core.refine import unsupported
from normlift_ns.core.reliability import reliability
from normlift_ns.core.scene import Scene
from normlift_ns.core.sparse import SparseRows
from normlift_ns.errors import InputError
from normlift_ns.evaluation.options import MAX_SUGGESTED_POSES, pose_output_paths
from normlift_ns.evaluation.studies import make_figure, recorded_vote, voting_scalars
from normlift_ns.evidence_collection import sample_evenly
from normlift_ns.io.atomic import atomic_files
from normlift_ns.io.guard import refuse_inputs
from normlift_ns.lifted_run import LiftedRun
from normlift_ns.options import RasterizeMode, check_number, check_path, option_name
from normlift_ns.rasterization.rasterize import RasterOptions, rasterize_evidence, render, render_image
from normlift_ns.rasterization.settings import RasterSettings

LeftOutReason = Literal["max_views", "no features", "held out"]
MAX_IMAGES = 256
"""Maximum number of lifted images that the study examines, and maximum number of other images."""


class _Counts(msgspec.Struct):
    views: int | None = None
    left_out: int | None = None


class _Options(msgspec.Struct):
    max_views: Annotated[int, msgspec.Meta(ge=1)] | None = None


class _LiftRecord(msgspec.Struct):
    """Record of the lifted images in a manifest."""

    views_lifted: list[str] | None = None
    views_without_features: list[str] = []
    statistics: _Counts = msgspec.field(default_factory=_Counts)
    options: _Options = msgspec.field(default_factory=_Options)


class StudyImages(NamedTuple):
    """Images to examine, with the lifted images first."""

    lifted: int
    names: list[str]
    cameras: list[Camera]
    reasons: list[LeftOutReason]
    """Reason why the image was not lifted, for each image after the lifted ones."""
    left_out: dict[LeftOutReason, int]


def lifted_names(scene: Scene, manifest: Mapping[str, Any]) -> tuple[set[str], set[str]]:
    """Return the names of the lifted images, and of the images without features.

    Raises:
        ValueError: If the record in the manifest is missing or damaged, or the scene no longer has some of the lifted
            images.
    """
    names = list(scene.train.names)
    try:
        record = msgspec.convert(dict(manifest), _LiftRecord)
    except msgspec.ValidationError as error:
        raise InputError(f"the run's record of lifted images is damaged ({error}); lift the scene again") from None
    used, counts = record.views_lifted, record.statistics
    if used is None and counts.left_out == 0:  # version 0.1 has only counts
        indices = sample_evenly(len(names), record.options.max_views)
        used = [names[i] for i in indices] if len(indices) == counts.views else None
    if used is None:
        raise InputError("the run does not record which images were lifted; lift the scene again with ns-normlift")
    if not set(used) <= set(names):
        raise InputError(
            f"the run was lifted from images that {scene.name} no longer has; restore the dataset, set "
            f"{option_name('data')} to its path, or lift the scene again"
        )
    return set(used), set(record.views_without_features)


def study_images(scene: Scene, manifest: Mapping[str, Any]) -> StudyImages:
    """Return at most `MAX_IMAGES` lifted and `MAX_IMAGES` other images of a scene, evenly spaced.

    Raises:
        ValueError: For the same reasons as `lifted_names`.
    """
    used, unusable = lifted_names(scene, manifest)
    train, held_out = (list(zip(views.names, views.cameras)) for views in (scene.train, scene.held_out))
    lifted = [view for view in train if view[0] in used]
    unused = [view for view in train if view[0] not in used]
    reasons: list[LeftOutReason] = ["no features" if name in unusable else "max_views" for name, _ in unused]
    reasons.extend("held out" for _ in held_out)
    chosen, left = (sample_evenly(count, MAX_IMAGES) for count in (len(lifted), len(reasons)))
    images = [*(lifted[i] for i in chosen), *([*unused, *held_out][i] for i in left)]
    names, cameras = [name for name, _ in images], [camera for _, camera in images]
    return StudyImages(len(chosen), names, cameras, [reasons[i] for i in left], dict(Counter(reasons)))


# Regions without reliable evidence, which are connected parts of the surfaces in the images.


_HIDDEN_SHARE = 0.01
"""Maximum share of the total surface (see `GaussianEvidence`) in the smallest Gaussians, which are ignored."""
_MIN_SHARE = 0.001
"""Minimum share of the total surface (see `GaussianEvidence.surface`) in a listed region."""
_MAX_REGIONS = 20
"""Maximum number of listed regions."""


@dataclass(frozen=True)
class WeakRegion:
    """Connected visible Gaussians with little reliable evidence.

    Means are weighted by s_j, the largest weight of Gaussian j in any image.
    """

    size: int
    """Number of Gaussians in the region."""
    centre: list[float]
    """Mean of the Gaussian centers as x, y and z, in scene units."""
    box: dict[str, list[float]]
    """Corners "min" and "max" of the bounding box of the Gaussian centers, in scene units."""
    share: float
    """Sum of s_j in the region as a share of the sum over all Gaussians, in 0..1."""
    reliability: float
    """Mean of R_j(S), the expected reliability with the lifted views, in 0..1.

    A view that hardly shows Gaussian j has little influence on R_j(S).
    """
    lifted_reliability: float
    """Mean of the reliability R of the lift, in 0..1. R includes views that hardly show a Gaussian."""
    norm: float
    """Mean ||f|| of the Gaussians with evidence, in 0..1, or 0 if none has evidence. A low value means that the views
    disagree, so more views of the same kind may not help."""
    views: float
    """Mean number of lifted views in which a Gaussian has at least a tenth of s_j."""
    unsupported: float
    """Share of the region, weighted by s_j, that voting cannot repair because neither the Gaussians nor their neighbors
    have R > 0."""


class GaussianEvidence(NamedTuple):
    """Evidence of every Gaussian."""

    means: Float[Tensor, "n 3"]
    scalars: Scalars
    surface: Float64[Tensor, " n"]
    """Surface s_j, the largest weight of the Gaussian in any image, as a share of the image."""
    reliability: Float64[Tensor, " n"]
    """R_j(S), the expected reliability with the lifted views."""
    views: Int[Tensor, " n"]
    """Number of lifted views in which the Gaussian has at least a tenth of s_j."""
    unsupported: Bool[Tensor, " n"]


def visible(surface: Float64[Tensor, " n"]) -> Bool[Tensor, " n"]:
    """Return a mask that omits the Gaussians with the smallest surface, up to `_HIDDEN_SHARE` of the total surface.

    >>> visible(torch.tensor([0.5, 0.001, 0.5, 0.0])).tolist()
    [True, False, True, False]
    """
    order = surface.argsort()
    mask = torch.zeros_like(surface, dtype=torch.bool)
    mask[order] = surface[order].cumsum(0) > _HIDDEN_SHARE * surface.sum()
    return mask


def weak_regions(
    evidence: GaussianEvidence, min_reliability: float
) -> tuple[list[WeakRegion], list[Int64[Tensor, " m"]]]:
    """Return regions of visible Gaussians with R_j(S) below `min_reliability`, and the Gaussians of each region.

    Regions are sorted by sum_j s_j (min_reliability - R_j(S)), descending. Regions with less than `_MIN_SHARE` of the
    total surface are left out, and so are all regions after the first `_MAX_REGIONS`.
    """
    surface = evidence.surface
    weak = visible(surface) & (evidence.reliability < min_reliability)
    labels = connected_components(evidence.means, weak)
    chosen = (labels >= 0).nonzero().squeeze(1)
    number, lacking = labels[chosen].long(), surface * (min_reliability - evidence.reliability)
    share, lack = (torch.bincount(number, x[chosen]) for x in (surface / surface.sum(), lacking))
    listed = (share >= _MIN_SHARE).nonzero().squeeze(1)
    listed = listed[lack[listed].argsort(descending=True, stable=True)][:_MAX_REGIONS]
    parts = [chosen[number == i] for i in listed.tolist()]
    return [_region(evidence, rows) for rows in parts], parts


def _region(evidence: GaussianEvidence, rows: Int64[Tensor, " m"]) -> WeakRegion:
    surface, means, norm = evidence.surface[rows], evidence.means[rows].double(), evidence.scalars.norm[rows]
    weight = surface / surface.sum()

    def mean(values: Tensor, weight: Tensor = weight) -> float:
        return float((weight * values.double()).sum())

    evidenced = weight * (norm > 0)
    return WeakRegion(
        size=len(rows),
        centre=(weight[:, None] * means).sum(0).tolist(),
        box={"min": means.amin(0).tolist(), "max": means.amax(0).tolist()},
        share=float(surface.sum() / evidence.surface.sum()),
        reliability=mean(evidence.reliability[rows]),
        lifted_reliability=mean(evidence.scalars.reliability[rows]),
        norm=mean(norm, evidenced / evidenced.sum()) if bool((evidenced > 0).any()) else 0.0,
        views=mean(evidence.views[rows]),
        unsupported=mean(evidence.unsupported[rows]),
    )


# Benefit of one more view for a lift, computed from rendering weights without images or features.
#
# W_jv is the weight of Gaussian j in view v, as a share of the image, and S is the set of lifted views. Equation
# numbers are those of the paper.
#
#     s_j     = max_v W_jv over all images                                        surface of a Gaussian
#     N_j(S)  = (sum_v W_jv) ** 2 / (sum_v W_jv ** 2 + (FAINT s_j) ** 2)          effective views of eq. 8
#     R_j(S)  = ||f_j|| N_j(S) / (N_j(S) + beta)                                  eq. 8
#     gain(v) = sum_j s_j max(0, R_j(S + v) - R_j(S)) / sum_j s_j
#
# The term with FAINT reduces N_j(S) for views that hardly show a Gaussian. Without evidence, ||f_j|| is the mean of the
# other Gaussians, weighted by surface. The gain is the expected increase of the mean reliability of all surfaces. This
# assumes that a new view agrees with the lifted views as well as these agree with each other. Views are chosen
# greedily, by their gain in addition to the views chosen before. The second of two similar views therefore has a small
# gain.


PIXELS = 20_000
"""Approximate number of pixels per image for rasterizing weights; smaller images keep their size."""
FAINT = 0.1
"""Minimum weight of a Gaussian in a view that shows it, as a share of its largest weight in any view."""

_CHUNK = 2**24
"""Number of entries to process at a time."""


class RasterInputs(NamedTuple):
    """Gaussians and settings for rasterizing weights as in the lift."""

    gaussians: GaussianScene
    rasterize_mode: RasterizeMode
    settings: RasterSettings
    weight_power: int


@dataclass(frozen=True)
class ReliabilityModel:
    """Evidence of every Gaussian from the lifted views, in float64, for computing its reliability with more views."""

    norm: Float64[Tensor, " n"]
    """||f_j||, or its expected value for Gaussians without evidence."""
    weight: Float64[Tensor, " n"]
    """sum_v W_jv over the lifted views."""
    squared: Float64[Tensor, " n"]
    """sum_v W_jv ** 2 over the lifted views."""
    surface: Float64[Tensor, " n"]
    """s_j, the largest weight of the Gaussian in any image, as a share of the image."""
    beta: float

    def reliability(
        self, weight: Float64[Tensor, " m"], squared: Float64[Tensor, " m"], rows: Tensor | slice = slice(None)
    ) -> Float64[Tensor, " m"]:
        """Return R_j of the Gaussians `rows` (default: all) for the given sums of weights and of squared weights."""
        n_eff = _ratio(weight**2, squared + (FAINT * self.surface[rows]) ** 2)
        return self.norm[rows] * reliability(1.0, n_eff, self.beta)

    def with_view(self, views: SparseRows, view: int) -> ReliabilityModel:
        """Return the model with the evidence of one more view."""
        entries = views.column == view
        rows, weight = views.row_index()[entries], views.weight[entries].double()
        return replace(
            self,
            weight=self.weight.index_add(0, rows, weight),
            squared=self.squared.index_add(0, rows, weight**2),
        )


def _with_pixels(camera: Camera, pixels: int) -> Camera:
    """Return the camera with its image downscaled to about `pixels` pixels."""
    return camera.downscaled((pixels / (camera.width * camera.height)) ** 0.5)


def view_weights(drawn: RasterInputs, cameras: Sequence[Camera], *, pixels: int = PIXELS) -> SparseRows:
    """Return W_jv, [N, views], the weight of Gaussian j in view v as a share of the image."""
    small = [_with_pixels(camera, pixels) for camera in cameras]
    with warnings.catch_warnings():  # the lift has already warned about Gaussians that are not drawn
        warnings.filterwarnings("ignore", message=".*are not drawn")
        labels = (torch.zeros(camera.height, camera.width, dtype=torch.int32) for camera in small)
        mode, power = drawn.rasterize_mode, drawn.weight_power
        options = RasterOptions(rasterize_mode=mode, weight_power=power, settings=drawn.settings)
        rows = rasterize_evidence(drawn.gaussians, small, labels, num_regions=[1] * len(small), **options).rows
    area = torch.tensor([float(c.width * c.height) for c in small], dtype=torch.float64, device=rows.weight.device)
    return SparseRows(rows.offsets, rows.column, rows.weight.double() / area[rows.column.long()])


def max_weights(weights: SparseRows) -> Float64[Tensor, " n"]:
    """Return s_j, the largest weight of each Gaussian in any view; 0 for Gaussians that are not visible."""
    maxima = weights.weight.new_zeros(len(weights))
    return maxima.scatter_reduce_(0, weights.row_index(), weights.weight, "amax").double()


def count_views(weights: SparseRows, surface: Float64[Tensor, " n"]) -> Int64[Tensor, " n"]:
    """Count the views in which each Gaussian has at least `FAINT` times its largest weight."""
    row = weights.row_index()
    return torch.bincount(row[weights.weight >= FAINT * surface[row]], minlength=len(weights))


def model_of_lift(
    scalars: Scalars, lifted: SparseRows, surface: Float64[Tensor, " n"], *, beta: float
) -> ReliabilityModel:
    """Return the reliability model of a lift.

    N_eff, ||f_j|| and W_j are those of the lift. W_j is rescaled to shares of an image, because the lift may have used
    a different resolution and several levels of regions.

    Args:
        lifted: Weights of the lifted views, [N, views].
    """
    sums, norm = lifted.row_sums(), scalars.norm.double()
    valid = (norm > 0) & (sums > 0) & (scalars.n_eff > 0)
    scale = (sums[valid] / scalars.weight[valid].double()).median() if bool(valid.any()) else sums.new_ones(())
    weight = torch.where(valid, scale * scalars.weight.double(), 0.0)
    mean = _ratio((surface * norm)[valid].sum(), surface[valid].sum()) if bool(valid.any()) else sums.new_ones(())
    squared = _ratio(weight**2, scalars.n_eff.double())
    return ReliabilityModel(torch.where(valid, norm, mean), weight, squared, surface, beta)


def gains(model: ReliabilityModel, views: SparseRows, count: int) -> Float64[Tensor, " views"]:
    """Return gain(v) of every view v, the increase of the mean reliability if v is added to the lift."""
    before = model.reliability(model.weight, model.squared)
    rise = torch.zeros(count, dtype=torch.float64, device=before.device)
    parts = (x.split(_CHUNK) for x in (views.row_index(), views.column, views.weight))
    for row, column, weight in zip(*parts):
        added = weight.double()
        after = model.reliability(model.weight[row] + added, model.squared[row] + added**2, row)
        rise.index_add_(0, column.long(), model.surface[row] * (after - before[row]).clamp(min=0))
    return _ratio(rise, model.surface.sum())


def choose_views(
    model: ReliabilityModel, views: SparseRows, count: int, max_views: int, accept: Callable[[int], bool] | None = None
) -> list[tuple[int, float]]:
    """Choose views greedily by their gain over the views chosen before, and return (view, gain) pairs.

    Views without gain are not chosen.

    Args:
        views: W_jv of the candidates, [N, count].
        accept: Function that returns True if a view may be chosen (default: all views).
    """
    chosen: list[tuple[int, float]] = []
    for _ in range(min(max_views, count)):
        gain = gains(model, views, count).cpu()
        gain[[view for view, _ in chosen]] = 0.0
        order = gain.argsort(descending=True, stable=True)[: int((gain > 0).sum())].tolist()
        best = next((view for view in order if accept is None or accept(view)), None)
        if best is None:
            break
        chosen.append((best, float(gain[best])))
        model = model.with_view(views, best)
    return chosen


def visible_shares(views: SparseRows, count: int, surface: Tensor, parts: Sequence[Tensor]) -> Float64[Tensor, "p v"]:
    """Return the share of each part that each view shows, [parts, views], as sum_j min(W_jv, s_j) / sum_j s_j.

    The share is 1 if every Gaussian of the part has its largest weight in the view.
    """
    shares = torch.zeros(len(parts), count, dtype=torch.float64)
    for i, rows in enumerate(parts):
        part = views.select_rows(rows)
        shown = torch.minimum(part.weight.double(), surface[rows][part.row_index()])
        sums = torch.zeros(count, dtype=torch.float64, device=shown.device).index_add_(0, part.column.long(), shown)
        shares[i] = (sums / surface[rows].sum()).cpu()
    return shares


def _ratio(numerator: Float[Tensor, "*n"], denominator: Float[Tensor, "*n"]) -> Float[Tensor, "*n"]:
    """Divide two tensors, with 0 for a denominator of 0."""
    return torch.where(denominator > 0, numerator / denominator, 0.0)


# New poses that show regions without evidence from free positions.
#
# A position is free if a camera is near it, or if a ray of an image passes through it to a surface behind it.
# Candidates face a region from positions of the images, and from two rings around the region at the height of the
# cameras. Poses are chosen greedily by their gain in the regions.


_TARGET_REGIONS = 4
"""Maximum number of regions for which candidate poses are computed, in the order of `weak_regions`."""
_CAMERA_POSITIONS, _RING_POSITIONS = 12, 12
"""Number of camera positions, and of azimuths on each ring, for candidates of one region."""
_MAX_CANDIDATES = 10
"""Maximum number of candidates per region whose weights are rasterized."""
MIN_SHOWN_SHARE = 0.3
"""Minimum value of `visible_shares` for which a view counts as showing a region."""
_MIN_DEPTH = 0.15
"""Minimum depth in front of a new camera, as a share of the median depth of the images."""
_NEAR_SHARE = 0.05
"""Share of the pixels of a new camera that may have a depth below `_MIN_DEPTH`.

It is also the margin of the depth test for free positions.
"""
_DEPTH_PIXELS = 5_000
_DEPTH_VIEWS = 16


@dataclass(frozen=True)
class Pose:
    """A new camera in the coordinates of the scene."""

    camera: Camera
    gain: float
    """Expected increase of `Coverage.reliability` if an image from this pose is added to the lift, after images from
    the previous poses. Only Gaussians in weak regions contribute."""
    regions: list[int]
    """Numbers of the weak regions that the pose shows; region 1 is the first in `Coverage.regions`."""
    shown: float
    """Largest value of `visible_shares` over the weak regions, in 0..1."""

    @property
    def field_of_view(self) -> float:
        """Vertical field of view in degrees."""
        return math.degrees(2 * math.atan(self.camera.height / 2 / float(self.camera.K[1, 1])))

    def to_json(self) -> dict[str, Any]:
        """Return the pose as JSON types."""
        pose = self.camera.camera_to_world()
        numbers = {name: getattr(self, name) for name in ("field_of_view", "gain", "regions", "shown")}
        return {"position": pose[:3, 3].tolist(), "camera_to_world": pose.tolist(), **numbers}


@dataclass(frozen=True)
class FreeSpace:
    """Space in which a camera can be placed, derived from the cameras and depths of the images."""

    camera_positions: Float64[Tensor, "v 3"]
    up: Float64[Tensor, " 3"]
    cameras: Sequence[Camera]
    depths: Sequence[Float64[Tensor, "h w"]]
    """Depth of every pixel of each camera in `cameras`; infinite for empty pixels."""

    @property
    def depth(self) -> float:
        """Median depth of all pixels that are not empty, in scene units; 1 if all are empty."""
        finite = torch.cat([depth[depth.isfinite()] for depth in self.depths])
        return float(finite.median()) if len(finite) > 0 else 1.0

    @property
    def spacing(self) -> float:
        """Median distance between a camera and its nearest neighbor, or 0 for a single camera."""
        if len(self.camera_positions) < 2:
            return 0.0
        distance = torch.cdist(self.camera_positions, self.camera_positions).fill_diagonal_(torch.inf)
        return float(distance.amin(1).median())

    def is_free(self, positions: Float64[Tensor, "p 3"]) -> Bool[Tensor, " p"]:
        """Return a mask of the positions at which a camera could be placed."""
        free = (torch.cdist(positions, self.camera_positions) <= self.spacing + 1e-9).any(1)
        for camera, depth in zip(self.cameras, self.depths):
            row, column, z, inside = camera.project(positions)
            free |= inside & (depth[row, column] > (1 + _NEAR_SHARE) * z)
        return free


def free_space(drawn: RasterInputs, cameras: Sequence[Camera]) -> FreeSpace:
    """Compute the free space from the positions of all cameras and the rendered depths of some of them."""
    chosen = [_with_pixels(cameras[i], _DEPTH_PIXELS) for i in sample_evenly(len(cameras), _DEPTH_VIEWS)]
    to_world = torch.stack([camera.world_to_camera.double().cpu().inverse() for camera in cameras])
    up = normalize(-to_world[:, :3, 1].mean(0), dim=0)
    if not bool(up.norm() > 0):  # the roll of the cameras varies
        up = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)
    return FreeSpace(to_world[:, :3, 3], up, chosen, [mean_depth(drawn, camera) for camera in chosen])


def mean_depth(drawn: RasterInputs, camera: Camera) -> Float64[Tensor, "h w"]:
    """Return the mean depth at each pixel of a camera, or infinity if alpha is at most 0.5."""
    pose = camera.world_to_camera.to(drawn.gaussians.means)
    z = (drawn.gaussians.means @ pose[2, :3] + pose[2, 3])[:, None]
    return _mean_of_pixels(drawn, camera, torch.nan_to_num(z, 0.0, 0.0, 0.0), torch.inf).double().cpu()


def _mean_of_pixels(
    drawn: RasterInputs, camera: Camera, values: Float[Tensor, "n 1"], empty: float
) -> Float[Tensor, "h w"]:
    image, alpha = render(drawn.gaussians, camera, values, rasterize_mode=drawn.rasterize_mode, settings=drawn.settings)
    return torch.where(alpha > 0.5, image[:, :, 0] / alpha, empty)


def positions_around(space: FreeSpace, target: Float64[Tensor, " 3"]) -> Float64[Tensor, "p 3"]:
    """Return free positions for new cameras that face a target.

    The candidates are the positions of the capture's cameras, and positions on two rings around the target, at the
    median height of those cameras.
    """
    away = space.camera_positions - target
    height = away @ space.up
    radius = (away - height[:, None] * space.up).norm(dim=1).median()
    axis = torch.eye(3, dtype=torch.float64)[space.up.abs().argmin()]
    first = normalize(torch.linalg.cross(space.up, axis), dim=0)
    second = torch.linalg.cross(space.up, first)
    angle = torch.arange(_RING_POSITIONS, dtype=torch.float64) * (2 * math.pi / _RING_POSITIONS)
    circle = angle.cos()[:, None] * first + angle.sin()[:, None] * second
    rings = [target + height.median() * space.up + factor * radius * circle for factor in (1.0, 0.5)]
    near = space.camera_positions[sample_evenly(len(space.camera_positions), _CAMERA_POSITIONS)]
    positions = torch.cat([near, *rings])
    far = (positions - target).norm(dim=1) > _MIN_DEPTH * space.depth
    return positions[space.is_free(positions) & far]


def look_at(
    eye: Float64[Tensor, " 3"], target: Float64[Tensor, " 3"], up: Float64[Tensor, " 3"], like: Camera
) -> Camera:
    """Return a camera that faces a target, with a centered principal point as in ns-render.

    The focal length is the vertical one of `like`. The width and height are those of `like`, rounded down to even
    numbers of pixels.
    """
    width, height = (max(2, side - side % 2) for side in (like.width, like.height))  # videos need even sizes
    focal = float(like.K[1, 1])
    K = torch.tensor([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]])
    return Camera(K, facing_pose(eye, target, up).float(), width, height)


def suggest_poses(
    drawn: RasterInputs,
    cameras: Sequence[Camera],
    model: ReliabilityModel,
    targets: Sequence[Sequence[float]],
    parts: Sequence[Tensor],
) -> list[Pose]:
    """Suggest poses that show the given regions, chosen greedily by their gain in these regions.

    Args:
        targets: Centers of the regions.
        parts: Indices of the Gaussians in each region.
    """
    if len(parts) == 0:
        return []
    space = free_space(drawn, cameras)
    candidates: list[Camera] = []
    for target in targets[:_TARGET_REGIONS]:
        center = torch.tensor(target, dtype=torch.float64)
        positions = positions_around(space, center)
        eyes = positions[sample_evenly(len(positions), _MAX_CANDIDATES)]
        candidates += [look_at(eye, center, space.up, cameras[0]) for eye in eyes]
    if len(candidates) == 0:
        return []
    weights = view_weights(drawn, candidates)
    shown = visible_shares(weights, len(candidates), model.surface, parts)
    inside = torch.zeros_like(model.surface)
    inside[torch.cat(list(parts))] = 1
    share = float((inside * model.surface).sum() / model.surface.sum())
    lacking = replace(model, surface=inside * model.surface)

    @cache
    def accept(view: int) -> bool:
        """Return True if a view shows a region and the depth of most of its pixels is large enough."""
        if float(shown[:, view].max()) < MIN_SHOWN_SHARE:
            return False
        depth = mean_depth(drawn, _with_pixels(candidates[view], _DEPTH_PIXELS)).flatten()
        return float(depth.sort().values[int(_NEAR_SHARE * len(depth))]) >= _MIN_DEPTH * space.depth

    chosen = choose_views(lacking, weights, len(candidates), MAX_SUGGESTED_POSES, accept)
    return [Pose(candidates[v], share * gain, _regions_shown(shown, v), float(shown[:, v].max())) for v, gain in chosen]


def _regions_shown(shown: Float64[Tensor, "p v"], view: int) -> list[int]:
    """Return the 1-based numbers of the regions that a view shows."""
    return [i for i, share in enumerate(shown[:, view].tolist(), 1) if share >= MIN_SHOWN_SHARE]


# Output files of the coverage study, which are renders of the new poses and a camera path for ns-render.


_MAX_RENDER_PIXELS = 300_000
"""Approximate maximum number of pixels of a render."""
_INCHES = 6.0


class PoseRender(NamedTuple):
    """Renders of the scene and of its reliability from a pose."""

    image: UInt8[Tensor, "h w 3"]
    reliability: Float[Tensor, "h w"]
    """Mean R_j(S) at every pixel, in 0..1, or NaN for empty pixels."""


def render_pose(drawn: RasterInputs, scene: Scene, reliability: Float64[Tensor, " n"], pose: Pose) -> PoseRender:
    """Render the trained scene and its mean reliability at every pixel from a new pose."""
    camera = _with_pixels(pose.camera, _MAX_RENDER_PIXELS)
    image = render_image(scene, camera, settings=drawn.settings, gaussians=drawn.gaussians)
    values = reliability[:, None].to(drawn.gaussians.means)
    return PoseRender(image, _mean_of_pixels(drawn, camera, values, torch.nan).cpu())


def camera_path(poses: Sequence[Pose]) -> dict[str, Any]:
    """Return a camera path for `ns-render camera-path`, with one second per pose.

    The path is valid only for the run for which the poses were computed, because it uses the coordinates of this run.
    """
    width, height = (poses[0].camera.width, poses[0].camera.height)
    cameras = [
        {
            "camera_to_world": pose.camera.camera_to_world().flatten().tolist(),
            "fov": pose.field_of_view,
            "aspect": width / height,
        }
        for pose in poses
    ]
    size = {"render_width": width, "render_height": height}
    return {"camera_type": "perspective", **size, "camera_path": cameras, "fps": 1, "seconds": len(poses)}


def write_poses(
    stem: Path,
    poses: Sequence[Pose],
    pictures: Sequence[PoseRender],
    *,
    documents: Mapping[Path, Mapping[str, Any]] | None = None,
    overwrite: bool = False,
) -> list[Path]:
    """Write the documents and, if there are poses, <stem>_camera_path.json and <stem>_pose_1.png …; return the paths.

    On an error, none of the files is written.

    Args:
        documents: Content of additional JSON files, by path.
        overwrite: Replace existing files, and remove those of an earlier study.
    Raises:
        FileExistsError: If a file exists and `overwrite` is False.
        OSError: If the files cannot be written.
    """
    path, *images = pose_output_paths(stem)
    json_files = dict(documents or {})
    if len(poses) > 0:
        json_files[path] = camera_path(poses)
    written = [*json_files, *images[: len(poses)]]
    if len(written) == 0:
        return []
    old = [file for file in (path, *images) if overwrite and file not in written]
    with atomic_files(*written, overwrite=overwrite, delete=old) as drafts:
        for draft, content in zip(drafts, json_files.values()):
            draft.write_text(json.dumps(content, indent=1, allow_nan=False) + "\n", "utf8")
        for i, (draft, pose, picture) in enumerate(zip(drafts[len(json_files) :], poses, pictures), 1):
            save_pose_render(draft, f"pose {i} (regions shown: {', '.join(map(str, pose.regions))})", picture)
    return written


def save_pose_render(path: Path, title: str, picture: PoseRender) -> None:
    """Save a figure of the scene and its reliability, with a color scale."""
    height, width = picture.reliability.shape
    figure, (left, right) = make_figure((2 * _INCHES, _INCHES * height / width + 0.6), 1, 2)
    left.imshow(picture.image.numpy())
    left.set_title(title, parse_math=False)
    right.set_facecolor("black")
    right.imshow(picture.image.float().mean(dim=2).numpy(), cmap="gray", vmin=0, vmax=255)
    heat = right.imshow(picture.reliability.numpy(), cmap="inferno", vmin=0, vmax=1, alpha=0.75)
    scale = figure.colorbar(heat, ax=right, fraction=0.05)
    scale.solids.set_alpha(1.0)  # pyrefly: ignore[missing-attribute]
    scale.set_label("R")
    right.set_title("reliability")
    for axes in (left, right):
        axes.set(xticks=[], yticks=[])
    figure.savefig(path)


RELIABLE = 0.5
"""Minimum R of a reliable Gaussian. With beta = 1, a single consistent view gives this value."""
_MAX_IMAGES = 12
"""Maximum number of suggested images."""


@dataclass(frozen=True)
class SuggestedImage:
    """Image that was not lifted, with its expected benefit."""

    name: str
    why: LeftOutReason
    """Reason why the image was not lifted."""
    gain: float
    """Expected increase of `Coverage.reliability` if the image is added to the lift, after the previous images."""
    regions: list[int]
    """Numbers of the weak regions that the image shows; region 1 is the first in `Coverage.regions`."""


@check_arguments
@dataclass(frozen=True)
class Coverage:
    """Regions without reliable evidence in a lift, and images and poses that would add evidence.

    >>> from normlift_ns import coverage, open_run
    >>> result = coverage(open_run(config))
    >>> [image.why for image in result.photographs]
    ['held out', 'held out']
    >>> 0 < result.reliability < 1
    True
    """

    reliability: float
    """Mean of R_j(S), the expected reliability with the lifted views, in 0..1, weighted by s_j, the largest weight of
    Gaussian j in any image."""
    regions: list[WeakRegion]
    """Regions without reliable evidence, worst first."""
    photographs: list[SuggestedImage]
    """Images to add to the lift, most helpful first."""
    poses: list[Pose]
    """New poses for additional images, most helpful first."""
    pictures: list[PoseRender]
    """Renders of the poses."""
    left_out: dict[LeftOutReason, int]
    """Number of images that were not lifted, by reason."""
    remarks: list[str]
    """Notes for the user, in full sentences."""

    def to_json(self) -> dict[str, Any]:
        """Return the result without the renders, as JSON types."""
        plain = {f.name: getattr(self, f.name) for f in fields(self) if f.name != "pictures"}
        rows = {name: [asdict(row) for row in plain[name]] for name in ("regions", "photographs")}
        return {**plain, **rows, "poses": [pose.to_json() for pose in self.poses]}

    @check_arguments
    def save(self, path: str | Path, *, overwrite: bool = False) -> list[Path]:
        """Write a JSON file and, if there are poses, <stem>_camera_path.json and <stem>_pose_1.png …; return the paths.

        `ns-render camera-path` renders the camera path with the run.

        Args:
            overwrite: Replace existing files, and remove those of an earlier study.
        Raises:
            FileExistsError: If a file exists and `overwrite` is False.
            ValueError: If the path is not a file name, or a file of the run would be replaced.
            OSError: If the files cannot be written.

        >>> from normlift_ns import coverage, open_run
        >>> [path.name for path in coverage(open_run(config)).save(folder / "next.json")][:2]
        ['next.json', 'next_camera_path.json']
        """
        path = check_path("path", path)
        if path.name in ("", ".."):
            raise InputError(f"{path} is not a valid file name; give a name such as next.json")
        stem = path.with_suffix("")
        refuse_inputs((path, *pose_output_paths(stem)), instead="name")
        documents = {path: self.to_json()}
        return write_poses(stem, self.poses, self.pictures, documents=documents, overwrite=overwrite)


@check_arguments
def coverage(run: LiftedRun, *, min_reliability: float = RELIABLE, device: str | None = None) -> Coverage:
    """Find regions without reliable evidence, unused images that would help most, and new poses for these regions.

    The study does not read or lift images. It rasterizes the weights of the views at a low resolution. From these, it
    computes the reliability with one more view by the formula in `evaluation.coverage`.

    Args:
        min_reliability: Minimum R of a reliable Gaussian, in 0..1.
        device: Device for the rasterization (default: that of the run).
    Raises:
        ValueError: If `min_reliability` is not in 0..1 or no image shows a Gaussian, or as in `lifted_names`.

    >>> from normlift_ns import coverage, open_run
    >>> run = open_run(config)
    >>> result = coverage(run, min_reliability=0.6)
    >>> all(region.reliability < 0.6 for region in result.regions)
    True
    """
    device = choose_device(device or run.device)
    return coverage_of(run.scene, run.field, min_reliability=min_reliability, device=device)


def coverage_of(
    scene: Scene, field: SemanticField, *, min_reliability: float = RELIABLE, device: str = "cpu"
) -> Coverage:
    """Compute `coverage` of a scene and its semantic field. Raises the same errors."""
    check_number("min_reliability", min_reliability)
    images = study_images(scene, field.manifest)
    power, vote = field.manifest.get("options", {}).get("weight_power", 1), recorded_vote(field.manifest)
    gaussians, scalars = scene.gaussians.to(device), voting_scalars(field).to(device)
    drawn = RasterInputs(gaussians, scene.rasterize_mode, RasterSettings.recorded(field.manifest), power)
    weights, count = view_weights(drawn, images.cameras), len(images.cameras)
    surface = max_weights(weights)
    if not float(surface.sum()) > 0:
        raise InputError("no image shows a Gaussian; check that cameras and Gaussians belong to the same scene")
    split = images.lifted
    columns = torch.arange(count, device=device).tensor_split([split])
    lifted, unused = (weights.select_columns(part, count) for part in columns)
    model = model_of_lift(scalars, lifted, surface, beta=vote.beta)
    reliability = model.reliability(model.weight, model.squared)
    lost = unsupported(nearest_neighbors(gaussians.means, vote.config.k), scalars.reliability)
    evidenced = GaussianEvidence(gaussians.means, scalars, surface, reliability, count_views(lifted, surface), lost)
    regions, parts = weak_regions(evidenced, min_reliability)
    targets = [region.centre for region in regions]
    poses = suggest_poses(drawn, images.cameras, model, targets, parts)
    shown = visible_shares(unused, len(images.reasons), model.surface, parts)
    photographs = [
        SuggestedImage(images.names[split + view], images.reasons[view], gain, _regions_shown(shown, view))
        for view, gain in choose_views(model, unused, len(images.reasons), _MAX_IMAGES)
    ]
    return Coverage(
        reliability=float((surface * reliability).sum() / surface.sum()),
        regions=regions,
        photographs=photographs,
        poses=poses,
        pictures=[render_pose(drawn, scene, reliability, pose) for pose in poses],
        left_out=images.left_out,
        remarks=_remarks(images, regions, poses, min_reliability),
    )


def _remarks(
    images: StudyImages, regions: Sequence[WeakRegion], poses: Sequence[Pose], min_reliability: float
) -> list[str]:
    total, examined = sum(images.left_out.values()), len(images.reasons)
    hidden, single = len(regions) > 0 and len(poses) == 0, len(images.cameras) == 1
    remarks = {
        f"No part of the surfaces has R below {min_reliability:g}. Parts with less than a thousandth of the surface "
        "were ignored.": len(regions) == 0,
        "No new pose shows a region well. The regions may be hidden from all free positions.": hidden,
        "All images were lifted, so the study cannot suggest others.": examined == 0,
        f"{total:,} images were not lifted. Only {examined} of them, evenly spaced, were examined.": examined < total,
        "The scene has a single camera. The study does not cover surfaces that this camera does not show.": single,
    }
    return [text for text, applies in remarks.items() if applies]
