"""How far two oriented boxes agree: the volume of their intersection over that of their union."""

from __future__ import annotations

import numpy as np
from scipy.spatial import ConvexHull, HalfspaceIntersection, QhullError

from normlift_ns.analysis.objects import OrientedBox


def half_spaces(box: OrientedBox) -> np.ndarray:
    """[6, 4] normal and offset of the six faces: a point p lies inside where normal @ p + offset <= 0."""
    axes, center, size = box.axes.numpy(), box.center.numpy(), box.size.numpy()
    along = axes @ center
    upper = np.column_stack([axes, -along - size / 2])
    lower = np.column_stack([-axes, along - size / 2])
    return np.concatenate([upper, lower])


def intersection_volume(first: OrientedBox, second: OrientedBox) -> float:
    """Of two convex polytopes: the largest ball inside of both (a linear programme) gives a point inside, the faces
    around it the corners (qhull), and these the volume. 0 where they have no inside in common.
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
    """In 0..1; 0 for boxes without volume."""
    common = intersection_volume(first, second)
    union = float(first.size.prod() + second.size.prod()) - common
    return common / union if union > 0 else 0.0
