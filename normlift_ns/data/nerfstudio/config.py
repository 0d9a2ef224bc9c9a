"""Safe reader and writer for the config.yml of a nerfstudio run, with checks of its values and paths."""

from __future__ import annotations

import os
import re
import types
from collections.abc import Callable, Iterator, Sequence
from copy import deepcopy
from dataclasses import MISSING, dataclass, fields, is_dataclass
from itertools import chain
from operator import attrgetter
from pathlib import Path
from typing import Any, Literal, Union, get_args, get_origin, get_type_hints

import yaml

from normlift_ns.data.nerfstudio.config_classes import (
    CLASS_TARGETS,
    CONFIG_CLASS_NAMES,
    CONFIG_CLASSES,
    EventName,
    OptimizerConfig,
    SchedulerConfig,
    SupportedDataParserConfig,
    TrainerConfig,
)
from normlift_ns.errors import InputError
from normlift_ns.io.guard import read_text
from normlift_ns.options import LiftOptions, RefineConfig, short_repr

# The YAML of a config.yml, and the current paths of the files of its run. This part constructs no objects.


OBJECT_TAG = "tag:yaml.org,2002:python/object"
_MAX_BYTES = 2**18
"""Maximum size of a config.yml in bytes. Configs of nerfstudio have about 6,000 bytes."""
_EXPECTED = "With --load-config, give the config.yml that ns-train or ns-normlift wrote."


def check_config_exists(path: Path, wrote: str = "ns-train") -> None:
    """Raise FileNotFoundError unless a config.yml exists and is a file.

    Args:
        path: Path of a config.yml.
        wrote: Command that writes such files, for the error message.
    """
    if not path.is_file():
        problem = "is not a file" if path.exists() else "does not exist"
        hint = f"; give {path / 'config.yml'}" if (path / "config.yml").is_file() else ""
        method = "splatfacto" if wrote == "ns-train" else "normlift"
        raise FileNotFoundError(
            f"The config {path} {problem}{hint}. Expected the config.yml that {wrote} wrote, for example "
            f"--load-config outputs/fox/{method}/2024-05-01_120000/config.yml."
        )


def compose_config(path: Path) -> yaml.MappingNode:
    """Return the YAML tree of a nerfstudio config.

    Raises:
        FileNotFoundError: The file does not exist.
        OSError, ValueError: The file cannot be read, or is not a nerfstudio config with a method name.
    """
    check_config_exists(path)
    size = path.stat().st_size
    if size > _MAX_BYTES:
        raise InputError(
            f"{path} is not a nerfstudio config: it has {size:,} bytes, expected at most {_MAX_BYTES:,}. {_EXPECTED}"
        )
    try:
        root = yaml.compose(read_text(path), Loader=getattr(yaml, "CSafeLoader", yaml.SafeLoader))
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
    """Return a description of a YAML error without line breaks, with the line number if it is known."""
    if isinstance(error, RecursionError):
        return "it is nested too deeply"
    if isinstance(error, yaml.MarkedYAMLError):
        line = "" if error.problem_mark is None else f", line {error.problem_mark.line + 1}"
        return f"{error.problem}{line}"
    return " ".join(str(error).split())


def config_string(node: yaml.Node | None, *keys: str) -> str | None:
    """Return the scalar at a path of keys in nested mappings as text, or None if it does not exist."""
    value = _value(node, *keys)
    return value.value if isinstance(value, yaml.ScalarNode) else None


def _value(node: yaml.Node | None, *keys: str) -> yaml.Node | None:
    for key in keys:
        entries = node.value if isinstance(node, yaml.MappingNode) else ()
        node = next((value for name, value in entries if isinstance(name, yaml.ScalarNode) and name.value == key), None)
    return node


def _stored_path(node: yaml.Node | None, *keys: str) -> Path | None:
    """Return a path that nerfstudio stored as a list of its parts, or None if it does not exist."""
    value = _value(node, *keys)
    if not isinstance(value, yaml.SequenceNode) or not value.tag.endswith("Path"):
        return None
    parts = [part.value for part in value.value if isinstance(part, yaml.ScalarNode)]
    return Path(*parts) if 0 < len(parts) == len(value.value) else None


