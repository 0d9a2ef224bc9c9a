"""Writing the directory of a lifted run: what stock nerfstudio loads, and the semantic field beside it."""

from __future__ import annotations

import json
from collections.abc import Mapping
from copy import deepcopy
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from normlift_ns.core.field import SemanticField, fingerprint
from normlift_ns.core.files import draft_directory, new_file, numbered, publish, write_text
from normlift_ns.encoders.texts.files import write_text_vectors
from normlift_ns.errors import InputError
from normlift_ns.question import Question
from normlift_ns.runs.files import FIELD_FOLDER, TEXTS_FILE, digests_beside, refuse_existing_run, sealed, tidy
from normlift_ns.runs.question import save_question
from normlift_ns.runs.splat_config import splat_config
from normlift_ns.scenes.added import ADDED_FILE
from normlift_ns.scenes.checkpoint import Checkpoint
from normlift_ns.scenes.nerfstudio.allowed import dump_config
from normlift_ns.scenes.nerfstudio.classes import NormLiftModelConfig, TrainerConfig
from normlift_ns.scenes.nerfstudio.config import set_data, skip_seed_points
from normlift_ns.scenes.nerfstudio.load import NerfstudioScene
from normlift_ns.scenes.opening import SplatScene
from normlift_ns.scenes.saved import CHECKPOINT_FOLDER, checkpoint_of, save_splat
from normlift_ns.scenes.transforms import write_transforms


def write_run(
    source: NerfstudioScene | SplatScene,
    field: SemanticField,
    run_dir: Path,
    *,
    question: Question | None = None,
    texts: Mapping[str, Tensor] | None = None,
    overwrite: bool = False,
    exact: bool = True,
) -> Path:
    """Writes a lifted run, complete or not at all; returns its directory.

    It holds config.yml (method normlift), nerfstudio_models/step-*.ckpt (step and tensors of the model, without
    optimizers), dataparser_transforms.json and the field in normlift/. Relative paths of the source's config stay
    relative, so stock ns-* commands run from where the source run was trained, ours from anywhere. A run of a splat
    holds its cameras too, as transforms.json, and what else opens it again, as splat.json.

    Args:
        run_dir: as `run_directory` names it, output_dir/experiment/normlift/timestamp.
        question: what to draw as relevancy_0, relevancy_1, …
        texts: vectors of the user's own, by text.
        overwrite: replace a directory of that name.
        exact: False: where something has that name, the run is called <name>_2, <name>_3, …
    Raises:
        FileExistsError: the directory exists, `exact` is True and `overwrite` False.
        ValueError: a field of other Gaussians.
        OSError: it cannot be written, for instance because the disk is full; nothing is left then.
    """
    tidy(run_dir)
    if exact:
        refuse_existing_run(run_dir, overwrite)
    if field.manifest["means_fingerprint"] != fingerprint(source.gaussians.means):
        raise InputError(
            f"The semantic field has {len(field)} Gaussians and was not lifted from the {len(source.gaussians)} of "
            f"{source.checkpoint_path}; lift that again."
        )
    with draft_directory(run_dir) as folder:
        if isinstance(source, SplatScene):
            save_splat(folder, source)
            transform = {"transform": torch.eye(4)[:3].tolist(), "scale": 1.0}
        else:
            if len(source.added) > 0:
                write_transforms(folder / ADDED_FILE, source.added, ())
            transform = {"transform": source.dataparser_transform.tolist(), "scale": source.dataparser_scale}
        write_text(folder / "dataparser_transforms.json", json.dumps(transform, indent=4))
        _write_tensors(folder, source, field, question, texts)
        for place in (run_dir,) if exact else numbered(run_dir):
            of_splat = isinstance(source, SplatScene)
            config = splat_config(source, place) if of_splat else _lifted_config(source, place)
            write_text(folder / "config.yml", sealed(dump_config(config)), overwrite=True)
            if publish(folder, place, overwrite=overwrite and exact):
                return place
    refuse_existing_run(run_dir, overwrite=False)  # another process was faster
    raise FileExistsError(f"{run_dir} was there a moment ago; lift again")


def _lifted_config(source: NerfstudioScene, run_dir: Path) -> TrainerConfig:
    config, location = deepcopy(source.config), source.location
    config.method_name = "normlift"
    config.output_dir = location.portable(run_dir.parents[2])
    config.timestamp = run_dir.name
    config.relative_model_dir = Path(CHECKPOINT_FOLDER)
    config.load_dir = config.load_step = config.load_config = config.load_checkpoint = None
    config.pipeline.model = NormLiftModelConfig.upgrade(source.model_config, semantics=Path(FIELD_FOLDER))
    if location.moved_data or config.output_dir.is_absolute():
        set_data(config, location.data)  # a relative one would not be found
    skip_seed_points(config)
    config.pipeline.datamanager.cache_images = (
        "gpu"  # that is, on the pipeline's device; "cpu" pins memory, which needs CUDA
    )
    return config


def _write_tensors(
    folder: Path,
    source: NerfstudioScene | SplatScene,
    field: SemanticField,
    question: Question | None,
    texts: Mapping[str, Tensor] | None,
) -> None:
    checkpoint = checkpoint_of(source) if isinstance(source, SplatScene) else _slim(source.checkpoint)
    path = folder / CHECKPOINT_FOLDER / f"step-{checkpoint['step']:09d}.ckpt"
    with new_file(path) as draft:
        torch.save(checkpoint, draft)
    inside = folder / FIELD_FOLDER
    if texts:
        write_text_vectors(inside / TEXTS_FILE, texts)
    field.save(inside, beside=digests_beside(inside, [path, inside / TEXTS_FILE, *folder.glob("*.json")]))
    if question is not None:
        save_question(inside, question)


def _slim(checkpoint: Checkpoint) -> dict[str, Any]:
    pipeline = {f"_model.{name}": tensor for name, tensor in checkpoint.model.items()}
    return {"step": checkpoint.step, "pipeline": pipeline}
