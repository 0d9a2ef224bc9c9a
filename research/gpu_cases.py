"""Scenes, cameras and regions for lifts on a GPU, and timing of steps."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import torch

from normlift_ns import Camera, Evidence, GaussianScene, rasterize_evidence
from research import rooms
from tests.captures import trained_scene, training_cameras

CELL, DIMENSION = 60, 512
"""Side of the square regions in pixels, and number of feature channels."""


def grid_labels(camera: Camera) -> torch.Tensor:
    across = -(-camera.width // CELL)
    y, x = torch.meshgrid(torch.arange(camera.height), torch.arange(camera.width), indexing="ij")
    return (y // CELL * across + x // CELL).int()


def features(rows: int, device: str = "cuda") -> torch.Tensor:
    """Return unit rows around 40 directions, so that neighbors agree partly."""
    g = torch.Generator(device).manual_seed(0)
    classes = torch.randn(40, DIMENSION, generator=g, device=device)
    which = torch.randint(0, 40, (rows,), generator=g, device=device)
    noise = torch.randn(rows, DIMENSION, generator=g, device=device)
    return torch.nn.functional.normalize(classes[which] + 0.5 * noise, dim=1)


@dataclass(frozen=True)
class Case:
    name: str
    scene: GaussianScene
    cameras: list[Camera]
    labels: list[torch.Tensor]

    @cached_property
    def counts(self) -> list[int]:
        """Number of regions of each view."""
        return [int(labels.max()) + 1 for labels in self.labels]

    def evidence(self, **options: Any) -> Evidence:
        return rasterize_evidence(self.scene, self.cameras, self.labels, num_regions=self.counts, **options)


def room_case(name: str, n: int, views: int, regions: int = 128, scale: float = 1.0) -> Case:
    width, height = round(rooms.WIDTH * scale), round(rooms.HEIGHT * scale)
    labels = [rooms.voronoi_labels(regions, width, height, seed=v) for v in range(views)]
    return Case(name, rooms.room(n), rooms.cameras(views, width, height), labels)


def capture_case(name: str) -> Case:
    cameras = training_cameras(name)
    return Case(name, trained_scene(name).to("cuda"), cameras, [grid_labels(camera).cuda() for camera in cameras])


def once(run: Callable[[], Any]) -> float:
    """Return the seconds of one run, with synchronization of the GPU before and after."""
    torch.cuda.synchronize()
    start = time.perf_counter()
    run()
    torch.cuda.synchronize()
    return time.perf_counter() - start


def timed(run: Callable[[], Any]) -> tuple[float, Any]:
    """Return the median seconds of three runs after a warm-up run, and the result of the last."""
    result, seconds = run(), []
    for _ in range(3):
        del result
        torch.cuda.synchronize()
        start = time.perf_counter()
        result = run()
        torch.cuda.synchronize()
        seconds.append(time.perf_counter() - start)
    return sorted(seconds)[1], result
