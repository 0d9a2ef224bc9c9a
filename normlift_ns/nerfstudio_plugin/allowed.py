"""The classes that a config.yml may name, and a YAML loader that knows no others."""

from __future__ import annotations

from dataclasses import MISSING, fields
from importlib import import_module
from pathlib import Path
from typing import Any

import yaml

OBJECT_TAG = "tag:yaml.org,2002:python/object"
_NAME_TAG, _TUPLE_TAG = "tag:yaml.org,2002:python/name:", "tag:yaml.org,2002:python/tuple"
_BASE, _DATA, _OURS = "nerfstudio.configs.base_config", "nerfstudio.data", "normlift_ns.nerfstudio_plugin"

_CAMERA = "nerfstudio.cameras.camera_optimizers.CameraOptimizer"

PAIRS: dict[str, str | None] = {
    "nerfstudio.engine.trainer.TrainerConfig": "nerfstudio.engine.trainer.Trainer",
    f"{_BASE}.MachineConfig": None,
    f"{_BASE}.LoggingConfig": None,
    f"{_BASE}.LocalWriterConfig": "nerfstudio.utils.writer.LocalWriter",
    f"{_BASE}.ViewerConfig": None,
    "nerfstudio.pipelines.base_pipeline.VanillaPipelineConfig": "nerfstudio.pipelines.base_pipeline.VanillaPipeline",
    f"{_DATA}.datamanagers.full_images_datamanager.FullImageDatamanagerConfig": (
        f"{_DATA}.datamanagers.full_images_datamanager.FullImageDatamanager"
    ),
    f"{_DATA}.dataparsers.nerfstudio_dataparser.NerfstudioDataParserConfig": (
        f"{_DATA}.dataparsers.nerfstudio_dataparser.Nerfstudio"
    ),
    f"{_DATA}.dataparsers.colmap_dataparser.ColmapDataParserConfig": (
        f"{_DATA}.dataparsers.colmap_dataparser.ColmapDataParser"
    ),
    f"{_DATA}.dataparsers.blender_dataparser.BlenderDataParserConfig": (
        f"{_DATA}.dataparsers.blender_dataparser.Blender"
    ),
    "nerfstudio.models.splatfacto.SplatfactoModelConfig": "nerfstudio.models.splatfacto.SplatfactoModel",
    f"{_CAMERA}Config": _CAMERA,
    "nerfstudio.engine.optimizers.AdamOptimizerConfig": "torch.optim.adam.Adam",
    "nerfstudio.engine.optimizers.RAdamOptimizerConfig": "torch.optim.radam.RAdam",
    **{
        f"nerfstudio.engine.schedulers.{name}Config": f"nerfstudio.engine.schedulers.{name}"
        for name in ("ExponentialDecayScheduler", "CosineDecayScheduler", "MultiStepScheduler")
    },
    f"{_OURS}.model.NormLiftModelConfig": f"{_OURS}.model.NormLiftModel",
    f"{_OURS}.pipeline.NormLiftPipelineConfig": f"{_OURS}.pipeline.NormLiftPipeline",
    "normlift_ns.plugin.model.NormLiftModelConfig": "normlift_ns.plugin.model.NormLiftModel",  # those of version 0.1
    "normlift_ns.plugin.pipeline.NormLiftPipelineConfig": "normlift_ns.plugin.pipeline.NormLiftPipeline",
    "normlift_ns.plugin.lifting.LiftOptions": None,
    "normlift_ns.core.refine.RefineConfig": None,
    "normlift_ns.encoders.build.SourceOptions": None,
    "normlift_ns.options.LiftOptions": None,
    "normlift_ns.options.SourceOptions": None,
    "normlift_ns.options.RefineConfig": None,
}
"""Configuration classes, and what each of them instantiates."""
_TARGETS = {target for target in PAIRS.values() if target is not None}
_ENUMS = {"nerfstudio.utils.writer.EventName"}
_PATHS = {f"pathlib.{name}" for name in ("PosixPath", "WindowsPath", "PurePosixPath", "PureWindowsPath", "Path")}


class ConfigLoader(yaml.SafeLoader):
    """Constructs what splatfacto's configs consist of, and refuses everything else.

    nerfstudio reads config.yml with `yaml.Loader`, which imports any module and calls any function that the file names.
    Here nothing is called but the constructors of paths and enums, and nothing imported but the classes in `PAIRS`.
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


def _found(name: str) -> Any:
    """A class that stands in one of the lists."""
    module, _, attribute = name.rpartition(".")
    return getattr(import_module(module), attribute)


def _construct_object(loader: ConfigLoader, name: str, node: yaml.Node) -> Any:
    if name not in PAIRS or not isinstance(node, yaml.MappingNode):
        parser = " is not one of the data parsers that are read" if name.endswith("DataParserConfig") else ""
        raise _refusal(f"{name}{parser or ' is no part of a configuration'}", node)
    cls, target = _found(name), PAIRS[name]
    config = cls.__new__(cls)
    yield config
    values = loader.construct_mapping(node, deep=True)
    known = {field.name: field for field in fields(cls)}
    if "_target" in known and target is not None and values.setdefault("_target", _found(target)) is not _found(target):
        found = getattr(values["_target"], "__qualname__", type(values["_target"]).__name__)
        raise _refusal(f"the _target of {name} is {found}, expected {target}", node)
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
    if not isinstance(node, yaml.SequenceNode) or name not in _PATHS | _ENUMS:
        raise _refusal(f"{name} is no part of a configuration", node)
    parts = loader.construct_sequence(node, deep=True)
    if not all(isinstance(part, str) for part in parts):
        raise _refusal(f"{name} is made of other things than text", node)
    return Path(*parts) if name in _PATHS else _found(name)(*parts)  # also the paths of another operating system


def _construct_name(loader: ConfigLoader, name: str, node: yaml.Node) -> Any:
    if name not in _TARGETS:
        raise _refusal(f"{name} is no part of a configuration", node)
    return _found(name)


def _construct_tuple(loader: ConfigLoader, node: Any) -> tuple[Any, ...]:
    return tuple(loader.construct_sequence(node, deep=True))


ConfigLoader.add_multi_constructor(f"{OBJECT_TAG}:", _construct_object)
ConfigLoader.add_multi_constructor(f"{OBJECT_TAG}/apply:", _construct_call)
ConfigLoader.add_multi_constructor(_NAME_TAG, _construct_name)
ConfigLoader.add_constructor(_TUPLE_TAG, _construct_tuple)
