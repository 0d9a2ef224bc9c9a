"""Validation of the values in a config.yml, before nerfstudio uses them."""

from __future__ import annotations

import types
from collections.abc import Iterator
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import Any, Literal, Union, get_args, get_origin, get_type_hints

from normlift_ns.errors import InputError
from normlift_ns.options import LiftOptions, RefineConfig
from normlift_ns.scenes.nerfstudio.allowed import PAIRS
from normlift_ns.scenes.nerfstudio.classes import NAMES, SplatfactoModelConfig, TrainerConfig
from normlift_ns.scenes.nerfstudio.data_classes import DataParser, FullImageDatamanagerConfig
from normlift_ns.scenes.nerfstudio.optimizer_classes import OptimizerConfig, SchedulerConfig

_PARTS = {
    "pipeline": ("VanillaPipelineConfig", "NormLiftPipelineConfig"),
    "pipeline.datamanager": ("FullImageDatamanagerConfig",),
    "pipeline.datamanager.dataparser": tuple(cls.__name__ for cls in get_args(DataParser)),
    "pipeline.model": ("SplatfactoModelConfig", "NormLiftModelConfig"),
}
_UNCHECKED = ("_target", "vis")
"""Fields that are not checked here. The loader compares `_target`; `vis` only matters for training, and programs set it
to values that the flag does not accept."""
_MAX_DEPTH, _MAX_INT = 12, 2**53
_REMEDY = "Restore the config.yml that ns-train wrote, or train the capture again with: ns-train splatfacto --data ..."


def check_config(config: Any, path: Path) -> None:
    """Raise if a config holds values with which stock splatfacto cannot have been trained.

    Raises:
        ValueError: if a value does not match its type, a number is out of range, a folder name is invalid, or a
            component is not splatfacto's.
    """
    if type(config) is not TrainerConfig:
        raise InputError(f"{path} is a {type(config).__name__}, expected a TrainerConfig. {_REMEDY}")
    check_parts(config, path)
    for name, value, expected in _type_errors(config, TrainerConfig, "", 0):
        raise InputError(f"{path}: {name} is {_format(value)}, expected {expected}. {_REMEDY}")
    _check_names(config, path)
    pipeline: Any = config.pipeline
    for name, value, in_range, expected in _ranges(pipeline.model, pipeline.datamanager):
        if not in_range:
            raise InputError(f"{path}: {name} is {_format(value)}, expected {expected}. {_REMEDY}")
    if hasattr(pipeline, "lift"):
        check_options(pipeline.lift, f"{path}: pipeline.lift")


def check_parts(config: Any, path: Path) -> None:
    """Raise if the pipeline, data manager, data parser or model is not one of the supported classes.

    Raises:
        ValueError: if one of them is an instance of another class; the message names both classes.
    """
    for name, classes in _PARTS.items():
        part: Any = config
        for step in name.split("."):
            part = getattr(part, step)
        cls = type(part)
        if cls.__name__ not in classes or NAMES.get(cls, f"{cls.__module__}.{cls.__qualname__}") not in PAIRS:
            raise InputError(
                f"{path} has the method {str(config.method_name)!r}, but its {name} is a {cls.__name__}, expected "
                f"{' or '.join(classes)}; only stock splatfacto runs can be lifted. "
                "Train the capture with: ns-train splatfacto --data ..."
            )


def _format(value: Any) -> str:
    """Format any value briefly."""
    if value is None or isinstance(value, str | bool | int | float | Path):
        try:
            text = "null" if value is None else repr(str(value) if isinstance(value, Path) else value)
        except ValueError:  # an integer of thousands of digits
            text = "a huge number"
        return text if len(text) <= 60 else f"{text[:60]}…"
    return f"a {type(value).__name__}"


