"""Catalogue of objects: position, size and reliability of each, and the images that show it."""

from __future__ import annotations

import csv
import json
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Float64
from torch import Tensor

from normlift_ns.analysis.objects import BOX_QUANTILES, Instances, OrientedBox, oriented_box
from normlift_ns.core.field import SemanticField
from normlift_ns.core.gaussians import Camera, GaussianScene
from normlift_ns.core.scene import Scene
from normlift_ns.io.atomic import atomic_files
from normlift_ns.options import CATALOG_FILES
from normlift_ns.rasterization.rasterize import rasterize_evidence
from normlift_ns.rasterization.settings import RasterSettings

MIN_VIEW_SHARE = 0.1
"""An image shows an object if the object's share of the image is at least this times its largest share of any image."""
MIN_WHOLE_FRACTION = 0.95
"""An image shows the whole object if the fraction of the object inside its frame is at least this times the largest
such fraction.
"""
MAX_BEST_VIEWS = 3
_RENDER_SIZE = 256
"""Longer side, in pixels, of the renders that rank images by object; more resolution does not change the order."""


@dataclass(frozen=True, eq=False)
class SimilarityTransform:
    """Similarity transform p -> scale * rotation @ p + shift."""

    rotation: Float64[np.ndarray, "3 3"]
    scale: float
    shift: Float64[np.ndarray, " 3"]

    @classmethod
    def inverse_of(cls, transform: Float64[np.ndarray, "3 4"], scale: float) -> SimilarityTransform:
        """Return the inverse of p -> scale * (transform @ p)."""
        rotation = transform[:, :3].T
        return cls(rotation, 1 / scale, -rotation @ transform[:, 3])

    @classmethod
    def identity(cls) -> SimilarityTransform:
        """Return the identity transform."""
        return cls(np.eye(3), 1.0, np.zeros(3))

    def compose(self, other: SimilarityTransform) -> SimilarityTransform:
        """Return the composition that applies this transform first and `other` second."""
        shift = other.transform_points(self.shift[None])[0]
        return SimilarityTransform(other.rotation @ self.rotation, other.scale * self.scale, shift)

    def scaled(self, factor: float) -> SimilarityTransform:
        """Return this transform followed by scaling with `factor`."""
        return SimilarityTransform(self.rotation, factor * self.scale, factor * self.shift)

    def transform_points(self, points: Float64[np.ndarray, "m 3"]) -> Float64[np.ndarray, "m 3"]:
        """Transform points [M, 3]."""
        return self.scale * points @ self.rotation.T + self.shift


@dataclass(frozen=True, eq=False)
class Placement:
    """Position and size of an object in one coordinate system."""

    centroid: Float64[np.ndarray, " 3"]
    """Mean of the Gaussian centers, weighted by W_j, the total weight of Gaussian j over all views."""
    extent: Float64[np.ndarray, " 3"]
    """Distance from the 1st to the 99th percentile of the centers along x, y and z."""
    box: OrientedBox


@dataclass(frozen=True, eq=False)
class CatalogueObject:
    """One object; docs/objects.md explains every number."""

    id: int
    """The instance_id of exports."""
    text: str
    class_id: int
    gaussians: int
    reliability: float
    """Mean of R, weighted by W_j, in 0..1."""
    views: int
    """Number of training images that show the object."""
    best_views: tuple[str, ...]
    """Names of at most three images, those with the whole object first, then by the share of the image it covers."""
    capture: Placement
    """Position in the coordinates of the capture."""
    scene: Placement
    """Position in the coordinates of the Gaussians, which nerfstudio and exported files use."""


@dataclass(frozen=True, eq=False)
class Catalogue:
    """Objects by prompt, and by descending size within each prompt."""

    objects: tuple[CatalogueObject, ...]
    num_in_small_components: int
    """Number of selected Gaussians in components that are too small to be listed."""
    meters_per_unit: float | None
    """Meters per unit of the capture. If it is given, `capture` positions are in meters, otherwise in capture units."""

    @property
    def unit(self) -> str:
        """Unit of the `capture` positions."""
        return "capture unit" if self.meters_per_unit is None else "metre"


