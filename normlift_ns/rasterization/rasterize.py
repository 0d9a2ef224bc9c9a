"""Rasterization of evidence and images, selection of backends, and compositing weights along a ray."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from importlib import import_module
from itertools import groupby, islice, zip_longest
from typing import Any, NamedTuple, Protocol, TypedDict, cast, get_args

import torch
from jaxtyping import Float, Float64, Int, Int32, Int64, UInt8
from torch import Tensor
from typing_extensions import Unpack

from normlift_ns.core.arguments import check_arguments
from normlift_ns.core.device import has_triton, retry_in_halves
from normlift_ns.core.evidence import MASKED, UNLABELED, WEIGHT_POWERS, Entries, Evidence
from normlift_ns.core.gaussians import Camera, GaussianScene
from normlift_ns.core.scene import Scene
from normlift_ns.core.sparse import SparseRows, row_offsets
from normlift_ns.errors import InputError
from normlift_ns.options import BackendName, RasterizeMode, option_name, option_setting, short_repr
from normlift_ns.rasterization import projection
from normlift_ns.rasterization.settings import RasterSettings

# Backends: their interface, the backend in plain torch, and the choice of a backend.


@dataclass(frozen=True)
class RasterJob:
    """Scene and options of one call, shared by all its views."""

    scene: GaussianScene
    antialiased: bool
    settings: RasterSettings
    dtype: torch.dtype
    """Precision of the computation."""
    weight_power: int = 1
    """Exponent p of the weights. The evidence is the sum of A_ij ** p."""

    @cached_property
    def prepared(self) -> projection.AnyPrepared:
        """The drawable Gaussians, prepared for any camera."""
        prepare = projection.prepare_gaussians_2d if self.is_2d else projection.prepare_gaussians
        return prepare(self.scene, self.dtype)

    @property
    def is_2d(self) -> bool:
        """True for a 2D Gaussian Splatting scene."""
        return self.scene.primitive == "2dgs"

    def project(self, camera: Camera) -> projection.AnyProjected:
        """Project the Gaussians into a camera."""
        if isinstance(self.prepared, projection.PreparedGaussians2D):
            return projection.project_2d(self.prepared, camera, self.settings)
        return projection.project(self.prepared, camera, self.settings, self.antialiased)


def check_gpu(backend: str, job: RasterJob) -> None:
    """Raise ValueError if a job is not in float32 on a GPU."""
    means = job.scene.means
    if not means.dtype == job.dtype == torch.float32 or means.device.type != "cuda":
        other = str(job.dtype if means.dtype == torch.float32 else means.dtype).removeprefix("torch.")
        raise InputError(
            f'backend "{backend}" needs float32 on a GPU, got {other} on {means.device.type}; use '
            f"{option_setting('backend', 'auto')}"
        )


class RasterBatch(NamedTuple):
    """Views of the same size that are rasterized together."""

    cameras: Sequence[Camera]
    labels: Sequence[Int32[Tensor, "h w"]]
    num_regions: Sequence[int]


class Backend(Protocol):
    """Interface of a backend, implemented by `TileBackend` and the modules `numba`, `gsplat` and `triton`."""

    def check(self, job: RasterJob) -> None:
        """Raise ValueError if the backend does not support the job. The message suggests an alternative."""
        ...

    def in_flight(self, job: RasterJob, camera: Camera) -> int:
        """Return the number of views of this camera's size to pass to one call of `views_evidence`."""
        ...

    def views_evidence(self, job: RasterJob, batch: RasterBatch) -> Entries:
        """Return the sums of A_ij ** weight_power by (Gaussian, region)."""
        ...

    def composite(
        self, job: RasterJob, camera: Camera, values: Float[Tensor, "n c"]
    ) -> tuple[Float[Tensor, "h w c"], Float[Tensor, "h w"]]:
        """Return sum_j A_ij values_j and sum_j A_ij of every pixel."""
        ...