@dataclass(frozen=True)
class ConfigPaths:
    """Names and paths in the config of a trained or lifted run; None for missing or invalid ones."""

    experiment: str | None
    output_dir: Path | None
    """Folder of the experiments, as in `RunLocation`."""
    data: tuple[Path, ...]
    """Possible paths of the dataset; empty if they are unknown."""


def read_config_paths(path: Path) -> ConfigPaths:
    """Read names and paths from the YAML of a config.yml, without constructing the config.

    Raises:
        FileNotFoundError, OSError, ValueError: As in `compose_config`.
    """
    root = compose_config(path)
    names = [config_string(root, key) for key in ("experiment_name", "method_name", "timestamp")]
    data = _stored_path(root, "pipeline", "datamanager", "data")
    data = data or _stored_path(root, "pipeline", "datamanager", "dataparser", "data")
    configured = _stored_path(root, "output_dir")
    if configured is None:
        return ConfigPaths(names[0], None, ())
    output_dir, root = _folders(_absolute(path).parent, names, configured)
    return ConfigPaths(names[0], output_dir, () if data is None else tuple(_dataset_candidates(data, output_dir, root)))


@dataclass(frozen=True)
class RunLocation:
    """Current absolute paths of the files of a run."""

    run_dir: Path
    """Folder of config.yml."""
    output_dir: Path
    """Folder of the experiments (default: outputs/); for a moved run, a folder in the current directory."""
    root: Path | None
    """Working directory of the training, which stock ns-* commands need.

    None if it is unknown, because output_dir is absolute or the run was moved.
    """
    data: Path
    """Path of the dataset, a folder or a .json file."""
    data_moved: bool
    """False if `data` was found at the path in the config, relative to `root`; otherwise True."""

    @property
    def folder(self) -> Path:
        """Folder of the dataset."""
        return self.data.parent if self.data.suffix == ".json" else self.data

    def relative_to_root(self, path: Path) -> Path:
        """Return a path relative to `root`, as stored in configs; unchanged if it is outside of `root`."""
        return path.relative_to(self.root) if self.root is not None and path.is_relative_to(self.root) else path


def locate_run(config: Any, config_path: Path, data: Path | None = None) -> RunLocation:
    """Locate the files of a run from the path of its config.yml.

    Paths in a config.yml are relative to the working directory of the training, which the file does not contain. The
    function infers this directory from the path output_dir/experiment/method/timestamp/config.yml.

    Args:
        config: Contents of config.yml.
        config_path: Path of config.yml.
        data: Current path of the dataset, relative to the current directory; None for the path in the config.
    Raises:
        FileNotFoundError: The dataset does not exist. The message gives all paths that were tried.
    """
    run_dir = _absolute(config_path).parent
    names = (str(config.experiment_name), str(config.method_name), config.timestamp)
    output_dir, root = _folders(run_dir, names, config.output_dir)
    if data is not None:
        if not data.exists():
            raise FileNotFoundError(
                f"The dataset {_absolute(data)}, given with --data, does not exist. Give the folder or the "
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
        f"The dataset of {config_path} is not at {' or '.join(map(str, tried))}; the config has {str(stored)!r}. "
        "If it was moved, give its new path with --data."
    )


def _folders(run_dir: Path, names: Sequence[str | None], output_dir: Path) -> tuple[Path, Path | None]:
    """Return the folder of the experiments, and the working directory of the training.

    For a run that is not in experiment/method/timestamp, the folder is in the current directory. The working directory
    is None if it is unknown.

    Args:
        run_dir: Folder of config.yml.
        names: Experiment, method and timestamp.
        output_dir: Folder in the config, relative to the working directory.
    """
    inferred = _strip_tail(run_dir, Path(*filter(None, names))) if all(names) else None
    if inferred is not None:
        return inferred, _strip_tail(inferred, Path(os.path.normpath(output_dir)))
    # a moved run gets a folder in the current directory, even if the folder in the config is outside of it
    is_elsewhere = output_dir.is_absolute() or ".." in output_dir.parts
    return _absolute(Path("outputs") if is_elsewhere else output_dir), None


def _dataset_candidates(stored: Path, output_dir: Path, root: Path | None) -> list[Path]:
    """Return the possible absolute paths of a dataset, given its path relative to the working directory of the
    training.

    If `root` is None, this directory is unknown, and may be any parent of `output_dir`. The current directory is last.
    """
    roots = output_dir.parents if root is None else (root,)
    return list(dict.fromkeys(_absolute(base / stored) for base in (*roots, Path.cwd())))


