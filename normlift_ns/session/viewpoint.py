"""Where a camera goes to look at something."""

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
_CLEAR = 0.25
"""Opacity of what may stand in the way."""
_TURNS, _TILTS = (0, 45, -45, 90, -90, 135, -135, 180), (0, 35)
"""Degrees, around the vertical and from above."""


@dataclass(frozen=True)
class Spot:
    """A place to go to that is no object."""

    centre: Place
    extent: float
    """How much around it is to be seen."""


def clear_viewpoint(
    found: FoundObject | Spot,
    scene: GaussianScene,
    drawn: Bool[Tensor, " n"] | None,
    from_: Sequence[float] | np.ndarray,
    up: Sequence[float] | np.ndarray,
    field_of_view: float = 0.9,
) -> Place:
    """As `viewpoint`, from the first side from which nothing stands before it; where there is none, from the best.

    The sides are tried from where the camera is: turned around the vertical, at its height first and then from above.

    Args:
        drawn: Gaussians that can stand in the way; None: all.
        up: the vertical.
    """
    first = viewpoint(found, from_, field_of_view)
    centre = torch.tensor(found.centre, dtype=torch.float64)
    reach = float(np.linalg.norm(np.asarray(first) - np.asarray(found.centre)))
    means = scene.means.detach().double().cpu()
    near = (means - centre).norm(dim=1) - 3 * scene.scales.detach().double().cpu().amax(dim=1) < reach
    near = near if drawn is None else near & drawn.cpu()
    parts = (x.detach().cpu()[near] for x in (scene.means, scene.quats, scene.scales, scene.opacities))
    around, best, least = GaussianScene(*parts), first, np.inf
    for place in _sides(np.asarray(first), np.asarray(found.centre), np.asarray(up, float)):
        hidden = _in_the_way(around, torch.from_numpy(place), centre, found.extent / 2)
        if hidden < least:
            best, least = (float(place[0]), float(place[1]), float(place[2])), hidden
        if least <= _CLEAR:
            break
    return best


def viewpoint(found: FoundObject | Spot, from_: Sequence[float] | np.ndarray, field_of_view: float = 0.9) -> Place:
    """Where a camera goes that looks at an object or a spot: from the side where it is, so far that it fills half the
    picture.

    Args:
        from_: where the camera is now.
        field_of_view: of the camera, in radians.
    """
    centre = np.asarray(found.centre)
    away = np.asarray(from_, float) - centre
    length = float(np.linalg.norm(away))
    away = away / length if length > 0 else np.array([0.0, -1.0, 0.0])
    distance = max(found.extent, 1e-6) / np.tan(field_of_view / 2)
    place = centre + away * distance
    return float(place[0]), float(place[1]), float(place[2])


def _sides(place: np.ndarray, centre: np.ndarray, up: np.ndarray) -> Iterator[np.ndarray]:
    """Places around a centre, as far away as the first one, which is the first."""
    away = place - centre
    distance, up = np.linalg.norm(away), up / max(float(np.linalg.norm(up)), 1e-12)
    along = (away @ up) * up
    level, across = away - along, np.cross(up, away)
    for tilt in _TILTS:
        for turn in _TURNS:
            turned = np.cos(np.radians(turn)) * level + np.sin(np.radians(turn)) * across + along
            turned = turned + np.tan(np.radians(tilt)) * distance * up
            yield centre + turned * (distance / max(float(np.linalg.norm(turned)), 1e-12))


def _in_the_way(scene: GaussianScene, place: Float[Tensor, " 3"], centre: Float[Tensor, " 3"], margin: float) -> float:
    """Opacity of what is met between a place and what is looked at there, without the last `margin` before it."""
    direction = centre - place
    length = direction.norm().clamp(min=1e-12)
    before = (scene.means.double() - place) @ (direction / length) < length - margin
    return float(ray_weights(scene, place, direction)[before].sum())
