"""Configs of trained runs as objects of nerfstudio's own classes, for its commands and its viewer."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import yaml
from nerfstudio.engine.trainer import TrainerConfig

from normlift_ns.nerfstudio_plugin.model import NormLiftModelConfig
from normlift_ns.runs.files import FIELD_FOLDER
from normlift_ns.scenes.nerfstudio import config as plain
from normlift_ns.scenes.nerfstudio.allowed import dump_config


def read_config(path: Path) -> TrainerConfig:
    """As `normlift_ns.scenes.nerfstudio.config.read_config`, in nerfstudio's classes.

    Raises:
        FileNotFoundError, ValueError: as there.
    """
    return as_nerfstudios(plain.read_config(path))


def as_nerfstudios(config: Any) -> TrainerConfig:
    """A config that was read and checked here, in nerfstudio's classes."""
    return yaml.load(dump_config(config), Loader=yaml.Loader)  # of our own text, which names allowed classes only


def rerooted(config: TrainerConfig, config_path: Path, data: Path | None = None) -> TrainerConfig:
    """A copy of the config with absolute paths, which works from any directory, and without seed points.

    Serves stock nerfstudio too: `eval_setup(path, update_config_callback=lambda config: rerooted(config, path))`.

    Raises:
        FileNotFoundError: as `locate`.
    """
    location = plain.locate(config, config_path, data)
    config = plain.rebased(config, location)
    model: Any = config.pipeline.model
    if isinstance(model, NormLiftModelConfig) and model.semantics is not None:
        model.semantics = location.run_dir / FIELD_FOLDER
    return config
