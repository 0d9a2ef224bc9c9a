"""A catalogue of objects: where each is, how large, how reliable, and which photographs show it."""

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
"""A photograph shows an object if it shows at least this share of what the best photograph of the object does."""
WHOLE = 0.95
"""An object lies wholly within a picture if this share does of what lies in the picture that has most of it."""
BEST = 3
_LONGEST_SIDE = 256
"""Pixels of the pictures in which objects are looked for: the order of photographs needs no more."""


@dataclass(frozen=True, eq=False)
class Similarity:
    """p -> scale * rotation @ p + shift."""

    rotation: Float64[np.ndarray, "3 3"]
    scale: float
    shift: Float64[np.ndarray, " 3"]

    @classmethod
    def undoing(cls, transform: Float64[np.ndarray, "3 4"], scale: float) -> Similarity:
        """What leads back from the world that p -> scale * (transform @ p) leads to."""
        rotation = transform[:, :3].T
        return cls(rotation, 1 / scale, -rotation @ transform[:, 3])

    @classmethod
    def identity(cls) -> Similarity:
        """Which moves nothing."""
        return cls(np.eye(3), 1.0, np.zeros(3))

    def then(self, other: Similarity) -> Similarity:
        """This one, and then another."""
        shift = other.points(self.shift[None])[0]
        return Similarity(other.rotation @ self.rotation, other.scale * self.scale, shift)

    def times(self, factor: float) -> Similarity:
        """The same with another unit."""
        return Similarity(self.rotation, factor * self.scale, factor * self.shift)

    def points(self, points: Float64[np.ndarray, "m 3"]) -> Float64[np.ndarray, "m 3"]:
        """Points [M, 3] moved."""
        return self.scale * points @ self.rotation.T + self.shift


@dataclass(frozen=True, eq=False)
class Place:
    """Where an object is, in one set of coordinates."""

    centroid: Float64[np.ndarray, " 3"]
    """Mean of the centres, weighted by W_j, what the views saw of each Gaussian."""
    extent: Float64[np.ndarray, " 3"]
    """From the 1st to the 99th percentile of the centres along x, y and z."""
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
    """Training photographs that show it."""
    best_views: tuple[str, ...]
    """Names of at most three: those in which it lies wholly within the picture first, the largest share first."""
    capture: Place
    """In the coordinates of the capture."""
    scene: Place
    """In the coordinates of the Gaussians, as nerfstudio and exported files have them."""


@dataclass(frozen=True, eq=False)
class Catalogue:
    """Objects by text, for each text the largest first."""

    objects: tuple[CatalogueObject, ...]
    in_smaller_parts: int
    """Selected Gaussians of parts too small to be listed."""
    metres_per_unit: float | None
    """Of the capture; None: `capture` of the objects is in its units, else in metres."""

    @property
    def unit(self) -> str:
        """Of what `capture` of the objects says."""
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
    """What is known of every object.

    Args:
        capture: from the scene's world to the capture's.
        metres_per_unit: length of a unit of the capture, > 0.
        device: where objects are looked for in the photographs.
    """
    to_capture = capture if metres_per_unit is None else capture.times(metres_per_unit)
    means, ids = scene.gaussians.means.double().cpu().numpy(), instances.instance_id.cpu().numpy()
    weight, reliability = (x.double().cpu().numpy() for x in (field.scalars.weight + 1e-12, field.scalars.reliability))
    count, names, cameras = len(instances.classes), scene.train.names, scene.train.cameras
    settings = RasterSettings.recorded(field.manifest)
    gaussians, mode = scene.gaussians.to(device), scene.rasterize_mode
    shown = view_shares(gaussians, cameras, instances, rasterize_mode=mode, settings=settings).cpu().numpy()
    objects = []
    for number in range(1, count + 1):
        rows = np.flatnonzero(ids == number)
        share = shown[number - 1]
        shows = (share > 0) & (share >= SEEN * share.max(initial=0))
        inside = _inside(means[rows], cameras)
        whole = shows & (inside >= WHOLE * inside[shows].max(initial=0))
        order, seen = np.lexsort((-share, ~whole, ~shows)), int(shows.sum())
        here = _place(means[rows], weight[rows])
        points = to_capture.points(means[rows])
        box = here.box.moved(to_capture.rotation, to_capture.scale, to_capture.shift)
        objects.append(
            CatalogueObject(
                id=number,
                text=instances.texts[instances.classes[number - 1] - 1],
                class_id=instances.classes[number - 1],
                gaussians=len(rows),
                reliability=float(np.average(reliability[rows], weights=weight[rows])),
                views=seen,
                best_views=tuple(str(names[i]) for i in order[: min(BEST, seen)]),
                capture=_place(points, weight[rows], box),
                scene=here,
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
    """The share of each picture that each object takes up, what hides it counted: the compositing weight of its
    Gaussians per pixel.
    """
    count = len(instances.classes)
    shares = torch.zeros(count, len(cameras))
    if count == 0:
        return shares
    small = [_smaller(camera) for camera in cameras]
    maps = [torch.zeros(camera.height, camera.width, dtype=torch.int32) for camera in small]
    how = {"rasterize_mode": rasterize_mode, "settings": settings, "num_regions": [1] * len(small)}
    rows = rasterize_evidence(gaussians, small, maps, **how).rows  # pyright: ignore[reportArgumentType]
    ids = instances.instance_id.to(rows.weight.device).long()[rows.row_index()]
    flat = torch.zeros((count + 1) * len(small), dtype=torch.float64, device=rows.weight.device)
    flat.index_add_(0, ids * len(small) + rows.column.long(), rows.weight.double())
    pixels = flat.new_tensor([camera.width * camera.height for camera in small])
    return (flat.view(count + 1, len(small))[1:] / pixels).float()


def _inside(points: np.ndarray, cameras: Sequence[Camera]) -> np.ndarray:
    """[views], the share of the points that lies within each picture."""
    shares = []
    for camera in cameras:
        pose, K = camera.world_to_camera.double().cpu().numpy(), camera.K.double().cpu().numpy()
        pixels = (points @ pose[:3, :3].T + pose[:3, 3]) @ K.T
        depth = np.where(pixels[:, 2] > 0, pixels[:, 2], np.nan)[:, None]  # nothing is inside that lies behind
        pixels = pixels[:, :2] / depth
        shares.append(((pixels >= 0) & (pixels <= (camera.width, camera.height))).all(axis=1).mean())
    return np.array(shares)


def _smaller(camera: Camera) -> Camera:
    factor = min(1.0, _LONGEST_SIDE / max(camera.width, camera.height))
    width, height = (max(1, round(side * factor)) for side in (camera.width, camera.height))
    scale = torch.tensor([[width / camera.width], [height / camera.height], [1.0]], dtype=camera.K.dtype)
    return Camera(camera.K * scale, camera.world_to_camera, width, height)


def _place(points: np.ndarray, weight: np.ndarray, box: OrientedBox | None = None) -> Place:
    low, high = np.quantile(points, CENTRAL, axis=0)
    return Place(np.average(points, axis=0, weights=weight), high - low, box or oriented_box(points))
