"""Objects of a selection as rows for a panel, and camera positions that show them."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from normlift_ns.analysis.objects import connected_components, evidence_weights
from normlift_ns.core.gaussians import GaussianScene
from normlift_ns.options import OBJECT_MIN_GAUSSIANS
from normlift_ns.rasterization.rasterize import ray_weights
from normlift_ns.rendering.colors import RGB, prompt_rgb_tuples
from normlift_ns.session.state import BY_HAND, WEAK_RELIABILITY, State

_STRONG = 0.8
"""Minimum reliability R of strong evidence."""
_BY_HAND_COLOR = (1.0, 0.75, 0.1)


@dataclass(frozen=True, eq=False)
class ObjectRow:
    """One object of a selection; see `list_objects`.

    Means are weighted by W_j, the total weight of Gaussian j over all views.
    """

    text: str
    """The prompt, or "selected by hand"."""
    number: int
    """Number of the object among those with the same text, from 1. Objects that were added by hand come first, in the
    order of addition; the others follow by descending size."""
    color: RGB
    """Color of the prompt, or the color of selections made by hand; RGB in 0..1."""
    mask: Bool[Tensor, " n"]
    """Mask of the object's Gaussians."""
    size: int
    """Number of Gaussians."""
    reliability: float
    """Weighted mean of the reliability R."""
    mean_views: float
    """Weighted mean of the effective number of views N_eff."""
    center: tuple[float, float, float]
    """Weighted mean of the Gaussian centers. The camera looks at this position."""
    extent: float
    """Diagonal, in scene units, of the box around the central 90 % of the Gaussian centers along each axis."""

    @property
    def name(self) -> str:
        """Text and number of the object; `io.atomic.safe_file_name` converts them to a file name."""
        return f"{self.text} {self.number}"

    @property
    def evidence(self) -> str:
        """Strength of the evidence as text, with the reliability R and the effective number of views."""
        grade = "strong" if self.reliability >= _STRONG else "fair" if self.reliability >= WEAK_RELIABILITY else "weak"
        return f"{grade} evidence (R {self.reliability:.2f}, {self.mean_views:.1f} views)"


@dataclass(frozen=True, eq=False)
class ObjectList:
    """List of the objects of a selection."""

    objects: tuple[ObjectRow, ...]
    """Listed objects, ordered by prompt and then by number."""
    left_out: int
    """Number of objects that are not listed because there are too many."""
    in_smaller_parts: int
    """Number of Gaussians in components too small to be objects, counted separately for each prompt."""


def list_objects(state: State, *, max_objects: int = 12, min_gaussians: int = OBJECT_MIN_GAUSSIANS) -> ObjectList:
    """List the objects of the drawn part of the selection, for each prompt or for a selection made by hand.

    Objects are connected components. In a selection made by hand, each object that was selected or added stays one
    object, unless the selection was grown or shrunk. If prompts select, Gaussians that were only added by hand do not
    belong to an object.

    Args:
        max_objects: Maximum number of listed objects; the largest object of each prompt has priority.
        min_gaussians: Minimum number of Gaussians in an object; Gaussians in smaller components are only counted.
    """
    selected, answer = state.selection & state.drawn, state.answer
    rows: list[tuple[int, int, str, RGB, Tensor, int]] = []
    if answer is None or not state.prompts_select:
        parts = [(one.text, one.mask & selected) for one in state.additions if state.grow_steps == 0]
        for group, (text, mask) in enumerate(parts):
            if int(mask.sum()) >= min_gaussians:
                number = sum(row[2] == text for row in rows)
                rows.append((number, group, text, _BY_HAND_COLOR, mask, int(mask.sum())))
                selected = selected & ~mask
        groups = [(BY_HAND, _BY_HAND_COLOR, selected)]
    else:
        prompts = range(len(answer.texts)) if state.shown is None else [state.shown]
        colors = prompt_rgb_tuples(answer.texts)
        groups = [(answer.texts[q], colors[q], selected & answer.selected[:, q]) for q in prompts]
    small = 0
    for group, (text, color, mask) in enumerate(groups, len(rows)):
        labels, first = connected_components(state.space.means, mask), sum(row[2] == text for row in rows)
        sizes = torch.bincount(labels[labels >= 0].long()).tolist()
        count = sum(size >= min_gaussians for size in sizes)
        small += sum(sizes[count:])
        rows += [(first + n, group, text, color, labels == n, size) for n, size in enumerate(sizes[:count])]
    listed = sorted(sorted(rows, key=lambda row: row[:2])[:max_objects], key=lambda row: (row[1], row[0]))
    objects = tuple(_object(state, text, n, color, mask, size) for n, _, text, color, mask, size in listed)
    return ObjectList(objects, len(rows) - len(listed), small)


