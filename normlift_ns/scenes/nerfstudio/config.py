"""Safe reading of a nerfstudio run's config.yml, and location of its files from any working directory."""

from __future__ import annotations

import os
from copy import deepcopy
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml

from normlift_ns.errors import InputError
from normlift_ns.scenes.nerfstudio.allowed import OBJECT_TAG, ConfigLoader
from normlift_ns.scenes.nerfstudio.checks import check_config
from normlift_ns.scenes.nerfstudio.classes import TrainerConfig

SUPPORTED_METHODS = (
    *("splatfacto", "splatfacto-big", "splatfacto-mcmc"),  # the last one comes from nerfstudio's main branch
    *("normlift", "normlift-lerf-ovs", "normlift-scannet"),
)
_MAX_BYTES = 2**18
"""Largest config.yml that is read; nerfstudio's have 6,000 bytes."""
_EXPECTED = "Expected the config.yml that ns-train splatfacto wrote; give that with --load-config."


def read_config(path: Path) -> TrainerConfig:
    """Read the config.yml of a splatfacto or normlift run, with its paths unchanged.

    Raises:
        FileNotFoundError: if there is no such file.
        ValueError: if nerfstudio did not write the config, or it has an unsupported method or data parser, classes
            other than nerfstudio's configuration classes, or invalid values.
    """
    if not path.is_file():
        hint = f"; {path / 'config.yml'} exists, give that" if (path / "config.yml").is_file() else ""
        raise FileNotFoundError(
            f"No config at {path}{hint}. Expected the config.yml that ns-train wrote, "
            "for example --load-config outputs/fox/splatfacto/2024-05-01_120000/config.yml."
        )
    if path.stat().st_size > _MAX_BYTES:
        raise InputError(
            f"{path} is not a nerfstudio config: it has {path.stat().st_size:,} bytes, more than {_MAX_BYTES:,}. "
            f"{_EXPECTED}"
        )
    try:
        loader = ConfigLoader(path.read_text("utf8"))
        root = loader.get_single_node()
    except (yaml.YAMLError, UnicodeDecodeError, RecursionError) as error:
        raise InputError(
            f"{path} is not a nerfstudio config: it is not valid YAML ({_brief(error)}). {_EXPECTED}"
        ) from error
    method = _method_name(root)
    if method is None:
        raise InputError(f"{path} is not a nerfstudio config: it has no method_name. {_EXPECTED}")
    if method not in SUPPORTED_METHODS:
        raise InputError(
            f"{path} is a run of method {method!r}; only Gaussians of {', '.join(SUPPORTED_METHODS)} can be lifted. "
            "Train the capture with: ns-train splatfacto --data ...; or, if the run's Gaussians are standard ones, "
            "export them with ns-export gaussian-splat and lift that file with --load-ply"
        )
    try:
        config = loader.construct_document(root)
    except Exception as error:  # PyYAML converts values to dates, numbers and sets without catching their errors
        raise InputError(
            f"{path} cannot be read: {_brief(error)}. Only the configuration classes of splatfacto and normlift_ns "
            "are read, with nerfstudio's own optimizers and the data parsers nerfstudio-data, colmap and "
            "blender-data. Convert other datasets to one of those formats with ns-process-data, and train on that."
        ) from error
    check_config(config, path)
    return config


def _method_name(root: yaml.Node | None) -> str | None:
    """Return the method_name of any config, without constructing objects."""
    if not isinstance(root, yaml.MappingNode) or not root.tag.startswith(f"{OBJECT_TAG}:"):
        return None
    for key, value in root.value:
        if isinstance(key, yaml.ScalarNode) and key.value == "method_name" and isinstance(value, yaml.ScalarNode):
            return value.value
    return None


def _brief(error: Exception) -> str:
    """Summarize a YAML error in one line: problem and line number."""
    if isinstance(error, RecursionError):
        return "it is nested too deeply"
    if isinstance(error, yaml.MarkedYAMLError):
        line = "" if error.problem_mark is None else f", line {error.problem_mark.line + 1}"
        return f"{error.problem}{line}"
    return " ".join(str(error).split())