def make_catalogue(
    scene: Scene,
    field: SemanticField,
    instances: Instances,
    capture: SimilarityTransform,
    *,
    metres_per_unit: float | None = None,
    device: str = "cpu",
) -> Catalogue:
    """Summarize every object in a catalogue.

    Args:
        capture: transform from the coordinates of the scene to those of the capture.
        metres_per_unit: length of a capture unit in meters, > 0; None if unknown.
        device: device that renders the objects, to rank images.
    """
    to_capture = capture if metres_per_unit is None else capture.scaled(metres_per_unit)
    means, ids = scene.gaussians.means.double().cpu().numpy(), instances.instance_id.cpu().numpy()
    weight, reliability = (x.double().cpu().numpy() for x in (field.scalars.weight + 1e-12, field.scalars.reliability))
    count, names, cameras = len(instances.classes), scene.train.names, scene.train.cameras
    settings = RasterSettings.recorded(field.manifest)
    gaussians, mode = scene.gaussians.to(device), scene.rasterize_mode
    shares = view_shares(gaussians, cameras, instances, rasterize_mode=mode, settings=settings).cpu().numpy()
    objects = []
    for number in range(1, count + 1):
        rows = np.flatnonzero(ids == number)
        share = shares[number - 1]
        shows = (share > 0) & (share >= MIN_VIEW_SHARE * share.max(initial=0))
        inside = _inside(means[rows], cameras)
        whole = shows & (inside >= MIN_WHOLE_FRACTION * inside[shows].max(initial=0))
        order, num_views = np.lexsort((-share, ~whole, ~shows)), int(shows.sum())
        scene_place = _place(means[rows], weight[rows])
        points = to_capture.transform_points(means[rows])
        box = scene_place.box.transformed(to_capture.rotation, to_capture.scale, to_capture.shift)
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
    return Catalogue(tuple(objects), small, metres_per_unit)


def view_shares(
    gaussians: GaussianScene,
    cameras: Sequence[Camera],
    instances: Instances,
    *,
    rasterize_mode: str = "classic",
    settings: RasterSettings | None = None,
) -> Float[Tensor, "m v"]:
    """Return the share of each image that each object covers, with occlusion.

    The share is the compositing weight of the object's Gaussians, averaged over the pixels of the image.
    """
    count = len(instances.classes)
    if count == 0:
        return torch.zeros(count, len(cameras))
    small = [_downscaled(camera) for camera in cameras]
    maps = [torch.zeros(camera.height, camera.width, dtype=torch.int32) for camera in small]
    options = {"rasterize_mode": rasterize_mode, "settings": settings, "num_regions": [1] * len(small)}
    rows = rasterize_evidence(gaussians, small, maps, **options).rows  # pyright: ignore[reportArgumentType]
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


def _downscaled(camera: Camera) -> Camera:
    factor = min(1.0, _RENDER_SIZE / max(camera.width, camera.height))
    width, height = (max(1, round(side * factor)) for side in (camera.width, camera.height))
    scale = torch.tensor([[width / camera.width], [height / camera.height], [1.0]], dtype=camera.K.dtype)
    return Camera(camera.K * scale, camera.world_to_camera, width, height)


def _place(points: np.ndarray, weight: np.ndarray, box: OrientedBox | None = None) -> Placement:
    low, high = np.quantile(points, BOX_QUANTILES, axis=0)
    return Placement(np.average(points, axis=0, weights=weight), high - low, box or oriented_box(points))


# Export of a catalogue as JSON, as a CSV table, and as box meshes for mesh viewers.


_FACES = ((0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3))
"""Corner indices of each face of a box, counterclockwise as seen from outside."""
_GOLDEN_RATIO = 0.618033988749895


