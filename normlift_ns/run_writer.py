"""Directory of a lifted run: the files that stock nerfstudio loads, and the semantic field."""

from __future__ import annotations

import json
from collections.abc import Mapping
from copy import deepcopy
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from normlift_ns.core.field import SemanticField, fingerprint
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
from normlift_ns.encoders.text_files import write_text_embeddings
from normlift_ns.errors import InputError
from normlift_ns.io.atomic import atomic_file, commit_directory, draft_directory, numbered_paths, write_text_file
from normlift_ns.io.run_dir import (
    FIELD_FOLDER,
    TEXT_EMBEDDINGS_FILE,
    add_digest_comment,
    complete_interrupted_lifts,
    refuse_existing_run,
    run_file_digests,
)
from normlift_ns.query.question import Query, save_query


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

    The directory holds config.yml (method normlift), nerfstudio_models/step-*.ckpt (step and tensors of the model,
    without optimizers), dataparser_transforms.json, and the field in normlift/. A run lifted from a PLY file or gsplat
    checkpoint also has its cameras in transforms.json, and other settings for reopening it in splat.json.

    Relative paths in the config of the source run stay relative. Stock ns-* commands therefore run from the directory
    that the source run was trained in; ns-normlift commands run from any directory.

    Args:
        run_dir: directory from `run_directory`, output_dir/experiment/normlift/timestamp.
        question: query to render as relevancy_0, relevancy_1, …
        text_embeddings: embeddings provided by the user, by prompt.
        overwrite: replace an existing directory.
        exact_name: if False and `run_dir` exists, write to <name>_2, <name>_3, … instead.
    Raises:
        FileExistsError: the directory exists, `exact_name` is True and `overwrite` is False.
        ValueError: the field was lifted from other Gaussians.
        OSError: writing failed, for instance because the disk is full; no files are left then.
    """
    complete_interrupted_lifts(run_dir)
    if exact_name:
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
            if len(source.extra_frames) > 0:
                write_transforms(folder / EXTRA_IMAGES_FILE, source.extra_frames, ())
            transform = {"transform": source.dataparser_transform.tolist(), "scale": source.dataparser_scale}
        write_text_file(folder / "dataparser_transforms.json", json.dumps(transform, indent=4))
        _write_tensors(folder, source, field, question, text_embeddings)
        for path in (run_dir,) if exact_name else numbered_paths(run_dir):
            is_splat = isinstance(source, SplatScene)
            config = splat_config(source, path) if is_splat else _lifted_config(source, path)
            write_text_file(folder / "config.yml", add_digest_comment(dump_config(config)), overwrite=True)
            if commit_directory(folder, path, overwrite=overwrite and exact_name):
                return path
    refuse_existing_run(run_dir, overwrite=False)  # another process created it meanwhile
    raise FileExistsError(f"another process created and removed {run_dir} during the lift; lift again")


def _lifted_config(source: NerfstudioScene, run_dir: Path) -> TrainerConfig:
    config, location = deepcopy(source.config), source.location
    config.method_name = "normlift"
    config.output_dir = location.relative_to_root(run_dir.parents[2])
    config.timestamp = run_dir.name
    config.relative_model_dir = Path(CHECKPOINT_DIR)
    config.load_dir = config.load_step = config.load_config = config.load_checkpoint = None
    config.pipeline.model = NormLiftModelConfig(**{**vars(source.model_config), "semantics": Path(FIELD_FOLDER)})
    if location.data_moved or config.output_dir.is_absolute():
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


def splat_config(scene: SplatScene, run_dir: Path) -> TrainerConfig:
    """Return the config of a run lifted from a PLY file or gsplat checkpoint, for which nerfstudio has written none.

    Stock nerfstudio loads the cameras in the run directory with it, without transforming them.

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
