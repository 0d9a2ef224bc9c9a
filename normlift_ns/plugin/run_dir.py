"""The run directory of a lift: what stock nerfstudio loads, and the semantic field beside it."""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from copy import deepcopy
from datetime import datetime
from pathlib import Path
from typing import Any

import torch
import yaml
from nerfstudio.engine.trainer import TrainerConfig
from safetensors import SafetensorError

from normlift_ns.core.field import SemanticField, fingerprint
from normlift_ns.plugin.adapters import SourceRun
from normlift_ns.plugin.config import FIELD_FOLDER, set_data, skip_seed_points
from normlift_ns.plugin.model import NormLiftModelConfig
from normlift_ns.plugin.queries import Question, save_question

_MODEL_FOLDER = "nerfstudio_models"


def run_directory(source: SourceRun, *, output_dir: Path | None = None, timestamp: str | None = None) -> Path:
    """Where `write_run` puts a run: output_dir/experiment/normlift/timestamp, absolute.

    Args:
        output_dir: None: that of the source run, where it is now.
        timestamp: None: now, as 2024-05-01_120000.
    """
    base = source.location.output_dir if output_dir is None else Path(os.path.abspath(output_dir))
    stamp = timestamp or datetime.now().strftime("%Y-%m-%d_%H%M%S")
    return base / str(source.config.experiment_name) / "normlift" / stamp


def write_run(
    source: SourceRun,
    field: SemanticField,
    *,
    question: Question | None = None,
    output_dir: Path | None = None,
    timestamp: str | None = None,
    overwrite: bool = False,
) -> Path:
    """Writes a lifted run, complete or not at all, and returns its directory.

    It holds config.yml (method normlift), nerfstudio_models/step-*.ckpt (step and tensors of the model, without
    optimizers), dataparser_transforms.json and the field in normlift/. Relative paths of the source's config stay
    relative, so stock ns-* commands run from where the source run was trained, ours from anywhere.

    Args:
        question: what to draw as relevancy_0, relevancy_1, …
        output_dir, timestamp: as `run_directory`.
        overwrite: replace a directory of that name.
    Raises:
        FileExistsError: the directory exists and `overwrite` is False.
        ValueError: a field of other Gaussians.
        OSError: it cannot be written, for instance because the disk is full; nothing is left then.
    """
    run_dir = run_directory(source, output_dir=output_dir, timestamp=timestamp)
    if run_dir.exists() and not overwrite:
        raise FileExistsError(f"{run_dir} exists; give another --timestamp or --output-dir, or --overwrite True.")
    if field.manifest["means_fingerprint"] != fingerprint(source.scene.means):
        raise ValueError(
            f"The semantic field has {len(field)} Gaussians and was not lifted from the {len(source.scene)} of "
            f"{source.checkpoint.path}; lift that checkpoint again."
        )
    config = _lifted_config(source, run_dir)
    with _complete_directory(run_dir) as folder:
        try:
            _write_tensors(folder, source, field, question)
        except (RuntimeError, SafetensorError) as error:  # what torch and safetensors make of a full disk
            raise OSError(f"{run_dir} cannot be written: {error}") from error
        transform = {"transform": source.dataparser_transform.tolist(), "scale": source.dataparser_scale}
        (folder / "dataparser_transforms.json").write_text(json.dumps(transform, indent=4), "utf8")
        (folder / "config.yml").write_text(yaml.dump(config), "utf8")
    return run_dir


def load_field(run: SourceRun) -> SemanticField:
    """The semantic field of a lifted run.

    Raises:
        FileNotFoundError: the run has none.
        ValueError: a damaged field, or one of other Gaussians than the run's checkpoint.
    """
    folder = run.location.run_dir / FIELD_FOLDER
    if not folder.exists():
        raise FileNotFoundError(
            f"{run.location.run_dir} is a {run.config.method_name} run without semantics (no {FIELD_FOLDER}/ in it). "
            "Lift it with ns-normlift --load-config, then give the config.yml that ns-normlift names at its end."
        )
    return SemanticField.load(folder, run.scene.means, checkpoint=run.checkpoint.path)


def _lifted_config(source: SourceRun, run_dir: Path) -> TrainerConfig:
    config, location = deepcopy(source.config), source.location
    config.method_name = "normlift"
    config.output_dir = location.portable(run_dir.parents[2])
    config.timestamp = run_dir.name
    config.relative_model_dir = Path(_MODEL_FOLDER)
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


def _write_tensors(folder: Path, source: SourceRun, field: SemanticField, question: Question | None) -> None:
    field.save(folder / FIELD_FOLDER)
    if question is not None:
        save_question(folder / FIELD_FOLDER, question)
    (folder / _MODEL_FOLDER).mkdir()
    pipeline = {f"_model.{name}": tensor for name, tensor in source.checkpoint.model.items()}
    torch.save({"step": source.step, "pipeline": pipeline}, folder / _MODEL_FOLDER / f"step-{source.step:09d}.ckpt")


@contextmanager
def _complete_directory(path: Path) -> Iterator[Path]:
    """A temporary directory that takes the place of `path` if all goes well, and vanishes if not, Ctrl-C included."""
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary, old = (path.with_name(f".{path.name}.{os.getpid()}.{kind}") for kind in ("tmp", "old"))
    temporary.mkdir()
    try:
        yield temporary
        if path.exists():
            path.rename(old)
        temporary.rename(path)
    finally:
        shutil.rmtree(temporary, ignore_errors=True)
        if old.exists() and not path.exists():
            old.rename(path)
        shutil.rmtree(old, ignore_errors=True)
