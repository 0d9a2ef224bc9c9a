"""Benefit of one more view for a lift, from rendering weights alone: no image is read and no feature is computed.

W_jv is the weight of Gaussian j in view v, as a share of the image, and S is the set of lifted views. Equation numbers
are those of the paper::

    s_j      = max_v W_jv over all images, lifted or not: the surface that a Gaussian shows
    N_j(S)   = (sum_v W_jv) ** 2 / (sum_v W_jv ** 2 + (FAINT s_j) ** 2), the effective views of eq. 8; a view that
               hardly shows a Gaussian does not count as a whole one
    R_j(S)   = ||f_j|| N_j(S) / (N_j(S) + beta)               eq. 8; for a Gaussian without evidence, ||f_j|| is the
               mean of the others, weighted by surface
    gain(v)  = sum_j s_j max(0, R_j(S + v) - R_j(S)) / sum_j s_j

The gain is the expected increase of the mean reliability of everything that the images show. It assumes that the new
view agrees with the others as well as they agree with each other. Views are chosen one after the other, each by its
gain in addition to those chosen before. The second of two similar views thus gains little.
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
"""Resolution at which weights are rasterized, in pixels per image."""
FAINT = 0.1
"""Share of a Gaussian's largest weight below which a view hardly shows it."""

_CHUNK = 2**24
"""Number of entries that are processed together."""


class Drawn(NamedTuple):
    """Settings to rasterize weights as in the lift."""

    gaussians: GaussianScene
    rasterize_mode: RasterizeMode
    settings: RasterSettings
    weight_power: int


@dataclass(frozen=True)
class Known:
    """Evidence of the lifted views for every Gaussian, in float64."""

    norm: Float64[Tensor, " n"]
    """|f_j||, or its expected value."""
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
        """Return R_j of some Gaussians with these sums of weights."""
        n_eff = _ratio(weight**2, squared + (FAINT * self.surface[rows]) ** 2)
        return self.norm[rows] * _ratio(n_eff, n_eff + self.beta)

    def seen_by(self, views: SparseRows, view: int) -> Known:
        """Return the evidence after lifting one of the views, too."""
        entries = views.column == view
        rows, weight = views.row_index()[entries], views.weight[entries].double()
        return replace(
            self,
            weight=self.weight.index_add(0, rows, weight),
            squared=self.squared.index_add(0, rows, weight**2),
        )


def smaller(camera: Camera, pixels: int = PIXELS) -> Camera:
    """Return the camera with about `pixels` pixels, but never more than it has.

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
    """Return W_jv, [N, views]: the weight of Gaussian j in view v, as a share of the image."""
    small = [smaller(camera, pixels) for camera in cameras]
    with warnings.catch_warnings():  # the lift has already warned of Gaussians that are not drawn
        warnings.filterwarnings("ignore", message=".*are not drawn")
        rows = rasterize_evidence(
            drawn.gaussians,
            small,
            (torch.zeros(camera.height, camera.width, dtype=torch.int32) for camera in small),
            num_regions=[1] * len(small),
            rasterize_mode=drawn.rasterize_mode,
            settings=drawn.settings,
            weight_power=drawn.weight_power,
        ).rows
    area = torch.tensor([float(c.width * c.height) for c in small], dtype=torch.float64, device=rows.weight.device)
    return SparseRows(rows.offsets, rows.column, rows.weight.double() / area[rows.column.long()])


def largest(weights: SparseRows) -> Float64[Tensor, " n"]:
    """Return s_j, the largest weight of every Gaussian in any view, 0 if no view shows it."""
    maxima = weights.weight.new_zeros(len(weights))
    return maxima.scatter_reduce_(0, weights.row_index(), weights.weight, "amax").double()


def views_that_see(weights: SparseRows, surface: Float64[Tensor, " n"]) -> Int64[Tensor, " n"]:
    """Count the views that show each Gaussian with at least `FAINT` of its largest weight."""
    row = weights.row_index()
    return torch.bincount(row[weights.weight >= FAINT * surface[row]], minlength=len(weights))


def known_of_lift(scalars: Scalars, lifted: SparseRows, surface: Float64[Tensor, " n"], *, beta: float) -> Known:
    """Return the evidence of a lift.

    N_eff and ||f_j|| are those of the lift. So is W_j, except for its scale, because a lift counts pixels at another
    resolution, and several levels of regions.

    Args:
        lifted: weights of the lifted views.
    """
    sums, norm = lifted.row_sums(), scalars.norm.double()
    valid = (norm > 0) & (sums > 0) & (scalars.n_eff > 0)
    scale = (sums[valid] / scalars.weight[valid].double()).median() if bool(valid.any()) else sums.new_ones(())
    weight = torch.where(valid, scale * scalars.weight.double(), 0.0)
    mean = _ratio((surface * norm)[valid].sum(), surface[valid].sum()) if bool(valid.any()) else sums.new_ones(())
    squared = _ratio(weight**2, scalars.n_eff.double())
    return Known(torch.where(valid, norm, mean), weight, squared, surface, beta)


def gains(model: Known, views: SparseRows, count: int) -> Float64[Tensor, " views"]:
    """Return gain(v) of every view, in addition to the lifted ones."""
    before = model.expected(model.weight, model.squared)
    rise = torch.zeros(count, dtype=torch.float64, device=before.device)
    parts = (x.split(_CHUNK) for x in (views.row_index(), views.column, views.weight))
    for row, column, weight in zip(*parts):
        added = weight.double()
        after = model.expected(model.weight[row] + added, model.squared[row] + added**2, row)
        rise.index_add_(0, column.long(), model.surface[row] * (after - before[row]).clamp(min=0))
    return _ratio(rise, model.surface.sum())


def choose_views(model: Known, views: SparseRows, count: int, most: int) -> list[tuple[int, float]]:
    """Choose views greedily and return them with their gains. Each has the largest gain after those before it.

    Views without any gain are not returned.

    Args:
        views: W_jv of the candidates, [N, count].
    """
    chosen: list[tuple[int, float]] = []
    for _ in range(min(most, count)):
        gain = gains(model, views, count)
        gain[[view for view, _ in chosen]] = 0.0
        best = int(gain.argmax())
        if not float(gain[best]) > 0:
            break
        chosen.append((best, float(gain[best])))
        model = model.seen_by(views, best)
    return chosen


def shown_shares(views: SparseRows, count: int, surface: Tensor, parts: Sequence[Tensor]) -> Float64[Tensor, "p v"]:
    """Return how much of each part a view shows, [parts, views]: sum_j min(W_jv, s_j) / sum_j s_j.

    It is 1 if the view shows everything as well as the image that shows it best.
    """
    shares = torch.zeros(len(parts), count, dtype=torch.float64)
    for i, rows in enumerate(parts):
        part = views.select_rows(rows)
        shown = torch.minimum(part.weight.double(), surface[rows][part.row_index()])
        sums = torch.zeros(count, dtype=torch.float64, device=shown.device).index_add_(0, part.column.long(), shown)
        shares[i] = (sums / surface[rows].sum()).cpu()
    return shares


def _ratio(numerator: Float[Tensor, "*n"], denominator: Float[Tensor, "*n"]) -> Float[Tensor, "*n"]:
    """Divide; 0 if the denominator is 0."""
    return torch.where(denominator > 0, numerator / denominator, 0.0)
