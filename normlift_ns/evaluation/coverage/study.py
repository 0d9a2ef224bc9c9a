"""Where to look next, for a lifted run: the page to read first."""

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
"""R above which a Gaussian is reliable: more than one view that agrees with itself gives, at beta 1."""
PHOTOGRAPHS = 12
"""Photographs that are suggested."""


@dataclass(frozen=True)
class Photograph:
    """A photograph that was left out of the lift."""

    name: str
    why: Why
    """Why it was left out."""
    gain: float
    """Expected rise of the mean reliability of all surface, beside the lift and the photographs above it."""
    regions: list[int]
    """Numbers of the regions that it sees, from 1."""


@dataclass(frozen=True)
class Coverage:
    """What a lift lacks, and where to get it.

    >>> from normlift_ns import coverage, open_run
    >>> found = coverage(open_run(config))
    >>> [photograph.why for photograph in found.photographs]
    ['held out', 'held out']
    >>> 0 < found.reliability < 1
    True
    """

    reliability: float
    """Mean R_j(S) of `evaluation.coverage.gain`, over all surface that the photographs show, in 0..1."""
    regions: list[Region]
    """The one that lacks most comes first."""
    photographs: list[Photograph]
    """In the order in which to add them."""
    poses: list[Pose]
    """New ones, in the order in which to take them."""
    pictures: list[Picture]
    """What the poses see."""
    left_out: dict[Why, int]
    """Photographs that are not in the lift."""
    remarks: list[str]
    """In whole sentences."""

    def to_json(self) -> dict[str, Any]:
        """The same as plain types, without the pictures."""
        plain = {f.name: getattr(self, f.name) for f in fields(self) if f.name != "pictures"}
        rows = {name: [asdict(row) for row in plain[name]] for name in ("regions", "photographs")}
        return {**plain, **rows, "poses": [pose.to_json() for pose in self.poses]}

    def save(self, path: str | Path, *, overwrite: bool = False) -> list[Path]:
        """Writes a JSON file with all of it, and beside it <stem>_pose_1.png … and <stem>_camera_path.json, which
        `ns-render camera-path` takes with the run; returns their paths.

        Args:
            overwrite: replace files of these names.
        Raises:
            FileExistsError: one is there, and `overwrite` is False.
            ValueError: the name of a file of a run.
            OSError: they cannot be written.

        >>> from normlift_ns import coverage, open_run
        >>> [path.name for path in coverage(open_run(config)).save(folder / "next.json")][:2]
        ['next.json', 'next_camera_path.json']
        """
        place = check_path("path", path)
        if place.name in ("", ".."):
            raise InputError(f"{place} is no name of a file; give one such as next.json")
        stem = place.with_suffix("")
        refuse_run_files(place, *pose_files(stem), instead="name")
        documents = {place: self.to_json()}
        return write_poses(stem, self.poses, self.pictures, documents=documents, overwrite=overwrite)


def coverage(run: LiftedRun, *, min_reliability: float = RELIABLE, device: str | None = None) -> Coverage:
    """Which regions lack reliable evidence, which photographs left out of the lift would help most, and new poses that
    would see the worst regions.

    Nothing is lifted and no image is read: weights of views are rasterized at a low resolution, and the reliability
    that one more view would give is computed from them (`evaluation.coverage.gain` has the formula).

    Args:
        min_reliability: R below which a Gaussian is not reliable, in 0..1.
        device: where to rasterize; None: that of the run.
    Raises:
        ValueError: a run that does not tell which photographs were lifted; photographs that show no Gaussian.

    >>> from normlift_ns import coverage, open_run
    >>> run = open_run(config)
    >>> found = coverage(run, min_reliability=0.6)
    >>> all(region.reliability < 0.6 for region in found.regions)
    True
    """
    return coverage_of(run.scene, run.field, min_reliability=min_reliability, device=device or run.device)


def coverage_of(
    scene: Scene, field: SemanticField, *, min_reliability: float = RELIABLE, device: str = "cpu"
) -> Coverage:
    """`coverage` of a scene and its semantics."""
    check_number("min_reliability", min_reliability)
    photographs = photographs_of(scene, field.manifest)
    power, vote = field.manifest.get("options", {}).get("weight_power", 1), own_vote(field.manifest)
    gaussians, scalars = scene.gaussians.to(device), voting_scalars(field).map(lambda x: x.to(device))
    drawn = Drawn(gaussians, scene.rasterize_mode, RasterSettings.recorded(field.manifest), power)
    weights, count = view_weights(drawn, photographs.cameras), len(photographs.cameras)
    surface = largest(weights)
    if not float(surface.sum()) > 0:
        raise InputError("no photograph shows a Gaussian; check that cameras and Gaussians are of one scene")
    split = photographs.lifted
    lifted, left = _columns(weights, range(split), count), _columns(weights, range(split, count), count)
    known = known_of_lift(scalars, lifted, surface, beta=vote.beta)
    reliability = known.expected(known.weight, known.squared)
    lost = unsupported(nearest_neighbors(gaussians.means, vote.config.k), scalars.reliability)
    evidenced = Evidenced(gaussians.means, scalars, surface, reliability, views_that_see(lifted, surface), lost)
    regions, parts = weak_regions(evidenced, min_reliability=min_reliability, reach=REACH)
    targets = [region.centre for region in regions]
    poses = suggest_poses(drawn, photographs.cameras, known, targets, parts)
    return Coverage(
        reliability=float((surface * reliability).sum() / surface.sum()),
        regions=regions,
        photographs=_suggested(photographs, known, left, parts),
        poses=poses,
        pictures=[draw_pose(drawn, scene, reliability, pose) for pose in poses],
        left_out=photographs.left_out,
        remarks=_remarks(photographs, regions, poses, min_reliability),
    )


def _suggested(photographs: Photographs, known: Known, left: SparseRows, parts: Sequence[Tensor]) -> list[Photograph]:
    names, count = photographs.names[photographs.lifted :], len(photographs.why)
    seen = shown_shares(left, count, known.surface, parts)
    return [
        Photograph(
            names[view],
            photographs.why[view],
            gain,
            [i for i, share in enumerate(seen[:, view].tolist(), 1) if share >= SEES],
        )
        for view, gain in choose_views(known, left, count, PHOTOGRAPHS)
    ]


def _columns(weights: SparseRows, some: range, count: int) -> SparseRows:
    return weights.select_columns(torch.tensor(list(some), dtype=torch.int64, device=weights.weight.device), count)


def _remarks(
    photographs: Photographs, regions: Sequence[Region], poses: Sequence[Pose], min_reliability: float
) -> list[str]:
    found = []
    if len(regions) == 0:
        found.append(
            f"No region lacks evidence: all that the photographs show has R of at least {min_reliability:g}, but for "
            "parts smaller than a thousandth of it."
        )
    elif len(poses) == 0:
        found.append(
            "No new pose was found that sees a region better than the photographs do; it may be hidden from wherever "
            "a camera could be."
        )
    if len(photographs.why) == 0:
        found.append("No photograph was left out of the lift, so none can be suggested.")
    total = sum(photographs.left_out.values())
    if len(photographs.why) < total:
        found.append(f"Of {total:,} photographs left out, {len(photographs.why)}, evenly spread, were looked at.")
    if len(photographs.cameras) == 1:
        found.append("The scene has a single camera; what it does not see cannot be told.")
    return found