def _strip_tail(path: Path, tail: Path) -> Path | None:
    """Return `path` without the relative path `tail` at its end, or None if it does not end with `tail`."""
    count = len(path.parts) - len(tail.parts)
    return Path(*path.parts[:count]) if count > 0 and path.parts[count:] == tail.parts else None


def dataset_in_config(config: Any) -> Path:
    """Return the path of the dataset as stored in a config."""
    datamanager = config.pipeline.datamanager
    return Path(datamanager.data if datamanager.data is not None else datamanager.dataparser.data)


def _absolute(path: Path) -> Path:
    return Path(os.path.abspath(path))


# Construction of the objects in a config.yml from allowed classes only, and a writer for such files.


_NAME_TAG, _TUPLE_TAG = "tag:yaml.org,2002:python/name:", "tag:yaml.org,2002:python/tuple"


CONFIG_TARGETS: dict[str, str | None] = {
    name: name.removesuffix("Config")
    if name.startswith("normlift_ns.plugin.") and cls in CLASS_TARGETS
    else CLASS_TARGETS.get(cls)
    for name, cls in CONFIG_CLASSES.items()
}
"""Name of the class or function that each configuration class instantiates, keyed by the name of the configuration
class; None if there is none."""
_TARGETS = {target for target in CONFIG_TARGETS.values() if target is not None}
_TARGET = "_target"
"""Field of a config.yml with the class or function that a configuration class instantiates.

The mirror classes do not have it. The loader checks its value, and the dumper adds it.
"""
_PATHS = {f"pathlib.{name}" for name in ("PosixPath", "WindowsPath", "PurePosixPath", "PureWindowsPath", "Path")}


@dataclass(frozen=True)
class _Name:
    """Name of a class or function in a config, which the loader neither imports nor calls."""

    name: str


class ConfigLoader(yaml.SafeLoader):
    """YAML loader that constructs the parts of splatfacto's configs and rejects all other objects.

    nerfstudio uses `yaml.Loader`, which can import any module and call any function in the file. This loader imports
    no modules, and calls only the constructors of paths and one enum. Objects become instances of the mirror classes.
    `unknown` collects the fields that the mirror classes do not have, with their values.
    """

    def __init__(self, stream: str) -> None:
        super().__init__(stream)
        self.unknown: list[tuple[str, str, Any]] = []
        """Name of the class, name and value of each unknown field."""

    def pass_over(self, cls: type, known: dict[str, Any], values: dict[str, Any]) -> None:
        """Add to `unknown` the fields that a class does not have, with their values."""
        self.unknown += [(cls.__name__, name, value) for name, value in values.items() if name not in known]

    def flatten_mapping(self, node: yaml.MappingNode) -> None:
        """Reject merge keys (`<<`), which configs do not use. A few nested ones could fill the memory."""
        for key, _ in node.value:
            if key.tag == "tag:yaml.org,2002:merge":
                raise _error("<< is not allowed in a configuration", key)

    def construct_mapping(self, node: Any, deep: bool = False) -> dict[Any, Any]:
        """Construct a mapping, and reject duplicate keys."""
        mapping = super().construct_mapping(node, deep)
        if len(mapping) < len(node.value):
            raise _error("a key occurs twice", node)
        return mapping


def _error(problem: str, node: yaml.Node) -> yaml.constructor.ConstructorError:
    return yaml.constructor.ConstructorError(None, None, problem, node.start_mark)


def _construct_object(loader: ConfigLoader, name: str, node: yaml.Node) -> Any:
    if name not in CONFIG_TARGETS or not isinstance(node, yaml.MappingNode):
        kind = "one of the supported data parsers" if name.endswith("DataParserConfig") else "part of a configuration"
        raise _error(f"{name} is not {kind}", node)
    cls: Any = CONFIG_CLASSES[name]
    target = CONFIG_TARGETS[name]
    config = cls.__new__(cls)
    yield config
    values = loader.construct_mapping(node, deep=True)
    known = {field.name: field for field in fields(cls)}
    stored = values.pop(_TARGET, None if target is None else _Name(target))
    if target is not None and not (isinstance(stored, _Name) and stored.name == target):
        stored_name = stored.name if isinstance(stored, _Name) else type(stored).__name__
        raise _error(f"the _target of {name} is {stored_name}, expected {target}", node)
    if hasattr(config, "__setstate__"):
        config.__setstate__(values)  # renames the fields of version 0.1
        values = dict(vars(config))
    loader.pass_over(cls, known, values)
    vars(config).clear()
    for key, field in known.items():
        if key in values:
            vars(config)[key] = values[key]
        elif field.default is not MISSING:
            vars(config)[key] = field.default  # the version that wrote the file does not have this field
        else:
            raise _error(f"{name} has no {key}", node)


