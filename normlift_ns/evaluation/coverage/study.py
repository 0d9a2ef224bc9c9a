"""Coverage study of a lifted run. Read this module first."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from normlift_ns.core.field import SemanticField
from normlift_ns.core.files import refuse_run_files
from normlift_ns.core.neighbors import nearest_neighbors
from normlift_ns.core.refine import unsupported
from normlift_ns.core.scene import Scene
from normlift_ns.core.sparse import SparseRows
from normlift_ns.errors import InputError
from normlift_ns.evaluation.coverage.files import Picture, draw_pose, write_poses
from normlift_ns.evaluation.coverage.gain import (
    Drawn,
    Known,
    choose_views,
    known_of_lift,
    largest,
    shown_shares,
    view_weights,
    views_that_see,
)
from normlift_ns.evaluation.coverage.photographs import Photographs, Why, photographs_of
from normlift_ns.evaluation.coverage.poses import SEES, Pose, suggest_poses
from normlift_ns.evaluation.coverage.regions import Evidenced, Region, weak_regions
from normlift_ns.evaluation.options import pose_files
from normlift_ns.evaluation.votes import own_vote, voting_scalars
from normlift_ns.lifted_run import LiftedRun
from normlift_ns.options import REACH
from normlift_ns.ranges import check_number, check_path
from normlift_ns.raster.settings import RasterSettings

RELIABLE = 0.5
"""R above which a Gaussian is reliable; at beta 1, a single consistent view gives this value."""
_MAX_IMAGES = 12
"""Maximum number of suggested images."""


@dataclass(frozen=True)
class Photograph:
    """An image that was left out of the lift."""

    name: str
    why: Why
    """Reason for leaving it out."""
    gain: float
    """Expected increase of the mean reliability of all surfaces, in addition to the lift and the images above it."""
    regions: list[int]
    """Numbers of the regions that it shows, from 1."""


@dataclass(frozen=True)
class Coverage:
    """Gaps in the evidence of a lift, and views that would fill them.

    >>> from normlift_ns import coverage, open_run
    >>> result = coverage(open_run(config))
    >>> [image.why for image in result.photographs]
    ['held out', 'held out']
    >>> 0 < result.reliability < 1
    True
    """

    reliability: float
    """Mean R_j(S) of `evaluation.coverage.gain` over all surfaces that the images show, in 0..1."""
    regions: list[Region]
    """Regions that lack evidence, worst first."""
    photographs: list[Photograph]
    """Images to add to the lift, in this order."""
    poses: list[Pose]
    """New poses for more images, in this order."""
    pictures: list[Picture]
    """Renders of the poses."""
    left_out: dict[Why, int]
    """Number of images that are not in the lift, by reason."""
    remarks: list[str]
    """Remarks in whole sentences."""

    def to_json(self) -> dict[str, Any]:
        """Return the result as JSON types, without the renders."""
        plain = {f.name: getattr(self, f.name) for f in fields(self) if f.name != "pictures"}
        rows = {name: [asdict(row) for row in plain[name]] for name in ("regions", "photographs")}
        return {**plain, **rows, "poses": [pose.to_json() for pose in self.poses]}

    def save(self, path: str | Path, *, overwrite: bool = False) -> list[Path]:
        """Write a JSON file, and next to it <stem>_pose_1.png … and <stem>_camera_path.json; return the paths.

        `ns-render camera-path` renders the camera path with the run.

        Args:
            overwrite: replace files of these names.
        Raises:
            FileExistsError: a file exists and `overwrite` is False.
            ValueError: a file of the run has that name.
            OSError: the files cannot be written.

        >>> from normlift_ns import coverage, open_run
        >>> [path.name for path in coverage(open_run(config)).save(folder / "next.json")][:2]
        ['next.json', 'next_camera_path.json']
        """
        path = check_path("path", path)
        if path.name in ("", ".."):
            raise InputError(f"{path} is not a valid file name; give one such as next.json")
        stem = path.with_suffix("")
        refuse_run_files(path, *pose_files(stem), instead="name")
        documents = {path: self.to_json()}
        return write_poses(stem, self.poses, self.pictures, documents=documents, overwrite=overwrite)


def coverage(run: LiftedRun, *, min_reliability: float = RELIABLE, device: str | None = None) -> Coverage:
    """Find regions that lack reliable evidence, unused images that would help most, and new poses for the worst
    regions.

    Nothing is lifted and no image is read. Weights of views are rasterized at a low resolution. They determine the
    reliability that one more view would give, by the formula in `evaluation.coverage.gain`.

    Args:
        min_reliability: R below which a Gaussian is not reliable, in 0..1.
        device: device for rasterizing, that of the run if None.
    Raises:
        ValueError: the run does not record which images were lifted, or the images show no Gaussian.

    >>> from normlift_ns import coverage, open_run
    >>> run = open_run(config)
    >>> result = coverage(run, min_reliability=0.6)
    >>> all(region.reliability < 0.6 for region in result.regions)
    True
    """
    return coverage_of(run.scene, run.field, min_reliability=min_reliability, device=device or run.device)


def coverage_of(
    scene: Scene, field: SemanticField, *, min_reliability: float = RELIABLE, device: str = "cpu"
) -> Coverage:
    """Compute `coverage` of a scene and its semantics."""
    check_number("min_reliability", min_reliability)
    images = photographs_of(scene, field.manifest)
    power, vote = field.manifest.get("options", {}).get("weight_power", 1), own_vote(field.manifest)
    gaussians, scalars = scene.gaussians.to(device), voting_scalars(field).map(lambda x: x.to(device))
    drawn = Drawn(gaussians, scene.rasterize_mode, RasterSettings.recorded(field.manifest), power)
    weights, count = view_weights(drawn, images.cameras), len(images.cameras)
    surface = largest(weights)
    if not float(surface.sum()) > 0:
        raise InputError("no image shows a Gaussian; check that cameras and Gaussians belong to the same scene")
    split = images.lifted
    lifted, unused = _columns(weights, range(split), count), _columns(weights, range(split, count), count)
    model = known_of_lift(scalars, lifted, surface, beta=vote.beta)
    reliability = model.expected(model.weight, model.squared)
    lost = unsupported(nearest_neighbors(gaussians.means, vote.config.k), scalars.reliability)
    evidenced = Evidenced(gaussians.means, scalars, surface, reliability, views_that_see(lifted, surface), lost)
    regions, parts = weak_regions(evidenced, min_reliability=min_reliability, reach=REACH)
    targets = [region.centre for region in regions]
    poses = suggest_poses(drawn, images.cameras, model, targets, parts)
    return Coverage(
        reliability=float((surface * reliability).sum() / surface.sum()),
        regions=regions,
        photographs=_suggest_images(images, model, unused, parts),
        poses=poses,
        pictures=[draw_pose(drawn, scene, reliability, pose) for pose in poses],
        left_out=images.left_out,
        remarks=_remarks(images, regions, poses, min_reliability),
    )


def _suggest_images(images: Photographs, model: Known, unused: SparseRows, parts: Sequence[Tensor]) -> list[Photograph]:
    names, count = images.names[images.lifted :], len(images.why)
    shown = shown_shares(unused, count, model.surface, parts)
    return [
        Photograph(
            names[view],
            images.why[view],
            gain,
            [i for i, share in enumerate(shown[:, view].tolist(), 1) if share >= SEES],
        )
        for view, gain in choose_views(model, unused, count, _MAX_IMAGES)
    ]


def _columns(weights: SparseRows, views: range, count: int) -> SparseRows:
    return weights.select_columns(torch.tensor(list(views), dtype=torch.int64, device=weights.weight.device), count)


def _remarks(
    images: Photographs, regions: Sequence[Region], poses: Sequence[Pose], min_reliability: float
) -> list[str]:
    remarks = []
    if len(regions) == 0:
        remarks.append(
            f"No region lacks evidence: everything that the images show has R of at least {min_reliability:g}, except "
            "for parts smaller than a thousandth of it."
        )
    elif len(poses) == 0:
        remarks.append(
            "No new pose shows a region better than the images do; it may be hidden from all possible positions."
        )
    if len(images.why) == 0:
        remarks.append("No image was left out of the lift, so none can be suggested.")
    total = sum(images.left_out.values())
    if len(images.why) < total:
        remarks.append(f"Of {total:,} images left out, only {len(images.why)}, evenly spaced, were examined.")
    if len(images.cameras) == 1:
        remarks.append("The scene has a single camera; the study cannot judge what this camera does not show.")
    return remarks
