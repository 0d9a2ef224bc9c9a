"""Pipeline from a trained scene and a source of 2D features to a semantic field. Read this module first.

`lift_run` opens a scene, lifts features onto it and writes the lifted run. `lift_scene` only lifts, in these steps:
features -> evidence -> consensus -> lift -> vote -> store. Both use one process; `distributed.lift` runs the same steps
in several processes.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from threading import Thread
from types import MappingProxyType
from typing import Any, NamedTuple

import torch
from jaxtyping import Float, Float64, Int, Int32, Int64
from torch import Tensor

from normlift_ns.core.arguments import check_arguments
from normlift_ns.core.consensus import (
    CHANCE_AGREEMENT,
    SAMPLING_SEED,
    Consensus,
    consensus,
    hash_to_unit,
    sample_gaussians,
    with_original_reliability,
)
from normlift_ns.core.device import choose_device, init_cuda, load_triton
from normlift_ns.core.evidence import Entries, Evidence
from normlift_ns.core.field import CHANGED_COSINE, SemanticField, with_null_level
from normlift_ns.core.gaussians import GaussianScene
from normlift_ns.core.left_out import leave_views_out
from normlift_ns.core.lift import Lifted, lift
from normlift_ns.core.neighbors import Neighbors, nearest_neighbors
from normlift_ns.core.refine import (
    clamp_k,
    labeled_share,
    refine,
    relative_gate,
    sample_pairs,
    shared_region_cosines,
    unsupported,
)
from normlift_ns.core.reliability import independent_views, norm_of_reliability, pair_reliability
from normlift_ns.core.scene import Scene, camera_summary
from normlift_ns.data.alignment import Alignment, alignment_warning, cached_alignment, measure_alignment
from normlift_ns.data.nerfstudio.load import NerfstudioScene
from normlift_ns.data.open_scene import SplatScene, open_scene, resolve_field_paths
from normlift_ns.encoders.base import (
    FeatureSource,
    PatchFeatures,
    PrecomputedFeatures,
    RegionFeatures,
    precomputed_features,
)
from normlift_ns.encoders.build import make_source, null_vectors, source_settings
from normlift_ns.encoders.langsplat import FeatureExport, check_unique_stems
from normlift_ns.errors import InputError
from normlift_ns.evidence_collection import EvidenceCollection, RasterConfig, ViewObservations, sample_evenly
from normlift_ns.io.memory import refuse_small_memory
from normlift_ns.io.run_dir import (
    FIELD_FOLDER,
    TEXT_EMBEDDINGS_FILE,
    cache_folder,
    complete_interrupted_lifts,
    refuse_existing_run,
    run_directory,
)
from normlift_ns.lifted_run import LiftedRun, write_run
from normlift_ns.options import (
    CANONICAL_NEGATIVES,
    LiftOptions,
    SourceOptions,
    check_bool,
    check_path,
    check_prompt_list,
    option_name,
    renamed,
)
from normlift_ns.progress import ProgressCallback, StageTimer, lift_cost
from normlift_ns.query.engine import run_query
from normlift_ns.query.question import Query, make_query
from normlift_ns.query.text_encoder import encoder_settings, precomputed_settings
from normlift_ns.rasterization.gsplat import resolve_gsplat_rules
from normlift_ns.rasterization.rasterize import resolve_backend
from normlift_ns.rasterization.settings import RasterSettings
from normlift_ns.segmentation.registry import describe_choice, resolve_source

_MIN_LIFTED_SHARE = 0.01
"""Smallest share of Gaussians with a direction, in 0..1, for which `check_directions` does not warn."""
_OBJECT_REGIONS = ("sam", "sam2", "sam3", "edges", "langsplat")
"""Kinds of regions that are objects or parts of objects."""
_COMPARED = 20_000
"""Approximate number of Gaussians whose directions are compared before and after the vote."""
_ALIGNMENT_FOLDER = "alignment"
"""Subfolder of the cache for comparisons of renders with images."""
_WARM_UP_GAUSSIANS, _WARM_UP_REGIONS = 4096, 4


@renamed(check="check_alignment")
@check_arguments
def lift_run(
    config_or_scene: str | Path | Scene,
    *,
    source: SourceOptions | None = None,
    features: Sequence[tuple[Any, Any]] | Mapping[str, tuple[Any, Any]] | None = None,
    texts: Mapping[str, Float[Tensor, " d"]] | None = None,
    lift: LiftOptions | None = None,
    queries: Sequence[str] = (),
    data: str | Path | None = None,
    load_step: int | None = None,
    output_dir: str | Path | None = None,
    timestamp: str | None = None,
    overwrite: bool = False,
    check_alignment: bool = True,
    device: str = "auto",
    export: FeatureExport | None = None,
    report: ProgressCallback = lambda stage, done, total: None,
    say: Callable[[str], None] = lambda text: None,
) -> LiftedRun:
    """Lift 2D features onto the Gaussians of a trained run, and write a lifted run next to it.

    The new run is outputs/<experiment>/normlift/<timestamp>. ns-viewer, ns-render and the ns-normlift commands open it.

    Args:
        config_or_scene: config.yml of the trained run, or a scene from `open_scene` or `open_splat`.
        source: Options of the 2D features to compute from the images. If None, use the defaults of ns-normlift.
        features: Your own features, instead of `source`. Each training image has a pair of a label map [H, W] and
            vectors [R, D]. The label map has the size of the undistorted image, before or after `lift_downscale`. Its
            values are regions 0..R-1, or -1 for no region. Pass a list with one pair per training image, or a
            dictionary by image name, which may omit images.
        texts: Vector [D] of each prompt, for your own features. The run stores the vectors for later queries.
        lift: Options of the lift. If None, use the defaults.
        queries: Prompts to store in the run; ns-render and ns-viewer show their relevancy.
        data: As in `open_scene`; allowed only with a config.
        load_step: As in `open_scene`; allowed only with a config.
        output_dir: Output folder, instead of the outputs folder of the trained run.
        timestamp: Name of the new run directory. If None, use the current time, with a number if such a run exists.
        overwrite: Replace an existing run directory of that name. For exported files, see `FeatureExport.overwrite`.
        check_alignment: Compare a few training images with renders of the scene before the lift. Warn if they differ.
            Raise if the training images show almost no Gaussians or, for a splat without a nerfstudio run, if the
            renders do not match the images at all.
        device: Device to lift on: auto, cpu or cuda.
        export: Destination of a copy of the 2D features, as LangSplat files. If None, write no copy.
        report: Progress callback, called with (stage, steps done, total steps).
        say: Callback for status lines and warnings, such as `print`.
    Raises:
        FileExistsError: The run directory of this `timestamp` exists, and `overwrite` is False.
        FileNotFoundError, ValueError: As in `open_scene`; also if an image, a label map or an option is not valid.
        MemoryError: The lift does not fit into memory or into GPU memory.
        TypeError: `config_or_scene` is neither a config nor a scene from `open_scene` or `open_splat`.

    >>> scene = open_scene(config)
    >>> import torch
    >>> left = [(torch.arange(160).expand(120, 160) // 80, torch.eye(2)) for _ in scene.train.names]
    >>> run = lift_run(scene, features=left, texts={"left": torch.tensor([1.0, 0.0])}, output_dir=folder)
    >>> 0.1 < run.ask("left")["left"].fraction < 0.8
    True
    """
    if not isinstance(config_or_scene, str | Path) and (data is not None or load_step is not None):
        raise InputError("data and load_step apply to a config only; pass them to open_scene")

    def opened() -> Scene:
        if isinstance(config_or_scene, str | Path):
            return open_scene(config_or_scene, data=data, load_step=load_step)
        return config_or_scene

    request = LiftRequest(
        open_scene=opened, source=source, features=features, texts=texts,
        lift=lift, queries=queries, output_dir=output_dir, timestamp=timestamp, overwrite=overwrite,
        check_alignment=check_alignment, device=device, export=export, report=report, say=say,
    )  # fmt: skip
    return run_lift(request)


@dataclass(frozen=True, kw_only=True)
class LiftRequest:
    """Request to lift features onto a trained scene and to write the lifted run; see `normlift_ns.lift_run`."""

    open_scene: Callable[[], Scene]
    """Function that opens the trained scene, called after all checks that do not need the scene."""
    source: SourceOptions | None = None
    features: Sequence[tuple[Any, Any]] | Mapping[str, tuple[Any, Any]] | None = None
    texts: Mapping[str, Float[Tensor, " d"]] | None = None
    lift: LiftOptions | None = None
    queries: Sequence[str] = ()
    output_dir: str | Path | None = None
    timestamp: str | None = None
    overwrite: bool = False
    check_alignment: bool = True
    device: str = "auto"
    export: FeatureExport | None = None
    report: ProgressCallback = lambda stage, done, total: None
    say: Callable[[str], None] = lambda text: None

    def __post_init__(self) -> None:
        if self.features is None and self.texts is not None:
            raise InputError("texts apply to your own features only; pass features as well, or omit texts")
        if self.features is not None and self.source is not None:
            raise InputError("got both features and source; pass only one of them, because features replace source")
        check_prompt_list("queries", self.queries)
        check_bool("check_alignment", self.check_alignment)
        check_bool("overwrite", self.overwrite)
        if self.output_dir is not None:
            check_path("output_dir", self.output_dir)
        if self.timestamp is not None:
            run_directory(Path(), "run", self.timestamp)  # raises for an invalid name before the scene loads
        for name, kind in (("source", SourceOptions), ("lift", LiftOptions), ("export", FeatureExport)):
            value = getattr(self, name)
            if value is not None and not isinstance(value, kind):
                raise InputError(f"{name} must be {kind.__name__}, got {type(value).__name__}")


@dataclass(frozen=True)
class PreparedLift:
    """Lift with an open scene and checked inputs."""

    request: LiftRequest
    scene: NerfstudioScene | SplatScene
    source: FeatureSource
    options: SourceOptions
    lift: LiftOptions
    device: str
    run_dir: Path
    texts: Mapping[str, Float[Tensor, " d"]] | None
    """The user's own text embeddings by prompt; None if the encoder embeds prompts."""
    encoder: Mapping[str, Any]
    """Options of the text encoder that matches the features."""


def run_lift(request: LiftRequest) -> LiftedRun:
    """Lift features onto a trained scene, write the lifted run, and return it."""
    prepared, stages = prepare_lift(request), StageTimer(request.report)
    scene, cache, device = prepared.scene, cache_folder(prepared.run_dir), prepared.device
    cameras = scene.train.cameras
    refuse_small_memory(len(scene.gaussians), max((c.width * c.height for c in cameras), default=0))
    check_target(prepared)
    announce(prepared)
    load_networks(prepared.source, cache)
    collection = plan_collection(scene, prepared.source, prepared.lift, cache, device=device, export=request.export)
    kernels = start_kernel_warm_up(scene, collection.gaussians, collection.options, collection.config)
    if not (cache / _ALIGNMENT_FOLDER).exists():  # a lift with cached evidence does not need these kernels
        kernels.start_rasterization()
    check_alignment(prepared, stages, kernels.wait_for_rendering)  # while the other kernels are compiled
    result = lift_collection(collection, kernels, device=device, encoder=prepared.encoder, report=request.report)
    return write_lifted_run(prepared, result, stages)


def prepare_lift(request: LiftRequest) -> PreparedLift:
    """Make the feature source, open the scene, and choose the run directory without writing to it."""
    device, options = choose_device(request.device), (request.source or SourceOptions()).looking_for(request.queries)
    init_cuda(device)
    source = None
    if request.features is None:
        options = resolve_source(options, device)
        source = make_source(options, device)  # raises before the scene loads
        if isinstance(source, RegionFeatures | PatchFeatures):
            _start_in_background(partial(getattr, source, "identity"))  # reads the files of networks
    if source is not None and len(request.queries) > 0:
        source.text(request.queries)
    scene = request.open_scene()
    if not isinstance(scene, NerfstudioScene | SplatScene):
        raise TypeError(
            "lift_run takes the config.yml of a run, or a scene from open_scene or open_splat; got "
            f"{type(scene).__name__}"
        )
    if request.export is not None:
        check_unique_stems(scene.train.names)
    if source is None:
        source = precomputed_features(request.features, request.texts, scene.train.names)
        if len(request.queries) > 0:
            source.text(request.queries)
    folder = scene.runs_dir if request.output_dir is None else check_path("output_dir", request.output_dir)
    run_dir = run_directory(folder, scene.name, request.timestamp)
    texts = source.texts if isinstance(source, PrecomputedFeatures) else None
    own = precomputed_settings(TEXT_EMBEDDINGS_FILE if texts else None)
    encoder = encoder_settings(options) if request.features is None else own
    lift = request.lift or LiftOptions()
    return PreparedLift(request, scene, source, options, lift, device, run_dir, texts, encoder)


def load_networks(source: FeatureSource, cache: Path) -> None:
    """Start to load the networks of a lift in a background thread, unless the cache already has features.

    Errors are ignored here. They occur again at the first use of the networks.
    """
    regions = source.regions if isinstance(source, RegionFeatures) else None
    encoder = source.encoder if isinstance(source, RegionFeatures | PatchFeatures) else None
    if encoder is not None and not (cache / "features").exists():
        _start_in_background(*(partial(getattr, part, "network", None) for part in (regions, encoder)))


def _start_in_background(*calls: Callable[[], object]) -> None:
    """Start a thread that calls functions one after the other, and ignores their errors."""

    def run() -> None:
        for call in calls:
            with suppress(Exception):
                call()

    Thread(target=run, name="background", daemon=True).start()


def check_target(prepared: PreparedLift) -> None:
    """Complete file writes that earlier lifts left unfinished; raise if the run exists and must not be replaced."""
    complete_interrupted_lifts(prepared.run_dir)
    if prepared.request.timestamp is not None:
        refuse_existing_run(prepared.run_dir, prepared.request.overwrite, prepared.scene.checkpoint_path)


def announce(prepared: PreparedLift) -> None:
    """Report the size of the lift, the automatic choice of 2D features, and the warnings about the scene."""
    request, scene, most, say = prepared.request, prepared.scene, prepared.lift.max_views, prepared.request.say
    used = "" if most is None else f"{min(most, len(scene.train))} of "
    views = f"{used}{len(scene.train)} training view{'s' * (len(scene.train) != 1)}"
    say(f"{len(scene.gaussians):,} Gaussians, {views}, on {prepared.device}")
    if request.features is None:
        choice = describe_choice(request.source or SourceOptions(), prepared.device)
        if choice is not None:
            say(choice)
    for remark in scene.remarks:
        say(f"Warning: {remark}")


def compare_with_images(
    scene: Scene, options: LiftOptions, device: str, measure: Callable[..., Alignment] = measure_alignment
) -> str | None:
    """Compare renders with training images; return a warning if they differ, or raise as `alignment_warning` does.

    Args:
        measure: Function that measures the agreement.
    """
    settings = RasterSettings.recorded({**scene.identity, "gsplat_rules": resolve_gsplat_version(scene, options)})
    measured_with = RasterSettings.recorded(scene.identity)
    match = scene.alignment if isinstance(scene, SplatScene) and settings == measured_with else None
    match = match or measure(scene, settings, device=device)
    return alignment_warning(match, trained_cameras=not isinstance(scene, SplatScene))


def check_alignment(prepared: PreparedLift, stages: StageTimer, wait_for_rendering: Callable[[], None]) -> None:
    """Report the warning of `compare_with_images`, unless the request disables the comparison.

    Args:
        wait_for_rendering: Function that waits until the kernels for renders are compiled.
    """
    if not prepared.request.check_alignment:
        return
    with stages("check") as step:
        measure = measure_alignment
        if prepared.lift.reuse_evidence and prepared.request.features is None:  # given features may still be refused
            folder = cache_folder(prepared.run_dir) / _ALIGNMENT_FOLDER
            measure = partial(cached_alignment, folder=folder, wait_for_kernels=wait_for_rendering)
        else:
            wait_for_rendering()
        warning = compare_with_images(prepared.scene, prepared.lift, prepared.device, measure)
        step()
    if warning is not None:
        prepared.request.say(f"Warning: {warning}")


def write_lifted_run(prepared: PreparedLift, result: LiftResult, stages: StageTimer) -> LiftedRun:
    """Write the run of a finished lift, and return it."""
    request, field = prepared.request, result.field
    if request.features is None:
        settings = source_settings(prepared.options, prepared.device)
        field = replace(field, manifest={**field.manifest, "source": settings})
    seconds = {**stages.seconds, **result.seconds}
    with stages("write") as step:
        question = query_to_store(field, prepared.scene.gaussians.means, prepared.source, request.queries)
        run_dir = write_run(
            prepared.scene, field, prepared.run_dir,
            question=question, text_embeddings=prepared.texts, overwrite=request.overwrite,
            exact_name=request.timestamp is not None,
        )  # fmt: skip
        field = field.to("cpu")
        step()
    seconds["write"] = stages.seconds["write"]
    return LiftedRun(
        run_dir, prepared.scene, resolve_field_paths(field, run_dir / FIELD_FOLDER), prepared.device, seconds
    )


def query_to_store(
    field: SemanticField, means: Float[Tensor, "n 3"], source: FeatureSource, queries: Sequence[str]
) -> Query | None:
    """Return the query that a new run stores for these prompts; None without prompts.

    Raises:
        ValueError: The vectors of the prompts and the features have different dimensions.
    """
    if len(queries) == 0:
        return None
    length = source.text(queries).shape[1]
    if length != field.dimension:
        raise InputError(
            f"the vectors of {option_name('queries')} have {length} numbers, but the features have {field.dimension}; "
            f"give the model of the features with {option_name('encoder_model')} and "
            f"{option_name('encoder_pretrained')}, or vectors of that model with {option_name('text_embeddings')}"
        )
    negatives = None
    if isinstance(source, PrecomputedFeatures):  # the file with these prompts does not exist yet
        negatives = CANONICAL_NEGATIVES if set(CANONICAL_NEGATIVES) <= set(source.texts) else ()
    return run_query(field, means, make_query(field, source.text, queries, negatives=negatives)).question


class LiftResult(NamedTuple):
    """Semantic field of a lift, with the seconds of its stages."""

    field: SemanticField
    seconds: dict[str, float]
    """Duration of each stage, in order: features, evidence, consensus, recognition, lift, neighbors, vote, store.
    Stages that the options disable are left out. A lift in several processes also has exchange, after evidence."""


def lift_scene(
    scene: Scene,
    source: FeatureSource,
    options: LiftOptions,
    cache: Path,
    *,
    device: str = "cpu",
    encoder: Mapping[str, Any],
    export: FeatureExport | None = None,
    report: ProgressCallback = lambda stage, done, total: None,
) -> LiftResult:
    """Lift 2D features onto the Gaussians of a trained scene.

    Args:
        cache: Folder for 2D features and evidence. It is created if missing, and may be deleted at any time.
        device: Device for rasterizing, lifting and voting.
        encoder: Options of the text encoder that matches the features. The manifest stores them for queries.
        export: Destination of a copy of the 2D features, as LangSplat files. If None, write no copy.
        report: Progress callback; see `ProgressCallback`.
    Raises:
        ValueError, FileNotFoundError: An image, a label map or an option is not valid, or no pixel is labeled.
        MemoryError: The lift does not fit into GPU memory.
    """
    collection = plan_collection(scene, source, options, cache, device=device, export=export)
    kernels = start_kernel_warm_up(scene, collection.gaussians, collection.options, collection.config)
    kernels.start_rasterization()
    return lift_collection(collection, kernels, device=device, encoder=encoder, report=report)


def lift_collection(
    collection: EvidenceCollection,
    kernels: KernelWarmUp,
    *,
    device: str,
    encoder: Mapping[str, Any],
    report: ProgressCallback,
) -> LiftResult:
    """Run the steps of a planned lift.

    Args:
        kernels: Result of `start_kernel_warm_up`.
        device, encoder, report: As in `lift_scene`.
    Raises:
        ValueError, FileNotFoundError, MemoryError: As in `lift_scene`.
    """
    stages, facts = StageTimer(report), {}
    options, means, source = collection.options, collection.gaussians.means, collection.source
    views = collection.collect(stages, kernels)
    table = views.features
    if options.consensus:
        with stages("consensus") as step:
            agreed = consensus(views.evidence, table, level=views.level, **consensus_options(options))
            step()
        table, facts = agreed.features, consensus_facts(options, agreed)
    if options.recognition:
        with stages("recognition") as step:
            facts |= recognition_facts(views, options)
            step()
    with stages("lift") as step:
        lifted, own = lift_features(views, table, options)
        check_directions(count_directions(lifted), len(means), source)
        step()
    copied = None
    if options.refine:
        level = views.level if measures_gate(options, facts) else None
        copied, options, vote_facts = vote_directions(means, lifted, own, options, stages, level=level)
        facts |= vote_facts
    with stages("store") as step:
        lifted = with_stored_reliability(lifted, means, collection)
        statistics = lift_statistics(collection, views, lifted.scalars.reliability, facts)
        provenance = lift_provenance(collection, options, encoder, statistics)
        field = SemanticField.build(
            lifted, means, copied, tolerance=options.tolerance, storage=options.storage, provenance=provenance
        )
        field = add_null_level(field, collection, encoder)
        step()
    return LiftResult(with_cost(field, stages, device), stages.seconds)


def add_null_level(field: SemanticField, collection: EvidenceCollection, encoder: Mapping[str, Any]) -> SemanticField:
    """Add null levels to a field as in `with_null_level`; return it unchanged if `null_vectors` returns None."""
    reused = collection.cache / "null_words" if collection.options.reuse_evidence else None
    vectors = null_vectors(collection.source, encoder, reused)
    return field if vectors is None else with_null_level(field, vectors)


def plan_collection(
    scene: Scene,
    source: FeatureSource,
    options: LiftOptions,
    cache: Path,
    *,
    device: str,
    export: FeatureExport | None,
) -> EvidenceCollection:
    """Choose the views and the rasterizer of a lift, and check its inputs as far as possible without reading images.

    Args:
        scene, source, options, cache, device, export: As in `lift_scene`.
    """
    gaussians, names = scene.gaussians.to(device), scene.train.names
    options = replace(options, vote=clamp_k(options.vote, len(gaussians))) if options.refine else options
    if options.consensus:
        options = replace(options, consensus_min_agreement=min_agreement(options, source.identity))
    config = choose_raster_config(scene, gaussians, options)
    available = set(source.available(names))
    usable = [index for index, name in enumerate(names) if name in available]
    used = [usable[i] for i in sample_evenly(len(usable), options.max_views)]
    if export is not None:
        check_unique_stems([names[index] for index in used])
    missing = [name for name in names if name not in available]
    return EvidenceCollection(scene, gaussians, used, missing, source, options, config, cache, export)


def resolve_gsplat_version(scene: Scene, options: LiftOptions) -> str:
    """Return the gsplat version whose rasterization rules a lift follows.

    Raises:
        ValueError: The options select the rules of the installed gsplat, but it is not installed.
    """
    return resolve_gsplat_rules(options.gsplat_version, scene.identity.get("gsplat_rules"))


def choose_raster_config(scene: Scene, gaussians: GaussianScene, options: LiftOptions) -> RasterConfig:
    """Choose rasterization rules, backend and precision; raise if the backend does not support the lift."""
    rules, mode = resolve_gsplat_version(scene, options), scene.rasterize_mode
    dtype = torch.float64 if options.precision == "double" else torch.float32
    planes = scene.identity.get("clip_planes")
    config = RasterConfig(rules, options.backend, dtype, mode, options.weight_power, planes)
    return replace(config, backend=resolve_backend(gaussians, **config.options))


def min_agreement(options: LiftOptions, features: Mapping[str, Any] = MappingProxyType({})) -> float:
    """Return the agreement up to which the consensus leaves features unchanged.

    Masks of objects agree more than by chance even if they are inaccurate. Cells of a partition may agree only by
    chance.

    Args:
        features: Identity of the source of 2D features, as in the manifest.
    """
    if options.consensus_min_agreement is not None:
        return options.consensus_min_agreement
    kind = features.get("regions", features).get("kind")
    return 0.0 if kind in _OBJECT_REGIONS else CHANCE_AGREEMENT


def consensus_options(options: LiftOptions) -> dict[str, Any]:
    """Return the keyword arguments for `consensus`."""
    least = min_agreement(options)
    return {"power": options.consensus_power, "sample": options.consensus_sample, "least": least}


def consensus_facts(options: LiftOptions, result: Consensus) -> dict[str, Any]:
    """Return the manifest entry for the consensus."""
    facts = {"seed": SAMPLING_SEED, "gaussians": result.gaussians, "agreement": result.agreement}
    return {"consensus": {**consensus_options(options), **facts}}


def recognition_facts(
    views: ViewObservations, options: LiftOptions, sample: tuple[Evidence, Float64[Tensor, " m"]] | None = None
) -> dict[str, Any]:
    """Return the manifest entry for the recognition of regions in left-out views.

    Args:
        sample: Evidence and sampling probabilities of the Gaussians from `sample_gaussians` (default: sample them).
    """
    if sample is None:
        rows, size = views.evidence.rows, views.evidence.num_regions
        chosen, probability = sample_gaussians(rows, size, options.consensus_sample)
        sample = views.evidence.select_gaussians(chosen), probability
    least = min_agreement(options) if options.consensus else None
    found = leave_views_out(*sample, views.features, level=views.level, power=options.consensus_power, least=least)
    return {"recognition": found.facts}


def lift_features(
    views: ViewObservations, table: Float[Tensor, "s d"], options: LiftOptions
) -> tuple[Lifted, Float[Tensor, " n"]]:
    """Lift a feature table; also return each Gaussian's own evidence for the vote, in views.

    The reliability R is always that of the features before the consensus.

    Args:
        table: Features of the regions, after the consensus if it is enabled.
    """
    kwargs = {"beta": options.reliability_beta, "unlabeled": options.unlabeled}
    lifted = lift(views.evidence, table, **kwargs)
    own = lifted.scalars.own_evidence
    if options.consensus:
        before = lift(views.evidence, views.features, **kwargs).scalars
        own = torch.where(lifted.scalars.norm > 0, before.own_evidence, 0.0)
        lifted = replace(lifted, scalars=with_original_reliability(lifted.scalars, before))
    return lifted, own


def with_stored_reliability(lifted: Lifted, means: Float[Tensor, "n 3"], collection: EvidenceCollection) -> Lifted:
    """Replace the paper's R with the kind of R that the options select.

    Args:
        lifted: Lift with the paper's R of the features before the consensus.
        means: Centers of the Gaussians.
    """
    kind, beta, scalars = collection.options.reliability, collection.options.reliability_beta, lifted.scalars
    if kind == "paper":
        return lifted
    views, norm = scalars.n_eff.double(), norm_of_reliability(scalars.reliability, scalars.n_eff, beta)
    if kind == "angular":
        cameras = (collection.scene.train.cameras[index] for index in collection.views)
        centers = torch.stack([camera.world_to_camera.double().cpu().inverse()[:3, 3] for camera in cameras])
        views = independent_views(lifted.evidence.view_weights(), means, centers.to(means.device))
    value = pair_reliability(norm, views, beta).to(scalars.reliability)
    return replace(lifted, scalars=replace(scalars, reliability=value))


def count_directions(lifted: Lifted) -> Int64[Tensor, " 2"]:
    """Return the number of Gaussians with a direction, and the number of evidence entries."""
    norm = lifted.scalars.norm
    return torch.stack([(norm > 0).sum(), torch.tensor(lifted.evidence.nnz, device=norm.device)])


def check_directions(counts: Int64[Tensor, " 2"], total: int, source: FeatureSource) -> None:
    """Raise if no Gaussian received a direction, and warn if few did.

    Args:
        counts: Counts from `count_directions`, of all Gaussians.
        total: Number of Gaussians.
    Raises:
        ValueError: No Gaussian has a direction.
    """
    lifted, entries = counts.tolist()
    if lifted == 0 and entries == 0:
        raise InputError(
            f"nothing was labeled: no pixel that shows any of the {total:,} Gaussians belongs to a region (from "
            f"{_describe(source)}). Check these likely causes: all label values are negative or the background "
            f"({option_name('regions_background')}), the level has no regions ({option_name('level')}), masks exclude "
            "all pixels, all features are zero, or the cameras do not face the scene"
        )
    if lifted == 0:
        raise InputError(
            f"none of the {total:,} Gaussians received a direction, although some of them appear in regions (from "
            f"{_describe(source)}). Check whether the features of the regions cancel out in every Gaussian"
        )
    if lifted < _MIN_LIFTED_SHARE * total:
        warnings.warn(
            f"only {lifted:,} of {total:,} Gaussians ({lifted / total:.2%}) received a direction; the others have "
            f"no features. If this is not intended, check the regions (from {_describe(source)}) and the cameras",
            stacklevel=2,
        )


def _describe(source: FeatureSource) -> str:
    """Describe the source of the regions, for a message."""
    regions = getattr(source, "regions", source)
    kind, folder = regions.identity.get("kind", "your own source"), getattr(regions, "folder", None)
    return str(kind) if folder is None else f"{kind} in {folder}"


def measures_gate(options: LiftOptions, facts: Mapping[str, Any]) -> bool:
    """Return True if the gate of the vote (tau and gamma) is measured instead of taken from the options.

    It is measured in a posterior vote without --vote-tau, after a consensus that changed features.

    Args:
        facts: `consensus_facts`, if the consensus is enabled.
    """
    agreement = facts["consensus"]["agreement"] if "consensus" in facts else []
    changed = any(x > min_agreement(options) for x in agreement)
    return changed and options.vote.vote == "posterior" and options.vote.tau is None


def with_gate(options: LiftOptions, cosines: Float64[Tensor, " q"] | None) -> tuple[LiftOptions, dict[str, Any]]:
    """Return the options with the resolved gate of the vote, and its manifest entry if it was measured.

    Args:
        cosines: Cosines of all processes from `shared_region_cosines`, or None for the gate of the options.
    """
    gate = None if cosines is None else relative_gate(cosines)
    if cosines is None or gate is None:
        return replace(options, vote=replace(options.vote, **options.vote.numbers._asdict())), {}
    tau, gamma = gate
    gamma = gamma if options.vote.gamma is None else options.vote.gamma
    facts = {"gate": {"tau": tau, "gamma": gamma, "pairs": len(cosines)}}
    return replace(options, vote=replace(options.vote, tau=tau, gamma=gamma)), facts


def vote_directions(
    means: Float[Tensor, "n 3"],
    lifted: Lifted,
    own: Float[Tensor, " n"],
    options: LiftOptions,
    stages: StageTimer,
    *,
    level: Int64[Tensor, " s"] | None = None,
) -> tuple[Int32[Tensor, " n"], LiftOptions, dict[str, Any]]:
    """Let neighboring Gaussians vote on their directions.

    Args:
        level: Level of every region, to measure the gate. If None, use the gate of the options.
    Returns:
        The index of the Gaussian whose direction each Gaussian takes, the options with the resolved parameters of the
        vote, and the manifest entries (the gate and shares of Gaussians).
    """
    reliability, n = lifted.scalars.reliability, len(means)
    gaussians = torch.arange(n, device=means.device)
    with stages("neighbors", n):
        neighbors = nearest_neighbors(means, options.vote.k, progress=partial(stages.report, "neighbors"))
    with stages("vote", n):
        cosines = None
        if level is not None:
            cosines = shared_region_cosines(lifted, *sample_pairs(gaussians, neighbors.index, n), level)
        options, facts = with_gate(options, cosines)
        progress = partial(stages.report, "vote")
        copied = refine(
            means, lifted.directions, reliability, options.vote,
            own=own, labeled=labeled_share(lifted.evidence), neighbors=neighbors, progress=progress,
        )  # fmt: skip
        changed = count_changes(lifted, copied.long(), gaussians, n)
        copied = copied if int(changed[0]) > 0 else gaussians.int()  # a vote that changes nothing stores nothing
        counts = count_votes(copied, gaussians, neighbors, reliability)
    return copied, options, facts | vote_shares(counts, changed, n)


def count_changes(
    lifted: Lifted, source: Int64[Tensor, " m"], gaussians: Int64[Tensor, " m"], n: int
) -> Int64[Tensor, " 2"]:
    """Return the number of sampled Gaussians that change direction, and the number of all sampled Gaussians.

    A direction counts as changed if the cosine of the old and the new direction is below `CHANGED_COSINE`.

    Args:
        source: Row in the lift of the Gaussian that provides the direction, for each of the first m Gaussians.
        gaussians: Indices of the first m Gaussians among all n. A hash of the index decides whether a Gaussian is
            sampled.
    """
    row = (hash_to_unit(gaussians) < min(1.0, _COMPARED / max(1, n))).nonzero().squeeze(1)
    copies = row[source[row] != row]
    cosine = (lifted.directions(copies) * lifted.directions(source[copies])).sum(dim=1)
    return torch.stack([(cosine < CHANGED_COSINE).sum(), row.new_tensor(len(row))])


def count_votes(
    copied: Int32[Tensor, " m"], gaussians: Int[Tensor, " m"], neighbors: Neighbors, reliability: Float[Tensor, " n"]
) -> Int64[Tensor, " 2"]:
    """Return the number of Gaussians that copied another direction, and the number of `unsupported` Gaussians."""
    return torch.stack([(copied != gaussians).sum(), unsupported(neighbors, reliability).sum()])


def vote_shares(counts: Int64[Tensor, " 2"], changed: Int64[Tensor, " 2"], n: int) -> dict[str, float]:
    """Return shares for the manifest: `count_votes` relative to n Gaussians, `count_changes` relative to the sample."""
    (copied, lost), (turned, sampled) = counts.tolist(), changed.tolist()
    shares = {"refined_share": copied / n, "changed_share": turned / max(1, sampled)}
    return {**shares, "unsupported_share": lost / n}


def lift_statistics(
    collection: EvidenceCollection,
    views: ViewObservations,
    reliability: Float[Tensor, " n"],
    facts: Mapping[str, Any],
) -> dict[str, Any]:
    """Return the statistics of a lift for the manifest.

    Args:
        reliability: R of all Gaussians.
        facts: Statistics of the consensus, the recognition and the vote, if they are enabled.
    """
    positive = reliability[reliability > 0].double().sort().values
    n, count, shares = reliability.numel(), len(positive), (0.05, 0.25, 0.5, 0.75, 0.95)
    quantiles = {str(q): float(positive[round(q * (count - 1))]) for q in shares} if count > 0 else {}
    return {
        "views": len(collection.views),
        "left_out": len(collection.missing),
        "excluded": views.evidence.num_excluded,
        "gaussians": n,
        "zero_evidence_share": 1 - count / max(1, n),
        "reliability_quantiles": quantiles,
        **facts,
    }


def lift_provenance(
    collection: EvidenceCollection, options: LiftOptions, encoder: Mapping[str, Any], statistics: Mapping[str, Any]
) -> dict[str, Any]:
    """Return the metadata of a lift for the manifest.

    Args:
        options: Options with the gate that the vote used.
    """
    scene, config = collection.scene, collection.config
    return {
        **scene.identity,
        "encoder": dict(encoder),
        "cameras": camera_summary(scene.train.cameras),
        "cameras_held_out": camera_summary(scene.held_out.cameras),
        "features": collection.source.identity,
        "options": asdict(options),
        "views_lifted": [scene.train.names[index] for index in collection.views],
        "views_without_features": list(collection.missing),
        "gsplat_rules": config.gsplat_version,
        "backend": config.backend,
        "statistics": dict(statistics),
    }


def with_cost(field: SemanticField, stages: StageTimer, device: str) -> SemanticField:
    """Return a field whose manifest records the time and memory of the lift."""
    return replace(field, manifest={**field.manifest, "cost": lift_cost(stages.seconds, device)})


class KernelWarmUp:
    """Threads that compile or load the kernels of a lift before their first use.

    Errors in the threads are suppressed, because the lift itself raises them again.

    Args:
        rendering: Calls that compile the kernels of renders.
        sums: Calls that compile the other kernels of evidence.
        early: Calls that compile the other kernels that do not depend on the features.
        lift: Calls that compile the remaining kernels, as a function of the dimension of the features.
        load: Function that each thread calls first.
    """

    def __init__(
        self,
        rendering: Sequence[Callable[[], None]] = (),
        sums: Sequence[Callable[[], None]] = (),
        early: Iterable[Callable[[], None]] = (),
        lift: Callable[[int], Iterable[Callable[[], None]]] = lambda dimension: (),
        load: Callable[[], None] = lambda: None,
    ) -> None:
        self._rendering_calls, self._sums_calls, self._lift_calls, self._load = rendering, sums, lift, load
        self._rendering, self._sums, self._lift = list[Thread](), list[Thread](), list[Thread]()
        self._early = [self._start(call) for call in early]

    def _start(self, call: Callable[[], None]) -> Thread:
        def run() -> None:
            with suppress(Exception), torch.no_grad():
                self._load()
                call()

        thread = Thread(target=run, name="kernel warm-up", daemon=True)
        thread.start()
        return thread

    def start_lift(self, dimension: int) -> None:
        """Start to compile the kernels that depend on the dimension of the features, unless this has been done."""
        if len(self._lift) == 0:
            self._lift = [self._start(call) for call in self._lift_calls(dimension)]

    def start_rasterization(self) -> None:
        """Start to compile the kernels of renders and evidence, unless this has been done."""
        if len(self._rendering) == 0:
            self._rendering, self._sums = (
                [self._start(call) for call in calls] for calls in (self._rendering_calls, self._sums_calls)
            )

    def wait_for_rendering(self) -> None:
        """Call `start_rasterization`, and wait for the kernels of renders."""
        self.start_rasterization()
        for thread in self._rendering:
            thread.join()

    def wait_for_evidence(self) -> None:
        """Call `start_rasterization`, and wait for all kernels that do not depend on the features."""
        self.start_rasterization()
        for thread in (*self._rendering, *self._sums, *self._early):
            thread.join()

    def wait(self) -> None:
        """Wait for all kernels whose compilation has been started."""
        for thread in (*self._rendering, *self._sums, *self._early, *self._lift):
            thread.join()


def start_kernel_warm_up(
    scene: Scene, gaussians: GaussianScene, options: LiftOptions, config: RasterConfig
) -> KernelWarmUp:
    """Start to compile or load the kernels of a lift, except those of `start_rasterization` and `start_lift`."""
    if config.backend == "numba":
        from normlift_ns.rasterization.numba import compile_kernels  # noqa: PLC0415 (importing numba takes a second)

        return KernelWarmUp(early=[compile_kernels(config.dtype).join])
    if config.backend != "triton" or len(scene.train) == 0:
        return KernelWarmUp()
    from normlift_ns.rasterization.triton import kernel_calls  # noqa: PLC0415 (needs triton)

    rendering, sums = kernel_calls(gaussians, scene.train.cameras[0], **config.options)
    early, lift = lift_calls(gaussians.means, options)
    return KernelWarmUp(rendering, sums, early, lift, load_triton)


def lift_calls(
    means: Float[Tensor, "n 3"], options: LiftOptions
) -> tuple[list[Callable[[], None]], Callable[[int], list[Callable[[], None]]]]:
    """Return functions that run stages of a lift on some Gaussians, to compile the kernels, and discard the results.

    Returns:
        Functions for the consensus and the neighbors, and a function that returns those for the lift and the vote,
        given the dimension of the features.
    """
    means, regions = means[:_WARM_UP_GAUSSIANS], _WARM_UP_REGIONS
    n, device = len(means), means.device
    votes = options.refine and n > options.vote.k

    def evidence() -> Evidence:
        gaussian = torch.arange(n, dtype=torch.int32, device=device)
        entries = Entries(gaussian, gaussian % regions + 1, torch.ones(n, device=device), (regions,))
        return Evidence.from_entries([entries], n)

    def agree() -> None:
        if options.consensus:
            consensus(evidence(), torch.eye(regions, device=device))

    def find_neighbors() -> None:
        if votes:
            nearest_neighbors(means, options.vote.k)

    def start_libraries() -> None:
        rows = torch.eye(regions, device=device)
        torch.linalg.eigh((rows @ rows).double())  # on a GPU, these are cuBLAS and cuSOLVER

    def of_dimension(dimension: int) -> list[Callable[[], None]]:
        features = torch.zeros(regions, dimension, device=device)
        features[:, 0] = 1

        def lift_sample() -> None:
            lifted = lift(evidence(), features, beta=options.reliability_beta, unlabeled=options.unlabeled)
            lifted.directions()
            lifted.evidence.rows.matmul(features[:, :1].double())  # as `basis_of_rank` does

        def vote() -> None:
            if votes:
                rows, ones = features[torch.arange(n, device=device) % regions], torch.ones(n, device=device)
                refine(means, rows, ones, options.vote, own=ones, neighbors=nearest_neighbors(means, options.vote.k))

        return [lift_sample, vote]

    return [start_libraries, agree, find_neighbors], of_dimension