def _construct_call(loader: ConfigLoader, name: str, node: yaml.Node) -> Any:
    if not isinstance(node, yaml.SequenceNode) or name not in {*_PATHS, CONFIG_CLASS_NAMES[EventName]}:
        raise _error(f"{name} is not part of a configuration", node)
    parts = loader.construct_sequence(node, deep=True)
    if not all(isinstance(part, str) for part in parts):
        raise _error(f"the arguments of {name} are not text", node)
    return Path(*parts) if name in _PATHS else EventName(*parts)  # also for paths of another operating system


def _construct_name(loader: ConfigLoader, name: str, node: yaml.Node) -> Any:
    if name not in _TARGETS:
        raise _error(f"{name} is not part of a configuration", node)
    return _Name(name)


def _construct_tuple(loader: ConfigLoader, node: Any) -> tuple[Any, ...]:
    return tuple(loader.construct_sequence(node, deep=True))


ConfigLoader.add_multi_constructor(f"{OBJECT_TAG}:", _construct_object)
ConfigLoader.add_multi_constructor(f"{OBJECT_TAG}/apply:", _construct_call)
ConfigLoader.add_multi_constructor(_NAME_TAG, _construct_name)
ConfigLoader.add_constructor(_TUPLE_TAG, _construct_tuple)


class _ConfigDumper(yaml.Dumper):
    """YAML dumper that writes instances of mirror classes under the names of nerfstudio's classes."""


def _represent(dumper: _ConfigDumper, config: Any) -> yaml.Node:
    name, target = CONFIG_CLASS_NAMES[type(config)], CLASS_TARGETS.get(type(config))
    if isinstance(config, EventName):
        return dumper.represent_sequence(f"{OBJECT_TAG}/apply:{name}", [config.value])
    values = vars(config) if target is None else {_TARGET: _NAMES[target], **vars(config)}
    return dumper.represent_mapping(f"{OBJECT_TAG}:{name}", values)


_NAMES = {name: _Name(name) for name in CLASS_TARGETS.values()}
"""One object per name, so that a dump writes repeated names as YAML aliases, as nerfstudio does for classes."""
for _cls in CONFIG_CLASS_NAMES:
    _ConfigDumper.add_representer(_cls, _represent)
_ConfigDumper.add_representer(_Name, lambda dumper, name: dumper.represent_scalar(_NAME_TAG + name.name, ""))


def dump_config(config: Any) -> str:
    """Return a config as the text of a config.yml in nerfstudio's format."""
    return yaml.dump(config, Dumper=_ConfigDumper)


# Validation of the values in a config.yml, before nerfstudio uses them.


_PARTS = {
    "pipeline": ("VanillaPipelineConfig", "NormLiftPipelineConfig"),
    "pipeline.datamanager": ("FullImageDatamanagerConfig",),
    "pipeline.datamanager.dataparser": tuple(cls.__name__ for cls in get_args(SupportedDataParserConfig)),
    "pipeline.model": ("SplatfactoModelConfig", "NormLiftModelConfig"),
}
_RANGES: dict[str, tuple[Callable[[Any], bool], str]] = {
    "pipeline.model.sh_degree": (lambda x: 0 <= x <= 4, "0 to 4"),
    "pipeline.model.sh_degree_interval": (lambda x: x >= 1, "at least 1"),
    "pipeline.datamanager.camera_res_scale_factor": (lambda x: 0 < x <= 1, "above 0 and at most 1"),
    "pipeline.datamanager.dataparser.scale_factor": (lambda x: x > 0, "above 0"),
    "pipeline.datamanager.dataparser.downscale_factor": (lambda x: x is None or 1 <= x <= 2**10, "1 to 1024, or null"),
    "pipeline.datamanager.dataparser.train_split_fraction": (lambda x: 0 < x <= 1, "above 0 and at most 1"),
    "pipeline.datamanager.dataparser.eval_interval": (lambda x: x >= 1, "at least 1"),
}
"""Checks and descriptions of the ranges of numbers that affect a lift. Some data parsers do not have all of these
numbers."""
_MAX_DEPTH, _MAX_INT = 12, 2**53
_REMEDY = "Restore the original config.yml of the run."
_TRAINING_ONLY = re.compile(
    r"(machine|logging|viewer)\..*|pipeline\.datamanager\.(cache_images|cache_images_type|train_cameras_sampling_strategy)"
)
"""Pattern for the names of fields that affect neither rendering nor the choice of the lifted images."""
_DRAWN = re.compile(
    r"2d|3dgut|unscented|kernel|filter|near_plane|far_plane|radius_clip|eps2d|camera_model|raster|render|modifier|"
    r"activation|antialias|appearance|embed|deform|motion|exposure|blur|distort"
)
"""Words in the names of fields that may affect rendering or camera poses."""
_CLASSES_OF_DRAWN = ("SplatfactoModelConfig", "NormLiftModelConfig", "CameraOptimizerConfig")
_NOTHING = (None, False, 0, "", "off", "none", "default")


