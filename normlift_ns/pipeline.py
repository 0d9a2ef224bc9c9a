"""The lift from a trained scene and its features to a lifted run: evidence, consensus, lift, vote, store, write."""

from __future__ import annotations

import json
import warnings
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from copy import deepcopy
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path
from threading import Thread
from typing import Any, NamedTuple

import torch
from jaxtyping import Float, Int32, Int64
from torch import Tensor

from normlift_ns.core.consensus import SAMPLING_SEED, consensus, with_original_reliability
from normlift_ns.core.device import choose_device, init_cuda
from normlift_ns.core.evidence import Evidence
from normlift_ns.core.field import SemanticField, fingerprint
from normlift_ns.core.gaussians import Camera, GaussianScene
from normlift_ns.core.lift import Lifted, Scalars, lift
from normlift_ns.core.neighbors import nearest_neighbors
from normlift_ns.core.partition import SINGLE_PROCESS, Communicator, Partition, ProgressCallback
from normlift_ns.core.refine import clamp_k, decay_width, refine, refine_subset, unsupported
from normlift_ns.core.scene import Scene, camera_summary
from normlift_ns.data.alignment import alignment_warning, measure_alignment
from normlift_ns.data.checkpoint import Checkpoint
from normlift_ns.data.extra_images import EXTRA_IMAGES_FILE
from normlift_ns.data.nerfstudio.config import dump_config, set_dataset, skip_seed_points
from normlift_ns.data.nerfstudio.config_classes import (
    FullImageDatamanagerConfig,
    NerfstudioDataParserConfig,
    NormLiftModelConfig,
    TrainerConfig,
    VanillaPipelineConfig,
    ViewerConfig,
)
from normlift_ns.data.nerfstudio.load import NerfstudioScene
from normlift_ns.data.open_splat import CHECKPOINT_DIR, TRANSFORMS_FILE, SplatScene, save_splat, splatfacto_checkpoint
from normlift_ns.data.transforms import write_transforms
from normlift_ns.distributed.communicator import gather_halo
from normlift_ns.encoders.base import FeatureSource
from normlift_ns.encoders.build import make_source, source_settings
from normlift_ns.encoders.langsplat import check_unique_stems
from normlift_ns.encoders.precomputed import PrecomputedFeatures, precomputed_features
from normlift_ns.encoders.text_files import write_text_embeddings
from normlift_ns.errors import InputError
from normlift_ns.evidence_collection import FeatureExport, RasterConfig, collect_evidence, sample_evenly
from normlift_ns.io.atomic import atomic_file, commit_directory, draft_directory, numbered_paths, write_text_file
from normlift_ns.io.run_dir import (
    FIELD_FOLDER,
    TEXT_EMBEDDINGS_FILE,
    add_digest_comment,
    cache_folder,
    complete_interrupted_lifts,
    refuse_existing_run,
    run_directory,
    run_file_digests,
)
from normlift_ns.lifted_run import LiftedRun, resolve_field_paths
from normlift_ns.options import (
    CANONICAL_NEGATIVES,
    BackendName,
    LiftOptions,
    RasterizeMode,
    RefineConfig,
    SourceOptions,
    check_bool,
    check_path,
    check_prompt_list,
)
from normlift_ns.progress import StageTimer, lift_cost
from normlift_ns.query.engine import run_query
from normlift_ns.query.question import Query, make_query, save_query
from normlift_ns.query.text_encoder import encoder_settings, precomputed_settings
from normlift_ns.rasterization.gsplat import resolve_gsplat_rules
from normlift_ns.rasterization.rasterize import rasterize_evidence, resolve_backend
from normlift_ns.rasterization.settings import RasterSettings

_GAUSSIANS, _REGIONS, _DIMENSION = 4096, 4, 512


