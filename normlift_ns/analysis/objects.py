"""Objects in a selection: boxes, connected components, instances, catalogs of objects, and floaters."""

from __future__ import annotations

import csv
import json
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass
from functools import reduce
from itertools import product
from pathlib import Path
from typing import Any, NamedTuple, cast

import numpy as np
import torch
from jaxtyping import Bool, Float, Float64, Int32
from torch import Tensor

from normlift_ns.core.arguments import check_arguments
from normlift_ns.core.field import SemanticField
from normlift_ns.core.gaussians import MIN_OPACITY, Camera, GaussianScene
from normlift_ns.core.lift import Scalars
from normlift_ns.core.neighbors import nearest_neighbors
from normlift_ns.core.scene import Scene
from normlift_ns.data.transforms import capture_transforms
from normlift_ns.errors import InputError
from normlift_ns.io.atomic import atomic_files
from normlift_ns.options import CATALOG_FILES, FLOATER_THRESHOLD, OBJECT_MAX_GAP, OBJECT_MIN_GAUSSIANS, check_number
from normlift_ns.rasterization.rasterize import RasterOptions, rasterize_evidence
from normlift_ns.rasterization.settings import RasterSettings

BOX_QUANTILES = (0.01, 0.99)
"""Quantiles of the points along each axis that define the two faces of a box."""
_FLAT = 1e-14
"""Points count as flat if the ratio of their smallest to their largest variance is below this value."""
_DIRECTIONS = np.array([
    direction for direction in product((-1, 0, 1), repeat=3) if direction > (0, 0, 0)
], dtype=np.float64)  # fmt: skip
"""The 13 axes through opposite faces, edges and corners of a cube. Every line is within 28 degrees of one of them."""


@dataclass(frozen=True, eq=False)
class OrientedBox:
    """Box with arbitrary orientation.

    >>> box = oriented_box(np.array([[x, y, z] for x in (0, 8) for y in (0, 4) for z in (0, 2)], float))
    >>> [x.round(decimals=2).tolist() for x in (box.size, box.center, abs(box.axes[0]))]
    [[8.0, 4.0, 2.0], [4.0, 2.0, 1.0], [1.0, 0.0, 0.0]]
    """

    center: Float64[Tensor, " 3"]
    size: Float64[Tensor, " 3"]
    """Edge lengths in descending order."""
    axes: Float64[Tensor, "3 3"]
    """Unit vectors along the edges, one per row, which form a right-handed system."""

    @property
    def corners(self) -> Float64[Tensor, "8 3"]:
        """The eight corners. Bits a, b, c of index 4 a + 2 b + c select the far end of axes 0, 1 and 2."""
        signs = torch.tensor(list(product((-0.5, 0.5), repeat=3)), dtype=torch.float64)
        return self.center + (signs * self.size) @ self.axes

    def transformed(self, by: SimilarityTransform) -> OrientedBox:
        """Return the box after a similarity transform."""
        center = torch.from_numpy(by.transform_points(self.center.numpy()[None])[0])
        return OrientedBox(center, by.scale * self.size, self.axes @ torch.from_numpy(by.rotation).T)


def oriented_box(points: Float64[np.ndarray, "m 3"]) -> OrientedBox:
    """Return an oriented box around the central 98% of the points along each of its axes.

    The axes are those of the smallest box (trimesh) around the points between the 1st and the 99th percentile along
    each of 13 directions. A few distant points therefore cannot rotate the box. Along each axis, the box extends from
    the 1st to the 99th percentile of all points.

    Raises:
        ValueError: `points` is empty or contains numbers that are not finite.
    """
    if len(points) == 0 or not np.isfinite(points).all():
        finite = int(np.isfinite(points).all(axis=1).sum())
        raise InputError(
            f"a box needs at least one point, and all points must be finite; points: {len(points)}, finite: {finite}"
        )
    axes = _axes(points[_central(points)])
    low, high = np.quantile(points @ axes.T, BOX_QUANTILES, axis=0)
    order = np.argsort(low - high, kind="stable")
    axes = axes[order]
    if np.linalg.det(axes) < 0:
        axes[2] *= -1
    low, high = np.quantile(points @ axes.T, BOX_QUANTILES, axis=0)
    return OrientedBox(*map(torch.from_numpy, ((low + high) / 2 @ axes, high - low, axes)))


