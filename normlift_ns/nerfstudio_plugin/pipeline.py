"""Pipeline of `ns-train normlift`, which trains splatfacto and then lifts features onto the trained Gaussians."""

from __future__ import annotations

import os
import shlex
import shutil
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import torch
import yaml
from nerfstudio.engine.callbacks import TrainingCallback, TrainingCallbackAttributes, TrainingCallbackLocation
from nerfstudio.pipelines.base_pipeline import VanillaPipeline, VanillaPipelineConfig
from nerfstudio.utils.rich_utils import CONSOLE

from normlift_ns.data.checkpoint import numpy_scalar_globals
from normlift_ns.data.nerfstudio.config import check_components, check_lift_options, dataset_in_config
from normlift_ns.data.nerfstudio.dataset_views import DatasetViews
from normlift_ns.data.nerfstudio.load import load_nerfstudio_scene
from normlift_ns.data.transforms import relative_name
from normlift_ns.encoders.base import FeatureSource
from normlift_ns.encoders.build import make_source, source_settings
from normlift_ns.errors import describe_error
from normlift_ns.io.atomic import write_text_file
from normlift_ns.io.run_dir import FIELD_FOLDER, add_digest_comment, cache_folder, run_file_digests
from normlift_ns.nerfstudio_plugin.model import NormLiftModel
from normlift_ns.nerfstudio_plugin.panel import rerender_clients
from normlift_ns.options import LiftOptions, SourceOptions
from normlift_ns.pipeline import lift_scene, query_to_store
from normlift_ns.query.question import save_query
from normlift_ns.query.text_encoder import encoder_settings
from normlift_ns.segmentation.registry import describe_choice

if TYPE_CHECKING:
    from nerfstudio.engine.trainer import Trainer, TrainerConfig


@dataclass
class NormLiftPipelineConfig(VanillaPipelineConfig):
    """Config of splatfacto's pipeline with a lift at the end of training."""

    _target: type = field(default_factory=lambda: NormLiftPipeline)
    source: SourceOptions = field(default_factory=SourceOptions)
    """Options of the 2D features."""
    lift: LiftOptions = field(default_factory=LiftOptions)
    """Options of the lift."""
    queries: tuple[str, ...] = ()
    """Prompts to store in the run. ns-render and ns-viewer show their relevancy."""


class NormLiftPipeline(VanillaPipeline):
    """Pipeline for splatfacto that lifts features onto the last checkpoint of a run when training ends."""

    config: NormLiftPipelineConfig  # pyrefly: ignore[bad-override-mutable-attribute]

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        if hasattr(torch.serialization, "add_safe_globals"):  # nerfstudio needs it with torch 2.4 and later
            torch.serialization.add_safe_globals(numpy_scalar_globals())

    def get_training_callbacks(
        self, training_callback_attributes: TrainingCallbackAttributes
    ) -> list[TrainingCallback]:
        """Return splatfacto's callbacks and the lift, after checking the requirements of the lift.

        Raises:
            ValueError, FileNotFoundError, PermissionError: The encoder or a query cannot be used. Also the errors of
                `check_before_training`.
        """
        callbacks = super().get_training_callbacks(training_callback_attributes)
        trainer, model = training_callback_attributes.trainer, cast(NormLiftModel, self.model)
        model.detach()  # remove the field if the training of a lifted checkpoint is resumed
        if trainer is not None and trainer.local_rank == 0:
            check_before_training(trainer)
            source = feature_source_of(trainer.config)
            folder = dataset_folder(trainer.config)
            files = self.datamanager.train_dataset.image_filenames  # type: ignore[union-attr]
            source.available([relative_name(file, folder) for file in files])
            if len(self.config.queries) > 0:
                source.text(self.config.queries)
            after = [TrainingCallbackLocation.AFTER_TRAIN]
            callbacks.append(TrainingCallback(after, _lift_at_the_end, args=[trainer]))
        return callbacks


def check_before_training(trainer: Trainer) -> None:
    """Raise before training if the lift at its end would fail, and print warnings about the images.

    Raises:
        ValueError, FileNotFoundError: The lift does not support the scene, an option is out of range, or nerfstudio
            misreads the pixel values of an image.
        PermissionError: The folder of the run or of the lift's caches is not writable.
    """
    config: Any = trainer.config
    path = trainer.base_dir / "config.yml"
    check_components(config, path)
    check_lift_options(config.pipeline.lift, "--pipeline.lift")
    datamanager: Any = trainer.pipeline.datamanager
    dataset = datamanager.train_dataset
    poses = dataset.cameras.camera_to_worlds
    for warning in DatasetViews(dataset, dataset_folder(config), poses, torch.zeros(3)).check_files():
        CONSOLE.print(f"Warning: {warning}", markup=False, soft_wrap=True)
    cache = cache_folder(trainer.base_dir)
    for folder in (cache if cache.exists() else cache.parent, trainer.base_dir):
        if folder.exists() and not os.access(folder, os.W_OK | os.X_OK):
            raise PermissionError(
                f"{folder} cannot be written, so the lift at the end of training would fail. Make the folder writable, "
                "or choose another one with --output-dir."
            )


