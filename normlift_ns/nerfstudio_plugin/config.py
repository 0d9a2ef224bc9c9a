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
    """Read a config.yml into nerfstudio's classes.

    Raises:
        FileNotFoundError, ValueError: as `normlift_ns.scenes.nerfstudio.config.read_config`.
    """
    return as_nerfstudios(plain.read_config(path))


def as_nerfstudios(config: Any) -> TrainerConfig:
    """Convert a config that normlift_ns has read and checked to nerfstudio's classes."""
    # Loader is safe here: dump_config wrote the text, and it names allowed classes only
    return yaml.load(dump_config(config), Loader=yaml.Loader)


def rerooted(config: TrainerConfig, config_path: Path, data: Path | None = None) -> TrainerConfig:
    """Return a copy of the config with absolute paths, valid from any directory, and without seed points.

    It also works with stock nerfstudio:
    `eval_setup(path, update_config_callback=lambda config: rerooted(config, path))`.

    Raises:
        FileNotFoundError: as `locate`.
    """
    location = plain.locate(config, config_path, data)
    config = plain.rebased(config, location)
    model: Any = config.pipeline.model
    if isinstance(model, NormLiftModelConfig) and model.semantics is not None:
        model.semantics = location.run_dir / FIELD_FOLDER
    return config
