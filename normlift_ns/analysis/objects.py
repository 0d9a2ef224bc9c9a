"""Objects in a selection: connected components, boxes, instances and floaters."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import asdict, dataclass
from itertools import product
from typing import Any, NamedTuple, cast

import numpy as np
import torch
from jaxtyping import Bool, Float, Float64, Int32
from torch import Tensor

from normlift_ns.core.field import SemanticField
from normlift_ns.core.gaussians import MIN_OPACITY, GaussianScene
from normlift_ns.core.lift import Scalars
from normlift_ns.core.neighbors import nearest_neighbors
from normlift_ns.errors import InputError
from normlift_ns.options import FLOATER_THRESHOLD, OBJECT_MAX_GAP, OBJECT_MIN_GAUSSIANS, check_number

__all__ = ["Objects", "SceneObject", "connected_components", "find_objects"]


# Oriented bounding boxes of Gaussian centers that are robust to outliers.


BOX_QUANTILES = (0.01, 0.99)
"""Quantiles of the points along each axis that bound a box."""
_FLAT = 1e-14
"""Ratio of the smallest to the largest variance below which points count as flat."""
_DIRECTIONS = np.array([
    direction for direction in product((-1, 0, 1), repeat=3) if direction > (0, 0, 0)
], dtype=np.float64)  # fmt: skip
"""The 13 directions to the faces, edges and corners of a cube: every direction is within 28 degrees of one of them."""


@dataclass(frozen=True, eq=False)
class OrientedBox:
    """A box with arbitrary orientation.

    >>> box = oriented_box(np.array([[x, y, z] for x in (0, 8) for y in (0, 4) for z in (0, 2)], float))
    >>> box.size.round(2).tolist(), box.center.round(2).tolist(), abs(box.axes).round(2).tolist()[0]
    ([8.0, 4.0, 2.0], [4.0, 2.0, 1.0], [1.0, 0.0, 0.0])
    """

    center: Float64[np.ndarray, " 3"]
    size: Float64[np.ndarray, " 3"]
    """Edge lengths in descending order."""
    axes: Float64[np.ndarray, "3 3"]
    """Unit vectors along these edges, one per row, as a right-handed system."""

    @property
    def corners(self) -> Float64[np.ndarray, "8 3"]:
        """The eight corners. Bits a, b, c of index 4 a + 2 b + c select the far end of axes 0, 1 and 2."""
        signs = np.array(list(product((-0.5, 0.5), repeat=3)))
        return self.center + (signs * self.size) @ self.axes

    def transformed(
        self, rotation: Float64[np.ndarray, "3 3"], scale: float, shift: Float64[np.ndarray, " 3"]
    ) -> OrientedBox:
        """Return the box transformed by p -> scale * rotation @ p + shift."""
        return OrientedBox(scale * rotation @ self.center + shift, scale * self.size, self.axes @ rotation.T)


def oriented_box(points: Float64[np.ndarray, "m 3"]) -> OrientedBox:
    """Return the oriented box of the central points.

    The axes are those of the smallest box (trimesh) around the points between the 1st and the 99th percentile along
    each of 13 directions. A few distant points therefore cannot rotate the box. Along each axis, the box extends from
    the 1st to the 99th percentile of all points.

    Raises:
        ValueError: there are no points, or some are not finite.
    """
    if len(points) == 0 or not np.isfinite(points).all():
        raise InputError(f"a box needs at least one point, all of them finite; got {len(points)} points")
    axes = _axes(points[_central(points)])
    low, high = np.quantile(points @ axes.T, BOX_QUANTILES, axis=0)
    order = np.argsort(low - high, kind="stable")
    axes = axes[order]
    if np.linalg.det(axes) < 0:
        axes[2] *= -1
    low, high = np.quantile(points @ axes.T, BOX_QUANTILES, axis=0)
    return OrientedBox((low + high) / 2 @ axes, high - low, axes)


def _central(points: Float64[np.ndarray, "m 3"]) -> np.ndarray:
    """Return a mask of the points that are not an outlier along any direction; of all points if that leaves none."""
    along = points @ _DIRECTIONS.T
    low, high = np.quantile(along, BOX_QUANTILES, axis=0)
    inside = ((along >= low) & (along <= high)).all(axis=1)
    return inside if inside.any() else np.ones(len(points), bool)


def _axes(points: Float64[np.ndarray, "m 3"]) -> Float64[np.ndarray, "3 3"]:
    """Return the axes of the smallest box around some points, one per row."""
    from scipy.spatial import QhullError  # noqa: PLC0415 (queries do not need it)
    from trimesh.bounds import oriented_bounds  # noqa: PLC0415

    centered = points - points.mean(axis=0)
    variances, principal = np.linalg.eigh(centered.T @ centered)
    if variances[0] > _FLAT * variances[2]:  # a point, line or plane has no 3D hull
        with suppress(QhullError):
            return cast(np.ndarray, oriented_bounds(centered)[0])[:3, :3].copy()
    return principal.T.copy()


# Objects: the connected components of a selection, and a summary of each.


_NEIGHBORS = 8


@dataclass(frozen=True)
class SceneObject:
    """One object, in units of the scene; means are weighted by W_j, the total weight of Gaussian j over all views."""

    size: int
    """Number of Gaussians."""
    centroid: list[float]
    box: dict[str, list[float]]
    """Corners "min" and "max" of the axis-aligned box of the centers."""
    mean_reliability: float


@dataclass(frozen=True)
class Objects:
    """A selection, divided into objects."""

    gaussians: int
    """Number of selected Gaussians."""
    in_smaller_parts: int
    """Number of those in components that are too small to be listed."""
    objects: list[SceneObject]
    """Objects by descending size."""

    def to_json(self) -> dict[str, Any]:
        """Return all fields as plain Python types."""
        return asdict(self)


def find_objects(
    field: SemanticField,
    means: Float[Tensor, "n 3"],
    selected: Bool[Tensor, " n"],
    *,
    max_gap: float = OBJECT_MAX_GAP,
    min_gaussians: int = OBJECT_MIN_GAUSSIANS,
) -> Objects:
    """Divide a selection into objects, its connected components.

    Args:
        max_gap: as in `connected_components`.
        min_gaussians: components with fewer Gaussians are counted but not listed.
    Raises:
        ValueError: `min_gaussians` is less than 1, or as in `connected_components`.
    """
    check_number("min_size", min_gaussians, int)
    labels = connected_components(means, selected, reach=max_gap)
    sizes = torch.bincount(labels[labels >= 0].long())
    count = int((sizes >= min_gaussians).sum())  # sizes are in descending order
    return Objects(
        gaussians=int(selected.sum()),
        in_smaller_parts=int(selected.sum() - sizes[:count].sum()),
        objects=[describe_object(field, means, labels == i) for i in range(count)],
    )


def describe_object(field: SemanticField, means: Tensor, rows: Bool[Tensor, " n"]) -> SceneObject:
    """Summarize some Gaussians as one object."""
    centers = means[rows].double().cpu().numpy()
    weight = field.scalars.weight[rows].double().cpu().numpy() + 1e-12
    reliability = field.scalars.reliability[rows].double().cpu().numpy()
    return SceneObject(
        size=int(rows.sum()),
        centroid=np.average(centers, axis=0, weights=weight).tolist(),
        box={"min": centers.min(axis=0).tolist(), "max": centers.max(axis=0).tolist()},
        mean_reliability=float(np.average(reliability, weights=weight)),
    )


def evidence_weights(scalars: Scalars, rows: Bool[Tensor, " n"]) -> Float64[Tensor, " m"]:
    """Return W_j of some Gaussians as shares of their sum; equal shares if none has evidence."""
    weight = scalars.weight[rows].double() + 1e-12
    return weight / weight.sum()


def connected_components(
    means: Float[Tensor, "n 3"], selected: Bool[Tensor, " n"], *, reach: float = OBJECT_MAX_GAP
) -> Int32[Tensor, " n"]:
    """Label each selected Gaussian with its connected component, 0 for the largest; label the others -1.

    Two selected Gaussians are connected if one is among the 8 nearest selected neighbors of the other, within `reach`
    times the median spacing. The spacing of a selected Gaussian is its distance to the nearest selected one at a
    different position. Components of equal size are ordered by their first Gaussian.

    Args:
        reach: maximum distance in units of the median spacing, > 0.
    Raises:
        ValueError: `reach` is not positive and finite.
    """
    check_number("reach", reach)
    from scipy.sparse import coo_array  # noqa: PLC0415 (a lift does not need it)
    from scipy.sparse.csgraph import connected_components as components_of_graph  # noqa: PLC0415

    labels = torch.full((len(means),), -1, dtype=torch.int32)
    rows = (selected.cpu() & means.cpu().isfinite().all(dim=1)).nonzero().squeeze(1)
    if len(rows) == 0:
        return labels.to(means.device)
    neighbors = nearest_neighbors(means.cpu()[rows], _NEIGHBORS)
    spacing = neighbors.spacing[neighbors.spacing.isfinite()]
    limit = reach * float(spacing.median()) if len(spacing) > 0 else 0.0
    near = ((neighbors.index >= 0) & (neighbors.distance <= limit)).numpy()
    first, slot = np.nonzero(near)
    second = neighbors.index.numpy()[first, slot]
    graph = coo_array((np.ones(len(first), bool), (first, second)), shape=(len(rows), len(rows)))
    count, component = components_of_graph(graph, directed=False)
    size, start = np.bincount(component, minlength=count), np.unique(component, return_index=True)[1]
    rank = np.empty(count, np.int32)
    rank[np.lexsort((start, -size))] = np.arange(count)
    labels[rows] = torch.from_numpy(rank[component])
    return labels.to(means.device)


# Assignment of each Gaussian to at most one class and one object, for exports to other tools.


@dataclass(frozen=True, eq=False)
class Instances:
    """Class and object of every Gaussian: classes are prompts, objects are connected components of a class."""

    texts: tuple[str, ...]
    class_id: Int32[Tensor, " n"]
    """Class, 1 for the first prompt; 0 if no prompt selects the Gaussian."""
    instance_id: Int32[Tensor, " n"]
    """Object, numbered 1, 2, … over all prompts, by descending size within each prompt. 0 for Gaussians without a class
    or in a component that is too small.
    """
    classes: tuple[int, ...]
    """Class of object 1, 2, …"""

    def to_json(self) -> dict[str, Any]:
        """Return the names of all classes and objects by id, as plain Python types."""
        sizes = torch.bincount(self.instance_id.long(), minlength=len(self.classes) + 1).tolist()
        return {
            "none": 0,
            "class_id": {str(number): text for number, text in enumerate(self.texts, 1)},
            "instance_id": {
                str(number): {"class_id": class_id, "text": self.texts[class_id - 1], "gaussians": sizes[number]}
                for number, class_id in enumerate(self.classes, 1)
            },
        }


def best_prompt(relevancy: Float[Tensor, "n q"], selected: Bool[Tensor, "n q"]) -> Int32[Tensor, " n"]:
    """Return the index of the selected prompt with the largest relevancy, or -1 if none is selected.

    Ties go to the first prompt.

    >>> best_prompt(torch.tensor([[0.3, 0.9], [0.1, 0.2]]), torch.tensor([[True, True], [False, False]]))
    tensor([ 1, -1], dtype=torch.int32)
    """
    if relevancy.shape[1] == 0:
        return torch.full((len(relevancy),), -1, dtype=torch.int32, device=relevancy.device)
    best = relevancy.where(selected, -torch.inf).argmax(dim=1)
    return best.where(selected.any(dim=1), -1).int()


def find_instances(
    texts: tuple[str, ...],
    means: Float[Tensor, "n 3"],
    relevancy: Float[Tensor, "n q"],
    selected: Bool[Tensor, "n q"],
    *,
    reach: float = OBJECT_MAX_GAP,
    min_size: int = OBJECT_MIN_GAUSSIANS,
) -> Instances:
    """Assign each selected Gaussian to a class and an object.

    A Gaussian that several prompts select belongs to the prompt with the highest relevancy.

    Args:
        reach, min_size: as in `find_objects`.
    Raises:
        ValueError: as in `find_objects`.

    >>> means = torch.tensor([[0.0, 0, 0], [1, 0, 0], [9, 0, 0], [5, 0, 0]])
    >>> relevancy = torch.tensor([[0.9, 0.8], [0.7, 0.1], [0.6, 0.9], [0.1, 0.2]])
    >>> instances = find_instances(("cup", "box"), means, relevancy, relevancy > 0.5, min_size=1)
    >>> instances.class_id.tolist(), instances.instance_id.tolist(), instances.classes
    ([1, 1, 2, 0], [1, 1, 2, 0], (1, 2))
    """
    check_number("min_size", min_size, int)
    class_id = best_prompt(relevancy, selected) + 1
    instance_id = torch.zeros_like(class_id)
    classes: list[int] = []
    for number in range(1, len(texts) + 1):
        labels = connected_components(means, class_id == number, reach=reach)
        sizes = torch.bincount(labels[labels >= 0].long())
        count = int((sizes >= min_size).sum())  # sizes are in descending order
        listed = (labels >= 0) & (labels < count)
        instance_id = torch.where(listed, labels + 1 + len(classes), instance_id)
        classes += [number] * count
    return Instances(texts, class_id, instance_id, tuple(classes))


def object_tables(field: SemanticField, means: Float[Tensor, "n 3"], instances: Instances) -> list[dict[str, Any]]:
    """Return a summary of each prompt and its objects, as plain Python types."""
    tables = []
    for number, text in enumerate(instances.texts, 1):
        in_class = instances.class_id == number
        ids = [i for i, class_id in enumerate(instances.classes, 1) if class_id == number]
        tables.append({
            "text": text,
            "class_id": number,
            "gaussians": int(in_class.sum()),
            "in_smaller_parts": int((in_class & (instances.instance_id == 0)).sum()),
            "objects": [
                {"instance_id": i, **asdict(describe_object(field, means, instances.instance_id == i))} for i in ids
            ],
        })  # fmt: skip
    return tables


# Detection of floaters: Gaussians in front of the cameras that belong to no surface, left over from training.
#
# The score of a visible Gaussian j is::
#
# log2(d_j / (s_j + s'_j)) + 2 max(0, log2(median ||f|| / ||f_j||)) + (1 - o_j)
#
# where d_j is the distance to its 8th nearest visible neighbor, and s_j is its largest standard deviation. s'_j is
# the median of the largest standard deviations of these 8 neighbors. f_j is its mean feature (equation 3 of the
# paper), and o_j its opacity.
#
# * The first term is high if the neighbors are too far away to touch, counted in doublings; Gaussians on a surface
# overlap their neighbors. * The second term is high if views disagree about Gaussian j more than about the rest of
# the scene. Views see a floater in front of different objects. The term is 0 without evidence. * The third term is
# high for transparent Gaussians.
#
# docs/honest_answers.md reports detection and false-positive rates, and the variants that did not help.


_FLOATER_NEIGHBORS = 8
_DISAGREEMENT_WEIGHT = 2.0


class Floaters(NamedTuple):
    """Floater scores of all Gaussians, and a mask of the likely floaters.

    >>> import torch
    >>> from normlift_ns.core.gaussians import GaussianScene
    >>> from normlift_ns.core.lift import Scalars
    >>> from normlift_ns.analysis.objects import find_floaters
    >>> wall = torch.cartesian_prod(torch.arange(5.0), torch.arange(5.0), torch.zeros(1))
    >>> means = torch.cat([wall, torch.tensor([[2.0, 2.0, 9.0]])])
    >>> scene = GaussianScene(means, torch.ones(26, 4), torch.full((26, 3), 0.6), torch.full((26,), 0.8))
    >>> one = torch.ones(26)
    >>> floaters = find_floaters(scene, Scalars(one, one, one, one, one, one, one.int()))
    >>> floaters.mask.nonzero().tolist(), round(float(floaters.score[25]), 2)
    ([[25]], 3.12)
    """

    score: Float[Tensor, " n"]
    """Higher for more likely floaters; -inf for Gaussians that are never rendered."""
    mask: Bool[Tensor, " n"]
    """True if the score is above the limit."""


def find_floaters(scene: GaussianScene, scalars: Scalars, *, limit: float = FLOATER_THRESHOLD) -> Floaters:
    """Score each Gaussian by how likely it is a floater.

    Args:
        scalars: per-Gaussian numbers from a lift of the scene.
        limit: score above which a Gaussian is a likely floater.
    Raises:
        ValueError: the scalars have a different number of Gaussians, or the limit is not finite.
    """
    limit = check_number("floater_limit", limit)
    if len(scalars.norm) != len(scene):
        raise InputError(f"the lift has {len(scalars.norm):,} Gaussians, but the scene has {len(scene):,}")
    rows = (scene.drawable & (scene.opacities >= MIN_OPACITY)).nonzero().squeeze(1)
    score = torch.full((len(scene),), -torch.inf, device=scene.means.device)
    if len(rows) > 1:
        norm = scalars.norm.to(score)[rows]
        isolation, disagreement = _isolation(scene, rows), _disagreement(norm)
        score[rows] = isolation + _DISAGREEMENT_WEIGHT * disagreement + 1 - scene.opacities[rows].float()
    return Floaters(score, score > limit)


def _isolation(scene: GaussianScene, rows: Tensor) -> Float[Tensor, " m"]:
    """Return the first term, log2(d / (s + s'))."""
    count = min(_FLOATER_NEIGHBORS, len(rows) - 1)
    neighbors = nearest_neighbors(scene.means[rows], count)
    size = scene.scales[rows].float().amax(dim=1)
    neighbor_size = size[neighbors.index.long()].median(dim=1).values  # finite means: no index is -1
    tiny = torch.finfo(torch.float32).tiny
    return (neighbors.distance[:, -1].float().clamp(min=tiny) / (size + neighbor_size).clamp(min=tiny)).log2()


def _disagreement(norm: Float[Tensor, " m"]) -> Float[Tensor, " m"]:
    """Return the second term without its weight, max(0, log2(median ||f|| / ||f||)); 0 without evidence."""
    has_evidence = norm > 0
    if not bool(has_evidence.any()):
        return torch.zeros_like(norm)
    return torch.where(has_evidence, (norm[has_evidence].median() / norm.clamp(min=1e-30)).log2().clamp(min=0), 0.0)