def warm_up_kernels(
    gaussians: GaussianScene,
    camera: Camera,
    options: LiftOptions,
    *,
    rasterize_mode: RasterizeMode,
    settings: RasterSettings,
    backend: BackendName,
    dtype: torch.dtype,
) -> Thread:
    """Lift random features onto some of the Gaussians in a thread, and discard the result.

    Errors are suppressed here, because the lift itself will raise them again.
    """
    arrays = (gaussians.means, gaussians.quats, gaussians.scales, gaussians.opacities)
    sample = GaussianScene(*(array[:_GAUSSIANS] for array in arrays))

    def work() -> None:
        with suppress(Exception), torch.no_grad():  # as the docstring says
            evidence = rasterize_evidence(
                sample, [camera], [_quarters(camera)], num_regions=[_REGIONS], backend=backend,
                rasterize_mode=rasterize_mode, settings=settings, dtype=dtype, weight_power=options.weight_power,
            )  # fmt: skip
            features = torch.eye(_REGIONS, _DIMENSION, dtype=dtype, device=sample.means.device)
            if options.consensus:
                consensus(evidence, features)
            lifted = lift(evidence, features, beta=options.beta, unlabeled=options.unlabeled)
            if options.refine and len(sample) > options.vote.k:
                neighbors = nearest_neighbors(sample.means, options.vote.k)
                own, reliability = lifted.scalars.own_evidence, lifted.scalars.reliability
                refine(sample.means, lifted.directions, reliability, options.vote, own=own, neighbors=neighbors)

    thread = Thread(target=work, name="kernel warm-up", daemon=True)
    thread.start()
    return thread