def export_advice(path: Path) -> str:
    """Return a sentence with commands that lift the Gaussians of a run with an unsupported config or dataset.

    Args:
        path: Path of the config.yml of the run.
    """
    return (
        "If the run has standard Gaussians, export them with: ns-export gaussian-splat --load-config "
        f"{path} --output-dir exports, and lift them with: ns-normlift --load-ply exports/splat.ply --transforms "
        f"transforms.json (or --colmap PROJECT) --world-transform {path.parent / 'dataparser_transforms.json'}"
    )


def check_config_values(config: Any, path: Path, say: Callable[[str], None] = lambda text: None) -> None:
    """Raise if a config contains values that stock splatfacto does not accept.

    The function replaces unknown choices of newer versions with the default if they do not affect a lift.

    Args:
        config: Config to check.
        path: Path of its file, for error messages.
        say: Function that is called with a sentence for each replaced choice.
    Raises:
        ValueError: A value does not match its type, a number is out of range, or a folder name or a component is not
            supported.
    """
    if type(config) is not TrainerConfig:
        raise InputError(f"{path} is a {type(config).__name__}, expected a TrainerConfig. {_REMEDY}")
    check_components(config, path)
    for name, value, expected in chain(
        _type_errors(config, TrainerConfig, "", 0), _name_errors(config), _range_errors(config)
    ):
        if isinstance(value, str) and _TRAINING_ONLY.fullmatch(name) and expected.startswith("'"):  # names of choices
            part, _, field = name.rpartition(".")
            owner: Any = attrgetter(part)(config)
            setattr(owner, field, next(item.default for item in fields(owner) if item.name == field))
            say(f"{path}: {name} is {_format(value)}. This value is ignored, because it does not affect a lift.")
            continue
        raise InputError(f"{path}: {name} is {_format(value)}, expected {expected}. {_REMEDY}")
    pipeline: Any = config.pipeline
    if hasattr(pipeline, "lift"):
        check_lift_options(pipeline.lift, f"{path}: pipeline.lift")


def check_components(config: Any, path: Path) -> None:
    """Raise if the pipeline, data manager, data parser or model of a config is not supported.

    Raises:
        ValueError: One of them is an instance of a different class. The message gives its class and the expected
            classes.
    """
    for name, classes in _PARTS.items():
        cls = type(attrgetter(name)(config))
        full_name = CONFIG_CLASS_NAMES.get(cls, f"{cls.__module__}.{cls.__qualname__}")
        if cls.__name__ not in classes or full_name not in CONFIG_TARGETS:
            raise InputError(
                f"{path} has the method {str(config.method_name)!r}, but its {name} is {full_name}, expected "
                f"{' or '.join(classes)}. Only stock splatfacto runs can be lifted. "
                f"{export_advice(path)}"
            )


def _format(value: Any) -> str:
    """Return a short description of a value for error messages."""
    if isinstance(value, str | bool | int | float | Path):
        return short_repr(str(value) if isinstance(value, Path) else value)
    return "null" if value is None else f"a {type(value).__name__}"


