"""The YAML of a config.yml, and the current paths of its run's files; reading them constructs no objects."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml

from normlift_ns.errors import InputError

OBJECT_TAG = "tag:yaml.org,2002:python/object"
_MAX_BYTES = 2**18
"""Largest config.yml that is read; nerfstudio's have 6,000 bytes."""
_EXPECTED = "Expected the config.yml that ns-train splatfacto wrote; give that with --load-config."


def check_config_exists(path: Path, wrote: str = "ns-train") -> None:
    """Raise FileNotFoundError unless the path is that of a file.

    Args:
        path: path of a config.yml.
        wrote: command that wrote it, for the message.
    """
    if not path.is_file():
        hint = f"; {path / 'config.yml'} exists, give that path" if (path / "config.yml").is_file() else ""
        method = "splatfacto" if wrote == "ns-train" else "normlift"
        raise FileNotFoundError(
            f"No config at {path}{hint}. Expected the config.yml that {wrote} wrote, for example "
            f"--load-config outputs/fox/{method}/2024-05-01_120000/config.yml."
        )


def compose_config(path: Path) -> yaml.MappingNode:
    """Return the YAML of a nerfstudio config, which names a method.

    Raises:
        FileNotFoundError: if there is no such file.
        OSError, ValueError: if the file cannot be read, or is not a nerfstudio config.
    """
    check_config_exists(path)
    size = path.stat().st_size
    if size > _MAX_BYTES:
        raise InputError(
            f"{path} is not a nerfstudio config: it has {size:,} bytes, more than {_MAX_BYTES:,}. {_EXPECTED}"
        )
    try:
        root = yaml.compose(path.read_text("utf8"), Loader=getattr(yaml, "CSafeLoader", yaml.SafeLoader))
    except OSError as error:
        raise OSError(f"{path} cannot be read: {error.strerror}. {_EXPECTED}") from None
    except (yaml.YAMLError, UnicodeDecodeError, RecursionError) as error:
        raise InputError(
            f"{path} is not a nerfstudio config: it is not valid YAML ({describe_yaml_error(error)}). {_EXPECTED}"
        ) from error
    is_object = isinstance(root, yaml.MappingNode) and root.tag.startswith(f"{OBJECT_TAG}:")
    if not is_object or config_string(root, "method_name") is None:
        raise InputError(f"{path} is not a nerfstudio config: it has no method_name. {_EXPECTED}")
    return root


def describe_yaml_error(error: Exception) -> str:
    """Summarize a YAML error in one line: problem and line number."""
    if isinstance(error, RecursionError):
        return "it is nested too deeply"
    if isinstance(error, yaml.MarkedYAMLError):
        line = "" if error.problem_mark is None else f", line {error.problem_mark.line + 1}"
        return f"{error.problem}{line}"
    return " ".join(str(error).split())


def config_string(node: yaml.Node | None, *keys: str) -> str | None:
    """Return the text at a path of keys in nested mappings; None if there is none."""
    value = _value(node, *keys)
    return value.value if isinstance(value, yaml.ScalarNode) else None


def _value(node: yaml.Node | None, *keys: str) -> yaml.Node | None:
    for key in keys:
        entries = node.value if isinstance(node, yaml.MappingNode) else ()
        node = next((value for name, value in entries if isinstance(name, yaml.ScalarNode) and name.value == key), None)
    return node


def _stored_path(node: yaml.Node | None, *keys: str) -> Path | None:
    """Return a path that nerfstudio wrote as a list of its parts."""
    value = _value(node, *keys)
    if not isinstance(value, yaml.SequenceNode) or not value.tag.endswith("Path"):
        return None
    parts = [part.value for part in value.value if isinstance(part, yaml.ScalarNode)]
    return Path(*parts) if 0 < len(parts) == len(value.value) else None


@dataclass(frozen=True)
class ConfigPaths:
    """Names and paths of a trained or lifted run; None if the config does not store them as nerfstudio does."""

    experiment: str | None
    output_dir: Path | None
    """Folder that contains the experiment folder."""
    data: tuple[Path, ...]
    """Possible paths of the dataset; empty if the config has none."""


