"""What one more view would add to a lift, from rendering weights alone: no image is read and no feature is computed.

With W_jv the weight of Gaussian j in view v, as a share of the picture, and S the views that were lifted (equation
numbers of the paper)::

    s_j      = max_v W_jv over all photographs, lifted or not: the surface that a Gaussian shows
    N_j(S)   = (sum_v W_jv) ** 2 / (sum_v W_jv ** 2 + (FAINT s_j) ** 2), the effective views of eq. 8; a view that
               hardly sees a Gaussian is not a whole one
    R_j(S)   = ||f_j|| N_j(S) / (N_j(S) + beta)               eq. 8; ||f_j|| of a Gaussian without evidence is taken
               as the mean of the others, by surface
    gain(v)  = sum_j s_j max(0, R_j(S + v) - R_j(S)) / sum_j s_j

The gain is the rise of the mean reliability of what the photographs show, if the new view agrees with the others as
well as they do with each other. Views are chosen one after the other, each by its gain beside those chosen before: the
second of two similar views gains little.
"""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import torch
from jaxtyping import Float, Float64, Int64
from torch import Tensor

from normlift_ns.core.gaussians import Camera, GaussianScene
from normlift_ns.core.lift import Scalars
from normlift_ns.core.sparse import SparseRows
from normlift_ns.options import RasterizeMode
from normlift_ns.raster.rasterize import rasterize_evidence
from normlift_ns.raster.settings import RasterSettings

PIXELS = 20_000
"""Of the pictures that weights are taken from."""
FAINT = 0.1
"""Share of its largest weight below which a view hardly sees a Gaussian."""

_PART = 2**24
"""Entries that are looked at at once."""


class Drawn(NamedTuple):
    """How weights are rasterized: as for the lift."""

    gaussians: GaussianScene
    rasterize_mode: RasterizeMode
    settings: RasterSettings
    weight_power: int


@dataclass(frozen=True)
class Known:
    """What the lifted views know of every Gaussian, in float64."""

    norm: Float64[Tensor, " n"]
    """||f_j||, or what is expected of it."""
    weight: Float64[Tensor, " n"]
    """sum_v W_jv of the lifted views."""
    squared: Float64[Tensor, " n"]
    """sum_v W_jv ** 2 of the lifted views."""
    surface: Float64[Tensor, " n"]
    """s_j"""
    beta: float

    def expected(
        self, weight: Float64[Tensor, " m"], squared: Float64[Tensor, " m"], rows: Tensor | slice = slice(None)
    ) -> Float64[Tensor, " m"]:
        """R_j of some Gaussians with these sums of weights."""
        n_eff = _ratio(weight**2, squared + (FAINT * self.surface[rows]) ** 2)
        return self.norm[rows] * _ratio(n_eff, n_eff + self.beta)

    def seen_by(self, views: SparseRows, view: int) -> Known:
        """What is known once one of the views is lifted too."""
        here = views.column == view
        rows, weight = views.row_index()[here], views.weight[here].double()
        return replace(
            self,
            weight=self.weight.index_add(0, rows, weight),
            squared=self.squared.index_add(0, rows, weight**2),
        )


def smaller(camera: Camera, pixels: int = PIXELS) -> Camera:
    """The same camera with about so many pixels; never with more than it has.

    >>> camera = Camera(torch.tensor([[100.0, 0, 80], [0, 100, 60], [0, 0, 1]]), torch.eye(4), width=160, height=120)
    >>> small = smaller(camera, 1200)
    >>> small.width, small.height, small.K[0].tolist()
    (40, 30, [25.0, 0.0, 20.0])
    """
    factor = min(1.0, (pixels / (camera.width * camera.height)) ** 0.5)
    width, height = (max(1, round(factor * side)) for side in (camera.width, camera.height))
    scale = torch.tensor([[width / camera.width], [height / camera.height], [1.0]], dtype=camera.K.dtype)
    return Camera(camera.K * scale.to(camera.K.device), camera.world_to_camera, width, height)