def _type_errors(value: Any, hint: Any, name: str, depth: int) -> Iterator[tuple[str, Any, str]]:
    """Yield the field name, value and expected type of each value that does not match its type hint."""
    parts, origin = get_args(hint), get_origin(hint)
    if depth > _MAX_DEPTH:
        yield name, value, "less deeply nested values"
    elif hint is Any:
        yield from _optimizer_errors(value, name) if name.startswith("optimizers.") else ()
    elif origin in (Union, types.UnionType):
        yield from _union_errors(value, parts, name, depth)
    elif origin is Literal:
        if not any(type(value) is type(part) and value == part for part in parts):
            yield name, value, " or ".join(map(repr, parts))
    elif not _fits(value, hint):
        yield name, value, _describe(hint)
    else:
        for key, item, item_hint in _items(value, hint):
            yield from _type_errors(item, item_hint, f"{name}{key}".removeprefix("."), depth + 1)


def _union_errors(value: Any, parts: tuple[Any, ...], name: str, depth: int) -> Iterator[tuple[str, Any, str]]:
    classes = [part for part in parts if is_dataclass(part) and type(value) is part]
    errors = [list(_type_errors(value, part, name, depth)) for part in classes or parts]
    if all(errors):
        yield errors[0][0] if classes else (name, value, " or ".join(map(_describe, parts)))


def _fits(value: Any, hint: Any) -> bool:
    """Return True if a value matches a type hint; the items of containers are not checked."""
    parts, origin = get_args(hint), get_origin(hint)
    if origin is tuple:
        return isinstance(value, tuple | list) and (parts[-1] is Ellipsis or len(value) == len(parts))
    if origin is dict:
        return isinstance(value, dict) and all(isinstance(key, str) for key in value)
    return _SCALARS[hint][0](value) if hint in _SCALARS else not isinstance(hint, type) or isinstance(value, hint)


def _items(value: Any, hint: Any) -> Iterator[tuple[str, Any, Any]]:
    """Yield the suffix of the name, the value and the type hint of each item in a value."""
    parts, origin = get_args(hint), get_origin(hint)
    if origin is tuple:
        hints = parts[:1] * len(value) if parts[-1] is Ellipsis else parts
        yield from ((f"[{i}]", item, item_hint) for i, (item, item_hint) in enumerate(zip(value, hints)))
    elif origin is dict:
        yield from ((f".{key[:40]}", item, parts[1]) for key, item in value.items())
    elif is_dataclass(hint):
        hints = get_type_hints(type(value))
        for name in (field.name for field in fields(value)):
            if name != "vis":  # affects only training, and programs set it to values that ns-train does not accept
                yield f".{name}", getattr(value, name), hints[name]


_SCALARS: dict[Any, tuple[Callable[[Any], bool], str]] = {
    float: (lambda x: type(x) is not bool and isinstance(x, int | float) and abs(x) <= 1e300, "a finite number"),
    int: (lambda x: type(x) is int and abs(x) <= _MAX_INT, "a whole number"),
    str: (lambda x: isinstance(x, str) and "\0" not in x, "text"),
    Path: (lambda x: isinstance(x, Path) and "\0" not in str(x), "a path"),
    type(None): (lambda x: x is None, "null"),
}
"""Check of values, and description of valid values, for each type hint."""


def _optimizer_errors(value: Any, name: str) -> Iterator[tuple[str, Any, str]]:
    """Yield the errors in an entry of `optimizers`, for which nerfstudio has no type hints."""
    if not isinstance(value, dict) or set(value) != {"optimizer", "scheduler"}:
        yield name, value, "an optimizer and a scheduler"
        return
    yield from _type_errors(value["optimizer"], OptimizerConfig, f"{name}.optimizer", 2)
    yield from _type_errors(value["scheduler"], SchedulerConfig | None, f"{name}.scheduler", 2)


def _describe(hint: Any) -> str:
    if hint in _SCALARS:
        return _SCALARS[hint][1]
    return getattr(hint, "__name__", None) or str(hint).replace("typing.", "")


def _name_errors(config: TrainerConfig) -> Iterator[tuple[str, Any, str]]:
    """Yield invalid folder names, and paths outside of the folder of the run."""
    for name in ("experiment_name", "method_name", "timestamp"):
        value = getattr(config, name)
        if (
            not isinstance(value, str)
            or value.strip() in ("", ".", "..")
            or {"/", "\\", "\0", "\n"} & set(value)
            or len(value) > 255
        ):
            yield name, value, "the name of a single folder"
    for name in ("viewer.relative_log_filename", "logging.relative_log_dir", "relative_model_dir"):
        value = Path(attrgetter(name)(config))
        if value.is_absolute() or ".." in value.parts:
            yield name, value, "a relative path in the folder of the run"


