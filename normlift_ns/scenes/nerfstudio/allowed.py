"""The classes that a config.yml may name, and a YAML loader that knows no others."""

from __future__ import annotations

from dataclasses import MISSING, fields
from pathlib import Path
from typing import Any

import yaml

from normlift_ns.scenes.nerfstudio.classes import NAMES, READ, EventName
from normlift_ns.scenes.nerfstudio.targets import Target, named

OBJECT_TAG = "tag:yaml.org,2002:python/object"
_NAME_TAG, _TUPLE_TAG = "tag:yaml.org,2002:python/name:", "tag:yaml.org,2002:python/tuple"


def _instantiated(cls: type) -> str | None:
    """What a configuration class names as its `_target`."""
    found = {item.name: item for item in fields(cls)}.get("_target")
    if found is None:
        return None
    factory: Any = found.default_factory
    return factory().name


def _pair(name: str, cls: type) -> str | None:
    target = _instantiated(cls)
    return name.removesuffix("Config") if target and name.startswith("normlift_ns.plugin.") else target


PAIRS: dict[str, str | None] = {name: _pair(name, cls) for name, cls in READ.items()}
"""Configuration classes, and what each of them instantiates."""
_TARGETS = {target for target in PAIRS.values() if target is not None}
_PATHS = {f"pathlib.{name}" for name in ("PosixPath", "WindowsPath", "PurePosixPath", "PureWindowsPath", "Path")}


class ConfigLoader(yaml.SafeLoader):
    """Constructs what splatfacto's configs consist of, and refuses everything else.

    nerfstudio reads config.yml with `yaml.Loader`, which imports any module and calls any function that the file names.
    Here nothing is called but the constructors of paths and of one enum, and nothing is imported: objects are of the
    mirrors of nerfstudio's classes.
    """

    def flatten_mapping(self, node: yaml.MappingNode) -> None:
        """Merging (`<<`) is no part of a configuration; nested, it makes a few lines fill the memory."""
        for key, _ in node.value:
            if key.tag == "tag:yaml.org,2002:merge":
                raise _refusal("<< is no part of a configuration", key)

    def construct_mapping(self, node: Any, deep: bool = False) -> dict[Any, Any]:
        """As usual, but every key once."""
        found = super().construct_mapping(node, deep)
        if len(found) < len(node.value):
            raise _refusal("a key stands there twice", node)
        return found


def _refusal(problem: str, node: yaml.Node) -> yaml.constructor.ConstructorError:
    return yaml.constructor.ConstructorError(None, None, problem, node.start_mark)


def _construct_object(loader: ConfigLoader, name: str, node: yaml.Node) -> Any:
    if name not in PAIRS or not isinstance(node, yaml.MappingNode):
        parser = " is not one of the data parsers that are read" if name.endswith("DataParserConfig") else ""
        raise _refusal(f"{name}{parser or ' is no part of a configuration'}", node)
    cls: Any = READ[name]
    target = PAIRS[name]
    config = cls.__new__(cls)
    yield config
    values = loader.construct_mapping(node, deep=True)
    known = {field.name: field for field in fields(cls)}
    if "_target" in known and target is not None:
        found = values.get("_target", Target(target))
        if found != Target(target) or not isinstance(found, Target):
            called = found.name.rpartition(".")[2] if isinstance(found, Target) else type(found).__name__
            raise _refusal(f"the _target of {name} is {called}, expected {target}", node)
        values["_target"] = named(_instantiated(cls) or target)  # today's, where the file has that of version 0.1
    if hasattr(config, "__setstate__"):
        config.__setstate__(values)  # renames what version 0.1 called otherwise
        values = dict(vars(config))
    vars(config).clear()
    for key, field in known.items():  # what this version of nerfstudio does not know is left out
        if key in values:
            vars(config)[key] = values[key]
        elif field.default is not MISSING:
            vars(config)[key] = field.default  # what its version did not know
        else:
            raise _refusal(f"{name} has no {key}", node)


def _construct_call(loader: ConfigLoader, name: str, node: yaml.Node) -> Any:
    if not isinstance(node, yaml.SequenceNode) or name not in {*_PATHS, NAMES[EventName]}:
        raise _refusal(f"{name} is no part of a configuration", node)
    parts = loader.construct_sequence(node, deep=True)
    if not all(isinstance(part, str) for part in parts):
        raise _refusal(f"{name} is made of other things than text", node)
    return Path(*parts) if name in _PATHS else EventName(*parts)  # also the paths of another operating system


def _construct_name(loader: ConfigLoader, name: str, node: yaml.Node) -> Any:
    if name not in _TARGETS:
        raise _refusal(f"{name} is no part of a configuration", node)
    return named(name)


def _construct_tuple(loader: ConfigLoader, node: Any) -> tuple[Any, ...]:
    return tuple(loader.construct_sequence(node, deep=True))


ConfigLoader.add_multi_constructor(f"{OBJECT_TAG}:", _construct_object)
ConfigLoader.add_multi_constructor(f"{OBJECT_TAG}/apply:", _construct_call)
ConfigLoader.add_multi_constructor(_NAME_TAG, _construct_name)
ConfigLoader.add_constructor(_TUPLE_TAG, _construct_tuple)


class _Dumper(yaml.Dumper):
    """Writes the mirrors as nerfstudio writes its own classes."""


def _object(dumper: _Dumper, config: Any) -> yaml.Node:
    return dumper.represent_mapping(f"{OBJECT_TAG}:{NAMES[type(config)]}", vars(config))


def _event(dumper: _Dumper, event: EventName) -> yaml.Node:
    return dumper.represent_sequence(f"{OBJECT_TAG}/apply:{NAMES[EventName]}", [event.value])


for _cls in NAMES:
    _Dumper.add_representer(_cls, _event if _cls is EventName else _object)
_Dumper.add_representer(Target, lambda dumper, target: dumper.represent_scalar(_NAME_TAG + target.name, ""))


def dump_config(config: Any) -> str:
    """The text of a config.yml, as nerfstudio writes it."""
    return yaml.dump(config, Dumper=_Dumper)
