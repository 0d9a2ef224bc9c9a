"""Estimate of the time, memory and disk space of a lift, from a short measurement on this machine.

`dry_run` implements `ns-normlift --dry-run`. `ns-normlift-check` runs the same steps and reports the result of each.
"""

from __future__ import annotations

import re
import shutil
import tempfile
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, replace
from functools import partial
from importlib.metadata import PackageNotFoundError, requires, version
from itertools import chain, islice
from pathlib import Path
from time import perf_counter
from typing import Any, Literal, NamedTuple, TypeVar, cast

import torch
from jaxtyping import Float
from torch import Tensor

from normlift_ns import evidence_collection, pipeline
from normlift_ns.core.consensus import consensus
from normlift_ns.core.device import choose_device, init_cuda
from normlift_ns.core.evidence import Evidence
from normlift_ns.core.field import SemanticField
from normlift_ns.core.gaussians import GaussianScene
from normlift_ns.core.refine import clamp_k
from normlift_ns.core.scene import Scene
from normlift_ns.data.alignment import in_frustum
from normlift_ns.encoders.base import FeatureSource, segmentation_workers
from normlift_ns.encoders.build import make_source
from normlift_ns.encoders.cache import NotCachedError, cached
from normlift_ns.encoders.huggingface import MODEL_FAMILIES, find_local_model, resolve_model_name
from normlift_ns.encoders.open_clip import has_local_clip_weights
from normlift_ns.encoders.weights import EDGES, IMAGENET, find_local_sam
from normlift_ns.io.memory import free_memory
from normlift_ns.io.run_dir import FIELD_FOLDER, MANIFEST_FILE, cache_folder, read_manifest, run_directory
from normlift_ns.options import DEFAULT_SAM, DEFAULT_SAM3, LiftOptions, SourceOptions
from normlift_ns.progress import StageTimer, peak_gib
from normlift_ns.segmentation.registry import resolve_source

# Extrapolation from measurements of a few views to the time, memory and disk space of a whole lift.


_EVIDENCE_COPIES = 3
"""Number of copies of the evidence in memory while the evidence of all batches is joined and converted to regions."""
_DIRECTION_COPIES = 2
"""Number of copies of the directions in memory while the vote gathers them and a storage format is chosen."""
_OFFSET_BYTES = 16
"""Minimum bytes per Gaussian in an evidence file."""


@dataclass(frozen=True)
class Rate:
    """Cost of a stage: a fixed part, plus a part proportional to the number of items."""

    fixed: float
    per_item: float
    count: float
    """Number of items in the whole lift."""

    def cost(self, share: float = 1.0) -> float:
        """Return the fixed part plus the cost of a share of the items.

        >>> Rate(fixed=2.0, per_item=0.5, count=10).cost(0.5)
        4.5
        """
        return self.fixed + self.per_item * self.count * share


@dataclass(frozen=True)
class Measurements:
    """Measurements of a capture on a machine. Seconds are for one device."""

    device: str
    views: int
    """Number of views to lift."""
    gaussians: int
    dimension: int
    """Length of the feature vectors."""
    regions: float
    """Number of regions per view."""
    entries: float
    """Evidence entries per view."""
    entry_bytes: int
    """Bytes per evidence entry."""
    preparation_s: Mapping[str, float]
    """Seconds of the steps before the views, by name (start, open, kernels, check). The lift repeats these steps."""
    load_s: float
    """Seconds to load the networks."""
    features_s: float | None
    """Seconds per view with new features; None if all are cached."""
    cached_features_s: float | None
    """Seconds per view with cached features; None if none are cached."""
    cached_features_share: float
    """Share of the views with cached features, in 0..1."""
    evidence_s: float
    """Seconds per view that is rasterized."""
    cached_evidence_s: float
    """Seconds per view with cached evidence."""
    cached_evidence_share: float
    """Share of the views with cached evidence, in 0..1."""
    core_s: Mapping[str, Rate]
    """Cost of each enabled stage in seconds, by name: consensus, recognition, lift, neighbors, vote, store."""
    field_bytes: Rate
    """Bytes of the stored semantics."""
    run_bytes: int
    """Bytes of the checkpoint that is stored with the semantics."""
    write_bytes_s: float
    """Bytes written per second."""
    view_bytes: float
    """Bytes of a view's features and regions in the cache."""
    host_bytes: int
    """Peak memory of this process so far, in bytes."""
    device_bytes: int | None
    """Peak GPU memory up to the end of the evidence stage, in bytes; None without a GPU."""
    measured_views: int = 0
    """Number of views that the measurement processed."""


