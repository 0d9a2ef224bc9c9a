"""Collection of 2D features and evidence from the views of a scene, in batches whose results are cached."""

from __future__ import annotations

import json
import os
import warnings
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, replace
from functools import cached_property, lru_cache
from hashlib import blake2b
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple, Protocol

import torch
from jaxtyping import Float, Int32, Int64
from torch import Tensor
from xxhash import xxh3_128

from normlift_ns.core.device import prefetch_map
from normlift_ns.core.evidence import MASKED, Evidence
from normlift_ns.core.gaussians import Camera, GaussianScene
from normlift_ns.core.scene import Scene, View
from normlift_ns.data.images import filled_function, label_undistortion
from normlift_ns.encoders.base import (
    FeatureSource,
    PrecomputedFeatures,
    RegionFeatures,
    StoredMaps,
    iterate_view_features,
)
from normlift_ns.encoders.cache import CachedRegions, cached
from normlift_ns.errors import InputError
from normlift_ns.io.arrays import read_metadata
from normlift_ns.options import BackendName, LiftOptions, RasterizeMode, option_name, option_setting
from normlift_ns.rasterization.rasterize import rasterize_evidence, render_image
from normlift_ns.rasterization.settings import RasterSettings
from normlift_ns.segmentation.regions import LabelFiles

if TYPE_CHECKING:
    from normlift_ns.encoders.langsplat import FeatureExport
    from normlift_ns.progress import StageTimer

_MAX_CHUNK = 16
_READERS = 8
"""Number of images to read ahead in parallel while the current image is processed or a network loads."""
_MIN_SIDE = 8
"""Minimum side length of a downscaled image, in pixels."""
_CACHE_VERSION = "normlift_ns.block/6"
"""Version in every key of the evidence cache; increase it if evidence changes for the same input."""


@dataclass(frozen=True)
class RasterConfig:
    """Rasterization settings of a lift."""

    gsplat_version: str
    """gsplat version whose rasterization rules apply."""
    backend: BackendName
    """Rasterization backend, already resolved from auto."""
    dtype: torch.dtype
    rasterize_mode: RasterizeMode
    weight_power: int
    """Exponent of the rasterization weights A_ij in the evidence."""
    clip_planes: tuple[float, float] | None = None
    """Near and far planes of the training, in world units; None for those of splatfacto."""

    @property
    def settings(self) -> RasterSettings:
        """Constants of the rasterization rules."""
        return RasterSettings.recorded({"gsplat_rules": self.gsplat_version, "clip_planes": self.clip_planes})

    @property
    def options(self) -> dict[str, Any]:
        """Keyword arguments for `rasterize_evidence`."""
        names = ("backend", "rasterize_mode", "weight_power", "settings", "dtype")
        return {name: getattr(self, name) for name in names}

    @property
    def key(self) -> list[Any]:
        """Settings in every key of the evidence cache, as JSON types."""
        return [self.rasterize_mode, self.weight_power, str(self.dtype), asdict(self.settings), self.backend]


class ViewObservations(NamedTuple):
    """Evidence of one or more views, with the features and levels of their regions."""

    evidence: Evidence
    features: Float[Tensor, "s d"]
    level: Int64[Tensor, " s"]

    @staticmethod
    def of_block(block: ViewBatch, evidence: Evidence) -> ViewObservations:
        """Combine the evidence of a batch of views with the features and levels of its regions."""
        levels = [region_levels(regions, len(rows)) for regions, rows in zip(block.regions, block.features)]
        return ViewObservations(evidence, torch.cat(block.features), torch.cat(levels))

    @staticmethod
    def merge(parts: Iterable[ViewObservations]) -> ViewObservations:
        """Concatenate the observations of several groups of views, in the given order."""
        evidence, features, level = zip(*parts)
        return ViewObservations(Evidence.merge(*evidence), torch.cat(features), torch.cat(level))


class Kernels(Protocol):
    """Kernels that are compiled in the background; see `pipeline.KernelWarmUp`."""

    def start_lift(self, dimension: int) -> None: ...  # noqa: D102

    def wait_for_evidence(self) -> None: ...  # noqa: D102

    def wait(self) -> None: ...  # noqa: D102