def _central(points: Float64[np.ndarray, "m 3"]) -> np.ndarray:
    """Return a mask of the points that are not outliers along any direction; if all are outliers, select all points."""
    along = points @ _DIRECTIONS.T
    low, high = np.quantile(along, BOX_QUANTILES, axis=0)
    inside = ((along >= low) & (along <= high)).all(axis=1)
    return inside if inside.any() else np.ones(len(points), bool)


def _axes(points: Float64[np.ndarray, "m 3"]) -> Float64[np.ndarray, "3 3"]:
    """Return the axes of the smallest box around the points, or their principal axes if they are flat, one per row."""
    from scipy.spatial import QhullError  # noqa: PLC0415 (queries do not need it)
    from trimesh.bounds import oriented_bounds  # noqa: PLC0415

    centered = points - points.mean(axis=0)
    variances, principal = np.linalg.eigh(centered.T @ centered)
    if variances[0] > _FLAT * variances[2]:  # a point, line or plane has no 3D hull
        with suppress(QhullError):
            return cast(np.ndarray, oriented_bounds(centered)[0])[:3, :3].copy()
    return principal.T.copy()


# Objects, which are connected components of a selection, and their summaries.


_NEIGHBORS = 8


@dataclass(frozen=True)
class SceneObject:
    """Summary of an object in scene units. Means are weighted by W_j, the total weight of Gaussian j over all views."""

    size: int
    """Number of Gaussians of the object."""
    centroid: list[float]
    box: dict[str, list[float]]
    """Lowest corner "min" and highest corner "max" of the axis-aligned bounding box of the centers, as lists.

    `bounds` contains the same corners as a tensor.
    """
    mean_reliability: float

    @property
    def bounds(self) -> Float64[Tensor, "2 3"]:
        """Lowest and highest corner of the axis-aligned bounding box of the centers."""
        return torch.tensor([self.box["min"], self.box["max"]], dtype=torch.float64)


@dataclass(frozen=True)
class Objects:
    """Objects of a selection."""

    gaussians: int
    """Number of selected Gaussians."""
    in_smaller_parts: int
    """Number of selected Gaussians in components that are too small to be listed."""
    objects: list[SceneObject]
    """Objects by descending size."""


def find_objects(
    field: SemanticField,
    means: Float[Tensor, "n 3"],
    selected: Bool[Tensor, " n"],
    *,
    max_gap: float = OBJECT_MAX_GAP,
    min_gaussians: int = OBJECT_MIN_GAUSSIANS,
) -> Objects:
    """Divide a selection into objects, which are its connected components.

    Args:
        max_gap: As in `connected_components`.
        min_gaussians: Minimum number of Gaussians in an object, >= 1; smaller components are not listed.
    Raises:
        ValueError: `min_gaussians` is less than 1, or `max_gap` is not positive and finite.
    """
    labels, count = _large_components(means, selected, max_gap, min_gaussians)
    return _objects(field, means, selected, labels + 1, range(1, count + 1))


def _objects(field: SemanticField, means: Tensor, selected: Tensor, ids: Tensor, listed: Iterable[int]) -> Objects:
    """Summarize the listed objects; `ids` is the object number of every Gaussian, 0 for none."""
    small = int((selected & (ids == 0)).sum())
    return Objects(int(selected.sum()), small, [describe_object(field, means, ids == i) for i in listed])


def _large_components(means: Tensor, selected: Tensor, max_gap: float, min_gaussians: int) -> tuple[Tensor, int]:
    """Label large connected components; return the labels (-1 for other Gaussians) and the number of labels."""
    check_number("object_min_gaussians", min_gaussians, int)
    labels = connected_components(means, selected, max_gap=max_gap)
    count = int((torch.bincount(labels[labels >= 0].long()) >= min_gaussians).sum())  # sizes are in descending order
    return labels.where(labels < count, -1), count