class TileBackend:
    """Backend in plain torch for any device and precision, which processes one view at a time."""

    def check(self, job: RasterJob) -> None:
        """Accept every job on any device."""

    def in_flight(self, job: RasterJob, camera: Camera) -> int:
        """Return 1, because views are processed one at a time."""
        return 1

    def views_evidence(self, job: RasterJob, batch: RasterBatch) -> Entries:  # noqa: D102 (as in the protocol)
        (camera,), (labels,), (count,) = batch
        projected, tiles = _with_tiles(job, camera)
        return projection.view_evidence(projected, tiles, labels, count, job.weight_power, job.settings)

    def composite(  # noqa: D102 (as in the protocol)
        self, job: RasterJob, camera: Camera, values: Float[Tensor, "n c"]
    ) -> tuple[Float[Tensor, "h w c"], Float[Tensor, "h w"]]:
        projected, tiles = _with_tiles(job, camera)
        visible_values = values[projected.gaussian].to(projected.opacities.dtype)
        return projection.composite(projected, tiles, visible_values, camera.width, camera.height, job.settings)


def _with_tiles(job: RasterJob, camera: Camera) -> tuple[projection.AnyProjected, projection.TileLists]:
    projected = job.project(camera)
    return projected, projection.assign_tiles(projected, camera.width, camera.height, job.settings.tile_size)


def choose_backend(name: str, job: RasterJob) -> tuple[str, Backend]:
    """Choose a backend, and return its name and the backend itself.

    "auto" selects the fastest backend for the device, the precision, the kind of Gaussians and the weight power.

    Args:
        name: Name of the backend, or "auto".
        job: Scene and options.

    Raises:
        ValueError: If the name is unknown or the backend does not support the job.
    """
    if name == "auto":
        name = _fastest(job)
    if name not in get_args(BackendName):
        raise InputError(f"backend {name!r} is unknown; choose one of {', '.join(get_args(BackendName))}")
    if name == "triton" and not has_triton():
        raise InputError(
            'backend "triton" needs Triton 3, which PyTorch 2.4 and later on Linux include; use '
            f"{option_setting('backend', 'auto')}"
        )
    backend: Any = TileBackend() if name == "torch" else import_module(f"normlift_ns.rasterization.{name}")
    backend.check(job)
    return name, backend


def _fastest(job: RasterJob) -> str:
    means = job.scene.means
    if means.device.type == "cpu":
        return "numba"
    if not means.is_cuda or job.dtype != torch.float32 or means.dtype != torch.float32:
        return "torch"
    if has_triton():
        return "triton"
    return "torch" if job.is_2d or job.weight_power != 1 else "gsplat"


# Rasterization of evidence (`rasterize_evidence`) and of values (`render`).


ViewProgress = Callable[[int, int | None], None]
MAX_REGIONS = 2**24
"""Largest number of regions of a view. Regions without pixels also take memory."""


class RasterOptions(TypedDict, total=False):
    """Keyword arguments of `rasterize_evidence` that define the weights A_ij and their sums."""

    rasterize_mode: RasterizeMode
    """splatfacto's `rasterize_mode` in the training of the scene (default: classic)."""
    weight_power: int
    """Exponent of the summed A_ij (default: 1, as in the paper). The code of Splat Feature Solver uses 2. With 0, the
    sum is the number of pixels of a region to which a Gaussian contributes."""
    settings: RasterSettings | None
    """Constants of the rasterizer (default: those of gsplat 1.4.0). See `RasterSettings.of_gsplat`."""
    dtype: torch.dtype | None
    """Precision of the computation and of the weights (default: that of the scene). The backends "torch" and "numba"
    compute sums in float64."""


