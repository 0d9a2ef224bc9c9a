"""Catalogue of objects: position, size and reliability of each, and the images that show it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Float64
from torch import Tensor

from normlift_ns.core.field import SemanticField
from normlift_ns.core.gaussians import Camera, GaussianScene
from normlift_ns.core.scene import Scene
from normlift_ns.objects.boxes import CENTRAL, OrientedBox, oriented_box
from normlift_ns.objects.instances import Instances
from normlift_ns.raster.rasterize import rasterize_evidence
from normlift_ns.raster.settings import RasterSettings

SEEN = 0.1
"""An image shows an object if the object's share of the image is at least this times its largest share of any image."""
WHOLE = 0.95
"""An image shows the whole object if the fraction of the object inside its frame is at least this times the largest
such fraction.
"""
BEST = 3
_RENDER_SIZE = 256
"""Longer side, in pixels, of the renders that rank images by object; more resolution does not change the order."""


@dataclass(frozen=True, eq=False)
class Similarity:
    """Similarity transform p -> scale * rotation @ p + shift."""

    rotation: Float64[np.ndarray, "3 3"]
    scale: float
    shift: Float64[np.ndarray, " 3"]

    @classmethod
    def undoing(cls, transform: Float64[np.ndarray, "3 4"], scale: float) -> Similarity:
        """Return the inverse of p -> scale * (transform @ p)."""
        rotation = transform[:, :3].T
        return cls(rotation, 1 / scale, -rotation @ transform[:, 3])

    @classmethod
    def identity(cls) -> Similarity:
        """Return the identity transform."""
        return cls(np.eye(3), 1.0, np.zeros(3))

    def then(self, other: Similarity) -> Similarity:
        """Return the composition that applies this transform first and `other` second."""
        shift = other.points(self.shift[None])[0]
        return Similarity(other.rotation @ self.rotation, other.scale * self.scale, shift)

    def times(self, factor: float) -> Similarity:
        """Return this transform followed by scaling with `factor`."""
        return Similarity(self.rotation, factor * self.scale, factor * self.shift)

    def points(self, points: Float64[np.ndarray, "m 3"]) -> Float64[np.ndarray, "m 3"]:
        """Transform points [M, 3]."""
        return self.scale * points @ self.rotation.T + self.shift


@dataclass(frozen=True, eq=False)
class Place:
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
    capture: Place
    """Position in the coordinates of the capture."""
    scene: Place
    """Position in the coordinates of the Gaussians, which nerfstudio and exported files use."""


@dataclass(frozen=True, eq=False)
class Catalogue:
    """Objects by prompt, and by descending size within each prompt."""

    objects: tuple[CatalogueObject, ...]
    in_smaller_parts: int
    """Number of selected Gaussians in components that are too small to be listed."""
    metres_per_unit: float | None
    """Meters per unit of the capture. If it is given, `capture` positions are in meters, otherwise in capture units."""

    @property
    def unit(self) -> str:
        """Unit of the `capture` positions."""
        return "capture unit" if self.metres_per_unit is None else "metre"


def make_catalogue(
    scene: Scene,
    field: SemanticField,
    instances: Instances,
    capture: Similarity,
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
    to_capture = capture if metres_per_unit is None else capture.times(metres_per_unit)
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
        shows = (share > 0) & (share >= SEEN * share.max(initial=0))
        inside = _inside(means[rows], cameras)
        whole = shows & (inside >= WHOLE * inside[shows].max(initial=0))
        order, num_views = np.lexsort((-share, ~whole, ~shows)), int(shows.sum())
        scene_place = _place(means[rows], weight[rows])
        points = to_capture.points(means[rows])
        box = scene_place.box.moved(to_capture.rotation, to_capture.scale, to_capture.shift)
        objects.append(
            CatalogueObject(
                id=number,
                text=instances.texts[instances.classes[number - 1] - 1],
                class_id=instances.classes[number - 1],
                gaussians=len(rows),
                reliability=float(np.average(reliability[rows], weights=weight[rows])),
                views=num_views,
                best_views=tuple(str(names[i]) for i in order[: min(BEST, num_views)]),
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


def _place(points: np.ndarray, weight: np.ndarray, box: OrientedBox | None = None) -> Place:
    low, high = np.quantile(points, CENTRAL, axis=0)
    return Place(np.average(points, axis=0, weights=weight), high - low, box or oriented_box(points))