def dataset_folder(config: TrainerConfig) -> Path:
    """Return the folder of the dataset of a config."""
    data = dataset_in_config(config)
    return data.parent if data.suffix == ".json" else data


def feature_source_of(config: TrainerConfig, device: str = "cpu") -> FeatureSource:
    """Make the feature source of a config. LangSplat's features are read from the dataset unless a folder is given.

    Raises:
        ValueError, FileNotFoundError: `make_source` fails. For missing features of LangSplat, the message names the
            options of ns-train.
    """
    options = _source_options(config)
    try:
        return make_source(options, device)
    except FileNotFoundError as error:
        if options.features != "langsplat":
            raise
        raise FileNotFoundError(
            f"{error}. In ns-train, put pipeline.source before the option, as in --pipeline.source.features-dir. "
            "To encode the images instead, use --pipeline.source.features none"
        ) from error


def _source_options(config: TrainerConfig) -> SourceOptions:
    options: SourceOptions = config.pipeline.source  # type: ignore[attr-defined]
    options = options.looking_for(config.pipeline.queries)  # type: ignore[attr-defined]
    if options.features == "langsplat" and options.features_dir is None:
        return replace(options, features_dir=dataset_folder(config))
    return options


def _lift_at_the_end(trainer: Trainer, step: int) -> None:
    """Lift the trained scene. Errors are printed instead of raised, because training is complete and saved."""
    config = trainer.base_dir / "config.yml"
    try:
        lift_last_checkpoint(trainer)
    except Exception as error:  # a completed training must not fail
        if trainer.config.pipeline.model.semantics is None:  # type: ignore[attr-defined]
            shutil.rmtree(trainer.base_dir / FIELD_FOLDER, ignore_errors=True)
        CONSOLE.print("Error", style="bold red")
        CONSOLE.print(
            f"Training is complete and saved, but the lift at step {step} failed: {describe_error(error)[0]}\n"
            "To repeat the lift, run this command, with any lift options that you gave: "
            f"ns-normlift --load-config {shlex.quote(str(config))}",
            markup=False,
            highlight=False,
            soft_wrap=True,
        )


def lift_last_checkpoint(trainer: Trainer) -> Path:
    """Lift the last checkpoint of a trainer, write the field and its config into the run, and update the viewer.

    Returns:
        Folder of the field.
    """
    pipeline: Any = trainer.pipeline
    options, path = pipeline.config, trainer.base_dir / "config.yml"
    CONSOLE.print("Lifting the trained scene")
    choice = describe_choice(_source_options(trainer.config), str(pipeline.device))
    if choice is not None:
        CONSOLE.print(choice, markup=False, soft_wrap=True)
    scene = load_nerfstudio_scene(path)
    source = feature_source_of(trainer.config, str(pipeline.device))
    encoder = encoder_settings(options.source)
    device = "cuda" if pipeline.device.type == "cuda" else "cpu"
    result = lift_scene(scene, source, options.lift, cache_folder(path.parent), device=device, encoder=encoder)
    settings = source_settings(_source_options(trainer.config), str(pipeline.device))
    field = replace(result.field, manifest={**result.field.manifest, "source": settings})
    folder = trainer.base_dir / FIELD_FOLDER
    files = [scene.checkpoint_path, scene.location.run_dir / "dataparser_transforms.json"]
    field.save(folder, overwrite=True, beside=run_file_digests(folder, files), own=True)
    question = query_to_store(field, scene.gaussians.means, source, options.queries)
    if question is not None:
        save_query(folder, question)
    model: Any = trainer.config.pipeline.model
    model.semantics = Path(FIELD_FOLDER)
    write_text_file(path, add_digest_comment(yaml.dump(trainer.config)), overwrite=True, own=True)
    model.semantics = folder
    with trainer.train_lock:
        pipeline.model.attach(field, question)
    viewer: Any = trainer.viewer_state
    if hasattr(viewer, "render_statemachines"):
        rerender_clients(viewer)
    command = f"ns-normlift-query --load-config {shlex.quote(str(path))} --text ..."
    CONSOLE.print(f"Wrote the semantic field to {folder}. To query it, run {command}", markup=False, soft_wrap=True)
    return folder