@check_arguments
def rasterize_evidence(
    scene: GaussianScene,
    cameras: Iterable[Camera],
    labels: Iterable[Tensor],
    *,
    num_regions: Iterable[int] | None = None,
    backend: BackendName = "auto",
    progress: ViewProgress | None = None,
    **options: Unpack[RasterOptions],
) -> Evidence:
    """Compute the evidence E_js = sum of A_ij ** weight_power over the pixels i of region s, for all views.

    The weights A_ij are those of the rasterizer that trained the scene, including its thresholds and drawing order.

    Views are streamed. cameras, labels and num_regions may be generators, and only the entries of a view are kept.

    Args:
        scene: N Gaussians. Gaussians with invalid parameters (see `GaussianScene.drawable`) are not drawn. The result
            counts them, and a warning reports them.
        cameras: One camera per view.
        labels: One integer tensor [height, width] per view, with region ids 0, 1, … of this view. -1 means unlabeled.
            -2 means masked, and `lift` always ignores such pixels.
        num_regions: Number of regions per view (default: largest id + 1). Required if the feature table has rows for
            regions above the largest id.
        backend: "torch" is the reference for any device and precision. "numba" is compiled for the CPU. "triton" has
            its own kernels for float32 on a GPU. "gsplat" is stock gsplat, for 3D Gaussians in float32 on a GPU,
            weight_power 1 and constants that the installed version supports. "auto" selects the fastest backend for the
            device, the precision, the kind of Gaussians and the weight power.
        progress: Callback after every view, with the number of finished views and the number of all views, or None if
            the latter is unknown.
        options: Keyword arguments of `RasterOptions`.

    Raises:
        ValueError: If an option is invalid, or the backend does not support the scene. Also if labels have a wrong type
            or size, an id is out of range, or the iterables have different lengths. Messages about labels name the
            view.

    >>> import torch
    >>> from normlift_ns import Camera, GaussianScene, rasterize_evidence
    >>> means, quats = torch.tensor([[0.0, 0, 1], [0, 0, 2]]), torch.tensor([[1.0, 0, 0, 0]]).expand(2, 4)
    >>> scene = GaussianScene(means, quats, scales=torch.ones(2, 3), opacities=torch.tensor([0.5, 0.5]))
    >>> camera = Camera(torch.tensor([[1.0, 0, 0.5], [0, 1, 0.5], [0, 0, 1]]), torch.eye(4), width=1, height=1)
    >>> evidence = rasterize_evidence(scene, [camera, camera], [torch.tensor([[0]]), torch.tensor([[-1]])])
    >>> evidence.rows.row_sums().tolist(), evidence.unlabeled.row_sums().tolist()  # 0.25 behind the first one
    ([0.5, 0.25], [0.5, 0.25])
    """
    weight_power = options.get("weight_power", 1)
    if weight_power not in WEIGHT_POWERS:
        raise InputError(f"weight_power must be 0, 1 or 2, got {weight_power}")
    job = _job(scene, **options)
    _, chosen = choose_backend(backend, job)
    num_excluded = len(scene) - int(scene.drawable.sum())
    if num_excluded > 0:
        warnings.warn(
            f"{num_excluded} of {len(scene)} Gaussians {'is' if num_excluded == 1 else 'are'} not drawn, because of "
            "parameters that are not finite or out of range",
            stacklevel=3,
        )
    total = len(cameras) if isinstance(cameras, list | tuple) else None
    parts: list[Entries] = []
    done = 0
    with torch.no_grad():
        views = _zip_views(cameras, labels, num_regions)
        for batch in _batches(views, lambda camera: chosen.in_flight(job, camera)):
            for i, (camera, label_map, _) in enumerate(batch):
                _check_map(done + i, camera, label_map)
            device = scene.means.device
            ranges = torch.stack([torch.stack(x.aminmax()).to(device, torch.int64) for _, x, _ in batch]).tolist()
            checked = [
                (camera, label_map, _check_range(done + i, ranges[i][0], ranges[i][1], count))
                for i, (camera, label_map, count) in enumerate(batch)
            ]

            def sums(views: Sequence[tuple[Camera, Tensor, int]]) -> Entries:
                view_cameras, label_maps, counts = zip(*views)
                on_device = [labels.to(scene.means.device, torch.int32) for labels in label_maps]
                return chosen.views_evidence(job, RasterBatch(view_cameras, on_device, counts))

            advice = f"rasterize smaller images (in a lift, increase {option_name('lift_downscale')}) or use the CPU"
            parts += retry_in_halves(sums, checked, advice)
            for _ in batch:
                done += 1
                if progress is not None:
                    progress(done, total)
    return Evidence.join(parts, len(scene), weight_power=weight_power, num_excluded=num_excluded)