def describe_object(field: SemanticField, means: Tensor, rows: Bool[Tensor, " n"]) -> SceneObject:
    """Summarize the Gaussians in `rows` as one object."""
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
    """Return W_j of the M Gaussians in `rows`, normalized to a sum of 1; equal weights if none has evidence."""
    weight = scalars.weight[rows].double() + 1e-12
    return weight / weight.sum()


def connected_components(
    means: Float[Tensor, "n 3"], selected: Bool[Tensor, " n"], *, max_gap: float = OBJECT_MAX_GAP
) -> Int32[Tensor, " n"]:
    """Label each selected Gaussian with its connected component, 0 for the largest; label other Gaussians -1.

    Gaussians whose center is not finite count as not selected.

    Two selected Gaussians are connected if one is among the 8 nearest selected neighbors of the other, within `max_gap`
    times the median spacing. The spacing of a selected Gaussian is its distance to the nearest selected one at a
    different position. Components of equal size are ordered by their first Gaussian.

    Args:
        max_gap: Maximum distance in units of the median spacing, > 0.
    Raises:
        ValueError: `max_gap` is not positive and finite.
    """
    check_number("object_max_gap", max_gap)
    from scipy.sparse import coo_array  # noqa: PLC0415 (a lift does not need it)
    from scipy.sparse.csgraph import connected_components as components_of_graph  # noqa: PLC0415

    labels = torch.full((len(means),), -1, dtype=torch.int32)
    rows = (selected.cpu() & means.cpu().isfinite().all(dim=1)).nonzero().squeeze(1)
    if len(rows) == 0:
        return labels.to(means.device)
    neighbors = nearest_neighbors(means.cpu()[rows], _NEIGHBORS)
    spacing = neighbors.spacing[neighbors.spacing.isfinite()]
    limit = max_gap * float(spacing.median()) if len(spacing) > 0 else 0.0
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