def _type_errors(value: Any, hint: Any, name: str, depth: int) -> Iterator[tuple[str, Any, str]]:
    """Yield values that violate their type hints: field name, value, and what was expected."""
    origin, parts = get_origin(hint), get_args(hint)
    if depth > _MAX_DEPTH:
        yield name, value, "no more than a few levels"
    elif hint is Any:
        yield from _optimizer_errors(value, name) if name.startswith("optimizers.") else ()
    elif origin in (Union, types.UnionType):
        classes = [part for part in parts if is_dataclass(part) and type(value) is part]
        errors = [list(_type_errors(value, part, name, depth)) for part in classes or parts]
        if all(errors):
            yield errors[0][0] if classes else (name, value, " or ".join(map(_describe, parts)))
    elif origin is Literal:
        if not any(type(value) is type(part) and value == part for part in parts):
            yield name, value, " or ".join(map(repr, parts))
    elif is_dataclass(hint):
        if not isinstance(value, hint):  # type: ignore[arg-type]
            yield name, value, _describe(hint)
            return
        hints = get_type_hints(type(value))
        for field in fields(value):
            if field.name not in _UNCHECKED:
                full_name = f"{name}.{field.name}" if name else field.name
                yield from _type_errors(getattr(value, field.name), hints[field.name], full_name, depth + 1)
    elif origin is tuple:
        if not isinstance(value, tuple | list) or (parts[-1] is not Ellipsis and len(value) != len(parts)):
            yield name, value, _describe(hint)
        else:
            item_hints = parts[:1] * len(value) if parts[-1] is Ellipsis else parts
            for i, (item, item_hint) in enumerate(zip(value, item_hints)):
                yield from _type_errors(item, item_hint, f"{name}[{i}]", depth + 1)
    elif origin is dict:
        if not isinstance(value, dict) or not all(isinstance(key, str) for key in value):
            yield name, value, _describe(hint)
        else:
            for key, item in value.items():
                yield from _type_errors(item, parts[1], f"{name}.{key[:40]}", depth + 1)
    elif hint is float:
        if isinstance(value, bool) or not isinstance(value, int | float) or not abs(value) <= 1e300:
            yield name, value, "a finite number"
    elif hint is int:
        if type(value) is not int or abs(value) > _MAX_INT:
            yield name, value, "a whole number"
    elif hint is str or hint is Path:
        if not isinstance(value, hint) or "\0" in str(value):
            yield name, value, "text" if hint is str else "a path"
    elif isinstance(hint, type) and not isinstance(value, hint):
        yield name, value, _describe(hint)


def _optimizer_errors(value: Any, name: str) -> Iterator[tuple[str, Any, str]]:
    """Check an entry of `optimizers`, for which nerfstudio has no type hints."""
    if not isinstance(value, dict) or set(value) != {"optimizer", "scheduler"}:
        yield name, value, "an optimizer and a scheduler"
        return
    yield from _type_errors(value["optimizer"], OptimizerConfig, f"{name}.optimizer", 2)
    yield from _type_errors(value["scheduler"], SchedulerConfig | None, f"{name}.scheduler", 2)


def _describe(hint: Any) -> str:
    names = {float: "a number", int: "a whole number", str: "text", Path: "a path", type(None): "null"}
    return names.get(hint) or getattr(hint, "__name__", None) or str(hint).replace("typing.", "")


def _check_names(config: TrainerConfig, path: Path) -> None:
    """Raise if a name or path would lead out of the run's folders."""
    for name in ("experiment_name", "method_name", "timestamp"):
        value = getattr(config, name)
        if (
            not isinstance(value, str)
            or value.strip() in ("", ".", "..")
            or {"/", "\\", "\0", "\n"} & set(value)
            or len(value) > 255
        ):
            raise InputError(f"{path}: {name} is {_format(value)}, expected the name of one folder. {_REMEDY}")
    relative = {
        "viewer.relative_log_filename": Path(config.viewer.relative_log_filename),
        "logging.relative_log_dir": config.logging.relative_log_dir,
        "relative_model_dir": config.relative_model_dir,
    }
    for name, value in relative.items():
        if value.is_absolute() or ".." in value.parts:
            raise InputError(
                f"{path}: {name} is {_format(value)}, expected a relative path in the folder of the run. {_REMEDY}"
            )


def _ranges(
    model: SplatfactoModelConfig, datamanager: FullImageDatamanagerConfig
) -> Iterator[tuple[str, Any, bool, str]]:
    """Yield the numbers that a lift depends on: name, value, whether it is in range, and the range."""
    yield "pipeline.model.sh_degree", model.sh_degree, 0 <= model.sh_degree <= 4, "0 to 4"
    interval = model.sh_degree_interval
    yield "pipeline.model.sh_degree_interval", interval, interval >= 1, "at least 1"
    scale = datamanager.camera_res_scale_factor
    yield "pipeline.datamanager.camera_res_scale_factor", scale, 0 < scale <= 1, "above 0 and at most 1"
    parser: Any = datamanager.dataparser
    limits = {
        "scale_factor": (lambda value: value > 0, "above 0"),
        "downscale_factor": (lambda value: value is None or 1 <= value <= 2**10, "1 to 1024, or null"),
        "train_split_fraction": (lambda value: 0 < value <= 1, "above 0 and at most 1"),
        "eval_interval": (lambda value: value >= 1, "at least 1"),
    }
    for name, (in_range, expected) in limits.items():
        value = getattr(parser, name, None)
        if hasattr(parser, name):
            yield f"pipeline.datamanager.dataparser.{name}", value, in_range(value), expected


def check_options(options: LiftOptions, name: str) -> None:
    """Run the constructors' checks, which neither a config.yml nor `ns-train --load-config` triggers.

    Raises:
        ValueError: if an option is out of range.
    """
    try:
        RefineConfig(**vars(options.vote))
        LiftOptions(**vars(options))
    except ValueError as error:
        raise InputError(f"{name}: {error}. {_REMEDY}") from error
