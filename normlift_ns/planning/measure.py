"""A short look at a capture: a few views are encoded and rasterized for real, and some Gaussians lifted.

Nothing is kept of it, and nothing downloaded. What is in the cache is looked up, and not computed again.
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
LOOKED_AT = 4
"""Views that are rasterized for real, at most, and encoded; more are encoded where several are cut at a time."""
_LOADED = 3.0
"""Seconds that kernels take at most to be loaded; longer, they were compiled, which is done once."""
_ENOUGH = 20.0
"""Seconds of the first view from which on only as many others are looked at as are cut at a time: how many of these
seconds were loading is not known."""
_LOOKED_UP = 16
"""Views that are looked up in the cache, at most."""


class _Look(NamedTuple):
    """Some views, and the seconds that it took to see them."""

    block: Block
    seconds: float


def load_kernels(scene: Scene, options: LiftOptions, *, device: str = "cpu", clock: Clock = perf_counter) -> float:
    """Loads or compiles the kernels of a lift; returns the seconds that the next process will need for it."""
    gaussians = scene.gaussians.to(device)
    ready = get_ready(scene, gaussians, options, drawing_of(scene, gaussians, options))
    return min(_LOADED, _seconds(ready, clock=clock, device=device)[0])


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
    """Looks at a few views of a scene as a lift would.

    Args:
        source: as in `lift_scene`.
        cache: folder of 2D features and evidence, which is read.
        before: seconds of what a lift does before it looks at views, by name: start, open, kernels, check.
        clock: tells seconds; `time.process_time` for those of all cores.
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

    def look(indices: Sequence[int], seen: FeatureSource) -> _Look:
        how = {"rendered": rendered, "divisor": options.lift_downscale, "done": lambda view: None}
        seconds, block = timed(lambda: observe_views(scene, indices, seen, **how))
        return _Look(block, seconds)

    chosen = [used[i] for i in spread(len(used), _LOOKED_UP)]
    kept: dict[int, Block] = {}
    there = only_kept(source, cache)
    if options.reuse_evidence:
        for index in chosen:
            with suppress(NotKeptError):
                kept[index] = look([index], there).block
    new = [index for index in chosen if index not in kept]
    at_once = cut_at_once(source)
    encoded = [new[i] for i in spread(len(new), max(LOOKED_AT, 1 + 2 * at_once))]
    seen, load_s = _seen(encoded, partial(look, seen=source), at_once)
    kept_s = look(list(kept)[:_LOOKED_UP], there).seconds / len(kept) if len(kept) > 0 else None
    some = _joined([seen.block, *kept.values()], LOOKED_AT)
    with tempfile.TemporaryDirectory(prefix="normlift-plan-") as folder:
        rasterize = partial(_evidence, gaussians, some, scene, options, drawing, Path(folder))
        if cuda:  # kernels for labels like these are compiled once for all lifts
            _evidence(gaussians, some, scene, options, drawing, Path(folder) / "first")
        evidence_s, evidence = timed(rasterize)
        kept_evidence_s, _ = timed(rasterize)
        saved_s, _ = timed(lambda: evidence.save(Path(folder) / "again.safetensors"))
        saved = (Path(folder) / "again.safetensors").stat().st_size
    count = len(some.cameras)
    held = torch.cuda.max_memory_allocated(device) if cuda else None  # the plan adds what the core needs
    rates, field_bytes = core_rates(gaussians, evidence, torch.cat(some.features), options, len(used), timed)
    entries = evidence.nnz + evidence.unlabeled.weight.numel()
    maps = sum(labels.numel() * 2 + rows.numel() * 4 for labels, rows in zip(some.labels, some.features))
    return Facts(
        device=_named(device),
        views=len(used),
        gaussians=len(gaussians),
        dimension=some.features[0].shape[1],
        regions=sum(map(len, some.features)) / count,
        entries=entries / count,
        entry_bytes=4 + evidence.rows.weight.element_size(),
        before_s=before or {},
        load_s=load_s,
        features_s=seen.seconds / len(seen.block.cameras) if len(seen.block.cameras) > 0 else None,
        kept_features_s=kept_s,
        features_kept=len(kept) / len(chosen),
        evidence_s=evidence_s / count,
        kept_evidence_s=kept_evidence_s / count,
        evidence_kept=_evidence_kept(gaussians, seen, kept, len(chosen), scene, options, drawing, cache),
        core_s=rates,
        field_bytes=field_bytes,
        run_bytes=sum(value.numel() * value.element_size() for value in scene.parameters.values()),
        write_bytes_s=saved / max(saved_s, 1e-6),
        view_bytes=maps / count,
        host_bytes=round((peak_gib() or 0.0) * 2**30),
        device_bytes=held,
        looked_at=max(count, len(seen.block.cameras)),
    )


def _seen(indices: Sequence[int], look: Callable[[Sequence[int]], _Look], at_once: int) -> tuple[_Look, float]:
    """Views as a lift sees them once networks are loaded, and the seconds until they are."""
    if len(indices) == 0:
        return _Look(Block([], [], [], []), 0.0), 0.0
    first = look(indices[:1])
    if len(indices) == 1:
        return first, 0.0
    others = indices[1 : 1 + at_once if first.seconds > _ENOUGH else None]
    rest = look(others)
    each = rest.seconds / len(others)
    return _Look(_joined([first.block, rest.block]), each * (1 + len(others))), max(0.0, first.seconds - each)


def _joined(blocks: Sequence[Block], most: int | None = None) -> Block:
    """The views of all blocks, as far as there are no more than `most`."""
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


def _evidence_kept(
    gaussians: GaussianScene,
    seen: _Look,
    kept: Mapping[int, Block],
    looked_up: int,
    scene: Scene,
    options: LiftOptions,
    drawing: Drawing,
    cache: Path,
) -> float:
    """Share of the views whose evidence is in the cache; views whose features are there count for those."""
    if not options.reuse_evidence:
        return 0.0
    facts = [scene.rasterize_mode, options.weight_power, str(drawing.dtype), asdict(drawing.settings), drawing.backend]
    share = 0.0
    for block, views in ((_joined(list(kept.values())), len(kept)), (seen.block, looked_up - len(kept))):
        known = known_views(cache / "evidence", view_keys(gaussians, block, facts))
        share += sum(known) / max(1, len(known)) * views / looked_up
    return share


def _named(device: str) -> str:
    if torch.device(device).type != "cuda":
        return f"{device}, {torch.get_num_threads()} threads"
    return torch.cuda.get_device_name(device)


def _seconds(work: Callable[[], Result], *, clock: Clock, device: str) -> tuple[float, Result]:
    """What some work takes, on a GPU until it is done there, and what it gives."""
    start = clock()
    found = work()
    if torch.device(device).type == "cuda":
        torch.cuda.synchronize(device)
    return clock() - start, found
