"""Short measurement of a capture: encode and rasterize a few views, and lift some Gaussians.

The results are discarded, and nothing is downloaded. Cached views are read, not computed again.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict
from functools import partial
from itertools import chain, islice
from pathlib import Path
from time import perf_counter
from typing import Any, NamedTuple, TypeVar, cast

import torch

from normlift_ns.core.evidence import Evidence
from normlift_ns.core.gaussians import GaussianScene
from normlift_ns.core.scene import Scene
from normlift_ns.encoders.cache import NotKeptError, only_kept
from normlift_ns.encoders.source import FeatureSource, cut_at_once
from normlift_ns.lifting import Drawing, drawing_of, get_ready
from normlift_ns.observing import Block, block_evidence, observe_views, spread, view_keys
from normlift_ns.options import LiftOptions
from normlift_ns.planning.core import core_rates
from normlift_ns.planning.plan import Facts
from normlift_ns.raster.kept import known_views
from normlift_ns.stages import peak_gib

Clock = Callable[[], float]
Result = TypeVar("Result")
_MAX_VIEWS = 4
"""Maximum number of views that are rasterized and encoded. More are encoded if several are segmented in one batch."""
_MAX_LOAD_S = 3.0
"""Maximum number of seconds to load kernels. If it takes longer, they were compiled, which happens only once."""
_SLOW_FIRST_VIEW_S = 20.0
"""If the first view takes this many seconds, only one more batch is measured.

