"""Intersection over union of two oriented boxes, by volume."""

from __future__ import annotations

import numpy as np
from scipy.spatial import ConvexHull, HalfspaceIntersection, QhullError

from normlift_ns.analysis.objects import OrientedBox


def half_spaces(box: OrientedBox) -> np.ndarray:
    """Return [6, 4], the normal and offset of the six faces; a point p is inside if normal @ p + offset <= 0."""
    axes, center, size = box.axes.numpy(), box.center.numpy(), box.size.numpy()
    along = axes @ center
    upper = np.column_stack([axes, -along - size / 2])
    lower = np.column_stack([-axes, along - size / 2])
    return np.concatenate([upper, lower])


def intersection_volume(first: OrientedBox, second: OrientedBox) -> float:
    """Return the volume of the intersection of two boxes, or 0 if they share no interior point.

    A linear program finds the largest ball inside both boxes, whose center is an interior point. From this point, qhull
    computes the corners of the intersection and its volume.
    """
    from scipy.optimize import linprog  # noqa: PLC0415 (slow)

    faces = np.concatenate([half_spaces(first), half_spaces(second)])
    scale = float(max(first.size.max(), second.size.max()))
    if scale == 0:
        return 0.0
    middle = first.center.numpy()
    faces = np.column_stack([faces[:, :3], (faces[:, 3] + faces[:, :3] @ middle) / scale])
    ball = linprog([0, 0, 0, -1], np.column_stack([faces[:, :3], np.ones(12)]), -faces[:, 3], bounds=[(None, None)] * 4)
    if ball.status != 0 or ball.x[3] <= 1e-9:
        return 0.0
    try:
        return float(ConvexHull(HalfspaceIntersection(faces, ball.x[:3]).intersections).volume) * scale**3
    except QhullError:  # thinner than rounding
        return 0.0


def box_iou(first: OrientedBox, second: OrientedBox) -> float:
    """Return the intersection over union of two boxes, in 0..1, or 0 for boxes without volume."""
    common = intersection_volume(first, second)
    union = float(first.size.prod() + second.size.prod()) - common
    return common / union if union > 0 else 0.0