def resolve_backend(scene: GaussianScene, backend: BackendName, **options: Unpack[RasterOptions]) -> BackendName:
    """Return the name of the backend that `rasterize_evidence` would use.

    Raises:
        ValueError: If the name is unknown or the backend does not support the scene and options. The message
            suggests an alternative.
    """
    return cast(BackendName, choose_backend(backend, _job(scene, **options))[0])


@check_arguments
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
    """Composite values of Gaussians; return sum_j A_ij values_j and sum_j A_ij of every pixel i (eq. 2 of the paper).

    Args:
        scene: N Gaussians.
        camera: Camera of the image.
        values: Values of every Gaussian to composite, such as colors or relevancies, not premultiplied.
        backend: As in `rasterize_evidence`.
        rasterize_mode: As in `rasterize_evidence`.
        settings: As in `rasterize_evidence`.
        dtype: As in `rasterize_evidence`.

    Returns:
        The image without background (add background * (1 - alpha)), and alpha in 0..1.

    Raises:
        ValueError: If the values do not have one row per Gaussian, an option is invalid, or the backend does not
            support the scene.

    >>> import torch
    >>> from normlift_ns import Camera, GaussianScene, render
    >>> means, quats = torch.tensor([[0.0, 0, 1], [0, 0, 2]]), torch.tensor([[1.0, 0, 0, 0]]).expand(2, 4)
    >>> scene = GaussianScene(means, quats, scales=torch.ones(2, 3), opacities=torch.tensor([0.5, 0.5]))
    >>> camera = Camera(torch.tensor([[1.0, 0, 0.5], [0, 1, 0.5], [0, 0, 1]]), torch.eye(4), width=1, height=1)
    >>> image, alpha = render(scene, camera, torch.tensor([[1.0, 0, 0], [0, 0, 1]]))  # red before blue
    >>> image.tolist(), alpha.tolist()
    ([[[0.5, 0.0, 0.25]]], [[0.75]])
    """
    options = {"backend": backend, "rasterize_mode": rasterize_mode, "settings": settings, "dtype": dtype}
    return next(render_views(scene, [camera], values, **options))


def render_views(
    scene: GaussianScene,
    cameras: Iterable[Camera],
    values: Float[Tensor, "n c"],
    *,
    backend: BackendName = "auto",
    rasterize_mode: RasterizeMode = "classic",
    settings: RasterSettings | None = None,
    dtype: torch.dtype | None = None,
) -> Iterator[tuple[Float[Tensor, "h w c"], Float[Tensor, "h w"]]]:
    """Yield the result of `render` for each camera. The Gaussians are prepared only once."""
    if len(values) != len(scene):
        raise InputError(f"values must have shape [{len(scene)}, C], one row per Gaussian, got {tuple(values.shape)}")
    job = _job(scene, rasterize_mode, settings, dtype)
    _, chosen = choose_backend(backend, job)
    for camera in cameras:
        with torch.no_grad():
            image = chosen.composite(job, camera, values)
        yield image


