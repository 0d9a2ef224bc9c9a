"""Allow-list of the classes that a config.yml may name, and its safe YAML loader and dumper."""

from __future__ import annotations

from dataclasses import MISSING, fields
from pathlib import Path
from typing import Any

import yaml

from normlift_ns.scenes.nerfstudio.classes import NAMES, READ, EventName
from normlift_ns.scenes.nerfstudio.targets import Target, named

OBJECT_TAG = "tag:yaml.org,2002:python/object"
_NAME_TAG, _TUPLE_TAG = "tag:yaml.org,2002:python/name:", "tag:yaml.org,2002:python/tuple"


def _default_target(cls: type) -> str | None:
    """Return the class that a configuration class names as its `_target`."""
    target = {field.name: field for field in fields(cls)}.get("_target")
    if target is None:
        return None
    factory: Any = target.default_factory
    return factory().name


def _target_name(name: str, cls: type) -> str | None:
    target = _default_target(cls)
    return name.removesuffix("Config") if target and name.startswith("normlift_ns.plugin.") else target


PAIRS: dict[str, str | None] = {name: _target_name(name, cls) for name, cls in READ.items()}
"""Names of the configuration classes, and of the classes that they instantiate."""
_TARGETS = {target for target in PAIRS.values() if target is not None}
_PATHS = {f"pathlib.{name}" for name in ("PosixPath", "WindowsPath", "PurePosixPath", "PureWindowsPath", "Path")}


class ConfigLoader(yaml.SafeLoader):
    """YAML loader that constructs the parts of splatfacto's configs and rejects everything else.

    nerfstudio reads config.yml with `yaml.Loader`, which imports any module and calls any function that the file names.
    This loader imports nothing and calls only the constructors of paths and of one enum; objects are instances of the
    mirrors of nerfstudio's classes.
    """

    def flatten_mapping(self, node: yaml.MappingNode) -> None:
        """Reject merge keys (`<<`). Configs do not use them, and a few nested ones would fill the memory."""
        for key, _ in node.value:
            if key.tag == "tag:yaml.org,2002:merge":
                raise _error("<< is not part of a configuration", key)

    def construct_mapping(self, node: Any, deep: bool = False) -> dict[Any, Any]:
        """Construct a mapping, and reject duplicate keys."""
        mapping = super().construct_mapping(node, deep)
        if len(mapping) < len(node.value):
            raise _error("a key is listed twice", node)
        return mapping


def _error(problem: str, node: yaml.Node) -> yaml.constructor.ConstructorError:
    return yaml.constructor.ConstructorError(None, None, problem, node.start_mark)


def _construct_object(loader: ConfigLoader, name: str, node: yaml.Node) -> Any:
    if name not in PAIRS or not isinstance(node, yaml.MappingNode):
        kind = "one of the supported data parsers" if name.endswith("DataParserConfig") else "part of a configuration"
        raise _error(f"{name} is not {kind}", node)
    cls: Any = READ[name]
    target = PAIRS[name]
    config = cls.__new__(cls)
    yield config
    values = loader.construct_mapping(node, deep=True)
    known = {field.name: field for field in fields(cls)}
    if "_target" in known and target is not None:
        stored = values.get("_target", Target(target))
        if stored != Target(target) or not isinstance(stored, Target):
            stored_name = stored.name.rpartition(".")[2] if isinstance(stored, Target) else type(stored).__name__
            raise _error(f"the _target of {name} is {stored_name}, expected {target}", node)
        values["_target"] = named(_default_target(cls) or target)  # the current name instead of that of version 0.1
    if hasattr(config, "__setstate__"):
        config.__setstate__(values)  # translates the field names of version 0.1
        values = dict(vars(config))
    vars(config).clear()
    for key, field in known.items():  # fields that only newer nerfstudio versions have are dropped
        if key in values:
            vars(config)[key] = values[key]
        elif field.default is not MISSING:
            vars(config)[key] = field.default  # a field that the writer's version did not have
        else:
            raise _error(f"{name} has no {key}", node)


def _construct_call(loader: ConfigLoader, name: str, node: yaml.Node) -> Any:
    if not isinstance(node, yaml.SequenceNode) or name not in {*_PATHS, NAMES[EventName]}:
        raise _error(f"{name} is not part of a configuration", node)
    parts = loader.construct_sequence(node, deep=True)
    if not all(isinstance(part, str) for part in parts):
        raise _error(f"the arguments of {name} are not text", node)
    return Path(*parts) if name in _PATHS else EventName(*parts)  # paths of another operating system work too


def _construct_name(loader: ConfigLoader, name: str, node: yaml.Node) -> Any:
    if name not in _TARGETS:
        raise _error(f"{name} is not part of a configuration", node)
    return named(name)


def _construct_tuple(loader: ConfigLoader, node: Any) -> tuple[Any, ...]:
    return tuple(loader.construct_sequence(node, deep=True))


ConfigLoader.add_multi_constructor(f"{OBJECT_TAG}:", _construct_object)
ConfigLoader.add_multi_constructor(f"{OBJECT_TAG}/apply:", _construct_call)
ConfigLoader.add_multi_constructor(_NAME_TAG, _construct_name)
ConfigLoader.add_constructor(_TUPLE_TAG, _construct_tuple)


class _ConfigDumper(yaml.Dumper):
    """YAML dumper that writes the mirrors as nerfstudio writes its own classes."""


def _represent_object(dumper: _ConfigDumper, config: Any) -> yaml.Node:
    return dumper.represent_mapping(f"{OBJECT_TAG}:{NAMES[type(config)]}", vars(config))


def _represent_event(dumper: _ConfigDumper, event: EventName) -> yaml.Node:
    return dumper.represent_sequence(f"{OBJECT_TAG}/apply:{NAMES[EventName]}", [event.value])


for _cls in NAMES:
    _ConfigDumper.add_representer(_cls, _represent_event if _cls is EventName else _represent_object)
_ConfigDumper.add_representer(Target, lambda dumper, target: dumper.represent_scalar(_NAME_TAG + target.name, ""))


def dump_config(config: Any) -> str:
    """Return the text of a config.yml, as nerfstudio writes it."""
    return yaml.dump(config, Dumper=_ConfigDumper)