@dataclass(frozen=True)
class EvidenceCollection:
    """Collection of evidence from some training views, one chunk of views at a time.

    The results of a chunk are cached, so an interrupted lift can resume.
    """

    scene: Scene
    gaussians: GaussianScene
    """Gaussians of the scene, on the device that rasterizes."""
    views: Sequence[int]
    """Indices of the training views to lift."""
    missing: Sequence[str]
    """Names of the training images without features."""
    source: FeatureSource
    options: LiftOptions
    config: RasterConfig
    cache: Path
    """Directory of cached features and evidence."""
    export: FeatureExport | None
    """Destination of the 2D features; None for no export."""

    @cached_property
    def _cached_source(self) -> FeatureSource:
        source = cached(self.source, self.cache) if self.options.reuse_evidence else self.source
        return downscaled_source(source, self.options.lift_downscale)

    def collect(self, stages: StageTimer, kernels: Kernels) -> ViewObservations:
        """Collect evidence, features and levels from all views.

        Args:
            stages: Timer of the lift, which reports progress.
            kernels: Kernels that are being compiled in the background.
        """
        parts = [self.collect_chunk(chunk, stages, kernels) for chunk in chunk_views(self.views)]
        with stages("evidence", len(self.views)):
            views = ViewObservations.merge(parts)
            kernels.wait()
        return views._replace(features=views.features.to(self.gaussians.means.device, self.config.dtype))

    def collect_chunk(self, chunk: Sequence[int], stages: StageTimer, kernels: Kernels) -> ViewObservations:
        """Collect evidence, features and levels from one chunk of the views; see `collect`."""
        source = self._cached_source
        rendered = self.config.settings if self.options.image_source == "render" else None
        with stages("features", len(self.views)) as step:

            def done(view: View) -> None:
                if self.export is not None:
                    self.export.write(source, view.image, view.name)
                step()

            divisor = self.options.lift_downscale
            block = observe_views(self.scene, chunk, source, render_settings=rendered, downscale=divisor, on_view=done)
        kernels.start_lift(block.features[0].shape[1])
        with stages("evidence", len(self.views)) as step:
            evidence = batch_evidence(
                self.gaussians, block, self.cache / "evidence", self.config,
                reuse=self.options.reuse_evidence, on_view=step, wait_for_kernels=kernels.wait_for_evidence,
            )  # fmt: skip
        return ViewObservations.of_block(block, evidence)


def region_levels(regions: Int32[Tensor, "levels c"], count: int) -> Int64[Tensor, " r"]:
    """Return, for each of `count` regions, the first level that contains it, or 0 if it has no cells.

    >>> region_levels(torch.tensor([[0, 0, -1], [1, 2, 2]], dtype=torch.int32), 3).tolist()
    [0, 1, 1]
    """
    level = torch.zeros(count, dtype=torch.int64)
    for number, of_cell in reversed(list(enumerate(regions))):
        level[of_cell[of_cell >= 0].long()] = number
    return level


class ViewBatch(NamedTuple):
    """Batch of views, as input to the rasterizer and the lift."""

    cameras: list[Camera]
    labels: list[Int32[Tensor, "h w"]]
    """Cell of every pixel, -1 if unlabeled, -2 if masked. On each level, the pixels of a cell share a region."""
    regions: list[Int32[Tensor, "levels c"]]
    """Region of every cell on every level; -1 for no region."""
    features: list[Float[Tensor, "r d"]]


