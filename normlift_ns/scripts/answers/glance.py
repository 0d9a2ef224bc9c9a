"""Names and paths in a config.yml, read without nerfstudio and without constructing any object."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path

import yaml

from normlift_ns.errors import InputError

_MAX_CONFIG_BYTES = 2**22
"""Largest size of a config; those of nerfstudio have a few thousand bytes."""


@dataclass(frozen=True)
class ConfigPaths:
    """Names and paths of a trained or lifted run; None if the config does not store them as nerfstudio does."""

    experiment: str | None
    output_dir: Path | None
    """Folder that contains the experiment folder."""
    data: tuple[Path, ...]
    """Possible paths of the dataset; empty if the config has none."""


def glance(config: Path) -> ConfigPaths:
    """Read names and paths from a config.yml.

    Raises:
        InputError: The file is not valid YAML, or not a nerfstudio config.
    """
    expected = "Expected the config.yml that ns-train splatfacto wrote; give that with --load-config."
    if config.stat().st_size > _MAX_CONFIG_BYTES:
        raise InputError(
            f"{config} is not a nerfstudio config: it has more than {_MAX_CONFIG_BYTES:,} bytes. {expected}"
        )
    try:
        root = yaml.compose(config.read_text("utf8"), Loader=getattr(yaml, "CSafeLoader", yaml.SafeLoader))
    except OSError as error:
        raise OSError(f"{config} cannot be read: {error.strerror}. {expected}") from None
    except (yaml.YAMLError, UnicodeDecodeError, RecursionError) as error:
        reason = error.problem if isinstance(error, yaml.MarkedYAMLError) else " ".join(str(error).split())
        raise InputError(f"{config} is not a nerfstudio config: it is not valid YAML ({reason}). {expected}") from None
    method = _string(_value(root, "method_name"))
    if method is None:
        raise InputError(f"{config} is not a nerfstudio config: it has no method_name. {expected}")
    experiment, timestamp = _string(_value(root, "experiment_name")), _string(_value(root, "timestamp"))
    run_dir = Path(os.path.abspath(config)).parent
    names = (experiment, method, timestamp)
    parent = run_dir.parents[2] if None not in names and run_dir.parts[-3:] == names else None
    manager = _value(root, "pipeline", "datamanager")
    data = _config_path(_value(manager, "data")) or _config_path(_value(manager, "dataparser", "data"))
    configured = _config_path(_value(root, "output_dir"))
    output_dir = parent
    if parent is None and configured is not None:
        from normlift_ns.scenes.nerfstudio.config import outputs_of_moved  # noqa: PLC0415 (rarely needed)

        output_dir = outputs_of_moved(configured)
    if data is None or configured is None:
        return ConfigPaths(experiment, output_dir, ())
    tail = Path(os.path.normpath(configured)).parts
    if parent is not None and parent.parts[-len(tail) :] == tail:  # this gives the working directory of the training
        roots = [Path(*parent.parts[: -len(tail)]), Path.cwd()]
    else:
        roots = [*(parent or Path(os.path.abspath(configured))).parents, Path.cwd()]
    data_paths = tuple(dict.fromkeys(Path(os.path.abspath(folder / data)) for folder in roots))
    return ConfigPaths(experiment, output_dir, data_paths)


def _value(node: yaml.Node | None, *keys: str) -> yaml.Node | None:
    """Return the value at a path of keys in nested mappings."""
    for key in keys:
        entries = node.value if isinstance(node, yaml.MappingNode) else ()
        node = next((value for name, value in entries if isinstance(name, yaml.ScalarNode) and name.value == key), None)
    return node


def _string(node: yaml.Node | None) -> str | None:
    return node.value if isinstance(node, yaml.ScalarNode) else None


def _config_path(node: yaml.Node | None) -> Path | None:
    """Return a path that nerfstudio wrote as a list of its parts."""
    if not isinstance(node, yaml.SequenceNode) or not node.tag.endswith("Path"):
        return None
    parts = [_string(part) for part in node.value]
    return Path(*(part for part in parts if part is not None)) if parts and None not in parts else None
