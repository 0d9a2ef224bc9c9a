"""`rasterize_evidence`: a loop over views. Backends differ only in how one view is summed."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterable, Iterator
from itertools import zip_longest
from typing import Any, Literal

import torch
from jaxtyping import Float
from torch import Tensor

from normlift_ns.core.evidence import MASKED, UNLABELED, Evidence, ViewEvidence
from normlift_ns.core.gaussians import Camera, GaussianScene
from normlift_ns.raster import reference
from normlift_ns.raster.projection import assign_tiles, project, to_world
from normlift_ns.raster.settings import RasterSettings

Backend = Literal["auto", "torch", "numba"]
RasterizeMode = Literal["classic", "antialiased"]
Progress = Callable[[int, int | None], None]


def rasterize_evidence(
    scene: GaussianScene,
    cameras: Iterable[Camera],
    labels: Iterable[Tensor],
    *,
    num_regions: Iterable[int] | None = None,
    backend: Backend = "auto",
    rasterize_mode: RasterizeMode = "classic",
    weight_power: int = 1,
    settings: RasterSettings | None = None,
    dtype: torch.dtype | None = None,
    progress: Progress | None = None,
) -> Evidence:
    """Evidence E_js = sum of A_ij over the pixels i of region s, for all views.

    The weights A_ij are those of the rasterizer that trained the scene, its cut-offs and its order of drawing included.

    Views stream: cameras, labels and num_regions may be generators, and nothing of a view is kept but its entries.

    Args:
        scene: N Gaussians. Those with non-finite parameters are not drawn; they are counted in the result, with a
            warning.
        cameras: one per view.
        labels: per view an integer tensor [height, width] of view-local region ids 0, 1, …; -1 = unlabelled;
            -2 = masked: the pixel is no observation at all, whatever `lift` does with unlabelled ones.
        num_regions: regions (columns, feature rows) per view; by default the largest id + 1. Needed where a table has
            rows that no pixel shows.
        backend: "torch" (the reference, any device), "numba" (compiled, CPU), "auto" (by the scene's device).
        rasterize_mode: as the scene was trained, splatfacto's `rasterize_mode`.
        weight_power: sums A_ij ** power. 1: the paper. 2: as SFS's code. 0: counts the pixels that a Gaussian
            contributes to.
        settings: constants of the rasterizer; those of gsplat 1.4.0 by default.
        dtype: precision of the computation and of the weights; by default the scene's. Sums are always taken in
            float64.
        progress: called after every view with (views done, number of views or None).
    Raises:
        ValueError: an unknown option, labels of another size or type than their camera, an id below -1 or not below
            its `num_regions`,
            or iterables of different lengths; the message names the view.
    """
    _check_mode(rasterize_mode)
    if weight_power not in (0, 1, 2):
        raise ValueError(f"weight_power must be 0, 1 or 2, got {weight_power}")
    settings = settings or RasterSettings()
    view_evidence = _choose(backend, scene.means.device).view_evidence
    num_excluded = len(scene) - int(scene.drawable.sum())
    if num_excluded > 0:
        warnings.warn(
            f"{num_excluded} of {len(scene)} Gaussians have non-finite parameters and are not drawn", stacklevel=2
        )
    total = len(cameras) if isinstance(cameras, list | tuple) else None
    world = to_world(scene, dtype or scene.means.dtype)
    views: list[ViewEvidence] = []
    with torch.no_grad():
        for index, (camera, label_map, count) in enumerate(_zip_views(cameras, labels, num_regions)):
            regions = _check_labels(index, camera, label_map, count)
            projected = project(world, camera, settings, rasterize_mode == "antialiased")
            tiles = assign_tiles(projected, camera.width, camera.height, settings.tile_size)
            there = label_map.to(scene.means.device)
            views.append(view_evidence(projected, tiles, there, regions, weight_power, settings))
            if progress is not None:
                progress(index + 1, total)
    return Evidence.from_views(views, len(scene), weight_power=weight_power, num_excluded=num_excluded)


def render(
    scene: GaussianScene,
    camera: Camera,
    values: Float[Tensor, "n c"],
    *,
    backend: Backend = "auto",
    rasterize_mode: RasterizeMode = "classic",
    settings: RasterSettings | None = None,
    dtype: torch.dtype | None = None,
) -> tuple[Float[Tensor, "h w c"], Float[Tensor, "h w"]]:
    """Composites any per-Gaussian values: sum_j A_ij values_j and sum_j A_ij of every pixel (eq. 2 of the paper).

    Args:
        values: colours, relevancies, reliability, …; not premultiplied.
    Returns:
        The image without background (add background * (1 - alpha)), and alpha in 0..1.
    Raises:
        ValueError: values of another length, an unknown option.
    """
    _check_mode(rasterize_mode)
    if values.ndim != 2 or len(values) != len(scene):
        raise ValueError(f"values must be [{len(scene)}, C], one row per Gaussian, got {tuple(values.shape)}")
    settings = settings or RasterSettings()
    with torch.no_grad():
        world = to_world(scene, dtype or scene.means.dtype)
        projected = project(world, camera, settings, rasterize_mode == "antialiased")
        tiles = assign_tiles(projected, camera.width, camera.height, settings.tile_size)
        drawn = values[projected.gaussian].to(projected.opacities.dtype)
        return _choose(backend, scene.means.device).composite(
            projected, tiles, drawn, camera.width, camera.height, settings
        )


def _check_mode(rasterize_mode: str) -> None:
    if rasterize_mode not in ("classic", "antialiased"):
        raise ValueError(f'rasterize_mode must be "classic" or "antialiased", got {rasterize_mode!r}')


def _choose(backend: str, device: torch.device) -> Any:
    """The module that sums one view: `view_evidence` and `composite`."""
    if backend == "auto":
        backend = "numba" if device.type == "cpu" else "torch"
    if backend == "torch":
        return reference
    if backend == "numba":
        if device.type != "cpu":
            raise ValueError(
                f'backend "numba" needs a scene on the CPU, this one is on {device}; move it, or use backend="torch"'
            )
        from normlift_ns.raster import numba  # noqa: PLC0415 (importing numba takes a second)

        return numba
    raise ValueError(f'backend must be "auto", "torch" or "numba", got {backend!r}')


def _zip_views(
    cameras: Iterable[Camera], labels: Iterable[Tensor], num_regions: Iterable[int] | None
) -> Iterator[tuple[Camera, Tensor, int | None]]:
    end: Any = object()
    streams: list[Iterable[Any]] = [cameras, labels, *([] if num_regions is None else [num_regions])]
    for index, items in enumerate(zip_longest(*streams, fillvalue=end)):
        for name, item in zip(("cameras", "labels", "num_regions"), items):
            if item is end:
                raise ValueError(
                    f"{name} ended after {index} views, but more views follow; "
                    "give one camera, one label map and one count per view"
                )
        yield items[0], items[1], items[2] if num_regions is not None else None


def _check_labels(index: int, camera: Camera, labels: Tensor, count: int | None) -> int:
    if (
        not isinstance(labels, Tensor)
        or labels.dtype.is_floating_point
        or labels.dtype in (torch.bool, torch.complex64)
    ):
        kind = labels.dtype if isinstance(labels, Tensor) else type(labels).__name__
        raise ValueError(f"labels of view {index} must be an integer tensor, got {kind}")
    if tuple(labels.shape) != (camera.height, camera.width):
        raise ValueError(
            f"labels of view {index} have shape {tuple(labels.shape)}, but its camera is {camera.height} x "
            f"{camera.width} (height x width)"
        )
    low, high = int(labels.min()), int(labels.max())
    if low < MASKED:
        raise ValueError(f"labels of view {index} contain {low}; region ids start at 0, -1 means unlabelled, -2 masked")
    if count is not None and high >= count:
        raise ValueError(f"labels of view {index} contain region {high}, but num_regions says {count}")
    return max(high, UNLABELED) + 1 if count is None else count