def view_weights(drawn: Drawn, cameras: Sequence[Camera], *, pixels: int = PIXELS) -> SparseRows:
    """W_jv, [N, views]: the weight of Gaussian j in picture v, as a share of the picture."""
    small = [smaller(camera, pixels) for camera in cameras]
    with warnings.catch_warnings():  # the lift has told of Gaussians that are not drawn
        warnings.filterwarnings("ignore", message=".*are not drawn")
        found = rasterize_evidence(
            drawn.gaussians,
            small,
            (torch.zeros(camera.height, camera.width, dtype=torch.int32) for camera in small),
            num_regions=[1] * len(small),
            rasterize_mode=drawn.rasterize_mode,
            settings=drawn.settings,
            weight_power=drawn.weight_power,
        ).rows
    area = torch.tensor([float(c.width * c.height) for c in small], dtype=torch.float64, device=found.weight.device)
    return SparseRows(found.offsets, found.column, found.weight.double() / area[found.column.long()])


def largest(weights: SparseRows) -> Float64[Tensor, " n"]:
    """s_j: the largest weight of every Gaussian in any view, 0 where none sees it."""
    found = weights.weight.new_zeros(len(weights))
    return found.scatter_reduce_(0, weights.row_index(), weights.weight, "amax").double()


def views_that_see(weights: SparseRows, surface: Float64[Tensor, " n"]) -> Int64[Tensor, " n"]:
    """Number of views that see each Gaussian with at least `FAINT` of its largest weight."""
    row = weights.row_index()
    return torch.bincount(row[weights.weight >= FAINT * surface[row]], minlength=len(weights))


def known_of_lift(scalars: Scalars, lifted: SparseRows, surface: Float64[Tensor, " n"], *, beta: float) -> Known:
    """What a lift knows.

    N_eff and ||f_j|| are those of the lift, and W_j is too, but for its scale: a lift counts pixels of another size,
    and several levels of regions.

    Args:
        lifted: weights of the lifted views.
    """
    own, seen = lifted.row_sums(), scalars.norm.double()
    has = (seen > 0) & (own > 0) & (scalars.n_eff > 0)
    scale = (own[has] / scalars.weight[has].double()).median() if bool(has.any()) else own.new_ones(())
    weight = torch.where(has, scale * scalars.weight.double(), 0.0)
    mean = _ratio((surface * seen)[has].sum(), surface[has].sum()) if bool(has.any()) else own.new_ones(())
    squared = _ratio(weight**2, scalars.n_eff.double())
    return Known(torch.where(has, seen, mean), weight, squared, surface, beta)


def gains(known: Known, views: SparseRows, count: int) -> Float64[Tensor, " views"]:
    """gain(v) of every view, beside those that are known."""
    before = known.expected(known.weight, known.squared)
    found = torch.zeros(count, dtype=torch.float64, device=before.device)
    parts = (x.split(_PART) for x in (views.row_index(), views.column, views.weight))
    for row, column, weight in zip(*parts):
        added = weight.double()
        after = known.expected(known.weight[row] + added, known.squared[row] + added**2, row)
        found.index_add_(0, column.long(), known.surface[row] * (after - before[row]).clamp(min=0))
    return _ratio(found, known.surface.sum())


def choose_views(known: Known, views: SparseRows, count: int, most: int) -> list[tuple[int, float]]:
    """Views with their gains, greedily: each gains most beside those before it. None that gains nothing.

    Args:
        views: W_jv of the candidates, [N, count].
    """
    chosen: list[tuple[int, float]] = []
    for _ in range(min(most, count)):
        found = gains(known, views, count)
        found[[view for view, _ in chosen]] = 0.0
        best = int(found.argmax())
        if not float(found[best]) > 0:
            break
        chosen.append((best, float(found[best])))
        known = known.seen_by(views, best)
    return chosen


def shown_shares(views: SparseRows, count: int, surface: Tensor, parts: Sequence[Tensor]) -> Float64[Tensor, "p v"]:
    """[parts, views] how much of each part a view shows: sum_j min(W_jv, s_j) / sum_j s_j, 1 where it shows all as well
    as the photograph that shows it best.
    """
    shares = torch.zeros(len(parts), count, dtype=torch.float64)
    for i, rows in enumerate(parts):
        some = views.select_rows(rows)
        shown = torch.minimum(some.weight.double(), surface[rows][some.row_index()])
        found = torch.zeros(count, dtype=torch.float64, device=shown.device).index_add_(0, some.column.long(), shown)
        shares[i] = (found / surface[rows].sum()).cpu()
    return shares


def _ratio(numerator: Float[Tensor, "*n"], denominator: Float[Tensor, "*n"]) -> Float[Tensor, "*n"]:
    """0 where the denominator is."""
    return torch.where(denominator > 0, numerator / denominator, 0.0)
