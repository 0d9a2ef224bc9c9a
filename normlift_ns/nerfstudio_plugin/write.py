"""Writing the directory of a lifted run: what stock nerfstudio loads, and the semantic field beside it."""

from __future__ import annotations

import json
from collections.abc import Mapping
from copy import deepcopy
from pathlib import Path
from typing import Any

import torch
import yaml
from nerfstudio.engine.trainer import TrainerConfig
from safetensors import SafetensorError
from torch import Tensor

from normlift_ns.asking import Question
from normlift_ns.core.field import SemanticField, fingerprint
from normlift_ns.encoders.text_vectors import write_text_vectors
from normlift_ns.nerfstudio_plugin.config import set_data, skip_seed_points
from normlift_ns.nerfstudio_plugin.load import NerfstudioScene
from normlift_ns.nerfstudio_plugin.model import NormLiftModelConfig
from normlift_ns.nerfstudio_plugin.splat_config import splat_config
from normlift_ns.runs.files import FIELD_FOLDER, TEXTS_FILE, complete_directory, refuse_existing
from normlift_ns.runs.question import save_question
from normlift_ns.scenes.checkpoint import Checkpoint
from normlift_ns.scenes.opening import SplatScene
from normlift_ns.scenes.saved import CHECKPOINT_FOLDER, checkpoint_of, save_splat


def write_run(
    source: NerfstudioScene | SplatScene,
    field: SemanticField,
    run_dir: Path,
    *,
    question: Question | None = None,
    texts: Mapping[str, Tensor] | None = None,
    overwrite: bool = False,
) -> None:
    """Writes a lifted run, complete or not at all.

    It holds config.yml (method normlift), nerfstudio_models/step-*.ckpt (step and tensors of the model, without
    optimizers), dataparser_transforms.json and the field in normlift/. Relative paths of the source's config stay
    relative, so stock ns-* commands run from where the source run was trained, ours from anywhere. A run of a splat
    holds its cameras too, as transforms.json, and what else opens it again, as splat.json.

    Args:
        run_dir: as `run_directory` names it, output_dir/experiment/normlift/timestamp.
        question: what to draw as relevancy_0, relevancy_1, …
        texts: vectors of the user's own, by text.
        overwrite: replace a directory of that name.
    Raises:
        FileExistsError: the directory exists and `overwrite` is False.
        ValueError: a field of other Gaussians.
        OSError: it cannot be written, for instance because the disk is full; nothing is left then.
    """
    refuse_existing(run_dir, overwrite)
    if field.manifest["means_fingerprint"] != fingerprint(source.gaussians.means):
        raise ValueError(
            f"The semantic field has {len(field)} Gaussians and was not lifted from the {len(source.gaussians)} of "
            f"{source.checkpoint_path}; lift that again."
        )
    splat = isinstance(source, SplatScene)
    config = splat_config(source, run_dir) if splat else _lifted_config(source, run_dir)
    with complete_directory(run_dir) as folder:
        try:
            _write_tensors(folder, source, field, question, texts)
        except (RuntimeError, SafetensorError) as error:  # what torch and safetensors make of a full disk
            raise OSError(f"{run_dir} cannot be written: {error}") from error
        if splat:
            save_splat(folder, source)
            transform = {"transform": torch.eye(4)[:3].tolist(), "scale": 1.0}
        else:
            transform = {"transform": source.dataparser_transform.tolist(), "scale": source.dataparser_scale}
        (folder / "dataparser_transforms.json").write_text(json.dumps(transform, indent=4), "utf8")
        (folder / "config.yml").write_text(yaml.dump(config), "utf8")


def _lifted_config(source: NerfstudioScene, run_dir: Path) -> TrainerConfig:
    config, location = deepcopy(source.config), source.location
    config.method_name = "normlift"
    config.output_dir = location.portable(run_dir.parents[2])
    config.timestamp = run_dir.name
    config.relative_model_dir = Path(CHECKPOINT_FOLDER)
    config.load_dir = config.load_step = config.load_config = config.load_checkpoint = None
    config.pipeline.model = NormLiftModelConfig.upgrade(
        source.model_config, semantics=location.portable(run_dir / FIELD_FOLDER)
    )
    if location.moved_data or config.output_dir.is_absolute():
        set_data(config, location.data)  # a relative one would not be found
    skip_seed_points(config)
    datamanager: Any = config.pipeline.datamanager
    datamanager.cache_images = "gpu"  # that is, on the pipeline's device; "cpu" pins memory, which needs CUDA
    return config


def _write_tensors(
    folder: Path,
    source: NerfstudioScene | SplatScene,
    field: SemanticField,
    question: Question | None,
    texts: Mapping[str, Tensor] | None,
) -> None:
    field.save(folder / FIELD_FOLDER)
    if question is not None:
        save_question(folder / FIELD_FOLDER, question)
    if texts:
        write_text_vectors(folder / FIELD_FOLDER / TEXTS_FILE, texts)
    checkpoint = checkpoint_of(source) if isinstance(source, SplatScene) else _slim(source.checkpoint)
    (folder / CHECKPOINT_FOLDER).mkdir()
    torch.save(checkpoint, folder / CHECKPOINT_FOLDER / f"step-{checkpoint['step']:09d}.ckpt")


def _slim(checkpoint: Checkpoint) -> dict[str, Any]:
    pipeline = {f"_model.{name}": tensor for name, tensor in checkpoint.model.items()}
    return {"step": checkpoint.step, "pipeline": pipeline}