def _object(state: State, text: str, number: int, color: RGB, mask: Tensor, size: int) -> ObjectRow:
    scalars = state.space.field.scalars
    weight = evidence_weights(scalars, mask)
    means = state.space.means[mask].double()
    center = (weight[:, None] * means).sum(dim=0).tolist()
    low, high = np.quantile(means.cpu().numpy(), (0.05, 0.95), axis=0)
    reliability, views = (float((weight * x[mask].double()).sum()) for x in (scalars.reliability, scalars.n_eff))
    extent = float(np.linalg.norm(high - low))
    return ObjectRow(text, number + 1, color, mask, size, reliability, views, tuple(center), extent)


# Camera positions that show an object.


Position = tuple[float, float, float]
"""x, y and z in scene units."""
_MAX_OCCLUSION = 0.25
"""Maximum mean opacity in front of an object for a clear view of it."""
_FILL = 0.8
"""Fraction of the image height that an object fills, seen from the position that `viewpoint` returns."""
_SIGHT_POINTS = 8
_AZIMUTHS, _ELEVATIONS = (0, 45, -45, 90, -90, 135, -135, 180), (0, 35)
"""Azimuths and elevations of the candidate camera positions, in degrees relative to the first candidate."""


@dataclass(frozen=True)
class LookAtTarget:
    """Point to look at, in place of an object."""

    center: Position
    extent: float
    """Size of the visible region around the point, in scene units."""


def unoccluded_viewpoint(
    target: ObjectRow | LookAtTarget,
    scene: GaussianScene,
    drawn: Bool[Tensor, " n"] | None,
    camera_position: Sequence[float] | np.ndarray,
    up: Sequence[float] | np.ndarray,
    field_of_view: float = 0.9,
) -> Position:
    """Return the first candidate camera position with a clear view of an object, else the one with the least occlusion.

    The first candidate is on the current side of the object. The others are rotations of it around the vertical, first
    at the same height, then at a greater height. The occlusion is the mean opacity in front of the center and of
    several Gaussians of the object; the object itself does not count as an occluder.

    Args:
        target: Object or point to look at.
        scene: Gaussians that may occlude the target.
        drawn: Mask of the Gaussians that are drawn; None if all are.
        camera_position: Current position of the camera.
        up: Up direction.
        field_of_view: Vertical field of view of the camera in radians.
    """
    first = viewpoint(target, camera_position, field_of_view)
    center = torch.tensor(target.center, dtype=torch.float64)
    distance = float(np.linalg.norm(np.asarray(first) - np.asarray(target.center)))
    means = scene.means.detach().double().cpu()
    near = (means - center).norm(dim=1) - 3 * scene.scales.detach().double().cpu().amax(dim=1) < distance
    near = near if drawn is None else near & drawn.cpu()
    points, margin = center[None], target.extent / 2
    if isinstance(target, ObjectRow):
        near &= ~target.mask.cpu()
        own = means[target.mask.cpu()]
        points, margin = torch.cat([points, own[:: 1 + len(own) // _SIGHT_POINTS]]), target.extent / 4
    occluders, best, least = scene.to("cpu").select(near), first, np.inf
    for position in _candidates(np.asarray(first), np.asarray(target.center), np.asarray(up, float)):
        start = torch.from_numpy(position)
        occlusion = float(np.mean([_occlusion(occluders, start, point, margin) for point in points]))
        if occlusion < least:
            best, least = _as_position(position), occlusion
        if least <= _MAX_OCCLUSION:
            break
    return best


def viewpoint(
    target: ObjectRow | LookAtTarget, camera_position: Sequence[float] | np.ndarray, field_of_view: float = 0.9
) -> Position:
    """Return a camera position on the current side of an object, from which the object fills 80 % of the image height.

    Args:
        target: Object or point to look at.
        camera_position: Current position of the camera.
        field_of_view: Vertical field of view of the camera in radians.
    """
    center = np.asarray(target.center)
    offset = np.asarray(camera_position, float) - center
    length = float(np.linalg.norm(offset))
    offset = offset / length if length > 0 else np.array([0.0, -1.0, 0.0])
    distance = max(target.extent, 1e-6) / (2 * _FILL * np.tan(field_of_view / 2))
    return _as_position(center + offset * distance)


def _as_position(point: np.ndarray) -> Position:
    x, y, z = point.tolist()
    return x, y, z


def _candidates(position: np.ndarray, center: np.ndarray, up: np.ndarray) -> Iterator[np.ndarray]:
    """Yield `position`, then positions around the center at the same distance."""
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
    """Return the opacity between a position and a center, excluding a distance of `margin` in front of the center."""
    direction = center - position
    length = direction.norm().clamp(min=1e-12)
    before = (scene.means.double() - position) @ (direction / length) < length - margin
    return float(ray_weights(scene, position, direction)[before].sum())