@dataclass(frozen=True)
class RunLocation:
    """Current absolute paths of a run's files."""

    run_dir: Path
    """Folder of config.yml."""
    output_dir: Path
    """Folder above experiment/method/timestamp, in which runs of this experiment are stored; outputs/ by default."""
    root: Path | None
    """Working directory of the training, from which stock ns-* commands must be run. None if it cannot be inferred,
    because output_dir is absolute or the run was moved."""
    data: Path
    """The dataset: a folder or a .json file."""
    moved_data: bool
    """Whether `data` differs from the path in the config, read relative to `root`."""

    @property
    def folder(self) -> Path:
        """Folder of the dataset."""
        return self.data.parent if self.data.suffix == ".json" else self.data

    def portable(self, path: Path) -> Path:
        """Return the path to store in a config: relative to `root` if it is inside it, otherwise unchanged."""
        return path.relative_to(self.root) if self.root is not None and path.is_relative_to(self.root) else path


def locate(config: Any, config_path: Path, data: Path | None = None) -> RunLocation:
    """Locate the files of a run from the path of its config.yml, whatever the current directory.

    nerfstudio stores output_dir, data and other paths relative to the training's working directory, which config.yml
    does not contain. But config.yml lies in output_dir/experiment/method/timestamp, from which the directory follows.

    Args:
        config: contents of config.yml.
        config_path: path of config.yml.
        data: current path of the dataset, relative to the current directory; None: the path in the config.
    Raises:
        FileNotFoundError: if there is no dataset; the message names every path tried.
    """
    run_dir = _absolute(config_path).parent
    inferred = _strip_tail(run_dir, Path(str(config.experiment_name), str(config.method_name), config.timestamp))
    output_dir = outputs_of_moved(config.output_dir) if inferred is None else inferred
    root = None if inferred is None else _strip_tail(inferred, Path(os.path.normpath(config.output_dir)))
    if data is not None:
        if not data.exists():
            raise FileNotFoundError(
                f"There is no dataset at {_absolute(data)}, given with --data. Expected the folder or the "
                "transforms.json that the run was trained with."
            )
        return RunLocation(run_dir, output_dir, root, _absolute(data), moved_data=True)
    stored = stored_data(config)
    roots = [root] if root is not None else list(output_dir.parents)
    tried = list(dict.fromkeys(_absolute(base / stored) for base in (*roots, Path.cwd())))
    for path in tried:
        if path.exists():
            moved = root is None or path != _absolute(root / stored)
            return RunLocation(run_dir, output_dir, root, path, moved_data=moved)
    raise FileNotFoundError(
        f"The dataset of {config_path} is not at {' nor at '.join(map(str, tried))}; the config has {str(stored)!r}. "
        "If it was moved, give its path with --data."
    )


def _strip_tail(path: Path, tail: Path) -> Path | None:
    """Return `path` without the trailing relative path `tail`; None if it does not end in it."""
    count = len(path.parts) - len(tail.parts)
    return Path(*path.parts[:count]) if count > 0 and path.parts[count:] == tail.parts else None


def stored_data(config: Any) -> Path:
    """Return the path of the dataset in the config."""
    datamanager = config.pipeline.datamanager
    return Path(datamanager.data if datamanager.data is not None else datamanager.dataparser.data)


def outputs_of_moved(output_dir: Path) -> Path:
    """Return the output folder for a moved run: inside the current directory, whatever its config names."""
    return _absolute(Path("outputs") if output_dir.is_absolute() or ".." in output_dir.parts else output_dir)


def _absolute(path: Path) -> Path:
    return Path(os.path.abspath(path))


def rebased(config: Any, location: RunLocation) -> Any:
    """Return a copy of the config with absolute paths, valid in any directory, and without seed points."""
    config = deepcopy(config)
    set_data(config, location.data)
    skip_seed_points(config)
    if location.root is not None:
        config.output_dir = location.root / config.output_dir
    config.relative_model_dir = location.run_dir / config.relative_model_dir
    return config


def set_data(config: Any, data: Path) -> None:
    """Change the dataset in the three fields in which nerfstudio stores it."""
    datamanager = config.pipeline.datamanager
    config.data = datamanager.data = datamanager.dataparser.data = data


def skip_seed_points(config: Any) -> None:
    """Stop the dataparser from reading the initial point cloud, which a trained run does not need."""
    dataparser = config.pipeline.datamanager.dataparser
    if hasattr(dataparser, "load_3D_points"):
        dataparser.load_3D_points = False
    if hasattr(dataparser, "ply_path"):
        dataparser.ply_path = None
