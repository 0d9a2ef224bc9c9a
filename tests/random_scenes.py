"""Small random scenes, cameras, label maps and evidence for tests; all from a seed."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from types import SimpleNamespace
from typing import Any

import torch
from torch import Tensor

from normlift_ns import Camera, Evidence, GaussianScene, View
from normlift_ns.core.sparse import SparseRows


def generator(seed: int) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def unit_rows(count: int, dimension: int, seed: int, dtype: torch.dtype = torch.float64) -> Tensor:
    return torch.nn.functional.normalize(torch.randn(count, dimension, generator=generator(seed), dtype=dtype), dim=1)


def random_scene(n: int, seed: int = 0, dtype: torch.dtype = torch.float64, size: float = 0.15) -> GaussianScene:
    """Gaussians around the origin, opacities over the whole of 0..1."""
    g = generator(seed)
    return GaussianScene(
        torch.randn(n, 3, generator=g, dtype=dtype),
        torch.randn(n, 4, generator=g, dtype=dtype),
        torch.rand(n, 3, generator=g, dtype=dtype) * size,
        torch.rand(n, generator=g, dtype=dtype),
    )


def orbit_camera(angle: float, width: int = 40, height: int = 35, distance: float = 4.0, focal: float = 40.0) -> Camera:
    """A camera on a circle around the y axis, looking at the origin; its principal point is off centre."""
    pose = torch.eye(4, dtype=torch.float64)
    c, s = math.cos(angle), math.sin(angle)
    pose[:3, :3] = torch.tensor([[c, 0, s], [0, 1, 0], [-s, 0, c]])
    pose[2, 3] = distance
    K = torch.tensor([[focal, 0, 0.45 * width], [0, 1.1 * focal, 0.55 * height], [0, 0, 1]], dtype=torch.float64)
    return Camera(K, pose, width, height)


def orbit(count: int, **kwargs: float) -> list[Camera]:
    return [orbit_camera(2 * math.pi * i / count, **kwargs) for i in range(count)]


def random_labels(camera: Camera, regions: int, seed: int = 0, cell: int = 5) -> Tensor:
    """Cells of `cell` pixels with random region ids, -1 among them."""
    g = generator(seed)
    coarse = torch.randint(-1, regions, (-(-camera.height // cell), -(-camera.width // cell)), generator=g)
    fine = coarse.repeat_interleave(cell, 0).repeat_interleave(cell, 1)
    return fine[: camera.height, : camera.width].int()


def random_evidence(
    n: int, regions_per_view: list[int], seed: int, *, fill: float = 0.4, dtype: torch.dtype = torch.float64
) -> Evidence:
    """Evidence that no rasterizer made: a random sparse matrix with weights over six decades."""
    g = generator(seed)
    counts = torch.tensor(regions_per_view)
    views, s = len(regions_per_view), int(counts.sum())

    def rows(columns: int) -> SparseRows:
        keep = torch.rand(n, columns, generator=g) < fill
        row, column = keep.nonzero(as_tuple=True)
        weight = 10 ** (6 * torch.rand(row.numel(), generator=g, dtype=torch.float64) - 4)
        return SparseRows.from_coo(row, column, weight.to(dtype), n)

    labeled = rows(s)
    region_view = torch.repeat_interleave(torch.arange(views), counts).int()
    return Evidence(labeled, region_view, rows(views), views)


def dense(rows: SparseRows, columns: int) -> Tensor:
    """[N, columns] float64, on the device of the rows, whose columns have to ascend."""
    assert bool(((rows.column.diff() > 0) | (rows.row_index().diff() > 0)).all())
    out = torch.zeros(len(rows), columns, dtype=torch.float64, device=rows.weight.device)
    out[rows.row_index(), rows.column.long()] = rows.weight.double()
    return out


def same_evidence(a: Evidence, b: Evidence) -> bool:
    arrays = ("offsets", "column", "weight")
    return (
        torch.equal(a.region_view, b.region_view)
        and all(torch.equal(getattr(a.rows, name), getattr(b.rows, name)) for name in arrays)
        and all(torch.equal(getattr(a.unlabeled, name), getattr(b.unlabeled, name)) for name in arrays)
        and (a.num_views, a.weight_power, a.num_excluded) == (b.num_views, b.weight_power, b.num_excluded)
    )


@dataclass
class Photographs:
    names: Sequence[str]
    cameras: Sequence[Camera]
    seeds: Sequence[int] = range(99)
    masks: Sequence[Tensor | None] = (None,) * 99
    original: tuple[int, int] | None = None

    def __len__(self) -> int:
        return len(self.names)

    def __getitem__(self, index: int) -> View:
        camera = self.cameras[index]
        shape = (camera.height, camera.width, 3)
        image = torch.randint(0, 256, shape, generator=generator(self.seeds[index]), dtype=torch.uint8)
        return View(camera, image, self.masks[index], self.names[index], self.original)


def made_scene(gaussians: GaussianScene, train: Photographs, held_out: Any = (), **more: Any) -> Any:
    """What a lift reads of a scene."""
    facts = {"rasterize_mode": "classic", "identity": {}, "name": "made", **more}
    return SimpleNamespace(gaussians=gaussians, train=train, held_out=held_out or Photographs([], []), **facts)