def render_image(
    scene: Scene,
    camera: Camera,
    *,
    settings: RasterSettings | None = None,
    mode: RasterizeMode | None = None,
    gaussians: GaussianScene | None = None,
) -> UInt8[Tensor, "h w 3"]:
    """Render the trained scene in sRGB on its background, with the scene's own renderer if it has one.

    The scene's own renderer needs only the camera. The other arguments are for scenes without a renderer.

    Args:
        scene: Scene to render.
        camera: Camera of the image.
        settings: Constants of the rasterizer (default: those of gsplat 1.4.0).
        mode: rasterize_mode (default: that of the training).
        gaussians: Gaussians of the scene on the rendering device (default: those of `scene`).

    Returns:
        The image on the CPU.
    """
    if scene.renderer is not None:
        return scene.renderer(camera)
    gaussians = gaussians or scene.gaussians
    nothing = gaussians.means[:, :0]
    return render_with_image(scene, camera, nothing, settings=settings, mode=mode, gaussians=gaussians)[0]


def render_with_image(
    scene: Scene,
    camera: Camera,
    values: Float[Tensor, "n c"],
    *,
    settings: RasterSettings | None = None,
    mode: RasterizeMode | None = None,
    gaussians: GaussianScene | None = None,
) -> tuple[UInt8[Tensor, "h w 3"], Float[Tensor, "h w c"], Float[Tensor, "h w"]]:
    """Return the results of `render_image`, on the CPU, and of `render`.

    Both are computed in one pass over the Gaussians, unless the scene has its own renderer.

    Args:
        values: Values per Gaussian, as in `render`, on the rendering device.
        scene, camera, settings, mode, gaussians: As in `render_image`.
    """
    gaussians = gaussians or scene.gaussians
    options = {"rasterize_mode": mode or scene.rasterize_mode, "settings": settings}
    if scene.renderer is not None:
        return scene.renderer(camera), *render(gaussians, camera, values, **options)
    image, alpha = render(gaussians, camera, torch.cat([scene.colors(camera).to(values), values], dim=1), **options)
    color = image[:, :, :3] + (1 - alpha)[:, :, None] * scene.background.to(image)
    return (color.clamp(0, 1) * 255).round().to(torch.uint8).cpu(), image[:, :, 3:], alpha


def _job(
    scene: GaussianScene,
    rasterize_mode: str = "classic",
    settings: RasterSettings | None = None,
    dtype: torch.dtype | None = None,
    weight_power: int = 1,
) -> RasterJob:
    if rasterize_mode not in ("classic", "antialiased"):
        raise InputError(f'rasterize_mode must be "classic" or "antialiased", got {rasterize_mode!r}')
    if (dtype := dtype or scene.means.dtype) not in (torch.float32, torch.float64):
        raise InputError(f"dtype must be torch.float32 or torch.float64, got {dtype}; pass dtype=torch.float32")
    job = RasterJob(scene, rasterize_mode == "antialiased", settings or RasterSettings(), dtype, weight_power)
    if job.is_2d and job.antialiased:
        raise InputError('2D Gaussians need rasterize_mode "classic", got "antialiased"')
    if job.is_2d and job.settings.per_axis:
        raise InputError(
            "2D Gaussians need the rules of gsplat 1.4, got those of a later version; use "
            f"{option_setting('gsplat_version', '1.4')}"
        )
    return job


def _batches(
    views: Iterator[tuple[Camera, Tensor, int | None]], batch_size: Callable[[Camera], int]
) -> Iterator[list[tuple[Camera, Tensor, int | None]]]:
    """Yield batches of consecutive views of the same size."""
    for _, group in groupby(views, key=lambda view: (view[0].width, view[0].height)):
        same_size = iter(group)
        for first in same_size:
            yield [first, *islice(same_size, batch_size(first[0]) - 1)]