@dataclass(frozen=True, eq=False)
class Instances:
    """Class and object of every Gaussian.

    Classes are prompts, and objects are connected components of the Gaussians that a prompt selects.
    """

    texts: tuple[str, ...]
    class_id: Int32[Tensor, " n"]
    """Class of each Gaussian, 1 for the first prompt; 0 if no prompt selects the Gaussian."""
    instance_id: Int32[Tensor, " n"]
    """Object of each Gaussian, numbered 1, 2, … over all prompts, by descending size within each prompt. It is 0 for
    Gaussians without a class or in a component that is too small. The objects of a prompt are the components of its own
    selection, so further prompts do not change existing numbers.
    """
    classes: tuple[int, ...]
    """Class of each object, starting with object 1. An object has no Gaussians if all Gaussians of its
    component belong to other prompts."""

    def to_json(self) -> dict[str, Any]:
        """Return the prompt of each class, and the class, prompt and size of each object, as plain Python types.

        `class_id` and `instance_id` map each id to its prompt or object. `none` is the id of Gaussians without a class
        or an object.
        """
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
    """Return, for every Gaussian, the index of the most relevant prompt among those that select it; -1 if none does.

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
    max_gap: float = OBJECT_MAX_GAP,
    min_gaussians: int = OBJECT_MIN_GAUSSIANS,
) -> Instances:
    """Assign each selected Gaussian to a class and an object.

    A Gaussian that several prompts select belongs to the prompt with the highest relevancy, and to the object of this
    prompt that contains it.

    Args:
        texts: Prompts.
        max_gap, min_gaussians: As in `find_objects`.
    Raises:
        ValueError: As in `find_objects`.

    >>> means = torch.tensor([[0.0, 0, 0], [1, 0, 0], [9, 0, 0], [5, 0, 0]])
    >>> relevancy = torch.tensor([[0.9, 0.8], [0.7, 0.1], [0.6, 0.9], [0.1, 0.2]])
    >>> instances = find_instances(("cup", "box"), means, relevancy, relevancy > 0.5, min_gaussians=1)
    >>> instances.class_id.tolist(), instances.instance_id.tolist(), instances.classes
    ([1, 1, 2, 0], [1, 1, 3, 0], (1, 1, 2))
    """
    class_id = best_prompt(relevancy, selected) + 1
    instance_id = torch.zeros_like(class_id)
    classes: list[int] = []
    for number in range(1, len(texts) + 1):
        labels, count = _large_components(means, selected[:, number - 1], max_gap, min_gaussians)
        instance_id = torch.where((labels >= 0) & (class_id == number), labels + 1 + len(classes), instance_id)
        classes += [number] * count
    return Instances(texts, class_id, instance_id, tuple(classes))


def object_tables(field: SemanticField, means: Float[Tensor, "n 3"], instances: Instances) -> list[dict[str, Any]]:
    """Return a summary of each prompt and of its objects that have Gaussians, as plain Python types."""
    tables, sizes = [], torch.bincount(instances.instance_id.long(), minlength=len(instances.classes) + 1)
    for number, text in enumerate(instances.texts, 1):
        in_class = instances.class_id == number
        ids = [i for i, class_id in enumerate(instances.classes, 1) if class_id == number and sizes[i] > 0]
        found = asdict(_objects(field, means, in_class, instances.instance_id, ids))
        objects = [{"instance_id": i, **row} for i, row in zip(ids, found["objects"])]
        tables.append({"text": text, "class_id": number, **found, "objects": objects})
    return tables


MIN_VIEW_SHARE = 0.1
"""Minimum area of an object in an image that shows it, as a fraction of its largest area in any image."""
MIN_WHOLE_FRACTION = 0.95
"""Minimum fraction of an object's Gaussians inside the frame of an image that counts as showing the whole object.

It is relative to the largest such fraction over the images that show the object.
"""
MAX_BEST_VIEWS = 3
_RENDER_SIZE = 256
"""Longer side, in pixels, of the renders that measure how much of each image an object covers."""


@dataclass(frozen=True, eq=False)
class SimilarityTransform:
    """Similarity transform p -> scale * rotation @ p + shift."""

    rotation: Float64[np.ndarray, "3 3"]
    scale: float
    shift: Float64[np.ndarray, " 3"]

    @classmethod
    def inverse_of(cls, transform: Float64[np.ndarray, "3 4"], scale: float) -> SimilarityTransform:
        """Return the inverse of p -> scale * transform @ (p, 1)."""
        rotation = transform[:, :3].T
        return cls(rotation, 1 / scale, -rotation @ transform[:, 3])

    def compose(self, other: SimilarityTransform) -> SimilarityTransform:
        """Return the composition that applies this transform first and `other` second."""
        shift = other.transform_points(self.shift[None])[0]
        return SimilarityTransform(other.rotation @ self.rotation, other.scale * self.scale, shift)

    def transform_points(self, points: Float64[np.ndarray, "m 3"]) -> Float64[np.ndarray, "m 3"]:
        """Transform points [M, 3]."""
        return self.scale * points @ self.rotation.T + self.shift


@dataclass(frozen=True, eq=False)
class Placement:
    """Position and size of an object in one coordinate system."""

    centroid: Float64[Tensor, " 3"]
    """Mean of the Gaussian centers, weighted by W_j, the total weight of Gaussian j over all views."""
    extent: Float64[Tensor, " 3"]
    """Distance from the 1st to the 99th percentile of the centers along x, y and z."""
    box: OrientedBox


@dataclass(frozen=True, eq=False)
class CatalogueObject:
    """One object of a catalog; docs/objects.md explains every value."""

    id: int
    """Number of the object, which is its instance_id in exports."""
    text: str
    class_id: int
    gaussians: int
    reliability: float
    """Mean R of the object's Gaussians, weighted by their total weight over all views, in 0..1."""
    views: int
    """Number of training images that show the object."""
    best_views: tuple[str, ...]
    """Names of up to three images that show the object. Images of the whole object come before images of a part of it.
    Both groups are sorted by the fraction of the image that the object covers, largest first."""
    capture: Placement
    """Position and size in the coordinates of the capture."""
    scene: Placement
    """Position and size in the coordinates of the Gaussians, which viewers use."""