def _quarters(camera: Camera) -> torch.Tensor:
    """Return labels of the four quarters of an image."""
    x, y = torch.arange(camera.width), torch.arange(camera.height)
    return (2 * (y[:, None] * 2 // camera.height) + x * 2 // camera.width).int()


# The config.yml of a run lifted from a PLY file or gsplat checkpoint, for which nerfstudio has written none.


def splat_config(scene: SplatScene, run_dir: Path) -> TrainerConfig:
    """Return a config with which stock nerfstudio loads the cameras in the run directory without transforming them.

    All paths except that of the field are absolute, because there is no training directory for relative paths.
    """
    cameras = run_dir / TRANSFORMS_FILE
    dataparser = NerfstudioDataParserConfig(
        data=cameras,
        downscale_factor=1,
        orientation_method="none",
        center_method="none",
        auto_scale_poses=False,
        eval_mode="all",
        load_3D_points=False,
    )
    model = NormLiftModelConfig(
        sh_degree=max(1, scene.splat.degree),
        background_color=scene.background_name,
        rasterize_mode=scene.rasterize_mode,
        semantics=Path(FIELD_FOLDER),
    )
    datamanager = FullImageDatamanagerConfig(
        data=cameras,
        dataparser=dataparser,
        cache_images="gpu",  # means the pipeline's device; "cpu" would pin memory, which needs CUDA
        cache_images_type="uint8",
    )
    return TrainerConfig(
        method_name="normlift",
        experiment_name=scene.name,
        output_dir=run_dir.parents[2],
        timestamp=run_dir.name,
        relative_model_dir=Path(CHECKPOINT_DIR),
        data=cameras,
        pipeline=VanillaPipelineConfig(datamanager=datamanager, model=model),
        viewer=ViewerConfig(num_rays_per_chunk=1 << 15),
        vis="viewer",
    )


# Writing the directory of a lifted run: the files that stock nerfstudio loads, and the semantic field.


def write_run(
    source: NerfstudioScene | SplatScene,
    field: SemanticField,
    run_dir: Path,
    *,
    question: Query | None = None,
    texts: Mapping[str, Tensor] | None = None,
    overwrite: bool = False,
    exact: bool = True,
) -> Path:
    """Write a lifted run, completely or not at all, and return its directory.

    The directory holds config.yml (method normlift), nerfstudio_models/step-*.ckpt (step and tensors of the model,
    without optimizers), dataparser_transforms.json, and the field in normlift/. A run lifted from a PLY file or gsplat
    checkpoint also has its cameras in transforms.json, and other settings for reopening it in splat.json.

    Relative paths in the config of the source run stay relative. Stock ns-* commands therefore run from the directory
    that the source run was trained in; ns-normlift commands run from any directory.

    Args:
        run_dir: directory from `run_directory`, output_dir/experiment/normlift/timestamp.
        question: query to render as relevancy_0, relevancy_1, …
        texts: embeddings provided by the user, by prompt.
        overwrite: replace an existing directory.
        exact: if False and `run_dir` exists, write to <name>_2, <name>_3, … instead.
    Raises:
        FileExistsError: the directory exists, `exact` is True and `overwrite` is False.
        ValueError: the field was lifted from other Gaussians.
        OSError: writing failed, for instance because the disk is full; no files are left then.
    """
    complete_interrupted_lifts(run_dir)
    if exact:
        refuse_existing_run(run_dir, overwrite)
    if field.manifest["means_fingerprint"] != fingerprint(source.gaussians.means):
        raise InputError(
            f"The semantic field has {len(field)} Gaussians and was not lifted from the {len(source.gaussians)} of "
            f"{source.checkpoint_path}; lift that checkpoint again."
        )
    with draft_directory(run_dir) as folder:
        if isinstance(source, SplatScene):
            save_splat(folder, source)
            transform = {"transform": torch.eye(4)[:3].tolist(), "scale": 1.0}
        else:
            if len(source.added) > 0:
                write_transforms(folder / EXTRA_IMAGES_FILE, source.added, ())
            transform = {"transform": source.dataparser_transform.tolist(), "scale": source.dataparser_scale}
        write_text_file(folder / "dataparser_transforms.json", json.dumps(transform, indent=4))
        _write_tensors(folder, source, field, question, texts)
        for path in (run_dir,) if exact else numbered_paths(run_dir):
            is_splat = isinstance(source, SplatScene)
            config = splat_config(source, path) if is_splat else _lifted_config(source, path)
            write_text_file(folder / "config.yml", add_digest_comment(dump_config(config)), overwrite=True)
            if commit_directory(folder, path, overwrite=overwrite and exact):
                return path
    refuse_existing_run(run_dir, overwrite=False)  # another process created it meanwhile
    raise FileExistsError(f"another process created and removed {run_dir} during the lift; lift again")


def _lifted_config(source: NerfstudioScene, run_dir: Path) -> TrainerConfig:
    config, location = deepcopy(source.config), source.location
    config.method_name = "normlift"
    config.output_dir = location.portable(run_dir.parents[2])
    config.timestamp = run_dir.name
    config.relative_model_dir = Path(CHECKPOINT_DIR)
    config.load_dir = config.load_step = config.load_config = config.load_checkpoint = None
    config.pipeline.model = NormLiftModelConfig.upgrade(source.model_config, semantics=Path(FIELD_FOLDER))
    if location.moved_data or config.output_dir.is_absolute():
        set_dataset(config, location.data)  # a relative path would not be found
    skip_seed_points(config)
    # "gpu" means the pipeline's device; "cpu" would pin memory, which needs CUDA
    config.pipeline.datamanager.cache_images = "gpu"
    return config


def _write_tensors(
    folder: Path,
    source: NerfstudioScene | SplatScene,
    field: SemanticField,
    question: Query | None,
    texts: Mapping[str, Tensor] | None,
) -> None:
    checkpoint = (
        splatfacto_checkpoint(source) if isinstance(source, SplatScene) else _model_checkpoint(source.checkpoint)
    )
    path = folder / CHECKPOINT_DIR / f"step-{checkpoint['step']:09d}.ckpt"
    with atomic_file(path) as draft:
        torch.save(checkpoint, draft)
    field_dir = folder / FIELD_FOLDER
    if texts:
        write_text_embeddings(field_dir / TEXT_EMBEDDINGS_FILE, texts)
    field.save(
        field_dir, beside=run_file_digests(field_dir, [path, field_dir / TEXT_EMBEDDINGS_FILE, *folder.glob("*.json")])
    )
    if question is not None:
        save_query(field_dir, question)


def _model_checkpoint(checkpoint: Checkpoint) -> dict[str, Any]:
    """Return the step and the model of a checkpoint, without optimizers."""
    pipeline = {f"_model.{name}": tensor for name, tensor in checkpoint.model.items()}
    return {"step": checkpoint.step, "pipeline": pipeline}


# Pipeline from a trained scene and a source of 2D features to a semantic field. Read this module first.


_MIN_LIFTED_SHARE = 0.01
"""Share of Gaussians with features below which to warn: something is wrong, or almost no pixel was labeled."""


class LiftResult(NamedTuple):
    """Semantic field of a lift, and the time it took."""

    field: SemanticField
    seconds: dict[str, float]
    """Duration of each stage, in order: features, evidence, consensus (if enabled), lift, neighbors, vote, store."""


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
        cache: folder for 2D features and evidence. It is created if missing, and may be deleted at any time.
        device: device for rasterizing, lifting and voting.
        encoder: options that queries need to encode prompts in the same way. The manifest stores them.
        export: where to also write the 2D features, in LangSplat's format.
        report: called with the progress.
    Raises:
        ValueError, FileNotFoundError: an image, a label map or an option does not fit, which the message names, or no
            pixel is labeled.
        MemoryError: the lift does not fit into GPU memory.
    """
    result = lift_scene_distributed(
        SINGLE_PROCESS, scene, source, options, cache, device=device, encoder=encoder, export=export, report=report
    )
    assert result is not None
    return result


def lift_scene_distributed(
    team: Communicator,
    scene: Scene,
    source: FeatureSource,
    options: LiftOptions,
    cache: Path,
    *,
    device: str,
    encoder: Mapping[str, Any],
    export: FeatureExport | None,
    report: ProgressCallback,
) -> LiftResult | None:
    """Run `lift_scene` in several processes, each with the whole scene. Only rank 0 gets the result.

    The result does not depend on the number of processes. The evidence of a view does not depend on other views, and
    Gaussians are processed in the same blocks.
    """
    stages = StageTimer(team.counted(report))
    gaussians, views = scene.gaussians.to(device), scene.train
    options = replace(options, vote=clamp_k(options.vote, len(gaussians))) if options.refine else options
    config = choose_raster_config(scene, gaussians, options)
    names = set(source.available(views.names))
    usable = [index for index, name in enumerate(views.names) if name in names]
    used = [usable[i] for i in sample_evenly(len(usable), options.max_views)]
    if export is not None:
        check_unique_stems([views.names[index] for index in used])
    wait_for_kernels = start_kernel_warm_up(scene, gaussians, options, config)
    portion = Partition.of(team, gaussians.means)
    evidence, features, level = collect_evidence(
        scene, gaussians, used, source, options, config, cache, export, stages, wait_for_kernels, portion
    )
    table, consensus_facts = features, {}
    if options.consensus:
        table, consensus_facts = _run_consensus(evidence, features, level, options, portion, stages)
    with stages("lift") as step:
        kwargs = {"beta": options.beta, "unlabeled": options.unlabeled}
        lifted = lift(evidence, table, **kwargs)
        _check_directions(evidence, lifted.scalars, source, portion)
        own = lifted.scalars.own_evidence
        if options.consensus:
            before = lift(evidence, features, **kwargs).scalars
            own = torch.where(lifted.scalars.norm > 0, before.own_evidence, 0.0)
            lifted = replace(lifted, scalars=with_original_reliability(lifted.scalars, before))
        step()
    counts = {"views": len(used), "left_out": len(views) - len(usable), "excluded": evidence.num_excluded}
    copied, vote_facts = None, {}
    if options.refine:
        copied, vote_facts = vote_distributed(gaussians.means, lifted, own, options.vote, portion, stages)
    with stages("store") as step:
        provenance = {
            **scene.identity,
            "encoder": dict(encoder),
            "cameras": camera_summary(scene.train.cameras),
            "cameras_held_out": camera_summary(scene.held_out.cameras),
            "features": source.identity,
            "options": asdict(options),
            "views_lifted": [views.names[index] for index in used],
            "views_without_features": [name for name in views.names if name not in names],
            "gsplat_rules": config.rules,
            "backend": config.backend,
            "statistics": {
                **counts,
                **consensus_facts,
                **_statistics(portion.join(lifted.scalars.reliability)),
                **vote_facts,
            },
        }
        kwargs = {"tolerance": options.tolerance, "storage": options.storage}
        field = SemanticField.build_together(lifted, gaussians.means, copied, portion, provenance=provenance, **kwargs)
        step()
    if field is None:
        return None
    field = replace(field, manifest={**field.manifest, "cost": lift_cost(stages.seconds, device)})
    return LiftResult(field, stages.seconds)


def resolve_gsplat_version(scene: Scene, options: LiftOptions) -> str:
    """Return the gsplat version whose rasterization rules a lift follows.

    Raises:
        ValueError: the options ask for the rules of the installed gsplat, but it is not installed.
    """
    return resolve_gsplat_rules(options.gsplat_rules, scene.identity.get("gsplat_rules"))


def choose_raster_config(scene: Scene, gaussians: GaussianScene, options: LiftOptions) -> RasterConfig:
    """Choose how to rasterize, and raise before any image is read if that is impossible."""
    rules = resolve_gsplat_version(scene, options)
    dtype = torch.float64 if options.precision == "double" else torch.float32
    settings = RasterSettings.of_gsplat(rules)
    power = options.weight_power
    backend = resolve_backend(gaussians, options.backend, settings=settings, dtype=dtype, weight_power=power)
    return RasterConfig(rules, backend, dtype)


def start_kernel_warm_up(
    scene: Scene, gaussians: GaussianScene, options: LiftOptions, drawing: RasterConfig
) -> Callable[[], None]:
    """Start to compile or load kernels in the background; return a function that waits for them."""
    if drawing.backend == "numba":
        from normlift_ns.rasterization.numba import compile_kernels  # noqa: PLC0415 (importing numba takes a second)

        return compile_kernels(drawing.dtype).join
    if drawing.backend != "triton" or len(scene.train) == 0:
        return lambda: None
    kwargs = {"settings": drawing.settings, "backend": drawing.backend, "dtype": drawing.dtype}
    return warm_up_kernels(
        gaussians, scene.train.cameras[0], options, rasterize_mode=scene.rasterize_mode, **kwargs
    ).join


def _check_directions(evidence: Evidence, scalars: Scalars, source: FeatureSource, portion: Partition) -> None:
    """Raise if no Gaussian received a direction.

    Raises:
        ValueError: no Gaussian has a direction.
    """
    entries = torch.tensor(evidence.nnz, device=scalars.norm.device)
    lifted, entries = portion.team.add(torch.stack([(scalars.norm > 0).sum(), entries])).tolist()
    total = len(portion.order)
    if lifted == 0 and entries == 0:
        raise InputError(
            f"nothing was labeled: no pixel that shows any of the {total:,} Gaussians belongs to a region (from "
            f"{_describe(source)}). Likely causes: every value in the label maps is negative or the background "
            "(--regions-background), the level has no regions (--level), masks exclude everything, or the cameras do "
            "not see the scene"
        )
    if lifted == 0:
        raise InputError(
            f"none of the {total:,} Gaussians received a direction, although they have regions (from "
            f"{_describe(source)}): the features cancel out in every Gaussian, or unlabeled pixels outweigh them "
            "(--unlabeled dilute)"
        )
    if lifted < _MIN_LIFTED_SHARE * total:
        warnings.warn(
            f"only {lifted:,} of {total:,} Gaussians ({lifted / total:.2%}) appear in labeled pixels; the others have "
            f"no features. If you did not expect this, check the regions (from {_describe(source)}) and the cameras",
            stacklevel=2,
        )


def _describe(source: FeatureSource) -> str:
    """Describe the source of the regions, for a message."""
    regions = getattr(source, "regions", source)
    kind, folder = regions.identity.get("kind", "your own source"), getattr(regions, "folder", None)
    return str(kind) if folder is None else f"{kind} in {folder}"


def _run_consensus(
    evidence: Evidence,
    features: Float[Tensor, "s d"],
    level: Int64[Tensor, " s"],
    options: LiftOptions,
    portion: Partition,
    stages: StageTimer,
) -> tuple[Float[Tensor, "s d"], dict[str, Any]]:
    """Return the features after consensus, and what the manifest records about it."""
    with stages("consensus") as step:
        kwargs = {
            "power": options.consensus_power, "sample": options.consensus_sample, "least": options.consensus_least
        }  # fmt: skip
        result = consensus(evidence, features, level=level, portion=portion, **kwargs)
        step()
    facts = {**kwargs, "seed": SAMPLING_SEED, "gaussians": result.gaussians, "agreement": result.agreement}
    return result.features, {"consensus": facts}


def vote_distributed(
    means: Float[Tensor, "n 3"],
    lifted: Lifted,
    own: Float[Tensor, " m"],
    config: RefineConfig,
    portion: Partition,
    stages: StageTimer,
) -> tuple[Int32[Tensor, " m"], dict[str, float]]:
    """Vote in one or several processes.

    Returns:
        For every Gaussian of the partition, the Gaussian whose direction it takes. Also the shares of all Gaussians
        that change their direction and that have no support.
    """
    gaussians = portion.gaussians
    with stages("neighbors", len(gaussians)):
        progress = partial(stages.tell, "neighbors")
        of = gaussians if portion.team.size > 1 else None
        neighbors = nearest_neighbors(means, config.k, of=of, progress=progress, team=portion.team)
    with stages("vote", len(gaussians)):
        progress = partial(stages.tell, "vote")
        if portion.team.size == 1:
            reliability = lifted.scalars.reliability
            copied = refine(
                means, lifted.directions, reliability, config, own=own, neighbors=neighbors, progress=progress
            )
        else:
            halo = gather_halo(lifted, neighbors, portion)
            neighbors, reliability = halo.neighbors, portion.join(lifted.scalars.reliability)[halo.gaussians]
            own = torch.cat([own, own.new_zeros(len(halo.gaussians) - len(own))])
            kwargs = {"own": None if config.vote == "paper" else own, "progress": progress}
            width = decay_width(portion.team.join(neighbors.spacing), config)
            directions = halo.lifted.directions
            rows = refine_subset(portion.along, neighbors, directions, reliability, config, width=width, **kwargs)
            copied = halo.gaussians[rows[: len(gaussians)].long()].int()
        changed, lost = (copied != gaussians).sum(), unsupported(neighbors, reliability).sum()
        changed, lost = portion.team.add(torch.stack([changed, lost])).tolist()
    return copied, {"refined_share": changed / len(means), "unsupported_share": lost / len(means)}


def _statistics(reliability: Float[Tensor, " n"]) -> dict[str, Any]:
    positive = reliability[reliability > 0].double().sort().values
    n, count, shares = reliability.numel(), len(positive), (0.05, 0.25, 0.5, 0.75, 0.95)
    quantiles = {str(q): float(positive[round(q * (count - 1))]) for q in shares} if count > 0 else {}
    return {"gaussians": n, "zero_evidence_share": 1 - count / max(1, n), "reliability_quantiles": quantiles}


# Lifting into a new run, in one or several processes.


def lift_run_distributed(
    team: Communicator,
    opened: Callable[[], Scene],
    *,
    source: SourceOptions | None,
    features: Sequence[tuple[Any, Any]] | Mapping[str, tuple[Any, Any]] | None,
    texts: Mapping[str, Float[Tensor, " d"]] | None,
    lift: LiftOptions | None,
    queries: Sequence[str],
    output_dir: str | Path | None,
    timestamp: str | None,
    overwrite: bool,
    check: bool,
    device: str,
    export: FeatureExport | None,
    report: ProgressCallback,
    say: Callable[[str], None],
) -> LiftedRun | None:
    """Run `lift_run` in several processes, all with the same arguments. Only rank 0 writes and returns the run.

    Args:
        opened: opens the trained scene. It is called after all checks that do not need the scene.
    """
    if features is None and texts is not None:
        raise InputError("texts are for your own features; pass features, too, or omit texts")
    if features is not None and source is not None:
        raise InputError("features replace source; pass only one of the two")
    check_prompt_list("queries", queries)
    check_bool("overwrite", overwrite)
    check_bool("check", check)
    target = None if output_dir is None else check_path("output_dir", output_dir)
    if timestamp is not None:
        run_directory(Path(), "run", timestamp)  # raise for a bad name before the scene loads
    for name, value, kind in (
        ("source", source, SourceOptions),
        ("lift", lift, LiftOptions),
        ("export", export, FeatureExport),
    ):
        if value is not None and not isinstance(value, kind):
            raise InputError(f"{name} must be {kind.__name__}, got {type(value).__name__}")
    device, options = choose_device(device), (source or SourceOptions()).looking_for(queries)
    init_cuda(device)
    feature_source = None if features is not None else make_source(options, device)  # raises before the scene loads
    if feature_source is not None and len(queries) > 0:
        feature_source.text(queries)
    scene = opened()
    if not isinstance(scene, NerfstudioScene | SplatScene):
        raise TypeError(
            "lift_run takes the config.yml of a run, or a scene from open_scene or open_splat; got "
            f"{type(scene).__name__}"
        )
    run_dir = run_directory(target or scene.runs_dir, scene.name, timestamp)
    run_dir = run_dir.with_name(team.tell(run_dir.name))  # clocks differ
    if team.rank == 0:
        complete_interrupted_lifts(run_dir)
    if timestamp is not None and team.rank == 0:
        refuse_existing_run(run_dir, overwrite)
    lift, stages = lift or LiftOptions(), StageTimer(report)
    used = "" if lift.max_views is None else f"{min(lift.max_views, len(scene.train))} of "
    say(f"{len(scene.gaussians):,} Gaussians, {used}{len(scene.train)} training views, on {device}")
    for remark in scene.remarks:
        say(f"Warning: {remark}")
    if export is not None:
        _refuse_equal_stems(scene.train.names)
    settings = encoder_settings(options)
    if feature_source is None:
        feature_source = precomputed_features(features, texts, scene.train.names)
        texts = feature_source.texts
        settings = precomputed_settings(TEXT_EMBEDDINGS_FILE if texts else None)
        if len(queries) > 0:
            feature_source.text(queries)
    if check and team.rank == 0:
        with stages("check") as step:
            match = measure_alignment(
                scene, RasterSettings.of_gsplat(resolve_gsplat_version(scene, lift)), device=device
            )
            warning = alignment_warning(match, own_cameras=not isinstance(scene, SplatScene))
            step()
        if warning is not None:
            say(f"Warning: {warning}")
    cache = cache_folder(run_dir)
    with team.shares(cache):
        result = lift_scene_distributed(
            team, scene, feature_source, lift, cache, device=device, encoder=settings, export=export, report=report
        )
    if result is None:
        return None
    field, seconds = result
    if features is None:
        field = replace(field, manifest={**field.manifest, "source": source_settings(options, device)})
    seconds = {**stages.seconds, **seconds}
    with stages("write") as step:
        question = _question(field, scene.gaussians.means, feature_source, queries)
        run_dir = write_run(
            scene, field, run_dir, question=question, texts=texts, overwrite=overwrite, exact=timestamp is not None
        )
        field = field.to("cpu")
        step()
    seconds["write"] = stages.seconds["write"]
    return LiftedRun(run_dir, scene, resolve_field_paths(field, run_dir / FIELD_FOLDER), device, seconds)


def _refuse_equal_stems(names: Sequence[str]) -> None:
    """Raise if two images have the same stem, because LangSplat's format names files by it."""
    stems = [Path(name).stem for name in names]
    for i, stem in enumerate(stems):
        if stem in stems[:i]:
            raise InputError(
                f"{names[stems.index(stem)]} and {names[i]} would share the files {stem}_*.npy of LangSplat's format. "
                "Rename one of the images, or lift without --export-langsplat."
            )


def _question(
    field: SemanticField, means: Float[Tensor, "n 3"], source: FeatureSource, queries: Sequence[str]
) -> Query | None:
    if len(queries) == 0:
        return None
    length = source.text(queries).shape[1]
    if length != field.dimension:
        raise InputError(
            f"the vectors of --queries have {length} numbers, but the features have {field.dimension}; name the model "
            "of the features with --encoder-model and --encoder-pretrained, or give --text-vectors"
        )
    negatives = None
    if isinstance(source, PrecomputedFeatures):  # the file with its prompts is not written yet
        negatives = CANONICAL_NEGATIVES if set(CANONICAL_NEGATIVES) <= set(source.texts) else ()
    return run_query(field, means, make_query(field, source.text, queries, negatives=negatives)).question