def read_config_paths(path: Path) -> ConfigPaths:
    """Read names and paths from a config.yml, in the time that its YAML takes.

    Raises:
        FileNotFoundError, OSError, ValueError: as in `compose_config`.
    """
    root = compose_config(path)
    names = [config_string(root, key) for key in ("experiment_name", "method_name", "timestamp")]
    data = _stored_path(root, "pipeline", "datamanager", "data")
    data = data or _stored_path(root, "pipeline", "datamanager", "dataparser", "data")
    configured = _stored_path(root, "output_dir")
    inferred = _infer_output_dir(_absolute(path).parent, names)
    if configured is None:
        return ConfigPaths(names[0], inferred, ())
    output_dir = inferred or fallback_output_dir(configured)
    candidates = () if data is None else _dataset_candidates(data, output_dir, _training_dir(inferred, configured))
    return ConfigPaths(names[0], output_dir, tuple(candidates))


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
    data_moved: bool
    """Whether `data` differs from the path in the config, read relative to `root`."""

    @property
    def folder(self) -> Path:
        """Folder of the dataset."""
        return self.data.parent if self.data.suffix == ".json" else self.data

    def relative_to_root(self, path: Path) -> Path:
        """Return the path to store in a config: relative to `root` if it is inside it, otherwise unchanged."""
        return path.relative_to(self.root) if self.root is not None and path.is_relative_to(self.root) else path


def locate_run(config: Any, config_path: Path, data: Path | None = None) -> RunLocation:
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
    inferred = _infer_output_dir(run_dir, (str(config.experiment_name), str(config.method_name), config.timestamp))
    output_dir = inferred or fallback_output_dir(config.output_dir)
    root = _training_dir(inferred, config.output_dir)
    if data is not None:
        if not data.exists():
            raise FileNotFoundError(
                f"There is no dataset at {_absolute(data)}, given with --data. Expected the folder or the "
                "transforms.json that the run was trained with."
            )
        return RunLocation(run_dir, output_dir, root, _absolute(data), data_moved=True)
    stored = dataset_in_config(config)
    tried = _dataset_candidates(stored, output_dir, root)
    for path in tried:
        if path.exists():
            moved = root is None or path != _absolute(root / stored)
            return RunLocation(run_dir, output_dir, root, path, data_moved=moved)
    raise FileNotFoundError(
        f"The dataset of {config_path} is not at {' nor at '.join(map(str, tried))}; the config has {str(stored)!r}. "
        "If it was moved, give its path with --data."
    )


def _infer_output_dir(run_dir: Path, names: Sequence[str | None]) -> Path | None:
    """Return the folder above experiment/method/timestamp; None if the run does not lie in folders of these names."""
    known = [name for name in names if name is not None]
    return _strip_tail(run_dir, Path(*known)) if len(known) == len(names) else None


def _training_dir(inferred: Path | None, output_dir: Path) -> Path | None:
    """Return the working directory of the training from the folder of the runs, and output_dir in the config."""
    return None if inferred is None else _strip_tail(inferred, Path(os.path.normpath(output_dir)))


def _dataset_candidates(stored: Path, output_dir: Path, root: Path | None) -> list[Path]:
    """Return the possible paths of a dataset: in the working directory of the training, and in the current one."""
    roots = output_dir.parents if root is None else (root,)
    return list(dict.fromkeys(_absolute(base / stored) for base in (*roots, Path.cwd())))


def _strip_tail(path: Path, tail: Path) -> Path | None:
    """Return `path` without the trailing relative path `tail`; None if it does not end in it."""
    count = len(path.parts) - len(tail.parts)
    return Path(*path.parts[:count]) if count > 0 and path.parts[count:] == tail.parts else None


def dataset_in_config(config: Any) -> Path:
    """Return the path of the dataset in the config."""
    datamanager = config.pipeline.datamanager
    return Path(datamanager.data if datamanager.data is not None else datamanager.dataparser.data)


def fallback_output_dir(output_dir: Path) -> Path:
    """Return the output folder for a moved run: inside the current directory, whatever its config names."""
    return _absolute(Path("outputs") if output_dir.is_absolute() or ".." in output_dir.parts else output_dir)


def _absolute(path: Path) -> Path:
    return Path(os.path.abspath(path))