@dataclass(frozen=True, eq=False)
class Catalogue:
    """Catalog of objects in the order of their numbers."""

    objects: tuple[CatalogueObject, ...]
    num_in_small_components: int
    """Number of selected Gaussians in components that are too small to be listed."""
    meters_per_unit: float | None
    """Meters per unit of the capture; None if unknown. If known, `capture` positions and sizes are in meters."""
    view_shares: Float[Tensor, "m v"]
    """Fraction of each of V training images that each of M objects covers, on the CPU; see `view_shares`."""

    @property
    def unit(self) -> str:
        """Unit of the `capture` positions and sizes."""
        return "capture unit" if self.meters_per_unit is None else "metre"

    def to_json(self) -> dict[str, Any]:
        """Return all values except `view_shares` as plain Python types."""
        return {
            "unit": self.unit,
            "metres_per_unit": self.meters_per_unit,
            "in_smaller_parts": self.num_in_small_components,
            "objects": [asdict(item, dict_factory=_plain) for item in self.objects],
        }


def similarity_to_capture(run_dir: Path, identity: Mapping[str, Any]) -> SimilarityTransform:
    """Return the transform from the coordinates of the Gaussians of a lifted run to those of the capture.

    Args:
        run_dir, identity: As in `capture_transforms`.
    Raises:
        ValueError, FileNotFoundError: As in `capture_transforms`.
    """
    worlds = capture_transforms(run_dir, identity)
    inverses = (SimilarityTransform.inverse_of(world.transform, world.scale) for world in reversed(worlds))
    return reduce(SimilarityTransform.compose, inverses)


def make_catalogue(
    scene: Scene,
    field: SemanticField,
    instances: Instances,
    capture: SimilarityTransform,
    *,
    meters_per_unit: float | None = None,
    device: str = "cpu",
) -> Catalogue:
    """Make a catalog of objects.

    Args:
        instances: Objects to list.
        capture: Transform from the coordinates of the scene to those of the capture.
        meters_per_unit: Length of a capture unit in meters, > 0; None if unknown.
        device: Device for the renders that rank images.
    """
    unit = 1.0 if meters_per_unit is None else meters_per_unit
    to_capture = SimilarityTransform(capture.rotation, unit * capture.scale, unit * capture.shift)
    means, ids = scene.gaussians.means.double().cpu().numpy(), instances.instance_id.cpu().numpy()
    weight, reliability = (x.double().cpu().numpy() for x in (field.scalars.weight + 1e-12, field.scalars.reliability))
    count, names, cameras = len(instances.classes), scene.train.names, scene.train.cameras
    shares = view_shares(scene, instances, RasterSettings.recorded(field.manifest), device).cpu()
    objects = []
    for number in range(1, count + 1):
        rows = np.flatnonzero(ids == number)
        if len(rows) == 0:
            continue
        share = shares[number - 1].numpy()
        shows = (share > 0) & (share >= MIN_VIEW_SHARE * share.max(initial=0))
        inside = _inside(means[rows], cameras)
        whole = shows & (inside >= MIN_WHOLE_FRACTION * inside[shows].max(initial=0))
        order, num_views = np.lexsort((-share, ~whole, ~shows)), int(shows.sum())
        scene_place = _place(means[rows], weight[rows])
        points = to_capture.transform_points(means[rows])
        box = scene_place.box.transformed(to_capture)
        objects.append(
            CatalogueObject(
                id=number,
                text=instances.texts[instances.classes[number - 1] - 1],
                class_id=instances.classes[number - 1],
                gaussians=len(rows),
                reliability=float(np.average(reliability[rows], weights=weight[rows])),
                views=num_views,
                best_views=tuple(str(names[i]) for i in order[: min(MAX_BEST_VIEWS, num_views)]),
                capture=_place(points, weight[rows], box),
                scene=scene_place,
            )
        )
    small = int(((instances.class_id > 0) & (instances.instance_id == 0)).sum())
    return Catalogue(tuple(objects), small, meters_per_unit, shares)