def chunk_views(views: Sequence[int], processes: int = 1) -> list[Sequence[int]]:
    """Split views into chunks of at most 16; an interrupted lift loses the results of at most one chunk per process.

    Every process gets the same number of chunks, if there are enough views, and the sizes of chunks differ by at most
    one view. The evidence of a view does not depend on the other views in its chunk.

    >>> [[len(chunk) for chunk in chunk_views(range(45), processes)] for processes in (1, 2)]
    [[15, 15, 15], [12, 11, 11, 11]]
    """
    count = -(-len(views) // _MAX_CHUNK)
    count = processes * max(1, -(-count // processes))
    starts = [-(-len(views) * number // count) for number in range(count + 1)]
    return [views[first:last] for first, last in pairwise(starts) if first < last]


def sample_evenly(count: int, maximum: int | None) -> list[int]:
    """Return at most `maximum` of `count` indices, evenly spaced, with the first and (if `maximum` > 1) the last.

    >>> sample_evenly(10, 4)
    [0, 3, 6, 9]
    """
    if maximum is None or maximum >= count:
        return list(range(count))
    return torch.linspace(0, count - 1, maximum).round().long().tolist() if maximum > 1 else [0]


def observe_views(
    scene: Scene,
    indices: Sequence[int],
    source: FeatureSource,
    *,
    render_settings: RasterSettings | None,
    downscale: int,
    on_view: Callable[[View], None] = lambda view: None,
) -> ViewBatch:
    """Compute labels and features of some training views.

    Args:
        render_settings: Rasterization rules for renders of the trained scene, which replace the images. If None, use
            the images.
        downscale: Divisor of the size of images and cameras.
        on_view: Called after every view, with the view that the source received.
    Raises:
        ValueError, FileNotFoundError: As in `FeatureSource.view` and `check_undistorted`; also if an image, a mask or
            a label map differs in size from its camera.
    """
    source = undistorting_source(downscaled_source(source, downscale), label_undistortion(scene.train))
    if isinstance(source, RegionFeatures) and render_settings is None:
        source = replace(source, filled=filled_function(scene.train))
    waiting = deque[View]()

    def images() -> Iterator[tuple[Tensor, str]]:
        for read in prefetch_map(scene.train.__getitem__, indices, _READERS):
            image = (
                read.image if render_settings is None else render_image(scene, read.camera, settings=render_settings)
            )
            view = read._replace(image=image)
            _check_sizes(view)
            waiting.append(_downscaled(view, downscale) if downscale > 1 else view)
            check_undistorted(source, view, waiting[-1])
            yield waiting[-1].image, view.name

    block = ViewBatch([], [], [], [])
    for result in iterate_view_features(source, images()):
        view, labels = waiting.popleft(), result.labels
        if labels.shape != view.image.shape[:2]:
            raise InputError(
                f"the labels of {view.name} have size {tuple(labels.shape)} (height x width), but the image has size "
                f"{tuple(view.image.shape[:2])}; make the feature source return labels of the size of the image"
            )
        block.cameras.append(view.camera)
        block.labels.append(labels if view.mask is None else labels.where(view.mask, MASKED))
        block.regions.append(result.region_of_cell)
        block.features.append(result.features)
        on_view(view)
    return block


def downscaled_source(source: Any, divisor: int) -> Any:
    """Return a feature source that also accepts label maps that have the size of the images before downscaling."""
    return _replace_in_source(source, LabelFiles | PrecomputedFeatures, divisor=divisor)


def undistorting_source(source: Any, undistort: Callable[[str, Any], Any] | None) -> Any:
    """Return a feature source that undistorts its label maps; see `label_undistortion`."""
    return source if undistort is None else _replace_in_source(source, LabelFiles, undistort=undistort)


def _replace_in_source(source: Any, kinds: Any, **fields: Any) -> Any:
    if isinstance(source, kinds) and any(getattr(source, name) != value for name, value in fields.items()):
        return replace(source, **fields)
    for name in {RegionFeatures: ("regions",), CachedRegions: ("inner",)}.get(type(source), ()):
        part = getattr(source, name)
        if (other := _replace_in_source(part, kinds, **fields)) is not part:
            return replace(source, **{name: other})
    return source


def _check_sizes(view: View) -> None:
    expected = (view.camera.height, view.camera.width)
    for name, size in (("image", view.image.shape[:2]), ("mask", expected if view.mask is None else view.mask.shape)):
        if tuple(size) != expected:
            raise InputError(
                f"the {name} of {view.name} is {tuple(size)}, but its camera is {expected} (height x width); images, "
                "masks and cameras must have the same size"
            )


def batch_evidence(
    gaussians: GaussianScene,
    block: ViewBatch,
    folder: Path,
    config: RasterConfig,
    *,
    reuse: bool,
    on_view: Callable[[], None],
    wait_for_kernels: Callable[[], None] = lambda: None,
) -> Evidence:
    """Return the evidence of the regions of a batch of views, summed over the cells of each region.

    The folder caches the cell evidence of each view. If `reuse` is True, the function reuses the cached evidence of a
    view with the same Gaussians, camera, labels and rasterization settings. The regions and features of the view, and
    the other views of the batch, may differ.

    Args:
        on_view: Called after every view.
        wait_for_kernels: Called before rasterization, if any view is not cached.
    """
    keys = evidence_keys(gaussians, block, config)
    cached = find_cached_views(folder, keys) if reuse else {}
    missing = [view for view in range(len(keys)) if view not in cached]
    for _ in cached:
        on_view()
    if len(missing) > 0:
        wait_for_kernels()
        evidence = rasterize_evidence(
            gaussians,
            [block.cameras[view] for view in missing],
            [block.labels[view] for view in missing],
            num_regions=[block.regions[view].shape[1] for view in missing],
            progress=lambda *_: on_view(),
            **config.options,
        )
        cache_views(evidence, folder, [keys[view] for view in missing])
        cached.update((view, (evidence, index)) for index, view in enumerate(missing))
    return cells_to_regions(join_cached_views(cached).to(gaussians.means.device), block)


def cached_batch_evidence(
    gaussians: GaussianScene, block: ViewBatch, folder: Path, config: RasterConfig
) -> Evidence | None:
    """Return the evidence of the regions of a batch of views from the cache, or None if the cache lacks a view."""
    cached = find_cached_views(folder, evidence_keys(gaussians, block, config))
    return cells_to_regions(join_cached_views(cached), block) if len(cached) == len(block.cameras) else None


def evidence_keys(gaussians: GaussianScene, block: ViewBatch, config: RasterConfig) -> list[str]:
    """Return the cache key of each view's cell evidence, a digest of all inputs of the rasterization."""
    primitive = [] if gaussians.primitive == "3dgs" else [gaussians.primitive]
    scene = _digest(
        [_CACHE_VERSION, *config.key, *primitive],
        [gaussians.means, gaussians.quats, gaussians.scales, gaussians.opacities],
    )
    views = zip(block.cameras, block.labels, block.regions)
    return [
        _digest([scene, regions.shape[1]], [labels, camera.K, camera.world_to_camera])
        for camera, labels, regions in views
    ]


def cells_to_regions(evidence: Evidence, block: ViewBatch) -> Evidence:
    """Convert the evidence of the cells of a batch of views to evidence of their regions."""
    counts = torch.tensor([0, *(len(rows) for rows in block.features)])
    first = counts.cumsum(0).tolist()
    columns = [torch.where(regions >= 0, regions + start, -1) for regions, start in zip(block.regions, first)]
    region_view = torch.repeat_interleave(torch.arange(len(block.features)), counts[1:])
    return evidence.regroup(torch.cat(columns, dim=1), region_view.int())


def _digest(facts: Any, tensors: Sequence[Tensor]) -> str:
    key = xxh3_128(json.dumps(facts).encode())
    for tensor in tensors:
        key.update(f"{tensor.dtype}{tuple(tensor.shape)}".encode())
        key.update(tensor.detach().cpu().contiguous().numpy().tobytes())
    return key.hexdigest()


def _downscaled(view: View, divisor: int) -> View:
    """Downscale a view; raise InputError if a side would be shorter than 8 pixels."""
    camera = view.camera
    height, width = camera.height // divisor, camera.width // divisor
    if min(height, width) < _MIN_SIDE:
        raise InputError(
            f"{option_name('lift_downscale')} {divisor:,} reduces {view.name} from {camera.width} x {camera.height} "
            f"to {width} x {height} pixels; give a smaller number that leaves at least {_MIN_SIDE} pixels on each side"
        )
    return view.downscaled(height, width)


def check_undistorted(source: FeatureSource, *views: View) -> None:
    """Check that the label map of an undistorted image was not made from the original, distorted image.

    Undistortion crops an image by a few pixels, but may move its content by many. A map of a different size may
    therefore show the distorted image, so the function accepts only maps that have the size of one of the views.

    Args:
        views: The same view at every size that the label map may have.
    Raises:
        ValueError: The map has the wrong size. If the source resamples maps, the function warns instead. It also warns
            if undistortion did not change the size, because the size then proves nothing.
    """
    original_size, name = views[0].original, views[0].name
    maps = source.regions if isinstance(source, RegionFeatures) else source
    maps = maps.inner if isinstance(maps, CachedRegions) else maps
    if original_size is None or not isinstance(maps, StoredMaps) or getattr(maps, "undistort", None):
        return
    file, width, height = maps.size(name)
    sizes = [(view.camera.width, view.camera.height) for view in views]
    if (width, height) not in sizes:
        kind = ", the size of the original image" if (width, height) == original_size else ""
        to_size = f"the training undistorted the image to {sizes[0][0]}x{sizes[0][1]}"
        mismatch = f"is {width}x{height} (width x height){kind}; {to_size}"
        if not maps.resample:
            raise InputError(
                f"label map {file} of {name} {mismatch}. Make the label maps from the undistorted images, or give "
                f"{option_setting('regions_resample', True)} and accept that the maps may not fit the images exactly"
            )
        warnings.warn(f"label map {file} {mismatch}. The map is resized and may not fit exactly", stacklevel=2)
    elif (width, height) == original_size:
        warnings.warn(
            "the training undistorted the images without changing their size. Make sure that the label maps in "
            f"{file.parent} were made from the undistorted images",
            stacklevel=2,
        )


# Cache of the evidence of rasterized views. A file contains several views, and each view is looked up on its own.
#
# The name of a file is a digest of the keys of its views, and its header lists these keys. A view is therefore found
# in any file: if images are added between old ones, only the new images are rasterized.


_VIEWS = "views"
"""Header entry with the keys of the views, in order."""
_CACHED_HEADERS = 2**14
"""Maximum number of file headers that a process keeps in memory."""
CachedView = tuple[Evidence, int]
"""Evidence of one or more views, and the index of one of them."""


def cache_views(evidence: Evidence, folder: Path, keys: Sequence[str]) -> None:
    """Write the evidence of views to a file in a folder.

    Args:
        evidence: Evidence of the views.
        folder: Folder of the cache.
        keys: Digest of the inputs of each view, in the order of the views.

    Raises:
        OSError: The file cannot be written, for instance because the disk is full.
    """
    path = _cache_path(folder, keys)
    evidence.save(path, key=path.stem, remarks={_VIEWS: " ".join(keys)}, own=True)


def find_cached_views(folder: Path, keys: Sequence[str]) -> dict[int, CachedView]:
    """Return the cached views, keyed by their index in `keys`; skip files that are damaged or have a wrong name."""
    places: dict[int, CachedView] = {}
    for path, file_keys in _cached_files(folder, keys):
        wanted = [number for number, key in enumerate(keys) if number not in places and key in file_keys]
        with suppress(FileNotFoundError, ValueError):
            evidence = Evidence.load(path, key=path.stem) if len(wanted) > 0 else None
            if evidence is not None and evidence.num_views == len(file_keys):
                places.update((number, (evidence, file_keys.index(keys[number]))) for number in wanted)
        if len(places) == len(keys):
            break
    return places


def views_in_cache(folder: Path, keys: Sequence[str]) -> list[bool]:
    """Return, for each key, True if the header of a file in the folder lists it."""
    listed = {key for keys in _cache_headers(folder).values() for key in keys}
    return [key in listed for key in keys]


def join_cached_views(places: Mapping[int, CachedView]) -> Evidence:
    """Join the evidence of cached views, in ascending order of the keys of `places`."""
    runs: list[tuple[Evidence, list[int]]] = []
    for number in sorted(places):
        evidence, view = places[number]
        if len(runs) > 0 and runs[-1][0] is evidence and view not in runs[-1][1]:
            runs[-1][1].append(view)
        else:
            runs.append((evidence, [view]))
    device = runs[0][0].region_view.device
    parts = [
        evidence if views == list(range(evidence.num_views)) else evidence.select_views(views)
        for evidence, views in runs
    ]
    return parts[0] if len(parts) == 1 else Evidence.merge(*(part.to(device) for part in parts))


def _cache_path(folder: Path, keys: Sequence[str]) -> Path:
    name = blake2b(" ".join(keys).encode(), digest_size=16).hexdigest()
    return folder / f"{name}.safetensors"


def _cached_files(folder: Path, keys: Sequence[str]) -> Iterator[tuple[Path, list[str]]]:
    """Yield the files that contain any of the requested views, with the keys of all views in the file.

    A file with exactly the requested views comes first. The others follow by the number of requested views that they
    contain, largest first.
    """
    exact = _cache_path(folder, keys)
    if exact.is_file():
        yield exact, list(keys)
    headers, wanted = _cache_headers(folder), set(keys)
    counts = {path: len(wanted.intersection(file_keys)) for path, file_keys in headers.items()}
    paths = (path for path, count in counts.items() if count > 0 and path != exact)
    yield from ((path, headers[path]) for path in sorted(paths, key=lambda path: (-counts[path], path.name)))


def _cache_headers(folder: Path) -> dict[Path, list[str]]:
    """Return the view keys in the header of each file of a folder, by path."""
    try:
        with os.scandir(folder) as entries:
            files = [(entry.path, entry.stat()) for entry in entries if entry.name.endswith(".safetensors")]
    except OSError:
        return {}
    return {Path(path): _cache_header(path, stat.st_mtime_ns, stat.st_size).split() for path, stat in files}


@lru_cache(_CACHED_HEADERS)
def _cache_header(path: str, modified: int, size: int) -> str:
    """Return the view keys in the header of a file, separated by spaces; empty if the file is missing or damaged."""
    try:
        return read_metadata(Path(path)).get(_VIEWS, "")
    except (FileNotFoundError, ValueError):
        return ""