def _zip_views(
    cameras: Iterable[Camera], labels: Iterable[Tensor], num_regions: Iterable[int] | None
) -> Iterator[tuple[Camera, Tensor, int | None]]:
    end: Any = object()
    streams: list[Iterable[Any]] = [cameras, labels, *([] if num_regions is None else [num_regions])]
    for index, items in enumerate(zip_longest(*streams, fillvalue=end)):
        for name, item in zip(("cameras", "labels", "num_regions"), items):
            if item is end:
                raise InputError(
                    f"{name} has {index} item{'s' * (index != 1)}, but another argument has more; every view needs a "
                    "camera, a label map and, if num_regions is given, a number of regions"
                )
        yield items[0], items[1], items[2] if num_regions is not None else None


def _check_map(index: int, camera: Camera, labels: Tensor) -> None:
    kind = labels.dtype if isinstance(labels, Tensor) else type(labels).__name__
    if isinstance(kind, str) or kind.is_floating_point or kind.is_complex or kind == torch.bool:
        raise InputError(f"labels of view {index} must be an integer tensor, got {kind}")
    if tuple(labels.shape) != (camera.height, camera.width):
        raise InputError(
            f"labels of view {index} have shape {tuple(labels.shape)}, expected the size of its camera, "
            f"({camera.height}, {camera.width})"
        )


def _check_range(index: int, low: int, high: int, count: int | None) -> int:
    """Check the range of the labels of a view, and return its number of regions."""
    if low < MASKED:
        raise InputError(
            f"labels of view {index} contain {low}, expected region ids >= 0, -1 (unlabeled) or -2 (masked)"
        )
    if count is not None and not 0 <= count <= MAX_REGIONS:
        raise InputError(f"num_regions of view {index} must be in 0..{MAX_REGIONS}, got {short_repr(count)}")
    if high >= (MAX_REGIONS if count is None else count):
        expected = f"{MAX_REGIONS}; number the regions of a view 0, 1, …" if count is None else f"num_regions ({count})"
        raise InputError(f"labels of view {index} contain region {high}, expected ids below {expected}")
    return max(high, UNLABELED) + 1 if count is None else count


@check_arguments
class Contributors(NamedTuple):
    """Gaussians that contribute to P pixels.

    Entries offsets[p] to offsets[p + 1] - 1 belong to pixel p, nearest first.

    >>> import torch
    >>> result = Contributors(torch.tensor([0, 2, 3]), torch.tensor([4, 7, 4]), torch.tensor([0.5, 0.25, 0.9]))
    >>> result.gaussian[result.offsets[0] : result.offsets[1]].tolist()  # for the first pixel
    [4, 7]
    """

    offsets: Int64[Tensor, " p_plus_1"]
    gaussian: Int64[Tensor, " m"]
    """Indices of the Gaussians in the scene."""
    weight: Float[Tensor, " m"]
    """Weights A_pj in 0..1. The weights of a pixel add up to its alpha."""


