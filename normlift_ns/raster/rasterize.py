"""`rasterize_evidence`: a loop over views. `render`: one view. Both leave the sums to a backend."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterable, Iterator, Sequence
from itertools import groupby, islice, zip_longest
from typing import Any, cast

import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from normlift_ns.core.evidence import MASKED, UNLABELED, Entries, Evidence
from normlift_ns.core.gaussians import Camera, GaussianScene
from normlift_ns.core.gpu import in_parts
from normlift_ns.core.scene import Scene
from normlift_ns.errors import InputError
from normlift_ns.options import BackendName, RasterizeMode
from normlift_ns.raster.backend import Batch, Job
from normlift_ns.raster.backends import choose_backend
from normlift_ns.raster.settings import RasterSettings

Progress = Callable[[int, int | None], None]
_ADVICE = "rasterize at a fraction of the resolution (ns-normlift --lift-downscale 2), or on the CPU (--device cpu)"


def rasterize_evidence(
    scene: GaussianScene,
    cameras: Iterable[Camera],
    labels: Iterable[Tensor],
    *,
    num_regions: Iterable[int] | None = None,
    backend: BackendName = "auto",
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
        scene: N Gaussians. Those with parameters that are not finite or out of range (`GaussianScene.drawable`) are
            not drawn; they are counted in the result, with a warning.
        cameras: one per view.
        labels: per view an integer tensor [height, width] of view-local region ids 0, 1, …; -1 = unlabelled;
            -2 = masked: the pixel is no observation at all, whatever `lift` does with unlabelled ones.
        num_regions: regions (columns, feature rows) per view; by default the largest id + 1. Needed where a table has
            rows that no pixel shows.
        backend: "torch" (the reference, any device and precision), "numba" (compiled, CPU), "triton" (fast, GPU,
            float32), "gsplat" (stock gsplat, GPU, float32, weight_power 1, by the rules of the installed version or
            older ones), "auto" (the fastest for the scene's device and the precision).
        rasterize_mode: as the scene was trained, splatfacto's `rasterize_mode`.
        weight_power: sums A_ij ** power. 1: the paper. 2: as SFS's code. 0: counts the pixels that a Gaussian
            contributes to.
        settings: constants of the rasterizer; those of gsplat 1.4.0 by default. See `RasterSettings.of_gsplat`.
        dtype: precision of the computation and of the weights; by default the scene's. Sums are always taken in
            float64.
        progress: called after every view with (views done, number of views or None).
    Raises:
        ValueError: an unknown option, labels of another size or type than their camera, an id below -2 or not below
            its `num_regions`, or iterables of different lengths; the message names the view.

    >>> import torch
    >>> from normlift_ns import Camera, GaussianScene, rasterize_evidence
    >>> means, quats = torch.tensor([[0.0, 0, 1], [0, 0, 2]]), torch.tensor([[1.0, 0, 0, 0]]).expand(2, 4)
    >>> scene = GaussianScene(means, quats, scales=torch.ones(2, 3), opacities=torch.tensor([0.5, 0.5]))
    >>> camera = Camera(torch.tensor([[1.0, 0, 0.5], [0, 1, 0.5], [0, 0, 1]]), torch.eye(4), width=1, height=1)
    >>> evidence = rasterize_evidence(scene, [camera, camera], [torch.tensor([[0]]), torch.tensor([[-1]])])
    >>> evidence.rows.row_sums().tolist(), evidence.unlabeled.row_sums().tolist()  # 0.25: seen through the first
    ([0.5, 0.25], [0.5, 0.25])
    """
    if weight_power not in (0, 1, 2):
        raise InputError(f"weight_power must be 0, 1 or 2, got {weight_power}")
    job = _job(scene, rasterize_mode, settings, dtype, weight_power)
    _, chosen = choose_backend(backend, job, pictures=False)
    num_excluded = len(scene) - int(scene.drawable.sum())
    if num_excluded > 0:
        warnings.warn(
            f"{num_excluded} of {len(scene)} Gaussians have parameters that are not finite or out of range, "
            "and are not drawn",
            stacklevel=2,
        )
    total = len(cameras) if isinstance(cameras, list | tuple) else None
    parts: list[Entries] = []
    done = 0
    with torch.no_grad():
        for flight in _flights(_zip_views(cameras, labels, num_regions), lambda camera: chosen.in_flight(job, camera)):
            for i, (camera, there, _) in enumerate(flight):
                _check_map(done + i, camera, there)
            device = scene.means.device
            ends = torch.stack([torch.stack(x.aminmax()).to(device, torch.int64) for _, x, _ in flight]).tolist()
            checked = [
                (camera, there, _check_range(done + i, ends[i][0], ends[i][1], count))
                for i, (camera, there, count) in enumerate(flight)
            ]

            def sums(views: Sequence[tuple[Camera, Tensor, int]]) -> Entries:
                seen, maps, counts = zip(*views)
                there = [labels.to(scene.means.device, torch.int32) for labels in maps]
                return chosen.views_evidence(job, Batch(seen, there, counts))

            parts += in_parts(sums, checked, _ADVICE)
            for _ in flight:
                done += 1
                if progress is not None:
                    progress(done, total)
    return Evidence.from_entries(parts, len(scene), weight_power=weight_power, num_excluded=num_excluded)


def backend_of(
    scene: GaussianScene, backend: BackendName, *, settings: RasterSettings, dtype: torch.dtype, weight_power: int
) -> BackendName:
    """The name of the backend that `rasterize_evidence` would use.

    Raises:
        ValueError: none of that name, or it cannot do the job; says what to use instead.
    """
    job = _job(scene, "classic", settings, dtype, weight_power)
    return cast(BackendName, choose_backend(backend, job, pictures=False)[0])