def write_catalogue(
    catalogue: Catalogue, folder: Path, *, question: Mapping[str, Any] | None = None, overwrite: bool = False
) -> tuple[Path, ...]:
    """Write the files of a catalogue, all or none, and return their paths.

    The files are objects.json, objects.csv, objects.ply (boxes in the coordinates of the capture) and
    objects_scene.ply (boxes in the coordinates of the Gaussians). docs/objects.md explains them.

    Args:
        question: the query that found the objects, for objects.json.
    Raises:
        FileExistsError: a file exists, and `overwrite` is False.
        OSError: a file cannot be written.
    """
    files = tuple(folder / name for name in CATALOG_FILES)
    document = {**catalogue_to_json(catalogue), **(question or {})}
    with atomic_files(*files, overwrite=overwrite) as drafts:
        drafts[0].write_text(json.dumps(document, indent=2, allow_nan=False) + "\n", "utf8")
        with drafts[1].open("w", newline="", encoding="utf8") as file:
            table = csv.writer(file)
            table.writerow(csv_columns())
            table.writerows(row.values() for row in csv_rows(catalogue))
        write_box_mesh(drafts[2], catalogue.objects, [item.capture.box for item in catalogue.objects])
        write_box_mesh(drafts[3], catalogue.objects, [item.scene.box for item in catalogue.objects])
    return files


def catalogue_to_json(catalogue: Catalogue) -> dict[str, Any]:
    """Return a catalogue as plain Python types."""
    return {
        "unit": catalogue.unit,
        "metres_per_unit": catalogue.meters_per_unit,
        "in_smaller_parts": catalogue.num_in_small_components,
        "objects": [
            {
                "id": item.id,
                "text": item.text,
                "class_id": item.class_id,
                "gaussians": item.gaussians,
                "reliability": item.reliability,
                "views": item.views,
                "best_views": list(item.best_views),
                "capture": _place_json(item.capture),
                "scene": _place_json(item.scene),
            }
            for item in catalogue.objects
        ],
    }


def _place_json(place: Placement) -> dict[str, Any]:
    box = place.box
    return {
        "centroid": place.centroid.tolist(),
        "extent": place.extent.tolist(),
        "box": {"center": box.center.tolist(), "size": box.size.tolist(), "axes": box.axes.tolist()},
    }


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


def csv_rows(catalogue: Catalogue) -> Iterator[dict[str, Any]]:
    """Yield the rows of the CSV table as dicts by column name."""
    for item in catalogue.objects:
        best = [*item.best_views, *[""] * (MAX_BEST_VIEWS - len(item.best_views))]
        numbers = (number for place in (item.capture, item.scene) for number in _numbers(place))
        summary = (item.id, item.text, item.class_id, item.gaussians, item.reliability, item.views)
        yield dict(zip(csv_columns(), (*summary, *best, *numbers)))


def _numbers(place: Placement) -> list[float]:
    box = place.box
    return np.concatenate([place.centroid, place.extent, box.center, box.size, box.axes.ravel()]).tolist()


def write_box_mesh(path: Path, objects: Sequence[CatalogueObject], boxes: Iterable[OrientedBox]) -> None:
    """Write a PLY mesh with eight corners and six faces per box; each corner has the ids and color of its object."""
    from plyfile import PlyData, PlyElement  # noqa: PLC0415 (--help does not need it)

    dtype = [*((axis, "<f4") for axis in "xyz"), *((name, "u1") for name in ("red", "green", "blue"))]
    dtype += [("class_id", "<u4"), ("instance_id", "<u4")]
    corners = np.zeros(8 * len(objects), dtype)
    for i, (item, box) in enumerate(zip(objects, boxes)):
        block = slice(8 * i, 8 * i + 8)
        for k, axis in enumerate("xyz"):
            corners[axis][block] = box.corners[:, k]
        corners["red"][block], corners["green"][block], corners["blue"][block] = _color(item.id)
        corners["class_id"][block], corners["instance_id"][block] = item.class_id, item.id
    faces = np.empty(6 * len(objects), [("vertex_indices", "<i4", (4,))])
    faces["vertex_indices"] = (8 * np.arange(len(objects))[:, None, None] + np.array(_FACES)).reshape(-1, 4)
    elements = [PlyElement.describe(corners, "vertex"), PlyElement.describe(faces, "face")]
    with path.open("wb") as file:
        PlyData(elements, byte_order="<", comments=["Boxes of objects, written by normlift_ns"]).write(file)


def _color(number: int) -> tuple[int, int, int]:
    """Return an RGB color in 0..255 that differs from object to object."""
    angle = 2 * np.pi * _GOLDEN_RATIO * number
    red, green, blue = (round(150 + 100 * float(np.cos(angle - shift))) for shift in (0, 2.094, 4.189))
    return red, green, blue