@check_arguments
def contributors(
    scene: GaussianScene,
    camera: Camera,
    pixels: Int[Tensor, "p 2"],
    *,
    backend: BackendName = "auto",
    rasterize_mode: RasterizeMode = "classic",
    settings: RasterSettings | None = None,
    dtype: torch.dtype | None = None,
) -> Contributors:
    """Return the Gaussians that contribute to pixels, with their compositing weights A_pj (eq. 1 of the paper).

    The weights are exact, because each pixel is rasterized as a region. The sum of A_pj over the pixels of a region is
    therefore the evidence E_js of `rasterize_evidence` with weight_power 1. The sum over j of A_pj times the values of
    the Gaussians is the result of `render`.

    Args:
        scene: N Gaussians. Gaussians with invalid parameters (see `GaussianScene.drawable`) do not contribute.
        camera: Camera of the image.
        pixels: (column, row) from the upper left corner. A pixel may occur several times.
        backend: As in `rasterize_evidence`.
        rasterize_mode: As in `rasterize_evidence`.
        settings: As in `rasterize_evidence`.
        dtype: As in `rasterize_evidence`.

    Returns:
        One list per pixel, in the order of the pixels, on the device of the scene.

    Raises:
        ValueError: If pixels are not integers or are outside the image, an option is invalid, or the backend does not
            support the scene.

    >>> import torch
    >>> from normlift_ns import Camera, GaussianScene, contributors
    >>> means, quats = torch.tensor([[0.0, 0, 2], [0, 0, 1]]), torch.tensor([[1.0, 0, 0, 0]]).expand(2, 4)
    >>> scene = GaussianScene(means, quats, scales=torch.ones(2, 3), opacities=torch.tensor([0.5, 0.5]))
    >>> camera = Camera(torch.tensor([[1.0, 0, 0.5], [0, 1, 0.5], [0, 0, 1]]), torch.eye(4), width=1, height=1)
    >>> result = contributors(scene, camera, torch.tensor([[0, 0]]))
    >>> result.offsets.tolist(), result.gaussian.tolist(), result.weight.tolist()
    ([0, 2], [1, 0], [0.5, 0.25])
    """
    device = scene.means.device
    pixels = _check_pixels(pixels, camera).to(device)
    position, region = (pixels[:, 1] * camera.width + pixels[:, 0]).unique(return_inverse=True)
    labels = torch.full((camera.height * camera.width,), MASKED, dtype=torch.int32, device=device)
    labels[position] = torch.arange(len(position), dtype=torch.int32, device=device)
    options = {"backend": backend, "rasterize_mode": rasterize_mode, "settings": settings, "dtype": dtype}
    shape = (camera.height, camera.width)
    rows = rasterize_evidence(scene, [camera], [labels.view(shape)], num_regions=[len(position)], **options).rows
    pose = camera.world_to_camera.to(scene.means)
    depth = scene.means @ pose[2, :3] + pose[2, 3]
    gaussian, column = rows.row_index(), rows.column.long()
    order = depth[gaussian].argsort(stable=True)
    order = order[column[order].argsort(stable=True)]
    by_position = SparseRows(row_offsets(column, len(position)), gaussian[order].int(), rows.weight[order])
    by_pixel = by_position.select_rows(region)
    return Contributors(by_pixel.offsets, by_pixel.column.long(), by_pixel.weight)


def _check_pixels(pixels: Tensor, camera: Camera) -> Int64[Tensor, "p 2"]:
    size = pixels.new_tensor([camera.width, camera.height])
    outside = ((pixels < 0) | (pixels >= size)).any(dim=1).nonzero()
    if len(outside) > 0:
        first = int(outside[0])
        raise InputError(
            f"pixels[{first}] is {tuple(pixels[first].tolist())}, expected (column, row) in an image of {camera.width} "
            f"columns and {camera.height} rows, counted from 0"
        )
    return pixels.long()


# Colors of Gaussians.


def view_colors(
    means: Float[Tensor, "n 3"], coefficients: Float[Tensor, "n k 3"], camera: Camera, degree: int | None
) -> Float[Tensor, "n 3"]:
    """Return RGB >= 0 of every Gaussian, as splatfacto and gsplat.rasterization compute it.

    Args:
        means: Centers of the Gaussians.
        coefficients: features_dc and features_rest of a checkpoint, [N, 1 + rest, 3].
        camera: Camera of the image.
        degree: Degree of the spherical harmonics with (degree + 1) ** 2 <= K, or None if the coefficients are logits.
    """
    if degree is None:
        return torch.sigmoid(coefficients[:, 0])
    from gsplat.cuda._torch_impl import _spherical_harmonics  # noqa: PLC0415 (slow import)

    pose = camera.world_to_camera.to(means)
    center = -pose[:3, :3].T @ pose[:3, 3]
    return (_spherical_harmonics(degree, means - center, coefficients) + 0.5).clamp(min=0)


