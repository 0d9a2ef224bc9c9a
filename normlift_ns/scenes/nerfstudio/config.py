"""config.yml of a nerfstudio run: reading it safely, and finding its files from wherever the program was started."""

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
    *("splatfacto", "splatfacto-big", "splatfacto-mcmc"),  # the last one is of nerfstudio's main branch
    *("normlift", "normlift-lerf-ovs", "normlift-scannet"),
)
_LARGEST = 2**18
"""Bytes of a config.yml; nerfstudio's have 6,000."""
_EXPECTED = "Expected the config.yml that ns-train splatfacto wrote; give that with --load-config."


def read_config(path: Path) -> TrainerConfig:
    """Reads config.yml of a splatfacto or normlift run, with the paths as they stand in the file.

    Raises:
        FileNotFoundError: no such file.
        ValueError: not a config that nerfstudio wrote, a method or a data parser that is not supported, a config that
            names anything but nerfstudio's own configuration classes, or values that these cannot have.
    """
    if not path.is_file():
        hint = f"; {path / 'config.yml'} exists, give that" if (path / "config.yml").is_file() else ""
        raise FileNotFoundError(
            f"No config at {path}{hint}. Expected the config.yml that ns-train wrote, "
            "for example --load-config outputs/fox/splatfacto/2024-05-01_120000/config.yml."
        )
    if path.stat().st_size > _LARGEST:
        raise InputError(
            f"{path} is not a nerfstudio config: it has {path.stat().st_size:,} bytes, more than {_LARGEST:,}. "
            f"{_EXPECTED}"
        )
    try:
        loader = ConfigLoader(path.read_text("utf8"))
        root = loader.get_single_node()
    except (yaml.YAMLError, UnicodeDecodeError, RecursionError) as error:
        raise InputError(
            f"{path} is not a nerfstudio config: it is no valid YAML ({_brief(error)}). {_EXPECTED}"
        ) from error
    method = _method_name(root)
    if method is None:
        raise InputError(f"{path} is not a nerfstudio config: it has no method_name. {_EXPECTED}")
    if method not in SUPPORTED_METHODS:
        raise InputError(
            f"{path} is a run of method {method!r}; only Gaussians of {', '.join(SUPPORTED_METHODS)} can be lifted. "
            "Train the capture with: ns-train splatfacto --data ...; or, if its Gaussians are plain ones, write them "
            "with ns-export gaussian-splat and lift that file with --load-ply"
        )
    try:
        config = loader.construct_document(root)
    except Exception as error:  # PyYAML turns values into dates, numbers and sets, and lets all their errors through
        raise InputError(
            f"{path} cannot be read: {_brief(error)}. Only the configuration classes of splatfacto and normlift_ns "
            "are read, with nerfstudio's own optimizers and the data parsers nerfstudio-data, colmap and "
            "blender-data; turn other data sets into one of those with ns-process-data, and train on that."
        ) from error
    check_config(config, path)
    return config


def _method_name(root: yaml.Node | None) -> str | None:
    """method_name of a config of any method, read without constructing anything."""
    if not isinstance(root, yaml.MappingNode) or not root.tag.startswith(f"{OBJECT_TAG}:"):
        return None
    for key, value in root.value:
        if isinstance(key, yaml.ScalarNode) and key.value == "method_name" and isinstance(value, yaml.ScalarNode):
            return value.value
    return None


def _brief(error: Exception) -> str:
    """One line of a YAML error: what and where."""
    if isinstance(error, RecursionError):
        return "it is nested too deeply"
    if isinstance(error, yaml.MarkedYAMLError):
        line = "" if error.problem_mark is None else f", line {error.problem_mark.line + 1}"
        return f"{error.problem}{line}"
    return " ".join(str(error).split())


