"""Camera positions to look at an object from."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from normlift_ns.core.gaussians import GaussianScene
from normlift_ns.raster.picking import ray_weights
from normlift_ns.session.found import FoundObject

Place = tuple[float, float, float]
"""x, y, z in scene units."""
_MAX_OCCLUSION = 0.25
"""Opacity in front of the object up to which the view counts as clear."""
_AZIMUTHS, _ELEVATIONS = (0, 45, -45, 90, -90, 135, -135, 180), (0, 35)
"""Degrees around the vertical and above the current height."""


@dataclass(frozen=True)
class Spot:
    """Point to look at that is not an object."""

    centre: Place
    extent: float
    """Size of the region around the point that is to be visible."""


def clear_viewpoint(
    target: FoundObject | Spot,
    scene: GaussianScene,
    drawn: Bool[Tensor, " n"] | None,
    camera_position: Sequence[float] | np.ndarray,
    up: Sequence[float] | np.ndarray,
    field_of_view: float = 0.9,
) -> Place:
    """Return the first camera position with a clear view of an object, or the one with the least occlusion.

    Candidates start from the current side of the camera: turned around the vertical, first at its height, then from
    above.

    Args:
        target: object or point to look at.
        scene: Gaussians that may occlude it.
        drawn: mask of the Gaussians that are drawn; None: all.
        camera_position: current position of the camera.
        up: direction of the vertical.
        field_of_view: of the camera, in radians.
    """
    first = viewpoint(target, camera_position, field_of_view)
    center = torch.tensor(target.centre, dtype=torch.float64)
    distance = float(np.linalg.norm(np.asarray(first) - np.asarray(target.centre)))
    means = scene.means.detach().double().cpu()
    near = (means - center).norm(dim=1) - 3 * scene.scales.detach().double().cpu().amax(dim=1) < distance
    near = near if drawn is None else near & drawn.cpu()
    parts = (x.detach().cpu()[near] for x in (scene.means, scene.quats, scene.scales, scene.opacities))
    occluders, best, least = GaussianScene(*parts), first, np.inf
    for position in _candidates(np.asarray(first), np.asarray(target.centre), np.asarray(up, float)):
        occlusion = _occlusion(occluders, torch.from_numpy(position), center, target.extent / 2)
        if occlusion < least:
            best, least = (float(position[0]), float(position[1]), float(position[2])), occlusion
        if least <= _MAX_OCCLUSION:
            break
    return best


def viewpoint(
    target: FoundObject | Spot, camera_position: Sequence[float] | np.ndarray, field_of_view: float = 0.9
) -> Place:
    """Return the camera position on the current side of an object from which it fills half of the image.

    Args:
        target: object or point to look at.
        camera_position: current position of the camera.
        field_of_view: of the camera, in radians.
    """
    center = np.asarray(target.centre)
    offset = np.asarray(camera_position, float) - center
    length = float(np.linalg.norm(offset))
    offset = offset / length if length > 0 else np.array([0.0, -1.0, 0.0])
    distance = max(target.extent, 1e-6) / np.tan(field_of_view / 2)
    position = center + offset * distance
    return float(position[0]), float(position[1]), float(position[2])


def _candidates(position: np.ndarray, center: np.ndarray, up: np.ndarray) -> Iterator[np.ndarray]:
    """Yield positions at the same distance around a center, the given one first."""
    offset = position - center
    distance, up = np.linalg.norm(offset), up / max(float(np.linalg.norm(up)), 1e-12)
    along = (offset @ up) * up
    level, across = offset - along, np.cross(up, offset)
    for elevation in _ELEVATIONS:
        for azimuth in _AZIMUTHS:
            turned = np.cos(np.radians(azimuth)) * level + np.sin(np.radians(azimuth)) * across + along
            turned = turned + np.tan(np.radians(elevation)) * distance * up
            yield center + turned * (distance / max(float(np.linalg.norm(turned)), 1e-12))


def _occlusion(
    scene: GaussianScene, position: Float[Tensor, " 3"], center: Float[Tensor, " 3"], margin: float
) -> float:
    """Return the opacity between a position and a center, without the last `margin` in front of the center."""
    direction = center - position
    length = direction.norm().clamp(min=1e-12)
    before = (scene.means.double() - position) @ (direction / length) < length - margin
    return float(ray_weights(scene, position, direction)[before].sum())
