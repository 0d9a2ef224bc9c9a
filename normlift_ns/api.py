"""Lifting of a trained scene into a new run: `lift_run`, its request, its checks, and the directory that it writes."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from copy import deepcopy
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from normlift_ns.core.arguments import check_arguments
from normlift_ns.core.device import choose_device, init_cuda
from normlift_ns.core.field import SemanticField, fingerprint
from normlift_ns.core.scene import Scene
from normlift_ns.data.alignment import alignment_warning, measure_alignment
from normlift_ns.data.nerfstudio import config_classes
from normlift_ns.data.nerfstudio.config import dump_config, set_dataset, skip_seed_points
from normlift_ns.data.nerfstudio.load import NerfstudioScene
from normlift_ns.data.open_scene import (
    CHECKPOINT_DIR,
    EXTRA_IMAGES_FILE,
    TRANSFORMS_FILE,
    SplatScene,
    open_scene,
    resolve_field_paths,
    save_splat,
    splatfacto_checkpoint,
)
from normlift_ns.data.transforms import write_transforms
from normlift_ns.encoders.base import FeatureSource, PrecomputedFeatures, precomputed_features
from normlift_ns.encoders.build import make_source, source_settings
from normlift_ns.encoders.langsplat import FeatureExport, check_unique_stems
from normlift_ns.encoders.text_files import write_text_embeddings
from normlift_ns.errors import InputError
from normlift_ns.io.atomic import atomic_file, commit_directory, draft_directory, numbered_paths, write_text_file
from normlift_ns.io.memory import refuse_small_memory
from normlift_ns.io.run_dir import (
    FIELD_FOLDER,
    TEXT_EMBEDDINGS_FILE,
    add_digest_comment,
    cache_folder,
    complete_interrupted_lifts,
    refuse_existing_run,
    run_directory,
    run_file_digests,
    written_files,
)
from normlift_ns.lifted_run import LiftedRun
from normlift_ns.options import (
    CANONICAL_NEGATIVES,
    LiftOptions,
    SourceOptions,
    check_bool,
    check_path,
    check_prompt_list,
    renamed,
)
from normlift_ns.pipeline import (
    LiftResult,
    lift_collection,
    plan_collection,
    resolve_gsplat_version,
    start_kernel_warm_up,
)
from normlift_ns.progress import ProgressCallback, StageTimer
from normlift_ns.query.engine import run_query
from normlift_ns.query.question import Query, make_query, save_query
from normlift_ns.query.text_encoder import encoder_settings, precomputed_settings
from normlift_ns.rasterization.settings import RasterSettings
from normlift_ns.segmentation.registry import describe_choice, resolve_source


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
        check_alignment: Compare a few training images with renders of the scene before the lift. Warn if they differ,
            and raise if they do not show the same scene.
        device: Device to lift on: auto, cpu or cuda.
        export: Folder for a copy of the 2D features, as LangSplat files. If None, write no copy.
        report: Progress callback, called with (stage, steps done, total steps).
        say: Callback for status lines and warnings, such as `print`.
    Raises:
        FileExistsError: The run directory exists and `overwrite` is False.
        FileNotFoundError, ValueError: As in `open_scene`; also if an image, a label map or an option is not valid.
        MemoryError: The lift does not fit into GPU memory.
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
    collection = plan_collection(scene, prepared.source, prepared.lift, cache, device=device, export=request.export)
    kernels = start_kernel_warm_up(scene, collection.gaussians, collection.options, collection.config)
    check_alignment(prepared, stages, kernels.wait_for_rendering)  # while the other kernels are compiled
    result = lift_collection(collection, kernels, device=device, encoder=prepared.encoder, report=request.report)
    return write_lifted_run(prepared, result, stages)


def prepare_lift(request: LiftRequest) -> PreparedLift:
    """Load encoders, open the scene and choose the run directory, without writing to this directory."""
    device, options = choose_device(request.device), (request.source or SourceOptions()).looking_for(request.queries)
    init_cuda(device)
    source = None
    if request.features is None:
        options = resolve_source(options, device)
        source = make_source(options, device)  # raises before the scene loads
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


def check_target(prepared: PreparedLift) -> None:
    """Complete file writes that earlier lifts left unfinished; raise if the run exists and must not be replaced."""
    complete_interrupted_lifts(prepared.run_dir)
    if prepared.request.timestamp is not None:
        refuse_existing_run(prepared.run_dir, prepared.request.overwrite, prepared.scene.checkpoint_path)


def announce(prepared: PreparedLift) -> None:
    """Report the size of the lift, the automatic choice of 2D features, and the warnings about the scene."""
    request, scene, most, say = prepared.request, prepared.scene, prepared.lift.max_views, prepared.request.say
    used = "" if most is None else f"{min(most, len(scene.train))} of "
    say(f"{len(scene.gaussians):,} Gaussians, {used}{len(scene.train)} training views, on {prepared.device}")
    if request.features is None:
        choice = describe_choice(request.source or SourceOptions(), prepared.device)
        if choice is not None:
            say(choice)
    for remark in scene.remarks:
        say(f"Warning: {remark}")


def compare_with_images(scene: Scene, options: LiftOptions, device: str) -> str | None:
    """Compare renders with training images; return a warning if they differ, or raise if they show different scenes."""
    settings = RasterSettings.recorded({**scene.identity, "gsplat_rules": resolve_gsplat_version(scene, options)})
    measured_with = RasterSettings.recorded(scene.identity)
    match = scene.alignment if isinstance(scene, SplatScene) and settings == measured_with else None
    match = match or measure_alignment(scene, settings, device=device)
    return alignment_warning(match, trained_cameras=not isinstance(scene, SplatScene))


def check_alignment(prepared: PreparedLift, stages: StageTimer, wait_for_rendering: Callable[[], None]) -> None:
    """Report the warning of `compare_with_images`, unless the request disables the comparison.

    Args:
        wait_for_rendering: Function that waits until the kernels for renders are compiled.
    """
    if not prepared.request.check_alignment:
        return
    with stages("check") as step:
        wait_for_rendering()
        warning = compare_with_images(prepared.scene, prepared.lift, prepared.device)
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
            f"the vectors of --queries have {length} numbers, but the features have {field.dimension}; give the model "
            "of the features with --encoder-model and --encoder-pretrained, or give --text-embeddings"
        )
    negatives = None
    if isinstance(source, PrecomputedFeatures):  # the file with these prompts does not exist yet
        negatives = CANONICAL_NEGATIVES if set(CANONICAL_NEGATIVES) <= set(source.texts) else ()
    return run_query(field, means, make_query(field, source.text, queries, negatives=negatives)).question


def write_run(
    source: NerfstudioScene | SplatScene,
    field: SemanticField,
    run_dir: Path,
    *,
    question: Query | None = None,
    text_embeddings: Mapping[str, Tensor] | None = None,
    overwrite: bool = False,
    exact_name: bool = True,
) -> Path:
    """Write a lifted run, completely or not at all, and return its directory.

    The directory contains config.yml (method normlift), nerfstudio_models/step-*.ckpt (step and tensors of the model,
    without optimizers), dataparser_transforms.json, and the field in normlift/. A run lifted from a PLY file or gsplat
    checkpoint also has its cameras in transforms.json, and the other settings that reopen it in splat.json.

    Relative paths in the config of the source run stay relative. nerfstudio's own commands must therefore run in the
    directory in which the source run was trained. The ns-normlift commands run in any directory.

    Args:
        run_dir: Directory from `run_directory`, output_dir/experiment/normlift/timestamp.
        question: Query to store, which nerfstudio renders as relevancy_0, relevancy_1, …
        text_embeddings: The user's own text embeddings, by prompt.
        overwrite: Replace an existing directory.
        exact_name: If False and `run_dir` exists, write to <name>_2, <name>_3, … instead.
    Raises:
        FileExistsError: The directory exists, `exact_name` is True and `overwrite` is False.
        ValueError: The field was lifted from other Gaussians.
        OSError: A file cannot be written, for instance because the disk is full. No files remain in that case.
    """
    complete_interrupted_lifts(run_dir)
    if exact_name:
        refuse_existing_run(run_dir, overwrite, source.checkpoint_path)
    if field.manifest["means_fingerprint"] != fingerprint(source.gaussians.means):
        raise InputError(
            f"The semantic field of {len(field)} Gaussians was not lifted from the {len(source.gaussians)} Gaussians "
            f"of {source.checkpoint_path}; lift that checkpoint again."
        )
    with draft_directory(run_dir) as folder:
        if isinstance(source, SplatScene):
            save_splat(folder, source)
            transform, scale, checkpoint = torch.eye(4)[:3], 1.0, splatfacto_checkpoint(source)
            config_in: Callable[[Path], config_classes.TrainerConfig] = partial(splat_config, source)
        else:
            if len(source.extra_frames) > 0:
                write_transforms(folder / EXTRA_IMAGES_FILE, source.extra_frames, ())
            transform, scale = source.dataparser_transform, source.dataparser_scale
            model = {f"_model.{name}": tensor for name, tensor in source.checkpoint.model.items()}
            checkpoint = {"step": source.checkpoint.step, "pipeline": model}
            config_in = partial(_lifted_config, source)
        facts = {"transform": transform.tolist(), "scale": scale}
        write_text_file(folder / "dataparser_transforms.json", json.dumps(facts, indent=4))
        stored = folder / CHECKPOINT_DIR / f"step-{checkpoint['step']:09d}.ckpt"
        with atomic_file(stored) as draft:
            torch.save(checkpoint, draft)
        field_dir = folder / FIELD_FOLDER
        if text_embeddings:
            write_text_embeddings(field_dir / TEXT_EMBEDDINGS_FILE, text_embeddings)
        files = [stored, field_dir / TEXT_EMBEDDINGS_FILE, *folder.glob("*.json")]
        field.save(field_dir, beside=run_file_digests(field_dir, files), own=True)
        if question is not None:
            save_query(field_dir, question)
        for path in (run_dir,) if exact_name else numbered_paths(run_dir):
            write_text_file(
                folder / "config.yml", add_digest_comment(dump_config(config_in(path))), overwrite=True, own=True
            )
            if commit_directory(folder, path, replaced=written_files if overwrite and exact_name else None):
                return path
    refuse_existing_run(run_dir, overwrite=False)  # another process created it meanwhile
    raise FileExistsError(f"another process created and removed {run_dir} during the lift; run the lift again")


def _lifted_config(source: NerfstudioScene, run_dir: Path) -> config_classes.TrainerConfig:
    config, location = deepcopy(source.config), source.location
    config.method_name = "normlift"
    config.output_dir = location.relative_to_root(run_dir.parents[2])
    config.timestamp = run_dir.name
    config.relative_model_dir = Path(CHECKPOINT_DIR)
    config.load_dir = config.load_step = config.load_config = config.load_checkpoint = None
    config.pipeline.model = config_classes.NormLiftModelConfig(
        **{**vars(source.model_config), "semantics": Path(FIELD_FOLDER)}
    )
    if location.data_moved or config.output_dir.is_absolute():
        set_dataset(config, location.data)  # relative paths would not resolve to the dataset
    skip_seed_points(config)
    # "gpu" means the pipeline's device; "cpu" would pin memory, which needs CUDA
    config.pipeline.datamanager.cache_images = "gpu"
    return config


def splat_config(scene: SplatScene, run_dir: Path) -> config_classes.TrainerConfig:
    """Return a nerfstudio config for a run lifted from a PLY file or gsplat checkpoint, which has no config of its own.

    With this config, nerfstudio loads the cameras in the run directory without transforming them. All paths except that
    of the field are absolute, because the run has no training directory as a base for relative paths.
    """
    cameras = run_dir / TRANSFORMS_FILE
    dataparser = config_classes.NerfstudioDataParserConfig(
        data=cameras,
        downscale_factor=1,
        orientation_method="none",
        center_method="none",
        auto_scale_poses=False,
        eval_mode="all",
        load_3D_points=False,
    )
    model = config_classes.NormLiftModelConfig(
        sh_degree=max(1, scene.splat.degree),
        background_color=scene.background_name,
        rasterize_mode=scene.rasterize_mode,
        semantics=Path(FIELD_FOLDER),
    )
    datamanager = config_classes.FullImageDatamanagerConfig(
        data=cameras,
        dataparser=dataparser,
        cache_images="gpu",  # means the pipeline's device; "cpu" would pin memory, which needs CUDA
        cache_images_type="uint8",
    )
    return config_classes.TrainerConfig(
        method_name="normlift",
        experiment_name=scene.name,
        output_dir=run_dir.parents[2],
        timestamp=run_dir.name,
        relative_model_dir=Path(CHECKPOINT_DIR),
        data=cameras,
        pipeline=config_classes.VanillaPipelineConfig(datamanager=datamanager, model=model),
        vis="viewer",
    )