@dataclass(frozen=True)
class PlannedStage:
    """Stage of a planned lift, with its estimated time."""

    name: str
    seconds: float
    remark: str = ""
    """Description of the cached part of the stage; empty if nothing is cached."""


@dataclass(frozen=True)
class Plan:
    """Estimated time, memory and disk space of a lift."""

    device: str
    num_devices: int
    views: int
    gaussians: int
    stages: tuple[PlannedStage, ...]
    features_kept: int
    """Approximate number of views with cached 2D features."""
    evidence_kept: int
    """Approximate number of views with cached evidence."""
    host_bytes: int
    """Memory of each process, in bytes."""
    device_bytes: int | None
    """Memory of each GPU, in bytes; None without a GPU."""
    disk_bytes: int
    """Bytes to be written."""
    looked_at: int
    """Number of measured views that the estimate is based on."""

    @property
    def seconds(self) -> float:
        """Total time of all stages."""
        return sum(stage.seconds for stage in self.stages)

    def to_json(self) -> dict[str, Any]:
        """Return the plan as JSON types, with `seconds` of each stage and `total_s`."""
        facts = {name: value for name, value in asdict(self).items() if name != "stages"}
        return {**facts, "seconds": {stage.name: stage.seconds for stage in self.stages}, "total_s": self.seconds}


def make_plan(facts: Measurements, *, num_devices: int = 1) -> Plan:
    """Estimate the cost of a lift.

    The devices share the work on views and Gaussians, but not the preparation, the loading of networks or the writing.

    Args:
        num_devices: Number of processes that share the work, each with its own device; at least 1.
    Raises:
        ValueError: `num_devices` is less than 1.
    """
    if num_devices < 1:
        raise ValueError(f"num_devices must be at least 1, got {num_devices}")
    views, share = facts.views, 1 / num_devices
    features_cached, evidence_cached = (
        _share_of(views, cached) for cached in (facts.cached_features_share, facts.cached_evidence_share)
    )
    new = views - features_cached
    features = share * (new * (facts.features_s or 0.0) + features_cached * (facts.cached_features_s or 0.0))
    features += facts.load_s if new > 0 else 0.0
    evidence = share * ((views - evidence_cached) * facts.evidence_s + evidence_cached * facts.cached_evidence_s)
    field_bytes = facts.field_bytes.cost()
    evidence_bytes = facts.entries * views * facts.entry_bytes
    stages = (
        *(PlannedStage(name, seconds) for name, seconds in facts.preparation_s.items()),
        PlannedStage("features", features, _cached(features_cached, views)),
        PlannedStage("evidence", evidence, _cached(evidence_cached, views)),
        *(PlannedStage(name, rate.cost(share)) for name, rate in facts.core_s.items()),
        PlannedStage("write", (field_bytes + facts.run_bytes) / facts.write_bytes_s),
    )
    table = facts.regions * views * facts.dimension * 4
    lift_bytes = (
        share * (_EVIDENCE_COPIES * evidence_bytes + _DIRECTION_COPIES * facts.gaussians * facts.dimension * 4)
        + 2 * table
    )
    files = (views - evidence_cached) / max(1, views) * (evidence_bytes + facts.gaussians * _OFFSET_BYTES * views / 16)
    on_gpu = facts.device_bytes is not None
    return Plan(
        device=facts.device,
        num_devices=num_devices,
        views=views,
        gaussians=facts.gaussians,
        stages=stages,
        features_kept=features_cached,
        evidence_kept=evidence_cached,
        host_bytes=round(facts.host_bytes + (table if on_gpu else lift_bytes)),
        device_bytes=None if facts.device_bytes is None else round(facts.device_bytes + lift_bytes),
        disk_bytes=round(files + new * facts.view_bytes + field_bytes + facts.run_bytes),
        looked_at=facts.measured_views,
    )


