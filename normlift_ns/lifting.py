"""From a trained scene and a source of 2D features to a semantic field: the page to read first."""

from __future__ import annotations

import resource
import sys
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import asdict
from pathlib import Path
from typing import Any, NamedTuple

import torch

from normlift_ns.core.evidence import Evidence
from normlift_ns.core.field import SemanticField
from normlift_ns.core.lift import Scalars, lift
from normlift_ns.core.neighbors import nearest_neighbors
from normlift_ns.core.refine import refine, unsupported
from normlift_ns.core.scene import Scene, View
from normlift_ns.encoders.cache import cached
from normlift_ns.encoders.langsplat.source import write_langsplat
from normlift_ns.encoders.source import FeatureSource
from normlift_ns.observing import BLOCK, block_evidence, observe_views, spread
from normlift_ns.options import LiftOptions

Report = Callable[[str, int, int], None]
"""Called with (stage, steps done, steps in all)."""


class Export(NamedTuple):
    """Where 2D features go besides the lift."""

    folder: Path
    overwrite: bool
    """Replace files of other content."""


class LiftResult(NamedTuple):
    """A field and how it came about."""

    field: SemanticField
    seconds: dict[str, float]
    """Of each stage, in their order: features, evidence, lift, neighbors, vote, store."""


def lift_scene(
    scene: Scene,
    source: FeatureSource,
    options: LiftOptions,
    cache: Path,
    *,
    device: str = "cpu",
    encoder: Mapping[str, Any],
    export: Export | None = None,
    report: Report = lambda stage, done, total: None,
) -> LiftResult:
    """Lifts 2D features onto the Gaussians of a trained scene.

    Args:
        cache: folder for 2D features and evidence; made if missing, may be deleted at any time.
        device: where to rasterize, lift and vote.
        encoder: the options that queries need to encode texts likewise; kept in the manifest.
        export: where to write the 2D features too, in LangSplat's format.
        report: told of the progress.
    Raises:
        ValueError, FileNotFoundError: an image, a label map or an option that does not fit; the message names it.
        MemoryError: the GPU's memory does not hold the lift.
    """
    stages = _Stages(report)
    gaussians = scene.gaussians.to(device)
    dtype = torch.float64 if options.precision == "double" else torch.float32
    names = set(source.available(scene.train.names))
    usable = [index for index, name in enumerate(scene.train.names) if name in names]
    indices = [usable[i] for i in spread(len(usable), options.max_views)]
    seen = cached(source, cache) if options.reuse_evidence else source
    parts, tables = [], []
    for start in range(0, len(indices), BLOCK):
        chosen = indices[start : start + BLOCK]
        with stages("features", len(indices)) as step:

            def done(view: View, step: Callable[[], None] = step) -> None:
                if export is not None:
                    write_langsplat(seen, view.image, view.name, *export)
                step()

            rendered = options.image_source == "render"
            block = observe_views(scene, chosen, seen, rendered=rendered, divisor=options.lift_downscale, done=done)
            tables.extend(block.features)
        with stages("evidence", len(indices)) as step:
            evidence = block_evidence(
                gaussians,
                block,
                cache / "evidence",
                rasterize_mode=scene.rasterize_mode,
                weight_power=options.weight_power,
                dtype=dtype,
                reuse=options.reuse_evidence,
                done=step,
            )
            parts.append(evidence)
    with stages("lift") as step:
        evidence, features = Evidence.merge(*parts), torch.cat(tables).to(device, dtype)
        lifted = lift(evidence, features, beta=options.beta, unlabeled=options.unlabeled)
        step()
    left_out = len(scene.train) - len(usable)
    statistics = {
        "views": len(indices),
        "left_out": left_out,
        "excluded": evidence.num_excluded,
        **_statistics(lifted.scalars),
    }
    copied = None
    if options.refine:
        with stages("neighbors") as step:
            neighbors = nearest_neighbors(gaussians.means, options.vote.k)
            step()
        with stages("vote") as step:
            reliability = lifted.scalars.reliability
            copied = refine(gaussians.means, lifted.directions, reliability, options.vote, neighbors=neighbors)
            step()
        changed = copied != torch.arange(len(copied), device=copied.device)
        statistics["refined_share"] = float(changed.float().mean())
        statistics["unsupported_share"] = float(unsupported(neighbors, reliability).float().mean())
    with stages("store") as step:
        provenance = {
            **scene.identity,
            "encoder": dict(encoder),
            "features": source.identity,
            "options": asdict(options),
            "statistics": statistics,
            "cost": _cost(stages.seconds, device),
        }
        built = SemanticField.build(
            lifted, gaussians.means, copied, tolerance=options.tolerance, storage=options.storage, provenance=provenance
        )
        step()
    return LiftResult(built, stages.seconds)


class _Stages:
    """Adds up the seconds of each stage and passes on how far it is."""

    def __init__(self, report: Report) -> None:
        self.seconds: dict[str, float] = {}
        self._report = report
        self._done: dict[str, int] = {}

    @contextmanager
    def __call__(self, stage: str, total: int = 1) -> Iterator[Callable[[], None]]:
        def step() -> None:
            self._done[stage] = self._done.get(stage, 0) + 1
            self._report(stage, self._done[stage], total)

        start = time.perf_counter()
        self._report(stage, self._done.get(stage, 0), total)
        try:
            yield step
        except torch.OutOfMemoryError as error:
            raise MemoryError(
                f"the GPU's memory is full in stage {stage} ({error}); lift on the CPU: --device cpu"
            ) from error
        if torch.cuda.is_available():
            torch.cuda.synchronize()
        self.seconds[stage] = self.seconds.get(stage, 0.0) + time.perf_counter() - start


def _cost(seconds: Mapping[str, float], device: str) -> dict[str, float]:
    """Seconds of the stages so far and in all, and the most memory of this process and of the GPU, GiB."""
    unit = 2**30 if sys.platform == "darwin" else 2**20
    memory = {"memory_gib": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / unit}
    if torch.device(device).type == "cuda":
        memory["gpu_memory_gib"] = torch.cuda.max_memory_allocated() / 2**30
    return {**{f"{stage}_s": value for stage, value in seconds.items()}, "total_s": sum(seconds.values()), **memory}


def _statistics(scalars: Scalars) -> dict[str, Any]:
    found = scalars.reliability[scalars.reliability > 0].double().sort().values
    shares = (0.05, 0.25, 0.5, 0.75, 0.95)
    quantiles = {str(q): float(found[round(q * (len(found) - 1))]) for q in shares} if len(found) > 0 else {}
    n = scalars.norm.numel()
    return {"gaussians": n, "zero_evidence_share": 1 - len(found) / max(1, n), "reliability_quantiles": quantiles}