@dataclass(frozen=True)
class RunLocation:
    """Where the files of a run are now; all paths absolute."""

    run_dir: Path
    """The folder of config.yml."""
    output_dir: Path
    """Where runs of this experiment go: the folder above experiment/method/timestamp, outputs/ by default."""
    root: Path | None
    """Working directory of the training, which stock ns-* commands must be run from; None where output_dir is absolute
    or the run was moved, so that its place does not tell."""
    data: Path
    """The dataset: a folder or a .json file."""
    moved_data: bool
    """True where `data` is not what the config, read from `root`, says."""

    @property
    def folder(self) -> Path:
        """The folder of the dataset."""
        return self.data.parent if self.data.suffix == ".json" else self.data

    def portable(self, path: Path) -> Path:
        """The path as it should stand in a config: relative to `root` where it lies below it, else absolute."""
        return path.relative_to(self.root) if self.root is not None and path.is_relative_to(self.root) else path


def locate(config: Any, config_path: Path, data: Path | None = None) -> RunLocation:
    """Finds the files of a run from where its config.yml lies, whatever the current directory.

    nerfstudio writes output_dir, data and others relative to the directory of the training, which config.yml does not
    name; but it lies in output_dir/experiment/method/timestamp, so the directory can be told.

    Args:
        data: where the dataset is now; relative to the current directory. None: where the config says.
    Raises:
        FileNotFoundError: no dataset there; the message names every place tried.
    """
    run_dir = _absolute(config_path).parent
    above = _without_tail(run_dir, Path(str(config.experiment_name), str(config.method_name), config.timestamp))
    output_dir = outputs_of_moved(config.output_dir) if above is None else above
    root = None if above is None else _without_tail(above, Path(os.path.normpath(config.output_dir)))
    if data is not None:
        if not data.exists():
            raise FileNotFoundError(
                f"There is no dataset at {_absolute(data)}, given with --data. Expected the folder or the "
                "transforms.json that ns-train got."
            )
        return RunLocation(run_dir, output_dir, root, _absolute(data), moved_data=True)
    stored = stored_data(config)
    roots = [root] if root is not None else list(output_dir.parents)
    tried = list(dict.fromkeys(_absolute(base / stored) for base in (*roots, Path.cwd())))
    for place in tried:
        if place.exists():
            moved = root is None or place != _absolute(root / stored)
            return RunLocation(run_dir, output_dir, root, place, moved_data=moved)
    raise FileNotFoundError(
        f"The dataset of {config_path} is not at {' nor at '.join(map(str, tried))}; the config says {str(stored)!r}. "
        "If it was moved, say where it is with --data."
    )


def _without_tail(path: Path, tail: Path) -> Path | None:
    """`path` without the relative path that it ends in; None if it does not."""
    count = len(path.parts) - len(tail.parts)
    return Path(*path.parts[:count]) if count > 0 and path.parts[count:] == tail.parts else None


def stored_data(config: Any) -> Path:
    """The dataset as the config names it."""
    datamanager = config.pipeline.datamanager
    return Path(datamanager.data if datamanager.data is not None else datamanager.dataparser.data)


def outputs_of_moved(output_dir: Path) -> Path:
    """outputs/ of a run that was moved: below the current directory, wherever its config says that it was trained."""
    return _absolute(Path("outputs") if output_dir.is_absolute() or ".." in output_dir.parts else output_dir)


def _absolute(path: Path) -> Path:
    return Path(os.path.abspath(path))


def rebased(config: Any, location: RunLocation) -> Any:
    """A copy of the config with absolute paths, which works from any directory, and without seed points."""
    config = deepcopy(config)
    set_data(config, location.data)
    skip_seed_points(config)
    if location.root is not None:
        config.output_dir = location.root / config.output_dir
    config.relative_model_dir = location.run_dir / config.relative_model_dir
    return config


def set_data(config: Any, data: Path) -> None:
    """Changes the dataset in the three places where nerfstudio keeps it."""
    datamanager = config.pipeline.datamanager
    config.data = datamanager.data = datamanager.dataparser.data = data


def skip_seed_points(config: Any) -> None:
    """Keeps the dataparser from reading the point cloud that a training starts from; a trained run needs none."""
    dataparser = config.pipeline.datamanager.dataparser
    if hasattr(dataparser, "load_3D_points"):
        dataparser.load_3D_points = False
    if hasattr(dataparser, "ply_path"):
        dataparser.ply_path = None