def _range_errors(config: TrainerConfig) -> Iterator[tuple[str, Any, str]]:
    """Yield the numbers of `_RANGES` that are out of range."""
    for name, (in_range, expected) in _RANGES.items():
        part, _, field = name.rpartition(".")
        values = vars(attrgetter(part)(config))
        if field in values and not in_range(values[field]):
            yield name, values[field], expected


def check_lift_options(options: LiftOptions, name: str) -> None:
    """Check the ranges of lift options, which are not checked when they are read from a config.yml.

    Args:
        options: Options to check.
        name: Path or name of the options, for error messages.
    Raises:
        ValueError: An option is out of range.
    """
    try:
        RefineConfig(**vars(options.vote))
        LiftOptions(**vars(options))
    except ValueError as error:
        raise InputError(f"{name}: {error}") from error


SUPPORTED_METHODS = (
    *("splatfacto", "splatfacto-big", "splatfacto-mcmc"),  # splatfacto-mcmc is in nerfstudio's main branch
    *("normlift", "normlift-lerf-ovs", "normlift-scannet"),
)


def read_trainer_config(path: Path, say: Callable[[str], None] = lambda text: None) -> TrainerConfig:
    """Read the config.yml of a splatfacto or normlift run, with its paths unchanged.

    Args:
        path: Path of the config.yml.
        say: Function that is called with a sentence about ignored settings.
    Raises:
        FileNotFoundError: The file does not exist.
        OSError: The file cannot be read.
        ValueError: The file is not a nerfstudio config, or it has an unsupported method, data parser or class, or
            invalid values.
    """
    root = compose_config(path)
    method = config_string(root, "method_name")
    if method not in SUPPORTED_METHODS:
        raise InputError(
            f"{path} has the method {method!r}, expected one of {', '.join(SUPPORTED_METHODS)}. "
            f"Train the capture with: ns-train splatfacto --data DATASET. {export_advice(path)}"
        )
    loader = ConfigLoader("")
    try:
        config = loader.construct_document(root)
    except Exception as error:  # PyYAML does not catch errors of dates, numbers and sets
        raise InputError(
            f"{path} cannot be read: {describe_yaml_error(error)}. Expected only configuration classes of splatfacto "
            "and normlift_ns, nerfstudio's optimizers, and the data parsers nerfstudio-data, colmap and blender-data. "
            f"{export_advice(path)}"
        ) from error
    for cls, name, value in loader.unknown:
        if cls in _CLASSES_OF_DRAWN and _DRAWN.search(name) and value not in _NOTHING:
            raise InputError(
                f"{path}: {cls} has the unknown setting {name}: {_format(value)}, which may affect rendering. "
                f"{export_advice(path)}"
            )
    if len(loader.unknown) > 0:
        names = ", ".join(f"{cls}.{name}" for cls, name, _ in loader.unknown)
        say(f"{path} has settings of another version of nerfstudio, which are ignored: {names[:1000]}.")
    check_config_values(config, path, say)
    return config


def with_absolute_paths(config: Any, location: RunLocation) -> Any:
    """Return a copy of a config for use in any directory, with absolute paths of the dataset and the checkpoints.

    The copy does not load seed points.
    """
    config = deepcopy(config)
    set_dataset(config, location.data)
    skip_seed_points(config)
    if location.root is not None:
        config.output_dir = location.root / config.output_dir
    config.relative_model_dir = location.run_dir / config.relative_model_dir
    return config


def set_dataset(config: Any, data: Path) -> None:
    """Set the path of the dataset in all three fields of a config that contain it."""
    datamanager = config.pipeline.datamanager
    config.data = datamanager.data = datamanager.dataparser.data = data


def skip_seed_points(config: Any) -> None:
    """Change a config so that the data parser does not read the initial point cloud, which only training needs."""
    dataparser = config.pipeline.datamanager.dataparser
    for name, value in (("load_3D_points", False), ("ply_path", None)):
        if hasattr(dataparser, name):
            setattr(dataparser, name, value)