def _share_of(views: int, share: float) -> int:
    """Convert a share of two or more views to a number, which is 0 only for share 0 and `views` only for share 1.

    >>> _share_of(45, 0.999), _share_of(45, 1.0), _share_of(45, 0.0)
    (44, 45, 0)
    """
    return views if share >= 1 else min(views - 1, max(int(share > 0), round(share * views)))


def _cached(cached: int, views: int) -> str:
    if cached in (0, views):
        return "" if cached == 0 else "cached"
    return f"about {cached} of {views} views cached"


# Cost of consensus, lift, neighbors, vote and storage, extrapolated from two samples of the Gaussians.


Clock = Callable[[], float]
"""Function that returns the current time in seconds."""
_LARGE_SAMPLE = {"cpu": 2**13, "cuda": 2**18}
"""Number of Gaussians in the larger sample, by device."""
_SAMPLE_RATIO = 4
"""Size of the larger sample divided by that of the smaller one."""
_MAX_SAMPLE_VIEWS = 64
"""Approximate maximum number of views in the samples. The cost of further views is extrapolated."""


def measure_core(
    gaussians: GaussianScene,
    evidence: Evidence,
    features: Float[Tensor, "s d"],
    options: LiftOptions,
    views: int,
    clock: Clock,
) -> tuple[dict[str, Rate], Rate]:
    """Measure the cost of each core stage of a lift in seconds, and of the storage in bytes.

    The function repeats the evidence of a few views up to about the number of views of the lift, but at most about 64.
    The cost of further views is extrapolated. `Rate` explains the parts of a cost.

    Args:
        evidence: Evidence of a few views.
        features: Features of the regions in these views.
        views: Number of views in the whole lift.
    """
    repeated = min(views, _MAX_SAMPLE_VIEWS)
    times = max(1, round(repeated / evidence.num_views))
    table = features.to(evidence.rows.weight).repeat(times, 1)
    factor = views / (times * evidence.num_views)
    most = min(len(gaussians), _LARGE_SAMPLE.get(gaussians.means.device.type, _LARGE_SAMPLE["cpu"]))

    def costs(count: int) -> tuple[dict[str, float], dict[str, float], int]:
        """Run all stages after the evidence on `count` Gaussians; return seconds and items by stage, and the bytes."""
        rows = torch.linspace(0, len(gaussians) - 1, max(1, count), dtype=torch.float64).long()
        rows = rows.to(gaussians.means.device)
        means, sample = gaussians.means[rows], replace(evidence.select_gaussians(rows), num_excluded=0)
        level = torch.zeros(len(table), dtype=torch.int64)
        observed = evidence_collection.ViewObservations(Evidence.merge(*[sample] * times), table, level)
        stages = StageTimer(lambda stage, done, total: None, clock)
        agreed, copied = table, None
        if options.consensus:
            with stages("consensus"):
                agreed = consensus(observed.evidence, table, **pipeline.consensus_options(options)).features
        if options.recognition:
            with stages("recognition"):
                pipeline.recognition_facts(observed, options)
        with stages("lift"):
            lifted, own = pipeline.lift_features(observed, agreed, options)
        if options.refine:
            vote = clamp_k(replace(options.vote, k=min(options.vote.k, max(1, len(means) - 1))), len(means))
            voted = replace(options, vote=vote)
            copied, _, _ = pipeline.vote_directions(
                means, lifted, own, voted, stages, level=level if options.consensus else None
            )
        with stages("store"):
            field = SemanticField.build(lifted, means, copied, tolerance=options.tolerance, storage=options.storage)
        stored_bytes = field.manifest["forms"][field.manifest["form"]]["bytes"]
        return stages.seconds, _items(sample, times, len(means), options), stored_bytes

    # The first two measurements only load or compile kernels for these sizes.
    _, _, (small, few, few_bytes), (large, many, many_bytes) = map(costs, 2 * (most // _SAMPLE_RATIO, most))
    counts = _items(evidence, times, len(gaussians), options)
    for name, power in (("consensus", 2), ("recognition", 2), ("lift", 1)):
        counts[name] *= factor**power
    rates = {name: _rate((few[name], small[name]), (many[name], large[name]), counts[name]) for name in small}
    return rates, _rate((few["store"], few_bytes), (many["store"], many_bytes), counts["store"])


def _rate(small: tuple[float, float], large: tuple[float, float], count: float) -> Rate:
    """Fit a line to two pairs (items, cost). The line passes through `large`; slope and fixed part are >= 0."""
    (items, cost), (more, most) = small, large
    each = (most - cost) / (more - items) if more > items else most / max(1.0, more)
    each = min(max(each, 0.0), most / max(1.0, more))
    return Rate(most - each * more, each, count)


def _items(evidence: Evidence, times: int, gaussians: int, options: LiftOptions) -> dict[str, float]:
    """Count the items of each stage.

    The items are sampled Gaussians in all regions for the consensus and the recognition, evidence entries for the lift,
    and Gaussians for the other stages.
    """
    per_region = torch.bincount(evidence.rows.column.long(), minlength=evidence.num_regions)
    sampled = float(per_region.clamp(max=options.consensus_sample).sum()) * times
    others = dict.fromkeys(("neighbors", "vote", "store"), float(gaussians))
    return {"consensus": sampled, "recognition": sampled, "lift": float(evidence.nnz * times), **others}


DiagnosticState = Literal["ok", "warning", "error"]
_PROJECTED_GAUSSIANS = 100_000
"""Approximate number of Gaussians that `diagnose_views` projects into the cameras."""
_FEW_IN_VIEW, _NONE_IN_VIEW = 0.5, 0.001
"""Shares of Gaussians in view below which the check warns, and below which it fails."""
_HIGH_SHARE = 0.8
"""Share of the free memory or disk space above which an estimate gets a warning."""
_LIFT_LESS = "increase --lift-downscale, reduce --max-views"
_SHOWN_PACKAGES = ("torch", "numpy", "nerfstudio", "gsplat", "open_clip_torch")


@dataclass(frozen=True)
class Diagnostic:
    """Result of one check."""

    what: str
    state: DiagnosticState
    found: str
    advice: str = ""
    """Advice, such as an option to add."""


def diagnose_views(scene: Scene) -> Diagnostic:
    """Check the share of the Gaussians that lie in at least one training view."""
    means = scene.gaussians.means
    means = means[:: max(1, len(means) // _PROJECTED_GAUSSIANS)]
    visible = torch.zeros(len(means), dtype=torch.bool)
    for camera in scene.train.cameras:
        visible |= in_frustum(means, camera)
    share = float(visible.float().mean())
    message = f"{share:.1%} of the Gaussians are in at least one training view (number of views: {len(scene.train)})"
    if share < _NONE_IN_VIEW:
        advice = "check the cameras and, with --load-ply or --load-gsplat, --world-transform"
        return Diagnostic("in view", "error", message, advice)
    if share < _FEW_IN_VIEW:
        advice = "check that these are the cameras of the splat; the other Gaussians get no semantics"
        return Diagnostic("in view", "warning", message, advice)
    return Diagnostic("in view", "ok", message)


def diagnose_cameras(warning: str | None) -> Diagnostic:
    """Return the diagnostic for the warning of `compare_cameras`, which is None if images and renders match."""
    match = "the images that were checked match renders from their cameras"
    return Diagnostic("cameras", "ok" if warning is None else "warning", warning or match)


def describe_recognition(facts: Mapping[str, Any]) -> str:
    """Describe how well the lift recognizes regions in views that were left out, from the manifest.

    >>> describe_recognition({"recognized": 812, "confirmed": 1024, "agreement": 0.71})
    'recognized 812 of 1,024 regions in views that were left out; agreement 0.71'
    >>> describe_recognition({"recognized": 0, "confirmed": 0, "agreement": None})
    'no region has a similar region in other views'
    """
    if facts["confirmed"] == 0:
        return "no region has a similar region in other views"
    counts = f"recognized {facts['recognized']:,} of {facts['confirmed']:,} regions in views that were left out"
    return f"{counts}; agreement {facts['agreement']:.2f}"


def diagnose_recognition(run_dirs: Iterable[Path]) -> list[Diagnostic]:
    """Report how well the first lifted run in the given folders recognizes regions of left-out views.

    The numbers come from its manifest. If no folder contains a lifted run, return an empty list.

    Args:
        run_dirs: Folders that may contain a lifted run.
    """
    for run_dir in run_dirs:
        if (run_dir / FIELD_FOLDER / MANIFEST_FILE).is_file():
            facts = read_manifest(run_dir / FIELD_FOLDER)[0].get("statistics", {}).get("recognition")
            if facts is None:
                advice = "lift with --recognition True to measure how well regions are recognized in left-out views"
                return [Diagnostic("lifted run", "ok", str(run_dir), advice)]
            return [Diagnostic("lifted run", "ok", describe_recognition(facts))]
    return []


def diagnose_device(device: str) -> Diagnostic:
    """Report the device of the lift; warn if the lift does not use an available GPU."""
    if torch.device(device).type == "cuda":
        free, total = torch.cuda.mem_get_info(device)
        name = torch.cuda.get_device_name(device)
        return Diagnostic("device", "ok", f"{name}, {free / 2**30:.1f} of {total / 2**30:.1f} GiB free")
    message = f"CPU (threads: {torch.get_num_threads()}); no GPU is used"
    if torch.cuda.is_available():
        return Diagnostic("device", "warning", f"{message}, although one is available", "give --device cuda")
    return Diagnostic("device", "ok", message)


def diagnose_versions() -> Diagnostic:
    """Report the versions of the main packages, and check that all required packages are installed."""
    missing = [name for name in _required_packages() if _version(name) is None]
    message = ", ".join(f"{name} {_version(name) or 'absent'}" for name in _SHOWN_PACKAGES)
    if missing == ["nerfstudio"]:
        message = f"{message}; ns-* commands need nerfstudio"
        return Diagnostic("versions", "warning", message, "run pip install nerfstudio==1.1.5")
    if len(missing) > 0:
        message = f"{message}; not installed: {', '.join(missing)}"
        return Diagnostic("versions", "error", message, f"run pip install {' '.join(missing)}")
    return Diagnostic("versions", "ok", f"{message}, normlift_ns {_version('normlift-ns') or 'from source'}")


def _required_packages() -> list[str]:
    """Return the names of the packages that normlift_ns requires; empty if it is not installed."""
    required = (requires("normlift-ns") or ()) if _version("normlift-ns") is not None else ()
    return [re.split(r"[^\w.-]", requirement)[0] for requirement in required if "extra ==" not in requirement]


def _version(name: str) -> str | None:
    try:
        return version(name)
    except PackageNotFoundError:
        return None


_LOCAL_WEIGHTS = (
    "fetch default weights with ns-normlift-weights --get NAME, or give a local copy with --encoder-pretrained FILE "
    "(open_clip), --encoder-model FOLDER (siglip, siglip2, metaclip2) or --sam-model PATH (SAM)"
)
"""Advice on weights that are not on this machine."""


def missing_weights(options: SourceOptions, device: str) -> list[str]:
    """Return descriptions of the network weights that the options need and that are not on this machine."""
    if options.features != "none":
        return []
    options, missing = resolve_source(options, device), []
    if options.regions in ("sam", "sam3"):
        model = options.sam_model or (DEFAULT_SAM if options.regions == "sam" else DEFAULT_SAM3)
        if find_local_sam(model) is None:
            missing.append(f"weights of SAM, {model}")
    family = MODEL_FAMILIES.get(options.encoder)
    if family is not None and find_local_model(resolve_model_name(options, family)) is None:
        missing.append(f"weights of {options.encoder}, {resolve_model_name(options, family)}")
    model, weights = options.encoder_model, options.encoder_pretrained
    if options.encoder == "open_clip" and has_local_clip_weights(model, weights) is False:
        missing.append(f"weights of OpenCLIP, {model} {weights}")
    files = [file for file in (IMAGENET, EDGES) if file.name in (options.encoder, options.regions) and not file.is_here]
    return missing + [f"weights for {file.user} ({file.command})" for file in files]


def diagnose_weights(missing: Sequence[str], options: SourceOptions, device: str) -> Diagnostic:
    """Report weights that are not on this machine; if none is missing, name the encoder and the regions of the lift."""
    if len(missing) == 0:
        options = resolve_source(options, device)
        used = f" (encoder {options.encoder}, regions {options.regions})" if options.features == "none" else ""
        return Diagnostic("weights", "ok", f"all required weights are on this machine{used}")
    message = (
        f"not on this machine: {'; '.join(missing)}. A lift downloads missing weights only from the Hugging Face hub"
    )
    return Diagnostic(
        "weights",
        "warning",
        message,
        _LOCAL_WEIGHTS,
    )


def diagnose_memory(plan: Plan, device: str) -> list[Diagnostic]:
    """Check that the lift fits into memory and, on a GPU, into GPU memory."""
    rows = []
    free = min(free_memory().values(), default=None)
    if free is not None:
        own = int((peak_gib() or 0.0) * 2**30)
        rows.append(_check_capacity("memory", plan.host_bytes, free + own, f"{_LIFT_LESS}, or free memory"))
    if plan.device_bytes is not None:
        free = torch.cuda.mem_get_info(device)[0] + torch.cuda.memory_reserved(device)
        rows.append(_check_capacity("GPU memory", plan.device_bytes, free, f"{_LIFT_LESS}, or give --device cpu"))
    return rows


def diagnose_disk(plan: Plan, folder: Path) -> Diagnostic:
    """Check that the output fits on the disk."""
    existing = next(path for path in (folder, *folder.parents) if path.exists())
    advice = f"free space in {existing}, or give another folder with --output-dir"
    return _check_capacity("disk", plan.disk_bytes, shutil.disk_usage(existing).free, advice)


def _check_capacity(name: str, needed: int, free: int, advice: str) -> Diagnostic:
    """Compare needed bytes with free bytes."""
    message = f"about {needed / 2**30:.2f} GiB are needed, and {free / 2**30:.1f} GiB are free"
    state: DiagnosticState = "error" if needed > free else "warning" if needed > _HIGH_SHARE * free else "ok"
    return Diagnostic(name, state, message, "" if state == "ok" else advice)


# Short measurement of a capture: encode and rasterize a few views, and lift some Gaussians.
#
# The measurement discards its results and downloads nothing. It reads cached views instead of recomputing them.


_Result = TypeVar("_Result")
_MAX_VIEWS = 4
"""Maximum number of views to rasterize and encode. Sources that segment several views in one batch encode more."""
_MAX_LOAD_S = 3.0
"""Maximum estimate of the seconds to load kernels. Longer times include compilation, which happens only once."""
_SLOW_FIRST_VIEW_S = 20.0
"""Limit on the seconds of the first view. If it takes longer, only one more batch is measured.

These seconds include an unknown time to load networks.
"""
_DIMENSION = 512
"""Dimension of the features for which kernels are loaded."""
_MAX_LOOKUPS = 16
"""Maximum number of views to look up in the cache."""


class _Observed(NamedTuple):
    """Batch of views, with the seconds to compute its labels and features."""

    block: evidence_collection.ViewBatch
    seconds: float


def time_kernel_loading(scene: Scene, options: LiftOptions, *, device: str = "cpu") -> float:
    """Load or compile the kernels of a lift, and estimate the seconds that another process needs to load them."""
    gaussians = scene.gaussians.to(device)
    config = pipeline.choose_raster_config(scene, gaussians, options)
    kernels = pipeline.start_kernel_warm_up(scene, gaussians, options, config)
    kernels.start_rasterization()
    kernels.start_lift(_DIMENSION)
    return min(_MAX_LOAD_S, _seconds(kernels.wait, clock=perf_counter, device=device)[0])


def measure_capture(
    scene: Scene,
    source: FeatureSource,
    options: LiftOptions,
    cache: Path,
    *,
    device: str = "cpu",
    before: Mapping[str, float] | None = None,
    clock: Clock = perf_counter,
) -> Measurements:
    """Process a few views of a scene as in a lift, and measure the cost.

    Args:
        source: As in `lift_scene`.
        cache: Folder of 2D features and evidence. The function only reads it.
        before: Seconds of the steps before the views, by name (start, open, kernels, check).
        clock: Clock in seconds; `time.process_time` measures the time of all cores.
    Raises:
        ValueError, FileNotFoundError, MemoryError: As in `lift_scene`.
    """
    collection = pipeline.plan_collection(scene, source, options, cache, device=device, export=None)
    gaussians, used, drawing = collection.gaussians, collection.views, collection.config
    cuda = torch.device(device).type == "cuda"
    timed = partial(_seconds, clock=clock, device=device)
    kernels = pipeline.start_kernel_warm_up(scene, gaussians, options, drawing)
    kernels.start_rasterization()
    kernels.wait()
    rendered = drawing.settings if options.image_source == "render" else None

    def observe(indices: Sequence[int], source: FeatureSource) -> _Observed:
        kwargs = {"render_settings": rendered, "downscale": options.lift_downscale}
        seconds, block = timed(lambda: evidence_collection.observe_views(scene, indices, source, **kwargs))
        return _Observed(block, seconds)

    chosen = [used[i] for i in evidence_collection.sample_evenly(len(used), _MAX_LOOKUPS)]
    observe_cached = partial(observe, source=cached(source, cache, compute=lambda part: False))
    known: dict[int, evidence_collection.ViewBatch] = {}
    for index in chosen if options.reuse_evidence else ():
        with suppress(NotCachedError):
            known[index] = observe_cached([index]).block
    new = [index for index in chosen if index not in known]
    batch = segmentation_workers(source)
    encoded = [new[i] for i in evidence_collection.sample_evenly(len(new), max(_MAX_VIEWS, 1 + 2 * batch))]
    observed, load_s = _observe_loaded(encoded, partial(observe, source=source), batch)
    cached_s = _per_view(observe_cached(list(known))) if len(known) > 0 else None
    block = _joined([observed.block, *known.values()], _MAX_VIEWS)

    def rasterize(folder: Path) -> Evidence:
        return evidence_collection.batch_evidence(gaussians, block, folder, drawing, reuse=True, on_view=lambda: None)

    with tempfile.TemporaryDirectory(prefix="normlift-plan-") as name:  # evidence is computed, read and written
        folder, file = Path(name), Path(name) / "again.safetensors"
        if cuda:  # kernels for labels like these are compiled once for all lifts
            rasterize(folder / "first")
        evidence_s, evidence = timed(lambda: rasterize(folder))
        cached_evidence_s, _ = timed(lambda: rasterize(folder))
        write_s, _ = timed(lambda: evidence.save(file))
        write_bytes_s = file.stat().st_size / max(write_s, 1e-6)
    count = len(block.cameras)
    device_bytes = torch.cuda.max_memory_allocated(device) if cuda else None  # the plan adds the memory of the core
    rates, field_bytes = measure_core(gaussians, evidence, torch.cat(block.features), options, len(used), clock)
    groups = ((_joined(list(known.values())), len(known)), (observed.block, len(new)))
    entries = evidence.nnz + evidence.unlabeled.weight.numel()
    return Measurements(
        device=torch.cuda.get_device_name(device) if cuda else f"{device}, {torch.get_num_threads()} threads",
        views=len(used),
        gaussians=len(gaussians),
        dimension=block.features[0].shape[1],
        regions=sum(map(len, block.features)) / count,
        entries=entries / count,
        entry_bytes=4 + evidence.rows.weight.element_size(),
        preparation_s=before or {},
        load_s=load_s,
        features_s=_per_view(observed),
        cached_features_s=cached_s,
        cached_features_share=len(known) / len(chosen),
        evidence_s=evidence_s / count,
        cached_evidence_s=cached_evidence_s / count,
        cached_evidence_share=_evidence_cached(collection, groups),
        core_s=rates,
        field_bytes=field_bytes,
        run_bytes=sum(value.numel() * value.element_size() for value in scene.parameters.values()),
        write_bytes_s=write_bytes_s,
        view_bytes=(4 * sum(map(Tensor.numel, block.features)) + 2 * sum(map(Tensor.numel, block.labels))) / count,
        host_bytes=round((peak_gib() or 0.0) * 2**30),
        device_bytes=device_bytes,
        measured_views=max(count, len(observed.block.cameras)),
    )


def _per_view(observed: _Observed) -> float | None:
    """Return the seconds for each view; None without views."""
    count = len(observed.block.cameras)
    return observed.seconds / count if count > 0 else None


def _observe_loaded(
    indices: Sequence[int], observe: Callable[[Sequence[int]], _Observed], batch: int
) -> tuple[_Observed, float]:
    """Observe views, or only some of them if the first is slow.

    Return the views with their seconds, and the seconds of loading networks, which are not included. If there is a
    single view, its seconds include the loading.
    """
    if len(indices) == 0:
        return _Observed(evidence_collection.ViewBatch([], [], [], []), 0.0), 0.0
    first = observe(indices[:1])
    if len(indices) == 1:
        return first, 0.0
    others = indices[1 : 1 + batch if first.seconds > _SLOW_FIRST_VIEW_S else None]
    rest = observe(others)
    each = rest.seconds / len(others)
    return _Observed(_joined([first.block, rest.block]), each * (1 + len(others))), max(0.0, first.seconds - each)


def _joined(blocks: Sequence[evidence_collection.ViewBatch], most: int | None = None) -> evidence_collection.ViewBatch:
    """Join batches of views, up to `most` views in total."""
    parts = zip(evidence_collection.ViewBatch([], [], [], []), *blocks)
    return evidence_collection.ViewBatch(*(list(islice(chain.from_iterable(cast(Any, part)), most)) for part in parts))


def _evidence_cached(
    collection: evidence_collection.EvidenceCollection, groups: Sequence[tuple[evidence_collection.ViewBatch, int]]
) -> float:
    """Estimate the share of the views whose evidence is cached.

    Args:
        groups: Batches of sample views, each with the number of views that it represents.
    """
    if not collection.options.reuse_evidence:
        return 0.0
    share = 0.0
    for block, views in groups:
        keys = evidence_collection.evidence_keys(collection.gaussians, block, collection.config)
        hits = evidence_collection.views_in_cache(collection.cache / "evidence", keys)
        share += sum(hits) / max(1, len(hits)) * views / sum(count for _, count in groups)
    return share


def _seconds(work: Callable[[], _Result], *, clock: Clock, device: str) -> tuple[float, _Result]:
    """Return the seconds that a function takes, including its work on the GPU, and its result."""
    start = clock()
    result = work()
    if torch.device(device).type == "cuda":
        torch.cuda.synchronize(device)
    return clock() - start, result


# The dry run of a lift.


class OpenedCapture(NamedTuple):
    """Opened capture, with the seconds of each stage so far."""

    scene: Scene
    run_dir: Path
    stage_seconds: dict[str, float]


def open_capture(request: pipeline.LiftRequest, start_time: float) -> OpenedCapture:
    """Open the capture of a request, and record the seconds of the stages `start` and `open`.

    Args:
        start_time: Value of `time.perf_counter` at the start of the command.
    """
    import_time = perf_counter()
    scene = request.open_scene()
    run_dir = run_directory(Path(request.output_dir or scene.runs_dir), scene.name, request.timestamp)
    return OpenedCapture(scene, run_dir, {"start": import_time - start_time, "open": perf_counter() - import_time})


def compare_cameras(opened: OpenedCapture, options: LiftOptions, device: str) -> str | None:
    """Return a warning if images and renders of some views differ; record the seconds of `kernels` and `check`."""
    opened.stage_seconds["kernels"] = time_kernel_loading(opened.scene, options, device=device)
    start = perf_counter()
    warning = pipeline.compare_with_images(opened.scene, options, device)
    opened.stage_seconds["check"] = perf_counter() - start
    return warning


def plan_opened(
    opened: OpenedCapture, source: FeatureSource, options: LiftOptions, device: str, num_devices: int
) -> Plan:
    """Estimate the cost of a lift from a short measurement of an opened capture."""
    scene, run_dir, seconds = opened
    facts = measure_capture(scene, source, options, cache_folder(run_dir), device=device, before=seconds)
    return make_plan(facts, num_devices=num_devices)


def dry_run(request: pipeline.LiftRequest, num_devices: int, start_time: float) -> Plan:
    """Estimate the time, memory and disk space of a lift without running it.

    Args:
        num_devices: Number of processes that share the work.
        start_time: Value of `time.perf_counter` at the start of the command.
    Raises:
        ValueError, FileNotFoundError, MemoryError: As in the lift; also if weights are not on this machine.
    """
    device, lift = choose_device(request.device), request.lift or LiftOptions()
    init_cuda(device)
    options = (request.source or SourceOptions()).looking_for(request.queries)
    source = make_source(options, device)
    missing = missing_weights(options, device)
    if len(missing) > 0:
        raise FileNotFoundError(
            f"A dry run encodes a few images, but this machine lacks {'; '.join(missing)}; {_LOCAL_WEIGHTS}."
        )
    opened = open_capture(request, start_time)
    warning = compare_cameras(opened, lift, device) if request.check_alignment else None
    if warning is not None:
        request.say(f"Warning: {warning}")
    return plan_opened(opened, source, lift, device, num_devices)