def render(
    scene: GaussianScene,
    camera: Camera,
    values: Float[Tensor, "n c"],
    *,
    backend: BackendName = "auto",
    rasterize_mode: RasterizeMode = "classic",
    settings: RasterSettings | None = None,
    dtype: torch.dtype | None = None,
) -> tuple[Float[Tensor, "h w c"], Float[Tensor, "h w"]]:
    """Composites any per-Gaussian values: sum_j A_ij values_j and sum_j A_ij of every pixel (eq. 2 of the paper).

    Args:
        values: colours, relevancies, reliability, …; not premultiplied.
        backend: as in `rasterize_evidence`.
    Returns:
        The image without background (add background * (1 - alpha)), and alpha in 0..1.
    Raises:
        ValueError: values of another length, an unknown option.

    >>> import torch
    >>> from normlift_ns import Camera, GaussianScene, render
    >>> means, quats = torch.tensor([[0.0, 0, 1], [0, 0, 2]]), torch.tensor([[1.0, 0, 0, 0]]).expand(2, 4)
    >>> scene = GaussianScene(means, quats, scales=torch.ones(2, 3), opacities=torch.tensor([0.5, 0.5]))
    >>> camera = Camera(torch.tensor([[1.0, 0, 0.5], [0, 1, 0.5], [0, 0, 1]]), torch.eye(4), width=1, height=1)
    >>> image, alpha = render(scene, camera, torch.tensor([[1.0, 0, 0], [0, 0, 1]]))  # red before blue
    >>> image.tolist(), alpha.tolist()
    ([[[0.5, 0.0, 0.25]]], [[0.75]])
    """
    if values.ndim != 2 or len(values) != len(scene):
        raise InputError(f"values must be [{len(scene)}, C], one row per Gaussian, got {tuple(values.shape)}")
    job = _job(scene, rasterize_mode, settings, dtype)
    _, chosen = choose_backend(backend, job, pictures=True)
    with torch.no_grad():
        return chosen.composite(job, camera, values)


def render_picture(
    scene: Scene,
    camera: Camera,
    *,
    settings: RasterSettings | None = None,
    mode: RasterizeMode | None = None,
    gaussians: GaussianScene | None = None,
) -> UInt8[Tensor, "h w 3"]:
    """The trained scene as a camera sees it, sRGB on its background: by the scene's own renderer if it has one.

    Args:
        settings, mode: other constants and another mode than those of the training, for pictures of another size.
        gaussians: those of the scene on the device that renders; the picture is on the CPU.
    """
    if scene.renderer is not None:
        return scene.renderer(camera)
    how = {"rasterize_mode": mode or scene.rasterize_mode, "settings": settings}
    there = gaussians or scene.gaussians
    color, alpha = render(there, camera, scene.colors(camera).to(there.means.device), **how)
    color = color + (1 - alpha)[:, :, None] * scene.background.to(color)
    return (color.clamp(0, 1) * 255).round().to(torch.uint8).cpu()


def _job(
    scene: GaussianScene,
    rasterize_mode: str,
    settings: RasterSettings | None,
    dtype: torch.dtype | None,
    weight_power: int = 1,
) -> Job:
    if rasterize_mode not in ("classic", "antialiased"):
        raise InputError(f'rasterize_mode must be "classic" or "antialiased", got {rasterize_mode!r}')
    antialiased = rasterize_mode == "antialiased"
    return Job(scene, antialiased, settings or RasterSettings(), dtype or scene.means.dtype, weight_power)


def _flights(
    views: Iterator[tuple[Camera, Tensor, int | None]], most: Callable[[Camera], int]
) -> Iterator[list[tuple[Camera, Tensor, int | None]]]:
    """Consecutive views of one size, at most so many at once."""
    for _, group in groupby(views, key=lambda view: (view[0].width, view[0].height)):
        same_size = iter(group)
        for first in same_size:
            yield [first, *islice(same_size, most(first[0]) - 1)]


def _zip_views(
    cameras: Iterable[Camera], labels: Iterable[Tensor], num_regions: Iterable[int] | None
) -> Iterator[tuple[Camera, Tensor, int | None]]:
    end: Any = object()
    streams: list[Iterable[Any]] = [cameras, labels, *([] if num_regions is None else [num_regions])]
    for index, items in enumerate(zip_longest(*streams, fillvalue=end)):
        for name, item in zip(("cameras", "labels", "num_regions"), items):
            if item is end:
                raise InputError(
                    f"{name} ended after {index} views, but more views follow; "
                    "give one camera, one label map and one count per view"
                )
        yield items[0], items[1], items[2] if num_regions is not None else None


def _check_map(index: int, camera: Camera, labels: Tensor) -> None:
    if (
        not isinstance(labels, Tensor)
        or labels.dtype.is_floating_point
        or labels.dtype in (torch.bool, torch.complex64)
    ):
        kind = labels.dtype if isinstance(labels, Tensor) else type(labels).__name__
        raise InputError(f"labels of view {index} must be an integer tensor, got {kind}")
    if tuple(labels.shape) != (camera.height, camera.width):
        raise InputError(
            f"labels of view {index} have shape {tuple(labels.shape)}, but its camera is {camera.height} x "
            f"{camera.width} (height x width)"
        )


def _check_range(index: int, low: int, high: int, count: int | None) -> int:
    """The number of regions of a view."""
    if low < MASKED:
        raise InputError(f"labels of view {index} contain {low}; region ids start at 0, -1 means unlabelled, -2 masked")
    if count is not None and high >= count:
        raise InputError(f"labels of view {index} contain region {high}, but num_regions says {count}")
    return max(high, UNLABELED) + 1 if count is None else count