def view_shares(scene: Scene, instances: Instances, settings: RasterSettings, device: str) -> Float[Tensor, "m v"]:
    """Return the fraction of each of V images that each of M objects covers after occlusion, in 0..1.

    The fraction is the compositing weight of the object's Gaussians, averaged over the pixels of the image.
    """
    count = len(instances.classes)
    if count == 0:
        return torch.zeros(count, len(scene.train))
    small = [camera.downscaled(_RENDER_SIZE / max(camera.width, camera.height)) for camera in scene.train.cameras]
    maps = [torch.zeros(camera.height, camera.width, dtype=torch.int32) for camera in small]
    kwargs = RasterOptions(rasterize_mode=scene.rasterize_mode, settings=settings)
    rows = rasterize_evidence(scene.gaussians.to(device), small, maps, num_regions=[1] * len(small), **kwargs).rows
    ids = instances.instance_id.to(rows.weight.device).long()[rows.row_index()]
    flat = torch.zeros((count + 1) * len(small), dtype=torch.float64, device=rows.weight.device)
    flat.index_add_(0, ids * len(small) + rows.column.long(), rows.weight.double())
    pixels = flat.new_tensor([camera.width * camera.height for camera in small])
    return (flat.view(count + 1, len(small))[1:] / pixels).float()


def _inside(points: np.ndarray, cameras: Sequence[Camera]) -> np.ndarray:
    """Return the fraction of the points inside the frame of each camera, [views]."""
    fractions = []
    for camera in cameras:
        world_to_camera, K = camera.world_to_camera.double().cpu().numpy(), camera.K.double().cpu().numpy()
        pixels = (points @ world_to_camera[:3, :3].T + world_to_camera[:3, 3]) @ K.T
        depth = np.where(pixels[:, 2] > 0, pixels[:, 2], np.nan)[:, None]  # NaN: points behind the camera are outside
        pixels = pixels[:, :2] / depth
        fractions.append(((pixels >= 0) & (pixels <= (camera.width, camera.height))).all(axis=1).mean())
    return np.array(fractions)


def _place(points: np.ndarray, weight: np.ndarray, box: OrientedBox | None = None) -> Placement:
    low, high = np.quantile(points, BOX_QUANTILES, axis=0)
    centroid = np.average(points, axis=0, weights=weight)
    return Placement(torch.from_numpy(centroid), torch.from_numpy(high - low), box or oriented_box(points))


_FACES = ((0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3))
"""Corner indices of each face of a box, counterclockwise from outside."""
_GOLDEN_RATIO = 0.618033988749895


def write_catalogue(
    catalog: Catalogue, folder: Path, *, question: Mapping[str, Any] | None = None, overwrite: bool = False
) -> tuple[Path, ...]:
    """Write all files of a catalog, or none if an error occurs, and return their paths.

    The files are objects.json, objects.csv, objects.ply (boxes in the coordinates of the capture) and
    objects_scene.ply (boxes in the coordinates of the Gaussians). docs/objects.md explains them.

    Args:
        question: Query that found the objects, as JSON types; it is written to objects.json.
        overwrite: Replace existing files.
    Raises:
        FileExistsError: A file exists, and `overwrite` is False.
        OSError: A file cannot be written.
    """
    files = tuple(folder / name for name in CATALOG_FILES)
    document = {**catalog.to_json(), **(question or {})}
    with atomic_files(*files, overwrite=overwrite) as drafts:
        drafts[0].write_text(json.dumps(document, indent=2, allow_nan=False) + "\n", "utf8")
        with drafts[1].open("w", newline="", encoding="utf8") as file:
            table = csv.writer(file)
            table.writerow(csv_columns())
            table.writerows(csv_rows(catalog))
        write_box_mesh(drafts[2], catalog.objects, [item.capture.box for item in catalog.objects])
        write_box_mesh(drafts[3], catalog.objects, [item.scene.box for item in catalog.objects])
    return files