def rotate_harmonics(coefficients: Float[Tensor, "n k 3"], rotation: Float64[Tensor, "3 3"]) -> Float[Tensor, "n k 3"]:
    """Return the coefficients of the spherical harmonics after a rotation of the Gaussians and their colors.

    The matrix that rotates coefficients is computed by least squares from harmonics in many directions.

    Args:
        coefficients: Coefficients of the spherical harmonics without the constant term, in gsplat's order.
        rotation: Rotation of the Gaussians.
    """
    from gsplat.cuda._torch_impl import _eval_sh_bases_fast  # noqa: PLC0415 (slow import)

    size = coefficients.shape[1] + 1
    directions = torch.randn(8 * size, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    directions = directions / directions.norm(dim=1, keepdim=True)
    before, after = (_eval_sh_bases_fast(size, points)[:, 1:] for points in (directions @ rotation, directions))
    matrix = torch.linalg.lstsq(after, before).solution
    return (matrix.to(coefficients) @ coefficients) if size > 1 else coefficients


# Compositing weights along a ray, computed in 3D without an image.


_MAX_ALPHA, _MIN_ALPHA = 0.999, 1 / 255
"""Largest alpha, and smallest alpha that is not ignored, as in the rasterizer."""
_MIN_SCALE_RATIO = 1e-4
"""Smallest ratio of a standard deviation to the largest one of the same Gaussian. Smaller standard deviations are
raised to this ratio, so that rays can hit the edges of flat Gaussians."""


def ray_weights(
    scene: GaussianScene, origin: Float[Tensor, " 3"], direction: Float[Tensor, " 3"]
) -> Float[Tensor, " n"]:
    """Return the weight alpha_j prod_{k<j} (1 - alpha_k) of every Gaussian along a ray, or 0 if the ray misses it.

    alpha_j is the opacity times the largest value of the Gaussian along the ray. Gaussians are sorted by the distance
    of this maximum from the origin. The Gaussians are not blurred, so the result does not depend on the
    resolution of an image.

    Args:
        scene: N Gaussians.
        origin: Start of the ray in world units. The ray misses Gaussians whose maximum lies behind it.
        direction: Direction of the ray, of any length > 0.
    """
    out = scene.means.new_zeros(len(scene))
    rows = scene.drawable.nonzero().squeeze(1)
    means, quats, scales = (x[rows].double() for x in (scene.means, scene.quats, scene.scales))
    scales = scales.clamp(min=1e-12).maximum(_MIN_SCALE_RATIO * scales.amax(dim=1, keepdim=True))
    forward = torch.nn.functional.normalize(direction.to(means), dim=0)
    quats = torch.nn.functional.normalize(quats, dim=1)
    start = to_axes(origin.to(means) - means, quats) / scales  # in standard deviations along the axes of each Gaussian
    step = to_axes(forward.expand_as(means), quats) / scales
    distance = -(start * step).sum(1) / (step * step).sum(1)
    square = (start + distance[:, None] * step).square().sum(1)
    alpha = (scene.opacities[rows].double() * torch.exp(-square / 2)).clamp(max=_MAX_ALPHA)
    hit = ((alpha >= _MIN_ALPHA) & (distance > 0)).nonzero().squeeze(1)
    hit = hit[distance[hit].argsort(stable=True)]
    transmittance = (1 - alpha[hit]).cumprod(0)
    before = torch.cat([transmittance.new_ones(1), transmittance])[: len(hit)]
    out[rows[hit]] = (alpha[hit] * before).to(out)
    return out


def to_axes(vectors: Float[Tensor, "n 3"], quats: Float[Tensor, "n 4"]) -> Float[Tensor, "n 3"]:
    """Rotate world vectors into the axes of Gaussians with unit quaternions (w, x, y, z)."""
    real, imaginary = quats[:, :1], -quats[:, 1:]
    turn = 2 * torch.linalg.cross(imaginary, vectors)
    return vectors + real * turn + torch.linalg.cross(imaginary, turn)