How many of these seconds were loading is unknown.
"""
_MAX_LOOKUPS = 16
"""Maximum number of views that are looked up in the cache."""


class _Observed(NamedTuple):
    """Some views, and the seconds that it took to observe them."""

    block: Block
    seconds: float


def load_kernels(scene: Scene, options: LiftOptions, *, device: str = "cpu", clock: Clock = perf_counter) -> float:
    """Load or compile the kernels of a lift; return the seconds that the next process will need for it."""
    gaussians = scene.gaussians.to(device)
    ready = get_ready(scene, gaussians, options, drawing_of(scene, gaussians, options))
    return min(_MAX_LOAD_S, _seconds(ready, clock=clock, device=device)[0])


def measure(
    scene: Scene,
    source: FeatureSource,
    options: LiftOptions,
    cache: Path,
    *,
    device: str = "cpu",
    before: Mapping[str, float] | None = None,
    clock: Clock = perf_counter,
) -> Facts:
    """Process a few views of a scene as a lift would.

    Args:
        source: as in `lift_scene`.
        cache: folder of 2D features and evidence, which is only read.
        before: seconds of the steps that precede the views, by name (start, open, kernels, check).
        clock: returns seconds; use `time.process_time` for the time of all cores.
    Raises:
        ValueError, FileNotFoundError, MemoryError: as `lift_scene`.
    """
    gaussians, views = scene.gaussians.to(device), scene.train
    drawing = drawing_of(scene, gaussians, options)
    cuda = torch.device(device).type == "cuda"
    timed = partial(_seconds, clock=clock, device=device)
    get_ready(scene, gaussians, options, drawing)()
    names = set(source.available(views.names))
    usable = [index for index, name in enumerate(views.names) if name in names]
    used = [usable[i] for i in spread(len(usable), options.max_views)]
    rendered = drawing.settings if options.image_source == "render" else None

    def observe(indices: Sequence[int], source: FeatureSource) -> _Observed:
        kwargs = {"rendered": rendered, "divisor": options.lift_downscale, "done": lambda view: None}
        seconds, block = timed(lambda: observe_views(scene, indices, source, **kwargs))
        return _Observed(block, seconds)

    chosen = [used[i] for i in spread(len(used), _MAX_LOOKUPS)]
    cached: dict[int, Block] = {}
    cached_source = only_kept(source, cache)
    if options.reuse_evidence:
        for index in chosen:
            with suppress(NotKeptError):
                cached[index] = observe([index], cached_source).block
    new = [index for index in chosen if index not in cached]
    batch = cut_at_once(source)
    encoded = [new[i] for i in spread(len(new), max(_MAX_VIEWS, 1 + 2 * batch))]
    observed, load_s = _observe_loaded(encoded, partial(observe, source=source), batch)
    cached_s = observe(list(cached)[:_MAX_LOOKUPS], cached_source).seconds / len(cached) if len(cached) > 0 else None
    block = _joined([observed.block, *cached.values()], _MAX_VIEWS)
    with tempfile.TemporaryDirectory(prefix="normlift-plan-") as folder:
        rasterize = partial(_evidence, gaussians, block, scene, options, drawing, Path(folder))
        if cuda:  # kernels for labels like these are compiled once for all lifts
            _evidence(gaussians, block, scene, options, drawing, Path(folder) / "first")
        evidence_s, evidence = timed(rasterize)
        cached_evidence_s, _ = timed(rasterize)
        saved_s, _ = timed(lambda: evidence.save(Path(folder) / "again.safetensors"))
        saved = (Path(folder) / "again.safetensors").stat().st_size
    count = len(block.cameras)
    device_bytes = torch.cuda.max_memory_allocated(device) if cuda else None  # the plan adds what the core needs
    rates, field_bytes = core_rates(gaussians, evidence, torch.cat(block.features), options, len(used), timed)
    entries = evidence.nnz + evidence.unlabeled.weight.numel()
    maps = sum(labels.numel() * 2 + rows.numel() * 4 for labels, rows in zip(block.labels, block.features))
    return Facts(
        device=_device_name(device),
        views=len(used),
        gaussians=len(gaussians),
        dimension=block.features[0].shape[1],
        regions=sum(map(len, block.features)) / count,
        entries=entries / count,
        entry_bytes=4 + evidence.rows.weight.element_size(),
        before_s=before or {},
        load_s=load_s,
        features_s=observed.seconds / len(observed.block.cameras) if len(observed.block.cameras) > 0 else None,
        kept_features_s=cached_s,
        features_kept=len(cached) / len(chosen),
        evidence_s=evidence_s / count,
        kept_evidence_s=cached_evidence_s / count,
        evidence_kept=_evidence_cached(gaussians, observed, cached, len(chosen), scene, options, drawing, cache),
        core_s=rates,
        field_bytes=field_bytes,
        run_bytes=sum(value.numel() * value.element_size() for value in scene.parameters.values()),
        write_bytes_s=saved / max(saved_s, 1e-6),
        view_bytes=maps / count,
        host_bytes=round((peak_gib() or 0.0) * 2**30),
        device_bytes=device_bytes,
        looked_at=max(count, len(observed.block.cameras)),
    )


def _observe_loaded(
    indices: Sequence[int], observe: Callable[[Sequence[int]], _Observed], batch: int
) -> tuple[_Observed, float]:
    """Observe views. Return them, with the seconds that it takes once networks are loaded, and the loading time."""
    if len(indices) == 0:
        return _Observed(Block([], [], [], []), 0.0), 0.0
    first = observe(indices[:1])
    if len(indices) == 1:
        return first, 0.0
    others = indices[1 : 1 + batch if first.seconds > _SLOW_FIRST_VIEW_S else None]
    rest = observe(others)
    each = rest.seconds / len(others)
    return _Observed(_joined([first.block, rest.block]), each * (1 + len(others))), max(0.0, first.seconds - each)


def _joined(blocks: Sequence[Block], most: int | None = None) -> Block:
    """Join the views of all blocks, up to `most` views."""
    parts = zip(Block([], [], [], []), *blocks)
    return Block(*(list(islice(chain.from_iterable(cast(Any, part)), most)) for part in parts))


def _evidence(
    gaussians: GaussianScene, block: Block, scene: Scene, options: LiftOptions, drawing: Drawing, folder: Path
) -> Evidence:
    return block_evidence(
        gaussians, block, folder,
        rasterize_mode=scene.rasterize_mode, settings=drawing.settings, backend=drawing.backend,
        weight_power=options.weight_power, dtype=drawing.dtype, reuse=True, done=lambda: None,
    )  # fmt: skip


def _evidence_cached(
    gaussians: GaussianScene,
    observed: _Observed,
    cached: Mapping[int, Block],
    chosen: int,
    scene: Scene,
    options: LiftOptions,
    drawing: Drawing,
    cache: Path,
) -> float:
    """Return the share of views whose evidence is cached. Views with cached features represent all such views."""
    if not options.reuse_evidence:
        return 0.0
    facts = [scene.rasterize_mode, options.weight_power, str(drawing.dtype), asdict(drawing.settings), drawing.backend]
    share = 0.0
    for block, views in ((_joined(list(cached.values())), len(cached)), (observed.block, chosen - len(cached))):
        hits = known_views(cache / "evidence", view_keys(gaussians, block, facts))
        share += sum(hits) / max(1, len(hits)) * views / chosen
    return share


def _device_name(device: str) -> str:
    if torch.device(device).type != "cuda":
        return f"{device}, {torch.get_num_threads()} threads"
    return torch.cuda.get_device_name(device)


def _seconds(work: Callable[[], Result], *, clock: Clock, device: str) -> tuple[float, Result]:
    """Return the duration of some work, until the GPU is done if there is one, and its result."""
    start = clock()
    result = work()
    if torch.device(device).type == "cuda":
        torch.cuda.synchronize(device)
    return clock() - start, result