def _plain(items: Iterable[tuple[str, Any]]) -> dict[str, Any]:
    return {key: x.tolist() if isinstance(x, Tensor) else list(x) if isinstance(x, tuple) else x for key, x in items}


def csv_columns() -> list[str]:
    """Return the column names of the CSV table.

    >>> csv_columns()[:10]
    ['id', 'text', 'class_id', 'gaussians', 'reliability', 'views', 'best_view_1', 'best_view_2', 'best_view_3', 'x']
    """
    places = [f"{prefix}{name}" for prefix in ("", "scene_") for name in _PLACE_COLUMNS]
    best = (f"best_view_{i}" for i in range(1, MAX_BEST_VIEWS + 1))
    return ["id", "text", "class_id", "gaussians", "reliability", "views", *best, *places]


_PLACE_COLUMNS = (
    *"xyz",
    *(f"extent_{axis}" for axis in "xyz"),
    *(f"box_{axis}" for axis in "xyz"),
    *(f"box_size_{i}" for i in (1, 2, 3)),
    *(f"box_axis_{i}_{axis}" for i in (1, 2, 3) for axis in "xyz"),
)


def csv_rows(catalog: Catalogue) -> Iterator[list[Any]]:
    """Yield the rows of the CSV table."""
    for item in catalog.objects:
        best = [*item.best_views, *[""] * (MAX_BEST_VIEWS - len(item.best_views))]
        places = [(x.centroid, x.extent, x.box.center, x.box.size, *x.box.axes) for x in (item.capture, item.scene)]
        numbers = [number for place in places for vector in place for number in vector.tolist()]
        names = [csv_text(item.text), *map(csv_text, best)]
        yield [item.id, names[0], item.class_id, item.gaussians, item.reliability, item.views, *names[1:], *numbers]


def csv_text(text: str) -> str:
    """Escape a text for a CSV cell, so that spreadsheet programs do not interpret it as a formula.

    >>> csv_text("=1+1"), csv_text("red mug")
    ("'=1+1", 'red mug')
    """
    return f"'{text}" if text.lstrip()[:1] in tuple("=+-@|") or text[:1] in tuple("\t\r\n") else text


def write_box_mesh(path: Path, objects: Sequence[CatalogueObject], boxes: Iterable[OrientedBox]) -> None:
    """Write a PLY mesh with eight corners and six faces per box. Each corner has the ids and color of its object."""
    from plyfile import PlyData, PlyElement  # noqa: PLC0415 (--help does not need it)

    dtype = [*((axis, "<f4") for axis in "xyz"), *((name, "u1") for name in ("red", "green", "blue"))]
    dtype += [("class_id", "<u4"), ("instance_id", "<u4")]
    corners = np.zeros(8 * len(objects), dtype)
    for item, box, block in zip(objects, boxes, corners.reshape(len(objects), 8)):
        block["x"], block["y"], block["z"] = box.corners.T.numpy()
        block["red"], block["green"], block["blue"] = object_color(item.id)
        block["class_id"], block["instance_id"] = item.class_id, item.id
    faces = np.empty(6 * len(objects), [("vertex_indices", "<i4", (4,))])
    faces["vertex_indices"] = (8 * np.arange(len(objects))[:, None, None] + np.array(_FACES)).reshape(-1, 4)
    elements = [PlyElement.describe(corners, "vertex"), PlyElement.describe(faces, "face")]
    with path.open("wb") as file:
        PlyData(elements, byte_order="<", comments=["Boxes of objects, written by normlift_ns"]).write(file)


