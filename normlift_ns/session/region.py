"""Selection of the visible Gaussians inside a polygon or along a brush stroke in a view."""

from __future__ import annotations

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from normlift_ns.core.gaussians import Camera, GaussianScene
from normlift_ns.options import RasterizeMode
from normlift_ns.rasterization.rasterize import render

_RENDER_SIZE = 320
"""Maximum longer side, in pixels, of the render that determines visibility."""
_MARGIN = 0.03


def inside_polygon(points: Float[np.ndarray, "m 2"], polygon: Float[np.ndarray, "k 2"]) -> Bool[np.ndarray, " m"]:
    """Return a mask of the points inside a polygon, by the even-odd rule.

    >>> square = np.array([[0.0, 0], [2, 0], [2, 2], [0, 2]])
    >>> inside_polygon(np.array([[1.0, 1], [3, 1]]), square)
    array([ True, False])
    """
    inside = np.zeros(len(points), bool)
    x, y = points.T
    for (x0, y0), (x1, y1) in zip(polygon, np.roll(polygon, -1, axis=0)):
        crosses = (y0 > y) != (y1 > y)
        with np.errstate(divide="ignore", invalid="ignore"):
            inside ^= crosses & (x < (x1 - x0) * (y - y0) / (y1 - y0) + x0)
    return inside


def near_path(
    points: Float[np.ndarray, "m 2"], path: Float[np.ndarray, "k 2"], radius: float
) -> Bool[np.ndarray, " m"]:
    """Return a mask of the points within a distance `radius` of a path of line segments.

    >>> near_path(np.array([[1.0, 0.5], [1, 2]]), np.array([[0.0, 0], [2, 0]]), 1.0)
    array([ True, False])
    """
    near = np.zeros(len(points), bool)
    for start, end in zip(path, [*path[1:], path[-1]]):
        line = end - start
        step = ((points - start) @ line / max(float(line @ line), 1e-12)).clip(0, 1)
        near |= np.square(points - start - step[:, None] * line).sum(axis=1) <= radius**2
    return near


def project(means: Float[Tensor, "n 3"], camera: Camera) -> tuple[Float[np.ndarray, "n 2"], Bool[np.ndarray, " n"]]:
    """Return the pixel coordinates of every point, and a mask of the points in front of the camera and in the image."""
    pose = camera.world_to_camera.double().cpu()
    seen = means.detach().double().cpu() @ pose[:3, :3].T + pose[:3, 3]
    pixels = ((seen @ camera.K.double().cpu().T)[:, :2] / seen[:, 2:].clamp(min=1e-12)).numpy()
    size = np.array([camera.width, camera.height])
    return pixels, (seen[:, 2] > 1e-6).numpy() & ((pixels >= 0) & (pixels <= size)).all(axis=1)


def visible_gaussians(
    scene: GaussianScene, camera: Camera, drawn: Bool[Tensor, " n"], *, rasterize_mode: RasterizeMode = "classic"
) -> Bool[Tensor, " n"]:
    """Return the mask of the drawn Gaussians that lie on or in front of the visible surface of a view.

    The depth of the surface is the mean depth rendered at the pixel of the Gaussian's center. A Gaussian may lie behind
    the surface by up to twice its largest standard deviation, or 3 % of the surface's depth if that is more.

    Args:
        drawn: Mask of the Gaussians that are drawn.
    """
    small = camera.downscaled(_RENDER_SIZE / max(camera.width, camera.height))
    rows = (drawn & scene.drawable).nonzero().squeeze(1)
    part = scene.select(rows)
    row, column, depth, inside = small.project(part.means)
    shown, alpha = render(part, small, depth[:, None], rasterize_mode=rasterize_mode)
    surface = (shown[:, :, 0] / alpha.clamp(min=1e-6))[row, column]
    margin = (2 * part.scales.amax(dim=1)).maximum(_MARGIN * surface)
    mask = torch.zeros_like(drawn)
    mask[rows] = inside & (depth <= surface + margin)
    return mask
