"""What a config.yml says of names and places, read without nerfstudio and without building anything."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path

import yaml

from normlift_ns.errors import InputError

_MOST_BYTES = 2**22
"""Of a config; nerfstudio's have some thousands."""


@dataclass(frozen=True)
class Glance:
    """Names and places of a trained or lifted run; None where the config says them otherwise than nerfstudio does."""

    experiment: str | None
    output_dir: Path | None
    """The folder above the runs of the experiment."""
    data: tuple[Path, ...]
    """Where the dataset may be; empty where the config does not say it."""


def glance(config: Path) -> Glance:
    """Looks at a config.yml.

    Raises:
        InputError: no YAML, or no config of nerfstudio.
    """
    expected = "Expected the config.yml that ns-train splatfacto wrote; give that with --load-config."
    if config.stat().st_size > _MOST_BYTES:
        raise InputError(f"{config} is not a nerfstudio config: it has more than {_MOST_BYTES:,} bytes. {expected}")
    try:
        root = yaml.compose(config.read_text("utf8"), Loader=getattr(yaml, "CSafeLoader", yaml.SafeLoader))
    except OSError as error:
        raise OSError(f"{config} cannot be read: {error.strerror}. {expected}") from None
    except (yaml.YAMLError, UnicodeDecodeError, RecursionError) as error:
        reason = error.problem if isinstance(error, yaml.MarkedYAMLError) else " ".join(str(error).split())
        raise InputError(f"{config} is not a nerfstudio config: it is no valid YAML ({reason}). {expected}") from None
    method = _text(_at(root, "method_name"))
    if method is None:
        raise InputError(f"{config} is not a nerfstudio config: it has no method_name. {expected}")
    experiment, stamp = _text(_at(root, "experiment_name")), _text(_at(root, "timestamp"))
    run_dir = Path(os.path.abspath(config)).parent
    names = (experiment, method, stamp)
    above = run_dir.parents[2] if None not in names and run_dir.parts[-3:] == names else None
    manager = _at(root, "pipeline", "datamanager")
    data = _path(_at(manager, "data")) or _path(_at(manager, "dataparser", "data"))
    outputs = _path(_at(root, "output_dir"))
    runs = above
    if above is None and outputs is not None:
        from normlift_ns.scenes.nerfstudio.config import outputs_of_moved  # noqa: PLC0415 (rarely needed)

        runs = outputs_of_moved(outputs)
    if data is None or outputs is None:
        return Glance(experiment, runs, ())
    tail = Path(os.path.normpath(outputs)).parts
    if above is not None and above.parts[-len(tail) :] == tail:  # so the directory of the training is known
        roots = [Path(*above.parts[: -len(tail)]), Path.cwd()]
    else:
        roots = [*(above or Path(os.path.abspath(outputs))).parents, Path.cwd()]
    return Glance(experiment, runs, tuple(dict.fromkeys(Path(os.path.abspath(base / data)) for base in roots)))


def _at(node: yaml.Node | None, *keys: str) -> yaml.Node | None:
    """The value under a key of a mapping, and so on."""
    for key in keys:
        entries = node.value if isinstance(node, yaml.MappingNode) else ()
        node = next((value for name, value in entries if isinstance(name, yaml.ScalarNode) and name.value == key), None)
    return node


def _text(node: yaml.Node | None) -> str | None:
    return node.value if isinstance(node, yaml.ScalarNode) else None


def _path(node: yaml.Node | None) -> Path | None:
    """A path as nerfstudio writes it, its parts in a list."""
    if not isinstance(node, yaml.SequenceNode) or not node.tag.endswith("Path"):
        return None
    parts = [_text(part) for part in node.value]
    return Path(*(part for part in parts if part is not None)) if parts and None not in parts else None