def object_color(number: int) -> tuple[int, int, int]:
    """Return an RGB color in 0..255 for an object number; consecutive numbers get different hues."""
    angle = 2 * np.pi * _GOLDEN_RATIO * number
    red, green, blue = (round(150 + 100 * float(np.cos(angle - shift))) for shift in (0, 2.094, 4.189))
    return red, green, blue


# Detection of floaters: Gaussians in front of the cameras that remain from training and are not part of a surface.
#
# The score of a visible Gaussian j is::
#
# log2(d_j / (s_j + s'_j)) + 2 max(0, log2(median ||f|| / ||f_j||)) + (1 - o_j)
#
# Here, d_j is the distance to its 8th nearest visible neighbor, and s_j is its largest standard deviation. s'_j is the
# median of the largest standard deviations of these 8 neighbors. f_j is its mean feature (equation 3 of the paper), and
# o_j is its opacity.
#
# * The first term is high if the neighbors are too far away to touch. Gaussians on a surface overlap their neighbors.
# * The second term is high if the views disagree more about Gaussian j than about the rest of the scene, because a
#   floater is in front of different objects in different views. The term is 0 without evidence.
# * The third term is high for transparent Gaussians.
#
# docs/honest_answers.md reports detection rates, false-positive rates and unsuccessful variants.


_FLOATER_NEIGHBORS = 8
_DISAGREEMENT_WEIGHT = 2.0


@check_arguments
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
    """Score, higher for more likely floaters; -inf for Gaussians that the renderer never draws."""
    mask: Bool[Tensor, " n"]
    """True if the score is above the limit."""


def find_floaters(scene: GaussianScene, scalars: Scalars, *, limit: float = FLOATER_THRESHOLD) -> Floaters:
    """Score the Gaussians of a scene, with a higher score for more likely floaters.

    Args:
        scalars: Scalars of the Gaussians from a lift of the scene.
        limit: Score above which a Gaussian is a likely floater.
    Raises:
        ValueError: The scalars have a different number of Gaussians, or the limit is not finite.
    """
    limit = check_number("floater_threshold", limit)
    if len(scalars.norm) != len(scene):
        raise InputError(f"scalars are for {len(scalars.norm):,} Gaussians, but the scene has {len(scene):,}")
    rows = (scene.drawable & (scene.opacities >= MIN_OPACITY)).nonzero().squeeze(1)
    score = torch.full((len(scene),), -torch.inf, device=scene.means.device)
    if len(rows) > 1:
        norm = scalars.norm.to(score)[rows]
        isolation, disagreement = _isolation(scene, rows), _disagreement(norm)
        score[rows] = isolation + _DISAGREEMENT_WEIGHT * disagreement + 1 - scene.opacities[rows].float()
    return Floaters(score, score > limit)


def _isolation(scene: GaussianScene, rows: Tensor) -> Float[Tensor, " m"]:
    """Return the first term of the score, log2(d / (s + s')).

    Here, d is the distance to the eighth nearest neighbor in `rows`, and s is the largest scale of the Gaussian. s' is
    the median of the largest scales of the eight neighbors.
    """
    count = min(_FLOATER_NEIGHBORS, len(rows) - 1)
    neighbors = nearest_neighbors(scene.means[rows], count)
    size = scene.scales[rows].float().amax(dim=1)
    neighbor_size = size[neighbors.index.long()].median(dim=1).values  # finite means: no index is -1
    tiny = torch.finfo(torch.float32).tiny
    return (neighbors.distance[:, -1].float().clamp(min=tiny) / (size + neighbor_size).clamp(min=tiny)).log2()


def _disagreement(norm: Float[Tensor, " m"]) -> Float[Tensor, " m"]:
    """Return the second term without its factor, max(0, log2(median ||f|| / ||f||)); 0 without evidence."""
    has_evidence = norm > 0
    if not bool(has_evidence.any()):
        return torch.zeros_like(norm)
    return torch.where(has_evidence, (norm[has_evidence].median() / norm.clamp(min=1e-30)).log2().clamp(min=0), 0.0)
